"""Estimates against closed forms and tables: lines, least squares, intervals, spectra, runs of rows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from replays.estimate.clock import fit_line, time_error
from replays.estimate.intervals import chi2_mean_ends, chi2_quantile, draw_normal, jackknife
from replays.estimate.least_squares import inverse_square, solve, solve_normal
from replays.estimate.runs import block_means, find_true_runs, split_at_breaks
from replays.estimate.sine import fit_tones
from replays.estimate.spectra import Spectrum, correlation, parabola_top, power, spectrum, transfer


def test_a_line_through_wall_time_keeps_its_digits() -> None:
    numbers = np.arange(10_000)
    line = fit_line(numbers, 1.7e9 + 1e-4 * numbers)
    assert line.slope == pytest.approx(1e-4, rel=1e-6)
    assert np.abs(line.residual).max() < 1e-6  # 1.7e9 s has digits of 2e-7 s
    assert float(line(20_000)) == pytest.approx(1.7e9 + 2.0, abs=1e-6)


def test_intervals_of_a_line_are_those_of_the_closed_form() -> None:
    x = np.linspace(3.0, 9.0, 12)
    line = fit_line(x, 2.0 - 0.5 * x + np.random.default_rng(1).standard_normal(12))
    _, covariance = np.polyfit(x, line(x) + line.residual, 1, cov=True)
    # Student's t of 10 degrees of freedom.
    assert line.half_widths == pytest.approx(2.22814 * np.sqrt(np.diag(covariance)), rel=1e-5)


def test_a_line_through_one_instant_is_level() -> None:
    line = fit_line(np.full(3, 5.0), np.array([1.0, 2.0, 3.0]))
    assert (line.slope, line.at_zero) == (0.0, 2.0)


def test_the_time_error_of_a_shifted_signal_is_its_shift() -> None:
    turn = np.linspace(0.0, 20.0, 4000)
    assert time_error(np.cos(turn), np.sin(turn + 1e-4) - np.sin(turn)) == pytest.approx(1e-4, rel=1e-3)
    assert time_error(np.zeros(4), np.ones(4)) == 0.0


@pytest.mark.parametrize("sizes", [(1.0, 1.0), (1e-9, 1e9), (1e-100, 1e100)])
def test_columns_may_have_any_size(sizes: tuple[float, float]) -> None:
    generator = np.random.default_rng(2)
    matrix, wanted = generator.standard_normal((50, 2)) * sizes, np.array([3.0, -2.0]) / sizes
    assert solve(matrix, matrix @ wanted) == pytest.approx(wanted, rel=1e-12)
    both = solve(matrix, np.column_stack([matrix @ wanted, matrix @ (2.0 * wanted)]))
    assert both.T[1] == pytest.approx(2.0 * wanted, rel=1e-12)
    own = inverse_square(matrix) * np.outer(sizes, sizes)
    assert own == pytest.approx(np.linalg.inv((matrix / sizes).T @ (matrix / sizes)), rel=1e-10)


def test_normal_equations_are_scaled_and_an_unidentifiable_value_is_kept() -> None:
    wanted, sizes = np.array([3.0, -2.0]), np.array([1e-6, 1e6])
    square, side = np.zeros((3, 3)), np.zeros(3)
    plain = np.array([[2.0, 1.0], [1.0, 3.0]])
    square[:2, :2], side[:2] = plain * np.outer(sizes, sizes), sizes * (plain @ wanted)
    assert solve_normal(square, side) == pytest.approx([*(wanted / sizes), 0.0], rel=1e-10)


def test_quantiles_of_chi_squared_are_those_of_tables() -> None:
    assert chi2_quantile(0.999, 20) == pytest.approx(45.315, abs=1e-3)
    assert chi2_mean_ends(10) == pytest.approx((0.3247, 2.0483), abs=1e-4)


def test_the_jackknife_of_a_mean_is_its_interval() -> None:
    values = np.random.default_rng(3).standard_normal(20)
    steps = np.array([[np.delete(values, n).mean()] for n in range(20)])
    assert jackknife(steps) == pytest.approx(2.09302 * values.std(ddof=1) / math.sqrt(20), rel=1e-5)
    assert jackknife(steps[:1]) == [0.0]


def test_draws_have_the_covariance_though_sizes_are_apart() -> None:
    covariance = np.array([[1e-12, 0.8e-3], [0.8e-3, 1e6]])
    drawn = draw_normal(covariance, np.random.default_rng(4), 40_000)
    assert np.cov(drawn.T) / covariance == pytest.approx(np.ones((2, 2)), rel=0.04)


@pytest.mark.parametrize("rows", [500, 501])
def test_a_filter_that_delays_moves_a_signal_of_any_number_of_rows(rows: int) -> None:
    turn = 2.0 * math.pi * 3.0 * np.arange(rows) / rows
    signal = Spectrum.from_samples(np.cos(turn), 1e-3)
    late = signal.apply_response(np.exp(-signal.turn * 5e-3))
    assert late == pytest.approx(np.cos(turn - 2.0 * math.pi * 15.0 / rows), abs=1e-12)


def test_power_and_transfer_are_those_of_white_noise() -> None:
    noise = 3.0 * np.random.default_rng(5).standard_normal((2, 1 << 14))
    assert power(noise, np.hanning(1 << 14)).mean(axis=1) == pytest.approx([9.0, 9.0], rel=0.05)
    _, density, gain, coherence = transfer(noise[0], -0.5 * noise[0], 2000.0, 512)
    assert density[5:-5].mean() == pytest.approx(9.0 / 1000.0, rel=0.05)
    assert gain == pytest.approx(np.full(257, 0.5))
    assert coherence == pytest.approx(np.ones(257))


def test_a_correlation_has_its_peak_at_the_lag() -> None:
    sent = np.random.default_rng(6).standard_normal((2, 256))
    found = correlation(np.roll(sent[1], -7), spectrum(sent), 256)
    assert np.unravel_index(found.argmax(), found.shape) == (1, 7)


def test_the_top_of_a_parabola_is_between_samples() -> None:
    assert parabola_top(*(4.0 - 3.0 * (x - 0.25) ** 2 for x in (-1.0, 0.0, 1.0))) == pytest.approx((0.25, 0.1875))
    assert parabola_top(1.0, 1.0, 1.0) == (0.0, 0.0)


def test_two_tones_are_found_by_their_frequencies() -> None:
    n = np.arange(4000) - 1999.5
    values = np.cos(2.0 * math.pi * 0.05 * n) + 0.3 * np.sin(2.0 * math.pi * 0.0713 * n) + 0.1
    turns, parts, matrix, residual = fit_tones(n, values, np.array([0.05001, 0.07129]), 1e-12)
    assert turns == pytest.approx([0.05, 0.0713], abs=1e-12)
    assert parts == pytest.approx([1.0, 0.0, 0.0, 0.3, 0.1], abs=1e-9)
    assert matrix.shape == (4000, 7)
    assert np.abs(residual).max() < 1e-9


def test_runs_pieces_and_blocks_of_rows() -> None:
    assert find_true_runs(np.array([True, False, True, True, False])) == [(0, 1), (2, 4)]
    assert find_true_runs(np.ones(3, bool)) == [(0, 3)]
    assert find_true_runs(np.empty(0, bool)) == []
    assert split_at_breaks(np.array([False, True, False])) == [(0, 2), (2, 4)]
    assert block_means(np.arange(7.0), 3).tolist() == [1.0, 4.0]
    assert len(block_means(np.arange(2.0), 3)) == 0
