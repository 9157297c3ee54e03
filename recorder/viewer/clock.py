"""Wall time of simulated instants, from pairs of both that somebody saw."""

from __future__ import annotations

import numpy as np

_KEPT = 4096


class WallClock:
    """Piecewise linear between the marks, one second a second outside of them."""

    def __init__(self) -> None:
        self._simulated: list[float] = []
        self._wall: list[float] = []

    def __len__(self) -> int:
        return len(self._wall)

    def mark(self, simulated_s: float, wall_s: float) -> None:
        """Say that a simulated instant [s] was seen at a wall time [s since 1970]; marks that go back are ignored."""
        if self._simulated and (simulated_s <= self._simulated[-1] or wall_s < self._wall[-1]):
            return
        self._simulated.append(simulated_s)
        self._wall.append(wall_s)
        if len(self._simulated) > _KEPT:
            del self._simulated[: _KEPT // 2], self._wall[: _KEPT // 2]

    def at(self, simulated_s: np.ndarray) -> np.ndarray | None:
        """Wall times [s since 1970] of simulated times [s], same shape; None as long as nothing was marked."""
        if not self._simulated:
            return None
        first, last = self._simulated[0], self._simulated[-1]
        inside = np.interp(simulated_s, self._simulated, self._wall)
        return inside + np.minimum(simulated_s - first, 0.0) + np.maximum(simulated_s - last, 0.0)
