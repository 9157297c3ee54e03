"""Plans of sweeps: TOML files, checked and made independent of other files, so that any worker can run a task."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, StrictBool

from rig.base.checks import Written, check, read_json, read_toml
from rig.base.errors import InputError, Words
from rig.ensemble.axes import MAX_RUNS, Design, Sampling
from rig.ensemble.ensemble import check_quantities
from rig.physics.parameters import DEFAULT_SET, load_parameters, set_names
from rig.run.scenes import Scene, load_scene, parse_scene, scene_document, scene_names

_PACKAGES = ("rotor-stator-rig", "numpy", "scipy", "numba", "pyarrow")
"""Packages that determine the bytes of a part."""
_MAX_TASKS = 1_000_000
"""Most tasks: each is a file in one folder."""

_AXIS_FIELDS = {"values", "from", "to", "scale", "distribution", "mean", "std"}
"""Fields of an axis that are no part of a key, as count is of magnet.count."""


class Plan(Written):
    """Content of a plan file."""

    scene: str
    """Name of a built-in scene, or path of a scene file, relative to the plan."""
    title: str = ""
    runs: Annotated[int, Field(ge=1, le=MAX_RUNS, strict=True)] | None = None
    """Number of runs; left out for a grid."""
    sampling: Sampling | None = None
    seed: Annotated[int, Field(ge=0, lt=2**63, strict=True)] = 1
    quantities: tuple[str, ...] | None = None
    task_runs: Annotated[int, Field(ge=1, le=1_000_000, strict=True)] = 2000
    """Runs of a task, which is one part of the output."""
    early_end: StrictBool = True
    """End a run as soon as its outcome is known."""
    set: dict[str, Any] = Field(default={})
    """Changed values of the scene by key."""
    over: dict[str, Any]
    """Axes by key."""


@dataclass(frozen=True)
class Work:
    """Runs of a plan, in tasks.

    Attributes:
        text: The plan as a JSON document without references to files, with the versions of the packages.
        document: The same, read.
        scene: The scene.
        design: Values of the runs.
    """

    text: str
    document: dict[str, Any]
    scene: Scene
    design: Design

    @property
    def tasks(self) -> int:
        """Number of tasks."""
        return -(-self.design.runs // self.document["task_runs"])

    def find_range(self, task: int) -> tuple[int, int]:
        """Return the number of a task's first run, and the number after its last run."""
        size = self.document["task_runs"]
        return task * size, min((task + 1) * size, self.design.runs)


@cache
def find_versions() -> dict[str, str]:
    """Return the versions of the packages that determine the bytes of a part."""
    return {name: version(name) for name in _PACKAGES}


def flatten(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a table of axes by dotted key; a key is written in quotes, or as nested tables."""
    flat: dict[str, Any] = {}
    for name, value in table.items():
        is_axis = not isinstance(value, dict) or not value or _AXIS_FIELDS & value.keys()
        found = {prefix + name: value} if is_axis else flatten(value, f"{prefix}{name}.")
        for key in found.keys() & flat.keys():
            raise InputError(f"over.{key}", "given once", Words("two tables"))
        flat |= found
    return flat


def embed_parameters(scene: Scene) -> Scene:
    """Return a scene whose parameters do not depend on a file, which a worker may not have."""
    if scene.parameters in set_names():
        return scene
    own, usual = scene.load_parameters().entries, load_parameters().entries
    changed = {key: entry.value for key, entry in own.items() if entry.value != usual[key].value}
    return parse_scene({**scene.model_dump(), "parameters": DEFAULT_SET, "set": changed})


def read_plan(path: Path) -> Work:
    """Return the work of a plan file.

    Raises:
        InputError: The file cannot be read, or a field is wrong.
    """
    plan = check(Plan, read_toml(path), field="")
    file = plan.scene if plan.scene in scene_names() else path.parent / plan.scene
    scene = load_scene(file, plan.set)
    scene.check_physics()
    scene = embed_parameters(scene)
    over = flatten(plan.over)
    design = Design.create(scene, over, runs=plan.runs, sampling=plan.sampling, seed=plan.seed)
    if design.runs > _MAX_TASKS * plan.task_runs:
        least = -(-design.runs // _MAX_TASKS)
        raise InputError("task_runs", f"at least {least}, as a sweep has at most {_MAX_TASKS} tasks", plan.task_runs)
    document = {
        "title": plan.title,
        "scene": scene_document(scene),
        "over": {key: axis.model_dump(by_alias=True, exclude_none=True) for key, axis in design.axes.items()},
        "sampling": design.sampling,
        "runs": design.runs,
        "seed": plan.seed,
        "quantities": check_quantities(plan.quantities),
        "task_runs": plan.task_runs,
        "early_end": plan.early_end,
        "versions": find_versions(),
    }
    return load_work(json.dumps(document, indent=1, allow_nan=False) + "\n")


@lru_cache(maxsize=4)
def load_work(text: str) -> Work:
    """Return the work of a plan's document, which was checked by `read_plan`."""
    document = read_json(text.encode(), field="plan")
    scene = parse_scene(document["scene"])
    runs, sampling, seed = (document[name] for name in ("runs", "sampling", "seed"))
    design = Design.create(scene, document["over"], runs=runs, sampling=sampling, seed=seed, checks=False)
    return Work(text, document, scene, design)


def find_difference(text: str, other: str) -> str | None:
    """Return the first difference between two plans as "name: value, not value"; None if they are equal."""
    plans = [read_json(each.encode(), field="plan") for each in (text, other)]
    versions = [plan.pop("versions", {}) for plan in plans]
    for kind, (a, b) in (("", versions), ("another ", plans)):
        for name in (*a, *b):
            if a.get(name) != b.get(name):
                return kind + name if kind else f"{name} {b.get(name)}, not {a.get(name)}"
    return None
