"""Plans of maps: TOML files, ready ones by name."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, FiniteFloat

from rig.base.checks import Written, check, read_json, read_toml
from rig.base.errors import InputError, UnknownNameError
from rig.ensemble.axes import Design
from rig.ensemble.batch import OUTCOMES, QUANTITIES, Batch
from rig.ensemble.keys import find_bounds
from rig.ensemble.plan import embed_parameters, find_versions
from rig.run.scenes import Scene, load_scene, parse_scene, scene_document, scene_names

_QUICK_BORDER, _QUICK_CELLS = 0.03, 12


class Second(Written):
    """Another quantity along the y axis, proportional to it."""

    label: str
    unit: str
    factor: Annotated[FiniteFloat, Field(gt=0.0)]


class Side(Written):
    """Axis of a map."""

    key: str
    start: Annotated[FiniteFloat, Field(alias="from")]
    stop: Annotated[FiniteFloat, Field(alias="to")]
    scale: Literal["linear", "log"] = "linear"
    label: str = ""
    second: Second | None = None

    def place(self, parts: Any) -> np.ndarray:
        """Return the values at fractions of the axis."""
        if self.scale == "log":
            return np.exp((1.0 - parts) * math.log(self.start) + parts * math.log(self.stop))
        return (1.0 - parts) * self.start + parts * self.stop

    def find_part(self, value: float) -> float:
        """Return the fraction of the axis at a value."""
        low, high = (math.log(each) if self.scale == "log" else each for each in (self.start, self.stop))
        return ((math.log(max(value, 1e-300)) if self.scale == "log" else value) - low) / (high - low)


class Panels(Written):
    """Key whose values are drawn side by side."""

    key: str
    values: Annotated[tuple[FiniteFloat, ...], Field(min_length=1, max_length=12)]
    label: str = ""


class Mark(Written):
    """Marked point."""

    x: FiniteFloat
    y: FiniteFloat
    label: str


class MapPlan(Written):
    """Content of a plan file."""

    title: str = ""
    scene: str
    """Name of a built-in scene, or path of a scene file, relative to the plan."""
    set: dict[str, Any] = Field(default={})
    """Changed values of the scene by key."""
    x: Side
    y: Side
    panels: Panels | None = None
    quantity: str = "outcome"
    """Outcome; or a number, drawn as a colour map without refinement unless `limits` divide it into classes."""
    limits: tuple[FiniteFloat, ...] = ()
    cells: Annotated[int, Field(ge=2, le=256)] = 16
    """Coarse cells along an axis."""
    border: Annotated[FiniteFloat, Field(ge=0.0005, le=0.5)] = 0.005
    """Largest width of a border cell, as a share of the axis."""
    margins: Annotated[int, Field(ge=0, le=12)] = 1
    """Levels at which neighbours of border cells are divided too."""
    check_runs: Annotated[int, Field(ge=0, le=100_000)] = 500
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    band_runs: Annotated[int, Field(ge=0, le=10_000)] = 0
    """Runs of the 95 % band over the assumed values at each of nine points along x."""
    overlay: Literal["", "dry whirl"] = ""
    """Closed-form conditions that are drawn over the map: x must be the friction, y the force of the hammer."""
    marks: tuple[Mark, ...] = ()


@dataclass(frozen=True)
class MapWork:
    """A checked plan.

    Attributes:
        plan: The plan.
        scene: The scene, with the plan's changes.
        text: JSON document of plan, scene and versions of packages.
    """

    plan: MapPlan
    scene: Scene
    text: str

    @property
    def keys(self) -> tuple[str, ...]:
        """Varied keys: panels if any, y and x; runs in this order share prepared models."""
        return (*([self.plan.panels.key] if self.plan.panels else []), self.plan.y.key, self.plan.x.key)

    @property
    def panel_values(self) -> tuple[float | None, ...]:
        """Values of the panels; None for a single one."""
        return self.plan.panels.values if self.plan.panels else (None,)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes; empty for a colour map."""
        if self.plan.quantity == "outcome":
            return OUTCOMES
        if not (limits := [f"{each:g}" for each in self.plan.limits]):
            return ()
        unit = QUANTITIES[self.plan.quantity].unit.replace("1", "")
        between = [f"{low} to {high} {unit}".strip() for low, high in pairwise(limits)]
        return (f"below {limits[0]} {unit}".strip(), *between, f"above {limits[-1]} {unit}".strip(), "failed")

    @property
    def levels(self) -> int:
        """Number of times that a coarse cell is divided."""
        return max(0, math.ceil(-math.log2(self.plan.border * self.plan.cells))) if self.classes else 0

    def create_batch(self, keys: tuple[str, ...]) -> Batch:
        """Return a batch of the scene; only outcomes are known before a run's end."""
        return Batch(self.scene, keys, early_end=self.plan.quantity == "outcome")

    def classify(self, table: dict[str, np.ndarray]) -> np.ndarray:
        """Return the class of each run of a table; 0 for a colour map."""
        if self.plan.quantity == "outcome":
            return np.array([self.classes.index(each) for each in table["outcome"]], np.int16)
        values = self.read_quantity(table)
        codes = np.where(np.isnan(values), len(self.plan.limits) + 1, np.digitize(values, self.plan.limits))
        return codes.astype(np.int16) if self.classes else np.zeros(len(values), np.int16)

    def read_quantity(self, table: dict[str, np.ndarray]) -> np.ndarray:
        """Return the quantity of each run of a table; NaN if it failed."""
        return np.where(table["outcome"] == "failed", np.nan, table[self.plan.quantity])

    def unit(self, key: str) -> str:
        """Return the unit of a key, "1" without one."""
        return find_bounds(self.scene, key).unit or "1"


def plan_names() -> list[str]:
    """Return the names of the ready plans."""
    return sorted(each.name.removesuffix(".toml") for each in files("replays.studies.maps").joinpath("plans").iterdir())


def read_map_plan(name: str, *, quick: bool = False) -> MapWork:
    """Return a ready plan by name, or a plan file.

    Args:
        name: Name or path.
        quick: Use wider border cells and a coarser colour map.

    Raises:
        InputError: The file cannot be read, or a field is wrong.
    """
    path = Path(str(files("replays.studies.maps"))) / "plans" / f"{name}.toml"
    if not path.is_file():
        path = Path(name)
        if not path.suffix:
            raise UnknownNameError("PLAN", f"one of {', '.join(plan_names())}, or a file", name, plan_names())
    plan = check(MapPlan, read_toml(path), field="")
    if quick:
        coarse = {"border": max(plan.border, _QUICK_BORDER), "check_runs": min(plan.check_runs, 100)}
        coarse |= {"cells": min(plan.cells, _QUICK_CELLS), "band_runs": min(plan.band_runs, 16)}
        plan = plan.model_copy(update=coarse)
    file = plan.scene if plan.scene in scene_names() else path.parent / plan.scene
    scene = embed_parameters(load_scene(file, plan.set))
    _check_plan(plan, scene)
    document = {
        "title": plan.title, "plan": plan.model_dump(mode="json", by_alias=True), "scene": scene_document(scene),
        "versions": find_versions(),
    }  # fmt: skip
    return load_map_work(json.dumps(document, indent=1) + "\n")


def load_map_work(text: str) -> MapWork:
    """Return the work of a plan's document, which was checked by `read_map_plan`."""
    document = read_json(text.encode(), field="plan")
    return MapWork(check(MapPlan, document["plan"], field=""), parse_scene(document["scene"]), text)


def _check_plan(plan: MapPlan, scene: Scene) -> None:
    scene.check_physics()
    known = ["outcome", *(name for name, each in QUANTITIES.items() if each.kind == "number")]
    if plan.quantity not in known:
        raise UnknownNameError("quantity", "outcome, or a number of a run", plan.quantity, known)
    if plan.limits and (plan.quantity == "outcome" or list(plan.limits) != sorted({*plan.limits})):
        raise InputError("limits", "increasing numbers, of a quantity other than outcome", list(plan.limits))
    over: dict[str, Any] = {}
    for name, side in (("x", plan.x), ("y", plan.y)):
        if side.key in over:
            raise InputError(f"{name}.key", "another key than that of x", side.key)
        if not side.start < side.stop or (side.scale == "log" and side.start <= 0.0):
            raise InputError(f"{name}.to", "greater than from, and from greater than 0 with scale log", side.stop)
        over[side.key] = [side.start, side.stop]
    if plan.panels:
        if plan.panels.key in over:
            raise InputError("panels.key", "another key than those of x and y", plan.panels.key)
        over[plan.panels.key] = list(plan.panels.values)
    if plan.overlay and (plan.x.key, plan.y.key) != ("contact.friction", "hammer.force_n"):
        raise InputError("overlay", "left out unless x is contact.friction and y hammer.force_n", plan.overlay)
    if plan.band_runs and (plan.quantity == "outcome" or plan.limits):
        raise InputError("band_runs", "left out, except for a quantity without limits", plan.band_runs)
    Design.create(scene, over, runs=None, sampling="grid", seed=1)
