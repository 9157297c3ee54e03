"""Row counts of streams, corrected by the documents on block faults: dropped, duplicated, late and renumbered blocks.

A block has the number under which the device under test receives it. The documents on `rig.base.wire.FAULTS` give the
true rows. With both, rows dropped by a fault are distinguished from rows lost in transmission.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from heapq import heappop, heappush
from typing import Annotated, Any

from pydantic import Field

from rig.base.checks import Count, StrictModel, check
from rig.base.errors import InputError
from rig.base.wire import Block, Continuity, Gap

_MAX_PENDING = 10_000
"""Declared blocks of a stream that have not arrived yet."""
_MAX_STREAMS = 1000
_MAX_WAITING = 1100
"""Blocks that wait for an earlier one: as many as arrive during the longest delay of a fault."""


class _SentBlock(StrictModel, extra="ignore"):
    index: Count
    tick: Annotated[int, Field(ge=0, le=2**53)]
    doors: list[str]


class _DeclaredBlock(StrictModel, extra="ignore"):
    key: str
    row: Count
    rows: Annotated[int, Field(gt=0, le=2**40)]
    sent: Annotated[list[_SentBlock], Field(max_length=100)]


class _Document(StrictModel, extra="ignore", strict=False):
    event: str
    blocks: tuple[_DeclaredBlock, ...] = ()


def sort_blocks(blocks: Iterator[tuple[str, Block]]) -> Iterator[tuple[str, Block]]:
    """Yield blocks of several streams, which may arrive late or twice, in order and once each."""
    waiting: dict[str, list[tuple[int, int, Block]]] = {}
    due: dict[str, int] = {}
    for n, (key, block) in enumerate(blocks):
        heap = waiting.setdefault(key, [])
        heappush(heap, (block.index, n, block))
        due.setdefault(key, block.index)
        while heap and (heap[0][0] <= due[key] or len(heap) > _MAX_WAITING):
            yield from _pop_next(key, heap, due)
    for key, heap in waiting.items():
        while heap:
            yield from _pop_next(key, heap, due)


def _pop_next(key: str, heap: list[tuple[int, int, Block]], due: dict[str, int]) -> Iterator[tuple[str, Block]]:
    index, _, block = heappop(heap)
    if index >= due[key]:
        due[key] = index + len(block.values)
        yield key, block


class Declared(Continuity):
    """Continuity of rows by their true numbers where documents declare these, otherwise as in `Continuity`.

    Attributes:
        declared: Rows counted as lost that a fault dropped, or that arrived late because of a fault; by key.
    """

    def __init__(self) -> None:
        super().__init__()
        self.declared: dict[str, int] = {}
        self._first: dict[str, int] = {}
        self._known: dict[str, dict[tuple[int, int, int], list[int]]] = {}
        """True row and number of expected arrivals of a declared block, by number, tick and length."""
        self._dropped_before: dict[str, list[tuple[int, int]]] = {}
        self._missing: dict[str, deque[tuple[int, int]]] = {}
        self._dropped: dict[str, deque[tuple[int, int]]] = {}
        self._undeclared: dict[str, deque[tuple[int, int, int]]] = {}
        """Number, tick and length of the latest undeclared blocks since the numbering restarted."""
        self._renumbered: dict[str, tuple[int, int]] = {}
        """Number after the last of these blocks that was declared later: as sent, and true."""

    def declare(self, document: Mapping[str, Any]) -> bool:
        """Register a document on faults, of blocks sent by zenoh. Return whether it is such a document."""
        try:
            declaration = check(_Document, dict(document), field="faults")
        except InputError:
            return False
        for one in declaration.blocks:
            if one.key not in self._known and len(self._known) >= _MAX_STREAMS:
                continue
            sent, blocks = [each for each in one.sent if "zenoh" in each.doors], self._known.setdefault(one.key, {})
            if not sent:
                dropped = self._dropped.setdefault(one.key, deque(maxlen=_MAX_PENDING))
                if dropped and sum(dropped[-1]) == one.row:
                    dropped[-1] = (dropped[-1][0], dropped[-1][1] + one.rows)
                else:
                    dropped.append((one.row, one.rows))
            for each in sent:
                if each.index != one.row:
                    self._undeclared.setdefault(one.key, deque(maxlen=_MAX_WAITING))
                if (which := (each.index, each.tick, one.rows)) in self._undeclared.get(one.key, ()):
                    self._undeclared[one.key].remove(which)
                    self._correct(one.key, each.index + one.rows, one.row + one.rows)
                else:
                    blocks.setdefault(which, [one.row, 0])[1] += 1
            while len(blocks) > _MAX_PENDING:
                del blocks[next(iter(blocks))]
            self._count_dropped(one.key)
        return True

    def knows(self, key: str, block: Block) -> bool:
        """Return whether a block has been declared."""
        return (block.index, block.tick, len(block.values)) in self._known.get(key, {})

    def true(self, key: str, block: Block) -> Block:
        """Return a block with the true number and tick of its rows."""
        declared = self._known.get(key, {}).get((block.index, block.tick, len(block.values)))
        if declared is None or declared[0] == block.index:
            tick = None if declared is None else round(block.index * block.tick_rate_hz / block.rate_hz)
            return block if tick is None else replace(block, tick=tick)
        return replace(block, index=declared[0], tick=round(declared[0] * block.tick_rate_hz / block.rate_hz))

    def take(self, key: str, block: Block) -> Gap | None:
        """Count the next block. Return the gap before it; None without a gap, or if a late block is declared."""
        blocks, rows = self._known.get(key, {}), len(block.values)
        declared = blocks.get(which := (block.index, block.tick, rows))
        row = block.index if declared is None else declared[0]
        due = self.next.get(key, row)
        self._first.setdefault(key, due)
        if declared is None and (row < due or key in self._undeclared):
            self._undeclared.setdefault(key, deque(maxlen=_MAX_WAITING)).append(which)
        if (declared is not None and row > due == block.index) or (due, row) == self._renumbered.get(key):
            # The earlier blocks, which were not declared in time, were renumbered as this one is.
            self.next[key] = due = row
            self._withdraw_restart(key)
        gap = self.follow(key, row, rows) if declared is None or row >= due else None
        if gap is not None and gap.size > 0:
            self._missing.setdefault(key, deque(maxlen=_MAX_PENDING)).append((due, row))
        if declared is not None:
            if row < due:
                self._count_late(key, row, rows)
            declared[1] -= 1
            if not declared[1]:
                del blocks[which]
        self._count_dropped(key)
        return gap

    def _withdraw_restart(self, key: str) -> None:
        """Withdraw a restart of the numbering that a document has explained."""
        self.runs[key] = max(0, self.runs.get(key, 0) - 1)
        self._renumbered.pop(key, None)

    def _correct(self, key: str, number: int, row: int) -> None:
        """Correct the counts for a block that was declared after its arrival.

        Args:
            key: Stream.
            number: Row number after the block, as sent.
            row: True row number after the block.
        """
        self._renumbered[key] = number, row
        if self.next.get(key) == number:
            self.next[key] = row
            self._withdraw_restart(key)
        elif (number, row) in self._missing.get(key, ()):
            self._missing[key].remove((number, row))
            self.declared[key] = self.declared.get(key, 0) + row - number
            self._withdraw_restart(key)

    def _count_late(self, key: str, row: int, rows: int) -> None:
        """Count a block that arrived after later ones: as late if its rows were missing, otherwise as a duplicate."""
        holes = self._missing.get(key, deque())
        hole = next((each for each in reversed(holes) if each[0] <= row and row + rows <= each[1]), None)
        if hole is None:
            early = row + rows <= self._first[key]
            self.received[key] += rows if early else 0
            self.stale += 0 if early else rows
            self._first[key] = row if early else self._first[key]
            return
        holes.remove(hole)
        holes.extend(part for part in ((hole[0], row), (row + rows, hole[1])) if part[0] < part[1])
        self.received[key] += rows
        self.declared[key] = self.declared.get(key, 0) + rows

    def _count_dropped(self, key: str) -> None:
        """Count the rows that faults dropped up to the next expected row."""
        dropped, due = self._dropped.get(key), self.next.get(key, 0)
        while dropped and dropped[0][0] < due:
            row, rows = dropped.popleft()
            here = min(row + rows, due) - row
            if here < rows:
                dropped.appendleft((row + here, rows - here))
            if row >= self._first.get(key, 0):
                self.declared[key] = self.declared.get(key, 0) + here
            else:
                self._dropped_before.setdefault(key, []).append((row, here))

    @property
    def faulty(self) -> set[str]:
        """Streams of which a fault dropped blocks."""
        return {*self._dropped}

    def around(self, key: str) -> list[list[int]]:
        """Return the dropped rows before the first block of a stream and after its last one: first row and number."""
        return [list(each) for each in (*self._dropped_before.get(key, ()), *self._dropped.get(key, ()))]
