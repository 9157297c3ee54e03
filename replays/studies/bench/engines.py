"""Benchmark of the rig: simulated over processor time, with errors; cases alternate in one process.

Speed is measured by the processor time of the simulating thread, which other load does not change. This includes single
frames; `rig status` shows how late a run in real time is.
"""

from __future__ import annotations

import math
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from replays.studies.common import provenance
from replays.studies.common.run import bare_sensors, run_scene
from replays.studies.peers import PEERS, Problem, Setting, scaled_error
from replays.studies.peers.common.reference import find_reference
from replays.studies.peers.common.window import cut_window
from rig.channels.table import ChannelTable, default_table
from rig.physics.kernels import has_compiled_kernels
from rig.physics.kernels.signals import COLUMN, N_STATE
from rig.run.scenes import Scene, load_scene
from rig.run.simulation import Simulation
from rig.serve.pacing import freeze_start_objects

ENGINE_ONLY = {**{f"sensors.{name}": value for name, value in bare_sensors().items()}, "model.friction": "exact"}
"""Settings for the engine alone: a row every 1 ms and almost no sensor chain."""
_BLOCK_TICKS = 10_000
_FRAME_TICKS = 1000
FRAME_GOAL_US = 100.0
"""Goal for the processor time of 99.9 % of frames [us]: a tenth of their length."""


@dataclass(frozen=True)
class BenchCase:
    """One line of the table.

    Attributes:
        name: What is measured.
        scene: Scene.
        changes: Changes to it.
        simulated_s: Length of a run [s].
        goal: Target speed as a multiple of real time; None: no target.
        error_goal: Largest total error against exact Coulomb for reaching the goal; None: not compared.
        blocks: Whether the run is made in blocks of 10 ms, as by the service, instead of one call.
    """

    name: str
    scene: str
    changes: dict[str, Any] = field(default_factory=dict)
    simulated_s: float = 1.0
    goal: float | None = None
    error_goal: float | None = None
    blocks: bool = False


def _engine(name: str, step_us: int, **changes: Any) -> dict[str, Any]:
    return {**ENGINE_ONLY, "engine.name": name, "engine.step_us": step_us, **changes}


def _split(tolerance: float, **changes: Any) -> dict[str, Any]:
    return _engine("split", 25, **{"engine.tolerance": tolerance, "engine.companion": False}, **changes)


def _faults(kind: str, **numbers: float) -> list[dict[str, Any]]:
    """Return the commands of the scene `hammer`, and one fault on each of its channels from the start."""
    pulse = [command.model_dump() for command in load_scene("hammer").commands]
    names = load_scene("hammer").table.channels
    return [*pulse, *({"at_s": 0.0, "command": "fault", "channel": one, "kind": kind, **numbers} for one in names)]


def _laboratory() -> ChannelTable:
    """Return 24 channels at 51.2 kHz: the rig's own, and nine formulas as in docs/daq24.toml."""
    table = default_table().select_groups((), 51_200)
    probes = table.groups["probes"]
    added = tuple(probes.channels[0].model_copy(update={"name": f"x{n}", "signal": each}) for n, each in enumerate((
        "along(shaft_x(0.349), shaft_y(0.349), 45) + runout(theta - pi / 4)",
        "along(shaft_x(0.349), shaft_y(0.349), 135) + runout(theta - 3 * pi / 4)",
        "magnet_x", "magnet_y", "along(inner_ax, inner_ay, 45)",
        "3 * 0.008 / 0.120 ** 2 * (x_ih - x_oh)", "3 * 0.010 / 0.120 ** 2 * y_oh", "pivot_x", "pivot_y",
    )))  # fmt: skip
    groups = {**table.groups, "probes": probes.model_copy(update={"channels": (*probes.channels, *added)})}
    runout = tuple((45.0 * n, 6e-6 * math.cos(0.25 * math.pi * n)) for n in range(8))
    return ChannelTable(groups=groups, version=table.version, curves={"runout": runout})


_SENSORS = {"engine.companion": False}
_LOW_RATES = {"sensors.rate_hz": 100, "sensors.truth_rate_hz": 100}
_SINGLE_IMPACT = [{"at_s": 0.02, "command": "hammer", "force_n": 100.0, "duration_ms": 2.0}]

CASES = (
    BenchCase("split 1e-3, hammer", "hammer", _split(1e-3), goal=450, error_goal=2e-3),
    BenchCase("split 1e-4, hammer", "hammer", _split(1e-4), goal=300, error_goal=1e-3),
    BenchCase("split 1e-5, hammer", "hammer", _split(1e-5), goal=150, error_goal=1e-4),
    BenchCase("split 1e-4 with its companion, hammer", "hammer", _engine("split", 25), error_goal=1e-3),
    BenchCase("tsit5 1e-6, hammer", "hammer", _engine("tsit5", 500, **{"engine.tolerance": 1e-6})),
    BenchCase("rk8 1e-8, hammer", "hammer", _engine("rk8", 25)),
    BenchCase("taylor 1e-8, hammer", "hammer", _engine("taylor", 25, **{"engine.tolerance": 1e-8}), error_goal=1e-6),
    BenchCase("split 1e-4, free flight, a row every 10 ms", "stable-run", _split(1e-4, **_LOW_RATES), 20.0, goal=20000),
    BenchCase("split 1e-4, 60 s: bounces, then free", "hammer", _split(1e-4, commands=_SINGLE_IMPACT), 60.0, goal=500),
    BenchCase("split 1e-4, 60 s: bounces, then whirl", "hammer", _split(1e-4), 60.0, goal=3000),
    BenchCase("split, hammer, all sensors at 20 kHz", "hammer", _SENSORS, goal=120, blocks=True),
    BenchCase("the same with its companion", "hammer", {}, blocks=True),
    BenchCase("the same at 51.2 kHz, no companion", "hammer", {**_SENSORS, "sensors.rate_hz": 51_200}, blocks=True),
    BenchCase(
        "24 channels at 51.2 kHz, no companion",
        "hammer",
        {**_SENSORS, "channels": _laboratory()},
        goal=60,
        blocks=True,
    ),
    BenchCase(
        "the same at 20 kHz with its companion, 15 faults",
        "hammer",
        {"commands": _faults("gain", factor=1.1)},
        blocks=True,
    ),
    BenchCase("the same with 15 late channels", "hammer", {"commands": _faults("late", late_us=500.0)}, blocks=True),
    BenchCase("split, stable run, all sensors at 20 kHz", "stable-run", {}, blocks=True),
    BenchCase("rk8 25 us, hammer, all sensors at 20 kHz", "hammer", {"engine.name": "rk8"}, blocks=True),
)
"""Cases; the first one is the basis of the ratios."""

PEER_CASES = (("cvode-bdf", 2e-3), ("cvode-adams", 2e-3), ("heyoka", 2e-3), ("heyoka", 1e-6))
"""Peer and target error; the peer is timed at the cheapest setting of its ladder that reaches it."""


def measure(*, runs: int, peers: bool, frames: int, progress: Callable[[str], None]) -> dict[str, Any]:
    """Run every case several times, alternating between cases.

    Args:
        runs: Runs of each case.
        peers: Whether to time the installed peers in the same rounds.
        frames: Number of frames of 1 ms that are timed separately; 0 for none.
        progress: Function that receives the name of each measurement.

    Returns:
        A JSON document: machine, time until the kernels were ready [s]; per case the multiple of real time (median,
        min, max, all), error, energy residual, goal and whether it is reached, and the median ratio to the first case
        of the same round; per peer the same; the time of a frame.
    """
    cached = has_compiled_kernels()
    begin = time.perf_counter()
    progress("loading or compiling the kernels")
    scenes = {case.name: load_scene(case.scene, {**case.changes, "duration_s": case.simulated_s}) for case in CASES}
    for scene in scenes.values():
        Simulation(scene).warm_up()
    ready_s = time.perf_counter() - begin

    progress("reference")
    problem = cut_window(scenes[CASES[0].name], end_s=CASES[0].simulated_s, sample_s=1e-3, friction="exact")
    reference, reference_error, source = _reference(problem)
    chosen: list[tuple[str, float, Setting, float]] = []
    missing = sorted({name for name, _ in PEER_CASES if not PEERS[name].installed}) if peers else []
    for name, wanted in PEER_CASES if peers else ():
        if PEERS[name].installed:
            progress(f"{name}: which setting has an error of {wanted:g}")
            chosen += _cheapest(name, wanted, problem, reference)

    speeds: dict[str, list[float]] = {case.name: [] for case in CASES}
    peer_speeds: list[list[float]] = [[] for _ in chosen]
    ends: dict[str, tuple[np.ndarray, Simulation]] = {}
    for turn in range(runs):
        progress(f"round {turn + 1} of {runs}")
        for case in CASES:
            speed, rows, simulation = _run(scenes[case.name], case)
            speeds[case.name].append(speed)
            ends[case.name] = (rows, simulation)
        for (name, _, setting, _), values in zip(chosen, peer_speeds, strict=True):
            solution = PEERS[name].solve(problem, setting, budget_s=60.0)
            values.append(problem.duration_s / solution.cpu_s)

    first = CASES[0].name
    cases = [
        _judge_case(case, *ends[case.name], reference, _summary(case.name, speeds[case.name], speeds[first]))
        for case in CASES
    ]
    return {
        "machine": {
            "processor": provenance.processor(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
        },
        "runs": runs,
        "ready_s": ready_s,
        "cached": cached,
        "reference": {"of": source, "error": reference_error},
        "cases": cases,
        "peers": [
            _summary(f"{PEERS[name].title}, {setting.label}", values, speeds[first])
            | {"error": error, "wanted": wanted}
            for (name, wanted, setting, error), values in zip(chosen, peer_speeds, strict=True)
        ],
        "missing_peers": missing,
        "frame": _frames(frames, progress) if frames else None,
    }


def _judge_case(
    case: BenchCase, rows: np.ndarray, simulation: Simulation, reference: np.ndarray, summary: dict[str, Any]
) -> dict[str, Any]:
    """Return a case's speeds with its error, residual and goal."""
    error = None
    if case.scene == "hammer" and not case.blocks and case.simulated_s == CASES[0].simulated_s:
        count = min(len(rows), len(reference))
        error = scaled_error(rows[:count, :N_STATE], reference[:count])
    reached = case.goal is None or summary["median"] >= case.goal
    if case.error_goal is not None:
        reached = reached and error is not None and error <= case.error_goal
    return summary | {
        "error": error,
        "residual_share": simulation.health()["energy"]["residual_share"],
        "spin_hz": float(rows[-1, COLUMN["theta_rate"]] / (2.0 * np.pi)),
        "goal": case.goal,
        "error_goal": case.error_goal,
        "reached": reached if case.goal is not None or case.error_goal is not None else None,
    }


def _run(scene: Scene, case: BenchCase) -> tuple[float, np.ndarray, Simulation]:
    """Return times real time, observed rows (of the last block if there are blocks), and the simulation at its end."""
    simulation = Simulation(scene)
    _ = simulation.first_row
    done = run_scene(simulation, block_ticks=_BLOCK_TICKS if case.blocks else simulation.end_tick, keep=False)
    return case.simulated_s / done.cpu_s, done.rows, simulation


def _reference(problem: Problem) -> tuple[np.ndarray, float | None, str]:
    """Return states at every 1 ms, the distance between the two codes of the reference, and their names."""
    reference = find_reference(problem, quick=True)
    if reference is not None:
        return reference.solution.states, reference.error, " and ".join(reference.names)
    rk8 = {"engine.tolerance": 1e-13}
    scene = load_scene("hammer", {**_engine("rk8", 5, **rk8), "duration_s": problem.duration_s})
    rows = _run(scene, BenchCase("reference", "hammer"))[1]
    return rows[:, :N_STATE].copy(), None, "rk8 alone (install the extra `peers` for two independent codes)"


def _cheapest(
    name: str, wanted: float, problem: Problem, reference: np.ndarray
) -> list[tuple[str, float, Setting, float]]:
    """Return the fastest setting of a peer's refined ladder whose error is at most the given one, if any."""
    best: tuple[float, Setting, float] | None = None
    for setting in _refine_ladder(PEERS[name].ladder):
        solution = PEERS[name].solve(problem, setting, budget_s=30.0)
        if solution.failure is not None:
            continue
        error = scaled_error(solution.states, reference[: len(solution.states)])
        if error <= wanted and (best is None or solution.cpu_s < best[0]):
            best = (solution.cpu_s, setting, error)
    return [] if best is None else [(name, wanted, best[1], best[2])]


def _refine_ladder(ladder: tuple[Setting, ...]) -> list[Setting]:
    """Return a ladder refined to three tolerances per decade, so that no peer has to use a needlessly fine one."""
    finer = list(ladder)
    for above, below in pairwise(ladder):
        if above.absolute is None and below.absolute is None:
            steps = round(3.0 * math.log10(above.tolerance / below.tolerance))
            for n in range(1, steps):
                tolerance = above.tolerance * (below.tolerance / above.tolerance) ** (n / steps)
                finer.append(Setting(f"{tolerance:.1e}".replace("e-0", "e-"), tolerance))
    return finer


def _summary(name: str, values: list[float], base: list[float]) -> dict[str, Any]:
    return {
        "name": name,
        "median": statistics.median(values),
        "min": min(values),
        "max": max(values),
        "all": values,
        "ratio": statistics.median(value / other for value, other in zip(values, base, strict=True)),
    }


def _frames(frames: int, progress: Callable[[str], None]) -> dict[str, Any]:
    """Return the processor time of single frames of 1 ms in a whirl [us], for the engine alone and with all sensors."""
    report = {}
    for name, changes in (("engine alone", _split(1e-4)), ("all sensors at 20 kHz", _SENSORS)):
        progress(f"{frames} frames of 1 ms, {name}")
        simulation = Simulation(load_scene("hammer", {**changes, "duration_s": 3600.0}))
        times_s = np.empty(frames)
        with freeze_start_objects():  # as in every run with pacing
            for _ in range(100):
                simulation.advance(_FRAME_TICKS)
            for n in range(frames):
                begin = time.thread_time()
                simulation.advance(_FRAME_TICKS)
                times_s[n] = time.thread_time() - begin
        low, high, worst = np.quantile(times_s, [0.5, 0.999, 1.0]) * 1e6
        report[name] = {
            "median_us": float(low), "p999_us": float(high), "worst_us": float(worst), "frames": frames,
            "goal_us": FRAME_GOAL_US, "reached": float(high) <= FRAME_GOAL_US,
        }  # fmt: skip
    return report
