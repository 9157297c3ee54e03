"""Accuracy check of a run: comparison with the same scene at a finer tolerance or step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from replays.studies.common.run import bare_sensors, run_scene
from replays.studies.peers.common.problem import scaled_error
from rig.base.errors import InputError
from rig.physics.engines import ENGINES
from rig.physics.kernels.signals import N_STATE
from rig.run.scenes import Scene, parse_scene
from rig.run.simulation import Simulation

MAX_BRANCH_ERROR = 0.1
"""Scaled error from which two runs no longer describe the same motion."""
_TOLERANCE_FACTOR = 0.1
"""Factor on the tolerance of an adaptive engine; steps of a fixed-step engine are halved instead."""


@dataclass(frozen=True)
class Check:
    """Comparison of two runs of a scene.

    Attributes:
        finer: Engine and setting of the second run, in words.
        error: RMS distance of the scaled states at the truth's rate, as in the charts.
        parted_s: First time at which a scaled state differs by `MAX_BRANCH_ERROR`, or None.
        contacts: Contacts in the run and in the finer run.
    """

    finer: str
    error: float
    parted_s: float | None
    contacts: tuple[int, int]

    @property
    def wrong_branch(self) -> bool:
        """True if the run probably follows another branch of motion than the model."""
        return self.error > MAX_BRANCH_ERROR or abs(self.contacts[0] - self.contacts[1]) > 0.2 * max(self.contacts)

    def line(self) -> str:
        """Return the result on one line."""
        if self.wrong_branch:
            since = f" after {self.parted_s:g} s" if self.parted_s is not None else ""
            return (
                f"a wrong branch is suspected{since}: {self.finer} follows another motion "
                f"(error {self.error:.1e}, {self.contacts[0]} against {self.contacts[1]} contacts)"
            )
        return f"error {self.error:.1e} of 1 against {self.finer}; {self.contacts[0]} and {self.contacts[1]} contacts"


def refine(scene: Scene) -> dict[str, float]:
    """Return changes to a scene's engine that make it more accurate.

    Raises:
        InputError: If there is no finer step.
    """
    scene.check_physics()
    engine = scene.engine
    if ENGINES[engine.name].tolerance:
        return {"tolerance": engine.tolerance * _TOLERANCE_FACTOR}
    if engine.step_us < 2:
        raise InputError("engine.step_us", "at least 2, for a check by finer steps", engine.step_us)
    sample_us = 1_000_000 // scene.sensors.truth_rate_hz
    return {"step_us": max(n for n in range(1, engine.step_us // 2 + 1) if sample_us % n == 0)}


def check(scene: Scene) -> Check:
    """Run a scene twice without sensors, as it is and with a more accurate engine.

    Args:
        scene: The scene.

    Raises:
        InputError: If there is no finer step.
    """
    changes = refine(scene)
    setting = f"tolerance {changes['tolerance']:.2g}" if "tolerance" in changes else f"{changes['step_us']} us"
    coarse, fine = _states(scene, {}), _states(scene, changes)
    n = min(len(coarse[0]), len(fine[0]))
    errors = np.array([scaled_error(a[None, :], b[None, :]) for a, b in zip(coarse[0][:n], fine[0][:n], strict=True)])
    parted = np.flatnonzero(errors > MAX_BRANCH_ERROR)
    return Check(
        finer=f"{scene.engine.name} at {setting}",
        error=float(np.sqrt(np.mean(errors**2))),
        parted_s=float(parted[0]) / scene.sensors.truth_rate_hz if len(parted) else None,
        contacts=(coarse[1], fine[1]),
    )


def _states(scene: Scene, changes: dict[str, float]) -> tuple[np.ndarray, int]:
    """Return states at the truth's rate, shape (n, N_STATE), and the number of contacts."""
    document = scene.model_dump()
    document["sensors"] |= bare_sensors(scene.sensors.truth_rate_hz)
    document["channels"] = None
    document["engine"] |= changes
    simulation = Simulation(parse_scene({**document, "fidelity": "given"}))
    every = simulation.tick_rate_hz // scene.sensors.truth_rate_hz // simulation.row_ticks
    done = run_scene(simulation, block_ticks=simulation.end_tick, every=every)
    return done.rows[:, :N_STATE], int(simulation.health()["contacts"])
