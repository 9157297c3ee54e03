"""`rig note`: a line into the recordings of a running rig."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.connection import Connect, Tls, console, show
from rig.transport import DEFAULT_ENDPOINT


def note(
    text: Annotated[str, typer.Argument(help="One line of text.")],
    *,
    tag: Annotated[list[str] | None, typer.Option(help="A word to find it by; may be repeated.")] = None,
    connect: Connect = DEFAULT_ENDPOINT,
    tls: Tls = None,
) -> None:
    """Put a note with the present simulated and wall time into every recording that is being made of a rig."""
    with console(connect, "note", tls) as rig:
        show(rig.note(text, tags=tag or []), "note")
