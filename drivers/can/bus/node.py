"""Node of the bus for python-can: received frames, transmit queue as reported by the hub, filters, states."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import can  # noqa: TID253 - loaded by python-can itself
import numpy as np
from can.bus import BusState  # noqa: TID253

from drivers.can.bus import codec
from drivers.can.bus.frame import pack_records
from rig.base.checks import check
from rig.base.errors import InputError
from rig.serve.waiting import Deadline

if TYPE_CHECKING:
    from can.typechecking import CanFilters

_RECEIVE_QUEUE = 100_000
"""Default number of frames that wait to be read: about 7 s of a full bus; the oldest are dropped."""
_SHUTDOWN_TIMEOUT_S = 1.0
"""Longest wait of a shutdown for frames that were sent before [s]."""
_STATES = (BusState.ACTIVE, BusState.PASSIVE, BusState.ERROR)
_LISTEN_ONLY = {BusState.ACTIVE: False, BusState.PASSIVE: True}
_numbers = itertools.count()


class NodeBus(can.BusABC):
    """Base of the connections to a hub.

    Args:
        channel: Name of the bus.
        can_filters: Filters as in python-can; error frames always pass.
        receive_own_messages: Deliver sent frames to this bus as well, after they have been on the wire.
        fd: None for the setting of the hub's bus; True requires CAN FD; False makes this a classic node, which receives
            no FD frames and cannot send any.
        listen_only: Send nothing and acknowledge nothing.
        in_order: Send frames in their order, as an operating system's transmit queue does, not by priority.
        rx_queue_size: Number of frames that wait to be read; beyond it the oldest are dropped, and an error frame
            reports it.
        bitrate: If given, must equal that of the hub's bus [bit/s].
        data_bitrate: If given, must equal that of the hub's bus [bit/s].
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
        in_order: bool = False,
        rx_queue_size: int = _RECEIVE_QUEUE,
        bitrate: int | None = None,
        data_bitrate: int | None = None,
        timing: Any = None,
        **_: object,
    ) -> None:
        self.channel = str(channel)
        self.name = f"{os.getpid()}-{next(_numbers)}-{os.urandom(3).hex()}"
        self.receive_own_messages = bool(receive_own_messages)
        self._fd_asked = fd
        self._listen_only, self._in_order = bool(listen_only), bool(in_order)
        self._rates = _bit_rates(bitrate, data_bitrate, timing)
        self._queue_size = max(1, int(rx_queue_size))
        self._lock = threading.Lock()
        self._arrived = threading.Condition(self._lock)
        self._room = threading.Condition(self._lock)
        self._ready: deque[can.Message] = deque()
        self._ready_filters: CanFilters | None = None
        self._batches: deque[tuple[np.ndarray, CanFilters | None]] = deque()
        self.waiting = 0
        """Frames in the batches."""
        self._overflowed = False
        """Whether frames were lost and the reader has not received an error frame yet."""
        self.node = codec.NO_NODE
        self.secret: str | None = None
        """Secret that proves to the hub that the name is this node's own."""
        self._fd = False
        self._window = 0
        self.offered = 0
        self.done = 0
        self._report = codec.NodeReport(codec.NO_NODE, 0, 0, 0, 0, 0)
        self._there = False
        self._filters = None
        self.dropped = 0
        """Received frames that were dropped because they were not read in time."""
        self.missed = 0
        """Messages of the hub that never arrived."""
        self.malformed = 0
        """Messages that were malformed."""
        self._connect()
        try:
            self._join()
        except BaseException:
            self._leave()
            raise
        self._can_protocol = can.CanProtocol.CAN_FD if self._fd else can.CanProtocol.CAN_20
        super().__init__(channel, can_filters=can_filters)

    # ---- provided by the connection ----

    def _connect(self) -> None:
        raise NotImplementedError

    def _ask(self, name: str, document: dict[str, Any]) -> dict[str, Any]:
        """Return the hub's reply; raises InputError if the hub refuses."""
        raise NotImplementedError

    def _offer(self, secret: str, records: np.ndarray) -> None:
        """Pass frames to the hub: an array of one of the `RECORDS` layouts, at most MAX_RECORDS."""
        raise NotImplementedError

    def _leave(self) -> None:
        raise NotImplementedError

    def _where(self) -> str:
        raise NotImplementedError

    # ---- connection ----

    def _join(self) -> None:
        """Join the bus.

        Raises:
            CanInitializationError: The hub refuses, or its bus has other settings.
        """
        again = {} if self.secret is None else {"secret": self.secret}
        try:
            settings = {"listen_only": self._listen_only, "in_order": self._in_order}
            answer = check(codec.JoinReply, self._ask("join", {**settings, **again}), field="hub")
        except InputError as error:
            raise can.CanInitializationError(f"{self._where()} refuses another node: {error}") from None
        rates = {"bitrate": answer.nominal_bit_s, "data_bitrate": answer.data_bit_s}
        for name, requested in self._rates.items():
            if requested is not None and rates[name] is not None and requested != rates[name]:
                raise can.CanInitializationError(
                    f"{name} must be that of {self._where()}, {rates[name]}; received {requested}"
                )
        if self._fd_asked and not answer.fd:
            raise can.CanInitializationError(f"{self._where()} has a bus for classic CAN only; fd=True asks for CAN FD")
        with self._lock:
            self.node, self.secret = answer.node, answer.secret
            self._fd = answer.fd and self._fd_asked is not False
            self._window = answer.window
            self.offered = self.done = 0
            self._report = codec.NodeReport(self.node, 0, 0, 0, 0, 0)
            self._there = True

    def _on_hub_lost(self) -> None:
        """Record that the hub has stopped, and wake waiting senders."""
        with self._lock:
            self._there = False
            self._room.notify_all()

    def _check_open(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError(f"the bus {self.channel} has been shut down")

    # ---- receiving ----

    def receive(self, content: codec.HubMessage) -> None:
        """Process a message of the hub, on the thread of the connection."""
        if isinstance(content, np.ndarray):
            self._take_frames(content)
        else:
            self._take_reports(content)

    def _take_frames(self, records: np.ndarray) -> None:
        own = records["node"] == self.node
        errors = (records["identifier"] & codec.ERROR) != 0
        confirmed = int(np.count_nonzero(own & ~errors))
        filters = self._filters
        wanted = np.ones(len(records), bool)
        if confirmed and not self.receive_own_messages:
            wanted &= ~own | errors
        if errors.any():
            # The state of another node's controller is not visible.
            wanted &= ~errors | own | (records["identifier"] & codec.BUS_ERROR != 0)
        if not self._fd:
            wanted &= (records["flags"] & codec.FD) == 0
        if filters:
            wanted &= errors | match_filters(records["identifier"], filters)
        records = records if wanted.all() else records[wanted]
        with self._lock:
            if confirmed:
                self.done += confirmed
                self._room.notify_all()
            if len(records):
                self._store(records, filters)

    def _take_reports(self, reports: Sequence[codec.NodeReport]) -> None:
        with self._lock:
            for report in reports:
                if report.node == self.node:
                    self._report = report
                    # Frames in between may have been missed; a report counts all before it.
                    self.done = report.done
                    self._room.notify_all()

    def _store(self, frames: np.ndarray, filters: CanFilters | None) -> None:
        """Keep frames until they are read; the caller holds the lock."""
        self._batches.append((frames, filters))
        self.waiting += len(frames)
        while (surplus := self.waiting - self._queue_size) > 0:
            oldest, by = self._batches.popleft()
            if surplus < len(oldest):
                self._batches.appendleft((oldest[surplus:], by))
            self.waiting -= min(surplus, len(oldest))
            self.dropped += min(surplus, len(oldest))
            self._overflowed = True
        self._arrived.notify()

    def _count_missed(self, count: int) -> None:
        """Count messages of the hub that never arrived."""
        with self._lock:
            self.missed += count
            self._overflowed = True
            self._arrived.notify()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self._check_open()
        try:
            # The usual case, without a lock: further frames of a batch.
            message = self._ready.popleft()
        except IndexError:
            message = self._next(timeout)
        if message is None:
            return None, False
        # Frames that arrived before a change of the filters are filtered by python-can.
        return message, message.is_error_frame or self._ready_filters is self._filters

    def _next(self, timeout: float | None) -> can.Message | None:
        deadline = Deadline(timeout)
        with self._arrived:
            while not self._ready:
                if self._overflowed:
                    self._overflowed = False
                    lost = codec.make_overflow(time.time_ns())
                    return codec.make_message(lost, channel=self.channel, node=self.node)
                if self._batches:
                    frames, self._ready_filters = self._batches.popleft()
                    self.waiting -= len(frames)
                    self._ready.extend(codec.make_messages(frames, channel=self.channel, node=self.node))
                    continue
                if self._is_shutdown or not deadline.wait(self._arrived):
                    return None
            return self._ready.popleft()

    # ---- sending ----

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Pass a frame to the hub, which sends it when it wins the bus.

        Args:
            msg: The frame.
            timeout: Longest wait for room in the transmit queue [s]; None for no limit, 0 for no wait.

        Raises:
            CanOperationError: The queue was full too long, the bus does not support the frame, the node only listens or
                is bus-off, or the hub has stopped.
        """
        self._check_open()
        try:
            record = codec.make_offer(msg, fd=self._fd)
        except codec.CodecError as error:
            raise can.CanOperationError(f"{self.channel} cannot send {error}") from None
        self._reserve(1, timeout)
        self._offer(self.secret or "", pack_records([record]))

    def send_records(self, records: np.ndarray, timeout: float | None = None) -> None:
        """Pass many frames to the hub at once.

        Args:
            records: Array of one of the layouts `drivers.can.bus.codec.RECORDS`; time and node are ignored.
            timeout: Longest wait for room in the transmit queue, for each portion of the frames [s].

        Raises:
            CanOperationError: As for `send`; a frame that the bus does not support is dropped and counted by the hub.
        """
        self._check_open()
        portion = min(self._window or 1, codec.MAX_RECORDS)
        for first in range(0, len(records), portion):
            part = records[first : first + portion]
            self._reserve(len(part), timeout)
            self._offer(self.secret or "", part)

    def _reserve(self, count: int, timeout: float | None) -> None:
        """Wait for room for some frames in the transmit queue, and reserve it."""
        with self._room:
            deadline = Deadline(timeout)
            while True:
                self._check_open()
                if not self._there:
                    raise can.CanOperationError(f"the link to {self._where()} is lost: nothing can be sent")
                if self._listen_only:
                    raise can.CanOperationError(f"this node of {self.channel} only listens: nothing can be sent")
                if self._report.state == 2:
                    raise can.CanOperationError(f"this node of {self.channel} is bus off: nothing can be sent")
                if self.offered - self.done + count <= max(self._window, count):
                    self.offered += count
                    return
                if not deadline.wait(self._room):
                    raise can.CanOperationError(
                        f"transmit queue of {self.channel} is full: {self.offered - self.done} frames wait"
                    )

    def flush_tx_buffer(self) -> None:
        """Withdraw the frames that wait to be sent; the frame on the wire is finished."""
        self._check_open()
        self._set("flush", {})

    def _set(self, name: str, document: dict[str, Any]) -> None:
        try:
            self._ask(name, {"secret": self.secret, **document})
        except InputError as error:
            raise can.CanOperationError(f"{self._where()} refuses: {error}") from None

    # ---- state and end ----

    @property
    def state(self) -> BusState:
        """ACTIVE; PASSIVE if error passive or only listening; ERROR if bus-off or without a hub."""
        if not self._there:
            return BusState.ERROR
        if self._listen_only:
            return BusState.PASSIVE
        return _STATES[self._report.state]

    @state.setter
    def state(self, new_state: BusState) -> None:
        """Set the state: ACTIVE takes part (also after bus-off), PASSIVE only listens."""
        if new_state not in _LISTEN_ONLY:
            raise can.CanOperationError(f"state must be ACTIVE or PASSIVE; received {new_state}")
        self._check_open()
        listen_only = _LISTEN_ONLY[new_state]
        self._set("set", {"listen_only": listen_only})
        self._listen_only = listen_only

    @property
    def error_counters(self) -> tuple[int, int]:
        """Transmit and receive error counter of this node, as last reported."""
        return self._report.transmit_errors, self._report.receive_errors

    def shutdown(self) -> None:
        """Leave the bus and close the connection; further calls have no effect."""
        if self._is_shutdown:
            return
        super().shutdown()
        with self._lock:
            self._arrived.notify_all()
            self._room.notify_all()
            # As with a socket, frames that were sent before go out, unless the bus does not accept them.
            self._room.wait_for(
                lambda: not self._there or self.offered <= self.done or self._report.state == 2, _SHUTDOWN_TIMEOUT_S
            )
        self._leave()


def _bit_rates(bitrate: int | None, data_bitrate: int | None, timing: Any) -> dict[str, int | None]:
    if isinstance(timing, can.BitTimingFd):
        return {"bitrate": timing.nom_bitrate, "data_bitrate": timing.data_bitrate}
    if isinstance(timing, can.BitTiming):
        return {"bitrate": timing.bitrate, "data_bitrate": None}
    return {"bitrate": bitrate, "data_bitrate": data_bitrate}


def match_filters(words: np.ndarray, filters: CanFilters) -> np.ndarray:
    """Return for each identifier word whether it matches at least one filter, shape of `words`."""
    extended = (words & codec.EXTENDED) != 0
    identifiers = words & np.uint32(codec.EXTENDED_MASK)
    matches = np.zeros(len(words), bool)
    for entry in filters:
        wanted, mask = int(entry["can_id"]), int(entry["can_mask"])
        # As in python-can, the mask bits beyond an identifier's 29 bits are compared with zeros.
        if wanted & mask & ~codec.EXTENDED_MASK:
            continue
        mask &= codec.EXTENDED_MASK
        match = identifiers & np.uint32(mask) == wanted & mask
        if "extended" in entry:
            match &= extended == bool(entry["extended"])
        matches |= match
    return matches
