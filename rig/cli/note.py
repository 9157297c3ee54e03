"""`rig note`: a line into the recordings of a running rig."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.connection import Connection, show


def note(
    text: Annotated[str, typer.Argument(help="One line of text.")],
    *,
    tag: Annotated[
        list[str] | None, typer.Option(metavar="WORD", help="A word to find it by; may be repeated.")
    ] = None,
    connection: Connection,
) -> None:
    """Put a note into every recording that is being made of a rig, with the present simulated and wall time."""
    with connection.console("note") as rig:
        show(rig.note(text, tags=tag or []), "note")
