"""Identification: the truth is recovered from noise, and values that cannot be identified are not reported.

| what | must agree with | why |
|---|---|---|
| fitted values, noisy recording, start 5 to 10 % off | the true values | purpose of the tool |
| intervals of a run without contact | the scatter of fits to other noise | an interval describes that scatter |
| trade-off of two moduli | dE_B/dE_S = -(E_B/E_S)^2 | only 1/E* = sum (1 - nu^2)/E enters |
| friction, magnets in a drop without them | nothing | no sliding, no magnets: no information |
| a recording of another engine | the true values | both solve the same equations |
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.reader import Recording
from replays.recordings.export import write_run
from replays.recordings.identification import Identification, ask, identify
from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.sensitivity import get_value
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

KEYS = ("magnet.stiffness", "contact.friction", "contact.stiffness", "ring.offset_x", "ring.offset_y")


def recorded(path: Path, scene: str, **changes: Any) -> Recording:
    simulation = Simulation(load_scene(scene, {key.replace("__", "."): value for key, value in changes.items()}))
    write_run(simulation, path, force=True)
    return Recording.open(path)


def scaled_errors(identification: Identification, truth: dict[str, float]) -> dict[str, float]:
    """Return the errors in half widths of the reported intervals."""
    return {
        finding.unknown.key: (finding.value - truth[finding.unknown.key]) / finding.half_width
        for finding in identification.judgement.findings
        if finding.standing == "identified"
    }


@pytest.fixture(scope="module")
def truth() -> dict[str, float]:
    usual = Experiment(scene=load_scene("hammer"))
    parts = {"magnet.stiffness": 1.04, "contact.friction": 0.95, "contact.stiffness": 1.05, "ring.offset_y": 0.97}
    return {key: get_value(usual, key) * part for key, part in parts.items()} | {"ring.offset_x": 0.03}


@pytest.mark.parametrize("engine", ["split", "taylor"])
def test_truth_is_recovered_from_a_hammer_recording(tmp_path: Path, truth: dict[str, float], engine: str) -> None:
    changes = {key.replace(".", "__"): value for key, value in truth.items()}
    recording = recorded(tmp_path / "h.mcap", "hammer", duration_s=0.1, engine__name=engine, seed=11, **changes)
    experiment = Experiment.from_recording(recording).with_changes(
        {"parameters": "corrected", "set": {}, "engine.name": "split"}
    )
    found = identify(ask(recording, experiment, KEYS))
    errors = scaled_errors(found, truth)
    assert set(errors) == set(KEYS)
    assert max(map(abs, errors.values())) < (2.0 if engine == "split" else 3.0)
    for finding in found.judgement.findings:
        # Orders of magnitude finer than the start, which was 5 % off.
        assert finding.half_width < 2e-3 * finding.unknown.scale
    if engine == "split":
        assert found.judgement.fits
        assert found.judgement.white


def test_a_start_ten_per_cent_off_converges(tmp_path: Path) -> None:
    recording = recorded(tmp_path / "h.mcap", "hammer", duration_s=0.06, seed=5)
    experiment = Experiment.from_recording(recording)
    right = {
        key: get_value(experiment, key) for key in ("contact.friction", "contact.restitution", "contact.stiffness")
    }
    start = {
        "contact.friction": 0.275,
        "contact.restitution": 0.81,
        "contact.stiffness": 1.1 * right["contact.stiffness"],
    }
    found = identify(ask(recording, experiment, tuple(right), start=start))
    errors = scaled_errors(found, right)
    assert set(errors) == set(right)
    assert max(map(abs, errors.values())) < 2.0


def test_intervals_agree_with_the_scatter_of_repeated_fits(tmp_path: Path) -> None:
    keys = ("magnet.stiffness", "shaft.unbalance_eccentricity", "shaft.unbalance_phase")
    values, widths = [], []
    for seed in range(8):
        recording = recorded(tmp_path / "s.mcap", "stable-run", duration_s=0.05, seed=seed, sensors__rate_hz=2000)
        found = identify(ask(recording, Experiment.from_recording(recording), keys, channels=("ring_x", "ring_y")))
        values.append([finding.value for finding in found.judgement.findings])
        widths.append([finding.half_width for finding in found.judgement.findings])
    scatter = np.std(values, axis=0, ddof=1)
    claimed = np.mean(widths, axis=0) / 1.96
    # Root of chi2 over its 7 degrees of freedom: 0.1 % to 99.9 %.
    assert (scatter / claimed > 0.29).all()
    assert (scatter / claimed < 1.86).all()


def test_moduli_act_only_together(tmp_path: Path) -> None:
    recording = recorded(tmp_path / "h.mcap", "hammer", duration_s=0.04, seed=3)
    found = identify(
        ask(
            recording,
            Experiment.from_recording(recording),
            ("shaft.young_modulus", "ring.young_modulus", "contact.friction"),
        )
    )
    shaft, ring, friction = found.judgement.findings
    assert shaft.standing == ring.standing == "only together"
    assert friction.standing == "identified"
    match = re.search(r"\+(\S+) Pa is compensated by ring.young_modulus by (\S+) Pa", shaft.words)
    assert match is not None
    parameters = Experiment.from_recording(recording).scene.load_parameters()
    ratio = (parameters["ring.young_modulus"] / parameters["shaft.young_modulus"]) ** 2
    assert float(match[2]) / float(match[1]) == pytest.approx(-ratio, rel=0.02)


def test_a_drop_identifies_neither_friction_nor_magnets(tmp_path: Path) -> None:
    """A released shaft has neither their stiffness nor their damping; the ring's place is given, not by the sag."""
    recording = recorded(tmp_path / "d.mcap", "drop", duration_s=0.06, seed=3, ring__offset_y=-1.56)
    keys = ("contact.friction", "magnet.stiffness", "contact.restitution")
    found = identify(ask(recording, Experiment.from_recording(recording), keys))
    friction, magnet, restitution = found.judgement.findings
    assert friction.standing == magnet.standing == "not seen"
    assert restitution.standing == "identified"
    assert abs(restitution.value - 0.9) < 2.0 * restitution.half_width
