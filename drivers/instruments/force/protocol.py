"""Protocol of a force transducer's charge amplifier: it measures, and does nothing else."""

from __future__ import annotations

from drivers.instruments.common.protocol import Codec
from drivers.link import Address

CODEC = Codec(Address("force", 2))
