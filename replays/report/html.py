"""A report as one HTML file: pictures inside, no script, nothing fetched."""

from __future__ import annotations

import base64
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import jinja2

    from replays.report.document import Report


def render(report: Report) -> bytes:
    """The report as a page."""
    from replays.report.document import Heading

    contents = [(number, part) for number, part in enumerate(report.parts) if isinstance(part, Heading)]
    return _template().render(report=report, contents=contents, kind=lambda part: type(part).__name__).encode()


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
    environment.filters["base64"] = lambda data: base64.b64encode(data).decode()
    return environment.from_string(files("replays.report").joinpath("page.html").read_text(encoding="utf-8"))
