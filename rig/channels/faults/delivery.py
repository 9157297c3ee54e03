"""Frames become messages: the one place that all doors and recordings take their blocks from, and faults of blocks act.

A stream without a fault passes as it is. Of one with faults rows are gathered into the blocks of these, on a grid of
time, so that what is sent does not depend on how the run is cut. What becomes of each such block is told, row by row,
in documents for `rig.base.wire.FAULTS`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rig.base.wire import EDGES, Block, sensor_key, truth_key
from rig.channels.faults import Draws, Kind, Message, OfBlocks
from rig.channels.sampling import TICKS_HZ, first_row

_NEVER = 1 << 62


@dataclass(frozen=True, slots=True)
class Frame:
    """What one `advance` made.

    Attributes:
        tick: Start.
        ticks: Length.
        samples: ADC counts by sensor group, whatever becomes of them on their way.
        edges: Keyphasor edges, ticks from the block's tick, or None where there was none.
        truth: Truth tables by name.
        events: What took effect, each with event, tick and time_s.
        rows: Observed rows, shape (n, N_ROW); a view that the next `advance` overwrites.
        sent: What is sent, in this order, where that is not all as it is.
        told: Documents on faults, for `rig.base.wire.FAULTS`: sent before the messages.
    """

    tick: int
    ticks: int
    samples: dict[str, Block]
    edges: Block | None
    truth: dict[str, Block]
    events: list[dict[str, Any]]
    rows: np.ndarray = field(repr=False)
    sent: list[Message] | None = field(default=None, repr=False)
    told: list[dict[str, Any]] = field(default_factory=list, repr=False)

    @property
    def messages(self) -> list[Message]:
        """What is sent, in this order."""
        return [Message(key, block, block.index) for key, block in self._plain()] if self.sent is None else self.sent

    def blocks(self) -> Iterator[tuple[str, Block]]:
        """Keys and blocks as they are published, but on CAN."""
        if self.sent is None:
            return self._plain()
        return ((message.key, message.block) for message in self.sent if "zenoh" in message.doors)

    def _plain(self) -> Iterator[tuple[str, Block]]:
        for group, block in self.samples.items():
            if len(block.values):
                yield sensor_key(group), block
        if self.edges is not None:
            yield EDGES, self.edges
        for table, block in self.truth.items():
            yield truth_key(table), block


@dataclass
class Active:
    """One fault.

    Attributes:
        id: Its number.
        what: The fault.
        names: Its channels.
        begin: First tick, a whole row.
        draws: Its numbers, for each channel; of blocks under "".
        key: Stream of one that is about blocks.
        end: Tick from which on there is none, a whole row.
        kept: What it keeps.
        noise: Converter noise of each channel whose samples it takes at times of their own.
    """

    id: int
    what: Kind
    names: tuple[str, ...]
    begin: int
    draws: dict[str, Draws]
    key: str = ""
    end: float = math.inf
    kept: dict[str, float] = field(default_factory=dict)
    noise: dict[str, np.random.Generator] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Held:
    """A message that is not sent yet, with the faults that hold it back."""

    message: Message
    by: tuple[Active, ...] = ()

    @property
    def order(self) -> tuple[float, bool, int]:
        return min((self.message.due, *(one.end for one in self.by))), self.message.behind, self.message.row


class Sending:
    """What is on its way from the sensors to the doors.

    Attributes:
        active: Faults of blocks.
    """

    def __init__(self) -> None:
        self.active: list[Active] = []
        self._gathered: dict[str, Block] = {}
        self._held: list[_Held] = []

    def pass_on(self, frame: Frame, *, last: bool) -> Frame:
        """A frame with what is sent of it, and of those before, and what is to be told of faults.

        Args:
            frame: The frame.
            last: It is the last of the run: nothing is held back any more.
        """
        told = [event for event in frame.events if event["event"] in ("fault", "clear")] if frame.events else []
        if not (self.active or self._gathered or self._held):
            return replace(frame, told=told) if told else frame
        end, sent, blocks = frame.tick + frame.ticks, list[Message](), list[dict[str, Any]]()
        keys = {*self._gathered, *(one.key for one in self.active), *(held.message.key for held in self._held)}
        for message in frame.messages:
            key, block = message.key, message.block
            if key not in keys:
                sent.append(message)
                continue
            if (before := self._gathered.pop(key, None)) is not None:
                block = replace(before, values=np.concatenate([before.values, block.values]))
            faults = [one for one in self.active if one.key == key]
            for piece, due, here in self._pieces(key, block, faults, last=last):
                made = _through(Message(key, piece, piece.index, min(due, end)), here)
                blocks += [_told(piece, key, here, made)] if here else []
                self._held += made
        waiting = sorted(self._held, key=lambda held: held.order)
        sent += [held.message for held in waiting if held.order[0] <= end or last]
        self._held = [] if last else [held for held in waiting if held.order[0] > end]
        self.active = [one for one in self.active if one.end > end]
        if blocks:
            told.append({"event": "blocks", "tick": end, "time_s": end / TICKS_HZ, "blocks": blocks})
        return replace(frame, sent=sent, told=told)

    def _pieces(
        self, key: str, block: Block, faults: list[Active], *, last: bool
    ) -> Iterator[tuple[Block, int, list[Active]]]:
        """Rows between two ends of blocks of faults: the block, when it is whole [ticks], and the faults there."""
        rate, row, stop = round(block.rate_hz), block.index, block.index + len(block.values)
        while row < stop:
            now = row * TICKS_HZ // rate
            here = [one for one in faults if one.begin <= now < one.end]
            ends = [tick for one in faults for tick in (one.begin, one.end) if not math.isinf(tick)]
            for one in here:
                assert isinstance(one.what, OfBlocks)
                length = one.what.ticks
                ends.append(one.begin + ((now - one.begin) // length + 1) * length)
            due = min((int(tick) for tick in ends if first_row(int(tick), rate) > row), default=None)
            upto = stop if due is None else min(stop, first_row(due, rate))
            whole = due is not None and first_row(due, rate) <= stop
            values = block.values[row - block.index : upto - block.index]
            piece = replace(block, tick=round(row * TICKS_HZ / rate), index=row, values=values)
            if here and not whole and not last:
                self._gathered[key] = piece
                return
            yield piece, _NEVER if due is None else due, here
            row = upto


def _through(message: Message, faults: list[Active]) -> list[_Held]:
    """What becomes of a block by some faults, one after the other."""
    found = [_Held(message)]
    now = message.row * TICKS_HZ // round(message.block.rate_hz)
    for one in faults:
        assert isinstance(one.what, OfBlocks)
        row = first_row(one.begin, round(message.block.rate_hz))
        first = row, round(row * TICKS_HZ / message.block.rate_hz)
        u = float(one.draws[""].uniform(np.array([(now - one.begin) // one.what.ticks]))[0, 0])
        before, found = found, []
        for held in before:
            inside, outside = (
                tuple(door for door in held.message.doors if (door in one.what.doors) == acts) for acts in (True, False)
            )
            if outside:
                found.append(replace(held, message=held.message._replace(doors=outside)))
            if inside:
                made = one.what.sent(held.message._replace(doors=inside), u, first)
                found += [_Held(each, (*held.by, one) if each.due != held.message.due else held.by) for each in made]
    return found


def _told(piece: Block, key: str, faults: list[Active], made: list[_Held]) -> dict[str, Any]:
    sent = [
        {"index": each.block.index, "tick": each.block.tick, "due": each.due, "doors": list(each.doors)}
        for each in (held.message for held in made)
    ]
    return {
        "faults": [one.id for one in faults], "key": key, "row": piece.index, "rows": len(piece.values), "sent": sent,
    }  # fmt: skip
