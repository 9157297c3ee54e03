"""`rig keys`: keys, messages and units."""

from __future__ import annotations

from typing import Annotated

import typer


def keys(
    *,
    markdown: Annotated[bool, typer.Option("--markdown", help="As the Markdown source of rig/KEYS.md.")] = False,
) -> None:
    """Show every key, message and unit of the rig's streams, made from the channel table."""
    from rig.interface import page

    if markdown:
        typer.echo(page(), nl=False)
        return
    from rich.console import Console
    from rich.markdown import Markdown

    console = Console()
    (console if console.is_terminal else Console(width=160)).print(Markdown(page()))
