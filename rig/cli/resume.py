"""`rig resume`: go on with a replay."""

from __future__ import annotations

from rig.cli.connection import Connect, Tls, console, show
from rig.transport import DEFAULT_ENDPOINT


def resume(*, connect: Connect = DEFAULT_ENDPOINT, tls: Tls = None) -> None:
    """Let the replay of a recording go on."""
    with console(connect, "resume", tls) as rig:
        show(rig.resume(), "resume")
