"""Faults that are not numbers of the model: a channel's gain, offset, polarity or noise, and the recorder's clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from replays.estimate.least_squares import fit
from replays.recordings.resimulation.prediction import Measured, Prediction
from replays.recordings.validation.explanations.channel_fit import MARGIN, MIN_ROWS, OUTLIER, Shown, gain_words
from replays.recordings.validation.explanations.explanation import Explanation, excess, is_noise, smooth_columns, vector
from replays.recordings.validation.explanations.laws import law_of
from replays.recordings.validation.trajectory import floors
from rig.channels.faults.defects import DEFECTS, size_text
from rig.channels.table import Channel

_TURN_TOLERANCE = 0.02
"""Largest deviation of two probes' signals from rotated ones."""
_FADED_PART = 1e-3
"""Tolerance of an AC-coupled channel's level, due to the start of the fault between two rows."""
_OUTLIER_NOISES = 6.0
"""Deviation of a sample, or of the mean of some, in noises, that is not noise."""
PAIR_ROWS = 100
"""Fewest common rows of two channels for them to be a pair."""
_MARGIN_S = 0.1
"""Time before a window that affects filtered and delayed signals in it."""
_SETTLES_S = 2e-3
"""Settling time of filters after a jump."""
MIN_PART = 0.9
"""Part of the difference that sensors must explain together, if the model is not exact."""
_EQUAL_PART = 0.2
"""Relative difference of changes that may be one common change."""
_MIN_NOISE_RATIO = 1.1
"""Smallest ratio of noise in a log to that of its quiet part that is a fault."""
_SEARCH_ROWS = 400
"""Range of the first search for a time offset [samples], in either direction."""


def sensor_faults(
    parts: dict[str, Measured], nominal: Prediction, end_s: float, others: Sequence[Prediction] = (), *,
    from_s: float = -math.inf,
) -> list[Explanation]:  # fmt: skip
    """Return the faults of differing channels, single or in pairs.

    Args:
        parts: Recorded channels.
        nominal: Prediction.
        end_s: End of the window [s].
        others: Equally valid predictions.
        from_s: Approximate first difference, after which a fault that begins within the run is fitted [s].
    """
    parts = {name: part.with_slow_floor() for name, part in parts.items()}
    if math.isfinite(from_s):
        from_s = _find_onset_s(parts, nominal, from_s, end_s)
    shown = []
    for name, part in parts.items():
        rows = slice(part.count_rows(from_s), part.count_rows(end_s))
        expected, *shown_too = (one.values[name][rows] for one in (nominal, *others))
        floor = floors(part, expected, shown_too)
        turns = nominal.compute_turns(part.times_s[rows]) if others else None
        shown += [
            Shown(
                part.channels[c], part.times_s[rows], part.values[rows, c], expected[:, c], floor[:, c],
                float(part.floor[c]), neighbours=partial(find_others, parts, nominal, part.channels[c]),
                around=extend(part, nominal.values[name][:, c], rows.start, rows.stop), turns=turns,
            )
            for c in smooth_columns(part)
        ]  # fmt: skip
    return diagnose(shown, end_s)


def diagnose(shown: list[Shown], end_s: float, step: Callable[[str], None] = lambda _text: None) -> list[Explanation]:
    """Return the faults of pairs of channels, then of single ones, with equal faults of several channels merged."""
    total = sum(excess(one.apart) for one in shown)
    off = {x.name: x for x in shown if x.counts is not None or (len(x.values) > MIN_ROWS and _differs(x.apart))}
    explain = _ExplanationMaker(total, end_s)
    faults, names = [], set()
    for a, b in combinations(off.values(), 2):
        if {a.name, b.name} & names:
            continue
        if a.counts is not None:
            times_s = np.intersect1d(a.times_s, b.times_s)
            if len(times_s) < PAIR_ROWS:
                continue
            a, b = a.at(times_s), b.at(times_s)
        elif a.unit != b.unit or len(a.values) != len(b.values):
            continue
        pair = _explain_swap(a, b, explain) or (_explain_turn(a, b, explain) if a.counts is None else None)
        if pair is not None:
            faults.append(pair)
            names |= {a.name, b.name}
    alone, singles = [], [one for name, one in off.items() if name not in names]
    for n, one in enumerate(singles, 1):
        step(f"faults of {one.name}, {n} of {len(singles)}")
        fault = _explain_channel(one, explain)
        named = fault.explanation
        if one.counts is not None or named.name != f"{one.name} noise" or named.value > _MIN_NOISE_RATIO:
            alone.append(fault)
    return faults + _merge_equal(alone, explain, [one.name for one in shown if one.moves])


def _differs(residuals: np.ndarray) -> bool:
    """Return whether residuals over their floors, shape (n,), or their mean are not noise."""
    return not is_noise(residuals) or abs(residuals.sum()) > OUTLIER * math.sqrt(len(residuals))


def extend(part: Measured, expected: np.ndarray, begin: int, end: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times and expected signal of a channel, from shortly before some rows to shortly after them."""
    more = round(_MARGIN_S * part.channels[0].rate_hz)
    rows = slice(max(0, begin - more), min(end + more, len(expected)))
    return part.times_s[rows], expected[rows]


def find_others(
    parts: Mapping[str, Measured], nominal: Prediction, channel: Channel
) -> dict[Channel, tuple[np.ndarray, np.ndarray]]:
    """Return times and expected signals of the other, varying channels [their units]."""
    signals = {}
    for name, part in parts.items():
        values = nominal.values[name]
        for c in smooth_columns(part):
            other, shown = part.channels[c], values[:, c]
            if other.name != channel.name and shown.std() > part.floor[c]:
                signals[other] = part.times_s[: len(shown)], shown
    return signals


def _find_onset_s(parts: dict[str, Measured], nominal: Prediction, from_s: float, end_s: float) -> float:
    """Return the start of a fault, after the settling of filters if enough rows remain [s]."""
    onsets = [end_s]
    for name, part in parts.items():
        rows = slice(part.count_rows(from_s), part.count_rows(end_s))
        z = ((part.values - nominal.values[name][: len(part.values)]) / part.floor)[rows, smooth_columns(part)]
        sums = np.cumsum(np.vstack([np.zeros(z.shape[1]), z]), axis=0)
        lasting = np.abs(sums[MIN_ROWS:] - sums[:-MIN_ROWS]) > _OUTLIER_NOISES * math.sqrt(MIN_ROWS)
        # A mean over some rows shows it only after a part of them.
        firsts = np.concatenate([np.flatnonzero((np.abs(z) > _OUTLIER_NOISES).any(axis=1)),
                                 np.flatnonzero(lasting.any(axis=1)) + MIN_ROWS - 1])  # fmt: skip
        onsets += [float(part.times_s[rows][firsts.min()])] if len(firsts) else []
    onset_s = min(onsets)
    return onset_s + _SETTLES_S if end_s - onset_s > 3.0 * _SETTLES_S else onset_s


def are_cause(sensors: list[Explanation], parts: dict[str, Measured], most: float = MIN_PART) -> bool:
    """Return whether sensors are the cause: they leave noise, or explain nearly all of the difference."""
    return bool(sensors) and (
        all(one.at_floor for one in sensors)
        or (sum(one.explained for one in sensors) > most and not _is_whole_kind(sensors, parts))
    )


def select_channels(explanations: list[Explanation], names: Iterable[str]) -> list[str]:
    """Return the channels that explanations concern."""
    words = {word for one in explanations for word in one.name.replace(",", " ").split()}
    return [name for name in names if name in words]


def _is_whole_kind(explanations: list[Explanation], parts: dict[str, Measured]) -> bool:
    """Return whether all channels of a kind differ, but not equally: then the motion differs, not the channels."""
    kinds: dict[str, list[str]] = {}
    for channel in (channel for part in parts.values() for channel in part.channels):
        kinds.setdefault(channel.unit, []).append(channel.name)
    return any(
        len(names) > 2
        and select_channels(explanations, names) == names
        and sum(bool(select_channels([one], names)) for one in explanations) > 1
        for names in kinds.values()
    )


def find_common_delay(explanations: Sequence[Explanation], parts: Mapping[str, Measured]) -> dict[str, float]:
    """Return the common delay of the channels of a kind [s], if at least half of them were found to have it.

    In the other channels the earlier fit has taken the delay for motion.
    """
    units = {channel.name: channel.unit for part in parts.values() for channel in part.channels}
    for one in explanations:
        names = one.channels_and_defect[0].split(", ")
        kind = [name for name, unit in units.items() if unit == units.get(names[0])]
        if one.channels_and_defect[1] == "delay" and len(kind) / 2.0 <= len(names) < len(kind) > 2:
            return dict.fromkeys(kind, one.value)
    return {}


@dataclass(frozen=True)
class _ExplanationMaker:
    """Constructor of explanations of one window, relative to its total excess."""

    total: float
    to_s: float

    def __call__(
        self, name: str, change: str, value: float, residual: np.ndarray, before: np.ndarray, unit: str = ""
    ) -> Explanation:
        explained = (excess(before) - excess(residual)) / self.total if self.total > 0.0 else 0.0
        return Explanation.of(
            residual, kind="sensor", name=name, change=change, value=value, unit=unit, explained=explained,
            to_s=self.to_s,
        )  # fmt: skip


def _explain_swap(a: Shown, b: Shown, explain: _ExplanationMaker) -> Explanation | None:
    """Return the explanation by two exchanged signals, each about its value at rest, or None."""
    crossed, own, before = np.empty(0), np.inf, np.concatenate([a.apart, b.apart])
    signs = set[float]()
    if a.counts is None and not (a.moves and b.moves):
        return None
    if a.counts is None and all(is_noise(one.solve([one.expected])[1]) for one in (a, b)):
        return None  # gains; opposite forces are each other's mirror image but for their preload
    for x, y in ((a, b), (b, a)):
        # In a log the exchange may be of cables, conditioners or names; the rig's cables carry volts.
        times_s, signal = y.around or (y.times_s, y.expected)
        if x.counts is not None:
            volts = np.clip(y.channel.bias_v + y.channel.sensitivity_v * signal, *y.channel.range_v)
            signal = (volts - x.channel.bias_v) / x.channel.sensitivity_v
        shown = x.coupled(times_s, signal)
        factors, residual = x.solve([shown, x.level])
        signs.add(math.copysign(1.0, factors[0]) if x.counts is None else 1.0)
        if y.moves and signal.std() > x.noise and abs(factors[0] - min(signs)) > 0.1:
            if x.counts is None:
                return None
            continue  # it may exceed the range of this converter: the other channel decides
        if not y.moves:
            (level,), residual = x.solve([x.level], x.values - shown)
            if abs(level) > OUTLIER * x.noise + _FADED_PART * float(np.abs(shown).max()):
                return None
        own = min(own, excess(x.solve([x.expected, x.level])[1]))
        crossed = np.concatenate([crossed, residual])
    if not len(crossed):
        return None
    if not is_noise(crossed) and excess(crossed) > 0.01 * (own if a.counts is None else excess(before)):
        return None
    if len(signs) > 1:
        return None  # one of them is inverted, which is a rotation by a quarter of a turn
    change = DEFECTS["swap"].validation[signs != {1.0}]
    return explain(f"{a.name} and {b.name}", change, 0.0, crossed, before)


def _explain_turn(a: Shown, b: Shown, explain: _ExplanationMaker) -> Explanation | None:
    """Return the explanation by two probes of a plane at another angle, whose signals are rotated by it, or None."""
    if a.name.rpartition("_")[0] != b.name.rpartition("_")[0]:
        return None
    if all(is_noise(one.solve([one.level], one.values - one.expected)[1]) for one in (a, b)):
        return None  # offsets
    ones = np.ones(len(a.expected))
    (aa, ab, _), residual_a = a.solve([a.expected, b.expected, ones])
    (ba, bb, _), residual_b = b.solve([a.expected, b.expected, ones])
    angle = math.atan2(ab - ba, aa + bb)
    off = max(abs(aa - bb), abs(ab + ba), abs(math.hypot(aa, ab) - 1.0))
    if not (a.moves and b.moves) or off > _TURN_TOLERANCE or abs(math.sin(angle)) < 3.0 * off:
        return None
    residual = np.concatenate([residual_a, residual_b])
    if not is_noise(residual) and excess(residual) > 0.01 * (excess(a.apart) + excess(b.apart)):
        return None
    before = np.concatenate([a.apart, b.apart])
    return explain(f"{a.name} and {b.name} angle", size_text("angle", angle), angle, residual, before, "rad")


@dataclass(frozen=True)
class _ChannelFault:
    """Fault of a single channel.

    Attributes:
        shown: The channel.
        explanation: Explanation by the fault.
        cost: Remaining sum of squares, plus the price of the law's numbers.
        numbers: Gain error and delay [s], if there are any.
    """

    shown: Shown
    explanation: Explanation
    cost: float
    numbers: Mapping[str, float]

    def by(self, kind: str, value: float) -> tuple[float, np.ndarray]:
        """Return cost and residual with a given gain error or delay, with or without an offset."""
        one = self.shown
        shown = (1.0 + value) * one.expected if kind == "gain" else one.expected_at(one.times_s - value)
        _, residual = one.solve([np.ones(len(shown))], one.values - shown)
        alone = (one.values - shown) / one.floor
        costs = [(float(alone @ alone), alone), (float(residual @ residual) + one.price, residual)]
        return min(costs, key=lambda pair: pair[0])


def _explain_channel(one: Shown, explain: _ExplanationMaker) -> _ChannelFault:
    law = law_of(one)
    explanation = explain(f"{one.name} {law.name}", law.change, law.value, law.residual, one.apart, law.unit)
    explanation = replace(explanation, sure=law.sure)
    return _ChannelFault(one, explanation, explanation.squares + one.price * law.count, law.numbers)


def _merge_equal(alone: list[_ChannelFault], explain: _ExplanationMaker, moving: list[str]) -> list[Explanation]:
    """Merge channels with equal faults, if one number for all costs less than one for each.

    If most of the varying channels are late, the others are early; if all are, the time is wrong.
    """
    merged = []
    for kind in ("gain", "delay"):
        of = {one.shown.name: one.numbers[kind] for one in alone if kind in one.numbers}
        while of:
            near = [
                [name for name, other in of.items() if abs(other - value) < _EQUAL_PART * max(abs(other), abs(value))]
                for value in of.values()
            ]
            names = max(near, key=len)
            value = float(np.median([of[name] for name in names]))
            of = {name: value for name, value in of.items() if name not in names}
            group = [one for one in alone if one.shown.name in names and one.by(kind, value)[0] < one.cost]
            if len(group) < 2:
                continue
            alone = [one for one in alone if one not in group]
            residual = np.concatenate([one.by(kind, value)[1] for one in group])
            change = gain_words(1.0 + value)[1] if kind == "gain" else size_text(kind, value)
            names = [one.shown.name for one in group]
            others = [name for name in moving if name not in names]
            if kind == "delay" and len(others) < len(names) and group[0].shown.counts is None:
                if not others:
                    continue
                names, value, change = others, -value, size_text(kind, -value)
            before = np.concatenate([one.shown.apart for one in group])
            merged.append(explain(f"{', '.join(names)} {kind}", change, value, residual, before, DEFECTS[kind].unit))
    return merged + _merge_shifts([one.explanation for one in alone])


def _merge_shifts(alone: list[Explanation]) -> list[Explanation]:
    """Merge channels that lost or repeated equally many rows: channels of one device lose them together."""
    found: dict[tuple[str, float], list[Explanation]] = {}
    for one in alone:
        what = one.channels_and_defect[1]
        shared = what in ("lost samples", "doubled samples")
        found.setdefault((what, one.value) if shared else (one.name, 0.0), []).append(one)
    merged = []
    for (what, _), group in found.items():
        first = max(group, key=lambda one: one.explained)
        if len(group) > 1:
            names = ", ".join(one.channels_and_defect[0] for one in group)
            squares, n = sum(one.squares for one in group), sum(one.n for one in group)
            first = replace(
                first, name=f"{names} {what}", explained=sum(one.explained for one in group), squares=squares, n=n,
                left=math.sqrt(squares / n), sure=all(one.sure for one in group),
            )  # fmt: skip
        merged.append(first)
    return merged


class Clock:
    """Residuals with a shifted and scaled clock of the recording; channels that are not smooth in time are excluded."""

    def __init__(self, parts: dict[str, Measured], nominal: Prediction, end_s: float) -> None:
        """Interpolate the prediction.

        Args:
            parts: Recorded channels.
            nominal: Prediction.
            end_s: End of the window [s].
        """
        from scipy.interpolate import CubicSpline

        self._splines = {
            name: CubicSpline(part.times_s, nominal.values[name])
            for name, part in parts.items()
            if part.count_rows(end_s) > 16 and (np.diff(part.times_s) > 0.0).all()
        }
        self._kept = {name: parts[name].select_until(end_s) for name in self._splines}
        self._end_s = end_s
        if self._kept:
            self._first_s = min(float(part.times_s[0]) for part in self._kept.values())
            self._period_s = min(float(np.diff(part.times_s).min()) for part in self._kept.values())

    def residuals(self, change: np.ndarray) -> np.ndarray:
        """Return the residuals over noise at a shift [s], or a shift and a rate [1], shape (n,)."""
        shift, rate = float(change[0]), float(change[1]) if len(change) > 1 else 0.0
        # The prediction continues after the window, so that a shift stays within it.
        values = {
            name: self._splines[name](part.times_s - shift - rate * (part.times_s - self._first_s))
            for name, part in self._kept.items()
        }
        return vector(self._kept, values)

    def coarse_shift(self) -> float:
        """Return the best shift in time to about a sample [s]; 0 if there are too few rows."""
        if not self._kept:
            return 0.0
        # A coarse grid suffices for the slope to converge.
        rows = np.unique(np.rint(np.concatenate([np.arange(-16, 17), np.linspace(-_SEARCH_ROWS, _SEARCH_ROWS, 101)])))
        shifts = rows * self._period_s
        return float(min(shifts, key=lambda shift: float(np.sum(self.residuals(np.array([shift])) ** 2))))

    def faults(self, start_s: float) -> list[Explanation]:
        """Return the explanation by a shift, and with a rate if that explains more; empty if they explain nothing.

        Args:
            start_s: Initial value of the shift [s].
        """
        before = excess(self.residuals(np.zeros(1))) if self._kept else 0.0
        explanations: list[Explanation] = []
        if before == 0.0:
            return explanations
        for rates in (False, True):
            done = fit(self.residuals, self._slopes, np.array([start_s, 0.0][: 1 + rates]), rounds=8, gain=1e-5)
            assert done is not None
            shift, rate = [*done.values.tolist(), 0.0][:2]
            change, value, unit = f"{shift * 1e6:+.1f} µs", shift, "s"
            if rates:
                change, value, unit = f"{change} and {rate * 1e6:+.1f} ppm", rate * 1e6, "ppm"
            explained = 1.0 - excess(done.residuals) / before
            if explained > 0.0 and (not explanations or done.squares < explanations[0].squares - MARGIN):
                explanations.append(
                    Explanation.of(
                        done.residuals, kind="time", name="clock" if rates else "time offset", change=change,
                        value=value, unit=unit, explained=explained, to_s=self._end_s,
                    )
                )  # fmt: skip
        return explanations

    def _slopes(self, change: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        length_s = self._end_s - self._first_s
        step_s = 0.02 * self._period_s
        steps = np.diag([step_s, step_s / max(length_s, self._period_s)][: len(change)])
        return np.column_stack([(self.residuals(change + step) - residuals) / step.sum() for step in steps])
