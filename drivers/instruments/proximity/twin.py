"""Twin of an eddy-current proximity probe conditioner."""

from __future__ import annotations

from drivers.instruments.common.twin import Twin
from drivers.instruments.proximity.protocol import CODEC


class ProximityTwin(Twin):
    """Serves the rig's group `probes`."""

    CODEC = CODEC
    TITLE = "Proximity probe conditioner"
    GROUP = "probes"
