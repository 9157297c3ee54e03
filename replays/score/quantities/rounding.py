"""Rounding of a converter whose steps exceed the noise: its error repeats with the signal and does not average out.

If the noise exceeds half a step, rounding is white noise (Widrow & Kollar 2008, Quantization Noise, ch. 5).
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
"""Tried places of the steps relative to the signal, as the true one is not known to a part of a step."""
_PEAK_SHIFTS = (0.0, 0.25)
"""Shifts of the signal's peak in steps, as the places of two levels in their steps may differ."""
_HARMONICS = 8
_MIN_DITHER = 0.5
"""Noise over a step above which the error of rounding is noise: the rest is below 1 % of a step."""
_MIN_STEP = 0.05
"""Step over the residual of a fit, below which rounding is negligible."""
_MAX_VALUES = 1 << 14
_MAX_ROWS = 1 << 16
"""Rows by which errors of parameters are estimated."""
_STEP_TOLERANCE = 1e-3
"""Largest deviation of differences of values from whole numbers of steps, as a part of a step: rounding of the file."""


def find_step(values: np.ndarray) -> float:
    """Return the step of which values are multiples [unit], or 0."""
    levels = np.unique(values[np.isfinite(values)][:_MAX_VALUES])
    apart = np.diff(levels)
    apart = apart[apart > 1e-9 * max(1e-300, float(np.abs(levels[[0, -1]]).max()))] if len(levels) else apart
    if not len(apart):
        return 0.0
    step = float(apart.min())
    return step if np.abs(apart / step - np.rint(apart / step)).max() < _STEP_TOLERANCE * len(levels) ** 0.5 else 0.0


@dataclass(frozen=True)
class Converter:
    """A converter whose rounding may be visible.

    Attributes:
        step: Step of its counts [unit].
        noise: Noise at its input [unit rms].
        values: Its output next to the rows of a fit [unit], shape (n,); None for the converter of the record itself.
    """

    step: float
    noise: float
    values: np.ndarray | None = None

    @property
    def error(self) -> float:
        """Noise and rounding of its output [unit rms]."""
        return math.hypot(self.noise, self.step / math.sqrt(12.0))


def find_undithered(fit: Waveform, step: float, session: Converter | None) -> tuple[Converter, ...]:
    """Return the converters whose rounding is not dithered by noise.

    Args:
        fit: A fit.
        step: Step of the DAQ's converter [unit], or 0.
        session: Converter of the known signal; None if the signal is known by a formula.
    """
    # The sensor's noise is the same at the input of the DAQ as at that of the session's converter.
    rounding = (step**2 + (session.step**2 if session else 0.0)) / 12.0
    noise = math.sqrt(max(0.0, float(np.mean(fit.residual**2)) - rounding))
    both = (Converter(step, noise), *((session,) if session else ()))
    least = _MIN_STEP * float(np.std(fit.residual))
    return tuple(each for each in both if each.step > least and each.noise <= _MIN_DITHER * each.step)


def find_rounding_errors(fit: Waveform, converters: Sequence[Converter], rows: slice | np.ndarray) -> np.ndarray:
    """Return the possible errors of rounding in a fit, in addition to its noise [unit].

    Args:
        fit: A fit.
        converters: Converters that may cause them.
        rows: Rows of the fit.

    Returns:
        Expected error for each of the tried places of the steps, shape (m, n); (0, n) without converters.
    """
    fitted = fit.values[rows] - fit.residual[rows]
    errors = np.zeros((len(_PEAK_SHIFTS) if converters else 0, _PHASES, len(fitted)))
    for one, (turn, each) in product(converters, zip(_PEAK_SHIFTS, errors, strict=False)):
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


def widen_intervals(fit: Waveform, converters: Sequence[Converter]) -> Waveform:
    """Return a fit whose intervals include the effect of rounding on its five parameters.

    Args:
        fit: A fit.
        converters: Converters whose rounding may cause errors.
    """
    if not converters:
        return fit
    rows = np.unique(np.linspace(0, len(fit.residual) - 1, _MAX_ROWS).astype(int))
    errors = find_rounding_errors(fit, converters, rows)
    sent, slope, since = fit.sent[rows], fit.slope[rows], fit.times_s[rows] - fit.middle_s
    late = [slope, slope * since, slope * 0.5 * (since**2 - fit.half_s**2 / 3.0)]
    columns = np.column_stack([sent, np.ones(len(since)), *(fit.gain * each for each in late)])
    moved = solve(columns, errors.T)
    return replace(fit, covariance=fit.covariance + np.diag((np.abs(moved).max(axis=1) / student(fit.dof)) ** 2))
