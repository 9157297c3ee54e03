"""HTML output of a report: one file with embedded pictures, without scripts or external resources."""

from __future__ import annotations

import base64
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import jinja2
    from markupsafe import Markup

    from replays.report.document import Report


def render(report: Report) -> bytes:
    """Return the report as a page."""
    from replays.report.document import Heading

    contents = [(number, part) for number, part in enumerate(report.parts) if isinstance(part, Heading)]
    # Parts before the first heading come before the contents: the result and its picture.
    first = contents[0][0] if contents else None
    page = _template().render(
        report=report, contents=contents, contents_at=first, kind=lambda part: type(part).__name__
    )
    return page.encode()


def _to_markup(text: str) -> Markup:
    """Return a text as markup with code, subscripts and superscripts."""
    from markupsafe import Markup, escape

    from replays.report.document import fragments

    return Markup("").join(
        Markup("<{0}>{1}</{0}>").format(style, piece) if style else escape(piece) for piece, style in fragments(text)
    )


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


@cache
def _template() -> jinja2.Template:
    import jinja2

    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["base64"] = _base64
    environment.filters["marked"] = _to_markup
    return environment.from_string(files("replays.report").joinpath("page.html").read_text(encoding="utf-8"))
