"""Signals between transducer and converter, with the faults that act there.

All channels are computed together: blocks have few rows, and calls take most of the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np

from rig.channels.faults import At, NoFilter, Swap, acts, connect_swaps
from rig.channels.faults.delivery import Active
from rig.channels.sampling import TICKS_HZ
from rig.channels.table import Channel, Group
from rig.physics.kernels.observe import EDGE_WIDTH, KEYPHASOR_WIDTH
from rig.physics.kernels.signals import COLUMN, N_ROW

NO_ANGLES = np.empty(0)
"""Empty angles and rates, for a fault that acts on samples."""


_ANALOGUE_METHODS = ("signal", "volts", "chain", "late_s")
"""Methods by which a kind acts before the converter; a channel without one of them is sound up to there."""
_PATH_KINDS = (Swap, NoFilter)
"""Kinds that change the path of a signal without any of these methods."""


class Plan:
    """Assignment of the active faults to the channels of one conditioner.

    Attributes:
        faulty: Faults of each faulty channel.
        homes: Group and column of each channel.
        twins: Faulty channels with their own signal chain; under True those with late samples.
        converters: Faults that act on counts, by channel.
    """

    def __init__(self, groups: Sequence[Group], active: Sequence[Active]) -> None:
        self.homes = {name: (group.name, c) for group in groups for c, name in enumerate(group.names)}
        every = {name: [one for one in active if name in one.names] for name in self.homes}
        self.faulty = {name: faults for name, faults in every.items() if faults}
        self.twins: dict[bool, dict[str, list[Active]]] = {False: {}, True: {}}
        self.converters: dict[str, list[Active]] = {}
        for name, faults in self.faulty.items():
            if any(acts(one.what, *_ANALOGUE_METHODS) or isinstance(one.what, _PATH_KINDS) for one in faults):
                self.twins[any(acts(one.what, "late_s") for one in faults)][name] = faults
            if last := [one for one in faults if acts(one.what, "counts")]:
                self.converters[name] = last


def make_place(
    one: Active, channel: Channel, n: np.ndarray, times_s: np.ndarray,
    other: Callable[[str], np.ndarray] | None = None, angle: np.ndarray = NO_ANGLES, rate: np.ndarray = NO_ANGLES,
) -> At:  # fmt: skip
    """Return the place at which a fault acts: rows or samples n of a channel at their times [s], shape (n,)."""
    t = times_s - one.begin / TICKS_HZ
    return At(t, n, channel, one.draws[channel.name], one.kept, other or read_nothing, angle, rate, mark_signal)


class Volts:
    """Signals of faulty channels over a block of rows [SI]: faults of transducers, range limits, faults of cables."""

    def __init__(
        self, scales: Scales, rows: np.ndarray, extra: np.ndarray, tick: int, row_ticks: int, active: Sequence[Active]
    ) -> None:
        self.rows, self._extra, self._active, self._scales = rows, extra, active, scales
        self._times_s = (tick + row_ticks * np.arange(len(rows))) / TICKS_HZ
        self._n = tick // row_ticks + np.arange(len(rows))

    def _at(self, one: Active, name: str) -> At:
        angle, rate = self.rows[:, COLUMN["theta"]], self.rows[:, COLUMN["theta_rate"]]
        channel = self._scales.channels[name]
        return make_place(one, channel, self._n, self._times_s, self._beyond_bias, angle, rate)

    @cached_property
    def _conditioned(self) -> np.ndarray:
        """Outputs of all conditioners, with the faults of transducers [V], shape (rows, channels)."""
        about = self._scales
        source = self.rows if about.columns.max(initial=0) < N_ROW else np.hstack([self.rows, self._extra])
        x = np.asfortranarray(source[:, about.columns] / about.si)
        for one in self._active:
            if acts(one.what, "signal"):
                for name in one.names:
                    column = about.places[name]
                    x[:, column] = one.what.signal(x[:, column], self._at(one, name))
        return np.minimum(np.maximum(about.bias_v + about.sensitivity_v * x, about.low_v), about.high_v)

    def _beyond_bias(self, name: str) -> np.ndarray:
        about = self._scales
        return self._conditioned[:, about.places[name]] - about.bias_v[about.places[name]]

    def signals(self, names: Sequence[str]) -> np.ndarray:
        """Return the signals [SI] equivalent to the inputs of the converters' filters, shape (rows, channels)."""
        about, plugs = self._scales, connect_swaps(self._active)
        # In C order, for which the filters are compiled; an index of columns would give the other.
        volts = np.take(self._conditioned, [about.places[plugs.get(name, name)] for name in names], axis=1)
        for one in self._active:
            if acts(one.what, "volts"):
                for name in one.names:
                    if name in names:
                        column = names.index(name)
                        volts[:, column] = one.what.volts(volts[:, column], self._at(one, name))
        own = [about.places[name] for name in names]
        return (volts - about.bias_v[own]) / about.sensitivity_v[own] * about.si[own]


class Scales:
    """Scales from signals to volts of all channels of a table, each an array of shape (channels,)."""

    def __init__(self, channels: Mapping[str, Channel], columns: Mapping[str, int]) -> None:
        self.channels = channels
        self.places = {name: place for place, name in enumerate(channels)}
        self.columns = np.array([columns.get(name, 0) for name in channels], dtype=np.int64)
        fields = ("si", "bias_v", "sensitivity_v")
        self.si, self.bias_v, self.sensitivity_v = (
            np.array([getattr(channel, field) for channel in channels.values()]) for field in fields
        )
        self.low_v, self.high_v = np.array([channel.range_v for channel in channels.values()]).T


def mark_signal(angle: np.ndarray) -> np.ndarray:
    """Return the keyphasor's signal at angles of the shaft [rad], as rows of the model have it, shape (n,)."""
    ahead = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return np.clip(0.5 + np.minimum(ahead, KEYPHASOR_WIDTH - ahead) / EDGE_WIDTH, 0.0, 1.0)


def read_nothing(_: str) -> np.ndarray:
    """Return an empty array: a fault of samples reads no other channel."""
    return NO_ANGLES
