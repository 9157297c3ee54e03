"""Atlas of the twelve scenes: the outcome at every step or tolerance of each engine and peer.

The reference is `taylor` at 1e-11, confirmed by `rk8`. Runs of our engines are whole simulations with a companion,
which can warn; a peer can only give up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from replays.report.canvas import GREEN, RED, house_style, new_figure, save
from replays.studies.chart.measure import Budget, run_peer
from replays.studies.chart.methods import Competitor, competitors
from replays.studies.chart.phases import scene_problem
from replays.studies.chart.store import code_digest
from replays.studies.common.twelve_scenes import TWELVE_SCENES
from replays.studies.peers import Setting
from replays.studies.peers.common.problem import scaled_error
from replays.studies.stability.scenes.truth import AGREE_ERROR, WRONG_ERROR, is_doubted
from replays.studies.stability.scenes.worker import Task, run_task
from replays.studies.stability.table import choose_names
from rig.base.errors import SimulationError
from rig.run.scenes import Scene

OUTCOMES = {
    "right": (GREEN, "right: error at most 0.01"),
    "near": ("#A6D854", "near: at most 0.1"),
    "warned": ("#F0C000", "wrong, and warns"),
    "silent": (RED, "wrong without a warning"),
    "gained": ("#7A0177", "wrong without a warning, and energy gained"),
    "ended": ("0.1", "gives up, or takes more than 20 s"),
    "refused": ("0.88", "cannot take the friction law"),
}
"""Kinds of outcome with colour and description."""
HATCHES = {"warned": "..", "silent": "///", "gained": "xxx"}
"""Hatches that mark wrong runs in print."""
_LIMIT_S = 20.0
"""Processor time per run [s]."""
_GAINED = 0.01
"""Energy residual, relative to the dissipated energy, above which energy counts as gained."""


class SceneOutcome(NamedTuple):
    """Outcome of one run."""

    scene: str
    method: str
    setting: str
    kind: str
    """Key of `OUTCOMES`."""
    error: float | None
    """Scaled error [1]; None for an incomplete run."""

    def document(self) -> dict[str, Any]:
        """Return the outcome by field."""
        return self._asdict()


def select_scenes(only: str | None) -> list[str]:
    """Return the scenes of a comma-separated list, in the order of the study; None selects all.

    Raises:
        InputError: If a scene does not exist, or the list is empty.
    """
    return choose_names("--only", only, list(TWELVE_SCENES))


def is_silent(one: SceneOutcome) -> bool:
    """Return whether a run is wrong without a warning."""
    return one.kind in ("silent", "gained")


def exact_states(scene: Scene) -> np.ndarray:
    """Return the states of a scene every millisecond, shape (n, N_STATE).

    Raises:
        SimulationError: If `taylor` and `rk8` do not agree.
    """
    first, second = (run_task(Task(scene, name, tolerance)) for name, tolerance in (("taylor", 1e-11), ("rk8", 1e-11)))
    failed = first.failure or second.failure
    if failed or scaled_error(first.states, second.states) > AGREE_ERROR:
        raise SimulationError(f"no two accurate engines agree on scene {scene.name}")
    return first.states


def outcomes(scenes: list[str], methods: list[str] | None = None, *, peers: bool = True) -> Iterator[SceneOutcome]:
    """Run every method at each of its settings in each scene.

    Args:
        scenes: Names of scenes.
        methods: Names of methods; None for all.
        peers: Whether to include the installed peers.

    Raises:
        SimulationError: If no two accurate engines agree on a scene.
    """
    for name in scenes:
        study = TWELVE_SCENES[name]
        scene = study.load().model_copy(update={"duration_s": study.window_s})
        exact = exact_states(scene)
        for one in competitors(peers=peers).values():
            if one.known_failure or (methods is not None and one.name not in methods):
                continue
            if not one.ours and not one.takes("exact"):
                continue
            for setting in one.quick:
                kind, error = "refused", None
                if one.takes(scene.model.friction):
                    ran = _ours(one, setting, scene, exact) if one.ours else _peer(one, setting, name, exact)
                    kind, error = ran
                yield SceneOutcome(name, one.name, setting.label, kind, error)


def _ours(one: Competitor, setting: Setting, scene: Scene, exact: np.ndarray) -> tuple[str, float | None]:
    done = run_task(Task(scene, one.name, setting.tolerance, limit_s=_LIMIT_S, step_us=setting.step_us))
    if done.failure:
        return "refused" if done.failure == "refused" else "ended", None
    error = scaled_error(done.states, exact)
    gained = float(done.health["energy"]["residual_share"])
    return _kind(error, warns=is_doubted(done.health), gained=gained), error


def _peer(one: Competitor, setting: Setting, name: str, exact: np.ndarray) -> tuple[str, float | None]:
    done = run_peer(one.name, setting, scene_problem(name), Budget(_LIMIT_S, 1))
    if done.failure:
        return "ended", None
    error = scaled_error(done.solution.states[: len(exact)], exact)
    return _kind(error, warns=False, gained=0.0), error


def _kind(error: float, *, warns: bool, gained: float) -> str:
    if not math.isfinite(error) or error > WRONG_ERROR:
        silent = "gained" if gained > _GAINED else "silent"
        return "warned" if warns else silent
    return "right" if error <= AGREE_ERROR else "near"


@house_style()
def draw_scene_atlas(folder: Path, results: list[SceneOutcome]) -> list[Path]:
    """Draw a row per method and a column per scene: outcomes of its settings, coarsest first.

    Returns:
        The files: PNG and SVG.
    """
    scenes, methods = (list(dict.fromkeys(getattr(one, key) for one in results)) for key in ("scene", "method"))
    figure = new_figure(1.6 + 0.42 * len(methods), "Twelve scenes: what becomes of each, the coarsest setting first")
    axes = figure.subplots()
    for y, method in enumerate(methods):
        for x, scene in enumerate(scenes):
            cell = [one for one in results if (one.scene, one.method) == (scene, method)]
            for place, one in enumerate(cell):
                width, colour = 0.86 / len(cell), OUTCOMES[one.kind][0]
                left, hatch = x - 0.43 + place * width, HATCHES.get(one.kind, "")
                axes.barh(y, 0.9 * width, 0.7, left, color=colour, hatch=hatch, edgecolor="white", lw=0.0)
    axes.set_yticks(range(len(methods)), methods)
    axes.set_xticks(range(len(scenes)), [TWELVE_SCENES[scene].title.replace(" of ", "\nof ") for scene in scenes])
    axes.tick_params(axis="x", rotation=40, labelsize=9)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.set(xlim=(-0.5, len(scenes) - 0.5), ylim=(len(methods) - 0.5, -0.5))
    for kind, (colour, title) in OUTCOMES.items():
        axes.bar(0, 0, color=colour, hatch=HATCHES.get(kind, ""), edgecolor="white", lw=0.0, label=title)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    paths = (folder / f"stability-scenes{suffix}" for suffix in (".png", ".svg"))
    return save(figure, *paths, source=f"code {code_digest()}")
