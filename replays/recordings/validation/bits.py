"""Comparison of payloads: every recorded block with the encoded rows of a re-simulation.

Columns are matched by name: of a recording with some channels only these are compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from recorder.reader import Recording
from rig.base.wire import EDGES, Block, encode_block, get_schema, sensor_key, truth_key
from rig.channels.table import ChannelTable
from rig.run.simulation import TICK_RATE_HZ, Frame

_MAX_DIFFERENT = 400_000
"""Largest number of differing rows that are kept."""
_EDGE_S = 0.05
"""Largest difference of streams' begins and ends [s]: a recorder may start between the blocks of two streams."""


@dataclass
class StreamBits:
    """Comparison of one stream.

    Attributes:
        rows: Number of compared rows.
        different: Number of different payloads.
        first_s: Simulated time of the first different row [s], or None.
        first_column: Column of the first difference.
        largest: Largest difference, in counts or SI.
        skipped: Number of rows that the recording lost.
        beyond: Number of rows without a counterpart.
        columns: Number of recorded and of simulated columns, if they or their order differ.
    """

    rows: int = 0
    different: int = 0
    first_s: float | None = None
    first_column: int = 0
    largest: float = 0.0
    skipped: int = 0
    beyond: int = 0
    columns: tuple[int, int] | None = None

    @property
    def equal(self) -> bool:
        """True if every payload is equal, byte for byte, in the recorded columns."""
        return self.different == 0 and self.beyond == 0

    @property
    def picked(self) -> str:
        """Compared columns as text; empty if all are present in their order."""
        if self.columns is None:
            return ""
        here, there = self.columns
        return f"{here} of {there}" if here < there else "in another order"


class Bits:
    """Comparison with a re-simulation, frame by frame; only rows for which recorded blocks wait are kept."""

    def __init__(self, recording: Recording, made: ChannelTable) -> None:
        """Prepare the comparison.

        Args:
            recording: The recording.
            made: Channel table of the re-simulation.
        """
        keys = sorted(key for key in recording.messages if get_schema(key) is not None and key in recording.streams)
        self._edges: list[np.ndarray] = []
        self._names = {name: group.names for name, group in recording.table.groups.items()}
        self.streams = {key: _Follower(key, recording.blocks(key)) for key in keys}
        for name, group in recording.table.groups.items():
            follower = self.streams.get(sensor_key(name))
            if follower is None or name not in made.groups:
                continue
            there = made.groups[name].names
            if group.names != there and set(group.names) <= set(there):
                follower.picked = [there.index(channel) for channel in group.names]
                follower.counts.columns = (len(group.names), len(there))

    def follow(self, frame: Frame) -> None:
        """Compare the next frame."""
        blocks = {sensor_key(name): block for name, block in frame.samples.items()}
        blocks |= {truth_key(name): block for name, block in frame.truth.items()}
        if frame.edges is not None:
            blocks[EDGES] = frame.edges
            self._edges.append(frame.edges.values[:, 0] + frame.edges.tick)
        for key, block in blocks.items():
            if key in self.streams:
                self.streams[key].take(block)

    def differences(self, group: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return the rows in which a group's counts differ, and the differences by channel, each shape (n,)."""
        kept = self.streams[sensor_key(group)].differences if sensor_key(group) in self.streams else []
        if not kept:
            return np.empty(0, np.int64), {}
        counts = np.concatenate([counts for _, counts in kept])
        return np.concatenate([rows for rows, _ in kept]), dict(zip(self._names[group], counts.T, strict=True))

    def channels_off(self, group: str) -> list[str]:
        """Return the channels of a group whose counts differ."""
        return [name for name, counts in self.differences(group)[1].items() if counts.any()]

    def edges_s(self) -> np.ndarray:
        """Return the simulated keyphasor edges [s]; empty if none were recorded."""
        if EDGES not in self.streams:
            return np.empty(0)
        return np.concatenate([np.empty(0), *self._edges]) / TICK_RATE_HZ

    def finish(self) -> dict[str, StreamBits]:
        """Return the results by key."""
        return {key: follower.finish() for key, follower in self.streams.items()}


def missing_rows(recording: Recording) -> dict[str, tuple[int, int]]:
    """Return the number of sample rows that a recording lacks, without use of its documents on faults.

    Args:
        recording: The recording.

    Returns:
        Number of missing rows, and of all rows in the span of all streams, by key of each incomplete stream.
    """
    groups = {sensor_key(name): group.rate_hz for name, group in recording.table.groups.items()}
    filled = [one for key, one in recording.streams.items() if key != EDGES and one.rows]
    if not filled:
        return {}
    first_s, last_s = min(one.first_time_s for one in filled), max(one.last_time_s for one in filled)
    losses: dict[str, tuple[int, int]] = {}
    for key, rate in groups.items():
        due = math.floor(last_s * rate + 1e-6) + 1 - math.ceil(first_s * rate - 1e-6)
        spans = sorted((block.index, block.index + len(block.values)) for block in recording.blocks(key))
        there, reached = 0, -1
        for begin, end in spans:
            there += max(0, end - max(begin, reached))
            reached = max(reached, end)
        inside = spans[-1][1] - spans[0][0] - there if spans else 0
        outside = due - there - inside
        if lost := inside + (outside if outside > _EDGE_S * rate else 0):
            losses[key] = lost, due
    return losses


@dataclass
class _Follower:
    key: str
    recorded: Iterator[Block]
    picked: list[int] | None = None
    """Recorded columns of the re-simulation, in their order; None for all."""
    counts: StreamBits = field(default_factory=StreamBits)
    differences: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    """Numbers of differing rows, and their differences, up to a limit."""
    _waiting: Block | None = None
    _rows: list[np.ndarray] = field(default_factory=list)
    _first: int = 0
    """Number of the first kept row."""
    _next: int | None = None

    def take(self, block: Block) -> None:
        values = block.values if self.picked is None else block.values[:, self.picked]
        if self.key == EDGES:  # ticks from the block's tick, converted to ticks from the rig's tick zero
            values = values + block.tick
        if not self._rows:
            self._first = block.index
        self._rows.append(values.copy())
        kept = np.concatenate(self._rows)
        end = self._first + len(kept)
        while (waiting := self._upcoming()) is not None and waiting.index + len(waiting.values) <= end:
            self._compare(waiting, kept[max(0, waiting.index - self._first) :][: len(waiting.values)], block)
            self._waiting = None
        begin = end if waiting is None else min(end, max(self._first, waiting.index))
        self._rows = [kept[begin - self._first :]] if begin < end else []
        self._first = begin

    def _upcoming(self) -> Block | None:
        if self._waiting is None:
            self._waiting = next(self.recorded, None)
        return self._waiting

    def _compare(self, recorded: Block, values: np.ndarray, like: Block) -> None:
        counts, n = self.counts, len(recorded.values)
        if self._next is not None:
            counts.skipped += max(0, recorded.index - self._next)
        self._next = recorded.index + n
        if recorded.index < self._first and len(values) and self._first > recorded.index:
            counts.beyond += n  # an older block again: its rows have been released
            return
        if n == 0:
            return
        counts.rows += n
        if self.key == EDGES:
            tick, values = recorded.tick, values - recorded.tick
        else:
            tick = round(recorded.index * TICK_RATE_HZ / like.rate_hz)
        again = Block(
            tick=tick, index=recorded.index, rate_hz=like.rate_hz, tick_rate_hz=like.tick_rate_hz, values=values
        )
        if encode_block(again) == encode_block(recorded):
            return
        counts.different += 1
        if values.shape != recorded.values.shape:
            row, column = 0, 0
        else:
            off = np.abs(values.astype(float) - recorded.values)
            counts.largest = max(counts.largest, float(off.max()))
            rows = np.flatnonzero(off.any(axis=1))
            if sum(len(n) for n, _ in self.differences) < _MAX_DIFFERENT:
                self.differences.append((recorded.index + rows, (recorded.values.astype(float) - values)[rows]))
            row, column = (int(k) for k in np.argwhere(values != recorded.values)[0]) if off.any() else (0, 0)
        if counts.first_s is None:
            rate = recorded.rate_hz
            offset = recorded.values[row, 0] if self.key == EDGES else row * TICK_RATE_HZ / rate if rate else 0.0
            counts.first_s, counts.first_column = float(recorded.tick + offset) / TICK_RATE_HZ, column

    def finish(self) -> StreamBits:
        """Count the rows without a counterpart."""
        while (waiting := self._upcoming()) is not None:
            self.counts.beyond += len(waiting.values)
            self._waiting = None
        return self.counts
