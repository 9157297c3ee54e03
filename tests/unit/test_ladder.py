"""`rig ladder`: what it reads, what it picks, how a pick is stored and comes into force, what it refuses."""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

from replays.studies.ladder.chart import draw
from replays.studies.ladder.document import ladder_document, pick_of
from replays.studies.ladder.pick import with_pick, write_pick
from replays.studies.ladder.quantity import QUANTITIES, Trace, parse_quantities
from replays.studies.ladder.search import LEVELS, Ladder, search
from rig.cli.ladder import engines_table, levels_table
from rig.cli.main import main
from rig.errors import InputError
from rig.kernels.signals import COLUMN, N_ROW
from rig.scenes import Scene, load_scene
from rig.simulation import Simulation
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
    return Trace(np.arange(n) * 1e-3, rows, 7.0, 1e-3, 0.0125, 0.5)


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
    apart = trace(penetration=-np.ones(100), ring_x=np.ones(100))
    assert QUANTITIES["outcome"].read(apart) == "no contact"
    assert math.isnan(QUANTITIES["whirl_frequency"].read(apart))  # pyright: ignore[reportArgumentType]


def test_errors_are_parts_of_their_scale_and_a_wrong_outcome_is_infinite() -> None:
    some = trace(penetration=np.ones(100))
    assert QUANTITIES["spin"].error(6.3, 6.0, some) == pytest.approx(0.05)
    assert QUANTITIES["spin"].error(math.nan, 6.0, some) == math.inf
    assert QUANTITIES["outcome"].error("bouncing", "backward whirl", some) == math.inf
    assert QUANTITIES["outcome"].error("bouncing", "bouncing", some) == 0.0


def test_rungs_are_the_models_own_and_are_tried_one_at_a_time(found: Ladder) -> None:
    assert LEVELS["stator"] == ("rigid", "inner-house", "two-houses")
    singles = [step.label for step in found.steps if step.stage == "single"]
    assert singles == [f"{level} {rung}" for level, rungs in LEVELS.items() for rung in rungs[:-1]]
    # Far fewer than all combinations of levels.
    assert len([step for step in found.steps if step.stage == "together"]) <= len(LEVELS)


def test_a_pick_meets_its_tolerance_as_it_will_run(found: Ladder) -> None:
    picked, errors = found.picked, found.picked_errors
    assert picked is not None
    assert errors is not None
    for name, tolerance in found.tolerances.items():
        assert errors.total[name] + found.reference_errors[name] <= tolerance
        assert errors.model[name] <= tolerance
        assert errors.numerical[name] <= tolerance
    # A rigid impact has no force: infinite, and never picked with a peak asked for.
    impact = next(step for step in found.steps if step.label == "contact impact")
    assert impact.errors.model["peak_normal_force"] == math.inf
    assert not impact.passes
    assert picked.candidate.levels.contact == "compliant"
    # The first impact comes before friction and houses have a say.
    assert picked.candidate.levels.magnet == "linear"
    assert math.isclose(float(picked.values["first_impact_time"]), 0.0255, abs_tol=2e-3)


def test_the_path_down_is_the_same_each_time(found: Ladder) -> None:
    again = search(found.scene, found.tolerances, runs=2)
    path = [[(s.label, s.errors.model, s.passes) for s in ladder.steps if s.stage != "engine"
             and s.stage != "verified"] for ladder in (found, again)]  # fmt: skip
    assert path[0] == path[1]


def test_document_and_pictures_hold_the_evidence(found: Ladder, tmp_path: Path) -> None:
    document = json.loads(json.dumps(ladder_document(found), allow_nan=False))
    assert {entry["name"] for entry in document["quantities"]} == set(found.tolerances)
    assert all(entry["reference_error"] < entry["tolerance"] for entry in document["quantities"])
    assert document["versions"]["numba"]
    assert document["pick"]["code_digest"]
    for file in draw(found, tmp_path / "new"):
        assert file.stat().st_size > 20_000


def test_a_pick_comes_into_force_and_says_so(found: Ladder, path: Path) -> None:
    pick = pick_of(found)
    write_pick(path, str(path), pick)
    text = path.read_text(encoding="utf-8")
    assert text.startswith(SCENE.rstrip())
    scene = load_scene(path)
    assert scene.fidelity_line is not None
    assert pick.engine in scene.fidelity_line
    assert scene.engine.name == pick.engine
    assert scene.engine.step_us == pick.step_us
    assert scene.model.magnet == pick.magnet
    assert scene.sensors.chain == pick.sensors
    document = Simulation(scene).scene_document()["scene"]
    assert document["fidelity"] == "auto"
    assert document["pick"]["quantities"][0]["total_error"] >= 0.0
    assert Scene(**document) == scene  # a recording's document runs again
    # As given, the same file is what it was.
    given = load_scene(path, {"fidelity": "given"})
    assert given.model.magnet == "map"
    assert given.fidelity_line is None


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_only_the_table_is_replaced(found: Ladder, end: str) -> None:
    pick = pick_of(found)
    once = with_pick(SCENE.replace("\n", end), pick)
    assert with_pick(once, pick) == once
    assert once.count("[pick]") == 1
    assert ("\r" in once) == (end == "\r\n")
    # With more behind it, comments and all.
    later = once + end + "# mine" + end + "[sensors]" + end + "noise = false  # quiet" + end
    changed = with_pick(later, pick.model_copy(update={"seed": 5}))
    assert "# mine" in changed
    assert "noise = false  # quiet" in changed
    assert "# the pulse" in changed
    data = tomllib.loads(changed)
    assert data["pick"]["seed"] == 5
    assert data["sensors"] == {"noise": False}


def test_text_that_hides_a_pick_is_left_alone(found: Ladder) -> None:
    with pytest.raises(InputError, match="--write"):
        with_pick('title = """\n[pick]\n"""\n', pick_of(found))


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"duration_s": 0.2}, "the scene"),
        ({"drive.speed_hz": 6.0}, "the scene"),
        ({"contact.friction": 0.2}, "its parameters"),
    ],
)
def test_a_stale_pick_is_refused(found: Ladder, path: Path, change: dict[str, float], what: str) -> None:
    write_pick(path, str(path), pick_of(found))
    with pytest.raises(InputError, match=f"picked anew .*{what} changed since the pick"):
        load_scene(path, dict(change))
    load_scene(path, {**change, "fidelity": "given"})


def test_changed_equations_and_choices_by_hand_are_refused(found: Ladder, path: Path) -> None:
    write_pick(path, str(path), pick_of(found).model_copy(update={"code_digest": "0" * 16}))
    with pytest.raises(InputError, match="equations or engines changed"):
        load_scene(path)
    write_pick(path, str(path), pick_of(found))
    with pytest.raises(InputError, match=r"where engine\.name is chosen by hand"):
        load_scene(path, {"engine.name": "rk4"})
    load_scene(path, {"seed": 7})  # of the sensors' noise: no part of the physics


def test_tables_are_legible(found: Ladder) -> None:
    document = ladder_document(found)
    document["steps"][0]["note"] = "a remark of many words " * 9
    for table in (levels_table(document), engines_table(document)):
        assert len(table.rows) > 3
        check_legible(table)


def test_no_pick_is_one_line(capsys: pytest.CaptureFixture[str], path: Path, tmp_path: Path) -> None:
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
def test_wrong_input_is_one_line(capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], says: str) -> None:
    assert says in refused(capsys, "ladder", "hammer", *arguments)


def test_parse_quantities_gives_each_its_tolerance() -> None:
    assert parse_quantities(["spin", "outcome"], [0.1]) == {"spin": 0.1, "outcome": 0.1}
    assert parse_quantities(["spin", "outcome"], [0.1, 0.2]) == {"spin": 0.1, "outcome": 0.2}
