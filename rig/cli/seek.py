"""`rig seek`: another position in a replay."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.connection import Connection, show


def seek(
    time_s: Annotated[float, typer.Argument(metavar="SECONDS", help="Simulated time in the recording, in s.")],
    *,
    connection: Connection,
) -> None:
    """Let the replay of a recording go on from another position; one that is paused stays so."""
    with connection.console("seek") as rig:
        show(rig.seek(time_s), "seek")
