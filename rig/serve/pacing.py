"""Clocks that decide when the next block of simulated time may run and when its result is due.

The loop is `grant` (wait for permission), run, `release` (wait until the result is due). No clock changes the step of
the simulation. The time source and the sleep are arguments.
"""

from __future__ import annotations

import gc
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_NS = 1_000_000_000


@contextmanager
def reduce_garbage_collections() -> Iterator[None]:
    """Reduce garbage collections while a start imports and builds.

    Little of that is garbage; collecting it took a tenth of the time.
    """
    before = gc.get_threshold()
    gc.set_threshold(300_000, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


@contextmanager
def freeze_start_objects() -> Iterator[None]:
    """Exclude the objects of the start from garbage collections during a paced run.

    They are never garbage, and traversing them took 5 to 8 ms of a full collection. A process that has already frozen
    its objects is left unchanged.
    """
    if gc.get_freeze_count():
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


class StepTimeoutError(TimeoutError):
    """No step was granted within the time limit."""


class Histogram:
    """Quantiles of any number of non-negative values in bounded memory.

    Logarithmic bins from 1e-6 to 1e3, 50 per decade; smaller and larger values count in the first and last bin. A
    quantile is the upper edge of its bin, so it is up to 4.7 % too large, never too small, and never above the largest
    value. Counts are integers and do not lose precision in long runs.
    """

    _LOW, _HIGH, _BINS_PER_DECADE = 1e-6, 1e3, 50

    def __init__(self) -> None:
        self.counts = [0] * (math.ceil(math.log10(self._HIGH / self._LOW) * self._BINS_PER_DECADE) + 1)
        """Values in each bin."""
        self.count = 0
        self.largest = 0.0

    def add(self, value: float) -> None:
        """Count one value."""
        index = 0 if value <= self._LOW else math.ceil(math.log10(value / self._LOW) * self._BINS_PER_DECADE)
        self.counts[min(index, len(self.counts) - 1)] += 1
        self.count += 1
        self.largest = max(self.largest, value)

    def quantile(self, fraction: float) -> float:
        """Return the value that a fraction of all values does not exceed; 0 without values."""
        rank = math.ceil(fraction * self.count)
        cumulative_count = 0
        for index, count in enumerate(self.counts):
            cumulative_count += count
            if count and cumulative_count >= rank:
                return min(self._LOW * 10 ** (index / self._BINS_PER_DECADE), self.largest)
        return self.largest


class Clock:
    """Pace of a simulation; `grant` and `release` are called by the simulation thread.

    This base class never waits and only measures the real-time factor.
    """

    pace = "free"
    """Name of the pace: real-time, lockstep or free."""

    def __init__(self, *, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._now_ns = now_ns
        self._lateness_s = Histogram()
        self._last_s = 0.0
        self._overruns = 0
        self._origin_ns = now_ns()
        self._origin_tick = 0
        self._tick_rate_hz = 1
        self._factor = 0.0
        self._last_tick = 0

    def start(self, tick: int, tick_rate_hz: int) -> None:
        """Use this tick as the origin, and start the wall time."""
        self._origin_tick = self._last_tick = tick
        self._tick_rate_hz = tick_rate_hz
        self._origin_ns = self._now_ns()

    def grant(self, ticks: int) -> int:
        """Return the number of ticks that may run now, at most `ticks`; 0 after a `wake`."""
        return ticks

    def release(self, tick: int) -> bool:
        """Return True when the result at `tick` is due; False after a `wake`, then call it again."""
        self._measure(tick, self._now_ns())
        return True

    def wake(self) -> None:
        """Make a waiting `grant` or `release` return; from any thread."""

    def hold(self, seconds: float) -> None:
        """Wait for a `wake`, at most this long [s]; only lockstep waits."""

    def position(self) -> int:
        """Return the current tick; without a wall clock, the last one released."""
        return self._last_tick

    @property
    def last_lateness_s(self) -> float:
        """Lateness of the last result [s]."""
        return self._last_s

    def statistics(self) -> dict[str, object]:
        """Return the real-time factor since the start, the lateness of results [ms] and the number of overruns."""
        # Read without a lock: a value that is one block old is acceptable, and the simulation thread never waits.
        lateness_s = self._lateness_s
        return {
            "real_time_factor": round(self._factor, 6),
            "lateness_ms": {
                "p50": round(1e3 * lateness_s.quantile(0.5), 4),
                "p99": round(1e3 * lateness_s.quantile(0.99), 4),
                "max": round(1e3 * lateness_s.largest, 4),
                "last": round(1e3 * self._last_s, 4),
            },
            "overruns": self._overruns,
        }

    def _measure(self, tick: int, now_ns: int) -> None:
        self._last_tick = tick
        elapsed_ns = now_ns - self._origin_ns
        if elapsed_ns > 0:
            self._factor = (tick - self._origin_tick) * _NS / (self._tick_rate_hz * elapsed_ns)


class FreeRun(Clock):
    """No pacing: as fast as possible."""


class RealTime(Clock):
    """Results are due when the wall clock reaches their tick; deadlines are absolute, so errors do not accumulate.

    A late simulation runs without waiting until it has caught up. Each result that is not ready at its
    deadline is an overrun. Lateness is the time from the deadline to the return of `release`.

    Args:
        spin_s: Poll the clock this long before a deadline [s]. Costs that much CPU per block; sleeping alone is about
            0.1 ms late.
        now_ns: Time source [ns], monotonic.
        sleep: Sleeps for a number of seconds; None: a sleep that `wake` ends.
        utc_ns: The host's clock [unix ns].
    """

    pace = "real-time"

    def __init__(
        self,
        *,
        spin_s: float = 0.0,
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] | None = None,
        utc_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        super().__init__(now_ns=now_ns)
        self._utc_ns = utc_ns
        self._spin_ns = round(spin_s * _NS)
        self._woken = threading.Event()
        self._sleep = sleep or self._woken.wait
        self._awaited: int | None = None

    def deadline_ns(self, tick: int) -> int:
        """Return when a tick is due, on the time source [ns]."""
        return self._origin_ns + (tick - self._origin_tick) * _NS // self._tick_rate_hz

    def statistics(self) -> dict[str, object]:
        """Return the statistics, and a tick's UTC time by the host's clock, whose error adds to the uncertainty."""
        before, utc_ns = self._now_ns(), self._utc_ns()
        after = self._now_ns()
        now = (before + after) // 2
        tick = self._origin_tick + (now - self._origin_ns) * self._tick_rate_hz // _NS
        since_ns = now - self.deadline_ns(tick)
        utc = {"tick": tick, "utc_s": (utc_ns - since_ns) / _NS, "uncertainty_s": (after - before + 1) / 2 / _NS}
        return {**super().statistics(), "utc": utc}

    def position(self) -> int:
        """Return the current tick by the wall clock."""
        return self._origin_tick + (self._now_ns() - self._origin_ns) * self._tick_rate_hz // _NS

    def wake(self) -> None:
        """Make a waiting `release` return False; from any thread."""
        self._woken.set()

    def release(self, tick: int) -> bool:
        """Return True when the wall clock has reached the tick, False before that after a `wake`."""
        deadline = self.deadline_ns(tick)
        now = self._now_ns()
        # Once per tick: a result that was ready in time is not an overrun because a command arrived meanwhile.
        if now > deadline and self._awaited != tick:
            self._overruns += 1
        self._awaited = tick
        while now < deadline:
            remaining_ns = deadline - now - self._spin_ns
            if remaining_ns > 0:
                self._sleep(remaining_ns / _NS)
            now = self._now_ns()
            if now < deadline and self._woken.is_set():
                self._woken.clear()
                return False
        self._last_s = (now - deadline) / _NS
        self._lateness_s.add(self._last_s)
        self._measure(tick, now)
        return True


class Lockstep(Clock):
    """Runs only ticks granted by `allow`.

    Args:
        timeout_s: Time without a grant after which the run ends with `StepTimeoutError` [s], so that a failed client
            does not block it.
        now_ns: Time source [ns], monotonic.
        wait: Waits on a held condition for a number of seconds; tests replace it.
    """

    pace = "lockstep"

    def __init__(
        self,
        *,
        timeout_s: float = 300.0,
        now_ns: Callable[[], int] = time.monotonic_ns,
        wait: Callable[[threading.Condition, float], object] = threading.Condition.wait,
    ) -> None:
        super().__init__(now_ns=now_ns)
        self._timeout_s = timeout_s
        self._wait = wait
        self._changed = threading.Condition()
        self._allowed = 0
        self._woken = False
        self._idle_since_ns: int | None = None

    def allow(self, ticks: int) -> None:
        """Grant this many further ticks; from any thread."""
        with self._changed:
            self._allowed += ticks
            self._changed.notify()

    def wake(self) -> None:
        """Make a waiting `grant` return 0; from any thread."""
        with self._changed:
            self._woken = True
            self._changed.notify()

    def hold(self, seconds: float) -> None:
        """Wait for a `wake`, at most this long [s], while devices work and nothing may run."""
        with self._changed:
            if not self._woken:
                self._wait(self._changed, seconds)
            self._woken = False

    def grant(self, ticks: int) -> int:
        """Wait for an allowance and return at most `ticks` of it; 0 after a `wake`.

        Raises:
            StepTimeoutError: Nothing was granted in time.
        """
        with self._changed:
            if self._idle_since_ns is None:
                self._idle_since_ns = self._now_ns()
            while self._allowed == 0 and not self._woken:
                left_s = self._timeout_s - (self._now_ns() - self._idle_since_ns) / _NS
                if left_s <= 0:
                    raise StepTimeoutError(
                        f"no step was granted within {self._timeout_s:g} s, after which a rig in lockstep ends"
                    )
                self._wait(self._changed, left_s)
            self._woken = False
            granted = min(self._allowed, ticks)
            self._allowed -= granted
            if granted:
                self._idle_since_ns = None
            return granted
