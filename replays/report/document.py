"""What a report holds, whatever it is written as."""

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
"""What a row of a table says: as it must be, not so, undecided, or nothing to be judged."""
OUTCOME_MARKS: dict[str, Mark] = {Outcome.PASS: "good", Outcome.FAIL: "bad", Outcome.INCONCLUSIVE: "open"}
_NUMBER = re.compile(r"[<>≤≥~±+− -]*\d")
_WORD = re.compile(r"[^\W\d_]{4}")
_SET = re.compile(r"`([^`]+)`|_\{([^}]+)\}|\^\{([^}]+)\}")
_PLAIN = re.compile(r"[−+-]?\d+(\.\d+)?")

Style = Literal["", "code", "sub", "sup"]


def fragments(text: str) -> list[tuple[str, Style]]:
    """Pieces of a text as they are set: code between backticks, what is lowered in _{}, what is raised in ^{}."""
    styles: tuple[Style, ...] = ("", "code", "sub", "sup")
    found: list[tuple[str, Style]] = []
    for n, piece in enumerate(_SET.split(text)):
        style = styles[n % len(styles)]
        if piece:
            found.append((piece if style else piece.replace("m/s^2", "m/s²"), style))
    return found


def unset(text: str) -> str:
    """A text where nothing can be set: without backticks, what is lowered after an underscore."""
    return "".join({"sub": "_", "sup": "^"}.get(style, "") + piece for piece, style in fragments(text))


@dataclass(frozen=True)
class Row:
    """One row of a table."""

    cells: tuple[str, ...]
    mark: Mark = "plain"


@dataclass(frozen=True)
class Heading:
    """A heading; level 1 opens a part, level 2 a section in it; the note stands beside it in the contents."""

    text: str
    level: int = 1
    note: str = ""


@dataclass(frozen=True)
class Paragraph:
    """Running text."""

    text: str


@dataclass(frozen=True)
class Table:
    """A table with headings; the first column is text, further ones may be numbers."""

    headings: tuple[str, ...]
    rows: tuple[Row, ...]
    caption: str = ""

    @property
    def numeric(self) -> tuple[bool, ...]:
        """Whether each column holds numbers, with or without units, and what stands where there is none."""
        columns = [[row.cells[n] for row in self.rows] for n in range(len(self.headings))]
        return tuple(
            any(map(_NUMBER.match, cells))
            and all(len(cell) < 5 or (_NUMBER.match(cell) and not _WORD.search(cell)) for cell in cells)
            for cells in columns
        )

    @property
    def tails(self) -> tuple[tuple[str, ...], ...]:
        """What a plain number lacks to be as long behind its point as the longest of a column of numbers, by row."""
        columns = [[_PLAIN.fullmatch(row.cells[n]) for row in self.rows] for n in range(len(self.headings))]
        decimals = [[match[1] or "" if match else None for match in found] for found in columns]
        longest = [max((each for each in found if each is not None), key=len, default="") for found in decimals]
        tails = [
            ["" if each is None or not numeric else ("." + "0" * len(most))[len(each) : len(most)] for each in found]
            for found, most, numeric in zip(decimals, longest, self.numeric, strict=True)
        ]
        return tuple(zip(*tails, strict=True))


@dataclass(frozen=True)
class Picture:
    """A picture with a caption.

    Attributes:
        png: Its bytes.
        caption: Says what it shows, and how it was made.
    """

    png: bytes
    caption: str


ReportPart = Heading | Paragraph | Table | Picture


class Report:
    """A report that grows part by part and is written once; texts of others, such as a file's name, come out printable.

    Attributes:
        title: Its title.
        lead: What it is and what comes out of it, in a sentence or two.
        origin: What it is made of and by, each by name: file, command, version, date.
        mark: Whether what comes out is as it must be.
        parts: What has been added, in order.
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
        """Add a heading; level 1 or 2; with a note beside it in the contents."""
        self.parts.append(Heading(printable(text), level, printable(note)))

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self.parts.append(Paragraph(printable(text)))

    def table(self, headings: Sequence[str], rows: Iterable[Row | Sequence[str]], *, caption: str = "") -> None:
        """Add a table.

        Args:
            headings: Of the columns.
            rows: Each with as many cells as there are headings; a bare sequence is a row without a mark.
            caption: Said above it.

        Raises:
            ValueError: A row of another length.
        """
        given = (row if isinstance(row, Row) else Row(tuple(row)) for row in rows)
        whole = tuple(Row(tuple(map(printable, row.cells)), row.mark) for row in given)
        for row in whole:
            if len(row.cells) != len(headings):
                raise ValueError(f"row must have {len(headings)} cells; instead received {row.cells}")
        self.parts.append(Table(tuple(map(printable, headings)), whole, printable(caption)))

    def picture(self, figure: Figure, caption: str, *, dpi: int = DPI) -> None:
        """Add a figure of matplotlib as a picture."""
        self.parts.append(Picture(png(figure, dpi=dpi), printable(caption)))
