"""How far ahead the model can be trusted to be linear in what is not known yet.

Through impacts a small error grows, and far ahead the distance to the recording has many valleys. Where the response
to the remaining uncertainty is still nearly a straight line, there is one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from replays.recordings.identification.window import Window
from rig.base.errors import InputError, SimulationError

BENT = 0.1
"""A response is no longer linear where its bend is above this part of it ..."""
NOTICEABLE = 3.0
"""... and above this many times the noise, summed in squares over a bin."""
SIGMAS = 2.0
"""The response to an error of so many standard deviations."""
_PARTS = (1.0, 0.5, 0.25, 0.1)
_BIN_S = 5e-4


@dataclass(frozen=True)
class Horizon:
    """Up to where the response is linear.

    Attributes:
        time_s: Simulated time [s].
        whole: Whether it is linear through all of the window.
        by: The unknown that has most part in the direction that bends first.
    """

    time_s: float
    whole: bool
    by: str = ""


def horizon(window: Window, z: np.ndarray, covariance: np.ndarray) -> Horizon:
    """Up to where the response to errors of the present size is linear.

    Args:
        window: As far as it is looked ahead.
        z: Present values.
        covariance: Of them, shape (unknowns, unknowns).
    """
    question = window.question
    times_s = question.observation.times_s[: window.rows]
    bins = ((times_s - times_s[0]) / _BIN_S).astype(int)
    starts = np.flatnonzero(np.diff(bins, prepend=-1))
    base = window.predicted(z)
    first, by = window.rows, ""
    sizes, directions = np.linalg.eigh(covariance)
    for size, direction in zip(sizes, directions.T, strict=True):
        change = SIGMAS * np.sqrt(max(size, 0.0)) * direction
        name = question.keys[int(np.argmax(np.abs(direction)))]
        for part in _PARTS:  # near the edge of what the model takes, a smaller change tells of the whole one
            try:
                up, down = window.predicted(z + part * change), window.predicted(z - part * change)
            except (InputError, SimulationError):
                continue
            break
        else:
            continue  # at the edge there is only one side
        slope, bend = (up - down) / (2.0 * part), ((up + down) / 2.0 - base) / part**2
        slope, bend = (
            np.sqrt(np.add.reduceat((np.where(window.known, part, 0.0) ** 2).sum(axis=1), starts))
            for part in (slope, bend)
        )
        bent = np.flatnonzero((bend > BENT * slope) & (bend > NOTICEABLE))
        if len(bent) and starts[bent[0]] < first:
            first, by = int(starts[bent[0]]), name
    if first == window.rows:
        return Horizon(window.end_s, whole=True)
    return Horizon(float(times_s[first]), whole=False, by=by)
