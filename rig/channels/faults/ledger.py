"""Rows followed by what is told of faults of blocks: what was never sent, was sent twice, late or with other numbers.

Blocks say what a device under test sees; the documents on `rig.base.wire.FAULTS` say which rows they truly are. Who may
read these tells what a fault has taken from what was really lost.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from heapq import heappop, heappush
from typing import Annotated, Any

from pydantic import Field

from rig.base.checks import Count, Outside, check
from rig.base.errors import InputError
from rig.base.wire import Block, Continuity, Gap

_MOST = 10_000
"""Blocks of a stream that were told and have not come."""
_MOST_STREAMS = 1000
_AHEAD = 1100
"""So many blocks wait for an earlier one: those that come while one is held back for longest."""


class _Sent(Outside, extra="ignore"):
    index: Count
    tick: Annotated[int, Field(ge=0, le=2**53)]
    doors: list[str]


class _Told(Outside, extra="ignore"):
    key: str
    row: Count
    rows: Annotated[int, Field(gt=0, le=2**40)]
    sent: Annotated[list[_Sent], Field(max_length=100)]


class _Document(Outside, extra="ignore", strict=False):
    event: str
    blocks: tuple[_Told, ...] = ()


def in_order(blocks: Iterator[tuple[str, Block]]) -> Iterator[tuple[str, Block]]:
    """Blocks of several streams that may come late or twice, each stream in order and once."""
    waiting: dict[str, list[tuple[int, int, Block]]] = {}
    due: dict[str, int] = {}
    for n, (key, block) in enumerate(blocks):
        heap = waiting.setdefault(key, [])
        heappush(heap, (block.index, n, block))
        due.setdefault(key, block.index)
        while heap and (heap[0][0] <= due[key] or len(heap) > _AHEAD):
            yield from _next(key, heap, due)
    for key, heap in waiting.items():
        while heap:
            yield from _next(key, heap, due)


def _next(key: str, heap: list[tuple[int, int, Block]], due: dict[str, int]) -> Iterator[tuple[str, Block]]:
    index, _, block = heappop(heap)
    if index >= due[key]:
        due[key] = index + len(block.values)
        yield key, block


class Declared(Continuity):
    """Follows rows as `Continuity` does, by their true numbers where these are told.

    Attributes:
        declared: Of the rows that are counted as lost, those that a fault has taken, or that came late by one; by key.
    """

    def __init__(self) -> None:
        super().__init__()
        self.declared: dict[str, int] = {}
        self._first: dict[str, int] = {}
        self._known: dict[str, dict[tuple[int, int, int], list[int]]] = {}
        """True row of what was told, and how many are to come, by number, tick and length."""
        self._before: dict[str, list[tuple[int, int]]] = {}
        self._holes: dict[str, deque[tuple[int, int]]] = {}
        self._never: dict[str, deque[tuple[int, int]]] = {}
        self._untold: dict[str, deque[tuple[int, int, int]]] = {}
        """Number, tick and length of the latest blocks, since numbers began anew, of which nothing was told."""
        self._anew: dict[str, tuple[int, int]] = {}
        """Number behind the last of these that was told since, as it was sent, and as it is."""

    def declare(self, document: Mapping[str, Any]) -> bool:
        """Take note of a document on faults, for those behind zenoh; whether it is one."""
        try:
            told = check(_Document, dict(document), field="faults")
        except InputError:
            return False
        for one in told.blocks:
            if one.key not in self._known and len(self._known) >= _MOST_STREAMS:
                continue
            sent, known = [each for each in one.sent if "zenoh" in each.doors], self._known.setdefault(one.key, {})
            if not sent:
                never = self._never.setdefault(one.key, deque(maxlen=_MOST))
                if never and sum(never[-1]) == one.row:
                    never[-1] = (never[-1][0], never[-1][1] + one.rows)
                else:
                    never.append((one.row, one.rows))
            for each in sent:
                if each.index != one.row:
                    self._untold.setdefault(one.key, deque(maxlen=_AHEAD))
                if (which := (each.index, each.tick, one.rows)) in self._untold.get(one.key, ()):
                    self._untold[one.key].remove(which)
                    self._tell(one.key, each.index + one.rows, one.row + one.rows)
                else:
                    known.setdefault(which, [one.row, 0])[1] += 1
            while len(known) > _MOST:
                del known[next(iter(known))]
            self._settle(one.key)
        return True

    def knows(self, key: str, block: Block) -> bool:
        """Whether a block was told."""
        return (block.index, block.tick, len(block.values)) in self._known.get(key, {})

    def true(self, key: str, block: Block) -> Block:
        """A block with the number and the tick that its rows have."""
        found = self._known.get(key, {}).get((block.index, block.tick, len(block.values)))
        if found is None or found[0] == block.index:
            tick = None if found is None else round(block.index * block.tick_rate_hz / block.rate_hz)
            return block if tick is None else replace(block, tick=tick)
        return replace(block, index=found[0], tick=round(found[0] * block.tick_rate_hz / block.rate_hz))

    def take(self, key: str, block: Block) -> Gap | None:
        """Take the next block; the step before it, but where it is told why there is one back."""
        known, rows = self._known.get(key, {}), len(block.values)
        told = known.get(which := (block.index, block.tick, rows))
        row = block.index if told is None else told[0]
        due = self.next.get(key, row)
        self._first.setdefault(key, due)
        if told is None and (row < due or key in self._untold):
            self._untold.setdefault(key, deque(maxlen=_AHEAD)).append(which)
        if (told is not None and row > due == block.index) or (due, row) == self._anew.get(key):
            # Those before it, of which nothing was told in time, were numbered as it is.
            self.next[key] = due = row
            self._know(key)
        gap = self.follow(key, row, rows) if told is None or row >= due else None
        if gap is not None and gap.size > 0:
            self._holes.setdefault(key, deque(maxlen=_MOST)).append((due, row))
        if told is not None:
            if row < due:
                self._fill(key, row, rows)
            told[1] -= 1
            if not told[1]:
                del known[which]
        self._settle(key)
        return gap

    def _know(self, key: str) -> None:
        """What seemed to be numbers that began anew was told to be none."""
        self.runs[key] = max(0, self.runs.get(key, 0) - 1)
        self._anew.pop(key, None)

    def _tell(self, key: str, number: int, row: int) -> None:
        """The block before a number, as it was sent, was taken, and is the one before a row."""
        self._anew[key] = number, row
        if self.next.get(key) == number:
            self.next[key] = row
            self._know(key)
        elif (number, row) in self._holes.get(key, ()):
            self._holes[key].remove((number, row))
            self.declared[key] = self.declared.get(key, 0) + row - number
            self._know(key)

    def _fill(self, key: str, row: int, rows: int) -> None:
        """Count a block that came behind later ones: late where its rows were missing, else a second time."""
        holes = self._holes.get(key, deque())
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

    def _settle(self, key: str) -> None:
        """Count what a fault has taken up to the row that is due."""
        never, due = self._never.get(key), self.next.get(key, 0)
        while never and never[0][0] < due:
            row, rows = never.popleft()
            here = min(row + rows, due) - row
            if here < rows:
                never.appendleft((row + here, rows - here))
            if row >= self._first.get(key, 0):
                self.declared[key] = self.declared.get(key, 0) + here
            else:
                self._before.setdefault(key, []).append((row, here))

    @property
    def faulty(self) -> set[str]:
        """Streams that blocks were never sent of."""
        return {*self._never}

    def around(self, key: str) -> list[list[int]]:
        """Rows that were never sent before the first block of a stream, and behind its last: first and number."""
        return [list(each) for each in (*self._before.get(key, ()), *self._never.get(key, ()))]
