"""Twin of a motor controller."""

from __future__ import annotations

from drivers.console import Accepted
from drivers.instruments.common.protocol import Act
from drivers.instruments.common.twin import Twin
from drivers.instruments.drive.protocol import CODEC, SetSpeed


class DriveTwin(Twin):
    """Serves the rig's group `drive`, and sets the speed."""

    CODEC = CODEC
    TITLE = "Drive controller"
    GROUP = "drive"

    def act(self, act: Act) -> Accepted:
        """Let the rig's drive hold a speed."""
        assert isinstance(act, SetSpeed)
        return self._console.speed(act.speed_hz)
