"""Python-can's way onto the virtual CAN: `can.Bus(interface="zenoh", channel="can0")` from any process of this machine.

`ZenohBus` reaches a hub in another process, `HubBus` one in this process; what they share is the rest of an interface:
the queue of what was received, the transmit queue as the hub reports it, filters, states.
"""

from __future__ import annotations

import itertools
import json
import os
import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import can  # noqa: TID253 - loaded by python-can itself
import numpy as np
from can.bus import BusState  # noqa: TID253

from drivers.can.bus import codec
from rig.errors import InputError, RefusedError
from rig.outside import check, read_json
from rig.transport.endpoint import parse_loopback

if TYPE_CHECKING:
    from can.typechecking import AutoDetectedConfig, CanFilters

    from drivers.can.bus.hub import Hub

_RECEIVE_QUEUE = 100_000
"""Frames that wait to be read, by default: about 7 s of a full bus; the oldest are dropped."""
_JOIN_S = 2.0
_PARTING_S = 1.0
"""How long a shutdown waits for what was sent before."""
_STATES = (BusState.ACTIVE, BusState.PASSIVE, BusState.ERROR)
_SETTINGS = {BusState.ACTIVE: False, BusState.PASSIVE: True}

_SHORT = 400
"""Messages of the hub that are shorter [bytes] are taken frame by frame."""
_Frames = Sequence[can.Message] | np.ndarray
_numbers = itertools.count()


class _MediumBus(can.BusABC):
    """What the ways to a hub share.

    Args:
        channel: Name of the bus.
        can_filters: As python-can has them; error frames pass always.
        receive_own_messages: Deliver sent frames to this bus as well, when they have been on the wire.
        fd: None takes what the hub's bus takes; True insists on CAN FD; False makes this a classic node, which gets no
            FD frames and cannot send any.
        listen_only: Take no part: send nothing, acknowledge nothing.
        rx_queue_size: Number of frames that wait to be read; beyond, the oldest are dropped, and an error frame says
            so.
        bitrate: Must be that of the hub's bus, where given [bit/s].
        data_bitrate: Must be that of the hub's bus, where given [bit/s].
        timing: Bit timing instead of the bit rates.
    """

    def __init__(
        self,
        channel: Any,
        *,
        can_filters: CanFilters | None = None,
        receive_own_messages: bool = False,
        fd: bool | None = None,
        listen_only: bool = False,
        rx_queue_size: int = _RECEIVE_QUEUE,
        bitrate: int | None = None,
        data_bitrate: int | None = None,
        timing: Any = None,
        **_: object,
    ) -> None:
        self.channel = str(channel)
        self._name = f"{os.getpid()}-{next(_numbers)}-{os.urandom(3).hex()}"
        self.receive_own_messages = bool(receive_own_messages)
        self._fd_asked = fd
        self._listen_only = bool(listen_only)
        self._rates = _bit_rates(bitrate, data_bitrate, timing)
        self._queue_size = max(1, int(rx_queue_size))
        self._lock = threading.Lock()
        self._arrived = threading.Condition(self._lock)
        self._room = threading.Condition(self._lock)
        self._ready: deque[can.Message] = deque()
        self._ready_filters: CanFilters | None = None
        self._batches: deque[tuple[_Frames, CanFilters | None]] = deque()
        self._waiting = 0
        """Frames in the batches."""
        self._overflowed = False
        """Whether frames were lost of which the reader has not been told."""
        self._node = codec.NO_NODE
        self._secret: str | None = None
        """What shows the hub that this node's name is its own."""
        self._fd = False
        self._window = 0
        self._offered = 0
        self._done = 0
        self._report = codec.Report(codec.NO_NODE, 0, 0, 0, 0, 0)
        self._there = False
        self._filters = None
        self.dropped = 0
        """Received frames that were dropped because nobody read them in time."""
        self.missed = 0
        """Messages of the hub that never arrived."""
        self.malformed = 0
        """Messages that were none of a hub."""
        self._connect()
        try:
            self._join()
        except BaseException:
            self._leave()
            raise
        self._can_protocol = can.CanProtocol.CAN_FD if self._fd else can.CanProtocol.CAN_20
        super().__init__(channel, can_filters=can_filters)

    # What a way to the hub provides.

    def _connect(self) -> None:
        raise NotImplementedError

    def _ask(self, name: str, document: dict[str, Any]) -> dict[str, Any]:
        """The hub's answer; raises InputError where it refuses."""
        raise NotImplementedError

    def _put(self, payload: bytes) -> None:
        raise NotImplementedError

    def _leave(self) -> None:
        raise NotImplementedError

    def _where(self) -> str:
        raise NotImplementedError

    # The connection.

    def _join(self) -> None:
        """Become a node of the bus.

        Raises:
            CanInitializationError: The hub refuses, or has another bus than was asked for.
        """
        again = {} if self._secret is None else {"secret": self._secret}
        try:
            answer = check(codec.Joined, self._ask("join", {"listen_only": self._listen_only, **again}), field="hub")
        except InputError as error:
            raise can.CanInitializationError(f"{self._where()} refuses another node: {error}") from None
        rates = {"bitrate": answer.nominal_bit_s, "data_bitrate": answer.data_bit_s}
        for name, asked in self._rates.items():
            if asked is not None and rates[name] is not None and asked != rates[name]:
                raise can.CanInitializationError(
                    f"{name} must be that of {self._where()}, {rates[name]}; instead received {asked}"
                )
        if self._fd_asked and not answer.fd:
            raise can.CanInitializationError(f"{self._where()} has a bus for classic CAN only; fd=True asks for CAN FD")
        with self._lock:
            self._node, self._secret = answer.node, answer.secret
            self._fd = answer.fd and self._fd_asked is not False
            self._window = answer.window
            self._offered = self._done = 0
            self._report = codec.Report(self._node, 0, 0, 0, 0, 0)
            self._there = True

    def _lost(self) -> None:
        """The hub has gone: whoever waits to send must know."""
        with self._lock:
            self._there = False
            self._room.notify_all()

    def _check_open(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError(f"the bus {self.channel} has been shut down")

    # Receiving.

    def _take(self, payload: bytes) -> None:
        """A message of the hub, on the thread of the connection."""
        try:
            if codec.kind_of(payload) == codec.REPORTS:
                self._take_reports(codec.decode_reports(payload))
            elif len(payload) <= _SHORT:
                self._take_few(codec.decode(payload))
            else:
                self._take_many(codec.decode_array(payload))
        except codec.CodecError:
            self.malformed += 1

    def _take_few(self, records: Iterable[codec.Record]) -> None:
        """Some frames; arrays would cost more than they save."""
        confirmed = 0
        wanted = []
        for record in records:
            if not record.identifier & codec.ERROR:
                if record.node == self._node:
                    confirmed += 1
                    if not self.receive_own_messages:
                        continue
                if record.flags & codec.FD and not self._fd:
                    continue
            elif record.node != self._node and not record.identifier & codec.BUS_ERROR:
                # How another controller is, nobody sees.
                continue
            wanted.append(codec.message_of(record, channel=self.channel, node=self._node))
        self._keep(confirmed, wanted, None)

    def _take_many(self, records: np.ndarray) -> None:
        own = records["node"] == self._node
        errors = (records["identifier"] & codec.ERROR) != 0
        confirmed = int(np.count_nonzero(own & ~errors))
        filters = self._filters
        wanted = np.ones(len(records), bool)
        if confirmed and not self.receive_own_messages:
            wanted &= ~own | errors
        if errors.any():
            wanted &= ~errors | own | (records["identifier"] & codec.BUS_ERROR != 0)
        if not self._fd:
            wanted &= (records["flags"] & codec.FD) == 0
        if filters:
            wanted &= errors | _matching(records["identifier"], filters)
        self._keep(confirmed, records if wanted.all() else records[wanted], filters)

    def _keep(self, confirmed: int, frames: _Frames, filters: CanFilters | None) -> None:
        with self._lock:
            if confirmed:
                self._done += confirmed
                self._room.notify_all()
            if len(frames):
                self._store(frames, filters)

    def _take_reports(self, reports: Sequence[codec.Report]) -> None:
        with self._lock:
            for report in reports:
                if report.node == self._node:
                    self._report = report
                    # Frames in between may have been missed; a report counts all that were before it.
                    self._done = report.done
                    self._room.notify_all()

    def _store(self, frames: _Frames, filters: CanFilters | None) -> None:
        """Keep frames until they are read; the lock is held."""
        self._batches.append((frames, filters))
        self._waiting += len(frames)
        while self._waiting > self._queue_size and len(self._batches) > 1:
            surplus = len(self._batches.popleft()[0])
            self._waiting -= surplus
            self.dropped += surplus
            self._overflowed = True
        self._arrived.notify()

    def _missed(self, count: int) -> None:
        """Messages of the hub never arrived."""
        with self._lock:
            self.missed += count
            self._overflowed = True
            self._arrived.notify()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self._check_open()
        try:
            # The usual case, without a lock: more of the frames that came together.
            message = self._ready.popleft()
        except IndexError:
            message = self._next(timeout)
        if message is None:
            return None, False
        # Where the filters were changed after the frame came, python-can filters once more.
        return message, message.is_error_frame or self._ready_filters is self._filters

    def _next(self, timeout: float | None) -> can.Message | None:
        deadline = None if timeout is None else time.monotonic() + timeout
        with self._arrived:
            while not self._ready:
                if self._overflowed:
                    self._overflowed = False
                    lost = codec.overflow(time.time_ns())
                    return codec.message_of(lost, channel=self.channel, node=self._node)
                if self._batches:
                    frames, self._ready_filters = self._batches.popleft()
                    self._waiting -= len(frames)
                    if isinstance(frames, np.ndarray):
                        frames = codec.messages_of(frames, channel=self.channel, node=self._node)
                    self._ready.extend(frames)
                    continue
                left = None if deadline is None else deadline - time.monotonic()
                if self._is_shutdown or (left is not None and left <= 0):
                    return None
                self._arrived.wait(left)
            return self._ready.popleft()

    # Sending.

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand a frame to the hub, which sends it as soon as it wins the bus.

        Args:
            msg: The frame.
            timeout: How long to wait for room in the transmit queue [s]; None waits for ever, 0 not at all.

        Raises:
            CanOperationError: No room in time, no such frame on this bus, listening only, bus off, or no hub.
        """
        self._check_open()
        try:
            record = codec.offered(msg, fd=self._fd)
        except codec.CodecError as error:
            raise can.CanOperationError(f"{self.channel} cannot send {error}") from None
        self._reserve(1, timeout)
        self._offer(codec.encode([record]))

    def send_records(self, records: np.ndarray, timeout: float | None = None) -> None:
        """Hand many frames to the hub at once.

        Args:
            records: Array of one of the layouts `drivers.can.bus.codec.RECORDS`; only what makes a frame counts.
            timeout: How long to wait for room in the transmit queue, for each portion of the frames [s].

        Raises:
            CanOperationError: As `send`; a frame that the bus cannot have is dropped and counted by the hub.
        """
        self._check_open()
        portion = min(self._window or 1, codec.MAX_RECORDS)
        for first in range(0, len(records), portion):
            part = records[first : first + portion]
            self._reserve(len(part), timeout)
            self._offer(codec.encode_array(part))

    def _offer(self, message: bytes) -> None:
        self._put(bytes.fromhex(self._secret or "") + message)

    def _reserve(self, count: int, timeout: float | None) -> None:
        """Wait for room for some frames in the transmit queue, and take it."""
        with self._room:
            deadline = None if timeout is None else time.monotonic() + timeout
            while True:
                self._check_open()
                if not self._there:
                    raise can.CanOperationError(f"{self._where()} has gone: nothing can be sent")
                if self._listen_only:
                    raise can.CanOperationError(f"this node of {self.channel} only listens: nothing can be sent")
                if self._report.state == 2:
                    raise can.CanOperationError(f"this node of {self.channel} is bus off: nothing can be sent")
                if self._offered - self._done + count <= max(self._window, count):
                    self._offered += count
                    return
                left = None if deadline is None else deadline - time.monotonic()
                if left is not None and left <= 0:
                    raise can.CanOperationError(
                        f"transmit queue of {self.channel} is full: {self._offered - self._done} frames wait"
                    )
                self._room.wait(left)

    def flush_tx_buffer(self) -> None:
        """Withdraw what waits to be sent; the frame that is on the wire is finished."""
        self._check_open()
        self._set("flush", {})

    def _set(self, name: str, document: dict[str, Any]) -> None:
        try:
            self._ask(name, {"secret": self._secret, **document})
        except InputError as error:
            raise can.CanOperationError(f"{self._where()} refuses: {error}") from None

    # State and end.

    @property
    def state(self) -> BusState:
        """ACTIVE; PASSIVE: error passive, or only listening; ERROR: bus off, or the hub has gone."""
        if not self._there:
            return BusState.ERROR
        if self._listen_only:
            return BusState.PASSIVE
        return _STATES[self._report.state]

    @state.setter
    def state(self, new_state: BusState) -> None:
        """ACTIVE takes part (again, also after bus off), PASSIVE only listens."""
        if new_state not in _SETTINGS:
            raise can.CanOperationError(f"state must be ACTIVE or PASSIVE; instead received {new_state}")
        self._check_open()
        listen_only = _SETTINGS[new_state]
        self._set("set", {"listen_only": listen_only})
        self._listen_only = listen_only

    @property
    def error_counters(self) -> tuple[int, int]:
        """Transmit and receive error counter of this node, as last reported."""
        return self._report.transmit_errors, self._report.receive_errors

    def shutdown(self) -> None:
        """Leave the bus and close the connection; may be called again."""
        if self._is_shutdown:
            return
        super().shutdown()
        with self._lock:
            self._arrived.notify_all()
            self._room.notify_all()
            # As from a socket, what was sent before goes out, unless the bus does not take it.
            deadline = time.monotonic() + _PARTING_S
            while self._there and self._offered > self._done and self._report.state != 2:
                if not self._room.wait(deadline - time.monotonic()):
                    break
        self._leave()


class ZenohBus(_MediumBus):
    """A node of a virtual CAN bus whose hub runs in another process of this machine.

    Args:
        channel: Name of the bus.
        endpoint: HOST:PORT of the hub, on 127.0.0.1; one of another machine is reached by `ssh -L`.
        connect_s: How long to wait for the hub to be there [s].
        **settings: Those of every bus here: can_filters, receive_own_messages, fd, listen_only, rx_queue_size, bitrate,
            data_bitrate, timing.

    Raises:
        CanInitializationError: No hub of that channel is there, or it has another bus than was asked for.
    """

    def __init__(
        self,
        channel: Any = "can0",
        *,
        endpoint: str = codec.DEFAULT_ENDPOINT,
        connect_s: float = 1.0,
        **settings: Any,
    ) -> None:
        self._address, self._connect_s = str(endpoint), connect_s
        super().__init__(channel, **settings)
        # Only now: a hub that comes back is joined anew, which must not meet the first time.
        self._client.watch(codec.alive_key(self.channel), self._watch)
        self.channel_info = f"zenoh {self.channel} at {self._address}"

    def _connect(self) -> None:
        from rig.transport import NoReplyError
        from rig.transport.zenoh import ZenohClient

        try:
            parse_loopback(self._address, field="endpoint")
            if not codec.is_name(self.channel):
                raise InputError("channel", "letters, digits, - and _, such as can0", self.channel)
        except InputError as error:
            raise can.CanInitializationError(str(error)) from None
        try:
            self._client = ZenohClient(self._address, wait_s=self._connect_s)
        except NoReplyError:
            raise can.CanInitializationError(self._nobody()) from None
        self._client.announce(codec.node_key(self.channel, self._name))
        self._client.subscribe(
            codec.bus_key(self.channel),
            lambda _, payload: self._take(payload),
            on_miss=lambda _, count: self._missed(count),
        )

    def _nobody(self) -> str:
        return (
            f"no hub for CAN channel {self.channel} answers at {self._address}; start one with: "
            f"rig can hub {self.channel} (or with the rig: rig run --can zenoh:{self.channel})"
        )

    def _where(self) -> str:
        return f"the hub of CAN channel {self.channel} at {self._address}"

    def _ask(self, name: str, document: dict[str, Any]) -> dict[str, Any]:
        from rig.transport import NoReplyError

        payload = json.dumps({"endpoint": self._name, **document}).encode()
        try:
            answer = self._client.request(codec.request_key(self.channel, name), payload, timeout_s=_JOIN_S)
        except NoReplyError as error:
            if name != "join":
                raise can.CanOperationError(f"{self._where()} does not answer: {error}") from None
            others = [key.split("/")[2] for key in self._client.tokens(codec.ALIVE)]
            also = f" (channels there: {', '.join(others)})" if others else ""
            raise can.CanInitializationError(self._nobody() + also) from None
        document = read_json(answer, field="hub")
        if "error" in document:
            raise RefusedError(str(document["error"]))
        return document

    def _put(self, payload: bytes) -> None:
        self._client.report(codec.offer_key(self.channel, self._name), payload)

    def _watch(self, there: bool) -> None:
        """The hub has gone, or is there again."""
        if not there:
            self._lost()
        elif not self._there and not self._is_shutdown:
            try:
                self._join()
            except can.CanError:
                # A hub of another kind, or gone again: the bus stays without one, which its state and send tell.
                self._lost()

    def _leave(self) -> None:
        self._client.close()

    @staticmethod
    def _detect_available_configs() -> Sequence[AutoDetectedConfig]:
        """Channels of the hub at the default endpoint; none where no hub runs."""
        from rig.transport import NoReplyError
        from rig.transport.zenoh import ZenohClient

        try:
            with ZenohClient(codec.DEFAULT_ENDPOINT, wait_s=0.2) as client:
                channels = [key.split("/")[2] for key in client.tokens(codec.ALIVE)]
        except NoReplyError:
            return []
        return [{"interface": "zenoh", "channel": channel} for channel in channels]


class HubBus(_MediumBus):
    """A node of a virtual CAN bus whose hub runs in this very process.

    Args:
        hub: The hub.
        **settings: As those of `ZenohBus`.
    """

    def __init__(self, hub: Hub, **settings: Any) -> None:
        self._hub = hub
        super().__init__(hub.channel, **settings)
        self.channel_info = f"{hub.channel} of this process"

    def _connect(self) -> None:
        self._secret = self._hub.connect(self._name, self._take, self._lost)

    def _where(self) -> str:
        return f"the hub of CAN channel {self.channel} in this process"

    def _ask(self, name: str, document: dict[str, Any]) -> dict[str, Any]:
        return self._hub.answer(name, {"endpoint": self._name, **document})

    def _put(self, payload: bytes) -> None:
        self._hub.offer(self._name, payload)

    def _leave(self) -> None:
        self._hub.disconnect(self._name)


def _bit_rates(bitrate: int | None, data_bitrate: int | None, timing: Any) -> dict[str, int | None]:
    if isinstance(timing, can.BitTimingFd):
        return {"bitrate": timing.nom_bitrate, "data_bitrate": timing.data_bitrate}
    if isinstance(timing, can.BitTiming):
        return {"bitrate": timing.bitrate, "data_bitrate": None}
    return {"bitrate": bitrate, "data_bitrate": data_bitrate}


def _matching(words: np.ndarray, filters: CanFilters) -> np.ndarray:
    """Which identifier words match at least one filter, shape of `words`."""
    extended = (words & codec.EXTENDED) != 0
    identifiers = words & np.uint32(codec.EXTENDED_MASK)
    found = np.zeros(len(words), bool)
    for entry in filters:
        wanted, mask = int(entry["can_id"]), int(entry["can_mask"])
        # As python-can compares: bits of the mask beyond an identifier's 29 see zeros.
        if wanted & mask & ~codec.EXTENDED_MASK:
            continue
        mask &= codec.EXTENDED_MASK
        match = identifiers & np.uint32(mask) == wanted & mask
        if "extended" in entry:
            match &= extended == bool(entry["extended"])
        found |= match
    return found
