"""The table of units: what each one measures, its size in SI, and the spellings that files and people use for it."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from rig.errors import InputError
from rig.text import nearest

_TURN = 2.0 * math.pi
_STANDARD_GRAVITY = 9.80665
_POUND_FORCE = 4.4482216152605
_INCH, _FOOT = 25.4e-3, 0.3048
_RANKINE = 1.0 / 1.8
"""Size of a degree Fahrenheit [K]."""


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


# Per quantity: the unit's name, its size in SI, and other spellings, with "|" between them. Case, blanks, signs of
# multiplication and power, and the plural's s are alike to `_key` and `_find`, and are not listed.
_TABLE: dict[str, tuple[tuple[str, float, str], ...]] = {
    "length": (
        ("m", 1.0, "meter|metre"), ("cm", 1e-2, "centimeter|centimetre"), ("mm", 1e-3, "millimeter|millimetre"),
        ("um", 1e-6, "micron|micrometer|micrometre"), ("nm", 1e-9, "nanometer|nanometre"),
        ("in", _INCH, 'inch|inches|"'), ("mil", 1e-3 * _INCH, ""), ("thou", 1e-3 * _INCH, ""),
        ("ft", _FOOT, "foot|feet"),
    ),
    "force": (
        ("N", 1.0, "newton"), ("mN", 1e-3, "millinewton"), ("daN", 10.0, "decanewton"), ("kN", 1e3, "kilonewton"),
        ("lbf", _POUND_FORCE, "lb|pound-force"), ("kip", 1e3 * _POUND_FORCE, "klbf"),
        ("kgf", _STANDARD_GRAVITY, "kp|kilopond"),
    ),
    "acceleration": (
        ("m/s^2", 1.0, "ms-2|m/s/s|mps2|m/s\u00c22"), ("mm/s^2", 1e-3, "mms-2|mm/s/s"), ("cm/s^2", 1e-2, "cms-2"),
        ("um/s^2", 1e-6, "ums-2"), ("g", _STANDARD_GRAVITY, "gn|g0|g's"), ("mg", 1e-3 * _STANDARD_GRAVITY, ""),
        ("in/s^2", _INCH, "ins-2|ips2|in/s/s"), ("ft/s^2", _FOOT, "fts-2|ft/s/s"),
    ),
    "velocity": (
        ("m/s", 1.0, "ms-1|mps|m/sec"), ("cm/s", 1e-2, "cms-1|cm/sec"), ("mm/s", 1e-3, "mms-1|mm/sec"),
        ("um/s", 1e-6, "ums-1|um/sec"), ("in/s", _INCH, "ins-1|ips|in/sec|inch/s|inch/sec"),
        ("mil/s", 1e-3 * _INCH, ""), ("ft/s", _FOOT, "fts-1|fps|ft/sec"),
    ),
    # 1 Hz of a rotation is a turn a second.
    "speed of rotation": (
        ("Hz", _TURN, "hertz|1/s|s-1|rps|rev/s"), ("kHz", 1e3 * _TURN, "kilohertz"),
        ("rpm", _TURN / 60.0, "1/min|u/min|min-1|r/min|rev/min|cpm|upm"), ("krpm", 1e3 * _TURN / 60.0, ""),
        ("rad/s", 1.0, "rads-1|rad/sec"), ("deg/s", _TURN / 360.0, "degs-1|deg/sec"),
    ),
    "angle": (
        ("rad", 1.0, "radian"), ("mrad", 1e-3, "milliradian"), ("deg", _TURN / 360.0, "degree"),
        ("rev", _TURN, "turn|revolution"),
    ),
    "torque": (
        ("N m", 1.0, "newtonmeter|newtonmetre|n-m"), ("mN m", 1e-3, ""), ("kN m", 1e3, ""), ("N mm", 1e-3, ""),
        ("daN m", 10.0, ""), ("kgf m", _STANDARD_GRAVITY, "kpm"),
        ("lbf ft", _FOOT * _POUND_FORCE, "ftlb|ftlbf|lbft|ft-lb|ft-lbf|lb-ft|lbf-ft"),
        ("lbf in", _INCH * _POUND_FORCE, "inlb|inlbf|lbin|in-lb|in-lbf|lb-in|lbf-in"),
    ),
    "pressure": (
        ("Pa", 1.0, "pascal|n/m2"), ("mPa", 1e-3, ""), ("hPa", 1e2, ""), ("kPa", 1e3, ""), ("MPa", 1e6, "n/mm2"),
        ("GPa", 1e9, ""), ("bar", 1e5, ""), ("mbar", 1e2, "millibar"),
        ("psi", _POUND_FORCE / _INCH**2, "lbf/in2|lb/in2"),
    ),
    "temperature": (("K", 1.0, "kelvin"), ("degC", 1.0, "celsius|degreec"), ("degF", _RANKINE, "fahrenheit|degreef")),
    "voltage": (("V", 1.0, "volt|vdc"), ("mV", 1e-3, "millivolt"), ("uV", 1e-6, "microvolt"), ("kV", 1e3, "kilovolt")),
    "current": (("A", 1.0, "amp|ampere"), ("mA", 1e-3, "milliamp|milliampere"), ("uA", 1e-6, "microamp")),
    "time": (
        ("s", 1.0, "sec|second"), ("ms", 1e-3, "msec|millisec|millisecond"), ("us", 1e-6, "usec|microsec|microsecond"),
        ("ns", 1e-9, "nsec|nanosec|nanosecond"), ("min", 60.0, "minute"), ("h", 3600.0, "hr|hour"),
        ("d", 86400.0, "day"),
    ),
    "number": (("1", 1.0, "|-|none|[-]|v/v"),),
}  # fmt: skip
"""Sizes are exact by definition (1 in = 25.4 mm, standard gravity, the international pound)."""
_ZEROS = {"degC": 273.15, "degF": 459.67 * _RANKINE}
"""Zero of a scale of temperature [K]."""
_UNITS = {
    name: _Unit(quantity, size, _ZEROS.get(name, 0.0)) for quantity, rows in _TABLE.items() for name, size, _ in rows
}
_SI = {unit.quantity: name for name, unit in reversed(_UNITS.items()) if (unit.size, unit.zero) == (1.0, 0.0)}
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
for _quantity_rows in _TABLE.values():
    for _name, _, _others in _quantity_rows:
        for _spelling in (_name, *_others.split("|")) if _others else (_name,):
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


def canonical(unit: str) -> str:
    """Return a unit as this project spells it; an unknown or ambiguous one as it stands."""
    found = _find(unit)
    return found[0] if len(found) == 1 else unit.strip()


def known(unit: str) -> bool:
    """Return whether a unit, as a file may spell it, can be converted."""
    return canonical(unit) in _UNITS


def _unknown(unit: str) -> str:
    """Return why a spelling is not a known unit, with what to give instead."""
    found = _find(unit)
    if len(found) > 1:
        return f"unambiguous: {' or '.join(found)}"
    if (split := _DETECTOR.fullmatch(unit.strip())) and known(split[1]):
        name = canonical(split[1])
        return f"a unit of samples, such as {name} ({split[2]} is the reading of a detector; give {name} if it is not)"
    close = nearest(canonical(unit), _UNITS, most=1)
    return f"a known unit{f', such as {close[0]}' if close else ''}"


def parse(unit: str, *, field: str) -> str:
    """Return a unit as this project spells it.

    Args:
        unit: As a file or a person spells it; empty, "-" and "none" are the number 1.
        field: Field that named the unit, for errors.

    Raises:
        InputError: It is unknown, ambiguous, or has a detector's suffix (rms, pk, pk-pk).
    """
    if not known(unit):
        raise InputError(field, _unknown(unit), unit)
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
