"""Assessment of a fit: intervals, unknowns that cannot be separated, and whether the model explains the recording."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from replays.estimate.intervals import chi2_quantile, draw_normal, student
from replays.recordings.identification.request import Unknown
from replays.recordings.identification.window import Window

Standing = Literal["identified", "not seen", "only together", "at its bound", "not explained"]

_CHI2_TOLERANCE = 0.03
"""Allowed excess of the sum of squares per degree of freedom over 1, as the noise is not known better."""
MIN_CHI2 = 0.6
"""Sum of squares per degree of freedom below which the assumed noise is too large."""
_CHI2_SIGMAS = 5.0
"""Standard deviations of the sum of squares that are allowed as chance."""
_ERROR_RATIO = 2.0
"""Ratio of the assumed effect of model errors along the unknowns to the observed one across them; it corresponds to a
correlation of 0.9 between the two."""
_ERROR_SIGMAS = 3.0
"""Standard deviations of the sum of squares from which a model error is counted."""
_MIN_ROWS = 100
"""Minimum number of samples in a test for model errors."""
_MIN_PART = 0.1
"""Smallest component in a direction for an unknown to be named."""
_MAX_CORRELATION = 0.99
"""Correlation from which two unknowns are reported as hard to separate."""
_WIDENINGS = (1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 12.0)
"""Factors by which an interval is widened in turn if the response is not linear."""
_DRAWS = 40_000
_LAGS = 20
"""Largest lag of the autocorrelation of residuals [samples]."""


@dataclass(frozen=True)
class Finding:
    """Result for one unknown.

    Attributes:
        unknown: The unknown.
        value: Fitted value in its unit; a result only if it is identified.
        half_width: Half of the 95 % interval, in its unit; inf without an interval.
        standing: Status of the result.
        words: Status in words, with the unknowns that it cannot be separated from.
    """

    unknown: Unknown
    value: float
    half_width: float
    standing: Standing
    words: str


@dataclass(frozen=True)
class ChannelFit:
    """Fit of one channel: root mean square of the residuals over the noise, and their autocorrelation."""

    name: str
    rms: float
    correlation: float
    """Correlation of consecutive residuals; 0 for white ones."""
    white: bool
    """The Ljung-Box test over 20 lags does not reject whiteness at 0.1 %."""


@dataclass(frozen=True)
class Judgement:
    """Assessment of a fit.

    Attributes:
        findings: One per unknown.
        correlation: Correlation of the identified unknowns, nan elsewhere, shape (unknowns, unknowns).
        singular_values: Singular values of the Jacobian in units of the noise and of each unknown's reach, descending.
        chi2: Sum of squares of the residuals over the noise, per degree of freedom.
        dof: Degrees of freedom.
        together: Factor for simultaneous 95 % intervals.
        inflation: Largest factor by which an interval exceeds that from noise alone.
        channels: Fit of each channel.
    """

    findings: tuple[Finding, ...]
    correlation: np.ndarray
    singular_values: np.ndarray
    chi2: float
    dof: int
    together: float
    inflation: float
    channels: tuple[ChannelFit, ...]

    @property
    def fits(self) -> bool:
        """True if the residuals are no larger than the noise."""
        return _is_explained(self.chi2, self.dof)

    @property
    def white(self) -> bool:
        """True if the residuals are white, except for channels that fail by chance."""
        return sum(not channel.white for channel in self.channels) <= len(self.channels) // 10

    @property
    def verdict(self) -> str:
        """The verdict in a sentence."""
        if self.fits and self.chi2 < MIN_CHI2:
            part = math.sqrt(self.chi2)
            return (
                f"the residuals are {part:.2g} times the assumed noise, which is too large: the intervals are too wide"
            )
        if self.fits and self.white:
            return "the model explains the recording within its noise"
        if self.fits:
            coloured = ", ".join(channel.name for channel in self.channels if not channel.white)
            return f"the residuals are as small as the noise but not white ({coloured}): the model lacks a small effect"
        return f"lack of fit: the residuals are {math.sqrt(self.chi2):.3g} times the noise; no value is a result"


def judge(window: Window, z: np.ndarray, slopes: np.ndarray, residuals: np.ndarray, valid: np.ndarray) -> Judgement:
    """Judge a fit.

    Args:
        window: The samples.
        z: Fitted values in scales, shape (unknowns,).
        slopes: d predicted / d z over the noise, shape (rows, channels, unknowns).
        residuals: Measured minus predicted over the noise, shape (rows, channels).
        valid: Mask of the samples that count, shape (rows, channels); slopes and residuals are 0 for the others.
    """
    unknowns, observation, values = window.question.unknowns, window.question.observation, window.values(z)
    reach = np.array([unknown.reach / unknown.scale for unknown in unknowns])
    count = int(valid.sum())
    _, singular, directions = np.linalg.svd(triangular_factor(slopes * reach))
    dof = max(1, count - len(unknowns))
    chi2 = float((residuals**2).sum()) / dof
    quantile = float(student(dof))
    unsure = _CHI2_TOLERANCE if "measured" in observation.noise_from else 0.0
    spread = 1.0 + _ERROR_RATIO * _misfit(residuals, valid, unsure) / quantile
    observable = quantile * spread < singular  # the 95 % interval along the direction is within the reach
    blind = directions[~observable].T
    part = np.linalg.norm(blind, axis=1) if blind.size else np.zeros(len(unknowns))
    alone = quantile * spread > np.linalg.norm(slopes * reach, axis=(0, 1))

    kept = directions[observable].T / singular[observable]
    plain = kept @ kept.T  # covariance of z / reach from the noise alone
    noise_only = np.sqrt(np.diag(plain))
    covariance = plain * spread**2
    channels = tuple(
        _channel(name, residuals[:, column], valid[:, column]) for column, name in enumerate(observation.names)
    )
    if not _is_explained(chi2, dof) or sum(not channel.white for channel in channels) > len(channels) // 10:
        covariance = _max_covariance(covariance, plain @ _scores(slopes * reach, residuals) @ plain)
    stretch = _widenings(window, z, covariance * np.outer(reach, reach), residuals, valid, far=quantile, spread=spread)
    covariance = _with_priors(covariance * np.outer(stretch, stretch), unknowns, reach)
    deviation, inflation = np.sqrt(np.diag(covariance)), 1.0
    clear = (part < _MIN_PART) & ~alone & (noise_only > 0.0)
    if clear.any():
        inflation = float((deviation / np.where(clear, noise_only, np.inf)).max())

    findings = []
    for place, unknown in enumerate(unknowns):
        half = quantile * deviation[place] * unknown.reach
        finding = _finding(place, unknowns, float(values[place]), half, alone=alone, blind=blind, part=part)
        findings.append(finding if _is_explained(chi2, dof) else _drop_result(finding))
    correlation = np.full(covariance.shape, np.nan)
    identified = np.array([finding.standing == "identified" for finding in findings])
    both = np.outer(identified, identified) & (np.outer(deviation, deviation) > 0.0)
    correlation[both] = (covariance / np.where(both, np.outer(deviation, deviation), 1.0))[both]
    return Judgement(
        findings=tuple(_with_similar(finding, place, findings, correlation) for place, finding in enumerate(findings)),
        correlation=correlation,
        singular_values=singular,
        chi2=chi2,
        dof=dof,
        together=_simultaneous_factor(correlation[np.ix_(identified, identified)]),
        inflation=inflation,
        channels=channels,
    )


def _misfit(residuals: np.ndarray, valid: np.ndarray, variance_error: float) -> float:
    """Return the size of the model error over the noise: root of the excess sum of squares from the worst row on.

    It is added to the intervals as the largest possible bias: bias-aware intervals, after Armstrong and Kolesár
    (Econometrica 86, 2018). Model errors act after an impact, so a sum over all rows could hide them.

    Args:
        residuals: Residuals over the noise, shape (rows, channels).
        valid: Mask of the samples that count, shape (rows, channels).
        variance_error: Relative uncertainty of the noise variance.
    """
    squares, counts = (part.sum(axis=1)[::-1].cumsum() for part in (residuals**2, valid))
    beyond = squares - (1.0 + variance_error) * counts - _ERROR_SIGMAS * np.sqrt(2.0 * counts)
    return math.sqrt(max(0.0, float(beyond[counts >= min(_MIN_ROWS, counts[-1])].max())))


def _drop_result(finding: Finding) -> Finding:
    """Return the finding without a result, for a model that does not explain the samples."""
    if finding.standing in ("not seen", "only together"):
        return finding
    half = finding.half_width
    moved = f", and the model error may have moved it by {half:.2g}" if half < math.inf else ""
    ended = _with_unit(finding.value, finding.unknown, ".6g")
    words = f"no result, as the model does not explain the samples: the fit ended at {ended}{moved}"
    return Finding(finding.unknown, finding.value, math.inf, "not explained", words)


def _is_explained(chi2: float, dof: int) -> bool:
    return chi2 < 1.0 + _CHI2_TOLERANCE + _CHI2_SIGMAS * math.sqrt(2.0 / dof)


def _simultaneous_factor(correlation: np.ndarray) -> float:
    """Return the width of simultaneous 95 % intervals over that of single ones, by Monte Carlo."""
    if len(correlation) < 2:
        return 1.0
    largest = np.abs(draw_normal(correlation, np.random.default_rng(0), _DRAWS)).max(axis=1)
    return max(1.0, float(np.quantile(largest, 0.95)) / 1.96)


def triangular_factor(slopes: np.ndarray) -> np.ndarray:
    """Return the triangle R of slopes = Q R, which has all their information, shape (unknowns, unknowns)."""
    from scipy.linalg import qr

    flat = slopes.reshape(-1, slopes.shape[-1])
    return np.asarray(qr(flat, mode="r")[0])[: slopes.shape[-1]]


def blind_directions(slopes: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return directions of z / reach that the samples do not show, shape (unknowns, directions)."""
    _, singular, directions = np.linalg.svd(triangular_factor(slopes * reach))
    return directions[singular < 1.96].T


def _finding(
    place: int,
    unknowns: tuple[Unknown, ...],
    value: float,
    half: float,
    *,
    alone: np.ndarray,
    blind: np.ndarray,
    part: np.ndarray,
) -> Finding:
    unknown = unknowns[place]
    if alone[place]:
        return Finding(unknown, value, math.inf, "not seen", _describe_unseen(unknown))
    if part[place] > _MIN_PART:
        return Finding(unknown, value, math.inf, "only together", _describe_inseparable(place, unknowns, blind))
    if min(value - unknown.low, unknown.high - value) < 1e-6 * unknown.scale:
        return Finding(unknown, value, math.inf, "at its bound", "at its bound: no interval")
    return widen_interval(Finding(unknown, value, half, "identified", "identified"), 0.0)


def widen_interval(finding: Finding, by: float) -> Finding:
    """Return the finding with a wider interval; not seen if it exceeds the assumed one.

    Args:
        finding: The finding.
        by: Added to half of the interval, in its unit.
    """
    half = finding.half_width + by
    if finding.standing == "identified" and half > finding.unknown.reach:
        return Finding(finding.unknown, finding.value, math.inf, "not seen", _describe_unseen(finding.unknown))
    return replace(finding, half_width=half)


def _describe_unseen(unknown: Unknown) -> str:
    limit = "the prior" if unknown.prior is not None else "the bounds" if unknown.bounded else "the value itself"
    return f"not seen in this window: its interval would be wider than {limit}"


def _describe_inseparable(place: int, unknowns: tuple[Unknown, ...], blind: np.ndarray) -> str:
    """Return the unknowns that one cannot be separated from, and the changes that compensate each other."""
    direction = blind[:, int(np.argmax(np.abs(blind[place])))]
    others = [n for n in np.argsort(-np.abs(direction)) if n != place and abs(direction[n]) > _MIN_PART]
    if not others:
        return _describe_unseen(unknowns[place])
    change = 0.01 * unknowns[place].scale
    rates = [change * direction[n] * unknowns[n].reach / (direction[place] * unknowns[place].reach) for n in others]
    compensation = " and ".join(
        f"{unknowns[n].key} by {_with_unit(rate, unknowns[n])}" for n, rate in zip(others, rates, strict=True)
    )
    names = ", ".join(unknowns[n].key for n in others)
    return f"only together with {names}: {_with_unit(change, unknowns[place])} is compensated by {compensation}"


def _with_unit(change: float, unknown: Unknown, form: str = "+.3g") -> str:
    return f"{change:{form}}" + ("" if unknown.unit in ("", "1") else f" {unknown.unit}")


def _with_similar(finding: Finding, place: int, findings: list[Finding], correlation: np.ndarray) -> Finding:
    if finding.standing != "identified":
        return finding
    alike = [
        f"{findings[other].unknown.key} ({correlation[place, other]:+.4f})"
        for other in range(len(findings))
        if other != place and abs(correlation[place, other]) > _MAX_CORRELATION
    ]
    if not alike:
        return finding
    words = f"identified, but hard to separate from {', '.join(alike)}"
    return Finding(finding.unknown, finding.value, finding.half_width, "identified", words)


def _with_priors(covariance: np.ndarray, unknowns: tuple[Unknown, ...], reach: np.ndarray) -> np.ndarray:
    """Return the covariance of z / reach with the priors added."""
    places = [place for place, unknown in enumerate(unknowns) if unknown.prior is not None]
    for place in places:
        prior = unknowns[place].prior
        assert prior is not None
        column = covariance[:, place].copy()
        variance = (prior[1] / unknowns[place].scale / reach[place]) ** 2
        covariance = covariance - np.outer(column, column) / (covariance[place, place] + variance)
    return covariance


def _widenings(
    window: Window,
    z: np.ndarray,
    covariance: np.ndarray,
    residuals: np.ndarray,
    valid: np.ndarray,
    *,
    far: float,
    spread: float,
) -> np.ndarray:
    """Return the factor by which each interval has to be wider than for a linear response, shape (unknowns,).

    At the end of an interval, with the other unknowns adjusted, the sum of squares must have grown as for a linear
    response. If it has not, the end is moved outward until it has.
    """
    stretch = np.ones(len(z))
    base = float((residuals**2).sum())
    deviation = np.sqrt(np.diag(covariance))
    for place in np.flatnonzero(deviation > 0.0):
        along = covariance[:, place] / deviation[place]
        # Only the part from noise: other causes of a wider interval are in the covariance already.
        wanted = 0.5 * (far * spread) ** 2
        for sign in (-1.0, 1.0):
            for factor in _WIDENINGS:
                moved = window.residuals_or_none(z + sign * factor * far * along)
                if moved is None or float((moved[valid] ** 2).sum()) - base > wanted:
                    break
                stretch[place] = max(stretch[place], _WIDENINGS[min(_WIDENINGS.index(factor) + 1, len(_WIDENINGS) - 1)])
    return stretch


def _scores(slopes: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Return the covariance of the sum of slope times residual, with the autocorrelation of the residuals.

    After Newey and West (Econometrica 55, 1987); shape (unknowns, unknowns).
    """
    rows = np.einsum("ncp,nc->np", slopes, residuals)
    total = rows.T @ rows
    for lag in range(1, min(_LAGS, len(rows) - 1) + 1):
        both = rows[lag:].T @ rows[:-lag]
        total += (1.0 - lag / (_LAGS + 1.0)) * (both + both.T)
    return total


def _max_covariance(covariance: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return a covariance, widened where the other one has a larger variance."""
    own = np.sqrt(np.diag(covariance))
    stretch = np.where(own > 0.0, np.sqrt(np.maximum(np.diag(other), 0.0)) / np.where(own > 0.0, own, 1.0), 1.0)
    return covariance * np.outer(np.maximum(stretch, 1.0), np.maximum(stretch, 1.0))


def _channel(name: str, residuals: np.ndarray, valid: np.ndarray) -> ChannelFit:
    held = residuals[valid]
    if len(held) < 2 * _LAGS or not held.any():
        return ChannelFit(name, float(np.sqrt(np.mean(held**2))) if len(held) else 0.0, 0.0, white=True)
    centred = held - held.mean()
    power = float(centred @ centred)
    lags = np.arange(1, _LAGS + 1)
    correlations = np.array([float(centred[lag:] @ centred[:-lag]) / power for lag in lags]) if power else 0.0 * lags
    statistic = len(held) * (len(held) + 2.0) * float((correlations**2 / (len(held) - lags)).sum())
    return ChannelFit(
        name, float(np.sqrt(np.mean(held**2))), float(correlations[0]), white=statistic < chi2_quantile(0.999, _LAGS)
    )
