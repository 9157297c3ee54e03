"""Runs of rows: consecutive rows with a common property, and means over blocks of rows."""

from __future__ import annotations

from itertools import pairwise

import numpy as np


def find_true_runs(rows: np.ndarray) -> list[tuple[int, int]]:
    """Return begin and end (exclusive) of each run of true elements of `rows`, shape (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], rows, [False]]).astype(np.int8)))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def split_at_breaks(breaks: np.ndarray) -> list[tuple[int, int]]:
    """Return begin and end (exclusive) of the pieces of rows between breaks.

    Args:
        breaks: Whether a row does not continue the previous one, from the second row on, shape (n - 1,).
    """
    edges = [0, *(np.flatnonzero(breaks) + 1).tolist(), len(breaks) + 1]
    return list(pairwise(edges))


def block_means(values: np.ndarray, rows: int) -> np.ndarray:
    """Return means over blocks of `rows` rows, without an incomplete last block, shape (n // rows,)."""
    return values[: len(values) // rows * rows].reshape(-1, rows).mean(axis=1)
