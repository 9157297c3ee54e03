"""`rig keys`: keys, messages and units."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.tables import echo, table_console


def keys(
    *,
    markdown: Annotated[bool, typer.Option("--markdown", help="As the Markdown source of rig/KEYS.md.")] = False,
) -> None:
    """Show every key, message and unit of the rig's streams, made from the channel table."""
    from rig.interface import page

    if markdown:
        echo(page(), nl=False)
        return
    from rich.markdown import Markdown

    table_console(width=160).print(Markdown(page()))
