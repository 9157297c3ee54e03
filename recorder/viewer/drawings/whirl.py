"""Sense and frequency of a whirl, from z = x + j y."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rig.channels.orbit import mean_rotation, rms_radius

BACKWARD_RGB = (240, 100, 75)
FORWARD_RGB = (95, 205, 150)
STILL_RGB = (150, 155, 165)

_MIN_RADIUS_MM = 5e-3
_MIN_FREQUENCY_HZ = 0.5


@dataclass(frozen=True, slots=True)
class Whirl:
    """Rotation of z over a time span.

    Attributes:
        frequency_hz: Mean rotation [Hz]: forward (counter-clockwise, with the spin) positive, backward negative.
        radius_mm: Root mean square distance from the orbit's own centre [mm].
    """

    frequency_hz: float
    radius_mm: float

    @property
    def sense(self) -> str:
        """`forward`, `backward`, or `none` for negligible rotation."""
        if self.radius_mm < _MIN_RADIUS_MM or abs(self.frequency_hz) < _MIN_FREQUENCY_HZ:
            return "none"
        return "forward" if self.frequency_hz > 0.0 else "backward"

    @property
    def color(self) -> tuple[int, int, int]:
        """RGB colour of the sense, the same in every view."""
        return {"forward": FORWARD_RGB, "backward": BACKWARD_RGB, "none": STILL_RGB}[self.sense]


def compute_whirl(z: np.ndarray, rate_hz: float) -> Whirl:
    """Return the rotation of z about its mean.

    Args:
        z: x + j y [mm], shape (n,).
        rate_hz: Samples per second [Hz].
    """
    if not len(z):
        return Whirl(frequency_hz=0.0, radius_mm=0.0)
    x, y = np.real(z), np.imag(z)
    return Whirl(frequency_hz=mean_rotation(x, y, rate_hz), radius_mm=rms_radius(x, y))
