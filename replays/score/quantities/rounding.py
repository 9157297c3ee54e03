"""Rounding of a converter whose steps exceed the noise: its error repeats with the signal, and does not average.

Where noise is larger than half a step, rounding is white noise (Widrow & Kollar 2008, Quantization Noise, ch. 5).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from replays.estimate.intervals import student
from replays.estimate.least_squares import solve
from replays.score.waveform import Waveform

_PHASES = 8
"""Places of the steps against the signal that are tried: the true one is not known to a part of a step."""
_TURNS = (0.0, 0.25)
"""Parts of a step by which the signal's peak is moved as well: two levels may stand differently in their steps."""
_HARMONICS = 8
_DITHERED = 0.5
"""Noise over a step from which the error of rounding is noise: what is left of it is below 1 % of a step."""
_SMALLEST = 0.05
"""Step over all that a fit leaves, below which rounding is nothing beside the rest."""
_LOOKED = 1 << 14
_MOST_ROWS = 1 << 16
"""Rows by which errors of parameters are estimated."""
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


@dataclass(frozen=True)
class Converter:
    """A converter whose rounding may show.

    Attributes:
        step: Of its counts [unit].
        noise: At its input [unit rms].
        values: What it made of its input next to the rows of a fit [unit], shape (n,); None of the record's own.
    """

    step: float
    noise: float
    values: np.ndarray | None = None

    @property
    def error(self) -> float:
        """Noise and rounding of what came out of it [unit rms]."""
        return math.hypot(self.noise, self.step / math.sqrt(12.0))


def undithered(found: Waveform, step: float, session: Converter | None) -> tuple[Converter, ...]:
    """Return the converters whose rounding the noise does not hide.

    Args:
        found: A fit.
        step: Of the DAQ's converter [unit]; 0 if it has none.
        session: What the known signal went through; None for one that is known by its formula.
    """
    # The sensor's noise is at the input of the DAQ as it was at that of the session's converter.
    rounding = (step**2 + (session.step**2 if session else 0.0)) / 12.0
    noise = math.sqrt(max(0.0, float(np.mean(found.residual**2)) - rounding))
    both = (Converter(step, noise), *((session,) if session else ()))
    least = _SMALLEST * float(np.std(found.residual))
    return tuple(each for each in both if each.step > least and each.noise <= _DITHERED * each.step)


def rounding_errors(found: Waveform, converters: Sequence[Converter], rows: slice | np.ndarray) -> np.ndarray:
    """Return the errors that rounding may have left beside the noise of a fit [unit].

    Args:
        found: A fit.
        converters: That may have left them.
        rows: Of the fit.

    Returns:
        Expected error for each of some places of the steps, shape (m, n); (0, n) without converters.
    """
    fitted = found.values[rows] - found.residual[rows]
    errors = np.zeros((len(_TURNS) if converters else 0, _PHASES, len(fitted)))
    for one, (turn, each) in product(converters, zip(_TURNS, errors, strict=False)):
        values = fitted if one.values is None else one.values[rows]
        around = values - values.mean()
        angle = 2.0 * np.pi * (values / one.step + turn * around / max(float(np.abs(around).max()), 1e-300))
        for k in range(1, _HARMONICS + 1):
            size = (-1) ** k * one.step / (math.pi * k) * math.exp(-2.0 * (math.pi * k * one.noise / one.step) ** 2)
            sine, cosine = np.sin(k * angle), np.cos(k * angle)
            for n in range(_PHASES):
                shift = 2.0 * math.pi * k * n / _PHASES
                each[n] += size * (sine * math.cos(shift) - cosine * math.sin(shift))
    return errors.reshape(-1, len(fitted))


def widen(found: Waveform, converters: Sequence[Converter]) -> Waveform:
    """Return a fit whose intervals hold what errors of rounding may have done to its five parameters.

    Args:
        found: A fit.
        converters: Whose rounding may have left errors.
    """
    if not converters:
        return found
    rows = np.unique(np.linspace(0, len(found.residual) - 1, _MOST_ROWS).astype(int))
    errors = rounding_errors(found, converters, rows)
    known, slope, since = found.known[rows], found.slope[rows], found.times_s[rows] - found.middle_s
    late = [slope, slope * since, slope * 0.5 * (since**2 - found.half_s**2 / 3.0)]
    columns = np.column_stack([known, np.ones(len(since)), *(found.gain * each for each in late)])
    moved = solve(columns, errors.T)
    return replace(
        found, covariance=found.covariance + np.diag((np.abs(moved).max(axis=1) / student(found.freedom)) ** 2)
    )
