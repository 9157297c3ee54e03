"""`rig paper`: its data files, its verdicts, its quick variant, and refusals."""

from __future__ import annotations

import itertools
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replays.report import write_report
from replays.report.document import Heading, Paragraph, Picture, Report, Table
from replays.studies.paper.claim import CORRECTIONS, Bar, bars, claim_groups, correction_keys, select_lower_ends
from replays.studies.paper.document import typeset, write_up
from replays.studies.paper.figures.chart import draw_verdicts
from replays.studies.paper.figures.figure import first_impacts
from replays.studies.paper.findings import Findings, find, list_groups, steps
from replays.studies.paper.scans.pulse import PULSE_AT, Pulse, PulseRun, outcome, outcomes
from replays.studies.paper.scans.spread import (
    assumed_values,
    changes,
    free_values,
    hypercube,
    one_at_a_time,
    phases,
    rank_correlation,
)
from replays.studies.paper.statement import (
    MIN_RUNS,
    SETS,
    Statement,
    claims,
    distribution,
    number,
    printed_values,
    statements,
)
from rig.cli.main import main
from rig.physics.parameters import load_parameters
from tests.commands import run_for_output
from tests.waiting import until

ASSUMPTIONS = {"hammer.duration", "hammer.at", "transducer.bandwidth"}
"""Assumptions of the report in addition to the parameters."""


@pytest.fixture(scope="module")
def progress() -> list[str]:
    return []


@pytest.fixture(scope="module")
def findings(progress: list[str]) -> Findings:
    return find(quick=True, processes=1, progress=progress.append)


def statement(**fields: object) -> Statement:
    given = {"quantity": "q", "place": "p", "says": "s", "kind": "claim", "paper": "", "unit": "N"}
    return Statement.model_validate({**given, **fields})


def test_every_assumed_value_has_a_range():
    for name in SETS:
        entries = load_parameters(name).entries
        assumed = {key for key, entry in entries.items() if entry.kind == "assumed"}
        assert {entry.key for entry in assumed_values()} == assumed | ASSUMPTIONS


def test_ranges_contain_the_default_and_are_valid_in_the_model():
    entries = load_parameters().entries
    for entry in free_values():
        assert entry.low < entry.high
        assert entry.why
        value = entries[entry.key].value if entry.key in entries else entry.value
        if isinstance(value, float):
            assert entry.low <= value <= entry.high, entry.key
        if entry.key in entries and not entry.name:
            least, most = entries[entry.key].range
            assert least <= entry.low
            assert entry.high <= most


def test_tied_value_follows():
    assert changes({"shaft.radius": 27.0}) == {"shaft.radius": 27.0, "ring.clearance": 2.0}


def test_hypercube_has_one_point_per_layer_and_is_reproducible():
    parts, pulses = hypercube(8)
    assert np.array_equal(parts, hypercube(8)[0])
    assert len(pulses) == 8
    for column in parts.T:
        assert sorted(np.floor(column * 8).astype(int)) == list(range(8))


def test_statements_name_their_source_and_agreement():
    names = [entry.quantity for entry in (*statements(), *claims())]
    assert len(set(names)) == len(names)
    for entry in (*statements(), *claims()):
        assert entry.place
        assert entry.says
        judged = math.isfinite(entry.low) and math.isfinite(entry.high)
        assert judged != bool(entry.why), entry.quantity
        if judged:
            assert entry.low <= entry.high
    keys = load_parameters().entries
    assert all(printed.key in keys for printed in printed_values())


@pytest.mark.parametrize(
    ("value", "verdict"), [(1.0, "agrees"), (2.0, "agrees"), (2.1, "differs"), (0.9, "differs"), (math.nan, "differs")]
)
def test_verdict_of_a_number(value, verdict):
    assert statement(low=1.0, high=2.0).verdict(np.full(MIN_RUNS, value)) == verdict
    assert statement(low=1.0, high=2.0).verdict(np.full(MIN_RUNS - 1, value)) == "cannot be judged"


@pytest.mark.parametrize(
    ("inside", "verdict"),
    [(0, "differs"), (1, "differs"), (2, "cannot be judged"), (18, "cannot be judged"), (19, "agrees"), (20, "agrees")],
)
def test_verdict_of_a_share_inside(inside, verdict):
    values = np.repeat([1.5, math.nan], [inside, 20 - inside])
    assert statement(low=1.0, high=2.0).verdict(values) == verdict


@pytest.mark.parametrize(
    ("inside", "count", "fields", "shown"),
    [
        (19, 20, {}, "95%, 76% to 99% (20)"), (8, 8, {}, "100%, 68% to 100% (8)"), (0, 16, {}, "0%, 0% to 19% (16)"),
        (2, 2, {}, "too few (2)"), (16, 16, {"readings": 2}, "100%, 68% to 100% (8, 2 readings)"),
        (8, 8, {"readings": 2}, "too few (4, 2 readings)"), (0, 5, {"listed": True}, "0 of 5 cases"),
    ],
)  # fmt: skip
def test_a_share_has_the_bounds_of_its_runs_or_says_too_few(inside, count, fields, shown):
    from scipy.stats import binomtest

    entry, values = statement(low=1.0, high=2.0, **fields), np.repeat([1.5, 3.0], [inside, count - inside])
    assert entry.format_share(values) == shown
    if math.isfinite(entry.bounds(values)[0]):
        runs = count // entry.readings
        expected = binomtest(inside // entry.readings, runs).proportion_ci(method="wilson")
        assert entry.bounds(values) == pytest.approx(tuple(expected), abs=1e-6)


CONTRADICTIONS = {
    "drop_span": 0.3, "drop_settled": 250.0, "drop_bounces": 1.0, "drop_reaction": 1000.0, "drop_acceleration": 500.0,
    "drop_sensed": 500.0, "drop_sensed_acceleration": 500.0, "drop_amplified": 0.7, "backward": 0.0, "lasts": 0.0,
    "orbit_ring": 0.3, "orbit_disk": 0.5, "whirl_hz": 80.0, "whirl_per_spin": 13.0, "imbalance": 3.0,
    "peak_x": 1000.0, "peak_y": 1000.0, "peak_sensed": 1500.0, "steady": 10.0, "east": 300.0, "bouncing": 1.3,
    "slowest_whirls": 0.0, "period_ratio": 1.0, "impulsive_ratio": 0.9, "house_raises": 0.95, "house_ripple": 0.9,
    "stiff_bouncing": 0.8, "stiff_force": 0.8, "law_whirl": 1.02, "law_peak": 2.0,
}  # fmt: skip
"""A possible result for each judged statement that contradicts it. A whirl at a natural frequency has an equal period
at any speed; a rigid ring has a ripple by unequal damping; times and ratios above 0 need no test."""


def test_every_judged_statement_can_be_contradicted_by_a_possible_result():
    judged = {entry.quantity: entry for entry in (*statements(), *claims()) if math.isfinite(entry.low)}
    assert set(judged) == set(CONTRADICTIONS)
    for name, value in CONTRADICTIONS.items():
        assert value > 0.0 or judged[name].low == judged[name].high == 1.0, "no motion has it"
        assert judged[name].verdict(np.full(100, value)) == "differs", name


def test_verdict_without_data():
    assert statement(why="no axis").verdict(np.array([1.0])) == "cannot be judged"


@pytest.mark.parametrize(
    ("values", "shown"),
    [([1.0, 1.0], "1"), ([1.1111, 1.1112], "1.111"), ([538.6], "538.6"), ([1000.0, 2084.0, 3000.0], "2080 (1000–3000)"),
     ([1.049, 1.6, 2.38], "1.60 (1.05–2.38)"), ([13.19, 13.4, 13.47], "13.40 (13.19–13.47)"),
     (list(range(1, 102)), "51.0 (6.0–96.0)"), ([math.nan], "none")],
)  # fmt: skip
def test_distribution_is_printed_with_its_significant_figures(values, shown):
    assert distribution(np.array(values)) == shown


def test_printed_values_against_the_sets():
    printed = {entry.key: entry for entry in printed_values()}
    verdicts = {key: entry.verdict(load_parameters("as-printed")) for key, entry in printed.items()}
    differs = {key for key, verdict in verdicts.items() if verdict == "differs"}
    # M_oh denotes the sum in eqs. 24 and 25, K_ft one transducer of a pair.
    assert differs == {"house.outer_mass", "house.pair_stiffness_vertical"}


def test_a_decaying_pulse_and_an_invalid_model():
    weak = outcome(Pulse(force_n=5.0, duration_s=0.3))
    assert not weak.whirls
    assert math.isnan(weak.whirl_hz)
    assert outcome(Pulse(changes={"magnet.count": 20})).outcome == "cannot be built"


def test_bandwidth_lowers_the_peak_and_not_the_contact():
    plain, slow = (outcome(Pulse(changes=change)) for change in ({}, {"transducer.bandwidth": 200.0}))
    assert slow.peak_x_n < 0.6 * plain.peak_x_n
    assert slow.normal_n == plain.normal_n
    # Butterworth of order 2 at 82 Hz.
    share = 1.0 / math.sqrt(1.0 + (abs(plain.whirl_hz) / 200.0) ** 4)
    assert slow.reaction_x_n / plain.reaction_x_n == pytest.approx(share, rel=5e-3)


def test_corrections_are_where_the_sets_differ():
    assert set(correction_keys()) == set(CORRECTIONS)


def test_tornado_is_sorted_by_width_and_marks_the_measured_value():
    blank = PulseRun("backward whirl", reaction_x_n=540.0)
    results = {name: [blank] for name in claim_groups(ensemble=1)}
    results["low shaft.radius"] = [PulseRun("backward whirl", reaction_x_n=350.0)]
    found = bars(results, "reaction_x_n")
    assert found[0] == Bar("shaft radius", "assumed value", (350.0, 540.0, 540.0))
    assert select_lower_ends(found) == found[:1]
    assert {entry.called for entry in free_values()} <= {bar.name for bar in found}
    assert {entry.key for entry, _, _ in one_at_a_time()} == {entry.key for entry in free_values()}


def test_phases_cover_one_turn_of_the_shaft():
    at = [pulse.changes[PULSE_AT] for pulse in phases(Pulse(), 4)]
    assert np.diff(at) == pytest.approx([1 / 6.2 / 4] * 3, abs=2e-4)


def test_rank_correlation():
    parts = np.array([[0.1, 0.9], [0.4, 0.2], [0.6, 0.7], [0.9, 0.1], [0.5, 0.5]])
    values = np.array([1.0, 8.0, 27.0, 64.0, math.nan])
    assert rank_correlation(parts, values) == pytest.approx([1.0, -0.8])


def test_quick_variant_has_a_number_on_every_line(findings: Findings, progress: list[str]):
    assert len(progress) == steps(quick=True)
    for line in findings.lines:
        assert set(line.values) == set(SETS)
    for line in [*findings.lines, *findings.claims]:
        assert all(np.isfinite(values).all() for values in line.values.values()), line.statement.quantity
        *_, corrected, inside, verdict = line.row().cells
        assert re.search(r"\d", corrected)
        assert (inside == "–") == bool(line.statement.why)
        assert verdict
    spread = {line.statement.quantity: len(line.values["corrected"]) for line in findings.lines}
    assert spread["peak_x"] == len(findings.spread), "all assumed values at once"
    assert spread["orbit_ring"] == 2 * spread["orbit_disk"], "in the ring or at the disk"
    runs = {line.statement.quantity: line.statement.count_runs(line.values["corrected"]) for line in findings.lines}
    assert runs["orbit_ring"] == spread["orbit_disk"]
    assert runs["drop_amplified"] == runs["drop_reaction"] == 4
    claims_of = {line.statement.quantity: line.values["corrected"] for line in findings.claims}
    few = len(findings.results["spread rigid"])
    assert {line.statement.count_runs(line.values["corrected"]) for line in findings.claims[:4]} == {few}
    assert len(claims_of["stiff_force"]) == 3 * 3 * few > 9, "three housings and three readings of each sample"
    assert len(claims_of["house_raises"]) == few
    assert spread["drop_amplified"] == 2 * spread["drop_reaction"] > 2, "two readings of each sample"
    assert all(len(findings.results[name]) == len(group) for name, group in list_groups(quick=True).items())


@pytest.fixture(scope="module")
def report(findings: Findings) -> Iterator[Report]:
    """The report of the quick variant, its pictures small and without automatic layout, which takes long."""
    picture = Report.picture

    def small(report: Report, figure: Any, caption: str, *, dpi: int = 25) -> None:
        figure.set_layout_engine("none")
        picture(report, figure, caption, dpi=min(dpi, 25))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Report, "picture", small)
        yield write_up(findings, quick=True)


def test_labels_of_the_statements_are_whole_and_apart(findings: Findings):
    figure = draw_verdicts([*findings.lines, *findings.claims])
    figure.canvas.draw()
    boxes = [label.get_window_extent() for label in figure.axes[0].get_yticklabels()]
    assert min(box.x0 for box in boxes) >= 0.0
    assert all(above.y0 >= below.y1 for above, below in itertools.pairwise(boxes))


def test_report_backs_every_section_with_a_table(report: Report, tmp_path: Path):
    headings = [part.text for part in report.parts if isinstance(part, Heading) and part.level == 1]
    assert headings == [
        "Summary",
        "Figure by figure",
        "Open questions",
        "The paper's conclusion: which changes bring the force closer to the measured one?",
        "Conditions for whirl, and whirl frequency",
        "Assumed values",
    ]
    assert sum(isinstance(part, Picture) for part in report.parts) == 13
    assert isinstance(report.parts[0], Picture), "a picture before any table"
    for before, after in zip(report.parts[1:], report.parts[2:], strict=False):
        if isinstance(before, Picture):
            assert isinstance(after, Table), before.caption
    judged = [part for part in report.parts if isinstance(part, Table) and part.headings[0] == "statement"]
    stated = [row.cells[0] for table in judged for row in table.rows]
    assert len(stated) == len(set(stated)) == len(statements()) + len(claims()), "each once"
    for table in (part for part in report.parts if isinstance(part, Table)):
        assert table.rows, table.caption
        assert any(re.search(r"\d", cell) for row in table.rows for cell in row.cells[1:])
    opened = report.parts.index(Heading("Open questions"))
    questions = [n for n, part in enumerate(report.parts) if isinstance(part, Heading) and n > opened]
    questions = questions[: next(n for n, place in enumerate(questions) if report.parts[place].level == 1)]
    assert len(questions) == 6
    for place in questions:
        answer = report.parts[place + 2]
        assert isinstance(answer, Paragraph)
        assert re.search(r"\d", answer.text)
    target = tmp_path / "report.html"
    write_report(report, target)
    text = target.read_text(encoding="utf-8")
    assert "nan" not in re.sub(r"base64,[^\"]*", "", text)


@pytest.mark.wallclock
def test_two_processes_give_the_result_of_one():
    pulses = [Pulse(label=str(force), force_n=force, duration_s=0.3) for force in (20.0, 80.0, 100.0, 120.0)]
    labels: list[str] = []
    assert str(list(outcomes(pulses, processes=2, progress=labels.append))) == str(list(outcomes(pulses, processes=1)))
    assert labels == [pulse.label for pulse in pulses]


_POOL = """
import os, signal
from replays.studies.paper.scans.pulse import Pulse, outcomes
pulses = [Pulse(force_n=20.0, duration_s=0.05)] * 400
for n, _ in enumerate(outcomes(pulses, processes=2)):
    if n == 0:
        import multiprocessing
        print(*(child.pid for child in multiprocessing.active_children()), flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.wallclock
def test_workers_end_when_their_parent_is_killed():
    killed = subprocess.run([sys.executable, "-c", _POOL], capture_output=True, text=True, timeout=120)
    workers = [int(number) for number in killed.stdout.split()]
    assert len(workers) == 2, killed.stderr
    until(lambda: not any(map(_lives, workers)))


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("name", ["report.txt", "missing/report.html"])
def test_command_refuses_a_file_before_it_runs(name, tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        main(["paper", "--quick", "-o", str(tmp_path / name)])
    assert end.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_number():
    assert [number(x) for x in (math.nan, 0.0, 1234.5, 538.61, 1e-4, 1.28)] == [
        "none", "0", "1234", "538.6", "0.0001", "1.28",
    ]  # fmt: skip


def test_symbols_powers_and_signs_are_set_as_in_print():
    words = "R_S/r_0 of house.k_T with  ω_n² and l_0B², -1.5e-05 to 2e+07 N/m^n in eqs. 24-25, a-b"
    printed = "R_{S}/r_{0} of house.k_T with ω_{n}² and l_{0B}², −1.5·10^{−5} to 2·10^{7} N/m^{n} in eqs. 24-25, a-b"
    assert typeset(words) == printed
    assert [typeset(words) for words in ("6 to 12 count", "eqs. 24 and 25 count")] == ["6 to 12", "eqs. 24 and 25"]


def test_terminal_shows_every_statement_and_the_rule(findings: Findings, capsys, monkeypatch):
    monkeypatch.setattr("replays.studies.paper.findings.find", lambda **_: findings)
    printed = run_for_output(capsys, "paper", "--quick")
    text = " ".join(printed.split())
    for line in [*findings.lines, *findings.claims]:
        assert " ".join(line.row().cells[-2:]) in text
    assert not re.search(r"\d+ (agree|differ)", text), "no headline of counts"
    assert "more than 2/5" in text
    assert "no file written" in text


def test_a_folder_for_pictures_is_created(findings: Findings, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("replays.studies.paper.findings.find", lambda **_: findings)
    drawn: list[Path] = []
    monkeypatch.setattr("replays.studies.paper.document.draw_pictures", lambda _, folder: drawn.append(folder) or [])
    (tmp_path / "file").write_text("")
    for name, code in (("new", 0), ("new", 0), ("no/new", 2), ("file", 2)):
        with pytest.raises(SystemExit) as end:
            main(["paper", "--quick", "--pictures", str(tmp_path / name)])
        assert end.value.code == code, capsys.readouterr().err
    assert drawn == [tmp_path / "new"] * 2
    assert (tmp_path / "new").is_dir()


def test_deliberate_corrections_are_not_reported_as_differences(report: Report):
    table = next(part for part in report.parts if isinstance(part, Table) and part.headings[0] == "symbol")
    kept = load_parameters("corrected")
    for printed, row in zip(printed_values(), table.rows, strict=True):
        agrees = abs(kept[printed.key] / printed.value - 1.0) < 5e-3
        assert (row.cells[-1], row.mark) == (("as printed", "plain") if agrees else ("corrected", "open"))
    assert {row.cells[0] for row in table.rows if row.mark == "open"} == {
        "M_{oh} (as-printed contains M_{ih} + M_{oh})",
        "K_{ft}, printed for one transducer; both sets contain k_{T} of a pair",
    }  # fmt: skip


def test_ringing_houses_are_drawn_as_waves(findings: Findings):
    one = findings.runs_by_set["corrected"]
    start, end = first_impacts(one.drop["penetration"], one.drop.times_s * 1e3)
    touching = one.drop.times_s[one.drop["penetration"] > 0.0] * 1e3
    assert start < touching[0] < end
    inside = (one.drop.times_s * 1e3 > start) & (one.drop.times_s * 1e3 < end)
    force = (one.drop["P_S"] - one.drop["P_N"])[inside]
    waves = np.count_nonzero(np.diff(np.sign(force - force.mean()))) / 2
    assert 5 < waves < 40, "more would be a block on a panel of some 200 pixels"
