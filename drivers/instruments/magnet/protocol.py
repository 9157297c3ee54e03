"""Protocol of the magnet that holds the shaft: it releases, and measures nothing."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.instruments.common.protocol import Act, Codec
from drivers.link import Address


@dataclass(frozen=True, slots=True)
class Release(Act):
    """Let the shaft go."""

    KIND = 0x40
    COMMAND = "release"


CODEC = Codec(Address("magnet", 6), (Release,))
