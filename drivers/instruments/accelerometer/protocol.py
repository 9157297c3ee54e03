"""Protocol of an IEPE accelerometer conditioner, which only measures."""

from __future__ import annotations

from drivers.instruments.common.protocol import Codec
from drivers.link import Address

CODEC = Codec(Address("accelerometer", 3))
