"""Other people's solvers on exactly the rig's equations, side by side: what `rig chart` compares our engines with.

Every peer solves a `Problem` through `Peer.solve` and returns a `Solution`; what goes wrong stands in its `failure`
and never raised. The right-hand side is compiled for every peer that can call it so; rows "as installed" call plain
Python, as a user of that library would.

Not here: CENIC, the error-controlled integrator for contact of Drake (1.51.1, `pydrake.multibody.cenic`). Its contact
is MultibodyPlant's: point contact is linear in the penetration (1, 10 and 100 N at 1, 10 and 100 um, measured) with one
constant dissipation, so it has neither K delta^1.5 nor a c/v0 that is latched at each onset, and the hollow ring would
be a polygon, as it is for MuJoCo. Our law could be put in as a system of external forces in Python, at 15 us and more a
step, which leaves out just what CENIC is for.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np

from replays.studies.peers.problem import ERROR_COLUMNS, ERROR_SCALE, Problem, scaled_error
from replays.studies.peers.solution import Journal, Manner, Setting, Solution
from rig.errors import InputError, Words

__all__ = [
    "ERROR_COLUMNS", "ERROR_SCALE", "PEERS", "Peer", "Problem", "Setting", "Solution", "scaled_error",
]  # fmt: skip


def _ladder(*tolerances: float) -> tuple[Setting, ...]:
    return tuple(Setting(f"{tolerance:.0e}".replace("e-0", "e-"), tolerance) for tolerance in tolerances)


ODE15S = Setting("ode15s's defaults", 1e-3, 1e-6)
"""Relative 1e-3 and absolute 1e-6 in every SI unit, as MATLAB's ode15s has them by default."""
_CVODE = _ladder(1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10)


@dataclass(frozen=True)
class Peer:
    """One solver that somebody else wrote.

    Attributes:
        name: Its name here.
        title: Its name for a legend.
        family: Library it comes from.
        order: Order of the method in words.
        build: How the right-hand side is called.
        ladder: Tolerances to chart, the coarsest first; of MuJoCo, its steps.
        file: Module of this package that drives it.
        known_failure: Why it is expected to fail or to mislead; empty for a peer in good order.
        exact_friction: Whether it takes problems with Coulomb's set-valued law.
        module: Python module that must be installed; empty where the rig itself needs it anyway.
        options: What that module's `solve` is given beside the problem.
    """

    name: str
    title: str
    family: str
    order: str
    build: Literal["compiled", "as installed"]
    ladder: tuple[Setting, ...]
    file: str
    known_failure: str = ""
    exact_friction: bool = True
    module: str = ""
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def installed(self) -> bool:
        """Whether its library is there."""
        return not self.module or find_spec(self.module) is not None

    def require(self) -> None:
        """Check that its library is there.

        Raises:
            InputError: It is not; the message names the extra that brings it.
        """
        if not self.installed:
            raise InputError(
                "peer",
                f"installed ({self.name} needs {self.module}: pip install 'rotor-stator-rig[peers]')",
                Words("missing"),
            )

    def solve(self, problem: Problem, setting: Setting | None = None, *, budget_s: float = 60.0) -> Solution:
        """Solve a problem.

        Args:
            problem: The problem.
            setting: Tolerances; None for the middle of the ladder.
            budget_s: Wall time allowed [s]; the solve is given up soon after.

        Returns:
            The solution; its `failure` tells what went wrong.

        Raises:
            InputError: Its library is not installed.
        """
        self.require()
        setting = setting or self.ladder[len(self.ladder) // 2]
        begun = Journal(problem.times, budget_s)
        try:
            solver = import_module(f"replays.studies.peers.{self.file}")
            with np.errstate(all="ignore"):  # trial steps that overflow are the solver's own affair
                return solver.solve(problem, setting=setting, budget_s=budget_s, **self.options)
        except Exception as error:  # whatever a foreign library raises is a result on the chart
            begun.failure = f"{type(error).__name__}: {error}"
            return begun.close()


_PLAIN, _UNSTOPPED, _EVENTLESS = Manner(plain=True), Manner(stops=False), Manner(events=False)
_NO_STOPS = "no stop at the hammer's corners: may step over the pulse"
_NO_EVENTS = "no events: the impact speed is latched at a step's end"

_ALL = (
    Peer(
        "scipy-bdf", "scipy BDF + events", "scipy", "1 to 5", "compiled",
        (ODE15S, *_ladder(1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)), "scipy_solvers", options={"method": "BDF"},
    ),
    Peer(
        "scipy-radau", "scipy Radau + events", "scipy", "5", "compiled",
        _ladder(1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8), "scipy_solvers", options={"method": "Radau"},
    ),
    Peer(
        "scipy-lsoda", "scipy LSODA + events", "scipy", "1 to 12", "compiled",
        _ladder(1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10), "scipy_solvers", options={"method": "LSODA"},
    ),
    Peer(
        "scipy-dop853", "scipy DOP853 + events", "scipy", "8", "compiled",
        _ladder(1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10, 1e-12), "scipy_solvers", options={"method": "DOP853"},
    ),
    Peer(
        "scipy-bdf-python", "scipy BDF + events, plain Python", "scipy", "1 to 5", "as installed",
        (ODE15S, *_ladder(1e-4, 1e-6)), "scipy_solvers", exact_friction=False,
        options={"method": "BDF", "manner": _PLAIN},
    ),
    Peer(
        "scipy-bdf-no-stops", "scipy BDF + events, no stops", "scipy", "1 to 5", "compiled",
        (ODE15S, *_ladder(1e-3, 1e-4, 1e-6)), "scipy_solvers", known_failure=_NO_STOPS,
        options={"method": "BDF", "manner": _UNSTOPPED},
    ),
    Peer(
        "scipy-bdf-no-events", "scipy BDF, no events", "scipy", "1 to 5", "compiled",
        (ODE15S, *_ladder(1e-3, 1e-4, 1e-6, 1e-8)), "scipy_solvers", known_failure=_NO_EVENTS, exact_friction=False,
        options={"method": "BDF", "manner": _EVENTLESS},
    ),
    Peer(
        "scipy-dop853-no-events", "scipy DOP853, no events", "scipy", "8", "compiled",
        _ladder(1e-3, 1e-4, 1e-6, 1e-8), "scipy_solvers", known_failure=_NO_EVENTS, exact_friction=False,
        options={"method": "DOP853", "manner": _EVENTLESS},
    ),
    Peer(
        "cvode-bdf", "CVODE BDF", "SUNDIALS", "1 to 5", "compiled", _CVODE, "cvode", module="sksundae",
        options={"method": 2},
    ),
    Peer(
        "cvode-adams", "CVODE Adams", "SUNDIALS", "1 to 12", "compiled", (*_CVODE, *_ladder(1e-12)), "cvode",
        module="sksundae", options={"method": 1, "tuned": False},
    ),
    # Both: tuned gains over many scenes, but in the chart's own hammer scene chance favours the defaults.
    Peer(
        "cvode-adams-tuned", "CVODE Adams, tuned", "SUNDIALS", "1 to 12", "compiled", (*_CVODE, *_ladder(1e-12)),
        "cvode", module="sksundae", options={"method": 1},
    ),
    Peer(
        "cvode-bdf-python", "CVODE BDF, plain Python", "SUNDIALS", "1 to 5", "as installed",
        _ladder(1e-4, 1e-6, 1e-8), "cvode", exact_friction=False, module="sksundae",
        options={"method": 2, "manner": _PLAIN},
    ),
    Peer(
        "cvode-adams-python", "CVODE Adams, plain Python", "SUNDIALS", "1 to 12", "as installed",
        _ladder(1e-4, 1e-6, 1e-8), "cvode", exact_friction=False, module="sksundae",
        options={"method": 1, "manner": _PLAIN},
    ),
    Peer(
        "cvode-bdf-no-stops", "CVODE BDF, no stops", "SUNDIALS", "1 to 5", "compiled",
        _ladder(1e-3, 1e-4, 1e-6), "cvode", known_failure=_NO_STOPS, module="sksundae",
        options={"method": 2, "manner": _UNSTOPPED},
    ),
    Peer(
        "cvode-bdf-no-events", "CVODE BDF, no events", "SUNDIALS", "1 to 5", "compiled",
        _ladder(1e-3, 1e-4, 1e-6, 1e-8), "cvode", known_failure=_NO_EVENTS, exact_friction=False, module="sksundae",
        options={"method": 2, "manner": _EVENTLESS},
    ),
    Peer(
        "heyoka", "heyoka, Taylor series", "heyoka", "5 to 20, by the tolerance", "compiled",
        _ladder(1e-3, 1e-4, 1e-5, 1e-6, 1e-8, 1e-10, 1e-12, 1e-15), "taylor", module="heyoka",
    ),
    Peer(
        "mujoco", "MuJoCo, closest model", "MuJoCo", "1, fixed step", "as installed",
        tuple(Setting(f"{us} us", us * 1e-6) for us in (200, 100, 50, 20, 10)), "mujoco_engine", module="mujoco",
        known_failure="another contact law and a polygon for the ring: the error is the model's",
    ),
)  # fmt: skip
PEERS: dict[str, Peer] = {peer.name: peer for peer in _ALL}
"""All peers by name, whether their library is installed or not."""
