"""Instruments over CAN: messages in ISO 15765-2 (ISO-TP) frames, by the library can-isotp.

Identifiers have 11 bits: 0x600 + number to the instrument, 0x640 + number from it. They lose arbitration against all
other messages of the rig. A message has at most 4095 bytes, which every ISO-TP implementation accepts. On a CAN FD bus
the frames have up to 64 bytes. If the bus is too slow for the data, reduce the rate by `rate_hz` of `configure`.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from drivers.link import FORMS, QUEUE_MESSAGES, Address, LinkClosedError, LinkTimeoutError
from rig.base.errors import InputError
from rig.serve.request_handler import one_line
from rig.serve.waiting import BoundedQueue, Deadline

if TYPE_CHECKING:
    import can
    import isotp

TO_INSTRUMENT = 0x600
FROM_INSTRUMENT = 0x640
_MAX_BYTES = 4095
_SEND_TIMEOUT_S = 0.5
"""Longest wait of a frame for space in the transmit queue [s]."""


_LOGGER = "drivers.link.can"
# Messages that the library warns about count as lost; they are logged if the program has set up logging.
logging.getLogger(_LOGGER).addHandler(logging.NullHandler())


class CanNode:
    """One node of a bus, for any number of links.

    Args:
        spec: INTERFACE:CHANNEL, and `?NAME=VALUE&...` with further settings of python-can's bus.
        receive: Identifiers to receive.

    Raises:
        InputError: python-can has no such bus.
    """

    def __init__(self, spec: str, receive: list[int]) -> None:
        import can

        interface, channel, settings = parse_spec(spec)
        filters = [{"can_id": each, "can_mask": 0x7FF, "extended": False} for each in receive]
        self.bus = open_bus(spec, interface, channel, can_filters=filters, **settings)
        self._receivers: dict[int, Callable[[can.Message], None]] = {}
        self.fd = settings.get("fd") is True or self.bus.protocol is can.CanProtocol.CAN_FD
        self._notifier = can.Notifier(self.bus, [self._take], timeout=0.1)

    def listen(self, identifier: int, take: Callable[[can.Message], None]) -> None:
        """Call a function with each frame of one identifier; it must not block."""
        self._receivers[identifier] = take

    def leave(self, identifier: int) -> None:
        """Stop passing on frames of one identifier."""
        self._receivers.pop(identifier, None)

    def _take(self, message: can.Message) -> None:
        take = self._receivers.get(message.arbitration_id)
        if take is not None and not (message.is_extended_id or message.is_error_frame or message.is_remote_frame):
            take(message)

    def close(self) -> None:
        """Leave the bus."""
        self._notifier.stop(timeout=2.0)
        self.bus.shutdown()


def open_bus(spec: str, interface: str, channel: str, **settings: Any) -> can.BusABC:
    """Open a bus of python-can.

    Args:
        spec: Specification to name in an error.
        interface: Name of python-can's interface.
        channel: Channel of the interface.
        settings: Further settings of the bus.

    Raises:
        InputError: The bus does not exist, or cannot be opened.
    """
    import can

    try:
        return can.Bus(channel, interface, **settings)
    except (can.CanError, OSError, ValueError, TypeError) as error:
        raise InputError("can", f"a bus that can be opened ({one_line(error)})", spec) from None


def parse_spec(spec: str) -> tuple[str, str, dict[str, Any]]:
    """Split INTERFACE:CHANNEL?NAME=VALUE&...; values are converted as by python-can.

    Raises:
        InputError: The text has another form.
    """
    from can.util import cast_from_string

    place, question, text = spec.partition("?")
    interface, colon, channel = place.partition(":")
    pairs = [pair.partition("=") for pair in text.split("&")] if question else []
    if not colon or not interface or not channel or any(not (name and equals) for name, equals, _ in pairs):
        raise InputError("url", f"one of {FORMS}", f"can:{spec}")
    return interface, channel, {name: cast_from_string(value) for name, _, value in pairs}


class CanLink:
    """One end of the connection between a host and an instrument.

    Args:
        spec: Bus, as for `CanNode`.
        address: The instrument.
        node: Node to share; by default the link has its own.
        instrument: Whether this is the instrument's end.

    Raises:
        InputError: The bus does not exist.
    """

    def __init__(self, spec: str, address: Address, *, node: CanNode | None = None, instrument: bool = False) -> None:
        import isotp

        down, up = TO_INSTRUMENT + address.number, FROM_INSTRUMENT + address.number
        send, receive = (up, down) if instrument else (down, up)
        self._owns_node = node is None
        self._node = CanNode(spec, [receive]) if node is None else node
        fd = self._node.fd
        self._name = address.name
        self._receive_identifier = receive
        self._frames: queue.SimpleQueue[can.Message | None] = queue.SimpleQueue()
        self._stack = isotp.TransportLayer(
            self._receive_frame,
            self._send_frame,
            address=isotp.Address(isotp.AddressingMode.Normal_11bits, txid=send, rxid=receive),
            error_handler=self._count_spoilt,
            params={
                "stmin": 0,
                "blocksize": 0,
                "blocking_send": True,
                "max_frame_size": _MAX_BYTES,
                "can_fd": fd,
                "bitrate_switch": fd,
                "tx_data_length": 64 if fd else 8,
                "logger_name": _LOGGER,
            },
        )
        self._sending = threading.Lock()
        self._closing = threading.Lock()
        # The library's own queue is unbounded.
        self._messages: BoundedQueue[bytes] = BoundedQueue(QUEUE_MESSAGES)
        self._closed = False
        self._spoilt = 0
        self.max_bytes = _MAX_BYTES
        self._stack.start()
        self._node.listen(receive, self._frames.put)
        self._reader = threading.Thread(target=self._read, name=f"can {address.name} reads", daemon=True)
        self._reader.start()

    @property
    def lost(self) -> int:
        """Messages that were corrupted, found no space, or did not get onto the bus."""
        return self._spoilt + self._messages.dropped

    def _count_spoilt(self, _: Exception) -> None:
        self._spoilt += 1

    def _receive_frame(self, _: float) -> isotp.CanMessage | None:
        """Return the next frame to the library. It ignores the library's time-out; `close` wakes it."""
        import isotp

        message = None if self._closed else self._frames.get()
        if message is None:
            return None
        return isotp.CanMessage(arbitration_id=message.arbitration_id, data=bytes(message.data), is_fd=message.is_fd)

    def _send_frame(self, message: isotp.CanMessage) -> None:
        """Send a frame of the library; if the bus does not accept it, its message is spoilt and times out."""
        import can

        frame = can.Message(
            arbitration_id=message.arbitration_id,
            data=message.data,
            is_extended_id=False,
            is_fd=message.is_fd,
            bitrate_switch=message.bitrate_switch,
        )
        try:
            self._node.bus.send(frame, timeout=_SEND_TIMEOUT_S)
        except can.CanError:
            self._spoilt += 1

    def _read(self) -> None:
        while not self._closed:
            message = self._stack.recv(block=True, timeout=1.0)
            if message:
                self._messages.push(bytes(message))

    def send(self, message: bytes, *, timeout_s: float) -> None:
        """Send one message; return when the bus has accepted its last frame."""
        import isotp

        if len(message) > _MAX_BYTES:
            raise InputError("message", f"at most {_MAX_BYTES} bytes long", len(message))
        deadline = Deadline(timeout_s)
        with self._sending:
            if self._closed:
                raise LinkClosedError("the link is closed")
            try:
                self._stack.send(message, send_timeout=deadline.left_s)
            except isotp.BlockingSendFailure:
                with contextlib.suppress(Exception):
                    self._stack.stop_sending()
                if self._closed:
                    raise LinkClosedError("the link is closed") from None
                raise LinkTimeoutError(f"the {self._name} on this bus accepts no messages; is it running?") from None

    def receive(self, *, timeout_s: float) -> bytes | None:
        """Return the next message, or None if none arrived in time."""
        message = self._messages.take(timeout_s)
        if self._closed:
            raise LinkClosedError("the link is closed")
        return message

    def close(self) -> None:
        """Close the link, and leave the bus if the node is its own."""
        with self._closing:
            if self._closed:
                return
            self._closed = True
        self._messages.close()
        self._node.leave(self._receive_identifier)
        # Wake both readers.
        self._frames.put(None)
        self._stack.rx_queue.put(bytearray())
        self._reader.join(timeout=2.0)
        self._stack.stop()
        if self._owns_node:
            self._node.close()
