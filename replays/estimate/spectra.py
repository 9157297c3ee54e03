"""Spectra of real signals, filters and correlations, and interpolation of a peak between samples.

The two-sided spectrum of an orbit x + j y is `rig.channels.orbit.full_spectrum`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


def spectrum(values: np.ndarray, size: int | None = None) -> np.ndarray:
    """Return the one-sided complex spectrum along the last axis, zero-padded to `size` rows."""
    return np.fft.rfft(values, size)


def power(values: np.ndarray, window: np.ndarray | float = 1.0) -> np.ndarray:
    """Return the power of each line along the last axis; for white noise, its variance [unit^2]."""
    window = np.broadcast_to(window, values.shape[-1:])
    return np.abs(spectrum(values * window)) ** 2 / float(window @ window)


def periodic_hann(rows: int) -> np.ndarray:
    """Return a periodic Hann window, shape (rows,)."""
    return np.hanning(rows + 1)[:-1]


def correlation(values: np.ndarray, spectra: np.ndarray, size: int) -> np.ndarray:
    """Return the circular correlation of values with signals given by their spectra, by lag, shape (signals, size)."""
    return np.fft.irfft(np.conj(spectrum(values, size)) * spectra, size)


class Spectrum(NamedTuple):
    """Spectrum of a signal for filtering.

    Attributes:
        lines: One-sided spectrum, shape (rows // 2 + 1,).
        turn: 2 pi i times the frequencies [rad/s], of the same shape.
        rows: Number of samples of the signal.
    """

    lines: np.ndarray
    turn: np.ndarray
    rows: int

    @classmethod
    def from_samples(cls, values: np.ndarray, step_s: float) -> Spectrum:
        """Compute the spectrum of evenly spaced samples, shape (n,)."""
        return cls(spectrum(values), 2j * np.pi * np.fft.rfftfreq(len(values), step_s), len(values))

    def apply_response(self, response: np.ndarray | float) -> np.ndarray:
        """Return the signal filtered with a response at each line, shape (rows,)."""
        return np.fft.irfft(self.lines * response, self.rows)


def transfer(x: np.ndarray, y: np.ndarray, rate_hz: float, rows: int) -> tuple[np.ndarray, ...]:
    """Estimate a transfer function by Welch's method with Hann windows and 50 % overlap.

    Args:
        x: Input signal, shape (n,).
        y: Output signal, shape (n,).
        rate_hz: Sample rate [Hz].
        rows: Samples per segment.

    Returns:
        Frequencies [Hz], power density of x, magnitude of y over x, and coherence, each of shape (rows // 2 + 1,).
    """
    from scipy.signal import csd, welch

    settings = {"fs": rate_hz, "nperseg": rows, "window": "hann", "detrend": "constant"}
    f, sxx = welch(x, **settings)
    _, syy = welch(y, **settings)
    _, sxy = csd(x, y, **settings)
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.minimum(1.0, np.abs(sxy) ** 2 / (sxx * syy))
        return f, sxx, np.abs(sxy) / sxx, coherence


def window_spectra(x: np.ndarray, y: np.ndarray, rate_hz: float) -> tuple[np.ndarray, ...]:
    """Average power and cross spectra of whole windows, such as those after hammer hits, without a taper.

    Args:
        x: Input signal, shape (windows, rows).
        y: Output signal, of the same shape.
        rate_hz: Sample rate [Hz].

    Returns:
        Frequencies [Hz], power densities of x and of y, and complex cross density, each of shape (rows // 2 + 1,).
    """
    from scipy.signal import csd, welch

    settings: Any = {"fs": rate_hz, "window": "boxcar", "nperseg": x.shape[1], "noverlap": 0, "detrend": False}
    f, sxx = welch(x.ravel(), **settings)
    return f, sxx, welch(y.ravel(), **settings)[1], csd(x.ravel(), y.ravel(), **settings)[1]


def parabola_top(before: float, middle: float, after: float) -> tuple[float, float]:
    """Return the vertex of a parabola through three equally spaced values, the largest in the middle.

    Returns:
        Position of the vertex relative to the middle value [samples], and its height above it; both 0 if the values are
        level.
    """
    bend = before - 2.0 * middle + after
    if not bend < 0.0:
        return 0.0, 0.0
    return 0.5 * (before - after) / bend, -((before - after) ** 2) / (8.0 * bend)
