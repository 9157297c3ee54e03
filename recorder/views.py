"""The plottable messages of a recording: which channels stand together in one, and the joining of their blocks.

A viewer that knows nothing of this project makes a plot for each array of each JointState topic (position, velocity,
effort); rerun makes eight at most, of any of the arrays, empty ones included. So groups share a topic as long as each
of its three arrays holds one unit: lengths go to `position`, forces to `effort`, all else to `velocity`. The arrays
only sort the channels into plots; the unit stands in each name, and a column is nan in the arrays it is not part of.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from recorder.schemas import VIEW, JointStateRows
from rig.channels import Channel, ChannelTable, Group
from rig.wire import Block

_LENGTHS = frozenset({"m", "mm", "um", "\u00b5m", "mil"})
_FORCES = frozenset({"N", "kN"})
_PATIENCE = 4000
"""Blocks of one group that wait for the same instants of another before they are written without: more than a rig's
cache holds, for history comes key by key. A block keeps few rows here."""


def slot_of(channel: Channel) -> str:
    """Array of the message that a channel's unit belongs to."""
    if channel.unit in _LENGTHS:
        return "position"
    return "effort" if channel.unit in _FORCES else "velocity"


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
    _first: dict[str, int] = field(default_factory=dict)
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
        """Whether a group can join without a second unit in any array."""
        units = {slot: channel.unit for slot, channel in zip(self.slots, self.channels, strict=True)}
        return all(units.get(slot_of(channel), channel.unit) == channel.unit for channel in group.channels)

    def join(self, group: Group) -> None:
        """Add a group's channels behind the others."""
        self._first[group.name] = len(self.channels)
        self.groups.append(group.name)
        self.channels += group.channels
        self.slots += [slot_of(channel) for channel in group.channels]

    def add(self, group: Group, tick: int, times_ns: np.ndarray, values: np.ndarray) -> list[tuple[int, bytes]]:
        """Take rows of one group; give the messages that are complete with them.

        Args:
            group: One of the view's groups.
            tick: Tick of the block that the rows are from.
            times_ns: Simulated time of each row [ns], shape (n,).
            values: Engineering values, shape (n, channels of the group).

        Returns:
            Simulated time [ns] and CDR message, oldest first.
        """
        self._waiting.setdefault(tick, {})[group.name] = (times_ns, values)
        if len(self._waiting[tick]) == len(self.groups):
            # Each group's blocks come in order: what is older and still waits for another group waits in vain.
            due = [earlier for earlier in self._waiting if earlier <= tick]
        elif len(self._waiting) > _PATIENCE:
            due = [next(iter(self._waiting))]
        else:
            due = []
        return self._encode(due)

    def rest(self) -> list[tuple[int, bytes]]:
        """Give what still waits."""
        return self._encode(list(self._waiting))

    def _encode(self, ticks: list[int]) -> list[tuple[int, bytes]]:
        if not ticks:
            return []
        used = tuple(dict.fromkeys(self.slots))
        if self._rows is None:
            self._rows = JointStateRows(self.names, used)
        messages: list[tuple[int, bytes]] = []
        for tick in sorted(ticks):
            parts = self._waiting.pop(tick)
            instants = np.unique(np.concatenate([times_ns for times_ns, _ in parts.values()]))
            filled = {slot: np.full((len(instants), len(self.channels)), np.nan) for slot in used}
            for name, (times_ns, values) in parts.items():
                rows = np.searchsorted(instants, times_ns)
                for column in range(values.shape[1]):
                    place = self._first[name] + column
                    filled[self.slots[place]][rows, place] = values[:, column]
            messages += zip(instants.tolist(), self._rows.encode(instants, filled), strict=True)
        return messages


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
        for group in table.groups.values() if rate_hz else ():
            view = next((view for view in self.all if view.takes(group)), None)
            if view is None:
                view = View()
                self.all.append(view)
            view.join(group)
            self._of[group.name] = view

    def add(self, group: Group, block: Block, time_ns: int) -> tuple[View, list[tuple[int, bytes]]] | None:
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
        return view, view.add(group, block.tick, times_ns, group.engineering(block.values[picked]))
