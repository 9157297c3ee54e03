"""Markdown output of a report: text and tables, and captions in place of pictures."""

from __future__ import annotations

from collections.abc import Iterable

from replays.report.document import Heading, Paragraph, Report, Table


def render(report: Report) -> bytes:
    """Return the report as Markdown with pipe tables."""
    blocks = [f"# {report.title}", report.lead]
    if report.origin:
        blocks.append("\n".join(f"- {name}: {text}" for name, text in report.origin.items()))
    for part in report.parts:
        match part:
            case Heading():
                blocks.append(f"{'#' * (part.level + 1)} {part.text}")
            case Paragraph():
                blocks.append(part.text)
            case Table():
                rows = [part.headings, ["---"] * len(part.headings), *(row.cells for row in part.rows)]
                blocks += [part.caption, "\n".join(map(_format_row, rows))]
            case _:
                blocks.append(part.caption)
    return ("\n\n".join(filter(None, blocks)) + "\n").encode()


def _format_row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
