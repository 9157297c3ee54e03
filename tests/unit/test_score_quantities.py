"""Intermodulation, INL, DNL, crosstalk and step response, by DAQs whose values are known in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from replays.score.analogue import in_unit
from replays.score.card.scorecard import FAIL, INCONCLUSIVE, PASS, Interval, Scorecard, Verdict, make_matrix, text_row
from replays.score.judgement import judge
from replays.score.quantities.crosstalk import find_crosstalk
from replays.score.quantities.nonlinearity import intermodulation, transfer_curve
from replays.score.quantities.step import step_response
from replays.score.records.recorded import Recorded
from rig.channels.table import ChannelTable, default_table
from tests.score_daqs import write_parquet
from tests.score_sessions import Sent, make_table, write_counts

RATE_HZ, NOISE = 20e3, 1e-3
SEEDS = 20
MIN_HITS = 17
"""Number of 20 intervals of 95 % that contain the truth, in 99 of 100 cases."""


def check_coverage(true: float, judged: Callable[[np.random.Generator], Interval | None], width: float) -> None:
    """Check how many intervals contain a value, and their largest width."""
    found = [judged(np.random.default_rng(seed)) for seed in range(SEEDS)]
    whole = [each for each in found if each is not None]
    assert len(whole) == SEEDS
    assert sum(low <= true <= high for _, low, high in whole) >= MIN_HITS, (true, whole)
    assert np.median([high - low for _, low, high in whole]) < width


@pytest.mark.parametrize(("square", "cube"), [(2e-3, 0.0), (1e-3, 2e-3)])
def test_intermodulation_agrees_with_a_polynomial(square: float, cube: float) -> None:
    # y = x + a2 x^2 + a3 x^3 of two tones of amplitude A: products of a2 A^2, twice, and of 3/4 a3 A^3, twice.
    a, t = 2.0, np.arange(3000) / RATE_HZ
    x = a * (np.sin(2.0 * np.pi * 79.0 * t) + np.sin(2.0 * np.pi * 1999.0 * t + 0.3))
    bent = square * x**2 + cube * x**3
    true = 10.0 * math.log10(((square * a**2) ** 2 + (0.75 * cube * a**3) ** 2) / a**2)

    def judged(generator: np.random.Generator) -> Interval | None:
        known = x + NOISE * generator.standard_normal(len(x))  # a session has independent noise
        y = x + bent + NOISE * generator.standard_normal(len(x))
        matrix = np.column_stack([known, np.ones(len(x))])
        parts = np.linalg.lstsq(matrix, y, rcond=None)[0]
        return intermodulation(t, known, y - matrix @ parts, float(parts[0]))

    # The gain of a cube is 1 + 9/4 a3 A^2.
    check_coverage(true - 20.0 * math.log10(1.0 + 2.25 * cube * a**2), judged, 0.5)


@pytest.mark.parametrize(
    ("rate_hz", "low_hz", "high_hz", "rows"),
    [(4e3, 80.0, 1000.02, 2400), (4e3, 500.0, 1500.02, 4000), (20e3, 300.0, 900.03, 9000)],
)
def test_folded_or_coincident_products_are_excluded(rate_hz: float, low_hz: float, high_hz: float, rows: int) -> None:
    t = np.arange(rows) / rate_hz
    known = 2.0 * (np.sin(2.0 * np.pi * low_hz * t) + np.sin(2.0 * np.pi * high_hz * t + 0.3))
    for seed in range(4):
        noise = NOISE * np.random.default_rng(seed).standard_normal(rows)
        found = intermodulation(t, known, noise, 1.0)
        assert found is not None
        assert found[2] < -80.0
    bent = intermodulation(t, known, 1e-3 * (known**2 - np.mean(known**2)) + noise, 1.0)
    assert bent is not None
    assert -61.0 < bent[0] < -53.0  # two lines of a2 A^2 over two tones are -54 dB; one may coincide with another


def test_products_above_half_of_the_rate_give_no_intermodulation() -> None:
    t = np.arange(4000) / 5e3
    known = np.sin(2.0 * np.pi * 1000.0 * t) + np.sin(2.0 * np.pi * 2000.0 * t + 0.3)
    assert intermodulation(t, known, NOISE * np.random.default_rng(1).standard_normal(4000), 1.0) is None


@pytest.mark.parametrize("kind", ["sine", "noise", "quiet", "chips"])
def test_intermodulation_needs_two_tones(kind: str) -> None:
    t, generator = np.arange(4000) / RATE_HZ, np.random.default_rng(1)
    known = {
        "sine": np.sin(2.0 * np.pi * 997.0 * t), "noise": generator.standard_normal(4000), "quiet": np.zeros(4000),
        "chips": np.repeat(generator.integers(0, 2, 1000) * 2.0 - 1.0, 4),
    }[kind]  # fmt: skip
    known = known + 1e-4 * generator.standard_normal(4000)
    assert intermodulation(t, known, 1e-3 * generator.standard_normal(4000), 1.0) is None
    assert transfer_curve(t, known, known, 20.0) is None


def make_ramp(rows: int, period: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times and a ramp from -10 to 10 V."""
    n = np.arange(rows)
    return n / RATE_HZ, 20.0 * ((n / period + 0.1) % 1.0) - 10.0


@pytest.mark.parametrize(("square", "cube"), [(1e-4, 0.0), (0.0, 4e-5)])
def test_inl_agrees_with_a_polynomial(square: float, cube: float) -> None:
    # From the best line, a2 x^2 on +-h deviates by at most 2/3 a2 h^2, and a3 x^3 by 2/5 a3 h^3, both at the ends.
    t, x = make_ramp(12_000, 12_000)
    h = 10.0 - 80 * 20.0 / 12_000 - 4.0 * NOISE
    true = max(2.0 / 3.0 * square * h**2, 0.4 * cube * h**3) / 20.0 * 1e6

    def judged(generator: np.random.Generator) -> Interval | None:
        known = x + NOISE * generator.standard_normal(len(x))
        y = x + square * x**2 + cube * x**3 + NOISE * generator.standard_normal(len(x))
        found = transfer_curve(t, known, y, 20.0)
        return None if found is None else found.inl

    check_coverage(true, judged, 60.0)


@pytest.mark.parametrize("wider", [0.0, 0.7])
def test_dnl_agrees_with_one_wide_code(wider: float) -> None:
    # 8 bits: code 100 includes a part of the next one.
    t, x = make_ramp(20_000, 20_000)
    step = 20.0 / 256

    def judged(generator: np.random.Generator) -> Interval | None:
        y = x + 5.0 * NOISE * generator.standard_normal(len(x))
        place = y / step + 128.0
        codes = np.clip(np.floor(place), 0, 255)
        codes[(codes == 101) & (place < 101.0 + wider)] = 100
        found = transfer_curve(t, x + NOISE * generator.standard_normal(len(x)), (codes - 127.5) * step, 20.0)
        assert found is not None
        assert found.inl is not None
        return found.dnl

    check_coverage(wider, judged, 1.4)


def test_too_few_samples_per_code_and_half_a_ramp_are_inconclusive() -> None:
    t, x = make_ramp(20_000, 50_000)
    y = np.rint(x / 20.0 * 2**16) * 20.0 / 2**16
    found = transfer_curve(t, x, y, 20.0)
    assert found is not None
    assert (found.inl, found.dnl) == (None, None)
    assert (found.coverage, found.code_samples) == (pytest.approx(0.4, abs=0.02), pytest.approx(0.76, rel=0.02))


@pytest.mark.parametrize("parts", [(1e-3, 1e-4, 0.0), (0.0, -3e-4, 2e-4)])
def test_crosstalk_is_the_worst_entry_of_the_mixing_matrix(parts: tuple[float, ...]) -> None:
    def judged(generator: np.random.Generator) -> Interval | None:
        signals = [np.repeat(generator.integers(0, 2, 1500) * 4.0 - 2.0, 4) for _ in range(4)]
        own, *others = signals
        residual = np.column_stack(others) @ parts + NOISE * generator.standard_normal(6000)
        worst, part = find_crosstalk(residual, [own, np.gradient(own)], others, 0.0, np.empty((0, len(own))))
        assert worst == np.argmax(np.abs(parts))
        return part

    check_coverage(max(map(abs, parts)), judged, 1e-4)


@pytest.mark.parametrize("same", ["own", "another"])
def test_crosstalk_of_equal_signals_is_inconclusive(same: str) -> None:
    generator = np.random.default_rng(1)
    own, first = generator.standard_normal((2, 4000))
    second = (own if same == "own" else -first) + 1e-3 * generator.standard_normal(4000)
    assert find_crosstalk(own * 1e-3, [own], [first, second], 0.0, np.empty((0, len(own))))[1] is None


@pytest.mark.parametrize(("hz", "amplitude"), [(5.0, 0.3), (8.0, 0.2), (12.0, 0.1)])
def test_errors_of_a_slow_reference_are_not_crosstalk(hz: float, amplitude: float) -> None:
    from scipy.signal import detrend

    # Without mean and slope of each of 64 blocks, less remains of slow signals than a session's rounding may repeat.
    t, size = np.arange(24_000) / 48e3, 1.2e-3
    angle = 2.0 * np.pi * hz * t
    own = amplitude * np.sin(angle)
    other = own + 0.3 * amplitude * np.sin(1.7 * angle + 0.4)
    rest = detrend(other, bp=np.linspace(0, len(t), 65).astype(int)[1:-1])
    error = 0.2 * size * rest / np.std(rest)
    known, nothing = own + error, np.empty((0, len(t)))
    residual = size * np.random.default_rng(1).standard_normal(len(t)) - error
    part = find_crosstalk(residual, [known, np.gradient(known)], [other], size, nothing)[1]
    assert part is None or part[1] < 1e-4


def make_steps(
    respond: Callable[[np.ndarray], np.ndarray], generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return a square wave and a DAQ's record of it, whose rows are 0.37 rows after the steps and decreasing."""
    n = np.arange(9700)
    known, values = np.where(n // 600 % 2, 2.0, -2.0), np.full(len(n), -2.0)
    for number, edge in enumerate(range(600, len(n), 600)):
        since = np.maximum(n - edge + 0.37, 0.0)
        values += (1.0 if number % 2 == 0 else -1.0) * 4.0 * respond(since)
    return known, values + NOISE * generator.standard_normal(len(n))


@pytest.mark.parametrize("quantity", ["rise_rows", "settling_rows"])
def test_a_low_pass_of_first_order_rises_in_2_2_time_constants(quantity: str) -> None:
    tau = 12.0
    true = {"rise_rows": tau * math.log(9.0), "settling_rows": tau * math.log(50.0)}[quantity]

    def judged(generator: np.random.Generator) -> Interval | None:
        found = step_response(*make_steps(lambda since: 1.0 - np.exp(-since / tau), generator))
        return None if found is None else getattr(found, quantity)

    check_coverage(true, judged, 0.2 if quantity == "rise_rows" else 4.0)


@pytest.mark.parametrize("zeta", [0.3, 0.6])
def test_overshoot_of_a_second_order_low_pass_follows_its_damping(zeta: float) -> None:
    w, root = 0.1, math.sqrt(1.0 - zeta**2)
    true = 100.0 * math.exp(-math.pi * zeta / root)

    def respond(since: np.ndarray) -> np.ndarray:
        turned = np.cos(root * w * since) + zeta / root * np.sin(root * w * since)
        return 1.0 - np.exp(-zeta * w * since) * turned

    def judged(generator: np.random.Generator) -> Interval | None:
        found = step_response(*make_steps(respond, generator))
        return None if found is None else found.overshoot

    check_coverage(true, judged, 0.2)


def test_an_ideal_step_is_within_its_resolution() -> None:
    found = step_response(*make_steps(lambda since: (since > 0.0) * 1.0, np.random.default_rng(1)))
    assert found is not None
    assert found.rise_rows[1:] == (0.0, pytest.approx(2.0))
    assert abs(found.overshoot[0]) < 0.1
    assert found.settling_rows is not None
    assert found.settling_rows[2] < 3.0


def test_a_matrix_has_the_worst_verdict_of_each_quantity_and_channel() -> None:
    card = Scorecard("a DAQ", "analogue", "", lambda *_, **__: None)
    rows: list[tuple[str, str, Verdict]] = [
        ("gain", "a", PASS), ("gain", "b", FAIL), ("gain", "b", INCONCLUSIVE), ("clock", "", INCONCLUSIVE),
        ("noise", "a", INCONCLUSIVE), ("noise", "a", PASS),
    ]  # fmt: skip
    card.rows = [text_row("analogue", quantity, channel, "", verdict, "") for quantity, channel, verdict in rows]
    names, lines = make_matrix(card)
    assert names == ["a", "b", "all"]
    assert lines == [("gain", "+", "X", ""), ("clock", "", "", "?"), ("noise", "?", "", "")]
    card.rows = [row for row in card.rows if row.channel != "b"]
    assert make_matrix(card)[1] == []


def test_an_inverting_sensor_has_the_same_scorecard(tmp_path: Path) -> None:
    document = make_table(16, ["probes"]).model_dump(mode="json")
    for channel in document["groups"]["probes"]["channels"]:
        channel["sensitivity_v"] *= -1.0
    sent = Sent("test-prbs", 1, ChannelTable.model_validate(document), True, tmp_path / "session.mcap", 40_000, 8000)
    write_counts(sent.path, sent, sent.counts, 40_000)
    times_s, columns = 2.05 + np.arange(5000) / RATE_HZ + 13e-6, dict[str, np.ndarray]()
    for n, c in enumerate(sent.channels):
        volts = sent.volts(c.name, times_s) + c.noise_v * np.random.default_rng(n).standard_normal(len(times_s))
        columns[f"{c.name} [V]"] = np.rint(volts / c.lsb_v) * c.lsb_v
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [sent.path])
    assert card.path == "analogue"
    assert {row.quantity for row in card.rows if row.verdict == FAIL} == set()
    for c in sent.channels:
        assert card.row("polarity", c.name).verdict == card.row("mapping", c.name).verdict == PASS
        # Noise and rounding of both, the session and the DAQ.
        noise_v = math.sqrt(2.0) * math.hypot(c.noise_v, c.lsb_v / math.sqrt(12.0))
        assert float(card.row("noise", c.name).high) * abs(c.sensitivity_v) == pytest.approx(noise_v, rel=0.3)
        bits = math.log2(2.0 * c.adc_v / (noise_v * math.sqrt(12.0)))
        assert card.row("effective bits", c.name).value == pytest.approx(bits, abs=0.3)
        assert card.row("dynamic range", c.name).value == pytest.approx(
            20.0 * math.log10(c.adc_v / math.sqrt(2.0) / noise_v), abs=3.0
        )


@pytest.mark.parametrize(("unit", "expected"), [
    ("mm", [1.0, 5.0]), ("um", [1e-3, 5e-3]), ("mils", [0.0254, 0.127]), ("m", [1e3, 5e3]),
    ("V", [11.0 / 3.94, 15.0 / 3.94]), ("mV", [10.001 / 3.94, 10.005 / 3.94]),
])  # fmt: skip
def test_values_of_any_unit_are_those_of_the_channels_unit(unit: str, expected: list[float]) -> None:
    channel = default_table().channels["disk_x"]
    found, known = in_unit(cast(Recorded, SimpleNamespace(name="a", unit=unit, values=np.array([1.0, 5.0]))), channel)
    assert known
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("unit", ["", "N", "bananas", "m/s", "counts"])
def test_values_of_an_incompatible_unit_are_kept_and_not_judged(unit: str) -> None:
    values = np.array([1.0, 5.0])
    signal = cast(Recorded, SimpleNamespace(name="a", unit=unit, values=values))
    assert in_unit(signal, default_table().channels["disk_x"]) == (values, False)
