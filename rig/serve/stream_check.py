"""What is taken of a rig's streams: blocks as its catalogue promises them, in line, and events of their form.

A forged or damaged block must neither be believed nor end anything, while a gap, a repetition and a rig that is started
again are what happens. A block says enough to tell: columns and rates stand in the catalogue, time and row number hang
together, and a step of the row number is believed once another block goes on from it. Until then blocks behind the step
wait; where the old line goes on instead, they were none of it and are refused.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rig.base import wire
from rig.base.checks import Count, Name, Outside, check, read_json
from rig.base.errors import InputError
from rig.channels.faults.ledger import Declared
from rig.channels.table import ChannelTable

_MOST_S = 1e9
"""Thirty years: longer than any simulated time [s]."""
_MOST_STEP = 1 << 40
"""Rows that a stream may step ahead at once: almost two years at 20 kHz."""
_MOST_OTHERS = 16
"""Streams that the catalogue does not name and that are taken nevertheless (a replay can give them other keys)."""
_BLOCK_BYTES = 64 << 20
_MOST_WAITING = 8
"""Blocks of a stream that wait; with more, so much is lost that no block goes on from another, and they are taken."""
_MOST_LEFT_OUT = 64
_EVENT_BYTES = 1 << 20
_Text = Annotated[str, Field(max_length=10_000)]
_Rate = Annotated[float, Field(gt=0.0, le=1e12)]


class Event(Outside):
    """An event of the stream: what is acted on; further fields are only shown."""

    model_config = ConfigDict(extra="allow")

    event: Name
    tick: Annotated[int, Field(ge=-(2**53), le=2**53)] | None = None
    time_s: Annotated[float, Field(ge=-_MOST_S, le=1e10)] | None = None
    wall_s: float | None = None
    reason: _Text | None = None
    text: _Text | None = None
    tags: list[_Text] | None = None
    id: int | Literal["all"] | None = None  # "all": a clear of all faults, in recordings made before 0.2.0 was released
    command: _Text | None = None
    request: dict[str, Any] | None = None
    rows: dict[str, Count] | None = None


class BlockEnd(Outside):
    """The end of a block in lockstep: all of it was published before."""

    block: Count
    """Its number in this run, from 1 on."""
    tick: Count
    """Where it ends [ticks]: what a device says that it is done with."""
    time_s: float
    messages: dict[str, Annotated[int, Field(ge=-1)]]
    """Number of the last message, by key, of which any was published since the block before."""


def block_end_in(payload: bytes) -> BlockEnd:
    """The end of a block in a payload.

    Raises:
        InputError: It is none.
    """
    return check(BlockEnd, read_json(payload, field="block", most_bytes=_EVENT_BYTES), field="block")


def event_in(payload: bytes) -> dict[str, Any]:
    """The event in a payload.

    Raises:
        InputError: It is none.
    """
    document = read_json(payload, field="event", most_bytes=_EVENT_BYTES)
    check(Event, document, field="event")
    return document


@dataclass(frozen=True, slots=True)
class Promise:
    """What all blocks of a stream have in common.

    Attributes:
        columns: Values per row.
        rate_hz: Rows per simulated second [Hz]; 0 for rows that come when there are any.
        tick_rate_hz: Ticks per simulated second [Hz].
    """

    columns: int
    rate_hz: float
    tick_rate_hz: float

    def broken_by(self, block: wire.Block) -> str:
        """What is wrong with a block; empty if nothing is."""
        rows, columns = block.values.shape
        if not rows or (columns, block.rate_hz, block.tick_rate_hz) != (self.columns, self.rate_hz, self.tick_rate_hz):
            return (
                f"{rows} rows of {columns} values at {block.rate_hz:g} Hz, {block.tick_rate_hz:g} ticks a second; "
                f"the catalogue promises {self.columns} at {self.rate_hz:g} Hz, {self.tick_rate_hz:g} ticks a second"
            )
        return ""

    def untimely(self, block: wire.Block) -> str:
        """What is wrong with its time, or its number; empty if nothing is."""
        rows, most = len(block.values), _MOST_S * self.tick_rate_hz
        if not (abs(block.tick) <= most and block.index >= 0 and block.index + rows <= _MOST_S * (self.rate_hz or 1e3)):
            return f"row {block.index} at tick {block.tick} is beyond {_MOST_S:g} s"
        if self.rate_hz:
            # Both begin at 0. A tick is rounded, and a recording that is numbered anew moves by whole rows.
            ticks_a_row = self.tick_rate_hz / self.rate_hz
            if abs(block.tick - block.index * ticks_a_row) > 2.0 * ticks_a_row + 1.0:
                return f"row {block.index} cannot be at tick {block.tick}"
        return ""


class _Truth(BaseModel):
    rate_hz: Annotated[float, Field(gt=0.0, le=1e9)]
    columns: Annotated[list[dict[str, Any]], Field(min_length=1, max_length=1000)]


class Catalogue(BaseModel):
    """A rig's catalogue, as far as its streams are concerned."""

    table: ChannelTable
    tick_rate_hz: _Rate
    truth: dict[str, _Truth] = {}
    rates_hz: dict[str, _Rate] = {}
    """True rates by group, where the table tells them as whole numbers: those of a log of another system."""

    @classmethod
    def read(cls, document: Mapping[str, Any]) -> Catalogue:
        """The catalogue in a document.

        Raises:
            InputError: It is none.
        """
        try:
            return cls.model_validate(document)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise InputError("catalogue", f"that of a rig of this version ({first['msg']})", where) from None

    def promises(self) -> dict[str, Promise]:
        """What its streams promise, by key."""
        ticks = self.tick_rate_hz
        found = {wire.EDGES: Promise(1, 0.0, ticks)}
        for name, group in self.table.groups.items():
            found[wire.sensor_key(name)] = Promise(
                len(group.channels), self.rates_hz.get(name, float(group.rate_hz)), ticks
            )
        for name, table in self.truth.items():
            found[wire.truth_key(name)] = Promise(len(table.columns), table.rate_hz, ticks)
        return found


class Taken(NamedTuple):
    """A block that is believed.

    Attributes:
        key: Its stream.
        block: What it holds.
        payload: Its bytes.
        wall_ns: When it came, where that was told [unix ns].
    """

    key: str
    block: wire.Block
    payload: bytes
    wall_ns: int = 0

    @property
    def end(self) -> int:
        """Number of the row after its last one."""
        return self.block.index + len(self.block.values)


class Intake:
    """Takes blocks of one rig's streams and gives those that are believed; the blocks of one stream on one thread.

    Args:
        catalogue: What the rig says of its streams.
    """

    def __init__(self, catalogue: Catalogue) -> None:
        self._promises = catalogue.promises()
        self._most = len(self._promises) + _MOST_OTHERS
        self._waiting: dict[str, list[Taken]] = {}
        """Blocks behind a step, as they came, until another one tells whose line goes on."""
        self._rows = Declared()
        self._left_out: dict[str, deque[Taken]] = {}
        """The latest blocks that were refused: what is told of them may come behind them."""
        self.next = self._rows.next
        """Number of the row that is due next, by key."""
        self.refused = 0
        """Blocks that cannot be of this rig, or were of no line."""
        self.why = ""
        """What was wrong with the first of them."""

    def knows(self, key: str) -> bool:
        """Whether there is such a stream."""
        return key in self._promises

    def take(self, key: str, payload: bytes, wall_ns: int = 0) -> list[Taken]:
        """Take a payload; gives the blocks that can be believed now, in order.

        Raises:
            ValueError: It is no whole message.
        """
        if len(payload) > _BLOCK_BYTES:
            raise InputError("block", f"at most {_BLOCK_BYTES} bytes", len(payload))
        try:
            block = wire.decode_block(payload, wire.schema_of(key) or "")
        except wire.ImplausibleError as error:
            return self._refuse(key, str(error))
        promise = self._promises.get(key)
        if promise is None:
            promise = Promise(block.values.shape[1], block.rate_hz, block.tick_rate_hz)
            if (
                len(self._promises) >= self._most
                or not 0.0 <= block.rate_hz <= 1e9
                or not 0.0 < block.tick_rate_hz <= 1e12
            ):
                return self._refuse(key, "the catalogue has no such stream")
        if why := promise.broken_by(block):
            return self._refuse(key, why)
        self._promises.setdefault(key, promise)
        new, due = Taken(key, block, payload, wall_ns), self.next.get(key, block.index)
        if self._rows.knows(key, block):
            return self._believe([new])
        if why := promise.untimely(block):
            return self._refuse(key, why, new)
        if block.index - due > _MOST_STEP:
            return self._refuse(key, f"row {block.index} is {block.index - due} rows ahead")
        waiting = self._waiting.setdefault(key, [])
        place = next((n for n, each in enumerate(waiting) if each.end == block.index), None)
        if block.index != due and place is None:
            waiting.append(new)
            return self._first(key, behind=True) if len(waiting) > _MOST_WAITING else []
        line = [new]
        for n, each in reversed(list(enumerate(waiting))):
            # What the new block goes on from; with gap upon gap, also those between that and the old line.
            between = n != place and due <= each.block.index and each.end <= line[0].block.index
            if block.index != due and (n == place or (between and len(line) > 1)):
                line.insert(0, each)
            else:
                self._refuse_step(each)
        waiting.clear()
        return self._believe(line)

    def declare(self, document: Mapping[str, Any]) -> list[Taken]:
        """Take note of a document on faults; gives the blocks that can be believed by it.

        Blocks that a fault doubles, turns round or stamps anew are believed where that is told, and only there.
        """
        found = list[Taken]()
        if not self._rows.declare(document):
            return found
        for rest in (*self._left_out.values(), *self._waiting.values()):
            for each in list(rest):
                if self._rows.knows(each.key, each.block):
                    found += self._believe([each])
            left = [each for each in rest if all(each is not one for one in found)]
            self.refused -= len(rest) - len(left) if isinstance(rest, deque) else 0
            rest.clear()
            rest.extend(left)
        return found

    def rest(self, rows: Mapping[str, int] | None, key: str | None = None) -> list[Taken]:
        """At the end: the blocks that still wait and are part of what was published.

        Args:
            rows: Number of the row after the last one published, by key; None where that is not known.
            key: Only of this stream.
        """
        found = []
        for name in list(self._waiting) if key is None else [key]:
            last = None if rows is None else rows.get(name, 0)
            while taken := self._first(name, last=last):
                found += taken
        return found

    def _first(self, key: str, *, last: int | None = None, behind: bool = False) -> list[Taken]:
        """Of the blocks that wait, the next one ahead, up to row `last`; else, if that may be, the first one behind."""
        waiting, due = self._waiting.get(key, []), self.next.get(key, 0)
        ahead = [
            n
            for n, each in enumerate(waiting)
            if due <= each.block.index and each.end <= (each.end if last is None else last)
        ]
        if not ahead and not (behind and waiting):
            return []
        place = min(ahead, key=lambda n: waiting[n].block.index, default=0)
        for each in waiting[:place]:
            self._refuse_step(each)
        chosen = waiting[place]
        del waiting[: place + 1]
        return self._believe([chosen])

    def _believe(self, line: list[Taken]) -> list[Taken]:
        for each in line:
            self._rows.take(each.key, each.block)
        return line

    def _refuse_step(self, waiting: Taken) -> None:
        due = self.next[waiting.key]
        why = f"row {waiting.block.index} came where row {due} was due, and nothing went on from it"
        self._refuse(waiting.key, why, waiting)

    def _refuse(self, key: str, why: str, block: Taken | None = None) -> list[Taken]:
        self.refused += 1
        if block is not None:
            self._left_out.setdefault(key, deque(maxlen=_MOST_LEFT_OUT)).append(block)
        self.why = self.why or f"{key}: {why}"
        return []
