"""Table of all scene commands, and the tables derived from it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Union

from pydantic import Field, FiniteFloat, model_validator

from rig.base.checks import Written, check
from rig.base.errors import InputError
from rig.run.commands import SUMMARIES, channel, mechanical
from rig.run.commands.channel import ClearCommand, FaultCommand  # noqa: F401
from rig.run.commands.command import SceneCommand, find_commands
from rig.run.commands.mechanical import HammerCommand, ReleaseCommand, SpeedCommand  # noqa: F401

_ENTRIES = find_commands(mechanical) | find_commands(channel)
COMMANDS: dict[str, type[SceneCommand]] = {name: _ENTRIES[name] for name in SUMMARIES if name in _ENTRIES}
if TYPE_CHECKING:
    Command = SceneCommand
else:
    Command = Union[tuple(COMMANDS.values())]
SERVICE_COMMANDS = ("stop", "step", "note", "join", "done", "leave")
"""Commands executed by the service, not by a simulation."""
EVENT_KINDS = ("start", "command", *COMMANDS, "note", "device", "warning", "end")
"""All values of `event` that a rig publishes."""
MECHANICAL = tuple(name for name, command in COMMANDS.items() if command.MECHANICAL)
"""Commands that act on the shaft."""
TRIGGERS = tuple(name for name, command in COMMANDS.items() if command.TRIGGERS)
"""Commands whose events can start a capture."""
QUANTITIES = {field: each for command in COMMANDS.values() for field, each in command.quantities().items()}
"""Fields with a unit, of all commands; a name is the same quantity in every command."""
HAMMER_BOUNDS = {
    name: (each.low, each.high) for name, each in HammerCommand.quantities().items() if not each.takes_text
}
"""Smallest and largest peak force [N] and duration [ms] of a hammer pulse, by field."""


class TimedCommand(Written):
    """A command at a fixed time of the scene."""

    at_s: Annotated[FiniteFloat, Field(ge=0.0)]
    request: Annotated[Command, Field(discriminator="command")]

    @model_validator(mode="before")
    @classmethod
    def _nest_fields(cls, data: Any) -> Any:
        # In the file the command's own fields are next to at_s.
        if isinstance(data, dict) and "request" not in data:
            return {"at_s": data.get("at_s"), "request": {key: value for key, value in data.items() if key != "at_s"}}
        return data


def check_command(name: str, request: dict[str, Any]) -> SceneCommand:
    """Return a command from outside after checking it.

    Raises:
        InputError: The command or a field is unknown, or a value is out of range; the message has the range.
    """
    if name not in COMMANDS:
        raise InputError("command", f"one of {', '.join(COMMANDS)}", name)
    return check(COMMANDS[name], request, field=name)


def nest_faults(scene: Any) -> Any:
    """Return a scene file's data with the entries of [[faults]] moved to its commands.

    Raises:
        InputError: The faults are not tables.
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
