"""Crosstalk between the channels of a record: what of the others' known signals is in the residual of one."""

from __future__ import annotations

import numpy as np

from replays.estimate.intervals import bound_maximum, sandwich
from replays.estimate.least_squares import solve
from replays.score.card.scorecard import Interval

_SEPARATE = 0.01
"""Part of the power of a source that the other signals must leave: below, none of them can be told from it."""
_NOISE_DOUBT = 2.0
"""Factor up to which the power of that noise may be larger than its nominal value, as rounding without noise is."""
_BLOCKS = 64
"""Blocks of a record of which each has a mean and a slope of its own."""


def find_crosstalk(
    residual: np.ndarray, own: list[np.ndarray], sources: list[np.ndarray], noise: float, errors: np.ndarray
) -> tuple[int, Interval | None]:
    """Return the source of the worst crosstalk, and its part in the residual.

    Args:
        residual: Of a channel, shape (n,).
        own: Signals of the channel itself: known signal and slope, each shape (n,).
        sources: Known signals of the other channels, each of some power, shape (n,).
        noise: Of the channel's own known signal, which is in the residual as well, in the unit of that [rms].
        errors: What rounding may have left in the residual, shape (m, n).

    Returns:
        Number of the source, and the absolute part of its signal in the residual with its 95 % interval, simultaneous
        over the sources; None for it where that source is the same as other signals.
    """
    from scipy.signal import detrend

    # A drift is like anything slow: of each block, mean and slope are taken off.
    blocks = np.linspace(0, len(residual), _BLOCKS + 1).astype(int)[1:-1]
    left, *columns = (detrend(each, bp=blocks) for each in (residual, *sources, *own))
    sizes = np.array([max(float(np.std(each)), 1e-300) for each in columns])
    matrix = np.column_stack([each / size for each, size in zip(columns, sizes, strict=True)])
    likeness = matrix.T @ matrix / len(matrix)
    own_part = 1.0 / np.diag(np.linalg.inv(likeness + 1e-9 * np.eye(len(sizes))))[: len(sources)]
    if own_part.min() < _SEPARATE:
        return int(own_part.argmin()), None
    parts, *moved = solve(matrix, np.column_stack([left, *map(detrend, errors)])).T
    covariance, freedom = sandwich(matrix, left - matrix @ parts)
    held, own_size = slice(len(sources)), sizes[len(sources)]
    sizes, parts = sizes[held], np.abs(parts[held] / sizes[held])
    value, low, high = bound_maximum(parts, np.sqrt(np.diag(covariance)[held]) / sizes, freedom[held])
    # Noise of the own signal, which is in the residual, is in what of a source is not like that signal, too.
    likest = np.abs(likeness[held, len(sources)]) * sizes / own_size
    wrong = _NOISE_DOUBT * noise**2 * likest / (own_part * sizes**2)
    wrong += np.max(np.abs(np.reshape(moved, (-1, len(matrix.T)))[:, held]), axis=0, initial=0.0) / sizes
    return int(parts.argmax()), (value, max(0.0, low - float(wrong.max())), high + float(wrong.max()))
