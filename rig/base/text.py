"""Text that is not ours, made fit to be shown: names, notes and values that a client, a file or a bus has sent."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterable
from typing import Any

_MOST = 500
"""Longest value that is shown whole [characters]."""
_LONG_INT_BITS = 256


class Words(str):
    """Words of ours about what was received, which are shown as they stand; any other text is a value and quoted."""


def printable(text: str, most: int | None = None) -> str:
    """The same text without anything that a terminal would act on.

    Args:
        text: White space of every kind becomes a blank, other characters that cannot be printed (escapes, marks that
            turn the direction of writing, halves of surrogate pairs) their escaped form.
        most: Longest result [characters]; what is left out of the middle becomes three dots.
    """
    if not text.isprintable():
        text = "".join(
            each if each.isprintable() else " " if each.isspace() else each.encode("unicode_escape").decode("ascii")
            for each in text
        )
    if most is not None and len(text) > most:
        text = f"{text[: most - most // 3 - 3]}...{text[len(text) - most // 3 :]}"
    return text


def nearest(name: object, known: Iterable[str], *, most: int = 3) -> list[str]:
    """Names that one which is none could have been meant for, the nearest first; upper and lower case are alike.

    Args:
        name: What was given.
        known: The names that there are.
        most: How many at most.

    Example:
        >>> nearest("p_n", ["P_N", "P_S", "disk_x"], most=1)
        ['P_N']
    """
    import difflib

    folded = {each.casefold(): each for each in known}
    return [folded[each] for each in difflib.get_close_matches(str(name)[:100].casefold(), folded, most, 0.5)]


def finite(value: Any) -> Any:
    """The same document with None for numbers that JSON cannot carry: a diverged run must still be able to say so."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: finite(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return value


class _Shown(reprlib.Repr):
    """A repr that is bounded in depth and length, whatever it is given."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 5
        self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdict = self.maxarray = 20
        self.maxstring = self.maxother = _MOST
        self.maxlong = 60

    def repr_int(self, x: int, level: int) -> str:
        # Python itself refuses to write integers of more than 4300 digits.
        if x.bit_length() > _LONG_INT_BITS:
            return f"a whole number of about {round(x.bit_length() * 0.30103)} digits"
        return super().repr_int(x, level)


def shown(value: object) -> str:
    """A value as an error shows it: its bounded repr, and `nothing` for None, as for a field that is missing."""
    if isinstance(value, Words):
        return printable(value, 2 * _MOST)
    return "nothing" if value is None else printable(_Shown().repr(value), 2 * _MOST)
