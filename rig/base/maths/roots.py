"""Root of a function of one variable; importing a library for it would take 0.25 s of every start."""

from __future__ import annotations

import math
from collections.abc import Callable

_EPSILON = 2.0**-50
"""Relative accuracy of the root."""
_MAX_ROUNDS = 1000


def find_root(function: Callable[[float], float], low: float, high: float, *, within: float) -> float:
    """Return the root of a function by Brent's method (Algorithms for Minimization without Derivatives, 1973).

    Uses inverse quadratic or linear interpolation if it converges fast enough, otherwise bisection.

    Args:
        function: Continuous function.
        low: One end of the interval.
        high: The other end, where the function has the other sign.
        within: Absolute accuracy of the root, in addition to 4 / 2^52 relative.

    Raises:
        ValueError: Both ends have the same sign, or the function is NaN in between.
    """
    former, best = low, high
    f_former, f_best = function(former), function(best)
    if f_former == 0.0:
        return former
    if f_best == 0.0:
        return best
    if (f_former < 0.0) == (f_best < 0.0):
        raise ValueError(f"the function must change its sign from {low:g} to {high:g}")
    other, f_other = former, f_former
    step = last_step = best - former
    for _ in range(_MAX_ROUNDS):
        if f_former != 0.0 and (f_former < 0.0) != (f_best < 0.0):
            other, f_other = former, f_former
            step = last_step = best - former
        if abs(f_other) < abs(f_best):
            former, best, other = best, other, best
            f_former, f_best, f_other = f_best, f_other, f_best
        least = 0.5 * (within + _EPSILON * abs(best))
        half = 0.5 * (other - best)
        if f_best == 0.0 or abs(half) < least:
            return best
        if math.isnan(f_best):
            break
        trial = half
        if abs(last_step) > least and abs(f_best) < abs(f_former):
            if former == other:
                trial = -f_best * (best - former) / (f_best - f_former)
            else:
                slope = (f_former - f_best) / (former - best)
                slope_other = (f_other - f_best) / (other - best)
                bend = slope_other * slope * (f_other - f_former)
                # Differences that have underflowed give no slope.
                trial = -f_best * (f_other * slope_other - f_former * slope) / bend if bend else math.inf
            if 2.0 * abs(trial) < min(abs(last_step), 3.0 * abs(half) - least):
                last_step, step = step, trial
            else:
                last_step = step = half
        else:
            last_step = step = half
        former, f_former = best, f_best
        best += step if abs(step) > least else (least if half > 0.0 else -least)
        f_best = function(best)
    raise ValueError(f"no root found from {low:g} to {high:g}: the function is {f_best:g} at {best:g}")
