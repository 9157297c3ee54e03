"""User-defined contact law, as a file: `--law FILE.toml` gives a run its numbers or formulas.

title = "Laboratory X, 2025"
source = "our drop tests"
stiffness = "1.7e10 * delta**1.5"        # K, a law's name, or the force [N] of delta [m], R_S, r0, L [m], E [Pa]
damping_factor = "1.2 * (1 - e**2)"      # c, a law's name, or c of the restitution e
exponent = 1.5                           # where stiffness is K
viscous_damping = 0.0                    # D [N s/m]
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import FiniteFloat

from rig.base.checks import Written, a_line, check, read_toml
from rig.base.errors import InputError, Words


class ContactLaw(Written):
    """Contents of a law file; omitted fields keep the parameter set's values."""

    title: Annotated[str, a_line(100)]
    source: str = ""
    stiffness: FiniteFloat | str | None = None
    exponent: FiniteFloat | str | None = None
    damping_factor: FiniteFloat | str | None = None
    viscous_damping: FiniteFloat | str | None = None

    def changes(self) -> dict[str, float | str]:
        """Return the changed parameters by dotted key."""
        numbers = self.model_dump(exclude={"title", "source"}, exclude_none=True)
        return {f"contact.{name}": value for name, value in numbers.items()}


def read_law(path: Path) -> ContactLaw:
    """Read a law file.

    Raises:
        InputError: The file cannot be read, has an unknown field, or defines nothing of a law.
    """
    data: dict[str, Any] = read_toml(path)
    law = check(ContactLaw, data, field=str(path))
    if not law.changes():
        fields = ", ".join(name for name in ContactLaw.model_fields if name not in ("title", "source"))
        raise InputError(str(path), f"a file with at least one of {fields}", Words("none"))
    return law
