"""Least squares over channels weighted by their own residuals, so that a faulty channel has little influence.

The cost is the sum over channels of the logarithm of the mean square residual. It is minimised by iteratively
reweighted least squares, in which the majority of the channels prevails.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from replays.estimate.intervals import jackknife
from replays.estimate.least_squares import solve_normal
from replays.recordings.resimulation.prediction import Measured
from replays.recordings.resimulation.sensitivity import Predictor
from rig.base.errors import InputError, SimulationError

MAX_PRIOR_DEVIATION = 5.0
"""Limit of a value's distance from its prior, in standard deviations; a value at the limit is a finding."""
_MAX_REWEIGHTINGS = 12
"""Iterations of reweighted least squares, enough for the channel weights to converge."""
_MIN_GAIN = 1.0
"""Minimum gain of a step; the cost itself varies by about 1 with the noise."""
_STEP_FRACTIONS = (1.0, 0.3, 0.1, 0.03)
"""Fractions of a step that are tried in turn until the cost decreases."""
_DAMPINGS = (0.0, 1e-4, 1e-2)
"""Dampings of the step, relative to the curvature along each value, that are tried in turn."""
_MAX_STEPS = 8
_LONG_BLOCK_S, _SHORT_BLOCK_S = 0.1, 0.004
"""Length of jackknife blocks before the hammer pulse and from it on [s]."""
_RESTART_FACTORS = (0.8, 0.9, 0.95, 1.05, 1.1, 1.25)
"""Start values of a new search, relative to the previous start, for values that showed no effect before."""


def solve_weighted(
    target: list[np.ndarray],
    columns: list[np.ndarray],
    scales: list[float],
    priors: tuple[np.ndarray, np.ndarray] | None = None,
    enabled: Sequence[bool] | None = None,
) -> np.ndarray:
    """Return the least-squares solution over channels weighted by their own residuals, shape (unknowns,).

    Args:
        target: Samples of each channel over its noise, shape (n,).
        columns: Slopes of each channel over its noise, shape (n, unknowns).
        scales: Initial inverse weight of each channel, for example its signal size, so that all start equal.
        priors: Means and standard deviations of the priors.
        enabled: Channels that are used; None: all.
    """
    weights = [1.0 if one else 0.0 for one in enabled or [True] * len(target)]
    grams = [has * (one.T @ one) for one, has in zip(columns, weights, strict=True)]
    sides = [has * (one.T @ z) for one, z, has in zip(columns, target, weights, strict=True)]
    solution = np.zeros(columns[0].shape[1])
    for _ in range(_MAX_REWEIGHTINGS):
        square = sum(gram / scale**2 for gram, scale in zip(grams, scales, strict=True))
        side = sum(one / scale**2 for one, scale in zip(sides, scales, strict=True))
        if priors is not None:
            square, side = square + np.diag(priors[1] ** -2.0), side + priors[0] * priors[1] ** -2.0
        solution = solve_normal(np.asarray(square), np.asarray(side))
        scales = [max(1.0, rms(z - a @ solution)) for z, a in zip(target, columns, strict=True)]
    return solution


def signal_sizes(parts: Mapping[str, Measured]) -> list[float]:
    """Return the standard deviation of each channel over its noise, at least 1."""
    shown = split_channels(parts, {name: part.values for name, part in parts.items()})
    return [max(1.0, float(values.std()) / floor) for values, floor in shown]


def rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return math.sqrt(float(values @ values) / len(values))


def split_channels(parts: Mapping[str, Measured], values: Mapping[str, np.ndarray]) -> list[tuple[np.ndarray, float]]:
    """Return values, shape (n,), and noise of each channel."""
    return [
        (values[name][:, c], float(part.floor[c])) for name, part in parts.items() for c in range(len(part.channels))
    ]


def subtract_mean(values: np.ndarray) -> np.ndarray:
    """Return values without the mean of each column."""
    return values - values.mean(axis=0)


@dataclass(frozen=True)
class ChannelState:
    """Channels at given values: residuals over the noise, each shape (n,), and slopes, (n, unknowns)."""

    apart: list[np.ndarray]
    slopes: list[np.ndarray]

    def cost(self, off: np.ndarray, enabled: Sequence[bool]) -> float:
        """Return the cost of these residuals and of values this many standard deviations from their priors."""
        apart = [z for z, has in zip(self.apart, enabled, strict=True) if has]
        agreement = sum(len(z) * math.log(1.0 + float(z @ z) / len(z)) for z in apart)
        return agreement + float(off @ off)


def approach(
    predictor: Predictor,
    values: np.ndarray,
    priors: np.ndarray,
    *,
    by_residuals: bool,
    enabled: Sequence[bool],
    steps: int = _MAX_STEPS,
) -> tuple[np.ndarray, ChannelState]:
    """Search values near a start on which most channels agree.

    Args:
        predictor: Predictor of the channels.
        values: Start of the search, shape (keys,).
        priors: Means and standard deviations of the priors, shape (2, keys).
        by_residuals: True: channels are weighted by their residuals from the first step on; False: by their signals.
        enabled: Channels that are used.
        steps: Largest number of steps.

    Returns:
        The values, and the channels at them.
    """
    means, deviations = priors
    low, high = means - MAX_PRIOR_DEVIATION * deviations, means + MAX_PRIOR_DEVIATION * deviations
    here = evaluate(predictor, values)
    assert here is not None
    for _ in range(steps):
        slopes = [
            {name: predictor.parts[name].whiten(slope) for name, slope in one.items()}
            for one in predictor.derivatives(values).slopes
        ]
        by_key = [[one / floor for one, floor in split_channels(predictor.parts, slope)] for slope in slopes]
        here = ChannelState(here.apart, [np.column_stack(columns) for columns in zip(*by_key, strict=True)])
        channel_weights = [max(1.0, rms(z)) for z in here.apart] if by_residuals else signal_sizes(predictor.parts)
        cost = here.cost((values - means) / deviations, enabled)
        for step in _list_steps(here, channel_weights, (means - values, deviations), enabled):
            moved = np.clip(values + step, low, high)
            ahead = evaluate(predictor, moved)
            gained = 0.0 if ahead is None else cost - ahead.cost((moved - means) / deviations, enabled)
            if ahead is not None and gained > 0.0:
                break
        else:
            break
        values, here = moved, ChannelState(ahead.apart, here.slopes)
        if gained < _MIN_GAIN:
            break
    return values, here


def _list_steps(
    here: ChannelState, channel_weights: list[float], priors: tuple[np.ndarray, np.ndarray], enabled: Sequence[bool]
) -> Iterator[np.ndarray]:
    """Yield the steps to try: fractions of the full one, then damped ones, each shape (keys,).

    A small error of a slope turns the full step around where values nearly cancel, as force and length of a pulse do.
    """
    off, deviations = priors
    curvature = sum(np.sum(a**2, axis=0) / max(1.0, rms(z)) ** 2 for z, a in zip(here.apart, here.slopes, strict=True))
    for damping in _DAMPINGS:
        precision = deviations**-2.0 + damping * curvature
        held = off * deviations**-2.0 / precision, precision**-0.5
        step = solve_weighted(here.apart, here.slopes, channel_weights, held, enabled)
        yield from (part * step for part in (_STEP_FRACTIONS if damping == 0.0 else _STEP_FRACTIONS[:1]))


def evaluate(predictor: Predictor, values: np.ndarray) -> ChannelState | None:
    """Return the channels at given values; None if the model rejects the values."""
    try:
        predicted = predictor.predict(values).values
    except (InputError, SimulationError):
        return None
    apart = {name: part.whiten(part.values - predicted[name]) for name, part in predictor.parts.items()}
    return ChannelState([one / floor for one, floor in split_channels(predictor.parts, apart)], [])


def search_restarts(predictor: Predictor, values: np.ndarray, places: list[int], enabled: Sequence[bool]) -> np.ndarray:
    """Return values with some of them replaced by better ones from a coarse search, beyond the reach of slopes.

    Args:
        predictor: Predictor of the channels.
        values: End of a search, shape (keys,).
        places: Indices of the values to search, one after the other.
        enabled: Channels that are used.
    """

    def cost(one: np.ndarray) -> float:
        here = evaluate(predictor, one)
        return math.inf if here is None else here.cost(np.zeros(1), enabled)

    best = cost(values), values
    for place in places:
        candidates = [best]
        for part in _RESTART_FACTORS:
            (moved := best[1].copy())[place] = part * values[place]
            candidates.append((cost(moved), moved))
        best = min(candidates, key=lambda one: one[0])
    return best[1]


def jackknife_blocks(times_s: np.ndarray, first_s: float) -> np.ndarray:
    """Return the jackknife block of each sample, shape (n,): long blocks before the hammer pulse, short ones after."""
    return np.floor((times_s - first_s) / np.where(times_s < first_s, _LONG_BLOCK_S, _SHORT_BLOCK_S)).astype(int)


def jackknife_half_widths(
    here: ChannelState,
    times_s: Sequence[np.ndarray],
    scales: Sequence[float],
    prior: tuple[np.ndarray, np.ndarray],
    first_s: float,
) -> np.ndarray:
    """Return half of 95 % intervals by a jackknife over channels and over blocks of time.

    Args:
        here: Channels at the values.
        times_s: Sample times of each channel [s], shape (n,).
        scales: Inverse weight of each channel.
        prior: Prior terms of the normal equations, shapes (unknowns, unknowns) and (unknowns,).
        first_s: Time of the hammer pulse [s].

    Returns:
        Shape (unknowns,).
    """
    pieces = []
    for c, (z, a, scale) in enumerate(zip(here.apart, here.slopes, scales, strict=True)):
        number = jackknife_blocks(times_s[c], first_s)
        for one in np.unique(number):
            rows = number == one
            pieces.append((c, int(one), a[rows].T @ a[rows] / scale**2, a[rows].T @ z[rows] / scale**2))

    def step(place: int, one: int) -> np.ndarray:
        kept = [piece for piece in pieces if piece[place] != one]
        return solve_normal(prior[0] + sum(piece[2] for piece in kept), prior[1] + sum(piece[3] for piece in kept))

    return np.max(
        [jackknife(np.array([step(place, one) for one in {piece[place] for piece in pieces}])) for place in (0, 1)],
        axis=0,
    )
