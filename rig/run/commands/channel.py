"""Commands that act on channels: a fault begins, faults end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, FiniteFloat, model_validator

from rig.base.checks import check
from rig.base.errors import UnknownNameError
from rig.channels.faults import KINDS, AnyKind
from rig.run.commands.command import CanFrame, Run, SceneCommand

MAX_FAULT_S = 86_400.0
"""Longest time of a fault: a day, as no run is longer [s]."""


class _ChannelCommand(SceneCommand):
    """A command that the simulation's faults check."""

    MECHANICAL = False

    def check(self, run: Run, waiting: Sequence[Any]) -> dict[str, Any]:
        """Raise where there can be, or is, no such fault; return the number, channels and first rows of a new one."""
        return run.faulty.check(self, run.tick, waiting)


class FaultCommand(_ChannelCommand):
    """A channel, or a group of them, begins to misbehave: `rig.channels.faults` has the kinds and their numbers."""

    CAN = CanFrame(0x6B, event=8, shown="number of a fault", message="Fault")
    SHOWN_FIELD = "fault"
    command: Literal["fault"] = "fault"
    channel: str
    """A channel, or a group: all of its channels."""
    what: Annotated[AnyKind, Field(discriminator="kind")]
    """The kind and its numbers; they stand beside `channel`."""
    for_s: Annotated[FiniteFloat, Field(gt=0.0, le=MAX_FAULT_S)] | None = None
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

    def request(self) -> dict[str, Any]:
        """Return the fields as a client sends them: the channel and the numbers of the kind in one table."""
        timed = {} if self.for_s is None else {"for_s": self.for_s}
        return {"channel": self.channel, **self.what.model_dump(exclude_none=True), **timed}

    def take_effect(self, run: Run) -> list[dict[str, Any]]:
        """Begin the fault."""
        return [run.faulty.begin(self, run.tick, run.pending)]


class ClearCommand(_ChannelCommand):
    """Ends a fault, by its number, or all of them; from then on it is as if there had been none."""

    CAN = CanFrame(0x9A, event=9, message="Fault")
    TRIGGERS = False
    command: Literal["clear"] = "clear"
    id: Annotated[int, Field(ge=1)] | Literal["all"] = "all"

    def take_effect(self, run: Run) -> list[dict[str, Any]]:
        """End the faults; each has an event of its own."""
        return run.faulty.clear(self, run.tick)
