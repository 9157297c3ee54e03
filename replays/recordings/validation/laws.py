"""What a channel may have by itself: laws with few numbers, fitted to what it shows beside what it should show."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from replays.recordings.validation.explanation import DECIDES, excess, is_noise
from replays.recordings.validation.shown import FEW, OFF, Law, Shown
from replays.recordings.validation.signals import runs_of, steady_rows
from rig.sensors.filters import channel_poles

_LATEST_S = 4e-3
"""How late a channel is looked for [s]."""
_EARLIEST_S, _HELD_S = -1e-6, 0.011
"""A log's channel may be early, one of the rig's own may not, as what is not yet cannot be shown; nor so late."""
_EXACTLY = 0.01
"""The same where all else is known to the bit."""
_NEARLY = 0.05
"""A change that takes away all but this part is it, though the model leaves something."""
_UNITS = {
    25.4: "as mm for inch", 1.0 / 25.4: "as inch for mm", 1e3: "a thousand", 1e-3: "a thousandth",
    9.80665: "as m/s^2 for g", 1.0 / 9.80665: "as g for m/s^2", 4.4482: "as N for lbf", 1.0 / 4.4482: "as lbf for N",
    60.0: "as 1/min for Hz", 1.0 / 60.0: "as Hz for 1/min", 2.0: "twice", 0.5: "half", 10.0: "tenfold",
    0.1: "a tenth",
}  # fmt: skip
"""Gains that slips with units and ranges make."""
_PERIODS = 1.5
"""So many periods of a hum must be there."""
_HIGHEST_HZ = 1000.0
"""Of a hum."""
_SEGMENTS = 40
"""Into so many a channel is cut to see how its delay goes."""
_SETTLES_S = 0.02
"""Behind this it is another filter's."""
_ENDS_S = 1e-3
"""Before the end of what is known, a filter cannot be taken back."""
_HARDLY = 0.3
"""Where this part of what differs is left without the folding, that is looked at too."""
_SETTLED = 5.0
"""Periods of its corner, behind which a filter has forgotten."""
_HALF = 0.5
"""What is left where noise was drawn again may be this part of what was there."""
_SAME = 0.8
"""Of the noise, below which what is left has none of its own."""
_ANOTHER = 1.6
"""What noise beside another seems to be times itself, at least."""
_DRAWN = 1.6
"""Of the noise, that the difference of two has at most."""
_ALL = 0.95
"""More than this part of the rows is all of them."""
_SLACK, _FADING = 1e-3, 0.02
"""Parts of its span by which a channel may be off a level."""
_ROUNDED = 2
"""Counts that rounding may make."""
_SPARSE = 0.3
"""Fewer than this part of the samples are spikes."""


def law_of(one: Shown) -> Law:
    """The simplest law of a channel that leaves noise, else the one that leaves least."""
    before = one.apart
    for law in _by_counts(one):
        return law
    held = steady_rows(one.values) if one.noise > 0.0 and one.counts is None else np.zeros(len(before), dtype=bool)
    if held.any() and excess(before[held]) > 0.5 * excess(before):
        times_s = one.times_s[held]
        return Law("stuck", f"from {times_s[0]:.4f} s, {len(times_s)} rows", 0.0, before[~held])
    laws = [*_of_level(one), *_of_time(one)]
    if one.moves or one.counts is not None:
        laws += _of_others(one)
    if one.moves:
        laws += _bent(one)
        if one.even:
            laws += [*_late(one), *_filtered(one)]
    best = min(laws, key=lambda law: one.cost(law.left, law.count))
    if one.counts is not None:
        least = one.cost(best.left, best.count) + DECIDES
        alike = dict.fromkeys(
            law.name for law in laws if law.count == best.count and one.cost(law.left, law.count) < least
        )
        best = replace(best, name=" or ".join([best.name, *(name for name in alike if name != best.name)]))
    rms = _rms(before)
    if one.counts is None:
        if is_noise(best.left) or _rms(best.left) < _NEARLY * min(1.0, rms) + 1.0:
            return best
    elif rms < _ROUNDED:
        return replace(best, sure=False)
    else:
        # Late samples have noise of their own, which is as good as none.
        # Knocks are too sharp to be told between samples: most rows count.
        typical = 1.48 * float(np.median(np.abs(best.left)))
        drawn = typical < _DRAWN * one.noise / float(one.floor[0]) and _white(np.sign(best.left))
        if is_noise(best.left) or _rms(best.left) < (_HALF if drawn else _EXACTLY) * rms:
            return best
        for law in _ringing(one):
            if _rms(law.left) < _EXACTLY * rms:
                return law
    return next(_at_random(one), replace(best, sure=False))


def _white(left: np.ndarray) -> bool:
    return abs(float(left[1:] @ left[:-1]) / max(float(left @ left), 1e-300)) < 0.1


def _rms(left: np.ndarray) -> float:
    return math.sqrt(float(left @ left) / max(1, len(left)))


def _by_counts(one: Shown) -> Iterator[Law]:
    """What is seen in counts alone, and leaves nothing."""
    if one.counts is None:
        return
    said, sound = one.counts.T
    none = np.zeros(len(said))
    if (said == said[0]).all() and one.noise > 0.0 and one.at_begin(said[0] * one.channel.scale + one.channel.offset):
        yield Law("freeze", f"at {one.channel.scale * said[0] + one.channel.offset:.6g} {one.unit}", 0.0, none)
        return
    for bit in range(one.channel.adc_bits - 1):
        mask = 1 << bit
        for value, shown in ((1, sound | mask), (0, sound & ~mask)):
            if (said == shown).all():
                yield Law("stuck-bit", f"bit {bit} is {value}", float(bit), none)
        if bit and (said == sound >> bit << bit).all():
            yield Law("bits", f"the lowest {bit} lost", float(bit), none)
    low, high = int(said.min()), int(said.max())
    if (said == np.clip(sound, low, high)).all() and ((sound > high).any() or (sound < low).any()):
        part = max(abs(low), abs(high) + 1) / 2.0 ** (one.channel.adc_bits - 1)
        yield Law("clip", f"at {part:.4g} of the converter's range", part, none)
    off = said != sound
    sizes = np.abs(said - sound)[off]
    if off.mean() < _SPARSE and len(sizes) and sizes.min() == sizes.max() > _ROUNDED:
        yield _spikes(one, off, none)


def _least(cost: Callable[[float], float], low: float, high: float) -> float:
    """Where a cost is least between two ends."""
    from scipy.optimize import minimize_scalar

    found: Any = minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 1e-9})
    return float(found.x)


def _spikes(one: Shown, rows: np.ndarray, left: np.ndarray) -> Law:
    size = float(np.median(np.abs(one.values - one.foretold)[rows]))
    rate = rows.sum() / max(float(one.times_s[-1] - one.times_s[0]), 1e-9)
    return Law("spikes", f"{rows.sum()} of {size:.4g} {one.unit}, {rate:.3g} a second", size, left, 2, one.unit)


def _of_level(one: Shown) -> Iterator[Law]:
    """Offset, gain and what is left of a signal."""
    ones, e, unit = one.level, one.foretold, one.unit
    coupled = one.counts is not None and one.channel.highpass_hz > 0.0
    (shift,), left = one.left([ones], one.values - e)
    yield Law("offset", f"{shift:+.4g} {unit}", float(shift), left, 1, unit)
    rests = not one.moves
    if rests and one.counts is None:
        return
    # Of something that rests, a gain is as good as an offset, but no better.
    for columns in [[e]] if rests else [[e], [e, ones]]:
        factors, left = one.left(columns)
        what, change = gain_words(gain := float(factors[0]))
        if (what == "signal" and one.counts is not None) or (rests and abs(float(e.mean())) < one.noise):
            continue  # the level says more
        if len(columns) > 1 and what == "gain" and not coupled:
            what, change = "gain and offset", f"{change}, {factors[1]:+.4g} {unit}"
        numbers = {"gain": gain - 1.0} if "gain" in what else {}
        yield Law(what, change, gain - 1.0, left, len(columns), "", numbers)
    if one.counts is not None:
        (level,), left = one.left([ones])
        yield _level_law(one, float(level), left)


def _level_law(one: Shown, level: float, left: np.ndarray) -> Law:
    """Nothing but a level."""
    e, volts = one.foretold, one.channel.bias_v + one.channel.sensitivity_v * level
    if one.channel.highpass_hz > 0.0:
        return Law("open, short or stuck", "nothing", 0.0, left)
    if abs(volts) < 1e-3 * np.ptp(one.channel.range_v):
        return Law("open or short", "0 V", 0.0, left, 1, "V")
    if one.at_begin(level):
        return Law("stuck", f"at {level:.5g} {one.unit}", level, left, 1, one.unit)
    middle = (np.mean(one.channel.range_v) - one.channel.bias_v) / one.channel.sensitivity_v
    beyond = bool(((e - middle) / (level - middle) > 1.0).all())
    return Law("open or saturation" if beyond else "open", f"{volts:.4g} V", volts, left, 1, "V")


def _of_time(one: Shown) -> Iterator[Law]:
    """What is added as a function of time: a drift, a hum."""
    if not one.even:
        return
    t, d = one.times_s - one.times_s[0], one.values - one.foretold
    ones, length_s = one.level, float(one.times_s[-1] - one.times_s[0])
    held = 2.0 * math.pi * one.channel.highpass_hz if one.counts is not None else 0.0
    (rate, _), left = one.left([(1.0 - ones) / held if held else t, ones], d)
    yield Law("drift", f"{rate:+.4g} {one.unit}/s", float(rate), left, 2, f"{one.unit}/s")

    def levelling(log_s: float) -> tuple[np.ndarray, np.ndarray]:
        return one.left([-np.exp(-t / math.exp(log_s)), ones], d)

    ends = math.log(0.01 * length_s), math.log(3.0 * length_s)
    log_s = _least(lambda log_s: _rms(levelling(log_s)[1]), *ends)
    (far, _), left = levelling(log_s)
    yield Law("drift", f"{far:+.4g} {one.unit} in {math.exp(log_s):.3g} s", float(far), left, 3, one.unit)
    if not one.uniform:
        return
    period_s = length_s / (len(t) - 1)
    size = np.abs(np.fft.rfft((d - d.mean()) * np.hanning(len(d)), 4 * len(d)))
    hz = np.fft.rfftfreq(4 * len(d), period_s)
    within = (hz * length_s > _PERIODS) & (hz < min(_HIGHEST_HZ, 0.45 / period_s))
    if not within.any():
        return

    def columns(f: float, third: bool = False) -> list[np.ndarray]:
        turns = [2.0 * math.pi * f * t * k for k in ((1.0, 3.0) if third else (1.0,))]
        return [ones, *(wave(turn) for turn in turns for wave in (np.cos, np.sin))]

    peak, span = float(hz[within][size[within].argmax()]), 1.0 / length_s
    for third in (False, True):
        f = _least(
            lambda f, third=third: float(np.sum(one.left(columns(f, third), d)[1] ** 2)), peak - span, peak + span
        )
        factors, left = one.left(columns(f, third), d)
        amplitude = math.hypot(factors[1], factors[2])
        change = f"{f:.5g} Hz, {amplitude:.4g} {one.unit}"
        yield Law("hum", change + (" with its third" if third else ""), amplitude, left, 6 if third else 4, one.unit)


def _of_others(one: Shown) -> Iterator[Law]:
    """What comes over from another channel."""
    d, ones = one.values - one.foretold, one.level
    for other, shown in one.beside().items():
        (part, _), left = one.left([one.coupled(*shown), ones], d)
        through = abs(part * one.channel.sensitivity_v / other.sensitivity_v)
        change = f"{part:.4g} {one.unit} for a {other.unit} of {other.name}"
        if one.counts is not None and through > 0.0:
            change = f"{20.0 * math.log10(through):.3g} dB of {other.name}"
        yield Law("crosstalk", change, float(part), left, 4 if one.counts is None else 2)


def _bent(one: Shown) -> Iterator[Law]:
    """A curve, or an end, of what it can show."""
    e, reach = one.foretold, float(np.abs(one.foretold).max())
    if reach == 0.0:
        return
    starts = [[reach * part] for part in (0.1, 0.3, 0.6, 1.0, 2.0, 5.0, 15.0)]
    (end,), left = one.fitted(lambda p: p[0] * np.tanh(e / p[0]), starts, [reach])
    count = 1 if one.counts is not None else 2
    yield Law("nonlinear", f"end at {abs(end):.4g} {one.unit}", abs(float(end)), left, count, one.unit)
    low, high = float(one.values.min()), float(one.values.max())
    for _ in range(8):  # the ends of what it shows, less what noise adds to them
        over, under = e > high, e < low
        high = float(one.values[over].mean()) if over.any() else high
        low = float(one.values[under].mean()) if under.any() else low
    if (e > high).any() or (e < low).any():
        left = (one.values - np.clip(e, low, high)) / one.floor
        yield Law("saturation", f"from {low:.4g} to {high:.4g} {one.unit}", max(abs(low), abs(high)), left, 2, one.unit)


def _late(one: Shown) -> Iterator[Law]:
    """A time that is not that of the others."""
    ones, spline, t = np.ones(len(one.values)), one.foretold_at, one.times_s - one.times_s[0]
    late_s, delayed, _ = _delayed(one)
    if one.counts is not None:
        (late_s,), _ = one.fitted(lambda p: spline(one.times_s - p[0]), [[late_s]], [1e-6])
        delayed = spline(one.times_s - late_s)
    earliest_s, latest_s = (-_LATEST_S, _LATEST_S) if one.counts is None else (_EARLIEST_S, _HELD_S)
    if earliest_s <= late_s <= latest_s + 2.0 * one.period_s:  # else it is the search's end
        (shift,), left = one.left([ones], one.values - delayed)
        change, of = f"{late_s * 1e6:+.4g} µs", {"delay": late_s}
        yield Law("delay", change, late_s, (one.values - delayed) / one.floor, 1, "s", of)
        if abs(shift) > one.noise:
            yield Law("delay and offset", f"{change}, {shift:+.4g} {one.unit}", late_s, left, 2, "s", of)
        if one.counts is not None and abs(late_s) < -_EARLIEST_S:
            return  # there is no delay in it
        factors, left = one.left([delayed, ones])
        what, also = gain_words(gain := float(factors[0]))
        yield Law(f"{what} and delay", f"{also}, {change}", gain - 1.0, left, 3, "", of)
    if one.counts is None or one.channel.signal == "keyphasor":
        return  # of a log, the time of all is fitted before; pulses tell by their edges
    at, delays = _delays(one)
    if len(at) < 6:
        return
    rate, start = np.polyfit(at, delays, 1)
    (start, rate), left = one.fitted(
        lambda p: spline(one.times_s - p[0] - p[1] * t), [[start, rate], [0.0, rate]], [1e-6, 1e-6]
    )
    if min(start, start + rate * t[-1]) > _EARLIEST_S:
        yield Law("clock", f"{1e6 * rate:+.5g} ppm", 1e6 * float(rate), left, 2, "ppm")
    length_s = float(t[-1])
    starts = []
    for period_s in 2.0 * length_s / np.arange(1.0, 2.0 * _SEGMENTS / 3.0):
        turn = 2.0 * math.pi * at / period_s
        table = np.column_stack([np.ones(len(at)), np.cos(turn), np.sin(turn)])
        starts.append([*np.linalg.lstsq(table, delays, rcond=None)[0].tolist(), period_s])
    (mean_s, a, b, period_s), left = one.fitted(
        lambda p: spline(
            one.times_s - p[0] - p[1] * np.cos(2.0 * math.pi * t / p[3]) - p[2] * np.sin(2.0 * math.pi * t / p[3])
        ),
        starts, [1e-6, 1e-6, 1e-6, length_s],
    )  # fmt: skip
    size = math.hypot(a, b)
    if mean_s - size > _EARLIEST_S:
        yield Law("wander", f"{1e6 * size:.4g} µs in {abs(period_s):.4g} s", size, left, 4, "s")


def _delays(one: Shown) -> tuple[np.ndarray, np.ndarray]:
    """How the delay goes: middles of pieces behind the first row [s], and how late each is [s]."""
    spline, t = one.foretold_at, one.times_s - one.times_s[0]
    slope, at, found, late_s = spline.derivative(), [], [], 0.0
    for rows in np.array_split(np.arange(len(t)), min(_SEGMENTS, len(t) // FEW)):
        for _ in range(8):
            places = one.times_s[rows] - late_s
            falls, off = -slope(places), one.values[rows] - spline(places)
            weight = float(falls @ falls)
            step = float(falls @ off) / weight if weight > 0.0 else 0.0
            late_s = float(np.clip(late_s + np.clip(step, -20.0 * one.period_s, 20.0 * one.period_s), -0.02, 0.02))
        at.append(float(t[rows].mean()))
        found.append(late_s)
    return np.array(at), np.array(found)


def _delayed(one: Shown) -> tuple[float, np.ndarray, np.ndarray]:
    """By how much a channel is late [s], what it should show then, and the slope of that [its unit/s]."""
    spline = one.foretold_at
    slope, period_s = spline.derivative(), one.period_s

    def cost(late_s: float) -> float:
        shown = spline(one.times_s - late_s)
        if one.counts is None:
            return _rms(one.left([shown, np.ones(len(shown))])[1])
        return _rms(one.left([one.level], one.values - shown)[1])

    if one.counts is None:
        far = np.linspace(-_LATEST_S, _LATEST_S, 81) / period_s
        rows = np.unique(np.rint(np.concatenate([np.arange(-16, 17), far])))
    else:
        rows = np.arange(0.0, _HELD_S / period_s)
    late_s = float(min(rows * period_s, key=cost))
    for _ in range(6):
        at = one.times_s - late_s
        (_, step, _), _ = one.left([spline(at), -slope(at), np.ones(len(at))])
        late_s = float(np.clip(late_s + np.clip(step, -period_s, period_s), -_HELD_S, _HELD_S))
    at = one.times_s - late_s
    return late_s, spline(at), slope(at)


def _filtered(one: Shown) -> Iterator[Law]:
    """A low-pass at another corner."""
    if one.counts is None:
        slope = one.foretold_at.derivative()(one.times_s)
        factors, left = one.left([slope, np.gradient(slope, one.times_s)], one.values - one.foretold)
        lower = "lower" if factors[1] > 0.0 else "higher"
        yield Law("bandwidth", f"{lower} than told", float(factors[1]), left, 2)
        return
    if not one.uniform:
        return
    channel, (begin, wave, turn) = one.channel, _waves(one)

    def through(corner_hz: float) -> np.ndarray:
        poles, residues, direct = channel_poles(
            channel.model_copy(update={"bandwidth_hz": corner_hz, "highpass_hz": 0.0})
        )
        shown = np.full(len(turn), complex(direct))
        for pole, residue in zip(poles.tolist(), residues.tolist(), strict=True):
            shown += residue / (turn - pole)
            if pole.imag:  # one of a pair: their residues are given doubled
                shown += 0.5 * (residue.conjugate() / (turn - pole.conjugate()) - residue / (turn - pole))
        return shown

    plain = wave / through(channel.bandwidth_hz)
    margin = min(len(one.values) // 8, round(_SETTLES_S / one.period_s))

    def left_by(other: np.ndarray | float) -> np.ndarray:
        left = one.values - np.fft.irfft(plain * other)[begin:][: len(one.values)]
        left = one.left([one.level], left)[1] if channel.highpass_hz else left / one.floor
        known = slice(margin, -round(_ENDS_S / one.period_s))  # how it goes on tells of what is behind a filter
        left[: known.start] = left[known.stop :] = _rms(left[known])
        return left

    def cost(log_hz: float) -> float:
        settled = min(len(one.values) // 2, round(_SETTLED / math.exp(log_hz) / one.period_s))
        return _rms(left_by(through(math.exp(log_hz)))[max(margin, settled) :])

    grid = np.log(np.geomspace(10.0, 0.98 * channel.bandwidth_hz, 40))
    near, step = min(grid, key=cost), grid[1] - grid[0]
    corner_hz = math.exp(_least(cost, near - step, min(near + step, grid[-1])))
    margin = max(margin, min(len(one.values) // 2, round(_SETTLED / corner_hz / one.period_s)))
    left = left_by(through(corner_hz))
    if _rms(left) < _SAME * max(1.0, one.noise / float(one.floor[0])):  # else noise of another time is in it
        yield Law("bandwidth", f"{corner_hz:.4g} Hz", corner_hz, left, 1, "Hz")
    if one.bare is not None and (_rms(left_by(1.0)) < _HARDLY * _rms(one.apart)):
        _, left = one.left([one.level] if channel.highpass_hz else [np.zeros(len(one.values))], one.values - one.bare())
        yield Law("no-filter", "what is above half of the rate folds back", 0.0, left, 1)


def _waves(one: Shown) -> tuple[int, np.ndarray, np.ndarray]:
    """What it should show, from before to behind, there and back: its first row, spectrum, frequencies [2 pi i Hz]."""
    times_s, e = one.around or (one.times_s, one.foretold)
    round_trip = np.concatenate([e, e[::-1]])
    turn = 2j * math.pi * np.fft.rfftfreq(len(round_trip), one.period_s)
    return int(np.searchsorted(times_s, one.times_s[0])), np.fft.rfft(round_trip), turn


def _ringing(one: Shown) -> Iterator[Law]:
    """A transducer with a resonance of its own, which may ring from what was before."""
    if not one.uniform or not one.moves:
        return
    from scipy.interpolate import make_interp_spline
    from scipy.optimize import minimize

    begin, wave, turn = _waves(one)
    t = one.times_s - one.times_s[0]

    def left(logs: np.ndarray) -> np.ndarray:
        w, quality = 2.0 * math.pi * math.exp(logs[0]), 0.5 + math.exp(logs[1])
        shown = np.fft.irfft(wave * w**2 / (turn**2 + turn * w / quality + w**2))[begin:][: len(t)]
        fading, angle = np.exp(-0.5 * w / quality * t), w * math.sqrt(1.0 - 0.25 / quality**2) * t
        return one.left([fading * np.cos(angle), fading * np.sin(angle), one.level], one.values - shown)[1]

    # x'' = w^2 (e - x) - (w / quality) x' has both numbers, though knocks do not make it exact.
    shown = make_interp_spline(t, one.values, k=5)
    pulls = [one.foretold - one.values, -shown.derivative()(t)]
    (stiff, damping), _ = one.left(pulls, shown.derivative(2)(t))
    if not (stiff > 0.0 and damping > 0.0 and math.sqrt(stiff) > 0.5 * damping):
        return
    start = [math.log(math.sqrt(stiff) / 2.0 / math.pi), math.log(math.sqrt(stiff) / damping - 0.5)]
    close = {"xatol": 1e-7, "fatol": 1e-3}
    found: Any = minimize(lambda logs: math.log(_rms(left(logs))), start, method="Nelder-Mead", options=close)
    hz, quality = math.exp(found.x[0]), 0.5 + math.exp(found.x[1])
    yield Law("resonance", f"at {hz:.4g} Hz, quality {quality:.3g}", hz, left(found.x), 4, "Hz")


def _at_random(one: Shown) -> Iterator[Law]:
    """What no sample tells of the next: spikes, a loose contact, jitter, noise."""
    e, d = one.foretold, one.values - one.foretold
    off = np.abs(d) > OFF * one.floor
    lengths = [end - begin for begin, end in runs_of(off)]
    if off.any() and off.mean() < _SPARSE and max(lengths) < 3 and is_noise(one.apart[~off]):
        yield _spikes(one, off, one.apart[~off])
        return
    if off.any() and not off.all() and one.moves:
        level = float(np.median(one.values[off]))
        # Filters go towards it, and an AC-coupled one shows nothing of it but what fades away.
        fades = one.counts is not None and one.channel.highpass_hz > 0.0
        slack = (_FADING if fades else _SLACK) * float(np.ptp(e)) + 2.0 * OFF * one.floor
        there = off & (np.abs(one.values - level) < slack)
        varied = not fades or float(e[there].std()) > 5.0 * float(slack[0])
        if varied and there.sum() > max(FEW, 0.5 * off.sum()):
            if there.mean() > _ALL and one.counts is not None:  # the rest is on the way
                yield _level_law(one, level, ((one.values - level) / one.floor)[there])
                return
            part, beyond = float(there.mean()), (e - level) * np.sign(float((e - level)[there].mean()))
            if (beyond[there] > -slack[there]).all() and (beyond[~off] < slack[~off]).all():
                yield Law("saturation", f"at {level:.4g} {one.unit}", level, one.apart[~off], 2, one.unit)
                return
            volts = one.channel.bias_v + one.channel.sensitivity_v * level
            change = f"{part:.2g} of the time at {level:.4g} {one.unit} ({volts:.3g} V)"
            yield Law("intermittent", change, part, one.apart[~off], 2)
            return
    (_,), rest = one.left([np.ones(len(d))], d)
    if one.moves and one.even:
        late_s, delayed, slope = _delayed(one)
        timed, floor = one.values - delayed, one.floor if one.counts is None else np.full(len(d), 1.5 * one.noise)
        rms_s = math.sqrt(float(timed**2 @ slope**2) / float(slope**2 @ slope**2))
        bend = rms_s**2 * one.foretold_at.derivative(2)(one.times_s - late_s) / math.sqrt(2.0)
        width = np.sqrt((rms_s * slope) ** 2 + bend**2 + floor**2)
        z, plain = (timed - bend / math.sqrt(2.0)) / width, float(rest.std()) * one.floor
        # The more likely of the two; each has a number of its own.
        gain = float(np.sum(np.log(plain / width))) + 0.5 * float(rest @ rest / rest.var() - z @ z)
        seen = one.counts is None or rms_s * _rms(slope) > 2.0 * one.noise
        if gain > DECIDES and seen and _white(z):
            yield Law("jitter", f"{1e6 * rms_s:.4g} µs about {1e6 * late_s:.4g} µs", rms_s, z / z.std(), 2, "s")
            return
    tied = one.moves and abs(float(np.corrcoef(rest, e)[0, 1])) > 0.1
    if _white(rest) and not tied:
        ratio = float(rest.std())
        if one.counts is None:
            yield Law("noise", f"x {ratio:.2f}", ratio, rest / ratio)
            return
        said = (one.channel.scale * one.counts[:, 0] + one.channel.offset - one.foretold).std() / one.noise
        times = math.hypot(1.0, ratio * float(one.floor[0]) / one.noise)
        if abs(said - 1.0) < abs(said - times) and times > _ANOTHER:
            yield Law("other noise", "as loud as told: samples are taken at other times", float(said), rest / ratio)
        else:
            yield Law("noise", f"x {times:.2f}", times, rest / ratio)


def gain_words(gain: float) -> tuple[str, str]:
    """What a factor is called, and how large it is, in words."""
    known = next((text for factor, text in _UNITS.items() if abs(gain / factor - 1.0) < 0.02), "")
    if abs(gain + 1.0) < 0.1:
        return "polarity", "turned round"
    if abs(gain) < 0.05 and not known:
        return "signal", "missing"
    return "gain", f"{100.0 * (gain - 1.0):+.3g} %" + (f" ({known})" if known else "")
