"""Confidence intervals of linear fits with noise of unknown spectrum and variance, from block sums."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from replays.estimate.least_squares import column_sizes, solve

_BLOCKS = 64
_MAX_CORRELATION = 0.8
"""Upper limit of the correlation of neighbouring blocks; 64 blocks do not determine larger ones."""
_WANDER_TERMS = 12
"""Cosine terms per record that describe a slow wander; noise correlated over 1/40 of a record is not a wander."""
_MIN_WANDER_RATIO = 30.0
"""Threshold for a wander: power of the 4 slowest terms over that of the 12 terms after the first 12. First-order noise
with a correlation time of 1/60 of the record has 2 to 8, a random walk 115."""
_MAX_SLOW_SIGNAL = 0.5
"""Largest part of a fitted column that the terms may explain; a slower signal cannot be separated from a wander."""


def wander_columns(residual: np.ndarray, matrix: np.ndarray | None = None) -> np.ndarray:
    """Return cosines that describe the slow wander of a residual.

    Args:
        residual: Residual of a fit, shape (n,).
        matrix: Matrix of the fit, shape (n, k); None: there is no signal.

    Returns:
        Zero-mean cosines, shape (n, 12), or (n, 0) if the residual does not wander or the signal is as slow.
    """
    from scipy.fft import dct

    n = len(residual)
    # Sums over 256 parts contain these terms and take a tenth of the time.
    sums = np.add.reduceat(residual, np.linspace(0, n, min(256, n), endpoint=False).astype(int))
    power = np.asarray(dct(sums, norm="ortho"))[1 : 2 * _WANDER_TERMS + 1] ** 2
    if power[:4].mean() <= _MIN_WANDER_RATIO * power[_WANDER_TERMS:].mean():
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
        matrix: Matrix of the fit, shape (n, k).
        residual: Residual of the fit without a wander, shape (n,).

    Returns:
        Change of the k parameters, residual including the wander, and covariance and degrees of freedom as `sandwich`.
    """
    slow, k = wander_columns(residual, matrix), matrix.shape[1]
    if not slow.shape[1]:
        return np.zeros(k), residual, *sandwich(matrix, residual)
    both = np.column_stack([matrix, slow])
    change = solve(both, residual)
    covariance, dof = sandwich(both, residual - both @ change)
    return change[:k], residual - matrix @ change[:k], covariance[:k, :k], dof[:k]


def sandwich(matrix: np.ndarray, residual: np.ndarray, *, even: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance of a linear fit from block sums, and the degrees of freedom of each variance.

    Noise that correlates between blocks widens a variance by the correlation of neighbouring block contributions and
    reduces the degrees of freedom accordingly (Andrews & Monahan 1992, Econometrica 60). The residuals of blocks with
    high leverage are scaled up, and variances that depend on few blocks have few degrees of freedom (Bell & McCaffrey
    2002, Survey Methodology 28).

    Args:
        matrix: Matrix of the fit, shape (n, k).
        residual: Residual of the fit, shape (n,).
        even: Whether all blocks have the same noise; otherwise it is estimated per block.

    Returns:
        Covariance, shape (k, k), and degrees of freedom, shape (k,).
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
    leverage, axes = np.linalg.eigh(shares)
    lift = (axes / np.sqrt(np.maximum(1.0 - leverage, 1.0 / _BLOCKS))[:, None, :]) @ axes.transpose(0, 2, 1)
    contributions = (lift @ (scores @ white)[:, :, None])[:, :, 0] @ white.T
    # Joint variation of the blocks' contributions to each parameter, with the noise of each block or the same for all.
    noise = np.array([1.0 if even else math.sqrt(float(residual[part] @ residual[part])) for part in rows])
    lifted = np.einsum("bij,kj->kbi", lift @ shares, white)
    apart = -lifted @ lifted.transpose(0, 2, 1)
    apart[:, np.arange(_BLOCKS), np.arange(_BLOCKS)] += np.einsum("kbi,bij,kj->kb", lifted, lift, white)
    apart *= np.outer(noise, noise) / max(float(noise @ noise), 1e-300)
    squares = np.sum(apart**2, axis=(1, 2))
    dof = np.trace(apart, axis1=1, axis2=2) ** 2 / np.maximum(squares, 1e-300)
    covariance = contributions.T @ contributions
    # First-order correlation between blocks, minus its standard deviation for uncorrelated noise.
    correlation = np.sum(contributions[1:] * contributions[:-1], axis=0) / np.maximum(np.diag(covariance), 1e-300)
    correlation = np.clip(correlation - _BLOCKS**-0.5, 0.0, _MAX_CORRELATION)
    growth = (1.0 + correlation) / (1.0 - correlation)
    return covariance * np.sqrt(np.outer(growth, growth)) / np.outer(sizes, sizes), np.maximum(1.0, dof / growth)


def student(dof: ArrayLike) -> Any:
    """Return the 97.5 % quantile of Student's t for each number of degrees of freedom."""
    return student_quantile(0.975, dof)


def student_quantile(probability: float, dof: ArrayLike) -> Any:
    """Return a quantile of Student's t for each number of degrees of freedom."""
    from scipy.stats import t

    return t.ppf(probability, dof)


def chi2_quantile(probability: float, dof: float) -> float:
    """Return a quantile of chi squared."""
    from scipy.stats import chi2

    return float(chi2.ppf(probability, dof))


def chi2_mean_ends(dof: float) -> tuple[float, float]:
    """Return the 95 % interval of a mean of squares, relative to its expectation."""
    return chi2_quantile(0.025, dof) / dof, chi2_quantile(0.975, dof) / dof


def jackknife(steps: np.ndarray) -> np.ndarray:
    """Return half widths of 95 % intervals from the changes of estimates when one of n parts is left out, shape (k,).

    A model error affects some channels and times more than others. Grouped jackknife after Tukey (J. Shao and C. F. J.
    Wu, Annals of Statistics 17, 1989).

    Args:
        steps: Change of the estimates without each part, shape (n, k).
    """
    n = len(steps)
    if n < 2:
        return np.zeros(steps.shape[-1])
    deviation = np.sqrt((n - 1) / n * ((steps - steps.mean(axis=0)) ** 2).sum(axis=0))
    return student(n - 1) * deviation


def draw_normal(covariance: np.ndarray, generator: np.random.Generator, draws: int) -> np.ndarray:
    """Draw from a normal distribution of mean 0; the standard deviations may differ by a factor of 1e6.

    Args:
        covariance: Shape (k, k), with positive variances.
        generator: Random generator.
        draws: Number of draws.

    Returns:
        Samples, shape (draws, k).
    """
    size = np.sqrt(np.diag(covariance))
    powers, directions = np.linalg.eigh(covariance / np.outer(size, size))
    white = generator.standard_normal((draws, len(size)))
    return size * (white * np.sqrt(np.maximum(powers, 0.0)) @ directions.T)


def bound_maximum(values: np.ndarray, spread: np.ndarray, dof: ArrayLike = math.inf) -> tuple[float, float, float]:
    """Return the largest of several estimates with a simultaneous 95 % interval (Bonferroni): value, low, high.

    Args:
        values: Estimates, shape (n,).
        spread: Standard deviations, shape (n,).
        dof: Degrees of freedom of the standard deviations.
    """
    half = student_quantile(1.0 - 0.025 / len(values), dof) * spread
    return float(values.max()), float((values - half).max()), float((values + half).max())


def make_interval(value: float, half: float, size: float = 1.0) -> tuple[float, float, float]:
    """Return value, low and high of an interval of a half width, all multiplied by `size`."""
    return size * value, size * (value - half), size * (value + half)


def scale_interval(estimate: tuple[float, float, float], size: float) -> tuple[float, float, float]:
    """Return value, low and high of an interval, multiplied by `size`."""
    return estimate[0] * size, estimate[1] * size, estimate[2] * size


def pool_estimates(values: np.ndarray, weights: np.ndarray, *, equal_errors: bool) -> tuple[float, float]:
    """Return the weighted mean of estimates and half of its 95 % interval.

    Args:
        values: Estimates, shape (n,).
        weights: Inverse squares of the half widths of their intervals, or 0, shape (n,).
        equal_errors: True if the errors may be equal, as rounding errors are, and so do not average out.
    """
    whole = weights.sum()
    half = np.sqrt(weights).sum() / whole if equal_errors else whole**-0.5
    return float(weights @ values / whole), float(half)


def format_with_half_width(value: float, half: float) -> str:
    """Return a value and half of its interval as text, with two significant digits of the latter in both."""
    if not 1e-9 < half < 100.0:
        return f"{value:.6g} ±{half:.2g}"
    digits = 1 - math.floor(math.log10(half))
    return f"{value:.{digits}f} ±{half:.{digits}f}"
