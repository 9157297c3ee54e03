"""What a log of another system does not tell exactly: its clock, the shaft's angle, the speed, the force of the pulse.

A recording of this rig has all of that to the tick. Of an imported log it is fitted along with whatever is asked, so
that it neither spoils other values nor passes for a fault of the model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from recorder.reader import Recording
from replays.estimate.intervals import draw_normal
from replays.recordings.identification.agreement import (
    BEYOND,
    Here,
    approach,
    by_agreement,
    centred,
    channels_of,
    elsewhere,
    half_without_parts,
    look,
    rms,
    signals_of,
)
from replays.recordings.identification.request import first_command_s, observe
from replays.recordings.resimulation.experiment import BEFORE_S, Experiment
from replays.recordings.resimulation.prediction import Measured, Prediction
from replays.recordings.resimulation.sensitivity import (
    ANGLE,
    STATE,
    Predictor,
    on_the_models_clock,
    value_of,
    with_values,
)
from rig.base.errors import InputError, Words
from rig.run.simulation import TICK_RATE_HZ

NUISANCES = (
    "clock.offset_s",
    "clock.rate_ppm",
    ANGLE,
    *STATE,
    "drive.speed_hz",
    "hammer.1.force_n",
    "hammer.1.duration_ms",
    "ring.offset_x",
    "ring.offset_y",
)
"""In place of the time of the first pulse stand clock and angle: a simulation has pulses only at its own ticks."""
_PULSE = "hammer.1.at_s"
_DEVIATIONS = {"clock.rate_ppm": 50.0, "clock.offset_s": 1e-4, "ring.offset_x": 0.1, "ring.offset_y": 0.1}
"""What is known before, as standard deviations: of a crystal [ppm]; of a trigger that is found in samples behind a
filter [s]; of a ring that was put where it is by hand [mm]; ..."""
_RELATIVE = {"drive.speed_hz": 1e-4, "hammer.1.duration_ms": 0.01}
"""... and of a speed and the length of a pulse that are read off the log, as a part of them; `Experiment.unsure` has
what is told less surely."""
_ANOTHER = 0.2
"""Part by which two instruments do not differ that measure one speed."""
_LOOSER = 100.0
"""Where a value wants beyond, it is given so many times the room, to see where to."""
_TURNS_S = 3.0
"""So much of the edges before the hammer pulse tells the speed [s]."""
_LEAST_LOOK_S = 0.02
_SETTLED_S = 0.01
"""Samples so soon behind the begin still show what filters were filled with [s]."""
_MARGIN_S = 2e-3
"""What is before the hammer pulse ends here [s], as its time is not known better."""
_BEFORE_S, _EVERY = 0.03, 8
"""Of what is longer before the hammer pulse [s] so many samples are one: it tells where the shaft was, and no more."""
_WINDOWS_S = (4e-3, 8e-3, 13e-3, 20e-3, 30e-3)
"""How far behind the begin of the hammer pulse the fits look [s]."""
_LAST = 2
"""Growths of the window by which it is told how far values are moved by what the model lacks."""
_LATE_S = 5e-3
"""So far from where the log has it the pulse is looked for where nothing goes together [s]."""
_WORSE = 1.2
"""A longer window is given up where it leaves more by this factor in a third of the channels; ..."""
_BROKEN = 10.0
"""... one that it leaves so much more of is a faulty one."""


@dataclass(frozen=True)
class Fitted:
    """One fitted number: where it began, where it ended, and half of its 95 % interval, in its unit.

    The interval is that of the noise, with what the last samples that came moved the number by, and a jackknife.
    """

    key: str
    start: float
    value: float
    half_width: float
    known: tuple[float, float] | None = None
    """Mean and standard deviation before."""

    @property
    def beyond(self) -> bool:
        """Whether it is as far from what is known of it as it may go."""
        return _is_beyond(self.value, self.known)

    @property
    def line(self) -> str:
        """In words."""
        if self.key == "clock.offset_s":
            return f"time: shifted by {self.value * 1e6:+.1f} ±{1.0e6 * self.half_width:.2g} µs, fitted"
        if self.key == _PULSE:
            late = 1e6 * (self.value - self.start)
            return f"time: hammer pulse shifted by {late:+.1f} ±{1e6 * self.half_width:.2g} µs, fitted"
        if self.key == "clock.rate_ppm":
            return f"clock: {self.value:+.1f} ±{self.half_width:.2g} ppm fast, fitted"
        change = self.value - self.start
        return f"{self.key}: {self.value:.6g} ±{self.half_width:.2g}, fitted ({change:+.2g} on what the log tells)"


def _is_beyond(value: float, known: tuple[float, float] | None) -> bool:
    return known is not None and abs(value - known[0]) > 0.99 * BEYOND * known[1]


@dataclass(frozen=True)
class Tuned:
    """An imported log and its experiment, brought together.

    Attributes:
        begun: The experiment before the fit.
        experiment: With the fitted numbers, those of a hammer pulse as its rows can have them.
        fitted: What was fitted.
        values: The same, by key.
        covariance: Of them, shape (values, values).
        moves: What the last growths of the window moved them by, shape (growths, values): they stand for the deviation
            that what the model lacks makes.
        about_s: Where the clocks differ by the offset alone [s].
        end_s: End of the samples that it rests on [s].
        longest_s: To where it would have gone on, had the model explained it [s].
        scales: RMS of what is left of each channel over its noise, at least 1.
    """

    begun: Experiment
    experiment: Experiment
    fitted: tuple[Fitted, ...]
    values: dict[str, float]
    covariance: np.ndarray
    moves: np.ndarray
    about_s: float
    end_s: float
    longest_s: float
    scales: dict[str, float]

    def on_time(self, parts: dict[str, Measured]) -> dict[str, Measured]:
        """Channels of the log on the model's clock."""
        return on_the_models_clock(parts, self.values, about_s=self.about_s)

    def better_than(self, other: Tuned) -> bool:
        """Whether it goes on for longer, or as long with less left."""
        left, its = (sum(math.log(scale) for scale in one.scales.values()) for one in (self, other))
        return (self.end_s, -left) > (other.end_s, -its)

    def changed(self, changes: dict[str, Any]) -> Tuned:
        """The same numbers with another model."""
        return replace(self, begun=self.begun.changed(changes))

    def before(self) -> Tuned:
        """The same as the fit was before its window last grew: on that it was as right."""
        moved = zip(self.values.items(), self.moves[-1].tolist(), strict=True)
        return replace(self, values=_possible(self.begun, {key: value - by for (key, value), by in moved}))

    def drawn(self, generator: np.random.Generator) -> Tuned:
        """The same with values as far off as the fit leaves open, and as what the model lacks still moves them."""
        off = draw_normal(self.covariance, generator, 1)[0]
        off += generator.standard_normal(len(self.moves)) @ self.moves
        moved = {key: value + d for (key, value), d in zip(self.values.items(), off.tolist(), strict=True)}
        return replace(self, values=_possible(self.begun, moved))

    def predict(self, parts: dict[str, Measured]) -> Prediction:
        """What is predicted for channels of the log, on its own clock."""
        predictor = Predictor(self.begun, tuple(self.values), parts, about_s=self.about_s)
        return predictor.predict(tuple(self.values.values()))


def nuisances_of(
    experiment: Experiment, keys: Sequence[str] = NUISANCES, *, besides: Sequence[str] = ()
) -> dict[str, tuple[float, float] | None]:
    """Nuisances that an experiment has, and what is known of each before: mean and standard deviation, or None.

    Args:
        experiment: The experiment.
        keys: The nuisances.
        besides: What is asked anyway.
    """
    if experiment.begin is None:  # it has run from the scene's own start: the pulse is late, and not the clock
        keys = [_PULSE if key == "clock.offset_s" else key for key in keys]
    found: dict[str, tuple[float, float] | None] = {}
    for key in keys:
        if key in besides:
            continue
        try:
            value = value_of(experiment, key)
        except InputError:
            continue  # no hammer pulse
        deviation = experiment.unsure.get(key) or _DEVIATIONS.get(key) or _RELATIVE.get(key, 0.0) * abs(value)
        found[key] = (value, deviation) if deviation else None
    return found


def turned(recording: Recording, experiment: Experiment) -> Experiment:
    """With speed, angle and place of the shaft as the motion before the hammer pulse has them.

    Small motions are a sum: of one that begins elsewhere, and of one by the unbalance, as a cosine and a sine.
    Least squares over a few turns, in which a channel counts by what it leaves: one that is faulty has no say.
    """
    first_s = _told_until_s(experiment)
    experiment = _with_speed_of_edges(recording, experiment)
    start_s, end_s = looks_from(experiment), first_s - _MARGIN_S
    if end_s - start_s < _LEAST_LOOK_S:
        return experiment
    parts = observe(recording, experiment, window=(start_s, end_s)).parts
    keys = (*(STATE if experiment.begin is not None else ()), ANGLE)
    predictor = Predictor(experiment, keys, parts)

    def shown(values: Sequence[float] | np.ndarray) -> list[np.ndarray]:
        found = predictor.predict(np.asarray(values)).values
        return [one for one, _ in channels_of(parts, found)]

    still = np.zeros(len(keys))
    still[: len(keys) - 1] = predictor.start[:-1]
    ahead, behind, beside = (shown([*still[:-1], angle]) for angle in (0.0, math.pi, math.pi / 2.0))
    moved = [shown(still + step) for step in np.diag(predictor.scales)[:-1]]
    middle = [(a + b) / 2.0 for a, b in zip(ahead, behind, strict=True)]
    target, columns = [], []
    for c, (measured, floor) in enumerate(channels_of(parts, {name: part.values for name, part in parts.items()})):
        slopes = [(ahead[c] - behind[c]) / 2.0, beside[c] - middle[c], *(one[c] - ahead[c] for one in moved)]
        # What a probe's zero is, this does not tell: without each channel's mean.
        target.append(centred(measured - middle[c]) / floor)
        columns.append(centred(np.column_stack(slopes)) / floor)
    found = by_agreement(target, columns, signals_of(parts))
    moves = np.array([*found[2:], 0.0]) * predictor.scales
    values = dict(zip(keys, (still + moves).tolist(), strict=True))
    return with_values(experiment, values | {ANGLE: math.atan2(found[1], found[0])})


def _with_speed_of_edges(recording: Recording, experiment: Experiment) -> Experiment:
    """At the speed that the keyphasor's edges tell, which no calibration can spoil; without edges as it was.

    Where they tell quite another speed than the tachometer, that which the probes turn at is right.
    """
    first_s, told_hz = first_command_s(experiment) or math.inf, experiment.scene.drive.speed_hz
    edges_s = recording.edges()
    edges_s = edges_s[edges_s < first_s]
    edges_s = edges_s[edges_s > edges_s[-1:].sum() - _TURNS_S] if len(edges_s) else edges_s
    if len(edges_s) < 3 or experiment.scene.drive.profile:
        return experiment
    steps = np.diff(edges_s)
    turns = np.rint(steps / np.median(steps)).sum()  # one that is missing is two turns
    speed_hz = float(turns / (edges_s[-1] - edges_s[0]))
    if abs(speed_hz - told_hz) > _ANOTHER * told_hz > 0.0:
        parts = observe(recording, experiment, window=(looks_from(experiment), first_s - _MARGIN_S)).parts
        speed_hz = max(speed_hz, told_hz, key=lambda hz: _turning(parts, hz))
    return with_values(experiment, {"drive.speed_hz": speed_hz})


def _turning(parts: Mapping[str, Measured], speed_hz: float) -> float:
    """How much of the channels goes round at a speed, over their noise, without what is steady or drifts."""
    found = 0.0
    for part in parts.values():
        turning = np.exp(2j * math.pi * speed_hz * part.times_s) * np.hanning(len(part.times_s))
        found += float(np.sum(np.abs(turning @ (centred(part.values) / part.floor)) ** 2)) / len(part.times_s)
    return found


def asked_along(experiment: Experiment, keys: Sequence[str]) -> dict[str, tuple[float, float] | None]:
    """Nuisances that are fitted along with what is asked of an imported log: those that a search can take.

    The length of a hammer pulse only in rows of the simulation, and the speed is known before.
    """
    few = tuple(key for key in NUISANCES if key not in ("drive.speed_hz", "hammer.1.duration_ms"))
    return nuisances_of(experiment, few, besides=keys)


def tune(
    recording: Recording,
    experiment: Experiment,
    keys: Sequence[str] = NUISANCES,
    *,
    known: Mapping[str, tuple[float, float]] | None = None,
    channels: Sequence[str] | None = None,
    to_s: float | None = None,
    late_s: Mapping[str, float] | None = None,
    progress: Callable[[str], None] = lambda _text: None,
) -> Tuned:
    """Fit what a log does not tell exactly, and nothing else, on windows that grow from the pulse.

    A channel counts by what it leaves itself, so that a faulty one does not turn the others; and no value goes further
    from what is known of it than `BEYOND` standard deviations.

    Args:
        recording: The log.
        experiment: What was done, as far as it is known.
        keys: What is fitted of it.
        known: What is known of some of them: means and standard deviations.
        channels: By which channels; None for all.
        to_s: Samples are used up to here [s].
        late_s: By how much some channels are taken to be late [s].
        progress: Told what is being done.

    Raises:
        InputError: There are no samples to do it by, or none before the pulse.
    """
    progress("speed, angle and place of the shaft before the hammer pulse")
    begun = turned(recording, experiment) if ANGLE in keys else experiment
    wanted = nuisances_of(begun, keys) | dict(known or {})
    first_s = _told_until_s(begun)
    if first_s <= looks_from(begun):
        must = (
            f"a log that begins more than {1e3 * _SETTLED_S:g} ms before the hammer pulse, to tell where the shaft was"
        )
        raise InputError("file", must, Words(f"{recording.path}, of which the pulse comes at {first_s:.4g} s"))
    end_s = min(first_s + _WINDOWS_S[-1], math.inf if to_s is None else to_s)
    whole = observe(recording, begun, channels=channels, window=(looks_from(begun), end_s)).parts
    whole = {name: part.earlier(late_s or {}) for name, part in whole.items()}
    whole = {name: _thinned(part, first_s - _BEFORE_S) for name, part in whole.items()}
    found = _best(begun, wanted, whole, progress)
    if max(found.scales) > _BROKEN and (early := _with_earlier_pulse(begun, whole)) is not None:
        other = _grown(early, wanted, whole, progress, trusting=True, without=("hammer",))
        if other.worth() > found.worth():
            begun, found = early, other
    far = [key for key, value in zip(wanted, found.values, strict=True) if _is_beyond(float(value), wanted[key])]
    if far:
        looser = wanted | {key: (told[0], _LOOSER * told[1]) for key in far if (told := wanted[key]) is not None}
        found = max(found, _best(begun, looser, whole, progress), key=_Grown.worth)
    half = np.hypot(1.96 * np.sqrt(np.diag(found.covariance) + np.mean(found.moves**2, axis=0)), found.lacking)
    told = dict(zip(wanted, found.values.tolist(), strict=True))
    # What was known before goes on being known, about where it was.
    loosest = [1.96 * math.hypot(one[1], told[key] - one[0]) if one else math.inf for key, one in wanted.items()]
    return Tuned(
        begun=begun,
        experiment=with_values(begun, told),
        fitted=tuple(
            Fitted(key, value_of(experiment, key), value, width, wanted[key])
            for (key, value), width in zip(told.items(), np.minimum(half, loosest).tolist(), strict=True)
        ),
        values=told,
        covariance=found.covariance,
        moves=found.moves,
        about_s=min(float(part.times_s[0]) for part in whole.values()),
        end_s=found.end_s,
        longest_s=end_s,
        scales=dict(zip((name for part in whole.values() for name in part.names), found.scales, strict=True)),
    )


def _possible(experiment: Experiment, values: dict[str, float]) -> dict[str, float]:
    """Values as a rig can have them: one that it cannot, far off where a log tells little, stays as it was."""
    try:
        with_values(experiment, values)
    except InputError:
        if len(values) == 1:
            return {key: value_of(experiment, key) for key in values}
        each = (_possible(experiment, {key: value}) for key, value in values.items())
        return {key: value for one in each for key, value in one.items()}
    return values


@dataclass(frozen=True)
class _Grown:
    """Values on the longest window that they explain, and what they are worth.

    Attributes:
        values: Shape (keys,).
        covariance: Of them.
        moves: What the last growths of the window moved them by, shape (growths, keys).
        end_s: End of the window [s].
        scales: What is left of each channel over its noise.
        lacking: Half of 95 % intervals by what they do without parts of the samples, shape (keys,).
    """

    values: np.ndarray
    covariance: np.ndarray
    moves: np.ndarray
    end_s: float
    scales: list[float]
    lacking: np.ndarray

    @property
    def odds(self) -> float:
        """What is left of the middle one of the channels."""
        return float(np.median(self.scales))

    def worth(self) -> tuple[float, float]:
        """What goes on for longer is worth more, then what leaves less."""
        return self.end_s, -sum(map(math.log, self.scales))


def _best(
    begun: Experiment,
    wanted: dict[str, tuple[float, float] | None],
    whole: dict[str, Measured],
    progress: Callable[[str], None],
) -> _Grown:
    """Where channels are at odds from the start, it depends on whom one believes: the log, or all but the hammer."""
    found = _grown(begun, wanted, whole, progress, trusting=False)
    for without in ((), ("hammer",)):
        early = without and found.end_s <= _told_until_s(begun) + _WINDOWS_S[0]  # the hammer is no witness of that
        if early or (max(found.scales) > _BROKEN and (found.odds > _BROKEN or not without)):
            other = _grown(begun, wanted, whole, progress, trusting=True, without=without)
            found = max(found, other, key=_Grown.worth)
    return found


def _with_earlier_pulse(begun: Experiment, whole: dict[str, Measured]) -> Experiment | None:
    """With the pulse when most channels say that it came, where that is not when the hammer says."""
    if not (first_s := first_command_s(begun)) or begun.begin is None:
        return None
    # Not what is long before: that tells nothing of it.
    parts = {name: part.until(first_s + _WINDOWS_S[0]).from_(first_s - _LATE_S) for name, part in whole.items()}
    predictor, at_s = Predictor(begun, (_PULSE,), parts), value_of(begun, _PULSE)

    def left(late_s: float) -> float:
        here = look(predictor, np.array([at_s + late_s]))
        return math.inf if here is None else sum(math.log(max(1.0, rms(z))) for z in here.apart)

    late_s = min(np.linspace(-_LATE_S, _LATE_S, 41).tolist(), key=left)
    return with_values(begun, {_PULSE: at_s + late_s}) if left(late_s) < left(0.0) else None


def _grown(
    begun: Experiment,
    wanted: dict[str, tuple[float, float] | None],
    whole: dict[str, Measured],
    progress: Callable[[str], None],
    *,
    trusting: bool,
    without: Sequence[str] = (),
) -> _Grown:
    """Fit on windows that grow from the pulse.

    Args:
        begun: The experiment.
        wanted: What is fitted, with what is known of it.
        whole: The samples.
        progress: Told what is being done.
        trusting: Believe first what agrees with what the log tells.
        without: Channels that have no say.
    """
    first_s, every = _told_until_s(begun), [name not in without for part in whole.values() for name in part.names]
    values = np.array([value_of(begun, key) for key in wanted])
    covariance, end_s, scales, moves = np.eye(len(values)), first_s, list[float](), [np.zeros(len(values))]
    lacking = np.zeros(len(values))
    for length in _WINDOWS_S:
        progress(f"{len(wanted)} numbers that the log does not tell exactly: to {first_s + length:.3f} s")
        parts = {name: part.until(first_s + length) for name, part in whole.items()}
        predictor = Predictor(begun, tuple(wanted), parts)
        # Without a prior a value is held as loosely as makes no difference, so that what is not seen stays.
        loose = zip(predictor.start, predictor.scales, strict=True)
        known = np.array([prior or held for prior, held in zip(wanted.values(), loose, strict=True)]).T

        def fitted(start: np.ndarray) -> tuple[np.ndarray, Here, list[float]]:
            found, here = approach(predictor, start, known, trusting=trusting, heard=every)  # noqa: B023
            heard = [has and rms(z) <= _BROKEN for z, has in zip(here.apart, every, strict=True)]
            if len(heard) / 2.0 < sum(heard) < len(heard):
                # What is plainly wrong has no say at all: the little that it keeps moves what no other channel tells.
                found, here = approach(predictor, found, known, trusting=True, heard=heard)  # noqa: B023
            return found, here, [max(1.0, rms(z)) for z in here.apart]

        found, here, now = fitted(values)
        unseen = [
            place for place, key in enumerate(wanted)
            if key not in NUISANCES and covariance[place, place] > 0.25 * known[1, place] ** 2
        ]  # fmt: skip
        if scales and unseen and _is_worse(now, scales):
            found, here, now = fitted(elsewhere(predictor, values, unseen, every))
        if _is_worse(now, scales):
            break  # the model no longer explains it: that is to be judged, and not to be fitted away
        scales = now
        square = sum(one.T @ one / scale**2 for one, scale in zip(here.slopes, scales, strict=True))
        moves.append(found - values)
        covariance, values = np.linalg.inv(square + np.diag(known[1] ** -2.0)), found
        times = [part.times_s for part in parts.values() for _ in part.names]
        before = np.diag(known[1] ** -2.0), np.zeros(len(values))
        end_s, lacking = first_s + length, half_without_parts(here, times, scales, before, first_s)
    return _Grown(values, covariance, np.array(moves[-_LAST:]), end_s, scales, lacking)


def _is_worse(now: list[float], before: list[float]) -> bool:
    """Whether what is left of channels is no longer what it was on a shorter window."""
    worse = [b / a for a, b in zip(before, now, strict=False) if b > _WORSE * a]
    return 2 * len(worse) > len(now) or 3 * sum(times < _BROKEN for times in worse) > len(now)


def _told_until_s(experiment: Experiment) -> float:
    """When the first hammer pulse comes; without one, as long behind the begin as is looked at before a pulse [s]."""
    return first_command_s(experiment) or looks_from(experiment) + BEFORE_S


def looks_from(experiment: Experiment) -> float:
    """From where on samples before the hammer pulse are looked at [s]."""
    begin_s = experiment.first_s if experiment.begin is None else experiment.begin.tick / TICK_RATE_HZ + _SETTLED_S
    return max(begin_s, first_command_s(experiment) - BEFORE_S)


def _thinned(part: Measured, until_s: float) -> Measured:
    """All rows from a time on, and some of those before it."""
    return part.chosen(np.flatnonzero((part.times_s >= until_s) | (np.arange(len(part.times_s)) % _EVERY == 0)))
