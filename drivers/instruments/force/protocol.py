"""Protocol of a force transducer's charge amplifier, which only measures."""

from __future__ import annotations

from drivers.instruments.common.protocol import Codec
from drivers.link import Address

CODEC = Codec(Address("force", 2))
