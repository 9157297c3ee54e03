"""Outgoing frames: each waits until it is due, then for room on the bus; replies go first."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from drivers.can.bus import codec
from drivers.can.bus.frame import FD_WIDTH, RECORDS, join_records
from drivers.can.gateway.samples import make_records
from drivers.can.message import CanMessage
from drivers.can.schedule import SLOT_S
from rig.base import wire

if TYPE_CHECKING:
    import can

_LATENESS_MARGIN_S = 1e-3
"""Allowance for blocks that arrive a little late [s], added to the length of a block."""
_MAX_REPLIES = 16
"""Largest number of replies that wait for the bus."""
_BATCH_FRAMES = 64
"""Number of frames passed to the bus in one call."""
_AHEAD_SLOTS = 12
"""Slots in advance in which a bus that can hold frames until they are due receives them: a usual block at once."""
_MAX_AHEAD_FRAMES = 128
"""Largest number of frames sent in advance: a quarter of a transmit queue, so that late ones find room."""
_MARGIN_SLOTS = 2
"""Slots before the next frame is due at which more frames are sent in advance."""


class Outbox:
    """Passes frames to a bus when they are due; frames without room follow later, in order.

    Args:
        bus: Any bus of python-can. If it has `send_records` (a node of the virtual CAN), frames are passed in batches;
            if it has `schedule_records` (its hub is in this process), also before they are due.
        room: Largest number of frames that wait for room on the bus; beyond it the oldest are dropped.
        paced: Send each frame when it is due; False sends at once, and waits for room.
        now: Clock [s].
    """

    def __init__(self, bus: can.BusABC, *, room: int, paced: bool, now: Callable[[], float]) -> None:
        self._bus = bus
        self._send_records = getattr(bus, "send_records", None)
        self._schedule_records = getattr(bus, "schedule_records", None) if paced else None
        self._ahead = 0 if self._schedule_records is None else _AHEAD_SLOTS
        self._last_handed_s = -math.inf
        """Due time of the last frame passed to the bus [s of the clock]."""
        self._room = room
        self._paced = paced
        self._now = now
        self._sending = threading.Lock()
        self._undue: tuple[np.ndarray, np.ndarray] = (np.zeros(0, np.int64), np.zeros(0, RECORDS[FD_WIDTH]))
        """Frames that are not due: slot numbers on the clock, ascending, and the frames."""
        self._added: list[tuple[np.ndarray, np.ndarray]] = []
        """The same for new frames that are not sorted in yet."""
        self._last_slot: dict[int, int] = {}
        self._replies: deque[np.ndarray] = deque()
        self._waiting: deque[tuple[np.ndarray, np.ndarray]] = deque()
        """Frames that wait for room, and their due times [s of the clock]."""
        self._origin_s: float | None = None
        """Clock time of simulated time 0 [s], from the earliest arrival of any block."""
        self.latency_s = 0.0
        """Time from a sample to its frame's due time [s]: a block's length and an allowance."""
        self.waiting = 0
        """Frames that wait for room, without replies."""
        self.sent = 0
        """Frames that the bus has accepted."""
        self.dropped = 0
        """Frames that were dropped."""

    @property
    def undue(self) -> bool:
        """Whether frames wait for their slot, here or at the bus."""
        return len(self._undue[0]) > 0 or bool(self._added) or self._now() < self._last_handed_s

    @property
    def stuck(self) -> bool:
        """Whether frames wait for room."""
        return bool(self._waiting or self._replies)

    @property
    def next_s(self) -> float:
        """Next time at which `send_due` has work [s of the clock]; infinite if nothing waits for its slot."""
        if self._added:
            return -math.inf
        slots = self._undue[0]
        if not len(slots):
            return self._last_handed_s if self._now() < self._last_handed_s else math.inf
        return (int(slots[0]) - min(self._ahead, _MARGIN_SLOTS)) * SLOT_S

    def follow(self, block: wire.Block) -> None:
        """Update the relation of simulated time to the clock, and the latency, from a block that has arrived."""
        length_s = len(block.values) / block.rate_hz
        arrival_s = self._now() - (block.tick / block.tick_rate_hz + length_s)
        if self._origin_s is None or arrival_s < self._origin_s:
            self._origin_s = arrival_s
        # The last block of a run may be shorter; the latency must not shrink.
        self.latency_s = max(self.latency_s, length_s + _LATENESS_MARGIN_S)

    def put(self, message: CanMessage, data: np.ndarray, times_s: np.ndarray) -> None:
        """Queue frames until their slot.

        Args:
            message: Their message.
            data: uint8, shape (frames, length).
            times_s: Simulated times, ascending [s], shape (frames,).
        """
        records = make_records(message, data)
        if not self._paced or self._origin_s is None:
            self._added.append((np.zeros(len(records), np.int64), records))
            return
        due = np.ceil((times_s + (self._origin_s + self.latency_s)) / SLOT_S).astype(np.int64)
        # If the origin has moved, frames must not overtake earlier ones of the same message.
        np.maximum(due, self._last_slot.get(message.identifier, 0), out=due)
        self._last_slot[message.identifier] = int(due[-1])
        self._added.append((due, records))

    def put_one(self, message: CanMessage, time_s: float, **raw: int) -> None:
        """Queue one frame with these raw values until its slot."""
        self.put(message, np.frombuffer(message.encode(**raw), np.uint8)[None], np.array([time_s]))

    def answer(self, message: CanMessage, **raw: int) -> None:
        """Send a frame with these raw values before all samples; it is dropped if too many replies wait."""
        if len(self._replies) < _MAX_REPLIES:
            self._replies.append(make_records(message, np.frombuffer(message.encode(**raw), np.uint8)[None]))
        else:
            self.dropped += 1
        self.send()

    def send_due(self) -> None:
        """Send the frames that are due; to a bus that holds them until then, also those due soon."""
        slot = math.floor(self._now() / SLOT_S) if self._paced else 0
        if self._added:
            parts = [self._undue, *self._added]
            self._added.clear()
            slots = np.concatenate([each for each, _ in parts])
            # Frames of one slot keep the order of their arrival.
            order = np.argsort(slots, kind="stable")
            self._undue = slots[order], join_records([each for _, each in parts])[order]
        slots, records = self._undue
        count = int(np.searchsorted(slots, slot, side="right"))
        if self._ahead:
            soon, later = np.searchsorted(slots, (slot + _MARGIN_SLOTS, slot + self._ahead), side="right").tolist()
            count = max(soon, min(later, _MAX_AHEAD_FRAMES))
        if count:
            self._undue = slots[count:], records[count:]
            with self._sending:
                self._waiting.append((records[:count], slots[:count] * SLOT_S))
                self.waiting += count
                if slots[count - 1] > slot:
                    self._last_handed_s = int(slots[count - 1]) * SLOT_S
        self.send()

    def send(self) -> None:
        """Pass frames to the bus as far as it has room."""
        with self._sending:
            # Replies first: they do not wait for samples.
            while self._replies and self._pass_to_bus(self._replies[0]):
                self._replies.popleft()
            while self._waiting and not self._replies:
                records, due_s = self._waiting[0]
                accepted = self._pass_to_bus(records[:_BATCH_FRAMES], due_s[:_BATCH_FRAMES])
                self._forget_oldest(accepted)
                if accepted < min(len(records), _BATCH_FRAMES):
                    break
            while self.waiting > self._room:
                surplus = min(self.waiting - self._room, len(self._waiting[0][0]))
                self._forget_oldest(surplus)
                self.dropped += surplus

    def _forget_oldest(self, count: int) -> None:
        """Remove the oldest waiting frames, at most as many as were added at once."""
        records, due_s = self._waiting.popleft()
        self.waiting -= count
        if count < len(records):
            self._waiting.appendleft((records[count:], due_s[count:]))

    def drop_all(self) -> None:
        """Count all waiting frames as dropped."""
        undue = len(self._undue[0]) + sum(len(slots) for slots, _ in self._added)
        self.dropped += self.waiting + len(self._replies) + undue

    def _pass_to_bus(self, records: np.ndarray, due_s: np.ndarray | None = None) -> int:
        """Return the number of frames that the bus accepted, from the first on; frames without a time are due now."""
        import can

        # If the rig runs in real time, nothing waits here; otherwise the bus has a second.
        timeout = 0.0 if self._paced else 1.0
        accepted = 0
        try:
            if self._schedule_records is not None and due_s is not None:
                self._schedule_records(records, (1e9 * due_s).astype(np.int64), timeout)
                accepted = len(records)
            elif self._send_records is not None:
                self._send_records(records, timeout)
                accepted = len(records)
            else:
                for message in codec.make_messages(records):
                    self._bus.send(message, timeout)
                    accepted += 1
        except (can.CanError, OSError):
            if not self._paced:
                # Waiting has not helped.
                self.sent += accepted
                self.dropped += len(records) - accepted
                return len(records)
        self.sent += accepted
        return accepted
