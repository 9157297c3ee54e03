"""Separation of noise and jitter in the residual of a fit, by the slope of the signal."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from replays.estimate.intervals import sandwich, student, wander_columns
from replays.estimate.least_squares import solve_normal
from replays.score.waveform import Waveform

_SKEW = 0.6
"""Relative half interval of a power above which the power may be 0, with a symmetric interval."""


@dataclass(frozen=True)
class NoiseSplit:
    """Noise of the voltage and of the sampling instants, each as value, low and high end of its 95 % interval.

    Attributes:
        total: Whole residual, rms [unit].
        noise: Part of the residual that is independent of the slope, rms [unit].
        jitter_s: Jitter, rms [s]; None if the signal's slope does not vary.
    """

    total: tuple[float, float, float]
    noise: tuple[float, float, float]
    jitter_s: tuple[float, float, float] | None


def split_noise(fit: Waveform, *, floor: float = 0.0, steps: bool = False) -> NoiseSplit:
    """Separate jitter from noise: residual^2 = noise^2 + (gain slope)^2 jitter^2, by weighted least squares.

    Args:
        fit: A fit.
        floor: Noise that may be due to the known signal itself [unit rms]: extends both intervals downward.
        steps: Whether rounding shows in the residual: its power may depend on the slope, as that of jitter does.
    """
    slow = wander_columns(fit.residual)
    # A wander is part of the noise, and its power is that of this record.
    wander = (slow @ (slow.T @ fit.residual) * 2.0 / len(slow)) ** 2
    squared, steep = fit.residual**2, (fit.gain * fit.slope) ** 2
    typical = float(np.mean(steep))
    ones = np.ones(len(squared))
    if not (typical > 0.0 and float(np.std(steep)) > 0.05 * typical):
        (total,) = _fit_powers(squared, wander, [ones], floor)
        return NoiseSplit(total, total, None)
    noise, late = _fit_powers(squared, wander, [ones, steep / typical], floor)
    # The noise that the threshold kept or removed is below twice the known signal's noise, and may be in steep parts.
    wander_error = 2.0 * floor * typical / math.sqrt(float(np.mean(steep**2)))
    late = late[0], 0.0 if steps else math.sqrt(max(0.0, late[1] ** 2 - wander_error**2)), late[2]
    (total,) = _fit_powers(squared, wander + late[0] ** 2 * steep / typical, [ones], floor)
    size = math.sqrt(typical)
    return NoiseSplit(total, noise, (late[0] / size, late[1] / size, late[2] / size))


def _fit_powers(
    squared: np.ndarray, wander: np.ndarray, columns: list[np.ndarray], floor: float
) -> list[tuple[float, float, float]]:
    """Return the roots of the parts of squares, with 95 % intervals.

    Args:
        squared: Squares of a residual, shape (n,).
        wander: Part of the squares that is known separately, as of a wander; it is added to the first part, shape (n,).
        columns: Factors to which the parts are proportional, the first constant, each shape (n,).
        floor: Contribution of the known signal to the first part [rms].
    """
    matrix, weights, rounds = np.column_stack(columns), np.ones(len(squared)), 3 if columns[1:] else 1
    fast = squared - wander
    while True:
        weighted = matrix * weights[:, None]
        parts = solve_normal(weighted.T @ matrix, weighted.T @ fast)
        rounds -= 1
        if not rounds:
            break
        # The standard deviation of a normal noise's square is proportional to its mean, and grows with a wander.
        total = float(np.mean(squared))
        model = np.maximum(matrix @ parts, 0.05 * total)
        weights = total**2 / (model**2 + 2.0 * model * wander)
    root = np.sqrt(weights)
    # A drifting level is that of this record: squares wander, too, and their mean is not random.
    rest = (fast - matrix @ parts) * root
    both = np.column_stack([matrix * root[:, None], slow := wander_columns(rest)])
    rest = rest - slow @ (slow.T @ rest) * 2.0 / len(rest)
    covariance, dof = (each[..., : len(parts)] for each in sandwich(both, rest, even=True))
    half = student(dof) * np.sqrt(np.diag(covariance))
    parts[0] += np.mean(wander)
    # Few independent squares have a skewed chi-squared distribution: the ends are at equal ratios.
    ratio = np.exp(half / np.maximum(parts, 1e-300), where=half < _SKEW * parts, out=np.full(len(parts), np.nan))
    low, high = np.where(np.isnan(ratio), [parts - half, parts + half], [parts / ratio, parts * ratio])
    roots = np.sqrt(np.maximum(0.0, [parts, low, high]))
    roots[1, 0] = math.sqrt(max(0.0, roots[1, 0] ** 2 - floor**2))
    return [(float(value), float(low), float(high)) for value, low, high in roots.T]
