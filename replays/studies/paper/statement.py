"""Statements of the paper as data, and their verdicts."""

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
"""Parameter sets compared with the paper, in the order of the tables."""
VERDICT_SHARE = 0.95
"""Share of our values inside, or outside, the stated range that is required for a verdict."""
MIN_RUNS = 8
"""Runs required for a share and a verdict: if all of 8 agree, more than two thirds of all runs do, at 95 %."""
_ROUNDING_ERROR = 5e-3
"""Relative rounding error of a printed value."""


class Statement(BaseModel, frozen=True, extra="forbid"):
    """A statement of the paper."""

    quantity: str
    place: str
    says: str
    kind: Literal["text", "axis", "claim"]
    paper: str
    unit: str
    low: float = math.nan
    high: float = math.nan
    why: str = ""
    readings: int = 1
    listed: bool = False

    def inside(self, values: np.ndarray) -> float:
        """Return the share of values inside the stated range; NaN without a range. Missing motions count as outside."""
        if not math.isfinite(self.low) or not math.isfinite(self.high):
            return math.nan
        return float(np.mean((self.low <= values) & (values <= self.high))) if len(values) else 0.0

    def count_runs(self, values: np.ndarray) -> int:
        """Return the number of runs behind our values; several readings of a run count once."""
        return len(values) // self.readings

    def is_short(self, values: np.ndarray) -> bool:
        """Return whether there are too few runs for a share; a complete list of cases needs no number."""
        return not self.listed and self.count_runs(values) < MIN_RUNS

    def bounds(self, values: np.ndarray) -> tuple[float, float]:
        """Return the 95 % bounds of the share inside; NaN without a range, for too few runs, and for a list."""
        share = self.inside(values)
        if self.listed or self.is_short(values) or not math.isfinite(share):
            return math.nan, math.nan
        return wilson_bounds(share, self.count_runs(values))

    def format_share(self, values: np.ndarray) -> str:
        """Format the share inside with its bounds, and the number of values."""
        share, count = self.inside(values), len(values)
        if not math.isfinite(share):
            return "–"
        if self.listed:
            return f"{round(share * count)} of {count} cases"
        cases = f"{self.count_runs(values)}" + f", {self.readings} readings" * (self.readings > 1)
        if self.is_short(values):
            return f"too few ({cases})"
        low, high = self.bounds(values)
        return f"{share:.0%}, {low:.0%} to {high:.0%} ({cases})"

    def verdict(self, values: np.ndarray) -> Verdict:
        """Return the verdict on our values, shape (n,), spread by shaft phases, assumed values and readings."""
        share = self.inside(values)
        if self.is_short(values):
            return "cannot be judged"
        if share >= VERDICT_SHARE:
            return "agrees"
        return "differs" if share <= 1.0 - VERDICT_SHARE else "cannot be judged"


class Printed(BaseModel, frozen=True, extra="forbid"):
    """A printed value of a parameter, in SI."""

    key: str
    symbol: str
    place: str
    value: float
    unit: str

    def verdict(self, parameters: ParameterSet) -> Verdict:
        """Return whether a parameter set uses the printed value."""
        return "agrees" if abs(parameters[self.key] / self.value - 1.0) < _ROUNDING_ERROR else "differs"


@cache
def _document() -> dict[str, list[dict[str, object]]]:
    return tomllib.loads(files("replays.studies.paper").joinpath("statements.toml").read_text(encoding="utf-8"))


def statements() -> tuple[Statement, ...]:
    """Return all statements on figures and text."""
    return tuple(Statement.model_validate(entry) for entry in _document()["statement"])


def claims() -> tuple[Statement, ...]:
    """Return the claims that are tested by scans of the corrected rig."""
    return tuple(Statement.model_validate(entry) for entry in _document()["claim"])


def printed_values() -> tuple[Printed, ...]:
    """Return the values of tables 1 and 2 and of the text."""
    return tuple(Printed.model_validate(entry) for entry in _document()["printed"])


def wilson_bounds(share: float, runs: int) -> tuple[float, float]:
    """Return the 95 % bounds of Wilson's interval for a share of some runs."""
    z = 1.959964 / math.sqrt(runs)
    middle, half = share + 0.5 * z * z, z * math.sqrt(share * (1.0 - share) + 0.25 * z * z)
    return (middle - half) / (1.0 + z * z), (middle + half) / (1.0 + z * z)


def number(value: float) -> str:
    """Format a number for the tables."""
    if not math.isfinite(value):
        return "none"
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.3g}"
    if abs(value) >= 1000.0:
        return f"{value:.0f}"
    return f"{value:.4g}"


def distribution(values: np.ndarray) -> str:
    """Format the median and, if they differ, the ends of `percentiles`, with 3 or 4 digits."""
    low, middle, high = percentiles(values)
    if not high - low > 1e-3 * abs(middle):
        return number(middle)
    figures = 3 if high - low < 0.03 * abs(middle) else 2
    places = figures - math.floor(math.log10(abs(middle) or 1.0))
    low, middle, high = (f"{round(each, places):.{max(0, places)}f}" for each in (low, middle, high))
    return f"{middle} ({low}–{high})"
