"""Foreign solvers on the chart: the problem file, the file of results, and refusals."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replays.studies.chart import session
from replays.studies.chart.drawing import figure
from replays.studies.chart.measure import Budget, measure_point, run_engine
from replays.studies.chart.methods import ADDED_FAMILY, competitors
from replays.studies.chart.phases import build_problem
from replays.studies.chart.store import Store, read_table
from replays.studies.chart.submission import write_problem
from replays.studies.peers import PEERS, Setting
from replays.studies.peers.common.problem import ERROR_COLUMNS, Problem
from replays.studies.peers.common.reference import Reference
from rig.cli.main import main
from rig.physics.kernels.laws.magnet import RADIAL
from rig.physics.kernels.signals import STATE
from rig.physics.levels import FRICTION_LAWS

PHASE = "first-impacts"
HEADINGS = ["time [s]", *(f"{STATE[column].name} [{STATE[column].unit}]" for column in ERROR_COLUMNS)]
KEYS = {"solver": "mine", "phase": PHASE, "setting": "1e-4", "cpu_s": "0.25", "contacts": "3"}


def make_results(times: np.ndarray, states: np.ndarray, **keys: str) -> str:
    """Return the text of a file of results."""
    rows = [",".join(map(repr, row)) for row in np.column_stack([times, states]).tolist()]
    return "\n".join([*(f"# {key}: {value}" for key, value in (KEYS | keys).items()), ",".join(HEADINGS), *rows, ""])


def run_refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run a command that must be refused, and return its last line."""
    with pytest.raises(SystemExit) as end:
        main(["chart", *arguments])
    assert end.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw nothing, and use a cheap reference without floors of smoothed laws."""

    def reference(problem: Problem, *, quick: bool) -> Reference:
        assert quick
        solution = PEERS["scipy-dop853"].solve(problem, Setting("1e-9", 1e-9))
        return Reference(solution, ("a", "b"), 1e-9, (0.0, 0.0), True)

    monkeypatch.setattr(session, "find_reference", reference)
    monkeypatch.setattr(session, "SMOOTHED_SPEEDS", ())
    monkeypatch.setattr(figure, "draw", lambda *_arguments, **_options: [])


@pytest.mark.usefixtures("undrawn")
def test_submitted_results_of_an_engine_equal_its_own_point(tmp_path: Path) -> None:
    problem, setting = build_problem("exact", PHASE, ""), Setting("25 us", 0.0, step_us=25)
    done = run_engine("rk4", setting, problem, Budget(30.0, 1))
    states, contacts = done.solution.states[:, ERROR_COLUMNS], done.solution.contacts
    versions: dict[str, tuple[np.ndarray, int]] = {
        "right": (states, contacts), "count": (states, contacts + 7), "branch": (states + 3.0, contacts),
    }  # fmt: skip
    arguments = []
    for name, (values, count) in versions.items():
        path = tmp_path / f"{name}.csv"
        path.write_text(make_results(problem.times, values, solver=name, contacts=str(count)), encoding="utf-8")
        arguments += ["--add", str(path)]
    folder = tmp_path / "out"
    with pytest.raises(SystemExit) as end:
        main(["chart", *arguments, "-o", str(folder)])
    assert end.value.code == 0
    assert not {*versions} & {*PEERS}, "registered for the moment of the comparison alone"
    rows = {row["method"]: row for row in read_table(folder)}
    reference = session.find_reference(problem, quick=True)
    assert reference is not None
    wanted = measure_point(competitors(peers=False)["rk4"], setting, problem, reference, Budget(30.0, 1))
    assert wanted["failure"] == ""
    assert rows["right"]["error"] == pytest.approx(wanted["error"], rel=1e-5)
    assert [rows[name]["failure"] for name in versions] == ["", "contacts", "branch"]
    row = rows["right"]
    assert (row["cpu_s"], row["speed"], row["tolerance"], row["rung"]) == (0.25, pytest.approx(0.2), 1e-4, "1e-4")
    assert {rows[name]["family"] for name in versions} == {ADDED_FAMILY}
    # The same solver, setting and phase again: the later file replaces the earlier one only.
    (tmp_path / "right.csv").write_text(
        make_results(problem.times, states, solver="right", cpu_s="0.5"), encoding="utf-8"
    )
    again_added = session.add_solvers(folder, [tmp_path / "right.csv"])
    drawn = "chart.png and chart-exact.png"  # the only phase is the main one
    assert re.fullmatch(
        rf"right, 1e-4, {PHASE}: error \S+, 0\.1 times real time, \d+ of \d+ contacts.*; drawn in {drawn}",
        again_added.added[0],
    )
    assert not (folder / "chart-work.png").exists(), "an added solver states no evaluations"
    again = {row["method"]: row for row in read_table(folder)}
    assert (again["right"]["cpu_s"], len(again)) == (0.5, len(rows))


def at_rest(**keys: str) -> str:
    times = build_problem("exact", PHASE, "").times
    return make_results(times, np.zeros((len(times), len(ERROR_COLUMNS))), **keys)


def change_line(number: int, change: Callable[[str], str]) -> Callable[[str], str]:
    """Change one line of a text, counted from its end if the number is negative."""

    def changed(text: str) -> str:
        lines = text.splitlines()
        lines[number] = change(lines[number])
        return "\n".join(lines)

    return changed


@pytest.mark.parametrize(
    ("keys", "change", "words"),
    [
        ({}, lambda text: text.replace("# cpu_s:", "# time:"), "cpu_s must be in one line `# cpu_s: VALUE`"),
        ({}, lambda text: f"# solver: two\n{text}", "solver must be in one line"),
        ({}, lambda _: "", "solver must be in one line"),
        ({}, lambda _: "\0\x89PNG", "solver must be in one line"),
        ({"phase": "rub"}, str, "phase must be one of first-impacts, transient, whirl, drop"),
        ({"solver": "tsit5"}, str, "solver must be 1 to 40 ASCII characters"),
        ({"solver": "heyoka"}, str, "solver must be 1 to 40"),
        ({"solver": "reference"}, str, "solver must be 1 to 40"),
        ({"solver": r"$\frac$"}, str, "solver must be 1 to 40"),
        ({"setting": ""}, str, "setting must be 1 to 40"),
        ({"cpu_s": "0"}, str, "cpu_s must be a number from 1e-09"),
        ({"cpu_s": "nan"}, str, "cpu_s must be a number"),
        ({"cpu_s": "1 s"}, str, "cpu_s must be a number"),
        ({"contacts": "3.5"}, str, "contacts must be a whole number from 0 to 99999; received '3.5'"),
        ({"contacts": "-1"}, str, "contacts must be a whole number"),
        ({}, lambda text: text.replace("beta [rad]", "beta [deg]"), "columns must be time [s], Gamma [rad], beta"),
        ({}, lambda text: text.replace("beta [rad]", "Gamma [rad]"), "columns must be"),
        ({}, lambda text: text[: text.index("time [s]")], "columns must be"),
        ({}, lambda text: text.rstrip().rpartition("\n")[0], "rows must be 51, one at each instant of the problem"),
        ({}, change_line(-1, lambda line: line.replace("0.049", "0.0489")), "time [s] in row 51 must be 0.05"),
        ({}, change_line(-2, lambda line: line.replace(",0.0", ",nan", 1)), "Gamma [rad] in row 50 must be a number"),
        ({}, change_line(-2, lambda line: line.replace(",0.0", ",inf", 1)), "Gamma [rad] in row 50 must be a number"),
        ({}, change_line(-2, lambda line: line.rpartition(",")[0]), "theta_rate [rad/s] in row 50 must be a number"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_in_one_line(
    keys: dict[str, str],
    change: Callable[[str], str],
    words: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    path = tmp_path / "mine.csv"
    path.write_text(change(at_rest(**keys)), encoding="utf-8")
    line = run_refused(capsys, "--add", str(path), "-o", str(tmp_path / "out"))
    assert words in line
    assert "received" in line
    assert not (tmp_path / "out").exists()


def test_wrong_options_are_refused_in_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path, folder = tmp_path / "mine.csv", tmp_path / "out"
    path.write_text(at_rest(), encoding="utf-8")
    assert "file must be a file that can be read" in run_refused(capsys, "--add", f"{path}x", "-o", str(folder))
    assert "the only option except" in run_refused(capsys, "--add", str(path), "--full", "-o", str(folder))
    assert "the only option except" in run_refused(capsys, "--problem", "drop", "--draw", "-o", str(folder))
    assert "the only option except" in run_refused(capsys, "--problem", "drop", "--add", str(path), "-o", str(folder))
    assert "phase must be one of" in run_refused(capsys, "--problem", "rub", "-o", str(folder))
    assert not folder.exists()
    assert "must be a folder" in run_refused(capsys, "--problem", "drop", "-o", str(path))


def test_a_chart_of_other_code_is_not_extended(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_text(at_rest(), encoding="utf-8")
    store = Store(tmp_path / "out")
    store.stamp = {**store.stamp, "code": "another"}
    columns = {"mode": "quick", "panel": "exact", "phase": PHASE, "case": "", "method": "rk4", "rung": "5 us"}
    store.add(columns)
    before = [path.read_bytes() for path in store.write("quick")]
    assert "output must be a folder with a chart by this code" in run_refused(
        capsys, "--add", str(path), "-o", str(tmp_path / "out")
    )
    assert before == [(tmp_path / "out" / name).read_bytes() for name in ("chart.parquet", "chart.csv")]


def test_an_added_solver_is_drawn_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("replays.report.canvas.png", lambda _figure, **_about: b"")
    store = Store(tmp_path)
    columns: dict[str, Any] = {"mode": "quick", "panel": "exact", "phase": "whirl", "case": "", "family": ADDED_FAMILY}
    good = {"error": 1e-4, "speed": 1.0, "speed_min": 1.0, "speed_max": 1.0}
    store.add({**columns, **good, "method": "mine", "title": "mine", "rung": "1e-6"})
    store.add({**columns, "method": "mine", "title": "mine", "rung": "1e-2", "speed": 2.0, "failure": "branch"})
    figure.draw(store.rows("quick"), tmp_path, ["exact"], command="rig chart")
    drawn = (tmp_path / "chart.svg").read_text(encoding="utf-8")
    assert 'id="mine"' in drawn
    assert 'id="failure-mine-1e-2"' in drawn
    assert ADDED_FAMILY in drawn
    assert "Solvers added" in drawn, "in the words under the picture"


@pytest.mark.parametrize("phase", ["first-impacts", "drop"])
def test_a_problem_file_contains_exactly_the_documented_fields(phase: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as end:
        main(["chart", "--problem", phase, "-o", str(tmp_path)])
    assert end.value.code == 0
    document = json.loads((tmp_path / f"problem-{phase}.json").read_text(encoding="utf-8"))
    problem = build_problem("exact", phase, "")
    assert document["instants_s"] == problem.times.tolist()
    assert document["corners_s"] == list(problem.corners)
    assert list(document["initial_state"].values()) == problem.y0.tolist()
    assert document["units"]["initial_state"] == {signal.name: signal.unit for signal in STATE}
    for group in ("shaft", "magnet", "contact", "house"):
        values = document[group]
        assert values == getattr(problem.constants, group)._asdict()
        assert {*document["units"][group]} >= {*values} - {"terms", "number", "gap_counts_outer"}
    # Terms that the equations of docs/charts.md omit are zero.
    levels = problem.constants.levels
    assert (levels.euler, levels.inner_house, levels.outer_house, levels.compliant) == (True, True, True, True)
    assert levels.friction == FRICTION_LAWS["exact"]
    assert problem.constants.magnet.terms == RADIAL
    assert problem.constants.contact.gap_counts_outer == problem.constants.contact.viscous_damping == 0.0
    assert (problem.inputs.ideal_drive, problem.inputs.speed_slope) == (False, 0.0)


def test_units_of_a_problem_are_those_of_the_constants(tmp_path: Path) -> None:
    units = json.loads(write_problem("drop", tmp_path).read_text(encoding="utf-8"))["units"]
    assert units["shaft"]["unbalance"] == "kg m"
    assert units["contact"]["stiffness"] == "N/m^exponent"
    assert units["inputs"]["speed"] == "rad/s"
    assert units["torque_gain"] == "N m s"
    tables = [group for group in units.values() if isinstance(group, dict)]
    assert not [unit for group in tables for unit in group.values() if re.search(r"[\[\],]", unit)]
