"""Possible explanation of a difference, and the part that it explains: residuals over noise, before and after."""

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

_NOISE_DEVIATIONS = 6.0
"""Standard deviations above its mean within which a sum of squares is noise."""
_NAMES = re.compile(r"((?:\w+(?:, | and ))*\w+) ?(.*)")
"""Channels of a name, and the defects that follow."""
_UNTIMED = ("keyphasor",)
"""Channels that are not smooth functions of time."""


@dataclass(frozen=True)
class Explanation:
    """A possible explanation of a difference.

    Attributes:
        kind: Sensor, time, a command, or model.
        name: Name of the changed number, or channels and defect.
        change: Size of the change as text.
        value: Size of the change: relative, or in `unit`.
        unit: Unit of `value`; "" for a relative change.
        explained: Part of the residual's excess over noise that it removes.
        left: RMS of the remaining residual over the floor, in the channels concerned.
        squares: Sum of squares of the same.
        n: Number of samples in it.
        to_s: End of the window of the fit [s]; earlier than that of others if it was given up there.
        sure: Whether the remaining residual is negligible.
        from_s: Start of the change, if known [s].
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
        """Return an explanation that leaves residuals over their floors, shape (n,)."""
        squares, n = float(residuals @ residuals), max(1, len(residuals))
        return cls(kind, name, change, value, unit, explained, math.sqrt(squares / n), squares, n, to_s)

    @property
    def channels_and_defect(self) -> tuple[str, str]:
        """Channels and defects in `name`; the latter are empty if `change` has them."""
        channels, defect = _NAMES.fullmatch(self.name).groups()  # pyrefly: ignore[missing-attribute]
        return channels, defect

    @property
    def defects(self) -> tuple[str, ...]:
        """Names in the table of defects; empty if a model, a command or the time of all channels is the cause."""
        return defects_in(self.channels_and_defect[1] or self.change) if self.kind == "sensor" else ()

    @property
    def part(self) -> str:
        """Explained part as text."""
        return f"{self.explained:.2%}" if self.explained >= 1e-4 else "< 0.01%"

    @property
    def at_floor(self) -> bool:
        """True if the remaining residual is noise."""
        return _is_noise_sum(self.squares, self.n)


def smooth_columns(part: Measured) -> list[int]:
    """Return the columns of the channels that are smooth functions of time."""
    return [c for c, channel in enumerate(part.channels) if channel.name not in _UNTIMED]


def vector(parts: dict[str, Measured], values: dict[str, np.ndarray]) -> np.ndarray:
    """Return the residuals over their floors of all channels, shape (n,)."""
    return np.concatenate(
        [scaled(parts[name], v)[:, smooth_columns(parts[name])].ravel() for name, v in values.items()]
    )


def is_noise(residuals: np.ndarray) -> bool:
    """Return whether residuals over their floors are noise."""
    return _is_noise_sum(float(residuals @ residuals), len(residuals))


def excess(residuals: np.ndarray) -> float:
    """Return the sum of squares of residuals over their floors beyond that of noise."""
    return max(float(residuals @ residuals) - len(residuals), 0.0)


def _is_noise_sum(squares: float, n: int) -> bool:
    return squares < n + _NOISE_DEVIATIONS * math.sqrt(2.0 * n)
