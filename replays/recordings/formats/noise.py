"""The noise of a signal, whatever its colour: how much there is, and where in frequency it ends."""

from __future__ import annotations

import numpy as np

_LENGTH = 256
"""Samples of a stretch."""
_LOW = 16
"""Lines of its spectrum, from 0 on, in which the signal itself moves: noise is taken to go on there as above them."""
_MANY = 5
"""Of more stretches than this, the quietest tenth is below the mean, by so many standard deviations: ..."""
_TENTH = 1.2816
_TIED = 1.0 + 2.0 * (4.0 / 9.0 + 1.0 / 36.0)
"""By this a Hann window multiplies the variance of a sum of lines, as it ties each to its neighbours."""
_ORDER = 4
"""Of the low-pass, a Butterworth, as the channel table has it."""
_FALL = 6.0
"""So much higher than at its end the noise must be, in power, for a corner to be seen, ..."""
_FIT = 1.2
"""... and so near the filter's curve the spectrum, as a factor in power, beside its own scatter."""
_LEAST = 32
"""Stretches without which none is looked for."""


def _spectra(values: np.ndarray) -> np.ndarray:
    """Power of the lines of each stretch, as white noise has in all [unit^2], shape (stretches, lines from _LOW on).

    Of second differences, divided by what these do to a sine: what the signal does slowly drops out of them.
    """
    second = np.diff(values, 2)
    second = second[np.isfinite(second)]
    stretches = second[: len(second) // _LENGTH * _LENGTH].reshape(-1, _LENGTH)
    window = np.hanning(_LENGTH + 1)[:-1]
    lines = np.abs(np.fft.rfft(stretches * window, axis=1)[:, _LOW:-1]) ** 2 / float(window @ window)
    return lines / (2.0 * np.sin(np.pi * np.arange(_LOW, _LENGTH // 2) / _LENGTH)) ** 4


def white_or_not(values: np.ndarray) -> float:
    """Standard deviation of a signal's noise [its unit], in the quietest tenth of its stretches, if there are many.

    Of white noise it is that of the noise; of noise behind a filter, or between whose samples straight lines were
    drawn, that of what is left. Where it ends below a sixteenth of the rate it is not seen.
    """
    spectra = _spectra(values)
    if not len(spectra):
        return 0.0
    weights = np.ones(spectra.shape[1])
    weights[: _LOW // 2] += 2.0
    rms = np.sqrt(spectra @ weights / (_LENGTH / 2))
    if len(rms) <= _MANY:
        return float(np.quantile(rms, 0.1))
    mean = weights * np.median(spectra, axis=0)
    spread = 0.5 * np.sqrt(_TIED * float(mean @ mean)) / max(float(mean.sum()), 1e-300)
    return float(np.quantile(rms, 0.1)) / (1.0 - _TENTH * min(float(spread), 0.5))


def corner_hz(values: np.ndarray, rate_hz: float) -> float | None:
    """Where the noise of a signal ends as it does behind a low-pass of order 4 [Hz]; None where it does not.

    Of a converter's own noise, which comes behind the filter, nothing is learnt: it is as strong up to half of the
    rate.
    """
    spectra = _spectra(values)
    levels = spectra.mean(axis=1) if len(spectra) else np.empty(0)
    quiet = spectra[levels <= np.quantile(levels, 0.25)] if len(spectra) >= _LEAST else spectra[:0]
    if not len(quiet):
        return None
    power = quiet.mean(axis=0)
    part = np.arange(_LOW, _LENGTH // 2) / _LENGTH
    end = float(np.median(power[-_LOW // 2 :]))
    if not end > 0.0 or float(np.median(power[: _LOW // 2])) < _FALL * end:
        return None
    best: tuple[float, float] | None = None
    for corner in np.geomspace(part[0], 0.5, 200):
        shape = 1.0 / (1.0 + (part / corner) ** (2 * _ORDER))
        for floor in end * np.array([0.0, 0.5, 0.8, 0.95]):
            held = np.log(np.maximum(power - floor, 1e-3 * end)) if floor else np.log(power)
            level = np.median(held[: _LOW // 2])
            off = np.log(power) - np.log(np.exp(level) * shape + floor)
            error = float(np.sqrt(np.mean(off**2)))
            if best is None or error < best[0]:
                best = error, float(corner)
    assert best is not None
    # Each line is a mean of so many squares: its logarithm varies by one over their number.
    return best[1] * rate_hz if best[0] < np.hypot(np.log(_FIT), 1.0 / np.sqrt(len(quiet))) else None
