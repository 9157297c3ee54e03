"""Engines: one integration method a file, one protocol, chosen by name in a scene.

An engine is a module with `MEMORY` (length of its memory), `start(constants, inputs, y, memory)` and
`advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows)`: it moves state `y` and `memory` on in
place by `steps` steps of `step_ticks` and writes one row of `rig.kernels.signals.ROW` every `stride` steps, the first
at the start. It knows no clock, no I/O and no threads, and its result does not depend on how a run is cut into calls.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

ENGINES = {"rk8": 25, "rk4": 5}
"""Engines, the default first, and the step [us] at which each closes the energy ledger to 1e-6 in every scene."""


def load_engine(name: str) -> ModuleType:
    """The engine of one of those names (imported only now)."""
    return import_module(f"rig.engines.{name}")
