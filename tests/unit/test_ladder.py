"""`rig ladder`: input, chosen model, storage and use of a choice, refusals."""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replays.studies.common.run import Timed, run_scene
from replays.studies.ladder.chart import draw
from replays.studies.ladder.document import ladder_document, make_pick
from replays.studies.ladder.measurement import Candidate, Measurement, measure
from replays.studies.ladder.pick import with_pick, write_pick
from replays.studies.ladder.quantity import QUANTITIES, Ending, Trace, find_ending, parse_quantities
from replays.studies.ladder.search import LEVELS, MIN_SAVING, Ladder, search
from rig.base.errors import InputError
from rig.cli.commands.ladder import engines_table, levels_table
from rig.cli.main import main
from rig.physics.kernels.signals import COLUMN, N_ROW
from rig.physics.levels import ModelLevels
from rig.run.offline import simulate
from rig.run.scenes import Scene, load_scene, parse_scene
from rig.run.simulation import Simulation
from tests.commands import check_legible

SCENE = """# my own scene
title = "mine"   # a comment
duration_s = 0.1
fidelity = "auto"

[drive]
speed_hz = 6.2  # as in the paper

# the pulse
[[commands]]
at_s = 0.02
command = "hammer"
"""


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as end:
        main(list(arguments))
    captured = capsys.readouterr()
    assert end.value.code == 2, captured
    assert captured.err.count("\n") == 1
    return captured.err


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "mine.toml"
    file.write_text(SCENE, encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Ladder:
    file = tmp_path_factory.mktemp("scene") / "mine.toml"
    file.write_text(SCENE, encoding="utf-8")
    scene = load_scene(file, {"fidelity": "given"})
    return search(scene, {"first_impact_time": 0.01, "contact_impulse": 0.5, "peak_normal_force": 0.2}, runs=2)


def trace(**columns: np.ndarray) -> Trace:
    n = len(next(iter(columns.values())))
    rows = np.zeros((n, N_ROW))
    for name, values in columns.items():
        rows[:, COLUMN[name]] = values
    return Trace(np.arange(n) * 1e-3, rows, 7.0, 1e-3, 0.0125, 0.5, 0.3)


def test_quantities_read_closed_forms() -> None:
    t = np.arange(1000) * 1e-3
    turning = trace(
        ring_x=np.cos(-2 * math.pi * 80.0 * t), ring_y=np.sin(-2 * math.pi * 80.0 * t), penetration=np.ones(1000),
        contact_impulse=300.0 * t, theta=2 * math.pi * 6.0 * t, normal_force=300.0 + np.sin(2 * math.pi * 40.0 * t),
        P_E=400.0 * np.sin(2 * math.pi * 80.0 * t), theta_rate=np.full(1000, 40.0),
        sliding_speed=np.where(t < 0.3, 0.1, 0.0), friction_loss=t,
    )  # fmt: skip
    expected = {
        "whirl_frequency": -80.0, "mean_normal_force": 300.0, "spin": 6.0, "force_ripple": math.sqrt(0.5),
        "reaction_amplitude": 400.0, "peak_normal_force": 7.0, "contact_impulse": 300.0 * 0.999, "time_to_roll": 0.3,
        "dissipated_energy": 0.999, "contact_fraction": 1.0, "first_impact_time": 0.5,
    }  # fmt: skip
    for name, value in expected.items():
        assert QUANTITIES[name].read(turning) == pytest.approx(value, rel=1e-6), name
    assert QUANTITIES["outcome"].read(turning) == "backward whirl"
    assert find_ending(turning).outcome == "rolling backward whirl"
    noise = np.linspace(-1e-12, 1e-12, 1000)
    standing = trace(contact_impulse=t, ring_y=-np.ones(1000), sliding_speed=noise, theta_rate=0.1 * noise)
    assert (find_ending(standing).outcome, find_ending(standing).rolling_share) == ("resting", 1.0)
    apart = trace(penetration=-np.ones(100), ring_x=np.ones(100))
    assert QUANTITIES["outcome"].read(apart) == "no contact"
    assert math.isnan(QUANTITIES["whirl_frequency"].read(apart))


def test_errors_are_relative_and_infinite_for_a_wrong_outcome() -> None:
    for name in ("spin", "force_ripple", "contact_fraction"):
        assert QUANTITIES[name].error(6.3, 6.0) == pytest.approx(0.05)
        assert QUANTITIES[name].error(math.nan, 6.0) == QUANTITIES[name].error(1e-9, 0.0) == math.inf
    assert QUANTITIES["outcome"].error("bouncing", "backward whirl") == math.inf
    assert QUANTITIES["outcome"].error("bouncing", "bouncing") == 0.0


WHIRL = Ending(touches=True, contact_share=1.0, turns=-40.0, rolling_share=1.0)


@pytest.mark.parametrize(
    ("change", "word", "alike"),
    [
        ({"turns": -44.0}, "rolling backward whirl", True),
        ({"turns": 40.0}, "rolling forward whirl", False),
        ({"turns": 0.1}, "resting", False),
        ({"rolling_share": 0.1}, "sliding backward whirl", False),
        ({"contact_share": 0.94}, "partial rub", True),
        ({"contact_share": 0.8}, "partial rub", False),
        ({"contact_share": 0.2}, "bounces", False),
        ({"contact_share": 0.0, "touches": False}, "flight", False),
    ],
)
def test_outcomes_have_a_name_and_soft_limits(change: dict[str, float], word: str, alike: bool) -> None:
    other = WHIRL._replace(**change)
    assert (other.outcome, WHIRL.is_alike(other), other.is_alike(WHIRL)) == (word, alike, alike)


def test_time_to_roll_detects_every_slip() -> None:
    scene = load_scene("hammer", {"duration_s": 0.06})
    run = simulate(scene)  # with rows every 50 us
    radius = run.simulation.model.constants.shaft.radius
    slides = np.abs(run["sliding_speed"]) > 0.02 * radius * np.abs(run["theta_rate"])
    last = run.times_s[slides | (run["penetration"] <= 0.0)][-1]
    found = measure(scene, Candidate(ModelLevels(), "torque", "split", 25, 3e-4), ["time_to_roll"], runs=1)
    assert found.values["time_to_roll"] == pytest.approx(last + 25e-6, abs=26e-6)


def test_a_model_without_friction_has_another_outcome_for_any_quantity() -> None:
    scene = load_scene("hammer")
    full = Candidate(ModelLevels(), "torque", "split", scene.engine.step_us, scene.engine.tolerance)
    whirl, flight = (
        measure(scene, candidate, ["force_ripple"], runs=1).ending
        for candidate in (full, full.with_model(friction="none"))
    )
    assert whirl is not None
    assert flight is not None
    assert (whirl.outcome, flight.outcome) == ("rolling backward whirl", "flight")


def test_a_first_run_in_short_blocks_is_no_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene("hammer", {"duration_s": 0.1})

    def timed(simulation: Simulation, *, keep: bool, **options: Any) -> Timed:
        done = run_scene(simulation, keep=keep, **options)
        return done._replace(cpu_s=5.0 if keep else 1.5)

    monkeypatch.setattr("replays.studies.ladder.measurement.run_scene", timed)
    candidate = Candidate(ModelLevels(), "torque", "split", 25, 3e-4)
    for runs, cost in ((1, 5.0), (3, 1.5)):
        measured = measure(scene, candidate, ["spin"], runs=runs)
        assert (measured.cpu_s * 0.1, measured.runs) == pytest.approx((cost, 1))


def test_a_run_is_stopped_at_its_limit_of_processor_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(0, 10**9, 1000))
    monkeypatch.setattr("replays.studies.common.run.time.perf_counter", lambda: next(clock))  # a busy machine
    scene = load_scene("hammer", {"duration_s": 0.1})
    candidate = Candidate(ModelLevels(), "torque", "split", 25, 3e-4)
    failures = [measure(scene, candidate, ["spin"], runs=1, limit_s=limit_s).failure for limit_s in (60.0, 0.0)]
    assert failures[0] == ""
    assert failures[1].startswith("given up after 0 s")


def test_a_level_that_saves_less_than_a_tenth_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    extra = {"cylinders": 0.5, "map": 0.05, "euler": 0.05, "two-houses": 0.4, "inner-house": 0.2, "exact": 0.5}

    def cost(candidate: Candidate) -> float:
        return 1.0 + sum(extra.get(choice, 0.0) for choice in candidate.model.values())

    def measured(_scene: Scene, candidate: Candidate, *_: object, **__: object) -> Measurement:
        end = WHIRL._replace(rolling_share=float(candidate.levels.friction != "none"))
        spent = cost(candidate)
        return Measurement(candidate, {"spin": 6.0}, end, spent, (spent, spent), 1, 1, 0.0)

    def saved(_scene: Scene, simpler: Candidate, fuller: Candidate, **_: object) -> float:
        return 1.0 - cost(simpler) / cost(fuller)

    monkeypatch.setattr("replays.studies.ladder.search.measure", measured)
    monkeypatch.setattr("replays.studies.ladder.search.compute_saving", saved)
    found = search(load_scene("hammer"), {"spin": 0.1})
    assert found.picked.candidate.model == {
        "magnet": "map",  # the linear one saves 3 %
        "shaft": "euler",
        "stator": "rigid",
        "contact": "compliant",  # costs the same
        "friction": "exact",  # without it, the contact slides
        "drive": "torque",
    }
    assert found.savings == pytest.approx({"magnet": 1 - 1.6 / 2.05, "stator": 1 - 1.6 / 2.0})
    # If it saves nothing else, the scene stays unchanged.
    extra.update({"two-houses": 0.0, "inner-house": 0.0})
    given = load_scene("hammer", {"engine.name": "tsit5", "engine.step_us": 50})
    again = search(given, {"spin": 0.1})
    assert (again.picked.candidate.engine, again.savings) == ("tsit5", {})
    # A level that the scene omits already is reported if the search chooses it, too.
    given = load_scene("hammer", {"engine.tolerance": 3e-2, "engine.companion": False})
    again = search(given, {"spin": 0.1})
    assert (again.picked.candidate, list(again.savings)) == (again.given.candidate, ["magnet"])


def test_a_stored_choice_has_no_companion_and_an_old_one_the_scenes(found: Ladder) -> None:
    assert (found.given.candidate.companion, found.picked.candidate.companion) == (True, False)
    pick = make_pick(found).model_copy(update={"engine": "split", "step_us": 25, "engine_tolerance": 3e-4})
    for companion, has in ((pick.companion, False), (None, True)):
        applied = pick.model_copy(update={"companion": companion}).apply({})
        assert parse_scene(applied).engine.companion == has


def test_levels_are_those_of_the_model_and_are_tried_one_at_a_time(found: Ladder) -> None:
    assert LEVELS["stator"] == ("rigid", "inner-house", "two-houses")
    singles = [step.label for step in found.steps if step.stage == "single"]
    assert singles == [f"{level} {rung}" for level, rungs in LEVELS.items() for rung in rungs[:-1]]
    # Far fewer than all combinations of levels.
    assert len([step for step in found.steps if step.stage == "together"]) <= 2 * len(LEVELS)
    assert all(part > MIN_SAVING for part in found.savings.values())


def test_a_choice_meets_its_tolerance_in_its_final_form(found: Ladder) -> None:
    picked, errors = found.picked, found.picked_errors
    assert picked is not None
    assert errors is not None
    for name, tolerance in found.tolerances.items():
        assert errors.total[name] + found.reference_errors[name] <= tolerance
        assert errors.model[name] <= tolerance
        assert errors.numerical[name] <= tolerance
    # A rigid impact has no force: infinite, and never chosen if a peak is required.
    impact = next(step for step in found.steps if step.label == "contact impact")
    assert impact.errors.model["peak_normal_force"] == math.inf
    assert not impact.passes
    assert picked.candidate.levels.contact == "compliant"
    assert math.isclose(float(picked.values["first_impact_time"]), 0.0255, abs_tol=2e-3)


def test_errors_are_the_same_each_time(found: Ladder) -> None:
    again = search(found.scene, found.tolerances, runs=1)  # repeated timing changes no error
    single = [[(s.label, s.errors.model, s.passes) for s in ladder.steps if s.stage == "single"]
              for ladder in (found, again)]  # fmt: skip
    assert single[0] == single[1]


def test_document_and_pictures_contain_the_evidence(found: Ladder, tmp_path: Path) -> None:
    document = json.loads(json.dumps(ladder_document(found), allow_nan=False))
    assert {entry["name"] for entry in document["quantities"]} == set(found.tolerances)
    assert all(entry["reference_error"] < entry["tolerance"] for entry in document["quantities"])
    assert document["versions"]["numba"]
    assert document["pick"]["code_digest"]
    for file in draw(found, tmp_path / "new"):
        assert file.stat().st_size > 20_000


def test_a_stored_choice_is_applied_with_a_message(found: Ladder, path: Path) -> None:
    pick = make_pick(found)
    write_pick(path, str(path), pick)
    text = path.read_text(encoding="utf-8")
    assert text.startswith(SCENE.rstrip())
    scene = load_scene(path)
    assert scene.fidelity_line is not None
    assert pick.engine in scene.fidelity_line
    assert scene.engine.name == pick.engine
    assert scene.engine.step_us == pick.step_us
    assert scene.engine.companion == pick.companion
    assert scene.model.magnet == pick.magnet
    assert scene.sensors.chain == pick.sensors
    document = Simulation(scene).scene_document()["scene"]
    assert document["fidelity"] == "auto"
    assert document["pick"]["quantities"][0]["total_error"] >= 0.0
    assert Scene(**document) == scene  # a recording's document runs again
    # With the original numbers the file is the original.
    given = load_scene(path, {"fidelity": "given"})
    assert given.model.magnet == "map"
    assert given.fidelity_line is None


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_only_the_table_is_replaced(found: Ladder, end: str) -> None:
    pick = make_pick(found)
    once = with_pick(SCENE.replace("\n", end), pick)
    assert with_pick(once, pick) == once
    assert once.count("[pick]") == 1
    assert ("\r" in once) == (end == "\r\n")
    # With more after it, comments included.
    later = once + end + "# mine" + end + "[sensors]" + end + "noise = false  # quiet" + end
    changed = with_pick(later, pick.model_copy(update={"seed": 5}))
    assert "# mine" in changed
    assert "noise = false  # quiet" in changed
    assert "# the pulse" in changed
    data = tomllib.loads(changed)
    assert data["pick"]["seed"] == 5
    assert data["sensors"] == {"noise": False}


def test_text_that_hides_a_choice_is_not_changed(found: Ladder) -> None:
    with pytest.raises(InputError, match="--write"):
        with_pick('title = """\n[pick]\n"""\n', make_pick(found))


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"duration_s": 0.2}, "the scene"),
        ({"drive.speed_hz": 6.0}, "the scene"),
        ({"contact.friction": 0.2}, "its parameters"),
    ],
)
def test_a_stale_pick_is_refused(found: Ladder, path: Path, change: dict[str, float], what: str) -> None:
    write_pick(path, str(path), make_pick(found))
    with pytest.raises(InputError, match=f"picked again .*{what} changed since the pick"):
        load_scene(path, dict(change))
    load_scene(path, {**change, "fidelity": "given"})


def test_changed_equations_and_choices_by_hand_are_refused(found: Ladder, path: Path) -> None:
    write_pick(path, str(path), make_pick(found).model_copy(update={"code_digest": "0" * 16}))
    with pytest.raises(InputError, match="equations or engines changed"):
        load_scene(path)
    write_pick(path, str(path), make_pick(found))
    with pytest.raises(InputError, match=r"where engine\.name is chosen by hand"):
        load_scene(path, {"engine.name": "rk4"})
    load_scene(path, {"seed": 7})  # of the sensors' noise: no part of the physics


def test_tables_are_legible(found: Ladder) -> None:
    document = ladder_document(found)
    document["steps"][0]["note"] = "a remark of many words " * 9
    for table in (levels_table(document), engines_table(document)):
        assert len(table.rows) > 3
        check_legible(table)


def test_a_search_without_a_choice_prints_one_line(
    capsys: pytest.CaptureFixture[str], path: Path, tmp_path: Path
) -> None:
    line = refused(capsys, "simulate", str(path), "-o", str(tmp_path / "x.csv"))
    assert 'fidelity must be "given" until' in line


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("-q", "colour", "-t", "0.1"), "--quantity must be one of whirl_frequency"),
        (("-q", "spin", "-q", "spin", "-t", "0.1"), "--quantity must be given once"),
        (("-q", "spin", "-t", "0"), "--tolerance must be above 0"),
        (("-q", "spin", "-t", "0.1", "-t", "0.1"), "--tolerance must be given once"),
        (("-q", "spin", "-t", "0.1", "--keep", "roof"), "--keep must be one of magnet"),
        (("-q", "spin", "-t", "0.1", "--write", "x.txt"), "--write must be a .toml file"),
        (("-q", "rebound_height", "-t", "0.1", "--set", "duration_s=0.02"), "--quantity must be one that scene hammer"),
        (("-q", "spin", "-t", "1e-14", "--set", "duration_s=0.1"), "--tolerance must be at least"),
    ],
)
def test_wrong_input_is_refused_in_one_line(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], says: str
) -> None:
    assert says in refused(capsys, "ladder", "hammer", *arguments)


def test_a_quantity_at_rounding_level_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, "ladder", "drop", "-q", "spin", "-t", "1", "--set", "duration_s=0.1")
    assert "--quantity must be one that two accurate engines agree on in scene drop; received 'spin'" in line


def test_parse_quantities_gives_each_its_tolerance() -> None:
    assert parse_quantities(["spin", "outcome"], [0.1]) == {"spin": 0.1, "outcome": 0.1}
    assert parse_quantities(["spin", "outcome"], [0.1, 0.2]) == {"spin": 0.1, "outcome": 0.2}
