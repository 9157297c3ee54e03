"""Widths of a scorecard's intervals, and limits derived from the channel table, against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from replays.estimate.intervals import pool_estimates, refine, sandwich, student
from replays.estimate.sine import fit_sine, quality
from replays.score.alignment.stamps import Stamps
from replays.score.card.limits import load_limits
from replays.score.card.scorecard import FAIL, INCONCLUSIVE, PASS, Bounds, Scorecard, judge_row
from replays.score.quantities.noise import split_noise
from replays.score.quantities.rounding import Converter, find_undithered, widen_intervals
from replays.score.records.recorded import RecordedTable
from replays.score.waveform import Waveform
from rig.channels.table import default_table
from tests.score_coverage import NOISES, ROWS, Estimate, compute_estimates, summarise_cell

PROBE = default_table().channels["disk_x"]
NOISE_V = math.hypot(1e-3, PROBE.lsb_v / math.sqrt(12.0))


def test_students_t_is_two_sided() -> None:
    # Tables of the 97.5 % quantile.
    assert student([1.0, 5.0, 30.0, 1e9]) == pytest.approx([12.7062, 2.5706, 2.0423, 1.95996], rel=1e-4)


def test_a_sandwich_has_the_variance_of_white_noise() -> None:
    generator, n = np.random.default_rng(1), 6400
    matrix = np.column_stack([np.ones(n), np.linspace(-1.0, 1.0, n)])
    found = [sandwich(matrix, 3.0 * generator.standard_normal(n))[0].diagonal() for _ in range(30)]
    assert np.mean(found, axis=0) == pytest.approx([9.0 / n, 27.0 / n], rel=0.15)


def _fit(noise: float, jitter_s: float, generator: np.random.Generator, n: int = 6400) -> Waveform:
    """Return a fit of a sine of 1 V at 1 kHz whose residual is noise and jitter."""
    times_s = np.arange(n) / 20e3
    slope = 2000.0 * np.pi * np.cos(2000.0 * np.pi * times_s * 1.000137)
    residual = noise * generator.standard_normal(n) + jitter_s * slope * generator.standard_normal(n)
    return Waveform(
        gain=1.0, offset=0.0, late_s=0.0, drift=0.0, bend=0.0, covariance=np.eye(5), dof=np.ones(5), middle_s=0.0,
        half_s=0.5 * n / 20e3, times_s=times_s, values=residual, sent=slope / 6283.0, slope=slope, residual=residual,
    )  # fmt: skip


def _two_levels(gain: float, noise: float) -> Waveform:
    """Return a fit of a square wave of 205 counts whose residual is noise and rounding [count]."""
    fit = _fit(math.hypot(noise, math.sqrt(1.0 / 12.0)), 0.0, np.random.default_rng(3))
    known = np.where(np.arange(len(fit.values)) // 37 % 2, 205.0, -205.0)
    covariance = np.diag([1e-12, 1e-6, 1e-18, 1e-18, 1e-18])
    return replace(
        fit, gain=gain, sent=known, values=gain * known + fit.residual, slope=0.0 * known + 1.0,
        covariance=covariance, dof=np.full(5, 1e4),
    )  # fmt: skip


def test_two_levels_rounded_by_the_session_leave_the_gain_inconclusive() -> None:
    # 204.8 counts, rounded to 205 with noise of a tenth of a step: off by 976 ppm, and by up to 0.4 / 205 from others.
    fit = _two_levels(204.8 / 205.0, 0.1)
    session = Converter(1.0, 0.1, values=fit.sent)
    half = widen_intervals(fit, find_undithered(fit, 0.0, session)).half_widths[0]
    assert 976e-6 < half < 0.5 / 205.0


def test_noise_of_one_step_removes_the_rounding_error() -> None:
    fit = _two_levels(1.0, 1.0)
    assert find_undithered(fit, 1.0, Converter(1.0, 1.0, values=fit.sent)) == ()
    assert widen_intervals(fit, ()) is fit


def test_intervals_of_noise_and_jitter_are_two_standard_deviations_to_each_side() -> None:
    # The spread of an rms is rms / sqrt(2 n); that of jitter is measured over the fits themselves.
    generator = np.random.default_rng(2)
    splits = [split_noise(_fit(1e-3, 2e-7, generator)) for _ in range(40)]
    alone = [split_noise(_fit(1e-3, 0.0, generator)).total for _ in range(12)]
    widths = np.mean([high - low for _, low, high in alone])
    assert widths == pytest.approx(2.0 * 1.96 * 1e-3 / math.sqrt(2.0 * 6400), rel=0.08)
    jitters = [split.jitter_s for split in splits if split.jitter_s is not None]
    assert len(jitters) == 40
    ratio = np.mean([high - low for _, low, high in jitters]) / (2.0 * 1.96 * np.std([value for value, *_ in jitters]))
    assert 0.85 < ratio < 1.35
    assert np.mean([low < 2e-7 < high for _, low, high in jitters]) >= 0.88


def test_a_floor_is_subtracted_from_the_low_end_of_the_noise_only() -> None:
    found, generator = [], np.random.default_rng(3)
    fit = _fit(1e-3, 0.0, generator)
    for floor in (0.0, 0.6e-3):
        found.append(split_noise(fit, floor=floor).total)
    (value, low, high), (same, lower, still) = found
    assert (value, high) == (same, still)
    assert lower == pytest.approx(math.sqrt(low**2 - 0.36e-6))


def test_the_interval_of_sinad_follows_chi_squared() -> None:
    from scipy.stats import chi2

    n, t = 500, np.arange(500)
    values = np.sin(2.0 * np.pi * 0.0713 * t) + 0.01 * np.random.default_rng(4).standard_normal(n)
    value, low, high = quality(fit_sine(values)).sinad_db
    ends = [10.0 * math.log10(chi2.ppf(p, n - 4) / (n - 4)) for p in (0.025, 0.975)]
    # Its degrees of freedom are those of the residual's spectrum, which for white noise are about n.
    assert (low - value, high - value) == pytest.approx(ends, rel=0.15)


def test_the_interval_of_stamp_jitter_follows_chi_squared() -> None:
    from scipy.stats import chi2

    n = 4096
    table = RecordedTable(n, 1, lambda columns: [np.zeros((n, 1 + len(columns)))])
    stamps, since_s = Stamps(table, shown=True), np.arange(n) / 20e3
    stamps.times_s = 0.25 + since_s * (1.0 + 5e-5) + 1e-6 * np.random.default_rng(5).standard_normal(n)
    stamps.add_rows(0.0, since_s, np.arange(n), n)
    found = stamps.estimate_all(None)
    assert found["stamp jitter"] is not None
    value, low, high = found["stamp jitter"]
    dof = n // 16 * 15
    ends = [value * math.sqrt(dof / chi2.ppf(p, dof)) for p in (0.975, 0.025)]
    assert (low, high) == pytest.approx(ends, rel=2e-3)
    for name, true in (("stamp offset", 0.25), ("stamp rate", 50.0)):
        interval = found[name]
        assert interval is not None
        assert interval[1] < true < interval[2]


@pytest.mark.parametrize("noise", ["white", "ar10", "ar100", "sine"])
def test_intervals_have_coverage_for_coloured_and_drifting_noise(noise: str) -> None:
    """Of 40, at least 33 contain the truth, which is 3.6 standard deviations below 38; the long run is
    `tests.score_coverage`.
    """
    found: dict[str, list[Estimate]] = {"offset": [], "noise": [], "SINAD": []}
    t = np.arange(ROWS) / 20e3
    for seed in range(40):
        series, mean, level = NOISES[noise](np.random.default_rng([seed, 7]), ROWS)
        ones = np.ones((ROWS, 1))
        flat, residual = np.zeros(ROWS), series - series.mean()
        change, _, covariance, dof = refine(ones, residual)
        half, offset = float(student(dof[0])) * math.sqrt(covariance[0, 0]), float(series.mean() + change[0])
        found["offset"].append((offset, offset - half, offset + half, mean))
        fit = Waveform(1.0, 0.0, 0.0, 0.0, 0.0, np.eye(5), np.ones(5), 0.15, 0.15, t, series, flat, flat, residual)
        found["noise"].append((*split_noise(fit).noise, level))
        found["SINAD"].append(compute_estimates(seed, noise, ["sine"])["SINAD"])
    for quantity, each in found.items():
        held, width = summarise_cell(each)
        assert held >= 33, (quantity, held)
        assert width < 1.8, (quantity, width)


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [(-1.0, 1.0, PASS), (-1.0, 1.5, INCONCLUSIVE), (-1.5, 1.0, INCONCLUSIVE), (1.5, 2.0, FAIL), (-2.0, -1.5, FAIL),
     (-3.0, 3.0, INCONCLUSIVE), (1.0, 1.0, PASS)],
)  # fmt: skip
def test_the_whole_interval_decides(low: float, high: float, verdict: str) -> None:
    limit = Bounds(-1.0, 1.0, "a test")
    assert judge_row("analogue", "gain", "", (0.5 * (low + high), low, high), limit=limit).verdict == verdict


@pytest.mark.parametrize(
    ("values", "doubts", "outcome"),
    [((0.0,), [], "pass"), ((0.0,), ["a doubt"], "inconclusive"), ((9.0, 0.0), [], "fail"), ((9.0,), ["one"], "fail"),
     ((math.nan,), [], "inconclusive"), ((0.0, math.nan), [], "pass"), ((), [], "inconclusive")],
)  # fmt: skip
def test_a_pass_needs_a_quantity_that_passes_and_no_doubt(
    values: tuple[float, ...], doubts: list[str], outcome: str
) -> None:
    card = Scorecard("a test", "analogue", "", lambda *_, **__: Bounds(-1.0, 1.0, "a test"), evidence_gaps=doubts)
    for value in values:
        card.add("gain", "", None if math.isnan(value) else (value, value, value))
    assert card.outcome == outcome


def test_limits_from_the_table_agree_with_closed_forms() -> None:
    limits = load_limits()

    def ends(quantity: str, **numbers: float) -> tuple[float, float] | None:
        found = limits.bounds("analogue", quantity, PROBE, **numbers)
        return None if found is None else (found.low, found.high)

    noise_mm = NOISE_V / 3.94
    assert ends("offset") == pytest.approx((-noise_mm, noise_mm))
    assert ends("noise") == pytest.approx((-math.inf, 1.1 * noise_mm))
    assert ends("skew") == pytest.approx((-500.0, 500.0))
    assert ends("jitter") == pytest.approx((-math.inf, 50.0))
    assert ends("corner") == pytest.approx((4950.0, math.inf))
    assert ends("effective bits") == pytest.approx((math.log2(40.0 / (NOISE_V * math.sqrt(12.0))) - 0.14, math.inf))
    assert ends("dynamic range") == pytest.approx((20.0 * math.log10(20.0 / math.sqrt(2.0) / NOISE_V) - 0.83, math.inf))
    sine_db = 20.0 * math.log10(1.0 / math.sqrt(2.0) / noise_mm)
    assert ends("SINAD", amplitude=1.0) == pytest.approx((sine_db - 0.83, math.inf))
    assert ends("ENOB", amplitude=1.0) == pytest.approx(((sine_db - 1.76) / 6.02 - 0.14, math.inf))
    # Without an amplitude there is no requirement.
    assert ends("SINAD") is None


@pytest.mark.parametrize(("alike", "expected"), [(False, 1.0), (True, 2.0)])
def test_errors_of_rounding_do_not_average_out_over_channels(alike: bool, expected: float) -> None:
    """Channels of one rotor are rounded equally: a 14-bit stable run failed its clock drift by a mean of four."""
    value, half = pool_estimates(np.array([-3.0, -1.0, -3.0, -1.0]), np.full(4, 0.25), equal_errors=alike)
    assert value == pytest.approx(-2.0)
    assert half == pytest.approx(expected)
