"""`rig release`: let the magnets go of the shaft."""

from __future__ import annotations

from rig.cli.connection import Connection, show


def release(*, connection: Connection) -> None:
    """Make the magnets of a running rig let go of the shaft."""
    with connection.console("release") as rig:
        show(rig.release(), "release")
