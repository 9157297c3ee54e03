"""Protocol of a pendulum hammer, which strikes, and measures its own force."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.instruments.common.protocol import Codec, InstrumentCommand, VariableField
from drivers.link import Address


@dataclass(frozen=True, slots=True)
class Hit(InstrumentCommand):
    """Command to strike the shaft at the disk.

    Attributes:
        force_n: Peak force [N].
        duration_ms: Length of the half-sine pulse [ms].
        direction: `x`, `y`, `-x`, `-y`, or the angle from x towards y [degrees].
    """

    KIND = 0x40
    COMMAND = "hammer"
    LAYOUT = "<dd"
    LAST_FIELD = VariableField.TEXT
    force_n: float
    duration_ms: float
    direction: str


CODEC = Codec(Address("hammer", 4), (Hit,))
