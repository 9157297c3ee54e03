"""Residuals over their noise floors, sample by sample, within the predictable part of the trajectory.

A filter's corner, a calibration factor or a friction law that no log shows is one number for the whole log. It is
fitted with its prior, so that it explains only a residual of its own shape: a contact that begins late, or another
contact law, has another one. A floor as wide as the largest effect of each would hide both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from replays.estimate.least_squares import solve_bounded
from replays.estimate.runs import block_means
from replays.recordings.resimulation.prediction import Measured, Prediction
from replays.recordings.validation.criteria import Criteria, TrajectoryCriterion

STRETCH = 128
"""Samples of a mean in the drift."""
_NOISE_LIMIT = 7.0
"""Residual over its floor that noise never reaches."""
_MAX_DEVIATION = 3.0
"""Largest value of an uncertain number, in standard deviations."""
_LEAST_SHOWN = 0.5
"""Least value of an uncertain number that is stated, in standard deviations."""


PULSES_ONLY = ", pulses only"
"""Addition to the verdict of a channel whose amplitude is not compared."""


@dataclass(frozen=True)
class ChannelResidual:
    """Residual of a channel within the window.

    Attributes:
        group: Channel group.
        channel: Channel.
        unit: Unit.
        floor: Noise and rounding [unit].
        n: Number of samples.
        rms: RMS of residual over floor; 1 is noise alone.
        peak: Largest residual over floor.
        drift: Largest mean over a stretch or over all samples, in standard errors of the mean.
        limit: Limit of `rms`, including its standard errors.
        peak_limit: Limit of `peak`.
        drift_limit: Limit of `drift`.
        good: Whether the criterion is met; None without a criterion.
        first_s: First time at which a limit is exceeded [s], or None.
        reason: Reason of the criterion.
    """

    group: str
    channel: str
    unit: str
    floor: float
    n: int
    rms: float
    peak: float
    drift: float
    limit: float
    good: bool | None
    first_s: float | None
    reason: str
    peak_limit: float = math.inf
    drift_limit: float = math.inf

    @property
    def pulses(self) -> bool:
        """True for a channel of pulses, of which the amplitude is not compared."""
        return self.channel == "keyphasor"

    @property
    def broken(self) -> tuple[str, float, float] | None:
        """First measure beyond its limit: its name, value and limit; or None."""
        measures = (
            ("RMS", self.rms, self.limit),
            ("largest", self.peak, self.peak_limit),
            ("drift", self.drift, self.drift_limit),
        )
        return next((one for one in measures if not one[1] <= one[2]), None)  # nan is beyond the limit

    @staticmethod
    def alone(measure: str) -> str:
        """Return the value of a measure for noise alone, as text."""
        return "1" if measure == "RMS" else "noise"


def floors(part: Measured, values: np.ndarray, others: Sequence[np.ndarray] = ()) -> np.ndarray:
    """Return the noise combined with the differences between equally valid predictions, shape (n, channels).

    Args:
        part: Recorded channels.
        values: Prediction of its first rows, shape (n, channels).
        others: Equally valid predictions, each shape (n, channels).
    """
    squares = sum(((other - values) ** 2 for other in others), np.broadcast_to(part.floor**2, values.shape))
    return np.sqrt(squares)


def scaled(part: Measured, values: np.ndarray, others: Sequence[np.ndarray] = ()) -> np.ndarray:
    """Return the residuals over the floor, shape (n, channels); arguments as of `floors`."""
    return part.whiten(part.values[: len(values)] - values) / floors(part, values, others)


@dataclass(frozen=True)
class Uncertainty:
    """Something that is known up to a standard deviation.

    Attributes:
        name: What it is, with its standard deviation.
        prediction: Prediction with one standard deviation more of it.
        each: Whether it is another number for each channel.
    """

    name: str
    prediction: Prediction
    each: bool = False


@dataclass(frozen=True)
class Tolerated:
    """Part of a residual that an uncertainty explains.

    Attributes:
        name: What is uncertain, with its standard deviation.
        channel: Channel; "" for all.
        deviations: Its fitted value, in standard deviations.
        largest: Largest effect on a sample, over the noise.
    """

    name: str
    channel: str
    deviations: float
    largest: float

    @property
    def line(self) -> str:
        """The result in words."""
        where = f"{self.channel} " if self.channel else ""
        return f"{where}{self.name}: {self.deviations:+.2g} of it, up to {self.largest:.2g} times the noise"


def tolerate(
    parts: dict[str, Measured], nominal: Prediction, uncertainties: Sequence[Uncertainty], *, end_s: float
) -> tuple[dict[str, np.ndarray], list[Tolerated]]:
    """Return residuals over the noise without what is uncertain, whitened, and what was tolerated.

    Args:
        parts: Recorded channels.
        nominal: Prediction.
        uncertainties: What is uncertain.
        end_s: End of the samples [s].

    Returns:
        Residuals by group, each shape (n, channels), and what explains a part of them.
    """
    places = [(name, c) for name, part in parts.items() for c in range(len(part.channels))]
    residuals, effects = {}, [dict[tuple[str, int], np.ndarray]() for _ in uncertainties]
    for name, part in parts.items():
        model = nominal.values[name][: part.count_rows(end_s)]
        residuals[name] = part.whiten(part.values[: len(model)] - model) / part.floor
        for effect, one in zip(effects, uncertainties, strict=True):
            moved = np.nan_to_num(part.whiten(one.prediction.values[name][: len(model)] - model) / part.floor)
            effect |= {(name, c): moved[:, c] for c, channel in enumerate(part.channels) if channel.name != "keyphasor"}
    numbers = [
        (one.name, own)
        for one, effect in zip(uncertainties, effects, strict=True)
        for own in ([{place: effect[place]} for place in effect] if one.each else [effect])
        if any(signal.any() for signal in own.values())
    ]
    square, side = np.eye(len(numbers)), np.zeros(len(numbers))
    for i, (_, own) in enumerate(numbers):
        side[i] = sum(float(signal @ np.nan_to_num(residuals[name][:, c])) for (name, c), signal in own.items())
        for k, (_, other) in enumerate(numbers[: i + 1]):
            square[i, k] += sum(float(signal @ other[place]) for place, signal in own.items() if place in other)
            square[k, i] = square[i, k]
    fitted = solve_bounded(square, side, _MAX_DEVIATION)
    tolerated = []
    for (text, own), value in zip(numbers, fitted.tolist(), strict=True):
        for (name, c), signal in own.items():
            residuals[name][:, c] -= value * signal
        channel = parts[next(iter(own))[0]].names[next(iter(own))[1]] if len(own) < len(places) - 1 else ""
        largest = abs(value) * max(float(np.abs(signal).max()) for signal in own.values())
        if abs(value) > _LEAST_SHOWN and largest > 1.0:
            tolerated.append(Tolerated(text, channel, value, largest))
    for name, part in parts.items():
        if "keyphasor" in part.names:  # a pulse may shift by a row
            c, rows = part.names.index("keyphasor"), len(residuals[name])
            model = nominal.values[name][:rows]
            floor = floors(part, model, [one.prediction.values[name][:rows] for one in uncertainties])
            residuals[name][:, c] = (part.values[:rows, c] - model[:, c]) / floor[:, c]
    return residuals, sorted(tolerated, key=lambda one: -one.largest)


def residuals(
    parts: dict[str, Measured], scaled_residuals: Mapping[str, np.ndarray], criteria: Criteria
) -> list[ChannelResidual]:
    """Judge every channel within the window.

    Args:
        parts: Recorded channels.
        scaled_residuals: Residuals over the floors in the window, by group, each shape (n, channels).
        criteria: The limits.
    """
    judged = []
    for name, z in scaled_residuals.items():
        part = parts[name]
        if len(z) == 0:
            continue
        for c, channel in enumerate(part.channels):
            criterion = criteria.find_trajectory(channel.name)
            judged.append(_judge(part, c, z[:, c], criterion))
    return judged


def _judge(part: Measured, c: int, z: np.ndarray, criterion: TrajectoryCriterion | None) -> ChannelResidual:
    rms, peak = float(np.sqrt(np.mean(z**2))), float(np.abs(z).max())
    means = block_means(z, STRETCH) * math.sqrt(STRETCH)
    drift = float(np.abs(means).max(initial=abs(z.mean()) * math.sqrt(len(z))))
    limit, good, first = math.inf, None, None
    peak_limit = drift_limit = math.inf
    if criterion is not None:
        limit = criterion.rms + criterion.sigmas / math.sqrt(2.0 * len(z))
        random = bool(part.random[c])
        peak_limit = criterion.peak
        drift_limit = criterion.drift if random else math.inf
        limit = limit if random else math.inf
        # Rounding is not noise: its mean does not shrink, and its RMS may reach its bound.
        good = peak <= peak_limit and rms <= limit and drift <= drift_limit
        if not good:
            over = np.flatnonzero(np.abs(z) > min(criterion.peak, _NOISE_LIMIT))
            slow = STRETCH * np.flatnonzero(np.abs(means) > drift_limit)
            loud = STRETCH * np.argmax(block_means(z**2, STRETCH), keepdims=True) if rms > limit and len(means) else ()
            starts = np.concatenate([over, slow]) if len(over) or len(slow) else loud
            first = float(part.times_s[int(min(starts, default=0))])
    channel = part.channels[c]
    unit = "" if channel.unit == "1" else channel.unit
    return ChannelResidual(
        group=part.group, channel=channel.name, unit=unit, floor=float(part.floor[c]), n=len(z), rms=rms, peak=peak,
        drift=drift, limit=limit, good=good, first_s=first, reason=criterion.reason if criterion else "",
        peak_limit=peak_limit, drift_limit=drift_limit,
    )  # fmt: skip
