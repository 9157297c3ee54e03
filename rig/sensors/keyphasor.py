"""Keyphasor: the exact instants at which the shaft's mark passes."""

from __future__ import annotations

import math

import numpy as np

from rig.kernels.signals import COLUMN

TURN = 2.0 * math.pi
FRACTIONS = 2**20
"""Parts of a tick (1 ps) that an edge is told in: added to whole ticks they are exact, whatever the block."""


class Keyphasor:
    """Finds the once-per-turn edges between observed rows, on the cubic Hermite interpolant of the spin angle."""

    def __init__(self) -> None:
        self.edges_seen = 0
        self._angle: float | None = None
        self._rate = 0.0

    def edges(self, rows: np.ndarray, row_ticks: int) -> np.ndarray:
        """Edges (mark arriving, forward spin) up to the last of these rows.

        Args:
            rows: Observed rows that follow those of the last call, shape (n, N_ROW).
            row_ticks: Ticks a row.

        Returns:
            Instants in ticks from the first of these rows, with their fraction; negative ones lie between the last
            row of the call before and the first of this one. Shape (edges,).
        """
        angle = rows[:, COLUMN["theta"]]
        rate = rows[:, COLUMN["theta_rate"]]
        first = 0
        if self._angle is not None:
            angle = np.concatenate([[self._angle], angle])
            rate = np.concatenate([[self._rate], rate])
            first = -1
        found = []
        turns = np.floor(angle / TURN)
        for n in np.nonzero(turns[1:] > turns[:-1])[0]:
            step = row_ticks * 1e-6
            part = _crossing(turns[n + 1] * TURN, angle[n : n + 2], rate[n : n + 2] * step)
            found.append((first + n) * row_ticks + round(part * row_ticks * FRACTIONS) / FRACTIONS)
        self._angle, self._rate = float(angle[-1]), float(rate[-1])
        self.edges_seen += len(found)
        return np.array(found, dtype=np.float64)


def _crossing(target: float, angle: np.ndarray, slope: np.ndarray) -> float:
    """Part of an interval at which the interpolant reaches the target, by Newton's method.

    Four rounds are enough: the angle is nearly straight over one row.
    """
    (y0, y1), (m0, m1) = angle - target, slope
    s = -y0 / (y1 - y0)
    for _ in range(4):
        value = (
            y0 * (1 + 2 * s) * (1 - s) ** 2 + m0 * s * (1 - s) ** 2 + y1 * s * s * (3 - 2 * s) + m1 * s * s * (s - 1)
        )
        rate = 6 * s * (s - 1) * (y0 - y1) + m0 * (1 - s) * (1 - 3 * s) + m1 * s * (3 * s - 2)
        s -= value / rate
    return min(max(s, 0.0), 1.0)
