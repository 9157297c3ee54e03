"""Crosstalk between the channels of a record: components of the others' known signals in a channel's residual."""

from __future__ import annotations

import numpy as np

from replays.estimate.intervals import bound_maximum, sandwich
from replays.estimate.least_squares import solve
from replays.score.card.scorecard import Interval

_MIN_SEPARATE_PART = 0.01
"""Part of a source's power that must be independent of the other signals for the source to be identified."""
_NOISE_FACTOR = 2.0
"""Largest power of the noise over its nominal value, as of rounding without dither."""
_BLOCKS = 64
"""Blocks of a record with separate mean and slope."""


def find_crosstalk(
    residual: np.ndarray, own: list[np.ndarray], sources: list[np.ndarray], noise: float, errors: np.ndarray
) -> tuple[int, Interval | None]:
    """Return the source of the worst crosstalk, and its part in the residual.

    Args:
        residual: Residual of a channel, shape (n,).
        own: Signals of the channel itself: known signal and slope, each shape (n,).
        sources: Known signals of the other channels, none constant, shape (n,).
        noise: Noise of the channel's known signal, which is in the residual as well, in its unit [rms].
        errors: Possible errors of rounding in the residual, shape (m, n).

    Returns:
        Number of the source, and the absolute part of its signal in the residual with its 95 % interval, simultaneous
        over the sources; None for the latter if that source equals other signals.
    """
    from scipy.signal import detrend

    # A drift correlates with any slow signal: mean and slope of each block are removed.
    blocks = np.linspace(0, len(residual), _BLOCKS + 1).astype(int)[1:-1]
    detrended, *columns = (detrend(each, bp=blocks) for each in (residual, *sources, *own))
    sizes = np.array([max(float(np.std(each)), 1e-300) for each in columns])
    matrix = np.column_stack([each / size for each, size in zip(columns, sizes, strict=True)])
    likeness = matrix.T @ matrix / len(matrix)
    own_part = 1.0 / np.diag(np.linalg.inv(likeness + 1e-9 * np.eye(len(sizes))))[: len(sources)]
    if own_part.min() < _MIN_SEPARATE_PART:
        return int(own_part.argmin()), None
    parts, *moved = solve(matrix, np.column_stack([detrended, *map(detrend, errors)])).T
    covariance, dof = sandwich(matrix, detrended - matrix @ parts)
    held, own_size = slice(len(sources)), sizes[len(sources)]
    sizes, parts = sizes[held], np.abs(parts[held] / sizes[held])
    value, low, high = bound_maximum(parts, np.sqrt(np.diag(covariance)[held]) / sizes, dof[held])
    # Noise of the channel's own signal in the residual correlates with the part of a source that differs from it.
    likest = np.abs(likeness[held, len(sources)]) * sizes / own_size
    wrong = _NOISE_FACTOR * noise**2 * likest / (own_part * sizes**2)
    wrong += np.max(np.abs(np.reshape(moved, (-1, len(matrix.T)))[:, held]), axis=0, initial=0.0) / sizes
    return int(parts.argmax()), (value, max(0.0, low - float(wrong.max())), high + float(wrong.max()))
