"""One cell of the table of trials: what was measured, what it shows, and what it should show."""

from __future__ import annotations

import math
from typing import Any, NamedTuple


class Case(NamedTuple):
    """One case of a trial on one method.

    Attributes:
        name: Which one.
        value: What was measured.
        limit: The largest value that still holds.
        because: Why it should hold or fail.
        expected: Whether it should hold; None where nobody has said so: then the value alone stands.
        unit: Unit of value and limit.
    """

    name: str
    value: float
    limit: float
    because: str
    expected: bool | None = True
    unit: str = "1"


class Cell(NamedTuple):
    """One trial of one method.

    Attributes:
        trial: T1 to T14.
        case: Which of its cases.
        method: Engine, or peer.
        value: What was measured.
        unit: Its unit.
        limit: The largest value that still holds.
        expected: Whether it should hold; None where nobody has said so: then the value alone stands.
        because: Why it should hold or fail.
        skipped: Why it was not run; empty where it was.
    """

    trial: str
    case: str
    method: str
    value: float
    unit: str
    limit: float
    expected: bool | None
    because: str
    skipped: str = ""

    @classmethod
    def of(cls, trial: str, method: str, case: Case) -> Cell:
        """A case as a cell of the table."""
        return cls(trial, case.name, method, case.value, case.unit, case.limit, case.expected, case.because)

    @property
    def holds(self) -> bool:
        """Whether the value is within its limit; what is not finite never is."""
        return math.isfinite(self.value) and self.value <= self.limit

    @property
    def agrees(self) -> bool:
        """Whether the verdict is the expected one, or nothing was expected."""
        return bool(self.skipped) or self.expected is None or self.holds == self.expected

    def document(self) -> dict[str, Any]:
        """As a JSON document; a value that is not finite is a string."""
        value: float | str = self.value if math.isfinite(self.value) else str(self.value)
        return {**self._asdict(), "value": value, "holds": self.holds, "agrees": self.agrees}
