"""diffrax, on JAX: Dormand and Prince's 8(7) pair with a PI controller, on the equations of `taylor_equations`.

XLA compiles each phase with its events, which bisection on the step's interpolant locates. The Python loop from phase
to phase is that of heyoka (`replays.studies.peers.taylor`); the time inside the compiled phases is the solution's
`own_s`. Processor time is that of the process, as XLA uses its own threads.
"""

from __future__ import annotations

import functools
from importlib import import_module
from time import process_time as clock
from types import SimpleNamespace
from typing import Any

import numpy as np

from replays.studies.peers.common.problem import Problem
from replays.studies.peers.common.solution import Setting, Solution
from replays.studies.peers.taylor import CONTACT_SIGNALS, PhaseMethod, System, phase_events, solve_by_phases
from replays.studies.peers.taylor_equations import PARAMETERS, Kind, system_rates
from rig.physics.kernels.laws.magnet import RIPPLED

_SAMPLES_PER_CALL = 501
"""Number of samples per call: with arrays of one shape, each phase is compiled once."""
_MAX_STEPS_PER_CALL = 4_096
"""Largest number of steps per call."""
_FIRST_STEP_S = 1e-6
"""First step of a phase [s]: a function that starts at 0 within rounding shows its sign before it falls again."""
_EVENT_TOLERANCE = 1e-13
"""Tolerance of the time of an event, relative and in seconds."""


def _module(name: str) -> Any:
    """Import a module that may not be installed."""
    return import_module(name)


def solve(problem: Problem, *, setting: Setting, budget_s: float) -> Solution:
    """Solve a problem by diffrax.

    Args:
        problem: Problem.
        setting: Tolerance, relative and of the scaled states.
        budget_s: Permitted wall time [s].
    """
    jax = _module("jax")

    with jax.enable_x64(True):
        return solve_by_phases(problem, PhaseMethod(setting.tolerance, _system, _contact_function, clock), budget_s)


def _library(time_s: Any) -> Any:
    """Return the functions used by the equations."""
    jnp = _module("jax.numpy")

    def root(x: Any) -> Any:
        return jnp.sqrt(jnp.maximum(x, 0.0))  # a trial step may leave the contact

    return SimpleNamespace(sqrt=root, sin=jnp.sin, cos=jnp.cos, tanh=jnp.tanh, expression=float, time=time_s)


def evaluate(kind: Kind, time_s: Any, state: Any, pars: Any) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """Return rates, quantities for the events, and parameters by name."""
    jnp = _module("jax.numpy")

    numbers = dict(zip(PARAMETERS, pars, strict=True))
    rates, signals = system_rates(kind, list(state), numbers, _library(time_s))
    return jnp.stack([jnp.asarray(rate, float) for rate in rates]), signals, numbers


class _Phase:
    """Phase with heyoka's interface: `propagate_grid` ends at the grid's end or at an event."""

    order = 13
    """Stages of a step."""

    def __init__(self, kind: Kind, tolerance: float) -> None:
        self.time, self.state, self.pars = 0.0, np.full(14, 1e-2), np.ones(len(PARAMETERS))
        self._tolerance = tolerance
        self._solve, self.following = _compiled(kind)
        self._rates = _compiled_rates(kind)

    def reset_cooldowns(self) -> None:
        """Ignore the call: an event counts only where its function passes 0 in the right direction."""

    def propagate_grid(self, grid: np.ndarray, max_steps: int) -> tuple[int, None, None, int, None, np.ndarray]:
        """Integrate to the end of a grid or to an event, as heyoka does."""
        wanted = np.full(_SAMPLES_PER_CALL, grid[-1])
        wanted[: len(grid) - 1] = grid[1:]
        time_s, state, samples, which, steps = self._solve(
            self.time, grid[-1], wanted, self.state, self.pars, self._tolerance
        )
        self.time, self.state = float(time_s), np.array(state)
        kept = int(np.searchsorted(grid, self.time, side="right"))
        reached = np.concatenate([self.state[None], np.array(samples)])[: max(kept, 1)]
        return -1 - int(which), None, None, int(steps), None, reached

    def update_d_output(self, time_s: float) -> np.ndarray:
        """Return the state slightly after the end, by one step of the classical Runge-Kutta method."""
        h, y = time_s - self.time, self.state
        a = self._rates(self.time, y, self.pars)
        b = self._rates(self.time + 0.5 * h, y + 0.5 * h * a, self.pars)
        c = self._rates(self.time + 0.5 * h, y + 0.5 * h * b, self.pars)
        d = self._rates(self.time + h, y + h * c, self.pars)
        return np.array(y + h / 6.0 * (a + 2.0 * b + 2.0 * c + d))


@functools.cache
def _system(kind: Kind, tolerance: float) -> System:
    """Return one compiled phase."""
    if kind.terms == RIPPLED:
        raise NotImplementedError("diffrax does not support the map with ripples")
    phase = _Phase(kind, tolerance)
    phase.propagate_grid(np.array([0.0, 1e-9]), 1)
    return System(phase, phase.following)


@functools.cache
def _compiled_rates(kind: Kind) -> Any:
    jax = _module("jax")

    return jax.jit(lambda t, y, pars: evaluate(kind, t, y, pars)[0])


@functools.cache
def _compiled(kind: Kind) -> tuple[Any, tuple[int, ...]]:
    """Return the compiled solver of a phase over a span, and the phases that follow its events."""
    diffrax, jax, jnp, optimistix = _module("diffrax"), _module("jax"), _module("jax.numpy"), _module("optimistix")

    def rates(t: Any, y: Any, pars: Any) -> Any:
        return evaluate(kind, t, y, pars)[0]

    _, signals, numbers = evaluate(kind, 0.0, np.full(14, 1e-2), np.ones(len(PARAMETERS)))
    events = phase_events(kind, signals, numbers)

    def left(t: Any, y: Any, args: Any) -> Any:
        """Return the events' functions, each positive within the phase."""
        _, signals, numbers = evaluate(kind, t, y, args)
        return jnp.stack([-way * value for value, way, _ in phase_events(kind, signals, numbers)])

    # A single function, as diffrax's bracketing root finders support no more.
    event = diffrax.Event(
        lambda t, y, args, **_: jnp.min(left(t, y, args)),
        root_finder=optimistix.Bisection(rtol=_EVENT_TOLERANCE, atol=_EVENT_TOLERANCE, flip="detect"),
        direction=False,
    )

    def solve_span(begin: Any, end: Any, wanted: Any, y: Any, pars: Any, tolerance: Any) -> Any:
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(rates), diffrax.Dopri8(), begin, end, _FIRST_STEP_S, y, pars,
            saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=wanted), diffrax.SubSaveAt(t1=True)]),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance, pcoeff=0.3, icoeff=0.4),
            max_steps=_MAX_STEPS_PER_CALL, event=event, throw=False,
        )  # fmt: skip
        time_s, state = found.ts[1][0], found.ys[1][0]
        which = jnp.where(found.event_mask, jnp.argmin(left(time_s, state, pars)), len(events))
        return time_s, state, found.ys[0], which, found.stats["num_accepted_steps"]

    return jax.jit(solve_span), tuple(following for _, _, following in events)


@functools.cache
def _contact_function(kind: Kind) -> Any:
    """Return the function of a scaled state that `solve_by_phases` needs."""
    jax, jnp = _module("jax"), _module("jax.numpy")

    @jax.jit
    def look(state: Any, pars: Any, time: Any) -> Any:
        _, signals, _ = evaluate(kind, time, state, pars)
        return jnp.stack([jnp.asarray(signals[name], float) for name in CONTACT_SIGNALS])

    def contact_at(state: np.ndarray, pars: np.ndarray, time: float) -> np.ndarray:
        return np.array(look(state, pars, time))

    contact_at.nparams = len(PARAMETERS)  # pyrefly: ignore[missing-attribute]
    return contact_at
