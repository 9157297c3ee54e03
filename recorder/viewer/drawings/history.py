"""Latest values of a signal at full rate."""

from __future__ import annotations

import numpy as np


class History:
    """Buffer of the last `capacity` values of a signal."""

    def __init__(self, *, capacity: int, dtype: type = float) -> None:
        self._capacity = capacity
        self._rows = np.empty(0, dtype=dtype)

    def add(self, rows: np.ndarray) -> None:
        """Append values, shape (n,), and drop the oldest beyond the capacity."""
        self._rows = np.concatenate((self._rows, rows))[-self._capacity :]

    def clear(self) -> None:
        """Drop all values, because the next ones are not contiguous with them."""
        self._rows = self._rows[:0]

    def last(self, count: int) -> np.ndarray:
        """Return the last `count` values, or fewer if there are not as many."""
        return self._rows[max(0, len(self._rows) - count) :]

    def __len__(self) -> int:
        return len(self._rows)
