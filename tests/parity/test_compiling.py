"""Every engine compiles all that it needs once, before a run. With several workers this module comes first."""

from __future__ import annotations

import sys
from pathlib import Path

import numba
import pytest
from numba.core.dispatcher import Dispatcher

from rig.physics.engines import ENGINES
from rig.physics.kernels import has_compiled_kernels
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="this process is plain Python")


def compiled() -> dict[str, int]:
    """Return the number of compiled signatures of each kernel in this process; the cache is shared with other
    workers.
    """
    modules = [
        module
        for name, module in sys.modules.items()
        if name.startswith(("rig.physics.kernels", "rig.physics.engines"))
    ]
    kernels = [each for module in modules for each in vars(module).values() if isinstance(each, Dispatcher)]
    return {f"{each.__module__}.{each.__name__}": len(each.signatures) for each in kernels}


@pytest.mark.parametrize("engine", ENGINES)
def test_a_warm_up_compiles_all_that_a_run_needs_and_keeps_it(engine: str) -> None:
    friction = "exact" if "exact" in ENGINES[engine].frictions else "smoothed"
    changes = {"sensors.rate_hz": 1000, "sensors.truth_rate_hz": 1000}
    simulation = Simulation(load_scene("hammer", {**changes, "engine.name": engine, "model.friction": friction}))
    simulation.warm_up()
    assert has_compiled_kernels()
    before = compiled()
    assert sum(before.values()) > 0
    assert any(Path(numba.config.CACHE_DIR).rglob("*.nbc"))
    simulation.advance(40_000)
    assert simulation.health()["contacts"] > 0
    assert compiled() == before
