"""Spectrum of a log's noise, from its samples before the hammer pulse."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from replays.estimate.least_squares import solve
from replays.estimate.spectra import NoiseSpectrum
from replays.recordings.resimulation.prediction import Measured

_TURNS = 2
"""Multiples of the speed at which a signal is not noise: a wrong gain and run-out."""
_MAX_EXCESS = 5.0
"""Largest RMS of coloured noise over white noise; more is a fault."""
_MAX_LINE = 3.0
"""Largest RMS of a line over white noise; more is hum."""


def with_spectra(parts: Mapping[str, Measured], expected: Mapping[str, np.ndarray]) -> dict[str, Measured]:
    """Return parts with the spectrum of each channel's noise, as the rows of a quiet stretch show it.

    What may be motion is not noise: a constant and a trend, and parts of any channel's expected signal, are removed
    first.

    Args:
        parts: Channels in the quiet stretch, at their full rate.
        expected: Their expected signals, each shape (n, channels).
    """
    return {
        name: replace(part, spectra=tuple(_measure(part, c, expected[name]) for c in range(len(part.channels))))
        for name, part in parts.items()
    }


def _measure(part: Measured, c: int, expected: np.ndarray) -> NoiseSpectrum | None:
    if part.channels[c].name == "keyphasor" or not part.random[c]:
        return None
    scales = np.ptp(expected, axis=0)
    moving = (expected - expected.mean(axis=0))[:, scales > 0.0] / scales[scales > 0.0]
    columns = [np.ones(len(expected)), np.linspace(-1.0, 1.0, len(expected)), *moving.T, *np.gradient(moving, axis=0).T]
    rest = solve_rest(columns, (part.values[:, c] - expected[:, c]) / part.floor[c])
    spectrum = NoiseSpectrum.estimate(rest)
    if spectrum is None or spectrum.excess > _MAX_EXCESS or spectrum.largest_line > _MAX_LINE:
        return None
    return spectrum


def solve_rest(columns: list[np.ndarray], values: np.ndarray) -> np.ndarray:
    """Return values without their least-squares combination of columns, shape (n,)."""
    table = np.column_stack(columns)
    return values - table @ solve(table, values)
