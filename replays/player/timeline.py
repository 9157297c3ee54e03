"""Payloads of a recording in order of their deadlines, independent of clock and transport."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import accumulate

from replays.player.messages import Message, Track
from rig.base import wire

_NS_PER_S = 1_000_000_000


class By(StrEnum):
    """Time that determines the deadlines."""

    SIMULATED = "simulated"
    ARRIVAL = "arrival"


@dataclass(frozen=True, slots=True)
class Item:
    """A payload with its deadline.

    Attributes:
        due_ns: Deadline, on the scale selected by `By` [ns].
        position_ns: Simulated time of the end of a block, or of a document [ns].
        key: Key of the payload.
        payload: Recorded bytes.
        block: Decoded block; None if the payload is none.
    """

    due_ns: int
    position_ns: int
    key: str
    payload: bytes
    block: wire.Block | None


Batch = list[Item]
"""Payloads with the same deadline."""


class Timeline:
    """Payloads in order of deadline, from any position.

    By simulated time, a block is due at its end, when a rig has it, and a document at its own time. By arrival, each
    payload is due when the recorder received it. The recorded order within a key is always kept: a payload is never due
    before its predecessor.

    A recorder may have received one key after the other (`rig record --history`), so chunks are read until no later
    chunk can contain the next payload.

    Args:
        track: Source of the messages.
        by: Time that determines the deadlines.
    """

    def __init__(self, track: Track, by: By = By.SIMULATED) -> None:
        self.track = track
        self.by = by

    def play(self, from_ns: int, to_ns: int | None = None) -> Iterator[Batch]:
        """Yield batches in order, limited to payloads that lie entirely between two positions.

        Args:
            from_ns: Earliest begin of a block or time of a document [ns of simulated time].
            to_ns: Latest end of a block or time of a document [ns of simulated time]; None: no limit.
        """
        batch: Batch = []
        for item in self._read_in_order(from_ns, to_ns):
            if batch and item.due_ns != batch[0].due_ns:
                yield batch
                batch = []
            batch.append(item)
        if batch:
            yield batch

    def _read_in_order(self, from_ns: int, to_ns: int | None) -> Iterator[Item]:
        chunks = self.track.chunks
        # Earliest begin of a message in each chunk and all chunks after it.
        beginnings = list(accumulate((chunk.begin_ns for chunk in reversed(chunks)), min))[::-1]
        waiting: list[tuple[int, int, Item]] = []
        deadlines = _Deadlines(self.by)
        number = 0
        for chunk, beginning_ns in zip(chunks, beginnings, strict=True):
            if to_ns is not None and beginning_ns > to_ns:
                break
            if chunk.end_ns < from_ns:
                continue
            if self.by is By.SIMULATED:
                while waiting and waiting[0][0] <= beginning_ns:
                    yield heapq.heappop(waiting)[2]
            for message in self.track.read(chunk):
                item = deadlines.make_item(message)
                if message.time_ns < from_ns or (to_ns is not None and item.position_ns > to_ns):
                    continue
                if self.by is By.ARRIVAL:
                    yield item
                else:
                    heapq.heappush(waiting, (item.due_ns, number, item))
                    number += 1
        while waiting:
            yield heapq.heappop(waiting)[2]


class _Deadlines:
    """Computes the deadline of each message, in the order of the file."""

    def __init__(self, by: By) -> None:
        self._by = by
        self._last: dict[str, int] = {}
        self._arrived_ns = 0
        self._length_ns = 0

    def make_item(self, message: Message) -> Item:
        block, key = _block(message), message.key
        position_ns = message.time_ns
        if block is not None and block.rate_hz > 0.0:
            length_ns = round(len(block.values) * _NS_PER_S / block.rate_hz)
            position_ns += length_ns
            if key.startswith(f"{wire.SENSORS}/"):
                self._length_ns = length_ns
        elif key == wire.EDGES:
            # A block of edges does not contain its length; the rig publishes it together with the samples.
            position_ns += self._length_ns
        if self._by is By.ARRIVAL:
            due_ns = self._arrived_ns = max(self._arrived_ns, message.arrival_ns)
        else:
            due_ns = self._last[key] = max(self._last.get(key, position_ns), position_ns)
        return Item(due_ns, position_ns, key, message.payload, block)


def _block(message: Message) -> wire.Block | None:
    schema = wire.get_schema(message.key)
    if schema is None:
        return None
    try:
        return wire.decode_block(message.payload, schema)
    except ValueError:
        # The payload does not match its key; publish it as recorded.
        return None
