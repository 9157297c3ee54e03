"""Integration engines: one method per file, one protocol, selected by name in a scene.

An engine is a module with `METHOD`, a one-step method that `rig.physics.engines.common.march` marches through events
(see `rig.physics.engines.common.method`), or with its own `start(constants, inputs, y, memory, step_ticks, tolerance)`
and `advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows)`. `advance` moves state `y` and
`memory` (shape (MEMORY,), counters first, see `rig.physics.engines.common.memory`) in place by `steps` steps of
`step_ticks`. It writes a row of `rig.physics.kernels.signals.ROW` at the start and every `stride` steps, and the row at
the end if `rows` has room for it. An engine has no clock, I/O or threads, and its result does not depend on how a run
is divided into calls. It receives constants and inputs as records (`rig.physics.kernels.records`); an `Engine` takes
the tuples.

An engine of another package is added by an entry point of the group `rig.engines`: its name is the engine's, and it
refers to a `Method` that names the engine's `module`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

from rig.base.checks import load_extensions
from rig.physics.engines.common.memory import MEMORY
from rig.physics.kernels import ENGINE_GROUP
from rig.physics.kernels.constants import Constants, Inputs


class Method(NamedTuple):
    """Properties of an engine that are known before it is loaded."""

    title: str
    step_us: int
    """Default step [us]; of an adaptive engine, the grid on which its steps end."""
    tolerance: float
    """Default scaled error per step of an adaptive engine; 0 for fixed steps."""
    frictions: tuple[str, ...]
    """Supported friction laws (`rig.physics.levels`)."""
    contacts: tuple[str, ...] = ("compliant",)
    energy: float = 1e-3
    """Largest energy residual as a share of the dissipated energy."""
    companion: bool = False
    """Default for a companion run, which estimates the error."""
    rolling: str = "series"
    """Default method for rolling contact."""
    module: str = ""
    """Module with its code; empty for the module of its name in this package."""

    @property
    def advice(self) -> str:
        """Advice for a run that fails."""
        return "try a finer engine.tolerance" if self.tolerance else "try a shorter engine.step_us"


_BY_STATE = ("none", "smoothed", "switch")

ENGINES = {
    "split": Method(
        "Taylor series for the accuracy of a whole run, rigid impacts one by one",
        25,
        3e-4,
        ("none", "smoothed", "exact"),
        ("impact", "compliant"),
        companion=True,
        rolling="collocation",
    ),
    "rk8": Method("Dormand-Prince 8(5,3), events located", 25, 1e-8, (*_BY_STATE, "exact")),
    "taylor": Method("Taylor series of order 16, events as roots", 25, 1e-9, ("none", "smoothed", "exact")),
    "tsit5": Method("Tsitouras 5(4), adaptive, events located", 50, 1e-6, (*_BY_STATE, "exact")),
    "rk4": Method("classical Runge-Kutta, events located", 5, 0.0, (*_BY_STATE, "exact")),
    "verlet": Method("velocity Verlet, order 2, events located", 5, 0.0, (*_BY_STATE, "exact")),
    "semi-implicit-euler": Method("symplectic Euler, order 1, events located", 5, 0.0, _BY_STATE),
    "rosenbrock": Method("RODAS 4(3), linearly implicit, adaptive, events located", 50, 1e-7, (*_BY_STATE, "exact")),
}
"""Engines by name, the default first, those of other packages last."""
_found, BROKEN = load_extensions(ENGINE_GROUP, Method, ENGINES)
"""Reasons for entry points of engines that cannot be used: `NAME (REASON)`."""
BROKEN += [f"{name} (its Method must name a module)" for name, method in _found.items() if not method.module]
ENGINES |= {name: method for name, method in _found.items() if method.module}


class Engine(NamedTuple):
    """Engine that is ready to run."""

    start: Callable[..., None]
    advance: Callable[..., None]
    order: int
    memory_size: int = MEMORY
    """Size of the memory. `split` with its own size rolls by collocation; with size MEMORY, by series."""
    warm_up: Callable[[Constants, Inputs], None] | None = None
    """Compile the functions that `advance` may call after its first steps, if any."""


def load_engine(name: str) -> Engine:
    """Import an engine, which is a separate module or a one-step method for the march.

    Args:
        name: Key of `ENGINES`.
    """
    from rig.physics.kernels.records import pack_record

    module: Any = import_module(ENGINES[name].module or f"rig.physics.engines.{name.replace('-', '_')}")
    if hasattr(module, "METHOD"):
        march: Any = import_module("rig.physics.engines.common.march")
        start, advance = march.start, partial(march.advance, module.METHOD)
    else:
        start, advance = module.start, module.advance

    def on_records(kernel: Callable[..., None], constants: Constants, inputs: Inputs, *others: Any) -> None:
        kernel(pack_record(constants), pack_record(inputs), *others)

    size = getattr(module, "MEMORY", MEMORY)
    warm_up = partial(on_records, module.warm_up) if hasattr(module, "warm_up") else None
    return Engine(partial(on_records, start), partial(on_records, advance), module.ORDER, size, warm_up)
