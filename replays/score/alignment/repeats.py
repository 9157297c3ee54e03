"""Times at which the known signal is like a whole record, wherever record and session overlap."""

from __future__ import annotations

import math

import numpy as np

from replays.score.records.stimulus import Stimulus
from replays.score.waveform import Waveform

_MOST, _FINER, _TOLD = 1 << 20, 8, 12
"""Samples of a record that are compared, places between two of them, and how many times are returned."""
_AS_WELL = 1.3
"""Residual power over the least one, up to which a time counts as good as the best."""
_OVERLAP, _FEWEST_ROWS = 0.2, 400
"""Part of the shorter of record and session in which both must be, and rows of it."""
_LIKE = 0.5
"""Part of its power that the known signal explains in a record that is like it."""


def find_repeats(values: np.ndarray, first_s: float, found: Waveform, stimulus: Stimulus) -> list[float]:
    """Return session less file times at which the known signal is like a record, by the clock of a fit [s].

    Record and session need to overlap in part only. Of the begins that leave as little of the rows in both as the best
    one, those with most rows are first; then the others, as they leave little.

    Args:
        values: Of the record, shape (n,).
        first_s: Time of the first of them by its clock [s].
        found: A fit of some of them.
        stimulus: The known signal.
    """
    from scipy.signal import correlate

    low, high = stimulus.span_s
    period_s = (found.times_s[-1] - found.times_s[0]) / (len(found.times_s) - 1)
    step_s = (1.0 + found.drift) * period_s
    skipped = max(0, min(round((found.times_s[0] - first_s) / period_s), len(values) - _MOST // 2) - _MOST // 2)
    y = values[skipped : skipped + _MOST] - values.mean()
    n, rows = len(y), math.floor((high - low) / step_s)
    lags = np.arange(1 - n, rows - 1)
    here, there = np.maximum(0, -lags), np.maximum(0, lags)
    overlap = np.minimum(n - here, rows - 1 - there)
    taken = slice(*np.flatnonzero(overlap >= max(_FEWEST_ROWS, _OVERLAP * min(n, rows)))[[0, -1]] + [0, 1])
    here, there, overlap = here[taken], there[taken], overlap[taken]

    def power(signal: np.ndarray, begin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sums, squares = (np.cumsum(np.concatenate([[0.0], each])) for each in (signal, signal**2))
        total = sums[begin + overlap] - sums[begin]
        return total, squares[begin + overlap] - squares[begin] - total**2 / overlap

    total, power_y = power(y, here)
    likeness = np.zeros((len(overlap), _FINER))
    for phase in range(_FINER):
        s, _ = stimulus(low + (np.arange(rows - 1) + phase / _FINER) * step_s)
        s = s - s.mean()
        total_s, power_s = power(s, there)
        alike = correlate(s, y, "full", "fft")[taken] - total * total_s / overlap
        both = power_y * power_s
        likeness[:, phase] = alike**2 / np.maximum(both, 1e-12 * both.max())
    curve = likeness.ravel()
    at = np.flatnonzero((curve[1:-1] > curve[:-2]) & (curve[1:-1] >= curve[2:])) + 1
    at = at[curve[at] > _LIKE]
    bend = curve[at - 1] - 2.0 * curve[at] + curve[at + 1]
    aside = 0.5 * (curve[at - 1] - curve[at + 1]) / bend
    peaks = np.minimum(curve[at] - 0.25 * (curve[at - 1] - curve[at + 1]) * aside, 1.0)
    # A parabola is off its peak by some part of the square of its bend.
    left = (1.0 - peaks) * (power_y / overlap)[at // _FINER]
    alike = left <= _AS_WELL * left.min(initial=math.inf) + 0.1 * bend**2 * (power_y / overlap)[at // _FINER]
    best = np.lexsort((np.where(alike, -overlap[at // _FINER], left), ~alike))[:_TOLD]
    # Session less file time in the middle of the rows in both, as the clocks are apart.
    middle = (here + 0.5 * overlap)[at[best] // _FINER]
    place = middle + lags[taken][0] + (at[best] + aside[best]) / _FINER
    return (low + place * step_s - first_s - (skipped + middle) * period_s).tolist()
