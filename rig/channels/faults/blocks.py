"""Kinds of faults of a group's blocks in transit, on one transport of the rig or on all.

While one acts, the rows of the stream are sent in blocks of block_s from its first row, whatever the lengths of frames.
n is the number of such a block, and u(n) a uniform random number of the fault. Counts are never changed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, FiniteFloat

from rig.base.wire import Block
from rig.channels.faults.kind import Kind

TRANSPORTS = ("zenoh", "can")
"""Outputs by which blocks leave the rig; a file written without pace has the blocks of the first."""
MAX_DELAY_S = 10.0
"""Longest delay of a block [s]."""
PartOrAll = Annotated[FiniteFloat, Field(gt=0.0, le=1.0)]


class Message(NamedTuple):
    """A block in transit.

    Attributes:
        key: Stream.
        block: The block, with the number and the tick under which it is sent.
        row: True number of its first row.
        due: Time at which it is sent [ticks].
        transports: Transports by which it is sent.
        faults: Numbers of the faults that acted on it.
        after_others: Whether it is sent after others that are due at the same tick.
    """

    key: str
    block: Block
    row: int
    due: int = 0
    transports: tuple[str, ...] = TRANSPORTS
    faults: tuple[int, ...] = ()
    after_others: bool = False


class BlockFault(Kind):
    """A fault of a stream's blocks."""

    stage = "wire"
    of_blocks = True
    door: Literal["all", "zenoh", "can"] = "all"
    block_s: Annotated[FiniteFloat, Field(ge=1e-3, le=1.0)] = 0.01

    @property
    def transports(self) -> tuple[str, ...]:
        """Transports on which it acts."""
        return TRANSPORTS if self.door == "all" else (self.door,)

    @property
    def ticks(self) -> int:
        """Length of its blocks [ticks]."""
        return round(1e6 * self.block_s)

    @classmethod
    def needs_at(cls, door: str, group: str, groups: tuple[str, ...]) -> str:
        """Return what a transport requires in place of a group, out of all; empty if the fault shows there."""
        return ""

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        """Return the messages that a block becomes.

        Args:
            message: The block.
            u: Uniform random number of the block.
            first: Number and tick of the fault's first row.
        """
        raise NotImplementedError


class Dropout(BlockFault, number=30):
    """No block is sent; the row numbers continue."""

    kind: Literal["dropout"] = "dropout"

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        return []


class _Random(BlockFault):
    """A fault of randomly selected blocks."""

    part: PartOrAll = 0.1

    def chance(self, rate_hz: int) -> tuple[str, float, float]:
        return "part", 1.0, self.block_s


class LoseBlocks(_Random, number=31):
    """Blocks with u(n) < part are not sent."""

    kind: Literal["lose-blocks"] = "lose-blocks"
    part: Annotated[FiniteFloat, Field(gt=0.0, lt=1.0)] = 0.1  # all of them: dropout

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        return [] if u < self.part else [message]


class DuplicateBlocks(_Random, number=32):
    """Blocks with u(n) < part are sent twice in succession."""

    kind: Literal["duplicate-blocks"] = "duplicate-blocks"

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        return [message] * (2 if u < self.part else 1)


class ReorderBlocks(_Random, number=33):
    """Blocks with u(n) < part are sent block_s later, after those that are due by then."""

    kind: Literal["reorder-blocks"] = "reorder-blocks"
    part: Annotated[FiniteFloat, Field(gt=0.0, lt=1.0)] = 0.1  # all of them: late-blocks

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        later = message.due + self.ticks
        return [message._replace(due=later, after_others=True) if u < self.part else message]


class LateBlocks(BlockFault, number=34):
    """Blocks are sent delay_s later, in their order; at its end all delayed blocks are sent."""

    kind: Literal["late-blocks"] = "late-blocks"
    delay_s: Annotated[FiniteFloat, Field(ge=1e-6, le=MAX_DELAY_S)]

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        return [message._replace(due=message.due + round(1e6 * self.delay_s))]


class StaleStamps(BlockFault, number=35):
    """All blocks have the time of the first row; row numbers continue. On CAN, Sync has this time, for one group."""

    kind: Literal["stale-stamps"] = "stale-stamps"

    @classmethod
    def needs_at(cls, door: str, group: str, groups: tuple[str, ...]) -> str:
        away = f"{groups[0]}, whose time is in Sync, for {cls.name()} on CAN (dropout supports all)"
        return away if door == "can" and group != groups[0] else ""

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        return [message._replace(block=replace(message.block, tick=first[1]))]


class Restart(BlockFault, number=36):
    """Row numbers and times begin again at 0: index' = index - that of the first row, and likewise for the tick."""

    kind: Literal["restart"] = "restart"

    def sent(self, message: Message, u: float, first: tuple[int, int]) -> list[Message]:
        row, tick = first
        block = replace(message.block, index=message.block.index - row, tick=max(0, message.block.tick - tick))
        return [message._replace(block=block)]


BlockKind = Dropout | LoseBlocks | DuplicateBlocks | ReorderBlocks | LateBlocks | StaleStamps | Restart
