from __future__ import annotations

import random
import threading

import pytest

from rig.serve.pacing import FreeRun, Histogram, Lockstep, RealTime, StepTimeoutError
from tests.waiting import PATIENCE_S

TICK_RATE = 1_000_000
BLOCK = 10_000


class FakeTime:
    """A time source that only advances by sleeping, and by `cost_ns` at each reading."""

    def __init__(self, *, oversleep_ns: int = 0, cost_ns: int = 0) -> None:
        self.ns = 123_456_789
        self.oversleep_ns = oversleep_ns
        self.cost_ns = cost_ns
        self.slept: list[float] = []

    def now_ns(self) -> int:
        self.ns += self.cost_ns
        return self.ns

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.slept.append(seconds)
        self.ns += round(seconds * 1e9) + self.oversleep_ns

    def work(self, seconds: float) -> None:
        self.ns += round(seconds * 1e9)


def real_time(fake: FakeTime, *, spin_s: float = 0.0) -> RealTime:
    clock = RealTime(spin_s=spin_s, now_ns=fake.now_ns, sleep=fake.sleep)
    clock.start(0, TICK_RATE)
    return clock


def lateness(clock: FreeRun) -> dict[str, float]:
    late = clock.statistics()["lateness_ms"]
    assert isinstance(late, dict)
    return late


def test_real_time_does_not_drift_though_every_sleep_is_late() -> None:
    fake = FakeTime(oversleep_ns=700_000)
    clock = real_time(fake)
    start = fake.ns
    for n in range(1, 10_001):
        fake.work(0.002)
        assert clock.grant(BLOCK) == BLOCK
        clock.release(n * BLOCK)
    # 100 s of blocks, each 0.7 ms late: absolute deadlines leave only the last one's lateness.
    assert fake.ns - start == 100_000_000_000 + 700_000
    statistics = clock.statistics()
    assert statistics["overruns"] == 0
    assert statistics["real_time_factor"] == pytest.approx(1.0, abs=1e-5)
    assert lateness(clock)["last"] == pytest.approx(0.7, abs=1e-3)
    assert lateness(clock)["p50"] == pytest.approx(0.7, rel=0.05)


def test_deadlines_are_exact_after_eight_hours_at_a_rate_that_does_not_divide_a_second() -> None:
    fake = FakeTime()
    clock = RealTime(now_ns=fake.now_ns, sleep=fake.sleep)
    clock.start(7, 44_100)
    ticks = 8 * 3600 * 44_100
    assert clock.deadline_ns(7 + ticks) - clock.deadline_ns(7) == 8 * 3600 * 1_000_000_000


def test_a_block_that_took_too_long_is_caught_up_without_waiting_and_counted() -> None:
    fake = FakeTime()
    clock = real_time(fake)
    start = fake.ns
    clock.release(BLOCK)
    fake.work(0.055)
    for n in range(2, 7):
        clock.release(n * BLOCK)
    assert len(fake.slept) == 1, "no wait while late"
    clock.release(7 * BLOCK)
    assert fake.ns - start == 70_000_000, "back on the first grid"
    statistics = clock.statistics()
    assert statistics["overruns"] == 5
    assert lateness(clock)["max"] == pytest.approx(45.0)
    assert lateness(clock)["last"] == 0.0
    assert statistics["real_time_factor"] == pytest.approx(1.0)


def test_spinning_sleeps_less_and_returns_at_the_deadline() -> None:
    fake = FakeTime(oversleep_ns=150_000, cost_ns=1_000)
    clock = real_time(fake, spin_s=200e-6)
    for n in range(1, 101):
        clock.release(n * BLOCK)
    assert lateness(clock)["max"] <= 2e-3
    assert clock.statistics()["overruns"] == 0


def test_free_run_grants_everything_and_measures_the_factor() -> None:
    fake = FakeTime()
    clock = FreeRun(now_ns=fake.now_ns)
    clock.start(500, TICK_RATE)
    assert clock.grant(BLOCK) == BLOCK
    fake.work(0.001)
    clock.release(500 + BLOCK)
    assert clock.statistics()["real_time_factor"] == pytest.approx(10.0)
    assert clock.statistics()["overruns"] == 0


def lockstep(fake: FakeTime, *, timeout_s: float = 5.0) -> Lockstep:
    clock = Lockstep(timeout_s=timeout_s, now_ns=fake.now_ns, wait=lambda _, seconds: fake.sleep(seconds))
    clock.start(0, TICK_RATE)
    return clock


def test_lockstep_grants_exactly_the_allowed_steps() -> None:
    clock = lockstep(FakeTime())
    clock.allow(25_000)
    clock.allow(3_000)
    assert [clock.grant(BLOCK) for _ in range(3)] == [10_000, 10_000, 8_000]


def test_lockstep_times_out_and_waking_does_not_postpone_it() -> None:
    fake = FakeTime()
    clock = lockstep(fake, timeout_s=5.0)
    start = fake.ns
    clock.wake()
    assert clock.grant(BLOCK) == 0
    fake.work(2.0)
    with pytest.raises(StepTimeoutError, match="within 5 s"):
        clock.grant(BLOCK)
    assert fake.ns - start == 5_000_000_000


def test_lockstep_counts_the_timeout_from_the_last_grant() -> None:
    fake = FakeTime()
    clock = lockstep(fake, timeout_s=5.0)
    for _ in range(3):
        fake.work(4.0)
        clock.allow(BLOCK)
        assert clock.grant(BLOCK) == BLOCK
    with pytest.raises(StepTimeoutError):
        clock.grant(BLOCK)


@pytest.mark.wallclock
def test_lockstep_wakes_a_waiting_thread() -> None:
    clock = Lockstep(timeout_s=PATIENCE_S)
    clock.start(0, TICK_RATE)
    granted: list[int] = []
    thread = threading.Thread(target=lambda: granted.extend(clock.grant(BLOCK) for _ in range(2)))
    thread.start()
    clock.wake()
    while not granted and thread.is_alive():
        thread.join(0.001)
    clock.allow(BLOCK)
    thread.join(PATIENCE_S)
    assert granted == [0, BLOCK]


def test_histogram_quantiles_are_never_too_small_and_at_most_one_bin_too_large() -> None:
    draw = random.Random(1)
    values = sorted(10 ** draw.uniform(-5, 0) for _ in range(20_000))
    histogram = Histogram()
    for value in values:
        histogram.add(value)
    for fraction in (0.01, 0.5, 0.9, 0.99, 0.999):
        exact = values[-(-int(fraction * len(values) * 1000) // 1000) - 1]
        assert exact * (1 - 1e-12) <= histogram.quantile(fraction) <= exact * 10 ** (1 / 50) * (1 + 1e-12)
    assert histogram.quantile(1.0) == values[-1] == histogram.largest


def test_histogram_holds_any_value_and_starts_at_zero() -> None:
    histogram = Histogram()
    assert histogram.quantile(0.99) == 0.0
    for value in (0.0, 1e-9, 1e9):
        histogram.add(value)
    assert histogram.count == 3
    assert histogram.quantile(0.5) <= 1e-6
    assert histogram.quantile(1.0) <= histogram.largest == 1e9


def test_histogram_memory_does_not_grow() -> None:
    histogram = Histogram()
    bins = len(histogram.counts)
    for n in range(100_000):
        histogram.add(n * 1e-6)
    assert len(histogram.counts) == bins
    assert sum(histogram.counts) == histogram.count == 100_000


def test_a_wake_ends_one_wait_for_a_deadline() -> None:
    clock = RealTime()
    clock.start(0, 1)
    clock.wake()
    # An hour ahead: waiting for it would end the test.
    assert clock.release(3600) is False
    waker = threading.Timer(0.05, clock.wake)
    waker.start()
    assert clock.release(3600) is False
    waker.join()
    assert clock.release(0) is True
    assert clock.statistics()["overruns"] == 1


def test_a_command_does_not_make_a_ready_result_an_overrun() -> None:
    now = [0]
    clock = RealTime(now_ns=lambda: now[0], sleep=lambda seconds: None)
    clock.start(0, 1)
    clock.wake()
    assert clock.release(1) is False
    now[0] = 2_000_000_000
    assert clock.release(1) is True
    assert clock.statistics()["overruns"] == 0


def test_a_tick_is_reported_with_its_utc_and_uncertainty() -> None:
    times = iter([0, 5_000_000_000, 7_123_456_789, 7_123_458_789])
    clock = RealTime(now_ns=lambda: next(times), utc_ns=lambda: 1_700_000_000_000_000_000)
    clock.start(250_000, 1_000_000)
    utc = clock.statistics()["utc"]
    assert isinstance(utc, dict)
    # 2.123457789 s after the start is between two ticks; the tick before was due 0.789 us earlier.
    assert utc["tick"] == 250_000 + 2_123_457
    assert utc["utc_s"] == pytest.approx(1_700_000_000.0 - 0.789e-6, abs=3e-7)  # a double holds 0.24 us
    assert utc["uncertainty_s"] == pytest.approx(1e-6, rel=1e-3)
