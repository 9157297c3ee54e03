"""Comparison of a record's time stamps with the times of its rows in the session."""

from __future__ import annotations

import math

import numpy as np

from replays.estimate.clock import fit_line
from replays.estimate.intervals import chi2_mean_ends, make_interval, student
from replays.score.card.scorecard import Interval
from replays.score.records.recorded import RecordedTable

_MAX_BATCHES, _JUDGED_BATCHES = 256, 32
"""Batches of stamps in the picture, and in the intervals."""
_MAX_BATCH_ROWS = 1 << 12
"""Largest number of rows of a batch."""
_SAME_CLOCK_S = 10.0
"""Largest deviation of stamps from the session's wall time [s]; others are of another clock, by default."""


class Stamps:
    """Time stamps compared with the times of their rows, for offset and rate separately.

    Attributes:
        times_s: Stamps of the next rows [s], shape (n,).
    """

    def __init__(self, table: RecordedTable, *, shown: bool = False) -> None:
        """Prepare batches of a table's stamps, or of stamps from elsewhere if `shown`."""
        self.times_s = np.empty(0)
        self._stamped, self._size = shown or table.stamped, max(4, min(table.rows // _MAX_BATCHES, _MAX_BATCH_ROWS))
        self._back, self._last_s = 0, -math.inf
        self._means: list[np.ndarray] = []
        self._squares, self._dof = 0.0, 0

    def add_rows(self, first_s: float, since_s: np.ndarray, identified: np.ndarray, rows: int) -> None:
        """Add rows to the batches.

        Args:
            first_s: Time at which the first row was sent [s].
            since_s: Time from then to the known ones of the next rows [s].
            identified: Indices of these rows.
            rows: Number of the next rows.
        """
        if not self._stamped or not rows:
            return
        times_s, size = self.times_s, self._size
        self._back += int(np.count_nonzero(np.diff(times_s, prepend=self._last_s) < 0.0))
        self._last_s = float(times_s[-1])
        apart = times_s[identified] - first_s - since_s
        for start in range(0, len(apart) - size + 1, size):
            late = apart[start : start + size]
            self._means.append(np.array([since_s[start : start + size].mean(), late.mean()]))
            self._squares += float(np.sum((late - late.mean()) ** 2))
            self._dof += size - 1

    def estimate_all(self, wall_s: float | None, *, apart_s: float = _SAME_CLOCK_S) -> dict[str, Interval | None]:
        """Return intervals of the offset at the first row [s], rate [ppm], jitter [s], backward steps, and latency [s].

        Args:
            wall_s: Wall time at which the recorder of the session received what was sent at time zero [s].
            apart_s: Largest deviation of stamps of the same clock [s].
        """
        names = ("stamp offset", "stamp rate", "stamp jitter", "stamps that go back", "latency")
        if not self._stamped:
            return dict.fromkeys(names)
        estimates: dict[str, Interval | None] = dict.fromkeys(names)
        estimates["stamps that go back"] = (float(self._back),) * 3
        if len(self._means) < 8:
            return estimates
        # Rows that arrived in bursts are not independent: several batches count as one.
        several = max(1, len(self._means) // _JUDGED_BATCHES)
        whole = np.array(self._means[: len(self._means) // several * several])
        since, late = whole.reshape(-1, several, 2).mean(axis=1).T
        line = fit_line(since, late)
        estimates["stamp rate"] = make_interval(line.slope, line.half_widths[0], 1e6)
        estimates["stamp offset"] = make_interval(line.at_zero, line.half_widths[1])
        if wall_s is not None and abs(late.mean() - wall_s) < apart_s:
            value, wide = late.mean() - wall_s, student(len(late) - 1) * late.std(ddof=1) / math.sqrt(len(late))
            estimates["latency"] = make_interval(float(value), float(wide))
        jitter_s, (low, high) = math.sqrt(self._squares / self._dof), chi2_mean_ends(self._dof)
        estimates["stamp jitter"] = jitter_s, jitter_s / math.sqrt(high), jitter_s / math.sqrt(low)
        return estimates

    def batch_means(self) -> np.ndarray:
        """Return the time since the first row and the lateness of each batch [s], shape (n, 2)."""
        return np.array(self._means).reshape(-1, 2)
