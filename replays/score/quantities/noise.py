"""Noise and jitter: what a fit leaves, told apart by the slope of the signal."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from replays.estimate.intervals import sandwich, student, wander_columns
from replays.estimate.least_squares import solve_normal
from replays.score.waveform import Waveform

_SKEW = 0.6
"""Half interval of a power, over the power, from which it may be 0 and its interval is even to both sides."""


@dataclass(frozen=True)
class NoiseSplit:
    """Noise of the voltage and of the sampling instants, each as value, low and high end of its 95 % interval.

    Attributes:
        left: All that is left, rms [unit].
        noise: What of it goes not with the slope, rms [unit].
        jitter_s: rms [s]; None where the signal's slope does not vary.
    """

    left: tuple[float, float, float]
    noise: tuple[float, float, float]
    jitter_s: tuple[float, float, float] | None


def split_noise(found: Waveform, *, floor: float = 0.0, steps: bool = False) -> NoiseSplit:
    """Tell jitter from noise: residual^2 = noise^2 + (gain slope)^2 jitter^2, by least squares with weights.

    Args:
        found: A fit.
        floor: Noise that the known signal itself may have brought [unit rms]: widens both intervals downward.
        steps: Whether rounding shows in the residual: its power may go with the slope, as that of jitter does.
    """
    slow = wander_columns(found.residual)
    # A wander is part of the noise, and its power is that of this record.
    wander = (slow @ (slow.T @ found.residual) * 2.0 / len(slow)) ** 2
    squared, steep = found.residual**2, (found.gain * found.slope) ** 2
    typical = float(np.mean(steep))
    ones = np.ones(len(squared))
    if not (typical > 0.0 and float(np.std(steep)) > 0.05 * typical):
        (left,) = _powers(squared, wander, [ones], floor)
        return NoiseSplit(left, left, None)
    noise, late = _powers(squared, wander, [ones, steep / typical], floor)
    # What was kept of the known signal, or taken off it, is below twice its noise, and may be where that is steep.
    known = 2.0 * floor * typical / math.sqrt(float(np.mean(steep**2)))
    late = late[0], 0.0 if steps else math.sqrt(max(0.0, late[1] ** 2 - known**2)), late[2]
    (left,) = _powers(squared, wander + late[0] ** 2 * steep / typical, [ones], floor)
    size = math.sqrt(typical)
    return NoiseSplit(left, noise, (late[0] / size, late[1] / size, late[2] / size))


def _powers(
    squared: np.ndarray, wander: np.ndarray, columns: list[np.ndarray], floor: float
) -> list[tuple[float, float, float]]:
    """Return the roots of the parts of squares, with 95 % intervals.

    Args:
        squared: Squares of a residual, shape (n,).
        wander: What of them is known apart, as by a wander; it is added to the first part, shape (n,).
        columns: To what the parts are proportional, the first constant, each shape (n,).
        floor: Rms that the known signal may have brought into the first part.
    """
    matrix, weights, rounds = np.column_stack(columns), np.ones(len(squared)), 3 if columns[1:] else 1
    fast = squared - wander
    while True:
        weighted = matrix * weights[:, None]
        parts = solve_normal(weighted.T @ matrix, weighted.T @ fast)
        rounds -= 1
        if not rounds:
            break
        # A square of normal noise spreads as its own mean, and beside a wander by twice the product of both.
        total = float(np.mean(squared))
        model = np.maximum(matrix @ parts, 0.05 * total)
        weights = total**2 / (model**2 + 2.0 * model * wander)
    root = np.sqrt(weights)
    # A level that drifts is that of this record: squares wander, too, and the mean of that is no matter of chance.
    rest = (fast - matrix @ parts) * root
    both = np.column_stack([matrix * root[:, None], slow := wander_columns(rest)])
    rest = rest - slow @ (slow.T @ rest) * 2.0 / len(rest)
    covariance, freedom = (found[..., : len(parts)] for found in sandwich(both, rest, even=True))
    half = student(freedom) * np.sqrt(np.diag(covariance))
    parts[0] += np.mean(wander)
    # Few independent squares spread as chi squared, which is skew: the ends are at equal ratios.
    ratio = np.exp(half / np.maximum(parts, 1e-300), where=half < _SKEW * parts, out=np.full(len(parts), np.nan))
    low, high = np.where(np.isnan(ratio), [parts - half, parts + half], [parts / ratio, parts * ratio])
    roots = np.sqrt(np.maximum(0.0, [parts, low, high]))
    roots[1, 0] = math.sqrt(max(0.0, roots[1, 0] ** 2 - floor**2))
    return [(float(value), float(low), float(high)) for value, low, high in roots.T]
