"""`rig resume`: go on with a replay."""

from __future__ import annotations

from rig.cli.connection import Connection, show


def resume(*, connection: Connection) -> None:
    """Let the replay of a recording go on."""
    with connection.console("resume") as rig:
        show(rig.resume(), "resume")
