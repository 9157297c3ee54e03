"""Time axes of long logs: computed in blocks, equal to those of whole arrays."""

import tracemalloc

import numpy as np
import pytest

from replays.estimate.clock import fit_line
from replays.estimate.spool import ROWS, find_median, running_sum, spool, steps_of
from replays.recordings.formats.clock import TimeAxis, make_axis


@pytest.mark.parametrize("rows", [1, ROWS, ROWS + 1, 3 * ROWS])
@pytest.mark.parametrize("decimals", [0, 16])
def test_the_median_of_a_long_array_is_that_of_numpy(rows: int, decimals: int) -> None:
    values = np.round(np.random.default_rng(rows).standard_normal(rows), decimals)
    assert find_median(values) == np.median(values)


def test_steps_and_sums_of_a_long_array_are_those_of_numpy() -> None:
    values = np.arange(3 * ROWS + 5) ** 2
    np.testing.assert_array_equal(steps_of(values), np.diff(values))
    np.testing.assert_array_equal(running_sum(values), np.append(0, np.cumsum(values)))


def test_a_line_through_many_points_is_that_of_few() -> None:
    x = np.arange(800_000)
    line = fit_line(x, 5.0 + 0.25 * x)
    assert (line.slope, line.at_zero) == pytest.approx((0.25, 5.0), abs=1e-9)
    assert np.abs(line.residual).max() < 1e-9


def test_missing_samples_of_a_long_signal_are_placed() -> None:
    numbers = np.delete(np.arange(2 * ROWS), [7, ROWS])
    placed = TimeAxis(0.0, 1.0, 2 * ROWS, numbers=numbers).place_samples(numbers)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(placed)), [7, ROWS])
    np.testing.assert_array_equal(placed[numbers], numbers)


@pytest.mark.parametrize("scatter_s", [0.0, 5e-6])
def test_the_memory_of_a_time_axis_does_not_grow_with_its_rows(scatter_s: float) -> None:
    def peak(rows: int) -> int:
        rng = np.random.default_rng(1)
        times_s = spool(np.arange(n, n + 50_000) / 51_200 + scatter_s * rng.random() for n in range(0, rows, 50_000))
        tracemalloc.start()
        try:
            make_axis(times_s, line=True, what="")
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    assert peak(1_200_000) < 1.1 * peak(600_000)
