"""The table of units: what each one measures, its size in SI, and the spellings that files and people use for it."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from rig.base.errors import InputError
from rig.base.text import nearest


@dataclass(frozen=True)
class _Unit:
    """A unit of the table.

    Attributes:
        quantity: What it measures.
        size: One of it in the SI unit of the quantity.
        zero: Its zero in that unit; only temperatures have one.
    """

    quantity: str
    size: float
    zero: float = 0.0


_TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_UNITS = {
    name: _Unit(of, row["size"], row.get("zero", 0.0)) for of, rows in _TABLE.items() for name, row in rows.items()
}
_SI = {quantity: next(iter(rows)) for quantity, rows in _TABLE.items()}
"""SI unit of each quantity."""
_AMBIGUOUS = {
    "M": ("m", "min"), "MN": ("mN", "meganewton"), "MV": ("mV", "megavolt"), "MG": ("mg", "megagram"),
    "MA": ("mA", "megaampere"), "C": ("degC", "coulomb"), "F": ("degF", "farad"), "k": ("K", "kilo"),
}  # fmt: skip
"""Spellings that a log in capitals, or a careless one, uses for a unit of the table, and the SI for another one."""
_DETECTOR = re.compile(
    r"(.+?)[\s_(,]*((?:0|zero|p|pk|peak)?[- ]?(?:to)?[- ]?(?:pk|peak)|p-p|pp|0-p|rms|eff)\)?", re.IGNORECASE
)
"""A unit, and the detector whose reading of a stretch of signal a value is."""
_SENSITIVITY = re.compile(r"\s*([-+0-9.eE]+)\s*([a-zA-Z\u00b5\u03bc]+)\s*/\s*(\S.*)")


_PLAIN = str.maketrans({
    "\u00b5": "u", "\u03bc": "u", "\u00b9": "1", "\u00b2": "2", "\u207b": "-", "\u2212": "-", "\u2013": "-",
    "\u2044": "/", "\u00b0": "deg", "\u00ba": "deg", "\u02da": "deg", "\u2103": "degC", "\u2109": "degF",
})  # fmt: skip
"""Non-ASCII signs of units: micro, powers, minus, slash and degree."""


def _key(spelling: str) -> str:
    """Return a spelling without blanks, brackets and signs of multiplication and power, with u for micro."""
    text = spelling.strip().strip("[]()").translate(_PLAIN)
    return re.sub(r"\*\*|[\s^*_·⋅∙]|(?<=[A-Za-z])\.(?=[A-Za-z]|$)", "", text)


_EXACT = {_key(name): name for name in _UNITS}
_FOLDED: dict[str, set[str]] = {}
for _rows in _TABLE.values():
    for _name, _row in _rows.items():
        for _spelling in (_name, *_row.get("also", ())):
            _FOLDED.setdefault(_key(_spelling).lower(), set()).add(_name)


def _find(spelling: str) -> tuple[str, ...]:
    """Return the units that a spelling can stand for: one where it is known, several where it is ambiguous."""
    key = _key(spelling)
    if key in _AMBIGUOUS:
        return _AMBIGUOUS[key]
    if key in _EXACT:
        return (_EXACT[key],)
    if not key and spelling.strip():  # signs only
        return ()
    folded = key.lower()
    if folded not in _FOLDED and folded.endswith("s") and (len(folded) > 3 or folded in ("gs", "lbs", "hrs")):
        folded = folded[:-1]
    return tuple(sorted(_FOLDED.get(folded, ())))


QUANTITIES = tuple(_TABLE)
"""What units of the table measure, as `kind` returns it."""


def canonical(unit: str) -> str:
    """Return a unit as this project spells it; an unknown or ambiguous one as it stands."""
    found = _find(unit)
    return found[0] if len(found) == 1 else unit.strip()


def known(unit: str) -> bool:
    """Return whether a unit, as a file may spell it, can be converted."""
    return canonical(unit) in _UNITS


def _unknown(unit: str, also: Iterable[str] = ()) -> str:
    """Return why a spelling is not a known unit, with a unit or another accepted name to give instead."""
    found = _find(unit)
    if len(found) > 1:
        return f"unambiguous: {' or '.join(found)}"
    if (split := _DETECTOR.fullmatch(unit.strip())) and known(split[1]):
        name = canonical(split[1])
        return f"a unit of samples, such as {name} ({split[2]} is the reading of a detector; give {name} if it is not)"
    close = nearest(canonical(unit), (*_UNITS, *_FOLDED, *also), most=1)
    return f"a known unit{f', such as {canonical(close[0])}' if close else ''}"


def parse(unit: str, *, field: str, also: Iterable[str] = ()) -> str:
    """Return a unit as this project spells it.

    Args:
        unit: As a file or a person spells it; empty, "-" and "none" are the number 1.
        field: Field that named the unit, for errors.
        also: Other names that the field accepts, which an error can propose.

    Raises:
        InputError: It is unknown, ambiguous, or has a detector's suffix (rms, pk, pk-pk).
    """
    if not known(unit):
        raise InputError(field, _unknown(unit, also), unit)
    return canonical(unit)


def kind(unit: str) -> str:
    """Return the quantity that a unit measures: length, force, voltage, ...; empty if it is unknown."""
    found = _UNITS.get(canonical(unit))
    return found.quantity if found else ""


def size_si(unit: str) -> float:
    """Return one of the unit in SI; 1 for a unit that is unknown."""
    found = _UNITS.get(canonical(unit))
    return found.size if found else 1.0


def in_si(unit: str) -> tuple[str, float, float]:
    """Return the SI unit of what a unit measures, one of the unit in it, and the unit's zero in it.

    An unknown unit stays as it is, with 1 and 0.
    """
    found = _UNITS.get(canonical(unit))
    return (_SI[found.quantity], found.size, found.zero) if found else (unit, 1.0, 0.0)


def factor(unit: str, target: str, *, field: str) -> float:
    """Return the number of `target` in one of `unit`.

    Args:
        unit: What the values are in.
        target: What they are wanted in.
        field: Field that named the unit, for errors.

    Raises:
        InputError: A unit is unknown, or the two measure different things or count from another zero.
    """
    source, wanted = canonical(unit), canonical(target)
    if source == wanted:
        return 1.0
    if wanted not in _UNITS:
        raise InputError(field, f"{target}, the unit of the channel, which has no conversion", unit)
    quantity = _UNITS[wanted].quantity
    allowed = [name for name, each in _UNITS.items() if each.quantity == quantity]
    if source not in _UNITS:
        if len(_find(unit)) > 1 or _DETECTOR.fullmatch(unit.strip()):
            raise InputError(field, _unknown(unit), unit)
        close = nearest(source, allowed, most=1)
        hint = f" (such as {close[0]})" if close else ""
        raise InputError(field, f"one of {', '.join(allowed)}, or V or mV with a sensitivity{hint}", unit)
    if _UNITS[source].quantity != quantity:
        hint = ", with a sensitivity" if _UNITS[source].quantity == "voltage" else ""
        raise InputError(field, f"a unit of {quantity} ({', '.join(allowed)}){hint}", unit)
    if _UNITS[source].zero != _UNITS[wanted].zero:
        raise InputError(field, f"{wanted}, as {source} counts from another zero", unit)
    return _UNITS[source].size / _UNITS[wanted].size


def sensitivity_v(text: str, target: str, *, field: str) -> float:
    """Return a sensitivity such as "200 mV/mil" in volts per `target` unit.

    Raises:
        InputError: It does not read so, or is of another quantity.
    """
    match = _SENSITIVITY.fullmatch(text)
    try:
        number = float(match[1]) if match else 0.0
    except ValueError:
        number = 0.0
    if match is None or not number or not math.isfinite(number) or kind(match[2]) != "voltage":
        raise InputError(field, 'volts per unit, such as "7.87 V/mm", "200 mV/mil" or "100 mV/g"', text)
    if kind(match[3]) != kind(target):
        allowed = [name for name, each in _UNITS.items() if each.quantity == kind(target)]
        must = f"volts per unit of {kind(target)} ({', '.join(allowed)})" if allowed else f"volts per {target}"
        raise InputError(field, must, text)
    return number * size_si(match[2]) / factor(match[3], target, field=field)
