"""Joint variation of the assumed values: a Latin hypercube over all of them, and its results."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from replays.studies.paper.scans.pulse import PULSE_AT, Pulse, PulseRun
from rig.physics.parameters import DEFAULT_SET, load_parameters

SEED = 2013
_PERCENTILE_RUNS = 20
"""Values from which the 5 and 95 % percentiles lie inside the lowest and the highest."""


class Assumed(BaseModel, frozen=True, extra="forbid"):
    """An assumed value and its range, which is assumed as well."""

    key: str
    called: str
    """Name in pictures and tables."""
    name: str = Field(default="", alias="as")
    """Name in a pulse's changes, if it differs from the key."""
    low: float = math.nan
    high: float = math.nan
    log: bool = False
    whole: bool = False
    tied: str = ""
    """Key of the value that it is proportional to."""
    ratio: float = 1.0
    """Ratio of that value to this one."""
    unit: str = ""
    value: float | None = None
    """Value in the rest of the report, if no parameter set defines it."""
    why: str

    @property
    def change_key(self) -> str:
        """Name in a pulse's changes."""
        return self.name or self.key

    def at(self, part: float) -> float:
        """Return the value at a fraction of the range, 0 to 1."""
        if self.log:
            return float(self.low * (self.high / self.low) ** part)
        value = self.low + part * (self.high - self.low)
        return float(min(self.high, math.floor(self.low + part * (self.high - self.low + 1)))) if self.whole else value


@cache
def assumed_values() -> tuple[Assumed, ...]:
    """Return all assumed values from the data file."""
    import tomllib

    document = tomllib.loads(files("replays.studies.paper").joinpath("spread.toml").read_text(encoding="utf-8"))
    return tuple(Assumed.model_validate(entry) for entry in document["value"])


def free_values() -> tuple[Assumed, ...]:
    """Return the values that are not tied to another."""
    return tuple(entry for entry in assumed_values() if not entry.tied)


def format_value(entry: Assumed) -> str:
    """Return the value of the default set, or of this report, with its unit."""
    default = load_parameters(DEFAULT_SET).entries.get(entry.key)
    value = default.value if default else entry.value
    unit = default.unit if default and not entry.unit else entry.unit
    return f"{value:g} {unit}".strip() if isinstance(value, float | int) else str(value)


def changes(values: dict[str, float]) -> dict[str, Any]:
    """Return the changes of a pulse from free values by key, including tied values."""
    changed: dict[str, Any] = {}
    for entry in assumed_values():
        if entry.tied and entry.tied in values:
            changed[entry.change_key] = values[entry.tied] / entry.ratio
        elif entry.key in values:
            changed[entry.change_key] = values[entry.key]
    return changed


def one_at_a_time() -> list[tuple[Assumed, Pulse, Pulse]]:
    """Return each value with pulses at both ends of its range, the others unchanged."""
    return [
        (
            entry,
            Pulse(label=f"{entry.key} low", changes=changes({entry.key: entry.at(0.0)})),
            Pulse(label=f"{entry.key} high", changes=changes({entry.key: entry.at(1.0)})),
        )
        for entry in free_values()
    ]


def hypercube(samples: int, *, parameters: str = DEFAULT_SET) -> tuple[np.ndarray, list[Pulse]]:
    """Return a Latin hypercube over all free values: fractions of their ranges, shape (samples, values), and pulses."""
    from scipy.stats import qmc

    entries = free_values()
    parts = qmc.LatinHypercube(d=len(entries), rng=np.random.default_rng(SEED)).random(samples)
    pulses = [
        Pulse(
            label=f"spread {number}",
            parameters=parameters,
            changes=changes({entry.key: entry.at(float(part)) for entry, part in zip(entries, row, strict=True)}),
        )
        for number, row in enumerate(parts, 1)
    ]
    return parts, pulses


def phases(pulse: Pulse, count: int) -> list[Pulse]:
    """Return a pulse at `count` shaft phases; impacts are chaotic, so a single run is not representative."""
    at_s = [round(0.02 + k / count / pulse.speed_hz, 4) for k in range(count)]
    return [replace(pulse, changes={**pulse.changes, PULSE_AT: each}) for each in at_s]


def column(results: list[PulseRun], name: str) -> np.ndarray:
    """Return one number of many outcomes, NaN if missing, shape (n,)."""
    return np.array([float(getattr(result, name)) for result in results])


def rank_correlation(parts: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return Spearman's rank correlation of each input with a number, over runs that have one, shape (inputs,)."""
    from scipy.stats import spearmanr

    there = np.isfinite(values)
    if there.sum() < 4 or np.ptp(values[there]) == 0.0:
        return np.full(parts.shape[1], math.nan)
    tests: list[Any] = [spearmanr(parts[there, k], values[there]) for k in range(parts.shape[1])]
    return np.array([float(each.statistic) for each in tests])


def percentiles(values: np.ndarray) -> tuple[float, float, float]:
    """Return the 5, 50 and 95 % percentiles of the finite values, or the range of fewer than 20; NaN without values."""
    there = values[np.isfinite(values)]
    if not len(there):
        return math.nan, math.nan, math.nan
    low, middle, high = np.percentile(there, [5, 50, 95] if len(there) >= _PERCENTILE_RUNS else [0, 50, 100])
    return float(low), float(middle), float(high)
