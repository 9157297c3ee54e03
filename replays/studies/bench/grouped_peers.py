"""Peers that advance many runs at once: heyoka's batch mode and a vmap of diffrax.

Both integrate one system of equations for all runs of a call, whereas each run of an ensemble is in a phase of its own.
Every run therefore follows the loop of `replays.studies.peers.taylor` in its own thread, with the same events, and its
calls are collected: the phase for which most runs wait is integrated next, each of its runs to its own event or goal.
A lane of heyoka whose run has reached it takes the next run; a call of diffrax lasts as long as its longest run.
"""

from __future__ import annotations

import functools
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from replays.studies.peers import Problem, taylor
from replays.studies.peers import diffrax_solver as diffrax
from replays.studies.peers.taylor_equations import PARAMETERS, Kind, equations, heyoka, parameter

GROUP = 32
"""Runs of a vmap; a smaller group is filled with copies."""


class GroupMethod(NamedTuple):
    """Integrators of a library for many runs."""

    advance: Callable[[Kind, float, list[_Call]], tuple[list[_Call], float]]
    """Integrate waiting runs of a phase; return those that have reached their event or goal, which leave the list, and
    the processor time inside the library [s]."""
    following: Callable[[Kind, float], tuple[int, ...]]
    """Compile a phase, and return the phases that follow its events."""
    rates: Callable[[Kind], Callable[..., Any]]
    """Return the function of time, state and parameters that gives the rates."""
    make_contact: Callable[[Kind], Any]
    """Values as in `taylor.PhaseMethod`."""


class _Call(diffrax._Phase):
    """Phase of one run, with heyoka's interface, whose integration waits for others."""

    def __init__(self, kind: Kind, method: GroupMethod, park: Callable[[_Call], None]) -> None:
        self.time, self.state, self.pars = 0.0, np.full(14, 1e-2), np.ones(len(PARAMETERS))
        self.kind, self.goal, self.event = kind, 0.0, 0
        self.ready = threading.Semaphore(0)
        self._rates, self._park = method.rates(kind), park

    def propagate_grid(self, grid: np.ndarray, max_steps: int) -> tuple[int, None, None, int, None, np.ndarray]:
        """Wait until this run has been integrated to the end of the grid or to an event."""
        begin, self.goal = self.state.copy(), float(grid[-1])
        self._park(self)
        self.ready.acquire()
        reached = [begin, self.state] if self.time >= self.goal else [begin]
        return -1 - self.event, None, None, 0, None, np.array(reached)


def solve_together(problems: list[Problem], method: GroupMethod, tolerance: float) -> tuple[np.ndarray, float]:
    """Solve problems whose only required state is the last.

    Returns:
        Last states, shape (n, 14), NaN after a failure; processor time inside the library [s].
    """
    ends = np.full((len(problems), 14), np.nan)
    waiting: dict[Kind, list[_Call]] = defaultdict(list)
    compiling = threading.Lock()
    change, parked, running, inside_s = threading.Condition(), 0, len(problems), 0.0

    def park(call: _Call) -> None:
        nonlocal parked
        with change:
            waiting[call.kind].append(call)
            parked += 1
            change.notify()

    def make_system(kind: Kind, tolerance: float) -> taylor.System:
        with compiling:
            return taylor.System(_Call(kind, method, park), method.following(kind, tolerance))

    def make_contact(kind: Kind) -> Any:
        with compiling:
            return method.make_contact(kind)

    def run(number: int) -> None:
        nonlocal running
        try:
            phases = taylor.PhaseMethod(tolerance, make_system, make_contact)
            solution = taylor.solve_by_phases(problems[number], phases, 3600.0)
            if solution.failure is None:
                ends[number] = solution.states[-1]
        finally:
            with change:
                running -= 1
                change.notify()

    def all_parked() -> bool:
        return parked == running

    threads = [threading.Thread(target=run, args=(number,), daemon=True) for number in range(len(problems))]
    for thread in threads:
        thread.start()
    while True:
        with change:
            change.wait_for(all_parked)
            if not running:
                return ends, inside_s
        kind = max(waiting, key=lambda kind: len(waiting[kind]))
        done, spent_s = method.advance(kind, tolerance, waiting[kind])
        inside_s += spent_s
        parked -= len(done)
        for call in done:
            call.ready.release()


@functools.cache
def _batch_system(kind: Kind, tolerance: float) -> tuple[Any, tuple[int, ...]]:
    """Return heyoka's integrator of a phase for a register's number of runs, and the phases that follow its events."""
    hy = heyoka()
    variables, rates, signals = equations(kind)
    events = taylor.phase_events(kind, signals, {name: parameter(name) for name in PARAMETERS})
    ways = {-1: hy.event_direction.negative, 1: hy.event_direction.positive}
    series = hy.taylor_adaptive_batch(
        sys=list(zip(variables, rates, strict=True)),
        state=np.full((14, hy.recommended_simd_size()), 1e-2),
        tol=tolerance,
        t_events=[hy.t_event_batch(function, direction=ways[way]) for function, way, _ in events],
        fast_math=True,
    )
    return series, tuple(following for _, _, following in events)


def _advance_batch(kind: Kind, tolerance: float, calls: list[_Call]) -> tuple[list[_Call], float]:
    """Integrate in the lanes of heyoka's batch mode, until one run is done, none waits and half of the lanes are idle.

    Runs that are not done remain in `calls`.
    """
    series, done, spent_s = _batch_system(kind, tolerance)[0], [], 0.0
    width, state, pars = series.batch_size, series.state, series.pars
    ongoing = int(heyoka().taylor_outcome.success)
    lanes: list[_Call | None] = [None] * width
    times, goals = np.zeros(width), np.zeros(width)
    state[:], pars[:] = calls[-1].state[:, None], calls[-1].pars[: len(pars), None]  # an idle lane must be finite, too
    while True:
        for i, call in enumerate(lanes):
            if call is None and calls:
                lanes[i] = call = calls.pop()
                times[i] = call.time
                series.set_time(times)
                state[:, i], pars[:, i] = call.state, call.pars[: len(pars)]
                series.reset_cooldowns(i)
            goals[i] = times[i] if call is None else call.goal
        if done and width - lanes.count(None) <= width // 2:
            break
        begin = time.thread_time()
        series.propagate_until(goals)  # until one of them reaches an event, or all their goal
        spent_s += time.thread_time() - begin
        times[:] = series.time
        for i, (outcome, *_) in enumerate(series.propagate_res):
            call = lanes[i]
            if call is not None and int(outcome) != ongoing:
                call.event = -int(outcome) - 1
                call.time = call.goal if outcome == heyoka().taylor_outcome.time_limit else float(times[i])
                call.state = state[:, i].copy()
                done.append(call)
                lanes[i] = None
    for i, call in enumerate(lanes):
        if call is not None:
            call.time, call.state = float(times[i]), state[:, i].copy()
            calls.append(call)
    return done, spent_s


@functools.cache
def _batch_rates(kind: Kind) -> Callable[..., Any]:
    variables, rates, _ = equations(kind)
    function = heyoka().cfunc(rates, vars=variables)
    return lambda time_s, state, pars: function(state, pars=pars[: function.nparams], time=time_s)


@functools.cache
def _vmapped(kind: Kind) -> Any:
    jax = import_module("jax")
    return jax.jit(jax.vmap(diffrax._compiled(kind)[0], in_axes=(0, 0, 0, 0, 0, None)))


def _advance_vmap(kind: Kind, tolerance: float, calls: list[_Call]) -> tuple[list[_Call], float]:
    """Integrate a group of runs by a vmap of diffrax, each to its event or goal."""
    done = [calls.pop() for _ in range(min(GROUP, len(calls)))]
    rows = [*done, *[done[0]] * (GROUP - len(done))]
    goals = np.array([call.goal for call in rows])
    starts, states, pars = (np.array([getattr(call, name) for call in rows]) for name in ("time", "state", "pars"))
    begin = time.process_time()  # of all threads of XLA
    found = _vmapped(kind)(starts, goals, goals[:, None], states, pars, tolerance)
    results = [np.array(found[n]) for n in (0, 1, 3)]
    spent_s = time.process_time() - begin
    for call, time_s, state, which in zip(done, *results, strict=False):
        call.time, call.state, call.event = float(time_s), state, int(which)
    return done, spent_s


HEYOKA_BATCH = GroupMethod(
    _advance_batch, lambda kind, tolerance: _batch_system(kind, tolerance)[1], _batch_rates, taylor._contact_function
)
DIFFRAX_VMAP = GroupMethod(
    _advance_vmap, lambda kind, _: diffrax._compiled(kind)[1], diffrax._compiled_rates, diffrax._contact_function
)
