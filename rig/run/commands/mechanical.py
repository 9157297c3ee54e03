"""Commands that act on the shaft: hammer impact, speed, release of the magnets."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, FiniteFloat

from rig.base.errors import InputError, Words
from rig.run.commands.command import CanField, CanFrame, Quantity, Run, SceneCommand

_DIRECTIONS = {"x": (1.0, 0.0), "y": (0.0, 1.0), "-x": (-1.0, 0.0), "-y": (0.0, -1.0)}
_FORCE = Quantity("N", "Peak force in N", CanField("force", 1, 16, 0.1, "Peak force"))
_DURATION = Quantity(
    "ms", "Duration of the half-sine pulse in ms", CanField("duration", 2, 8, 0.25, "Of the half sine")
)
_DEGREES = {"x": 0.0, "y": 90.0, "-x": 180.0, "-y": 270.0}
_DIRECTION = Quantity(
    "degrees", "Direction: an axis, or an angle from x towards y in degrees",
    CanField("direction", 3, 8, 1.5, "From x (EAST) toward y (up)", unit="deg", full_turn=240, words=_DEGREES),
    metavar="x|y|-x|-y|ANGLE", takes="x, y, -x, -y, or degrees from x toward y", span=(-360.0, 360.0),
)  # fmt: skip
_SPEED = Quantity(
    "Hz", "Spin speed in Hz, approached at the drive's ramp rate",
    CanField("speed", 4, 24, 0.001, "Speed that the drive holds"),
)  # fmt: skip


def _check_direction(direction: str | float) -> str | float:
    is_valid = direction in _DIRECTIONS if isinstance(direction, str) else -360.0 <= direction <= 360.0
    if not is_valid:
        raise ValueError(f"{', '.join(_DIRECTIONS)}, or an angle from -360 to 360 degrees")
    return direction


class HammerCommand(SceneCommand):
    """An impact of the pendulum hammer on the disk: a half-sine pulse."""

    CAN = CanFrame(0xA1, event=3, shown="force of a hammer pulse, N")
    SHOWN_FIELD = "force_n"
    command: Literal["hammer"] = "hammer"
    force_n: Annotated[FiniteFloat, Field(ge=1.0, le=1000.0), _FORCE] = 100.0
    """Peak force [N]."""
    duration_ms: Annotated[FiniteFloat, Field(ge=0.5, le=50.0), _DURATION] = 5.0
    """Length of the pulse [ms]; the paper does not give it."""
    direction: Annotated[str | float, _DIRECTION, AfterValidator(_check_direction)] = "x"
    """Along x (EAST), y (up), or at an angle from x toward y [degrees]."""

    @property
    def cosines(self) -> tuple[float, float]:
        """Direction as a unit vector (x, y)."""
        if isinstance(self.direction, str):
            return _DIRECTIONS[self.direction]
        angle = math.radians(self.direction)
        return math.cos(angle), math.sin(angle)

    def check_in_scene(self, at_s: float, last: Mapping[str, Any], *, magnets: bool) -> None:
        """Raise an error if the hammer is in a pulse in the scene."""
        if (other := last.get(self.command)) is not None:
            free_s = other.at_s + other.request.duration_ms * 1e-3
            if at_s < free_s:
                received = Words(f"a pulse at {at_s:g} s")
                raise InputError("hammer", f"idle (in a pulse until {free_s:g} s)", received)

    def check(self, run: Run, waiting: Sequence[Any]) -> dict[str, Any]:
        """Raise an error if the hammer is in a pulse, or about to be."""
        busy_until = run.inputs["hammer_end"]
        if run.tick < busy_until or any(isinstance(other, HammerCommand) for other in waiting):
            until = f"until {busy_until / run.tick_rate_hz:.6f} s" if run.tick < busy_until else "from now on"
            raise InputError("hammer", f"idle (it is in a pulse {until})", Words("another pulse"))
        return {}

    def take_effect(self, run: Run) -> list[dict[str, Any]]:
        """Start the pulse, unless a pulse from a client is active."""
        if run.tick < run.inputs["hammer_end"]:
            return [{"event": "warning", "text": "a hammer pulse of the scene found the hammer in a pulse"}]
        (x, y), length = self.cosines, round(self.duration_ms * 1e-3 * run.tick_rate_hz)
        run.inputs |= {
            "hammer_force": float(self.force_n), "hammer_x": x, "hammer_y": y,
            "hammer_start": run.tick, "hammer_end": run.tick + max(1, length),
        }  # fmt: skip
        return [{}]


class SpeedCommand(SceneCommand):
    """Sets a new speed, approached at the drive's ramp rate."""

    CAN = CanFrame(0x5C, event=4, shown="speed, Hz")
    SHOWN_FIELD = "speed_hz"
    command: Literal["speed"] = "speed"
    speed_hz: Annotated[FiniteFloat, Field(ge=0.0), _SPEED]
    """Target [Hz]; limited further by the parameter drive.top_speed."""

    def check(self, run: Run, waiting: Sequence[Any]) -> dict[str, Any]:
        """Raise an error above the drive's top speed."""
        top = run.model.parameters.entries["drive.top_speed"].value
        if not isinstance(top, str) and self.speed_hz > top:
            raise InputError("speed.speed_hz", f"at most drive.top_speed = {top:g} Hz", self.speed_hz)
        return {}

    def take_effect(self, run: Run) -> list[dict[str, Any]]:
        """Start the ramp to the speed."""
        run.ramp_to(self.speed_hz)
        return [{}]


class ReleaseCommand(SceneCommand):
    """Releases the shaft from the magnets."""

    CAN = CanFrame(0x36, event=5)
    command: Literal["release"] = "release"

    def check_in_scene(self, at_s: float, last: Mapping[str, Any], *, magnets: bool) -> None:
        """Raise an error if the scene has released the shaft before."""
        if not magnets or self.command in last:
            raise InputError("release", "given once, while the magnets hold", Words(f"another at {at_s:g} s"))

    def check(self, run: Run, waiting: Sequence[Any]) -> dict[str, Any]:
        """Raise an error if the shaft is released, or about to be."""
        if not run.inputs["magnet_engaged"] or any(isinstance(other, ReleaseCommand) for other in waiting):
            raise InputError("release", "given once (the magnets have let go already)", Words("another release"))
        return {}

    def take_effect(self, run: Run) -> list[dict[str, Any]]:
        """Release the shaft."""
        run.release_magnets()
        return [{}]
