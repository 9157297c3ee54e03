"""Engines: one integration method a file, one protocol, chosen by name in a scene.

An engine is a module with `MEMORY` (length of its memory), `start(constants, inputs, y, memory)` and
`advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows)`: it moves state `y` and `memory` on in
place by `steps` steps of `step_ticks` and writes one row of `rig.kernels.signals.ROW` every `stride` steps, the first
at the start. It knows no clock, no I/O and no threads, and its result does not depend on how a run is cut into calls.
"""

from __future__ import annotations

from types import ModuleType

from rig.errors import InputError

NAMES = ("rk8", "rk4")


def load_engine(name: str) -> ModuleType:
    """The engine of that name (imported, and so compiled, only now).

    Raises:
        InputError: No such engine.
    """
    if name not in NAMES:
        raise InputError("engine.name", f"one of {', '.join(NAMES)}", name)
    from importlib import import_module

    return import_module(f"rig.engines.{name}")
