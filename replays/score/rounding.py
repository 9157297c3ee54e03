"""Rounding of a converter whose steps exceed the noise: its error repeats with the signal, and does not average.

Where noise is larger than half a step, rounding is white noise (Widrow & Kollar 2008, Quantization Noise, ch. 5).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from replays.score.intervals import student
from replays.score.waveform import Waveform

_PHASES = 4
"""Places of the steps against the signal that are tried: the true one is not known to a part of a step."""
_HARMONICS = 8
_DITHERED = 0.5
"""Noise over a step from which the error of rounding is noise: what is left of it is below 1 % of a step."""
_LOOKED = 1 << 14
_WHOLE = 1e-3
"""Part of a step by which differences of values may be off whole numbers of it: rounding of the file."""


def find_step(values: np.ndarray) -> float:
    """Return the step that values are multiples of [unit]; 0 where they have none."""
    found = np.unique(values[np.isfinite(values)][:_LOOKED])
    apart = np.diff(found)
    apart = apart[apart > 1e-9 * max(1e-300, float(np.abs(found[[0, -1]]).max()))] if len(found) else apart
    if not len(apart):
        return 0.0
    step = float(apart.min())
    return step if np.abs(apart / step - np.rint(apart / step)).max() < _WHOLE * len(found) ** 0.5 else 0.0


def rounding_errors(found: Waveform, step: float) -> np.ndarray:
    """Return the errors that rounding may have left beside the noise of a fit [unit].

    Args:
        found: A fit.
        step: Of the converter [unit]; of the larger one of the DAQ's and the session's.

    Returns:
        Expected error for each of some places of the steps, shape (4, n); (0, n) where noise hides the steps.
    """
    noise = math.sqrt(max(0.0, float(np.mean(found.residual**2)) - step**2 / 12.0))
    if step <= 0.0 or noise > _DITHERED * step:
        return np.empty((0, len(found.residual)))
    angle = 2.0 * np.pi / step * (found.values - found.residual)
    errors = np.zeros((_PHASES, len(angle)))
    for k in range(1, _HARMONICS + 1):
        size = (-1) ** k * step / (math.pi * k) * math.exp(-2.0 * (math.pi * k * noise / step) ** 2)
        sine, cosine = np.sin(k * angle), np.cos(k * angle)
        for n in range(_PHASES):
            turn = 2.0 * math.pi * k * n / _PHASES
            errors[n] += size * (sine * math.cos(turn) - cosine * math.sin(turn))
    return errors


def widen(found: Waveform, errors: np.ndarray) -> Waveform:
    """Return a fit whose intervals hold what errors of rounding may have done to its five parameters.

    Args:
        found: A fit.
        errors: That rounding may have left, shape (m, n).
    """
    if not len(errors):
        return found
    since = found.times_s - found.middle_s
    late = [found.slope, found.slope * since, found.slope * 0.5 * (since**2 - found.half_s**2 / 3.0)]
    columns = np.column_stack([found.known, np.ones(len(since)), *(found.gain * each for each in late)])
    sizes = np.maximum(np.sqrt(np.mean(columns**2, axis=0)), 1e-300)
    moved = np.linalg.lstsq(columns / sizes, errors.T, rcond=None)[0] / sizes[:, None]
    return replace(
        found, covariance=found.covariance + np.diag((np.abs(moved).max(axis=1) / student(found.freedom)) ** 2)
    )
