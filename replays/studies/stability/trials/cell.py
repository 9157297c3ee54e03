"""One cell of the table of trials: what was measured, what it shows, and what it should show."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

_DOCUMENT = (
    "trial", "case", "method", "value", "unit", "limit", "expected", "because", "skipped", "holds", "agrees",
)  # fmt: skip


class Cell(NamedTuple):
    """One case of a trial on one method.

    Attributes:
        case: Which one.
        value: What was measured.
        limit: The largest value that still holds.
        because: Why it should hold or fail.
        expected: Whether it should hold; None where nobody has said so: then the value alone stands.
        unit: Unit of value and limit.
        trial: T1 to T14, once it stands in the table.
        method: Engine, or peer, likewise.
        skipped: Why it was not run; empty where it was.
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
        """Whether the value is within its limit; what is not finite never is."""
        return math.isfinite(self.value) and self.value <= self.limit

    @property
    def agrees(self) -> bool:
        """Whether the verdict is the expected one, or nothing was expected."""
        return bool(self.skipped) or self.expected is None or self.holds == self.expected

    def document(self) -> dict[str, Any]:
        """As a JSON document; a value that is not finite is a string."""
        value: float | str = self.value if math.isfinite(self.value) else str(self.value)
        return {name: getattr(self, name) for name in _DOCUMENT} | {"value": value}
