"""How far a run can be trusted: the same scene again, finer, held against it."""

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

ANOTHER_BRANCH = 0.1
"""Scaled error from which the two runs are no longer the same motion."""
_FINER = 0.1
"""The tolerance of an engine that has one is multiplied by this; steps of one that has none are halved."""


@dataclass(frozen=True)
class Check:
    """Two runs of a scene, compared.

    Attributes:
        finer: What the second run was made with, in words.
        error: RMS distance of the scaled states at the truth's rate, as in the charts.
        parted_s: First instant at which a scaled state is off by `ANOTHER_BRANCH`, or None.
        contacts: Contacts in the run and in the finer one.
    """

    finer: str
    error: float
    parted_s: float | None
    contacts: tuple[int, int]

    @property
    def wrong_branch(self) -> bool:
        """Whether the run must be suspected to follow another branch than the model."""
        return self.error > ANOTHER_BRANCH or abs(self.contacts[0] - self.contacts[1]) > 0.2 * max(self.contacts)

    def line(self) -> str:
        """The result in one line."""
        if self.wrong_branch:
            since = f" after {self.parted_s:g} s" if self.parted_s is not None else ""
            return (
                f"a wrong branch is suspected{since}: {self.finer} goes another way "
                f"(error {self.error:.1e}, {self.contacts[0]} against {self.contacts[1]} contacts)"
            )
        return f"error {self.error:.1e} of 1 against {self.finer}; {self.contacts[0]} and {self.contacts[1]} contacts"


def finer(scene: Scene) -> dict[str, float]:
    """What to change of a scene's engine to have it finer.

    Raises:
        InputError: There is no finer step.
    """
    scene.check_physics()
    engine = scene.engine
    if ENGINES[engine.name].tolerance:
        return {"tolerance": engine.tolerance * _FINER}
    if engine.step_us < 2:
        raise InputError("engine.step_us", "at least 2, for a check by finer steps", engine.step_us)
    sample_us = 1_000_000 // scene.sensors.truth_rate_hz
    return {"step_us": max(n for n in range(1, engine.step_us // 2 + 1) if sample_us % n == 0)}


def check(scene: Scene) -> Check:
    """Run a scene twice without sensors, as it is and finer.

    Args:
        scene: The scene.

    Raises:
        InputError: There is no finer step.
    """
    changes = finer(scene)
    setting = f"tolerance {changes['tolerance']:.2g}" if "tolerance" in changes else f"{changes['step_us']} us"
    coarse, fine = _states(scene, {}), _states(scene, changes)
    n = min(len(coarse[0]), len(fine[0]))
    errors = np.array([scaled_error(a[None, :], b[None, :]) for a, b in zip(coarse[0][:n], fine[0][:n], strict=True)])
    parted = np.flatnonzero(errors > ANOTHER_BRANCH)
    return Check(
        finer=f"{scene.engine.name} at {setting}",
        error=float(np.sqrt(np.mean(errors**2))),
        parted_s=float(parted[0]) / scene.sensors.truth_rate_hz if len(parted) else None,
        contacts=(coarse[1], fine[1]),
    )


def _states(scene: Scene, changes: dict[str, float]) -> tuple[np.ndarray, int]:
    """States at the truth's rate, shape (n, N_STATE), and the number of contacts."""
    document = scene.model_dump()
    document["sensors"] |= bare_sensors(scene.sensors.truth_rate_hz)
    document["channels"] = None
    document["engine"] |= changes
    simulation = Simulation(parse_scene({**document, "fidelity": "given"}))
    every = simulation.tick_rate_hz // scene.sensors.truth_rate_hz // simulation.row_ticks
    done = run_scene(simulation, block_ticks=simulation.end_tick, every=every)
    return done.rows[:, :N_STATE], int(simulation.health()["contacts"])
