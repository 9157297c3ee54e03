"""Nuisance parameters of an imported log: clock, shaft angle, speed, and force of the hammer pulse.

A recording of this rig has these values exactly. For an imported log they are fitted together with the requested
values, so that they neither bias these nor appear as an error of the model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from recorder.reader import Recording
from replays.estimate.intervals import draw_normal, format_with_half_width
from replays.estimate.spectra import NoiseSpectrum
from replays.recordings.identification.agreement import (
    MAX_PRIOR_DEVIATION,
    ChannelState,
    approach,
    evaluate,
    jackknife_half_widths,
    rms,
    search_restarts,
    signal_sizes,
    solve_weighted,
    split_channels,
    subtract_mean,
)
from replays.recordings.identification.request import first_command_s, fit_unit, observe
from replays.recordings.resimulation.experiment import PICKUP_S, Experiment
from replays.recordings.resimulation.noise import foreseeable_s, with_spectra
from replays.recordings.resimulation.prediction import Measured, Prediction, read_measured
from replays.recordings.resimulation.sensitivity import (
    ANGLE,
    PHASE,
    SCAN,
    STATE,
    Predictor,
    get_scale,
    get_value,
    to_model_clock,
    with_values,
)
from rig.base.errors import InputError, Words
from rig.run.simulation import TICK_RATE_HZ

NUISANCES = (
    "clock.offset_s",
    "clock.rate_ppm",
    ANGLE,
    *STATE,
    "drive.speed_hz",
    "hammer.1.force_n",
    "hammer.1.duration_ms",
    "ring.offset_x",
    "ring.offset_y",
)
"""Nuisance parameters. Clock and angle replace the time of the first pulse, as a simulation has pulses only at its
ticks."""
_PULSE, _RATE, _SPEED = "hammer.1.at_s", "clock.rate_ppm", "drive.speed_hz"
_DEVIATIONS = {"clock.rate_ppm": 50.0, "clock.offset_s": 1e-4, SCAN: 10.0, "ring.offset_x": 0.1, "ring.offset_y": 0.1}
"""Prior standard deviations: of a crystal [ppm], of a trigger found in filtered samples [s], of a scanner [us], and of
a ring that was positioned by hand [mm]."""
_RELATIVE = {"drive.speed_hz": 1e-4, "hammer.1.duration_ms": 0.01}
"""Relative prior standard deviations of a speed and a pulse length read from the log; `Experiment.unsure` has those of
less certain values."""
_MAX_SPEED_MISMATCH = 0.2
"""Largest relative difference of two instruments that measure the same speed."""
_PRIOR_WIDENING = 100.0
"""Factor by which a prior is widened if the value is at its limit, to find the value that the samples prefer."""
_EDGES_LENGTH_S = 3.0
"""Length of the record of edges before the hammer pulse that gives the speed [s]."""
_MIN_LENGTH_S = 0.02
_SETTLING_S = 0.01
"""Time after the start of the samples in which filters still show their initial state [s]."""
_MARGIN_S = 2e-3
"""Gap before the hammer pulse, whose time is not known exactly [s]."""
_FULL_RATE_S, _DECIMATION = 0.03, 8
"""Time before the hammer pulse from which samples are kept [s], and the decimation factor of earlier ones, which only
determine the state of the shaft."""
_WINDOWS_S = (4e-3, 8e-3, 13e-3, 20e-3, 30e-3)
"""Lengths of the fit windows from the start of the hammer pulse [s]."""
_START_STEPS = 2
"""Steps of the rough fit before the noise is measured."""
_MIN_GROWTH_S = 1.6e-3
"""Growth of the window up to which it is halved if residuals grow [s]."""
_MAX_HALVINGS = 8
"""Largest number of windows that are halved; each costs a fit."""
_COUNTED_GROWTHS = 2
"""Last growths of the window whose changes of the values represent the error of the model."""
_SEARCH_S = 5e-3
"""Range around the logged time in which the pulse is searched if the channels disagree [s]."""
_MAX_RMS_GROWTH = 1.2
"""Growth of a channel's residual, in a third of the channels, at which a longer window is rejected."""
_FAULTY_RMS = 10.0
"""Residual over noise from which a channel counts as faulty."""


@dataclass(frozen=True)
class Fitted:
    """Fitted value: start, result and half of its 95 % interval, in its unit.

    The interval includes the noise, the last changes of the value as the window grew, and a jackknife.
    """

    key: str
    start: float
    value: float
    half_width: float
    prior: tuple[float, float] | None = None
    """Mean and standard deviation of the prior."""
    scale: float = math.inf
    """Size of a unit change; an interval this wide contains no information."""

    @property
    def is_determined(self) -> bool:
        """True if the samples or a prior determine the value."""
        return self.prior is not None or self.half_width < 0.5 * self.scale

    @property
    def beyond(self) -> bool:
        """True if the value is at the limit that its prior allows, or if there should be none."""
        return self.key == SCAN or _is_beyond(self.value, self.prior)

    @property
    def contradicts_prior(self) -> bool:
        """True if the value is beyond its prior, and its interval does not contain the mean of the prior."""
        return self.beyond and (self.prior is None or abs(self.value - self.prior[0]) > self.half_width)

    @property
    def is_at_limit(self) -> bool:
        """True if the value is beyond its prior, but its interval contains the mean: the log does not determine it."""
        return self.beyond and not self.contradicts_prior

    @property
    def line(self) -> str:
        """The result in words."""
        if self.key == "clock.offset_s":
            return f"time: shifted by {self.value * 1e6:+.1f} ±{1.0e6 * self.half_width:.2g} µs, fitted"
        if self.key == _PULSE:
            late = 1e6 * (self.value - self.start)
            return f"time: hammer pulse shifted by {late:+.1f} ±{1e6 * self.half_width:.2g} µs, fitted"
        if self.key == "clock.rate_ppm":
            return f"clock: {self.value:+.1f} ±{self.half_width:.2g} ppm fast, fitted"
        if self.key == SCAN:
            size = f"{self.value:+.3g} ±{self.half_width:.2g} µs"
            return f"scanner: each channel is sampled {size} after the one before it in the mapping, fitted"
        if self.key == ANGLE:
            off = math.degrees(self.value - (self.prior[0] if self.prior else 0.0))
            text = f"{off:+.3g} ±{math.degrees(self.half_width):.2g} degrees"
            if self.prior is None:
                return f"shaft angle: {text}, fitted; not compared (needs edges and [keyphasor] angle_deg)"
            return f"keyphasor mark: {text} from angle_deg, or from {PHASE}, fitted"
        unit = fit_unit(self.key)
        text = f"{format_with_half_width(self.value, self.half_width)}{f' {unit}' * (unit not in ('', '1'))}"
        change = self.value - self.start
        return f"{self.key}: {text}, fitted (changed by {change:+.3g} from the start value {self.start:.6g})"


def _is_beyond(value: float, prior: tuple[float, float] | None) -> bool:
    return prior is not None and abs(value - prior[0]) > 0.99 * MAX_PRIOR_DEVIATION * prior[1]


@dataclass(frozen=True)
class Tuned:
    """Imported log with its fitted experiment.

    Attributes:
        baseline: Experiment before the fit.
        experiment: Experiment with the fitted values; those of a hammer pulse are rounded to rows.
        fitted: Fitted values with their intervals.
        values: Fitted values by key.
        covariance: Covariance of the values, shape (values, values).
        moves: Changes of the values at the last growths of the window, shape (growths, values); they represent the
            error of the model.
        growths: The same if the parts of a growth that was divided count as one, as each may be small.
        about_s: Time at which the clocks differ by the offset alone [s].
        end_s: End of the samples of the fit [s].
        longest_s: End of the samples if the model had explained all of them [s].
        parted_s: Time from which equally valid models differ, where the fit ends [s]; infinite if there is none.
        scales: Residual rms over noise of each channel, at least 1.
        spectra: Spectrum of the noise of each channel that is not white, by name.
        parts: Samples of the fit.
    """

    baseline: Experiment
    experiment: Experiment
    fitted: tuple[Fitted, ...]
    values: dict[str, float]
    covariance: np.ndarray
    moves: np.ndarray
    growths: np.ndarray
    about_s: float
    end_s: float
    longest_s: float
    parted_s: float
    scales: dict[str, float]
    spectra: dict[str, NoiseSpectrum]
    parts: dict[str, Measured] = field(repr=False)

    def to_model_clock(self, parts: dict[str, Measured]) -> dict[str, Measured]:
        """Return channels of the log on the model's clock."""
        return to_model_clock(parts, self.values, about_s=self.about_s)

    def is_better_than(self, other: Tuned) -> bool:
        """Return whether this fit explains a longer window, or an equal one with smaller residuals."""
        own, its = (sum(math.log(scale) for scale in one.scales.values()) for one in (self, other))
        return (self.end_s, -own) > (other.end_s, -its)

    def with_changes(self, changes: dict[str, Any]) -> Tuned:
        """Return the same values with another model."""
        return replace(self, baseline=self.baseline.with_changes(changes))

    def undo_last_growth(self) -> Tuned:
        """Return the values before the last growth of the window, which were equally valid on that window."""
        moved = zip(self.values.items(), self.moves[-1].tolist(), strict=True)
        return replace(self, values=_restrict(self.baseline, {key: value - by for (key, value), by in moved}))

    def draw_values(self, generator: np.random.Generator) -> Tuned:
        """Return values drawn from the uncertainty of the fit and of the model."""
        off = draw_normal(self.covariance, generator, 1)[0]
        off += generator.standard_normal(len(self.moves)) @ self.moves
        moved = {key: value + d for (key, value), d in zip(self.values.items(), off.tolist(), strict=True)}
        return replace(self, values=_restrict(self.baseline, moved))

    def predict(self, parts: dict[str, Measured]) -> Prediction:
        """Return the prediction of channels of the log, on its own clock."""
        predictor = Predictor(self.baseline, tuple(self.values), parts, about_s=self.about_s)
        return predictor.predict(tuple(self.values.values()))


def find_nuisances(
    experiment: Experiment, keys: Sequence[str] = NUISANCES, *, excluded: Sequence[str] = ()
) -> dict[str, tuple[float, float] | None]:
    """Return the nuisance parameters of an experiment with their priors: mean and standard deviation, or None.

    Args:
        experiment: The experiment.
        keys: Candidate keys.
        excluded: Requested keys.
    """
    if experiment.begin is None:  # the scene started with the recording: the pulse is shifted, not the clock
        keys = [_PULSE if key == "clock.offset_s" else key for key in keys]
    priors: dict[str, tuple[float, float] | None] = {}
    for key in keys:
        if key in excluded:
            continue
        try:
            value = get_value(experiment, key)
        except InputError:
            continue  # no hammer pulse
        if key == ANGLE and (mark := experiment.mark) is not None:
            priors[key] = (value + math.remainder(mark[0] - value, 2.0 * math.pi), mark[1])
            continue
        deviation = experiment.unsure.get(key) or _DEVIATIONS.get(key) or _RELATIVE.get(key, 0.0) * abs(value)
        priors[key] = (value, deviation) if deviation else None
    return priors


def fit_initial_state(recording: Recording, experiment: Experiment) -> Experiment:
    """Return the experiment with speed, angle and position of the shaft fitted before the hammer pulse.

    Small motions are a superposition: free motion from the initial state, and the response to unbalance as a cosine and
    a sine. They are fitted by least squares over a few turns, with channels weighted by their residuals.

    Raises:
        InputError: The channels do not show the position of the shaft.
    """
    first_s = _pulse_time_s(experiment)
    experiment = _with_edge_speed(recording, experiment)
    start_s, end_s = window_start_s(experiment), first_s - _MARGIN_S
    if end_s - start_s < _MIN_LENGTH_S:
        return experiment
    parts = observe(recording, experiment, window=(start_s, end_s)).parts
    keys = (*(STATE if experiment.begin is not None else ()), ANGLE)
    predictor = Predictor(experiment, keys, parts)

    def shown(values: Sequence[float] | np.ndarray) -> list[np.ndarray]:
        solution = predictor.predict(np.asarray(values)).values
        return [one for one, _ in split_channels(parts, solution)]

    still = np.zeros(len(keys))
    still[: len(keys) - 1] = predictor.start[:-1]
    ahead, behind, beside = (shown([*still[:-1], angle]) for angle in (0.0, math.pi, math.pi / 2.0))
    moved = [shown(still + step) for step in np.diag(predictor.scales)[:-1]]
    middle = [(a + b) / 2.0 for a, b in zip(ahead, behind, strict=True)]
    target, columns = [], []
    for c, (measured, floor) in enumerate(split_channels(parts, {name: part.values for name, part in parts.items()})):
        slopes = [(ahead[c] - behind[c]) / 2.0, beside[c] - middle[c], *(one[c] - ahead[c] for one in moved)]
        # The zero of a probe is unknown, so the mean of each channel is removed.
        target.append(subtract_mean(measured - middle[c]) / floor)
        columns.append(subtract_mean(np.column_stack(slopes)) / floor)
    solution = solve_weighted(target, columns, signal_sizes(parts))
    moves = np.array([*solution[2:], 0.0]) * predictor.scales
    clearance_mm = get_value(experiment, "ring.clearance")
    if experiment.begin is not None and math.hypot(*moves[:2]) > 2.0 * clearance_mm:
        names = ", ".join(name for part in parts.values() for name in part.names)
        must = "a log that shows the position of the shaft before the hammer pulse, as a pair of probes does"
        raise InputError("file", must, Words(f"{recording.path} with {names}"))
    values = dict(zip(keys, (still + moves).tolist(), strict=True))
    return with_values(experiment, values | {ANGLE: math.atan2(solution[1], solution[0])})


def _with_edge_speed(recording: Recording, experiment: Experiment) -> Experiment:
    """Return the experiment at the speed of the keyphasor's edges, which needs no calibration; unchanged without edges.

    If edges and tachometer disagree, the speed with the stronger motion of the probes is used.
    """
    first_s, tachometer_hz = first_command_s(experiment) or math.inf, experiment.scene.drive.speed_hz
    edges_s = recording.edges()
    edges_s = edges_s[edges_s < first_s]
    edges_s = edges_s[edges_s > edges_s[-1:].sum() - _EDGES_LENGTH_S] if len(edges_s) else edges_s
    if len(edges_s) < 3 or experiment.scene.drive.profile:
        return experiment
    steps = np.diff(edges_s)
    turns = np.rint(steps / np.median(steps)).sum()  # one step is two turns if an edge is missing
    speed_hz = float(turns / (edges_s[-1] - edges_s[0]))
    if abs(speed_hz - tachometer_hz) > _MAX_SPEED_MISMATCH * tachometer_hz > 0.0:
        parts = observe(recording, experiment, window=(window_start_s(experiment), first_s - _MARGIN_S)).parts
        speed_hz = max(speed_hz, tachometer_hz, key=lambda hz: _compute_power(parts, hz))
    return with_values(experiment, {"drive.speed_hz": speed_hz})


def _compute_power(parts: Mapping[str, Measured], speed_hz: float) -> float:
    """Return the power of the channels at a speed over their noise, without mean and drift."""
    power = 0.0
    for part in parts.values():
        turning = np.exp(2j * math.pi * speed_hz * part.times_s) * np.hanning(len(part.times_s))
        power += float(np.sum(np.abs(turning @ (subtract_mean(part.values) / part.floor)) ** 2)) / len(part.times_s)
    return power


def find_free_nuisances(experiment: Experiment, keys: Sequence[str]) -> dict[str, tuple[float, float] | None]:
    """Return the nuisance parameters of an imported log that a general search can fit.

    The length of a hammer pulse changes only in whole rows of the simulation, and the speed is known.
    """
    few = tuple(key for key in NUISANCES if key not in ("drive.speed_hz", "hammer.1.duration_ms"))
    return find_nuisances(experiment, few, excluded=keys)


def tune(
    recording: Recording,
    experiment: Experiment,
    keys: Sequence[str] = NUISANCES,
    *,
    priors: Mapping[str, tuple[float, float] | None] | None = None,
    channels: Sequence[str] | None = None,
    to_s: float | None = None,
    late_s: Mapping[str, float] | None = None,
    variants: Sequence[dict[str, Any]] = (),
    progress: Callable[[str], None] = lambda _text: None,
) -> Tuned:
    """Fit the nuisance parameters of a log in windows that grow from the pulse, until equally valid models differ.

    Channels are weighted by their residuals, so that a faulty one has little influence. No value leaves
    `MAX_PRIOR_DEVIATION` standard deviations of its prior.

    Args:
        recording: The log.
        experiment: Experiment, as far as it is known.
        keys: Keys to fit.
        priors: Additional keys and their priors: means and standard deviations; None fits a key without a prior.
        channels: Channels to use; None for all.
        to_s: End of the used samples [s].
        late_s: Assumed delay of some channels [s].
        variants: Changes that make equally valid models.
        progress: Callback for the current step.

    Raises:
        InputError: There are no samples, or none before the pulse.
    """
    progress("speed, angle and position of the shaft before the hammer pulse")
    held = experiment.mark if PHASE in keys and ANGLE not in keys else None  # the phase of unbalance instead
    baseline = fit_initial_state(recording, experiment) if ANGLE in keys or held else experiment
    baseline = replace(baseline, angle=held[0]) if held else baseline
    wanted = find_nuisances(baseline, keys) | dict(priors or {})
    first_s = _pulse_time_s(baseline)
    if first_s <= window_start_s(baseline):
        must = (
            f"a log that begins more than {1e3 * _SETTLING_S:g} ms before the hammer pulse, for the state of the shaft"
        )
        raise InputError("file", must, Words(f"{recording.path}, with the pulse at {first_s:.4g} s"))
    end_s = min(first_s + _WINDOWS_S[-1], math.inf if to_s is None else to_s)
    whole = observe(recording, baseline, channels=channels, window=(window_start_s(baseline), end_s)).parts
    whole = {name: part.remove_delays(late_s or {}) for name, part in whole.items()}
    whole = _with_spectra(recording, baseline, whole, end_s=first_s - _MARGIN_S)
    whole = {name: _decimate(part, first_s - _FULL_RATE_S) for name, part in whole.items()}
    start = None
    if not set(wanted) <= set(NUISANCES):  # the motion due to a wrong value of the model is not noise
        start = _find_start(baseline, wanted, whole)
        values = dict(zip(wanted, start.tolist(), strict=True))
        whole = _with_spectra(recording, baseline, whole, end_s=first_s - _MARGIN_S, values=values)
    fit = _fit_best(baseline, wanted, whole, variants, progress, start=start)
    if max(fit.scales) > _FAULTY_RMS and (early := _with_earlier_pulse(baseline, whole)) is not None:
        other = _fit_windows(early, wanted, whole, variants, progress, by_residuals=True, without=("hammer",))
        if other.rank() > fit.rank():
            baseline, fit = early, other
    far = [key for key, value in zip(wanted, fit.values, strict=True) if _is_beyond(float(value), wanted[key])]
    timed = get_value(baseline, _SPEED) != get_value(experiment, _SPEED)  # by edges, thus on the recorder's clock
    if _RATE in far and timed and wanted.get(_SPEED):
        far = list(dict.fromkeys([*far, _SPEED]))
    if far:
        widened = wanted | {key: (one[0], _PRIOR_WIDENING * one[1]) for key in far if (one := wanted[key]) is not None}
        fit = max(fit, _fit_best(baseline, widened, whole, variants, progress), key=_WindowFit.rank)
    half = np.hypot(1.96 * np.sqrt(np.diag(fit.covariance) + np.mean(fit.moves**2, axis=0)), fit.jackknife)
    fitted = dict(zip(wanted, fit.values.tolist(), strict=True))
    if _RATE in fitted and timed and (known := wanted.get(_SPEED)):
        wanted[_SPEED] = known[0] * (1.0 + 1e-6 * fitted[_RATE]), known[1]
    # A prior keeps its width, around the prior mean.
    prior_widths = [1.96 * math.hypot(one[1], fitted[key] - one[0]) if one else math.inf for key, one in wanted.items()]
    return Tuned(
        baseline=baseline,
        experiment=with_values(baseline, fitted),
        fitted=tuple(
            Fitted(key, get_value(experiment, key), value, width, wanted[key], get_scale(baseline, key))
            for (key, value), width in zip(fitted.items(), np.minimum(half, prior_widths).tolist(), strict=True)
        ),
        values=fitted,
        covariance=fit.covariance,
        moves=fit.moves,
        growths=fit.growths,
        about_s=min(float(part.times_s[0]) for part in whole.values()),
        end_s=fit.end_s,
        longest_s=end_s,
        parted_s=fit.parted_s,
        scales=dict(zip((name for part in whole.values() for name in part.names), fit.scales, strict=True)),
        spectra={name: one for part in whole.values() for name, one in part.named_spectra if one is not None},
        parts={name: part.select_until(fit.end_s) for name, part in whole.items()},
    )


def _with_spectra(
    recording: Recording,
    experiment: Experiment,
    parts: dict[str, Measured],
    *,
    end_s: float,
    values: Mapping[str, float] | None = None,
) -> dict[str, Measured]:
    """Return parts with the spectra of their noise, from all samples of a log before an end [s].

    Differences from the model with the given values of the experiment count as noise.
    """
    if not experiment.imported:
        return parts  # the noise of the rig itself is white
    every = read_measured(recording, experiment.scene)
    quiet = {
        name: replace(every[name].select_channels(part.names), floor=part.floor, random=part.random)
        .select_from(window_start_s(experiment))
        .select_until(end_s)
        for name, part in parts.items()
    }
    if not all(len(part.times_s) for part in quiet.values()):
        return parts
    values, about_s = values or {}, min(float(part.times_s[0]) for part in parts.values())
    predictor = Predictor(experiment, tuple(values), quiet, about_s=about_s)
    quiet = with_spectra(quiet, predictor.predict(tuple(values.values())).values)
    return {name: replace(part, spectra=quiet[name].spectra) for name, part in parts.items()}


def _restrict(experiment: Experiment, values: dict[str, float]) -> dict[str, float]:
    """Return values that the model accepts; others, far off where the log has little information, keep their start."""
    try:
        with_values(experiment, values)
    except InputError:
        if len(values) == 1:
            return {key: get_value(experiment, key) for key in values}
        each = (_restrict(experiment, {key: value}) for key, value in values.items())
        return {key: value for one in each for key, value in one.items()}
    return values


@dataclass(frozen=True)
class _WindowFit:
    """Values fitted on the longest window that they explain.

    Attributes:
        values: Fitted values, shape (keys,).
        covariance: Covariance of the values, shape (keys, keys).
        moves: Changes at the last growths of the window, shape (growths, keys).
        growths: The same if the parts of a divided growth count as one.
        end_s: End of the window [s].
        scales: Residual rms over noise of each channel, at least 1.
        jackknife: Half of 95 % intervals by a jackknife, shape (keys,).
        parted_s: Time from which equally valid models differ [s]; infinite if there is none.
    """

    values: np.ndarray
    covariance: np.ndarray
    moves: np.ndarray
    growths: np.ndarray
    end_s: float
    scales: list[float]
    jackknife: np.ndarray
    parted_s: float

    @property
    def median_scale(self) -> float:
        """Median over the channels of the residual over noise."""
        return float(np.median(self.scales))

    def rank(self) -> tuple[float, float]:
        """Return the rank of the fit: a longer window first, then smaller residuals."""
        return self.end_s, -sum(map(math.log, self.scales))


def _prepare(
    baseline: Experiment, wanted: Mapping[str, tuple[float, float] | None], parts: dict[str, Measured]
) -> tuple[Predictor, np.ndarray]:
    """Return the predictor of a window, and means and standard deviations of the priors, shape (2, keys)."""
    predictor = Predictor(baseline, tuple(wanted), parts, quiet_until_s=_pulse_time_s(baseline) - _FULL_RATE_S)
    # Without a prior, a value is held so weakly that only one without any effect keeps its start.
    loose = zip(predictor.start, predictor.scales, strict=True)
    return predictor, np.array([prior or held for prior, held in zip(wanted.values(), loose, strict=True)]).T


def _find_start(
    baseline: Experiment, wanted: Mapping[str, tuple[float, float] | None], whole: dict[str, Measured]
) -> np.ndarray:
    """Return values that fit the first window roughly, shape (keys,)."""
    end_s = _pulse_time_s(baseline) + _WINDOWS_S[0]
    predictor, priors = _prepare(baseline, wanted, {name: part.select_until(end_s) for name, part in whole.items()})
    every = [True for part in whole.values() for _ in part.names]
    return approach(predictor, predictor.start, priors, by_residuals=False, enabled=every, steps=_START_STEPS)[0]


def _fit_best(
    baseline: Experiment,
    wanted: dict[str, tuple[float, float] | None],
    whole: dict[str, Measured],
    variants: Sequence[dict[str, Any]],
    progress: Callable[[str], None],
    *,
    start: np.ndarray | None = None,
) -> _WindowFit:
    """Return the best of several fits; if channels disagree, also fit by the majority, with and without the hammer."""
    best = _fit_windows(baseline, wanted, whole, variants, progress, by_residuals=False, start=start)
    for without in ((), ("hammer",)):
        early = without and best.end_s <= _pulse_time_s(baseline) + _WINDOWS_S[0]  # its own time
        if early or (max(best.scales) > _FAULTY_RMS and (best.median_scale > _FAULTY_RMS or not without)):
            other = _fit_windows(baseline, wanted, whole, variants, progress, by_residuals=True, without=without)
            best = max(best, other, key=_WindowFit.rank)
    return best


def _with_earlier_pulse(baseline: Experiment, whole: dict[str, Measured]) -> Experiment | None:
    """Return the experiment with the pulse at the time that most channels show; None if that of the hammer is best."""
    if not (first_s := first_command_s(baseline)) or baseline.begin is None:
        return None
    # Earlier samples do not depend on the time of the pulse.
    low_s, high_s = first_s - _SEARCH_S, first_s + _WINDOWS_S[0]
    parts = {name: part.select_until(high_s).select_from(low_s) for name, part in whole.items()}
    predictor, at_s = Predictor(baseline, (_PULSE,), parts), get_value(baseline, _PULSE)

    def misfit(late_s: float) -> float:
        here = evaluate(predictor, np.array([at_s + late_s]))
        return math.inf if here is None else sum(math.log(max(1.0, rms(z))) for z in here.apart)

    late_s = min(np.linspace(-_SEARCH_S, _SEARCH_S, 41).tolist(), key=misfit)
    return with_values(baseline, {_PULSE: at_s + late_s}) if misfit(late_s) < misfit(0.0) else None


def _fit_windows(
    baseline: Experiment,
    wanted: dict[str, tuple[float, float] | None],
    whole: dict[str, Measured],
    variants: Sequence[dict[str, Any]],
    progress: Callable[[str], None],
    *,
    by_residuals: bool,
    without: Sequence[str] = (),
    start: np.ndarray | None = None,
) -> _WindowFit:
    """Fit in windows that grow from the pulse.

    Args:
        baseline: Experiment before the fit.
        wanted: Keys to fit, with their priors.
        whole: The samples.
        variants: Changes that make equally valid models; where these differ, the fit ends.
        progress: Callback for the current step.
        by_residuals: Weight channels by their residuals from the first step on, starting from the logged values.
        without: Channels that are not used.
        start: Start of the search, shape (keys,); None: the values of the experiment.
    """
    first_s, every = _pulse_time_s(baseline), [name not in without for part in whole.values() for name in part.names]
    values = np.array([get_value(baseline, key) for key in wanted]) if start is None else start
    covariance, end_s, scales, moves = np.eye(len(values)), first_s, list[float](), [np.zeros(len(values))]
    jackknife, rows, parted_s = np.zeros(len(values)), list[int](), math.inf
    lengths, last_s, halvings, undivided = list(_WINDOWS_S), 0.0, 0, 0.0
    growths, grown = [values - values], values
    while lengths:
        length = lengths.pop(0)
        progress(f"{len(wanted)} values, to {first_s + length:.4f} s of {first_s + _WINDOWS_S[-1]:.3f} s")
        parts = {name: part.select_until(first_s + length) for name, part in whole.items()}
        predictor, priors = _prepare(baseline, wanted, parts)

        def fitted(start: np.ndarray) -> tuple[np.ndarray, ChannelState, list[float]]:
            fit, here = approach(predictor, start, priors, by_residuals=by_residuals, enabled=every)  # noqa: B023
            enabled = select_sound([rms(z) if has else math.inf for z, has in zip(here.apart, every, strict=True)])
            if enabled != every:
                fit, here = approach(predictor, fit, priors, by_residuals=True, enabled=enabled)  # noqa: B023
            return fit, here, [max(1.0, rms(z)) for z in here.apart]

        fit, here, now = fitted(values)
        if variants and (here_s := _find_parting(baseline, predictor, fit, variants)) is not None:
            variants, parted_s = (), here_s
            if parted_s > first_s + last_s:  # later samples must not bend the motion before it
                lengths = [parted_s - first_s]
                continue
            if scales:
                break
        unseen = [
            place for place, key in enumerate(wanted)
            if key not in NUISANCES and covariance[place, place] > 0.25 * priors[1, place] ** 2
        ]  # fmt: skip
        worse = any(b > _MAX_RMS_GROWTH * a for a, b in zip(scales, now, strict=False))
        if worse and not unseen and length - last_s > _MIN_GROWTH_S and halvings < _MAX_HALVINGS:
            halvings += 1
            lengths = [0.5 * (last_s + length), length, *lengths]  # the step was too long for a linear model
            undivided = max(undivided, length)
            continue
        if scales and unseen and _is_worse(now, scales):
            fit, here, now = fitted(search_restarts(predictor, values, unseen, every))
        # Sharp signals of a contact that the model does not explain must not bend the motion before it.
        early = [max(1.0, rms(z[:n])) for z, n in zip(here.apart, rows, strict=False)]
        if _is_worse(now, scales) or any(b > _MAX_RMS_GROWTH * a for a, b in zip(scales, early, strict=False)):
            break  # the model does not explain the longer window, which is for the judgement to report
        scales, rows, last_s = now, [len(z) for z in here.apart], length
        square = sum(one.T @ one / scale**2 for one, scale in zip(here.slopes, scales, strict=True))
        moves.append(fit - values)
        growths[-1] = fit - grown
        if length >= undivided:
            growths, grown = [*growths, fit - fit], fit
        covariance, values = np.linalg.inv(square + np.diag(priors[1] ** -2.0)), fit
        times = [part.times_s for part in parts.values() for _ in part.names]
        before = np.diag(priors[1] ** -2.0), np.zeros(len(values))
        end_s, jackknife = first_s + length, jackknife_half_widths(here, times, scales, before, first_s)
    growths = [one for one in growths if one.any()][-_COUNTED_GROWTHS:] or growths
    last = np.array(moves[-_COUNTED_GROWTHS:]), np.array(growths)
    return _WindowFit(values, covariance, *last, end_s, scales, jackknife, parted_s)


def _find_parting(
    baseline: Experiment, predictor: Predictor, values: np.ndarray, variants: Sequence[dict[str, Any]]
) -> float | None:
    """Return the time from which equally valid models differ [s]; None if there is no such time."""
    nominal = predictor.predict(values)
    if not nominal.contacts:
        return None
    wanted = dict.fromkeys(predictor.keys)
    models = (_prepare(baseline.with_changes(changes), wanted, predictor.parts)[0] for changes in variants)
    return foreseeable_s(predictor.parts, nominal, [model.predict(values) for model in models], share=1.0)


def select_sound(scales: Sequence[float]) -> list[bool]:
    """Return a mask without faulty channels, if they are a minority, by the residuals over the noise.

    Even a small weight of a faulty channel would move values that no other channel shows.
    """
    sound = [scale <= _FAULTY_RMS for scale in scales]
    return sound if sum(sound) > len(sound) / 2.0 else [True] * len(sound)


def _is_worse(now: list[float], before: list[float]) -> bool:
    """Return whether residuals have grown on a longer window."""
    worse = [b / a for a, b in zip(before, now, strict=False) if b > _MAX_RMS_GROWTH * a]
    return 2 * len(worse) > len(now) or 3 * sum(times < _FAULTY_RMS for times in worse) > len(now)


def _pulse_time_s(experiment: Experiment) -> float:
    """Return the time of the first hammer pulse, else the end of the initial interval [s]."""
    return first_command_s(experiment) or window_start_s(experiment) + PICKUP_S


def window_start_s(experiment: Experiment) -> float:
    """Return the start of the samples before the hammer pulse that are used [s]."""
    begin_s = experiment.first_s if experiment.begin is None else experiment.begin.tick / TICK_RATE_HZ + _SETTLING_S
    return max(begin_s, first_command_s(experiment) - PICKUP_S)


def _decimate(part: Measured, until_s: float) -> Measured:
    """Return all rows from a time on, and decimated rows before it."""
    rows = np.arange(len(part.times_s))
    return part.select_rows(np.flatnonzero((part.times_s >= until_s) | (rows % _DECIMATION == 0)))
