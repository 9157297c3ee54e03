"""Frames on their way to a bus: each waits until it is due, then for room; what answers somebody goes first."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from drivers.can.bus import codec
from drivers.can.gateway.samples import records_of
from drivers.can.message import Message
from drivers.can.schedule import SLOT_S
from rig import wire

if TYPE_CHECKING:
    import can

_SETTLE_S = 1e-3
"""Added to the length of a block, so that a block that comes a little late still goes out on time [s]."""
_ANSWERS = 16
"""Answers that may wait for the bus."""
_PORTION = 64
"""Frames that the bus gets in one go."""


class Outbox:
    """Hands frames to a bus, each when it is due, those without room a little later and in their order.

    Args:
        bus: Any bus of python-can. Where it has `send_records` (a node of the virtual CAN), frames go there many at a
            time.
        room: Frames that may wait for room on the bus; beyond, the oldest are dropped.
        paced: Send each frame when it is due; False: at once, and wait for room.
        now: Clock [s].
    """

    def __init__(self, bus: can.BusABC, *, room: int, paced: bool, now: Callable[[], float]) -> None:
        self._bus = bus
        self._send_records = getattr(bus, "send_records", None)
        self._room = room
        self._paced = paced
        self._now = now
        self._sending = threading.Lock()
        self._slots: dict[int, list[np.ndarray]] = {}
        """Frames that are not due yet, by number of the slot on the clock."""
        self._last_slot: dict[int, int] = {}
        self._answers: deque[np.ndarray] = deque()
        self._waiting: deque[np.ndarray] = deque()
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
        """Whether frames wait for their slot."""
        return bool(self._slots)

    @property
    def stuck(self) -> bool:
        """Whether frames wait for room."""
        return bool(self._waiting or self._answers)

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
            self._slots.setdefault(0, []).append(records)
            return
        due = np.ceil((times_s + (self._origin_s + self.latency_s)) / SLOT_S).astype(np.int64)
        # Where the origin has moved, frames must not overtake those of the same message before them.
        np.maximum(due, self._last_slot.get(message.identifier, 0), out=due)
        self._last_slot[message.identifier] = int(due[-1])
        edges = [0, *(np.flatnonzero(np.diff(due)) + 1).tolist(), len(due)]
        for low, high in pairwise(edges):
            self._slots.setdefault(int(due[low]), []).append(records[low:high])

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
        """Send what is due by now."""
        slot = math.floor(self._now() / SLOT_S) if self._paced else 0
        for number in sorted(number for number in self._slots if number <= slot or not number):
            parts = self._slots.pop(number)
            records = parts[0] if len(parts) == 1 else np.concatenate(parts)
            with self._sending:
                self._waiting.append(records)
                self.waiting += len(records)
            self.send()
        self.send()

    def send(self) -> None:
        """Give the bus what it has room for."""
        with self._sending:
            # First what answers somebody: it does not wait behind samples.
            while self._answers and self._give(self._answers[0]):
                self._answers.popleft()
            while self._waiting and not self._answers:
                portion = self._waiting[0][:_PORTION]
                given = self._give(portion)
                self.waiting -= given
                if given < len(self._waiting[0]):
                    self._waiting[0] = self._waiting[0][given:]
                else:
                    self._waiting.popleft()
                if given < len(portion):
                    break
            while self.waiting > self._room:
                oldest = self._waiting.popleft()
                self.waiting -= len(oldest)
                self.dropped += len(oldest)

    def drop_all(self) -> None:
        """Give up what waits for room."""
        self.dropped += self.waiting + len(self._answers)

    def _give(self, records: np.ndarray) -> int:
        """How many of some frames the bus has taken, from the first on."""
        import can

        # Nothing waits here where the rig runs by the clock; else the bus has a second.
        timeout = 0.0 if self._paced else 1.0
        given = 0
        try:
            if self._send_records is not None:
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
