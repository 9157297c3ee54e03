"""Where a play is in its own time, which runs by a clock and stands while it is paused."""

from __future__ import annotations

import time
from typing import Any

from rig.base.errors import InputError
from rig.serve.pacing import Clock

NS = 1_000_000_000
LEAST_RATE, GREATEST_RATE = 0.01, 1000.0
_BEHIND_S = 0.5
"""Lateness that is told: a busy machine is late by tens of milliseconds, and catches up."""


class Playhead:
    """Instants of a play [ns]: 0 at its beginning, never stepping back, and without its pauses.

    Deadlines are absolute, from one origin; starting, jumping and another rate set a new one.

    Args:
        clock: What paces.
        rate: Recorded seconds a second, where the clock is a real one.
    """

    def __init__(self, clock: Clock, rate: float) -> None:
        self._clock = clock
        self.rate = check_rate(rate)
        self.play_ns = 0
        """Instant of what went out last."""
        self._held_ns = 0
        """Instant at which it stands while it does not run."""
        self._since_s: float | None = None
        self._ran_s = 0.0

    @property
    def runs(self) -> bool:
        """Whether time runs."""
        return self._since_s is not None

    @property
    def achieved_rate(self) -> float:
        """Recorded seconds played a second, without pauses."""
        since_s = self._since_s
        ran_s = self._ran_s + (0.0 if since_s is None else time.monotonic() - since_s)
        return self.play_ns / NS / ran_s if ran_s > 0.0 else 0.0

    @property
    def behind_s(self) -> float:
        """How late the last payload was, where that is more than a passing hold-up [s]; else 0."""
        late_s = self._clock.last_late_s
        return late_s if late_s > _BEHIND_S else 0.0

    def release(self, at_ns: int) -> bool:
        """Return True when it is that instant, False before that after a `wake` of the clock."""
        return self._clock.release(at_ns)

    def now_ns(self, due_ns: int | None) -> int:
        """The instant that it is now, never past what is still to go out.

        Args:
            due_ns: When that is due; None where it is not known.
        """
        if not self.runs:
            return self._held_ns
        now_ns = max(self._clock.position(), self.play_ns)
        return now_ns if due_ns is None else min(now_ns, due_ns)

    def start(self) -> None:
        """Let time run on from where it stands."""
        self._go(self._held_ns)
        if self._since_s is None:
            self._since_s = time.monotonic()

    def hold(self, at_ns: int) -> None:
        """Stand at an instant."""
        self._held_ns = at_ns
        since_s, self._since_s = self._since_s, None
        if since_s is not None:
            self._ran_s += time.monotonic() - since_s

    def jump(self, at_ns: int) -> None:
        """What comes next begins at this instant; it runs on, or stands there."""
        self.play_ns = self._held_ns = at_ns
        if self.runs:
            self._go(at_ns)

    def set_rate(self, rate: Any, at_ns: int) -> None:
        """Go by another rate from this instant on.

        Raises:
            InputError: There is no such rate.
        """
        self.rate = check_rate(rate)
        if self.runs:
            self._go(at_ns)

    def _go(self, at_ns: int) -> None:
        # A tick of this clock is a nanosecond of the recording: a rate is so many of them a second.
        self._clock.start(at_ns, round(self.rate * NS))


def check_rate(rate: Any) -> float:
    """The rate, if it is one.

    Raises:
        InputError: It is no number, or too small or too great.
    """
    number = isinstance(rate, float | int) and not isinstance(rate, bool)
    if not number or not LEAST_RATE <= rate <= GREATEST_RATE:
        raise InputError("rate", f"a number of {LEAST_RATE:g} to {GREATEST_RATE:g}", rate)
    return float(rate)
