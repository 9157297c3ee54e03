"""`rig pause`: hold a replay."""

from __future__ import annotations

from rig.cli.connection import Connect, Tls, console, show
from rig.transport import DEFAULT_ENDPOINT


def pause(*, connect: Connect = DEFAULT_ENDPOINT, tls: Tls = None) -> None:
    """Hold the replay of a recording: nothing more goes out until `rig resume`, `rig step` or `rig seek`."""
    with console(connect, "pause", tls) as rig:
        show(rig.pause(), "pause")
