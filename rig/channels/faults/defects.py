"""Table of the defects of channels and streams, read from `defects.toml`.

Faults inject these defects, and `rig validate`, `rig score` and `rig import` recognise them. All of these use the
names, units and size texts of this table, so that a defect has the same name everywhere.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple


class Defect(NamedTuple):
    """A row of the table; `defects.toml` describes the columns."""

    text: str
    unit: str = ""
    size: str = ""
    words: str = ""
    faults: Mapping[str, str] = {}
    neutral: float = 0.0
    validation: Sequence[str] = ()
    log_name: str = ""
    score: Sequence[str] = ()
    digital: Sequence[str] = ()
    doubts: str = ""
    guess: str = ""
    undetected: Mapping[str, str] = {}
    slips: Sequence[tuple[float, str]] = ()


DEFECTS = {
    name: Defect(**row)
    for name, row in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")).items()
}


def alternatives(words: str) -> list[str]:
    """Return the names in a list of alternatives such as "open, short or stuck"."""
    return re.split(", | or ", words)


def unit_of(words: str, unit: str) -> str:
    """Return the unit of a defect's size on a channel; of several alternatives, that of the first."""
    return DEFECTS[alternatives(words)[0].partition(" and ")[0]].unit.format(unit=unit)


def size_text(name: str, value: float, unit: str = "") -> str:
    """Return the size of a defect as text with its unit.

    Args:
        name: Name in the table.
        value: Size in the table's unit.
        unit: Unit of the channel.
    """
    also = {"percent": 100.0 * value, "us": 1e6 * value, "degrees": math.degrees(value)}
    return DEFECTS[name].words.format(value=value, unit=unit, **also)


def defects_in(words: str) -> tuple[str, ...]:
    """Return the names in the table of the defects in a validation's wording."""
    names = list[str]()
    for part in alternatives(words):
        names += [one for one in part.split(" and ") if one in DEFECTS] or [
            name for name, each in DEFECTS.items() if part in each.validation
        ]
    return tuple(dict.fromkeys(names))


def defects_shown(failed: Collection[str], *, digital: bool) -> list[str]:
    """Return the defects that explain the failed quantities of a scorecard, without those that explain only a part."""
    sets = {name: {*(each.digital if digital else each.score)} for name, each in DEFECTS.items()}
    shown = {name: each for name, each in sets.items() if each and each <= {*failed}}
    return [name for name, each in shown.items() if not any(each < other for other in shown.values())]


def earlier_name(words: str) -> str:
    """Return a text that ends with a defect's name under the name in the JSON of earlier imported logs."""
    for name, each in DEFECTS.items():
        if each.log_name and words.endswith(name):
            return words.removesuffix(name) + each.log_name
    return words
