"""Time track of an analogue record: lost and doubled samples, drift of the clock, begins, and what is judged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from replays.score.judgement import judge
from replays.score.scorecard import FAIL, INCONCLUSIVE, PASS, Scorecard
from replays.score.stimulus import Exact
from replays.score.track import Follower, Track, follow_record
from rig.channels import default_table
from tests.score_daqs import RATE_HZ, Tones, counts_of, write_parquet, write_session

ROWS = np.arange(30_000)
TONES = Tones(1, 0.5, high_hz=6000.0, tones=12)
PROBES = default_table().groups["probes"].channels


def two_tones(t: np.ndarray) -> np.ndarray:
    return 0.4 * np.sin(2.0 * np.pi * 80.0 * t) + 0.2 * np.sin(2.0 * np.pi * 1000.0 * t)


def track(signal: object, kept: np.ndarray, *, ppm_s: float = 0.0, span_s: tuple[float, float] = (0.0, 2.0)) -> Track:
    """Follow a record at 30 ppm, of which some rows are kept, from rows 2000 to 7000."""
    since_s = ROWS / RATE_HZ
    bend_s = 0.5e-6 * ppm_s * (since_s - since_s[4500]) ** 2
    true_s = 0.05 + since_s * (1.0 - 30e-6) - bend_s
    known = Exact(signal, span_s, RATE_HZ)  # type: ignore[arg-type]
    values = (known(true_s)[0] + 1e-3 * np.random.default_rng(2).standard_normal(len(ROWS)))[kept]
    follower = Follower(values, known, float(true_s[4500] - since_s[4500]), 1.0, 0.0, 1e-3)
    return follow_record([follower], 0.0, 1.0 / RATE_HZ, len(values), (2000, 7000), -30e-6)


@pytest.mark.parametrize("signal", [TONES, two_tones], ids=["tones", "two tones"])
@pytest.mark.parametrize(
    ("kept", "steps"),
    [
        (ROWS, []),
        (np.delete(ROWS, 19_000), [(19_000, 1)]),
        (np.delete(ROWS, 900), [(900, 1)]),
        (np.insert(ROWS, 19_000, 19_000), [(19_001, -1)]),
        (np.delete(ROWS, np.arange(12_000, 12_100)), [(12_000, 100)]),
        (np.delete(ROWS, [9000, 9001, 14_000, 25_500]), [(9000, 2), (13_998, 1), (25_497, 1)]),
    ],
    ids=["none", "one lost", "lost before the stretch", "one doubled", "a hundred lost", "four lost"],
)
def test_a_step_by_whole_samples_is_found_at_its_row(
    signal: object, kept: np.ndarray, steps: list[tuple[int, int]]
) -> None:
    found = track(signal, kept)
    assert [size for _, _, size in found.steps()] == [size for _, size in steps]
    for (first, last, _), (row, _) in zip(found.steps(), steps, strict=True):
        assert first <= row <= last <= first + 2
    assert found.explained == len(kept)


def test_a_missing_half_and_exchanged_parts_are_followed() -> None:
    missing = track(TONES, np.r_[0:8000, 23_000:30_000])
    ((first, last, size),) = missing.steps()
    assert size == 15_000
    assert 7850 < first <= 8000 <= last < 8150
    exchanged = track(TONES, np.r_[0:8000, 15_000:22_000, 8000:15_000, 22_000:30_000])
    assert sum(size for *_, size in exchanged.steps()) == 0
    assert max(size for *_, size in exchanged.steps()) == 7000


def test_rows_that_nothing_explains_are_not_judged() -> None:
    order = np.concatenate([ROWS[:15_000], np.random.default_rng(3).permutation(ROWS[15_000:])])
    assert track(TONES, order).explained == pytest.approx(15_000, abs=300)


def test_rows_outside_the_session_are_outside() -> None:
    found = track(TONES, ROWS, span_s=(0.1, 1.0))
    assert found.inside == (1001, 19_001)
    assert found.explained == 18_000


def test_a_clock_that_drifts_is_followed() -> None:
    found = track(TONES, ROWS, ppm_s=20.0)
    assert found.steps() == []
    assert 2.0 * RATE_HZ * found.line(4500.0)[2] == pytest.approx(-20e-6, rel=0.01)


# Through the scorecard: two probes of repeating tones.


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    t = np.arange(int(1.5 * RATE_HZ)) / RATE_HZ
    counts = counts_of("probes", np.column_stack([two_tones(t + 0.001 * n) for n in range(4)]), None)
    return write_session(tmp_path_factory.mktemp("sent") / "session.mcap", {"probes": counts})


def card_of(session: Path, file: Path, true_s: np.ndarray, *, turned: int = -1) -> Scorecard:
    generator = np.random.default_rng(4)
    columns = {"time [s]": np.arange(len(true_s)) / RATE_HZ}
    for n, channel in enumerate(PROBES):
        value = two_tones(true_s + 0.001 * n) * (-1.0 if n == turned else 1.0)
        volts = (
            channel.bias_v + channel.sensitivity_v * value + channel.noise_v * generator.standard_normal(len(true_s))
        )
        columns[f"{channel.name} [V]"] = np.rint(volts / channel.lsb_v) * channel.lsb_v
    known = {channel.name: (lambda t, n=n: two_tones(t + 0.001 * n)) for n, channel in enumerate(PROBES)}
    return judge(write_parquet(file, columns), [session], path="analogue", formulas=known)


def red(card: Scorecard) -> set[tuple[str, str]]:
    return {(row.quantity, row.channel) for row in card.rows if row.verdict == FAIL and row.quantity != "recorded"}


TRUE_S = 0.05 + np.arange(20_001) / RATE_HZ * (1.0 - 30e-6)


def test_a_lost_sample_of_a_signal_that_repeats_fails(session: Path, tmp_path: Path) -> None:
    card = card_of(session, tmp_path / "daq.parquet", np.delete(TRUE_S, 12_000))
    assert red(card) == {("lost samples", "")}
    assert card.runs["lost samples"] == [(12_000, 12_000)]
    assert card.row("start", next(r.channel for r in card.rows if r.quantity == "start")).verdict == INCONCLUSIVE
    assert card.row("gain", "disk_x").verdict == PASS


def test_one_turned_channel_of_a_signal_that_repeats_fails(session: Path, tmp_path: Path) -> None:
    card = card_of(session, tmp_path / "daq.parquet", TRUE_S, turned=2)
    assert red(card) == {("polarity", PROBES[2].name)}


def test_clock_is_the_mean_and_its_drift_fails(session: Path, tmp_path: Path) -> None:
    since_s = TRUE_S - TRUE_S.mean()
    card = card_of(session, tmp_path / "daq.parquet", TRUE_S - 10e-6 * since_s**2)
    assert red(card) == {("clock drift", "")}
    assert card.row("clock").low < 30.0 < card.row("clock").high
    assert card.row("clock drift").value == pytest.approx(20.0, rel=0.01)
