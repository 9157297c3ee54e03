"""Defects: one table of what can be wrong with a channel or a stream, in `defects.toml`.

Faults on command inject them, and `rig validate`, `rig score` and `rig import` recognise them. All of these take
names, units and the text of sizes from this table, so that one defect has one name.
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
    """Return the defects that words such as "open, short or stuck" offer."""
    return re.split(", | or ", words)


def unit_of(words: str, unit: str) -> str:
    """Return the unit of a defect's size on a channel with a unit; of several defects, that of the first."""
    return DEFECTS[alternatives(words)[0].partition(" and ")[0]].unit.format(unit=unit)


def size_text(name: str, value: float, unit: str = "") -> str:
    """Return the size of a defect, in its unit, as text for a channel with a unit."""
    also = {"percent": 100.0 * value, "us": 1e6 * value, "degrees": math.degrees(value)}
    return DEFECTS[name].words.format(value=value, unit=unit, **also)


def defects_in(words: str) -> tuple[str, ...]:
    """Return the names in the table of the defects that a validation reports in words."""
    found = list[str]()
    for part in alternatives(words):
        found += [one for one in part.split(" and ") if one in DEFECTS] or [
            name for name, each in DEFECTS.items() if part in each.validation
        ]
    return tuple(dict.fromkeys(found))


def defects_shown(failed: Collection[str], *, digital: bool) -> list[str]:
    """Return the defects that make quantities of a scorecard fail, without those that explain a part of them only."""
    sets = {name: {*(each.digital if digital else each.score)} for name, each in DEFECTS.items()}
    shown = {name: each for name, each in sets.items() if each and each <= {*failed}}
    return [name for name, each in shown.items() if not any(each < other for other in shown.values())]


def earlier_name(words: str) -> str:
    """Return words with a defect at their end under the name that JSON of imported logs had first."""
    for name, each in DEFECTS.items():
        if each.log_name and words.endswith(name):
            return words.removesuffix(name) + each.log_name
    return words
