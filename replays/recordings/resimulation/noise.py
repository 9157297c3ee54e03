"""Noise of a log: its spectrum, and where differences between models reach it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from replays.estimate.least_squares import solve
from replays.estimate.spectra import NoiseSpectrum
from replays.recordings.resimulation.prediction import Measured, Prediction

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
    measured = {}
    for name, part in parts.items():
        model = expected[name]
        scales = np.ptp(model, axis=0)
        moving = (model - model.mean(axis=0))[:, scales > 0.0] / scales[scales > 0.0]
        trend = np.linspace(-1.0, 1.0, len(model))
        table = np.column_stack([np.ones(len(model)), trend, moving, np.gradient(moving, axis=0)])
        apart = (part.values - model) / part.floor
        rest = apart - table @ solve(table, apart)
        measured[name] = replace(part, spectra=tuple(_measure(part, c, rest[:, c]) for c in range(len(part.channels))))
    return measured


def _measure(part: Measured, c: int, noise: np.ndarray) -> NoiseSpectrum | None:
    """Return the spectrum of a channel's noise over its floor, shape (n,); None if white, unknown or a fault."""
    if part.channels[c].name == "keyphasor" or not part.random[c]:
        return None
    spectrum = NoiseSpectrum.estimate(noise)
    if spectrum is None or spectrum.excess > _MAX_EXCESS or spectrum.largest_line > _MAX_LINE:
        return None
    return spectrum


def foreseeable_s(
    parts: dict[str, Measured], nominal: Prediction, others: Sequence[Prediction], *, share: float
) -> float | None:
    """Return the first time at which equally valid runs differ by a part of the noise [s]; None if they do not."""
    ends = []
    for name, part in parts.items():
        for other in others:
            apart = np.abs(part.whiten(other.values[name] - nominal.values[name])) > share * part.floor
            apart[:, [channel.name == "keyphasor" for channel in part.channels]] = False  # a pulse may shift by a row
            hit = np.flatnonzero(apart.any(axis=1))
            if len(hit):
                ends.append(float(part.times_s[hit[0]]))
    return min(ends, default=None)
