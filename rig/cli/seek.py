"""`rig seek`: another position in a replay."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.connection import Connect, Tls, console, show
from rig.transport import DEFAULT_ENDPOINT


def seek(
    seconds: Annotated[float, typer.Argument(help="Simulated time in the recording, in s.")],
    *,
    connect: Connect = DEFAULT_ENDPOINT,
    tls: Tls = None,
) -> None:
    """Let the replay of a recording go on from another position; one that is paused stays so."""
    with console(connect, "seek", tls) as rig:
        show(rig.seek(seconds), "seek")
