"""A report as PDF, page by page."""

from __future__ import annotations

import io
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from replays.report.document import Heading, Paragraph, Picture, Report, Row, Table

if TYPE_CHECKING:
    from fpdf import FPDF

_INK, _SOFT = (26, 26, 26), (102, 102, 102)
_MARKS = {"good": (0, 121, 79), "bad": (179, 38, 30), "open": (154, 103, 0), "plain": _INK}
_FONT = "DejaVu"


def render(report: Report) -> bytes:
    """The report as a PDF document, A4."""
    from fpdf import FPDF
    from fpdf.enums import XPos, YPos
    from matplotlib import get_data_path

    class _Pages(FPDF):
        def footer(self) -> None:
            self.set_y(-12)
            self.set_font(_FONT, size=8)
            self.set_text_color(*_SOFT)
            self.cell(0, 6, f"{report.title}   {self.page_no()}", align="R")

    pdf = _Pages(format="A4", unit="mm")
    # Without the date of writing, the same report gives the same file.
    pdf.set_creation_date(datetime(2000, 1, 1, tzinfo=UTC))
    pdf.set_title(report.title)
    fonts = Path(get_data_path()) / "fonts" / "ttf"  # the built-in fonts of PDF have no Greek
    pdf.add_font(_FONT, fname=fonts / "DejaVuSans.ttf")
    pdf.add_font(_FONT, style="B", fname=fonts / "DejaVuSans-Bold.ttf")
    pdf.set_margins(18, 16)
    pdf.set_auto_page_break(True, margin=16)
    pdf.add_page()

    def write(text: str, *, size: float, bold: bool = False, colour: tuple[int, int, int] = _INK) -> None:
        pdf.set_font(_FONT, style="B" if bold else "", size=size)
        pdf.set_text_color(*colour)
        pdf.multi_cell(0, size * 0.5, text, new_x=XPos.LMARGIN, new_y=YPos.NEXT, align="L")
        pdf.ln(1.5)

    write(report.title, size=16, bold=True)
    if report.lead:
        write(report.lead, size=10, colour=_SOFT)
    for part in report.parts:
        if isinstance(part, Heading):
            pdf.ln(3)
            if pdf.will_page_break(30):  # a heading does not stand alone at the foot of a page
                pdf.add_page()
            write(part.text, size=13 if part.level == 1 else 11, bold=True)
        elif isinstance(part, Paragraph):
            write(part.text, size=9)
        elif isinstance(part, Table):
            if part.caption:
                write(part.caption, size=8, colour=_SOFT)
            _table(pdf, part)
            pdf.ln(2)
        else:
            _picture(pdf, part)
            write(part.caption, size=8, colour=_SOFT)
    return bytes(pdf.output())


def _table(pdf: FPDF, table: Table) -> None:
    from fpdf.fonts import FontFace

    pdf.set_font(_FONT, size=7.5)
    pdf.set_text_color(*_INK)
    pdf.set_draw_color(221, 221, 221)
    # Wide enough for the text of a column, so far as there is room.
    rows = [Row(table.headings), *table.rows]
    widths = tuple(
        min(60.0, max(8.0, *(pdf.get_string_width(row.cells[n]) + 3 for row in rows)))
        for n in range(len(table.headings))
    )
    width = min(pdf.epw, sum(widths))
    with pdf.table(
        col_widths=widths,
        width=width,
        align="L",
        text_align="L",
        line_height=4,
        borders_layout="HORIZONTAL_LINES",
        headings_style=FontFace(emphasis="BOLD"),
        padding=0.6,
    ) as grid:
        grid.row(table.headings)
        for row in table.rows:
            line = grid.row()
            for n, cell in enumerate(row.cells):
                last = n == len(row.cells) - 1
                line.cell(cell, style=FontFace(color=_MARKS[row.mark] if last else _INK))


def _picture(pdf: FPDF, picture: Picture) -> None:
    from PIL import Image

    with Image.open(io.BytesIO(picture.png)) as image:
        share = image.height / image.width
    width = min(pdf.epw, (pdf.eph - 15) / share)
    if pdf.will_page_break(width * share + 8):
        pdf.add_page()
    pdf.image(io.BytesIO(picture.png), w=width)
    pdf.ln(1)
