"""One random scene: every engine against accurate runs by two unlike engines that agree with each other."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from replays.studies.peers.common.problem import scaled_error
from replays.studies.stability.scenes.worker import Run, Task
from rig.base.text import finite
from rig.physics.engines import ENGINES
from rig.run.scenes import Scene, scene_document

ACCURATE = (("taylor", 1e-10), ("rk8", 1e-9), ("tsit5", 1e-9))
"""Engines and tolerances of the truth: the first two that take the scene; the next where one doubts, or they differ."""
AGREE = 1e-2
"""Scaled error up to which two accurate runs tell the same motion."""
WRONG = 0.1
"""Scaled error from which a run is wrong, ..."""
ASKED = 1e-3
"""... and what an engine of fixed steps is taken to be asked for."""
_ABSURD, _LEAST_N = 20.0, 10.0
"""A peak force is absurd above so many times the accurate one, or this [N] where that is next to nothing."""
UNBOUNDED_N = 1e9
"""Above this accurate peak the model itself makes energy without end, as a gap that counts both houses can [N]."""
NUDGE = 1e-7
"""By how many clearances the start is moved to see what becomes of it."""
CHAOTIC = 1e5
"""Growth of that from which a scene is chaotic: accurate runs part by as much as they can be told apart."""
_NO_DOUBT = ("would have pulled", "lie after its end", "contacts began slower")
"""In warnings that say nothing of a run's accuracy."""

Row = dict[str, Any]


def doubted(health: Row) -> bool:
    """Whether a run says of itself that it may be wrong."""
    return any(not any(words in warning for words in _NO_DOUBT) for warning in health["warnings"])


def asked(engine: str, tolerance: float = 0.0) -> float:
    """The scaled error that an engine is asked for."""
    return tolerance or ENGINES[engine].tolerance or ASKED


def measure(scene: Scene, engines: list[str], run: Callable[[Task], Run], *, limit_s: float = 20.0) -> Row:
    """Run a scene by accurate engines and by those under test.

    Args:
        scene: The scene.
        engines: Those under test, each at its own step and tolerance.
        run: Does a run.
        limit_s: Processor time of a run [s].

    Returns:
        The scene; `distance` of the accurate runs; `odd`, which of them differs from two others; `growth` of a nudge;
        `status`: decided, chaotic (they differ, as a nudge would make them), undecided (they differ), untold (no two
        came to an end), or unbounded; `accurate` and `tested`, a row a run.
    """
    accurate: list[tuple[Task, Run]] = []
    for engine, tolerance in ACCURATE:
        sure = [done for _, done in accurate if not done.failure and not doubted(done.health)]
        if len(sure) >= 2 and _distance(*sure[:2]) <= AGREE:
            break
        task = Task(scene, engine, tolerance, limit_s=limit_s)
        accurate.append((task, run(task)))
    good = [(task, done) for task, done in accurate if not done.failure]
    good.sort(key=lambda pair: doubted(pair[1].health))  # those that doubt themselves stand back
    distance = _distance(good[0][1], good[1][1]) if len(good) > 1 else None
    growth = _growth(*good[0], run) if good else None
    status = "untold"
    if distance is not None:
        status = "decided" if distance <= AGREE else "chaotic" if growth and growth >= CHAOTIC else "undecided"
    peak = min((done.health["peak_normal_force_n"] for _, done in good), default=None)
    if peak is not None and not peak <= UNBOUNDED_N:
        status = "unbounded"
    tested = [Task(scene, engine, limit_s=limit_s) for engine in engines]
    truths = good if status == "decided" else []
    rows = [_row(task, run(task), truths, peak) for task in tested]
    document: Row = {
        "scene": _sparse(scene),
        "duration_s": scene.duration_s,
        "status": status,
        "distance": distance,
        "odd": _odd(good) if status == "undecided" else None,
        "growth": growth,
        "growth_per_s": math.log(growth) / scene.duration_s if growth else None,
        "contacts": good[0][1].health["contacts"] if good else None,
        "peak_n": peak,
        "accurate": [_row(task, done, [], peak) for task, done in accurate],
        "tested": rows,
    }
    return finite(document)


def _row(task: Task, done: Run, truths: list[tuple[Task, Run]], peak: float | None) -> Row:
    """One run, held against the first accurate one by another engine."""
    row: Row = {
        "engine": task.engine,
        "asked": asked(task.engine, task.tolerance),
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
    row |= {"doubted": doubted(done.health), "contacts": done.health["contacts"], "peak_n": force}
    row |= {"residual_share": done.health["energy"]["residual_share"], "warnings": done.health["warnings"]}
    if peak is not None:
        row["absurd"] = not force <= _ABSURD * max(peak, _LEAST_N)
    if not done.failure:
        row["error"] = next((_distance(done, truth) for other, truth in truths if other.engine != task.engine), None)
    return row


def _distance(a: Run, b: Run) -> float:
    return scaled_error(a.states, b.states)


def _growth(task: Task, done: Run, run: Callable[[Task], Run]) -> float | None:
    """Largest distance of a run from the same, nudged at the start, over their distance there."""
    other = run(task._replace(nudge=NUDGE))
    if other.failure:
        return None
    apart = [scaled_error(done.states[i : i + 1], other.states[i : i + 1]) for i in range(len(done.states))]
    return float(np.max(apart)) / apart[0]


def _odd(runs: list[tuple[Task, Run]]) -> str | None:
    """Of three accurate runs, the engine whose run differs from two that agree."""
    if len(runs) < 3:
        return None
    for (_, a), (_, b), (odd, _) in ((runs[0], runs[2], runs[1]), (runs[1], runs[2], runs[0])):
        if _distance(a, b) <= AGREE:
            return odd.engine
    return None


def _sparse(scene: Scene) -> Row:
    """What a scene has in another way than its defaults, complete enough to run it again."""
    given = scene_document(scene)
    defaults = scene_document(Scene())
    return {key: value for key, value in given.items() if value != defaults[key] and key != "engine"}
