"""Uncertainty budget of a log's validation: the contributions to each fitted number and each judged quantity.

Contributions are standard uncertainties, combined as independent ones and expanded with k = 2 (GUM, JCGM 100:2008, 5.1
and 6.2). That to a fitted number is its change in the last linear step of the fit, with one input changed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from replays.recordings.identification.agreement import (
    ChannelState,
    jackknife_half_widths,
    solve_weighted,
    split_channels,
)
from replays.recordings.identification.nuisance import Tuned, select_sound, window_start_s
from replays.recordings.identification.request import first_command_s, fit_unit
from replays.recordings.resimulation.prediction import Measured, Prediction
from replays.recordings.resimulation.sensitivity import CLOCK, Predictor
from replays.recordings.validation.criteria import Imported

COVERAGE = 2.0
"""Coverage factor of an expanded uncertainty."""
_DRAWS = 10
"""Draws of the noise for a quantity of a phase."""


@dataclass(frozen=True)
class Budget:
    """Uncertainty of a value.

    Attributes:
        name: Key of a fitted number, or phase and quantity.
        unit: Unit.
        value: The value in its unit.
        contributions: Standard uncertainty by source, in the unit of the value.
        by_gain: Change of a fitted number if a channel's gain is too large by its standard uncertainty, by channel.
    """

    name: str
    unit: str
    value: float
    contributions: dict[str, float]
    by_gain: dict[str, float] = field(default_factory=dict)

    @property
    def combined(self) -> float:
        """Combined standard uncertainty."""
        return math.hypot(*self.contributions.values())

    @property
    def expanded(self) -> float:
        """Expanded uncertainty with k = 2."""
        return COVERAGE * self.combined


def make_fit_budgets(tuned: Tuned, rules: Imported) -> list[Budget]:
    """Return the budgets of the numbers fitted to a log.

    Args:
        tuned: The fit.
        rules: Uncertainties of calibration and filters, and equally valid models.
    """
    parts, keys, values = tuned.parts, tuple(tuned.values), np.array(list(tuned.values.values()))
    predictor = Predictor(tuned.baseline, keys, parts, about_s=tuned.about_s)
    there = predictor.derivatives(values)

    def over_noise(values: dict[str, np.ndarray]) -> list[np.ndarray]:
        """Return values over the noise, whitened as in the fit, by channel."""
        whitened = {name: part.whiten(values[name]) for name, part in parts.items()}
        return [one / floor for one, floor in split_channels(parts, whitened)]

    def subtract(changed: dict[str, np.ndarray]) -> list[np.ndarray]:
        """Return the prediction minus another one over the noise, by channel."""
        return over_noise({name: base - changed[name] for name, base in there.base.values.items()})

    recorded = {name: part.values for name, part in parts.items()}
    residuals = [-one for one in subtract(recorded)]
    columns = [np.column_stack(one) for one in zip(*map(over_noise, there.slopes), strict=True)]
    loose = zip(predictor.start, predictor.scales, strict=True)
    means, deviations = np.array([one.prior or wide for one, wide in zip(tuned.fitted, loose, strict=True)]).T
    scales = list(tuned.scales.values())
    enabled = select_sound(scales)

    def solve(changes: Sequence[np.ndarray | float]) -> np.ndarray:
        target = [z + change for z, change in zip(residuals, changes, strict=True)]
        return solve_weighted(target, columns, scales, (means - values, deviations), enabled)

    def solve_each(changes: Sequence[np.ndarray]) -> np.ndarray:
        """Return the effect of a change of each channel alone, shape (channels, keys)."""
        each = [solve([change if c == n else 0.0 for n in range(len(changes))]) for c, change in enumerate(changes)]
        return np.array(each) - here

    here = solve([0.0] * len(residuals))
    weights = [used / scale for used, scale in zip(enabled, scales, strict=True)]
    grams = [weight**2 * (one.T @ one) for one, weight in zip(columns, weights, strict=True)]
    prior = np.diag(deviations**-2.0)
    inverse = np.linalg.inv(sum(grams) + prior)
    # The noise is that of the samples, also where residuals are larger.
    noisy = inverse @ sum(gram * weight**2 for gram, weight in zip(grams, weights, strict=True)) @ inverse
    known = [one.prior is not None for one in tuned.fitted]
    pulls = np.abs(inverse) / deviations * known
    clock = np.array([key in CLOCK for key in keys])
    gains = solve_each([rules.calibration * one for one in over_noise(recorded)])
    other = {name: part.with_corner_factor(rules.bandwidth) for name, part in parts.items()}
    variants = [tuned.with_changes(variant.set).predict(parts).values for variant in rules.variants]
    times = [part.times_s for part in parts.values() for _ in part.names]
    first_s = first_command_s(tuned.baseline) or window_start_s(tuned.baseline)
    jackknife = jackknife_half_widths(
        ChannelState(residuals, columns), times, scales, (prior, np.zeros(len(keys))), first_s
    )
    noise = np.sqrt(np.diag(noisy))
    unexplained = np.clip((jackknife / 1.96) ** 2 - noise**2, 0.0, None) + np.mean(tuned.moves**2, axis=0)
    model = unexplained + sum(((solve(subtract(one)) - here) ** 2 for one in variants), np.zeros(len(keys)))
    sources = {
        "noise": noise,
        "calibration": np.linalg.norm(gains, axis=0),
        "filter": np.linalg.norm(solve_each(subtract(tuned.predict(other).values)), axis=0),
        "clock": np.sqrt((pulls[:, clock] ** 2).sum(axis=1)),
        "inputs": np.sqrt((pulls[:, ~clock] ** 2).sum(axis=1)),
        "model": np.sqrt(model),
    }
    return [
        Budget(
            key,
            fit_unit(key),
            value,
            {name: float(one[place]) for name, one in sources.items()},
            dict(zip(tuned.scales, gains[:, place].tolist(), strict=True)),
        )
        for place, (key, value) in enumerate(tuned.values.items())
    ]


def make_quantity_budgets(
    judged: Mapping[tuple[int, str], tuple[str, str, float]],
    read: Callable[[dict[str, np.ndarray]], dict[tuple[int, str], float]],
    parts: Mapping[str, Measured],
    nominal: Prediction,
    fits: Sequence[Prediction],
    filters: Prediction,
    variants: Sequence[Prediction],
    rules: Imported,
) -> list[Budget]:
    """Return the budgets of the judged quantities of the phases, except for distances of spectra.

    Args:
        judged: Name, unit and value of each judged quantity, by phase and quantity.
        read: Function that returns the quantities of channels.
        parts: Recorded channels.
        nominal: Prediction.
        fits: Predictions with values drawn from the uncertainty of the fit.
        filters: Prediction with filters of other corners.
        variants: Predictions of equally valid models.
        rules: Uncertainty of the calibration.
    """
    base, generator = read(nominal.values), np.random.default_rng(0)
    gains = []
    for name, values in nominal.values.items():
        for c in range(values.shape[1]):
            factors = np.where(np.arange(values.shape[1]) == c, 1.0 + rules.calibration, 1.0)
            gains.append(read({**nominal.values, name: values * factors}))
    noisy = [{n: v + parts[n].draw_noise(generator, len(v)) for n, v in nominal.values.items()} for _ in range(_DRAWS)]
    changed = {
        "noise": (list(map(read, noisy)), _DRAWS),
        "calibration": (gains, 1),
        "filter": ([read(filters.values)], 1),
        "fit": ([read(one.values) for one in fits], len(fits)),
        "model": ([read(one.values) for one in variants], 1),
    }
    budgets = []
    for key, (name, unit, value) in judged.items():
        if key in base:
            sizes = {
                source: math.sqrt(sum((one[key] - base[key]) ** 2 for one in found) / count)
                for source, (found, count) in changed.items()
            }
            budgets.append(Budget(name, unit, value, sizes))
    return budgets
