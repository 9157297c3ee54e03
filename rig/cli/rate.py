"""`rig rate`: how fast a replay goes."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.connection import Connection, show


def rate(
    rate: Annotated[float, typer.Argument(metavar="X", help="Recorded seconds a second, 0.01 to 1000.")],
    *,
    connection: Connection,
) -> None:
    """Set how fast the replay of a recording goes."""
    with connection.console("rate") as rig:
        show(rig.rate(rate), "rate")
