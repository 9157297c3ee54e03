"""PDF output of a report."""

from __future__ import annotations

import io
from datetime import UTC, datetime
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

from replays.report.document import Heading, Paragraph, Picture, Report, ReportPart, Table, fragments, strip_styles

if TYPE_CHECKING:
    from fpdf import FPDF

_INK, _GREY = (26, 26, 26), (102, 102, 102)
_MARKS = {"good": (0, 121, 79), "bad": (179, 38, 30), "open": (154, 103, 0), "plain": _INK}
_FONT, _CODE = "DejaVu", "DejaVuMono"
_CHAR_POSITIONS = {"sub": "SUB", "sup": "SUP"}
_FIGURE_SPACES = str.maketrans({".": "\u2008", "0": "\u2007"})
"""Spaces as wide as a point and as a digit."""
_CELL_SIZE_PT, _CELL_SPACE_MM = 7.5, 2.5
"""Font size of a cell [pt], and space after it [mm]."""


def render(report: Report) -> bytes:
    """Return the report as an A4 PDF document."""
    from fpdf import FPDF
    from matplotlib import get_data_path

    class _Pages(FPDF):
        def footer(self) -> None:
            self.set_y(-12)
            self.set_font(_FONT, size=8)
            self.set_text_color(*_GREY)
            self.cell(0, 6, f"{report.title}   {self.page_no()} / {{nb}}", align="R")

    pdf = _Pages(format="A4", unit="mm")
    # Without the date of writing, equal reports give equal files.
    pdf.set_creation_date(datetime(2000, 1, 1, tzinfo=UTC))
    pdf.set_title(report.title)
    fonts = Path(get_data_path()) / "fonts" / "ttf"  # the built-in fonts of PDF have no Greek
    pdf.add_font(_FONT, fname=fonts / "DejaVuSans.ttf")
    pdf.add_font(_FONT, style="B", fname=fonts / "DejaVuSans-Bold.ttf")
    pdf.add_font(_CODE, fname=fonts / "DejaVuSansMono.ttf")
    pdf.add_font(_CODE, style="B", fname=fonts / "DejaVuSansMono-Bold.ttf")
    pdf.set_margins(18, 16)
    pdf.set_auto_page_break(True, margin=16)
    pdf.add_page()

    def write(
        text: str, *, size: float, bold: bool = False, colour: tuple[int, int, int] = _INK, below: float = 1.5
    ) -> None:
        pdf.set_text_color(*colour)
        for piece, style in fragments(text):
            code = style == "code"
            # Here and below: fpdf2 accepts fractions of points and mm, though its signatures declare integers.
            pdf.set_font(_CODE if code else _FONT, style="B" if bold else "", size=0.93 * size if code else size)  # pyrefly: ignore[bad-argument-type]
            pdf.char_vpos = _CHAR_POSITIONS.get(style, "LINE")
            pdf.write(size * 0.5, piece)
        pdf.char_vpos = "LINE"
        pdf.ln(size * 0.5 + below)

    write(report.title, size=16, bold=True)
    if report.lead:
        write(report.lead, size=10, bold=report.mark == "bad", colour=_MARKS[report.mark])
    for name, value in report.origin.items():
        write(f"{name}: {value}", size=7.5, colour=_GREY, below=0.0)
    pdf.ln(1.5)
    for number, part in enumerate(report.parts):
        if isinstance(part, Heading):
            pdf.ln(3)
            if pdf.will_page_break(_room(pdf, report.parts[number:])):
                pdf.add_page()
            write(part.text, size=13 if part.level == 1 else 11, bold=True)
        elif isinstance(part, Paragraph):
            write(part.text, size=9)
        elif isinstance(part, Table):
            if pdf.will_page_break(20.0):  # keeps a caption or headings from ending a page
                pdf.add_page()
            if part.caption:
                write(part.caption, size=8, colour=_GREY)
            _table(pdf, part)
            pdf.ln(2)
        else:
            _picture(pdf, part)
            write(part.caption, size=8, colour=_GREY)
    return bytes(pdf.output())


def _room(pdf: FPDF, parts: list[ReportPart]) -> float:
    """Return the height of headings and the start of the next part [mm], which must stay on one page."""
    headings = list(takewhile(lambda part: isinstance(part, Heading), parts))
    following = parts[len(headings)] if len(headings) < len(parts) else None
    return 9.0 * len(headings) + (_size(pdf, following)[1] + 9.0 if isinstance(following, Picture) else 20.0)


def _table(pdf: FPDF, table: Table) -> None:
    from fpdf.fonts import FontFace

    pdf.set_font(_FONT, size=_CELL_SIZE_PT)  # pyrefly: ignore[bad-argument-type]
    pdf.set_text_color(*_INK)
    pdf.set_draw_color(221, 221, 221)
    widths = _widths(pdf, table)
    with pdf.table(
        col_widths=widths,  # pyrefly: ignore[bad-argument-type]
        # The sum of the widths may exceed the page width by a rounding error.
        width=min(sum(widths), pdf.epw),  # pyrefly: ignore[bad-argument-type]
        align="L",
        text_align=tuple("RIGHT" if numeric else "LEFT" for numeric in table.numeric),
        line_height=4,
        borders_layout="HORIZONTAL_LINES",
        headings_style=FontFace(emphasis="BOLD"),
        padding=(0.6, _CELL_SPACE_MM, 0.6, 0.6),  # pyrefly: ignore[bad-argument-type]
    ) as grid:
        grid.row([strip_styles(heading) for heading in table.headings])
        for row, cells in zip(table.rows, _cells(table), strict=True):
            line = grid.row()
            for n, cell in enumerate(cells):
                line.cell(cell, style=FontFace(color=_MARKS[row.mark] if n == len(cells) - 1 else _INK))


def _cells(table: Table) -> list[list[str]]:
    """Return the cells as printed, with plain numbers aligned at their decimal points."""
    rows = zip(table.rows, table.tails, strict=True)
    return [
        [strip_styles(cell) + tail.translate(_FIGURE_SPACES) for cell, tail in zip(row.cells, tails, strict=True)]
        for row, tails in rows
    ]


def _widths(pdf: FPDF, table: Table) -> tuple[float, ...]:
    """Return column widths [mm]: one line per text if it fits, otherwise at least the longest word or number."""
    natural, least, rows = [], [], _cells(table)
    for column, heading in enumerate(table.headings):
        lines, words = 0.0, 0.0
        # Bold text is wider, so it is measured in bold.
        for style, texts in (("B", [strip_styles(heading)]), ("", [row[column] for row in rows])):
            pdf.set_font(_FONT, style=style, size=_CELL_SIZE_PT)  # pyrefly: ignore[bad-argument-type]
            whole = table.numeric[column] and not style  # a number and its uncertainty stay on one line
            lines = max([lines, *map(pdf.get_string_width, texts)])
            pieces = texts if whole else [word for text in texts for word in text.split()]
            words = max([words, *map(pdf.get_string_width, pieces)])
        natural.append(lines + 2.4 + _CELL_SPACE_MM)
        least.append(words + 2.4 + _CELL_SPACE_MM)
    pdf.set_font(_FONT, size=_CELL_SIZE_PT)  # pyrefly: ignore[bad-argument-type]
    spare = pdf.epw - sum(least)
    wanted = sum(natural) - sum(least)
    if wanted <= spare:
        return tuple(natural)
    if spare <= 0.0:  # too narrow for whole words
        fair = [min(width, pdf.epw / len(least)) for width in least]
        share = (pdf.epw - sum(fair)) / ((sum(least) - sum(fair)) or 1.0)
        return tuple(a + (b - a) * share for a, b in zip(fair, least, strict=True))
    return tuple(a + (b - a) * spare / wanted for a, b in zip(least, natural, strict=True))


def _picture(pdf: FPDF, picture: Picture) -> None:
    width, height = _size(pdf, picture)
    if pdf.will_page_break(height + 8):
        pdf.add_page()
    pdf.image(io.BytesIO(picture.png), w=width)
    pdf.ln(1)


def _size(pdf: FPDF, picture: Picture) -> tuple[float, float]:
    """Return width and height on the page [mm]: as wide as fits with a heading above and a caption below."""
    from PIL import Image

    with Image.open(io.BytesIO(picture.png)) as image:
        share = image.height / image.width
    width = min(pdf.epw, (pdf.eph - 30) / share)
    return width, width * share
