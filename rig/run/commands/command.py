"""Base class of the scene commands, and the annotations of their fields and CAN frames.

Recorders and drivers import the commands, so a command must not import the simulation: it receives a `Run`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, ClassVar, NamedTuple, Protocol

from pydantic import ConfigDict

from rig.base.checks import Written
from rig.base.errors import InputError
from rig.run.commands import SUMMARIES

UNBOUNDED = (-math.inf, math.inf)


@dataclass(frozen=True, slots=True)
class CanField:
    """Signal of a field in the frame of its command, after the signals of the fields before it.

    Attributes:
        name: Name of the signal.
        number: Number of the field in the frame Acknowledge; a number never changes.
        bits: Width.
        scale: Unit per step.
        label: Description in the DBC.
        unit: Unit in the DBC; that of the field unless given.
        full_turn: Steps of a full turn, for an angle, which is taken modulo that; 0 for other fields.
        words: Values of the words that the field takes.
    """

    name: str
    number: int
    bits: int
    scale: float
    label: str
    unit: str = ""
    full_turn: int = 0
    words: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Quantity:
    """Annotation of a command's field.

    Attributes:
        unit: Unit of the field.
        help: Description on the command line.
        can: Signal in the CAN frame.
        metavar: Placeholder on the command line; the unit unless given.
        takes: Accepted values in rig/KEYS.md, where limits do not describe them.
        span: Least and largest value that can be fitted, if the field has no limits.
    """

    unit: str
    help: str
    can: CanField | None = None
    metavar: str | None = None
    takes: str = ""
    span: tuple[float, float] = UNBOUNDED


@dataclass(frozen=True, slots=True)
class CanFrame:
    """Numbers of a command on a CAN bus; a number never changes.

    Attributes:
        kind: First byte of the frame; any two of a message differ in at least four bits.
        event: Number of the command's event in the frame Event.
        shown: Description of `SHOWN_FIELD` in the DBC, where the event carries it.
        message: Message that carries it; a command with a separate message defines its signals in `drivers.can`.
    """

    kind: int
    event: int
    shown: str = ""
    message: str = "Command"


class CommandField(NamedTuple):
    """Field of a command that is a quantity."""

    quantity: Quantity
    low: float
    high: float
    default: Any
    required: bool
    takes_text: bool


class Run(Protocol):
    """State of a simulation that a command may read and change."""

    tick: int
    tick_rate_hz: int
    model: Any
    faults: Any
    pending: list[tuple[int, Any]]
    inputs: dict[str, Any]
    """Inputs of the kernels (`rig.physics.kernels.constants.Inputs`) from now on."""

    def ramp_to(self, speed_hz: float) -> None:
        """Approach a speed at the drive's ramp rate."""

    def release_magnets(self) -> None:
        """Switch the magnets off."""


class SceneCommand(Written):
    """Base class of an entry.

    Attributes:
        command: Name of the command, and of its event.
    """

    # `"100"` is not a number, in files and in messages.
    model_config = ConfigDict(strict=True)

    CAN: ClassVar[CanFrame]
    """CAN frame; required for each command."""
    MECHANICAL: ClassVar[bool] = True
    """Acts on the shaft, not on channels: needs the model, can be identified, has a mark in the viewer."""
    TRIGGERS: ClassVar[bool] = True
    """Its event can start a capture."""
    SHOWN_FIELD: ClassVar[str] = ""
    """Field of the event that the viewer and the CAN frame Event show."""
    command: str

    @classmethod
    def quantities(cls) -> dict[str, CommandField]:
        """Return the fields that have a unit, by name, with their limits."""
        quantities = {}
        for name, info in cls.model_fields.items():
            if (quantity := next((entry for entry in info.metadata if isinstance(entry, Quantity)), None)) is not None:
                ends = [[getattr(entry, end) for entry in info.metadata if hasattr(entry, end)] for end in ("ge", "le")]
                low, high = (own[0] if own else edge for own, edge in zip(ends, quantity.span, strict=True))
                takes_text = info.annotation is not float
                quantities[name] = CommandField(quantity, low, high, info.default, info.is_required(), takes_text)
        return quantities

    def request(self) -> dict[str, Any]:
        """Return the fields as a client sends them."""
        return self.model_dump(exclude={"command"})

    def check_in_scene(self, at_s: float, last: Mapping[str, Any], *, magnets: bool) -> None:
        """Raise an error for a command that is impossible in a scene.

        Args:
            at_s: Time of the command in the scene [s].
            last: The latest earlier command of each name, with its time.
            magnets: Whether the magnets hold at the start.

        Raises:
            InputError: It is not possible after these commands.
        """

    def check(self, run: Run, waiting: Sequence[Any]) -> dict[str, Any]:
        """Raise an error if the command is not possible now.

        Args:
            run: The simulation.
            waiting: Commands that take effect before this one.

        Returns:
            Fields of the reply in addition to the tick.

        Raises:
            InputError: It is not possible now.
        """
        return {}

    def take_effect(self, run: Run) -> list[dict[str, Any]]:
        """Execute the command.

        Returns:
            The additional fields of each of its events.

        Raises:
            InputError: It has no implementation.
        """
        raise self.refusal()

    @classmethod
    def is_implemented(cls) -> bool:
        """Return whether the command has an implementation."""
        return cls.take_effect is not SceneCommand.take_effect

    def refusal(self) -> InputError:
        """Return the error for a command without an implementation."""
        return InputError("command", "one that the simulation can execute", type(self).__name__)


def find_commands(module: ModuleType) -> dict[str, type[SceneCommand]]:
    """Return the command classes of a module by name."""
    classes = {name: vars(module).get(f"{name.capitalize()}Command") for name in SUMMARIES}
    return {name: entry for name, entry in classes.items() if entry is not None}


def as_number(text: str) -> str | float:
    """Return the number in a text, or the text itself if it is not a number."""
    try:
        return float(text)
    except ValueError:
        return text  # a word, or an error that the rig explains
