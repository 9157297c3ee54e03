"""Measurements: a value, its limit, both with units, and the margin between them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from rig.base import units
from rig.base.errors import InputError, Words
from rig.base.outcome import Outcome
from rig.base.text import replace_nonfinite

OPERATORS = ("<=", "<", ">=", ">", "==", "!=", "between")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_QUANTITY = re.compile(rf"\s*({_NUMBER})\s*(\S.*)?\s*")
_MUST = re.compile(rf"\s*(?:(<=|>=|==|!=|<|>)\s*({_NUMBER})|({_NUMBER})\s+to\s+({_NUMBER}))\s*(\S.*?)?\s*")
_UNITLESS = ("", "1")

Limit = float | tuple[float, float]


@dataclass(frozen=True)
class Must:
    """Limit of a value.

    Attributes:
        op: One of `OPERATORS`.
        limit: Number, or lower and upper number for "between".
        unit: Unit of the limit; "1" if dimensionless.
    """

    op: str
    limit: Limit
    unit: str

    @classmethod
    def parse(cls, text: str, *, field: str) -> Must:
        """Parse `<= 100 ms`, `== 3` or `4 to 6 Hz`.

        Raises:
            InputError: If the text has another form.
        """
        match = _MUST.fullmatch(text)
        if match is None:
            raise InputError(field, "a comparison with a number and its unit, such as '<= 1.2 mm' or '4 to 6 Hz'", text)
        op, one, low, high, unit = match.groups()
        _check_finite([float(each) for each in (one, low, high) if each is not None], field, text)
        if op is not None:
            return cls(op, float(one), unit or "1")
        if not float(low) <= float(high):
            raise InputError(field, "from the lower number to the higher", text)
        return cls("between", (float(low), float(high)), unit or "1")

    def convert_to(self, unit: str, *, field: str, of: str) -> Must:
        """Return the limit in the unit of the measured value.

        Args:
            unit: Unit of the value.
            field: Field named in errors.
            of: What is measured, named in errors.

        Raises:
            InputError: If the unit is missing or of another kind.
        """
        scale = _factor(self.unit, unit, field=field, of=of, text=str(self))
        limit = self.limit
        scaled = (limit[0] * scale, limit[1] * scale) if isinstance(limit, tuple) else limit * scale
        _check_finite(scaled if isinstance(scaled, tuple) else [scaled], field, str(self))
        return Must(self.op, limit if scale == 1.0 else scaled, unit)

    def __str__(self) -> str:
        if isinstance(self.limit, tuple):
            return with_unit(f"{self.limit[0]:.6g} to {self.limit[1]:.6g}", self.unit)
        return with_unit(f"{self.op} {self.limit:.6g}", self.unit)

    def margin(self, value: float) -> float:
        """Return the distance of a value from the limit, negative outside it."""
        if isinstance(self.limit, tuple):
            margin = min(value - self.limit[0], self.limit[1] - value)
        elif self.op in ("==", "!="):
            margin = abs(value - self.limit) * (-1.0 if self.op == "==" else 1.0)
        else:
            margin = self.limit - value if self.op.startswith("<") else value - self.limit
        return float(f"{margin:.12g}") + 0.0  # drops -0 and rounding errors of the subtraction

    def holds(self, value: float) -> bool:
        """Return whether a value is within the limit; NaN and infinity are not."""
        margin = self.margin(value)
        return math.isfinite(value) and (margin > 0.0 if self.op in ("<", ">", "!=") else margin >= 0.0)

    def check_decides(self, *, whole: bool, field: str, of: str) -> None:
        """Check that some values from 0 on are within the limit and some are not.

        Args:
            whole: Whether the values are whole numbers.
            field: Field named in errors.
            of: What is measured, named in errors.

        Raises:
            InputError: If all values are within the limit, or none is.
        """
        places = [0.0, 1e300]
        for limit in self.limit if isinstance(self.limit, tuple) else (self.limit,):
            down, up = (math.floor(limit), math.ceil(limit)) if whole else (limit, limit)
            step = 1.0 if whole else 1e-6 * abs(limit)
            places += [down - step, down, up, up + step]
        if len({self.holds(place) for place in places if place >= 0.0}) == 1:
            what = "a whole number from 0 on" if whole else "at least 0"
            raise InputError(field, f"a limit that decides, as {of} is {what}", str(self))


@dataclass(frozen=True)
class Measurement:
    """One judged value.

    Attributes:
        name: What was measured.
        value: Value in the unit of `must`; NaN if there was nothing to measure.
        must: Limit.
        source: Origin of the limit.
        resolution: Resolution of the value.
        note: Remark, such as the reason for a missing value.
        at_s: Simulated time of the value [s].
        channels: Channels that the value depends on; two for the radius of an orbit.
        since_s: Simulated time that the value is counted from [s].
        level: Level of the channels that defines the value [unit of the channels].
        open_reason: Reason why the value neither passes nor fails; empty if it does.
    """

    name: str
    value: float
    must: Must
    source: str = ""
    resolution: str = ""
    note: str = ""
    at_s: float | None = None
    channels: tuple[str, ...] = ()
    open_reason: str = ""
    since_s: float | None = None
    level: float | None = None

    @property
    def outcome(self) -> Outcome:
        """Outcome: inconclusive if there is an open reason, otherwise pass or fail by the limit."""
        if self.open_reason:
            return Outcome.INCONCLUSIVE
        return Outcome.PASS if self.must.holds(self.value) else Outcome.FAIL

    @property
    def good(self) -> bool:
        """True if the measurement passes."""
        return self.outcome is Outcome.PASS

    @property
    def line(self) -> str:
        """Complete result on one line."""
        unit = self.must.unit
        text = with_unit(f"{self.value:.6g}", unit) if math.isfinite(self.value) else "nothing"
        margin = with_unit(f"{self.must.margin(self.value):+.4g}", unit) if math.isfinite(self.value) else ""
        parts = [
            f"margin {margin}" if margin else "",
            f"source {self.source}" if self.source else "",
            f"resolution {self.resolution}" if self.resolution else "",
        ]
        rest = "; ".join(part for part in parts if part)
        if self.open_reason:
            return f"{self.name} must be {self.must}; inconclusive: {self.open_reason}" + (f" [{rest}]" if rest else "")
        return (
            f"{self.name} must be {self.must}; received {text}"
            if not self.good
            else f"{self.name} is {text}, as it must be: {self.must}"
        ) + (f" ({self.note})" if self.note else "") + (f" [{rest}]" if rest else "")  # fmt: skip

    def document(self) -> dict[str, Any]:
        """Return the measurement as a JSON document."""
        return replace_nonfinite({
            "name": self.name, "value": self.value, "unit": self.must.unit,
            "op": self.must.op, "limit": self.must.limit,
            "margin": self.must.margin(self.value), "outcome": self.outcome.value, "good": self.good,
            "source": self.source, "resolution": self.resolution, "note": self.open_reason or self.note,
            "at_s": self.at_s,
        })  # fmt: skip

    def properties(self) -> list[tuple[str, str]]:
        """Return the measurement as JUnit properties."""
        document = self.document()
        value = "nothing" if document["value"] is None else f"{document['value']:.9g}"
        pairs = [(self.name, with_unit(value, self.must.unit)), (f"{self.name}.limit", str(self.must))]
        if document["margin"] is not None:
            pairs += [(f"{self.name}.margin", with_unit(f"{document['margin']:.6g}", self.must.unit))]
        rest = (("source", self.source), ("resolution", self.resolution))
        return pairs + [(f"{self.name}.{key}", value) for key, value in rest if value]


def quantity(text: str, unit: str, *, field: str, of: str) -> float:
    """Parse a number with a unit, such as "0.2 mm", and return it in a given unit.

    Raises:
        InputError: If the text has another form, or its unit is missing or of another kind.
    """
    number, unit_of_text = split_quantity(text, field=field)
    return number * _factor(unit_of_text, unit, field=field, of=of, text=text)


def split_quantity(text: str, *, field: str) -> tuple[float, str]:
    """Split a text such as "0.2 mm" into number and unit; the unit is "1" if there is none.

    Raises:
        InputError: If the text has another form.
    """
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise InputError(field, "a number with its unit, such as '0.2 mm'", text)
    _check_finite([float(match[1])], field, text)
    return float(match[1]), (match[2] or "1").strip()


def _check_finite(numbers: Iterable[float], field: str, text: object) -> None:
    if not all(map(math.isfinite, numbers)):
        raise InputError(field, "with finite numbers only", text)


def _factor(unit: str, wanted: str, *, field: str, of: str, text: str) -> float:
    if (unit in _UNITLESS and wanted in _UNITLESS) or units.canonical(unit) == units.canonical(wanted):
        return 1.0
    if unit in _UNITLESS:
        raise InputError(field, f"with a unit, as {of} is in {wanted}", text)
    if wanted in _UNITLESS or units.get_quantity(unit) != units.get_quantity(wanted) or not units.get_quantity(unit):
        what = units.get_quantity(wanted)
        must = "without a unit" if wanted in _UNITLESS else f"in a unit of {what}" if what else f"in {wanted}"
        tail = "has none" if wanted in _UNITLESS else f"is in {wanted}"
        raise InputError(field, f"{must}, as {of} {tail}", text)
    return units.size_si(unit) / units.size_si(wanted)


def with_unit(number: str, unit: str) -> str:
    """Return a number followed by its unit, if it has one."""
    return number if unit in _UNITLESS else f"{number} {unit}"


def judge_value(
    name: str, value: float, unit: str, op: str, limit: Limit, *, unit_of_limit: str | None = None, **fields: Any
) -> Measurement:
    """Return a measurement from a value and its limit, as the fixture `measure` does.

    Raises:
        InputError: If the operator is unknown, the limit is not a number, or the units are of different kinds.
    """
    if op not in OPERATORS:
        raise InputError("op", f"one of {', '.join(OPERATORS)}", op)
    try:
        numbers = tuple(map(float, limit)) if op == "between" else float(limit)  # type: ignore[arg-type]
        value = float(value)
    except (TypeError, ValueError):
        must = "two numbers, the lower first" if op == "between" else "a number"
        raise InputError("limit", must, Words(f"{limit!r}, and a value of {value!r}")) from None
    if isinstance(numbers, tuple) and (len(numbers) != 2 or not numbers[0] <= numbers[1]):
        raise InputError("limit", "two numbers, the lower first", limit)
    _check_finite(numbers if isinstance(numbers, tuple) else [numbers], "limit", limit)
    must = Must(op, numbers, unit_of_limit or unit).convert_to(unit or "1", field="unit_of_limit", of=name)  # type: ignore[arg-type]
    return Measurement(name, value, must, **fields)
