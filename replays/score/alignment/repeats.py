"""Times at which the known signal matches a record, over all overlaps of record and session."""

from __future__ import annotations

import math

import numpy as np

from replays.score.records.stimulus import Stimulus
from replays.score.waveform import Waveform

_SAMPLES, _FACTOR, _MAX_TIMES = 1 << 20, 8, 12
"""Compared samples of a record, places per sample, and returned times."""
_RATIO = 1.3
"""Residual power over the least one, up to which a time counts as equal to the best."""
_MIN_OVERLAP, _MIN_OVERLAP_ROWS = 0.2, 400
"""Smallest overlap, as a part of the shorter of record and session, and in rows."""
_MIN_LIKENESS = 0.5
"""Part of its power that the known signal must explain in a matching record."""


def find_repeats(values: np.ndarray, first_s: float, fit: Waveform, stimulus: Stimulus) -> list[float]:
    """Return session less file times at which the known signal matches a record, by the clock of a fit [s].

    Record and session need only overlap in part. Times whose residual equals the best one are first, in order of their
    overlap, then the others in order of their residual.

    Args:
        values: Values of the record, shape (n,).
        first_s: Time of the first value by the record's clock [s].
        fit: A fit of some of the values.
        stimulus: The known signal.
    """
    from scipy.signal import correlate

    low, high = stimulus.span_s
    period_s = (fit.times_s[-1] - fit.times_s[0]) / (len(fit.times_s) - 1)
    step_s = (1.0 + fit.drift) * period_s
    skipped = max(0, min(round((fit.times_s[0] - first_s) / period_s), len(values) - _SAMPLES // 2) - _SAMPLES // 2)
    y = values[skipped : skipped + _SAMPLES] - values.mean()
    n, rows = len(y), math.floor((high - low) / step_s)
    lags = np.arange(1 - n, rows - 1)
    here, there = np.maximum(0, -lags), np.maximum(0, lags)
    overlap = np.minimum(n - here, rows - 1 - there)
    valid = slice(*np.flatnonzero(overlap >= max(_MIN_OVERLAP_ROWS, _MIN_OVERLAP * min(n, rows)))[[0, -1]] + [0, 1])
    here, there, overlap = here[valid], there[valid], overlap[valid]

    def power(signal: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sums, squares = (np.cumsum(np.concatenate([[0.0], each])) for each in (signal, signal**2))
        total = sums[start + overlap] - sums[start]
        return total, squares[start + overlap] - squares[start] - total**2 / overlap

    total, power_y = power(y, here)
    likeness = np.zeros((len(overlap), _FACTOR))
    for phase in range(_FACTOR):
        s, _ = stimulus(low + (np.arange(rows - 1) + phase / _FACTOR) * step_s)
        s = s - s.mean()
        total_s, power_s = power(s, there)
        alike = correlate(s, y, "full", "fft")[valid] - total * total_s / overlap
        both = power_y * power_s
        likeness[:, phase] = alike**2 / np.maximum(both, 1e-12 * both.max())
    curve = likeness.ravel()
    at = np.flatnonzero((curve[1:-1] > curve[:-2]) & (curve[1:-1] >= curve[2:])) + 1
    at = at[curve[at] > _MIN_LIKENESS]
    bend = curve[at - 1] - 2.0 * curve[at] + curve[at + 1]
    aside = 0.5 * (curve[at - 1] - curve[at + 1]) / bend
    peaks = np.minimum(curve[at] - 0.25 * (curve[at - 1] - curve[at + 1]) * aside, 1.0)
    # The error of a parabola at its peak is some part of the square of its bend.
    residual = (1.0 - peaks) * (power_y / overlap)[at // _FACTOR]
    alike = residual <= _RATIO * residual.min(initial=math.inf) + 0.1 * bend**2 * (power_y / overlap)[at // _FACTOR]
    best = np.lexsort((np.where(alike, -overlap[at // _FACTOR], residual), ~alike))[:_MAX_TIMES]
    # Session less file time in the middle of the overlap, as the clocks differ.
    middle = (here + 0.5 * overlap)[at[best] // _FACTOR]
    place = middle + lags[valid][0] + (at[best] + aside[best]) / _FACTOR
    return (low + place * step_s - first_s - (skipped + middle) * period_s).tolist()
