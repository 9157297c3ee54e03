"""Frames on their way to a bus: each waits until it is due, then for room; what answers somebody goes first."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from drivers.can.bus import codec
from drivers.can.bus.frame import FD_WIDTH, RECORDS, joined
from drivers.can.gateway.samples import records_of
from drivers.can.message import Message
from drivers.can.schedule import SLOT_S
from rig.base import wire

if TYPE_CHECKING:
    import can

_SETTLE_S = 1e-3
"""Added to the length of a block, so that a block that comes a little late still goes out on time [s]."""
_ANSWERS = 16
"""Answers that may wait for the bus."""
_PORTION = 64
"""Frames that the bus gets in one go."""
_AHEAD_SLOTS = 12
"""Slots ahead for which a bus gets frames that it can hold until they are due: a usual block at once."""
_AHEAD_FRAMES = 128
"""Most frames that it gets before they are due: a quarter of a transmit queue, so that late ones find room."""
_MARGIN_SLOTS = 2
"""Slots before the next frame is due at which it gets more of them."""


class Outbox:
    """Hands frames to a bus, each when it is due, those without room a little later and in their order.

    Args:
        bus: Any bus of python-can. Where it has `send_records` (a node of the virtual CAN), frames go there many at a
            time; where it has `schedule_records` (one whose hub is in this process), also before they are due.
        room: Frames that may wait for room on the bus; beyond, the oldest are dropped.
        paced: Send each frame when it is due; False: at once, and wait for room.
        now: Clock [s].
    """

    def __init__(self, bus: can.BusABC, *, room: int, paced: bool, now: Callable[[], float]) -> None:
        self._bus = bus
        self._send_records = getattr(bus, "send_records", None)
        self._schedule_records = getattr(bus, "schedule_records", None) if paced else None
        self._ahead = 0 if self._schedule_records is None else _AHEAD_SLOTS
        self._last_handed_s = -math.inf
        """When the last frame that the bus has got is due, by the clock."""
        self._room = room
        self._paced = paced
        self._now = now
        self._sending = threading.Lock()
        self._undue: tuple[np.ndarray, np.ndarray] = (np.zeros(0, np.int64), np.zeros(0, RECORDS[FD_WIDTH]))
        """Frames that are not due yet: numbers of their slots on the clock, ascending, and the frames."""
        self._added: list[tuple[np.ndarray, np.ndarray]] = []
        """The same of frames that are not in their place there yet."""
        self._last_slot: dict[int, int] = {}
        self._answers: deque[np.ndarray] = deque()
        self._waiting: deque[tuple[np.ndarray, np.ndarray]] = deque()
        """Frames that wait for room, and when each is due by the clock [s]."""
        self._origin_s: float | None = None
        """What time of the clock simulated time 0 is at: the earliest by which a block ever came."""
        self.latency_s = 0.0
        """From a sample to when its frame is due [s]: a block's length, and a little."""
        self.waiting = 0
        """Frames that wait for room, answers aside."""
        self.sent = 0
        """Frames that the bus has taken."""
        self.dropped = 0
        """Frames that it has not."""

    @property
    def undue(self) -> bool:
        """Return whether frames wait for their slot, here or at the bus."""
        return len(self._undue[0]) > 0 or bool(self._added) or self._now() < self._last_handed_s

    @property
    def stuck(self) -> bool:
        """Whether frames wait for room."""
        return bool(self._waiting or self._answers)

    @property
    def next_s(self) -> float:
        """When `send_due` has something to do again by the clock [s]; infinite where nothing waits for its slot."""
        if self._added:
            return -math.inf
        slots = self._undue[0]
        if not len(slots):
            return self._last_handed_s if self._now() < self._last_handed_s else math.inf
        return (int(slots[0]) - min(self._ahead, _MARGIN_SLOTS)) * SLOT_S

    def follow(self, block: wire.Block) -> None:
        """Learn from a block what time on the clock a simulated time is due at."""
        length_s = len(block.values) / block.rate_hz
        came = self._now() - (block.tick / block.tick_rate_hz + length_s)
        if self._origin_s is None or came < self._origin_s:
            self._origin_s = came
        # The last block of a run may be shorter than the others; its frames wait no less.
        self.latency_s = max(self.latency_s, length_s + _SETTLE_S)

    def put(self, message: Message, data: np.ndarray, times_s: np.ndarray) -> None:
        """Keep frames until their slot.

        Args:
            message: What they are.
            data: uint8, shape (frames, length).
            times_s: Simulated times, ascending [s], shape (frames,).
        """
        records = records_of(message, data)
        if not self._paced or self._origin_s is None:
            self._added.append((np.zeros(len(records), np.int64), records))
            return
        due = np.ceil((times_s + (self._origin_s + self.latency_s)) / SLOT_S).astype(np.int64)
        # Where the origin has moved, frames must not overtake those of the same message before them.
        np.maximum(due, self._last_slot.get(message.identifier, 0), out=due)
        self._last_slot[message.identifier] = int(due[-1])
        self._added.append((due, records))

    def put_one(self, message: Message, time_s: float, **raw: int) -> None:
        """Keep one frame with these raw values until its slot."""
        self.put(message, np.frombuffer(message.encode(**raw), np.uint8)[None], np.array([time_s]))

    def answer(self, message: Message, **raw: int) -> None:
        """Send a frame with these raw values before all samples; dropped where many others wait."""
        if len(self._answers) < _ANSWERS:
            self._answers.append(records_of(message, np.frombuffer(message.encode(**raw), np.uint8)[None]))
        else:
            self.dropped += 1
        self.send()

    def send_due(self) -> None:
        """Send what is due by now, or soon where the bus can hold it until then."""
        slot = math.floor(self._now() / SLOT_S) if self._paced else 0
        if self._added:
            parts = [self._undue, *self._added]
            self._added.clear()
            slots = np.concatenate([each for each, _ in parts])
            # Those of a slot in the order in which they came.
            order = np.argsort(slots, kind="stable")
            self._undue = slots[order], joined([each for _, each in parts])[order]
        slots, records = self._undue
        count = int(np.searchsorted(slots, slot, side="right"))
        if self._ahead:
            soon, later = np.searchsorted(slots, (slot + _MARGIN_SLOTS, slot + self._ahead), side="right").tolist()
            count = max(soon, min(later, _AHEAD_FRAMES))
        if count:
            self._undue = slots[count:], records[count:]
            with self._sending:
                self._waiting.append((records[:count], slots[:count] * SLOT_S))
                self.waiting += count
                if slots[count - 1] > slot:
                    self._last_handed_s = int(slots[count - 1]) * SLOT_S
        self.send()

    def send(self) -> None:
        """Give the bus what it has room for."""
        with self._sending:
            # First what answers somebody: it does not wait behind samples.
            while self._answers and self._give(self._answers[0]):
                self._answers.popleft()
            while self._waiting and not self._answers:
                records, due_s = self._waiting[0]
                given = self._give(records[:_PORTION], due_s[:_PORTION])
                self._forget_oldest(given)
                if given < min(len(records), _PORTION):
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
        """Give up what waits for its slot or for room."""
        undue = len(self._undue[0]) + sum(len(slots) for slots, _ in self._added)
        self.dropped += self.waiting + len(self._answers) + undue

    def _give(self, records: np.ndarray, due_s: np.ndarray | None = None) -> int:
        """Return the number of frames that the bus has taken, from the first on; those without a time are due now."""
        import can

        # Nothing waits here where the rig runs by the clock; else the bus has a second.
        timeout = 0.0 if self._paced else 1.0
        given = 0
        try:
            if self._schedule_records is not None and due_s is not None:
                self._schedule_records(records, (1e9 * due_s).astype(np.int64), timeout)
                given = len(records)
            elif self._send_records is not None:
                self._send_records(records, timeout)
                given = len(records)
            else:
                for message in codec.messages_of(records):
                    self._bus.send(message, timeout)
                    given += 1
        except (can.CanError, OSError):
            if not self._paced:
                # Waiting has not helped.
                self.sent += given
                self.dropped += len(records) - given
                return len(records)
        self.sent += given
        return given
