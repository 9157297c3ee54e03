"""How often a live view draws: as often as its viewer takes in what is drawn, and never far ahead of it.

A rerun viewer takes in what arrived for 10 ms of each frame that it paints, however much waits. A slow one that gets
more than that keeps it all and falls behind without end. So the viewer is asked how far it has come; a new picture
leaves only while those on their way are young, and pictures get rarer as soon as they take long to be taken in.
"""

from __future__ import annotations

import math
from collections import deque

FASTEST_S = 0.04
"""Time between two pictures for a viewer that keeps up [s]."""
SLOWEST_S = 2.0
"""Longest time between two pictures that is chosen [s]; waiting for a viewer may add to it, up to `DEAF_S`."""
FIRST_S = 0.2
"""Time between two pictures for a viewer of which nothing is known yet [s]."""
LATE_S, PROMPT_S = 0.6, 0.3
"""A picture that took longer than the first to be taken in makes the next ones rarer; below the second, denser [s]."""
DEAF_S = 10.0
"""A picture leaves at least that often, even if nobody looks or takes it in [s]: a viewer that comes takes all in."""
CURVES_S = 0.16
"""Curves are drawn at most that often [s]: a piece of a curve costs the viewer as much as a whole picture."""
POINTS = 120
"""Points of each curve between two pictures at most, full rate around hammer pulses apart: a slow viewer gets an
envelope that is coarser, with the same peaks."""


class Pace:
    """When to draw, by what was drawn and what the viewer has taken in; every time is passed in."""

    def __init__(self) -> None:
        self.every_s = DEAF_S
        """Time between two pictures that is aimed at [s]."""
        self.interval_s = DEAF_S
        """Time between the last two [s], with all waiting for the viewer."""
        self._on_the_way: deque[tuple[int, float]] = deque()  # pictures' numbers, and when they were drawn
        self._drawn_s = -math.inf
        self._changed_s = -math.inf
        self._delay_s = 0.0
        self._shown_s: float | None = None  # when the latest that the viewer has was drawn
        self.looked_at = False
        """Whether there is a viewer, be it one that is still loading."""

    def due(self, now_s: float) -> bool:
        """Whether to draw now."""
        since_s = now_s - self._drawn_s
        if since_s < self.every_s - 1e-6:
            return False
        if not self._on_the_way or since_s >= DEAF_S:
            return True
        return self._shown_s is not None and now_s - self._on_the_way[0][1] < LATE_S

    def drew(self, picture: int, *, now_s: float) -> None:
        """The picture of that number was drawn."""
        self.interval_s, self._drawn_s = min(now_s - self._drawn_s, DEAF_S), now_s
        self._on_the_way.append((picture, now_s))

    def taken_in(self, picture: int | None, *, now_s: float) -> None:
        """The slowest viewer has all pictures up to that number, or nobody looks (None)."""
        if picture is None:
            self._on_the_way.clear()
            self.looked_at, self.every_s, self._shown_s = False, DEAF_S, None
            return
        if not self.looked_at:
            self.looked_at, self.every_s = True, FIRST_S
        drawn_s = None
        while self._on_the_way and self._on_the_way[0][0] <= picture:
            drawn_s = self._on_the_way.popleft()[1]
        if drawn_s is None:
            return
        self._shown_s, self._delay_s = drawn_s, now_s - drawn_s
        if drawn_s < self._changed_s:
            return  # drawn at the pace before
        if self._delay_s > max(LATE_S, 1.5 * self.every_s):
            self.every_s = min(SLOWEST_S, max(2.0 * self.every_s, 0.5 * self._delay_s))
            self._changed_s = now_s
        elif self._delay_s < max(PROMPT_S, 0.5 * self.every_s):
            # In large steps only as long as the viewer is idle between two pictures.
            step = 0.7 if self._delay_s < 0.5 * self.every_s else 0.93
            self.every_s = max(FASTEST_S, step * self.every_s)

    def behind_s(self, now_s: float) -> float | None:
        """How old what the viewer shows is [s]; None as long as it shows nothing."""
        if self._shown_s is None:
            return None
        return now_s - self._shown_s if self._on_the_way else self._delay_s
