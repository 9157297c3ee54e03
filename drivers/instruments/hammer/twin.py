"""Twin of a pendulum hammer."""

from __future__ import annotations

from drivers.instruments.common.twin import Twin
from drivers.instruments.hammer.protocol import CODEC


class HammerTwin(Twin):
    """Serves the rig's group `hammer`, and triggers impacts."""

    CODEC = CODEC
    TITLE = "Pendulum hammer controller"
    GROUP = "hammer"
