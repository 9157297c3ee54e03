"""heyoka's Taylor series on the rig's equations, written down anew: a peer, and half of the charts' reference.

Phases. Each is a smooth system of its own with terminal events, so that the series never meets a corner: flight;
contact with smoothed friction or none, sliding forward, sliding backward, rolling; contact whose normal law asks for
tension (no force). Rolling is Filippov's: the friction force is what keeps v_t at 0, linear in the accelerations, and
ends where it reaches mu F_n.

The root at the rim. delta^1.5 has a branch point at delta = 0, so a contact starts slightly inside: the flight's own
series is carried on past the onset to a depth h, and a contact ends at that depth too. What is left out is the impulse
K h^2.5 / (2.5 rate) twice a contact; h is chosen for it to change a speed by `_MARGIN` times the tolerance, in m/s.
Against 1e-2, 1e-4 costs nothing and is 1.5 to 9 times as exact at tolerance 1e-3, over 48 scenes, of which none ends on
a wrong branch any more. (In the chart's own hammer scene chance favours 1e-2 at tolerance 1e-4.) From there the steps
grow with the distance from the branch point, about 13 % a step. (Between h for 1 and for 1e-6 times the tolerance, the
first 0.1 s of the hammer scene move by 1.4e-11 scaled at tolerance 1e-15: the noise of rounding.)

Its best build: `fast_math`, with the code unrolled as heyoka has it by default. Measured in the same rounds on the
chart's 1 s from impacts to whirl, tolerances 1e-3 to 1e-15: `fast_math` takes 7 to 19 % off and leaves every error as
it was, but for rounding (1.4e-11 at 1e-15); `slp_vectorize`, `force_avx512`, `high_accuracy` and less optimisation
change neither time nor error; `compact_mode` takes 1.4 to 1.9 times as long.

One phase follows another in a Python loop: its package has no headers that a compiled one could be built with, and its
events can call back into Python alone. What is spent inside `propagate_grid` is told as the solution's `own_s`.

Left out: a transducer that loses its preload. Samples that show it make the run a failure.
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
    kind_of,
    numbers_of,
    parameter,
    to_series,
)
from rig.physics.kernels.laws.contact import BACKWARD, FLIGHT, FORWARD, ROLLING, SWITCH, TOUCHING

_MARGIN = 1e-4
_LEAST_MARGIN = 1e-14
"""[m], well above the rounding of the gap."""
_CHUNK = 500
"""Samples between two looks at the clock."""
_STEPS = 200_000
"""Steps between two of them."""


class System(NamedTuple):
    """A compiled system and what its events lead to. The integrator is used again by every solve."""

    integrator: Any
    following: tuple[int, ...]


_REST = -1
"""What follows where sliding stops: rolling, or sliding on, as the friction needed there says."""


def solve(problem: Problem, *, setting: Setting, budget_s: float) -> Solution:
    """Solve a problem by Taylor series.

    Args:
        problem: The problem.
        setting: Tolerance; an absolute one has no meaning here.
        budget_s: Wall time allowed [s].
    """
    return solve_by_phases(problem, setting.tolerance, budget_s, _system, _contact_function)


def solve_by_phases(
    problem: Problem,
    tolerance: float,
    budget_s: float,
    make_system: Callable[[Kind, float], System],
    make_contact: Callable[[Kind], Any],
    clock: Callable[[], float] = time.thread_time,
) -> Solution:
    """Solve a problem phase by phase, each a smooth system of its own.

    Args:
        problem: The problem.
        tolerance: Of the integrators.
        budget_s: Wall time allowed [s].
        make_system: Makes the integrator of a kind of system, with heyoka's interface, and what its events lead to.
        make_contact: Makes the function of a state, `pars` and `time` that gives penetration, its rate, sliding speed,
            normal force and the friction that rolling needs.
        clock: Of processor time [s].
    """
    _check(problem)
    # Whatever this problem may meet is compiled before the clock starts.
    begin = time.perf_counter()
    touching = (FORWARD, BACKWARD, ROLLING) if problem.exact_friction else (TOUCHING,)
    first = kind_of(problem, FLIGHT, hit=False)
    for phase in (FLIGHT, *touching, *((SLACK,) if first.damped or first.viscous else ())):
        for hit in {False, problem.pulse is not None}:
            make_system(kind_of(problem, phase, hit=hit), tolerance)
            make_contact(kind_of(problem, ROLLING, hit=hit))
    solution = Solution(problem.times, budget_s, time.perf_counter() - begin, clock=clock)
    _run(problem, tolerance, solution, make_system, make_contact)
    house = problem.constants.house
    for stretch, stiffness in (
        (solution.states[:, 4] - solution.states[:, 6], house.pair_stiffness_vertical),
        (solution.states[:, 5], house.pair_stiffness_horizontal),
    ):
        if solution.failure is None and np.max(np.abs(stretch)) * 0.5 * stiffness > house.preload:
            solution.failure = "a transducer loses its preload, which the series leaves out"
    return solution.close()


def _check(problem: Problem) -> None:
    levels = problem.constants.levels
    if not (levels.euler and levels.inner_house and levels.outer_house and levels.compliant):
        raise NotImplementedError("the series has the full model only, with a compliant contact")
    if levels.friction == SWITCH:
        raise NotImplementedError("the series has no switch friction")


def _run(
    problem: Problem,
    tolerance: float,
    solution: Solution,
    make_system: Callable[[Kind, float], System],
    make_contact: Callable[[Kind], Any],
) -> None:
    """Go from phase to phase until the end, into the solution."""
    numbers = numbers_of(problem)
    values = np.array([numbers[name] for name in PARAMETERS])
    margin_at, speed_at = PARAMETERS.index("margin"), PARAMETERS.index("v0")

    @functools.cache
    def system_of(phase: int, hit: bool) -> System:
        return make_system(kind_of(problem, phase, hit=hit), tolerance)

    @functools.cache
    def contact_of(hit: bool) -> Any:
        return make_contact(kind_of(problem, ROLLING, hit=hit))

    def look(time_s: float, state: np.ndarray) -> list[float]:
        contact_at = contact_of(hit)
        return contact_at(state, pars=values[: contact_at.nparams], time=time_s).tolist()

    times, pulse = problem.times, problem.pulse
    corners = [*problem.corners, problem.duration_s]
    phase, t = problem.phase, 0.0
    state = to_series(problem.y0, ideal_drive=problem.inputs.ideal_drive)
    samples = np.full((len(times), 14), np.nan)
    samples[0] = state
    hit, own_s = False, 0.0
    values[speed_at] = problem.onset_speed
    values[margin_at] = _margin(problem, problem.onset_speed, tolerance)
    while corners and not solution.overrun():
        hit = pulse is not None and pulse[0] <= t < pulse[1]
        system = system_of(phase, hit)
        series = system.integrator
        series.time = t
        series.state[:] = state
        # heyoka makes room up to the last parameter that this system has.
        series.pars[:] = values[: len(series.pars)]
        series.reset_cooldowns()
        first = int(np.searchsorted(times, t, side="right"))
        wanted = times[first : first + _CHUNK]
        wanted = wanted[wanted < corners[0]]
        goal = corners[0] if len(wanted) < _CHUNK else float(wanted[-1])
        grid = np.concatenate(([t], wanted[wanted < goal], [goal]))
        begin = solution.clock()
        outcome, _, _, steps, _, reached = series.propagate_grid(grid, max_steps=_STEPS)
        own_s += solution.clock() - begin
        solution.steps += int(steps)
        solution.evaluations += int(steps) * series.order
        # The goal itself is a sample only where it is wanted.
        kept = reached[1:][: len(times) - first]
        kept = kept[: int(np.searchsorted(times[first:], grid[len(reached) - 1], side="right"))]
        samples[first : first + len(kept)] = kept
        t, state = float(series.time), series.state.copy()
        number = -int(outcome) - 1
        if not np.isfinite(state).all():
            solution.failure = f"the series broke down at {t:.9g} s"
        elif 0 <= number < len(system.following):
            solution.switches += 1
            following = system.following[number]
            depth, rate, sliding, _, _ = look(t, state)
            if phase == FLIGHT:
                speed = max(rate, problem.constants.contact.speed_floor)
                solution.onsets.append((t, speed))
                values[speed_at] = speed
                values[margin_at] = margin = _margin(problem, max(rate, 1e-9), tolerance)
                beyond = t + margin / max(rate, 1e-9)
                for i in range(*np.searchsorted(times, (t, beyond), side="right")):
                    samples[i] = series.update_d_output(times[i])
                t = beyond
                state = series.update_d_output(t).copy()
                depth, _, sliding, _, _ = look(t, state)
                following = FLIGHT if depth <= 0.0 else following
            if following == FORWARD and phase in (FLIGHT, SLACK):
                following = _REST if sliding == 0.0 else FORWARD if sliding > 0.0 else BACKWARD
            if following == _REST:
                _, _, _, normal, needed = look(t, state)
                following = FORWARD if needed > 0.0 else BACKWARD
                if normal <= 0.0 and phase != SLACK:
                    following = SLACK  # both end at once where there is no sliding and no force
                elif abs(needed) <= numbers["mu"] * max(normal, 0.0):
                    following = ROLLING
            phase = following
        if t >= corners[0]:
            corners.pop(0)
    solution.own_s = own_s
    solution.states = from_series(samples, ideal_drive=problem.inputs.ideal_drive)


def _margin(problem: Problem, rate: float, tolerance: float) -> float:
    """Depth [m] up to which a contact's force is left out."""
    shaft, contact = problem.constants.shaft, problem.constants.contact
    mass = 1.0 / (shaft.arm_ring**2 / shaft.transverse_inertia + 1.0 / problem.constants.house.inner_mass)
    change = _MARGIN * tolerance
    n = contact.exponent + 1.0
    depth = (n * mass * rate * change / contact.stiffness) ** (1.0 / n)
    if contact.viscous_damping > 0.0:
        # A force that is there at once leaves out the impulse D h as well.
        depth = min(depth, mass * change / contact.viscous_damping)
    return max(depth, _LEAST_MARGIN)


def events_of(kind: Kind, seen: dict[str, Any], p: dict[str, Any]) -> list[tuple[Any, int, int]]:
    """Functions that end a phase where they pass 0, the sign of their slope there, and the phase that follows."""
    sliding = FORWARD if kind.exact else TOUCHING
    # The gap by its square where it is no part of the motion: heyoka's step suits the motion's series, not that of an
    # event, and the root has branch points where the shaft passes the ring's middle.
    inside = seen["square"] - (p["r0"] + (p["margin"] if kind.phase != FLIGHT else 0.0)) ** 2.0
    if kind.phase == FLIGHT:
        return [(inside, 1, sliding)]
    events = [(inside if kind.phase == SLACK else seen["depth"] - p["margin"], -1, FLIGHT)]
    if kind.damped or kind.viscous:
        events.append((seen["pull"], 1, sliding) if kind.phase == SLACK else (seen["pull"], -1, SLACK))
    if kind.phase in (FORWARD, BACKWARD):
        events.append((seen["sliding"], -1 if kind.phase == FORWARD else 1, _REST))
    elif kind.phase == ROLLING:
        events.append((p["mu"] * seen["normal"] - seen["friction"], -1, FORWARD))
        events.append((p["mu"] * seen["normal"] + seen["friction"], -1, BACKWARD))
    return events


@functools.cache
def _system(kind: Kind, tolerance: float) -> System:
    """Compile one phase."""
    hy = heyoka()
    variables, rates, seen = equations(kind)
    events = events_of(kind, seen, {name: parameter(name) for name in PARAMETERS})
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
    """Penetration, its rate, sliding speed, normal force, and the friction that rolling needs, of a scaled state."""
    hy = heyoka()
    variables, _, seen = equations(kind)
    return hy.cfunc([seen[name] for name in ("depth", "rate", "sliding", "normal", "friction")], vars=list(variables))
