"""A virtual rotor-stator test rig.

    import rig
    scene = rig.load_scene("hammer", {"drive.speed_hz": 5.2, "contact.friction": 0.3})
    run = rig.simulate(scene)
    run["normal_force"].max(), run.unit("normal_force")   # any state, force or energy of the model
    run.samples["disk_x"], run.sample_times_s             # what the sensors saw

The same objects carry the commands of `rig`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rig.errors import InputError
    from rig.offline import Run, simulate
    from rig.parameters import load_parameters
    from rig.scenes import Scene, load_scene
    from rig.simulation import Simulation

__all__ = ["InputError", "Run", "Scene", "Simulation", "load_parameters", "load_scene", "simulate"]

_HOMES = {
    "InputError": "rig.errors",
    "Run": "rig.offline",
    "Scene": "rig.scenes",
    "Simulation": "rig.simulation",
    "load_parameters": "rig.parameters",
    "load_scene": "rig.scenes",
    "simulate": "rig.offline",
}


def __getattr__(name: str) -> Any:
    # Loaded on first use: `rig --help` must not wait for compiled code.
    if name not in _HOMES:
        raise AttributeError(f"module 'rig' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
