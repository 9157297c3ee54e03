"""Twin of a motor controller."""

from __future__ import annotations

from drivers.instruments.common.twin import Twin
from drivers.instruments.drive.protocol import CODEC


class DriveTwin(Twin):
    """Serves the rig's group `drive`, and sets the speed."""

    CODEC = CODEC
    TITLE = "Drive controller"
    GROUP = "drive"
