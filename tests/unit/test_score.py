"""Scorecards of synthetic DAQs with known defects: the declared quantities fail, and no others."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree

import numpy as np
import pytest

from replays.estimate.sine import fit_sine, is_sine, quality
from replays.recordings.export import write_run
from replays.recordings.formats.mapping import FileOptions
from replays.recordings.formats.readers import columnar, delimited, mdf
from replays.recordings.formats.source import open_source
from replays.report import write_report
from replays.score.card.limits import load_limits
from replays.score.card.scorecard import (
    FAIL,
    INCONCLUSIVE,
    NO_LIMIT,
    PASS,
    QUANTITIES,
    Scorecard,
    judge_row,
    write_junit,
)
from replays.score.judgement import judge
from replays.score.quantities.noise import split_noise
from replays.score.records.rows import NO_COUNT, follow, stretches
from replays.score.records.stimulus import EDGE, Exact, Sampled
from replays.score.waveform import fit_waveform, student
from rig.base.errors import InputError
from rig.base.outcome import Outcome
from rig.channels.table import default_table
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation
from tests.commands import run_captured
from tests.processes import ROOT
from tests.score_daqs import RATE_HZ, Tones, make_chips, make_counts, write_parquet, write_session

TABLE = default_table()
PROBES = TABLE.groups["probes"].channels
NAMES = TABLE.groups["probes"].names
SIGNALS = {name: Tones(seed, 0.5, high_hz=6000.0, tones=12) for seed, name in enumerate(NAMES)}
START_S, SECONDS = 0.05, 0.6


def red(card: Scorecard) -> set[str]:
    return {row.quantity for row in card.rows if row.verdict == FAIL}


# Digital: the counts of the probes were sent.


@pytest.fixture(scope="module")
def sent(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A session and its counts."""
    t = (400 + np.arange(RATE_HZ)) / RATE_HZ
    values = np.column_stack([signal(t) for signal in SIGNALS.values()])
    counts = make_counts("probes", values, np.random.default_rng(1))
    return write_session(tmp_path_factory.mktemp("sent") / "session.mcap", {"probes": counts}, index=400), counts


def in_units(counts: np.ndarray) -> dict[str, np.ndarray]:
    values = TABLE.groups["probes"].engineering(counts)
    return {f"{name} [mm]": values[:, n] for n, name in enumerate(NAMES)}


def in_volts(counts: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{c.name} [V]": (counts[:, n] * c.lsb_v).astype(np.float32) for n, c in enumerate(PROBES)}


def as_counts(counts: np.ndarray) -> dict[str, np.ndarray]:
    return {name: counts[:, n].astype(np.int32) for n, name in enumerate(NAMES)}


@pytest.mark.parametrize("form", [in_units, in_volts, as_counts])
def test_a_perfect_daq_has_every_row_once_with_every_count(
    sent: tuple[Path, np.ndarray], tmp_path: Path, form: Callable[[np.ndarray], dict[str, np.ndarray]]
) -> None:
    session, counts = sent
    card = judge(write_parquet(tmp_path / "daq.parquet", form(counts[500:])), [session])
    assert (card.path, red(card)) == ("digital", set())
    assert card.row("missing rows", "probes").verdict == PASS
    assert card.row("rows before the first", "probes").value == 500
    assert card.row("stamp rate", "probes").verdict == INCONCLUSIVE  # there are no stamps in the file


def test_the_session_itself_is_perfect_and_its_stamps_are_the_ticks(sent: tuple[Path, np.ndarray]) -> None:
    card = judge(sent[0], [sent[0]])
    assert (card.path, red(card)) == ("digital", set())
    assert card.row("stamp offset", "probes").value == pytest.approx(0.0, abs=1e-12)


def test_lost_repeated_swapped_and_altered_rows_are_named(sent: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    session, counts = sent
    rows = np.delete(np.arange(len(counts)), [5000, 5001, 12000])
    rows = np.insert(rows, 7001, rows[7000])
    rows[[15000, 15001]] = rows[[15001, 15000]]
    columns = in_units(counts[rows])
    columns["ring_x [mm]"][1234] += PROBES[2].scale
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [session])
    assert red(card) == {"missing rows", "doubled rows", "swapped rows", "altered values"}
    # Numbers are the rig's own: the session begins with row 400.
    assert card.runs == {
        "missing rows probes": [(5400, 5401), (12400, 12400)],
        "doubled rows probes": [(7402, 7402)],
        "swapped rows probes": [(15402, 15402)],
        "altered values ring_x": [(1634, 1634)],
    }
    assert [card.row("altered values", name).value for name in NAMES] == [0, 0, 1, 0]


def test_a_scale_outside_the_table_is_found_and_reported(sent: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    session, counts = sent
    columns = in_units(counts)
    columns["disk_y [mm]"] = 1.001 * columns["disk_y [mm]"]
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [session])
    assert red(card) == {"scale"}
    assert card.row("scale", "disk_y").value == pytest.approx(1000.0, rel=1e-6)
    assert card.row("altered values", "disk_y").verdict == PASS


def test_offset_and_rate_of_stamps_are_two_numbers(sent: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    session, counts = sent
    true_s = (400 + np.arange(len(counts))) / RATE_HZ
    jitter = 2e-6 * np.random.default_rng(2).standard_normal(len(counts))
    stamps = 1.7e3 + true_s + 150e-6 * (true_s - true_s[0]) + jitter
    card = judge(write_parquet(tmp_path / "daq.parquet", {"time [s]": stamps, **in_units(counts)}), [session])
    assert red(card) == set()
    for quantity, true, width in (("stamp offset", 1.7e3, 2e-7), ("stamp rate", 150.0, 0.4)):
        row = card.row(quantity, "probes")
        assert row.low - width < true < row.high + width
        assert row.high - row.low < width
    assert card.row("stamp jitter", "probes").value == pytest.approx(2e-6, rel=0.02)


@pytest.mark.parametrize("levels", [10_000, 150])
def test_every_event_in_many_rows_is_found(levels: int) -> None:
    generator = np.random.default_rng(levels)
    total = 400_000
    counts = (levels * generator.standard_normal((total, 1 if levels < 1000 else 4))).astype(np.int64)
    spots = 1000 + 350 * generator.permutation(total // 350 - 10)[:300]
    lost, again, late = np.split(np.sort(spots)[generator.permutation(300)], 3)
    order = np.arange(total)
    order[late], order[late + 1] = late + 1, late
    order = np.repeat(order, 1 + np.isin(order, again) - np.isin(order, lost))
    daq = counts[order]
    parts = (
        [counts[n : n + 7_000] for n in range(0, total, 7_000)],
        [daq[n : n + 65_536] for n in range(0, total, 65_536)],
    )
    found = None
    places = []
    for place, found in follow(*parts, counts.shape[1]):  # noqa: B007
        places.append(place)
    assert found is not None
    assert np.array_equal(np.concatenate(places), order)
    assert np.array_equal(found.lost, stretches(np.sort(lost)))
    assert np.array_equal(found.doubled[:, 0], np.sort(again))
    assert np.array_equal(found.swapped[:, 0], np.sort(late))
    assert not sum(each.rows for each in found.altered)
    assert not len(found.foreign)


def test_late_blocks_and_foreign_rows_are_reported() -> None:
    counts = np.random.default_rng(5).integers(-9000, 9000, (6000, 2))
    order = np.concatenate([np.arange(1000), np.arange(2000, 3000), np.arange(1000, 2000), np.arange(3000, 6000)])
    daq = counts[order]
    daq[4500] = NO_COUNT
    daq = np.insert(daq, 5000, [1, 2], axis=0)
    *_, (_, found) = follow([counts], [daq], 2)
    assert np.array_equal(found.swapped[:, 0], np.arange(1000, 2000))
    assert [each.pairs().tolist() for each in found.altered] == [[[4500, 4500]]] * 2
    assert found.foreign.tolist() == [5000]
    assert not len(found.lost)


def test_a_broken_channel_does_not_affect_the_row_assignment() -> None:
    counts = np.random.default_rng(6).integers(-9000, 9000, (200_000, 3))
    daq = counts.copy()
    daq[70_000:, 1] += 1
    order = np.insert(np.delete(np.arange(len(daq)), [150_000, 150_700]), 160_000, 160_001)
    chunks = [daq[order[n : n + 30_000]] for n in range(0, len(order), 30_000)]
    *_, (_, found) = follow([counts], chunks, 3)
    assert found.lost.tolist() == [[150_000, 150_000], [150_700, 150_700]]
    assert found.doubled[:, 0].tolist() == [160_001]
    assert [each.pairs().tolist() for each in found.altered] == [
        [],
        [[70_000, 149_999], [150_001, 150_699], [150_701, 199_999]],
        [],
    ]


# Analogue: formulas of tones, sampled by the DAQ's own clock.


def record_tones(
    generator: np.random.Generator, *, ppm: float = 0.0, jitter_s: float = 0.0, skew_s: float = 0.0, gain: float = 1.0,
    offset: float = 0.0, wires: tuple[int, ...] = (0, 1, 2, 3),
    turned: int = -1, corner_hz: float = 0.0, seconds: float = SECONDS,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Return the tones as a DAQ with these defects records them, in volts; skew is that of the second channel."""
    rows = round(seconds * RATE_HZ)
    true_s = START_S + np.arange(rows) / RATE_HZ / (1.0 + 1e-6 * ppm)
    columns = {"time [s]": np.arange(rows) / RATE_HZ}
    for n, channel in enumerate(PROBES):
        at_s = true_s + (skew_s if n == 1 else 0.0) + jitter_s * generator.standard_normal(rows)
        signal = list(SIGNALS.values())[wires[n]]
        value = signal(at_s) if not corner_hz else signal.behind(corner_hz, 4)(at_s)
        value = gain * (-value if n == turned else value) + offset
        volts = channel.bias_v + channel.sensitivity_v * value
        volts = volts + channel.noise_v * generator.standard_normal(rows)
        columns[f"{channel.name} [V]"] = np.rint(volts / channel.lsb_v) * channel.lsb_v
    return columns


@pytest.mark.parametrize(
    ("defects", "declared"),
    [
        ({}, set()),
        ({"gain": 1.002, "offset": 0.01}, {"gain", "offset"}),
        ({"wires": (1, 0, 2, 2), "turned": 2}, {"mapping", "polarity"}),
        ({"ppm": 260.0, "skew_s": 1.5e-6}, {"clock", "skew"}),
        ({"jitter_s": 120e-9}, {"jitter", "effective bits"}),
        ({"corner_hz": 2000.0}, {"corner"}),
    ],
    ids=["perfect", "gain-offset", "swapped-polarity", "clock-skew", "jitter", "low-pass"],
)
def test_each_defect_fails_exactly_its_declared_quantities(
    sent: tuple[Path, np.ndarray], tmp_path: Path, defects: dict[str, float], declared: set[str]
) -> None:
    columns = record_tones(np.random.default_rng(3), **defects)  # type: ignore[arg-type]
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [sent[0]], formulas=SIGNALS)
    assert card.path == "analogue"
    assert red(card) == declared
    true = {"gain": 2000.0, "offset": 0.01, "clock": 260.0, "skew": 1500.0, "jitter": 120.0, "corner": 2000.0}
    for row in card.rows:
        if row.verdict == FAIL and row.quantity in true and row.channel not in NAMES[2:]:
            wide = row.high - row.low  # one interval in twenty misses the truth: none may miss by its whole width
            assert row.low - wide < true[row.quantity] < row.high + wide, row


def test_without_a_formula_the_sessions_noise_makes_small_defects_inconclusive(
    sent: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    columns = record_tones(np.random.default_rng(3))
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [sent[0]])
    assert red(card) == set()
    assert card.row("gain", "disk_x").verdict == PASS
    assert card.row("noise", "disk_x").verdict == INCONCLUSIVE
    assert card.row("alias rejection").run


def test_fifteen_channels_are_mapped_by_two_seconds_of_chips() -> None:
    from replays.score.records.wiring import find_wires

    generator = np.random.default_rng(8)
    names = list(TABLE.channels)
    sent = {name: (make_chips(n, 2.2) + 0.01 * generator.standard_normal(44_000), 20e3) for n, name in enumerate(names)}
    order = generator.permutation(15)
    order[3] = order[7]  # one is recorded twice
    signs = generator.choice([-1, 1], 15)
    recorded = {
        f"ai{n}": (signs[n] * sent[names[k]][0][2000:42_000] + 0.3 * generator.standard_normal(40_000), 20e3)
        for n, k in enumerate(order)
    }
    wires = find_wires(recorded, sent)
    assert [wire.channel for wire in wires.values()] == [names[k] for k in order]
    assert [wire.polarity for wire in wires.values()] == signs.tolist()
    assert {wire.rivals for wire in wires.values()} == {()}
    assert wires["ai0"].offset_s == pytest.approx(0.1)


def test_intervals_have_the_cramer_rao_width() -> None:
    # A sine of 5 V in 1 mV of noise, 80 Hz, for 10 s at 20 kHz.
    amplitude, noise, hz, seconds = 5.0, 1e-3, 80.0, 10.0
    t = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    signal = Exact(lambda at: amplitude * np.sin(2.0 * np.pi * hz * at), (-1.0, 11.0), RATE_HZ)
    values = signal(t)[0] + noise * np.random.default_rng(4).standard_normal(len(t))
    found = fit_waveform(values, t, signal, (0.0, 0.0, 0.0))
    assert found is not None
    one = noise / math.sqrt(len(t))
    floors = [
        one * math.sqrt(2.0) / amplitude, one, one * math.sqrt(2.0) / (amplitude * 2.0 * np.pi * hz),
        one * math.sqrt(24.0) / (amplitude * 2.0 * np.pi * hz * seconds),
    ]  # fmt: skip
    assert found.spread[:4] == pytest.approx(floors, rel=0.35)
    widths = (student(found.dof) * found.spread)[:4]
    # Gain 10 ppm, offset 20 uV, skew of two such 20 ns, clock 0.01 ppm.
    assert (widths < [10e-6, 20e-6, 20e-9 / math.sqrt(2.0), 0.01e-6]).all()


def test_jitter_of_five_nanoseconds_is_separated_from_noise() -> None:
    t = np.arange(10 * RATE_HZ) / RATE_HZ
    generator = np.random.default_rng(5)
    signal = Exact(lambda at: 5.0 * np.sin(2.0 * np.pi * 1000.3 * at), (-1.0, 11.0), RATE_HZ)
    late = 5e-9 * generator.standard_normal(len(t))
    values = signal(t + late)[0] + 1e-3 * generator.standard_normal(len(t))
    found = fit_waveform(values, t, signal, (0.0, 0.0, 0.0))
    assert found is not None
    split = split_noise(found)
    assert split.jitter_s is not None
    assert 0.0 < split.jitter_s[1] < 5e-9 < split.jitter_s[2] < 8e-9
    assert split.noise[1] < 1e-3 < split.noise[2]


def test_bits_and_distortion_of_a_sine_agree_with_closed_forms() -> None:
    rows, amplitude, noise = 40_000, 4.0, 1e-3
    phase = 2.0 * np.pi * 0.048713 * np.arange(rows) + 0.4
    clean = amplitude * np.cos(phase) + 2e-3 * np.cos(2.0 * phase) + 1e-3 * np.cos(3.0 * phase + 1.0) + 0.2
    fit = fit_sine(clean + noise * np.random.default_rng(6).standard_normal(rows))
    found = quality(fit)
    power = noise**2 + 0.5 * (2e-3**2 + 1e-3**2)
    sinad = 10.0 * math.log10(0.5 * amplitude**2 / power)
    assert fit.frequency[0] == pytest.approx(0.048713, abs=4.0 * fit.frequency[1])
    assert fit.amplitude[0] == pytest.approx(amplitude, abs=4.0 * fit.amplitude[1])
    assert found.enob[0] == pytest.approx((sinad - 1.76) / 6.02, abs=0.05)
    assert found.thd_db[0] == pytest.approx(10.0 * math.log10(5e-6 / 16.0), abs=0.2)
    assert found.sfdr_db[0] == pytest.approx(20.0 * math.log10(4.0 / 2e-3), abs=0.5)
    assert is_sine(clean[:5000], 2e-3)
    assert not is_sine(make_chips(1, 1.0), 0.1)


def test_interpolation_has_an_error_of_a_millionth() -> None:
    signal = Tones(9, 1.0, high_hz=0.4 * RATE_HZ)
    samples = Sampled(signal(np.arange(4000) / RATE_HZ), 0.0, RATE_HZ)
    t = np.sort(np.random.default_rng(9).uniform(*samples.span_s, 3000))
    values, slopes = samples(t)
    true, steep = Exact(signal, (0.0, 1.0), RATE_HZ)(t)
    assert np.abs(values - true).max() < 3e-5
    assert np.abs(slopes - steep).max() < 3e-4 * np.abs(steep).max()
    assert samples.span_s[0] == EDGE / RATE_HZ


# Options, and output of the result.


def test_an_interval_across_its_limit_is_inconclusive() -> None:
    limit = load_limits().bounds("analogue", "gain")
    assert [judge_row("analogue", "gain", "", each, limit=limit).verdict for each in (
        (0.0, -5.0, 5.0), (200.0, 150.0, 250.0), (95.0, 80.0, 110.0), None,
    )] == [PASS, FAIL, INCONCLUSIVE, INCONCLUSIVE]  # fmt: skip
    assert judge_row("analogue", "start", "", (1.0, 0.0, 2.0)).verdict == NO_LIMIT


def scorecard(*verdicts: str, evidence_gaps: tuple[str, ...] = ()) -> Scorecard:
    card = Scorecard("DAQ", "digital", "limits", lambda *_, **__: None, evidence_gaps=list(evidence_gaps))
    for n, verdict in enumerate(verdicts):
        row = judge_row("digital", "altered values", f"channel {n}", (0.0, 0.0, 0.0))
        card.rows.append(replace(row, verdict=cast(Any, verdict)))
    return card


@pytest.mark.parametrize(
    ("card", "outcome"),
    [
        (scorecard(), Outcome.INCONCLUSIVE),
        (scorecard(NO_LIMIT), Outcome.INCONCLUSIVE),
        (scorecard(INCONCLUSIVE), Outcome.INCONCLUSIVE),
        (scorecard(PASS, NO_LIMIT, INCONCLUSIVE), Outcome.PASS),
        (scorecard(PASS, evidence_gaps=("half of the record was not judged",)), Outcome.INCONCLUSIVE),
        (scorecard(PASS, FAIL), Outcome.FAIL),
        (scorecard(PASS, FAIL, evidence_gaps=("half of the record was not judged",)), Outcome.FAIL),
    ],
)
def test_an_outcome_is_a_pass_only_without_a_failing_quantity_and_without_a_doubt(
    card: Scorecard, outcome: Outcome, tmp_path: Path
) -> None:
    assert card.outcome is outcome
    assert f"digital path: {outcome}" in card.verdict_line
    assert outcome is not Outcome.INCONCLUSIVE or (card.evidence_gaps or ["no quantity passes"])[0] in card.verdict_line
    write_junit(card, tmp_path / "r.xml")
    first = ElementTree.parse(tmp_path / "r.xml").getroot()[0].find("testcase")
    assert first is not None
    errors = [each.get("type") for each in first.findall("error")]
    assert errors == (["inconclusive"] if outcome is Outcome.INCONCLUSIVE else [])


def test_every_quantity_is_in_the_documentation() -> None:
    text = " ".join((ROOT / "docs/score-reference.md").read_text("utf-8").split())
    for path, known in QUANTITIES.items():
        assert f"- {path}: {', '.join(known)} " in text


def test_limits_have_a_source() -> None:
    table = load_limits().bounds("analogue", "noise", PROBES[0])
    assert table is not None
    assert table.high == pytest.approx(1.1 * 1e-3 / 3.94, rel=1e-3)
    quoted = load_limits("api-670").bounds("analogue", "gain", PROBES[0])
    assert quoted is not None
    assert quoted.source.endswith("quoted second-hand")
    assert load_limits("api-670").bounds("analogue", "gain", TABLE.channels["P_E"]) is None  # of probes alone
    assert load_limits("iso-20816").title


def test_the_command_writes_report_junit_and_json(
    sent: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, counts = sent
    daq = write_parquet(tmp_path / "daq.parquet", in_units(np.delete(counts, 777, axis=0)))
    reports = [tmp_path / name for name in ("r.html", "r.xml", "r.json")]
    files = ("-o", reports[0], "--junit", reports[1], "--json", reports[2])
    status, out, _ = run_captured(capsys, "score", daq, "--against", session, *files)
    assert status == 1
    assert "digital path: fail: 27 pass, 1 fail (missing rows)" in out
    suite = ElementTree.parse(reports[1]).getroot()[0]
    failed = [case.get("name") for case in suite if case.find("failure") is not None]
    assert (suite.get("failures"), failed) == ("2", ["outcome", "missing rows probes"])
    assert suite.get("skipped") == "0"
    document = json.loads(reports[2].read_text(encoding="utf-8"))
    assert document["runs"] == {"missing rows probes": [[1177, 1177]]}
    assert reports[0].read_text(encoding="utf-8").count("<img") == 0  # there are no stamps to draw


def test_the_report_draws_the_channels_of_the_analogue_path(sent: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    from replays.score.report import make_report

    columns = record_tones(np.random.default_rng(3), seconds=0.3)
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [sent[0]], formulas=SIGNALS)
    card.pictures = {name: card.pictures[name] for name in ("analogue disk_x",)}
    write_report(make_report(card), tmp_path / "r.html")
    assert (tmp_path / "r.html").read_text(encoding="utf-8").count("<img") == 1


def test_wrong_inputs_are_refused_in_one_line(
    sent: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, counts = sent
    noise = np.random.default_rng(1).standard_normal(5000)
    noise[::7], noise[1::7] = np.inf, 1e300
    other = write_parquet(tmp_path / "other.parquet", {"x": noise, "one": np.ones(5000), "none": np.full(5000, np.nan)})
    few = write_parquet(tmp_path / "few.parquet", {"disk_x [mm]": in_units(counts)["disk_x [mm]"].astype(np.float16)})
    (tmp_path / "mine.toml").write_text('title = "x"\n[analogue.gian]\nhigh = 1\nkind = "assumed"\nsource = "me"\n')
    for arguments, message in (
        (["--against", str(session), "--limits", "api-671"], "limits must be"),
        (["--against", str(session), "--limits", str(tmp_path / "mine.toml")], "such as gain"),
        (["--against", str(tmp_path / "none.mcap")], "none.mcap"),
        (["--against", str(session), "--junit", "r.txt"], "--junit must be"),
        (["--against", str(session)], "which has none"),
    ):
        status, _, err = run_captured(capsys, "score", other, *arguments)
        assert (status, err.count("\n")) == (2, 1), err
        assert message in err
    with pytest.raises(InputError, match="the values are not counts"):
        judge(few, [session], path="digital")


@pytest.mark.parametrize(
    ("name", "ppm"), [("test-two-tone", 30.0), ("test-two-tone", 60.0), ("test-chirp", 30.0), ("test-multisine", 30.0)]
)
def test_a_test_signal_is_compared_with_its_formula(name: str, ppm: float, tmp_path: Path) -> None:
    """The session's own noise is then not in the DAQ's reference."""
    scene = load_scene(name, {"duration_s": 0.8})
    write_run(Simulation(scene), tmp_path / "sent.mcap")
    generator, true_s = np.random.default_rng(8), 0.05 + np.arange(8000) / RATE_HZ / (1.0 + 1e-6 * ppm)
    columns = {}
    for channel in ("disk_x", "P_N"):
        source = scene.sources()[channel]
        noise = source.channel.noise_v * generator.standard_normal(len(true_s))
        columns[f"{channel} [V]"] = source.volts(true_s) + noise
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [tmp_path / "sent.mcap"], channels=["disk_x", "P_N"])
    assert red(card) == set()
    assert card.row("clock").value == pytest.approx(ppm, abs=0.05)
    if name == "test-two-tone":  # which nearly repeats after 82.3 ms, and does, turned, after half a second
        assert card.row("start", "disk_x").value % 0.5 == pytest.approx(0.05, abs=1e-6)
    for channel in ("disk_x", "P_N"):
        assert [card.row(quantity, channel).verdict for quantity in ("gain", "noise", "effective bits")] == [PASS] * 3


@pytest.mark.parametrize(("rejection_db", "verdict"), [(40.0, FAIL), (75.0, PASS)])
def test_a_tone_above_half_of_the_rate_measures_aliasing(rejection_db: float, verdict: str, tmp_path: Path) -> None:
    scene = load_scene("test-two-tone", {"duration_s": 0.8, "generator.frequencies": [79.0, 7001.0]})
    write_run(Simulation(scene), tmp_path / "sent.mcap")
    source, rate_hz = scene.sources()["disk_x"], RATE_HZ // 2
    since_s = np.arange(7000) / rate_hz
    true_s = 0.05 + since_s / (1.0 + 3e-5)
    volts = source.volts(true_s)
    low = source.channel.bias_v + 2.0 * np.sin(2.0 * np.pi * 79.0 * true_s)
    volts = low + 10.0 ** (-rejection_db / 20.0) * (volts - low)
    volts += source.channel.noise_v * np.random.default_rng(3).standard_normal(len(volts))
    file = write_parquet(tmp_path / "daq.parquet", {"time [s]": since_s, "disk_x [V]": volts})
    card = judge(file, [tmp_path / "sent.mcap"], channels=["disk_x"])
    row = card.row("alias rejection", "disk_x")
    assert row.low < rejection_db < row.high < row.low + 3.0
    assert row.verdict == verdict
    assert card.row("noise", "disk_x").verdict == PASS


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".mf4"])
def test_a_file_in_pieces_is_the_whole_file(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, path = 5000, tmp_path / f"daq{suffix}"
    columns = {"time [s]": 2.0 + np.arange(rows) / RATE_HZ, "a": np.arange(rows), "b": np.sin(np.arange(rows))}
    if suffix == ".mf4":
        import asammdf

        times_s = columns.pop("time [s]")
        file = asammdf.MDF(version="4.10")
        file.append([asammdf.Signal(values, times_s, name=name) for name, values in columns.items()])
        file.save(path)
        file.close()
    elif suffix == ".csv":
        lines = (",".join(map(repr, line)) for line in zip(*(each.tolist() for each in columns.values()), strict=True))
        path.write_text("\n".join([",".join(columns), *lines]))
    else:
        write_parquet(path, columns)
    monkeypatch.setattr(columnar, "_PIECE", 700)
    monkeypatch.setattr(delimited, "_BLOCK_BYTES", 1 << 12)
    monkeypatch.setattr(delimited, "_MAX_CACHED_VALUES", 0)
    monkeypatch.setattr(mdf, "_PIECE", 1 << 12)
    source = open_source(path, FileOptions())
    assert source.pieces is not None
    pieces = list(source.pieces(source.entries))
    assert len(pieces) > 5
    for n, entry in enumerate(source.entries):
        whole = source.read(entry)
        assert whole.times_s is not None
        assert (entry.rows, entry.rate_hz) == (rows, pytest.approx(RATE_HZ))
        assert np.array_equal(np.concatenate([piece[n].physical for piece in pieces]), whole.physical)
        stamps = [piece[n].times_s for piece in pieces]
        assert np.array_equal(np.concatenate([each for each in stamps if each is not None]), whole.times_s)


@pytest.mark.parametrize(("bits", "noise"), [(24, 1e-3), (12, 1e-4), (24, 2e-2)])
def test_effective_bits_are_those_of_a_windowed_spectrum(bits: int, noise: float) -> None:
    """The textbook's alternative: no fit, but lines of a Blackman-Harris window, which spreads a line over nine."""
    rows = 1 << 16
    phase = 2.0 * np.pi * 0.0498765 * np.arange(rows) + 0.3
    values = 4.0 * np.sin(phase) + 1e-3 * np.sin(3.0 * phase) + 0.2
    values += noise * np.random.default_rng(bits).standard_normal(rows)
    values = np.rint(values / (10.0 / 2**bits)) * (10.0 / 2**bits)
    found = quality(fit_sine(values))
    n = 2.0 * np.pi * np.arange(rows) / rows
    window = 0.35875 - 0.48829 * np.cos(n) + 0.14128 * np.cos(2.0 * n) - 0.01168 * np.cos(3.0 * n)
    power = np.abs(np.fft.rfft((values - values.mean()) * window)) ** 2
    peak = int(np.argmax(power))
    signal = power[peak - 5 : peak + 6].sum()
    rest = np.concatenate([power[6 : peak - 5], power[peak + 6 :]])
    sinad = 10.0 * math.log10(signal / (rest.sum() * len(power) / len(rest)))
    assert found.enob[0] == pytest.approx((sinad - 1.76) / 6.02, abs=0.05)
    third = round(3.0 * 0.0498765 * rows)
    thd = 10.0 * math.log10(power[third - 5 : third + 6].sum() / signal)
    # The fit subtracts the noise at the harmonics, a spectrum does not: at high noise the interval decides.
    assert noise > 1e-2 or found.thd_db[0] == pytest.approx(thd, abs=1.0)
    assert found.thd_db[1] <= 20.0 * math.log10(1e-3 / 4.0) <= found.thd_db[2]
