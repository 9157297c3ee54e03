"""One point of a chart: a method with one setting on one problem, timed and compared with the reference."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from replays.studies.chart.methods import Competitor
from replays.studies.common.run import Course
from replays.studies.peers import PEERS, Setting
from replays.studies.peers.common.problem import Problem, scaled_error
from replays.studies.peers.common.reference import Reference
from replays.studies.peers.common.solution import MISSED_HAMMER, Solution
from rig.physics.engines.common.memory import CONTACTS, EVALUATIONS, STEPS
from rig.physics.kernels.frames.geometry import gap
from rig.physics.kernels.laws.contact import normal_force
from rig.physics.kernels.signals import N_ROW, N_STATE
from rig.run.motion import energy_balance

BRANCH_ERROR = 0.5
"""Scaled error from which a run follows another branch of the motion: the error is as large as the motion."""
_CONTACT_TOLERANCE, _CONTACT_TOLERANCE_SHARE = 2, 0.2
"""Permitted error of a contact count: this number, or this share if larger."""
_MIN_TIMED_S = 0.12
"""Minimum total time of repeated short runs [s]."""
_MAX_REPEATS = 25
"""Largest number of repeated runs."""


class Budget(NamedTuple):
    """Time limits of a point."""

    solve_s: float
    """Wall time of one run [s]."""
    runs: int = 3
    single_s: float = np.inf
    """Run time [s] above which a run is not repeated."""


@dataclass
class Run:
    """Result of a method on a problem."""

    solution: Solution
    """Solution; its contacts of our engines are timed by frames and have no impact speed."""
    costs: list[float]
    """Processor time of each run [s]; other load on the machine does not count."""
    reached_s: float
    """Simulated time at the end [s]."""
    own_costs: list[float] = field(default_factory=list)
    """Processor time inside the library's own calls in the same runs [s], where a Python loop calls it."""
    energy_residual: float | None = None
    worst_frame_s: float | None = None

    @property
    def failure(self) -> str:
        """Kind of failure: "", nan, hammer, budget or error."""
        words = self.solution.failure or ""
        kinds = {
            "": not words,
            "hammer": words == MISSED_HAMMER,
            "budget": words.startswith(("over the budget", "more than")),
            "nan": "not finite" in words,
        }
        return next((kind for kind, holds in kinds.items() if holds), "error")


def run_engine(name: str, setting: Setting, problem: Problem, budget: Budget) -> Run:
    """Run one of our engines: frame by frame, then in single calls for timing."""
    times = problem.times
    frame_ticks = round((times[1] - times[0]) / problem.inputs.tick_s)
    if frame_ticks % setting.step_us:
        raise ValueError(f"frames must be multiples of {setting.step_us} us; received {frame_ticks} us")
    stride, n = frame_ticks // setting.step_us, len(times) - 1

    def begin() -> Course:
        return Course(
            name, problem.constants, problem.inputs, problem.y0, step=setting.step_us, tolerance=setting.tolerance
        )

    rows = np.full((n + 1, N_ROW), np.nan)
    clock = time.perf_counter()
    begin().advance(1, 1, rows[:1])
    compile_s = time.perf_counter() - clock
    frames = _time_frames(begin, rows, stride, budget)
    solution = Solution(times, budget.solve_s, compile_s, failure=frames.failure or None)
    solution.states[:] = rows[:, :N_STATE]
    solution.steps, solution.evaluations = (int(frames.course.memory[name]) for name in (STEPS, EVALUATIONS))
    began = np.repeat(times, np.diff(frames.counts, prepend=0.0).clip(0).astype(int))
    solution.onsets = [(time_s, np.nan) for time_s in began.tolist()]
    run = Run(solution, [frames.cpu_s], float(times[frames.reached]))
    if not run.failure:
        run.costs = _time_whole_runs(begin, n, stride, budget)
    if solution.close().failure is None:
        balance = energy_balance(rows, rows[0])
        run.energy_residual = float(np.max(np.abs(balance["residual"])) / max(float(balance["dissipated"][-1]), 1e-6))
        run.worst_frame_s = float(frames.best_s.max())
    return run


class _Frames(NamedTuple):
    """Last run of the window frame by frame."""

    course: Course
    counts: np.ndarray
    """Number of contacts up to each instant, shape (n + 1,)."""
    best_s: np.ndarray
    """Minimum wall time of each frame [s], shape (n,)."""
    cpu_s: float
    """Processor time [s]."""
    reached: int
    """Number of completed frames."""
    failure: str


def _time_frames(begin: Callable[[], Course], rows: np.ndarray, stride: int, budget: Budget) -> _Frames:
    """Run the window frame by frame, repeatedly if that is quick.

    Args:
        begin: Return a new course.
        rows: Out, one row per instant, nan after the time limit, shape (n + 1, N_ROW).
        stride: Steps per frame.
        budget: Time limits.
    """
    n = len(rows) - 1
    spent, counts, best = np.empty(n), np.zeros(n + 1), np.full(n, np.inf)
    course, cpu_s = begin(), 0.0
    for turn in range(budget.runs):
        course = begin()
        begun, begun_cpu = time.perf_counter(), time.thread_time()
        for i in range(n):
            before = time.perf_counter()
            course.advance(stride, stride, rows[i : i + 1])
            after = time.perf_counter()
            spent[i] = after - before
            counts[i + 1] = course.memory[CONTACTS]
            if after - begun > budget.solve_s:
                rows[i + 1 :], counts[i + 2 :] = np.nan, counts[i + 1]
                cpu_s = time.thread_time() - begun_cpu
                return _Frames(course, counts, best, cpu_s, i + 1, f"over the budget of {budget.solve_s:g} s")
        cpu_s = time.thread_time() - begun_cpu
        best = np.minimum(best, spent)
        if turn == 0 and spent.sum() > 0.1 * budget.solve_s:
            break
    course.look(rows[n:])
    return _Frames(course, counts, best, cpu_s, n, "")


def _time_whole_runs(begin: Callable[[], Course], frames: int, stride: int, budget: Budget) -> list[float]:
    """Return the processor time of the whole window in one call [s], repeated for short windows."""
    whole, costs = np.empty((frames, N_ROW)), []
    while len(costs) < budget.runs or (sum(costs) < _MIN_TIMED_S and len(costs) < _MAX_REPEATS):
        clock = time.thread_time()
        begin().advance(frames * stride, stride, whole)
        costs.append(time.thread_time() - clock)
        if costs[-1] > budget.single_s:
            break
    return costs


def run_peer(name: str, setting: Setting, problem: Problem, budget: Budget) -> Run:
    """Run a peer; a short first run does not count, as it may load libraries."""
    costs: list[float] = []
    own_costs: list[float] = []
    solution: Solution | None = None
    while solution is None or len(costs) < budget.runs:
        fresh = solution is None
        compile_s = 0.0 if solution is None else solution.compile_s
        solution = PEERS[name].solve(problem, setting, budget_s=budget.solve_s)
        solution.compile_s = max(compile_s, solution.compile_s)
        if not fresh or solution.failure is not None or solution.cpu_s > 0.2 or solution.cpu_s > budget.single_s:
            costs.append(solution.cpu_s)
            own_costs += [solution.own_s] if solution.own_s else []
        if solution.failure is not None or solution.cpu_s > budget.single_s:
            break
    good: np.ndarray = np.isfinite(solution.states.sum(axis=1))
    reached = len(good) if good.all() else int(np.argmin(good))
    return Run(solution, costs, float(problem.times[max(reached - 1, 0)]), own_costs)


def run_method(contender: Competitor, setting: Setting, problem: Problem, budget: Budget) -> Run:
    """Run a method."""
    return (run_engine if contender.ours else run_peer)(contender.name, setting, problem, budget)


def measure_point(
    contender: Competitor, setting: Setting, problem: Problem, reference: Reference, budget: Budget
) -> dict[str, Any]:
    """Measure a point with its error against the reference, as columns of the store."""
    run = run_method(contender, setting, problem, budget)
    contacts, expected = run.solution.contacts, reference.solution.contacts
    error = scaled_error(run.solution.states, reference.solution.states) if not run.failure else None
    failure, message = run.failure, run.solution.failure or ""
    if error is not None and error > BRANCH_ERROR:
        failure, message = "branch", f"scaled error {error:.2g}: another branch of the motion"
    elif error is not None and abs(contacts - expected) > max(_CONTACT_TOLERANCE, _CONTACT_TOLERANCE_SHARE * expected):
        failure, message = "contacts", f"{contacts} contacts instead of {expected}"
    return {
        **_cost(run, problem),
        "error": error,
        "reference": " / ".join(reference.names) + ("" if reference.independent else " (one right-hand side)"),
        "reference_error": reference.error,
        "contacts_reference": expected,
        "failure": failure,
        "message": message,
    }


STATISTICS = ("contact_fraction", "rms_force", "impacts_per_s")


def measure_statistics(
    contender: Competitor, setting: Setting, problem: Problem, budget: Budget, *, settle_s: float = 1.0
) -> dict[str, Any]:
    """Measure a point of chaotic motion: means over blocks of time, with 95 % bootstrap intervals."""
    run = run_method(contender, setting, problem, budget)
    columns: dict[str, Any] = {
        **_cost(run, problem),
        "failure": run.failure,
        "message": run.solution.failure or "",
    }
    if run.failure:
        return columns
    force = elastic_forces(problem, run.solution.states)
    onsets = np.array([time_s for time_s, _ in run.solution.onsets])
    for name, (mean, low, high) in block_statistics(problem.times, force, onsets, settle_s=settle_s).items():
        columns |= {name: mean, f"{name}_low": low, f"{name}_high": high}
    return columns


def elastic_forces(problem: Problem, states: np.ndarray) -> np.ndarray:
    """Return the elastic part of the normal force [N], shape (n,), which depends on the state alone.

    Args:
        problem: Problem.
        states: States, shape (n, 14).
    """
    contact = problem.constants.contact
    forces = np.zeros(len(states))
    for i, state in enumerate(states):
        depth = gap(problem.constants, state)[0]
        if depth > 0.0:
            forces[i] = normal_force(depth, 0.0, contact.speed_floor, contact)[1]
    return forces


def block_statistics(
    times: np.ndarray, force: np.ndarray, onsets: np.ndarray, *, settle_s: float, block_s: float = 0.5, draws: int = 400
) -> dict[str, tuple[float, float, float]]:
    """Return mean and 95 % interval of contact fraction, RMS force [N] and impacts per second, by a block bootstrap.

    Args:
        times: Instants [s], shape (n,).
        force: Normal force [N], shape (n,).
        onsets: Times of impact [s].
        settle_s: Excluded time at the start [s].
        block_s: Length of a block [s], long compared with the memory of the motion.
        draws: Number of bootstrap samples.
    """
    edges = np.arange(settle_s, times[-1] + 1e-9, block_s)
    n = len(edges) - 1
    if n < 2:
        raise ValueError("statistics need at least two blocks of time")
    which = np.searchsorted(edges, times, side="right") - 1
    inside = (which >= 0) & (which < n)
    size = np.bincount(which[inside], minlength=n)
    touching = np.bincount(which[inside], (force[inside] > 0.0).astype(float), minlength=n) / size
    square = np.bincount(which[inside], force[inside] ** 2, minlength=n) / size
    rate = np.histogram(onsets, edges)[0] / block_s
    picks = np.random.default_rng(0).integers(0, n, (draws, n))

    def interval(values: np.ndarray, *, root: bool = False) -> tuple[float, float, float]:
        means, mean = values[picks].mean(axis=1), values.mean()
        means, mean = (np.sqrt(means), np.sqrt(mean)) if root else (means, mean)
        low, high = np.quantile(means, (0.025, 0.975))
        return float(mean), float(low), float(high)

    return {
        "contact_fraction": interval(touching),
        "rms_force": interval(square, root=True),
        "impacts_per_s": interval(rate),
    }


def _cost(run: Run, problem: Problem) -> dict[str, Any]:
    costs = run.costs or [np.nan]
    cost = statistics.median(costs)
    return {
        "simulated_s": problem.duration_s,
        "runs": len(run.costs),
        "cpu_s": cost,
        "cpu_min_s": min(costs),
        "cpu_max_s": max(costs),
        "speed": run.reached_s / cost,
        "speed_min": run.reached_s / max(costs),
        "speed_max": run.reached_s / min(costs),
        "compile_s": run.solution.compile_s,
        "own_cpu_s": statistics.median(run.own_costs) if run.own_costs else None,
        "steps": run.solution.steps,
        "evaluations": run.solution.evaluations,
        "contacts": run.solution.contacts,
        "energy_residual": run.energy_residual,
        "worst_frame_ms": None if run.worst_frame_s is None else run.worst_frame_s * 1e3,
    }
