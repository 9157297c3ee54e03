"""Spectra of real signals and of noise, filters and correlations, and interpolation of a peak between samples.

Noise of a measuring chain is rarely white: it has lines of the mains, and its density rises towards low frequencies. If
residuals are filtered so that such noise becomes white, sums of their squares, means over a stretch and least squares
have the statistics that they have for white noise. The filter is causal: a difference does not appear before its time.

The two-sided spectrum of an orbit x + j y is `rig.channels.orbit.full_spectrum`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

_SEGMENT_ROWS = 8192
"""Most samples of a segment of the spectrum, a power of two."""
_FEWEST_SEGMENTS, _SHORTEST = 8, 64
"""Fewest segments, and their fewest samples."""
_DOUBT = 4.0
"""Standard deviations of a line's estimate by which it must exceed white noise to be coloured."""
_EXTRAPOLATED = 4.0
"""Density at frequency 0 over that of the first line: that of a random walk at half of its frequency."""
_LINE_NEIGHBOURS = 15
"""Frequencies of a running median, which a line does not affect."""
_SETTLED = 0.99
"""Part of the filter's energy after which its start has no effect."""


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


@dataclass(frozen=True, eq=False)
class NoiseSpectrum:
    """Spectrum of a noise relative to white noise of a channel's floor, never below it.

    Attributes:
        density: Power at each frequency over that of the white floor, from 0 up to the sample rate, shape (n,).
    """

    density: np.ndarray

    @classmethod
    def estimate(cls, noise: np.ndarray) -> NoiseSpectrum | None:
        """Estimate the spectrum of a noise over its floor, shape (n,); None if it is white, or too short to tell.

        Between lines the density is a running median, so that a line stands alone. A density that white noise could
        have by chance counts as white.
        """
        from scipy.ndimage import median_filter
        from scipy.signal import detrend, welch

        size = min(_SEGMENT_ROWS, 1 << max(0, len(noise) // (_FEWEST_SEGMENTS // 2 + 1)).bit_length() >> 1)
        if size < _SHORTEST:
            return None
        one_sided = welch(detrend(noise, type="constant"), window="hann", nperseg=size, detrend=False)[1] / 2.0
        segments = 2.0 * len(noise) / size - 1.0
        # Segments of a Hann window with an overlap of a half are nearly independent.
        limit = 1.0 + _DOUBT / np.sqrt(segments)
        smooth = median_filter(one_sided, 5, mode="nearest")
        density = np.where(one_sided > limit * np.maximum(smooth, 1.0), one_sided, smooth)
        density[:2] = one_sided[1:3].max()
        density = np.where(density > limit, density, 1.0)
        if density.max() <= limit:
            return None
        density[0] *= _EXTRAPOLATED
        return cls(np.concatenate([density, density[-2:0:-1]]))

    @cached_property
    def _folded(self) -> dict[int, NoiseSpectrum]:
        """Spectra of every n-th sample, by n; each computes its filter once."""
        return {1: self}

    def fold(self, every: int) -> NoiseSpectrum:
        """Return the spectrum of every n-th sample."""
        if every not in self._folded:
            size = len(self.density) // every * every
            places = np.arange(size) * len(self.density) // size
            self._folded[every] = NoiseSpectrum(self.density[places].reshape(every, -1).mean(axis=0))
        return self._folded[every]

    @property
    def low(self) -> float:
        """Density of slow parts: the mean over the lowest sixty-fourth of the frequencies."""
        return float(self.density[: max(2, len(self.density) // 128)].mean())

    @property
    def excess(self) -> float:
        """RMS of the noise beyond white noise, over that of white noise."""
        return float(np.sqrt(self.density.mean() - 1.0))

    @property
    def largest_line(self) -> float:
        """Largest RMS of a single line over that of white noise."""
        from scipy.ndimage import median_filter

        half = self.density[2 : len(self.density) // 2]
        above = np.maximum(half - median_filter(half, _LINE_NEIGHBOURS, mode="nearest"), 0.0)
        return float(np.sqrt(2.0 * np.convolve(above, np.ones(3)).max() / len(self.density)))

    @cached_property
    def response(self) -> np.ndarray:
        """Impulse response of the whitening filter, which has the least delay, shape (n,)."""
        size = len(self.density)
        cepstrum = np.fft.ifft(-0.5 * np.log(self.density)).real
        cepstrum[1 : (size + 1) // 2] *= 2.0
        cepstrum[size // 2 + 1 :] = 0.0
        return np.fft.ifft(np.exp(np.fft.fft(cepstrum))).real

    @cached_property
    def first_gains(self) -> np.ndarray:
        """Factors that give the filter's first outputs, before it has settled, the variance of white noise."""
        energy = np.cumsum(self.response**2)
        rows = 1 + int(np.searchsorted(energy, _SETTLED * energy[-1]))
        size = len(self.density)
        started = np.tril(np.ones((rows, rows))) * self.response[:rows]
        return 1.0 / np.sqrt((np.abs(np.fft.fft(started, size, axis=1)) ** 2 * self.density).mean(axis=1))

    def colour(self, white: np.ndarray) -> np.ndarray:
        """Return white noise filtered so that it has this spectrum, shape (n,)."""
        half = self.density[: len(self.density) // 2 + 1]
        lines = np.fft.rfft(white)
        places = np.linspace(0.0, len(half) - 1.0, len(lines))
        return np.fft.irfft(lines * np.sqrt(np.interp(places, np.arange(len(half)), half)), len(white))

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Return values over the floor filtered so that the noise is white, shape (n,), from rest before the first."""
        from scipy.signal import oaconvolve

        filtered = oaconvolve(values, self.response[: len(values)])[: len(values)]
        gains = self.first_gains[: len(values)]
        filtered[: len(gains)] *= gains
        return filtered


def whiten_rows(values: np.ndarray, spectrum: NoiseSpectrum | None, index: np.ndarray) -> np.ndarray:
    """Return values over the floor, whitened in every stretch of equally spaced rows.

    Args:
        values: Values over the floor, shape (n,).
        spectrum: Spectrum of the noise at a spacing of 1; None: white.
        index: Number of each row, shape (n,).
    """
    if spectrum is None or not len(values):
        return values
    steps = np.diff(index)
    starts = [0, *(np.flatnonzero(np.diff(steps)) + 2).tolist(), len(values)]
    whitened = np.empty(len(values))
    for begin, end in pairwise(starts):
        every = int(index[begin + 1] - index[begin]) if end - begin > 1 else 1
        folded = spectrum.fold(every) if every > 0 else spectrum
        whitened[begin:end] = folded.whiten(values[begin:end])
    return whitened
