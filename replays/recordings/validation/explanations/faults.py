"""Faults that no number of the model makes: a channel's gain, offset, polarity or noise, and the recorder's clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from replays.estimate.least_squares import fit
from replays.recordings.resimulation.prediction import Measured, Prediction
from replays.recordings.validation.explanations.channel_fit import DECIDES, FEW, OFF, Shown, gain_words
from replays.recordings.validation.explanations.explanation import (
    Explanation,
    excess,
    is_noise,
    smooth_columns,
    vector,
)
from replays.recordings.validation.explanations.laws import law_of
from replays.recordings.validation.trajectory import floors
from rig.channels.faults.defects import DEFECTS, size_text
from rig.channels.table import Channel

_TURNED_OFF = 0.02
"""By so much may two probes' signals differ from ones that are turned."""
_FADED = 1e-3
"""Part of a level by which a row more or less lets an AC-coupled channel be off."""
_SURE = 6.0
"""Times its noise, by which a sample, or the mean of some, is off."""
SOME = 100
"""Rows that two channels must share to be a pair."""
_AROUND_S = 0.1
"""What comes before a window tells what filters and delays make of it."""
_SETTLES_S = 2e-3
"""Filters have forgotten a jump by then."""
MOST = 0.9
"""Changes of channels that together explain this part of all are it, though the model leaves something."""
_ALIKE = 0.2
"""Changes that differ by less than this part of them may be the same one."""
_SEARCH = 400
"""Samples by which the time may be off in the first search, either way."""


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
            Shown(
                part.channels[c], part.times_s[rows], part.values[rows, c], foretold[:, c], floor[:, c],
                float(part.floor[c]), beside=partial(beside, parts, nominal, part.channels[c]),
                around=around(part, nominal.values[name][:, c], rows.start, rows.stop),
            )
            for c in smooth_columns(part)
        ]  # fmt: skip
    return told_of(shown, end_s)


def told_of(shown: list[Shown], end_s: float, step: Callable[[str], None] = lambda _text: None) -> list[Explanation]:
    """What channels have: pairs of them first, then each by itself, and what several share as one."""
    total = sum(excess(one.apart) for one in shown)
    off = {
        one.name: one for one in shown if one.counts is not None or (len(one.values) > FEW and not is_noise(one.apart))
    }
    told = _Telling(total, end_s)
    found, seen = [], set()
    for a, b in combinations(off.values(), 2):
        if {a.name, b.name} & seen:
            continue
        if a.counts is not None:
            times_s = np.intersect1d(a.times_s, b.times_s)
            if len(times_s) < SOME:
                continue
            a, b = a.at(times_s), b.at(times_s)
        elif a.unit != b.unit or len(a.values) != len(b.values):
            continue
        pair = _swapped(a, b, told) or (_turned(a, b, told) if a.counts is None else None)
        if pair is not None:
            found.append(pair)
            seen |= {a.name, b.name}
    alone = []
    for name, one in off.items():
        if name not in seen:
            step(f"what {name} has")
            alone.append(_alone(one, told))
    return found + _together(alone, told, [one.name for one in shown if one.moves])


def around(part: Measured, foretold: np.ndarray, begin: int, end: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and what a channel should show, from shortly before some rows to shortly behind them."""
    more = round(_AROUND_S * part.channels[0].rate_hz)
    rows = slice(max(0, begin - more), min(end + more, len(foretold)))
    return part.times_s[rows], foretold[rows]


def beside(
    parts: Mapping[str, Measured], nominal: Prediction, channel: Channel
) -> dict[Channel, tuple[np.ndarray, np.ndarray]]:
    """Times and what the other channels should show [their units], of those that move."""
    found = {}
    for name, part in parts.items():
        values = nominal.values[name]
        for c in smooth_columns(part):
            other, shown = part.channels[c], values[:, c]
            if other.name != channel.name and shown.std() > part.floor[c]:
                found[other] = part.times_s[: len(shown)], shown
    return found


def _onset_s(parts: dict[str, Measured], nominal: Prediction, from_s: float, end_s: float) -> float:
    """From when on a channel is not as it should be, with what filters need to settle, if enough is left [s]."""
    onsets = [end_s]
    for name, part in parts.items():
        rows = slice(part.rows_until(from_s), part.rows_until(end_s))
        z = ((part.values - nominal.values[name][: len(part.values)]) / part.floor)[rows, smooth_columns(part)]
        sums = np.cumsum(np.vstack([np.zeros(z.shape[1]), z]), axis=0)
        lasting = np.abs(sums[FEW:] - sums[:-FEW]) > _SURE * math.sqrt(FEW)
        # A mean over some rows tells it when it has gone on for a part of them.
        firsts = np.concatenate([np.flatnonzero((np.abs(z) > _SURE).any(axis=1)),
                                 np.flatnonzero(lasting.any(axis=1)) + FEW - 1])  # fmt: skip
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
        names = one.channels_and_defect[0].split(", ")
        kind = [name for name, unit in units.items() if unit == units.get(names[0])]
        if one.channels_and_defect[1] == "delay" and len(kind) / 2.0 <= len(names) < len(kind) > 2:
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
        explained = (excess(before) - excess(left)) / self.total if self.total > 0.0 else 0.0
        return Explanation.of(
            left, kind="sensor", name=name, change=change, value=value, unit=unit, explained=explained, to_s=self.to_s
        )


def _swapped(a: Shown, b: Shown, told: _Telling) -> Explanation | None:
    """Two channels that show each other's signal, each at what it shows at rest."""
    crossed, own, before = np.empty(0), np.inf, np.concatenate([a.apart, b.apart])
    signs = set[float]()
    if a.counts is None and not (a.moves and b.moves):
        return None
    for x, y in ((a, b), (b, a)):
        # Of logs nobody knows which cable, conditioner or name it is; the rig's own cables carry volts.
        times_s, signal = y.around or (y.times_s, y.foretold)
        if x.counts is not None:
            volts = np.clip(y.channel.bias_v + y.channel.sensitivity_v * signal, *y.channel.range_v)
            signal = (volts - x.channel.bias_v) / x.channel.sensitivity_v
        shown = x.coupled(times_s, signal)
        factors, left = x.left([shown, x.level])
        signs.add(math.copysign(1.0, factors[0]) if x.counts is None else 1.0)
        if y.moves and signal.std() > x.noise and abs(factors[0] - min(signs)) > 0.1:
            if x.counts is None:
                return None
            continue  # its converter may be too small for it: the other of the two tells
        if not y.moves:
            (level,), left = x.left([x.level], x.values - shown)
            if abs(level) > OFF * x.noise + _FADED * float(np.abs(shown).max()):
                return None
        own = min(own, excess(x.left([x.foretold, x.level])[1]))
        crossed = np.concatenate([crossed, left])
    if not len(crossed):
        return None
    if not is_noise(crossed) and excess(crossed) > 0.01 * (own if a.counts is None else excess(before)):
        return None
    if len(signs) > 1:
        return None  # one of them inverted, which is a quarter of a turn
    change = DEFECTS["swap"].validation[signs != {1.0}]
    return told(f"{a.name} and {b.name}", change, 0.0, crossed, before)


def _turned(a: Shown, b: Shown, told: _Telling) -> Explanation | None:
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
    return told(f"{a.name} and {b.name} angle", size_text("angle", angle), angle, left, before, "rad")


@dataclass(frozen=True)
class _Alone:
    """What one channel has, by itself.

    Attributes:
        shown: The channel.
        told: What it has.
        cost: Sum of squares that it leaves, and what its numbers cost.
        numbers: Its gain less 1 and its delay [s], where it has one.
    """

    shown: Shown
    told: Explanation
    cost: float
    numbers: Mapping[str, float]

    def by(self, kind: str, value: float) -> tuple[float, np.ndarray]:
        """Cost of nothing but a gain or a delay that others pay for, with an offset or without, and what it leaves."""
        one = self.shown
        shown = (1.0 + value) * one.foretold if kind == "gain" else one.foretold_at(one.times_s - value)
        _, left = one.left([np.ones(len(shown))], one.values - shown)
        alone = (one.values - shown) / one.floor
        costs = [(float(alone @ alone), alone), (float(left @ left) + one.price, left)]
        return min(costs, key=lambda pair: pair[0])


def _alone(one: Shown, told: _Telling) -> _Alone:
    law = law_of(one)
    found = told(f"{one.name} {law.name}", law.change, law.value, law.left, one.apart, law.unit)
    found = replace(found, sure=law.sure)
    return _Alone(one, found, found.squares + one.price * law.count, law.numbers)


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
            change = gain_words(1.0 + value)[1] if kind == "gain" else size_text(kind, value)
            names = [one.shown.name for one in group]
            others = [name for name in moving if name not in names]
            if kind == "delay" and len(others) < len(names) and group[0].shown.counts is None:
                if not others:
                    continue
                names, value, change = others, -value, size_text(kind, -value)
            before = np.concatenate([one.shown.apart for one in group])
            found.append(told(f"{', '.join(names)} {kind}", change, value, left, before, DEFECTS[kind].unit))
    return found + [one.told for one in alone]


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
