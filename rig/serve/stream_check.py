"""Validation of a rig's streams: blocks must match the catalogue and continue their stream, and events their schema.

A forged or damaged block must neither be accepted nor end anything, whereas gaps, repetitions and a restarted rig are
normal. Columns and rates are in the catalogue, time and row number are related, and a jump of the row number is
accepted once another block continues from it. Until then, blocks after the jump wait. If the old sequence continues
instead, they are refused.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rig.base import wire
from rig.base.checks import Count, Name, StrictModel, check, read_json
from rig.base.errors import InputError
from rig.channels.faults.ledger import Declared
from rig.channels.table import ChannelTable

_MAX_S = 1e9
"""Thirty years: longer than any simulated time [s]."""
_MAX_JUMP = 1 << 40
"""Largest jump of a stream [rows]: almost two years at 20 kHz."""
_MAX_UNKNOWN = 16
"""Number of streams accepted although the catalogue lacks them (a replay can rename keys)."""
_BLOCK_BYTES = 64 << 20
_MAX_WAITING = 8
"""Limit of waiting blocks per stream. Beyond it, too many are lost for one to continue another; they are accepted."""
_MAX_REFUSED = 64
_EVENT_BYTES = 1 << 20
_Text = Annotated[str, Field(max_length=10_000)]
_Rate = Annotated[float, Field(gt=0.0, le=1e12)]


class Event(StrictModel):
    """An event of the stream: the fields that are used; further fields are only displayed."""

    model_config = ConfigDict(extra="allow")

    event: Name
    tick: Annotated[int, Field(ge=-(2**53), le=2**53)] | None = None
    time_s: Annotated[float, Field(ge=-_MAX_S, le=1e10)] | None = None
    wall_s: float | None = None
    reason: _Text | None = None
    text: _Text | None = None
    tags: list[_Text] | None = None
    id: int | Literal["all"] | None = None  # "all": a clear of all faults, in recordings made before 0.2.0 was released
    command: _Text | None = None
    request: dict[str, Any] | None = None
    rows: dict[str, Count] | None = None


class BlockEnd(StrictModel):
    """The end of a block in lockstep: the whole block was published before."""

    block: Count
    """Number of the block in this run, from 1."""
    tick: Count
    """End of the block [ticks], as devices report it."""
    time_s: float
    messages: dict[str, Annotated[int, Field(ge=-1)]]
    """Number of the last message by key, of keys with messages since the block before."""


def parse_block_end(payload: bytes) -> BlockEnd:
    """Return the end of a block from a payload.

    Raises:
        InputError: The payload is invalid.
    """
    return check(BlockEnd, read_json(payload, field="block", most_bytes=_EVENT_BYTES), field="block")


def parse_event(payload: bytes) -> dict[str, Any]:
    """Return the event from a payload.

    Raises:
        InputError: The payload is invalid.
    """
    document = read_json(payload, field="event", most_bytes=_EVENT_BYTES)
    check(Event, document, field="event")
    return document


@dataclass(frozen=True, slots=True)
class StreamFormat:
    """Common properties of all blocks of a stream.

    Attributes:
        columns: Values per row.
        rate_hz: Rows per simulated second [Hz]; 0 for a stream without a fixed rate.
        tick_rate_hz: Ticks per simulated second [Hz].
    """

    columns: int
    rate_hz: float
    tick_rate_hz: float

    def find_mismatch(self, block: wire.Block) -> str:
        """Return the difference of a block from the catalogue; empty for a valid block."""
        rows, columns = block.values.shape
        if not rows or (columns, block.rate_hz, block.tick_rate_hz) != (self.columns, self.rate_hz, self.tick_rate_hz):
            return (
                f"{rows} rows of {columns} values at {block.rate_hz:g} Hz, {block.tick_rate_hz:g} ticks a second; "
                f"the catalogue declares {self.columns} at {self.rate_hz:g} Hz, {self.tick_rate_hz:g} ticks a second"
            )
        return ""

    def find_timing_error(self, block: wire.Block) -> str:
        """Return the error of a block's time or row number; empty for a valid block."""
        rows, limit = len(block.values), _MAX_S * self.tick_rate_hz
        if not (abs(block.tick) <= limit and block.index >= 0 and block.index + rows <= _MAX_S * (self.rate_hz or 1e3)):
            return f"row {block.index} at tick {block.tick} is beyond {_MAX_S:g} s"
        if self.rate_hz:
            # Both begin at 0. Ticks are rounded, and a renumbered recording is shifted by whole rows.
            ticks_a_row = self.tick_rate_hz / self.rate_hz
            if abs(block.tick - block.index * ticks_a_row) > 2.0 * ticks_a_row + 1.0:
                return f"row {block.index} cannot be at tick {block.tick}"
        return ""


class _Truth(BaseModel):
    rate_hz: Annotated[float, Field(gt=0.0, le=1e9)]
    columns: Annotated[list[dict[str, Any]], Field(min_length=1, max_length=1000)]


class Catalogue(BaseModel):
    """The part of a rig's catalogue that describes its streams."""

    table: ChannelTable
    tick_rate_hz: _Rate
    truth: dict[str, _Truth] = {}
    rates_hz: dict[str, _Rate] = {}
    """Exact rates by group, if the table has rounded ones, as for logs of other systems."""

    @classmethod
    def read(cls, document: Mapping[str, Any]) -> Catalogue:
        """Return the catalogue from a document.

        Raises:
            InputError: The document is not a catalogue.
        """
        try:
            return cls.model_validate(document)
        except ValidationError as error:
            first = error.errors()[0]
            location = ".".join(map(str, first["loc"]))
            raise InputError("catalogue", f"that of a rig of this version ({first['msg']})", location) from None

    def get_formats(self) -> dict[str, StreamFormat]:
        """Return the properties of the declared streams, by key."""
        ticks = self.tick_rate_hz
        formats = {wire.EDGES: StreamFormat(1, 0.0, ticks)}
        for name, group in self.table.groups.items():
            formats[wire.sensor_key(name)] = StreamFormat(
                len(group.channels), self.rates_hz.get(name, float(group.rate_hz)), ticks
            )
        for name, table in self.truth.items():
            formats[wire.truth_key(name)] = StreamFormat(len(table.columns), table.rate_hz, ticks)
        return formats


class AcceptedBlock(NamedTuple):
    """An accepted block.

    Attributes:
        key: Key of its stream.
        block: Its decoded content.
        payload: Its bytes.
        wall_ns: Time of arrival, if known [unix ns].
    """

    key: str
    block: wire.Block
    payload: bytes
    wall_ns: int = 0

    @property
    def end(self) -> int:
        """Index after its last row."""
        return self.block.index + len(self.block.values)


class BlockValidator:
    """Validates the blocks of one rig's streams; the blocks of a stream must come on one thread.

    Args:
        catalogue: The rig's catalogue.
    """

    def __init__(self, catalogue: Catalogue) -> None:
        self._formats = catalogue.get_formats()
        self._max_streams = len(self._formats) + _MAX_UNKNOWN
        self._waiting: dict[str, list[AcceptedBlock]] = {}
        """Blocks after a jump, as received, until another block shows which sequence continues."""
        self._rows = Declared()
        self._refused_blocks: dict[str, deque[AcceptedBlock]] = {}
        """The latest refused blocks: a declaration of a fault may arrive after them."""
        self.next = self._rows.next
        """Index of the next expected row, by key."""
        self.refused = 0
        """Number of blocks that are invalid or continue no sequence."""
        self.reason = ""
        """Reason for the first refusal."""

    def has_stream(self, key: str) -> bool:
        """Return whether the catalogue has the stream."""
        return key in self._formats

    def take(self, key: str, payload: bytes, wall_ns: int = 0) -> list[AcceptedBlock]:
        """Accept a payload; return the blocks that are valid now, in order.

        Raises:
            ValueError: The payload is not a complete message.
        """
        if len(payload) > _BLOCK_BYTES:
            raise InputError("block", f"at most {_BLOCK_BYTES} bytes", len(payload))
        try:
            block = wire.decode_block(payload, wire.get_schema(key) or "")
        except wire.ImplausibleError as error:
            return self._refuse(key, str(error))
        stream_format = self._formats.get(key)
        if stream_format is None:
            stream_format = StreamFormat(block.values.shape[1], block.rate_hz, block.tick_rate_hz)
            if (
                len(self._formats) >= self._max_streams
                or not 0.0 <= block.rate_hz <= 1e9
                or not 0.0 < block.tick_rate_hz <= 1e12
            ):
                return self._refuse(key, "the catalogue has no such stream")
        if reason := stream_format.find_mismatch(block):
            return self._refuse(key, reason)
        self._formats.setdefault(key, stream_format)
        new, due = AcceptedBlock(key, block, payload, wall_ns), self.next.get(key, block.index)
        if self._rows.knows(key, block):
            return self._accept([new])
        if reason := stream_format.find_timing_error(block):
            return self._refuse(key, reason, new)
        if block.index - due > _MAX_JUMP:
            return self._refuse(key, f"row {block.index} is {block.index - due} rows ahead")
        waiting = self._waiting.setdefault(key, [])
        index = next((n for n, each in enumerate(waiting) if each.end == block.index), None)
        if block.index != due and index is None:
            waiting.append(new)
            return self._take_next(key, allow_earlier=True) if len(waiting) > _MAX_WAITING else []
        accepted = [new]
        for n, each in reversed(list(enumerate(waiting))):
            # The block that the new one continues; with several gaps, also those between it and the old sequence.
            between = n != index and due <= each.block.index and each.end <= accepted[0].block.index
            if block.index != due and (n == index or (between and len(accepted) > 1)):
                accepted.insert(0, each)
            else:
                self._refuse_step(each)
        waiting.clear()
        return self._accept(accepted)

    def declare(self, document: Mapping[str, Any]) -> list[AcceptedBlock]:
        """Apply a declaration of faults; return the blocks that are valid because of it.

        Blocks that a fault duplicates, reorders or stamps with other times are valid only if declared.
        """
        accepted_blocks = list[AcceptedBlock]()
        if not self._rows.declare(document):
            return accepted_blocks
        for blocks in (*self._refused_blocks.values(), *self._waiting.values()):
            for block in list(blocks):
                if self._rows.knows(block.key, block.block):
                    accepted_blocks += self._accept([block])
            remaining = [block for block in blocks if all(block is not accepted for accepted in accepted_blocks)]
            self.refused -= len(blocks) - len(remaining) if isinstance(blocks, deque) else 0
            blocks.clear()
            blocks.extend(remaining)
        return accepted_blocks

    def take_waiting(self, rows: Mapping[str, int] | None, key: str | None = None) -> list[AcceptedBlock]:
        """Return the waiting blocks that were published, at the end of the stream.

        Args:
            rows: Index after the last published row, by key; None if unknown.
            key: Only this stream.
        """
        accepted_blocks = []
        for name in list(self._waiting) if key is None else [key]:
            last = None if rows is None else rows.get(name, 0)
            while accepted := self._take_next(name, last=last):
                accepted_blocks += accepted
        return accepted_blocks

    def _take_next(self, key: str, *, last: int | None = None, allow_earlier: bool = False) -> list[AcceptedBlock]:
        """Return the next waiting block ahead, up to row `last`; otherwise, if `allow_earlier`, the first one back."""
        waiting, due = self._waiting.get(key, []), self.next.get(key, 0)
        ahead = [
            n
            for n, each in enumerate(waiting)
            if due <= each.block.index and each.end <= (each.end if last is None else last)
        ]
        if not ahead and not (allow_earlier and waiting):
            return []
        index = min(ahead, key=lambda n: waiting[n].block.index, default=0)
        for each in waiting[:index]:
            self._refuse_step(each)
        chosen = waiting[index]
        del waiting[: index + 1]
        return self._accept([chosen])

    def _accept(self, accepted: list[AcceptedBlock]) -> list[AcceptedBlock]:
        for each in accepted:
            self._rows.take(each.key, each.block)
        return accepted

    def _refuse_step(self, waiting: AcceptedBlock) -> None:
        due = self.next[waiting.key]
        reason = f"row {waiting.block.index} came where row {due} was due, and no block continued from it"
        self._refuse(waiting.key, reason, waiting)

    def _refuse(self, key: str, reason: str, block: AcceptedBlock | None = None) -> list[AcceptedBlock]:
        self.refused += 1
        if block is not None:
            self._refused_blocks.setdefault(key, deque(maxlen=_MAX_REFUSED)).append(block)
        self.reason = self.reason or f"{key}: {reason}"
        return []
