"""Protocol of a motor controller: it holds a speed, and measures it."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.instruments.common.protocol import Act, Codec
from drivers.link import Address


@dataclass(frozen=True, slots=True)
class SetSpeed(Act):
    """Hold a speed.

    Attributes:
        speed_hz: Turns per second [Hz].
    """

    KIND = 0x40
    COMMAND = "speed"
    LAYOUT = "<d"
    speed_hz: float


CODEC = Codec(Address("drive", 5), (SetSpeed,))
