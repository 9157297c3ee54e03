"""Attribution of a difference between recording and model to a sensor, the time, a command, or a number of the model.

Each candidate is one number, fitted to the recorded channels over their noise on windows that grow from the first
difference: after an impact a change has so large an effect that only a close initial value converges. The result is the
part of the residual that each candidate explains, so that equally good candidates are visible.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from replays.estimate.least_squares import Fit, fit
from replays.recordings.identification.nuisance import Tuned
from replays.recordings.identification.request import fit_unit
from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.prediction import Measured, Prediction, predict
from replays.recordings.resimulation.sensitivity import get_scale, get_value, with_values
from replays.recordings.validation.criteria import Attribution, Candidate
from replays.recordings.validation.explanations.channel_fit import MARGIN
from replays.recordings.validation.explanations.explanation import (
    Explanation,
    Kind,
    excess,
    is_noise,
    smooth_columns,
    vector,
)
from replays.recordings.validation.explanations.faults import MIN_PART, Clock, are_cause, select_channels, sensor_faults
from replays.recordings.validation.explanations.model_parameters import explain_by_parameters
from replays.recordings.validation.explanations.signals import SignalFault
from replays.recordings.validation.explanations.single_channels import make_signal_faults
from replays.recordings.validation.trajectory import scaled
from rig.base.errors import InputError, SimulationError
from rig.channels.table import default_table

_GROWTH_S = (5e-3, 10e-3, 20e-3, 40e-3, 80e-3, 160e-3)
"""Lengths of the windows after the first difference [s]; the criteria add the last one."""
_MAX_STEPS = 6
_MIN_GAIN = 1e-3
"""Relative decrease of the sum of squares below which a step is the last."""
_MAX_LAG = 0.3
"""Difference to the best explained part from which a candidate is given up, unless noise may have caused it."""
_NOISE = 2.0
"""Remaining residual over noise above which a candidate is only the closest one."""
_STARTS = (0.0, *(sign * part for part in (0.005, 0.01, 0.02, 0.035, 0.06, 0.1, 0.2, 0.5) for sign in (1.0, -1.0)))
"""Initial values on the first window, as parts of the largest change."""
_MAX_STARTS = 3
"""Number of initial values from which a fit is made."""
FEW_CHANNELS = 0.3
"""Part of channels that may have separate defects; if more differ, the model is the cause."""
_ALL_PART = 0.9995
"""Part of the difference that sensors must explain in a recording of this rig, where everything else is known."""
_MAX_MEDIAN_RESIDUAL = 10.0
"""Remaining residual of the median channel over its noise, above which most channels or the prediction are wrong."""
_MIN_SHARE = 1e-3
"""Explained part relative to the largest one, below which a change is not reported with it."""
_MAX_NAMED = 3
"""Largest number of equally good causes that are named; more are none."""
_MAX_TIED = 3
"""Largest number of equally good causes that are tried with a second one."""
_OUTLIER_FLOORS = 7.0
"""Residual in floors from which a sample is the first unexplained one."""
_WHOLE_S = 5.0
"""Time after the first difference in which sensors and clock are compared [s]."""


@dataclass(frozen=True)
class Explained:
    """All explanations of a difference.

    Attributes:
        from_s: First difference [s].
        to_s: End of the window [s].
        ranked: Explanations, best first.
        conclusion: Conclusion in a sentence.
        best: Names of the explanations in the conclusion.
        unsettled: Channels whose small differences are an effect of the faults in the conclusion, or other faults.
        settled: Further channels that differ, by name: an "effect" of these faults on the fit, or another "fault".
    """

    from_s: float
    to_s: float
    ranked: tuple[Explanation, ...]
    conclusion: str
    best: tuple[str, ...]
    unsettled: tuple[str, ...] = ()
    settled: dict[str, str] = field(default_factory=dict)


class Rest(NamedTuple):
    """Comparison of a log with a fit that does not use its faulty channels.

    Attributes:
        faults: Faults of the channels that are left.
        failed: Names of the channels that fail.
        is_evidence: Whether as much is compared as with the faulty channels.
    """

    faults: list[Explanation]
    failed: list[str]
    is_evidence: bool


def attribute(
    experiment: Experiment,
    parts: dict[str, Measured],
    nominal: Prediction,
    rules: Attribution,
    *,
    from_s: float,
    own: Sequence[Explanation] = (),
    step: Callable[[str], None] = lambda _text: None,
) -> Explained:
    """Find what explains a difference.

    Args:
        experiment: The predicted experiment.
        parts: Recorded channels.
        nominal: Prediction of the same rows.
        rules: Candidates and limits.
        from_s: First difference [s].
        own: Defects of channels whose counts differ while others are equal to the bit.
        step: Function that is called with the current step.
    """
    last_s = max(float(part.times_s[-1]) for part in parts.values())
    lengths = [length for length in _GROWTH_S if length < rules.longest_s] + [rules.longest_s]
    ends = sorted({min(from_s + length, last_s + 1e-9) for length in lengths})
    candidates = _list_candidates(experiment, parts, rules)
    fitted, end_s = _fit_model(candidates, ends, step)
    # Defects of sensors and clock last to the end; if the model is right for as long, none of its numbers is wrong.
    whole_s = min(last_s + 1e-9, from_s + _WHOLE_S)
    shift_s = Clock(parts, nominal, end_s).coarse_shift()
    sensors, timed, cured, until_s = list(own), [], bool(own) and all(one.sure for one in own), end_s
    for until_s in () if own else (whole_s, end_s):
        step(f"sensors and time, to {until_s:.3f} s")
        sensors = sensor_faults(parts, nominal, until_s, from_s=from_s)
        timed = Clock(parts, nominal, until_s).faults(shift_s)
        cured = are_cause(sensors, parts, _ALL_PART)
        if cured or any(one.at_floor for one in timed):
            break
        cured = False
    if until_s > end_s:  # the model must then explain the longer window
        fitted = [candidates[one.name].refit(one, until_s) if one.at_floor else one for one in fitted]
    explanations = [*fitted, *sensors, *timed]
    # Candidates that were given up on a shorter window are last.
    explanations.sort(key=lambda one: (-one.to_s, -one.explained))
    conclusion, best = conclude(explanations, sensors if cured else [], rules, end_s=until_s)
    explained = Explained(from_s, until_s, tuple(explanations), conclusion, best)
    floor = {one.name: one for one in explanations if one.at_floor and one.to_s == until_s}
    if until_s >= ends[-1] or not set(best) <= set(floor) & set(candidates):
        return explained
    tied = sorted((floor[name] for name in best), key=lambda one: one.squares)[:_MAX_TIED]
    return _add_second_cause(explained, [candidates[one.name] for one in tied], candidates, ends[-1], step)


def _add_second_cause(
    first: Explained,
    causes: list[_CandidateFit],
    candidates: dict[str, _CandidateFit],
    last_s: float,
    step: Callable[[str], None],
) -> Explained:
    """Return the explanation with a second, jointly fitted cause, if the first explains a part of the time only."""
    joint: list[tuple[Explanation, str]] = []
    for cause in causes:
        from_s = cause.first_off(last_s)
        ends = sorted({min(from_s + length, last_s) for length in _GROWTH_S})
        others = {name: one.join_cause(cause) for name, one in candidates.items() if not one.shares(cause)}
        fitted, end_s = _fit_model(others, ends, lambda text, name=cause.candidate.name: step(f"with {name}: {text}"))
        alone = cause.fit(cause.ended, end_s)
        least = np.inf if alone is None else alone.squares - MARGIN
        for one in fitted:
            if one.at_floor and one.to_s == end_s and one.squares < least:
                joint.append((one, f"{cause.candidate.name} {cause.format_value(float(others[one.name].ended[1]))}"))
        if joint and end_s >= ends[-1]:
            break
    if not joint:
        return replace(first, conclusion=f"{first.conclusion}; the difference after that is not explained")
    end_s = max(one.to_s for one, _ in joint)
    fewest = min(one.squares for one, _ in joint if one.to_s == end_s)
    pairs = [(one, cause) for one, cause in joint if one.to_s == end_s and one.squares < fewest + MARGIN]
    named = [replace(one, name=f"{one.name}, with {cause}") for one, cause in pairs]
    changes = " or ".join(f"{one.name} {one.change} with {cause}" for one, cause in pairs)
    return replace(
        first, to_s=end_s, ranked=(*named, *first.ranked), best=(*first.best, *(one.name for one in named)),
        conclusion=f"{first.conclusion}; after that a second cause, {changes}: together they explain it to "
        f"{end_s:.3f} s ({named[0].left:.2f} of the noise left)",
    )  # fmt: skip


def explain_by_defects(own: Sequence[Explanation]) -> Explained:
    """Return the explanation by defects of channels, if the motion is equal to the bit."""
    from_s = min(one.from_s for one in own)
    conclusion = "sensor: " + "; ".join(one.line for one in make_signal_faults(own))
    return Explained(
        from_s, max(one.to_s for one in own), tuple(own), conclusion, tuple(one.name for one in own if one.sure)
    )


def explain_log(
    parts: dict[str, Measured], nominal: Prediction, others: Sequence[Prediction], tuned: Tuned, rules: Attribution,
    *, from_s: float, end_s: float, faults: Sequence[SignalFault] = (), touching: bool = False,
) -> Explained:  # fmt: skip
    """Return the explanation of a difference in a log: by sensors, or by fitted numbers outside their uncertainty.

    Args:
        parts: Recorded channels, on the model's clock.
        nominal: Prediction of the same rows.
        others: Equally valid predictions.
        tuned: Fit of the log.
        rules: Limits.
        from_s: First difference [s].
        end_s: Time up to which the model was compared [s].
        faults: Faults that signals show without a model.
        touching: Whether the shaft is in contact when the log begins.
    """
    sensors = sensor_faults(parts, nominal, end_s, others)
    # Effects of a fault on other channels, through the earlier fit, are not faults of these.
    most = max((one.explained for one in sensors), default=0.0)
    brought = [one for one in sensors if one.explained <= _MIN_SHARE * most]
    sensors = [one for one in sensors if one.explained > _MIN_SHARE * most]
    trigger = any(one.name == "hammer delay" for one in sensors)
    far = [one for one in tuned.fitted if one.contradicts_prior and not (trigger and one.key == "clock.offset_s")]
    # Different faults of more channels than `FEW_CHANNELS` are rather one error of the model.
    few = len(sensors) < FEW_CHANNELS * len(tuned.scales)
    cured = few and are_cause(sensors, parts)
    numbers = explain_by_parameters(parts, nominal, others, tuned, rules, end_s=end_s) if sensors or far else []
    # A number that explains no more than the sensors do is not reported with them.
    numbers = [one for one in numbers if one.at_floor or one.explained > MIN_PART]
    small = [one for one in numbers if abs(one.value) < rules.least * _find_size(tuned.baseline, one, rules)]
    numbers = [one for one in numbers if one not in small]
    told_s = min((one.to_s for one in numbers), default=end_s)
    conclusion, best = conclude([*sensors, *numbers], sensors if cured else [], rules, end_s=told_s)
    unsettled = tuple(select_channels(brought, tuned.scales)) if cured else ()
    early = next((one.value for one in sensors if one.name == "hammer delay" and one.value < 0.0), None)
    probes = [name for name in tuned.scales if name in default_table().groups["probes"].names]
    if early is not None and best and len(probes) > 1:
        # Before the forces respond, only the probes show the time.
        conclusion += f"; or sensor: {', '.join(probes)} delay {-early * 1e6:+.4g} µs: "
        conclusion += "up to the first contact these are equivalent, and this log does not distinguish them"
    if far:
        also = f"; {conclusion}" if best else ""
        best = (*(one.key for one in far), *best)
        conclusion = "outside the known uncertainty: " + "; ".join(one.line for one in far) + also
    elif not best and cured:
        pass  # the closest defects of channels are stated, although more than noise is left
    elif not best and faults:
        conclusion = f"first repair the faults of signals: {'; '.join(one.line for one in faults)}"
    elif not best and float(np.median(list(tuned.scales.values()))) > _MAX_MEDIAN_RESIDUAL:
        if touching:
            conclusion = "the log begins in contact, and the earlier motion of the shaft is unknown: use a log "
            conclusion += "that begins before the hammer pulse"
        else:
            conclusion = "recording and model disagree from the hammer pulse onwards: its time, several channels, or "
            conclusion += "the model is wrong; this log does not distinguish them"
    elif not best and few and (part := sum(one.explained for one in sensors)) > rules.enough:
        conclusion = f"closest are {_list(sensors)}: {part:.0%} of the difference; "
        conclusion += "the rest is another fault, or the model"
    elif not best and 0 < len(some := select_channels(sensors, tuned.scales)) < FEW_CHANNELS * len(tuned.scales):
        conclusion = f"of {len(tuned.scales)} channels {_join(some)} alone: an unknown fault, "
        conclusion += "or a number of the model that affects no other; this log does not distinguish them"
    elif not best and small:
        conclusion = f"a change of {_list(small[:_MAX_NAMED])} would explain it, which no calibration knows: "
        conclusion += "another cause, or the model's equations"
    elif not best:
        conclusion = "neither a sensor nor the clock explains it"
        if unsure := "; ".join(one.line for one in tuned.fitted if one.is_at_limit):
            conclusion = f"no sensor explains it, and this log does not determine {unsure}"
        conclusion += ": the model differs"
        if any(one.name.startswith("contact.") for one in rules.candidates):
            conclusion += " from the first contact on (`rig identify --fit contact.friction,contact.restitution`)"
        else:
            conclusion += "; `rig identify` fits its numbers"
    return Explained(
        from_s, end_s, tuple(sorted([*sensors, *numbers], key=lambda one: -one.explained)), conclusion, best, unsettled
    )


def settle_channels(
    explained: Explained, passed: Mapping[str, bool], channels: list[str], compare: Callable[[list[str]], Rest]
) -> Explained:
    """Return the explanation of a log by sensors with further channels that differ: by other faults, or as an effect.

    Args:
        explained: The explanation.
        passed: Whether each judged channel passes.
        channels: Channels of the fit.
        compare: Function that compares the log with a fit of some channels only.
    """
    causes = [one for one in explained.ranked if one.name in explained.best]
    known = select_channels(causes, channels)
    off = [
        name for name in channels
        if name not in known and (name in explained.unsettled or not passed.get(name, True))
    ]  # fmt: skip
    if not off:
        return explained
    used = [name for name in channels if name not in known]
    by_sensors = bool(causes) and {one.kind for one in causes} == {"sensor"} and len(causes) == len(explained.best)
    rest = compare(used) if by_sensors and len(used) > len(known) else Rest([], [], is_evidence=False)
    if not rest.is_evidence:
        open_ones = [name for name in off if name in explained.unsettled]
        text = f"; {_join(open_ones)} in addition: an effect, or another fault" if open_ones else ""
        return replace(explained, conclusion=explained.conclusion + text)
    conclusion, without = explained.conclusion, f"a fit without {_join(known)}"
    found = {name: [one for one in rest.faults if select_channels([one], [name])][:1] for name in off}
    effects = [name for name in off if not found[name] and name not in rest.failed]
    if effects:
        verb = "differ" if effects[1:] else "differs"
        conclusion += f"; {_join(effects)} {verb} only through the fit: {without} shows no difference"
    others = list(dict.fromkeys(one for name in off for one in found[name]))
    for one in others:
        conclusion += f"; another fault, also in {without}, closest is {one.name} {one.change}"
    for name in (name for name in off if name not in effects and not found[name]):
        conclusion += f"; {name} fails, also in {without}, without a known cause"
    named = [one for one in others if one.at_floor and select_channels([one], rest.failed)]
    return replace(
        explained, conclusion=conclusion, ranked=(*explained.ranked, *named),
        best=(*explained.best, *(one.name for one in named)),
        settled={name: "effect" if name in effects else "fault" for name in off},
    )  # fmt: skip


def _find_size(experiment: Experiment, one: Explanation, rules: Attribution) -> float:
    """Return the size to which the smallest change of a number of the model is relative, in the change's unit."""
    key = next(each for each in rules.candidates if each.name == one.name).keys[0]
    return get_scale(experiment, key) if one.unit else 1.0


class _CandidateFit:
    """Residual as a function of one candidate's number, and of that of an earlier cause, which is fitted jointly.

    Attributes:
        candidate: The candidate.
        ended: Result of the accepted fit, the candidate's number first, shape (1,) or (2,).
        step: Step of the difference quotient.
    """

    def __init__(
        self,
        experiment: Experiment,
        candidate: Candidate,
        parts: dict[str, Measured],
        cause: _CandidateFit | None = None,
    ) -> None:
        self._experiment, self._parts, self._cause = experiment, parts, cause
        self.candidate = candidate
        self.ended = np.zeros(1) if cause is None else np.append(0.0, cause.ended[0])
        self._begin = self.ended
        self._start = {key: get_value(experiment, key) for key in candidate.keys}
        # A relative change of 0 has no effect: such a value changes in its unit.
        self._absolute = bool(candidate.unit) or 0.0 in self._start.values()
        self._unit = candidate.unit or (fit_unit(candidate.keys[0]) if self._absolute else "")
        self._scale = {} if self._absolute else self._start
        self.step = candidate.step
        if candidate.unit and candidate.step == Candidate.model_fields["step"].default:
            self.step *= get_scale(experiment, candidate.keys[0])

    def format_value(self, p: float) -> str:
        """Return a value of the candidate's number as text."""
        return f"{p:+.4g} {self._unit}".removesuffix(" 1") if self._absolute else f"{100.0 * p:+.3g} %"

    def join_cause(self, cause: _CandidateFit) -> _CandidateFit:
        """Return the candidate with a jointly fitted cause, from the result of that one's fit."""
        return _CandidateFit(self._experiment, self.candidate, self._parts, cause)

    def shares(self, other: _CandidateFit) -> bool:
        """Return whether both candidates change the same value."""
        return not self._start.keys().isdisjoint(other._start)

    def first_off(self, end_s: float) -> float:
        """Return the time of the first unexplained sample with the result of the last fit, up to an end [s]."""
        model = self._predicted(self.ended, end_s)
        off = {} if model is None else {name: np.abs(scaled(self._parts[name], v)) for name, v in model.values.items()}
        rows = {
            name: np.flatnonzero(each[:, smooth_columns(self._parts[name])].max(axis=1, initial=0.0) > _OUTLIER_FLOORS)
            for name, each in off.items()
        }
        return min(
            (float(self._parts[name].times_s[each[0]]) for name, each in rows.items() if len(each)), default=end_s
        )

    def changed(self, p: float) -> dict[str, float]:
        """Return the changed values for a value of the candidate's number."""
        return {key: value + p * self._scale.get(key, 1.0) for key, value in self._start.items()}

    def _predicted(self, values: np.ndarray, end_s: float) -> Prediction | None:
        changed = self.changed(float(values[0]))
        if self._cause is not None:
            changed |= self._cause.changed(float(values[1]))
        try:
            return predict(with_values(self._experiment, changed), self._parts, end_s=end_s)
        except (InputError, SimulationError):
            return None

    def residuals(self, values: np.ndarray, end_s: float) -> np.ndarray | None:
        """Return the residuals over floors, shape (n,); None if the model does not accept the numbers.

        Args:
            values: The numbers.
            end_s: End of the window [s].
        """
        prediction = self._predicted(values, end_s)
        return None if prediction is None else vector(self._parts, prediction.values)

    def search(self, end_s: float) -> Fit | None:
        """Return the best of fits from a few initial values: those with the smallest flattened residuals."""
        places = []
        for part in _STARTS:
            start = self._begin.copy()
            start[0] = part * self.candidate.largest
            z = self.residuals(start, end_s)
            if z is not None:
                # Impacts that do not overlap dominate the squares without a usable slope; the motion between them has
                # one.
                places.append((float(np.sum(np.arcsinh(z) ** 2)), abs(part), part, start))
        best: Fit | None = None
        for *_, start in sorted(places, key=lambda place: place[:3])[:_MAX_STARTS]:
            result = self.fit(start, end_s)
            if result is not None and (best is None or result.squares < best.squares):
                best = result
            if result is not None and is_noise(result.residuals):
                break
        return best

    def fit(self, start: np.ndarray, end_s: float) -> Fit | None:
        """Return the fit on a window, from an initial value."""
        both = [self] if self._cause is None else [self, self._cause]

        def residuals(values: np.ndarray) -> np.ndarray | None:
            return self.residuals(values, end_s)

        def slopes(values: np.ndarray, z: np.ndarray) -> np.ndarray | None:
            columns = []
            for place, one in enumerate(both):
                moved = values.copy()
                moved[place] += one.step
                ahead = self.residuals(moved, end_s)
                if ahead is None:
                    return None
                columns.append((ahead - z) / one.step)
            return np.stack(columns, axis=1)

        largest = np.array([one.candidate.largest for one in both])
        return fit(residuals, slopes, start, rounds=_MAX_STEPS, gain=_MIN_GAIN, farthest=largest, longest=largest / 4.0)

    def explanation(self, result: Fit, before: float, to_s: float) -> Explanation:
        """Return the explanation by a fit, relative to the excess of the residuals without it."""
        p, unit, key = float(result.values[0]), self._unit, self.candidate.keys[0]
        kind: Kind = "time" if key.endswith(".at_s") else "command" if key.startswith("hammer.") else "model"
        return Explanation.of(
            result.residuals, kind=kind, name=self.candidate.name,
            change=self.format_value(p), value=p, unit=unit,
            explained=1.0 - excess(result.residuals) / before, to_s=to_s,
        )  # fmt: skip

    def before(self, end_s: float) -> float:
        """Return the excess of the residuals of the unchanged experiment, or with the earlier cause."""
        z = self.residuals(self._begin, end_s)
        return 0.0 if z is None else excess(z)

    def refit(self, one: Explanation, end_s: float) -> Explanation:
        """Return the explanation on a longer window, from the result of the last fit."""
        before = self.before(end_s)
        result = self.fit(self.ended, end_s)
        return one if result is None or before == 0.0 else self.explanation(result, before, end_s)


def _list_candidates(
    experiment: Experiment, parts: dict[str, Measured], rules: Attribution
) -> dict[str, _CandidateFit]:
    """Return the candidates whose numbers an experiment has, by name."""
    fits = {}
    for candidate in rules.candidates:
        try:
            fits[candidate.name] = _CandidateFit(experiment, candidate, parts)
        except InputError:
            continue  # the experiment has no such number, for example no hammer pulse
    return fits


class _WindowStage(NamedTuple):
    """Explanations by the candidates on one window."""

    end_s: float
    fitted: list[Explanation]
    fits: dict[str, Fit]

    @property
    def rank(self) -> float:
        """Rank of the window: 1 if one candidate explains all down to the noise, otherwise the best explained part."""
        best = max(self.fitted, key=lambda one: one.explained, default=None)
        if best is None:
            return 0.0
        return 1.0 if best.at_floor else round(best.explained, 3) * 0.999


def _fit_model(
    candidates: dict[str, _CandidateFit], ends: list[float], step: Callable[[str], None]
) -> tuple[list[Explanation], float]:
    """Return the explanation by each candidate, and the end of the window that was chosen [s]."""
    places = {
        name: one.ended for name, one in candidates.items()
    }  # initial values of the candidates that are not given up
    stages: list[_WindowStage] = []
    for end_s in ends:
        fits: dict[str, Fit] = {}
        for n, (name, p) in enumerate(places.items(), 1):
            step(f"{name}, {n} of {len(places)}, to {end_s:.3f} s (window {len(stages) + 1} of {len(ends)})")
            result = candidates[name].fit(p, end_s)
            if result is not None:
                fits[name] = result
        if not stages and not any(is_noise(result.residuals) for result in fits.values()):
            for n, name in enumerate(places, 1):
                step(f"{name}, {n} of {len(places)}, wider search")
                far = candidates[name].search(end_s)
                if far is not None and (name not in fits or far.squares < fits[name].squares):
                    fits[name] = far
        before = next(iter(candidates.values())).before(end_s) if candidates else 0.0
        explanations = {
            name: candidates[name].explanation(result, before, end_s) for name, result in fits.items() if before > 0.0
        }
        stages.append(_WindowStage(end_s, [one for one in explanations.values() if one.explained > 0.0], fits))
        best = max((one.explained for one in explanations.values()), default=0.0)
        fewest = min((one.squares for one in explanations.values()), default=0.0)
        places = {
            name: fits[name].values
            for name, one in explanations.items()
            if one.explained > max(0.0, best - _MAX_LAG) or one.squares < fewest + 4.0 * MARGIN
        }
    # The longest window that one number explains to the noise distinguishes candidates best; later motion is too
    # sensitive for a fit.
    chosen = max(range(len(stages)), key=lambda k: (stages[k].rank, k))
    kept = {one.name: one for stage in stages[: chosen + 1] for one in stage.fitted}
    for name, result in stages[chosen].fits.items():
        candidates[name].ended = result.values
    return list(kept.values()), stages[chosen].end_s


def conclude(
    explanations: list[Explanation], cured: list[Explanation], rules: Attribution, *, end_s: float
) -> tuple[str, tuple[str, ...]]:
    """Return the conclusion from explanations in a sentence, and the names in it.

    Args:
        explanations: All explanations.
        cured: Sensor faults that together leave only noise; empty if they do not.
        rules: Limits.
        end_s: End of the window of those that were not given up [s].
    """
    alone = [one for one in explanations if one.kind != "sensor" and one.to_s == end_s]
    single = max(alone, key=lambda one: one.explained, default=None)
    if cured and (single is None or not single.at_floor or len(cured) == 1):
        names = tuple(one.name for one in cured)
        text = "; ".join(f"{one.name} {one.change}" for one in cured)
        most = sum(one.explained for one in cured)
        # A single number that explains as much as several sensor faults is reported with them.
        also = [one for one in alone if one.at_floor or (cured[1:] and one.explained > most - rules.equal)]
        if also:
            text = f"sensor: {text}, or {_list(also)} explain it equally; this recording does not distinguish them"
            return text, (*names, *(one.name for one in also))
        if (rest := max(one.left for one in cured)) > _NOISE:
            part = f"{min(1.0, most):.1%} of the difference; {rest:.2g} times the noise is left"
            return f"no known defect explains it down to the noise; closest is sensor: {text} ({part})", ()
        return f"sensor: {text} ({min(1.0, most):.1%} of the difference)", names
    if single is None or single.explained < rules.enough:
        most = f"; the most is {single.name} with {single.explained:.0%}" if single else ""
        return f"no single candidate explains it{most}", ()
    if single.at_floor:
        equal = [one for one in alone if one.squares < single.squares + MARGIN]
    else:
        equal = [one for one in alone if one.explained > single.explained - rules.equal]
    names = tuple(one.name for one in equal)
    part = f"{single.explained:.2%} of the difference to {end_s:.3f} s, {single.left:.2f} of the noise left"
    short = "" if single.left < _NOISE else "no candidate alone explains it down to the noise; closest is "
    if len(equal) > _MAX_NAMED:
        some = _list(sorted(equal, key=lambda one: one.squares)[:_MAX_NAMED])
        text = f"{len(equal)} causes explain it equally ({part}), such as {some}: this recording cannot tell which"
        return text, ()
    if len(equal) == 1:
        return f"{short}{single.kind}: {single.name} {single.change} ({part})", names
    return f"{short}{_list(equal)} explain it equally ({part}); this recording does not distinguish them", names


def _join(names: list[str]) -> str:
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)


def _list(explanations: list[Explanation]) -> str:
    return ", ".join(f"{one.name} {one.change}" for one in explanations)
