"""Twin of the magnet that holds the shaft."""

from __future__ import annotations

from drivers.console import Accepted
from drivers.instrument.protocol import Act
from drivers.instrument.twin import Twin
from drivers.magnet.protocol import CODEC


class MagnetTwin(Twin):
    """Releases."""

    CODEC = CODEC
    TITLE = "Magnet release"

    def act(self, act: Act) -> Accepted:
        """Let the rig release the shaft."""
        return self._console.release()
