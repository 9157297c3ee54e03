"""Position of a replay in its own time, which follows a clock and stops while the replay is paused."""

from __future__ import annotations

import time
from typing import Any

from rig.base.errors import InputError
from rig.serve.pacing import Clock

NS = 1_000_000_000
LEAST_RATE, GREATEST_RATE = 0.01, 1000.0
_MIN_LATENESS_S = 0.5
"""Lateness from which it is reported; a busy machine is late by tens of milliseconds and catches up [s]."""


class Playhead:
    """Time of a replay [ns]: 0 at its beginning, monotonic, and without its pauses.

    Deadlines are absolute from one origin; a start, a jump or a new rate sets a new origin.

    Args:
        clock: Clock that releases the payloads.
        rate: Recorded seconds per second, for a real-time clock.
    """

    def __init__(self, clock: Clock, rate: float) -> None:
        self._clock = clock
        self.rate = check_rate(rate)
        self.play_ns = 0
        """Time of the last published payload."""
        self._held_ns = 0
        """Time while stopped."""
        self._since_s: float | None = None
        self._ran_s = 0.0

    @property
    def runs(self) -> bool:
        """True if time runs."""
        return self._since_s is not None

    @property
    def achieved_rate(self) -> float:
        """Recorded seconds played per second, without pauses."""
        since_s = self._since_s
        ran_s = self._ran_s + (0.0 if since_s is None else time.monotonic() - since_s)
        return self.play_ns / NS / ran_s if ran_s > 0.0 else 0.0

    @property
    def behind_s(self) -> float:
        """Lateness of the last payload [s], or 0 if it is not worth reporting."""
        late_s = self._clock.last_lateness_s
        return late_s if late_s > _MIN_LATENESS_S else 0.0

    def release(self, at_ns: int) -> bool:
        """Return True at that time, or False if the clock is woken before."""
        return self._clock.release(at_ns)

    def now_ns(self, due_ns: int | None) -> int:
        """Return the current time, limited to the deadline of the next payload.

        Args:
            due_ns: Deadline of the next payload; None if it is not known.
        """
        if not self.runs:
            return self._held_ns
        now_ns = max(self._clock.position(), self.play_ns)
        return now_ns if due_ns is None else min(now_ns, due_ns)

    def start(self) -> None:
        """Start or resume time."""
        self._go(self._held_ns)
        if self._since_s is None:
            self._since_s = time.monotonic()

    def hold(self, at_ns: int) -> None:
        """Stop time at an instant."""
        self._held_ns = at_ns
        since_s, self._since_s = self._since_s, None
        if since_s is not None:
            self._ran_s += time.monotonic() - since_s

    def jump(self, at_ns: int) -> None:
        """Set the time to an instant; it keeps running or stays stopped."""
        self.play_ns = self._held_ns = at_ns
        if self.runs:
            self._go(at_ns)

    def set_rate(self, rate: Any, at_ns: int) -> None:
        """Set a new rate from this instant.

        Raises:
            InputError: If the rate is invalid.
        """
        self.rate = check_rate(rate)
        if self.runs:
            self._go(at_ns)

    def _go(self, at_ns: int) -> None:
        # One tick of this clock is 1 ns of the recording, so its tick rate is the replay rate times 1e9.
        self._clock.start(at_ns, round(self.rate * NS))


def check_rate(rate: Any) -> float:
    """Return a valid rate.

    Raises:
        InputError: If it is not a number, or out of range.
    """
    number = isinstance(rate, float | int) and not isinstance(rate, bool)
    if not number or not LEAST_RATE <= rate <= GREATEST_RATE:
        raise InputError("rate", f"a number of {LEAST_RATE:g} to {GREATEST_RATE:g}", rate)
    return float(rate)
