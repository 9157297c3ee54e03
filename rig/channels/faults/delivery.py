"""Conversion of frames into messages: the source of blocks for all transports and recordings, where block faults act.

A stream without a fault passes unchanged. Rows of a faulty stream are gathered into the blocks of its faults, on a
fixed grid of time, so that the messages do not depend on the length of a frame. Documents for `rig.base.wire.FAULTS`
report the result for each such block, row by row.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rig.base.wire import EDGES, Block, sensor_key, truth_key
from rig.channels.faults import BlockFault, Draws, Kind, Message
from rig.channels.sampling import TICKS_HZ, first_row

_NO_TICK = 1 << 62


@dataclass(frozen=True, slots=True)
class Frame:
    """Result of one `advance`.

    Attributes:
        tick: First tick.
        ticks: Length [ticks].
        samples: ADC counts by sensor group, before faults of blocks.
        edges: Keyphasor edges, ticks from the block's tick, or None.
        truth: Truth tables by name.
        events: Effects of commands, each with event, tick and time_s.
        rows: Observed rows, shape (n, N_ROW); a view that the next `advance` overwrites.
        sent: Messages in their order; None if all blocks are sent unchanged.
        documents: Documents on faults, for `rig.base.wire.FAULTS`: sent before the messages.
    """

    tick: int
    ticks: int
    samples: dict[str, Block]
    edges: Block | None
    truth: dict[str, Block]
    events: list[dict[str, Any]]
    rows: np.ndarray = field(repr=False)
    sent: list[Message] | None = field(default=None, repr=False)
    documents: list[dict[str, Any]] = field(default_factory=list, repr=False)

    @property
    def messages(self) -> list[Message]:
        """Messages in their order."""
        return [Message(key, block, block.index) for key, block in self._blocks()] if self.sent is None else self.sent

    def blocks(self) -> Iterator[tuple[str, Block]]:
        """Return keys and blocks as published by zenoh."""
        if self.sent is None:
            return self._blocks()
        return ((message.key, message.block) for message in self.sent if "zenoh" in message.transports)

    def _blocks(self) -> Iterator[tuple[str, Block]]:
        for group, block in self.samples.items():
            if len(block.values):
                yield sensor_key(group), block
        if self.edges is not None:
            yield EDGES, self.edges
        for table, block in self.truth.items():
            yield truth_key(table), block


@dataclass
class Active:
    """An active fault.

    Attributes:
        id: Number of the fault.
        what: The fault.
        names: Its channels.
        begin: First tick, that of a row.
        draws: Its random numbers by channel; under "" those of a fault of blocks.
        key: Stream of a fault of blocks.
        end: Tick at which it ends, that of a row.
        kept: State between blocks.
        noise: Converter noise of the channels whose sampling times it changes.
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
    """A message that is not sent yet, with the faults that delay it."""

    message: Message
    by: tuple[Active, ...] = ()

    @property
    def order(self) -> tuple[float, bool, int]:
        return min((self.message.due, *(one.end for one in self.by))), self.message.after_others, self.message.row


class Sending:
    """Blocks between the sensors and the transports.

    Attributes:
        active: Faults of blocks.
    """

    def __init__(self) -> None:
        self.active: list[Active] = []
        self._incomplete: dict[str, Block] = {}
        self._held: list[_Held] = []

    def pass_on(self, frame: Frame, *, last: bool) -> Frame:
        """Return a frame with its messages, those delayed from earlier frames, and the documents on faults.

        Args:
            frame: The frame.
            last: Whether it is the last frame of the run, which sends all delayed messages.
        """
        documents = [event for event in frame.events if event["event"] in ("fault", "clear")] if frame.events else []
        if not (self.active or self._incomplete or self._held):
            return replace(frame, documents=documents) if documents else frame
        end, sent, blocks = frame.tick + frame.ticks, list[Message](), list[dict[str, Any]]()
        keys = {*self._incomplete, *(one.key for one in self.active), *(held.message.key for held in self._held)}
        for message in frame.messages:
            key, block = message.key, message.block
            if key not in keys:
                sent.append(message)
                continue
            if (before := self._incomplete.pop(key, None)) is not None:
                block = replace(before, values=np.concatenate([before.values, block.values]))
            faults = [one for one in self.active if one.key == key]
            for piece, due, here in self._pieces(key, block, faults, last=last):
                results = _apply_faults(Message(key, piece, piece.index, min(due, end)), here)
                blocks += [_describe_blocks(piece, key, here, results)] if here else []
                self._held += results
        waiting = sorted(self._held, key=lambda held: held.order)
        sent += [held.message for held in waiting if held.order[0] <= end or last]
        self._held = [] if last else [held for held in waiting if held.order[0] > end]
        self.active = [one for one in self.active if one.end > end]
        if blocks:
            documents.append({"event": "blocks", "tick": end, "time_s": end / TICKS_HZ, "blocks": blocks})
        return replace(frame, sent=sent, documents=documents)

    def _pieces(
        self, key: str, block: Block, faults: list[Active], *, last: bool
    ) -> Iterator[tuple[Block, int, list[Active]]]:
        """Yield each fault's block of rows, the tick at which it is complete, and the faults that act on it."""
        rate, row, stop = round(block.rate_hz), block.index, block.index + len(block.values)
        while row < stop:
            now = row * TICKS_HZ // rate
            here = [one for one in faults if one.begin <= now < one.end]
            ends = [tick for one in faults for tick in (one.begin, one.end) if not math.isinf(tick)]
            for one in here:
                assert isinstance(one.what, BlockFault)
                length = one.what.ticks
                ends.append(one.begin + ((now - one.begin) // length + 1) * length)
            due = min((int(tick) for tick in ends if first_row(int(tick), rate) > row), default=None)
            upto = stop if due is None else min(stop, first_row(due, rate))
            whole = due is not None and first_row(due, rate) <= stop
            values = block.values[row - block.index : upto - block.index]
            piece = replace(block, tick=round(row * TICKS_HZ / rate), index=row, values=values)
            if here and not whole and not last:
                self._incomplete[key] = piece
                return
            yield piece, _NO_TICK if due is None else due, here
            row = upto


def _apply_faults(message: Message, faults: list[Active]) -> list[_Held]:
    """Return the messages that a block becomes after some faults in turn."""
    after = [_Held(message)]
    now = message.row * TICKS_HZ // round(message.block.rate_hz)
    for one in faults:
        assert isinstance(one.what, BlockFault)
        row = first_row(one.begin, round(message.block.rate_hz))
        first = row, round(row * TICKS_HZ / message.block.rate_hz)
        u = float(one.draws[""].uniform(np.array([(now - one.begin) // one.what.ticks]))[0, 0])
        before, after, targets = after, [], one.what.transports
        for held in before:
            inside, outside = (
                tuple(each for each in held.message.transports if (each in targets) == acts) for acts in (True, False)
            )
            if outside:
                after.append(replace(held, message=held.message._replace(transports=outside)))
            if inside:
                results = one.what.sent(held.message._replace(transports=inside), u, first)
                after += [_Held(each, (*held.by, one) if each.due != held.message.due else held.by) for each in results]
    return after


def _describe_blocks(piece: Block, key: str, faults: list[Active], results: list[_Held]) -> dict[str, Any]:
    sent = [
        {"index": each.block.index, "tick": each.block.tick, "due": each.due, "doors": list(each.transports)}
        for each in (held.message for held in results)
    ]
    return {
        "faults": [one.id for one in faults], "key": key, "row": piece.index, "rows": len(piece.values), "sent": sent,
    }  # fmt: skip
