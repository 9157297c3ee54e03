"""scipy's solvers, restarted at every change of phase and at the corners of the hammer pulse.

BDF is the method nearest to the paper's (ode15s with events): an event is detected by the sign of the switching
functions at the ends of each step and located on the step's interpolant, as `solve_ivp` and ode15s do. The state there
starts the next phase, and v0 is latched there.

Compiled, the implicit methods also have their matrix from compiled differences: at equal error this saves 1 to 10 % of
Radau's time and 2 to 5 % of LSODA's, with no certain gain for BDF (total of six windows, tolerances 1e-3 to 1e-8). No
gain beyond chance: a first step of 1e-5 s, a maximum step of 1e-3 s, RK45 instead of DOP853. The rest of the time is
scipy's own Python.

The known failures are the same solvers without a part of this: without the stops they can step over the hammer pulse;
without events the right-hand side uses the sign of the gap, and v0 is latched at the end of a step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from replays.studies.peers.common.problem import Problem
from replays.studies.peers.common.right_hand_side import (
    N_SWITCH,
    change_phase,
    compile_s,
    derivative,
    derivative_by_gap_sign,
    follow_gap_sign,
    jacobian,
    pack,
    switching,
)
from replays.studies.peers.common.solution import DEFAULT, MISSED_HAMMER, Manner, Setting, Solution
from replays.studies.peers.plain_python import PlainPython
from rig.physics.kernels.signals import STATE_SCALE

MIN_TOLERANCE = 2.3e-14
"""Smallest relative tolerance that scipy accepts: 100 times the rounding unit."""
_IMPLICIT = ("BDF", "Radau", "LSODA")
_SUBSTEP_SAMPLES = 8
"""Number of points within a step at which a switching function is evaluated if the step's ends are inconclusive."""


class _Law(NamedTuple):
    """Callbacks of a solve."""

    rates: Callable[[float, np.ndarray], Any]
    switching: Callable[[float, np.ndarray], Any]
    plain: PlainPython | None


def solve(problem: Problem, *, setting: Setting, budget_s: float, method: str, manner: Manner = DEFAULT) -> Solution:
    """Solve a problem by one of scipy's methods.

    Args:
        problem: Problem.
        setting: Tolerances.
        budget_s: Permitted wall time [s].
        method: BDF, Radau, LSODA or DOP853.
        manner: Mode of operation.
    """
    import scipy.integrate

    if not manner.events and problem.exact_friction:
        raise NotImplementedError("exact friction needs events")
    integrator: Any = getattr(scipy.integrate, method)
    compiling_s = 0.0 if manner.plain else compile_s()
    parameters = pack(problem)
    law = _law(problem, parameters, manner)
    rtol = max(setting.tolerance, MIN_TOLERANCE)
    atol = setting.tolerance * STATE_SCALE if setting.absolute is None else setting.absolute
    corners = [*problem.corners, problem.duration_s] if manner.stops else [problem.duration_s]
    # Without events the right-hand side uses the sign of the gap, which the matrix does not include.
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
        first_step = True
        while run.status == "running" and not solution.overrun():
            message = run.step()
            if run.status == "failed":
                solution.failure = f"failed at {run.t:.6g} s: {message}"
                break
            solution.steps += 1
            after = law.switching(run.t, run.y)
            if not np.isfinite(run.y).all():
                solution.failure = f"the state is not finite at {run.t:.6g} s"
                break
            # A function that starts at 0 within rounding may fall below it within the first step.
            negative = [i for i in range(N_SWITCH) if after[i] <= 0.0 and (before[i] > 0.0 or first_step)]
            crossing = _first_zero(law, run, negative) if manner.events and negative else None
            t = run.t if crossing is None else crossing[0]
            pulse_seen = pulse_seen or (pulse is not None and pulse[0] < t < pulse[1])
            _sample(solution, run, t)
            if crossing is not None:
                y = run.dense_output()(t)
                _switch(solution, law, parameters, t, y, crossing[1])
                break
            if not manner.events and follow_gap_sign(t, run.y, parameters):
                solution.onsets.append((t, float(parameters[0]["onset_speed"])))
            y, before, first_step = run.y, after, False
        if t >= corners[0]:
            corners.pop(0)
    solution.evaluations = law.plain.evaluations if law.plain else int(parameters[0]["evaluations"])
    # With stops, a step between the corners has its stages within the pulse.
    if solution.failure is None and not manner.stops and not pulse_seen:
        solution.failure = MISSED_HAMMER
    return solution.close()


def _law(problem: Problem, parameters: np.ndarray, manner: Manner) -> _Law:
    if manner.plain:
        callbacks = PlainPython(problem)
        return _Law(callbacks.rates, callbacks.switching, callbacks)
    rates = derivative if manner.events else derivative_by_gap_sign
    return _Law(lambda t, y: rates(t, y, parameters), lambda t, y: switching(t, y, parameters), None)


def _first_zero(law: _Law, run: Any, negative: list[int]) -> tuple[float, int] | None:
    """Return time and number of the switching function that first falls to 0 in the last step."""
    import scipy.optimize

    brentq: Any = scipy.optimize.brentq
    dense = run.dense_output()
    zeros = []
    for i in negative:

        def value(time: float, i: int = i) -> float:
            return law.switching(time, dense(time))[i]

        left = run.t_old
        if value(left) <= 0.0:
            looks = np.linspace(run.t_old, run.t, _SUBSTEP_SAMPLES + 2)[1:-1]
            inside = [time for time in looks if value(time) > 0.0]
            if not inside:
                # A contact without penetration ends at once. A sliding speed of the wrong sign, from drift in rolling
                # at a coarse tolerance, is about to change its sign.
                if i == 0:
                    zeros.append((float(run.t), i))
                continue
            left = inside[0]
        # The interpolant may miss the step's end by rounding.
        root = brentq(value, left, run.t, xtol=1e-17, rtol=1e-15) if value(run.t) < 0.0 else run.t
        zeros.append((float(root), i))
    return min(zeros) if zeros else None


def _sample(solution: Solution, run: Any, t: float) -> None:
    """Store the required states up to `t`, from the interpolant of the last step."""
    end = int(np.searchsorted(solution.times, t, side="right"))
    if end > solution.reached:
        solution.states[solution.reached : end] = run.dense_output()(solution.times[solution.reached : end]).T
        solution.reached = end


def _switch(solution: Solution, law: _Law, parameters: np.ndarray, t: float, y: np.ndarray, which: int) -> None:
    began = change_phase(t, y, parameters, which)
    solution.switches += 1
    if began:
        solution.onsets.append((t, float(parameters[0]["onset_speed"])))
    if law.plain is not None:
        law.plain.phase = int(parameters[0]["phase"])
        law.plain.onset_speed = float(parameters[0]["onset_speed"])
