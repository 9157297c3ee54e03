"""Twin of an IEPE accelerometer conditioner."""

from __future__ import annotations

from drivers.instruments.accelerometer.protocol import CODEC
from drivers.instruments.common.twin import Twin


class AccelerometerTwin(Twin):
    """Serves the rig's group `accelerations`."""

    CODEC = CODEC
    TITLE = "Accelerometer conditioner"
    GROUP = "accelerations"
