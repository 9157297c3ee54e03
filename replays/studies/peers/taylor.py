"""heyoka's Taylor series on an independent formulation of the equations: a peer, and half of the charts' reference.

Phases: each is a separate smooth system with terminal events, so that the series never meets a corner. They are
flight; contact with smoothed friction or none, sliding forward, sliding backward, rolling; contact whose normal law
would pull (no force). Rolling is Filippov's: the friction force keeps v_t at 0, is linear in the accelerations, and
ends the phase at mu F_n.

Contact depth: delta^1.5 has a branch point at delta = 0, so a contact starts slightly inside. The flight's own series
continues past the onset to a depth h, and a contact ends at that depth too. The neglected impulse is K h^2.5 / (2.5
rate), twice per contact; h is chosen such that it changes a speed by `_MARGIN_SHARE` times the tolerance, in m/s.
Compared with a share of 1e-2, 1e-4 costs no time and is 1.5 to 9 times as accurate at tolerance 1e-3 over 48 scenes,
none of which ends on a wrong branch. (In the chart's hammer scene, 1e-2 happens to be better at tolerance 1e-4.) From
there the steps grow with the distance from the branch point, about 13 % per step. (Between h for 1 and for 1e-6 times
the tolerance, the first 0.1 s of the hammer scene differ by 1.4e-11 scaled at tolerance 1e-15, the level of rounding.)

Build options: `fast_math`, with the code unrolled as heyoka does by default. Measured in the same rounds on the chart's
1 s from impacts to whirl, tolerances 1e-3 to 1e-15: `fast_math` saves 7 to 19 % of the time and leaves every error
unchanged except for rounding (1.4e-11 at 1e-15); `slp_vectorize`, `force_avx512`, `high_accuracy` and less optimisation
change neither time nor error; `compact_mode` takes 1.4 to 1.9 times as long.

A Python loop leads from phase to phase: heyoka's package has no headers for a compiled loop, and its events can call
back only into Python. The time inside `propagate_grid` is the solution's `own_s`.

Not supported: a transducer that loses its preload. Samples with such a loss make the run a failure.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from replays.studies.peers.common.problem import Problem
from replays.studies.peers.common.solution import Setting, Solution
from replays.studies.peers.taylor_equations import (
    PARAMETERS,
    SLACK,
    Kind,
    equations,
    from_series,
    heyoka,
    parameter,
    parameter_values,
    system_kind,
    to_series,
)
from rig.physics.kernels.laws.contact import BACKWARD, FLIGHT, FORWARD, ROLLING, SWITCH, TOUCHING

_MARGIN_SHARE = 1e-4
"""Change of speed by the neglected impulse, over the tolerance [m/s]."""
_MIN_MARGIN_M = 1e-14
"""Minimum depth [m], well above the rounding of the gap."""
_SAMPLES_PER_CHECK = 500
"""Number of samples between two checks of the clock."""
_MAX_STEPS_PER_CHECK = 200_000
"""Largest number of steps between two checks of the clock."""


class System(NamedTuple):
    """Compiled system and the phases that follow its events. Every solve reuses the integrator."""

    integrator: Any
    following: tuple[int, ...]


class PhaseMethod(NamedTuple):
    """Integrators of a library for `solve_by_phases`."""

    tolerance: float
    make_system: Callable[[Kind, float], System]
    """Return the compiled system of a kind, with heyoka's interface."""
    make_contact: Callable[[Kind], Any]
    """Return the function of a state, `pars` and `time` that gives penetration, its rate, sliding speed, normal force
    and the friction force for rolling."""
    clock: Callable[[], float] = time.thread_time
    """Clock of processor time [s]."""


CONTACT_SIGNALS = ("depth", "rate", "sliding", "normal", "friction")
"""Signals that the function of a state returns, in this order."""
_SLIDING_STOP = -1
"""Marks an event at which sliding stops: rolling or sliding follows, depending on the required friction."""


def solve(problem: Problem, *, setting: Setting, budget_s: float) -> Solution:
    """Solve a problem by Taylor series.

    Args:
        problem: Problem.
        setting: Tolerance; an absolute one has no effect.
        budget_s: Permitted wall time [s].
    """
    return solve_by_phases(problem, PhaseMethod(setting.tolerance, _system, _contact_function), budget_s)


def solve_by_phases(problem: Problem, method: PhaseMethod, budget_s: float) -> Solution:
    """Solve a problem phase by phase, each a separate smooth system.

    Args:
        problem: Problem.
        method: Integrators.
        budget_s: Permitted wall time [s].
    """
    _check(problem)
    # All systems of this problem are compiled before the clock starts.
    begin = time.perf_counter()
    touching = (FORWARD, BACKWARD, ROLLING) if problem.exact_friction else (TOUCHING,)
    first = system_kind(problem, FLIGHT, pulse_on=False)
    for phase in (FLIGHT, *touching, *((SLACK,) if first.damped or first.viscous else ())):
        for pulse_on in {False, problem.pulse is not None}:
            method.make_system(system_kind(problem, phase, pulse_on=pulse_on), method.tolerance)
            method.make_contact(system_kind(problem, ROLLING, pulse_on=pulse_on))
    solution = Solution(problem.times, budget_s, time.perf_counter() - begin, clock=method.clock)
    _run(problem, method, solution)
    house = problem.constants.house
    for stretch, stiffness in (
        (solution.states[:, 4] - solution.states[:, 6], house.pair_stiffness_vertical),
        (solution.states[:, 5], house.pair_stiffness_horizontal),
    ):
        if solution.failure is None and np.max(np.abs(stretch)) * 0.5 * stiffness > house.preload:
            solution.failure = "a transducer loses its preload, which the series does not model"
    return solution.close()


def _check(problem: Problem) -> None:
    levels = problem.constants.levels
    if not (levels.euler and levels.inner_house and levels.outer_house and levels.compliant):
        raise NotImplementedError("the series supports only the full model with a compliant contact")
    if levels.friction == SWITCH:
        raise NotImplementedError("the series does not support switch friction")


def _run(problem: Problem, method: PhaseMethod, solution: Solution) -> None:
    """Solve phase after phase until the end, into the solution."""
    numbers = parameter_values(problem)
    values = np.array([numbers[name] for name in PARAMETERS])
    margin_at, speed_at = PARAMETERS.index("margin"), PARAMETERS.index("v0")

    @functools.cache
    def system_of(phase: int, pulse_on: bool) -> System:
        return method.make_system(system_kind(problem, phase, pulse_on=pulse_on), method.tolerance)

    @functools.cache
    def contact_of(pulse_on: bool) -> Any:
        return method.make_contact(system_kind(problem, ROLLING, pulse_on=pulse_on))

    def look(time_s: float, state: np.ndarray) -> list[float]:
        contact_at = contact_of(pulse_on)
        return contact_at(state, pars=values[: contact_at.nparams], time=time_s).tolist()

    times, pulse = problem.times, problem.pulse
    corners = [*problem.corners, problem.duration_s]
    phase, t = problem.phase, 0.0
    state = to_series(problem.y0, ideal_drive=problem.inputs.ideal_drive)
    samples = np.full((len(times), 14), np.nan)
    samples[0] = state
    pulse_on, own_s = False, 0.0
    values[speed_at] = problem.onset_speed
    values[margin_at] = _margin(problem, problem.onset_speed, method.tolerance)
    while corners and not solution.overrun():
        pulse_on = pulse is not None and pulse[0] <= t < pulse[1]
        system = system_of(phase, pulse_on)
        series = system.integrator
        series.time = t
        series.state[:] = state
        # heyoka has room up to the last parameter of this system.
        series.pars[:] = values[: len(series.pars)]
        series.reset_cooldowns()
        first = int(np.searchsorted(times, t, side="right"))
        wanted = times[first : first + _SAMPLES_PER_CHECK]
        wanted = wanted[wanted < corners[0]]
        goal = corners[0] if len(wanted) < _SAMPLES_PER_CHECK else float(wanted[-1])
        grid = np.concatenate(([t], wanted[wanted < goal], [goal]))
        begin = solution.clock()
        outcome, _, _, steps, _, reached = series.propagate_grid(grid, max_steps=_MAX_STEPS_PER_CHECK)
        own_s += solution.clock() - begin
        solution.steps += int(steps)
        solution.evaluations += int(steps) * series.order
        # The goal itself is a sample only if it is required.
        kept = reached[1:][: len(times) - first]
        kept = kept[: int(np.searchsorted(times[first:], grid[len(reached) - 1], side="right"))]
        samples[first : first + len(kept)] = kept
        t, state = float(series.time), series.state.copy()
        number = -int(outcome) - 1
        if not np.isfinite(state).all():
            solution.failure = f"the series failed at {t:.9g} s"
        elif 0 <= number < len(system.following):
            solution.switches += 1
            following = system.following[number]
            depth, rate, sliding, _, _ = look(t, state)
            if phase == FLIGHT:
                speed = max(rate, problem.constants.contact.speed_floor)
                solution.onsets.append((t, speed))
                values[speed_at] = speed
                values[margin_at] = margin = _margin(problem, max(rate, 1e-9), method.tolerance)
                beyond = t + margin / max(rate, 1e-9)
                for i in range(*np.searchsorted(times, (t, beyond), side="right")):
                    samples[i] = series.update_d_output(times[i])
                t = beyond
                state = series.update_d_output(t).copy()
                depth, _, sliding, _, _ = look(t, state)
                following = FLIGHT if depth <= 0.0 else following
            if following == FORWARD and phase in (FLIGHT, SLACK):
                following = _SLIDING_STOP if sliding == 0.0 else FORWARD if sliding > 0.0 else BACKWARD
            if following == _SLIDING_STOP:
                _, _, _, normal, needed = look(t, state)
                following = FORWARD if needed > 0.0 else BACKWARD
                if normal <= 0.0 and phase != SLACK:
                    following = SLACK  # sliding and force end at the same time
                elif abs(needed) <= numbers["mu"] * max(normal, 0.0):
                    following = ROLLING
            phase = following
        if t >= corners[0]:
            corners.pop(0)
    solution.own_s = own_s
    solution.states = from_series(samples, ideal_drive=problem.inputs.ideal_drive)


def _margin(problem: Problem, rate: float, tolerance: float) -> float:
    """Return the depth [m] up to which a contact's force is neglected."""
    shaft, contact = problem.constants.shaft, problem.constants.contact
    mass = 1.0 / (shaft.arm_ring**2 / shaft.transverse_inertia + 1.0 / problem.constants.house.inner_mass)
    change = _MARGIN_SHARE * tolerance
    n = contact.exponent + 1.0
    depth = (n * mass * rate * change / contact.stiffness) ** (1.0 / n)
    if contact.viscous_damping > 0.0:
        # With D, the impulse D h is neglected as well.
        depth = min(depth, mass * change / contact.viscous_damping)
    return max(depth, _MIN_MARGIN_M)


def phase_events(kind: Kind, signals: dict[str, Any], p: dict[str, Any]) -> list[tuple[Any, int, int]]:
    """Return the functions that end a phase at a zero, the sign of their slope there, and the next phase."""
    sliding = FORWARD if kind.exact else TOUCHING
    # The square of the gap, if the gap is not part of the motion: heyoka chooses its step for the motion's series, not
    # for an event's, and the root has branch points where the shaft passes the ring's centre.
    inside = signals["square"] - (p["r0"] + (p["margin"] if kind.phase != FLIGHT else 0.0)) ** 2.0
    if kind.phase == FLIGHT:
        return [(inside, 1, sliding)]
    events = [(inside if kind.phase == SLACK else signals["depth"] - p["margin"], -1, FLIGHT)]
    if kind.damped or kind.viscous:
        events.append((signals["pull"], 1, sliding) if kind.phase == SLACK else (signals["pull"], -1, SLACK))
    if kind.phase in (FORWARD, BACKWARD):
        events.append((signals["sliding"], -1 if kind.phase == FORWARD else 1, _SLIDING_STOP))
    elif kind.phase == ROLLING:
        events.append((p["mu"] * signals["normal"] - signals["friction"], -1, FORWARD))
        events.append((p["mu"] * signals["normal"] + signals["friction"], -1, BACKWARD))
    return events


@functools.cache
def _system(kind: Kind, tolerance: float) -> System:
    """Compile one phase."""
    hy = heyoka()
    variables, rates, signals = equations(kind)
    events = phase_events(kind, signals, {name: parameter(name) for name in PARAMETERS})
    ways = {-1: hy.event_direction.negative, 1: hy.event_direction.positive}
    integrator = hy.taylor_adaptive(
        sys=list(zip(variables, rates, strict=True)),
        state=np.zeros(14),
        tol=tolerance,
        t_events=[hy.t_event(function, direction=ways[way]) for function, way, _ in events],
        fast_math=True,
    )
    return System(integrator, tuple(following for _, _, following in events))


@functools.cache
def _contact_function(kind: Kind) -> Any:
    """Return the function of a scaled state that `solve_by_phases` needs."""
    hy = heyoka()
    variables, _, signals = equations(kind)
    return hy.cfunc([signals[name] for name in CONTACT_SIGNALS], vars=list(variables))
