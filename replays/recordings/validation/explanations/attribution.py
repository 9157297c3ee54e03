"""What a difference between recording and model comes from: a sensor, the time, a command, or a number of the model.

Each candidate is one number, fitted to the recorded channels over their noise on windows that grow from the first
difference on: behind an impact a change acts so strongly that only a start close by converges. What is told is how much
of the residual each explains, so that two that explain it alike are seen to do so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from replays.estimate.least_squares import Fit, fit
from replays.recordings.identification.nuisance import Tuned
from replays.recordings.identification.request import unit_of
from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.prediction import Measured, Prediction, predict
from replays.recordings.resimulation.sensitivity import scale_of, value_of, with_values
from replays.recordings.validation.criteria import Attribution, Candidate
from replays.recordings.validation.explanations.channel_fit import DECIDES
from replays.recordings.validation.explanations.explanation import (
    Explanation,
    Kind,
    excess,
    is_noise,
    smooth_columns,
    vector,
)
from replays.recordings.validation.explanations.faults import MOST, Clock, channels_in, cured_by, sensor_faults
from replays.recordings.validation.explanations.numbers import numbers_of_the_model
from replays.recordings.validation.explanations.signals import SignalFault
from replays.recordings.validation.explanations.single_channels import as_faults
from replays.recordings.validation.trajectory import scaled
from rig.base.errors import InputError, SimulationError
from rig.channels.table import default_table

_GROWTH_S = (5e-3, 10e-3, 20e-3, 40e-3, 80e-3, 160e-3)
"""Lengths of the windows behind the first difference [s]; the last is the criteria's own."""
_ROUNDS = 6
_GAIN = 1e-3
"""A fit ends with a step that makes the sum of squares smaller by less than this part."""
_KEEP = 0.3
"""A candidate is given up when it explains less than the best by this, and the noise cannot have decided it."""
_NEAR = 2.0
"""Of the noise left, from which on a candidate is the nearest, and no explanation."""
_STARTS = (0.0, *(sign * part for part in (0.005, 0.01, 0.02, 0.035, 0.06, 0.1, 0.2, 0.5) for sign in (1.0, -1.0)))
"""Where a fit may start on the first window, as parts of the farthest that it may go ..."""
_TRIED = 3
"""... and from how many of these it does."""
FEW_CHANNELS = 0.3
"""Less than this part of the channels may be off by themselves: of more it is the model."""
_ALL = 0.9995
"""What sensors explain of a recording of this rig, of which everything else is known, if they are it."""
_AT_ODDS = 10.0
"""Where this is left of the middle channel, over its noise, most are wrong, or what is held against them."""
_BESIDE = 1e-3
"""A change that explains less than this part of what the largest one does is not told beside it."""
_MOST_TIED = 3
"""Of causes that explain the beginning equally, so many are tried with a second one behind it."""
_OFF = 7.0
"""A sample so many times its noise off is the first that a cause does not explain."""
_WHOLE_S = 5.0
"""How far sensors and time are looked at behind the first difference [s]."""


@dataclass(frozen=True)
class Explained:
    """All explanations of a difference.

    Attributes:
        from_s: First difference [s].
        to_s: End of the window [s].
        ranked: Best first.
        conclusion: What to make of it, in a sentence.
        best: Names of those that the conclusion names.
    """

    from_s: float
    to_s: float
    ranked: tuple[Explanation, ...]
    conclusion: str
    best: tuple[str, ...]


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
        experiment: What was predicted.
        parts: What was recorded.
        nominal: What was predicted, on the same rows.
        rules: Candidates and limits.
        from_s: First difference [s].
        own: What channels have whose counts differ while others are the same to the bit.
        step: Told what is being done.
    """
    last_s = max(float(part.times_s[-1]) for part in parts.values())
    lengths = [length for length in _GROWTH_S if length < rules.longest_s] + [rules.longest_s]
    ends = sorted({min(from_s + length, last_s + 1e-9) for length in lengths})
    candidates = _candidates(experiment, parts, rules)
    fitted, end_s = _model(candidates, ends, step)
    # What a sensor or the clock does, it does to the end; if the model is right for so long, no number of it is off.
    whole_s = min(last_s + 1e-9, from_s + _WHOLE_S)
    shift_s = Clock(parts, nominal, end_s).coarse_shift()
    sensors, timed, cured, until_s = list(own), [], bool(own) and all(one.sure for one in own), end_s
    for until_s in () if own else (whole_s, end_s):
        step(f"sensors and time, to {until_s:.3f} s")
        sensors = sensor_faults(parts, nominal, until_s, from_s=from_s)
        timed = Clock(parts, nominal, until_s).faults(shift_s)
        cured = cured_by(sensors, parts, _ALL)
        if cured or any(one.at_floor for one in timed):
            break
        cured = False
    if until_s > end_s:  # then the model must say the same for as long
        fitted = [candidates[one.name].again(one, until_s) if one.at_floor else one for one in fitted]
    found = [*fitted, *sensors, *timed]
    # Those that were given up on a shorter window come behind all others.
    found.sort(key=lambda one: (-one.to_s, -one.explained))
    conclusion, best = conclude(found, sensors if cured else [], rules, end_s=until_s)
    explained = Explained(from_s, until_s, tuple(found), conclusion, best)
    floor = {one.name: one for one in found if one.at_floor and one.to_s == until_s}
    if until_s >= ends[-1] or not set(best) <= set(floor) & set(candidates):
        return explained
    tied = sorted((floor[name] for name in best), key=lambda one: one.squares)[:_MOST_TIED]
    return _behind(explained, [candidates[one.name] for one in tied], candidates, ends[-1], step)


def _behind(
    first: Explained,
    causes: list[_CandidateFit],
    candidates: dict[str, _CandidateFit],
    last_s: float,
    step: Callable[[str], None],
) -> Explained:
    """With a second cause where the first explains the difference to some time only; each is fitted with the other."""
    found: list[tuple[Explanation, str]] = []
    for cause in causes:
        from_s = cause.first_off(last_s)
        ends = sorted({min(from_s + length, last_s) for length in _GROWTH_S})
        others = {name: one.along(cause) for name, one in candidates.items() if not one.shares(cause)}
        fitted, end_s = _model(others, ends, lambda text, told=cause.candidate.name: step(f"with {told}: {text}"))
        alone = cause.fit(cause.ended, end_s)
        least = np.inf if alone is None else alone.squares - DECIDES
        for one in fitted:
            if one.at_floor and one.to_s == end_s and one.squares < least:
                found.append((one, f"{cause.candidate.name} {cause.told(float(others[one.name].ended[1]))}"))
        if found and end_s >= ends[-1]:
            break
    if not found:
        return replace(first, conclusion=f"{first.conclusion}; what comes behind that is not explained")
    end_s = max(one.to_s for one, _ in found)
    fewest = min(one.squares for one, _ in found if one.to_s == end_s)
    pairs = [(one, cause) for one, cause in found if one.to_s == end_s and one.squares < fewest + DECIDES]
    named = [replace(one, name=f"{one.name}, with {cause}") for one, cause in pairs]
    told = " or ".join(f"{one.name} {one.change} with {cause}" for one, cause in pairs)
    return replace(
        first, to_s=end_s, ranked=(*named, *first.ranked), best=(*first.best, *(one.name for one in named)),
        conclusion=f"{first.conclusion}; behind that a second cause, {told}: together they explain it to {end_s:.3f} s "
        f"({named[0].left:.2f} of the noise left)",
    )  # fmt: skip


def own_explained(own: Sequence[Explanation]) -> Explained:
    """What explains that channels differ whose motion is the same to the bit: nothing but what they have."""
    from_s = min(one.from_s for one in own)
    conclusion = "sensor: " + "; ".join(one.line for one in as_faults(own))
    return Explained(
        from_s, max(one.to_s for one in own), tuple(own), conclusion, tuple(one.name for one in own if one.sure)
    )


def explain_log(
    parts: dict[str, Measured], nominal: Prediction, others: Sequence[Prediction], tuned: Tuned, rules: Attribution,
    *, from_s: float, end_s: float, faults: Sequence[SignalFault] = (), touching: bool = False,
) -> Explained:  # fmt: skip
    """What explains that a log of another system differs: sensors, or what was fitted beyond what is known of it.

    Args:
        parts: What was recorded, on the model's clock.
        nominal: What was predicted, on the same rows.
        others: What might be predicted as well.
        tuned: What was fitted.
        rules: Limits.
        from_s: First difference [s].
        end_s: How far the model has been followed [s].
        faults: What signals show by themselves.
        touching: The shaft is in contact where the log begins.
    """
    sensors = sensor_faults(parts, nominal, end_s, others)
    # What one fault brings along elsewhere, in the fit before, is none of its own.
    most = max((one.explained for one in sensors), default=0.0)
    brought = [one for one in sensors if one.explained <= _BESIDE * most]
    sensors = [one for one in sensors if one.explained > _BESIDE * most]
    trigger = any(one.name == "hammer delay" for one in sensors)
    far = [one for one in tuned.fitted if one.beyond and not (trigger and one.key == "clock.offset_s")]
    cured = cured_by(sensors, parts)
    numbers = numbers_of_the_model(parts, nominal, others, tuned, rules, end_s=end_s) if sensors or far else []
    # One that explains no more than the sensors do is not told beside them.
    numbers = [one for one in numbers if one.at_floor or one.explained > MOST]
    told_s = min((one.to_s for one in numbers), default=end_s)
    conclusion, best = conclude([*sensors, *numbers], sensors if cured else [], rules, end_s=told_s)
    if brought and cured:
        conclusion += f"; {_and(channels_in(brought, tuned.scales))} beside it: brought along, or another fault"
    early = next((one.value for one in sensors if one.name == "hammer delay" and one.value < 0.0), None)
    probes = [name for name in tuned.scales if name in default_table().groups["probes"].names]
    if early is not None and best and len(probes) > 1:
        # Until forces answer, nothing but the probes tells of time.
        conclusion += f"; or sensor: {', '.join(probes)} delay {-early * 1e6:+.4g} µs: "
        conclusion += "up to the first contact these look alike, and this log cannot tell"
    if far:
        also = f"; {conclusion}" if best else ""
        best = (*(one.key for one in far), *best)
        conclusion = "beyond what is known of it: " + "; ".join(one.line for one in far) + also
    elif not best and faults:
        conclusion = f"what signals show by themselves comes first: {'; '.join(one.line for one in faults)}"
    elif not best and float(np.median(list(tuned.scales.values()))) > _AT_ODDS:
        if touching:
            conclusion = "the log begins in contact, and where the shaft was before that, it does not tell: take one "
            conclusion += "that begins before the hammer pulse"
        else:
            conclusion = "nothing goes together from the hammer pulse on: its time, several channels, or the model is "
            conclusion += "off; this log cannot tell"
    elif not best and (part := sum(one.explained for one in sensors)) > rules.enough:
        conclusion = f"nearest are {_listed(sensors)}: {part:.0%} of the difference; "
        conclusion += "the rest is another fault, or the model"
    elif not best and 0 < len(few := channels_in(sensors, tuned.scales)) < FEW_CHANNELS * len(tuned.scales):
        conclusion = f"of {len(tuned.scales)} channels {_and(few)} alone: a fault that has no name here, "
        conclusion += "or a number of the model that moves no other; this log cannot tell"
    elif not best:
        conclusion = "neither a sensor nor the clock explains it: the model is off; `rig identify` fits numbers of it"
    return Explained(
        from_s, end_s, tuple(sorted([*sensors, *numbers], key=lambda one: -one.explained)), conclusion, best
    )


class _CandidateFit:
    """The residual as a function of one candidate's number, and of that of a cause found before, which is fitted along.

    Attributes:
        candidate: The candidate.
        ended: Where the fit ended that counts, its own number first, shape (1,) or (2,).
        step: Of a difference quotient.
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
        self._start = {key: value_of(experiment, key) for key in candidate.keys}
        # A value of 0 has no parts to change by: it changes in its own unit.
        self._absolute = bool(candidate.unit) or 0.0 in self._start.values()
        self._unit = candidate.unit or (unit_of(candidate.keys[0]) if self._absolute else "")
        self._scale = {} if self._absolute else self._start
        self.step = candidate.step
        if candidate.unit and candidate.step == Candidate.model_fields["step"].default:
            self.step *= scale_of(experiment, candidate.keys[0])

    def told(self, p: float) -> str:
        """A number of it in words."""
        return f"{p:+.4g} {self._unit}".removesuffix(" 1") if self._absolute else f"{100.0 * p:+.3g} %"

    def along(self, cause: _CandidateFit) -> _CandidateFit:
        """The same with a cause that is fitted along, from where its own fit ended."""
        return _CandidateFit(self._experiment, self.candidate, self._parts, cause)

    def shares(self, other: _CandidateFit) -> bool:
        """Whether both change the same value."""
        return not self._start.keys().isdisjoint(other._start)

    def first_off(self, end_s: float) -> float:
        """Time of the first sample that is far off with the number where the last fit ended, up to an end [s]."""
        found = self._predicted(self.ended, end_s)
        off = {} if found is None else {name: np.abs(scaled(self._parts[name], v)) for name, v in found.values.items()}
        rows = {
            name: np.flatnonzero(each[:, smooth_columns(self._parts[name])].max(axis=1, initial=0.0) > _OFF)
            for name, each in off.items()
        }
        return min(
            (float(self._parts[name].times_s[each[0]]) for name, each in rows.items() if len(each)), default=end_s
        )

    def changed(self, p: float) -> dict[str, float]:
        """The values that it changes, with its number."""
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
        """Residuals over floors, shape (n,); None where the model does not take the numbers.

        Args:
            values: The numbers.
            end_s: End of the window [s].
        """
        prediction = self._predicted(values, end_s)
        return None if prediction is None else vector(self._parts, prediction.values)

    def search(self, end_s: float) -> Fit | None:
        """The best of the fits from a few places: those with the smallest flattened residuals."""
        places = []
        for part in _STARTS:
            start = self._begin.copy()
            start[0] = part * self.candidate.largest
            z = self.residuals(start, end_s)
            if z is not None:
                # Impacts that do not overlap outweigh everything and give no slope to follow, while the smooth motion
                # between them does.
                places.append((float(np.sum(np.arcsinh(z) ** 2)), abs(part), part, start))
        best: Fit | None = None
        for *_, start in sorted(places, key=lambda place: place[:3])[:_TRIED]:
            found = self.fit(start, end_s)
            if found is not None and (best is None or found.squares < best.squares):
                best = found
            if found is not None and is_noise(found.residuals):
                break
        return best

    def fit(self, start: np.ndarray, end_s: float) -> Fit | None:
        """The numbers that leave least on a window, near a start."""
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
        return fit(residuals, slopes, start, rounds=_ROUNDS, gain=_GAIN, farthest=largest, longest=largest / 4.0)

    def explanation(self, found: Fit, before: float, to_s: float) -> Explanation:
        """What a fit comes to, against the excess of the residuals without it."""
        p, unit, key = float(found.values[0]), self._unit, self.candidate.keys[0]
        kind: Kind = "time" if key.endswith(".at_s") else "command" if key.startswith("hammer.") else "model"
        return Explanation.of(
            found.residuals, kind=kind, name=self.candidate.name,
            change=self.told(p), value=p, unit=unit,
            explained=1.0 - excess(found.residuals) / before, to_s=to_s,
        )  # fmt: skip

    def before(self, end_s: float) -> float:
        """Excess of the residuals of the experiment as it is, or with the cause found before."""
        z = self.residuals(self._begin, end_s)
        return 0.0 if z is None else excess(z)

    def again(self, one: Explanation, end_s: float) -> Explanation:
        """The same on a longer window, from where its fit ended."""
        before = self.before(end_s)
        found = self.fit(self.ended, end_s)
        return one if found is None or before == 0.0 else self.explanation(found, before, end_s)


def _candidates(experiment: Experiment, parts: dict[str, Measured], rules: Attribution) -> dict[str, _CandidateFit]:
    """The candidates that an experiment has, by name."""
    found = {}
    for candidate in rules.candidates:
        try:
            found[candidate.name] = _CandidateFit(experiment, candidate, parts)
        except InputError:
            continue  # the experiment has no such number: no hammer pulse, no speed
    return found


class _WindowStage(NamedTuple):
    """What the candidates explain on one window."""

    end_s: float
    fitted: list[Explanation]
    fits: dict[str, Fit]

    @property
    def worth(self) -> float:
        """1 where one candidate explains all down to the noise, else how much the best explains."""
        best = max(self.fitted, key=lambda one: one.explained, default=None)
        if best is None:
            return 0.0
        return 1.0 if best.at_floor else round(best.explained, 3) * 0.999


def _model(
    candidates: dict[str, _CandidateFit], ends: list[float], step: Callable[[str], None]
) -> tuple[list[Explanation], float]:
    """What each candidate explains, and the end of the window that this is said of [s]."""
    places = {
        name: one.ended for name, one in candidates.items()
    }  # where the fits begin, of those that are not given up
    stages: list[_WindowStage] = []
    for end_s in ends:
        fits: dict[str, Fit] = {}
        for name, p in places.items():
            step(f"{name}, to {end_s:.3f} s")
            found = candidates[name].fit(p, end_s)
            if found is not None:
                fits[name] = found
        if not stages and not any(is_noise(found.residuals) for found in fits.values()):
            for name in places:
                step(f"{name}, looked for further away")
                far = candidates[name].search(end_s)
                if far is not None and (name not in fits or far.squares < fits[name].squares):
                    fits[name] = far
        before = next(iter(candidates.values())).before(end_s) if candidates else 0.0
        told = {
            name: candidates[name].explanation(found, before, end_s) for name, found in fits.items() if before > 0.0
        }
        stages.append(_WindowStage(end_s, [one for one in told.values() if one.explained > 0.0], fits))
        best = max((one.explained for one in told.values()), default=0.0)
        fewest = min((one.squares for one in told.values()), default=0.0)
        places = {
            name: fits[name].values
            for name, one in told.items()
            if one.explained > max(0.0, best - _KEEP) or one.squares < fewest + 4.0 * DECIDES
        }
    # The longest window that one number explains to the noise tells candidates apart best; behind it, motion that is
    # too sensitive for a fit says nothing.
    chosen = max(range(len(stages)), key=lambda k: (stages[k].worth, k))
    kept = {one.name: one for stage in stages[: chosen + 1] for one in stage.fitted}
    for name, found in stages[chosen].fits.items():
        candidates[name].ended = found.values
    return list(kept.values()), stages[chosen].end_s


def conclude(
    found: list[Explanation], cured: list[Explanation], rules: Attribution, *, end_s: float
) -> tuple[str, tuple[str, ...]]:
    """What to make of explanations, in a sentence, and the names in it.

    Args:
        found: All of them.
        cured: Sensor faults that together leave nothing but noise; empty where they do not.
        rules: What is enough, and what is equal.
        end_s: End of the window that those that were not given up are said of [s].
    """
    alone = [one for one in found if one.kind != "sensor" and one.to_s == end_s]
    single = max(alone, key=lambda one: one.explained, default=None)
    if cured and (single is None or not single.at_floor or len(cured) == 1):
        names = tuple(one.name for one in cured)
        text = "; ".join(f"{one.name} {one.change}" for one in cured)
        most = sum(one.explained for one in cured)
        # What is one number against several is told beside them, if it explains as much.
        also = [one for one in alone if one.at_floor or (cured[1:] and one.explained > most - rules.equal)]
        if also:
            text = f"sensor: {text}, or {_listed(also)} explain it alike; this recording cannot tell"
            return text, (*names, *(one.name for one in also))
        beyond = f"; {rest:.2g} times the noise is left" if (rest := max(one.left for one in cured)) > _NEAR else ""
        return f"sensor: {text} ({min(1.0, most):.1%} of the difference{beyond})", names
    if single is None or single.explained < rules.enough:
        most = f"; the most is {single.name} with {single.explained:.0%}" if single else ""
        return f"no single candidate explains it{most}", ()
    if single.at_floor:
        equal = [one for one in alone if one.squares < single.squares + DECIDES]
    else:
        equal = [one for one in alone if one.explained > single.explained - rules.equal]
    names = tuple(one.name for one in equal)
    part = f"{single.explained:.2%} of the difference to {end_s:.3f} s, {single.left:.2f} of the noise left"
    short = "" if single.left < _NEAR else "nothing alone explains it down to the noise; nearest is "
    if len(equal) == 1:
        return f"{short}{single.kind}: {single.name} {single.change} ({part})", names
    return f"{short}{_listed(equal)} explain it equally ({part}); this recording cannot tell them apart", names


def _and(names: list[str]) -> str:
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)


def _listed(found: list[Explanation]) -> str:
    return ", ".join(f"{one.name} {one.change}" for one in found)
