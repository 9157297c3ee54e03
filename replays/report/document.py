"""Content of a report, independent of the file format."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from replays.report.canvas import DPI, png
from rig.base.outcome import Outcome
from rig.base.text import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Mark = Literal["good", "bad", "open", "plain"]
"""Mark of a table row: good, bad, inconclusive, or not judged."""
OUTCOME_MARKS: dict[str, Mark] = {Outcome.PASS: "good", Outcome.FAIL: "bad", Outcome.INCONCLUSIVE: "open"}
_NUMBER = re.compile(r"[<>≤≥~±+− -]*\d")
_LETTERS = re.compile(r"[^\W\d_]{4}")
_MARKUP = re.compile(r"`([^`]+)`|_\{([^}]+)\}|\^\{([^}]+)\}")
_PLAIN_NUMBER = re.compile(r"[−+-]?\d+(\.\d+)?")

Style = Literal["", "code", "sub", "sup"]


def fragments(text: str) -> list[tuple[str, Style]]:
    """Split a text into fragments and their styles: code in backticks, subscripts in _{}, superscripts in ^{}."""
    styles: tuple[Style, ...] = ("", "code", "sub", "sup")
    pieces: list[tuple[str, Style]] = []
    for n, piece in enumerate(_MARKUP.split(text)):
        style = styles[n % len(styles)]
        if piece:
            pieces.append((piece if style else piece.replace("m/s^2", "m/s²"), style))
    return pieces


def strip_styles(text: str) -> str:
    """Return a text without styles: backticks are removed, subscripts follow an underscore, superscripts a caret."""
    return "".join({"sub": "_", "sup": "^"}.get(style, "") + piece for piece, style in fragments(text))


@dataclass(frozen=True)
class Row:
    """A row of a table."""

    cells: tuple[str, ...]
    mark: Mark = "plain"


@dataclass(frozen=True)
class Heading:
    """A heading: level 1 for a part, level 2 for a section; the contents show the note next to it."""

    text: str
    level: int = 1
    note: str = ""


@dataclass(frozen=True)
class Paragraph:
    """Running text."""

    text: str


@dataclass(frozen=True)
class Table:
    """A table with headings; the first column is text, the others may be numbers."""

    headings: tuple[str, ...]
    rows: tuple[Row, ...]
    caption: str = ""

    @property
    def numeric(self) -> tuple[bool, ...]:
        """True if each column holds numbers, with or without units, or placeholders for missing ones."""
        columns = [[row.cells[n] for row in self.rows] for n in range(len(self.headings))]
        return tuple(
            any(map(_NUMBER.match, cells))
            and all(len(cell) < 5 or (_NUMBER.match(cell) and not _LETTERS.search(cell)) for cell in cells)
            for cells in columns
        )

    @property
    def tails(self) -> tuple[tuple[str, ...], ...]:
        """Characters to append to plain numbers so that all decimal points of a column line up, by row."""
        columns = [[_PLAIN_NUMBER.fullmatch(row.cells[n]) for row in self.rows] for n in range(len(self.headings))]
        decimals = [[match[1] or "" if match else None for match in digits] for digits in columns]
        longest = [max((each for each in digits if each is not None), key=len, default="") for digits in decimals]
        tails = [
            ["" if each is None or not numeric else ("." + "0" * len(most))[len(each) : len(most)] for each in digits]
            for digits, most, numeric in zip(decimals, longest, self.numeric, strict=True)
        ]
        return tuple(zip(*tails, strict=True))


@dataclass(frozen=True)
class Picture:
    """A picture with a caption.

    png: Bytes of a PNG file.
    caption: Content of the picture and how it was made.
    """

    png: bytes
    caption: str


ReportPart = Heading | Paragraph | Table | Picture


class Report:
    """A report that is built part by part and written once; texts from outside, such as file names, are made printable.

    Attributes:
        title: Title.
        lead: Subject and result in a sentence or two.
        origin: Sources by name: file, command, version, date.
        mark: Mark of the overall result.
        parts: Parts in order.
    """

    def __init__(
        self, title: str, lead: str = "", *, origin: Mapping[str, str] | None = None, mark: Mark = "plain"
    ) -> None:
        self.title = printable(title)
        self.lead = printable(lead)
        self.origin = {name: printable(value) for name, value in (origin or {}).items()}
        self.mark: Mark = mark
        self.parts: list[ReportPart] = []

    def heading(self, text: str, *, level: int = 1, note: str = "") -> None:
        """Add a heading of level 1 or 2, with a note for the contents."""
        self.parts.append(Heading(printable(text), level, printable(note)))

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self.parts.append(Paragraph(printable(text)))

    def table(self, headings: Sequence[str], rows: Iterable[Row | Sequence[str]], *, caption: str = "") -> None:
        """Add a table.

        Args:
            headings: Headings of the columns.
            rows: Rows with one cell per heading; a bare sequence is a row without a mark.
            caption: Caption above the table.

        Raises:
            ValueError: If a row has another length.
        """
        styled = (row if isinstance(row, Row) else Row(tuple(row)) for row in rows)
        whole = tuple(Row(tuple(map(printable, row.cells)), row.mark) for row in styled)
        for row in whole:
            if len(row.cells) != len(headings):
                raise ValueError(f"row must have {len(headings)} cells; received {row.cells}")
        self.parts.append(Table(tuple(map(printable, headings)), whole, printable(caption)))

    def picture(self, figure: Figure, caption: str, *, dpi: int = DPI) -> None:
        """Add a matplotlib figure as a picture."""
        self.parts.append(Picture(png(figure, dpi=dpi), printable(caption)))
