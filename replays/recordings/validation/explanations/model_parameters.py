"""Explanation of a log's difference by one model parameter at a time, in addition to its sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from replays.estimate.least_squares import solve_normal
from replays.recordings.identification.agreement import MAX_PRIOR_DEVIATION
from replays.recordings.identification.nuisance import Tuned
from replays.recordings.identification.request import first_command_s, fit_unit
from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.prediction import Measured, Prediction
from replays.recordings.resimulation.sensitivity import Predictor, get_value
from replays.recordings.validation.criteria import Attribution, Candidate
from replays.recordings.validation.explanations.explanation import Explanation, excess, smooth_columns
from replays.recordings.validation.trajectory import floors
from rig.base.errors import InputError

_RETRY_FRACTION = 0.6
"""Fraction of the time after the hammer pulse to which a repeated search is limited."""


def explain_by_parameters(
    parts: dict[str, Measured],
    nominal: Prediction,
    others: Sequence[Prediction],
    tuned: Tuned,
    rules: Attribution,
    *,
    end_s: float,
    shorten: bool = True,
) -> list[Explanation]:
    """Return an explanation for each model parameter that may cause the difference, with the fit readjusted to it.

    The prediction is linearised about the fit: exact for small changes, and sufficient to show which parameters
    correlate. If a fitted value is outside its prior uncertainty, only parameters that bring it back are returned.

    Args:
        parts: Recorded channels, on the model's clock.
        nominal: Prediction of the same rows.
        others: Equally valid predictions.
        tuned: Fit of the log.
        rules: Candidate parameters of the model.
        end_s: Time up to which the model was compared [s].
        shorten: Whether to search again on a shorter part if nothing is found.
    """
    along = tuple(tuned.values)
    candidates = [one for one in rules.candidates if _has_float_values(tuned, one) and not set(one.keys) & set(along)]
    keys = (*along, *dict.fromkeys(key for one in candidates for key in one.keys))
    kept = {name: part.select_until(end_s) for name, part in parts.items()}
    predictor = Predictor(tuned.baseline, keys, kept, about_s=tuned.about_s)
    # The parts are already on the model's clock.
    at = [0.0 if key.startswith("clock.") else tuned.values.get(key, get_value(tuned.baseline, key)) for key in keys]
    slopes = predictor.derivatives(at).slopes
    floor = {
        name: floors(
            part, fit := nominal.values[name][: len(part.times_s)], [o.values[name][: len(fit)] for o in others]
        )
        for name, part in kept.items()
    }

    def over_floors(values: dict[str, np.ndarray]) -> np.ndarray:
        return np.concatenate(
            [
                (kept[name].whiten(values[name][: len(by)]) / by)[:, smooth_columns(kept[name])].ravel()
                for name, by in floor.items()
            ]
        )

    z = over_floors({name: part.values - nominal.values[name][: len(part.times_s)] for name, part in kept.items()})
    columns = dict(zip(keys, map(over_floors, slopes), strict=True))
    priors = [one.prior or (one.value, predictor.scales[n]) for n, one in enumerate(tuned.fitted)]
    means, deviations = np.array(priors).T
    off = (np.array(list(tuned.values.values())) - means) / deviations
    far = np.array([one.beyond for one in tuned.fitted])
    fits, before = [], excess(z) + float(off[far] @ off[far])
    for one in candidates:
        relative, sizes = _find_sizes(tuned.baseline, one)
        column = sum(size * columns[key] for size, key in zip(sizes, one.keys, strict=True))
        table = np.column_stack([column, *(columns[key] for key in along)])
        square, side = table.T @ table, table.T @ z
        place = np.arange(1, len(priors) + 1)
        square[place, place] += deviations**-2.0
        side[place] -= off / deviations
        change = solve_normal(square, side)
        residual, back = z - table @ change, off + change[1:] / deviations
        if abs(change[0]) > one.largest or (np.abs(back) > MAX_PRIOR_DEVIATION).any() or before == 0.0:
            continue
        unit = "" if relative else one.unit or fit_unit(one.keys[0])
        text = f"{100.0 * change[0]:+.3g} %" if relative else f"{change[0]:+.4g} {unit}"
        fits.append(
            Explanation.of(
                residual, kind="model", name=one.name, change=text, value=float(change[0]), unit=unit,
                explained=1.0 - (excess(residual) + float(back[far] @ back[far])) / before, to_s=end_s,
            )
        )  # fmt: skip
    hit_s = first_command_s(tuned.baseline)
    if not fits and shorten and hit_s < end_s:
        # No candidate keeps the fitted values within their priors: across impacts the linearisation is not valid.
        sooner_s = hit_s + _RETRY_FRACTION * (end_s - hit_s)
        return explain_by_parameters(parts, nominal, others, tuned, rules, end_s=sooner_s, shorten=False)
    return fits


def find_changes(experiment: Experiment, rules: Attribution, one: Explanation) -> dict[str, float]:
    """Return the values that an explanation gives to the keys of its model parameter."""
    candidate = next(each for each in rules.candidates if each.name == one.name)
    _, sizes = _find_sizes(experiment, candidate)
    pairs = zip(candidate.keys, sizes, strict=True)
    return {key: get_value(experiment, key) + one.value * size for key, size in pairs}


def _find_sizes(experiment: Experiment, candidate: Candidate) -> tuple[bool, list[float]]:
    """Return whether a candidate changes its keys in proportion, and the change of each key for a change of 1."""
    values = [get_value(experiment, key) for key in candidate.keys]
    relative = not (candidate.unit or 0.0 in values)
    return relative, values if relative else [1.0] * len(values)


def _has_float_values(tuned: Tuned, candidate: Candidate) -> bool:
    try:
        return all(isinstance(get_value(tuned.baseline, key), float) for key in candidate.keys)
    except InputError:
        return False
