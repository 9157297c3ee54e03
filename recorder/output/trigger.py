"""Triggers of a capture: events of the run, and channels that cross a level."""

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
"""Events that can be triggers."""
_LEVEL = re.compile(r"\s*(\|?)([A-Za-z_]\w*)(\|?)\s*([<>])\s*([-+.\deE]+)\s*")
MOST_CAPTURES = 1000
_MAX_PRE_S = 120.0
MAX_CAPTURE_S = 60.0
"""Default maximum length of a capture [s of simulated time]."""
REARM_S = 0.25
"""Time without a value beyond the level after which it triggers again [s of simulated time].

Whirl crosses a level twice per revolution and would otherwise start captures for as long as it lasts.
"""


@dataclass(frozen=True)
class Trigger:
    """Condition that starts a capture: an event, or a channel that crosses a level.

    Attributes:
        text: Trigger as typed by the user.
        name: Event or channel; part of the file name.
        level: Level [unit of the channel]; None for an event.
        above: Whether the value must rise above the level; otherwise it must fall below.
        magnitude: Whether the absolute value is compared.
    """

    text: str
    name: str
    level: float | None = None
    above: bool = True
    magnitude: bool = False

    @classmethod
    def parse(cls, text: str) -> Trigger:
        """Parse a trigger: an event such as `hammer`, or a level such as `P_E>3200`, `speed<5` or `|disk_x|>0.5`.

        Raises:
            InputError: The text is neither.
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

    def is_beyond(self, values: np.ndarray) -> np.ndarray:
        """Return which values are beyond the level, shape (n,)."""
        values = np.abs(values) if self.magnitude else values
        return values > self.level if self.above else values < self.level

    def describe_initial_state(self, unit: str) -> str:
        """Return the message for a first value beyond the level, in a unit."""
        name = f"|{self.name}|" if self.magnitude else self.name
        side, other = ("above", "below") if self.above else ("below", "above")
        return f"{name} is {side} {self.level:g} {unit} already; waiting until it has been {other}"


@dataclass(frozen=True)
class Capture:
    """Triggers of a recording and the time to keep around each.

    Attributes:
        triggers: Triggers, each of which starts a capture.
        pre_s: Time before the trigger [s of simulated time].
        post_s: Time after the trigger [s of simulated time].
        count: Number of captures after which the recording ends; None for no limit.
        again: Effect of a trigger during a capture: extend it to `post_s` after the trigger, or ignore the trigger.
            Both count it and list it in the file. None: events extend; levels are ignored, because whirl can cross a
            level again and again.
        longest_s: Maximum length of a capture, including `pre_s` [s of simulated time]; None for `MAX_CAPTURE_S`, or
            `pre_s` + `post_s` if that is longer.
    """

    triggers: tuple[Trigger, ...]
    pre_s: float = 0.5
    post_s: float = 2.0
    count: int | None = None
    again: Literal["extend", "ignore"] | None = None
    longest_s: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.pre_s <= _MAX_PRE_S:
            raise InputError("pre_s", f"from 0 to {_MAX_PRE_S:g}, as it is kept in memory", self.pre_s)
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
    def max_length_s(self) -> float:
        """Effective maximum length of a capture [s of simulated time]."""
        return max(MAX_CAPTURE_S, self.pre_s + self.post_s) if self.longest_s is None else self.longest_s

    def is_extended_by(self, trigger: Trigger) -> bool:
        """Return whether a trigger extends a capture in progress."""
        return trigger.level is None if self.again is None else self.again == "extend"


class Crossings:
    """Detector of level crossings of a channel, block by block.

    Attributes:
        key: Key of the channel's blocks.
        remark: Message to the user; empty without one.
    """

    def __init__(self, trigger: Trigger, table: ChannelTable) -> None:
        """Find the channel in the table.

        Raises:
            InputError: The table does not have the channel.
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
        """True if the latest value was beyond the level; None before the first value."""
        self._beyond_ns = -math.inf
        """Simulated time of the latest value beyond the level [ns]."""

    def take(self, block: Block, begin_ns: int) -> list[tuple[int, bool]]:
        """Process the next block.

        Args:
            block: The block.
            begin_ns: Simulated time of its first row [ns].

        Returns:
            Simulated time of each relevant crossing [ns], and whether it may start a capture.
        """
        if not len(block.values) or block.values.shape[1] != self._columns:
            return []
        channel = self._channel
        beyond = self._trigger.is_beyond(block.values[:, self._column] * channel.scale + channel.offset)
        # A signal that is beyond the level from the first row on has not crossed it.
        if self._beyond is None and beyond[0]:
            self.remark = self._trigger.describe_initial_state(channel.unit)
        was_beyond = np.concatenate(([self._beyond is not False], beyond[:-1]))
        self._beyond = bool(beyond[-1])
        beyond_rows = np.flatnonzero(beyond)
        if not len(beyond_rows):
            return []
        row_ns = NS / block.rate_hz
        crossings = np.flatnonzero(beyond & ~was_beyond)
        # Time without a value beyond the level, before each crossing.
        positions = np.searchsorted(beyond_rows, crossings)
        previous_ns = np.where(positions > 0, beyond_rows[positions - 1] * row_ns, self._beyond_ns - begin_ns)
        is_new = crossings * row_ns - previous_ns >= REARM_S * NS
        self._beyond_ns = begin_ns + round(int(beyond_rows[-1]) * row_ns)
        # Report the crossing that may start a capture, or else the first, and the last, which may extend it.
        reported = dict.fromkeys((int(np.argmax(is_new)), len(crossings) - 1)) if len(crossings) else ()
        return [(begin_ns + round(int(crossings[number]) * row_ns), bool(is_new[number])) for number in reported]
