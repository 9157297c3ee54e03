"""`rig rate`: how fast a replay goes."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.connection import Connect, Tls, console, show
from rig.transport import DEFAULT_ENDPOINT


def rate(
    x: Annotated[float, typer.Argument(metavar="X", help="Recorded seconds a second, 0.01 to 1000.")],
    *,
    connect: Connect = DEFAULT_ENDPOINT,
    tls: Tls = None,
) -> None:
    """Set how fast the replay of a recording goes."""
    with console(connect, "rate", tls) as rig:
        show(rig.rate(x), "rate")
