"""Least squares over channels that count by what they leave themselves: one that is faulty does not turn the others.

With what a channel leaves as its own measure, the sum over channels of the logarithm of that is made small, by least
squares whose weights follow. Most channels together say what holds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from replays.estimate.intervals import jackknife
from replays.estimate.least_squares import solve_normal
from replays.recordings.resimulation.prediction import Measured
from replays.recordings.resimulation.sensitivity import Predictor
from rig.base.errors import InputError, SimulationError

BEYOND = 5.0
"""A value that many standard deviations from what is known of it is a finding, and no fit goes further."""
_AGREED = 12
"""Rounds of least squares until the channels' say is settled."""
_SAME = 1.0
"""A step that gains less, of a number that noise changes by some, is the last."""
_PARTS = (1.0, 0.3, 0.1, 0.03)
"""Parts of a step that are tried in turn, until one gains."""
_ROUNDS = 8
_LONG_S, _SHORT_S = 0.1, 0.004
"""Length of the stretches that are left out, before the hammer pulse and from it on [s]."""
_ELSEWHERE = (0.8, 0.9, 0.95, 1.05, 1.1, 1.25)
"""Where a search begins anew for what was not seen before a window that is given up, as parts of where it began."""


def by_agreement(
    target: list[np.ndarray],
    columns: list[np.ndarray],
    scales: list[float],
    held: tuple[np.ndarray, np.ndarray] | None = None,
    heard: Sequence[bool] | None = None,
) -> np.ndarray:
    """Least squares over channels that count by what they leave themselves, shape (unknowns,).

    Args:
        target: Of each channel, over its noise, shape (n,).
        columns: The same of each unknown, shape (n, unknowns).
        scales: By what each counts less at first: of all that it shows, so that none is right from the start.
        held: What is known of the unknowns before: means and standard deviations.
        heard: Which channels have a say at all; None: each.
    """
    asked = [1.0 if one else 0.0 for one in heard or [True] * len(target)]
    grams = [has * (one.T @ one) for one, has in zip(columns, asked, strict=True)]
    sides = [has * (one.T @ z) for one, z, has in zip(columns, target, asked, strict=True)]
    found = np.zeros(columns[0].shape[1])
    for _ in range(_AGREED):
        square = sum(gram / scale**2 for gram, scale in zip(grams, scales, strict=True))
        side = sum(one / scale**2 for one, scale in zip(sides, scales, strict=True))
        if held is not None:
            square, side = square + np.diag(held[1] ** -2.0), side + held[0] * held[1] ** -2.0
        found = solve_normal(np.asarray(square), np.asarray(side))
        scales = [max(1.0, rms(z - a @ found)) for z, a in zip(target, columns, strict=True)]
    return found


def signals_of(parts: Mapping[str, Measured]) -> list[float]:
    """How much each channel shows, over its noise."""
    shown = channels_of(parts, {name: part.values for name, part in parts.items()})
    return [max(1.0, float(values.std()) / floor) for values, floor in shown]


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return math.sqrt(float(values @ values) / len(values))


def channels_of(parts: Mapping[str, Measured], values: Mapping[str, np.ndarray]) -> list[tuple[np.ndarray, float]]:
    """Values of each channel, shape (n,), and its noise."""
    return [
        (values[name][:, c], float(part.floor[c])) for name, part in parts.items() for c in range(len(part.channels))
    ]


def centred(values: np.ndarray) -> np.ndarray:
    """Without the mean of each column."""
    return values - values.mean(axis=0)


@dataclass(frozen=True)
class Here:
    """Channels at some values: measured less predicted over the noise, each shape (n,); with slopes, (n, unknowns)."""

    apart: list[np.ndarray]
    slopes: list[np.ndarray]

    def cost(self, off: np.ndarray, heard: Sequence[bool]) -> float:
        """What values are worth that leave this, and are so many standard deviations off what is known of them."""
        apart = [z for z, has in zip(self.apart, heard, strict=True) if has]
        agreement = sum(len(z) * math.log(1.0 + float(z @ z) / len(z)) for z in apart)
        return agreement + float(off @ off)


def approach(
    predictor: Predictor, values: np.ndarray, known: np.ndarray, *, trusting: bool, heard: Sequence[bool]
) -> tuple[np.ndarray, Here]:
    """Values near some others at which most channels agree, and how the channels are there.

    Args:
        predictor: Of the channels.
        values: Where the search begins, shape (keys,).
        known: Means and standard deviations of the values before, shape (2, keys).
        trusting: Whether channels count by what they leave from the start on.
        heard: Which channels have a say.
    """
    means, deviations = known
    low, high = means - BEYOND * deviations, means + BEYOND * deviations
    here = look(predictor, values)
    assert here is not None
    for _ in range(_ROUNDS):
        slopes = predictor.derivatives(values).slopes
        by_key = [[one / floor for one, floor in channels_of(predictor.parts, slope)] for slope in slopes]
        here = Here(here.apart, [np.column_stack(columns) for columns in zip(*by_key, strict=True)])
        say = [max(1.0, rms(z)) for z in here.apart] if trusting else signals_of(predictor.parts)
        step = by_agreement(here.apart, here.slopes, say, (means - values, deviations), heard)
        cost = here.cost((values - means) / deviations, heard)
        for part in _PARTS:
            moved = np.clip(values + part * step, low, high)
            ahead = look(predictor, moved)
            gained = 0.0 if ahead is None else cost - ahead.cost((moved - means) / deviations, heard)
            if ahead is not None and gained > 0.0:
                break
        else:
            break
        values, here = moved, Here(ahead.apart, here.slopes)
        if gained < _SAME:
            break
    return values, here


def look(predictor: Predictor, values: np.ndarray) -> Here | None:
    """The channels at some values; None where the model does not take them."""
    try:
        found = predictor.predict(values).values
    except (InputError, SimulationError):
        return None
    apart = {name: part.values - found[name] for name, part in predictor.parts.items()}
    return Here([one / floor for one, floor in channels_of(predictor.parts, apart)], [])


def elsewhere(predictor: Predictor, values: np.ndarray, places: list[int], heard: Sequence[bool]) -> np.ndarray:
    """Values of which some are where they leave least, of several: from too far away no slope leads there.

    Args:
        predictor: Of the channels.
        values: Where a search ended, shape (keys,).
        places: Of those that are tried elsewhere, one after the other.
        heard: Which channels have a say.
    """

    def cost(one: np.ndarray) -> float:
        here = look(predictor, one)
        return math.inf if here is None else here.cost(np.zeros(1), heard)

    best = cost(values), values
    for place in places:
        tried = [best]
        for part in _ELSEWHERE:
            (moved := best[1].copy())[place] = part * values[place]
            tried.append((cost(moved), moved))
        best = min(tried, key=lambda one: one[0])
    return best[1]


def stretches(times_s: np.ndarray, first_s: float) -> np.ndarray:
    """Number of the stretch that each sample is in, shape (n,): long ones before the hammer pulse, and short ones."""
    return np.floor((times_s - first_s) / np.where(times_s < first_s, _LONG_S, _SHORT_S)).astype(int)


def half_without_parts(
    here: Here,
    times_s: Sequence[np.ndarray],
    scales: Sequence[float],
    known: tuple[np.ndarray, np.ndarray],
    first_s: float,
) -> np.ndarray:
    """Return half of 95 % intervals by what values do without single channels, and stretches of time.

    Args:
        here: The channels at the values.
        times_s: Of each channel's samples [s], shape (n,).
        scales: By what each channel counts less.
        known: What is known before, as a part of the normal equations, shapes (unknowns, unknowns) and (unknowns,).
        first_s: When the hammer pulse comes [s].

    Returns:
        Shape (unknowns,).
    """
    pieces = []
    for c, (z, a, scale) in enumerate(zip(here.apart, here.slopes, scales, strict=True)):
        number = stretches(times_s[c], first_s)
        for one in np.unique(number):
            rows = number == one
            pieces.append((c, int(one), a[rows].T @ a[rows] / scale**2, a[rows].T @ z[rows] / scale**2))

    def step(place: int, one: int) -> np.ndarray:
        kept = [piece for piece in pieces if piece[place] != one]
        return solve_normal(known[0] + sum(piece[2] for piece in kept), known[1] + sum(piece[3] for piece in kept))

    return np.max(
        [jackknife(np.array([step(place, one) for one in {piece[place] for piece in pieces}])) for place in (0, 1)],
        axis=0,
    )
