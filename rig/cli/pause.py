"""`rig pause`: hold a replay."""

from __future__ import annotations

from rig.cli.connection import Connection, show


def pause(*, connection: Connection) -> None:
    """Hold the replay of a recording: nothing more goes out until `rig resume`, `rig step` or `rig seek`."""
    with connection.console("pause") as rig:
        show(rig.pause(), "pause")
