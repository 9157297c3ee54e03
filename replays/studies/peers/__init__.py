"""Other people's solvers on exactly the rig's equations, side by side: what `rig chart` compares our engines with.

Every peer solves a `Problem` through `Peer.solve` and returns a `Solution`; what goes wrong stands in its `failure`
and never raised. The right-hand side is compiled for every peer that can call it so; rows "as installed" call plain
Python, as a user of that library would.

Not here: CENIC, the error-controlled integrator for contact of Drake (1.51.1, `pydrake.multibody.cenic`). Its contact
is MultibodyPlant's: point contact is linear in the penetration (1, 10 and 100 N at 1, 10 and 100 um, measured) with one
constant dissipation, so it has neither K delta^1.5 nor a c/v0 that is latched at each onset, and the hollow ring would
be a polygon, as it is for MuJoCo. Our law could be put in as a system of external forces in Python, at 15 us and more a
step, which leaves out just what CENIC is for.

Siconos is not on the Python package index; its time stepping has rigid contacts. SciML's solvers need Julia beside
Python, and may be added to a chart by their results (`rig chart --add`). IDA, SUNDIALS' solver of algebraic equations,
was not tried: rolling is solved for its friction, so that each phase is an ordinary equation, and IDA's method is that
of CVODE's BDF. `pychrono` on that index is another thing than Chrono.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from replays.studies.peers.common.problem import ERROR_COLUMNS, ERROR_SCALE, Problem, scaled_error
from replays.studies.peers.common.solution import PROPER, Manner, Setting, Solution
from rig.base.errors import InputError, Words

__all__ = [
    "ERROR_COLUMNS", "ERROR_SCALE", "PEERS", "Library", "Peer", "Problem", "Setting", "Solution", "scaled_error",
]  # fmt: skip


def _ladder(*tolerances: float) -> tuple[Setting, ...]:
    return tuple(Setting(f"{tolerance:.0e}".replace("e-0", "e-"), tolerance) for tolerance in tolerances)


ODE15S = Setting("ode15s's defaults", 1e-3, 1e-6)
"""Relative 1e-3 and absolute 1e-6 in every SI unit, as MATLAB's ode15s has them by default."""
_USUAL = _ladder(1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10)
_FINE = (*_USUAL, *_ladder(1e-12))
_LATE = _ladder(1e-3, 1e-4, 1e-6, 1e-8)
"""Of those without events, which no tolerance helps."""


class Library(NamedTuple):
    """Where a solver comes from."""

    name: str
    """Its name in a legend."""
    file: str
    """Module of this package that drives it."""
    module: str = ""
    """Python module that must be installed; empty where the rig itself needs it anyway."""


@dataclass(frozen=True)
class Peer:
    """One solver that somebody else wrote.

    Attributes:
        name: Its name here.
        title: Its name for a legend.
        library: Where it comes from.
        ladder: Tolerances to chart, the coarsest first; of MuJoCo, its steps.
        options: What the driving module's `solve` is given beside the problem and its manner.
        manner: How it is driven.
        model_failure: Why its very model is expected to mislead; empty for a peer that has the rig's.
        quick: Whether a quick chart has it: not where compiling alone takes longer than that may.
    """

    name: str
    title: str
    library: Library
    ladder: tuple[Setting, ...]
    options: dict[str, Any] = field(default_factory=dict)
    manner: Manner = PROPER
    model_failure: str = ""
    quick: bool = True

    @property
    def family(self) -> str:
        """Library it comes from, by name."""
        return self.library.name

    @property
    def module(self) -> str:
        """Python module that must be installed; empty where there is none."""
        return self.library.module

    @property
    def known_failure(self) -> str:
        """Why it is expected to fail or to mislead; empty for a peer in good order."""
        if not self.manner.stops:
            return "no stop at the hammer's corners: may step over the pulse"
        late = "" if self.manner.events else "no events: the impact speed is latched at a step's end"
        return self.model_failure or late

    @property
    def exact_friction(self) -> bool:
        """Whether it takes problems with Coulomb's set-valued law."""
        return self.manner.events and not self.manner.plain

    @property
    def installed(self) -> bool:
        """Whether its library is there."""
        return not self.module or find_spec(self.module) is not None

    def solve(self, problem: Problem, setting: Setting | None = None, *, budget_s: float = 60.0) -> Solution:
        """Solve a problem.

        Args:
            problem: The problem.
            setting: Tolerances; None for the middle of the ladder.
            budget_s: Wall time allowed [s]; the solve is given up soon after.

        Returns:
            The solution; its `failure` tells what went wrong.

        Raises:
            InputError: Its library is not installed; the message names the extra that brings it.
        """
        if not self.installed:
            must = f"installed ({self.name} needs {self.module}: pip install 'rotor-stator-rig[peers]')"
            raise InputError("peer", must, Words("missing"))
        setting = setting or self.ladder[len(self.ladder) // 2]
        begun = Solution(problem.times, budget_s)
        try:
            solver = import_module(f"replays.studies.peers.{self.library.file}")
            options = self.options if self.manner is PROPER else {**self.options, "manner": self.manner}
            with np.errstate(all="ignore"):  # trial steps that overflow are the solver's own affair
                return solver.solve(problem, setting=setting, budget_s=budget_s, **options)
        except Exception as error:  # whatever a foreign library raises is a result on the chart
            begun.failure = f"{type(error).__name__}: {error}"
            return begun.close()


_PLAIN, _UNSTOPPED, _EVENTLESS = Manner(plain=True), Manner(stops=False), Manner(events=False)
_SCIPY, _SUNDIALS = Library("scipy", "scipy_solvers"), Library("SUNDIALS", "cvode", "sksundae")
_BDF, _DOP853 = {"method": "BDF"}, {"method": "DOP853"}
_CVODE_ADAMS, _CVODE_BDF = {"method": 1}, {"method": 2}
_JAX = Library("diffrax", "diffrax_solver", "diffrax")
_MUJOCO = "another contact law and a polygon for the ring: the error is the model's"

_ALL = (
    Peer("scipy-bdf", "scipy BDF + events", _SCIPY, (ODE15S, *_ladder(1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)), _BDF),
    Peer(
        "scipy-radau", "scipy Radau + events", _SCIPY, _ladder(1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8), {"method": "Radau"}
    ),
    Peer("scipy-lsoda", "scipy LSODA + events", _SCIPY, _USUAL, {"method": "LSODA"}),
    Peer("scipy-dop853", "scipy DOP853 + events", _SCIPY, _FINE, _DOP853),
    Peer("scipy-bdf-python", "scipy BDF + events, plain Python", _SCIPY, (ODE15S, *_ladder(1e-4, 1e-6)), _BDF, _PLAIN),
    Peer(
        "scipy-bdf-no-stops", "scipy BDF + events, no stops", _SCIPY, (ODE15S, *_ladder(1e-3, 1e-4, 1e-6)), _BDF,
        _UNSTOPPED,
    ),
    Peer("scipy-bdf-no-events", "scipy BDF, no events", _SCIPY, (ODE15S, *_LATE), _BDF, _EVENTLESS),
    Peer("scipy-dop853-no-events", "scipy DOP853, no events", _SCIPY, _LATE, _DOP853, _EVENTLESS),
    Peer("cvode-bdf", "CVODE BDF", _SUNDIALS, _USUAL, _CVODE_BDF),
    Peer("cvode-adams", "CVODE Adams", _SUNDIALS, _FINE, {**_CVODE_ADAMS, "tuned": False}),
    # Both: tuned gains over many scenes, but in the chart's own hammer scene chance favours the defaults.
    Peer("cvode-adams-tuned", "CVODE Adams, tuned", _SUNDIALS, _FINE, _CVODE_ADAMS),
    Peer("cvode-bdf-python", "CVODE BDF, plain Python", _SUNDIALS, _ladder(1e-4, 1e-6, 1e-8), _CVODE_BDF, _PLAIN),
    Peer("cvode-adams-python", "CVODE Adams, plain Python", _SUNDIALS, _ladder(1e-4, 1e-6, 1e-8), _CVODE_ADAMS, _PLAIN),
    Peer("cvode-bdf-no-stops", "CVODE BDF, no stops", _SUNDIALS, _ladder(1e-3, 1e-4, 1e-6), _CVODE_BDF, _UNSTOPPED),
    Peer("cvode-bdf-no-events", "CVODE BDF, no events", _SUNDIALS, _LATE, _CVODE_BDF, _EVENTLESS),
    Peer(
        "heyoka", "heyoka, Taylor series", Library("heyoka", "taylor", "heyoka"),
        _ladder(1e-3, 1e-4, 1e-5, 1e-6, 1e-8, 1e-10, 1e-12, 1e-15),
    ),
    Peer(
        "diffrax", "diffrax Dopri8, on JAX", _JAX, _ladder(1e-3, 1e-5, 1e-6, 1e-8, 1e-10), quick=False,
    ),
    Peer(
        "mujoco", "MuJoCo, closest model", Library("MuJoCo", "mujoco_engine", "mujoco"),
        tuple(Setting(f"{us} us", us * 1e-6) for us in (200, 100, 50, 20, 10)), model_failure=_MUJOCO,
    ),
)  # fmt: skip
PEERS: dict[str, Peer] = {peer.name: peer for peer in _ALL}
"""All peers by name, whether their library is installed or not."""
