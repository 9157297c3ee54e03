"""`rig release`: let the magnets go of the shaft."""

from __future__ import annotations

from rig.cli.connection import Connect, Tls, console, show
from rig.transport import DEFAULT_ENDPOINT


def release(*, connect: Connect = DEFAULT_ENDPOINT, tls: Tls = None) -> None:
    """Make the magnets of a running rig let go of the shaft."""
    with console(connect, "release", tls) as rig:
        show(rig.release(), "release")
