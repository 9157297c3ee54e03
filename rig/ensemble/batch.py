"""Batches of runs of one scene with varied values: quantities of each run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rig.base.errors import InputError, SimulationError
from rig.ensemble.keys import vary
from rig.run.offline import frames
from rig.run.scenes import Scene
from rig.run.simulation import Simulation


class Quantity(NamedTuple):
    """A quantity of a run."""

    unit: str
    label: str
    kind: str = "number"


QUANTITIES = {
    "outcome": Quantity("", "motion at the end", "text"),
    "trusted": Quantity("", "no warning"),
    "engine": Quantity("", "engine", "text"),
    "end_s": Quantity("s", "end of the run"),
    "contacts": Quantity("", "number of contacts"),
    "peak_force_n": Quantity("N", "largest normal force"),
    "whirl_hz": Quantity("Hz", "whirl frequency, forward positive"),
    "energy_residual_j": Quantity("J", "energy residual"),
}


class Batch:
    """Runs that share scene and keys."""

    def __init__(self, scene: Scene, keys: Sequence[str], *, early_end: bool = True) -> None:
        scene.check_physics()
        self._scene, self._keys = scene, tuple(keys)

    def run(self, values: Any, *, check: bool = True) -> dict[str, np.ndarray]:
        """Return each quantity, shape (runs,).

        Args:
            values: Value of each key, shape (runs, keys).
            check: Ignored.
        """
        rows = [self._simulate(dict(zip(self._keys, row, strict=True))) for row in np.asarray(values, object)]
        return {name: np.array([row[name] for row in rows]) for name in QUANTITIES}

    def _simulate(self, changes: dict[str, Any]) -> dict[str, Any]:
        engine = self._scene.engine.name
        try:
            simulation = Simulation(vary(self._scene, changes))
            for _ in frames(simulation):
                pass
        except (InputError, SimulationError):
            ends = dict.fromkeys(("end_s", "peak_force_n", "whirl_hz", "energy_residual_j"), math.nan)
            return {"outcome": "failed", "trusted": False, "engine": engine, "contacts": 0, **ends}
        health = simulation.health()
        return {
            "outcome": health["motion"]["kind"], "trusted": not health["warnings"], "engine": engine,
            "end_s": simulation.tick / simulation.tick_rate_hz, "contacts": health["contacts"],
            "peak_force_n": health["peak_normal_force_n"], "whirl_hz": health["motion"]["whirl_hz"] or math.nan,
            "energy_residual_j": health["energy"]["residual_j"],
        }  # fmt: skip
