"""Part of a recording to play, number of passes, and the sequence of batches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from replays.player.playhead import NS
from replays.player.timeline import Batch, Item, Timeline
from rig.base import wire
from rig.base.errors import InputError


@dataclass(frozen=True)
class Part:
    """Part of a recording to play; times are simulated times of the recording [s].

    Attributes:
        from_s: Start of a pass; None: start of the recording.
        to_s: End of a pass; None: end of the recording.
        start_s: Start of the first pass; None: `from_s`.
        loops: Number of passes; None: unlimited.
    """

    from_s: float | None = None
    to_s: float | None = None
    start_s: float | None = None
    loops: int | None = 1


@dataclass(frozen=True, slots=True)
class Mark:
    """Start of a pass, or of the data after a seek.

    Attributes:
        number: Number of the pass, counted from 1.
        from_ns: Position in the recording [ns of simulated time].
        due_ns: First deadline [ns, on the scale of the timeline].
        tick: Tick of the first block, or of the position if there is no block.
    """

    number: int
    from_ns: int
    due_ns: int
    tick: int


class Passes:
    """Passes through a part of a recording.

    Args:
        timeline: The recording.
        part: The part, and the number of passes.
        tick_rate_hz: Ticks per simulated second [Hz].

    Attributes:
        part: As given.
        timeline: As given.
        from_ns: Start of a pass [ns of simulated time].
        start_ns: Start of the first pass [ns of simulated time].

    Raises:
        InputError: If the recording has no such part.
    """

    def __init__(self, timeline: Timeline, part: Part, tick_rate_hz: int) -> None:
        self.timeline = timeline
        self.part = part
        self._tick_rate_hz = tick_rate_hz
        track = timeline.track
        first_s, last_s = track.begin_ns / NS, track.end_ns / NS
        for name, value in (("from", part.from_s), ("to", part.to_s), ("start", part.start_s)):
            if value is not None and not first_s <= value <= last_s:
                raise InputError(name, f"within the recording, {first_s:g} to {last_s:g} s", value)
        if part.loops is not None and part.loops < 1:
            raise InputError("loop", "at least 1", part.loops)
        self.from_ns = track.begin_ns if part.from_s is None else round(part.from_s * NS)
        self._to_ns = None if part.to_s is None else round(part.to_s * NS)
        self.start_ns = self.from_ns if part.start_s is None else round(part.start_s * NS)
        if not self.from_ns < self.end_ns:
            raise InputError("to", "later than from", part.to_s)
        if not self.from_ns <= self.start_ns < self.end_ns:
            raise InputError("start", "within from and to", part.start_s)
        if next(timeline.play(self.start_ns, self._to_ns), None) is None:
            raise InputError("to", "late enough for a whole block", part.to_s)

    @property
    def end_ns(self) -> int:
        """End of a pass, as far as it is known in advance [ns of simulated time]."""
        return self.timeline.track.end_ns if self._to_ns is None else self._to_ns

    def play(self, from_ns: int, number: int) -> Iterator[Batch | Mark]:
        """Yield a mark for each pass, followed by its batches.

        Args:
            from_ns: Position at which to continue [ns of simulated time].
            number: Number of the current pass.
        """
        while self.part.loops is None or number <= self.part.loops:
            batches = self.timeline.play(from_ns, self._to_ns)
            first: list[Batch] = []
            for batch in batches:
                first.append(batch)
                if has_block(batch):
                    break
            if first:
                tick = next((item.block.tick for item in first[-1] if _is_block(item) and item.block is not None), None)
                position = from_ns * self._tick_rate_hz // NS
                yield Mark(number, from_ns, first[0][0].due_ns, position if tick is None else tick)
            yield from first
            yield from batches
            number += 1
            from_ns = self.from_ns


def has_block(batch: Batch) -> bool:
    """Return whether a batch contains a block of samples or of the truth; edges are published with those."""
    return any(map(_is_block, batch))


def _is_block(item: Item) -> bool:
    return item.block is not None and item.key != wire.EDGES


def payload_size(read: Batch | Mark) -> int:
    """Return the payload size of a batch or mark [bytes]."""
    return sum(len(item.payload) for item in read) if isinstance(read, list) else 0
