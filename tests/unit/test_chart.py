"""`rig chart`: resuming, criteria of failure, drawing, refusals. No timing asserted."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replays.studies.chart import measure, session
from replays.studies.chart.drawing import figure
from replays.studies.chart.drawing.figure import draw
from replays.studies.chart.drawing.panel import own_speed
from replays.studies.chart.measure import (
    BRANCH_ERROR,
    Budget,
    Run,
    block_statistics,
    elastic_forces,
    measure_point,
    run_engine,
)
from replays.studies.chart.methods import competitors
from replays.studies.chart.phases import PANELS, build_problem, plan_points
from replays.studies.chart.profile import draw_scene, profile_curves
from replays.studies.chart.session import make_chart
from replays.studies.chart.store import COLUMNS, KEY, Store, read_table
from replays.studies.peers import PEERS, Setting
from replays.studies.peers.common.problem import Problem
from replays.studies.peers.common.reference import Reference
from replays.studies.peers.common.solution import Solution
from rig.base.errors import InputError
from rig.cli.main import main
from rig.physics.kernels.signals import N_STATE

ONE_RUN = Budget(30.0, 1)


def row(**columns: Any) -> dict[str, Any]:
    base = {"mode": "quick", "panel": "exact", "phase": "whirl", "case": "", "method": "rk4", "rung": "5 us",
            "title": "rk4", "family": "rig"}  # fmt: skip
    return base | columns


def test_store_reuses_results_of_the_same_code(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.add(row(error=1e-3, speed=math.nan))
    with (tmp_path / "chart.journal.jsonl").open("a") as file:
        file.write('{"mode": "qui')  # a killed run
    again = Store(tmp_path)
    assert again.has(row())
    assert not again.has(row(mode="full"))
    kept = again.rows("quick")[0]
    assert (kept["error"], kept["speed"]) == (1e-3, None)
    assert kept["machine"]
    assert "numba" in kept["versions"]
    again.add(row(rung="10 us"))
    assert len(Store(tmp_path).rows("quick")) == 2
    assert not Store(tmp_path, fresh=True).rows("quick")


def test_store_repeats_results_of_other_code(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.stamp = {**store.stamp, "code": "another"}
    store.add(row(error=1e-3))
    later = Store(tmp_path)
    assert (later.outdated, later.rows("quick")) == (1, [])


def test_store_writes_one_table_in_two_formats(tmp_path: Path) -> None:
    import pyarrow.csv
    import pyarrow.parquet

    store = Store(tmp_path)
    store.add(row(error=1e-3))
    store.add(row(rung="10 us", failure="nan"))
    store.add(row(mode="full", error=2.0))
    parquet, csv = store.write("quick")
    table = pyarrow.parquet.read_table(parquet)
    assert table["error"].to_pylist() == [1e-3, None]
    assert pyarrow.csv.read_csv(csv).column_names == table.column_names


def make_run(shift: float) -> tuple[Problem, Reference, Run]:
    """Return a reference at rest, and a run that is off by `shift` scales in one of seven states, half the time."""
    problem = build_problem("exact", "first-impacts", "", end_s=4e-3)
    problem = Problem(**{**problem.__dict__, "times": problem.times[:4]})
    solution = Solution(problem.times, 1.0).close()
    solution.states = np.zeros((4, N_STATE))
    states = np.zeros((4, N_STATE))
    states[2:, 9] = 40.0 * shift
    ours = Solution(problem.times, 1.0).close()
    ours.states, ours.failure = states, None
    done = Run(ours, [0.5, 0.1, 0.2], problem.duration_s)
    return problem, Reference(solution, ("a", "b"), 1e-9, (0.0, 0.0), True), done


@pytest.mark.parametrize(
    ("shift", "contacts", "failure"), [(0.01, 0, ""), (0.01, 5, "contacts"), (10.0, 0, "branch"), (math.nan, 0, "nan")]
)
def test_error_and_verdict_of_a_hand_made_run(
    monkeypatch: pytest.MonkeyPatch, shift: float, contacts: int, failure: str
) -> None:
    problem, reference, done = make_run(shift)
    done.solution.onsets = [(0.0, 0.1)] * contacts
    done.solution.failure = "the state is not finite" if failure == "nan" else None
    monkeypatch.setattr(measure, "run_method", lambda *_: done)
    found = measure_point(competitors(peers=False)["rk4"], Setting("5 us", 0.0, step_us=5), problem, reference, ONE_RUN)
    assert found["failure"] == failure
    assert (found["cpu_s"], found["cpu_min_s"], found["cpu_max_s"]) == (0.2, 0.1, 0.5)
    assert found["speed"] == pytest.approx(problem.duration_s / 0.2)
    if failure == "nan":
        assert found["error"] is None
    else:
        assert found["error"] == pytest.approx(shift * math.sqrt(0.5 / 7.0))
        assert (found["error"] > BRANCH_ERROR) == (failure == "branch")


def test_engine_called_directly_agrees_with_another_code_and_closes_its_ledger() -> None:
    problem = build_problem("exact", "first-impacts", "", end_s=0.03)
    done = run_engine("rk4", Setting("10 us", 0.0, step_us=10), problem, ONE_RUN)
    truth = PEERS["scipy-dop853"].solve(problem, Setting("1e-9", 1e-9))
    assert done.failure == ""
    assert measure.scaled_error(done.solution.states, truth.states) < 1e-3
    assert done.solution.contacts == truth.contacts == 2
    began = [[time for time, _ in each.onsets] for each in (done.solution, truth)]
    assert began[0] == pytest.approx(began[1], abs=1.01e-3)
    assert done.energy_residual is not None
    assert done.energy_residual < 1e-4
    assert done.worst_frame_s is not None


def test_engine_without_time_is_a_failure_and_no_error() -> None:
    problem = build_problem("exact", "first-impacts", "", end_s=0.01)
    done = run_engine("rk4", Setting("10 us", 0.0, step_us=10), problem, Budget(0.0, 3))
    assert done.failure == "budget"
    assert done.reached_s == pytest.approx(1e-3)
    assert np.isnan(done.solution.states[-1]).all()


def test_frames_must_be_whole_steps() -> None:
    problem = build_problem("exact", "first-impacts", "", end_s=0.01)
    with pytest.raises(ValueError, match="must be multiples of"):
        run_engine("rk4", Setting("30 us", 0.0, step_us=30), problem, ONE_RUN)


def test_block_statistics_of_a_square_wave() -> None:
    times = np.arange(0.0, 5.0, 1e-3)
    force = np.where((times * 10.0) % 1.0 < 0.25, 8.0, 0.0)  # ten impacts per second, in contact a quarter of the time
    found = block_statistics(times, force, np.arange(0.05, 5.0, 0.1), settle_s=1.0)
    assert found["contact_fraction"] == pytest.approx((0.25, 0.25, 0.25), abs=2e-3)
    assert found["rms_force"] == pytest.approx((4.0, 4.0, 4.0), abs=2e-2)
    assert found["impacts_per_s"] == pytest.approx((10.0, 10.0, 10.0))
    with pytest.raises(ValueError, match="two blocks"):
        block_statistics(times[:800], force[:800], np.empty(0), settle_s=0.1)


def test_bootstrap_bars_contain_the_mean() -> None:
    rng = np.random.default_rng(5)
    times = np.arange(0.0, 40.0, 1e-2)
    mean, low, high = block_statistics(
        times, rng.exponential(10.0, len(times)), rng.uniform(0.0, 40.0, 800), settle_s=0.0
    )["impacts_per_s"]
    # 20 per second by chance: the standard error of the mean is sqrt(20/40).
    assert low < mean < high
    assert 0.5 * 1.96 * math.sqrt(0.5) < 0.5 * (high - low) < 2.0 * 1.96 * math.sqrt(0.5)


def test_elastic_force_is_hertz() -> None:
    problem = build_problem("exact", "first-impacts", "", end_s=0.01)
    shaft, contact = problem.constants.shaft, problem.constants.contact
    states = np.tile(problem.y0, (2, 1))
    beta = math.asin((contact.clearance + 1e-5 + contact.offset_x) / shaft.arm_ring)
    states[1, 1] = beta
    # The ring is centred on the shaft at rest, so that a lateral swing alone closes the gap.
    assert elastic_forces(problem, states) == pytest.approx([0.0, contact.stiffness * 1e-5**1.5], rel=1e-3)


def test_profile_shares_by_hand() -> None:
    points = [
        {"phase": scene, "method": method, "cpu_s": wall, "failure": failure}
        for scene, method, wall, failure in (
            ("a", "quick", 1.0, ""), ("a", "slow", 4.0, ""), ("b", "quick", 6.0, ""), ("b", "slow", 3.0, ""),
            ("c", "quick", 1.0, ""), ("c", "slow", 0.1, "target"), ("c", "never", 0.1, "nan"),
        )
    ]  # fmt: skip
    curves = profile_curves(points)
    assert curves["quick"][0].tolist() == [1.0, 1.0, 2.0]
    assert curves["quick"][1].tolist() == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert curves["slow"][0].tolist() == [1.0, 4.0]
    assert len(curves["never"][0]) == 0


def test_profile_of_a_bound_is_compared_with_the_best_method() -> None:
    points = [
        {"phase": "a", "method": "led", "cpu_s": 4.0, "own_cpu_s": 1.0, "failure": ""},
        {"phase": "a", "method": "other", "cpu_s": 2.0, "own_cpu_s": None, "failure": ""},
        {"phase": "b", "method": "led", "cpu_s": 3.0, "own_cpu_s": 2.0, "failure": ""},
        {"phase": "b", "method": "other", "cpu_s": 1.0, "own_cpu_s": None, "failure": ""},
    ]
    curves = profile_curves(points, column="own_cpu_s")
    assert list(curves) == ["led"]
    assert curves["led"][0].tolist() == [0.5, 2.0]


def test_draws_are_the_same_again_and_differ() -> None:
    assert draw_scene(3) == draw_scene(3)
    assert draw_scene(3).commands != draw_scene(4).commands


def test_plan_gives_a_method_only_supported_settings() -> None:
    tasks = plan_points(competitors(), mode="full", panels=list(PANELS))
    assert {task.case for task in tasks if task.panel == "memory"} == {"memory", "no memory"}
    assert not [task for task in tasks if task.panel == "exact" and task.method == "scipy-bdf-no-events"]
    assert len(set(tasks)) == len(tasks)


@pytest.fixture
def no_png(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write an empty file for each PNG: the test reads the SVG of the same picture."""
    monkeypatch.setattr("replays.report.canvas.png", lambda _figure, **_about: b"")


@pytest.mark.usefixtures("no_png")
def test_failures_are_drawn_not_dropped(tmp_path: Path) -> None:
    stamp = {"commit": "abc", "date": "2026-01-01", "machine": "m", "versions": "v"}
    blank = {name: None for name in COLUMNS if name not in KEY and name not in ("title", "family")}
    common = {**blank, **stamp, "failure": "", "known_failure": ""}
    good = {"error": 1e-4, "speed": 100.0, "speed_min": 90.0, "speed_max": 110.0, "step_us": 5.0}
    rows = [
        row(**{**common, **good}),
        row(**{**common, **good, "step_us": 10.0, "rung": "10 us", "error": 1e-2, "failure": "contacts"}),
        *[
            row(**{**common, "speed": 0.1, "rung": kind, "failure": kind})
            for kind in ("nan", "hammer", "budget", "error", "branch")
        ],
    ]
    files = draw(rows, tmp_path, ["exact"], command="rig chart --somehow")
    assert {file.name for file in files} == {
        f"{stem}.{suffix}" for stem in ("chart", "chart-exact", "chart-work") for suffix in ("png", "svg")
    }
    drawn = (tmp_path / "chart-exact.svg").read_text(encoding="utf-8")
    for kind in ("nan", "hammer", "budget", "error", "branch"):
        assert f'id="failure-rk4-{kind}"' in drawn
    assert "wrong number of contacts" in drawn
    assert "rig chart --somehow" in drawn


@pytest.mark.usefixtures("no_png")
def test_a_bound_is_drawn_and_named_with_its_method(tmp_path: Path) -> None:
    stamp = {"commit": "abc", "date": "2026-01-01", "machine": "m", "versions": "v"}
    blank = {name: None for name in COLUMNS if name not in KEY and name not in ("title", "family")}
    measured = {"error": 1e-4, "speed": 100.0, "speed_min": 90.0, "speed_max": 110.0, "tolerance": 1e-6,
                "cpu_s": 0.01, "own_cpu_s": 0.008, "failure": "", "known_failure": ""}  # fmt: skip
    led = row(**{**blank, **stamp, **measured}, method="heyoka", title="heyoka", family="heyoka", rung="1e-6")
    assert own_speed(led) == pytest.approx(125.0)
    draw([led], tmp_path, ["exact"], command="rig chart")
    drawn = (tmp_path / "chart-exact.svg").read_text(encoding="utf-8")
    assert 'id="heyoka-bound"' in drawn
    assert "heyoka alone: a bound" in drawn


def test_a_table_of_an_earlier_version_is_read() -> None:
    rows = read_table(Path(figure.__file__).parents[3] / "figures")
    assert rows
    assert all("own_cpu_s" in one for one in rows)


def test_a_small_chart_resumes_and_lists_missing_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def chart(**changes: Any) -> session.ChartOutcome:
        return make_chart(
            tmp_path / "out",
            panels=["exact"],
            only="first-impacts",
            peers=False,
            end_s=0.02,
            methods=["rk4"],
            **changes,
        )

    stopped: list[str] = []

    def stop(text: str) -> None:
        stopped.append(text)
        if len(stopped) == 3:  # after the reference and the first point
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(figure, "draw", lambda *_arguments, **_options: [])
        first = chart(progress=session.ChartProgress(step=stop))
    assert (first.interrupted, first.measured) == (True, 1)
    second = chart()
    assert not second.interrupted
    assert second.resumed == 1
    assert second.measured == 3
    assert second.failures == 0
    names = {path.name for path in second.files}
    outputs = [("chart", "parquet"), ("chart", "csv")]
    outputs += [(stem, suffix) for stem in ("chart", "chart-exact", "chart-work") for suffix in ("png", "svg")]
    assert names == {f"{stem}.{suffix}" for stem, suffix in outputs}
    for path in second.files:
        assert path.stat().st_size > 500
    assert "eers left out on request" in (tmp_path / "out" / "chart.svg").read_text(encoding="utf-8")
    pictures = [path for path in second.files if path.suffix in (".png", ".svg")]
    for path in pictures:
        path.unlink()
    with pytest.raises(SystemExit) as end:
        main(["chart", "--draw", "-o", str(tmp_path / "out")])
    assert end.value.code == 0
    assert all(path.is_file() for path in pictures), "drawn again from the table alone"
    monkeypatch.setattr(session, "missing_peers", lambda: ["heyoka"])
    monkeypatch.setattr(figure, "draw", lambda *_arguments, **_options: [])
    assert chart().missing == []


def test_without_peers_there_is_still_a_reference() -> None:
    problem = build_problem("exact", "first-impacts", "", end_s=0.03)
    own = session.own_reference(problem)
    truth = PEERS["scipy-radau"].solve(problem, Setting("1e-9", 1e-9))
    assert own is not None
    assert not own.independent
    assert own.error < 1e-7
    assert measure.scaled_error(own.solution.states, truth.states) < 1e-5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--only", "nowhere"], "only must be one of first-impacts"),
        (["--panel", "pretty"], "panel must be one of exact"),
        (["--panel", "memory", "--only", "drop"], "panel must be one that has the phase drop"),
        (["--quick", "--full"], "must be one of the two"),
        (["--peers"], "option must be one of `rig chart -h`, such as --no-peers"),
        (["--draw"], "output must be a folder with chart.csv of an earlier chart"),
    ],
)
def test_wrong_input_is_refused_in_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: list[str], words: str
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["chart", "-o", str(tmp_path / "out"), *arguments])
    captured = capsys.readouterr()
    assert end.value.code == 2
    assert words in captured.err
    assert not (tmp_path / "out").exists()


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("x")
    with pytest.raises(InputError, match="must be a folder"):
        Store(tmp_path / "out")
