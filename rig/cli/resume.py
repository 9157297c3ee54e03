"""`rig resume`: go on with a replay."""

from __future__ import annotations

from rig.cli.connection import Connect, console, show
from rig.transport import DEFAULT_ENDPOINT


def resume(*, connect: Connect = DEFAULT_ENDPOINT) -> None:
    """Let the replay of a recording go on."""
    with console(connect, "resume") as rig:
        show(rig.resume(), "resume")
