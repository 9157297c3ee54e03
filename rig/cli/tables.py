"""Tables on the terminal: how they look and how wide they are."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def new_table(title: str) -> Table:
    """A table without lines, under a title."""
    from rich.table import Table

    return Table(title=title, box=None, header_style="bold", title_justify="left")


def table_console(*, width: int = 200, highlight: bool = True) -> Console:
    """Where tables are printed: on a terminal they fit it, into a pipe they keep their whole width.

    Args:
        width: Columns into a pipe.
        highlight: Whether numbers and names in plain text are coloured.
    """
    from rich.console import Console

    return Console(width=None if Console().is_terminal else width, highlight=highlight)
