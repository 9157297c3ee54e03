"""Straight lines between two clocks, or between a clock and row numbers, and the time error of a residual."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from replays.estimate.intervals import student


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
    centre, offset = float(x.mean()), float(y.mean())
    apart = x - centre
    spread = float(apart @ apart)
    slope = float(apart @ (y - offset)) / spread if spread else 0.0
    return Line(slope, centre, offset, x, y - offset - slope * apart)


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
