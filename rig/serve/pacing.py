"""When the next block of simulated time may run, and when its result is due: three clocks over the same loop.

The loop is `grant` (may I run?), run, `release` (wait until the result is due). No clock changes the step of the
simulation; the time source and the sleep are arguments.
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
def rare_collections() -> Iterator[None]:
    """Few garbage collections while a start imports and builds.

    Little of that is garbage, and looking for it took a tenth of the time.
    """
    before = gc.get_threshold()
    gc.set_threshold(300_000, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


@contextmanager
def short_collections() -> Iterator[None]:
    """Keep what the start has left behind out of garbage collections while a paced run lasts.

    It is never garbage, and walking it took 5 to 8 ms of a full collection. Where a process has frozen its own start
    before, that stays as it is.
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
    """Nobody granted a step in time."""


class Histogram:
    """Quantiles of any number of non-negative values in bounded memory.

    Logarithmic bins from 1e-6 to 1e3, 50 a decade; all below and above counts as in the first and the last. A quantile
    is the upper edge of its bin, hence up to 4.7 % too large, never too small, and never above the largest value.
    Counts are integers: hours do not wear them out.
    """

    _LOW, _HIGH, _A_DECADE = 1e-6, 1e3, 50

    def __init__(self) -> None:
        self.counts = [0] * (math.ceil(math.log10(self._HIGH / self._LOW) * self._A_DECADE) + 1)
        """Values in each bin."""
        self.count = 0
        self.largest = 0.0

    def add(self, value: float) -> None:
        """Count one value."""
        at = 0 if value <= self._LOW else math.ceil(math.log10(value / self._LOW) * self._A_DECADE)
        self.counts[min(at, len(self.counts) - 1)] += 1
        self.count += 1
        self.largest = max(self.largest, value)

    def quantile(self, fraction: float) -> float:
        """The value that `fraction` of all values do not exceed; 0 where there are none."""
        rank = math.ceil(fraction * self.count)
        seen = 0
        for at, count in enumerate(self.counts):
            seen += count
            if count and seen >= rank:
                return min(self._LOW * 10 ** (at / self._A_DECADE), self.largest)
        return self.largest


class Clock:
    """Paces a simulation; `grant` and `release` are called by the thread that runs alone.

    As it stands, it lets everything run at once and only measures the real-time factor; each kind says what it waits
    for.
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
        """Take this tick as the origin; wall time runs from now on."""
        self._origin_tick = self._last_tick = tick
        self._tick_rate_hz = tick_rate_hz
        self._origin_ns = self._now_ns()

    def grant(self, ticks: int) -> int:
        """How many ticks may run now, at most `ticks`; 0 after a `wake`, so that the caller can look around."""
        return ticks

    def release(self, tick: int) -> bool:
        """Return True when what was simulated up to `tick` is due; False after a `wake`, and is to be called again."""
        self._measure(tick, self._now_ns())
        return True

    def wake(self) -> None:
        """Make a waiting `grant` or `release` return; from any thread."""

    def hold(self, seconds: float) -> None:
        """Wait for a `wake`, at most so long; only lockstep ever waits for anybody."""

    def position(self) -> int:
        """The tick that it is now; without a wall clock the last that was released."""
        return self._last_tick

    @property
    def last_late_s(self) -> float:
        """Lateness of the last result [s]."""
        return self._last_s

    def statistics(self) -> dict[str, object]:
        """Real-time factor since the start, lateness of results [ms], and how many were not ready in time."""
        # Read without a lock: a value that is one block old does no harm, and the simulation thread never waits.
        late = self._lateness_s
        return {
            "real_time_factor": round(self._factor, 6),
            "lateness_ms": {
                "p50": round(1e3 * late.quantile(0.5), 4),
                "p99": round(1e3 * late.quantile(0.99), 4),
                "max": round(1e3 * late.largest, 4),
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
    """As fast as it goes."""


class RealTime(Clock):
    """Results are due when the wall clock reaches their tick: absolute deadlines from one origin, so nothing adds up.

    Where the simulation is behind, it runs on without waiting until it has caught up; each result that was not ready at
    its deadline is an overrun. Lateness is the time from the deadline to the return of `release`.

    Args:
        spin_s: Wake this much earlier and poll the clock [s]. Costs that much CPU a block; sleeping alone is
            about 0.1 ms late.
        now_ns: Time source [ns], monotonic.
        sleep: Sleeps for a number of seconds; None: in a way that `wake` ends.
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
        """When a tick is due, in the time of the time source [ns]."""
        return self._origin_ns + (tick - self._origin_tick) * _NS // self._tick_rate_hz

    def statistics(self) -> dict[str, object]:
        """The same, and when in UTC a tick was due: by the host's clock, whose own error comes to the uncertainty."""
        before, utc_ns = self._now_ns(), self._utc_ns()
        after = self._now_ns()
        now = (before + after) // 2
        tick = self._origin_tick + (now - self._origin_ns) * self._tick_rate_hz // _NS
        since_ns = now - self.deadline_ns(tick)
        utc = {"tick": tick, "utc_s": (utc_ns - since_ns) / _NS, "uncertainty_s": (after - before + 1) / 2 / _NS}
        return {**super().statistics(), "utc": utc}

    def position(self) -> int:
        """The tick that it is now by the wall clock."""
        return self._origin_tick + (self._now_ns() - self._origin_ns) * self._tick_rate_hz // _NS

    def wake(self) -> None:
        """Make a waiting `release` return False; from any thread."""
        self._woken.set()

    def release(self, tick: int) -> bool:
        """Return True when the wall clock has reached the tick, False before that after a `wake`."""
        deadline = self.deadline_ns(tick)
        now = self._now_ns()
        # Once a tick: a result that was ready in time is no overrun because a command came in between.
        if now > deadline and self._awaited != tick:
            self._overruns += 1
        self._awaited = tick
        while now < deadline:
            rest = deadline - now - self._spin_ns
            if rest > 0:
                self._sleep(rest / _NS)
            now = self._now_ns()
            if now < deadline and self._woken.is_set():
                self._woken.clear()
                return False
        self._last_s = (now - deadline) / _NS
        self._lateness_s.add(self._last_s)
        self._measure(tick, now)
        return True


class Lockstep(Clock):
    """Runs only what was granted by `allow`.

    Args:
        timeout_s: A run that is granted nothing for this long ends with `StepTimeoutError` [s]: a partner that died
            must not leave it hanging.
        now_ns: Time source [ns], monotonic.
        wait: Waits on a held condition for a number of seconds; tests put a clock of their own here.
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
        """Wait for a `wake`, at most so long [s]: others are at work, and nothing may run meanwhile."""
        with self._changed:
            if not self._woken:
                self._wait(self._changed, seconds)
            self._woken = False

    def grant(self, ticks: int) -> int:
        """Wait for an allowance and take at most `ticks` of it; 0 after a `wake`.

        Raises:
            StepTimeoutError: Nothing was allowed in time.
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
