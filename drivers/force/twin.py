"""Twin of a force transducer's charge amplifier."""

from __future__ import annotations

from drivers.force.protocol import CODEC
from drivers.instrument.twin import Twin


class ForceTwin(Twin):
    """Serves the rig's group `forces`."""

    CODEC = CODEC
    TITLE = "Force transducer amplifier"
    GROUP = "forces"
