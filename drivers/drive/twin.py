"""Twin of a motor controller."""

from __future__ import annotations

from drivers.console import Accepted
from drivers.drive.protocol import CODEC, SetSpeed
from drivers.instrument.protocol import Act
from drivers.instrument.twin import Twin


class DriveTwin(Twin):
    """Serves the rig's group `drive`, and sets the speed."""

    CODEC = CODEC
    TITLE = "Drive controller"
    GROUP = "drive"

    def act(self, act: Act) -> Accepted:
        """Let the rig's drive hold a speed."""
        assert isinstance(act, SetSpeed)
        return self._console.speed(act.speed_hz)
