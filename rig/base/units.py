"""Table of units: quantity, size in SI, and the spellings used by files and users."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from rig.base.errors import InputError
from rig.base.text import find_similar


@dataclass(frozen=True)
class _Unit:
    """A unit of the table.

    Attributes:
        quantity: The measured quantity.
        size: Size of the unit in the SI unit of the quantity.
        zero: Zero of the unit in that unit, for temperatures, and for Excel's serial days, of 1970.
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
"""Spellings in capitals that some logs use for a unit of the table, while in SI they mean another one."""
_DETECTOR = re.compile(
    r"(.+?)[\s_(,]*((?:0|zero|p|pk|peak)?[- ]?(?:to)?[- ]?(?:pk|peak)|p-p|pp|0-p|rms|eff)\)?", re.IGNORECASE
)
"""A unit followed by the name of a detector, such as rms."""
_SENSITIVITY = re.compile(r"\s*([-+0-9.eE]+)\s*([a-zA-Z\u00b5\u03bc]+)\s*/\s*(\S.*)")


_ASCII_SIGNS = str.maketrans({
    "\u00b5": "u", "\u03bc": "u", "\u00b9": "1", "\u00b2": "2", "\u207b": "-", "\u2212": "-", "\u2013": "-",
    "\u2044": "/", "\u00b0": "deg", "\u00ba": "deg", "\u02da": "deg", "\u2103": "degC", "\u2109": "degF",
})  # fmt: skip
"""Non-ASCII signs of units: micro, powers, minus, slash and degree."""


def _key(spelling: str) -> str:
    """Return a spelling without spaces, brackets and signs of multiplication and power, with u for micro."""
    text = spelling.strip().strip("[]()").translate(_ASCII_SIGNS)
    return re.sub(r"\*\*|[\s^*_·⋅∙]|(?<=[A-Za-z])\.(?=[A-Za-z]|$)", "", text)


_EXACT = {_key(name): name for name in _UNITS}
_FOLDED: dict[str, set[str]] = {}
for _rows in _TABLE.values():
    for _name, _row in _rows.items():
        for _spelling in (_name, *_row.get("also", ())):
            _FOLDED.setdefault(_key(_spelling).lower(), set()).add(_name)


def _find(spelling: str) -> tuple[str, ...]:
    """Return the units that a spelling can mean: one if it is known, several if it is ambiguous."""
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
"""Quantities of the units, as `get_quantity` returns them."""


def canonical(unit: str) -> str:
    """Return a unit in this project's spelling; an unknown or ambiguous one unchanged."""
    candidates = _find(unit)
    return candidates[0] if len(candidates) == 1 else unit.strip()


def split_detector(unit: str) -> tuple[str, str]:
    """Return a unit without the reading of a detector at its end, such as rms, and that reading."""
    match = _DETECTOR.fullmatch(unit.strip())
    return (match[1], match[2]) if match and is_known(match[1]) else (unit, "")


def is_known(unit: str) -> bool:
    """Return whether a unit can be converted; any known spelling is accepted."""
    return canonical(unit) in _UNITS


def _unknown(unit: str, also: Iterable[str] = ()) -> str:
    """Return the requirement for a unit that is not known, with a suggestion."""
    candidates = _find(unit)
    if len(candidates) > 1:
        return f"unambiguous: {' or '.join(candidates)}"
    plain, detector = split_detector(unit)
    if detector:
        name = canonical(plain)
        return f"a unit of samples, such as {name} ({detector} is the reading of a detector; give {name} if it is not)"
    similar = find_similar(canonical(unit), (*_UNITS, *_FOLDED, *also), most=1)
    return f"a known unit{f', such as {canonical(similar[0])}' if similar else ''}"


def parse(unit: str, *, field: str, also: Iterable[str] = ()) -> str:
    """Return a unit in this project's spelling.

    Args:
        unit: Spelling in a file; empty, "-" and "none" are the number 1.
        field: Field that named the unit, for errors.
        also: Other accepted names, for suggestions in errors.

    Raises:
        InputError: The unit is unknown or ambiguous, or has a detector's suffix (rms, pk, pk-pk).
    """
    if not is_known(unit):
        raise InputError(field, _unknown(unit, also), unit)
    return canonical(unit)


def get_quantity(unit: str) -> str:
    """Return the quantity that a unit measures: length, force, voltage, ...; empty if it is unknown."""
    entry = _UNITS.get(canonical(unit))
    return entry.quantity if entry else ""


def size_si(unit: str) -> float:
    """Return the size of a unit in SI; 1 for an unknown unit."""
    entry = _UNITS.get(canonical(unit))
    return entry.size if entry else 1.0


def zero_of(unit: str) -> float:
    """Return the number of a unit at the zero of the SI unit; 0 for an unknown unit."""
    entry = _UNITS.get(canonical(unit))
    return entry.zero if entry else 0.0


def get_si_unit(unit: str) -> tuple[str, float, float]:
    """Return the SI unit of a unit's quantity, and the size and zero of the unit in it.

    An unknown unit is returned unchanged, with 1 and 0.
    """
    entry = _UNITS.get(canonical(unit))
    return (_SI[entry.quantity], entry.size, entry.zero) if entry else (unit, 1.0, 0.0)


def factor(unit: str, target: str, *, field: str) -> float:
    """Return the factor that converts values in `unit` to `target`.

    Args:
        unit: Unit of the values.
        target: Unit to convert to.
        field: Field that named the unit, for errors.

    Raises:
        InputError: A unit is unknown, or the two differ in quantity or zero.
    """
    source, target_unit = canonical(unit), canonical(target)
    if source == target_unit:
        return 1.0
    if target_unit not in _UNITS:
        raise InputError(field, f"{target}, the unit of the channel, which has no conversion", unit)
    quantity = _UNITS[target_unit].quantity
    allowed = [name for name, each in _UNITS.items() if each.quantity == quantity]
    if source not in _UNITS:
        if len(_find(unit)) > 1 or _DETECTOR.fullmatch(unit.strip()):
            raise InputError(field, _unknown(unit), unit)
        similar = find_similar(source, allowed, most=1)
        hint = f" (such as {similar[0]})" if similar else ""
        raise InputError(field, f"one of {', '.join(allowed)}, or V or mV with a sensitivity{hint}", unit)
    if _UNITS[source].quantity != quantity:
        hint = ", with a sensitivity" if _UNITS[source].quantity == "voltage" else ""
        raise InputError(field, f"a unit of {quantity} ({', '.join(allowed)}){hint}", unit)
    if _UNITS[source].zero != _UNITS[target_unit].zero:
        raise InputError(field, f"{target_unit}, as {source} counts from another zero", unit)
    return _UNITS[source].size / _UNITS[target_unit].size


def sensitivity_v(text: str, target: str, *, field: str) -> float:
    """Return a sensitivity such as "200 mV/mil" in volts per `target` unit.

    Raises:
        InputError: The text has another form, or the quantity differs.
    """
    match = _SENSITIVITY.fullmatch(text)
    try:
        number = float(match[1]) if match else 0.0
    except ValueError:
        number = 0.0
    if match is None or not number or not math.isfinite(number) or get_quantity(match[2]) != "voltage":
        raise InputError(field, 'volts per unit, such as "7.87 V/mm", "200 mV/mil" or "100 mV/g"', text)
    if get_quantity(match[3]) != get_quantity(target):
        allowed = [name for name, each in _UNITS.items() if each.quantity == get_quantity(target)]
        must = f"volts per unit of {get_quantity(target)} ({', '.join(allowed)})" if allowed else f"volts per {target}"
        raise InputError(field, must, text)
    return number * size_si(match[2]) / factor(match[3], target, field=field)
