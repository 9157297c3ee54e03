"""Protocol of the magnet that holds the shaft, which releases it and measures nothing."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.instruments.common.protocol import Codec, InstrumentCommand
from drivers.link import Address


@dataclass(frozen=True, slots=True)
class Release(InstrumentCommand):
    """Command to release the shaft."""

    KIND = 0x40
    COMMAND = "release"


CODEC = Codec(Address("magnet", 6), (Release,))
