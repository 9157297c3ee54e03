"""Intervals of linear fits whose noise may have any colour and strength: by blocks, with honest degrees of freedom."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

_BLOCKS = 64


def sandwich(matrix: np.ndarray, residual: np.ndarray, *, even: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of a linear fit by blocks, and the degrees of freedom of each variance.

    A block that has more say in the fit leaves less of its own noise: each is lifted by the root of what it leaves, and
    variances of which few blocks decide have few degrees of freedom (Bell & McCaffrey 2002, Survey Methodology 28).
    """
    edges = np.linspace(0, len(residual), _BLOCKS + 1).astype(int)
    rows = [slice(*ends) for ends in pairwise(edges)]
    grams = np.array([matrix[part].T @ matrix[part] for part in rows])
    scores = np.array([matrix[part].T @ residual[part] for part in rows])
    sizes, turn = np.linalg.eigh(grams.sum(axis=0))
    white = turn * np.where(sizes > 1e-14 * sizes[-1], np.maximum(sizes, 1e-300) ** -0.5, 0.0)
    shares = white.T @ grams @ white
    say, axes = np.linalg.eigh(shares)
    lift = (axes / np.sqrt(np.maximum(1.0 - say, 1.0 / _BLOCKS))[:, None, :]) @ axes.transpose(0, 2, 1)
    pulls = (lift @ (scores @ white)[:, :, None])[:, :, 0] @ white.T
    # Of each parameter, how the blocks' pulls vary together, each with the noise that it has, or all with the same.
    noise = np.array([1.0 if even else math.sqrt(float(residual[part] @ residual[part])) for part in rows])
    lifted = np.einsum("bij,kj->kbi", lift @ shares, white)
    apart = -lifted @ lifted.transpose(0, 2, 1)
    apart[:, np.arange(_BLOCKS), np.arange(_BLOCKS)] += np.einsum("kbi,bij,kj->kb", lifted, lift, white)
    apart *= np.outer(noise, noise) / max(float(noise @ noise), 1e-300)
    squares = np.sum(apart**2, axis=(1, 2))
    freedom = np.trace(apart, axis1=1, axis2=2) ** 2 / np.maximum(squares, 1e-300)
    return pulls.T @ pulls, np.maximum(1.0, freedom)


def student(freedom: ArrayLike) -> Any:
    """The 97.5 % quantile of Student's t, one for each number of degrees of freedom."""
    from scipy.stats import t

    return t.ppf(0.975, freedom)


def simultaneous(values: np.ndarray, spread: np.ndarray, freedom: ArrayLike = math.inf) -> tuple[float, float, float]:
    """Return the largest of some estimates with a 95 % interval that holds for all of them at once (Bonferroni).

    Args:
        values: The estimates, shape (n,).
        spread: Their standard deviations, shape (n,).
        freedom: Degrees of freedom of these.
    """
    from scipy.stats import t

    half = t.ppf(1.0 - 0.025 / len(values), freedom) * spread
    return float(values.max()), float((values - half).max()), float((values + half).max())
