"""Known signal at any time, with its slope: interpolated from the samples of a session, or exact from a formula."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

import numpy as np

_RATIO = 4
"""Oversampling of the splines."""
_HALF_TAPS, _KAISER, _CUTOFF = 64, 10.0, 0.97
EDGE = _HALF_TAPS + 4
"""Samples at each end at which the signal is not interpolated."""
_CHUNK = 1 << 18
"""Samples that one spline covers; a longer signal has one per `_BLOCK`, of which the last `_MAX_KEPT` are kept."""
_BLOCK, _MAX_KEPT = 1 << 16, 16
_SEGMENT, _MIN_SIGNAL_TO_NOISE = 512, 4.0
"""Samples of a spectrum, and its power over that of noise from which it contains a signal."""
_MAX_RATE_PART, _SPLIT_TAPS = 0.9, 513
"""Largest rate over the sent one, for a part above half of the rate to exist, and taps of the filter for this part."""


class Stimulus(Protocol):
    """A signal that is known at all times of a span.

    Attributes:
        span_s: First and last time [s].
    """

    span_s: tuple[float, float]

    def __call__(self, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values and slopes [unit, unit/s] at ascending times in the span, each shape (n,)."""
        ...


class Sampled:
    """Band-limited signal through even samples.

    Kaiser-windowed sinc to four times the rate, then quintic splines; `tests/unit/test_score.py` measures the error.
    """

    def __init__(self, values: np.ndarray, first_s: float, rate_hz: float) -> None:
        """Store even samples, shape (n,), with the time of the first one [s]."""
        self._values, self._first_s, self._rate_hz = values, first_s, rate_hz
        self._size = len(values) if len(values) <= _CHUNK else _BLOCK
        self._kept: dict[int, Any] = {}
        last_s = first_s + (len(values) - 1) / rate_hz
        self.span_s = (first_s + EDGE / rate_hz, last_s - EDGE / rate_hz)

    def __call__(self, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values and slopes as `Stimulus` does."""
        at = (times_s - self._first_s) * self._rate_hz
        values, slopes = np.empty(len(at)), np.empty(len(at))
        blocks = np.clip(at // self._size, 0, (len(self._values) - 1) // self._size)
        for block in np.unique(blocks).astype(int).tolist():
            part = blocks == block
            place = (at[part] - max(0, block * self._size - EDGE)) * _RATIO
            spline = self._spline(block)
            values[part] = spline(place)
            slopes[part] = spline(place, nu=1) * (_RATIO * self._rate_hz)
        return values, slopes

    def find_nearest(self, times_s: np.ndarray) -> np.ndarray:
        """Return the sample nearest to each time [s], shape (n,)."""
        at = np.rint((times_s - self._first_s) * self._rate_hz).astype(int)
        return self._values[np.clip(at, 0, len(self._values) - 1)]

    def _spline(self, block: int) -> Any:
        """Return the spline of a block and its margins, by place at four times the rate from its first sample."""
        from scipy.interpolate import make_interp_spline
        from scipy.signal import firwin, upfirdn

        if block not in self._kept:
            low, high = max(0, block * self._size - EDGE), (block + 1) * self._size + EDGE + 1
            window = cast(Any, ("kaiser", _KAISER))
            taps = firwin(2 * _HALF_TAPS * _RATIO + 1, _CUTOFF / _RATIO, window=window) * _RATIO
            finer = upfirdn(taps, self._values[low:high], up=_RATIO)[_HALF_TAPS * _RATIO : -_HALF_TAPS * _RATIO or None]
            if len(self._kept) == _MAX_KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[block] = make_interp_spline(np.arange(len(finer)), finer, k=5)
        return self._kept[block]


def remove_noise(values: np.ndarray, noise: float) -> np.ndarray:
    """Return samples without most of their white noise, by a threshold on their short spectra.

    A fit to noisy samples takes the slope of the noise for that of the signal, and its intervals are too narrow.

    Args:
        values: Even samples, shape (n,).
        noise: Noise of the samples [unit rms].
    """
    from scipy.ndimage import uniform_filter
    from scipy.signal import istft, stft

    cleaned = np.array(values, float)
    options: dict[str, Any] = {"nperseg": _SEGMENT, "noverlap": 3 * _SEGMENT // 4}
    for begin in range(0, len(values) if len(values) > 2 * _SEGMENT else 0, _CHUNK):
        low, high = max(0, begin - _SEGMENT), min(len(values), begin + _CHUNK + _SEGMENT)
        middle = float(np.mean(values[low:high]))
        _, _, spectra = stft(values[low:high] - middle, boundary="even", **options)
        # The power of white noise in a line is its variance times the sum of the window's squares over its sum squared.
        level = noise**2 * 1.5 / _SEGMENT
        spectra[uniform_filter(np.abs(spectra) ** 2, 3) < _MIN_SIGNAL_TO_NOISE * level] = 0.0
        part = istft(spectra, **options)[1][begin - low : high - low] + middle
        cleaned[begin : begin + _CHUNK] = part[: len(cleaned[begin : begin + _CHUNK])]
    return cleaned


def split_at_rate(
    stimulus: Stimulus, rate_hz: float, sent_hz: float, least: float
) -> tuple[Sampled, Sampled, Sampled] | None:
    """Return the part of a signal below half of a rate, the part above, and the latter a quarter of a period later.

    Args:
        stimulus: The signal.
        rate_hz: The rate [Hz].
        sent_hz: Twice the highest frequency that the signal may have [Hz].
        least: Smallest part above for which the parts are returned; None if it is smaller [unit rms].
    """
    from scipy.signal import fftconvolve, firwin, hilbert

    low, high = stimulus.span_s
    rows = int((high - low) * 2.0 * sent_hz)
    if rate_hz > _MAX_RATE_PART * sent_hz or rows < 4 * _SPLIT_TAPS:
        return None
    values, _ = stimulus(low + np.arange(rows) / (2.0 * sent_hz))
    taps = firwin(_SPLIT_TAPS, 0.5 * rate_hz, fs=2.0 * sent_hz, window=cast(Any, ("kaiser", _KAISER)))
    below = fftconvolve(values, taps, "valid")
    above = values[_SPLIT_TAPS // 2 :][: len(below)] - below
    if np.std(above) < least:
        return None
    first_s = low + (_SPLIT_TAPS // 2) / (2.0 * sent_hz)
    parts = below, above, hilbert(above).imag  # type: ignore[union-attr]
    return cast(Any, tuple(Sampled(part, first_s, 2.0 * sent_hz) for part in parts))


class Exact:
    """Signal by a formula of time; slope by central differences, with a relative error of 2e-6 at half of the rate."""

    def __init__(
        self, formula: Callable[[np.ndarray], np.ndarray], span_s: tuple[float, float], rate_hz: float
    ) -> None:
        """Store a formula [unit] of times [s], its span, and the rate at which the signal is recorded [Hz]."""
        self._formula, self.span_s, self._step_s = formula, span_s, 0.001 / rate_hz

    def __call__(self, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values and slopes as `Stimulus` does."""
        f, h = self._formula, self._step_s
        return f(times_s), (f(times_s + h) - f(times_s - h)) / (2.0 * h)
