"""The noise of a signal, whatever its colour: how much there is, and where in frequency it ends."""

from __future__ import annotations

import numpy as np

from replays.estimate.spectra import periodic_hann, power

_LENGTH = 256
"""Samples of a stretch."""
_LOW = 16
"""Lines of its spectrum, from 0 on, in which the signal itself moves: noise is taken to go on there as above them."""
_QUIET, _HALF_QUIET = 0.1, 0.4
"""Part of its stretches in which each line is taken for quiet: what a signal does at times drops out, line by line.
The second one is for the shape, which needs more of them."""
_TONE = 9
"""Lines of which the middle one counts, so that a single tone does not."""
_TONES = 3.0
"""So many times what its neighbours have, a line may have."""
_RARE = 0.02
"""Part of a signal's second differences that are 0 where it is not stuck."""
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
    still = ~stretches.any(axis=1)
    if not still.all() and (stretches[~still] == 0.0).mean() < _RARE:
        stretches = stretches[~still]  # where it is stuck it has no noise; where all of it is coarse it has little
    lines = power(stretches, periodic_hann(_LENGTH))[:, _LOW:-1]
    return lines / (2.0 * np.sin(np.pi * np.arange(_LOW, _LENGTH // 2) / _LENGTH)) ** 4


def _floor(values: np.ndarray, quiet: float) -> tuple[np.ndarray, int]:
    """Power of the noise in each line from _LOW on, shape (lines,), and the number of stretches; none: no lines."""
    spectra = _spectra(values)
    rows = len(spectra)
    if not rows:
        return np.empty(0), 0
    # Of a line of noise, powers are distributed exponentially: the k-th least of n is 1/n + ... + 1/(n - k + 1) means.
    means = np.cumsum(1.0 / np.arange(rows, 0, -1))
    return np.quantile(spectra, quiet, axis=0) / np.interp(quiet * (rows - 1), np.arange(rows), means), rows


def white_or_not(values: np.ndarray) -> float:
    """Standard deviation of a signal's noise [its unit], as it is in the quietest tenth of the time, if there is much.

    Of white noise it is that of the noise; of noise behind a filter, or between whose samples straight lines were
    drawn, that of what is left. Where it ends below a sixteenth of the rate it is not seen.
    """
    power, _ = _floor(values, _QUIET)
    if not len(power):
        return 0.0
    # A tone stands out of its neighbours; what scatters about them has its mean as it is.
    near = np.lib.stride_tricks.sliding_window_view(np.pad(power, _TONE // 2, mode="reflect"), _TONE)
    power = np.minimum(power, _TONES * np.median(near, axis=1))
    return float(np.sqrt((power.sum() + _LOW * power[: _LOW // 2].mean()) / (_LENGTH / 2)))


def corner_hz(values: np.ndarray, rate_hz: float) -> float | None:
    """Where the noise of a signal ends as it does behind a low-pass of order 4 [Hz]; None where it does not.

    Of a converter's own noise, which comes behind the filter, nothing is learnt: it is as strong up to half of the
    rate.
    """
    power, stretches = _floor(values, _HALF_QUIET)
    if stretches < _LEAST:
        return None
    part = np.arange(_LOW, _LENGTH // 2) / _LENGTH
    end = float(np.median(power[-_LOW // 2 :]))
    if not end > 0.0 or float(np.median(power[: _LOW // 2])) < _FALL * end:
        return None
    best: tuple[float, float] | None = None
    for corner in np.geomspace(part[0], 0.5, 200):
        shape = 1.0 / (1.0 + (part / corner) ** (2 * _ORDER))
        for floor in end * np.array([0.0, 0.5, 0.8, 0.95]):
            level = float(np.median((power - floor)[: _LOW // 2]))
            off = np.log(power) - np.log(np.maximum(level * shape + floor, 1e-3 * end))
            error = float(np.sqrt(np.mean(off**2)))
            if best is None or error < best[0]:
                best = error, float(corner)
    assert best is not None
    # Each line is like a mean of so many squares: its logarithm varies by one over their number.
    return best[1] * rate_hz if best[0] < np.hypot(np.log(_FIT), 1.0 / np.sqrt(_HALF_QUIET * stretches)) else None
