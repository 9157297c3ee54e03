"""`rig speed`: set the speed that the drive holds."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.connection import Connect, Tls, console, show
from rig.transport import DEFAULT_ENDPOINT


def speed(
    hz: Annotated[float, typer.Argument(metavar="HZ", help="Spin speed [Hz], approached at the drive's ramp rate.")],
    *,
    connect: Connect = DEFAULT_ENDPOINT,
    tls: Tls = None,
) -> None:
    """Set the spin speed of a running rig."""
    with console(connect, "speed", tls) as rig:
        show(rig.speed(hz), f"speed {hz:g} Hz")
