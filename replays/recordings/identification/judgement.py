"""What a fit is worth: intervals, what cannot be told apart, and whether the model explains the recording at all."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from replays.estimate.intervals import chi2_quantile, draw_normal, student
from replays.recordings.identification.request import Unknown
from replays.recordings.identification.window import Window

Standing = Literal["identified", "not seen", "only together", "at its bound", "not explained"]

_FITS = 0.03
"""By so much may the sum of squares a degree of freedom be above 1 beside chance: noise is not known better, ..."""
_CHANCE = 5.0
"""... and by so many of its standard deviations is chance."""
_ALONG = 2.0
"""What the model lacks may act along the unknowns by so many times what it does across them, which is seen: with a
correlation of up to 0.9 between the two."""
_NOTED = 3.0
"""What is missing is noted from so many standard deviations of the sum of squares on."""
_LEAST_ROWS = 100
"""Samples at least over which it is looked for."""
_NAMED = 0.1
"""Least part in a direction for an unknown to be named."""
_ALIKE = 0.99
"""Correlation from which two unknowns are called hard to tell apart."""
_STRETCHES = (1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 12.0)
"""By what an interval is widened, step by step, where the response bends."""
_DRAWS = 40_000
_LAGS = 20
"""How many samples apart residuals are held against each other."""


@dataclass(frozen=True)
class Finding:
    """What is known of one unknown.

    Attributes:
        unknown: It.
        value: Where the fit ended, in its unit; a result only where it stands as identified.
        half_width: Half of the 95 % interval, in its unit; inf where there is none.
        standing: What the recording tells of it.
        words: The same in words, with what it acts together with.
    """

    unknown: Unknown
    value: float
    half_width: float
    standing: Standing
    words: str


@dataclass(frozen=True)
class ChannelFit:
    """How well one channel is explained: root mean square of the residuals over the noise, and their correlation."""

    name: str
    rms: float
    correlation: float
    """Of a residual with the next one; 0 for white ones."""
    white: bool
    """Ljung and Box's test over 20 samples does not refuse it at 0.1 %."""


@dataclass(frozen=True)
class Judgement:
    """What a fit is worth.

    Attributes:
        findings: One an unknown.
        correlation: Between the identified ones, nan elsewhere, shape (unknowns, unknowns).
        singular_values: Of the Jacobian in units of the noise and of each unknown's reach, largest first.
        chi2: Sum of squares of the residuals over the noise, a degree of freedom.
        freedom: Degrees of freedom.
        together: By what the intervals must be wider so that all hold at once in 95 % of recordings.
        inflation: By what the intervals are wider than the noise alone would make them, for the largest.
        channels: How well each channel is explained.
    """

    findings: tuple[Finding, ...]
    correlation: np.ndarray
    singular_values: np.ndarray
    chi2: float
    freedom: int
    together: float
    inflation: float
    channels: tuple[ChannelFit, ...]

    @property
    def fits(self) -> bool:
        """Whether the residuals are no larger than the noise."""
        return _explained(self.chi2, self.freedom)

    @property
    def white(self) -> bool:
        """Whether the residuals are as white as the noise, in all channels but by chance one."""
        return sum(not channel.white for channel in self.channels) <= len(self.channels) // 10

    @property
    def verdict(self) -> str:
        """In a sentence."""
        if self.fits and self.white:
            return "the model explains the recording within its noise"
        if self.fits:
            coloured = ", ".join(channel.name for channel in self.channels if not channel.white)
            return f"the residuals are as small as the noise but not white ({coloured}): something small is left out"
        return f"lack of fit: the residuals are {math.sqrt(self.chi2):.3g} times the noise; no value is a result"


def judge(window: Window, z: np.ndarray, slopes: np.ndarray, residuals: np.ndarray, known: np.ndarray) -> Judgement:
    """Judge a fit by what it rests on.

    Args:
        window: The samples.
        z: Where the fit ended, in scales, shape (unknowns,).
        slopes: d predicted / d z over the noise, shape (rows, channels, unknowns).
        residuals: Measured less predicted over the noise, shape (rows, channels).
        known: Which samples count, shape (rows, channels); slopes and residuals are 0 for the others.
    """
    unknowns, observation, values = window.question.unknowns, window.question.observation, window.values(z)
    reach = np.array([unknown.reach / unknown.scale for unknown in unknowns])
    count = int(known.sum())
    _, singular, directions = np.linalg.svd(triangle_of(slopes * reach))
    freedom = max(1, count - len(unknowns))
    chi2 = float((residuals**2).sum()) / freedom
    quantile = float(student(freedom))
    unsure = _FITS if "measured" in observation.noise_from else 0.0
    spread = 1.0 + _ALONG * _misfit(residuals, known, unsure) / quantile
    seen = quantile * spread < singular  # a direction's 95 % interval is within the reach
    blind = directions[~seen].T
    part = np.linalg.norm(blind, axis=1) if blind.size else np.zeros(len(unknowns))
    alone = quantile * spread > np.linalg.norm(slopes * reach, axis=(0, 1))

    kept = directions[seen].T / singular[seen]
    plain = kept @ kept.T  # of z / reach, from the noise alone
    noise_only = np.sqrt(np.diag(plain))
    covariance = plain * spread**2
    channels = tuple(
        _channel(name, residuals[:, column], known[:, column]) for column, name in enumerate(observation.names)
    )
    if not _explained(chi2, freedom) or sum(not channel.white for channel in channels) > len(channels) // 10:
        covariance = _wider(covariance, plain @ _scores(slopes * reach, residuals) @ plain)
    stretch = _bends(window, z, covariance * np.outer(reach, reach), residuals, known, far=quantile, spread=spread)
    covariance = _with_priors(covariance * np.outer(stretch, stretch), unknowns, reach)
    deviation, inflation = np.sqrt(np.diag(covariance)), 1.0
    clear = (part < _NAMED) & ~alone & (noise_only > 0.0)
    if clear.any():
        inflation = float((deviation / np.where(clear, noise_only, np.inf)).max())

    findings = []
    for place, unknown in enumerate(unknowns):
        half = quantile * deviation[place] * unknown.reach
        finding = _finding(place, unknowns, float(values[place]), half, alone=alone, blind=blind, part=part)
        findings.append(finding if _explained(chi2, freedom) else _unexplained(finding))
    correlation = np.full(covariance.shape, np.nan)
    told = np.array([finding.standing == "identified" for finding in findings])
    both = np.outer(told, told) & (np.outer(deviation, deviation) > 0.0)
    correlation[both] = (covariance / np.where(both, np.outer(deviation, deviation), 1.0))[both]
    return Judgement(
        findings=tuple(_with_likeness(finding, place, findings, correlation) for place, finding in enumerate(findings)),
        correlation=correlation,
        singular_values=singular,
        chi2=chi2,
        freedom=freedom,
        together=_together_factor(correlation[np.ix_(told, told)]),
        inflation=inflation,
        channels=channels,
    )


def _misfit(residuals: np.ndarray, known: np.ndarray, unsure: float) -> float:
    """Size of what the model lacks, over the noise: root of what the squares have beyond chance from some row on.

    Added to the intervals as the most that the values may be off by it: bias-aware intervals, after Armstrong and
    Kolesár (Econometrica 86, 2018). What is missing acts behind an impact, so that all rows together would hide it.

    Args:
        residuals: Over the noise, shape (rows, channels).
        known: Which of them count, shape (rows, channels).
        unsure: Part by which the square of the noise is not known.
    """
    squares, counts = (part.sum(axis=1)[::-1].cumsum() for part in (residuals**2, known))
    beyond = squares - (1.0 + unsure) * counts - _NOTED * np.sqrt(2.0 * counts)
    return math.sqrt(max(0.0, float(beyond[counts >= min(_LEAST_ROWS, counts[-1])].max())))


def _unexplained(finding: Finding) -> Finding:
    """A finding where the model does not explain the samples: what would be a result is none."""
    if finding.standing in ("not seen", "only together"):
        return finding
    half = finding.half_width
    moved = f", and what is missing may have moved it by {half:.2g}" if half < math.inf else ""
    ended = _with_unit(finding.value, finding.unknown, ".6g")
    words = f"no result, as the model does not explain the samples: the fit ended at {ended}{moved}"
    return Finding(finding.unknown, finding.value, math.inf, "not explained", words)


def _explained(chi2: float, freedom: int) -> bool:
    return chi2 < 1.0 + _FITS + _CHANCE * math.sqrt(2.0 / freedom)


def _together_factor(correlation: np.ndarray) -> float:
    """Width of simultaneous 95 % intervals over that of single ones, by drawing from the normal distribution."""
    if len(correlation) < 2:
        return 1.0
    largest = np.abs(draw_normal(correlation, np.random.default_rng(0), _DRAWS)).max(axis=1)
    return max(1.0, float(np.quantile(largest, 0.95)) / 1.96)


def triangle_of(slopes: np.ndarray) -> np.ndarray:
    """The triangle R of slopes = Q R, which has all that they tell of the unknowns, shape (unknowns, unknowns)."""
    from scipy.linalg import qr

    flat = slopes.reshape(-1, slopes.shape[-1])
    return np.asarray(qr(flat, mode="r")[0])[: slopes.shape[-1]]


def blind_directions(slopes: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Directions of z / reach that the samples do not tell, shape (unknowns, directions)."""
    _, singular, directions = np.linalg.svd(triangle_of(slopes * reach))
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
        return Finding(unknown, value, math.inf, "not seen", _not_seen(unknown))
    if part[place] > _NAMED:
        return Finding(unknown, value, math.inf, "only together", _together(place, unknowns, blind))
    if min(value - unknown.low, unknown.high - value) < 1e-6 * unknown.scale:
        return Finding(unknown, value, math.inf, "at its bound", "at its bound: the interval does not hold there")
    return widened(Finding(unknown, value, half, "identified", "identified"), 0.0)


def widened(finding: Finding, by: float) -> Finding:
    """With an interval wider by so much to either side, in its unit; not seen where it leaves what was believed."""
    half = finding.half_width + by
    if finding.standing == "identified" and half > finding.unknown.reach:
        return Finding(finding.unknown, finding.value, math.inf, "not seen", _not_seen(finding.unknown))
    return replace(finding, half_width=half)


def _not_seen(unknown: Unknown) -> str:
    known = "the prior" if unknown.prior is not None else "the bounds" if unknown.bounded else "the value itself"
    return f"not seen in this window: its interval would be wider than {known}"


def _together(place: int, unknowns: tuple[Unknown, ...], blind: np.ndarray) -> str:
    """With what an unknown acts together, and how one makes up for the other."""
    direction = blind[:, int(np.argmax(np.abs(blind[place])))]
    others = [n for n in np.argsort(-np.abs(direction)) if n != place and abs(direction[n]) > _NAMED]
    if not others:
        return _not_seen(unknowns[place])
    change = 0.01 * unknowns[place].scale
    rates = [change * direction[n] * unknowns[n].reach / (direction[place] * unknowns[place].reach) for n in others]
    made_up = " and ".join(
        f"{unknowns[n].key} by {_with_unit(rate, unknowns[n])}" for n, rate in zip(others, rates, strict=True)
    )
    names = ", ".join(unknowns[n].key for n in others)
    return f"only together with {names}: a change by {_with_unit(change, unknowns[place])} is made up for by {made_up}"


def _with_unit(change: float, unknown: Unknown, form: str = "+.3g") -> str:
    return f"{change:{form}}" + ("" if unknown.unit in ("", "1") else f" {unknown.unit}")


def _with_likeness(finding: Finding, place: int, findings: list[Finding], correlation: np.ndarray) -> Finding:
    if finding.standing != "identified":
        return finding
    alike = [
        f"{findings[other].unknown.key} ({correlation[place, other]:+.4f})"
        for other in range(len(findings))
        if other != place and abs(correlation[place, other]) > _ALIKE
    ]
    if not alike:
        return finding
    words = f"identified, but hard to tell apart from {', '.join(alike)}"
    return Finding(finding.unknown, finding.value, finding.half_width, "identified", words)


def _with_priors(covariance: np.ndarray, unknowns: tuple[Unknown, ...], reach: np.ndarray) -> np.ndarray:
    """The covariance of z / reach with what the priors add."""
    given = [place for place, unknown in enumerate(unknowns) if unknown.prior is not None]
    for place in given:
        prior = unknowns[place].prior
        assert prior is not None
        column = covariance[:, place].copy()
        variance = (prior[1] / unknowns[place].scale / reach[place]) ** 2
        covariance = covariance - np.outer(column, column) / (covariance[place, place] + variance)
    return covariance


def _bends(
    window: Window,
    z: np.ndarray,
    covariance: np.ndarray,
    residuals: np.ndarray,
    known: np.ndarray,
    *,
    far: float,
    spread: float,
) -> np.ndarray:
    """By how much each interval has to be wider than a linear response makes it, shape (unknowns,).

    From the end of each interval, with the other unknowns moved along, the sum of squares must be larger by as much
    as the linear response says. Where it is not, as the response bends, the end is moved out until it is.
    """
    stretch = np.ones(len(z))
    base = float((residuals**2).sum())
    deviation = np.sqrt(np.diag(covariance))
    for place in np.flatnonzero(deviation > 0.0):
        along = covariance[:, place] / deviation[place]
        # Only as much as the noise explains: other reasons for a wider interval are in the covariance already.
        wanted = 0.5 * (far * spread) ** 2
        for sign in (-1.0, 1.0):
            for factor in _STRETCHES:
                found = window.residuals_or_none(z + sign * factor * far * along)
                if found is None or float((found[known] ** 2).sum()) - base > wanted:
                    break
                stretch[place] = max(stretch[place], _STRETCHES[min(_STRETCHES.index(factor) + 1, len(_STRETCHES) - 1)])
    return stretch


def _scores(slopes: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Covariance of the sum of slope times residual, with the residuals' own correlation in time.

    After Newey and West (Econometrica 55, 1987); shape (unknowns, unknowns).
    """
    rows = np.einsum("ncp,nc->np", slopes, residuals)
    total = rows.T @ rows
    for lag in range(1, min(_LAGS, len(rows) - 1) + 1):
        both = rows[lag:].T @ rows[:-lag]
        total += (1.0 - lag / (_LAGS + 1.0)) * (both + both.T)
    return total


def _wider(covariance: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The first, stretched where the other says more."""
    own = np.sqrt(np.diag(covariance))
    stretch = np.where(own > 0.0, np.sqrt(np.maximum(np.diag(other), 0.0)) / np.where(own > 0.0, own, 1.0), 1.0)
    return covariance * np.outer(np.maximum(stretch, 1.0), np.maximum(stretch, 1.0))


def _channel(name: str, residuals: np.ndarray, known: np.ndarray) -> ChannelFit:
    held = residuals[known]
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
