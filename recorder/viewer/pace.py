"""Pace of a live view: as many pictures as its viewer can process, and never far ahead of it.

A rerun viewer processes received data for 10 ms of each frame, regardless of how much is waiting. A slow viewer that
receives more than that falls further and further behind. Its progress is therefore polled: a new picture is sent only
while the pending ones are recent, and the interval grows as soon as pictures take long to be processed.
"""

from __future__ import annotations

import math
from collections import deque

MIN_INTERVAL_S = 0.04
"""Time between two pictures for a viewer that keeps up [s]."""
MAX_INTERVAL_S = 2.0
"""Longest chosen time between two pictures [s]; waiting for the viewer can extend it up to `MAX_WAIT_S`."""
FIRST_INTERVAL_S = 0.2
"""Time between two pictures for a viewer of unknown speed [s]."""
SLOW_PROCESSING_S, FAST_PROCESSING_S = 0.6, 0.3
"""Processing times of a picture above which the pace slows down, and below which it speeds up [s]."""
MAX_WAIT_S = 10.0
"""Longest time between two pictures, even without a responding viewer [s]; a new viewer receives all of them."""
CURVE_INTERVAL_S = 0.16
"""Shortest time between two updates of the curves [s]; a piece of a curve costs the viewer as much as a picture."""
MAX_POINTS = 120
"""Largest number of points of each curve between two pictures, outside hammer pulses.

A slow viewer receives a coarser envelope with the same peaks.
"""


class Pace:
    """Schedule of the pictures from those drawn and those processed by the viewer; all times are arguments."""

    def __init__(self) -> None:
        self.every_s = MAX_WAIT_S
        """Target time between two pictures [s]."""
        self.interval_s = MAX_WAIT_S
        """Time between the last two pictures, including waits for the viewer [s]."""
        self._pending: deque[tuple[int, float]] = deque()  # numbers and times of pending pictures
        self._drawn_s = -math.inf
        self._changed_s = -math.inf
        self._delay_s = 0.0
        self._displayed_s: float | None = None  # time of the latest picture that the viewer has
        self.is_viewed = False
        """True if a viewer is open, including one that is still loading."""

    def due(self, now_s: float) -> bool:
        """Return whether a picture is due."""
        since_s = now_s - self._drawn_s
        if since_s < self.every_s - 1e-6:
            return False
        if not self._pending or since_s >= MAX_WAIT_S:
            return True
        return self._displayed_s is not None and now_s - self._pending[0][1] < SLOW_PROCESSING_S

    def record_drawn(self, picture: int, *, now_s: float) -> None:
        """Register a drawn picture."""
        self.interval_s, self._drawn_s = min(now_s - self._drawn_s, MAX_WAIT_S), now_s
        self._pending.append((picture, now_s))

    def record_displayed(self, picture: int | None, *, now_s: float) -> None:
        """Register that the slowest viewer has all pictures up to a number; None if no viewer is open."""
        if picture is None:
            self._pending.clear()
            self.is_viewed, self.every_s, self._displayed_s = False, MAX_WAIT_S, None
            return
        if not self.is_viewed:
            self.is_viewed, self.every_s = True, FIRST_INTERVAL_S
        drawn_s = None
        while self._pending and self._pending[0][0] <= picture:
            drawn_s = self._pending.popleft()[1]
        if drawn_s is None:
            return
        self._displayed_s, self._delay_s = drawn_s, now_s - drawn_s
        if drawn_s < self._changed_s:
            return  # drawn before the last change of pace
        if self._delay_s > max(SLOW_PROCESSING_S, 1.5 * self.every_s):
            self.every_s = min(MAX_INTERVAL_S, max(2.0 * self.every_s, 0.5 * self._delay_s))
            self._changed_s = now_s
        elif self._delay_s < max(FAST_PROCESSING_S, 0.5 * self.every_s):
            # Use large steps only while the viewer is idle between pictures.
            step = 0.7 if self._delay_s < 0.5 * self.every_s else 0.93
            self.every_s = max(MIN_INTERVAL_S, step * self.every_s)

    def behind_s(self, now_s: float) -> float | None:
        """Return the age of the displayed picture [s]; None if nothing is displayed."""
        if self._displayed_s is None:
            return None
        return now_s - self._displayed_s if self._pending else self._delay_s
