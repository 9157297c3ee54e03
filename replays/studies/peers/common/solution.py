"""Settings and solutions of the solvers."""

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
"""Number of steps above which a solve has failed."""
SWITCH_CEILING = 100_000
"""Number of phase changes above which a solve has failed: a solver that stalls at a switch must stop."""


class Setting(NamedTuple):
    """Setting of another author's solver or of one of our engines."""

    label: str
    tolerance: float
    """Relative tolerance; step [s] of a solver with fixed step."""
    absolute: float | None = None
    """Absolute tolerance of all states; None for tolerance times `STATE_SCALE`."""
    step_us: int = 0
    """Step of one of our engines, or grid on which its steps end [µs]; 0 for other solvers."""


class Manner(NamedTuple):
    """Mode of operation of a library's solver: the default is proper, the others are known to fail or to be slow."""

    plain: bool = False
    """Whether the right-hand side is plain Python, called through the library's own interface, instead of compiled."""
    stops: bool = True
    """Whether it stops at the corners of the hammer pulse."""
    events: bool = True
    """Whether changes of phase are located; otherwise the right-hand side uses the sign of the gap."""


DEFAULT = Manner()


@dataclass
class Solution:
    """Solution of a problem, in progress or closed. A failure is a result as any other.

    Attributes:
        times: The problem's instants [s], shape (n,).
        budget_s: Permitted wall time [s].
        compile_s: Compile time in this process before the first solve [s].
        states: States at these instants, nan after a failure, shape (n, 14).
        reached: Number of states written, for solvers that count them.
        onsets: Time [s] and impact speed v0 [m/s] of each contact.
        switches: Number of phase changes: onsets, lift-offs, changes between sliding and rolling, and heyoka's clamps.
        steps: Accepted steps; 0 if the library does not report them.
        evaluations: Evaluations of the right-hand side, including those for a Jacobian; order times steps for a Taylor
            series.
        failure: Reason for a failure, or None.
        own_s: Processor time inside the library's own calls alone [s], without our Python loop. None if there is no
            such loop, or if its cost is negligible.
        cpu_s: Processor time of the solve, without compilation [s]; set by `close`.
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
    """Clock of processor time: of the calling thread, or of the process for a library with threads."""
    _begin: float = field(default_factory=time.perf_counter)
    _cpu_begin: float = field(init=False)

    def __post_init__(self) -> None:
        self._cpu_begin = self.clock()
        self.states = np.full((len(self.times), N_STATE), np.nan)

    @property
    def contacts(self) -> int:
        """Number of contacts."""
        return len(self.onsets)

    def overrun(self) -> bool:
        """Return whether a limit is exceeded, and set the failure."""
        if time.perf_counter() > self._begin + self.budget_s:
            self.failure = f"over the budget of {self.budget_s:g} s"
        elif self.steps > STEP_CEILING:
            self.failure = f"more than {STEP_CEILING} steps"
        elif self.switches > SWITCH_CEILING:
            self.failure = f"more than {SWITCH_CEILING} changes of phase"
        return self.failure is not None

    def close(self) -> Solution:
        """Return the solution with its processor time."""
        self.cpu_s = self.clock() - self._cpu_begin
        if self.failure is None and not np.isfinite(self.states).all():
            self.failure = "the state is not finite"
        return self
