"""`rig stop`: end a run."""

from __future__ import annotations

from rig.cli.connection import Connection, show


def stop(*, connection: Connection) -> None:
    """End the run of a rig; recordings of it close."""
    with connection.console("stop") as rig:
        show(rig.stop(), "stop")
