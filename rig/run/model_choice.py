"""The pick of `rig ladder` for a scene: the cheapest model, engine and step within the tolerances."""

from __future__ import annotations

import ast
import hashlib
from pathlib import Path
from typing import Any, Literal

from pydantic import FiniteFloat

from rig.base.checks import Written, get_table
from rig.physics.levels import ModelLevels

_RIG = Path(__file__).parents[1]
_WORDS = ("base/errors", "base/outside", "base/text")
"""Modules that only report errors of input, and compute nothing."""


class PickedQuantity(Written):
    """A quantity of a pick, with its errors as `rig ladder` measured them."""

    quantity: str
    unit: str = ""
    tolerance: FiniteFloat
    """Allowed error, relative to the quantity's scale."""
    value: FiniteFloat | str
    """Value with the picked model and engine [unit]."""
    reference: FiniteFloat | str
    """Value with the full model and the reference engine [unit]."""
    model_error: FiniteFloat
    """Error of the picked levels against the full model, both converged."""
    numerical_error: FiniteFloat
    """Error of the picked engine against a converged one on the picked levels."""
    total_error: FiniteFloat
    reference_error: FiniteFloat
    """Error of the reference: its distance from a different engine."""


class Pick(Written):
    """The cheapest model, engine and step that `rig ladder` found, with the data that the pick depends on."""

    magnet: str
    shaft: str
    stator: str
    contact: str
    friction: str
    drive: Literal["torque", "ideal"]
    sensors: Literal["ideal", "full"]
    engine: str
    step_us: int
    engine_tolerance: FiniteFloat = 0.0
    companion: bool | None = None
    """None in a pick of an earlier version: as in the scene."""
    quantities: tuple[PickedQuantity, ...]
    cpu_s: FiniteFloat
    """Processor time per simulated second of the pick, with its sensors [s]."""
    cpu_given_s: FiniteFloat
    """The same for the unchanged scene [s]."""
    cpu_full_s: FiniteFloat
    """The same for the full model with the reference engine [s]."""
    reference_engine: str = ""
    unlike_engine: str = ""
    """Engine whose distance from the reference is the error of the reference."""
    date: str = ""
    rig: str = ""
    """Version of the rig."""
    commit: str = ""
    machine: str = ""
    seed: int = 0
    scene_digest: str
    parameters_digest: str
    code_digest: str

    def apply(self, data: dict[str, Any]) -> dict[str, Any]:
        """Return a scene's data with the fields of the pick."""
        levels = {name: getattr(self, name) for name in ModelLevels.model_fields}
        engine: dict[str, Any] = {"name": self.engine, "step_us": self.step_us, "tolerance": self.engine_tolerance}
        if self.companion is not None:
            engine["companion"] = self.companion
        scene_engine = dict(get_table(data, "engine"))
        if self.companion is False:
            scene_engine.pop("limits", None)  # without a companion there is no error estimate to limit
        return {
            **data,
            "model": levels,
            "engine": {**scene_engine, **engine},
            "drive": {**get_table(data, "drive"), "mode": self.drive},
            "sensors": {**get_table(data, "sensors"), "chain": self.sensors},
        }


def digest(*parts: bytes) -> str:
    """Return the digest of the parts in their order, hexadecimal."""
    total = hashlib.sha256()
    for part in parts:
        total.update(len(part).to_bytes(8, "big") + part)
    return total.hexdigest()[:16]


def equations_digest(rig: Path = _RIG) -> str:
    """Return the digest of the code of model, kernels and engines, and of every module of the rig that they use.

    Args:
        rig: Folder of the package.
    """
    code_by_name: dict[str, bytes] = {}
    waiting = [rig / "physics" / name for name in ("model.py", "kernels", "engines")]
    while waiting:
        place = waiting.pop()
        for file in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            name = file.relative_to(rig).as_posix()
            if name in code_by_name:
                continue
            # Line ends differ between systems.
            code_by_name[name] = file.read_bytes().replace(b"\r\n", b"\n")
            used = _modules_used(code_by_name[name]) - {*_WORDS}
            waiting += [rig / each if (rig / each).is_dir() else rig / f"{each}.py" for each in sorted(used)]
    return digest(*(part for name in sorted(code_by_name) for part in (name.encode(), code_by_name[name])))


def _modules_used(code: bytes) -> set[str]:
    """Return the paths of the rig's modules and packages that a module imports."""
    names = []
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            names += [each.name for each in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [f"{node.module}.{each.name}" for each in node.names]
    return {"/".join(name.split(".")[1:3]) for name in names if name.startswith("rig.")}
