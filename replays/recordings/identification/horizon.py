"""Time up to which the model is linear in the remaining uncertainty.

Impacts amplify small errors, so that over a long window the cost has many minima. While the response to the remaining
uncertainty is nearly linear, there is only one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from replays.recordings.identification.window import Window
from rig.base.errors import InputError, SimulationError

MAX_NONLINEARITY = 0.1
"""A response is nonlinear if its second-order part exceeds this fraction of the linear part."""
MIN_NONLINEARITY = 3.0
"""The second-order part must also exceed this multiple of the noise, as root sum of squares over a bin."""
TEST_SIGMAS = 2.0
"""Size of the error whose response is tested, in standard deviations."""
_CHANGE_FRACTIONS = (1.0, 0.5, 0.25, 0.1)
_BIN_S = 5e-4


@dataclass(frozen=True)
class Horizon:
    """Limit of the linear response.

    Attributes:
        time_s: Simulated time [s].
        whole: True if the response is linear in the whole window.
        by: Unknown with the largest part in the direction that first becomes nonlinear.
    """

    time_s: float
    whole: bool
    by: str = ""


def find_horizon(window: Window, z: np.ndarray, covariance: np.ndarray) -> Horizon:
    """Return the time up to which the response to errors of the present size is linear.

    Args:
        window: Window that includes the look-ahead.
        z: Present values, shape (unknowns,).
        covariance: Covariance of z, shape (unknowns, unknowns).
    """
    question = window.question
    times_s = question.observation.times_s[: window.rows]
    bins = ((times_s - times_s[0]) / _BIN_S).astype(int)
    starts = np.flatnonzero(np.diff(bins, prepend=-1))
    base = window.predicted(z)
    first, by = window.rows, ""
    sizes, directions = np.linalg.eigh(covariance)
    for size, direction in zip(sizes, directions.T, strict=True):
        change = TEST_SIGMAS * np.sqrt(max(size, 0.0)) * direction
        name = question.keys[int(np.argmax(np.abs(direction)))]
        for part in _CHANGE_FRACTIONS:  # at the limits of the model a smaller change is scaled up
            try:
                up, down = window.predicted(z + part * change), window.predicted(z - part * change)
            except (InputError, SimulationError):
                continue
            break
        else:
            continue  # at a limit there is only one side
        slope, curvature = (up - down) / (2.0 * part), ((up + down) / 2.0 - base) / part**2
        slope, curvature = (
            np.sqrt(np.add.reduceat((np.where(window.valid, part, 0.0) ** 2).sum(axis=1), starts))
            for part in (slope, curvature)
        )
        nonlinear = np.flatnonzero((curvature > MAX_NONLINEARITY * slope) & (curvature > MIN_NONLINEARITY))
        if len(nonlinear) and starts[nonlinear[0]] < first:
            first, by = int(starts[nonlinear[0]]), name
    if first == window.rows:
        return Horizon(window.end_s, whole=True)
    return Horizon(float(times_s[first]), whole=False, by=by)
