"""Straight lines between two clocks, or between a clock and row numbers, and the time error of a residual."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from replays.estimate.intervals import student
from replays.estimate.spool import add_up, blocks, find_extent, find_median, find_rows, running_sum, steps_of, transform

_STEP_TOLERANCE = 0.2
"""Relative difference of steps of time stamps that count as equal."""
_REGULAR_PART, _MAX_ROUNDED = 0.9, 1.1
"""Part of equal steps above which stamps are not rounded to a coarse resolution, and largest deviation of such stamps
from a line, peak to peak, over their largest step."""
_MAX_SCATTER, _MIN_GAP = 5.0, 3.0
"""The same over the usual step for stamps of which some go back by jitter, and steps over the usual one from which rows
are missing: jitter of a quarter of a step, rms, reaches 5 steps peak to peak and steps of 2.5."""

_LINE_ROWS = 1 << 18
"""Rows of a line that are in memory at a time."""
_MAX_CLOCK_STEPS, _MAX_STEP_PART = 4, 1e-3
"""Number of steps, or part of them, up to which they are steps of the clock or pauses, of any length."""


class Line(NamedTuple):
    """A straight line y = offset + slope (x - centre) by least squares.

    Attributes:
        slope: Slope [unit of y per unit of x].
        centre: Mean of x.
        offset: Mean of y, the value at the centre.
        x: Fitted abscissae, shape (n,).
        residual: y minus the line, shape (n,).
    """

    slope: float
    centre: float
    offset: float
    x: np.ndarray
    residual: np.ndarray

    def __call__(self, x: np.ndarray | float) -> np.ndarray:
        """Return the line at x."""
        return np.asarray(self.offset + self.slope * (x - self.centre))

    @property
    def at_zero(self) -> float:
        """Value of the line at x = 0."""
        return float(self.offset - self.slope * self.centre)

    @property
    def half_widths(self) -> tuple[float, float]:
        """Half widths of the 95 % intervals of the slope and of the value at x = 0, for independent residuals."""
        n = len(self.residual)
        variance = float(self.residual @ self.residual) / (n - 2)
        spread = float(np.sum((self.x - self.centre) ** 2))
        of_one = float(student(n - 2)) * math.sqrt(variance)
        return of_one / math.sqrt(spread), of_one * math.sqrt(1.0 / n + self.centre**2 / spread)


def fit_line(x: np.ndarray, y: np.ndarray) -> Line:
    """Fit a straight line about the means, to keep digits if x and y are large; the slope is 0 if x is constant.

    Args:
        x: Times of one clock or row numbers, shape (n,).
        y: Times of the other clock, or any values, shape (n,).
    """
    centre, offset = add_up(x) / len(x), add_up(y) / len(y)
    spread = common = 0.0
    for rows in blocks(len(x), x, y, size=_LINE_ROWS):
        apart = x[rows] - centre
        spread, common = spread + float(apart @ apart), common + float(apart @ (y[rows] - offset))
    slope = common / spread if spread else 0.0
    return Line(slope, centre, offset, x, transform(lambda a, b: b - offset - slope * (a - centre), x, y))


def time_error(slope: np.ndarray, residual: np.ndarray) -> float:
    """Return how early a signal is, by least squares of a residual over its slope.

    Args:
        slope: Slope of the known signal [unit/s], or per sample, shape (n,) or (channels, n).
        residual: Recorded minus known signal [unit], of the same shape.

    Returns:
        Time error [s], or [samples]; 0 if the signal has no slope.
    """
    information = float(np.sum(slope**2))
    return float(np.sum(slope * residual)) / information if information > 0.0 else 0.0


def find_rate(times_s: np.ndarray, max_hz: float) -> float | None:
    """Return the rate of time stamps by those of their steps that are equal [Hz]; None if they are a minority.

    None also if the stamps do not ascend on the whole, or faster than a rate can be. Steps of the clock and missing
    rows do not change the rate.

    Args:
        times_s: The stamps [s], shape (n,).
        max_hz: Highest rate [Hz].
    """
    if len(times_s) < 2:
        return None
    steps = steps_of(times_s)
    usual, resolution_s = find_median(steps), find_resolution(steps)
    alike = transform(lambda part: part[np.abs(part - usual) < _STEP_TOLERANCE * usual], steps)
    if usual >= 0.0 and len(alike) < _REGULAR_PART * len(steps):
        # Steps are multiples of a coarse resolution, or have jitter: a line shows the rate.
        least_s, largest_s = find_extent(steps)
        most_s = _MAX_ROUNDED * largest_s if least_s >= 0.0 else _MAX_SCATTER * usual
        late = missing = _fit_rows(times_s, transform(np.ones_like, steps))
        period_s = usual
        for _ in range(2 if usual > 0.0 and largest_s > _MIN_GAP * usual else 0):
            counts = transform(
                lambda part, s=period_s: np.where(part > _MIN_GAP * usual, np.rint(part / s), 1.0), steps
            )
            missing = _fit_rows(times_s, counts)
            period_s = max(missing[1], 1.0 / max_hz)
        scatter_s, period_s = min(late, missing)  # a large step is due to late stamps, or to missing rows
        large = find_rows(lambda part: np.abs(part) > _MIN_GAP * max(usual, resolution_s), steps)
        few = 0 < len(large) <= max(_MAX_CLOCK_STEPS, _MAX_STEP_PART * len(steps))
        if few and not scatter_s <= _MAX_SCATTER * max(usual, resolution_s):
            return find_rate(max(np.split(times_s, large + 1), key=len), max_hz)
        if 0.0 < scatter_s <= most_s and period_s * max_hz >= 1.0:
            return 1.0 / period_s
    alike_s, span_s = add_up(alike), max(0.0, float(times_s[-1] - times_s[0]))
    if len(steps) - len(alike) <= max(_MAX_CLOCK_STEPS, _MAX_STEP_PART * len(steps)):
        span_s = alike_s
    return None if 2.0 * alike_s <= span_s or len(alike) > max_hz * alike_s else len(alike) / alike_s


def find_resolution(steps_s: np.ndarray) -> float:
    """Return the median of those steps of time stamps that ascend [s]; 0 if none does."""
    ascending = transform(lambda part: part[part > 0.0], steps_s)
    return find_median(ascending) if len(ascending) else 0.0


def _fit_rows(times_s: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    """Return the scatter of stamps about a line, peak to peak, and the line's time per row [s].

    Args:
        times_s: The stamps [s], shape (n,).
        counts: Rows from each stamp to the next, shape (n - 1,).
    """
    line = fit_line(running_sum(counts), times_s)
    low, high = find_extent(line.residual)
    return high - low, line.slope
