"""The check by finer steps: its error has the size of the true one, and a wrong branch is reported as suspected."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from replays.studies.check import Check, check
from replays.studies.peers.common.problem import scaled_error
from rig.base.errors import InputError
from rig.cli.main import main
from rig.physics.kernels.signals import N_STATE
from rig.run.offline import simulate
from rig.run.scenes import load_scene


def states(changes: dict[str, Any]) -> Any:
    run = simulate(load_scene("hammer", changes | {"sensors.rate_hz": 1000, "sensors.chain": "ideal"}))
    return run.signals[:, :N_STATE]


def test_error_agrees_with_that_of_another_method() -> None:
    changes = {"duration_s": 0.3, "sensors.rate_hz": 1000, "sensors.truth_rate_hz": 1000}
    found = check(load_scene("hammer", changes))
    true = scaled_error(states(changes), states(changes | {"engine.name": "rk8", "engine.step_us": 25}))
    assert 0.3 * true < found.error < 3.0 * true
    assert found.contacts[0] == found.contacts[1] > 10
    assert found.parted_s is None
    assert not found.wrong_branch
    assert "split at tolerance 3e-05" in found.line()


def test_wrong_branch_is_suspected() -> None:
    changes = {
        "duration_s": 0.3, "engine.name": "verlet", "engine.step_us": 50, "sensors.rate_hz": 1000,
        "sensors.truth_rate_hz": 1000,
    }  # fmt: skip
    found = check(load_scene("hammer", changes))
    true = scaled_error(states(changes), states(changes | {"engine.name": "rk8", "engine.step_us": 25}))
    assert true > 0.1
    assert found.wrong_branch
    assert found.parted_s is not None
    assert "a wrong branch is suspected after" in found.line()


@pytest.mark.parametrize(("contacts", "wrong"), [((10, 10), False), ((10, 14), True), ((0, 0), False), ((0, 3), True)])
def test_contacts_missed_are_a_wrong_branch(contacts: tuple[int, int], wrong: bool) -> None:
    assert Check(finer="x", error=1e-3, parted_s=None, contacts=contacts).wrong_branch == wrong


def test_a_suspected_wrong_branch_is_a_failed_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rates = ("--set", "sensors.rate_hz=1000", "--set", "sensors.truth_rate_hz=1000", "--duration-s", "0.3")
    coarse = ("--engine", "verlet", "--set", "engine.step_us=50")
    with pytest.raises(SystemExit) as end:
        main(["simulate", "hammer", "--check", "-o", str(tmp_path / "x.csv"), *rates, *coarse])
    assert end.value.code == 1
    assert "warning: a wrong branch is suspected after" in capsys.readouterr().err
    assert (tmp_path / "x.csv").stat().st_size > 1000, "what was simulated is kept"


def test_steps_that_cannot_be_finer_are_refused_before_the_run() -> None:
    with pytest.raises(InputError, match=r"engine\.step_us must be at least 2, .*received 1"):
        check(load_scene("hammer", {"engine.name": "rk4", "engine.step_us": 1}))


def test_adaptive_engine_is_checked_by_its_tolerance() -> None:
    found = check(load_scene("hammer", {"duration_s": 0.1, "engine.name": "rk8", "engine.tolerance": 1e-6}))
    assert "rk8 at tolerance 1e-07" in found.line()
    assert 0.0 < found.error < 1e-3
