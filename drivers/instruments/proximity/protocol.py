"""Protocol of an eddy-current proximity probe conditioner, which only measures."""

from __future__ import annotations

from drivers.instruments.common.protocol import Codec
from drivers.link import Address

CODEC = Codec(Address("proximity", 1))
