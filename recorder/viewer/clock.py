"""Wall time of simulated instants, interpolated from observed pairs."""

from __future__ import annotations

import numpy as np

_MAX_PAIRS = 4096


class WallClock:
    """Piecewise linear clock through the observed pairs, extrapolated at one second per second."""

    def __init__(self) -> None:
        self._simulated: list[float] = []
        self._wall: list[float] = []

    def __len__(self) -> int:
        return len(self._wall)

    def mark(self, simulated_s: float, wall_s: float) -> None:
        """Add a pair of simulated time [s] and wall time [unix s]; ignore pairs that go backward."""
        if self._simulated and (simulated_s <= self._simulated[-1] or wall_s < self._wall[-1]):
            return
        self._simulated.append(simulated_s)
        self._wall.append(wall_s)
        if len(self._simulated) > _MAX_PAIRS:
            del self._simulated[: _MAX_PAIRS // 2], self._wall[: _MAX_PAIRS // 2]

    def at(self, simulated_s: np.ndarray) -> np.ndarray | None:
        """Return the wall times [unix s] of simulated times [s], same shape; None before the first pair."""
        if not self._simulated:
            return None
        first, last = self._simulated[0], self._simulated[-1]
        inside = np.interp(simulated_s, self._simulated, self._wall)
        return inside + np.minimum(simulated_s - first, 0.0) + np.maximum(simulated_s - last, 0.0)
