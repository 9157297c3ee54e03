"""Scope of a chart: windows of scenes, contact laws, and the list of points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from replays.studies.chart.methods import Competitor
from replays.studies.common.twelve_scenes import TWELVE_SCENES
from replays.studies.peers import Setting
from replays.studies.peers.common.problem import Problem
from replays.studies.peers.common.window import cut_window
from rig.base.errors import InputError
from rig.run.scenes import load_scene, parse_scene

Mode = Literal["quick", "full"]
FRAME_S = 1e-3
"""Interval of compared states, and length of a timed frame [s]."""
SMOOTHING = 5e-3
"""v_s of the smoothed law [m/s]."""
SMOOTHED_SPEEDS = (5e-3, 5e-4, 1e-4)
"""v_s whose deviation from exact Coulomb friction is drawn [m/s]."""
RUB = "rub"


@dataclass(frozen=True)
class Phase:
    """Window of a scene from its start."""

    name: str
    title: str
    end_s: float
    scene: str = "hammer"
    changes: dict[str, Any] = field(default_factory=dict)


_ALL = (
    Phase("first-impacts", "first impacts, 0.05 s", 0.05),
    Phase("transient", "transient, 0.2 s", 0.2),
    Phase("whirl", "impacts to whirl, 1 s", 1.0),
    Phase("drop", "drop to rest, 0.5 s", 0.5, scene="drop"),
    Phase(
        RUB, "chaotic partial rub", 20.0, scene="",
        changes={"ring.offset_x": 0.8, "shaft.unbalance_eccentricity": 0.3},
    ),
)  # fmt: skip
PHASES = {phase.name: phase for phase in _ALL}
RUB_SAMPLE_S = 5e-4
"""Sample interval of the rub's statistics [s]."""
RUB_SPEED_HZ = 12.0
"""Speed of the rub [Hz]: two runs that start 5e-10 rad apart have lost all similarity after 0.4 s."""

PANELS = {
    "exact": "total error against exact Coulomb friction",
    "smoothed": f"all on the smoothed law, v_s = {SMOOTHING * 1e3:g} mm/s, against its own reference",
    "memory": "Lankarani-Nikravesh contact with its memory of the impact speed, and without; no friction",
    RUB: "chaotic partial rub: statistics only",
    "profile": "performance profile over random scenes",
    "scenes": "cheapest setting within 1e-2 and 1e-4 over twelve scenes",
}
_WINDOWS = ("whirl", "transient", "first-impacts", "drop")
_PANEL_PHASES = {
    "exact": _WINDOWS,
    "smoothed": ("transient", "whirl", "first-impacts"),
    "memory": ("first-impacts",),
    RUB: (RUB,),
    "profile": (),
    "scenes": (),
}
MEMORY_CASES = ("memory", "no memory")
SCENE_TARGETS = (1e-2, 1e-4)
"""Target errors for the twelve scenes, scaled, the largest first."""


@dataclass(frozen=True)
class Task:
    """Point to measure.

    `case` distinguishes laws within a panel: "" for the panel's own, "smoothed" for a smoothed law measured against
    exact Coulomb, one of `MEMORY_CASES`, or "floor" and "reference", which no method runs.
    """

    panel: str
    phase: str
    case: str
    method: str
    setting: Setting
    smoothing_speed: float = SMOOTHING


def select(only: str | None, panels: list[str] | None) -> tuple[list[str], str | None]:
    """Check a selection of phase and panels.

    Raises:
        InputError: Unknown phase or panel, or no selected panel has the phase.
    """
    if only is not None and only not in PHASES:
        raise InputError("only", f"one of {', '.join(PHASES)}", only)
    for panel in panels or ():
        if panel not in PANELS:
            raise InputError("panel", f"one of {', '.join(PANELS)}", panel)
    chosen = [panel for panel in PANELS if not panels or panel in panels]
    if only is not None:
        chosen = [panel for panel in chosen if only in _PANEL_PHASES[panel]]
        if not chosen:
            raise InputError("panel", f"one that has the phase {only}", ", ".join(panels or ()))
    return chosen, only


def plan_points(
    contenders: dict[str, Competitor], *, mode: Mode, panels: list[str], only: str | None = None
) -> list[Task]:
    """Return the points of a chart except those of the profile and the twelve scenes, the most informative first."""
    tasks: list[tuple[int, Task]] = []
    for panel in panels:
        for turn, phase in enumerate(_PANEL_PHASES[panel]):
            if only not in (None, phase):
                continue
            if mode == "quick" and panel == "smoothed" and phase != "transient" and only is None:
                continue
            cases = MEMORY_CASES if panel == "memory" else ("", "smoothed") if panel == "exact" else ("",)
            for case in cases:
                for contender in contenders.values():
                    tasks += _points(contender, panel, phase, case, turn, mode)
    return [task for _, task in sorted(tasks, key=lambda pair: pair[0])]


def _points(contender: Competitor, panel: str, phase: str, case: str, turn: int, mode: Mode) -> list[tuple[int, Task]]:
    friction = friction_law(panel, case)
    if not contender.takes(friction):
        return []
    if case == "smoothed" and (contender.name != "tsit5" or phase not in ("whirl", "transient")):
        return []
    settings = contender.settings if mode == "full" else contender.quick
    if panel == RUB:
        settings = tuple(each for each in settings if not each.step_us or round(RUB_SAMPLE_S * 1e6) % each.step_us == 0)
        middle = len(settings) // 2
        settings = settings[1:-1:2] if contender.ours else settings[middle : middle + 1]
        if contender.known_failure or contender.family == "scipy":
            return []
    elif mode == "quick" and contender.known_failure and panel != "memory":
        settings = settings[:2]
    slow = contender.family in ("scipy", "MuJoCo")
    rank = 10 * list(_PANEL_PHASES).index(panel) + turn + (0 if contender.ours else 200 if slow else 100)
    return [(rank, Task(panel, phase, case, contender.name, setting)) for setting in settings]


def friction_law(panel: str, case: str) -> Literal["none", "smoothed", "exact"]:
    """Return the friction law of a panel's case."""
    if panel == "memory":
        return "none"
    return "smoothed" if panel == "smoothed" or case == "smoothed" else "exact"


def build_problem(
    panel: str, phase: str, case: str, *, smoothing_speed: float = SMOOTHING, end_s: float | None = None
) -> Problem:
    """Return the window on which a point is measured."""
    window = PHASES[phase]
    end = window.end_s if end_s is None else end_s
    changes = dict(window.changes)
    if panel == "memory":
        changes["contact.damping_factor"] = "lankarani-nikravesh"
    if window.scene:
        scene = load_scene(window.scene, {**changes, "model.friction": "exact"})
    else:
        scene = parse_scene(
            {"name": window.name, "duration_s": end, "drive": {"speed_hz": RUB_SPEED_HZ}, "set": changes}
        )
    return cut_window(
        scene,
        end_s=end,
        sample_s=FRAME_S if panel != RUB else RUB_SAMPLE_S,
        friction=friction_law(panel, case),
        smoothing_speed=smoothing_speed,
        **{"damping_factor": 0.0} if case == "no memory" else {},
    )


def scene_problem(name: str, *, end_s: float | None = None) -> Problem:
    """Return the window of one of the twelve scenes, with its own friction law.

    Args:
        name: Name of the scene.
        end_s: Earlier end of the window [s]; None for the scene's own.
    """
    study = TWELVE_SCENES[name]
    end_s = study.window_s if end_s is None else min(end_s, study.window_s)
    return cut_window(study.load(), end_s=end_s, sample_s=FRAME_S)
