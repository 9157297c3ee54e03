"""Time track of an analogue record: lost and repeated samples, drift of the clock, start of the record, judged
parts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from replays.score.alignment.alignment import align
from replays.score.alignment.repeats import find_repeats
from replays.score.alignment.row_times import Follower, Track, follow_record
from replays.score.alignment.single_start import RowSource
from replays.score.card.scorecard import FAIL, INCONCLUSIVE, PASS, Scorecard
from replays.score.judgement import judge
from replays.score.records.stimulus import Exact
from replays.score.records.wiring import Wire, find_wires
from replays.score.waveform import fit_stretch
from rig.channels.table import default_table
from tests.score_cases import Converter, make_columns
from tests.score_daqs import RATE_HZ, Tones, make_counts, write_parquet, write_session
from tests.score_files import write_values
from tests.score_sessions import Sessions

ROWS = np.arange(14_000)
TONES = Tones(1, 0.5, high_hz=6000.0, tones=6)


def two_tones(t: np.ndarray) -> np.ndarray:
    return 0.4 * np.sin(2.0 * np.pi * 80.0 * t) + 0.2 * np.sin(2.0 * np.pi * 1000.0 * t)


def follow_track(
    signal: object, kept: np.ndarray, *, ppm_s: float = 0.0, ppm: float = 30.0, span_s: tuple[float, float] = (0.0, 0.8)
) -> Track:
    """Follow a record at 30 ppm or another rate, with some rows removed, from rows 1000 to 4000."""
    since_s = ROWS / RATE_HZ
    bend_s = 0.5e-6 * ppm_s * (since_s - since_s[2500]) ** 2
    true_s = 0.05 + since_s * (1.0 - 1e-6 * ppm) - bend_s
    known = Exact(signal, span_s, RATE_HZ)  # type: ignore[arg-type]
    values = (known(true_s)[0] + 1e-3 * np.random.default_rng(2).standard_normal(len(ROWS)))[kept]
    follower = Follower(values, known, float(true_s[2500] - since_s[2500]), 1.0, 0.0, 1e-3)
    return follow_record([follower], 0.0, 1.0 / RATE_HZ, len(values), (1000, 4000), -1e-6 * ppm)


@pytest.mark.parametrize("signal", [TONES, two_tones], ids=["tones", "two tones"])
@pytest.mark.parametrize(
    ("kept", "steps"),
    [
        (ROWS, []),
        (np.delete(ROWS, 7000), [(7000, 1)]),
        (np.delete(ROWS, 900), [(900, 1)]),
        (np.insert(ROWS, 7000, 7000), [(7001, -1)]),
        (np.delete(ROWS, np.arange(6000, 6100)), [(6000, 100)]),
        (np.delete(ROWS, [4000, 4001, 5500, 8500]), [(4000, 2), (5498, 1), (8497, 1)]),
    ],
    ids=["none", "one lost", "lost before the stretch", "one doubled", "a hundred lost", "four lost"],
)
def test_a_step_by_whole_samples_is_found_at_its_row(
    signal: object, kept: np.ndarray, steps: list[tuple[int, int]]
) -> None:
    found = follow_track(signal, kept)
    assert [size for _, _, size in found.steps()] == [size for _, size in steps]
    for (first, last, _), (row, _) in zip(found.steps(), steps, strict=True):
        assert first <= row <= last <= first + 2
    assert found.explained == len(kept)


def tone(t: np.ndarray) -> np.ndarray:
    return 0.5 * np.sin(2.0 * np.pi * 1234.5 * t)


@pytest.mark.parametrize("signal", [TONES, tone], ids=["tones", "tone"])
@pytest.mark.parametrize("row", [8, 100, -190, -12])
@pytest.mark.parametrize("size", [3, 1, -1], ids=["three lost", "lost", "doubled"])
def test_a_step_near_an_end_is_found_at_its_row(signal: object, row: int, size: int) -> None:
    row %= len(ROWS)
    kept = np.delete(ROWS, np.arange(row, row + size)) if size > 0 else np.insert(ROWS, row, row)
    found = follow_track(signal, kept)
    ((first, last, moved),) = found.steps()
    assert moved == size
    assert first <= (row if size > 0 else row + 1) <= last <= first + 10
    assert found.explained == len(kept)


@pytest.mark.parametrize("row", [3, -4])
def test_a_jump_within_eight_rows_of_an_end_equals_a_late_start(row: int) -> None:
    assert follow_track(TONES, np.delete(ROWS, row)).steps() == []


def test_a_disturbed_end_is_no_step() -> None:
    """No other part of the session explains the last rows."""
    values = np.concatenate([ROWS[:-100], np.random.default_rng(3).permutation(ROWS[-100:])])
    found = follow_track(TONES, values)
    assert found.steps() == []
    assert 100 <= len(ROWS) - found.explained < 600


def test_a_jump_is_found_at_its_row_despite_a_large_clock_error() -> None:
    """From the stretch to the ends of the record its time is off by up to 30 samples."""
    for row in (300, 12_000):
        found = follow_track(TONES, np.delete(ROWS, row), ppm=3000.0)
        ((first, last, size),) = found.steps()
        assert size == 1
        assert first <= row <= last <= first + 2
        assert found.explained == len(ROWS) - 1


def test_a_missing_half_and_exchanged_parts_are_followed() -> None:
    missing = follow_track(TONES, np.r_[0:4500, 8000:14_000])
    ((first, last, size),) = missing.steps()
    assert size == 3500
    assert 4350 < first <= 4500 <= last < 4650
    exchanged = follow_track(TONES, np.r_[0:4200, 9100:14_000, 4200:9100])
    assert [size for *_, size in exchanged.steps()] == [4900, -9800]


def test_unexplained_rows_are_not_judged() -> None:
    order = np.concatenate([ROWS[:5000], np.random.default_rng(3).permutation(ROWS[5000:10_000])])
    assert follow_track(TONES, order).explained == pytest.approx(5000, abs=300)


@pytest.mark.parametrize("doubled", [None, 9900])
def test_a_record_does_not_cycle_at_an_end_of_a_session(doubled: int | None) -> None:
    """The last rows of a session are less well known than those a period earlier, which explain the rows that
    follow.
    """

    def whirl(t: np.ndarray) -> np.ndarray:
        return np.sin(2.0 * np.pi * RATE_HZ / 245.1 * t)

    def known(t: np.ndarray) -> np.ndarray:
        return whirl(t) + 1e-3 * np.sin(2.0 * np.pi * 700.0 * t) * ((t < 0.06) | (t > 0.39))

    values = whirl(ROWS / RATE_HZ - 0.1) + 1e-3 * np.random.default_rng(1).standard_normal(len(ROWS))
    values = values if doubled is None else np.insert(values, doubled, values[doubled])
    follower = Follower(values, Exact(known, (0.05, 0.4), RATE_HZ), -0.1, 1.0, 0.0, 1e-3)
    found = follow_record([follower], 0.0, 1.0 / RATE_HZ, len(values), (4000, 6000), 0.0)
    assert found.inside == (3000, 10_001 + (doubled is not None))
    assert [size for _, _, size in found.steps()] == [-1] * (doubled is not None)


def test_rows_outside_the_session_are_outside() -> None:
    found = follow_track(TONES, ROWS, span_s=(0.1, 0.5))
    assert found.inside == (1001, 9001)
    assert found.explained == 8000


def test_a_drifting_clock_is_followed() -> None:
    found = follow_track(TONES, ROWS, ppm_s=60.0)
    assert found.steps() == []
    assert 2.0 * RATE_HZ * found.line(2500.0)[2] == pytest.approx(-60e-6, rel=0.01)


def test_a_repeating_signal_uses_the_start_that_explains_all_signals() -> None:
    """A keyphasor's pulse is a millisecond off at the start at which the probes show the same whirl."""

    def pulse(t: np.ndarray) -> np.ndarray:
        return 1.0 / (1.0 + np.exp(-200.0 * (np.sin(2.0 * np.pi * 46.1 * t) - 0.9)))

    begin_s, repeat_s, generator = 0.65, 0.5, np.random.default_rng(6)
    table = default_table().channels
    sources = []
    for name, signal, likeness in (("disk_x", two_tones, 1.0), ("keyphasor", pulse, 0.9)):
        values = signal(begin_s + ROWS / RATE_HZ) + 1e-4 * generator.standard_normal(len(ROWS))
        wrong_s = begin_s - repeat_s
        wire = Wire(name, 1, likeness, (), False, wrong_s, (0.0, 0.7), (begin_s,), wrong_s)
        sources.append(
            RowSource(name, table[name], wire, values, 0.0, RATE_HZ, Exact(signal, (0.0, 2.0), RATE_HZ), 0.0)
        )
    found = align(sources)
    assert found is not None
    assert not found.ambiguous  # at each of the other starts the pulse is at another part of the whirl
    assert found.shift_s == pytest.approx(repeat_s, abs=1e-6)
    assert found.own_s["keyphasor"] == pytest.approx(found.own_s["disk_x"], abs=1e-6)


SLOW_RATE_HZ = 3e3
"""Rate of records of slow signals, which keeps tests of several turns short [Hz]."""


def make_slow_sources(
    signals: Sequence[Callable[[np.ndarray], np.ndarray]], kept: np.ndarray, *, begin_s: float, found_s: float,
    end_s: float, noise: float,
) -> list[RowSource]:  # fmt: skip
    """Return probes that were recorded from a start on, and were first found at another one."""
    generator, table = np.random.default_rng(0), list(default_table().channels.values())
    wire = Wire("", 1, 1.0, (), False, found_s, (0.0, 0.7), (begin_s,), found_s)
    return [
        RowSource(
            channel.name, channel, replace(wire, channel=channel.name, likeness=1.0 - 0.1 * n),
            signal(begin_s + kept / SLOW_RATE_HZ) + noise * generator.standard_normal(len(kept)),
            0.0, SLOW_RATE_HZ, Exact(signal, (0.0, end_s), SLOW_RATE_HZ), 0.0,
        )
        for n, (channel, signal) in enumerate(zip(table, signals, strict=False))
    ]  # fmt: skip


def test_a_start_without_jumps_is_preferred() -> None:
    """Turns of a rotor differ by some samples: early starts explain rows after the session by steps; a loss is one."""

    def angle(t: np.ndarray) -> np.ndarray:
        return 2.0 * np.pi * 5.0 * (t + 7e-4 * np.sin(2.0 * np.pi * (t + 0.6 * t**2)))

    lost, signals = 1000, [lambda t: np.cos(angle(t)), lambda t: np.sin(angle(t))]
    kept = np.delete(np.arange(3301), lost)
    found = align(make_slow_sources(signals, kept, begin_s=1.3, found_s=1.1, end_s=2.0, noise=6e-3))
    assert found is not None
    assert found.shift_s == pytest.approx(0.2, abs=2e-5)
    ((first, last, size),) = found.track.steps()
    assert first <= lost <= last
    assert size == 1
    assert found.steps_doubted


@pytest.mark.parametrize("begin_s", [0.4, -0.5])
def test_a_longer_overlap_does_not_favour_an_inverted_start(begin_s: float) -> None:
    """Two tones of odd frequencies are inverted half a second later, where all of the session is in the record."""

    def tones_of(phase: float) -> Callable[[np.ndarray], np.ndarray]:
        return lambda t: np.sin(2.0 * np.pi * 79.0 * t + phase) + 0.5 * np.sin(2.0 * np.pi * 101.0 * t)

    found_s = begin_s - 0.5 if begin_s > 0.0 else begin_s + 0.5
    signals = [tones_of(0.0), tones_of(1.0)]
    sources = make_slow_sources(signals, np.arange(3900), begin_s=begin_s, found_s=found_s, end_s=1.0, noise=1e-3)
    found = align(sources)
    assert found is not None
    assert found.upright == len(sources)


# Through the scorecard: three probes of repeating tones.

PROBES = default_table().groups["probes"].channels[:3]
TRUE_S = 0.05 + np.arange(8001) / RATE_HZ * (1.0 - 30e-6)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    t = np.arange(int(0.6 * RATE_HZ)) / RATE_HZ
    counts = make_counts("probes", np.column_stack([two_tones(t + 0.001 * n) for n in range(4)]), None)
    return write_session(tmp_path_factory.mktemp("sent") / "session.mcap", {"probes": counts})


def card_of(
    session: Path, file: Path, true_s: np.ndarray, *, turned: int = -1, blank: dict[int, slice] | None = None,
    replaced: dict[int, slice] | None = None, stamps_s: np.ndarray | None = None,
) -> Scorecard:  # fmt: skip
    generator = np.random.default_rng(4)
    columns = {"time [s]": np.arange(len(true_s)) / RATE_HZ if stamps_s is None else stamps_s}
    for n, channel in enumerate(PROBES):
        value = two_tones(true_s + 0.001 * n) * (-1.0 if n == turned else 1.0)
        volts = (
            channel.bias_v + channel.sensitivity_v * value + channel.noise_v * generator.standard_normal(len(true_s))
        )
        volts = np.rint(volts / channel.lsb_v) * channel.lsb_v
        volts[(blank or {}).get(n, slice(0))] = np.nan
        volts[(replaced or {}).get(n, slice(0))] = 0.0
        columns[f"{channel.name} [V]"] = volts
    known = {channel.name: (lambda t, n=n: two_tones(t + 0.001 * n)) for n, channel in enumerate(PROBES)}
    names = [channel.name for channel in PROBES]
    return judge(write_parquet(file, columns), [session], path="analogue", formulas=known, channels=names)


def red(card: Scorecard) -> set[tuple[str, str]]:
    return {(row.quantity, row.channel) for row in card.rows if row.verdict == FAIL}


def test_a_lost_sample_of_a_repeating_signal_fails(session: Path, tmp_path: Path) -> None:
    card = card_of(session, tmp_path / "daq.parquet", np.delete(TRUE_S, 5000))
    assert red(card) == {("lost samples", "")}
    assert card.runs["lost samples"] == [(5000, 5000)]
    assert card.row("start", next(r.channel for r in card.rows if r.quantity == "start")).verdict == INCONCLUSIVE
    assert card.row("gain", "disk_x").verdict == PASS


def test_a_repeated_sample_of_a_whirl_keeps_one_start_for_all_channels(tmp_path: Path) -> None:
    """One channel is explained equally well half a turn off; the channels a quarter turn later are not."""
    sent, rate_hz = Sessions(tmp_path).get("test-whirl", seed=54, first_s=61.0), 25.6e3
    box = Converter(61.3 + 1e-5, round(0.8 * rate_hz), rate_hz, ppm=40.0)
    volts = box.volts(sent, np.random.default_rng(3))
    volts = np.insert(volts, 60, volts[60], axis=0)
    times_s = np.arange(len(volts)) / rate_hz
    file = write_values("parquet", tmp_path / "daq", make_columns(sent, volts, "unit"), times_s, rate_hz)
    assert red(judge(file, [sent.path], path="analogue")) == {("doubled samples", "")}


def test_lost_samples_are_found_beside_a_late_input(tmp_path: Path) -> None:
    """A late input is explained by no start; it must not decide for a start at which the signal nearly repeats."""
    sent = Sessions(tmp_path / "sessions").get("test-two-tone", first_s=61.0)
    box = Converter(61.05, 12_000, ppm=30.0, skew_s=np.array([-8e-4, 0.0, 0.0, 0.0]))
    volts = np.delete(box.volts(sent, np.random.default_rng(1)), np.arange(9000, 9016), axis=0)
    columns = dict(list(make_columns(sent, volts, "unit").items())[:3])
    file = write_values("parquet", tmp_path / "daq", columns, np.arange(len(volts)) / RATE_HZ, RATE_HZ)
    card = judge(file, [sent.path], path="analogue", channels=list(columns))
    assert (card.row("lost samples", "").value, card.runs["lost samples"]) == (16, [(9000, 9000)])


def test_rows_before_a_frozen_channel_stay_inside_the_session(tmp_path: Path) -> None:
    """A fault of 10 ms on one channel spoils no fit of the rest of a sine, and hides no rows."""
    sent = Sessions(tmp_path / "sessions").get("test-sine")
    volts = Converter(2.05, 24_000).volts(sent, np.random.default_rng(9))
    volts[9000:9200, 1] = volts[9000, 1]
    columns = make_columns(sent, volts, "unit")
    file = write_values("parquet", tmp_path / "daq", columns, np.arange(len(volts)) / RATE_HZ, RATE_HZ)
    card = judge(file, [sent.path], path="analogue")
    assert {channel for _, channel in red(card)} == {sent.channels[1].name}
    assert all("half a period later" in each for each in card.remarks)  # no rows are outside the session


@pytest.mark.parametrize(("at", "names"), [(8000, 4), (10_000, 2)])
def test_a_replaced_block_does_not_move_the_record_out_of_the_session(at: int, names: int, tmp_path: Path) -> None:
    """Judged up to the fault only, a wrong start leaves a smaller residual than the right one."""
    sent = Sessions(tmp_path / "sessions").get("test-two-tone", first_s=61.0)
    volts = Converter(61.2, 20_000).volts(sent, np.random.default_rng(3))
    volts[at : at + 200] = volts[at - 200 : at]
    columns = dict(list(make_columns(sent, volts, "unit").items())[:names])
    file = write_values("parquet", tmp_path / "daq", columns, np.arange(len(volts)) / RATE_HZ, RATE_HZ)
    card = judge(file, [sent.path], path="analogue", channels=list(columns))
    assert card.outcome == "fail"
    assert {quantity for quantity, _ in red(card)}.isdisjoint({"polarity", "gain", "offset"})
    assert all("half a period later" in each for each in card.remarks)  # no rows are outside the session


@pytest.mark.parametrize(
    ("blank", "lost"),
    [
        ({1: slice(5000, 5001)}, {1: 1}),
        (dict.fromkeys(range(3), slice(5000, 5100)), {0: 100, 1: 100, 2: 100}),
        ({0: slice(0, 4000)}, {0: 4000}),
        ({2: slice(1, None, 2)}, {}),
        (dict.fromkeys(range(3), slice(0, 300)), {}),
    ],
    ids=["one value", "all of a stretch", "half a channel", "every other row", "begins later"],
)
def test_rows_without_a_value_are_lost(
    blank: dict[int, slice], lost: dict[int, int], session: Path, tmp_path: Path
) -> None:
    card = card_of(session, tmp_path / "daq.parquet", TRUE_S, blank=blank)
    assert red(card) == {("lost samples", PROBES[n].name) for n in lost}
    for n, count in lost.items():
        assert card.row("lost samples", PROBES[n].name).value == count


DAQ_TIMES_S = np.arange(len(TRUE_S)) / RATE_HZ
UNEVEN = np.arange(len(TRUE_S)) % 7 == 5


@pytest.mark.parametrize(("held", "phase"), [(8, 0), (8, 5), (4, 1), (2, 1), (0, 0)])
def test_a_channel_of_a_lower_rate_in_one_table_is_judged_by_its_own_rows(
    held: int, phase: int, session: Path, tmp_path: Path
) -> None:
    """Two rates with no row in common, as programs merge files: the time stamps are uneven."""
    rows = np.arange(len(TRUE_S))
    if held:
        blank, true_s, stamps_s = {1: rows % held != phase}, TRUE_S, DAQ_TIMES_S
    else:
        blank, shift = {0: UNEVEN, 1: ~UNEVEN, 2: UNEVEN}, np.where(UNEVEN, 0.5, 0.0)
        own = np.cumsum(np.where(UNEVEN, 0, 1)) - 1 + shift
        stamps_s, true_s = own / RATE_HZ, 0.05 + own / RATE_HZ * (1.0 - 30e-6)
    card = card_of(session, tmp_path / "daq.parquet", true_s, blank=blank, stamps_s=stamps_s)  # type: ignore[arg-type]
    assert red(card) == set(), card.verdict_line
    assert card.row("gain", PROBES[1].name).verdict == PASS
    assert card.row("clock").value == pytest.approx(30.0, abs=1.0)


@pytest.mark.parametrize(
    ("stamps_s", "quantity"),
    [
        (np.where(np.arange(len(TRUE_S)) == 4000, DAQ_TIMES_S - 1e-4, DAQ_TIMES_S), "stamps that go back"),
        (np.where(np.arange(len(TRUE_S)) < 4000, DAQ_TIMES_S, DAQ_TIMES_S - 2e-3), "stamps that go back"),
        (np.where(np.arange(len(TRUE_S)) < 4000, DAQ_TIMES_S, DAQ_TIMES_S + 2e-3), "stamp rate"),
        (np.zeros(len(TRUE_S)), "stamp rate"),
        (DAQ_TIMES_S[::-1].copy(), "stamps that go back"),
    ],
    ids=["one back", "back from a row on", "ahead from a row on", "constant", "reversed"],
)
def test_bad_time_stamps_fail_on_the_analogue_path(
    stamps_s: np.ndarray, quantity: str, session: Path, tmp_path: Path
) -> None:
    card = card_of(session, tmp_path / "daq.parquet", TRUE_S, stamps_s=stamps_s)
    assert (quantity, "") in red(card)
    assert {name for name, _ in red(card)} <= {"stamps that go back", "stamp rate"}


@pytest.mark.parametrize(("begin", "rows"), [(4000, 100), (2000, 200), (6000, 100)])
def test_a_few_replaced_rows_fail_even_within_the_limit_of_unjudged_rows(
    begin: int, rows: int, session: Path, tmp_path: Path
) -> None:
    zeros = slice(begin, begin + rows)
    card = card_of(session, tmp_path / "daq.parquet", TRUE_S, replaced=dict.fromkeys(range(3), zeros))
    assert ("foreign rows", "") in red(card)
    ((first, last), *_) = card.runs["foreign rows"]
    assert first <= begin
    assert begin + rows <= last + 30


@pytest.mark.parametrize(
    ("kind", "unit", "outcome"),
    [("test-sine", "unit", "pass"), ("test-sine", "V", "fail")],
)
def test_an_inverted_record_fails_if_its_polarity_is_determined(
    kind: str, unit: str, outcome: str, tmp_path: Path
) -> None:
    """A sine is inverted half a period later, which leaves its polarity open; a bias does not."""
    sent = Sessions(tmp_path / "sessions").get(kind, first_s=61.0)
    volts = Converter(61.2, 8000).volts(sent, np.random.default_rng(9))
    columns = {name: (stamps, -values) for name, (stamps, values) in make_columns(sent, volts, unit).items()}
    file = write_values("parquet", tmp_path / "daq", columns, np.arange(len(volts)) / RATE_HZ, RATE_HZ)
    card = judge(file, [sent.path], path="analogue")
    assert card.outcome == outcome, card.verdict_line
    assert any("polarity" in each for each in card.remarks) == (outcome == "pass")


def test_one_inverted_channel_of_a_repeating_signal_fails(session: Path, tmp_path: Path) -> None:
    card = card_of(session, tmp_path / "daq.parquet", TRUE_S, turned=2)
    assert red(card) == {("polarity", PROBES[2].name)}


def test_clock_is_the_mean_and_its_drift_fails(session: Path, tmp_path: Path) -> None:
    since_s = TRUE_S - TRUE_S.mean()
    card = card_of(session, tmp_path / "daq.parquet", TRUE_S - 60e-6 * since_s**2)
    assert red(card) == {("clock drift", "")}
    assert card.row("clock").low < 30.0 < card.row("clock").high
    assert card.row("clock drift").value == pytest.approx(120.0, rel=0.01)


def test_an_idle_start_of_a_repeating_signal_begins_with_the_session(session: Path, tmp_path: Path) -> None:
    """Later starts explain the same rows; with them the idle rows would be in the session."""
    idle = np.full(2000, 0.0125)  # where the signal is zero
    card = card_of(session, tmp_path / "daq.parquet", np.concatenate([idle, 0.004 + np.arange(8001) / RATE_HZ]))
    assert red(card) == set()
    assert card.row("judged part").value == pytest.approx(1.0, abs=0.001)


@pytest.mark.parametrize(("before_s", "taken_s", "after_s"), [(5.0, 0.55, 0.0), (0.0, 0.8, 7.0)])
def test_quiet_rows_outside_a_repeating_session_are_not_judged(
    before_s: float, taken_s: float, after_s: float, tmp_path: Path
) -> None:
    """Hundreds of starts by whole periods explain the same rows; few of these leave the quiet rows outside."""
    sent = Sessions(tmp_path / "sessions").get("test-sine", seed=80, first_s=61.0)
    begin_s = 61.0 - before_s if before_s else 63.0 - taken_s
    rows = round((before_s + taken_s + after_s) * RATE_HZ)
    generator = np.random.default_rng(80)
    volts = Converter(begin_s, rows, ppm=40.0, idle_s=61.0).volts(sent, generator)
    for n, channel in enumerate(sent.channels):
        volts[rows - round(after_s * RATE_HZ) :, n] = channel.bias_v
    file = write_values("parquet", tmp_path / "daq", make_columns(sent, volts, "V"), np.arange(rows) / RATE_HZ, RATE_HZ)
    card = judge(file, [sent.path], path="analogue")
    assert (red(card), card.outcome) == (set(), "pass")
    assert card.row("judged part").value == pytest.approx(1.0, abs=0.002)


def test_exchanged_signals_a_quarter_turn_apart_are_detected() -> None:
    """A later start and another polarity explain one of the two pairs, not both."""
    t = np.arange(20_000) / RATE_HZ
    signals = {"disk_x": np.cos, "disk_y": np.sin, "ring_x": np.cos, "ring_y": np.sin}
    sent = {name: (signal(2.0 * np.pi * 27.0 * t), 20e3) for name, signal in signals.items()}
    recorded = {name: (values[3000:13_000], hz) for name, (values, hz) in sent.items()}
    wires = find_wires(recorded | {"ring_x": recorded["ring_y"], "ring_y": recorded["ring_x"]}, sent)
    assert {name: wire.channel for name, wire in wires.items()} == {
        "disk_x": "disk_x", "disk_y": "disk_y", "ring_x": "ring_y", "ring_y": "ring_x",
    }  # fmt: skip
    assert "ring_x" not in wires["ring_x"].rivals


def test_ringing_after_an_impact_is_distinguished_from_a_similar_channel() -> None:
    time_s = np.arange(20_000) / RATE_HZ
    ringing = TONES(time_s)
    hit = np.where((time_s > 0.05) & (time_s < 0.06), 30.0 * np.ptp(ringing), 0.0)
    near = ringing + 0.3 * np.std(ringing) * np.random.default_rng(4).standard_normal(len(time_s))
    sent = {"near": (near, RATE_HZ), "struck": (ringing + hit, RATE_HZ)}
    wire = find_wires({"struck": (ringing[6000:], RATE_HZ)}, sent)["struck"]
    assert (wire.channel, wire.rivals) == ("struck", ("near",))


def test_exact_repetitions_precede_near_repetitions() -> None:
    def tones(t: np.ndarray) -> np.ndarray:
        return np.sin(2.0 * np.pi * 79.0 * t) + np.sin(2.0 * np.pi * 1999.0 * t)

    known, rows = Exact(tones, (0.0, 2.0), RATE_HZ), np.arange(15_000)
    begin_s = 0.2
    values = tones(begin_s + rows / RATE_HZ)
    fit = fit_stretch(values, rows / RATE_HZ, known, begin_s, (5000, 10_000))
    assert fit is not None
    found = np.array(find_repeats(values, 0.0, fit, known)[:3])
    # Half a second later both tones have passed an odd number of half periods.
    assert np.sort(found) == pytest.approx([0.2, 0.7, 1.2], abs=1e-5)
