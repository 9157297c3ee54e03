"""Units that this rig and other measuring systems write, each with what it measures and its size in SI."""

from __future__ import annotations

import math
import re

from rig.errors import InputError
from rig.text import nearest

_TURN = 2.0 * math.pi
_STANDARD_GRAVITY = 9.80665
_POUND_FORCE = 4.4482216152605

_UNITS: dict[str, tuple[str, float]] = {
    **{name: ("length", size) for name, size in (
        ("m", 1.0), ("cm", 1e-2), ("mm", 1e-3), ("um", 1e-6), ("nm", 1e-9), ("in", 25.4e-3), ("mil", 25.4e-6),
        ("thou", 25.4e-6), ("ft", 0.3048),
    )},
    **{name: ("force", size) for name, size in (
        ("N", 1.0), ("mN", 1e-3), ("kN", 1e3), ("lbf", _POUND_FORCE), ("kgf", _STANDARD_GRAVITY),
    )},
    **{name: ("acceleration", size) for name, size in (
        ("m/s^2", 1.0), ("mm/s^2", 1e-3), ("g", _STANDARD_GRAVITY), ("mg", 1e-3 * _STANDARD_GRAVITY),
        ("in/s^2", 25.4e-3), ("ft/s^2", 0.3048),
    )},
    # A speed of rotation: 1 Hz is a turn a second.
    **{name: ("speed of rotation", size) for name, size in (
        ("Hz", _TURN), ("rpm", _TURN / 60.0), ("rad/s", 1.0), ("deg/s", _TURN / 360.0),
    )},
    **{name: ("voltage", size) for name, size in (("V", 1.0), ("mV", 1e-3), ("uV", 1e-6))},
    **{name: ("time", size) for name, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9), ("min", 60.0))},
    "1": ("number", 1.0),
}  # fmt: skip
"""Conversion factors are exact by definition (1 in = 25.4 mm, standard gravity, the international pound)."""

_SI = {what: name for name, (what, size) in _UNITS.items() if size == 1.0}
"""SI unit of what is measured."""

_SPELLINGS = {
    "newton": "N", "newtons": "N", "volt": "V", "volts": "V", "inch": "in", "inches": "in", "mils": "mil", '"': "in",
    "micron": "um", "microns": "um", "meter": "m", "metre": "m", "millimeter": "mm", "lb": "lbf", "lbs": "lbf",
    "gn": "g", "g's": "g", "gs": "g", "m/s2": "m/s^2", "m/s/s": "m/s^2", "m/s**2": "m/s^2", "mm/s2": "mm/s^2",
    "m/s²": "m/s^2", "mm/s²": "mm/s^2", "m/s\u00c2²": "m/s^2", "1/min": "rpm", "u/min": "rpm", "u/  min": "rpm",
    "min-1": "rpm", "min^-1": "rpm", "r/min": "rpm", "rev/min": "rpm", "1/s": "Hz", "rps": "Hz", "": "1", "-": "1",
    "none": "1", "[-]": "1", "v/v": "1", "sec": "s", "second": "s", "seconds": "s",
}  # fmt: skip

_SENSITIVITY = re.compile(r"\s*([-+0-9.eE]+)\s*([a-zA-Z\u00b5\u03bc]+)\s*/\s*(\S.*)")


def canonical(unit: str) -> str:
    """A unit as this project spells it; one that is unknown as it stands."""
    name = unit.strip().replace("\u00b5", "u").replace("\u03bc", "u")
    return name if name in _UNITS else _SPELLINGS.get(name.lower(), name)


def known(unit: str) -> bool:
    """Whether a unit, as a file may spell it, can be converted."""
    return canonical(unit) in _UNITS


def kind(unit: str) -> str:
    """What a unit measures: length, force, voltage, ...; empty if it is unknown."""
    return _UNITS.get(canonical(unit), ("", 0.0))[0]


def size_si(unit: str) -> float:
    """One of the unit in SI; 1 for a unit that is unknown."""
    return _UNITS.get(canonical(unit), ("", 1.0))[1]


def in_si(unit: str) -> tuple[str, float]:
    """The SI unit of what a unit measures, and one of the unit in it; one that is unknown stays as it is."""
    what, size = _UNITS.get(canonical(unit), ("", 1.0))
    return _SI.get(what, unit), size


def factor(unit: str, target: str, *, field: str) -> float:
    """How many of `target` one of `unit` is.

    Args:
        unit: What the values are in.
        target: What they are wanted in.
        field: Field that named the unit, for errors.

    Raises:
        InputError: A unit is unknown, or the two measure different things.
    """
    source, wanted = canonical(unit), canonical(target)
    if source == wanted:
        return 1.0
    if wanted not in _UNITS:
        raise InputError(field, f"{target}, the unit of the channel, which has no conversion", unit)
    allowed = [name for name, (what, _) in _UNITS.items() if what == _UNITS[wanted][0]]
    if source not in _UNITS:
        close = nearest(source, allowed, most=1)
        hint = f" (such as {close[0]})" if close else ""
        raise InputError(field, f"one of {', '.join(allowed)}, or V or mV with a sensitivity{hint}", unit)
    if _UNITS[source][0] != _UNITS[wanted][0]:
        hint = ", with a sensitivity" if _UNITS[source][0] == "voltage" else ""
        raise InputError(field, f"a unit of {_UNITS[wanted][0]} ({', '.join(allowed)}){hint}", unit)
    return _UNITS[source][1] / _UNITS[wanted][1]


def sensitivity_v(text: str, target: str, *, field: str) -> float:
    """A sensitivity such as "200 mV/mil" in volts per `target` unit.

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
        allowed = [name for name, (what, _) in _UNITS.items() if what == kind(target)]
        must = f"volts per unit of {kind(target)} ({', '.join(allowed)})" if allowed else f"volts per {target}"
        raise InputError(field, must, text)
    return number * size_si(match[2]) / factor(match[3], target, field=field)
