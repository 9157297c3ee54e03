"""Keys that a design varies: those of `rig.load_scene`, and fields of the scene's commands, such as hammer.force_n."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from rig.base.errors import InputError, such_as
from rig.physics.parameters import load_parameters
from rig.run.commands.table import COMMANDS, TimedCommand, check_command
from rig.run.scenes import Scene, load_scene, parse_scene

_UNITS = {"hz": "Hz", "mm": "mm", "s": "s", "ms": "ms", "us": "us", "n": "N", "deg": "deg"}
"""Unit by the suffix of a key."""
_OTHER_NAMES = {"angle_deg": "direction"}
"""Fields of commands under a name with a unit."""


class Bounds(NamedTuple):
    """Accepted numbers of a key [its unit]; infinite where the key has no limit."""

    low: float
    high: float
    unit: str


def find_bounds(scene: Scene, key: str) -> Bounds:
    """Return limits and unit of a key; of an unknown key, infinite limits (`vary` refuses it)."""
    if (entry := load_parameters().entries.get(key)) is not None:
        return Bounds(*entry.range, "" if entry.unit in ("1", "count") else entry.unit)
    name, _, field = key.partition(".")
    unit = _UNITS.get(key.rpartition("_")[2], "") if "_" in key else ""
    low, high = -math.inf, math.inf
    if name in COMMANDS and field != "at_s":
        quantity = COMMANDS[name].quantities().get(_OTHER_NAMES.get(field, field))
        low, high = (low, high) if quantity is None else (quantity.low, quantity.high)
        if field == "angle_deg":
            low, high = -360.0, 360.0
    else:
        fields: Any = TimedCommand if name in COMMANDS else Scene
        for part in key.split(".")[name in COMMANDS :]:
            found = getattr(fields, "model_fields", {}).get(part)
            fields = None if found is None else found.annotation
            for limit in () if found is None else found.metadata:
                low = max(low, getattr(limit, "ge", getattr(limit, "gt", -math.inf)))
                high = min(high, getattr(limit, "le", getattr(limit, "lt", math.inf)))
    top = scene.load_parameters().entries["drive.top_speed"].value
    if field == "speed_hz" and not isinstance(top, str):
        high = min(high, top)
    return Bounds(low, high, unit)


def vary(scene: Scene, changes: dict[str, Any]) -> Scene:
    """Return a scene with changed values, of its first command of a name too.

    Args:
        scene: The scene.
        changes: Values by key, as in `rig.load_scene`, or `hammer.force_n`, `hammer.angle_deg`, `hammer.at_s`,
            `speed.speed_hz` for a command.

    Raises:
        InputError: A key is unknown, or a value is not accepted.
    """
    commands = list(scene.commands)
    rest = {}
    for key, value in changes.items():
        name, _, field = key.partition(".")
        if name not in COMMANDS or not field:
            rest[key] = value
            continue
        place = next((place for place, each in enumerate(commands) if each.request.command == name), None)
        if place is None:
            must = such_as("a field of a command that the scene has", key, [each.request.command for each in commands])
            raise InputError(key, must, value)
        update = {"at_s": value}
        if field != "at_s":
            request = {**commands[place].request.model_dump(), _OTHER_NAMES.get(field, field): value}
            update = {"request": check_command(name, request)}
        commands[place] = commands[place].model_copy(update=update)
    if len(rest) < len(changes):
        dumped = [{"at_s": each.at_s, "request": dict(each.request)} for each in commands]
        scene = parse_scene({**scene.model_dump(), "commands": dumped})
    return load_scene(scene, rest) if rest else scene
