"""Terminal output: tables, lines and progress, with all control characters and markup disabled.

Names of scenes, channels and clients, notes and paths come from outside: square brackets are not markup, and escapes,
line breaks and marks for the direction of writing are printed escaped.

On a terminal, tables and lines fit its width, and no value is cut. In a pipe, and with `--wide`, a table has all
columns and each row is one line: at least two spaces between columns, and `-` for an empty cell.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import sys
import textwrap
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import typer

from rig.base.text import printable, replace_nonfinite
from rig.cli.options import Json, Wide

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions
    from rich.segment import Segment
    from rich.text import Text

    _Rows = list[tuple[list[Text], str]]

_PIPE_WIDTH = 1_000_000
"""Width of a pipe [characters]."""
_GAP = 2
_MIN_WIDTH = 20
"""Minimum width of a wrapped column [characters]."""
_MIN_SPARE_WIDTH = 48
"""The same for a column that can be left out; a narrower one would take too many lines."""
_UNIT = re.compile(r"(?<=\d)(?: (?:%|°|ppm\b|[kMGmuµn]?(?:s|m|g|N|B|V|W|J|A|Pa|Hz|rad|bit)\b))+")
_NO_BREAK = "\ue000"
"""A space without a line break; rich would treat Unicode's own as a space."""


@dataclass(frozen=True)
class Form:
    """Output form of a command."""

    as_json: Json = False
    wide: Wide = False

    def console(self) -> Console:
        """Return the console for output other than JSON."""
        return table_console(wide=self.wide)


def _lines(text: str) -> str:
    """Return the text with each of its lines made printable."""
    return "\n".join(map(printable, text.split("\n")))


def echo(text: object = "", *, err: bool = False) -> None:
    """Print lines; a terminal wraps them between words.

    Args:
        text: Text whose line breaks are kept; other unprintable characters are escaped.
        err: Print to stderr.
    """
    lines = _lines(str(text)).split("\n")
    if (sys.stderr if err else sys.stdout).isatty():
        lines = [part for line in lines for part in _broken(line, shutil.get_terminal_size().columns) or [""]]
    # The reader of stderr may have exited; the work continues.
    with contextlib.suppress(*([OSError] if err else [])):
        typer.echo("\n".join(lines), err=err)


def _broken(line: str, width: int) -> list[str]:
    indent = line[: len(line) - len(line.lstrip())]
    parts = textwrap.wrap(
        _bind_units(line), width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return [part.replace(_NO_BREAK, " ") for part in parts]


def echo_document(text: str) -> None:
    """Print a text without a final line break; unprintable characters are escaped."""
    typer.echo(_lines(text), nl=False)


def echo_json(document: Any, *, indent: int | None = 2) -> None:
    """Print a document as JSON, with null for a number that is not finite."""
    import json

    echo_document(json.dumps(replace_nonfinite(document), indent=indent, allow_nan=False) + "\n")


def make_printable(document: Any) -> Any:
    """Return a document with each text on one printable line, so that no text can imitate our own lines."""
    if isinstance(document, str):
        return printable(document)
    if isinstance(document, dict):
        return {make_printable(name): make_printable(value) for name, value in document.items()}
    return [make_printable(value) for value in document] if isinstance(document, list | tuple) else document


class Table:
    """A table without borders, with cells of one line; see `new_table`.

    Attributes:
        title: The title.
        headings: Headings of the columns.
        wrapped, spare: Indices of columns that may wrap, and of those that can be left out, in order of removal.
        keys: Number of leading columns that identify a row.
        rows: Cells and style of each row; a single cell spans all columns.
    """

    def __init__(
        self, title: str, headings: Sequence[str], *, wrapped: Collection[int], spare: Sequence[int], keys: int
    ) -> None:
        self.title = printable(title)
        self.headings = [printable(heading.removeprefix(">")) for heading in headings]
        self._right = [heading.startswith(">") for heading in headings]
        self.wrapped, self.spare, self.keys = wrapped, spare, keys
        self.rows: _Rows = []

    def add_row(self, *cells: str | Text, style: str = "") -> None:
        """Add a row: a cell for each column, or one across all columns."""
        from rich.text import Text

        if len(cells) not in (1, len(self.headings)):
            raise ValueError(f"a row must be 1 or {len(self.headings)} cells; received {len(cells)}")
        texts = [Text(cell) if isinstance(cell, str) else cell for cell in cells]
        self.rows.append(([Text(printable(text.plain), text.style) for text in texts], style))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Segment]:
        from rich.segment import Segment
        from rich.text import Text

        room = options.max_width
        rows = [([cell.copy() for cell in cells], style) for cells, style in self.rows]
        for cell in (cell for cells, _ in rows for cell in cells):
            cell.plain = _bind_units(cell.plain)
        blocks = self._blocks(room, rows)
        lines = list(Text(self.title, "italic").wrap(console, room)) if self.title else []
        for number, widths in enumerate(blocks):
            lines += [Text()] if number else []
            lines += self._head(widths)
            for cells, style in rows:
                if len(cells) < len(self.headings):
                    lines += cells[0].wrap(console, room)
                    continue
                filled = [cell if cell or room < _PIPE_WIDTH else Text("-") for cell in cells]
                wrapped = {at: list(filled[at].wrap(console, width, overflow="fold")) for at, width in widths.items()}
                for row in range(max(map(len, wrapped.values()))):
                    parts = {at: texts[row] if row < len(texts) else Text() for at, texts in wrapped.items()}
                    lines.append(self._line(parts, widths, style))
        if omitted := [heading for at, heading in enumerate(self.headings) if all(at not in block for block in blocks)]:
            lines += Text(f"columns left out: {', '.join(omitted)} (shown with --wide)", "dim").wrap(console, room)
        for line in lines:
            line.rstrip()
            yield from line.render(console)
            yield Segment.line()

    def _head(self, widths: dict[int, int]) -> list[Text]:
        from rich.text import Text

        if not any(self.headings):
            return []
        parts = {at: _stacked(self.headings[at], width) for at, width in widths.items()}
        height = max(map(len, parts.values()))
        padded = {at: [""] * (height - len(words)) + words for at, words in parts.items()}
        return [
            self._line({at: Text(words[row]) for at, words in padded.items()}, widths, "bold") for row in range(height)
        ]

    def _line(self, parts: dict[int, Text], widths: dict[int, int], style: str) -> Text:
        from rich.text import Text

        for at, part in parts.items():
            part.rstrip()
            part.align("right" if self._right[at] else "left", widths[at])
        return Text(" " * _GAP, style).join(parts.values())

    def _blocks(self, room: int, rows: _Rows) -> list[dict[int, int]]:
        """Return widths by column index: for all columns, without spare ones, or in several blocks."""
        columns = list(range(len(self.headings)))
        for spare in (None, *self.spare):
            columns = [at for at in columns if at != spare]
            widths = self._widths(columns, room, rows)
            if _total(widths) <= room:
                return [widths]
        keys, blocks = columns[: self.keys], [columns[: self.keys + 1]]
        for at in columns[self.keys + 1 :]:
            if _total(self._widths([*blocks[-1], at], room, rows)) <= room:
                blocks[-1].append(at)
            else:
                blocks.append([*keys, at])
        return [self._widths(block, room, rows) for block in blocks]

    def _widths(self, columns: Iterable[int], room: int, rows: _Rows) -> dict[int, int]:
        """Return the widths of columns in a block: as wanted, or reduced to fit."""
        wanted, widths = {}, {}
        for at in columns:
            cells = [cells[at] for cells, _ in rows if len(cells) == len(self.headings)]
            words = _stacked(self.headings[at], 1)
            whole = max((cell.cell_len for cell in cells), default=1)
            wanted[at] = max(whole, len(self.headings[at]))
            if at in self.wrapped:
                longest = max((len(word) for cell in cells for word in cell.plain.split()), default=1)
                least = _MIN_SPARE_WIDTH if at in self.spare else _MIN_WIDTH
                whole = longest if whole <= least else max(longest, least)
            # External names may have any length.
            whole = min(whole, max(room // (self.keys + 1) - _GAP, 1))
            widths[at] = max([whole, *map(len, words)])
        roomy = {at: min(width, _MIN_SPARE_WIDTH) if at in self.wrapped else width for at, width in wanted.items()}
        for better in (wanted, roomy):
            if _total(better) <= room:
                widths = better
                break
        while _total(widths) < room and (narrow := [at for at in widths if widths[at] < wanted[at]]):
            widths[max(narrow, key=lambda at: wanted[at] / widths[at])] += 1
        return widths


def _bind_units(text: str) -> str:
    """Return the text with numbers bound to their units."""
    return _UNIT.sub(lambda unit: unit[0].replace(" ", _NO_BREAK), text)


def _stacked(heading: str, width: int) -> list[str]:
    """Return the lines of a heading, of similar length; units in brackets are not split."""
    text = re.sub(r"\[.*?\]", lambda unit: unit[0].replace(" ", "\u00a0"), heading)
    longest = max(map(len, textwrap.wrap(text, 1, break_long_words=False)), default=1)
    lines = [textwrap.wrap(text, width) for width in range(longest, max(width, longest) + 1)]
    return [line.replace("\u00a0", " ") for line in next(each for each in lines if len(each) == len(lines[-1]))]


def _total(widths: dict[int, int]) -> int:
    return sum(widths.values()) + _GAP * (len(widths) - 1)


def new_table(
    title: str, *headings: str, wrapped: Collection[str] = (), spare: Sequence[str] = (), keys: int = 1
) -> Table:
    """Return a table under a title; cells are shown whole and on one line, except wrapped ones.

    On a terminal that is too narrow, spare columns are left out, with a note; the remaining columns continue below in
    blocks that begin with the same key columns.

    Args:
        title: The title.
        headings: Headings of the columns; `>` marks a column of numbers, aligned to the right.
        wrapped: Headings of columns that may wrap.
        spare: Headings of columns that can be left out, in order of removal.
        keys: Number of leading columns that identify a row.
    """
    places = {heading.removeprefix(">"): at for at, heading in enumerate(headings)}
    wrapped_at, spare_at = ([places[name] for name in names if name in places] for names in (wrapped, spare))
    return Table(title, headings, wrapped=wrapped_at, spare=spare_at, keys=keys)


def fact_table(title: str, rows: Iterable[tuple[str, str]], **styles: str) -> Table:
    """Return a table of names, in bold, and their texts; `styles`: style of a row by name."""
    from rich.text import Text

    table = Table(title, ("", ""), wrapped=(1,), spare=(), keys=1)
    for name, fact in rows:
        table.add_row(Text(name, "bold"), fact, style=styles.get(name, ""))
    return table


def table_console(*, wide: bool = False, stderr: bool = False, pipe_width: int = _PIPE_WIDTH) -> Console:
    """Return the console for tables: they fit a terminal, and have full length in a pipe.

    Strings are printed without markup; styles need a `rich.text.Text` or a style argument.

    Args:
        wide: Print on a terminal as in a pipe.
        stderr: Print to stderr.
        pipe_width: Width in a pipe [characters].
    """
    from rich.console import Console
    from rich.segment import Segment

    class Screen(Console):
        """A console without markup, whose texts are escaped and not cropped."""

        def print(self, *objects: Any, **options: Any) -> None:
            options.setdefault("crop", False)
            super().print(*objects, **options)

        def render_str(self, text: str, **options: Any) -> Any:
            options.update(markup=False, emoji=False)
            return super().render_str(_bind_units(_lines(text)), **options)

        def render(self, renderable: Any, options: Any = None) -> Any:
            for segment in super().render(renderable, options):
                if segment.control or segment.text == "\n":
                    yield segment
                else:
                    yield Segment(_lines(segment.text.replace(_NO_BREAK, " ")), segment.style)

    terminal = (sys.stderr if stderr else sys.stdout).isatty()
    width = _PIPE_WIDTH if wide else None if terminal else pipe_width
    return Screen(width=width, highlight=False, markup=False, emoji=False, stderr=stderr)


def progress_bar(*columns: Any, **options: Any) -> Any:
    """Return a `rich.progress.Progress` on stderr with the columns, followed by the description of each task."""
    from rich.progress import Progress, TextColumn

    console = table_console(stderr=True)
    return Progress(*columns, TextColumn("{task.description}", markup=False), console=console, **options)


def plain_text(text: str) -> Any:
    """Return a line as a text without markup, for functions such as the status of a console."""
    from rich.text import Text

    return Text(printable(text))
