"""Performance profile: over many random scenes, how often a method is how much more expensive than the best of them.

After Dolan and More, Math. Program. 91 (2002) 201: the share of scenes that a method solves, to the error asked for,
within a factor tau of the cheapest method.
"""

from __future__ import annotations

from itertools import dropwhile
from typing import Any

import numpy as np

from replays.studies.chart.measure import Budget, point
from replays.studies.chart.methods import Competitor
from replays.studies.chart.phases import FRAME_S
from replays.studies.peers.common.problem import Problem
from replays.studies.peers.common.reference import Reference
from replays.studies.peers.common.window import cut_window
from rig.run.scenes import Scene, parse_scene

TARGET = 1e-3
"""Scaled error to be reached."""
SCENES = {"quick": 12, "full": 100}
DURATION_S = 0.15
SHARP = 0.1
"""A scene counts only where its reference is this much sharper than the target."""


def draw_scene(seed: int) -> Scene:
    """A random scene: a hammer pulse at 5 ms, on a rotor and a contact that differ from draw to draw."""
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
    """Its window, with exact Coulomb friction."""
    return cut_window(draw_scene(seed), sample_s=FRAME_S, friction="exact")


def cheapest(
    contender: Competitor,
    problem: Problem,
    reference: Reference | None,
    budget: Budget,
    target: float,
    start: str = "",
) -> dict[str, Any]:
    """Walk down a method's ladder until the target is reached.

    Args:
        contender: The method.
        problem: The problem.
        reference: Its reference, or None where there is none.
        budget: Budget of each run.
        target: Scaled error to be reached.
        start: Label of the setting to begin at, such as the cheapest within a larger target; empty for the first.

    Returns:
        Columns of that setting's point. Where no setting reaches the target, of the last one tried, with failure
        "target"; failure "law" where the method cannot run the friction law, and "reference" where the reference is
        not sharp enough, as in chaotic motion: such a problem counts for nobody.
    """
    friction = "exact" if problem.exact_friction else "smoothed"
    columns: dict[str, Any] = {"friction": friction, "reference_error": reference.error if reference else None}
    if not contender.takes(friction):
        return columns | {"failure": "law", "message": f"cannot run {friction} friction"}
    if reference is None or reference.error > SHARP * target:
        return columns | {"failure": "reference", "message": "no reference sharp enough: chaotic motion"}
    for setting in dropwhile(lambda setting: start and setting.label != start, contender.settings):
        columns |= point(contender, setting, problem, reference, budget._replace(runs=1, single_s=0.0))
        columns |= {"rung": setting.label, "step_us": setting.step_us, "tolerance": setting.tolerance}
        error = columns["error"]
        if error is not None and error <= target and not columns["failure"]:
            return columns | point(contender, setting, problem, reference, budget)
        if columns["failure"] == "budget":
            return columns
    return columns | {"failure": columns["failure"] or "target"}


def shares(rows: list[dict[str, Any]], column: str = "cpu_s") -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Curves of the profile.

    Args:
        rows: Points of the profile, one a scene and method.
        column: Column that a method's cost is read from; methods without it are left out. The best's is its `cpu_s`.

    Returns:
        By method: cost ratios to the best, ascending, shape (n,), and the share of all scenes solved within each,
        shape (n,); a method that solves none has empty ones.
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
