"""Twin of a force transducer's charge amplifier."""

from __future__ import annotations

from drivers.instruments.common.twin import Twin
from drivers.instruments.force.protocol import CODEC


class ForceTwin(Twin):
    """Serves the rig's group `forces`."""

    CODEC = CODEC
    TITLE = "Force transducer amplifier"
    GROUP = "forces"
