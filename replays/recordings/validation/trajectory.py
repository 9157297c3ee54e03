"""Sample by sample, as long as the trajectory can be predicted: residuals over their noise floors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from replays.estimate.runs import block_means
from replays.recordings.resimulation.prediction import Measured, Prediction
from replays.recordings.validation.criteria import Criteria, TrajectoryCriterion

STRETCH = 128
"""Samples that one mean of the drift is taken over."""
_SURE = 7.0
"""No noise reaches this."""


@dataclass(frozen=True)
class ChannelResidual:
    """What is left of one channel inside the window.

    Attributes:
        group: Its group.
        channel: Its name.
        unit: Its unit.
        floor: Noise and rounding [unit].
        n: Samples.
        rms: RMS of residual over floor; 1 is noise alone.
        peak: Largest of it.
        drift: Largest mean over a stretch, in standard errors of such a mean.
        limit: The criterion's limit of `rms`, with its standard errors.
        peak_limit: That of `peak`.
        drift_limit: That of `drift`.
        good: Within the criterion; None where there is none for it.
        first_s: First time at which a limit is passed [s]; None where none is.
        reason: The criterion's.
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
    def broken(self) -> tuple[str, float, float] | None:
        """The first measure that is beyond its limit, the plainest first: its name, its value, its limit."""
        measures = (
            ("RMS", self.rms, self.limit),
            ("largest", self.peak, self.peak_limit),
            ("drift", self.drift, self.drift_limit),
        )
        return next((one for one in measures if not one[1] <= one[2]), None)  # not a number is beyond, too

    @staticmethod
    def alone(measure: str) -> str:
        """What is left where there is noise alone, in words."""
        return "1" if measure == "RMS" else "noise"


def foreseeable_s(
    parts: dict[str, Measured], nominal: Prediction, others: Sequence[Prediction], *, share: float
) -> float | None:
    """First time at which runs that are as right are apart by a part of the noise [s]; None: nowhere."""
    ends = []
    for name, part in parts.items():
        for other in others:
            apart = np.abs(other.values[name] - nominal.values[name]) > share * part.floor
            apart[:, [channel.name == "keyphasor" for channel in part.channels]] = (
                False  # a pulse: a row late is no sign
            )
            hit = np.flatnonzero(apart.any(axis=1))
            if len(hit):
                ends.append(float(part.times_s[hit[0]]))
    return min(ends, default=None)


def floors(part: Measured, values: np.ndarray, others: Sequence[np.ndarray] = ()) -> np.ndarray:
    """Noise, and how far predictions are from each other that are as right, shape (n, channels).

    Args:
        part: What was recorded.
        values: What was predicted for its first rows, shape (n, channels).
        others: What might have been predicted as well, each shape (n, channels).
    """
    squares = sum(((other - values) ** 2 for other in others), np.broadcast_to(part.floor**2, values.shape))
    return np.sqrt(squares)


def scaled(part: Measured, values: np.ndarray, others: Sequence[np.ndarray] = ()) -> np.ndarray:
    """Residuals of recorded against predicted over the floor, shape (n, channels); arguments as of `floors`."""
    return (part.values[: len(values)] - values) / floors(part, values, others)


def residuals(
    parts: dict[str, Measured], nominal: Prediction, others: Sequence[Prediction], criteria: Criteria, *, end_s: float
) -> list[ChannelResidual]:
    """Judge every channel inside the window.

    Args:
        parts: What was recorded.
        nominal: What was predicted.
        others: What might have been predicted as well.
        criteria: The limits.
        end_s: End of the window [s].
    """
    found = []
    for name, part in parts.items():
        n = part.rows_until(end_s)
        if n == 0:
            continue
        z = scaled(part, nominal.values[name][:n], [other.values[name][:n] for other in others])
        for c, channel in enumerate(part.channels):
            criterion = criteria.trajectory_of(channel.name)
            found.append(_judge(part, c, z[:, c], criterion))
    return found


def _judge(part: Measured, c: int, z: np.ndarray, criterion: TrajectoryCriterion | None) -> ChannelResidual:
    rms, peak = float(np.sqrt(np.mean(z**2))), float(np.abs(z).max())
    means = block_means(z, STRETCH) * math.sqrt(STRETCH)
    drift = float(np.abs(means).max(initial=0.0))
    limit, good, first = math.inf, None, None
    peak_limit = drift_limit = math.inf
    if criterion is not None:
        limit = criterion.rms + criterion.sigmas / math.sqrt(2.0 * len(z))
        random = bool(part.random[c])
        peak_limit = criterion.peak
        drift_limit = criterion.drift if random else math.inf
        limit = limit if random else math.inf
        # Rounding alone is no noise: its mean does not shrink, and its RMS may be its bound.
        good = peak <= peak_limit and rms <= limit and drift <= drift_limit
        if not good:
            over = np.flatnonzero(np.abs(z) > min(criterion.peak, _SURE))
            starts = [float(part.times_s[over[0]])] if len(over) else []
            slow = np.flatnonzero(np.abs(means) > drift_limit)
            starts += [float(part.times_s[slow[0] * STRETCH])] if len(slow) else []
            first = min(starts, default=float(part.times_s[0]))
    channel = part.channels[c]
    unit = "" if channel.unit == "1" else channel.unit
    return ChannelResidual(
        group=part.group, channel=channel.name, unit=unit, floor=float(part.floor[c]), n=len(z), rms=rms, peak=peak,
        drift=drift, limit=limit, good=good, first_s=first, reason=criterion.reason if criterion else "",
        peak_limit=peak_limit, drift_limit=drift_limit,
    )  # fmt: skip
