"""Intervals of linear fits whose noise may have any colour and strength: by blocks, with honest degrees of freedom."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from replays.estimate.least_squares import column_sizes, solve

_BLOCKS = 64
_MAX_FOLLOW = 0.8
"""Correlation of neighbouring blocks, at most: from 64 blocks a larger one is not known."""
_WANDER_TERMS = 12
"""Half periods a record, up to which a wander is fitted: noise that correlates over 1/40 of a record is no wander."""
_MIN_WANDER = 30.0
"""Power of the 4 slowest terms over that of the next 12 after these 12, from which a residual wanders: noise of first
order whose correlation time is 1/60 of the record has 2 to 8, a random walk 115."""
_MAX_SLOW_SIGNAL = 0.5
"""Part of a fitted column that the terms of a wander may explain: a signal as slow is not told from one."""


def wander_columns(residual: np.ndarray, matrix: np.ndarray | None = None) -> np.ndarray:
    """Return cosines that describe the slow wander of a residual.

    Args:
        residual: Of a fit, shape (n,).
        matrix: Of the fit, shape (n, k); None: there is no signal.

    Returns:
        Cosines without a mean, shape (n, 12), or (n, 0) where the residual does not wander or the signal is as slow.
    """
    from scipy.fft import dct

    n = len(residual)
    # Sums over 256 parts show these terms as well, in a tenth of the time.
    sums = np.add.reduceat(residual, np.linspace(0, n, min(256, n), endpoint=False).astype(int))
    power = np.asarray(dct(sums, norm="ortho"))[1 : 2 * _WANDER_TERMS + 1] ** 2
    if power[:4].mean() <= _MIN_WANDER * power[_WANDER_TERMS:].mean():
        return np.empty((n, 0))
    columns = np.cos(np.pi / n * np.outer(np.arange(n) + 0.5, np.arange(1, _WANDER_TERMS + 1)))
    if matrix is not None:
        explained = 2.0 / n * np.sum((columns.T @ matrix) ** 2, axis=0)
        if np.any(explained > _MAX_SLOW_SIGNAL * np.sum(matrix**2, axis=0)):
            return np.empty((n, 0))
    return columns


def refine(matrix: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Fit a wander together with the columns of a linear fit.

    Args:
        matrix: Of the fit, shape (n, k).
        residual: Of the fit without a wander, shape (n,).

    Returns:
        Change of the k parameters, residual with the wander in it, and covariance and degrees of freedom as `sandwich`.
    """
    slow, k = wander_columns(residual, matrix), matrix.shape[1]
    if not slow.shape[1]:
        return np.zeros(k), residual, *sandwich(matrix, residual)
    both = np.column_stack([matrix, slow])
    change = solve(both, residual)
    covariance, freedom = sandwich(both, residual - both @ change)
    return change[:k], residual - matrix @ change[:k], covariance[:k, :k], freedom[:k]


def sandwich(matrix: np.ndarray, residual: np.ndarray, *, even: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of a linear fit by blocks, and the degrees of freedom of each variance.

    Noise that correlates from block to block widens a parameter's variance by the correlation of its neighbouring pulls
    (Andrews & Monahan 1992, Econometrica 60), with as many fewer degrees of freedom.
    A block that has more say in the fit leaves less of its own noise: each is lifted by the root of what it leaves, and
    variances of which few blocks decide have few degrees of freedom (Bell & McCaffrey 2002, Survey Methodology 28).
    """
    sizes = column_sizes(matrix)
    matrix = matrix / sizes
    edges = np.linspace(0, len(residual), _BLOCKS + 1).astype(int)
    rows = [slice(*ends) for ends in pairwise(edges)]
    grams = np.array([matrix[part].T @ matrix[part] for part in rows])
    scores = np.array([matrix[part].T @ residual[part] for part in rows])
    powers, turn = np.linalg.eigh(grams.sum(axis=0))
    white = turn * np.where(powers > 1e-14 * powers[-1], np.maximum(powers, 1e-300) ** -0.5, 0.0)
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
    covariance = pulls.T @ pulls
    # Of first order from block to block, less the standard deviation that it has without any.
    follow = np.sum(pulls[1:] * pulls[:-1], axis=0) / np.maximum(np.diag(covariance), 1e-300)
    follow = np.clip(follow - _BLOCKS**-0.5, 0.0, _MAX_FOLLOW)
    growth = (1.0 + follow) / (1.0 - follow)
    return covariance * np.sqrt(np.outer(growth, growth)) / np.outer(sizes, sizes), np.maximum(1.0, freedom / growth)


def student(freedom: ArrayLike) -> Any:
    """The 97.5 % quantile of Student's t, one for each number of degrees of freedom."""
    return student_quantile(0.975, freedom)


def student_quantile(probability: float, freedom: ArrayLike) -> Any:
    """Return a quantile of Student's t, one for each number of degrees of freedom."""
    from scipy.stats import t

    return t.ppf(probability, freedom)


def chi2_quantile(probability: float, freedom: float) -> float:
    """Return a quantile of chi squared."""
    from scipy.stats import chi2

    return float(chi2.ppf(probability, freedom))


def chi2_mean_ends(freedom: float) -> tuple[float, float]:
    """Return the ends of the 95 % interval of a mean of squares, over its expectation."""
    return chi2_quantile(0.025, freedom) / freedom, chi2_quantile(0.975, freedom) / freedom


def jackknife(steps: np.ndarray) -> np.ndarray:
    """Return half of the 95 % intervals by how far estimates go without one of n parts of the samples, shape (k,).

    What a model lacks acts on some channels and at some times more than on others. Tukey's jackknife with groups left
    out (J. Shao and C. F. J. Wu, Annals of Statistics 17, 1989).

    Args:
        steps: By how much the estimates change without each part, shape (n, k).
    """
    n = len(steps)
    if n < 2:
        return np.zeros(steps.shape[-1])
    deviation = np.sqrt((n - 1) / n * ((steps - steps.mean(axis=0)) ** 2).sum(axis=0))
    return student(n - 1) * deviation


def draw_normal(covariance: np.ndarray, generator: np.random.Generator, draws: int) -> np.ndarray:
    """Draw from a normal distribution of mean 0, shape (draws, k); a covariance may have sizes a million apart.

    Args:
        covariance: Shape (k, k), with no variance of 0.
        generator: Source of the draws.
        draws: Number of draws.
    """
    size = np.sqrt(np.diag(covariance))
    powers, directions = np.linalg.eigh(covariance / np.outer(size, size))
    white = generator.standard_normal((draws, len(size)))
    return size * (white * np.sqrt(np.maximum(powers, 0.0)) @ directions.T)


def simultaneous(values: np.ndarray, spread: np.ndarray, freedom: ArrayLike = math.inf) -> tuple[float, float, float]:
    """Return the largest of some estimates with a 95 % interval that holds for all of them at once (Bonferroni).

    Args:
        values: The estimates, shape (n,).
        spread: Their standard deviations, shape (n,).
        freedom: Degrees of freedom of these.
    """
    half = student_quantile(1.0 - 0.025 / len(values), freedom) * spread
    return float(values.max()), float((values - half).max()), float((values + half).max())


def about(value: float, half: float, size: float = 1.0) -> tuple[float, float, float]:
    """Return a value and its interval of a half width, in a unit of which they hold `size`."""
    return size * value, size * (value - half), size * (value + half)


def scaled(estimate: tuple[float, float, float], size: float) -> tuple[float, float, float]:
    """Return a value and its interval in a unit of which they hold `size`."""
    return estimate[0] * size, estimate[1] * size, estimate[2] * size


def pooled(values: np.ndarray, weights: np.ndarray, *, alike: bool) -> tuple[float, float]:
    """Return the weighted mean of estimates and half of its 95 % interval.

    Args:
        values: The estimates, shape (n,).
        weights: One over the square of half of each one's interval, or 0, shape (n,).
        alike: Whether their errors may be alike, as those of rounding are: these do not average out.
    """
    whole = weights.sum()
    half = np.sqrt(weights).sum() / whole if alike else whole**-0.5
    return float(weights @ values / whole), float(half)
