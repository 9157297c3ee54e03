"""Benchmark of ensembles: many hammer runs by the batch kernel, the default engine and peers, with errors.

Every method has the same runs, of which slow ones take the first. Speed is simulated time over processor time, without
compilation and output rows. The error of a run is that of its last state.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from replays.studies.bench.engines import ENGINE_ONLY
from replays.studies.bench.grouped_peers import DIFFRAX_VMAP, HEYOKA_BATCH, GroupMethod, solve_together
from replays.studies.common import provenance
from replays.studies.common.run import run_scene
from replays.studies.peers import ERROR_COLUMNS, ERROR_SCALE, PEERS, Problem, Setting
from replays.studies.peers.common.window import cut_window
from replays.studies.peers.taylor_equations import SERIES_SCALE, from_series
from rig.ensemble.batch import TOLERANCE, Batch
from rig.ensemble.keys import vary
from rig.physics.kernels.signals import N_STATE
from rig.run.scenes import Scene, load_scene
from rig.run.simulation import Simulation

KEYS = ("contact.friction", "hammer.force_n")
LOWEST, HIGHEST = (0.05, 20.0), (0.4, 200.0)
DURATION_S = 0.25
ERROR_GOAL, SPEED_GOAL, THREADS_GOAL = 1e-4, 200.0, 1.9
"""Median error, times real time and gain of a second thread wanted of the batch kernel."""
PEER_RUNS, VMAP_RUNS = 256, 32
"""Runs of the methods that are slower than the batch kernel, and of the slowest."""
_SCENE = {
    **ENGINE_ONLY, "engine.companion": False, "duration_s": DURATION_S, "sensors.rate_hz": 100,
    "sensors.truth_rate_hz": 100,
}  # fmt: skip
_REFERENCE_TOLERANCE, _TAYLOR_TOLERANCE = 1e-11, 1e-13
_LADDER = (3e-5, 1e-5, 3e-6, 1e-6, 3e-7, 1e-7, 3e-8, 1e-8, 3e-9, 1e-9)
_SERIES_ORDER = [0, 1, 5, 6, 7, 8, 9, 2, 3, 4, 10, 11, 12, 13]
"""Places of the series' states in those of the batch kernel."""


class Ended(NamedTuple):
    """Last states of runs, shape (n, 14); processor time, and that inside a peer's library where it is known [s]."""

    states: np.ndarray
    cpu_s: float
    own_s: float | None = None


class Method(NamedTuple):
    """Way to simulate runs: the coarsest of its tolerances that reaches the error goal is timed."""

    name: str
    tolerances: tuple[float, ...]
    solve: Callable[[Any, float], Ended]
    module: str = ""
    runs: int = PEER_RUNS


class Runs:
    """Runs of the benchmark, in the form that each method needs.

    Args:
        values: Values of the keys, shape (n, 2).
    """

    def __init__(self, values: np.ndarray) -> None:
        self.values = values
        self.batch = Batch(load_scene("hammer", _SCENE), KEYS, early_end=False)
        self._prepared: list[Any] = [self.batch._prepare(tuple(row[self.batch._indirect].tolist())) for row in values]

    @cached_property
    def scenes(self) -> list[Scene]:
        """The runs as scenes."""
        return [vary(self.batch.scene, dict(zip(KEYS, row, strict=True))) for row in self.values.tolist()]

    @cached_property
    def problems(self) -> list[Problem]:
        """The runs as problems of the peers."""
        return [cut_window(scene, sample_s=DURATION_S) for scene in self.scenes]

    def march(self, tolerance: float, first: int = 0, last: int | None = None) -> np.ndarray:
        """Return the last states of runs by the batch kernel."""
        chosen = slice(first, last)
        found = self.batch._run_lanes(self.values[chosen], self._prepared[chosen], tolerance / TOLERANCE, None)
        states = found["end"][:, _SERIES_ORDER]
        return from_series(states / SERIES_SCALE, ideal_drive=False)


def _solve_lanes(runs: Runs, tolerance: float) -> Ended:
    begin = time.process_time()
    states = runs.march(tolerance)
    return Ended(states, time.process_time() - begin)


def _run_batch(runs: Runs, tolerance: float) -> Ended:
    """Run a batch as `rig.ensemble` does, with its preparation, quantities and repetitions by `split`."""
    begin = time.process_time()
    Batch(runs.batch.scene, KEYS, early_end=False).run(runs.values)
    cpu_s = time.process_time() - begin
    return Ended(runs.march(tolerance), cpu_s)


def _simulate(engine: str) -> Callable[[Any, float], Ended]:
    def solve(runs: Runs, tolerance: float) -> Ended:
        cpu_s, states = 0.0, []
        for scene in runs.scenes:
            simulation = Simulation(load_scene(scene, {"engine.name": engine, "engine.tolerance": tolerance}))
            _ = simulation.first_row
            cpu_s += run_scene(simulation, block_ticks=simulation.end_tick, keep=False).cpu_s
            states.append(simulation._motion.y[:N_STATE].copy())
        return Ended(np.array(states), cpu_s)

    return solve


def _solve_each(name: str) -> Callable[[Any, float], Ended]:
    def solve(runs: Runs, tolerance: float) -> Ended:
        found = [PEERS[name].solve(problem, Setting("", tolerance)) for problem in runs.problems]
        own = [each.own_s for each in found if each.own_s is not None]
        return Ended(np.array([each.states[-1] for each in found]), sum(each.cpu_s for each in found), sum(own) or None)

    return solve


def _solve_grouped(method: GroupMethod) -> Callable[[Any, float], Ended]:
    def solve(runs: Runs, tolerance: float) -> Ended:
        if method is DIFFRAX_VMAP:
            os.environ.setdefault("EQX_ON_ERROR", "nan")  # a vmap also locates the events of runs that have none
            import_module("jax").config.update("jax_enable_x64", True)
        begin = time.process_time()
        states, own_s = solve_together(runs.problems, method, tolerance)
        return Ended(states, time.process_time() - begin, own_s)

    return solve


METHODS = (
    Method("batch kernel", (TOLERANCE,), _solve_lanes, runs=sys.maxsize),
    Method("batch kernel, finer", (0.1 * TOLERANCE,), _solve_lanes, runs=sys.maxsize),
    Method("batch kernel, as in rig.ensemble", (TOLERANCE,), _run_batch, runs=sys.maxsize),
    Method("split, default", (1e-4,), _simulate("split")),
    Method("split", (1e-2, 3e-3, 1e-3, 3e-4), _simulate("split")),
    Method("heyoka, batch mode", _LADDER, _solve_grouped(HEYOKA_BATCH), "heyoka"),
    Method("heyoka, run by run", _LADDER, _solve_each("heyoka"), "heyoka"),
    Method("CVODE Adams, compiled, run by run", _LADDER, _solve_each("cvode-adams"), "sksundae"),
    Method("CVODE BDF, compiled, run by run", _LADDER, _solve_each("cvode-bdf"), "sksundae"),
    Method("diffrax Dopri8, vmap", _LADDER[3:], _solve_grouped(DIFFRAX_VMAP), "diffrax", VMAP_RUNS),
)


def measure_ensembles(
    *, count: int, rounds: int, peers: bool, progress: Callable[[str], None], methods: tuple[Method, ...] = METHODS
) -> dict[str, Any]:
    """Time every method several times, alternating between methods.

    Args:
        count: Number of runs; methods that are slower than the batch kernel take the first of them.
        rounds: Timed repetitions.
        peers: Whether to time the installed peers.
        progress: Function that receives the name of each measurement.
        methods: Methods.

    Returns:
        A JSON document: machine, load, runs, goals; per method tolerance, times real time (median, min, max), median
        error against the batch kernel at a fine tolerance and against `taylor`; gain of a second thread, by wall time
        and by the processor time of the longer thread, which other load changes less.
    """
    load, values = os.getloadavg(), np.random.default_rng(1).uniform(LOWEST, HIGHEST, (count, len(KEYS)))
    known = [method for method in methods if peers or not method.module]
    missing = sorted({each.module for each in known if each.module and not find_spec(each.module)})
    sets = {each.runs: Runs(values[: each.runs]) for each in known}
    shared = Runs(values[:PEER_RUNS])
    if peers and find_spec("heyoka"):
        import_module("heyoka").set_logger_level_error()  # its warnings would be lines of our output
    progress("references")
    references = shared.march(_REFERENCE_TOLERANCE), _simulate("taylor")(shared, _TAYLOR_TOLERANCE).states
    chosen: list[tuple[Method, float]] = []
    for method in known:
        if method.module not in missing:
            progress(f"{method.name}: tolerance for an error of {ERROR_GOAL:g}")
            for tolerance in method.tolerances:
                if _median_error(method.solve(sets[method.runs], tolerance).states, references[0]) <= ERROR_GOAL:
                    break
            chosen.append((method, tolerance))
    timed: list[list[Ended]] = [[] for _ in chosen]
    gains, every = [], Runs(values)
    for turn in range(rounds):
        progress(f"round {turn + 1} of {rounds}")
        for (method, tolerance), each in zip(chosen, timed, strict=True):
            each.append(method.solve(sets[method.runs], tolerance))
        gains.append(_time_threads(every, 1) / _time_threads(every, 2))
    machine = {"processor": provenance.processor(), "cores": os.cpu_count(), "load": [*load, *os.getloadavg()]}
    return {
        "machine": machine, "runs": count, "duration_s": DURATION_S, "rounds": rounds,
        "goals": {"speed": SPEED_GOAL, "error": ERROR_GOAL, "threads": THREADS_GOAL},
        "reference_difference": _median_error(*references),
        "methods": [
            _summarize(method.name, tolerance, each, references)
            for (method, tolerance), each in zip(chosen, timed, strict=True)
        ],
        "two_threads": {
            "wall_time": float(np.median(gains, axis=0)[0]), "best_wall_time": float(np.max(gains, axis=0)[0]),
            "processor_time": float(np.median(gains, axis=0)[1]),
        },
        "missing_peers": missing,
    }  # fmt: skip


def _summarize(name: str, tolerance: float, timed: list[Ended], references: tuple[np.ndarray, ...]) -> dict[str, Any]:
    states = timed[0].states
    speeds = [DURATION_S * len(states) / each.cpu_s for each in timed]
    own = [DURATION_S * len(states) / each.own_s for each in timed if each.own_s]
    return {
        "name": name, "tolerance": tolerance, "runs": len(states), "median": statistics.median(speeds),
        "min": min(speeds), "max": max(speeds), "library_alone": statistics.median(own) if own else None,
        "error": _median_error(states, references[0]), "error_taylor": _median_error(states, references[1]),
        "failed": int(np.count_nonzero(~np.isfinite(states).all(axis=1))),
    }  # fmt: skip


def _median_error(states: np.ndarray, reference: np.ndarray) -> float:
    """Return the median over the runs of the scaled RMS error; a failed run counts as infinite."""
    shared, columns = min(len(states), len(reference)), list(ERROR_COLUMNS)
    distance = (states[:shared, columns] - reference[:shared, columns]) / ERROR_SCALE
    return float(np.median(np.nan_to_num(np.sqrt(np.mean(distance**2, axis=1)), nan=np.inf)))


def _time_threads(runs: Runs, threads: int) -> np.ndarray:
    """Return the wall time of all runs by the batch kernel, and the processor time of the longest thread [s]."""
    edges = np.linspace(0, len(runs.values), threads + 1).astype(int)

    def run_part(part: int) -> float:
        begin = time.thread_time()
        runs.march(TOLERANCE, edges[part], edges[part + 1])
        return time.thread_time() - begin

    begin = time.perf_counter()
    with ThreadPoolExecutor(threads) as pool:
        longest_s = max(pool.map(run_part, range(threads)))
    return np.array([time.perf_counter() - begin, longest_s])
