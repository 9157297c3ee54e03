"""What a solver is asked and what it hands back."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from rig.kernels.signals import N_STATE

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


@dataclass(frozen=True)
class Solution:
    """One solve of one problem. A failure is a result like any other.

    Attributes:
        times: The problem's instants [s], shape (n,).
        states: States there, nan from where the solver failed, shape (n, 14).
        onsets: Time [s] and impact speed v0 [m/s] of each contact that began.
        contacts: How many began.
        switches: Changes of phase: onsets, lift-offs, those between sliding and rolling, and of heyoka the clamps.
        steps: Accepted steps; 0 where the library does not tell.
        evaluations: Of the right-hand side, with those for a Jacobian; of a Taylor series, its order times its steps.
        cpu_s: Processor time of the solve, without compilation [s].
        compile_s: What compiling took in this process before the first solve could start [s].
        failure: Why it failed, or None.
        phase: Phase of the contact at the end.
        onset_speed: v0 at the end [m/s].
        own_s: Processor time inside the library's own calls alone [s], where a Python loop of ours drives it: what is
            left if that loop cost nothing. None where there is no such loop, or where it costs as good as nothing.
    """

    times: np.ndarray
    states: np.ndarray
    onsets: tuple[tuple[float, float], ...]
    contacts: int
    switches: int
    steps: int
    evaluations: int
    cpu_s: float
    compile_s: float
    failure: str | None
    phase: int
    onset_speed: float
    own_s: float | None = None


@dataclass
class Journal:
    """A solve under way: what it has reached, and the clock that it must not overrun."""

    times: np.ndarray
    budget_s: float
    compile_s: float = 0.0
    states: np.ndarray = field(init=False)
    reached: int = 0
    onsets: list[tuple[float, float]] = field(default_factory=list)
    switches: int = 0
    steps: int = 0
    evaluations: int = 0
    phase: int = 0
    onset_speed: float = 0.0
    failure: str | None = None
    own_s: float | None = None
    _begin: float = field(default_factory=time.perf_counter)
    _cpu_begin: float = field(default_factory=time.thread_time)

    def __post_init__(self) -> None:
        self.states = np.full((len(self.times), N_STATE), np.nan)

    @property
    def deadline(self) -> float:
        """Instant of `time.perf_counter` at which the budget is spent."""
        return self._begin + self.budget_s

    def overrun(self) -> bool:
        """Whether a budget is spent; notes it as the failure."""
        if time.perf_counter() > self.deadline:
            self.failure = f"over the budget of {self.budget_s:g} s"
        elif self.steps > STEP_CEILING:
            self.failure = f"more than {STEP_CEILING} steps"
        elif self.switches > SWITCH_CEILING:
            self.failure = f"more than {SWITCH_CEILING} changes of phase"
        return self.failure is not None

    def close(self) -> Solution:
        """The solution as it stands."""
        cpu_s = time.thread_time() - self._cpu_begin
        if self.failure is None and not np.isfinite(self.states).all():
            self.failure = "the state is not finite"
        return Solution(
            times=self.times,
            states=self.states,
            onsets=tuple(self.onsets),
            contacts=len(self.onsets),
            switches=self.switches,
            steps=self.steps,
            evaluations=self.evaluations,
            cpu_s=cpu_s,
            compile_s=self.compile_s,
            failure=self.failure,
            phase=self.phase,
            onset_speed=self.onset_speed,
            own_s=self.own_s,
        )
