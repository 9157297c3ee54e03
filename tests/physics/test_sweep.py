"""Truth sweep: drawn scenes, compared engines, criteria of a fault, continuation of a stopped sweep.

| what                                    | must agree with                                        |
|-----------------------------------------|--------------------------------------------------------|
| the default engine in fixed scenes      | two accurate engines, which agree with each other      |
| status, error, faults of stubbed runs   | the values put into the stubs                          |
| a scene by its number                   | itself, independent of other drawn scenes              |
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replays.studies.common.journal import Journal
from replays.studies.common.random_scene import draw_scene
from replays.studies.stability.scenes.sweep import NAME, select_numbers, summary, sweep
from replays.studies.stability.scenes.truth import CHAOS_GROWTH, INITIAL_SHIFT, measure
from replays.studies.stability.scenes.worker import SceneRun, Task, Worker, limit_processor_time, run_task, shift_start
from rig.base.errors import InputError
from rig.cli.main import main
from rig.physics.contacts import DAMPING, STIFFNESS
from rig.physics.engines import ENGINES
from rig.physics.kernels.signals import N_STATE, STATE_SCALE
from rig.physics.levels import FRICTION_LAWS
from rig.physics.parameters import set_names
from rig.run.scenes import Scene, change_scene, parse_scene
from rig.run.simulation import Simulation

DEFAULT = next(iter(ENGINES))
SCENE = Scene(duration_s=0.1)
DOUBT = "energy residual 1 J is above 0.001 of what was dissipated"


@pytest.mark.parametrize("number", [2, 6, 7, 12, 22, 23, 24, 27, 41, 44, 48, 69])
def test_default_engine_is_accurate_in_fixed_scenes(number: int) -> None:
    scene = change_scene(draw_scene(7, number), {"duration_s": 0.08})
    row = measure(scene, [DEFAULT], run_task)
    assert row["contacts"] > 1
    assert (row["status"], row["distance"] < 1e-4) == ("decided", True)
    one = row["tested"][0]
    assert one["failure"] == ""
    assert one["error"] < 2e-3
    assert one["doubted"] == (one["error"] > 1e-3), "above ten times what it is asked for it says so"
    assert not one["absurd"]
    assert one["contacts"] == row["contacts"]


def test_another_law_is_detected() -> None:
    # The same engines at another restitution: a difference that the fixed scenes treat as small is large.
    scene = change_scene(draw_scene(7, 7), {"duration_s": 0.08})

    def other(task: Task) -> SceneRun:
        softer = {"contact.restitution": 0.9 * scene.load_parameters()["contact.restitution"]}
        return run_task(task._replace(scene=change_scene(scene, softer)) if task.engine == DEFAULT else task)

    assert measure(scene, [DEFAULT], other)["tested"][0]["error"] > 1e-3


def make_stub(shifts: dict[str, float], own: dict[str, dict[str, Any]] | None = None, *, grows: float = 1.0):
    """Return a stub of runs at rest, each engine off by a shift in the error's norm; `own`: other fields by engine."""

    def run(task: Task) -> SceneRun:
        states = np.zeros((100, N_STATE))
        states[:] = shifts.get(task.engine, 0.0) * STATE_SCALE
        if task.nudge:
            states += INITIAL_SHIFT * np.geomspace(1.0, grows, 100)[:, None] * STATE_SCALE
        health = {"peak_normal_force_n": 100.0, "contacts": 3, "energy": {"residual_share": 0.0}, "warnings": []}
        fields: dict[str, Any] = {"states": states, "cpu_s": 0.01, "reached_s": 0.1, "health": health}
        changes = (own or {}).get(task.engine, {})
        fields["health"] = health | {key: changes[key] for key in changes if key in health}
        fields |= {key: changes[key] for key in changes if key not in health}
        return SceneRun(**fields)

    return run


@pytest.mark.parametrize(
    ("shifts", "grows", "status", "odd"),
    [
        ({}, 1.0, "decided", None),
        ({"rk8": 5e-3}, 1.0, "decided", None),
        ({"taylor": 0.5}, 1.0, "undecided", "taylor"),
        ({"rk8": 0.5}, 1.0, "undecided", "rk8"),
        ({"rk8": 0.5, "tsit5": 1.5}, 1.0, "undecided", None),
        ({"taylor": 0.5}, 2.0 * CHAOS_GROWTH, "chaotic", None),
    ],
)
def test_status_of_a_scene(shifts: dict[str, float], grows: float, status: str, odd: str | None) -> None:
    row = measure(SCENE, [DEFAULT], make_stub(shifts, grows=grows))
    assert (row["status"], row["odd"]) == (status, odd)
    assert row["growth"] == pytest.approx(grows, rel=1e-6)
    assert (row["tested"][0]["error"] is None) == (status != "decided")


@pytest.mark.parametrize(
    ("shift", "own", "faults"),
    [
        (0.0, {}, []),
        (0.5, {}, ["wrong", "silent"]),
        (
            0.5,
            {"warnings": ["2 commands of the scene lie after its end"]},
            ["wrong", "silent"],
        ),
        (0.5, {"warnings": [DOUBT]}, ["wrong"]),
        (1e-4, {"warnings": [DOUBT]}, ["false_alarms"]),
        (0.05, {"warnings": [DOUBT]}, []),
        (0.0, {"peak_normal_force_n": 2500.0}, ["absurd"]),
        (0.0, {"peak_normal_force_n": float("nan")}, ["absurd"]),
        (0.0, {"failure": "crash", "health": {}}, ["crashes"]),
        (0.0, {"failure": "hang", "health": {}}, ["hangs"]),
    ],
)
def test_faults_of_a_run(shift: float, own: dict[str, Any], faults: list[str]) -> None:
    row = {"number": 4} | measure(SCENE, [DEFAULT], make_stub({DEFAULT: shift}, {DEFAULT: own}))
    found = summary([row], [DEFAULT])["engines"][DEFAULT]
    kinds = ("wrong", "silent", "false_alarms", "absurd", "crashes", "hangs")
    assert [kind for kind in kinds if found[kind]] == faults
    assert all(found[kind] == [4] for kind in faults)


def test_an_ill_posed_scene_counts_no_fault() -> None:
    wild = {"peak_normal_force_n": 1e15}
    run = make_stub({}, {"taylor": wild, "rk8": wild, DEFAULT: {"failure": "crash", "health": {}}})
    row = {"number": 4} | measure(SCENE, [DEFAULT], run)
    assert row["status"] == "unbounded"
    assert summary([row], [DEFAULT])["engines"][DEFAULT]["crashes"] == []


def test_an_accurate_run_with_a_warning_is_excluded() -> None:
    row = measure(SCENE, [DEFAULT], make_stub({"rk8": 0.5}, {"rk8": {"warnings": [DOUBT]}}))
    assert (row["status"], row["distance"], len(row["accurate"])) == ("decided", 0.0, 3)


def test_an_engine_is_not_compared_with_itself() -> None:
    row = measure(SCENE, ["taylor"], make_stub({"rk8": 1e-3}))
    assert row["tested"][0]["error"] == pytest.approx(1e-3)


def test_refused_scenes_are_counted_with_the_reason() -> None:
    scene = change_scene(SCENE, {"engine.name": "rk4", "model.friction": "switch", "duration_s": 0.002})
    row = measure(scene, ["taylor"], run_task)
    found = summary([{"number": 0} | row], ["taylor"])["engines"]["taylor"]
    assert (found["runs"], list(found["refused"].values())) == (0, [1])
    assert "model.friction must be one of none, smoothed, exact" in next(iter(found["refused"]))


def test_a_scene_is_its_numbers_alone_and_scenes_are_wide() -> None:
    scenes = [draw_scene(3, number) for number in range(150)]
    assert draw_scene(3, 17) == scenes[17]
    assert draw_scene(4, 17) != scenes[17]
    assert {scene.parameters for scene in scenes} == set(set_names())
    assert {scene.model.friction for scene in scenes} == set(FRICTION_LAWS)
    for key, laws in (("contact.stiffness", STIFFNESS), ("contact.damping_factor", DAMPING)):
        assert {scene.set.get(key) for scene in scenes} >= set(laws)
    blows = [timed.at_s * 1e3 for scene in scenes for timed in scene.commands]
    assert sum(at != round(at) for at in blows) > 0.9 * len(blows)


def test_the_stored_scene_equals_the_scene() -> None:
    for number in range(20):
        scene = draw_scene(5, number)
        kept = measure(scene, [], make_stub({}))["scene"]
        assert parse_scene({**kept, "engine": scene.engine.model_dump()}) == scene


@pytest.mark.parametrize("position", ["equilibrium", "top", "bottom"])
def test_a_nudge_is_small_and_inside_the_ring(position: str) -> None:
    scene = change_scene(SCENE, {"initial.position": position})
    simulation, moved = Simulation(scene), Simulation(shift_start(scene, 1e-3))
    apart = np.abs(moved.first_row[:2] - simulation.first_row[:2]) * simulation.model.constants.shaft.arm_ring
    clearance = simulation.model.constants.contact.clearance
    assert 0.99e-3 * clearance < apart.max() < 3.01e-3 * clearance


def test_a_stopped_sweep_continues(tmp_path) -> None:
    calls: list[Task] = []

    def run(task: Task) -> SceneRun:
        calls.append(task)
        return run_stub(task)

    run_stub = make_stub({})
    first = list(sweep([0, 2], seed=1, engines=[DEFAULT, "rk4"], folder=tmp_path, run=run))
    with (tmp_path / NAME).open("a") as file:
        file.write('{"seed": 1, "numb')  # a killed sweep
    calls.clear()
    assert list(sweep([0, 2], seed=1, engines=[DEFAULT], folder=tmp_path, run=run)) == first
    assert calls == []
    again = list(sweep([0, 1, 2], seed=1, engines=[DEFAULT], folder=tmp_path, run=run))
    assert [row["number"] for row in again] == [0, 2, 1]
    assert {task.scene.name for task in calls} == {"random-1-1"}
    assert len(list(sweep([0], seed=1, engines=["tsit5"], folder=tmp_path, run=run))) == 1
    assert len(Journal(tmp_path, NAME, first[0]["code"]).rows) == 4
    assert Journal(tmp_path, NAME, "other code").outdated == 4


def test_a_run_over_its_limit_and_one_that_breaks_are_results(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = run_task(Task(SCENE, DEFAULT, limit_s=0.0))
    assert (slow.failure, slow.reached_s, len(slow.states)) == ("hang", 0.01, 10)
    monkeypatch.setattr(Simulation, "advance", lambda *_: 1 // 0)
    broken = run_task(Task(SCENE, DEFAULT))
    assert (broken.failure, broken.message.partition(":")[0]) == ("crash", "ZeroDivisionError")


class _HangingScene:
    """An invalid scene: reading its fields never returns."""

    def model_dump(self) -> Any:
        limit_processor_time(1.0)
        while True:
            pass


class _ExitingScene:
    """An invalid scene: reading its fields ends the process."""

    def model_dump(self) -> Any:
        os._exit(7)


def test_a_process_that_hangs_or_ends_gives_a_result() -> None:
    lost: list[Any] = [_HangingScene(), _ExitingScene()]
    with Worker() as worker:
        hung, died = (worker.run(Task(scene, "rk4")) for scene in lost)
        good = worker.run(Task(change_scene(SCENE, {"duration_s": 0.003}), "rk4"))
    assert (hung.failure, died.failure) == ("hang", "crash")
    assert "exit status 7" in died.message
    assert (good.failure, good.states.shape) == ("", (3, N_STATE))


def test_the_time_limit_starts_with_the_run() -> None:
    begun: list[bool] = []
    run_task(Task(change_scene(SCENE, {"duration_s": 0.001}), "rk4"), lambda: begun.append(True))
    assert begun == [True]


def test_command_prints_stores_and_draws(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["stability", "--random", "1", "--seed", "7", "--only", "2", "--engines", DEFAULT, "-o", str(tmp_path)]
    with pytest.raises(SystemExit, match="0"):
        main([*command, "--json"])
    document = json.loads(capsys.readouterr().out)
    assert document["scenes"] == {"decided": 1, "chaotic": 0, "undecided": 0, "untold": 0, "unbounded": 0}
    assert document["engines"][DEFAULT]["compared"] == 1
    assert all(Path(picture).is_file() for picture in document["pictures"])
    with pytest.raises(SystemExit, match="0"):
        main(command)
    assert "random scenes of seed 7: 1 decided, 0 chaotic" in capsys.readouterr().out


def test_numbers_of_scenes_are_refused_unless_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    assert select_numbers("3, 14", 5) == [3, 14]
    assert select_numbers(None, 3) == [0, 1, 2]
    with pytest.raises(InputError, match="--only"):
        select_numbers("T3", 5)
    with pytest.raises(SystemExit, match="2"):
        main(["stability", "--random", "2", "--only", "x"])
    assert "--only must be numbers of scenes joined by commas" in capsys.readouterr().err
