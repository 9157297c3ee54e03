"""What is printed goes out through here: tables, lines and progress, none of it acted on by the terminal or by rich.

Names of scenes, channels and clients, notes and paths are not ours: square brackets in them are no markup, and escapes,
line breaks and marks that turn the direction of writing come out in their escaped form.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import typer

from rig.text import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def _lines(text: str) -> str:
    """The same text, each of its lines fit to be shown."""
    return "\n".join(map(printable, text.split("\n")))


def echo(text: object = "", *, err: bool = False, nl: bool = True) -> None:
    """Print lines.

    Args:
        text: They are kept apart; everything else that cannot be printed is escaped.
        err: To stderr.
        nl: With a line break at the end.
    """
    # Who reads what happens may have gone; what happens goes on.
    with contextlib.suppress(*([OSError] if err else [])):
        typer.echo(_lines(str(text)), err=err, nl=nl)


def shown(document: Any) -> Any:
    """A document as it may be shown: each text on one line, as one with line breaks could pass for ours."""
    if isinstance(document, str):
        return printable(document)
    if isinstance(document, dict):
        return {shown(name): shown(value) for name, value in document.items()}
    return [shown(value) for value in document] if isinstance(document, list | tuple) else document


def new_table(title: str, *headings: str, whole: Collection[str] = ()) -> Table:
    """A table without lines, under a title.

    Args:
        title: The title.
        headings: Of its columns; behind a `>` stand numbers, which are aligned to the right and not wrapped.
        whole: Of those columns that are not wrapped either.
    """
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title) if title else None, box=None, header_style="bold", title_justify="left")
    for heading in headings:
        number = heading.startswith(">")
        table.add_column(
            Text(heading.removeprefix(">")),  # brackets are units here, not markup
            justify="right" if number else "left",
            no_wrap=number or heading in whole,
        )
    return table


def echo_json(document: Any) -> None:
    """Print a document as JSON."""
    import json

    echo(json.dumps(document, indent=2, allow_nan=False))


def table_console(*, width: int | None = 200, highlight: bool = True, stderr: bool = False) -> Console:
    """Where tables are printed: on a terminal they fit it, into a pipe they keep their whole width.

    Strings are text and no markup; what is styled is a `rich.text.Text` or a style.

    Args:
        width: Columns into a pipe; None: those that rich assumes.
        highlight: Whether numbers and names in plain text are coloured.
        stderr: Print there.
    """
    from rich.console import Console
    from rich.segment import Segment
    from rich.text import Text

    class Screen(Console):
        """Markup is off for every kind of string, and no text leaves unescaped."""

        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(_lines(text), **{**options, "markup": False, "emoji": False})

        def render(self, renderable: Any, options: Any = None) -> Any:
            for segment in super().render(renderable, options):
                text = segment.text
                if segment.control or text == "\n" or text.isprintable():
                    yield segment
                else:
                    yield Segment(_lines(text), segment.style)

    terminal = Console(stderr=stderr).is_terminal
    return Screen(width=None if terminal else width, highlight=highlight, markup=False, emoji=False, stderr=stderr)


def progress_bar(*columns: Any, **options: Any) -> Any:
    """A `rich.progress.Progress` on stderr with the columns and, behind them, each task's description as it stands."""
    from rich.progress import Progress, TextColumn

    console = table_console(width=None, stderr=True)
    return Progress(*columns, TextColumn("{task.description}", markup=False), console=console, **options)


def plain(text: str) -> Any:
    """A line for what would take a string for markup, such as the status of a console."""
    from rich.text import Text

    return Text(printable(text))
