"""Commands that act on channels: inject and clear faults."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, FiniteFloat, model_validator

from rig.base.checks import check
from rig.base.errors import InputError, UnknownNameError
from rig.channels.faults import KINDS, AnyKind, Kind
from rig.run.commands.command import CanFrame, Run, SceneCommand

MAX_FAULT_S = 86_400.0
"""Longest duration of a fault [s]: a day, as no run is longer."""


def check_fault(numbers: dict[str, Any]) -> Kind:
    """Return a fault, given its kind and numbers by name.

    Raises:
        InputError: There is no such kind, it does not take one of the numbers, or a number is missing or out of range;
            the field is `KIND.NUMBER`.
    """
    kind = numbers.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise UnknownNameError("kind", "one of the kinds", kind, KINDS)
    takes = [name for name in KINDS[kind].model_fields if name != "kind"]
    for name, value in numbers.items():
        if name not in KINDS[kind].model_fields:
            raise InputError(f"{kind}.{name}", f"left out: {kind} takes {', '.join(takes) or 'no numbers'}", value)
    return check(KINDS[kind], numbers, field=kind)


class _ChannelCommand(SceneCommand):
    """A command that is checked against the faults of the simulation."""

    MECHANICAL = False

    def check(self, run: Run, waiting: Sequence[Any]) -> dict[str, Any]:
        """Raise an error for an impossible fault; return the number, channels and first rows of a new one."""
        return run.faults.check(self, run.tick, waiting)


class FaultCommand(_ChannelCommand):
    """Injects a fault into a channel or a group; kinds and parameters are in `rig.channels.faults`."""

    CAN = CanFrame(0x6B, event=8, shown="number of a fault", message="Fault")
    SHOWN_FIELD = "fault"
    command: Literal["fault"] = "fault"
    channel: str
    """A channel, or a group for all of its channels."""
    what: Annotated[AnyKind, Field(discriminator="kind")]
    """Kind and parameters; serialised next to `channel`."""
    for_s: Annotated[FiniteFloat, Field(gt=0.0, le=MAX_FAULT_S)] | None = None
    """Duration [s]; None: until it is cleared."""

    @model_validator(mode="before")
    @classmethod
    def _nest_fields(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "what" in data:
            return data
        fields = {key: value for key, value in data.items() if key in cls.model_fields}
        parameters = {key: value for key, value in data.items() if key not in fields}
        return {**fields, "what": check_fault(parameters)}

    def request(self) -> dict[str, Any]:
        """Return the fields as a client sends them: the channel and the parameters of the kind in one table."""
        timed = {} if self.for_s is None else {"for_s": self.for_s}
        return {"channel": self.channel, **self.what.model_dump(exclude_none=True), **timed}

    def take_effect(self, run: Run) -> list[dict[str, Any]]:
        """Inject the fault."""
        return [run.faults.begin(self, run.tick, run.pending)]


class ClearCommand(_ChannelCommand):
    """Clears a fault by its number, or all; afterwards the signal is as without the fault."""

    CAN = CanFrame(0x9A, event=9, message="Fault")
    TRIGGERS = False
    command: Literal["clear"] = "clear"
    id: Annotated[int, Field(ge=1)] | Literal["all"] = "all"

    def take_effect(self, run: Run) -> list[dict[str, Any]]:
        """Clear the faults; each has a separate event."""
        return run.faults.clear(self, run.tick)
