"""Limits of a run's error in a scene: the chosen tolerance, refusals, and no change for scenes without them."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from recorder.reader import Recording
from replays.recordings.export import write_run
from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.prediction import simplify
from rig.base.errors import InputError
from rig.physics.accuracy import QUANTITIES
from rig.physics.engine_choice import MIN_LIMIT_TOLERANCE, SCALES, EngineChoice, Limits
from rig.run.model_choice import Pick
from rig.run.scenes import Scene, change_scene, load_scene, parse_scene, scene_document
from rig.run.simulation import Simulation
from tests.commands import run_captured, run_for_output

LIMITS = {"engine.limits.radius_um": 0.03, "engine.limits.angle_deg": 0.5}
RUN_CHANGES = {"duration_s": 0.2, "sensors.rate_hz": 2000, "sensors.truth_rate_hz": 1000}


def tolerance(changes: dict[str, Any], scene: str | Scene = "hammer") -> float:
    return load_scene(scene, changes).engine.tolerance


def test_each_limit_is_of_a_quantity_of_the_estimate_in_its_unit() -> None:
    units = {name: unit for name, (_, unit, _) in QUANTITIES.items()}
    assert set(Limits.model_fields) == {f"{name}_{unit.lower()}" for name, unit in units.items() if name != "state"}
    assert set(SCALES) == set(Limits.model_fields)
    assert Limits(spin_angle_deg=2.0, force_n=1.0).by_quantity() == {"spin_angle": 2.0, "force": 1.0}


@pytest.mark.parametrize(
    ("changes", "chosen"),
    [
        ({"radius_um": 0.03}, 0.03 / 900.0),
        ({"radius_um": 0.03, "force_n": 0.01}, 1e-5),
        ({"radius_um": 50.0}, 3e-4),  # never coarser than the engine's own
        ({"frequency_hz": 1e-3, "spin_angle_deg": 100.0}, 1e-5),
        ({"angle_deg": 0.00573}, 1e-4),
        ({"force_n": 1e-12}, MIN_LIMIT_TOLERANCE),
        ({"force_n": 1e-320}, MIN_LIMIT_TOLERANCE),
    ],
)
def test_a_default_tolerance_is_the_smallest_limit_over_its_scale(changes: dict[str, float], chosen: float) -> None:
    limits = {f"engine.limits.{name}": limit for name, limit in changes.items()}
    assert tolerance(limits) == pytest.approx(chosen)
    assert tolerance({**limits, "engine.tolerance": 0.0}) == pytest.approx(chosen)
    assert tolerance({**limits, "engine.tolerance": 2e-3}) == 2e-3


def test_an_engine_finer_than_the_finest_choice_keeps_its_own_tolerance() -> None:
    taylor = {"engine.name": "taylor", "engine.companion": True, "engine.limits.force_n": 1e-12}
    assert tolerance(taylor) == EngineChoice(name="taylor").tolerance < MIN_LIMIT_TOLERANCE


def test_changed_limits_choose_a_new_tolerance_unless_it_was_given() -> None:
    scene = load_scene("hammer", LIMITS)
    assert tolerance({"engine.limits.radius_um": 0.01}, scene) == pytest.approx(0.01 / 900.0)
    assert tolerance({"engine.limits": {}}, scene) == 3e-4
    assert tolerance({"engine.limits.radius_um": 0.01, "engine.tolerance": 1e-3}, scene) == 1e-3
    assert tolerance({"engine.limits.radius_um": 0.01}, load_scene(scene, {"engine.tolerance": 1e-6})) == 1e-6
    assert change_scene(scene, {"engine.name": "rk8"}).engine == EngineChoice(name="rk8")


def test_a_scene_without_limits_keeps_its_document() -> None:
    before = {"name": "split", "step_us": 25, "tolerance": 3e-4, "companion": True, "rolling": "collocation"}
    for scene in (load_scene("hammer"), load_scene("hammer", {"engine.limits": {}})):
        assert json.dumps(scene_document(scene)["engine"]) == json.dumps(before)
        assert scene.model_dump()["engine"] == before
        assert "limits" not in Simulation(scene).health()["engine"]


def test_the_document_of_a_scene_with_limits_gives_it_again() -> None:
    scene = load_scene("hammer", LIMITS)
    document = scene_document(scene)
    assert document["engine"]["limits"] == {"radius_um": 0.03, "angle_deg": 0.5}
    assert parse_scene(document) == scene
    assert Simulation(scene).health()["engine"]["limits"] == document["engine"]["limits"]


@pytest.mark.parametrize(
    ("key", "value", "must"),
    [
        *(("engine.limits.angle_deg", value, "greater than 0") for value in ("0", "-1", "-0.0")),
        *(("engine.limits.radius_um", value, "a finite number") for value in ("nan", "inf", "-inf")),
        *(("engine.limits.force_n", value, "a valid number") for value in ("much", "'5'", "true", "[1]", "5N")),
        ("engine.limits.angle_deg", "181", "less than or equal to 180"),
        ("engine.limits.radius_mm", "1", "a field of a scene or a parameter, such as engine.limits.radius_um"),
        ("engine.limits.state", "1", "a field of a scene or a parameter, such as engine.limits.angle_deg"),
        ("engine.limits", "3", "a valid dictionary"),
    ],
)
def test_a_bad_limit_is_refused_in_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, key: str, value: str, must: str
) -> None:
    target = tmp_path / "run.csv"
    status, output, complaint = run_captured(capsys, "simulate", "hammer", "--set", f"{key}={value}", "-o", target)
    assert (status, output, complaint.count("\n")) == (2, "", 1)
    assert f"{key} must be {must}" in complaint
    assert not target.exists()


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("radius_mm = 1.0", "engine.limits.radius_mm must be a known field, such as radius_um"),
        ("force_n = 0", "engine.limits.force_n must be greater than 0"),
        ("force_n = true", "engine.limits.force_n must be a valid number"),
        ('force_n = "5"', "engine.limits.force_n must be a valid number"),
    ],
)
def test_a_bad_limit_in_a_file_is_named_with_the_file(tmp_path: Path, text: str, field: str) -> None:
    path = tmp_path / "own.toml"
    path.write_text(f"[engine.limits]\n{text}\n")
    with pytest.raises(InputError) as refused:
        load_scene(path)
    assert str(refused.value).startswith(f"own.toml: {field}")


@pytest.mark.parametrize(
    ("scene", "changes", "field"),
    [
        ("hammer", {"engine.companion": False}, "engine.limits.force_n must be left out without engine.companion"),
        ("hammer", {"engine.name": "tsit5"}, "engine.limits.force_n must be left out without engine.companion"),
        ("hammer", {"engine.name": "rk4"}, "engine.limits.force_n must be left out without engine.companion"),
        ("test-sine", {}, "engine.limits must be left out with a [generator]"),
    ],
)
def test_limits_without_an_estimate_are_refused(scene: str, changes: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as refused:
        load_scene(scene, {**changes, "engine.limits.force_n": 1.0})
    assert str(refused.value).startswith(field)


def test_a_stored_choice_without_a_companion_omits_the_limits() -> None:
    data = scene_document(load_scene("hammer", LIMITS))
    levels = {"magnet": "map", "shaft": "euler", "stator": "two-houses", "contact": "compliant", "friction": "exact"}
    made = {**levels, "drive": "torque", "sensors": "full", "engine": "split", "step_us": 25, "engine_tolerance": 1e-3}
    for companion, kept in ((False, {}), (True, data["engine"]["limits"])):
        picked = Pick.model_construct(None, **made, companion=companion).apply(data)
        assert parse_scene(picked).engine.limits.as_dict() == kept
    assert "limits" in data["engine"]


def test_a_recording_keeps_its_limits_and_is_validated(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path, table, mapping = tmp_path / "run.mcap", tmp_path / "run.csv", tmp_path / "run.toml"
    write_run(
        Simulation(
            load_scene("hammer", {**RUN_CHANGES, **LIMITS, "engine.limits.angle_deg": 1e-9, "engine.tolerance": 3e-3})
        ),
        path,
    )
    run_for_output(capsys, "validate", path)
    status, output, _ = run_captured(capsys, "info", path)
    printed = " ".join(output.split())
    assert status == 3, "inconclusive, as with each warning of the rig"
    assert "whirl angle off by" in printed
    assert "deg (limit 1e-09)" in printed
    recording = Recording.open(path)
    experiment = Experiment.from_recording(recording)
    assert {event["event"] for event in recording.events} >= {"hammer", "warning"}
    assert experiment.scene.engine.limits == Limits(radius_um=0.03, angle_deg=1e-9)
    reduced = simplify(experiment).scene.engine
    assert (reduced.limits.as_dict(), reduced.companion, reduced.tolerance) == ({}, False, 3e-3)
    run_for_output(capsys, "export", path, "-o", table)
    run_for_output(capsys, "import", table, "--template", mapping)
    changes = tomllib.loads(mapping.read_text())["experiment"]["set"]
    assert load_scene("hammer", changes).engine == experiment.scene.engine
