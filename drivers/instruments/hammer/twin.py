"""Twin of a pendulum hammer."""

from __future__ import annotations

from drivers.console import Accepted
from drivers.instruments.common.protocol import Act
from drivers.instruments.common.twin import Twin
from drivers.instruments.hammer.protocol import CODEC, Hit


class HammerTwin(Twin):
    """Serves the rig's group `hammer`, and hits."""

    CODEC = CODEC
    TITLE = "Pendulum hammer controller"
    GROUP = "hammer"

    def act(self, act: Act) -> Accepted:
        """Let the rig hit."""
        assert isinstance(act, Hit)
        try:
            direction: str | float = float(act.direction)
        except ValueError:
            # A name, or an error that the rig explains.
            direction = act.direction
        return self._console.hammer(force_n=act.force_n, duration_ms=act.duration_ms, direction=direction)
