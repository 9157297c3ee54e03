"""Keyphasor: exact instants at which the mark on the shaft passes the probe."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rig.physics.kernels.signals import COLUMN
from rig.physics.kernels.stage import kernel

TURN = 2.0 * math.pi
FRACTIONS = 2**20
"""Resolution of an edge: parts per tick (1 ps). Added to whole ticks, such fractions are exact for any block."""
_ANGLE, _RATE = COLUMN["theta"], COLUMN["theta_rate"]


class Keyphasor:
    """Detector of once-per-turn edges, on the cubic Hermite interpolant of the spin angle between observed rows."""

    def __init__(self) -> None:
        self.edges_seen = 0
        self._last = np.full(2, np.nan)
        """Angle and rate at the last row of the previous call."""

    def edges(self, rows: np.ndarray, row_ticks: int) -> np.ndarray:
        """Return the edges (mark arriving, forward spin) up to the last of these rows.

        Args:
            rows: Observed rows that follow those of the last call, shape (n, N_ROW).
            row_ticks: Ticks per row interval.

        Returns:
            Instants in ticks from the first of these rows, with fraction, shape (edges,). Negative ones lie between the
            last row of the previous call and the first of this one.
        """
        edges = np.empty(len(rows))
        count = _edges(rows, row_ticks, self._last, edges)
        self.edges_seen += count
        return edges[:count]


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def _edges(rows, row_ticks, last, edges):
    """Return the number of edges, at most one per row interval.

    Args:
        rows: Observed rows, shape (n, N_ROW).
        row_ticks: Ticks per row interval.
        last: Angle and rate of the previous row, in and out, shape (2,).
        edges: Instants [ticks], out, shape (n,).
    """
    count = 0
    angle, rate = last[0], last[1]
    turns = math.floor(angle / TURN) if angle == angle else np.inf
    for n in range(len(rows)):
        angle_before, rate_before, turns_before = angle, rate, turns
        angle, rate = rows[n, _ANGLE], rows[n, _RATE]
        turns = math.floor(angle / TURN)
        if turns > turns_before:
            step = row_ticks * 1e-6
            mark = turns * TURN
            part = _crossing(angle_before - mark, angle - mark, rate_before * step, rate * step)
            edges[count] = (n - 1) * row_ticks + np.rint(part * row_ticks * FRACTIONS) / FRACTIONS
            count += 1
    last[0], last[1] = angle, rate
    return count


@kernel
def _crossing(y0, y1, m0, m1):
    """Return the fraction of an interval at which the Hermite interpolant of values y and slopes m is 0.

    Four Newton iterations suffice, because the angle is nearly linear over one row interval.
    """
    s = -y0 / (y1 - y0)
    for _ in range(4):
        r = 1.0 - s
        value = y0 * (1.0 + 2.0 * s) * r * r + m0 * s * r * r + y1 * s * s * (3.0 - 2.0 * s) + m1 * s * s * (s - 1.0)
        slope = 6.0 * s * (s - 1.0) * (y0 - y1) + m0 * r * (1.0 - 3.0 * s) + m1 * s * (3.0 * s - 2.0)
        s -= value / slope
    return min(max(s, 0.0), 1.0)
