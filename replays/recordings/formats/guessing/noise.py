"""Noise of a signal, white or coloured: its level and its corner frequency."""

from __future__ import annotations

import numpy as np

from replays.estimate.spectra import periodic_hann, power
from replays.estimate.spool import Spool, blocks, spool

_SEGMENT = 256
"""Samples per segment of the spectrum."""
_FIRST_LINE = 16
"""Lowest spectral lines, which the signal itself occupies; noise there is assumed equal to that above."""
_QUIET_PART, _SHAPE_PART = 0.1, 0.4
"""Quantile of the segments that counts as quiet, line by line, so that temporary motion is excluded. The second one is
for the spectral shape, which needs more segments."""
_LINES, _LINES_ROWS = 4, 1 << 11
"""Spectral lines, and segments, that are read at a time."""
_MEDIAN_LINES = 9
"""Lines of a running median, which suppresses single tones."""
_MAX_LINE_RATIO = 3.0
"""Limit of a line over the median of its neighbours."""
_MAX_ZERO_FRACTION = 0.02
"""Fraction of second differences that are 0 in a signal that is not stuck."""
_ORDER = 4
"""Order of the low-pass, a Butterworth filter, as in the channel table."""
_MIN_POWER_DROP = 6.0
"""Minimum ratio of the noise power at low frequencies to that at the end, for a visible corner."""
_MAX_RATIO = 1.2
"""Largest deviation of the spectrum from the filter's curve, as a factor in power, in addition to its scatter."""
_MIN_SEGMENTS = 32
"""Minimum number of segments for an estimate of the corner."""


def segment_spectra(values: np.ndarray) -> np.ndarray:
    """Return the power spectrum of each segment [unit^2], shape (segments, lines from _FIRST_LINE).

    It is computed from second differences, corrected for their gain, which removes slow motion. White noise has its
    variance in each line.
    """
    gain = (2.0 * np.sin(np.pi * np.arange(_FIRST_LINE, _SEGMENT // 2) / _SEGMENT)) ** 4
    window, rest, zeros = periodic_hann(_SEGMENT), np.empty(0), 0
    spectra, moves = Spool(), list[np.ndarray]()
    for rows in blocks(len(values) - 2, values):
        second = np.diff(values[rows.start : rows.stop + 2], 2)
        second = np.concatenate([rest, second[np.isfinite(second)]])
        stretches, rest = np.split(second, [len(second) // _SEGMENT * _SEGMENT])
        stretches = stretches.reshape(-1, _SEGMENT)
        spectra.add(power(stretches, window)[:, _FIRST_LINE:-1] / gain)
        moves.append(np.any(stretches != 0.0, axis=1))
        zeros += np.count_nonzero(stretches[moves[-1]] == 0.0)
    moving, lines = np.concatenate(moves), spectra.array()
    if zeros < _MAX_ZERO_FRACTION * _SEGMENT * np.count_nonzero(moving) and not moving.all():
        lines = spool(lines[rows][moving[rows]] for rows in blocks(len(lines), lines))  # stuck: no noise
    return lines


def _floor(values: np.ndarray, quiet: float) -> tuple[np.ndarray, int]:
    """Return the noise power in each line from _LOW, shape (lines,), and the number of segments."""
    spectra = segment_spectra(values)
    rows = len(spectra)
    if not rows:
        return np.empty(0), 0
    # Powers of noise are exponentially distributed: the k-th smallest of n has the mean 1/n + ... + 1/(n - k + 1).
    means = np.cumsum(1.0 / np.arange(rows, 0, -1))
    lines = [  # a few lines at a time
        np.quantile(
            np.concatenate([spectra[part, first : first + _LINES] for part in blocks(rows, spectra, size=_LINES_ROWS)]),
            quiet, axis=0,
        )
        for first in range(0, spectra.shape[1], _LINES)
    ]  # fmt: skip
    return np.concatenate(lines) / np.interp(quiet * (rows - 1), np.arange(rows), means), rows


def estimate_noise(values: np.ndarray) -> float:
    """Return the standard deviation of a signal's noise in its quietest tenth [unit of the signal].

    For filtered or interpolated noise it is that of the remaining noise. Noise below a sixteenth of the rate is not
    visible.
    """
    power, _ = _floor(values, _QUIET_PART)
    if not len(power):
        return 0.0
    # Limit tones, which exceed their neighbours, and keep the scatter, whose mean is unbiased.
    near = np.lib.stride_tricks.sliding_window_view(np.pad(power, _MEDIAN_LINES // 2, mode="reflect"), _MEDIAN_LINES)
    power = np.minimum(power, _MAX_LINE_RATIO * np.median(near, axis=1))
    return float(np.sqrt((power.sum() + _FIRST_LINE * power[: _FIRST_LINE // 2].mean()) / (_SEGMENT / 2)))


def corner_hz(values: np.ndarray, rate_hz: float) -> float | None:
    """Return the corner of noise that a 4th-order low-pass has filtered [Hz], or None.

    The converter's own noise enters after the filter and extends to half of the rate; it shows no corner.
    """
    power, stretches = _floor(values, _SHAPE_PART)
    if stretches < _MIN_SEGMENTS:
        return None
    part = np.arange(_FIRST_LINE, _SEGMENT // 2) / _SEGMENT
    end = float(np.median(power[-_FIRST_LINE // 2 :]))
    if not end > 0.0 or float(np.median(power[: _FIRST_LINE // 2])) < _MIN_POWER_DROP * end:
        return None
    best: tuple[float, float] | None = None
    for corner in np.geomspace(part[0], 0.5, 200):
        shape = 1.0 / (1.0 + (part / corner) ** (2 * _ORDER))
        for floor in end * np.array([0.0, 0.5, 0.8, 0.95]):
            level = float(np.median((power - floor)[: _FIRST_LINE // 2]))
            off = np.log(power) - np.log(np.maximum(level * shape + floor, 1e-3 * end))
            error = float(np.sqrt(np.mean(off**2)))
            if best is None or error < best[0]:
                best = error, float(corner)
    assert best is not None
    # Each line is a mean of this many squares: its logarithm varies by the inverse square root.
    return best[1] * rate_hz if best[0] < np.hypot(np.log(_MAX_RATIO), 1.0 / np.sqrt(_SHAPE_PART * stretches)) else None
