"""The payloads of a recording in the order of their deadlines; knows no clock and no transport."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import accumulate

from replays.player.messages import Message, Track
from rig.base import wire

_NS = 1_000_000_000


class By(StrEnum):
    """What decides when a payload is due."""

    SIMULATED = "simulated"
    ARRIVAL = "arrival"


@dataclass(frozen=True, slots=True)
class Item:
    """A payload with its deadline.

    Attributes:
        due_ns: When it is due, on the scale that `By` names [ns].
        position_ns: Simulated time at which it was there: of a block the end, of a document its own [ns].
        key: Key that it came on.
        payload: Its bytes, as recorded.
        block: What it holds, where it is a block.
    """

    due_ns: int
    position_ns: int
    key: str
    payload: bytes
    block: wire.Block | None


Batch = list[Item]
"""What is due at the same instant."""


class Timeline:
    """Payloads by deadline, from any position on.

    By simulated time a block is due at its end, as a rig has it no sooner, and a document at its own time. By arrival
    everything is due when the recorder had got it. Within a key the order is the recorded one in any case: what would
    be due before its predecessor is due with it.

    A recorder may have got one key after the other (`rig record --history`), so chunks are read as far as something
    in them could be due next.

    Args:
        track: Where the messages are.
        by: What the deadlines follow.
    """

    def __init__(self, track: Track, by: By = By.SIMULATED) -> None:
        self.track = track
        self.by = by

    def play(self, from_ns: int, to_ns: int | None = None) -> Iterator[Batch]:
        """Batches in order, without what is not whole between two positions.

        Args:
            from_ns: Blocks begin and documents stand here or later [ns of simulated time].
            to_ns: Blocks end and documents stand here or earlier [ns of simulated time]; None: at the end.
        """
        batch: Batch = []
        for item in self._in_order(from_ns, to_ns):
            if batch and item.due_ns != batch[0].due_ns:
                yield batch
                batch = []
            batch.append(item)
        if batch:
            yield batch

    def _in_order(self, from_ns: int, to_ns: int | None) -> Iterator[Item]:
        chunks = self.track.chunks
        # Nothing that begins earlier than this stands in a chunk or in any after it.
        beginnings = list(accumulate((chunk.begin_ns for chunk in reversed(chunks)), min))[::-1]
        waiting: list[tuple[int, int, Item]] = []
        ages = _Ages(self.by)
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
                item = ages.item(message)
                if message.time_ns < from_ns or (to_ns is not None and item.position_ns > to_ns):
                    continue
                if self.by is By.ARRIVAL:
                    yield item
                else:
                    heapq.heappush(waiting, (item.due_ns, number, item))
                    number += 1
        while waiting:
            yield heapq.heappop(waiting)[2]


class _Ages:
    """Finds when each message is due, in the order of the file."""

    def __init__(self, by: By) -> None:
        self._by = by
        self._last: dict[str, int] = {}
        self._arrived_ns = 0
        self._length_ns = 0

    def item(self, message: Message) -> Item:
        block, key = _block(message), message.key
        position_ns = message.time_ns
        if block is not None and block.rate_hz > 0.0:
            length_ns = round(len(block.values) * _NS / block.rate_hz)
            position_ns += length_ns
            if key.startswith(f"{wire.SENSORS}/"):
                self._length_ns = length_ns
        elif key == wire.EDGES:
            # A block of edges does not tell its length; the rig publishes it together with the samples.
            position_ns += self._length_ns
        if self._by is By.ARRIVAL:
            due_ns = self._arrived_ns = max(self._arrived_ns, message.arrival_ns)
        else:
            due_ns = self._last[key] = max(self._last.get(key, position_ns), position_ns)
        return Item(due_ns, position_ns, key, message.payload, block)


def _block(message: Message) -> wire.Block | None:
    schema = wire.schema_of(message.key)
    if schema is None:
        return None
    try:
        return wire.decode_block(message.payload, schema)
    except ValueError:
        # Not what its key promises; it goes out as it came.
        return None
