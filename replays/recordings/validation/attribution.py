"""What a difference between recording and model comes from: a sensor, the time, a command, or a number of the model.

Each candidate is one number, fitted by Gauss-Newton's method to the recorded channels over their noise, on windows that
grow from the first difference on: behind an impact a change acts so strongly that only a start close by converges. What
is told is how much of the residual each explains, so that two that explain it alike are seen to do so.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from replays.recordings.experiment import Experiment
from replays.recordings.prediction import Measured, Prediction, predict
from replays.recordings.sensitivity import scale_of, value_of, with_values
from replays.recordings.validation.criteria import Attribution, Candidate
from replays.recordings.validation.trajectory import scaled
from rig.errors import InputError, SimulationError

Kind = Literal["sensor", "time", "command", "model"]

_GROWTH_S = (5e-3, 10e-3, 20e-3, 40e-3, 80e-3, 160e-3)
"""Lengths of the windows behind the first difference [s]; the last is the criteria's own."""
_ROUNDS = 6
_KEEP = 0.3
"""A candidate is given up when it explains less than the best by this, and the noise cannot have decided it."""
_SIGMAS = 6.0
"""Residuals are noise while their sum of squares is above its mean by less than so many standard deviations."""
_DECIDES = 25.0
"""A sum of squares that is smaller by this (five standard deviations of one number) decides between two candidates."""
_NEAR = 2.0
"""Of the noise left, from which on a candidate is the nearest, and no explanation."""
_STARTS = (0.0, *(sign * part for part in (0.005, 0.01, 0.02, 0.035, 0.06, 0.1, 0.2, 0.5) for sign in (1.0, -1.0)))
"""Where a fit may start on the first window, as parts of the farthest that it may go ..."""
_TRIED = 3
"""... and from how many of these it does."""
_WHOLE_S = 5.0
"""How far sensors and time are looked at behind the first difference [s]."""
_SEARCH = 400
"""Samples by which the time may be off in the first search, either way."""
_UNTIMED = ("keyphasor",)
"""A pulse is no smooth function of anything."""


@dataclass(frozen=True)
class Explanation:
    """One thing that may be off.

    Attributes:
        kind: Sensor, time, a command, or model.
        name: What.
        change: By how much, in words.
        value: The same as a number: a part, or in `unit`.
        unit: Unit of `value`; "" for a part of the value itself.
        explained: Part of the residual's excess over noise that it takes away.
        left: RMS of what is left over the floor, in the channels that it is about.
        squares: Sum of squares of the same.
        n: Samples in it.
        to_s: End of the window that this is said of [s]; earlier than the others' where it was given up there.
    """

    kind: Kind
    name: str
    change: str
    value: float
    unit: str
    explained: float
    left: float
    squares: float
    n: int
    to_s: float

    @property
    def at_floor(self) -> bool:
        """Nothing but noise is left."""
        return self.squares < self.n + _SIGMAS * math.sqrt(2.0 * self.n)  # as `_noise`


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
    step: Callable[[str], None] = lambda _text: None,
) -> Explained:
    """Find what explains a difference.

    Args:
        experiment: What was foretold.
        parts: What was recorded.
        nominal: What was foretold, on the same rows.
        rules: Candidates and limits.
        from_s: First difference [s].
        step: Told what is being done.
    """
    last_s = max(float(part.times_s[-1]) for part in parts.values())
    lengths = [length for length in _GROWTH_S if length < rules.longest_s] + [rules.longest_s]
    ends = sorted({min(from_s + length, last_s + 1e-9) for length in lengths})
    lines, fitted, end_s = _model(experiment, parts, rules, ends, step)
    # What a sensor or the clock does, it does to the end; if the model is right for so long, no number of it is off.
    whole_s = min(last_s + 1e-9, from_s + _WHOLE_S)
    shift = _shift(parts, nominal, end_s)
    for until_s in (whole_s, end_s):
        step(f"sensors and time, to {until_s:.3f} s")
        sensors, timed = _sensors(parts, nominal, until_s), _time(parts, nominal, until_s, shift)
        cured = bool(sensors) and all(one.at_floor for one in sensors)
        if cured or any(one.at_floor for one in timed):
            break
    else:
        until_s, cured = end_s, False
    if until_s > end_s:  # then the model must say the same for as long
        fitted = [_again(one, lines, parts, experiment, until_s) if one.at_floor else one for one in fitted]
    found = [*fitted, *sensors, *timed]
    # Those that were given up on a shorter window come behind all others.
    found.sort(key=lambda one: (-one.to_s, -one.explained))
    conclusion, best = _conclude(found, sensors if cured else [], rules, end_s=until_s)
    return Explained(from_s, until_s, tuple(found), conclusion, best)


# What is left, over the noise.


def _smooth(part: Measured) -> list[int]:
    return [c for c, channel in enumerate(part.channels) if channel.name not in _UNTIMED]


def _vector(parts: dict[str, Measured], values: dict[str, np.ndarray]) -> np.ndarray:
    """Residuals over their floors of all channels, shape (n,)."""
    return np.concatenate([scaled(parts[name], v)[:, _smooth(parts[name])].ravel() for name, v in values.items()])


def _noise(z: np.ndarray) -> bool:
    """Nothing but noise."""
    return float(z @ z) < len(z) + _SIGMAS * math.sqrt(2.0 * len(z))


def _excess(z: np.ndarray) -> float:
    """Square of the residuals beyond that of noise."""
    return max(float(z @ z) - len(z), 0.0)


def _explanation(
    kind: Kind, name: str, change: str, value: float, unit: str, explained: float, z: np.ndarray, to_s: float
) -> Explanation:
    squares, n = float(z @ z), max(1, len(z))
    return Explanation(kind, name, change, value, unit, explained, math.sqrt(squares / n), squares, n, to_s)


# The model: one number at a time.


class _Line:
    """The residual as a function of one candidate's number."""

    def __init__(self, experiment: Experiment, candidate: Candidate, parts: dict[str, Measured]) -> None:
        self._experiment, self._parts = experiment, parts
        self.candidate = candidate
        self._start = {key: value_of(experiment, key) for key in candidate.keys}
        if not candidate.unit and any(value == 0.0 for value in self._start.values()):
            raise InputError(candidate.name, "a value other than 0", 0.0)
        self._scale = {} if candidate.unit else self._start
        self._step = candidate.step
        if candidate.unit and candidate.step == Candidate.model_fields["step"].default:
            self._step *= scale_of(experiment, candidate.keys[0])

    def vector(self, p: float, end_s: float, *, flat: bool = False) -> np.ndarray | None:
        """Residuals over floors, or None where the model does not take the number.

        Args:
            p: The number.
            end_s: End of the window [s].
            flat: Large ones flattened, asinh z: impacts that do not overlap outweigh everything and give no slope to
                follow, while the smooth motion between them does.
        """
        changed = {key: value + p * self._scale.get(key, 1.0) for key, value in self._start.items()}
        try:
            prediction = predict(with_values(self._experiment, changed), self._parts, end_s=end_s)
        except (InputError, SimulationError):
            return None
        z = _vector(self._parts, prediction.values)
        return np.arcsinh(z) if flat else z

    def search(self, end_s: float) -> tuple[float, np.ndarray | None]:
        """The best of the fits from a few places: those with the smallest flat residuals."""
        flat = []
        for part in _STARTS:
            z = self.vector(part * self.candidate.largest, end_s, flat=True)
            if z is not None:
                flat.append((float(z @ z), abs(part), part * self.candidate.largest))
        best: tuple[float, np.ndarray | None] = (0.0, None)
        for _, _, start in sorted(flat)[:_TRIED]:
            p, z = self.fit(start, end_s)
            if z is not None and (best[1] is None or float(z @ z) < float(best[1] @ best[1])):
                best = (p, z)
            if z is not None and _noise(z):
                break
        return best

    def fit(self, p: float, end_s: float) -> tuple[float, np.ndarray | None]:
        """Gauss-Newton's method from a start, halving steps that make it worse."""
        z = self.vector(p, end_s)
        if z is None:
            return p, None
        for _ in range(_ROUNDS):
            moved = self.vector(p + self._step, end_s)
            if moved is None:
                break
            slope = (moved - z) / self._step
            size = float(slope @ slope)
            if size == 0.0:
                break
            change = -float(slope @ z) / size
            change = math.copysign(min(abs(change), self.candidate.largest / 4.0), change)
            better = None
            for _ in range(3):
                trial = min(max(p + change, -self.candidate.largest), self.candidate.largest)
                ahead = self.vector(trial, end_s)
                if ahead is not None and float(ahead @ ahead) < float(z @ z):
                    better = (trial, ahead)
                    break
                change *= 0.35
            if better is None:
                break
            gain = 1.0 - float(better[1] @ better[1]) / float(z @ z)
            p, z = better
            if gain < 1e-3 or change * change * size < 1e-2:
                break
        return p, z


def _model(
    experiment: Experiment,
    parts: dict[str, Measured],
    rules: Attribution,
    ends: list[float],
    step: Callable[[str], None],
) -> tuple[dict[str, _Line], list[Explanation], float]:
    """The candidates, what each explains, and the end of the window that this is said of [s]."""
    lines: list[tuple[_Line, float]] = []
    for candidate in rules.candidates:
        try:
            lines.append((_Line(experiment, candidate, parts), 0.0))
        except InputError:
            continue  # the experiment has no such number: no blow, no speed
    known = {line.candidate.name: line for line, _ in lines}
    stages: list[tuple[float, list[Explanation]]] = []
    for end_s in ends:
        before = _excess(_vector(parts, predict(experiment, parts, end_s=end_s).values))
        fits = []
        for line, p in lines:
            step(f"{line.candidate.name}, to {end_s:.3f} s")
            p, z = line.fit(p, end_s)
            fits.append((line, p, z))
        if not stages and not any(z is not None and _noise(z) for _, _, z in fits):
            for k, (line, _, z) in enumerate(fits):
                step(f"{line.candidate.name}, looked for further away")
                far = line.search(end_s)
                if far[1] is not None and (z is None or far[1] @ far[1] < z @ z):
                    fits[k] = (line, *far)
        fits = [
            (line, p, _told(line.candidate, p, 1.0 - _excess(z) / before, z, end_s))
            for line, p, z in fits
            if z is not None and before > 0.0
        ]
        best = max((one.explained for _, _, one in fits), default=0.0)
        stages.append((end_s, [one for _, _, one in fits if one.explained > 0.0]))
        fewest = min((one.squares for _, _, one in fits), default=0.0)
        lines = [
            (line, p)
            for line, p, one in fits
            if one.explained > max(0.0, best - _KEEP) or one.squares < fewest + 4.0 * _DECIDES
        ]
    # The longest window that one number explains to the noise tells candidates apart best; behind it, motion that is
    # too sensitive for a fit says nothing.
    chosen = max(range(len(stages)), key=lambda k: _worth(stages[k][1], k))
    found: dict[str, Explanation] = {}
    for _, fitted in stages[: chosen + 1]:
        found |= {one.name: one for one in fitted}
    return known, list(found.values()), stages[chosen][0]


def _again(
    one: Explanation, lines: dict[str, _Line], parts: dict[str, Measured], experiment: Experiment, end_s: float
) -> Explanation:
    """The same candidate on a longer window, from where its fit ended."""
    line = lines[one.name]
    before = _excess(_vector(parts, predict(experiment, parts, end_s=end_s).values))
    p, z = line.fit(one.value, end_s)
    return one if z is None or before == 0.0 else _told(line.candidate, p, 1.0 - _excess(z) / before, z, end_s)


def _worth(fitted: list[Explanation], stage: int) -> tuple[float, int]:
    """What a window is worth: explained down to the noise, or else how much is explained; the longer of equal ones."""
    best = max(fitted, key=lambda one: one.explained, default=None)
    if best is None:
        return 0.0, stage
    return (1.0 if best.at_floor else round(best.explained, 3) * 0.999), stage


def _told(candidate: Candidate, p: float, explained: float, z: np.ndarray, to_s: float) -> Explanation:
    change = f"{p:+.4g} {candidate.unit}" if candidate.unit else f"{100.0 * p:+.3g} %"
    key = candidate.keys[0]
    kind: Kind = "time" if key.endswith(".at_s") else "command" if key.startswith("hammer.") else "model"
    return _explanation(kind, candidate.name, change, p, candidate.unit, explained, z, to_s)


# Sensors: each channel by itself.


def _sensors(parts: dict[str, Measured], nominal: Prediction, end_s: float) -> list[Explanation]:
    columns = {}
    total = 0.0
    for name, part in parts.items():
        n = part.rows_until(end_s)
        for c in _smooth(part):
            floor = float(part.floor[c])
            r, e = part.values[:n, c] / floor, nominal.values[name][:n, c] / floor
            columns[part.channels[c].name] = (r, e, part.channels[c].unit, floor)
            total += _excess(r - e)
    off = {name: entry for name, entry in columns.items() if len(entry[0]) > 2 and not _noise(entry[0] - entry[1])}
    found = []
    swapped = set()
    for a, b in combinations(off, 2):
        if off[a][2] == off[b][2] and len(off[a][0]) == len(off[b][0]):
            (ra, ea, _, fa), (rb, eb, _, fb) = off[a], off[b]
            crossed = np.concatenate([ra - eb * (fb / fa), rb - ea * (fa / fb)])
            if _noise(crossed):
                share = (_excess(ra - ea) + _excess(rb - eb) - _excess(crossed)) / total
                found.append(_explanation("sensor", f"{a} and {b}", "swapped", 0.0, "", share, crossed, end_s))
                swapped |= {a, b}
    for name, (r, e, unit, floor) in off.items():
        if name not in swapped:
            found.append(_one_sensor(name, r, e, unit=unit, floor=floor, total=total, to_s=end_s))
    return found


def _one_sensor(
    name: str, r: np.ndarray, e: np.ndarray, *, unit: str, floor: float, total: float, to_s: float
) -> Explanation:
    """The simplest change of a channel that leaves noise, else the one that leaves least."""
    before = _excess(r - e)

    def told(what: str, change: str, value: float, left: np.ndarray, of: str = "") -> Explanation:
        after = _excess(left)
        return _explanation("sensor", f"{name} {what}", change, value, of, (before - after) / total, left, to_s)

    shift = float((r - e).mean())
    options = [told("offset", f"{shift * floor:+.4g} {unit}", shift * floor, r - e - shift, unit)]
    if e @ e > 0.0:
        gain = float(r @ e) / float(e @ e)
        what, change = _gain_words(gain)
        options.append(told(what, change, gain - 1.0, r - gain * e))
    if e.std() > 1.0:
        slope, base = (float(number) for number in np.polyfit(e, r, 1))
        what, change = _gain_words(slope)
        left = r - slope * e - base
        options.append(told(f"{what} and offset", f"{change}, {base * floor:+.4g} {unit}", slope - 1.0, left))
    # Another number must earn its place.
    best = min(enumerate(options), key=lambda pair: pair[1].squares + _DECIDES * (pair[0] == 2))[1]
    if best.at_floor:
        return best
    rest = r - e - shift
    white = abs(float(rest[1:] @ rest[:-1]) / float(rest @ rest)) < 0.1
    tied = e.std() > 1.0 and abs(float(np.corrcoef(rest, e)[0, 1])) > 0.1
    if white and not tied:
        ratio = float(rest.std())
        return _explanation("sensor", f"{name} noise", f"x {ratio:.2f}", ratio, "", before / total, rest / ratio, to_s)
    return best


def _gain_words(gain: float) -> tuple[str, str]:
    if abs(gain + 1.0) < 0.1:
        return "polarity", "turned round"
    if abs(gain) < 0.02:
        return "signal", "missing"
    return "gain", f"{100.0 * (gain - 1.0):+.3g} %"


# Time: all channels together.


def _shifted(
    parts: dict[str, Measured], nominal: Prediction, end_s: float
) -> tuple[Callable[[float, float], np.ndarray], float, float] | None:
    """Residuals as a function of shift [s] and rate [1] of the recording's clock; period and length of the rows [s]."""
    from scipy.interpolate import CubicSpline

    splines = {
        name: CubicSpline(part.times_s, nominal.values[name])
        for name, part in parts.items()
        if part.rows_until(end_s) > 16 and (np.diff(part.times_s) > 0.0).all()
    }
    if not splines:
        return None
    kept = {name: parts[name].until(end_s) for name in splines}
    first = min(float(part.times_s[0]) for part in kept.values())

    def vector(shift: float, rate: float) -> np.ndarray:
        # Beyond the window the foretold is known as well: a shift does not run out of it.
        values = {}
        for name, part in kept.items():
            values[name] = splines[name](part.times_s - shift - rate * (part.times_s - first))
        return _vector(kept, values)

    return vector, min(float(np.diff(part.times_s).min()) for part in kept.values()), end_s - first


def _shift(parts: dict[str, Measured], nominal: Prediction, end_s: float) -> float:
    """The shift in time that fits best, to a sample or so [s]."""
    shifted = _shifted(parts, nominal, end_s)
    if shifted is None:
        return 0.0
    vector, period, _ = shifted
    # Few places are enough to find the one from which the slope leads on.
    shifts = np.unique(np.rint(np.concatenate([np.arange(-16, 17), np.linspace(-_SEARCH, _SEARCH, 101)]))) * period
    return float(min(shifts, key=lambda tau: float(np.sum(vector(float(tau), 0.0) ** 2))))


def _time(parts: dict[str, Measured], nominal: Prediction, end_s: float, start: float) -> list[Explanation]:
    shifted = _shifted(parts, nominal, end_s)
    if shifted is None:
        return []
    vector, period, length = shifted
    before = _excess(vector(0.0, 0.0))
    found: list[Explanation] = []
    if before == 0.0:
        return found
    for rates in (False, True):
        tau, rate = _fit_time(vector, start, rates=rates, period=period, length=length)
        z = vector(tau, rate)
        explained = 1.0 - _excess(z) / before
        if rates:
            name, change, value, unit = "clock", f"{tau * 1e6:+.1f} us and {rate * 1e6:+.1f} ppm", rate * 1e6, "ppm"
        else:
            name, change, value, unit = "time offset", f"{tau * 1e6:+.1f} us", tau, "s"
        if explained > 0.0 and (not found or float(z @ z) < found[0].squares - _DECIDES):
            found.append(_explanation("time", name, change, value, unit, explained, z, end_s))
    return found


def _fit_time(
    vector: Callable[[float, float], np.ndarray], shift: float, *, rates: bool, period: float, length: float
) -> tuple[float, float]:
    """Gauss-Newton's method for a shift [s], and a rate where asked for."""
    x = np.array([shift, 0.0])
    steps = np.array([0.02 * period, 0.02 * period / max(length, period)])
    z = vector(*x)
    for _ in range(8):
        slopes = []
        for k in range(2 if rates else 1):
            moved = x.copy()
            moved[k] += steps[k]
            slopes.append((vector(*moved) - z) / steps[k])
        change, *_ = np.linalg.lstsq(np.column_stack(slopes), -z, rcond=None)
        for part in (1.0, 0.3, 0.1):
            trial = x.copy()
            trial[: len(change)] += part * change
            ahead = vector(*trial)
            if ahead @ ahead < z @ z:
                break
        else:
            break
        done = 1.0 - float(ahead @ ahead) / float(z @ z) < 1e-5
        x, z = trial, ahead
        if done:
            break
    return float(x[0]), float(x[1])


# What to make of it.


def _conclude(
    found: list[Explanation], cured: list[Explanation], rules: Attribution, *, end_s: float
) -> tuple[str, tuple[str, ...]]:
    alone = [one for one in found if one.kind != "sensor" and one.to_s == end_s]
    single = max(alone, key=lambda one: one.explained, default=None)
    if cured and (single is None or not single.at_floor or len(cured) == 1):
        names = tuple(one.name for one in cured)
        text = "; ".join(f"{one.name} {one.change}" for one in cured)
        also = [one for one in alone if one.at_floor]
        if also:
            text = f"sensor: {text}, or {_listed(also)} explain it alike; this recording cannot tell"
            return text, (*names, *(one.name for one in also))
        return f"sensor: {text} ({min(1.0, sum(one.explained for one in cured)):.1%} of the difference)", names
    if single is None or single.explained < rules.enough:
        most = f"; the most is {single.name} with {single.explained:.0%}" if single else ""
        return f"no single candidate explains it{most}", ()
    if single.at_floor:
        equal = [one for one in alone if one.squares < single.squares + _DECIDES]
    else:
        equal = [one for one in alone if one.explained > single.explained - rules.equal]
    names = tuple(one.name for one in equal)
    part = f"{single.explained:.2%} of the difference, {single.left:.2f} of the noise left"
    short = "" if single.left < _NEAR else "nothing alone explains it down to the noise; nearest is "
    if len(equal) == 1:
        return f"{short}{single.kind}: {single.name} {single.change} ({part})", names
    return f"{short}{_listed(equal)} explain it equally ({part}); this recording cannot tell them apart", names


def _listed(found: list[Explanation]) -> str:
    return ", ".join(f"{one.name} {one.change}" for one in found)
