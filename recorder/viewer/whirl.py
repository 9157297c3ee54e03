"""Sense and frequency of a whirl, from z = x + j y."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

BACKWARD_RGB = (240, 100, 75)
FORWARD_RGB = (95, 205, 150)
STILL_RGB = (150, 155, 165)

_LAG_S = 1e-3
_LEAST_RADIUS_MM = 5e-3
_LEAST_FREQUENCY_HZ = 0.5


@dataclass(frozen=True, slots=True)
class Whirl:
    """How z turned over a stretch of time.

    Attributes:
        frequency_hz: Mean rotation [Hz]: forward (counter-clockwise, with the spin) positive, backward negative.
        radius_mm: Root mean square distance from the orbit's own centre [mm].
    """

    frequency_hz: float
    radius_mm: float

    @property
    def sense(self) -> str:
        """`forward`, `backward`, or `none` where hardly anything turns."""
        if self.radius_mm < _LEAST_RADIUS_MM or abs(self.frequency_hz) < _LEAST_FREQUENCY_HZ:
            return "none"
        return "forward" if self.frequency_hz > 0.0 else "backward"

    @property
    def color(self) -> tuple[int, int, int]:
        """RGB of that sense, the same in every view."""
        return {"forward": FORWARD_RGB, "backward": BACKWARD_RGB, "none": STILL_RGB}[self.sense]


def whirl_of(z: np.ndarray, rate_hz: float) -> Whirl:
    """Radius-weighted mean rotation of z about its mean.

    The phase is advanced over 1 ms: short against any whirl of the rig (unambiguous to +-500 Hz), long against the
    correlation time of the probes' noise, which would otherwise pull the slope of a small orbit towards zero.

    Args:
        z: x + j y [mm], shape (n,).
        rate_hz: Samples per second [Hz].
    """
    lag = max(1, round(_LAG_S * rate_hz))
    if len(z) < 2 * lag:
        return Whirl(frequency_hz=0.0, radius_mm=0.0)
    turning = z - z.mean()
    radius = float(np.sqrt(np.mean(np.abs(turning) ** 2)))
    advance = np.vdot(turning[:-lag], turning[lag:])
    angle = math.atan2(advance.imag, advance.real)
    return Whirl(frequency_hz=angle * rate_hz / (2.0 * math.pi * lag), radius_mm=radius)
