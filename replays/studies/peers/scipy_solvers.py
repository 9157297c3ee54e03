"""scipy's solvers, restarted at every change of phase and at the hammer's corners.

Nearest to the paper's procedure (ode15s with events) is BDF: an event is looked for by the sign of the switching
functions at the ends of each step and located on the step's interpolant, as `solve_ivp` and ode15s do; the state there
starts the next phase, and v0 is latched there.

Compiled, the implicit methods have their matrix from compiled differences, too: at unchanged error 1 to 10 % off Radau,
2 to 5 % off LSODA, nothing sure off BDF (total of six windows, tolerances 1e-3 to 1e-8). No gain beyond chance: a first
step of 1e-5 s, a longest one of 1e-3 s, RK45 for DOP853. What is left is scipy's own Python.

The known failures are the same solvers with a part of this left out: without the stops they can step over the
hammer's pulse; without events the right-hand side asks for the gap's sign, and v0 is latched at a step's end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from replays.studies.peers.common.problem import Problem
from replays.studies.peers.common.right_hand_side import (
    N_SWITCH,
    compile_s,
    derivative,
    derivative_by_sign,
    follow_sign,
    jacobian,
    pack,
    switching,
    take_switch,
)
from replays.studies.peers.common.solution import MISSED_HAMMER, PROPER, Manner, Setting, Solution
from replays.studies.peers.plain_python import PlainPython
from rig.physics.kernels.signals import STATE_SCALE

LEAST_TOLERANCE = 2.3e-14
"""scipy takes no relative tolerance below 100 times the rounding unit."""
_IMPLICIT = ("BDF", "Radau", "LSODA")
_LOOKS = 8
"""Points inside a step at which a switching function is looked at where the step's ends tell nothing."""


class _Law(NamedTuple):
    """The callbacks of a solve, with the struct that holds the phase."""

    rates: Callable[[float, np.ndarray], Any]
    switching: Callable[[float, np.ndarray], Any]
    plain: PlainPython | None


def solve(problem: Problem, *, setting: Setting, budget_s: float, method: str, manner: Manner = PROPER) -> Solution:
    """Solve a problem by one of scipy's methods.

    Args:
        problem: The problem.
        setting: Tolerances.
        budget_s: Wall time allowed [s].
        method: BDF, Radau, LSODA or DOP853.
        manner: How it is driven.
    """
    import scipy.integrate

    if not manner.events and problem.exact_friction:
        raise NotImplementedError("exact friction needs events")
    integrator: Any = getattr(scipy.integrate, method)
    compiling_s = 0.0 if manner.plain else compile_s()
    parameters = pack(problem)
    law = _law(problem, parameters, manner)
    rtol = max(setting.tolerance, LEAST_TOLERANCE)
    atol = setting.tolerance * STATE_SCALE if setting.absolute is None else setting.absolute
    corners = [*problem.corners, problem.duration_s] if manner.stops else [problem.duration_s]
    # Without events the right-hand side asks for the gap's sign, of which the matrix knows nothing.
    compiled_matrix = method in _IMPLICIT and manner.events and not manner.plain
    own = {"jac": lambda t, y: jacobian(t, y, parameters)} if compiled_matrix else {}
    pulse = problem.pulse
    pulse_seen = pulse is None

    solution = Solution(problem.times, budget_s, compiling_s)
    solution.states[0] = y = problem.y0.copy()
    solution.reached = 1
    t = 0.0
    while corners and solution.failure is None:
        run = integrator(law.rates, t, y, corners[0], rtol=rtol, atol=atol, **own)
        before = law.switching(t, y)
        young = True
        while run.status == "running" and not solution.overrun():
            message = run.step()
            if run.status == "failed":
                solution.failure = f"gave up at {run.t:.6g} s: {message}"
                break
            solution.steps += 1
            after = law.switching(run.t, run.y)
            if not np.isfinite(run.y).all():
                solution.failure = f"the state is not finite at {run.t:.6g} s"
                break
            # A function that starts at 0 to rounding may be back below it within the first step.
            fallen = [i for i in range(N_SWITCH) if after[i] <= 0.0 and (before[i] > 0.0 or young)]
            met = _first_zero(law, run, fallen) if manner.events and fallen else None
            t = run.t if met is None else met[0]
            pulse_seen = pulse_seen or (pulse is not None and pulse[0] < t < pulse[1])
            _sample(solution, run, t)
            if met is not None:
                y = run.dense_output()(t)
                _switch(solution, law, parameters, t, y, met[1])
                break
            if not manner.events and follow_sign(t, run.y, parameters):
                solution.onsets.append((t, float(parameters[0]["onset_speed"])))
            y, before, young = run.y, after, False
        if t >= corners[0]:
            corners.pop(0)
    solution.evaluations = law.plain.evaluations if law.plain else int(parameters[0]["evaluations"])
    # With stops, a step from corner to corner has its stages inside.
    if solution.failure is None and not manner.stops and not pulse_seen:
        solution.failure = MISSED_HAMMER
    return solution.close()


def _law(problem: Problem, parameters: np.ndarray, manner: Manner) -> _Law:
    if manner.plain:
        callbacks = PlainPython(problem)
        return _Law(callbacks.rates, callbacks.switching, callbacks)
    rates = derivative if manner.events else derivative_by_sign
    return _Law(lambda t, y: rates(t, y, parameters), lambda t, y: switching(t, y, parameters), None)


def _first_zero(law: _Law, run: Any, fallen: list[int]) -> tuple[float, int] | None:
    """Time and number of the switching function that first falls to 0 in the step just taken."""
    import scipy.optimize

    brentq: Any = scipy.optimize.brentq
    dense = run.dense_output()
    zeros = []
    for i in fallen:

        def value(time: float, i: int = i) -> float:
            return law.switching(time, dense(time))[i]

        left = run.t_old
        if value(left) <= 0.0:
            looks = np.linspace(run.t_old, run.t, _LOOKS + 2)[1:-1]
            inside = [time for time in looks if value(time) > 0.0]
            if not inside:
                # A contact that is never inside is over as soon as it began. A sliding that starts on the wrong side
                # of 0, by what a loose tolerance let rolling drift, is on its way to the right one.
                if i == 0:
                    zeros.append((float(run.t), i))
                continue
            left = inside[0]
        # The interpolant may miss the step's end by rounding.
        root = brentq(value, left, run.t, xtol=1e-17, rtol=1e-15) if value(run.t) < 0.0 else run.t
        zeros.append((float(root), i))
    return min(zeros) if zeros else None


def _sample(solution: Solution, run: Any, t: float) -> None:
    """Keep the states wanted up to `t`, from the interpolant of the step just taken."""
    end = int(np.searchsorted(solution.times, t, side="right"))
    if end > solution.reached:
        solution.states[solution.reached : end] = run.dense_output()(solution.times[solution.reached : end]).T
        solution.reached = end


def _switch(solution: Solution, law: _Law, parameters: np.ndarray, t: float, y: np.ndarray, which: int) -> None:
    began = take_switch(t, y, parameters, which)
    solution.switches += 1
    if began:
        solution.onsets.append((t, float(parameters[0]["onset_speed"])))
    if law.plain is not None:
        law.plain.phase = int(parameters[0]["phase"])
        law.plain.onset_speed = float(parameters[0]["onset_speed"])
