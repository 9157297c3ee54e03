"""Step response of a channel: rise time, overshoot and settling time.

Definitions follow IEEE Std 1057-2017 as quoted in papers and tutorials; the standard itself was not available.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from replays.estimate.intervals import bound_maximum
from replays.estimate.spectra import parabola_top
from replays.score.card.scorecard import Interval

_LEVEL_PART, _MAX_EDGE_ROWS = 0.1, 3
"""Distance from a level, as a part of the step, and most rows between two levels, in a signal of steps."""
_MIN_PLATEAU_ROWS, _MAX_ROWS, _MIN_STEPS = 100, 4000, 6
"""Fewest rows of a plateau, most rows that are averaged, and fewest steps."""
_BEFORE_ROWS = 32
"""Rows before a step that are averaged."""
_RESOLVED_ROWS = 3.0
"""Rise time from which it is resolved [rows]; of a shorter one only the upper limit is known."""
BAND = 0.01
"""Part of the step within which a response has settled."""


@dataclass(frozen=True)
class StepResponse:
    """A step response, each value with its 95 % interval.

    Attributes:
        rise_rows: Rise time from 10 % to 90 % of the step [rows].
        overshoot: Overshoot above the final level, relative to the step [%].
        settling_rows: Time from 50 % of the step until it stays within the band [rows]; None if it does not.
        steps: Number of averaged steps.
    """

    rise_rows: Interval
    overshoot: Interval
    settling_rows: Interval | None
    steps: int


def has_steps(sent: np.ndarray) -> bool:
    """Return whether a signal consists of steps between two levels that are steeper than a response."""
    low, high = np.percentile(sent, (5.0, 95.0))
    near = np.minimum(np.abs(sent - low), np.abs(sent - high)) < _LEVEL_PART * (high - low)
    return bool(high > low and np.sum(~near) <= _MAX_EDGE_ROWS * len(_find_edges(sent)))


def _find_edges(sent: np.ndarray) -> np.ndarray:
    """Return the rows after which a signal passes the middle of its levels, shape (n,)."""
    above = sent > 0.5 * np.sum(np.percentile(sent, (5.0, 95.0)))
    return np.flatnonzero(above[1:] != above[:-1])


def step_response(sent: np.ndarray, values: np.ndarray) -> StepResponse | None:
    """Return the mean response to all steps whose plateaus are long enough; None if these are too few.

    Args:
        sent: The known signal, shape (n,).
        values: Recorded values, shape (n,).
    """
    from scipy.interpolate import PchipInterpolator

    middle = sent - 0.5 * np.sum(np.percentile(sent, (5.0, 95.0)))
    edges = _find_edges(sent)
    gaps = np.diff(edges, prepend=-1, append=len(sent))
    plateaus = np.minimum(gaps[:-1], gaps[1:])
    held = plateaus > max(_MIN_PLATEAU_ROWS, 0.5 * float(np.median(plateaus)) if len(plateaus) else 0.0)
    if held.sum() < _MIN_STEPS:
        return None
    rows = min(_MAX_ROWS, int(plateaus[held].min()) - 2)
    places_of = edges + middle[edges] / (middle[edges] - middle[edges + 1])
    # If all steps have the same place between two rows, the grid has it as well, and nothing is interpolated.
    grid = np.arange(-_BEFORE_ROWS, rows) - float(np.median((places_of - edges)[held]))
    responses = []
    for edge, at in zip(edges[held], places_of[held], strict=True):
        part = values[edge + 1 - min(rows, edge + 1) : edge + 1]
        base, top = part[len(part) // 2 : -_BEFORE_ROWS].mean(), values[edge + rows // 2 : edge + rows].mean()
        first = edge - _BEFORE_ROWS - 1
        near = values[first : edge + rows + 2]
        places = np.arange(first, first + len(near)) - at
        responses.append(np.interp(grid, places, (near - base) / (top - base)))
    mean, count = np.mean(responses, axis=0), len(responses)
    apart = np.var(responses, axis=0, ddof=1)
    spread = np.sqrt(np.maximum(apart, np.median(apart)) / count)
    after = slice(_BEFORE_ROWS - 1, None)
    over = bound_maximum(mean[after] - 1.0, spread[after])
    before, peak, following = mean[np.clip(np.argmax(mean), 1, len(mean) - 2) + np.arange(-1, 2)]
    _, between = parabola_top(before, peak, following)
    overshoot = 100.0 * (over[0] + between), 100.0 * over[1], 100.0 * (over[2] + 2.0 * between)
    curve, fine = PchipInterpolator(grid, mean), np.arange(grid[0], grid[-1], 1.0 / 64.0)

    def crossing(level: float) -> tuple[float, float]:
        """Return the row at which the response first passes a level, and the half width of its interval."""
        n = int(np.argmax(mean >= level))
        linear = grid[n] - (mean[n] - level) / max(mean[n] - mean[n - 1], 1e-300)
        k = int(np.argmax(curve(fine) >= level))
        half = 1.96 * float(spread[n]) / max(mean[n] - mean[n - 1], 1e-300) + abs(fine[k] - linear) + 1.0 / 64.0
        return float(fine[k]), half

    (low, low_half), (middle_row, _), (high, high_half) = (crossing(level) for level in (0.1, 0.5, 0.9))
    rise, half = high - low, math.hypot(low_half, high_half)
    resolved = rise >= _RESOLVED_ROWS
    rise_rows = rise, rise - half if resolved else 0.0, rise + half if resolved else max(1.0, rise) + 1.0
    limits = [0.0, *(bound_maximum(np.zeros(rows), spread[_BEFORE_ROWS:])[2] * sign for sign in (-1.0, 1.0))]
    ends = []
    for limit in limits:
        out = np.flatnonzero(np.abs(mean - 1.0) + limit > BAND)
        ends.append(float(grid[out[-1]]) - middle_row if len(out) else 0.0)
    settled = max(0.0, ends[0] + 0.5), max(0.0, ends[1] - 0.5), max(0.0, ends[2]) + 1.5
    return StepResponse(rise_rows, overshoot, settled if settled[2] < 0.9 * rows else None, count)
