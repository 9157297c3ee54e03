"""What the model predicts for the very rows of a recording: every channel without noise, and the truth.

Channels are the recording's own, with its calibration, filters and noise, on its own clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from recorder.reader import Recording
from replays.recordings.resimulation.experiment import Experiment
from rig.base.errors import InputError
from rig.channels.formula import Formulas
from rig.channels.sampling import between, fits, lagrange
from rig.channels.sensors.conditioning import Conditioner
from rig.channels.table import Channel, Group, default_table
from rig.run.offline import frames
from rig.run.scenes import Scene, rig_table
from rig.run.simulation import TICK_RATE_HZ, Frame, Simulation, Snapshot

_FINE_BITS = 32
"""Bits of a predicted channel's converter: its steps are none of the recording's."""
_BEYOND = 16.0
"""So much more than an imported log shows of a channel may be predicted, where the rig has none of that name."""
_QUIET = 2.0
"""Below so many steps of noise a channel's rounding is not random: its floor is a bound, not a deviation."""
_CHUNK_S = 0.1
_BEHIND = 3
"""Rows behind a sample that a polynomial through six of them may need."""
_SETTLED_S = 0.02
"""Low-passes have settled after this [s] ..."""
_DECAYS = 7.0
"""... and high-passes after so many of their time constants."""
_LEAD_INS = 8
"""So many are kept: those of a central difference in two values, and some more."""


@dataclass(frozen=True)
class Measured:
    """The channels of one group of a recording that the model knows.

    Attributes:
        group: Its name.
        channels: With the recording's own calibration.
        times_s: Simulated time of each row [s], shape (n,).
        index: Number of each row, shape (n,); a step other than 1 is a gap.
        values: Engineering values, shape (n, channels).
        floor: Standard deviation of noise and rounding of each channel [its unit], shape (channels,).
        random: Whether that is noise (True) or a bound of the rounding, shape (channels,).
        ideal: Whether the scene left filters and noise out.
        version: Of the channel table.
    """

    group: str
    channels: tuple[Channel, ...]
    times_s: np.ndarray
    index: np.ndarray
    values: np.ndarray
    floor: np.ndarray
    random: np.ndarray
    ideal: bool
    version: int = 2

    @property
    def names(self) -> tuple[str, ...]:
        """Channel names, in column order."""
        return tuple(channel.name for channel in self.channels)

    def rows_until(self, end_s: float) -> int:
        """Number of rows before a time."""
        return int(np.searchsorted(self.times_s, end_s))

    def until(self, end_s: float) -> Measured:
        """The rows before a time."""
        return self.first(self.rows_until(end_s))

    def from_(self, begin_s: float) -> Measured:
        """The rows from a time on."""
        return self.chosen(slice(self.rows_until(begin_s), None))

    def filtered(self, factor: float) -> Measured:
        """The same behind low-passes of other corners."""
        corners = ((channel, channel.bandwidth_hz * factor) for channel in self.channels)
        return replace(self, channels=tuple(one.model_copy(update={"bandwidth_hz": hz}) for one, hz in corners))

    def first(self, n: int) -> Measured:
        """The first rows."""
        return self.chosen(slice(n))

    def chosen(self, rows: slice | np.ndarray) -> Measured:
        """Some of the rows."""
        return replace(self, times_s=self.times_s[rows], index=self.index[rows], values=self.values[rows])

    def later(self, shift_s: float, rate: float, *, about_s: float) -> Measured:
        """The same where the recording's clock is late by a shift [s], and gains at a rate [1] from a time on [s]."""
        return replace(self, times_s=self.times_s - shift_s - rate * (self.times_s - about_s))

    def earlier(self, late_s: Mapping[str, float]) -> Measured:
        """The same with some channels as if they were not late [s]."""
        from scipy.interpolate import CubicSpline

        columns = [c for c, name in enumerate(self.names) if name in late_s]
        if not columns:
            return self
        values = self.values.copy()
        for c in columns:
            values[:, c] = CubicSpline(self.times_s, values[:, c])(self.times_s + late_s[self.names[c]])
        return replace(self, values=values)

    def only(self, names: Sequence[str]) -> Measured:
        """Some of the channels."""
        kept = [c for c, name in enumerate(self.names) if name in names]
        return replace(
            self, channels=tuple(self.channels[c] for c in kept), values=self.values[:, kept], floor=self.floor[kept],
            random=self.random[kept],
        )  # fmt: skip

    @cached_property
    def fine(self) -> tuple[Channel, ...]:
        """The channels with a converter that hardly rounds, and where no range is known, without one."""
        return tuple(
            channel.model_copy(update={"adc_bits": _FINE_BITS} | ({} if channel.has_range else _wide(channel)))
            for channel in self.channels
        )


def _wide(channel: Channel) -> dict[str, Any]:
    """A range that holds what the rig's own channel of that name may show: of the log's, the unit may be wrong."""
    own = default_table().channels.get(channel.name)
    reach_v = _BEYOND * channel.adc_v
    if own is not None and own.unit == channel.unit:
        ends = ((volts - own.bias_v) / own.sensitivity_v for volts in own.range_v)
        reach_v = max(channel.adc_v, 2.0 * max(abs(channel.bias_v + channel.sensitivity_v * end) for end in ends))
    return {"adc_v": reach_v, "range_v": (-reach_v, reach_v)}


def measured(recording: Recording, scene: Scene, *, longest_s: float = math.inf) -> dict[str, Measured]:
    """The groups of a recording that the model knows, by name.

    Args:
        recording: The recording.
        scene: What it is a recording of: what its channels feel, and whether there were filters and noise.
        longest_s: How much of it, from the first sample on [s].

    Raises:
        InputError: It holds no two samples of a channel that the model knows.
    """
    found, formulas, sensors = {}, scene.formulas(), scene.sensors
    ideal = sensors.chain == "ideal"
    noise = sensors.noise and not ideal
    for name, group in recording.table.groups.items():
        columns = [c for c, channel in enumerate(group.channels) if formulas.knows(channel.name, channel.signal)]
        samples = recording.samples(name)
        if not columns or len(samples.times_s) < 2:
            continue
        order = np.argsort(samples.index, kind="stable")
        order = order[samples.times_s[order] < samples.times_s[order[0]] + longest_s]
        channels = tuple(group.channels[c] for c in columns)
        loud = np.array([channel.noise_v if noise else 0.0 for channel in channels])
        step = np.array([channel.lsb_v for channel in channels])
        random = loud > _QUIET * step
        floor = np.where(random, np.hypot(loud, step / np.sqrt(12.0)), np.maximum(loud, step))
        found[name] = Measured(
            group=name,
            channels=channels,
            times_s=samples.times_s[order],
            index=samples.index[order],
            values=samples.values[order][:, columns],
            floor=floor / np.abs([channel.sensitivity_v for channel in channels]),
            random=random,
            ideal=ideal,
            version=recording.table.version,
        )
    if not found:
        raise InputError("file", "a recording with two samples of a channel that the model knows", str(recording.path))
    return found


@dataclass(frozen=True)
class Prediction:
    """What is predicted.

    Attributes:
        values: Of each group, on the recording's rows, in its channels' units, shape (rows, channels).
        truth: Of each truth table [SI], from time zero on, shape (n, columns).
        truth_rate_hz: Rows of it a second.
        contacts: Contacts begun from the start of the experiment to shortly behind the last row.
    """

    values: dict[str, np.ndarray]
    truth: dict[str, np.ndarray]
    truth_rate_hz: int
    contacts: int = 0


class _Channels:
    """Turns rows of the model into what channels of one rate show without noise, on the recorded rows."""

    def __init__(
        self, parts: Sequence[Measured], *, rate_hz: int, row_rate_hz: int, formulas: Formulas, digital: bool
    ) -> None:
        self._parts, self._rate_hz = parts, rate_hz
        self.apart, self._in_a_row = between(rate_hz, row_rate_hz)
        groups = [Group(name=part.group, title=part.group, rate_hz=rate_hz, channels=part.fine) for part in parts]
        self._groups = {group.name: group for group in groups}
        self._conditioner = Conditioner(
            groups, row_rate_hz=row_rate_hz, seed=0, noise=False, ideal=parts[0].ideal, digital=digital,
            columns=formulas.columns(groups),
        )  # fmt: skip
        self._formulas, self._last = formulas, np.empty((0, 0))
        self._counts: dict[str, list[np.ndarray]] = {part.group: [] for part in parts}
        self._first = 0

    def begin(self, row: int) -> None:
        """Leave out what is before a row that a sample falls on."""
        self._first = row * self._in_a_row // self.apart

    def take(self, rows: np.ndarray) -> None:
        if len(self._last):
            rows = np.concatenate([self._last, rows])
        self._last = rows[-1:].copy()
        for name, counts in self._conditioner.counts(rows, self._formulas.values(rows)).items():
            self._counts[name].append(counts)

    def values(self) -> dict[str, np.ndarray]:
        self.take(self._last)  # for the sample on the last row
        found = {}
        for part in self._parts:
            values = self._groups[part.group].engineering(np.concatenate(self._counts[part.group]))
            found[part.group] = sampled(values, part.times_s * self._rate_hz - self._first)
        return found


def sampled(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Even samples at places between them, by the polynomial through the six nearest; on a sample, that sample.

    Behind a low-pass at an eighth of the rate the error is 1e-3 of the signal where a straight line makes 8e-2.

    Args:
        values: Samples, shape (n, channels).
        places: In samples from the first, shape (m,).

    Returns:
        Shape (m, channels).
    """
    whole = np.rint(places).astype(int)
    if np.abs(places - whole).max(initial=0.0) < 1e-6 and len(values):
        return values[np.clip(whole, 0, len(values) - 1)]
    taps = np.arange(min(6, len(values)))
    first = np.clip(np.floor(places).astype(int) - (len(taps) - 1) // 2, 0, len(values) - len(taps))
    weights = lagrange(np.clip(places, 0.0, len(values) - 1.0) - first, taps)
    found = np.zeros((len(places), values.shape[1]))
    for tap, weight in zip(taps, weights, strict=True):
        found += weight[:, None] * values.take(first + tap, axis=0)
    return found


def _channels(parts: dict[str, Measured], scene: Scene, *, row_rate_hz: int) -> list[_Channels]:
    """The channels, those of one rate together."""
    rates: dict[tuple[int, bool], list[Measured]] = {}
    for part in parts.values():
        rate = part.channels[0].rate_hz
        places = part.times_s * rate
        digital = part.version < 2
        even = row_rate_hz % rate == 0 if digital else fits(rate, row_rate_hz)
        exact = even and bool(np.abs(places - np.rint(places)).max() < 1e-6)
        # A clock that does not divide ours is read off every row of the model.
        rates.setdefault((rate if exact else row_rate_hz, part.ideal), []).append(part)
    return [
        _Channels(alike, rate_hz=rate, row_rate_hz=row_rate_hz, formulas=scene.formulas(), digital=alike[0].version < 2)
        for (rate, _), alike in rates.items()
    ]


class LeadIns:
    """Runs up to shortly before the first samples, or the first command: experiments that differ in commands share one.

    What is predicted by them is the same bit for bit.
    """

    def __init__(self) -> None:
        self._kept: dict[tuple[Any, ...], tuple[Snapshot, dict[str, list[np.ndarray]]]] = {}

    def take(
        self, experiment: Experiment, simulation: Simulation, *, chunk_s: float, until: int
    ) -> dict[str, list[np.ndarray]]:
        """Take a simulation at its start to a tick, or as many whole chunks before it as no command comes in.

        Returns:
            The truth up to there, by table.
        """
        ticks = [round(command.at_s * TICK_RATE_HZ) for command in experiment.scene.commands]
        until = min([until, *ticks, *(command.tick for command in experiment.commands)])
        if until < simulation.tick + chunk_s * TICK_RATE_HZ:
            return {}
        alone = experiment.scene.model_copy(update={"commands": ()})
        key = (alone.model_dump_json(), experiment.begin, chunk_s, until)
        if key not in self._kept:
            if len(self._kept) == _LEAD_INS:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = _lead_in(Simulation(alone, begin=experiment.begin), chunk_s=chunk_s, until=until)
        snapshot, truth = self._kept[key]
        simulation.restore(snapshot)
        return {name: list(blocks) for name, blocks in truth.items()}


def _lead_in(simulation: Simulation, *, chunk_s: float, until: int) -> tuple[Snapshot, dict[str, list[np.ndarray]]]:
    truth: dict[str, list[np.ndarray]] = {}
    for frame in frames(simulation, chunk_s=chunk_s):
        for name, block in frame.truth.items():
            truth.setdefault(name, []).append(block.values)
        if simulation.tick + frame.ticks > until:
            break
    return simulation.snapshot(), truth


def predict(
    experiment: Experiment,
    parts: dict[str, Measured],
    *,
    end_s: float | None = None,
    follow: Callable[[Frame], None] | None = None,
    progress: Callable[[float], None] | None = None,
    lead_ins: LeadIns | None = None,
) -> Prediction:
    """Simulate, and read off what the recorded channels would have shown without noise.

    Args:
        experiment: What to simulate; `bare` makes it cheaper.
        parts: The channels, and the rows wanted.
        end_s: Only rows before this time [s].
        follow: Given every frame, to the end of the experiment; without it nothing behind the last row is simulated.
        progress: Called with the part done, 0 to 1.
        lead_ins: Those of predictions before this one; without `follow` only.
    """
    if end_s is not None:
        parts = {name: part.until(end_s) for name, part in parts.items()}
    parts = {name: part for name, part in parts.items() if len(part.times_s)}
    last_s = max((float(part.times_s[-1]) for part in parts.values()), default=0.0)
    simulation = experiment.simulation()
    if experiment.scene.generator is not None:
        if follow is not None:
            for frame in experiment.frames(simulation):
                follow(frame)
        return Prediction({name: _generated(experiment.scene, part) for name, part in parts.items()}, {}, 1)
    row_rate_hz = TICK_RATE_HZ // simulation.row_ticks
    taking = _channels(parts, experiment.scene, row_rate_hz=row_rate_hz)
    chunk_s = min(_CHUNK_S, last_s + 2e-3)  # the row of the last sample must be in it, and some behind it
    begin_tick = max(simulation.tick, _begin_tick(parts, taking, chunk_s=chunk_s, row_rate_hz=row_rate_hz))
    for channels in taking:
        channels.begin(begin_tick * row_rate_hz // TICK_RATE_HZ)
    truth: dict[str, list[np.ndarray]] = {}
    if lead_ins is not None:
        truth = lead_ins.take(experiment, simulation, chunk_s=chunk_s, until=begin_tick)
    for frame in experiment.frames(simulation, chunk_s=chunk_s):
        if frame.tick <= last_s * TICK_RATE_HZ + _BEHIND * simulation.row_ticks:
            # A command that was sent ends a frame, and those behind it begin on no grid.
            before = max(0, begin_tick - frame.tick) // simulation.row_ticks
            if before < len(frame.rows):
                for channels in taking:
                    channels.take(frame.rows[before:])
            for name, block in frame.truth.items():
                truth.setdefault(name, []).append(block.values)
        if follow is not None:
            follow(frame)
        if progress is not None:
            progress(simulation.tick / simulation.end_tick)
        if follow is None and simulation.tick > (last_s + 1e-3) * TICK_RATE_HZ:
            break
    return Prediction(
        values={name: values for channels in taking for name, values in channels.values().items()},
        truth={name: np.concatenate(blocks) for name, blocks in truth.items()},
        truth_rate_hz=experiment.scene.sensors.truth_rate_hz,
        contacts=simulation.health()["contacts"],
    )


def _generated(scene: Scene, part: Measured) -> np.ndarray:
    """What a group shows of test signals, in its channels' units, shape (rows, channels)."""
    sources = scene.sources()
    volts = [sources[channel.name].volts(part.times_s).clip(-channel.adc_v, channel.adc_v) for channel in part.channels]
    shown = [(v - channel.bias_v) / channel.sensitivity_v for v, channel in zip(volts, part.channels, strict=True)]
    return np.stack(shown, axis=1)


def _begin_tick(parts: dict[str, Measured], taking: Sequence[_Channels], *, chunk_s: float, row_rate_hz: int) -> int:
    """From when on the channels are worked out: early enough for their filters to have settled at the first sample."""
    chunk = round(chunk_s * row_rate_hz)
    if chunk_s < _CHUNK_S or any(chunk % channels.apart for channels in taking):
        return 0
    corners = [c.highpass_hz for part in parts.values() for c in part.channels if c.highpass_hz]
    settled_s = _SETTLED_S + _DECAYS / (2.0 * math.pi * min(corners, default=math.inf))
    first_s = min(float(part.times_s[0]) for part in parts.values()) - settled_s
    return max(0, math.floor(first_s / chunk_s)) * chunk * (TICK_RATE_HZ // row_rate_hz)


def bare(experiment: Experiment) -> Experiment:
    """The same motion with one cheap, sound sensor and no companion: rows stay as far apart as they were."""
    if experiment.scene.generator is not None:
        return experiment
    groups = (experiment.scene.channels or rig_table()).groups.values()
    fewest = min(groups, key=lambda group: len(group.channels))
    return experiment.without_faults().changed(
        {
            "engine.companion": False,
            "engine.limits": {},
            "engine.tolerance": experiment.scene.engine.tolerance,
            "sensors.groups": [fewest.name],
            "sensors.chain": "ideal",
            "sensors.rate_hz": TICK_RATE_HZ // experiment.simulation().row_ticks,
        }
    )
