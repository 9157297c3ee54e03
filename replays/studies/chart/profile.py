"""Performance profile over many random scenes: share of scenes solved within a cost ratio to the best method.

After Dolan and More, Math. Program. 91 (2002) 201: the share of scenes that a method solves, with the target error,
within a factor tau of the cheapest method.
"""

from __future__ import annotations

from itertools import dropwhile
from typing import Any

import numpy as np

from replays.studies.chart.measure import Budget, measure_point
from replays.studies.chart.methods import Competitor
from replays.studies.chart.phases import FRAME_S
from replays.studies.peers.common.problem import Problem
from replays.studies.peers.common.reference import Reference
from replays.studies.peers.common.window import cut_window
from rig.run.scenes import Scene, parse_scene

TARGET = 1e-3
"""Target error, scaled."""
SCENES = {"quick": 12, "full": 100}
DURATION_S = 0.15
MAX_REFERENCE_ERROR_RATIO = 0.1
"""Largest reference error over the target error of a scene that counts."""


def draw_scene(seed: int) -> Scene:
    """Return a random scene: a hammer pulse at 5 ms, with random speed, friction and restitution."""
    rng = np.random.default_rng([2013, seed])
    return parse_scene(
        {
            "name": f"draw-{seed:03d}",
            "duration_s": DURATION_S,
            "drive": {"speed_hz": round(float(rng.uniform(3.0, 7.5)), 3)},
            "set": {
                "contact.friction": round(float(rng.uniform(0.05, 0.4)), 4),
                "contact.restitution": round(float(rng.uniform(0.5, 0.95)), 4),
            },
            "commands": [
                {
                    "at_s": 0.005,
                    "command": "hammer",
                    "force_n": round(float(rng.uniform(60.0, 180.0)), 2),
                    "duration_ms": round(float(rng.uniform(2.0, 8.0)), 2),
                    "direction": round(float(rng.uniform(-180.0, 180.0)), 1),
                }
            ],
        }
    )


def draw_problem(seed: int) -> Problem:
    """Return the window of a random scene, with exact Coulomb friction."""
    return cut_window(draw_scene(seed), sample_s=FRAME_S, friction="exact")


def find_cheapest(
    contender: Competitor,
    problem: Problem,
    reference: Reference | None,
    budget: Budget,
    target: float,
    start: str = "",
) -> dict[str, Any]:
    """Return the cheapest setting of a method's ladder that reaches the target.

    Args:
        contender: Method.
        problem: Problem.
        reference: Reference, or None if there is none.
        budget: Time limits of each run.
        target: Target error, scaled.
        start: Label of the first setting, such as the cheapest for a larger target; empty for the coarsest.

    Returns:
        Columns of that setting's point. If no setting reaches the target, the columns of the last one, with failure
        "target"; failure "law" if the method does not support the friction law, and "reference" if the reference is not
        accurate enough, as in chaotic motion: such a problem counts for no method.
    """
    friction = "exact" if problem.exact_friction else "smoothed"
    columns: dict[str, Any] = {"friction": friction, "reference_error": reference.error if reference else None}
    if not contender.takes(friction):
        return columns | {"failure": "law", "message": f"cannot run {friction} friction"}
    if reference is None or reference.error > MAX_REFERENCE_ERROR_RATIO * target:
        return columns | {"failure": "reference", "message": "no reference sharp enough: chaotic motion"}
    for setting in dropwhile(lambda setting: start and setting.label != start, contender.settings):
        columns |= measure_point(contender, setting, problem, reference, budget._replace(runs=1, single_s=0.0))
        columns |= {"rung": setting.label, "step_us": setting.step_us, "tolerance": setting.tolerance}
        error = columns["error"]
        if error is not None and error <= target and not columns["failure"]:
            return columns | measure_point(contender, setting, problem, reference, budget)
        if columns["failure"] == "budget":
            return columns
    return columns | {"failure": columns["failure"] or "target"}


def profile_curves(rows: list[dict[str, Any]], column: str = "cpu_s") -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the curves of the profile.

    Args:
        rows: Points of the profile, one per scene and method.
        column: Cost column; methods without it are excluded. The best cost is always from `cpu_s`.

    Returns:
        By method: cost ratios to the best, ascending, shape (n,), and the share of all scenes solved within each ratio,
            shape (n,); both are empty for a method that solves none.
    """
    scenes = sorted({row["phase"] for row in rows})
    cost = {(row["phase"], row["method"]): row["cpu_s"] for row in rows if not row["failure"]}
    best = {
        scene: min((spent for (where, _), spent in cost.items() if where == scene), default=np.inf) for scene in scenes
    }
    if column != "cpu_s":
        rows = [row for row in rows if row[column]]
        cost = {(row["phase"], row["method"]): row[column] for row in rows if not row["failure"]}
    curves = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        ratios = np.sort([cost[scene, method] / best[scene] for scene in scenes if (scene, method) in cost])
        curves[method] = (ratios, np.arange(1, len(ratios) + 1) / len(scenes))
    return curves
