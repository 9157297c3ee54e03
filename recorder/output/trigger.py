"""What a recording around triggers waits for: events of the stream, and channels that cross a level."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from recorder.contents.counts import NS
from rig.base.errors import InputError
from rig.base.wire import Block, sensor_key
from rig.channels.table import ChannelTable
from rig.run.commands.table import TRIGGERS

EVENT_NAMES = (*TRIGGERS, "note", "warning")
"""Events of the stream that can be waited for."""
_LEVEL = re.compile(r"\s*(\|?)([A-Za-z_]\w*)(\|?)\s*([<>])\s*([-+.\deE]+)\s*")
MOST_CAPTURES = 1000
_MOST_PRE_S = 120.0
LONGEST_S = 60.0
"""Longest length of a capture by default [s of simulated time]."""
REARM_S = 0.25
"""A level starts a new capture only if nothing was beyond it for so long: whirl crosses one twice a turn, and would
otherwise start captures for as long as it lasts [s of simulated time]."""


@dataclass(frozen=True)
class Trigger:
    """What starts a capture: an event, or a channel that crosses a level.

    Attributes:
        text: As the user wrote it.
        name: Event or channel; goes into the name of the file.
        level: Level [unit of the channel]; None for an event.
        above: The value rises above the level; False: it falls below.
        magnitude: It is the absolute value that counts.
    """

    text: str
    name: str
    level: float | None = None
    above: bool = True
    magnitude: bool = False

    @classmethod
    def parse(cls, text: str) -> Trigger:
        """Read a trigger: an event such as `hammer`, or a level such as `P_E>3200`, `speed<5` or `|disk_x|>0.5`.

        Raises:
            InputError: It is neither.
        """
        if text in EVENT_NAMES:
            return cls(text=text, name=text)
        match = _LEVEL.fullmatch(text)
        must = f"one of {', '.join(EVENT_NAMES)}, or like P_E>3200, speed<5 or |disk_x|>0.5"
        if match is None or match[1] != match[3]:
            raise InputError("trigger", must, text)
        try:
            level = float(match[5])
        except ValueError:
            raise InputError("trigger", must, text) from None
        if not math.isfinite(level):
            raise InputError("trigger", must, text)
        return cls(text=text, name=match[2], level=level, above=match[4] == ">", magnitude=bool(match[1]))

    def crossed(self, values: np.ndarray) -> np.ndarray:
        """Where values are beyond the level, shape (n,)."""
        values = np.abs(values) if self.magnitude else values
        return values > self.level if self.above else values < self.level

    def already(self, unit: str) -> str:
        """What to say where the first value is beyond the level, in this unit."""
        name = f"|{self.name}|" if self.magnitude else self.name
        side, other = ("above", "below") if self.above else ("below", "above")
        return f"{name} is {side} {self.level:g} {unit} already; waiting until it has been {other}"


@dataclass(frozen=True)
class Capture:
    """Which triggers, and how much around them is kept.

    Attributes:
        triggers: Any of them starts a capture.
        pre_s: Time kept before the trigger [s of simulated time].
        post_s: Time kept after it [s of simulated time].
        count: The recording ends after so many captures; None if it does not.
        again: A trigger during a capture makes it longer, to `post_s` after the last one; or is ignored. Either way
            it is counted, and noted in the file. None: an event makes it longer, a level is ignored, for it can be
            crossed again for as long as the rig whirls.
        longest_s: Longest length of a capture, with the time before the trigger [s of simulated time]; None for
            `LONGEST_S`, or `pre_s` and `post_s` where they are more.
    """

    triggers: tuple[Trigger, ...]
    pre_s: float = 0.5
    post_s: float = 2.0
    count: int | None = None
    again: Literal["extend", "ignore"] | None = None
    longest_s: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.pre_s <= _MOST_PRE_S:
            raise InputError("pre_s", f"from 0 to {_MOST_PRE_S:g}, as it is kept in memory", self.pre_s)
        if not 0.0 < self.post_s <= 1e6:
            raise InputError("post_s", "above 0, at most 1e6", self.post_s)
        if self.count is not None and not 1 <= self.count <= MOST_CAPTURES:
            raise InputError("count", f"from 1 to {MOST_CAPTURES}", self.count)
        if self.again not in ("extend", "ignore", None):
            raise InputError("again", "extend or ignore", self.again)
        least_s = self.pre_s + self.post_s
        if self.longest_s is not None and not least_s <= self.longest_s <= 1e6:
            raise InputError("longest_s", f"at least pre_s and post_s, {least_s:g}, at most 1e6", self.longest_s)

    @property
    def most_s(self) -> float:
        """Longest length of a capture, whether it was given or not [s of simulated time]."""
        return max(LONGEST_S, self.pre_s + self.post_s) if self.longest_s is None else self.longest_s

    def extends(self, trigger: Trigger) -> bool:
        """Whether this trigger makes a capture longer that is being made."""
        return trigger.level is None if self.again is None else self.again == "extend"


class Crossings:
    """Where a channel crosses the level of a trigger, block after block.

    Attributes:
        key: Key of the channel's blocks.
        remark: What the user should know at once; empty if nothing.
    """

    def __init__(self, trigger: Trigger, table: ChannelTable) -> None:
        """Find the channel.

        Raises:
            InputError: The table does not have it.
        """
        if trigger.name not in table.channels:
            raise InputError("trigger", f"on one of {', '.join(table.channels)}", trigger.text)
        self._trigger = trigger
        self._channel = table.channels[trigger.name]
        names = table.groups[self._channel.group].names
        self._columns, self._column = len(names), names.index(trigger.name)
        self.key = sensor_key(self._channel.group)
        self.remark = ""
        self._beyond: bool | None = None
        """Whether the latest value was beyond the level; None before the first one."""
        self._beyond_ns = -math.inf
        """Simulated time of the latest value beyond it [ns]."""

    def take(self, block: Block, begin_ns: int) -> list[tuple[int, bool]]:
        """Take the next block, which begins at a simulated time [ns].

        Returns:
            Simulated time of those crossings that count [ns], and whether each may start a capture.
        """
        if not len(block.values) or block.values.shape[1] != self._columns:
            return []
        channel = self._channel
        beyond = self._trigger.crossed(block.values[:, self._column] * channel.scale + channel.offset)
        # What is beyond its level from the first row on has not crossed it.
        if self._beyond is None and beyond[0]:
            self.remark = self._trigger.already(channel.unit)
        before = np.concatenate(([self._beyond is not False], beyond[:-1]))
        self._beyond = bool(beyond[-1])
        there = np.flatnonzero(beyond)
        if not len(there):
            return []
        row_ns = NS / block.rate_hz
        crossings = np.flatnonzero(beyond & ~before)
        # Time for which nothing was beyond the level, at each crossing.
        places = np.searchsorted(there, crossings)
        before_ns = np.where(places > 0, there[places - 1] * row_ns, self._beyond_ns - begin_ns)
        is_new = crossings * row_ns - before_ns >= REARM_S * NS
        self._beyond_ns = begin_ns + round(int(there[-1]) * row_ns)
        # One that may start a capture, or else the first, counts, and the last, which may make it longer.
        picked = dict.fromkeys((int(np.argmax(is_new)), len(crossings) - 1)) if len(crossings) else ()
        return [(begin_ns + round(int(crossings[which]) * row_ns), bool(is_new[which])) for which in picked]
