"""What a solver is asked and what it hands back."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from rig.physics.kernels.signals import N_STATE

MISSED_HAMMER = "missed the hammer: no step ended inside its pulse"
STEP_CEILING = 20_000_000
"""A solve that takes more steps than this has failed."""
SWITCH_CEILING = 100_000
"""The same for changes of phase: a solver that stalls at a switch must not run for ever."""


class Setting(NamedTuple):
    """One setting of a method: of a solver that somebody else wrote, or of an engine of ours."""

    label: str
    tolerance: float
    """Relative tolerance; for a solver of fixed step, its step [s]."""
    absolute: float | None = None
    """One absolute tolerance for all states; None for tolerance times `STATE_SCALE`."""
    step_us: int = 0
    """Step of an engine of ours, or the grid that its steps end on [µs]; 0 of other solvers."""


class Manner(NamedTuple):
    """How a library's solver is driven: the default is the proper way, the others are those known to fail or to lag."""

    plain: bool = False
    """The right-hand side in plain Python through the library's own interface, instead of the compiled one."""
    stops: bool = True
    """Whether it stops at the hammer's corners."""
    events: bool = True
    """Whether changes of phase are located; where not, the right-hand side itself asks for the gap's sign."""


PROPER = Manner()


@dataclass
class Solution:
    """One solve of one problem, under way or closed. A failure is a result like any other.

    Attributes:
        times: The problem's instants [s], shape (n,).
        budget_s: Wall time allowed [s].
        compile_s: What compiling took in this process before the first solve could start [s].
        states: States there, nan from where the solver failed, shape (n, 14).
        reached: How many of them are there, where a solver counts by it.
        onsets: Time [s] and impact speed v0 [m/s] of each contact that began.
        switches: Changes of phase: onsets, lift-offs, those between sliding and rolling, and of heyoka the clamps.
        steps: Accepted steps; 0 where the library does not tell.
        evaluations: Of the right-hand side, with those for a Jacobian; of a Taylor series, its order times its steps.
        failure: Why it failed, or None.
        own_s: Processor time inside the library's own calls alone [s], where a Python loop of ours drives it: what is
            left if that loop cost nothing. None where there is no such loop, or where it costs as good as nothing.
        cpu_s: Processor time of the solve, without compilation [s]; there when it is closed.
    """

    times: np.ndarray
    budget_s: float
    compile_s: float = 0.0
    states: np.ndarray = field(init=False)
    reached: int = 0
    onsets: list[tuple[float, float]] = field(default_factory=list)
    switches: int = 0
    steps: int = 0
    evaluations: int = 0
    failure: str | None = None
    own_s: float | None = None
    cpu_s: float = math.nan
    clock: Callable[[], float] = time.thread_time
    """Clock of processor time: of the calling thread, or of the process where a library has threads of its own."""
    _begin: float = field(default_factory=time.perf_counter)
    _cpu_begin: float = field(init=False)

    def __post_init__(self) -> None:
        self._cpu_begin = self.clock()
        self.states = np.full((len(self.times), N_STATE), np.nan)

    @property
    def contacts(self) -> int:
        """How many contacts began."""
        return len(self.onsets)

    def overrun(self) -> bool:
        """Whether a budget is spent; notes it as the failure."""
        if time.perf_counter() > self._begin + self.budget_s:
            self.failure = f"over the budget of {self.budget_s:g} s"
        elif self.steps > STEP_CEILING:
            self.failure = f"more than {STEP_CEILING} steps"
        elif self.switches > SWITCH_CEILING:
            self.failure = f"more than {SWITCH_CEILING} changes of phase"
        return self.failure is not None

    def close(self) -> Solution:
        """The same, with the time that it took."""
        self.cpu_s = self.clock() - self._cpu_begin
        if self.failure is None and not np.isfinite(self.states).all():
            self.failure = "the state is not finite"
        return self
