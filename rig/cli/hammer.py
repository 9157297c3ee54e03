"""`rig hammer`: hit the shaft."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.connection import Connection, show


def hammer(
    *,
    force_n: Annotated[float, typer.Option(help="Peak force, in N.")] = 100.0,
    duration_ms: Annotated[float, typer.Option(help="Length of the half-sine pulse, in ms.")] = 5.0,
    direction: Annotated[
        str, typer.Option(metavar="x|y|-x|-y|ANGLE", help="Along x or y, or at an angle from x towards y, in degrees.")
    ] = "x",
    connection: Connection,
) -> None:
    """Hit the shaft of a running rig at the disk."""
    with connection.console("hammer") as rig:
        show(rig.hammer(force_n=force_n, duration_ms=duration_ms, direction=_direction(direction)), "hammer")


def _direction(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        # A name, or an error that the rig explains.
        return text
