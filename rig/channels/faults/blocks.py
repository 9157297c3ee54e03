"""What may go wrong with blocks on their way: kinds of faults of a group's stream, at one door of the rig or at all.

While one acts, rows of the stream go in blocks of block_s from its first row on, however the run is cut; n is the
number of such a block, and u(n) a uniform number of the fault's own. Counts are never changed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, FiniteFloat

from rig.base.wire import Block
from rig.channels.faults.kind import Kind

DOORS = ("zenoh", "can")
"""Where blocks leave the rig; what a rig without a clock writes is as the first one has it."""
MOST_LATE_S = 10.0
"""Longest that a block is held back [s]."""
Some = Annotated[FiniteFloat, Field(gt=0.0, le=1.0)]


class Message(NamedTuple):
    """A block on its way.

    Attributes:
        key: Its stream.
        block: What is sent, with the number and the tick that it is sent with.
        row: True number of its first row.
        due: When it is sent [ticks].
        doors: Where.
        faults: Numbers of the faults that it has met.
        behind: It lets another one that is due at the same tick go first.
    """

    key: str
    block: Block
    row: int
    due: int = 0
    doors: tuple[str, ...] = DOORS
    faults: tuple[int, ...] = ()
    behind: bool = False


class OfBlocks(Kind):
    """A fault of a stream's blocks."""

    stage = "wire"
    of_blocks = True
    door: Literal["all", "zenoh", "can"] = "all"
    block_s: Annotated[FiniteFloat, Field(ge=1e-3, le=1.0)] = 0.01

    @property
    def doors(self) -> tuple[str, ...]:
        """Where it acts."""
        return DOORS if self.door == "all" else (self.door,)

    @property
    def ticks(self) -> int:
        """Length of its blocks."""
        return round(1e6 * self.block_s)

    @classmethod
    def needs_at(cls, door: str, group: str, groups: tuple[str, ...]) -> str:
        """What would have to be given in place of a group, out of all, at one door; empty where it shows there."""
        return ""

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        """What becomes of a block.

        Args:
            message: The block.
            u: Its uniform number.
            first: Number and tick of the first row of the fault.
        """
        raise NotImplementedError


class Dropout(OfBlocks, number=30):
    """No block is sent; the numbers of the rows go on."""

    kind: Literal["dropout"] = "dropout"

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        return []


class _Random(OfBlocks):
    """A fault of some blocks."""

    part: Some = 0.1

    def chance(self, rate_hz: int) -> tuple[str, float, float]:
        return "part", 1.0, self.block_s


class LoseBlocks(_Random, number=31):
    """Blocks with u(n) < part are not sent."""

    kind: Literal["lose-blocks"] = "lose-blocks"
    part: Annotated[FiniteFloat, Field(gt=0.0, lt=1.0)] = 0.1  # all of them: dropout

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        return [] if u < self.part else [message]


class DuplicateBlocks(_Random, number=32):
    """Blocks with u(n) < part are sent twice, one right behind the other."""

    kind: Literal["duplicate-blocks"] = "duplicate-blocks"

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        return [message] * (2 if u < self.part else 1)


class ReorderBlocks(_Random, number=33):
    """Blocks with u(n) < part are sent block_s later, behind those that are due by then."""

    kind: Literal["reorder-blocks"] = "reorder-blocks"
    part: Annotated[FiniteFloat, Field(gt=0.0, lt=1.0)] = 0.1  # all of them: late-blocks

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        later = message.due + self.ticks
        return [message._replace(due=later, behind=True) if u < self.part else message]


class LateBlocks(OfBlocks, number=34):
    """Blocks are sent delay_s later, in their order; what is still held back when it ends is sent then."""

    kind: Literal["late-blocks"] = "late-blocks"
    delay_s: Annotated[FiniteFloat, Field(ge=1e-6, le=MOST_LATE_S)]

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        return [message._replace(due=message.due + round(1e6 * self.delay_s))]


class StaleStamps(OfBlocks, number=35):
    """The time of all blocks is that of the first row; their numbers go on. On CAN, Sync tells it, of one group."""

    kind: Literal["stale-stamps"] = "stale-stamps"

    @classmethod
    def needs_at(cls, door: str, group: str, groups: tuple[str, ...]) -> str:
        away = f"{groups[0]}, whose time is in Sync, for {cls.name()} on CAN (dropout supports all)"
        return away if door == "can" and group != groups[0] else ""

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        return [message._replace(block=replace(message.block, tick=first[1]))]


class Restart(OfBlocks, number=36):
    """Numbers and times of rows begin again at 0: index' = index - that of the first row, and the tick likewise."""

    kind: Literal["restart"] = "restart"

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        row, tick = first
        block = replace(message.block, index=message.block.index - row, tick=max(0, message.block.tick - tick))
        return [message._replace(block=block)]


BlockKind = Dropout | LoseBlocks | DuplicateBlocks | ReorderBlocks | LateBlocks | StaleStamps | Restart
