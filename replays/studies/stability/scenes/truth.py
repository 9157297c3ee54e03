"""Test of every engine on one random scene against accurate runs of two different engines."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from replays.studies.peers.common.problem import scaled_error
from replays.studies.stability.scenes.worker import SceneRun, Task
from rig.base.text import replace_nonfinite
from rig.physics.engines import ENGINES
from rig.run.scenes import Scene, scene_document

ACCURATE = (("taylor", 1e-10), ("rk8", 1e-9), ("tsit5", 1e-9))
"""Reference engines and tolerances: the first two that support the scene; the next one if one warns or they differ."""
AGREE_ERROR = 1e-2
"""Scaled error up to which two accurate runs count as the same motion."""
WRONG_ERROR = 0.1
"""Scaled error above which a run is wrong."""
FIXED_STEP_ERROR = 1e-3
"""Scaled error assumed to be requested from a fixed-step engine."""
_MAX_PEAK_RATIO, _MIN_PEAK_N = 20.0, 10.0
"""Ratio to the accurate peak force above which a peak is implausible, and least accurate peak for this ratio [N]."""
UNBOUNDED_N = 1e9
"""Accurate peak force above which the model itself generates energy, as a gap counted for both housings can [N]."""
INITIAL_SHIFT = 1e-7
"""Shift of the initial position, in clearances, for testing the sensitivity."""
CHAOS_GROWTH = 1e5
"""Growth of that shift from which a scene is chaotic: accurate runs differ by as much as they can."""
_NO_DOUBT = "lie after its end"
"""Part of the warning that does not concern the accuracy of a run."""

Row = dict[str, Any]


def is_doubted(health: Row) -> bool:
    """Return whether a run warns that it may be wrong."""
    return any(_NO_DOUBT not in warning for warning in health["warnings"])


def requested_error(engine: str, tolerance: float = 0.0) -> float:
    """Return the scaled error that an engine is requested to keep."""
    return tolerance or ENGINES[engine].tolerance or FIXED_STEP_ERROR


def measure(scene: Scene, engines: list[str], run: Callable[[Task], SceneRun], *, limit_s: float = 20.0) -> Row:
    """Run a scene with the accurate engines and with those under test.

    Args:
        scene: The scene.
        engines: Engines under test, each at its own step and tolerance.
        run: Function that executes a run.
        limit_s: Processor time per run [s].

    Returns:
        The scene; `distance` of the accurate runs; `odd`, the one that differs from two others; `growth` of a shift;
        `status`: decided, chaotic (they differ as after a shift), undecided (they differ otherwise), untold (no two
        runs are complete) or unbounded; `accurate` and `tested`, a row per run.
    """
    accurate: list[tuple[Task, SceneRun]] = []
    for engine, tolerance in ACCURATE:
        reliable = [done for _, done in accurate if not done.failure and not is_doubted(done.health)]
        if len(reliable) >= 2 and _distance(*reliable[:2]) <= AGREE_ERROR:
            break
        task = Task(scene, engine, tolerance, limit_s=limit_s)
        accurate.append((task, run(task)))
    good = [(task, done) for task, done in accurate if not done.failure]
    good.sort(key=lambda pair: is_doubted(pair[1].health))  # runs with a warning come last
    distance = _distance(good[0][1], good[1][1]) if len(good) > 1 else None
    growth = _growth(*good[0], run) if good else None
    status = "untold"
    if distance is not None:
        status = "decided" if distance <= AGREE_ERROR else "chaotic" if (growth or 0.0) >= CHAOS_GROWTH else "undecided"
    peak = min((done.health["peak_normal_force_n"] for _, done in good), default=None)
    if peak is not None and not peak <= UNBOUNDED_N:
        status = "unbounded"
    tested = [Task(scene, engine, limit_s=limit_s) for engine in engines]
    truths = good if status == "decided" else []
    rows = [_row(task, run(task), truths, peak) for task in tested]
    document: Row = {
        "scene": _scene_changes(scene),
        "duration_s": scene.duration_s,
        "status": status,
        "distance": distance,
        "odd": _find_deviating_engine(good) if status == "undecided" else None,
        "growth": growth,
        "growth_per_s": math.log(growth) / scene.duration_s if growth else None,
        "contacts": good[0][1].health["contacts"] if good else None,
        "peak_n": peak,
        "accurate": [_row(task, done, [], peak) for task, done in accurate],
        "tested": rows,
    }
    return replace_nonfinite(document)


def _row(task: Task, done: SceneRun, truths: list[tuple[Task, SceneRun]], peak: float | None) -> Row:
    """Return the row of a run, compared with the first accurate run of another engine."""
    row: Row = {
        "engine": task.engine,
        "asked": requested_error(task.engine, task.tolerance),
        "failure": done.failure,
        "message": done.message,
        "cpu_s": done.cpu_s,
        "speed": done.reached_s / done.cpu_s if done.cpu_s else None,
        "error": None,
        "doubted": None,
        "absurd": None,
    }
    if not done.health:
        return row
    force = done.health["peak_normal_force_n"]
    row |= {"doubted": is_doubted(done.health), "contacts": done.health["contacts"], "peak_n": force}
    row |= {"residual_share": done.health["energy"]["residual_share"], "warnings": done.health["warnings"]}
    if peak is not None:
        row["absurd"] = not force <= _MAX_PEAK_RATIO * max(peak, _MIN_PEAK_N)
    if not done.failure:
        row["error"] = next((_distance(done, truth) for other, truth in truths if other.engine != task.engine), None)
    return row


def _distance(a: SceneRun, b: SceneRun) -> float:
    return scaled_error(a.states, b.states)


def _growth(task: Task, done: SceneRun, run: Callable[[Task], SceneRun]) -> float | None:
    """Return the largest distance between a run and a shifted one, relative to the initial distance."""
    other = run(task._replace(nudge=INITIAL_SHIFT))
    if other.failure:
        return None
    apart = [scaled_error(done.states[i : i + 1], other.states[i : i + 1]) for i in range(len(done.states))]
    return float(np.max(apart)) / apart[0]


def _find_deviating_engine(runs: list[tuple[Task, SceneRun]]) -> str | None:
    """Return the engine whose run differs from two that agree, among three accurate runs."""
    if len(runs) < 3:
        return None
    for (_, a), (_, b), (odd, _) in ((runs[0], runs[2], runs[1]), (runs[1], runs[2], runs[0])):
        if _distance(a, b) <= AGREE_ERROR:
            return odd.engine
    return None


def _scene_changes(scene: Scene) -> Row:
    """Return the settings in which a scene differs from the defaults, sufficient to run it again."""
    document = scene_document(scene)
    defaults = scene_document(Scene())
    return {key: value for key, value in document.items() if value != defaults[key] and key != "engine"}
