"""`rig stop`: end a run."""

from __future__ import annotations

from rig.cli.connection import Connect, Tls, console, show
from rig.transport import DEFAULT_ENDPOINT


def stop(*, connect: Connect = DEFAULT_ENDPOINT, tls: Tls = None) -> None:
    """End the run of a rig; recordings of it close."""
    with console(connect, "stop", tls) as rig:
        show(rig.stop(), "stop")
