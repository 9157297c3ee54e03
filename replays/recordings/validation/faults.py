"""Faults that no number of the model makes: a channel's gain, offset, polarity or noise, and the recorder's clock."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from replays.recordings.least_squares import fit
from replays.recordings.prediction import Measured, Prediction
from replays.recordings.validation.explanation import (
    DECIDES,
    Explanation,
    excess,
    is_noise,
    smooth_columns,
    vector,
)
from replays.recordings.validation.signals import steady_rows
from replays.recordings.validation.trajectory import floors

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

_TURNED_OFF = 0.02
"""By so much may two probes' signals differ from ones that are turned."""
_FEW = 16
"""Rows that tell no delay."""
_SURE = 6.0
"""Times its noise, by which a sample, or the mean of some, is off."""
_SETTLES_S = 2e-3
"""Filters have forgotten a jump by then."""
_LATEST_S = 4e-3
"""How late a channel is looked for [s]."""
MOST = 0.9
"""Changes of channels that together explain this part of all are it, though the model leaves something."""
_ALIKE = 0.2
"""Changes that differ by less than this part of them may be the same one."""
_SLIGHT = 0.01
"""A second change of a channel that takes away no more than this part of the first is none."""
_NEARLY = 0.05
"""A change that takes away all but this part is it, though the model leaves something."""
_UNITS = {
    25.4: "as mm for inch", 1.0 / 25.4: "as inch for mm", 1e3: "a thousand", 1e-3: "a thousandth",
    9.80665: "as m/s^2 for g", 1.0 / 9.80665: "as g for m/s^2", 4.4482: "as N for lbf", 1.0 / 4.4482: "as lbf for N",
    60.0: "as 1/min for Hz", 1.0 / 60.0: "as Hz for 1/min", 2.0: "twice", 0.5: "half", 10.0: "tenfold",
    0.1: "a tenth",
}  # fmt: skip
"""Gains that slips with units and ranges make."""
_SEARCH = 400
"""Samples by which the time may be off in the first search, either way."""


@dataclass(frozen=True)
class _Shown:
    """One channel in the window, over its floor: what it shows, what it should, and that of its neighbours.

    Attributes:
        name: Its name.
        unit: Its unit.
        times_s: Of its rows [s], shape (n,).
        values: What it shows [its unit], shape (n,).
        foretold: What it should show [its unit], shape (n,).
        floor: Noise, and how far an equally right prediction may be off [its unit], shape (n,).
        noise: Noise alone [its unit].
    """

    name: str
    unit: str
    times_s: np.ndarray
    values: np.ndarray
    foretold: np.ndarray
    floor: np.ndarray
    noise: float

    @cached_property
    def foretold_at(self) -> CubicSpline:
        """What it should show at other times."""
        from scipy.interpolate import CubicSpline

        return CubicSpline(self.times_s, self.foretold)

    @property
    def apart(self) -> np.ndarray:
        """Residuals over the floor, shape (n,)."""
        return (self.values - self.foretold) / self.floor

    @property
    def price(self) -> float:
        """What another number must take away: more than noise makes, and than what is wrong elsewhere brings along."""
        return max(DECIDES, _SLIGHT * excess(self.apart))

    @property
    def moves(self) -> bool:
        """Whether it should show more than noise."""
        return float(self.foretold.std()) > self.noise

    def left(self, columns: list[np.ndarray], aim: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Least squares of what it shows by some columns: their factors, and the residuals over the floor, (n,)."""
        weights = 1.0 / self.floor
        table = np.column_stack(columns) * weights[:, None]
        goal = (self.values if aim is None else aim) * weights
        size = np.sqrt(np.maximum((table**2).sum(axis=0), 1e-300))
        found = np.linalg.lstsq(table / size, goal, rcond=None)[0] / size
        return found, goal - table @ found


def sensor_faults(
    parts: dict[str, Measured], nominal: Prediction, end_s: float, others: Sequence[Prediction] = (), *,
    from_s: float = -math.inf,
) -> list[Explanation]:  # fmt: skip
    """What each channel that differs may have, by itself, or as one of a pair.

    Args:
        parts: What was recorded.
        nominal: What was predicted.
        end_s: End of the window [s].
        others: What might be predicted as well.
        from_s: About the first difference: a fault that begins on the way is looked for behind it [s].
    """
    if math.isfinite(from_s):
        from_s = _onset_s(parts, nominal, from_s, end_s)
    shown = []
    for name, part in parts.items():
        rows = slice(part.rows_until(from_s), part.rows_until(end_s))
        foretold, *shown_too = (one.values[name][rows] for one in (nominal, *others))
        floor = floors(part, foretold, shown_too)
        shown += [
            _Shown(
                part.channels[c].name, part.channels[c].unit, part.times_s[rows], part.values[rows, c],
                foretold[:, c], floor[:, c], float(part.floor[c]),
            )
            for c in smooth_columns(part)
        ]  # fmt: skip
    total = sum(excess(one.apart) for one in shown)
    off = {one.name: one for one in shown if len(one.values) > _FEW and not is_noise(one.apart)}
    told = _Telling(total, end_s)
    found, seen = [], set()
    for a, b in combinations(off.values(), 2):
        if a.unit != b.unit or len(a.values) != len(b.values) or {a.name, b.name} & seen:
            continue
        pair = _swapped(a, b, told) or _turned(a, b, told)
        if pair is not None:
            found.append(pair)
            seen |= {a.name, b.name}
    alone = [_one_sensor(one, told) for name, one in off.items() if name not in seen]
    return found + _together(alone, told, [one.name for one in shown if one.moves])


def _onset_s(parts: dict[str, Measured], nominal: Prediction, from_s: float, end_s: float) -> float:
    """From when on a channel is not as it should be, with what filters need to settle, if enough is left [s]."""
    onsets = [end_s]
    for name, part in parts.items():
        rows = slice(part.rows_until(from_s), part.rows_until(end_s))
        z = ((part.values - nominal.values[name][: len(part.values)]) / part.floor)[rows, smooth_columns(part)]
        sums = np.cumsum(np.vstack([np.zeros(z.shape[1]), z]), axis=0)
        lasting = np.abs(sums[_FEW:] - sums[:-_FEW]) > _SURE * math.sqrt(_FEW)
        # A mean over some rows tells it when it has gone on for a part of them.
        firsts = np.concatenate([np.flatnonzero((np.abs(z) > _SURE).any(axis=1)),
                                 np.flatnonzero(lasting.any(axis=1)) + _FEW - 1])  # fmt: skip
        onsets += [float(part.times_s[rows][firsts.min()])] if len(firsts) else []
    onset_s = min(onsets)
    return onset_s + _SETTLES_S if end_s - onset_s > 3.0 * _SETTLES_S else onset_s


def cured_by(sensors: list[Explanation], parts: dict[str, Measured], most: float = MOST) -> bool:
    """Whether sensors are it: they leave noise, or nearly all is theirs."""
    return bool(sensors) and (
        all(one.at_floor for one in sensors)
        or (sum(one.explained for one in sensors) > most and not _whole_kind(sensors, parts))
    )


def channels_in(found: list[Explanation], names: Iterable[str]) -> list[str]:
    """Channels that explanations are about."""
    words = {word for one in found for word in one.name.replace(",", " ").split()}
    return [name for name in names if name in words]


def _whole_kind(found: list[Explanation], parts: dict[str, Measured]) -> bool:
    """Whether all channels of a kind are off, and not alike: then it is what they show, and none of them."""
    kinds: dict[str, list[str]] = {}
    for channel in (channel for part in parts.values() for channel in part.channels):
        kinds.setdefault(channel.unit, []).append(channel.name)
    return any(
        len(names) > 2
        and channels_in(found, names) == names
        and sum(bool(channels_in([one], names)) for one in found) > 1
        for names in kinds.values()
    )


def late_together(found: Sequence[Explanation], parts: Mapping[str, Measured]) -> dict[str, float]:
    """Delay of each of those channels that may be late together [s], as half of their kind was found to be.

    What the fit before took for motion hides it in the others.
    """
    units = {channel.name: channel.unit for part in parts.values() for channel in part.channels}
    for one in found:
        names = one.name.removesuffix(" delay").split(", ")
        kind = [name for name, unit in units.items() if unit == units.get(names[0])]
        if one.name.endswith(" delay") and len(kind) / 2.0 <= len(names) < len(kind) > 2:
            return dict.fromkeys(kind, one.value)
    return {}


@dataclass(frozen=True)
class _Telling:
    """Makes explanations of one window: of which excess in all they explain a part, and to where."""

    total: float
    to_s: float

    def __call__(
        self, name: str, change: str, value: float, left: np.ndarray, before: np.ndarray, unit: str = ""
    ) -> Explanation:
        explained = (excess(before) - excess(left)) / self.total
        return Explanation.of(
            left, kind="sensor", name=name, change=change, value=value, unit=unit, explained=explained, to_s=self.to_s
        )


def _swapped(a: _Shown, b: _Shown, told: _Telling) -> Explanation | None:
    """Two channels that show each other's signal, each at what it shows at rest."""
    crossed = np.concatenate([a.left([b.foretold, np.ones(len(b.foretold))])[1],
                              b.left([a.foretold, np.ones(len(a.foretold))])[1]])  # fmt: skip
    factors = [x.left([y.foretold, np.ones(len(y.foretold))])[0][0] for x, y in ((a, b), (b, a))]
    own = min(excess(x.left([x.foretold, np.ones(len(x.foretold))])[1]) for x in (a, b))
    if not (a.moves and b.moves) or max(abs(factor - 1.0) for factor in factors) > 0.1:
        return None
    if not is_noise(crossed) and excess(crossed) > 0.01 * own:
        return None
    return told(f"{a.name} and {b.name}", "swapped", 0.0, crossed, np.concatenate([a.apart, b.apart]))


def _turned(a: _Shown, b: _Shown, told: _Telling) -> Explanation | None:
    """Two probes that sit at another angle than is told: both signals are turned by it."""
    ones = np.ones(len(a.foretold))
    (aa, ab, _), left_a = a.left([a.foretold, b.foretold, ones])
    (ba, bb, _), left_b = b.left([a.foretold, b.foretold, ones])
    angle = math.atan2(ab - ba, aa + bb)
    off = max(abs(aa - bb), abs(ab + ba), abs(math.hypot(aa, ab) - 1.0))
    if not (a.moves and b.moves) or off > _TURNED_OFF or abs(math.sin(angle)) < 3.0 * off:
        return None
    left = np.concatenate([left_a, left_b])
    if not is_noise(left) and excess(left) > 0.01 * (excess(a.apart) + excess(b.apart)):
        return None
    before = np.concatenate([a.apart, b.apart])
    return told(f"{a.name} and {b.name} angle", f"{math.degrees(angle):+.3g} degrees", angle, left, before, "rad")


@dataclass(frozen=True)
class _Alone:
    """What one channel has, by itself.

    Attributes:
        shown: The channel.
        told: What it has.
        cost: Sum of squares that it leaves, and what its numbers cost.
        numbers: Its gain less 1 and its delay [s], where it has one.
    """

    shown: _Shown
    told: Explanation
    cost: float
    numbers: dict[str, float]

    def by(self, kind: str, value: float) -> tuple[float, np.ndarray]:
        """Cost of nothing but a gain or a delay that others pay for, with an offset or without, and what it leaves."""
        one = self.shown
        shown = (1.0 + value) * one.foretold if kind == "gain" else one.foretold_at(one.times_s - value)
        _, left = one.left([np.ones(len(shown))], one.values - shown)
        alone = (one.values - shown) / one.floor
        costs = [(float(alone @ alone), alone), (float(left @ left) + one.price, left)]
        return min(costs, key=lambda pair: pair[0])


def _one_sensor(one: _Shown, told: _Telling) -> _Alone:
    """The simplest change of a channel that leaves noise, else the one that leaves least."""
    before, ones, e, held = one.apart, np.ones(len(one.values)), one.foretold, _steady(one)

    def option(
        name: str, change: str, value: float, left: np.ndarray, count: int = 1, unit: str = "", **numbers: float | None
    ) -> _Alone:
        found = told(f"{one.name} {name}", change, value, left, before, unit)
        return _Alone(
            one, found, found.squares + one.price * count, {k: v for k, v in numbers.items() if v is not None}
        )

    if held.any() and excess(before[held]) > 0.5 * excess(before):
        return option("stuck", _for_how_long(one.times_s[held]), 0.0, before[~held])
    (shift,), left = one.left([ones], one.values - e)
    options = [option("offset", f"{shift:+.4g} {one.unit}", float(shift), left, unit=one.unit)]
    if one.moves:
        for columns, more in (([e], False), ([e, ones], True)):
            factors, left = one.left(columns)
            what, change = _gain_words(gain := float(factors[0]))
            if more and what == "gain":
                what, change = "gain and offset", f"{change}, {factors[1]:+.4g} {one.unit}"
            options.append(
                option(what, change, off := gain - 1.0, left, 1 + more, gain=off if "gain" in what else None)
            )
    if one.moves and len(e) > _FEW and (np.diff(one.times_s) > 0.0).all():
        late_s, delayed, slope = _delayed(one)
        if abs(late_s) <= _LATEST_S + 2.0 * float(np.diff(one.times_s).min()):  # else that is the search's end
            (shift,), left = one.left([ones], one.values - delayed)
            change = f"{late_s * 1e6:+.4g} µs"
            options.append(option("delay", change, late_s, (one.values - delayed) / one.floor, unit="s", delay=late_s))
            if abs(shift) > one.noise:
                both = f"{change}, {shift:+.4g} {one.unit}"
                options.append(option("delay and offset", both, late_s, left, 2, "s", delay=late_s))
            factors, left = one.left([delayed, ones])
            what, also = _gain_words(gain := float(factors[0]))
            options.append(option(f"{what} and delay", f"{also}, {change}", gain - 1.0, left, 3, delay=late_s))
        factors, left = one.left([slope, np.gradient(slope, one.times_s)], one.values - e)
        lower = "lower" if factors[1] > 0.0 else "higher"
        options.append(option("bandwidth", f"{lower} than told", float(factors[1]), left, 2))
    best = min(options, key=lambda one: one.cost)
    if best.told.at_floor or best.told.left < _NEARLY * min(1.0, math.sqrt(float(before @ before) / len(before))) + 1.0:
        return best
    rest = one.left([ones], one.values - e)[1]
    white = abs(float(rest[1:] @ rest[:-1]) / float(rest @ rest)) < 0.1
    tied = one.moves and abs(float(np.corrcoef(rest, e)[0, 1])) > 0.1
    if white and not tied:
        ratio = float(rest.std())
        return option("noise", f"x {ratio:.2f}", ratio, rest / ratio)
    return best


def _steady(one: _Shown) -> np.ndarray:
    """Rows of stretches in which a channel with noise shows one and the same number, shape (n,)."""
    return steady_rows(one.values) if one.noise > 0.0 else np.zeros(len(one.values), dtype=bool)


def _for_how_long(times_s: np.ndarray) -> str:
    return f"from {times_s[0]:.4f} s, {len(times_s)} rows"


def _delayed(one: _Shown) -> tuple[float, np.ndarray, np.ndarray]:
    """By how much a channel is late [s], what it should show then, and the slope of that [its unit/s]."""
    spline = one.foretold_at
    slope, period_s = spline.derivative(), float(np.diff(one.times_s).min())

    def cost(late_s: float) -> float:
        return float(np.sum(one.left([spline(one.times_s - late_s), np.ones(len(one.values))])[1] ** 2))

    rows = np.unique(np.rint(np.concatenate([np.arange(-16, 17), np.linspace(-_LATEST_S, _LATEST_S, 81) / period_s])))
    late_s = float(min(rows * period_s, key=cost))
    for _ in range(6):
        at = one.times_s - late_s
        (_, step, _), _ = one.left([spline(at), -slope(at), np.ones(len(at))])
        late_s = float(np.clip(late_s + np.clip(step, -period_s, period_s), -2.0 * _LATEST_S, 2.0 * _LATEST_S))
    at = one.times_s - late_s
    return late_s, spline(at), slope(at)


def _together(alone: list[_Alone], told: _Telling, moving: list[str]) -> list[Explanation]:
    """Channels that are off by the same, told as one: where one number for all costs less than one for each.

    Where most of those that move are late, it is the others that are early; where all are, it is the time.
    """
    found = []
    for kind in ("gain", "delay"):
        of = {one.shown.name: one.numbers[kind] for one in alone if kind in one.numbers}
        while of:
            near = [
                [name for name, other in of.items() if abs(other - value) < _ALIKE * max(abs(other), abs(value))]
                for value in of.values()
            ]
            names = max(near, key=len)
            value = float(np.median([of[name] for name in names]))
            of = {name: value for name, value in of.items() if name not in names}
            group = [one for one in alone if one.shown.name in names and one.by(kind, value)[0] < one.cost]
            if len(group) < 2:
                continue
            alone = [one for one in alone if one not in group]
            left = np.concatenate([one.by(kind, value)[1] for one in group])
            change = _gain_words(1.0 + value)[1] if kind == "gain" else f"{value * 1e6:+.4g} µs"
            names, unit = [one.shown.name for one in group], "s" if kind == "delay" else ""
            others = [name for name in moving if name not in names]
            if kind == "delay" and len(others) < len(names):
                if not others:
                    continue
                names, value, change = others, -value, f"{-value * 1e6:+.4g} µs"
            before = np.concatenate([one.shown.apart for one in group])
            found.append(told(f"{', '.join(names)} {kind}", change, value, left, before, unit))
    return found + [one.told for one in alone]


def _gain_words(gain: float) -> tuple[str, str]:
    known = next((text for factor, text in _UNITS.items() if abs(gain / factor - 1.0) < 0.02), "")
    if abs(gain + 1.0) < 0.1:
        return "polarity", "turned round"
    if abs(gain) < 0.05 and not known:
        return "signal", "missing"
    return "gain", f"{100.0 * (gain - 1.0):+.3g} %" + (f" ({known})" if known else "")


class Clock:
    """Residuals where the recording's clock is off by a shift and a rate; what is left out is not smooth in time."""

    def __init__(self, parts: dict[str, Measured], nominal: Prediction, end_s: float) -> None:
        """Prepare.

        Args:
            parts: What was recorded.
            nominal: What was predicted.
            end_s: End of the window [s].
        """
        from scipy.interpolate import CubicSpline

        self._splines = {
            name: CubicSpline(part.times_s, nominal.values[name])
            for name, part in parts.items()
            if part.rows_until(end_s) > 16 and (np.diff(part.times_s) > 0.0).all()
        }
        self._kept = {name: parts[name].until(end_s) for name in self._splines}
        self._end_s = end_s
        if self._kept:
            self._first_s = min(float(part.times_s[0]) for part in self._kept.values())
            self._period_s = min(float(np.diff(part.times_s).min()) for part in self._kept.values())

    def residuals(self, change: np.ndarray) -> np.ndarray:
        """Over the noise, at a shift [s], or a shift and a rate [1], shape (n,)."""
        shift, rate = float(change[0]), float(change[1]) if len(change) > 1 else 0.0
        # Beyond the window the prediction is known as well: a shift does not run out of it.
        values = {
            name: self._splines[name](part.times_s - shift - rate * (part.times_s - self._first_s))
            for name, part in self._kept.items()
        }
        return vector(self._kept, values)

    def coarse_shift(self) -> float:
        """The shift in time that fits best, to a sample or so [s]; 0 where there are too few rows to tell."""
        if not self._kept:
            return 0.0
        # Few places are enough to find the one from which the slope leads on.
        rows = np.unique(np.rint(np.concatenate([np.arange(-16, 17), np.linspace(-_SEARCH, _SEARCH, 101)])))
        shifts = rows * self._period_s
        return float(min(shifts, key=lambda shift: float(np.sum(self.residuals(np.array([shift])) ** 2))))

    def faults(self, start_s: float) -> list[Explanation]:
        """A shift, and a shift with a rate where that says more; none that takes nothing away.

        Args:
            start_s: Where the search for the shift begins [s].
        """
        before = excess(self.residuals(np.zeros(1))) if self._kept else 0.0
        found: list[Explanation] = []
        if before == 0.0:
            return found
        for rates in (False, True):
            done = fit(self.residuals, self._slopes, np.array([start_s, 0.0][: 1 + rates]), rounds=8, gain=1e-5)
            assert done is not None
            shift, rate = [*done.values.tolist(), 0.0][:2]
            change, value, unit = f"{shift * 1e6:+.1f} µs", shift, "s"
            if rates:
                change, value, unit = f"{change} and {rate * 1e6:+.1f} ppm", rate * 1e6, "ppm"
            explained = 1.0 - excess(done.residuals) / before
            if explained > 0.0 and (not found or done.squares < found[0].squares - DECIDES):
                found.append(
                    Explanation.of(
                        done.residuals, kind="time", name="clock" if rates else "time offset", change=change,
                        value=value, unit=unit, explained=explained, to_s=self._end_s,
                    )
                )  # fmt: skip
        return found

    def _slopes(self, change: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        length_s = self._end_s - self._first_s
        step_s = 0.02 * self._period_s
        steps = np.diag([step_s, step_s / max(length_s, self._period_s)][: len(change)])
        return np.column_stack([(self.residuals(change + step) - residuals) / step.sum() for step in steps])
