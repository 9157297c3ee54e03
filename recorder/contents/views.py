"""Plot messages of a recording: assignment of channels to topics, and merging of the blocks of several groups.

A generic viewer plots each array (position, velocity, effort) of each JointState topic; rerun plots at most eight
arrays, empty ones included. Groups therefore share a topic as long as each array holds one unit: lengths are written
to `position`, forces to `effort`, all others to `velocity`. The arrays only sort the channels into plots. The unit is
part of each name, and a column is nan in the arrays that it does not belong to.
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
_BATCH_INSTANTS = 16
"""Number of block instants that are encoded together; encoding them one at a time costs more."""
_MAX_WAITING_INSTANTS = 4000
"""Largest number of instants at which one group waits for another before they are written without it.

History is delivered key by key, so this exceeds the size of a rig's cache. Each waiting block holds only a few rows.
"""


def get_slot(channel: Channel) -> str:
    """Return the message array for a channel, by its unit."""
    if channel.unit in _LENGTHS:
        return "position"
    return "effort" if channel.unit in _FORCES else "velocity"


Messages = tuple[np.ndarray, np.ndarray]
"""Messages of one topic, oldest first: simulated times [ns], int64, shape (n,), and CDR, uint8, shape (n, bytes)."""
_NO_MESSAGES: Messages = (np.empty(0, np.int64), np.empty((0, 0), np.uint8))


@dataclass
class View:
    """Topic of plot messages, built from the blocks of one or more channel groups.

    Attributes:
        groups: Names of the groups.
        channels: Channels in column order.
        slots: Message array of each column.
    """

    groups: list[str] = field(default_factory=list)
    channels: list[Channel] = field(default_factory=list)
    slots: list[str] = field(default_factory=list)
    _column_map: dict[str, list[tuple[str, slice, slice]]] = field(default_factory=dict)
    """For each group: message array, columns of the message, and columns of the group, for each run of equal arrays."""
    _complete: list[dict[str, tuple[np.ndarray, np.ndarray]]] = field(default_factory=list)
    _waiting: dict[int, dict[str, tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict)
    _rows: JointStateRows | None = None

    @property
    def topic(self) -> str:
        """Name of the topic, built from its groups."""
        return f"{VIEW}/{'+'.join(self.groups)}"

    @property
    def names(self) -> tuple[str, ...]:
        """Column labels with units."""
        return tuple(f"{channel.name} [{channel.unit}]" for channel in self.channels)

    def takes(self, group: Group) -> bool:
        """Return whether a group fits this topic: equal rate, and no second unit in any array."""
        units = {slot: channel.unit for slot, channel in zip(self.slots, self.channels, strict=True)}
        same = all(channel.rate_hz == group.rate_hz for channel in self.channels)
        return same and all(units.get(get_slot(channel), channel.unit) == channel.unit for channel in group.channels)

    def join(self, group: Group) -> None:
        """Append a group's channels."""
        first, slots = len(self.channels), [get_slot(channel) for channel in group.channels]
        # Adjacent columns of the same array are copied together.
        self._column_map[group.name] = []
        start = 0
        for slot, neighbours in groupby(slots):
            end = start + len(list(neighbours))
            self._column_map[group.name].append((slot, slice(first + start, first + end), slice(start, end)))
            start = end
        self.groups.append(group.name)
        self.channels += group.channels
        self.slots += slots

    def add(self, group: Group, tick: int, times_ns: np.ndarray, values: np.ndarray) -> Messages:
        """Add rows of one group and return the messages completed by them.

        Args:
            group: One of the view's groups.
            tick: Tick of the block.
            times_ns: Simulated time of each row [ns], shape (n,).
            values: Engineering values, shape (n, channels of the group).
        """
        self._waiting.setdefault(tick, {})[group.name] = (times_ns, values)
        if len(self._waiting[tick]) == len(self.groups):
            # Blocks of a group arrive in order, so an older incomplete instant will not be completed.
            self._complete_instants([earlier for earlier in self._waiting if earlier <= tick])
        elif len(self._waiting) > _MAX_WAITING_INSTANTS:
            self._complete_instants([next(iter(self._waiting))])
        return self.take_complete() if len(self._complete) >= _BATCH_INSTANTS else _NO_MESSAGES

    def take_complete(self) -> Messages:
        """Return the complete messages, even if there are only a few."""
        parts, self._complete = self._complete, []
        return self._encode(parts)

    def take_all(self) -> Messages:
        """Return all waiting messages, complete or not."""
        self._complete_instants(list(self._waiting))
        return self.take_complete()

    def _complete_instants(self, ticks: list[int]) -> None:
        self._complete += [self._waiting.pop(tick) for tick in sorted(ticks)]

    def _encode(self, parts: list[dict[str, tuple[np.ndarray, np.ndarray]]]) -> Messages:
        """Merge the parts of all groups by instant and encode them."""
        if not parts:
            return _NO_MESSAGES
        used = tuple(dict.fromkeys(self.slots))
        if self._rows is None:
            self._rows = JointStateRows(self.names, used)
        merged = {}
        for name in self.groups:
            columns_by_part = [part[name] for part in parts if name in part]
            if columns_by_part:
                merged[name] = tuple(np.concatenate(columns) for columns in zip(*columns_by_part, strict=True))
        instants = next(iter(merged.values()))[0]
        if any(not np.array_equal(times_ns, instants) for times_ns, _ in merged.values()):
            instants = np.unique(np.concatenate([times_ns for times_ns, _ in merged.values()]))
        filled = {slot: np.full((len(instants), len(self.channels)), np.nan) for slot in used}
        for name, (times_ns, values) in merged.items():
            rows = slice(None) if len(times_ns) == len(instants) else np.searchsorted(instants, times_ns)
            for slot, place, columns in self._column_map[name]:
                filled[slot][rows, place] = values[:, columns]
        return instants, self._rows.encode(instants, filled)


class Views:
    """All plot topics of a channel table."""

    def __init__(self, table: ChannelTable, *, rate_hz: float) -> None:
        """Assign the groups to topics.

        Args:
            table: The channel table.
            rate_hz: Messages per simulated second [Hz]; 0 for no plot messages.
        """
        self.rate_hz = rate_hz
        self.all: list[View] = []
        self._view_by_group: dict[str, View] = {}
        self._calibration: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for group in table.groups.values() if rate_hz else ():
            view = next((view for view in self.all if view.takes(group)), None)
            if view is None:
                view = View()
                self.all.append(view)
            view.join(group)
            self._view_by_group[group.name] = view
            scale = np.array([channel.scale for channel in group.channels])
            offset = np.array([channel.offset for channel in group.channels])
            self._calibration[group.name] = scale, offset

    def add(self, group: Group, block: Block, time_ns: int) -> tuple[View, Messages] | None:
        """Add a block and return its view with the messages completed by it.

        Rows are selected by row number, unfiltered, so the messages do not depend on the block size.

        Args:
            group: The block's group.
            block: Its counts.
            time_ns: Simulated time of its first row [ns].
        """
        view = self._view_by_group.get(group.name)
        if view is None or block.rate_hz <= 0.0 or block.values.shape[1] != len(group.channels):
            return None
        step = max(1, round(block.rate_hz / self.rate_hz))
        picked = np.arange(-block.index % step, len(block.values), step)
        if not len(picked):
            return None
        times_ns = time_ns + np.rint(picked * (1e9 / block.rate_hz)).astype(np.int64)
        scale, offset = self._calibration[group.name]
        return view, view.add(group, block.tick, times_ns, block.values[picked] * scale + offset)
