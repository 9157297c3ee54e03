"""What the paper states, as data, and the verdict of our numbers on it."""

from __future__ import annotations

import math
import tomllib
from functools import cache
from importlib.resources import files
from typing import Literal

import numpy as np
from pydantic import BaseModel

from replays.studies.paper.scans.spread import percentiles
from rig.physics.parameters import ParameterSet

Verdict = Literal["agrees", "differs", "cannot be judged"]
SETS = ("as-printed", "corrected")
"""The parameter sets that are held against the paper, in the order of the tables."""
SURE = 0.95
"""Share of ours that must lie in, or out of, what the paper states for a verdict."""
_TEXT = 5e-3
"""How far a printed value may be off as it is rounded."""


class Statement(BaseModel, frozen=True, extra="forbid"):
    """One thing that the paper states."""

    quantity: str
    place: str
    says: str
    kind: Literal["text", "axis", "claim"]
    paper: str
    unit: str
    low: float = math.nan
    high: float = math.nan
    why: str = ""

    def inside(self, values: np.ndarray) -> float:
        """Share of ours that agrees; nan where there is nothing to judge by. A motion that did not come is outside."""
        if not math.isfinite(self.low) or not math.isfinite(self.high):
            return math.nan
        return float(np.mean((self.low <= values) & (values <= self.high))) if len(values) else 0.0

    def verdict(self, values: np.ndarray) -> Verdict:
        """Of ours, shape (n,), as far as phases of the shaft, assumed values and readings spread them."""
        share = self.inside(values)
        if share >= SURE:
            return "agrees"
        return "differs" if share <= 1.0 - SURE else "cannot be judged"


class Printed(BaseModel, frozen=True, extra="forbid"):
    """One printed value of a parameter, in SI."""

    key: str
    symbol: str
    place: str
    value: float
    unit: str

    def verdict(self, parameters: ParameterSet) -> Verdict:
        """Whether a set takes the printed value."""
        return "agrees" if abs(parameters[self.key] / self.value - 1.0) < _TEXT else "differs"


@cache
def _document() -> dict[str, list[dict[str, object]]]:
    return tomllib.loads(files("replays.studies.paper").joinpath("statements.toml").read_text(encoding="utf-8"))


def statements() -> tuple[Statement, ...]:
    """All statements on figures and text."""
    return tuple(Statement.model_validate(entry) for entry in _document()["statement"])


def claims() -> tuple[Statement, ...]:
    """Claims that scans of the corrected rig test."""
    return tuple(Statement.model_validate(entry) for entry in _document()["claim"])


def printed_values() -> tuple[Printed, ...]:
    """Tables 1 and 2, and the values in the text."""
    return tuple(Printed.model_validate(entry) for entry in _document()["printed"])


def number(value: float) -> str:
    """A number as the tables show it."""
    if not math.isfinite(value):
        return "none"
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.3g}"
    if abs(value) >= 1000.0:
        return f"{value:.0f}"
    return f"{value:.4g}"


def distribution(values: np.ndarray) -> str:
    """Median, and 5 to 95 % where they differ, as the tables show them: to three figures, four where it is narrow."""
    low, middle, high = percentiles(values)
    if not high - low > 1e-3 * abs(middle):
        return number(middle)
    figures = 3 if high - low < 0.03 * abs(middle) else 2
    places = figures - math.floor(math.log10(abs(middle) or 1.0))
    low, middle, high = (f"{round(each, places):.{max(0, places)}f}" for each in (low, middle, high))
    return f"{middle} ({low}–{high})"
