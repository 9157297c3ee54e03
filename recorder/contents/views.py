"""The plottable messages of a recording: which channels stand together in one, and the joining of their blocks.

A viewer that knows nothing of this project makes a plot for each array of each JointState topic (position, velocity,
effort); rerun makes eight at most, of any of the arrays, empty ones included. So groups share a topic as long as each
of its three arrays holds one unit: lengths go to `position`, forces to `effort`, all else to `velocity`. The arrays
only sort the channels into plots; the unit stands in each name, and a column is nan in the arrays it is not part of.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import groupby

import numpy as np

from recorder.files.schemas import VIEW, JointStateRows
from rig.base.wire import Block
from rig.channels.table import Channel, ChannelTable, Group

_LENGTHS = frozenset({"m", "mm", "um", "\u00b5m", "mil"})
_FORCES = frozenset({"N", "kN"})
_BATCH = 16
"""Instants of blocks whose messages are made in one go: many small ones cost more."""
_PATIENCE = 4000
"""Blocks of one group that wait for the same instants of another before they are written without: more than a rig's
cache holds, for history comes key by key. A block keeps few rows here."""


def slot_of(channel: Channel) -> str:
    """Array of the message that a channel's unit belongs to."""
    if channel.unit in _LENGTHS:
        return "position"
    return "effort" if channel.unit in _FORCES else "velocity"


Messages = tuple[np.ndarray, np.ndarray]
"""Messages of one topic, oldest first: simulated times [ns], int64, shape (n,), and CDR, uint8, shape (n, bytes)."""
_NONE: Messages = (np.empty(0, np.int64), np.empty((0, 0), np.uint8))


@dataclass
class View:
    """One topic of plottable messages, made from the blocks of one or more groups.

    Attributes:
        groups: Names of its groups.
        channels: Its channels, in column order.
        slots: Array of each column.
    """

    groups: list[str] = field(default_factory=list)
    channels: list[Channel] = field(default_factory=list)
    slots: list[str] = field(default_factory=list)
    _places: dict[str, list[tuple[str, slice, slice]]] = field(default_factory=dict)
    """Of each group, array by array: columns of the message, and columns of the group that go there."""
    _settled: list[dict[str, tuple[np.ndarray, np.ndarray]]] = field(default_factory=list)
    _waiting: dict[int, dict[str, tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict)
    _rows: JointStateRows | None = None

    @property
    def topic(self) -> str:
        """Its topic, which names its groups."""
        return f"{VIEW}/{'+'.join(self.groups)}"

    @property
    def names(self) -> tuple[str, ...]:
        """Labels of the columns, with units."""
        return tuple(f"{channel.name} [{channel.unit}]" for channel in self.channels)

    def takes(self, group: Group) -> bool:
        """Whether a group can join: it has the same rate, and no array gets a second unit."""
        units = {slot: channel.unit for slot, channel in zip(self.slots, self.channels, strict=True)}
        alike = all(channel.rate_hz == group.rate_hz for channel in self.channels)
        return alike and all(units.get(slot_of(channel), channel.unit) == channel.unit for channel in group.channels)

    def join(self, group: Group) -> None:
        """Add a group's channels behind the others."""
        first, slots = len(self.channels), [slot_of(channel) for channel in group.channels]
        # Neighbours that share an array go there together.
        self._places[group.name] = []
        start = 0
        for slot, neighbours in groupby(slots):
            end = start + len(list(neighbours))
            self._places[group.name].append((slot, slice(first + start, first + end), slice(start, end)))
            start = end
        self.groups.append(group.name)
        self.channels += group.channels
        self.slots += slots

    def add(self, group: Group, tick: int, times_ns: np.ndarray, values: np.ndarray) -> Messages:
        """Take rows of one group; give the messages that are complete with them.

        Args:
            group: One of the view's groups.
            tick: Tick of the block that the rows are from.
            times_ns: Simulated time of each row [ns], shape (n,).
            values: Engineering values, shape (n, channels of the group).
        """
        self._waiting.setdefault(tick, {})[group.name] = (times_ns, values)
        if len(self._waiting[tick]) == len(self.groups):
            # Each group's blocks come in order: what is older and still waits for another group waits in vain.
            self._settle([earlier for earlier in self._waiting if earlier <= tick])
        elif len(self._waiting) > _PATIENCE:
            self._settle([next(iter(self._waiting))])
        return self.settled() if len(self._settled) >= _BATCH else _NONE

    def settled(self) -> Messages:
        """Give the messages that are complete, however few."""
        parts, self._settled = self._settled, []
        return self._encode(parts)

    def rest(self) -> Messages:
        """Give what still waits."""
        self._settle(list(self._waiting))
        return self.settled()

    def _settle(self, ticks: list[int]) -> None:
        self._settled += [self._waiting.pop(tick) for tick in sorted(ticks)]

    def _encode(self, parts: list[dict[str, tuple[np.ndarray, np.ndarray]]]) -> Messages:
        """Join what came of each group, instant by instant."""
        if not parts:
            return _NONE
        used = tuple(dict.fromkeys(self.slots))
        if self._rows is None:
            self._rows = JointStateRows(self.names, used)
        joined = {}
        for name in self.groups:
            found = [part[name] for part in parts if name in part]
            if found:
                joined[name] = tuple(np.concatenate(columns) for columns in zip(*found, strict=True))
        instants = next(iter(joined.values()))[0]
        if any(not np.array_equal(times_ns, instants) for times_ns, _ in joined.values()):
            instants = np.unique(np.concatenate([times_ns for times_ns, _ in joined.values()]))
        filled = {slot: np.full((len(instants), len(self.channels)), np.nan) for slot in used}
        for name, (times_ns, values) in joined.items():
            rows = slice(None) if len(times_ns) == len(instants) else np.searchsorted(instants, times_ns)
            for slot, place, columns in self._places[name]:
                filled[slot][rows, place] = values[:, columns]
        return instants, self._rows.encode(instants, filled)


class Views:
    """All views of a channel table."""

    def __init__(self, table: ChannelTable, *, rate_hz: float) -> None:
        """Sort the groups into topics.

        Args:
            table: The channel table.
            rate_hz: Messages per simulated second [Hz]; 0 makes no views.
        """
        self.rate_hz = rate_hz
        self.all: list[View] = []
        self._of: dict[str, View] = {}
        self._calibration: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for group in table.groups.values() if rate_hz else ():
            view = next((view for view in self.all if view.takes(group)), None)
            if view is None:
                view = View()
                self.all.append(view)
            view.join(group)
            self._of[group.name] = view
            scale = np.array([channel.scale for channel in group.channels])
            offset = np.array([channel.offset for channel in group.channels])
            self._calibration[group.name] = scale, offset

    def add(self, group: Group, block: Block, time_ns: int) -> tuple[View, Messages] | None:
        """Take a block; give its view and the messages that are complete with it.

        Rows are picked by their number, unfiltered, so the messages do not depend on the size of the blocks.

        Args:
            group: The block's group.
            block: Its counts.
            time_ns: Simulated time of its first row [ns].
        """
        view = self._of.get(group.name)
        if view is None or block.rate_hz <= 0.0 or block.values.shape[1] != len(group.channels):
            return None
        step = max(1, round(block.rate_hz / self.rate_hz))
        picked = np.arange(-block.index % step, len(block.values), step)
        if not len(picked):
            return None
        times_ns = time_ns + np.rint(picked * (1e9 / block.rate_hz)).astype(np.int64)
        scale, offset = self._calibration[group.name]
        return view, view.add(group, block.tick, times_ns, block.values[picked] * scale + offset)
