"""A value with its unit against a limit with its own: what is asked, what came out, and how much there was to spare."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from rig.base import units
from rig.base.errors import InputError, Words
from rig.base.outcome import Outcome
from rig.base.text import finite

OPERATORS = ("<=", "<", ">=", ">", "==", "!=", "between")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_QUANTITY = re.compile(rf"\s*({_NUMBER})\s*(\S.*)?\s*")
_MUST = re.compile(rf"\s*(?:(<=|>=|==|!=|<|>)\s*({_NUMBER})|({_NUMBER})\s+to\s+({_NUMBER}))\s*(\S.*?)?\s*")
_UNITLESS = ("", "1")

Limit = float | tuple[float, float]


@dataclass(frozen=True)
class Must:
    """What is asked of a value.

    Attributes:
        op: One of `OPERATORS`.
        limit: The number, or both of "between".
        unit: Theirs; "1" without one.
    """

    op: str
    limit: Limit
    unit: str

    @classmethod
    def parse(cls, text: str, *, field: str) -> Must:
        """Read `<= 100 ms`, `== 3` or `4 to 6 Hz`.

        Raises:
            InputError: It does not read so.
        """
        match = _MUST.fullmatch(text)
        if match is None:
            raise InputError(field, "a comparison with a number and its unit, such as '<= 1.2 mm' or '4 to 6 Hz'", text)
        op, one, low, high, unit = match.groups()
        if op is not None:
            return cls(op, float(one), unit or "1")
        if not float(low) <= float(high):
            raise InputError(field, "from the lower number to the higher", text)
        return cls("between", (float(low), float(high)), unit or "1")

    def within(self, unit: str, *, field: str, of: str) -> Must:
        """The same in the unit of what is measured.

        Raises:
            InputError: It has no unit where there is one, or one of something else.
        """
        scale = _factor(self.unit, unit, field=field, of=of, text=str(self))
        limit = self.limit
        scaled = (limit[0] * scale, limit[1] * scale) if isinstance(limit, tuple) else limit * scale
        return Must(self.op, limit if scale == 1.0 else scaled, unit)

    def __str__(self) -> str:
        if isinstance(self.limit, tuple):
            return with_unit(f"{self.limit[0]:.6g} to {self.limit[1]:.6g}", self.unit)
        return with_unit(f"{self.op} {self.limit:.6g}", self.unit)

    def margin(self, value: float) -> float:
        """How far inside the limit a value is; negative: outside."""
        if isinstance(self.limit, tuple):
            margin = min(value - self.limit[0], self.limit[1] - value)
        elif self.op in ("==", "!="):
            margin = abs(value - self.limit) * (-1.0 if self.op == "==" else 1.0)
        else:
            margin = self.limit - value if self.op.startswith("<") else value - self.limit
        return float(f"{margin:.12g}") + 0.0  # no -0, and no digits that subtraction leaves

    def holds(self, value: float) -> bool:
        """Whether a value is as asked; nan is not."""
        margin = self.margin(value)
        return margin > 0.0 if self.op in ("<", ">", "!=") else margin >= 0.0


@dataclass(frozen=True)
class Measurement:
    """One value that was judged.

    Attributes:
        name: Of what.
        value: In the unit of `must`; nan where there was nothing to measure.
        must: What was asked.
        source: Where the limit is from.
        resolution: What the value is exact to.
        note: What else is to be known, such as why there is no value.
        at_s: Simulated time that it is about [s].
        channels: Channels that it is about.
        open_reason: Reason why the value neither passes nor fails; empty where it does.
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

    @property
    def outcome(self) -> Outcome:
        """Inconclusive where there is a reason for that, else pass or fail by the limit."""
        if self.open_reason:
            return Outcome.INCONCLUSIVE
        return Outcome.PASS if self.must.holds(self.value) else Outcome.FAIL

    @property
    def good(self) -> bool:
        """Whether it passes."""
        return self.outcome is Outcome.PASS

    @property
    def line(self) -> str:
        """All of it, in a line."""
        unit = self.must.unit
        told = with_unit(f"{self.value:.6g}", unit) if math.isfinite(self.value) else "nothing"
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
            f"{self.name} must be {self.must}; instead received {told}"
            if not self.good
            else f"{self.name} is {told}, as it must be: {self.must}"
        ) + (f" ({self.note})" if self.note else "") + (f" [{rest}]" if rest else "")  # fmt: skip

    def document(self) -> dict[str, Any]:
        """As a document for JSON."""
        return finite({
            "name": self.name, "value": self.value, "unit": self.must.unit,
            "op": self.must.op, "limit": self.must.limit,
            "margin": self.must.margin(self.value), "outcome": self.outcome.value, "good": self.good,
            "source": self.source, "resolution": self.resolution, "note": self.open_reason or self.note,
            "at_s": self.at_s,
        })  # fmt: skip

    def properties(self) -> list[tuple[str, str]]:
        """The same as JUnit's properties."""
        told = self.document()
        found = [(self.name, with_unit("nothing" if told["value"] is None else f"{told['value']:.9g}", self.must.unit))]
        found += [(f"{self.name}.limit", str(self.must))]
        if told["margin"] is not None:
            found += [(f"{self.name}.margin", with_unit(f"{told['margin']:.6g}", self.must.unit))]
        rest = (("source", self.source), ("resolution", self.resolution))
        return found + [(f"{self.name}.{key}", value) for key, value in rest if value]


def quantity(text: str, unit: str, *, field: str, of: str) -> float:
    """A number with a unit, such as "0.2 mm", in the unit of what it is about.

    Raises:
        InputError: It does not read so, or its unit is missing or of something else.
    """
    number, given = split_quantity(text, field=field)
    return number * _factor(given, unit, field=field, of=of, text=text)


def split_quantity(text: str, *, field: str) -> tuple[float, str]:
    """Number and unit of a text such as "0.2 mm"; "1" where there is none.

    Raises:
        InputError: It does not read so.
    """
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise InputError(field, "a number with its unit, such as '0.2 mm'", text)
    return float(match[1]), (match[2] or "1").strip()


def _factor(given: str, wanted: str, *, field: str, of: str, text: str) -> float:
    if (given in _UNITLESS and wanted in _UNITLESS) or units.canonical(given) == units.canonical(wanted):
        return 1.0
    if given in _UNITLESS:
        raise InputError(field, f"with a unit, as {of} is in {wanted}", text)
    if wanted in _UNITLESS or units.kind(given) != units.kind(wanted) or not units.kind(given):
        what = units.kind(wanted)
        must = "without a unit" if wanted in _UNITLESS else f"in a unit of {what}" if what else f"in {wanted}"
        tail = "has none" if wanted in _UNITLESS else f"is in {wanted}"
        raise InputError(field, f"{must}, as {of} {tail}", text)
    return units.size_si(given) / units.size_si(wanted)


def with_unit(number: str, unit: str) -> str:
    """A number with its unit behind it, if it has one."""
    return number if unit in _UNITLESS else f"{number} {unit}"


def measured(
    name: str, value: float, unit: str, op: str, limit: Limit, *, unit_of_limit: str | None = None, **told: Any
) -> Measurement:
    """A value that is judged; as the fixture `measure`.

    Raises:
        InputError: There is no such comparison, the limit is none, or its unit is of something else.
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
    must = Must(op, numbers, unit_of_limit or unit).within(unit or "1", field="unit_of_limit", of=name)  # type: ignore[arg-type]
    return Measurement(name, value, must, **told)
