"""One thing that may explain a difference, and how much of it: residuals over noise, before and after."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from replays.recordings.resimulation.prediction import Measured
from replays.recordings.validation.trajectory import scaled
from rig.channels.faults.defects import defects_in

Kind = Literal["sensor", "time", "command", "model"]

_SIGMAS = 6.0
"""Residuals are noise while their sum of squares is above its mean by less than so many standard deviations."""
_NAMES = re.compile(r"((?:\w+(?:, | and ))*\w+) ?(.*)")
"""Channels of a name, and the defects that follow."""
_UNTIMED = ("keyphasor",)
"""A pulse is no smooth function of anything."""


@dataclass(frozen=True)
class Explanation:
    """One thing that may be off.

    Attributes:
        kind: Sensor, time, a command, or model.
        name: What.
        change: By how much, in words.
        value: The same as a number: a part, or in `unit`.
        unit: Unit of `value`; "" for a part of the value itself.
        explained: Part of the residual's excess over noise that it takes away.
        left: RMS of what is left over the floor, in the channels that it is about.
        squares: Sum of squares of the same.
        n: Samples in it.
        to_s: End of the window that this is said of [s]; earlier than the others' where it was given up there.
        sure: Whether what it leaves is as good as nothing.
        from_s: Where it begins, where that is known [s].
    """

    kind: Kind
    name: str
    change: str
    value: float
    unit: str
    explained: float
    left: float
    squares: float
    n: int
    to_s: float
    sure: bool = True
    from_s: float = -math.inf

    @classmethod
    def of(
        cls,
        residuals: np.ndarray,
        *,
        kind: Kind,
        name: str,
        change: str,
        value: float,
        unit: str = "",
        explained: float,
        to_s: float,
    ) -> Explanation:
        """One that leaves residuals over their floors, shape (n,)."""
        squares, n = float(residuals @ residuals), max(1, len(residuals))
        return cls(kind, name, change, value, unit, explained, math.sqrt(squares / n), squares, n, to_s)

    @property
    def channels_and_defect(self) -> tuple[str, str]:
        """Names of the channels and of their defects in `name`; the second is empty where `change` has them."""
        channels, defect = _NAMES.fullmatch(self.name).groups()  # pyrefly: ignore[missing-attribute]
        return channels, defect

    @property
    def defects(self) -> tuple[str, ...]:
        """Names in the table of defects; none where a model, a command or the time of all channels is the cause."""
        return defects_in(self.channels_and_defect[1] or self.change) if self.kind == "sensor" else ()

    @property
    def at_floor(self) -> bool:
        """Nothing but noise is left."""
        return _of_noise(self.squares, self.n)


def smooth_columns(part: Measured) -> list[int]:
    """Columns of the channels that are smooth functions of time."""
    return [c for c, channel in enumerate(part.channels) if channel.name not in _UNTIMED]


def vector(parts: dict[str, Measured], values: dict[str, np.ndarray]) -> np.ndarray:
    """Residuals over their floors of all channels, shape (n,)."""
    return np.concatenate(
        [scaled(parts[name], v)[:, smooth_columns(parts[name])].ravel() for name, v in values.items()]
    )


def is_noise(residuals: np.ndarray) -> bool:
    """Whether residuals over their floors are nothing but noise."""
    return _of_noise(float(residuals @ residuals), len(residuals))


def excess(residuals: np.ndarray) -> float:
    """Sum of squares of residuals over their floors beyond that of noise."""
    return max(float(residuals @ residuals) - len(residuals), 0.0)


def _of_noise(squares: float, n: int) -> bool:
    return squares < n + _SIGMAS * math.sqrt(2.0 * n)
