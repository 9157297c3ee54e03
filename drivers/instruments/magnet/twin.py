"""Twin of the magnet that holds the shaft."""

from __future__ import annotations

from drivers.console import Accepted
from drivers.instruments.common.protocol import Act
from drivers.instruments.common.twin import Twin
from drivers.instruments.magnet.protocol import CODEC


class MagnetTwin(Twin):
    """Releases."""

    CODEC = CODEC
    TITLE = "Magnet release"

    def act(self, act: Act) -> Accepted:
        """Let the rig release the shaft."""
        return self._console.release()
