"""Text from clients, files and buses, made safe for display."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterable, Sequence
from typing import Any

_MAX_CHARACTERS = 500
"""Longest value shown in full [characters]."""
_LONG_INT_BITS = 256


class Words(str):
    """Our own description of a received value, shown as it is; other text is quoted."""


def printable(text: str, most: int | None = None) -> str:
    """Return the text without characters that affect a terminal.

    Args:
        text: White space becomes a space; other unprintable characters (escapes, direction marks, unpaired surrogates)
            become escape sequences.
        most: Longest result [characters]; the middle of longer texts is replaced by three dots.
    """
    if not text.isprintable():
        text = "".join(
            each if each.isprintable() else " " if each.isspace() else each.encode("unicode_escape").decode("ascii")
            for each in text
        )
    if most is not None and len(text) > most:
        text = f"{text[: most - most // 3 - 3]}...{text[len(text) - most // 3 :]}"
    return text


def build_html_table(title: str, headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a titled table in HTML, for objects in a notebook; all text is escaped.

    Args:
        title: Line above the table.
        headings: Heading of each column.
        rows: Cells of each row.
    """

    def escape(text: str) -> str:
        return printable(text).translate({ord("&"): "&amp;", ord("<"): "&lt;", ord(">"): "&gt;"})

    def line(tag: str, cells: Sequence[object]) -> str:
        return "<tr>" + "".join(f"<{tag}>{escape(str(cell))}</{tag}>" for cell in cells) + "</tr>"

    body = "".join(line("td", row) for row in rows)
    return f"<p>{escape(title)}</p><table><thead>{line('th', headings)}</thead><tbody>{body}</tbody></table>"


def find_similar(name: object, known_names: Iterable[str], *, most: int = 3) -> list[str]:
    """Return known names similar to an unknown one, most similar first; case is ignored.

    Args:
        name: The unknown name.
        known_names: The known names.
        most: Largest number of names.

    Example:
        >>> find_similar("p_n", ["P_N", "P_S", "disk_x"], most=1)
        ['P_N']
    """
    import difflib

    folded = {each.casefold(): each for each in known_names}
    return [folded[each] for each in difflib.get_close_matches(str(name)[:100].casefold(), folded, most, 0.5)]


def replace_nonfinite(value: Any) -> Any:
    """Return the document with None for numbers that JSON cannot represent, as in a diverged run."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: replace_nonfinite(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [replace_nonfinite(item) for item in value]
    return value


class _BoundedRepr(reprlib.Repr):
    """A repr with limited depth and length for any object."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 5
        self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdict = self.maxarray = 20
        self.maxstring = self.maxother = _MAX_CHARACTERS
        self.maxlong = 60

    def repr_int(self, x: int, level: int) -> str:
        # Python refuses to convert integers of more than 4300 digits.
        if x.bit_length() > _LONG_INT_BITS:
            return f"a whole number of about {round(x.bit_length() * 0.30103)} digits"
        return super().repr_int(x, level)


def format_value(value: object) -> str:
    """Return a value as shown in errors: a bounded repr, or `nothing` for None, as for a missing field."""
    if isinstance(value, Words):
        return printable(value, 2 * _MAX_CHARACTERS)
    return "nothing" if value is None else printable(_BoundedRepr().repr(value), 2 * _MAX_CHARACTERS)
