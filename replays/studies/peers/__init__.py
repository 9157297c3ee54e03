"""Solvers of other authors on exactly the rig's equations, which `rig chart` compares with our engines.

Every peer solves a `Problem` through `Peer.solve` and returns a `Solution`; errors go to its `failure` and are never
raised. The right-hand side is compiled for every peer that can call compiled code; rows "as installed" call plain
Python, as a user of that library would.

Excluded: CENIC, the error-controlled integrator for contact of Drake (1.51.1, `pydrake.multibody.cenic`). Its contact
model is MultibodyPlant's: point contact is linear in the penetration (1, 10 and 100 N at 1, 10 and 100 um, measured)
with one constant dissipation. It has neither K delta^1.5 nor a c/v0 latched at each onset, and the hollow ring would be
a polygon, as with MuJoCo. Our law could be added as external forces in Python, at 15 us and more per step, but that
would bypass CENIC's purpose.

Siconos is not on the Python package index; its time stepping has rigid contacts. SciML's solvers need Julia; their
results may be added to a chart (`rig chart --add`). IDA, SUNDIALS' solver of algebraic equations, was not tried:
rolling is solved for its friction, so that each phase is an ordinary differential equation, and IDA's method is that of
CVODE's BDF. `pychrono` on that index is not Chrono.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from replays.studies.peers.common.problem import ERROR_COLUMNS, ERROR_SCALE, Problem, scaled_error
from replays.studies.peers.common.solution import DEFAULT, Manner, Setting, Solution
from rig.base.errors import InputError, Words

__all__ = [
    "ERROR_COLUMNS", "ERROR_SCALE", "PEERS", "Library", "Peer", "Problem", "Setting", "Solution", "scaled_error",
]  # fmt: skip


def _ladder(*tolerances: float) -> tuple[Setting, ...]:
    return tuple(Setting(f"{tolerance:.0e}".replace("e-0", "e-"), tolerance) for tolerance in tolerances)


ODE15S = Setting("ode15s's defaults", 1e-3, 1e-6)
"""Relative 1e-3 and absolute 1e-6 in every SI unit, the defaults of MATLAB's ode15s."""
_TOLERANCES = _ladder(1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10)
_FINE_TOLERANCES = (*_TOLERANCES, *_ladder(1e-12))
_EVENTLESS_TOLERANCES = _ladder(1e-3, 1e-4, 1e-6, 1e-8)
"""Tolerances of peers without events, which a finer tolerance does not improve."""


class Library(NamedTuple):
    """Source of a solver."""

    name: str
    """Name in a legend."""
    file: str
    """Module of this package that calls it."""
    module: str = ""
    """Required Python module; empty if the rig needs it anyway."""


@dataclass(frozen=True)
class Peer:
    """Solver of other authors.

    Attributes:
        name: Name in this table.
        title: Name for a legend.
        library: Source.
        ladder: Tolerances to chart, the coarsest first; steps for MuJoCo.
        options: Options of the module's `solve` in addition to problem and manner.
        manner: Mode of operation.
        model_failure: Reason why its model is expected to mislead; empty for a peer with the rig's model.
        quick: Whether a quick chart includes it; False if compiling takes longer than such a chart.
    """

    name: str
    title: str
    library: Library
    ladder: tuple[Setting, ...]
    options: dict[str, Any] = field(default_factory=dict)
    manner: Manner = DEFAULT
    model_failure: str = ""
    quick: bool = True

    @property
    def family(self) -> str:
        """Name of its library."""
        return self.library.name

    @property
    def module(self) -> str:
        """Required Python module; empty if there is none."""
        return self.library.module

    @property
    def known_failure(self) -> str:
        """Reason for an expected failure or error; empty for a reliable peer."""
        if not self.manner.stops:
            return "no stop at the hammer's corners: may step over the pulse"
        late = "" if self.manner.events else "no events: the impact speed is latched at a step's end"
        return self.model_failure or late

    @property
    def exact_friction(self) -> bool:
        """Whether it solves problems with Coulomb's set-valued law."""
        return self.manner.events and not self.manner.plain

    @property
    def installed(self) -> bool:
        """Whether its library is installed."""
        return not self.module or find_spec(self.module) is not None

    def solve(self, problem: Problem, setting: Setting | None = None, *, budget_s: float = 60.0) -> Solution:
        """Solve a problem.

        Args:
            problem: Problem.
            setting: Tolerances; None for the middle of the ladder.
            budget_s: Permitted wall time [s]; the solver is stopped soon after.

        Returns:
            Solution; `failure` has the reason for a failure.

        Raises:
            InputError: The library is not installed; the message names the extra that installs it.
        """
        if not self.installed:
            must = f"installed ({self.name} needs {self.module}: pip install 'rotor-stator-rig[peers]')"
            raise InputError("peer", must, Words("missing"))
        setting = setting or self.ladder[len(self.ladder) // 2]
        begun = Solution(problem.times, budget_s)
        try:
            solver = import_module(f"replays.studies.peers.{self.library.file}")
            options = self.options if self.manner is DEFAULT else {**self.options, "manner": self.manner}
            with np.errstate(all="ignore"):  # trial steps may overflow
                return solver.solve(problem, setting=setting, budget_s=budget_s, **options)
        except Exception as error:  # any error of a library is a result on the chart
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
    Peer("scipy-lsoda", "scipy LSODA + events", _SCIPY, _TOLERANCES, {"method": "LSODA"}),
    Peer("scipy-dop853", "scipy DOP853 + events", _SCIPY, _FINE_TOLERANCES, _DOP853),
    Peer("scipy-bdf-python", "scipy BDF + events, plain Python", _SCIPY, (ODE15S, *_ladder(1e-4, 1e-6)), _BDF, _PLAIN),
    Peer(
        "scipy-bdf-no-stops", "scipy BDF + events, no stops", _SCIPY, (ODE15S, *_ladder(1e-3, 1e-4, 1e-6)), _BDF,
        _UNSTOPPED,
    ),
    Peer("scipy-bdf-no-events", "scipy BDF, no events", _SCIPY, (ODE15S, *_EVENTLESS_TOLERANCES), _BDF, _EVENTLESS),
    Peer("scipy-dop853-no-events", "scipy DOP853, no events", _SCIPY, _EVENTLESS_TOLERANCES, _DOP853, _EVENTLESS),
    Peer("cvode-bdf", "CVODE BDF", _SUNDIALS, _TOLERANCES, _CVODE_BDF),
    Peer("cvode-adams", "CVODE Adams", _SUNDIALS, _FINE_TOLERANCES, {**_CVODE_ADAMS, "tuned": False}),
    # Both: tuning gains over many scenes, but the defaults happen to be better in the chart's hammer scene.
    Peer("cvode-adams-tuned", "CVODE Adams, tuned", _SUNDIALS, _FINE_TOLERANCES, _CVODE_ADAMS),
    Peer("cvode-bdf-python", "CVODE BDF, plain Python", _SUNDIALS, _ladder(1e-4, 1e-6, 1e-8), _CVODE_BDF, _PLAIN),
    Peer("cvode-adams-python", "CVODE Adams, plain Python", _SUNDIALS, _ladder(1e-4, 1e-6, 1e-8), _CVODE_ADAMS, _PLAIN),
    Peer("cvode-bdf-no-stops", "CVODE BDF, no stops", _SUNDIALS, _ladder(1e-3, 1e-4, 1e-6), _CVODE_BDF, _UNSTOPPED),
    Peer("cvode-bdf-no-events", "CVODE BDF, no events", _SUNDIALS, _EVENTLESS_TOLERANCES, _CVODE_BDF, _EVENTLESS),
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
