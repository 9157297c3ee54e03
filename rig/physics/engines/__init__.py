"""Engines: one integration method a file, one protocol, chosen by name in a scene.

An engine is a module with `METHOD`, a one-step method that `rig.physics.engines.common.march` takes through events (see
`rig.physics.engines.common.method`), or with its own `start(constants, inputs, y, memory, step_ticks, tolerance)` and
`advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows)`: it moves state `y` and `memory` (shape
(MEMORY,), counters first, see `rig.physics.engines.common.memory`) on in place by `steps` steps of `step_ticks` and
writes one row of `rig.physics.kernels.signals.ROW` every `stride` steps, the first at the start, and that at the end
where `rows` has room for it. It knows no clock, no I/O and no threads, and its result does not depend on how a run is
cut into calls. Constants and inputs come to it as records (`rig.physics.kernels.records`); who calls an `Engine` hands
it the tuples.

An engine of another package has a row by an entry point of the group `rig.engines`: its name is the engine's, and it
refers to a `Method` that names the engine's `module`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, NamedTuple

from rig.physics.engines.common.memory import MEMORY
from rig.physics.kernels import ENGINE_GROUP
from rig.physics.kernels.constants import Constants, Inputs


class Method(NamedTuple):
    """What there is to know of an engine before it is loaded."""

    title: str
    step_us: int
    """Its own step [us]; of an adaptive engine, the grid that its steps end on."""
    tolerance: float
    """Scaled error a step that an adaptive engine aims at; 0: fixed steps."""
    frictions: tuple[str, ...]
    """Friction laws it can take (`rig.physics.levels`)."""
    contacts: tuple[str, ...] = ("compliant",)
    energy: float = 1e-3
    """Share of what was dissipated up to which its ledger may be open."""
    companion: bool = False
    """Whether a run has, unless asked otherwise, a companion that tells its error."""
    rolling: str = "series"
    """Method for rolling contact unless asked otherwise."""
    module: str = ""
    """Where its code is; empty: beside this file, under its name."""

    @property
    def advice(self) -> str:
        """What to try where it fails."""
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
"""Engines, the default first, those of other packages last."""
BROKEN: dict[str, str] = {}
"""Why an entry point for an engine cannot be used, by its name."""


def _add_engines() -> None:
    for point in entry_points(group=ENGINE_GROUP):
        try:
            method = point.load()
        except Exception as error:
            BROKEN[point.name] = f"{point.value} cannot be loaded: {type(error).__name__}: {error}"
            continue
        if point.name in ENGINES:
            BROKEN[point.name] = f"{point.value} has the name of another engine"
        elif not isinstance(method, Method) or not method.module:
            BROKEN[point.name] = f"{point.value} must be a rig.physics.engines.Method with a module"
        else:
            ENGINES[point.name] = method


_add_engines()


class Engine(NamedTuple):
    """An engine that is ready to run."""

    start: Callable[..., None]
    advance: Callable[..., None]
    order: int
    memory_size: int = MEMORY
    """Of `split` with room for rolling by collocation; in one of size MEMORY it rolls by series."""
    warm_up: Callable[[Constants, Inputs], None] | None = None
    """Compiles what `advance` may call later than in its first steps, if there is any."""


def load_engine(name: str) -> Engine:
    """The engine of one of those names (imported only now): a module of its own, or a one-step method for the march.

    Args:
        name: Key of `ENGINES`.
    """
    from rig.physics.kernels.records import packed

    module: Any = import_module(ENGINES[name].module or f"rig.physics.engines.{name.replace('-', '_')}")
    if hasattr(module, "METHOD"):
        march: Any = import_module("rig.physics.engines.common.march")
        start, advance = march.start, partial(march.advance, module.METHOD)
    else:
        start, advance = module.start, module.advance

    def on_records(kernel: Callable[..., None], constants: Constants, inputs: Inputs, *others: Any) -> None:
        kernel(packed(constants), packed(inputs), *others)

    size = getattr(module, "MEMORY", MEMORY)
    warm_up = partial(on_records, module.warm_up) if hasattr(module, "warm_up") else None
    return Engine(partial(on_records, start), partial(on_records, advance), module.ORDER, size, warm_up)
