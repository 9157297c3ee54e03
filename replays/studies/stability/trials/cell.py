"""Cell of the table of trials: measured value, verdict and expected verdict."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

_DOCUMENT = (
    "trial", "case", "method", "value", "unit", "limit", "expected", "because", "skipped", "holds", "agrees",
)  # fmt: skip


class Cell(NamedTuple):
    """One case of a trial on one method.

    Attributes:
        case: Name of the case.
        value: Measured value.
        limit: Largest passing value.
        because: Reason for the expected verdict.
        expected: Expected verdict; None if there is no expectation.
        unit: Unit of value and limit.
        trial: T1 to T14, in the table.
        method: Engine or peer, in the table.
        skipped: Reason why it was not run; empty if it was.
    """

    case: str
    value: float
    limit: float
    because: str
    expected: bool | None = True
    unit: str = "1"
    trial: str = ""
    method: str = ""
    skipped: str = ""

    @property
    def holds(self) -> bool:
        """True if the value is within its limit; never if it is not finite."""
        return math.isfinite(self.value) and self.value <= self.limit

    @property
    def agrees(self) -> bool:
        """True if the verdict is the expected one, or there is no expectation."""
        return bool(self.skipped) or self.expected is None or self.holds == self.expected

    def document(self) -> dict[str, Any]:
        """Return the cell as a JSON document; a value that is not finite is a string."""
        value: float | str = self.value if math.isfinite(self.value) else str(self.value)
        return {name: getattr(self, name) for name in _DOCUMENT} | {"value": value}
