"""Runs of rows: consecutive rows that share a property, and means over blocks of rows."""

from __future__ import annotations

from itertools import pairwise

import numpy as np


def true_runs(rows: np.ndarray) -> list[tuple[int, int]]:
    """Return the begin and the end (exclusive) of each run of true rows, shape (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], rows, [False]]).astype(np.int8)))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def split_at(breaks: np.ndarray) -> list[tuple[int, int]]:
    """Return the begin and the end (exclusive) of the pieces of rows that breaks leave.

    Args:
        breaks: Whether a row does not continue the one before it, from the second row on, shape (n - 1,).
    """
    edges = [0, *(np.flatnonzero(breaks) + 1).tolist(), len(breaks) + 1]
    return list(pairwise(edges))


def block_means(values: np.ndarray, rows: int) -> np.ndarray:
    """Return means over blocks of some rows, without the rows after the last whole block, shape (n // rows,)."""
    return values[: len(values) // rows * rows].reshape(-1, rows).mean(axis=1)
