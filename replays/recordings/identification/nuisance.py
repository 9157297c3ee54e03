"""What a log of another system does not tell exactly: its clock, the shaft's angle, the speed, the force of the pulse.

A recording of this rig has all of that to the tick. Of an imported log it is fitted along with whatever is asked, so
that it neither spoils other values nor passes for a fault of the model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from recorder.reader import Recording
from replays.recordings.experiment import Experiment
from replays.recordings.identification.question import first_command_s, observe
from replays.recordings.least_squares import Fit, fit
from replays.recordings.prediction import Measured, Prediction
from replays.recordings.sensitivity import ANGLE, Predictor, on_the_models_clock, value_of, with_values
from rig.errors import InputError, Words

NUISANCES = (
    "clock.offset_s",
    "clock.rate_ppm",
    ANGLE,
    "drive.speed_hz",
    "hammer.1.force_n",
    "hammer.1.duration_ms",
)
"""In place of the time of the first pulse stand clock and angle: a simulation has pulses only at its own rows."""
_PULSE = "hammer.1.at_s"
_DEVIATIONS = {"clock.rate_ppm": 50.0}
"""What is known before: the standard deviation of a crystal, in ppm; ..."""
_RELATIVE = {"drive.speed_hz": 1e-4}
"""... and of a speed read off the log, as a part of it."""
_ANGLES = 8
_ROUNDS = 2
_LOOK_S = 0.5
"""So much before the hammer pulse tells angle and speed [s] ..."""
_MARGIN_S = 2e-3
"""... up to here, as the time of the hammer pulse is not known better ..."""
_BEFORE_S = 0.03
"""... and so much of it is in the fit of all [s]."""
_WINDOWS_S = (6e-3, 9e-3, 13e-3, 20e-3, 30e-3)
"""How far behind the begin of the hammer pulse the fits look [s]."""
_WORSE = 1.5
"""A longer window is given up where it leaves more by this factor."""


@dataclass(frozen=True)
class Fitted:
    """One fitted number: where it began, where it ended, and half of its 95 % interval, in its unit."""

    key: str
    start: float
    value: float
    half_width: float

    @property
    def line(self) -> str:
        """In words."""
        if self.key == "clock.offset_s":
            return f"time: shifted by {self.value * 1e6:+.1f} ±{1.0e6 * self.half_width:.2g} µs, fitted"
        if self.key == _PULSE:
            late = 1e6 * (self.value - self.start)
            return f"time: hammer pulse shifted by {late:+.1f} ±{1e6 * self.half_width:.2g} µs, fitted"
        if self.key == "clock.rate_ppm":
            return f"clock: {self.value:+.1f} ±{self.half_width:.2g} ppm fast, fitted"
        change = self.value - self.start
        return f"{self.key}: {self.value:.6g} ±{self.half_width:.2g}, fitted ({change:+.2g} on what the log tells)"


@dataclass(frozen=True)
class Tuned:
    """An imported log and its experiment, brought together.

    Attributes:
        begun: The experiment before the fit.
        experiment: With the fitted numbers, those of a hammer pulse as its rows can have them.
        fitted: What was fitted.
        values: The same, by key.
        perturbed: Values as far off as the fit leaves open, drawn once from what it says.
        about_s: Where the clocks differ by the offset alone [s].
        end_s: End of the samples that it rests on [s].
        chi2: Sum of squares of what is left over the noise, a sample.
    """

    begun: Experiment
    experiment: Experiment
    fitted: tuple[Fitted, ...]
    values: dict[str, float]
    perturbed: dict[str, float]
    about_s: float
    end_s: float
    chi2: float

    def on_time(self, parts: dict[str, Measured]) -> dict[str, Measured]:
        """Channels of the log on the model's clock."""
        return on_the_models_clock(parts, self.values, about_s=self.about_s)

    def predict(self, parts: dict[str, Measured], *, perturbed: bool = False) -> Prediction:
        """What is predicted for channels of the log, on its own clock; a hammer pulse may lie between two rows.

        Args:
            parts: The channels.
            perturbed: As far off as the fit leaves open.
        """
        values = self.perturbed if perturbed else self.values
        predictor = Predictor(self.begun, tuple(values), parts, about_s=self.about_s)
        return predictor.predict(tuple(values.values()))


def is_imported(recording: Recording) -> bool:
    """Whether a recording is a log of another system."""
    return "import" in recording.scene


def nuisances_of(
    experiment: Experiment, keys: Sequence[str] = NUISANCES, *, besides: Sequence[str] = ()
) -> dict[str, tuple[float, float] | None]:
    """Nuisances that an experiment has, and what is known of each before: mean and standard deviation, or None.

    Args:
        experiment: The experiment.
        keys: The nuisances.
        besides: What is asked anyway.
    """
    if experiment.first_s == 0.0:  # it has run from the scene's own start: the pulse is late, and not the clock
        keys = [_PULSE if key == "clock.offset_s" else key for key in keys]
    found: dict[str, tuple[float, float] | None] = {}
    for key in keys:
        if key in besides:
            continue
        try:
            value = value_of(experiment, key)
        except InputError:
            continue  # no hammer pulse
        deviation = _DEVIATIONS.get(key) or _RELATIVE.get(key, 0.0) * abs(value)
        found[key] = (value, deviation) if deviation else None
    return found


def turned(recording: Recording, experiment: Experiment) -> Experiment:
    """With the angle and the speed of the shaft that explain the motion before the first pulse best.

    The steady motion is a constant and a vector that turns along with the angle: a sum of squares over the angle is a
    constant, a cosine and a sine. From its least place on, a fit.
    """
    first_s = first_command_s(experiment)
    try:
        window = (first_s - _LOOK_S, first_s - _MARGIN_S) if first_s > 0.0 else (None, None)
        parts = observe(recording, experiment, window=window).parts
    except InputError:
        return experiment  # no samples before the hammer pulse
    predictor = Predictor(experiment, (ANGLE, "drive.speed_hz"), parts)
    speed_hz = float(predictor.start[1])
    angles = 2.0 * math.pi * np.arange(_ANGLES) / _ANGLES
    # What a probe's zero is, the angle does not tell: without each channel's mean.
    squares = np.array([np.sum(_residuals(predictor, (angle, speed_hz), centred=True) ** 2) for angle in angles])
    values = np.array([math.atan2(-squares @ np.sin(angles), -squares @ np.cos(angles)), speed_hz])
    for _ in range(_ROUNDS):
        z = _residuals(predictor, values, centred=True)
        # Where the model is wrong, its errors do not outweigh the speed that the log tells.
        weight = math.sqrt(float(z @ z) / len(z)) / (_RELATIVE["drive.speed_hz"] * max(speed_hz, 1e-3))
        values = _fit(
            predictor, values, predictor.start, weights=np.array([0.0, weight]), rounds=1, centred=True
        ).values
    return with_values(experiment, dict(zip(predictor.keys, values.tolist(), strict=True)))


def asked_along(experiment: Experiment, keys: Sequence[str]) -> dict[str, tuple[float, float] | None]:
    """Nuisances that are fitted along with what is asked of an imported log: those that a search can take.

    The speed is known before the hammer pulse, and the length of a hammer pulse only in rows of the simulation.
    """
    few = tuple(key for key in NUISANCES if key not in ("drive.speed_hz", "hammer.1.duration_ms"))
    return nuisances_of(experiment, few, besides=keys)


def check_begin(experiment: Experiment, to_s: float | None) -> None:
    """Refuse a search through the impacts of a log that begins in the middle of a run.

    Every simulation would have to run through the seconds before it, in which small errors of stiffness and unbalance
    turn the motion away from the recorded one before the first impact: minutes of search that end in a wrong valley.

    Args:
        experiment: What was done.
        to_s: Where the samples end [s]; None for the log's end.

    Raises:
        InputError: It is such a log, and the samples go beyond the first pulse.
    """
    hammer_s = first_command_s(experiment)
    if experiment.first_s > 0.0 and hammer_s > 0.0 and (to_s is None or to_s > hammer_s):
        must = "a log that begins with the run, at rest (lead_s = 0 in its mapping), to be fitted through impacts; of "
        must += f"one from the middle of a run, only what is before the hammer pulse: --to {hammer_s - _MARGIN_S:.3f}"
        raise InputError("file", must, Words(f"{experiment.first_s:g} s of the run are before its first sample"))


def shortly_before(experiment: Experiment) -> float | None:
    """Where the window of a search begins in an imported log [s]; None for its start."""
    first_s = first_command_s(experiment)
    return first_s - _BEFORE_S if first_s > 0.0 else None


def tune(
    recording: Recording,
    experiment: Experiment,
    keys: Sequence[str] = NUISANCES,
    *,
    progress: Callable[[str], None] = lambda _text: None,
) -> Tuned:
    """Fit what a log does not tell exactly, and nothing else, on windows that grow from the pulse.

    Args:
        recording: The log.
        experiment: What was done, as far as it is known.
        keys: What is fitted of it.
        progress: Told what is being done.

    Raises:
        InputError: There are no samples to do it by.
    """
    progress("angle and speed of the shaft before the hammer pulse")
    begun = turned(recording, experiment) if ANGLE in keys else experiment
    wanted = nuisances_of(begun, keys)
    first_s = first_command_s(begun)
    whole = observe(recording, begun, window=(max(0.0, first_s - _BEFORE_S), first_s + _WINDOWS_S[-1]))
    values = np.array([value_of(begun, key) for key in wanted])
    covariance, chi2, end_s = np.eye(len(values)), math.inf, first_s
    for length in _WINDOWS_S:
        progress(f"{', '.join(wanted)}: to {first_s + length:.3f} s")
        predictor = Predictor(begun, tuple(wanted), whole.parts_until(whole.until(first_s + length)))
        # Without a prior a value is held as loosely as makes no difference, so that what is not seen stays.
        loose = zip(predictor.start, predictor.scales, strict=True)
        known = [prior or held for prior, held in zip(wanted.values(), loose, strict=True)]
        means, deviations = np.array(known).T
        found = _fit(predictor, values, means, weights=1.0 / deviations, rounds=_ROUNDS)
        left = found.squares / len(found.residuals)
        if math.isfinite(chi2) and left > max(_WORSE * chi2, _WORSE):
            break  # the model no longer explains it: that is to be judged, and not to be fitted away
        assert found.slopes is not None
        root = np.linalg.inv(np.linalg.qr(found.slopes, mode="r"))
        values, covariance, chi2, end_s = found.values, root @ root.T, left, first_s + length
    half = 1.96 * math.sqrt(max(1.0, chi2)) * np.sqrt(np.diag(covariance))
    draw = values + np.linalg.cholesky(covariance) @ np.random.default_rng(0).standard_normal(len(values))
    told = dict(zip(wanted, values.tolist(), strict=True))
    return Tuned(
        begun=begun,
        experiment=with_values(begun, told),
        fitted=tuple(
            Fitted(key, value_of(experiment, key), value, float(width))
            for (key, value), width in zip(told.items(), half, strict=True)
        ),
        values=told,
        perturbed=dict(zip(wanted, draw.tolist(), strict=True)),
        about_s=min(float(part.times_s[0]) for part in whole.parts.values()),
        end_s=end_s,
        chi2=chi2,
    )


def _fit(
    predictor: Predictor,
    start: np.ndarray,
    means: np.ndarray,
    *,
    weights: np.ndarray,
    rounds: int,
    centred: bool = False,
) -> Fit:
    """Values near a start that explain the channels best.

    Args:
        predictor: Of the channels.
        start: Where the search begins, shape (keys,).
        means: What is known of the values before, shape (keys,) ...
        weights: ... and how well: one over the standard deviation, 0 where nothing is, shape (keys,).
        rounds: Largest number of steps.
        centred: Without each channel's mean.
    """

    def residuals(values: np.ndarray) -> np.ndarray:
        return np.concatenate([_residuals(predictor, values, centred=centred), (values - means) * weights])

    def slopes(values: np.ndarray, _z: np.ndarray) -> np.ndarray:
        found = predictor.derivatives(values).slopes
        columns = [_over_noise(predictor, slope, centred=centred) for slope in found]
        return np.vstack([np.column_stack(columns), np.diag(weights)])

    found = fit(residuals, slopes, start, rounds=rounds)
    assert found is not None
    return found


def _residuals(predictor: Predictor, values: Sequence[float] | np.ndarray, *, centred: bool) -> np.ndarray:
    """Predicted less measured over the noise, of all channels, shape (n,)."""
    found = predictor.predict(values).values
    return _over_noise(
        predictor, {name: found[name] - part.values for name, part in predictor.parts.items()}, centred=centred
    )


def _over_noise(predictor: Predictor, values: dict[str, np.ndarray], *, centred: bool) -> np.ndarray:
    """Values of all channels, by group, in units of each one's noise, shape (n,)."""
    found = [values[name] / part.floor for name, part in predictor.parts.items()]
    return np.concatenate([(one - one.mean(axis=0) if centred else one).ravel() for one in found])
