"""`rig speed`: set the speed that the drive holds."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.connection import Connection, show


def speed(
    speed_hz: Annotated[
        float, typer.Argument(metavar="HZ", help="Spin speed [Hz], approached at the drive's ramp rate.")
    ],
    *,
    connection: Connection,
) -> None:
    """Set the spin speed of a running rig."""
    with connection.console("speed") as rig:
        show(rig.speed(speed_hz), f"speed {speed_hz:g} Hz")
