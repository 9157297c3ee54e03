"""Model prediction for the rows of a recording: every channel without noise, and the truth.

Channels have the recording's own calibration, filters and noise, on its own clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np

from recorder.reader import Recording
from replays.estimate.spectra import NoiseSpectrum, whiten_rows
from replays.recordings.resimulation.experiment import Experiment
from rig.base.errors import InputError
from rig.channels.formula import COLUMN, Formulas
from rig.channels.sampling import has_few_positions, lagrange, sample_spacing
from rig.channels.sensors.conditioning import Conditioner
from rig.channels.sensors.filters import delay_s
from rig.channels.table import Channel, Group, default_table
from rig.physics.kernels.signals import TRUTH
from rig.run.motion import MotionStart
from rig.run.offline import frames
from rig.run.scenes import Scene, rig_table
from rig.run.simulation import TICK_RATE_HZ, Frame, Simulation, Snapshot

K = TypeVar("K")
V = TypeVar("V")
_ADC_BITS = 32
"""Word length of a predicted channel's converter, whose rounding is then negligible."""
_RANGE_MARGIN = 16.0
"""Range of a predicted channel over that of an imported log, if the rig has no channel of that name."""
_MIN_NOISE_STEPS = 2.0
"""Noise in converter steps below which rounding is not random, so that the floor is a bound and not a deviation."""
_CHUNK_S = 0.1
_LOG_ROW_TICKS = 10
"""Largest row spacing for a log [ticks]: an impact contains frequencies above half of the rig's own row rate, which the
filters of a log never had to pass."""
_LOG_TOLERANCE = 1e-8
"""Largest tolerance of the engine for a log: later impacts amplify the error of a tolerance of 3e-4 to hundreds of
noises, and a run of some impacts takes no longer with this one."""
_POLYNOMIAL_ROWS = 3
"""Rows after a sample that a polynomial through six of them may need."""
_LOW_PASS_SETTLING_S = 0.02
"""Settling time of the low-passes [s]."""
_HIGH_PASS_SETTLING = 7.0
"""Settling time of high-passes, in time constants."""
_QUIET_ROW_TICKS, _QUIET_GRID_TICKS = (20, 50), 10_000
"""Row spacings for a quiet stretch, and the grid of the start after it [ticks]."""
_MAX_QUIET_CORNER = 0.4
"""Largest corner of a low-pass in a quiet stretch over the rate of its rows; one well above would be omitted."""
_MAX_LEAD_INS = 8
"""Lead-ins kept: those of a central difference in two values, and some more."""


@dataclass(frozen=True)
class Measured:
    """Channels of one group of a recording that the model knows.

    Attributes:
        group: Name of the group.
        channels: Channels with the recording's own calibration.
        times_s: Simulated time of each row [s], shape (n,).
        index: Number of each row, shape (n,); a step other than 1 is a gap.
        values: Engineering values, shape (n, channels).
        floor: Standard deviation of noise and rounding of each channel [its unit], shape (channels,).
        random: True if the floor is noise, False if it is a bound of the rounding, shape (channels,).
        ideal: True if the scene had no filters and no noise.
        spectra: Spectrum of the noise of each channel, None if it is white; empty if all are.
        version: Version of the channel table.
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
    spectra: tuple[NoiseSpectrum | None, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Channel names, in column order."""
        return tuple(channel.name for channel in self.channels)

    def count_rows(self, end_s: float) -> int:
        """Return the number of rows before a time."""
        return int(np.searchsorted(self.times_s, end_s))

    def select_until(self, end_s: float) -> Measured:
        """Return the rows before a time."""
        return self.select_first(self.count_rows(end_s))

    def select_from(self, begin_s: float) -> Measured:
        """Return the rows from a time on."""
        return self.select_rows(slice(self.count_rows(begin_s), None))

    def with_corner_factor(self, factor: float) -> Measured:
        """Return the channels with low-passes of other corners."""
        corners = ((channel, channel.bandwidth_hz * factor) for channel in self.channels)
        return replace(self, channels=tuple(one.model_copy(update={"bandwidth_hz": hz}) for one, hz in corners))

    def select_first(self, n: int) -> Measured:
        """Return the first rows."""
        return self.select_rows(slice(n))

    def select_rows(self, rows: slice | np.ndarray) -> Measured:
        """Return some of the rows."""
        return replace(self, times_s=self.times_s[rows], index=self.index[rows], values=self.values[rows])

    def correct_clock(self, shift_s: float, rate: float, *, about_s: float) -> Measured:
        """Return the rows with the recording's clock corrected.

        Args:
            shift_s: Delay of the recording's clock [s].
            rate: Relative rate error of the clock [1].
            about_s: Time at which the clocks differ by the delay alone [s].
        """
        return replace(self, times_s=self.times_s - shift_s - rate * (self.times_s - about_s))

    def remove_delays(self, late_s: Mapping[str, float]) -> Measured:
        """Return the rows with the delays of some channels removed [s]."""
        from scipy.interpolate import CubicSpline

        columns = [c for c, name in enumerate(self.names) if name in late_s]
        if not columns:
            return self
        values = self.values.copy()
        for c in columns:
            values[:, c] = CubicSpline(self.times_s, values[:, c])(self.times_s + late_s[self.names[c]])
        return replace(self, values=values)

    def select_channels(self, names: Sequence[str]) -> Measured:
        """Return some of the channels."""
        kept = [c for c, name in enumerate(self.names) if name in names]
        return replace(
            self, channels=tuple(self.channels[c] for c in kept), values=self.values[:, kept], floor=self.floor[kept],
            random=self.random[kept], spectra=tuple(self.spectra[c] for c in kept) if self.spectra else (),
        )  # fmt: skip

    @property
    def named_spectra(self) -> tuple[tuple[str, NoiseSpectrum | None], ...]:
        """Each channel's name, and the spectrum of its noise; None if that is white."""
        return tuple(zip(self.names, self.spectra or [None] * len(self.names), strict=True))

    def with_spectra(self, spectra: Mapping[str, NoiseSpectrum]) -> Measured:
        """Return the channels with the spectra of their noise, by name."""
        return replace(self, spectra=tuple(spectra.get(name) for name in self.names))

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviation of the noise of each channel, with its spectrum, shape (channels,)."""
        excess = [0.0 if one is None else one.excess for _, one in self.named_spectra]
        return self.floor * np.hypot(1.0, excess)

    def with_slow_floor(self) -> Measured:
        """Return the channels with floors of white noise as large as their noise is at low frequencies."""
        if not any(self.spectra):
            return self
        density = np.array([1.0 if one is None else one.low for one in self.spectra])
        return replace(self, floor=self.floor * np.sqrt(density), spectra=())

    def draw_noise(self, generator: np.random.Generator, n: int) -> np.ndarray:
        """Return random noise with the channels' floors and spectra, shape (n, channels)."""
        white = generator.standard_normal((n, len(self.names)))
        for c, (_, spectrum) in enumerate(self.named_spectra):
            if spectrum is not None:
                white[:, c] = spectrum.colour(white[:, c])
        return self.floor * white

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Return values of the first rows filtered so that the noise is white, at its floor, shape (n, channels)."""
        if not any(self.spectra):
            return values
        index = self.index[: len(values)]
        return np.column_stack([whiten_rows(v, one, index) for v, one in zip(values.T, self.spectra, strict=True)])

    @cached_property
    def fine(self) -> tuple[Channel, ...]:
        """Channels with a converter of negligible rounding, and without range limits if no range is known."""
        return tuple(
            channel.model_copy(update={"adc_bits": _ADC_BITS} | ({} if channel.has_range else _range(channel)))
            for channel in self.channels
        )


def _range(channel: Channel) -> dict[str, Any]:
    """Return a range that holds the rig's own channel of that name, as the unit of the log may be wrong."""
    own = default_table().channels.get(channel.name)
    reach_v = _RANGE_MARGIN * channel.adc_v
    if own is not None and own.unit == channel.unit:
        ends = ((volts - own.bias_v) / own.sensitivity_v for volts in own.range_v)
        reach_v = max(channel.adc_v, 2.0 * max(abs(channel.bias_v + channel.sensitivity_v * end) for end in ends))
    return {"adc_v": reach_v, "range_v": (-reach_v, reach_v)}


def read_measured(recording: Recording, scene: Scene, *, longest_s: float = math.inf) -> dict[str, Measured]:
    """Return the groups of a recording that the model knows, by name.

    Args:
        recording: The recording.
        scene: Scene of the recording, for the signals of its channels, filters and noise.
        longest_s: Length from the first sample on [s].

    Raises:
        InputError: No channel that the model knows has two samples.
    """
    parts, formulas, sensors = {}, scene.formulas(), scene.sensors
    ideal = sensors.chain == "ideal"
    noise = sensors.noise and not ideal
    for name, group in recording.table.groups.items():
        columns = [c for c, channel in enumerate(group.channels) if formulas.is_valid(channel.name, channel.signal)]
        samples = recording.samples(name)
        if not columns or len(samples.times_s) < 2:
            continue
        order = np.argsort(samples.index, kind="stable")
        order = order[samples.times_s[order] < samples.times_s[order[0]] + longest_s]
        channels = tuple(group.channels[c] for c in columns)
        noise_levels = np.array([channel.noise_v if noise else 0.0 for channel in channels])
        step = np.array([channel.lsb_v for channel in channels])
        random = noise_levels > _MIN_NOISE_STEPS * step
        floor = np.where(random, np.hypot(noise_levels, step / np.sqrt(12.0)), np.maximum(noise_levels, step))
        parts[name] = Measured(
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
    if not parts:
        raise InputError("file", "a recording with two samples of a channel that the model knows", str(recording.path))
    return parts


_SPEEDS = [COLUMN[name] for name in ("vx_ih", "vy_ih", "vx_oh", "vy_oh")]
_ACCELERATION_NAMES = ("inner_ax", "inner_ay", "outer_ax", "outer_ay")
_ACCELERATIONS = [COLUMN[name] for name in _ACCELERATION_NAMES]


@dataclass(frozen=True)
class Prediction:
    """Predicted channels and truth.

    Attributes:
        values: Channels of each group on the recording's rows, in their units, shape (rows, channels).
        truth: Truth tables [SI] from `begin_s` on, shape (n, columns).
        truth_rate_hz: Rate of the truth tables [Hz].
        contacts: Contacts from the start of the experiment to shortly after the last row.
        begin_s: Start of the simulation [s].
    """

    values: dict[str, np.ndarray]
    truth: dict[str, np.ndarray]
    truth_rate_hz: int
    contacts: int = 0
    begin_s: float = 0.0

    def compute_turns(self, times_s: np.ndarray) -> np.ndarray:
        """Return the angle of the shaft at times of the model's clock [revolutions], shape (n,)."""
        theta = self.truth["state"][:, TRUTH["state"].index("theta")]
        return np.interp(times_s, self.begin_s + np.arange(len(theta)) / self.truth_rate_hz, theta) / (2.0 * math.pi)


class _Channels:
    """Conversion of model rows to noise-free channels of one rate, on the recorded rows."""

    def __init__(
        self, parts: Sequence[Measured], *, rate_hz: int, row_rate_hz: int, formulas: Formulas, digital: bool,
        from_speeds: bool = False,
    ) -> None:  # fmt: skip
        """Set up the conversion.

        Args:
            parts: Channels of one rate.
            rate_hz: Samples per second [Hz].
            row_rate_hz: Rows of the model per second [Hz].
            formulas: Formulas of the scene.
            digital: Whether the filters are those of tables of version 1.
            from_speeds: Whether accelerations of the houses are derived from their speeds: friction that changes its
                sign between two rows makes a step in an acceleration, which its values at the rows do not locate.
        """
        self._parts, self._rate_hz, self._row_rate_hz = parts, rate_hz, row_rate_hz
        self.apart, _ = sample_spacing(rate_hz, row_rate_hz)
        # A compensated filter needs later rows: it is computed with a delay of whole samples, which is then removed.
        self._leads = {part.group: [math.ceil(lead_s(channel) * rate_hz) for channel in part.fine] for part in parts}
        groups = []
        for part in parts:
            channels = list(part.fine)
            for c, lead in enumerate(self._leads[part.group]):
                if lead:
                    late = {"group_delay_us": 1e6 * (delay_s(channels[c]) + lead / rate_hz)}
                    channels[c] = channels[c].model_copy(update=late)
            groups.append(Group(name=part.group, title=part.group, rate_hz=rate_hz, channels=tuple(channels)))
        self._groups = {group.name: group for group in groups}
        self._conditioner = Conditioner(
            groups, row_rate_hz=row_rate_hz, seed=0, noise=False, ideal=parts[0].ideal, digital=digital,
            columns=formulas.columns(groups),
        )  # fmt: skip
        self._formulas, self._rows, self._converted = formulas, np.empty((0, 0)), 0
        signals = [channel.signal for part in parts for channel in part.channels]
        self._from_speeds = from_speeds and any(name in signal for name in _ACCELERATION_NAMES for signal in signals)
        self._counts: dict[str, list[np.ndarray]] = {part.group: [] for part in parts}
        self._first = 0

    def begin(self, row: int) -> None:
        """Skip the samples before a row."""
        self._first = self._conditioner.start_at(row)

    def take(self, rows: np.ndarray) -> None:
        """Convert further rows, those with accelerations from speeds up to the last but two."""
        late = 2 if self._from_speeds else 0
        rows = np.concatenate([self._rows if len(self._rows) else rows[:0], rows])
        if len(rows) <= 2 * late:
            self._rows = rows
            return
        end = len(rows) - late
        if late:
            v = rows[:, _SPEEDS]
            rows[2:end, _ACCELERATIONS] = (8.0 * (v[3:-1] - v[1:-3]) - v[4:] + v[:-4]) * (self._row_rate_hz / 12.0)
        self._convert(rows[self._converted : end])
        self._converted = late // 2  # of the rows that are kept: the last one, with one before it for differences
        self._rows = rows[end - 1 - self._converted :].copy()

    def _convert(self, rows: np.ndarray) -> None:
        """Convert rows, which start with the last one of the previous call."""
        for name, counts in self._conditioner.counts(rows, self._formulas.values(rows)).items():
            self._counts[name].append(counts)

    def values(self) -> dict[str, np.ndarray]:
        self._convert(self._rows[[self._converted, self._converted]])  # for the sample on the last row
        values_by_group = {}
        for part in self._parts:
            counts = np.concatenate(self._counts[part.group])
            for c, lead in enumerate(self._leads[part.group]):
                if lead:
                    counts[:, c] = counts[np.minimum(np.arange(len(counts)) + lead, len(counts) - 1), c]
            counts = interpolate_rows(counts, part.times_s * self._rate_hz - self._first)
            values_by_group[part.group] = self._groups[part.group].engineering(counts)
        return values_by_group


def lead_s(channel: Channel) -> float:
    """Return the time by which a compensated filter responds before its input [s]."""
    return max(0.0, channel.half_length_s - delay_s(channel))


def last_needed_s(parts: Mapping[str, Measured]) -> float:
    """Return the time up to which samples need the motion: the last one, and the lead of a compensated filter [s]."""
    last_s = max((float(part.times_s[-1]) for part in parts.values()), default=0.0)
    return last_s + max((lead_s(channel) for part in parts.values() for channel in part.channels), default=0.0)


def interpolate_rows(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Interpolate even samples by the polynomial through the six nearest ones; sampling points are reproduced.

    After a low-pass at an eighth of the rate the error is 1e-3 of the signal, compared with 8e-2 of linear
    interpolation.

    Args:
        values: Samples, shape (n, channels).
        places: Positions in samples from the first, shape (m,).

    Returns:
        Shape (m, channels).
    """
    whole = np.rint(places).astype(int)
    if np.abs(places - whole).max(initial=0.0) < 1e-6 and len(values):
        return values[np.clip(whole, 0, len(values) - 1)]
    taps = np.arange(min(6, len(values)))
    first = np.clip(np.floor(places).astype(int) - (len(taps) - 1) // 2, 0, len(values) - len(taps))
    weights = lagrange(np.clip(places, 0.0, len(values) - 1.0) - first, taps)
    rows = np.zeros((len(places), values.shape[1]))
    for tap, weight in zip(taps, weights, strict=True):
        rows += weight[:, None] * values.take(first + tap, axis=0)
    return rows


def _channels(
    parts: dict[str, Measured], scene: Scene, *, row_rate_hz: int, from_speeds: bool = False
) -> list[_Channels]:
    """Return the channels, grouped by rate."""
    rates: dict[tuple[int, bool], list[Measured]] = {}
    for part in parts.values():
        rate = part.channels[0].rate_hz
        places = part.times_s * rate
        digital = part.version < 2
        even = row_rate_hz % rate == 0 if digital else has_few_positions(rate, row_rate_hz)
        exact = even and bool(np.abs(places - np.rint(places)).max() < 1e-6)
        # At a rate that does not divide the model's, channels are interpolated between all rows of the model.
        rates.setdefault((rate if exact else row_rate_hz, part.ideal), []).append(part)
    make = partial(_Channels, row_rate_hz=row_rate_hz, from_speeds=from_speeds)
    return [
        make(alike, rate_hz=rate, formulas=scene.formulas(), digital=alike[0].version < 2)
        for (rate, _), alike in rates.items()
    ]


def keep_recent(kept: dict[K, V], key: K, most: int, make: Callable[[], V]) -> V:
    """Return the value of a key; a new one is made, and replaces the oldest if there are as many as may be kept."""
    if key not in kept:
        if len(kept) >= most:
            kept.pop(next(iter(kept)))
        kept[key] = make()
    return kept[key]


def _command_ticks(experiment: Experiment) -> list[int]:
    """Return the ticks of all commands of an experiment, those of its scene and those that were sent."""
    timed = [round(command.at_s * TICK_RATE_HZ) for command in experiment.scene.commands]
    return timed + [command.tick for command in experiment.commands]


class LeadIns:
    """Cache of simulations up to the first samples or the first command, for experiments that differ only later.

    Predictions with and without it are equal bit for bit.
    """

    def __init__(self) -> None:
        self._kept: dict[tuple[Any, ...], tuple[Snapshot, dict[str, list[np.ndarray]]]] = {}

    def take(
        self, experiment: Experiment, simulation: Simulation, *, chunk_s: float, until: int
    ) -> dict[str, list[np.ndarray]]:
        """Advance a simulation from its start to a tick, or by whole chunks to the last one without a command.

        Returns:
            The truth up to there, by table.
        """
        until = min([until, *_command_ticks(experiment)])
        if until < simulation.tick + chunk_s * TICK_RATE_HZ:
            return {}
        alone = experiment.scene.model_copy(update={"commands": ()})
        key = (alone.model_dump_json(), experiment.begin, chunk_s, until)
        snapshot, truth = keep_recent(
            self._kept, key, _MAX_LEAD_INS,
            lambda: _lead_in(Simulation(alone, begin=experiment.begin), chunk_s=chunk_s, until=until),
        )  # fmt: skip
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
    """Simulate an experiment, and return the recorded channels without noise.

    Args:
        experiment: Experiment to simulate; `simplify` makes it cheaper.
        parts: Channels and rows to predict.
        end_s: Only rows before this time [s].
        follow: Callback for every frame to the end of the experiment; without it the simulation ends after the last
            row.
        progress: Callback for the completed fraction, 0 to 1.
        lead_ins: Cache of lead-ins; only without `follow`.
    """
    if end_s is not None:
        parts = {name: part.select_until(end_s) for name, part in parts.items()}
    parts = {name: part for name, part in parts.items() if len(part.times_s)}
    last_s = last_needed_s(parts)
    simulation = experiment.simulation()
    if experiment.scene.generator is not None:
        if follow is not None:
            for frame in experiment.frames(simulation):
                follow(frame)
        return Prediction({name: _test_signals(experiment.scene, part) for name, part in parts.items()}, {}, 1)
    row_rate_hz, begin_s = TICK_RATE_HZ // simulation.row_ticks, simulation.tick / TICK_RATE_HZ
    taking = _channels(parts, experiment.scene, row_rate_hz=row_rate_hz, from_speeds=experiment.imported)
    chunk_s = min(_CHUNK_S, last_s + 2e-3)  # includes the row of the last sample and some after it
    begin_tick = max(simulation.tick, _begin_tick(parts, taking, chunk_s=chunk_s, row_rate_hz=row_rate_hz))
    for channels in taking:
        channels.begin(begin_tick * row_rate_hz // TICK_RATE_HZ)
    truth: dict[str, list[np.ndarray]] = {}
    if lead_ins is not None:
        truth = lead_ins.take(experiment, simulation, chunk_s=chunk_s, until=begin_tick)
    for frame in experiment.frames(simulation, chunk_s=chunk_s):
        if frame.tick <= last_s * TICK_RATE_HZ + _POLYNOMIAL_ROWS * simulation.row_ticks:
            # A sent command ends a frame; later frames are not aligned to a grid.
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
        begin_s=begin_s,
    )


def _test_signals(scene: Scene, part: Measured) -> np.ndarray:
    """Return a group's test signals in its channels' units, shape (rows, channels)."""
    sources = scene.sources()
    volts = [sources[channel.name].volts(part.times_s).clip(-channel.adc_v, channel.adc_v) for channel in part.channels]
    shown = [(v - channel.bias_v) / channel.sensitivity_v for v, channel in zip(volts, part.channels, strict=True)]
    return np.stack(shown, axis=1)


def _begin_tick(parts: dict[str, Measured], taking: Sequence[_Channels], *, chunk_s: float, row_rate_hz: int) -> int:
    """Return the tick from which channels are computed, so that filters are settled at the first sample."""
    chunk = round(chunk_s * row_rate_hz)
    if chunk_s < _CHUNK_S or any(chunk % channels.apart for channels in taking):
        return 0
    first_s = min(float(part.times_s[0]) for part in parts.values()) - _settling_s(parts)
    return max(0, math.floor(first_s / chunk_s)) * chunk * (TICK_RATE_HZ // row_rate_hz)


def _settling_s(parts: Mapping[str, Measured]) -> float:
    """Return the time after which the filters of all channels have settled [s]."""
    channels = [channel for part in parts.values() for channel in part.channels]
    corners = [channel.highpass_hz for channel in channels if channel.highpass_hz]
    settled_s = _LOW_PASS_SETTLING_S + _HIGH_PASS_SETTLING / (2.0 * math.pi * min(corners, default=math.inf))
    return settled_s + max(2.0 * channel.half_length_s + delay_s(channel) for channel in channels)


class QuietStretch:
    """Prediction with rows further apart before the first contact, kept for experiments that differ only later.

    Without a contact, the motion of the default engine is exact at any row spacing.
    """

    def __init__(self, parts: Mapping[str, Measured], until_s: float) -> None:
        """Set up the prediction of the samples of some channels, of which those before a time are quiet [s]."""
        self._rows = {name: part.count_rows(until_s) for name, part in parts.items()}
        corners = [c.bandwidth_hz for part in parts.values() for c in part.channels if not math.isinf(c.bandwidth_hz)]
        highest_hz = max(corners, default=0.0) / _MAX_QUIET_CORNER
        if any(part.version < 2 for part in parts.values()):
            highest_hz = math.inf  # filters of version 1 depend on the rate of the rows
        self._ticks = max((ticks for ticks in _QUIET_ROW_TICKS if highest_hz * ticks < TICK_RATE_HZ), default=0)
        self._kept: dict[Any, tuple[dict[str, np.ndarray], MotionStart | None]] = {}

    def predict(self, experiment: Experiment, parts: dict[str, Measured], key: Any) -> Prediction | None:
        """Return the prediction, with the truth of the later samples only; None if it needs a single run.

        Args:
            experiment: Experiment, as `simplify` returns it.
            parts: The channels on the clock of the model.
            key: What determines the quiet samples; equal keys have equal ones.
        """
        early = {name: part.select_first(self._rows[name]) for name, part in parts.items()}
        late = {name: part.select_rows(slice(self._rows[name], None)) for name, part in parts.items()}
        has_both = all(len(part.times_s) for part in (*early.values(), *late.values()))
        if experiment.begin is None or not self._ticks or not has_both:
            return None
        if self._find_end(early) * TICK_RATE_HZ > min(_command_ticks(experiment), default=math.inf):
            return None
        values, begin = keep_recent(
            self._kept, key, _MAX_LEAD_INS, lambda: self._predict_early(experiment, early, late)
        )  # fmt: skip
        if begin is None:
            return None
        found = predict(replace(experiment, begin=begin), late)
        return replace(found, values={name: np.concatenate([values[name], found.values[name]]) for name in values})

    def _find_end(self, early: dict[str, Measured]) -> float:
        """Return the end of the run that shows the quiet samples [s]."""
        return last_needed_s(early) + (_POLYNOMIAL_ROWS + 1) * self._ticks / TICK_RATE_HZ

    def _predict_early(
        self, experiment: Experiment, early: dict[str, Measured], late: dict[str, Measured]
    ) -> tuple[dict[str, np.ndarray], MotionStart | None]:
        """Return the quiet samples, and a start from which the later ones are settled, if both are possible."""
        settled_s = min(float(part.times_s[0]) for part in late.values())
        start_s = min(settled_s - _settling_s(late), last_needed_s(early))  # there may be a gap between them
        grid = math.lcm(_QUIET_GRID_TICKS, TICK_RATE_HZ // experiment.scene.sensors.truth_rate_hz)
        tick = math.floor(start_s * TICK_RATE_HZ / grid) * grid
        if experiment.begin is None or tick < experiment.begin.tick:
            return {}, None
        scene = experiment.scene
        sensors = scene.sensors.model_copy(update={"rate_hz": TICK_RATE_HZ // self._ticks})
        scene = scene.model_copy(update={"sensors": sensors, "duration_s": self._find_end(early)})
        found = predict(replace(experiment, scene=scene), early)
        row = (tick - experiment.begin.tick) * found.truth_rate_hz // TICK_RATE_HZ
        begin = MotionStart(tick, state=tuple(found.truth["state"][row].tolist())) if not found.contacts else None
        return found.values, begin


def simplify(experiment: Experiment) -> Experiment:
    """Return the experiment with one cheap, fault-free sensor group and no companion, at the same row spacing."""
    if experiment.scene.generator is not None:
        return experiment
    groups = (experiment.scene.channels or rig_table()).groups.values()
    fewest = min(groups, key=lambda group: len(group.channels))
    row_ticks = experiment.simulation().row_ticks
    return experiment.without_faults().with_changes(
        {
            "engine.companion": False,
            "engine.limits": {},
            "engine.tolerance": min(experiment.scene.engine.tolerance, _LOG_TOLERANCE if experiment.imported else 1.0),
            "sensors.groups": [fewest.name],
            "sensors.chain": "ideal",
            "sensors.rate_hz": TICK_RATE_HZ // (min(row_ticks, _LOG_ROW_TICKS) if experiment.imported else row_ticks),
        }
    )
