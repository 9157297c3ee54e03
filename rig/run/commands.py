"""What can be done to the rig while it runs: a pulse of the hammer, another speed, the magnets' release, faults."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, FiniteFloat, field_validator, model_validator

from rig.base.errors import InputError, UnknownNameError
from rig.base.outside import Written, check
from rig.channels.faults import KINDS, AnyKind

_DIRECTIONS = {"x": (1.0, 0.0), "y": (0.0, 1.0), "-x": (-1.0, 0.0), "-y": (0.0, -1.0)}


class _Command(Written):
    # `"100"` is no number, be it in a file or on a wire.
    model_config = ConfigDict(strict=True)


class HammerCommand(_Command):
    """An impact of the pendulum hammer on the disk: a half-sine pulse."""

    command: Literal["hammer"] = "hammer"
    force_n: Annotated[FiniteFloat, Field(ge=1.0, le=1000.0)] = 100.0
    """Peak force [N]."""
    duration_ms: Annotated[FiniteFloat, Field(ge=0.5, le=50.0)] = 5.0
    """Length of the pulse [ms]; the paper gives none."""
    direction: str | float = "x"
    """Along x (EAST), y (up), or at an angle from x toward y [degrees]."""

    @field_validator("direction")
    @classmethod
    def _a_direction(cls, direction: str | float) -> str | float:
        good = direction in _DIRECTIONS if isinstance(direction, str) else -360.0 <= direction <= 360.0
        if not good:
            raise ValueError(f"{', '.join(_DIRECTIONS)}, or an angle from -360 to 360 degrees")
        return direction

    @property
    def cosines(self) -> tuple[float, float]:
        """Direction as a unit vector (x, y)."""
        if isinstance(self.direction, str):
            return _DIRECTIONS[self.direction]
        angle = math.radians(self.direction)
        return math.cos(angle), math.sin(angle)


class SpeedCommand(_Command):
    """A new speed, approached at the drive's ramp rate."""

    command: Literal["speed"] = "speed"
    speed_hz: Annotated[FiniteFloat, Field(ge=0.0)]
    """Target [Hz]; the parameter drive.top_speed limits it further."""


class ReleaseCommand(_Command):
    """The drop device: the magnets let go of the shaft."""

    command: Literal["release"] = "release"


class FaultCommand(_Command):
    """A channel, or a group of them, begins to misbehave: `rig.channels.faults` has the kinds and their numbers."""

    command: Literal["fault"] = "fault"
    channel: str
    """A channel, or a group: all of its channels."""
    what: Annotated[AnyKind, Field(discriminator="kind")]
    """The kind and its numbers; they stand beside `channel`."""
    for_s: Annotated[FiniteFloat, Field(gt=0.0, le=86_400.0)] | None = None
    """How long [s]; until it is cleared unless given."""

    @model_validator(mode="before")
    @classmethod
    def _flat(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "what" in data:
            return data
        own = {key: value for key, value in data.items() if key in cls.model_fields}
        rest = {key: value for key, value in data.items() if key not in own}
        kind = rest.get("kind")
        if not isinstance(kind, str) or kind not in KINDS:
            raise UnknownNameError("kind", "one of the kinds", kind, KINDS)
        return {**own, "what": check(KINDS[kind], rest, field="")}


class ClearCommand(_Command):
    """Ends a fault, by its number, or all of them; from then on it is as if there had been none."""

    command: Literal["clear"] = "clear"
    id: Annotated[int, Field(ge=1)] | Literal["all"] = "all"


Command = HammerCommand | SpeedCommand | ReleaseCommand | FaultCommand | ClearCommand
COMMANDS: dict[str, type[Command]] = {
    "hammer": HammerCommand, "speed": SpeedCommand, "release": ReleaseCommand, "fault": FaultCommand,
    "clear": ClearCommand,
}  # fmt: skip
SERVICE_COMMANDS = ("stop", "step", "note", "join", "done", "leave")
"""Commands that the service carries out, and no simulation."""


def _bounds(command: type[Command], field: str) -> tuple[float, float]:
    low, high = (
        next(getattr(mark, end) for mark in command.model_fields[field].metadata if hasattr(mark, end))
        for end in ("ge", "le")
    )
    return low, high


HAMMER_BOUNDS = {field: _bounds(HammerCommand, field) for field in ("force_n", "duration_ms")}
"""Least and largest peak force [N] and length [ms] of a hammer pulse, by field."""


def refusal(command: object) -> InputError:
    """Return the error for a command of the table that nothing carries out."""
    return InputError("command", "one that is carried out here", type(command).__name__)


class TimedCommand(Written):
    """A command at a fixed time of the scene."""

    at_s: Annotated[FiniteFloat, Field(ge=0.0)]
    request: Annotated[Command, Field(discriminator="command")]

    @model_validator(mode="before")
    @classmethod
    def _flat(cls, data: Any) -> Any:
        # In the file the command's own fields stand beside at_s.
        if isinstance(data, dict) and "request" not in data:
            return {"at_s": data.get("at_s"), "request": {key: value for key, value in data.items() if key != "at_s"}}
        return data


def check_command(name: str, request: dict[str, Any]) -> Command:
    """Check a command that came from outside.

    Raises:
        InputError: No such command, an unknown field, or a value out of its range; the message names the range.
    """
    if name not in COMMANDS:
        raise InputError("command", f"one of {', '.join(COMMANDS)}", name)
    return check(COMMANDS[name], request, field=name)


def with_faults(scene: Any) -> Any:
    """A scene as it is written, whose faults, under a heading of their own there, stand among its commands.

    Raises:
        InputError: They are no tables.
    """
    if not isinstance(scene, dict) or "faults" not in scene:
        return scene
    faults, commands = scene["faults"], scene.get("commands", ())
    if not isinstance(faults, list | tuple) or not all(isinstance(each, dict) for each in faults):
        raise InputError("faults", "a list of tables, each headed [[faults]]", faults)
    rest = {key: value for key, value in scene.items() if key != "faults"}
    if isinstance(commands, list | tuple):
        rest["commands"] = [*commands, *({"command": "fault", **each} for each in faults)]
    return rest
