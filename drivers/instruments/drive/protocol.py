"""Protocol of a motor controller, which controls a speed and measures it."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.instruments.common.protocol import Codec, InstrumentCommand
from drivers.link import Address


@dataclass(frozen=True, slots=True)
class SetSpeed(InstrumentCommand):
    """Command to set the speed set point.

    Attributes:
        speed_hz: Shaft speed [Hz].
    """

    KIND = 0x40
    COMMAND = "speed"
    LAYOUT = "<d"
    speed_hz: float


CODEC = Codec(Address("drive", 5), (SetSpeed,))
