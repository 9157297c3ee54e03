"""The check against another engine: its error has the size of the true one, and a wrong branch is reported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replays.studies.check import Check, Quantities, check, choose_reference, sample_rows
from replays.studies.peers.common.problem import scaled_error
from rig.base.errors import InputError
from rig.cli.main import main
from rig.physics.engines import ENGINES
from rig.physics.kernels.signals import N_STATE
from rig.run.offline import frames
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

SCENES = {"hammer": {"duration_s": 0.06}, "drop": {"duration_s": 0.1}}
TOLERANCES = {
    "split": (1e-2, 3e-4),
    "rk8": (1e-3, 1e-8),
    "taylor": (1e-6, 1e-8),
    "tsit5": (1e-3, 1e-8),
    "rosenbrock": (1e-5, 1e-7),
}
"""Two tolerances of each engine; 1e-3 has no effect in `rk8` and `tsit5`, whose steps end on the grid."""


def run(scene: str, changes: dict[str, Any]) -> tuple[Simulation, list[np.ndarray]]:
    simulation = Simulation(load_scene(scene, changes))
    return simulation, [sample_rows(simulation, frame) for frame in frames(simulation)]


def run_and_check(scene: str, changes: dict[str, Any]) -> tuple[Check, np.ndarray]:
    simulation, rows = run(scene, changes)
    return check(simulation, rows), np.concatenate(rows)[:, :N_STATE]


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("engine", TOLERANCES)
def test_error_is_within_a_factor_of_ten_of_the_true_one(scene: str, engine: str) -> None:
    assert {name for name, method in ENGINES.items() if method.tolerance} == TOLERANCES.keys()
    # True by another engine than the run and its check, except for rk8 and taylor, which check each other.
    exact = {"engine.name": "taylor" if engine in ("rk8", "taylor") else "rk8", "engine.tolerance": 1e-13}
    truth = np.concatenate(run(scene, SCENES[scene] | exact)[1])[:, :N_STATE]
    for tolerance in TOLERANCES[engine]:
        changes = {"engine.name": engine, "engine.tolerance": tolerance, "engine.companion": False}
        found, states = run_and_check(scene, SCENES[scene] | changes)
        true = scaled_error(states, truth)
        assert 0.1 * true < found.error < 10.0 * true, tolerance
        assert "no information" not in found.line()


def test_tolerance_without_effect_does_not_hide_the_error() -> None:
    changes = {"duration_s": 0.1, "engine.name": "tsit5", "engine.tolerance": 1e-3}
    found, _ = run_and_check("hammer", changes)
    assert 1.5e-3 < found.error < 3e-3
    assert found.line() == (
        "against taylor at tolerance 1e-12: scaled error 2.0e-03 (1: as large as the motion); 19 and 19 contacts, "
        f"peak force {found.quantities[0].peak_force_n:.6g} and {found.quantities[1].peak_force_n:.6g} N; in the last "
        f"quarter whirl {found.quantities[0].frequency_hz:.6g} and {found.quantities[1].frequency_hz:.6g} Hz, radius "
        f"{found.quantities[0].radius_um:.6g} and {found.quantities[1].radius_um:.6g} µm"
    )
    assert run_and_check("hammer", changes | {"engine.step_us": 500})[0] == found, "its steps end on the samples"


def test_wrong_branch_is_suspected() -> None:
    changes = {"duration_s": 0.1, "engine.name": "verlet", "engine.step_us": 50}
    found, _ = run_and_check("hammer", changes)
    assert found.error > 0.1
    assert found.wrong_branch
    assert found.parted_s is not None
    assert "a wrong branch is suspected after" in found.line()


@pytest.mark.parametrize(
    ("contacts", "parted_s", "wrong"),
    [((10, 10), 0.1, False), ((10, 14), 0.1, True), ((10, 14), None, False), ((0, 0), 0.1, False), ((0, 3), 0.1, True)],
)
def test_contacts_missed_are_a_wrong_branch(contacts: tuple[int, int], parted_s: float | None, wrong: bool) -> None:
    quantities = Quantities(contacts[0], 1.0), Quantities(contacts[1], 1.0)
    assert Check("x", 1e-3, parted_s, quantities).wrong_branch == wrong


def test_identical_runs_give_no_information(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    same = Check("split at tolerance 3e-06", 0.0, None, (Quantities(1, 1.0), Quantities(1, 1.0)))
    monkeypatch.setattr("replays.studies.check.check", lambda *_: same)
    with pytest.raises(SystemExit) as end:
        main(["simulate", "hammer", "--check", "-o", str(tmp_path / "x.csv"), "--duration-s", "0.01"])
    assert end.value.code == 3
    assert "no information: the run and split at tolerance 3e-06 are identical" in capsys.readouterr().err


def test_a_suspected_wrong_branch_is_a_failed_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    coarse = ("--engine", "verlet", "--set", "engine.step_us=50")
    with pytest.raises(SystemExit) as end:
        main(["simulate", "hammer", "--check", "-o", str(tmp_path / "x.csv"), "--duration-s", "0.1", *coarse])
    assert end.value.code == 1
    assert "warning: a wrong branch is suspected after" in capsys.readouterr().err
    assert (tmp_path / "x.csv").stat().st_size > 1000, "what was simulated is kept"


@pytest.mark.parametrize(
    ("engine", "changes", "expected"),
    [
        ("split", {}, ("taylor", 1e-12)),
        ("rk4", {"engine.step_us": 1}, ("taylor", 1e-12)),
        ("taylor", {}, ("rk8", 1e-12)),
        ("tsit5", {"model.friction": "switch"}, ("rk8", 1e-12)),
        ("rk8", {"model.friction": "switch"}, ("tsit5", 1e-12)),
        ("split", {"model.contact": "impact"}, ("split", pytest.approx(3e-6))),
    ],
)
def test_reference_supports_the_model(engine: str, changes: dict[str, Any], expected: tuple[str, float]) -> None:
    assert choose_reference(load_scene("hammer", {"engine.name": engine, **changes})) == expected


def test_impacts_and_limits_are_checked() -> None:
    found, _ = run_and_check("hammer", {"duration_s": 0.06, "model.contact": "impact"})
    assert 0.0 < found.error < 1e-3
    found, _ = run_and_check("hammer", {"duration_s": 0.06, "engine.limits.radius_um": 0.03})
    assert 0.0 < found.error < 1e-4


def test_test_signals_are_refused_before_the_run() -> None:
    with pytest.raises(InputError, match="generator"):
        choose_reference(load_scene("test-sine"))
