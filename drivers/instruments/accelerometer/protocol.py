"""Protocol of an IEPE accelerometer conditioner: it measures, and does nothing else."""

from __future__ import annotations

from drivers.instruments.common.protocol import Codec
from drivers.link import Address

CODEC = Codec(Address("accelerometer", 3))
