"""Twin of the magnet that holds the shaft."""

from __future__ import annotations

from drivers.instruments.common.twin import Twin
from drivers.instruments.magnet.protocol import CODEC


class MagnetTwin(Twin):
    """Releases the shaft."""

    CODEC = CODEC
    TITLE = "Magnet release"
