"""Laws of a channel's defects with few numbers, fitted to the recorded signal and the expected one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np

from replays.estimate.runs import find_true_runs
from replays.estimate.spectra import spectrum
from replays.recordings.validation.explanations.channel_fit import (
    MARGIN,
    MIN_ROWS,
    OUTLIER,
    Law,
    Shown,
    gain_words,
    least_at,
    rms_of,
    with_level,
)
from replays.recordings.validation.explanations.explanation import excess, is_noise
from replays.recordings.validation.explanations.signals import RAIL_ROWS, steady_rows
from replays.recordings.validation.explanations.timing import ac_coupled, delayed_by, filtered, late, ringing, shifted
from rig.base.units import get_quantity
from rig.channels.faults.defects import DEFECTS, size_text

_EXACT_PART = 0.01
"""Largest remaining part of a difference, if everything else is known to the bit."""
_EXPLAINED_PART = 0.05
"""Largest remaining part of an explained difference, if the model is not exact."""
_MIN_HUM_PERIODS = 1.5
"""Fewest periods of a hum."""
_MAX_ANGLE_STEP = 0.1
"""Largest error of a probe's angle by its projections [rad]."""
_RUNOUT_ORDERS, _MAX_SHOWN_ORDERS = (1, 2, 4, 8, 16, 32), 4
"""Numbers of components of a run-out that are tried, and most of them in its text."""
_MAX_HUM_HZ = 1000.0
"""Highest frequency of a hum."""
_COMPLEX_LAWS = ("resonance", "wander")
"""Laws with more numbers that resemble simpler ones over short stretches."""
_KIN = {"offset": ("drift", "hum", "crosstalk", "delay", "gain and offset"), "delay": ("clock", "wander", "gain")}
"""Laws that equal the first one with an additional number."""
_TIME_LAWS = ("delay", "clock", "wander")
"""Laws by which noise is sampled again, so that the residual is that of two independent noises."""
_MAX_OTHER_PART = 0.5
"""Largest part of the expected signal without its main line, for the signal to resemble hum."""
_MAX_OWN_LINE = 0.25
"""Largest line of the expected signal relative to a hum that is distinguished from it."""
_RESAMPLED_PART = 0.5
"""Largest remaining part of a difference, if noise was sampled again."""
_MIN_NOISE_RATIO = 1.6
"""Smallest ratio of noises at which independent additional noise is distinguished from resampled noise."""
_MAX_NOISE_FACTOR = 1.6
"""Largest residual of two independent noises, relative to one."""
_MAX_STRETCH_PART = 0.5
"""Largest part of the time with another gain, for the gain to have changed for a time."""
_ALL_PART = 0.95
"""Part of the rows above which all count as affected."""
_LEVEL_PART, _FADING_PART = 1e-3, 0.02
"""Tolerance of a level relative to the span, without and with a filter that fades."""
_MAX_ROUNDING = 2
"""Largest difference by rounding [counts]."""
_MIN_VISIBLE_PART = 0.02
"""Smallest part of a signal that counts as a signal."""
_MAX_CURVE_PART = 0.25
"""Largest residual of a curve relative to that of a line for a log, as other errors are curved, too."""
_MIN_STEADINESS = 0.6
"""Smallest median estimate of noise relative to its standard deviation."""
_MAX_SPIKE_PART = 0.3
"""Largest part of samples that are spikes."""


def law_of(one: Shown) -> Law:
    """Return the simplest law of a channel that leaves noise, or else the one with the least residual."""
    before = one.apart
    for law in [*_fit_steps(one), *_fit_rails(one)] if one.counts is None else _fit_counts(one, one.counts):
        return law
    held = steady_rows(one.values) if one.noise > 0.0 and one.counts is None else np.zeros(len(before), dtype=bool)
    if held.any() and excess(before[held]) > 0.5 * excess(before):
        times_s = one.times_s[held]
        return one.law("freeze", 0.0, before[~held], 1, f"from {times_s[0]:.4f} s, {len(times_s)} rows")
    laws = [*_fit_levels(one), *_fit_times(one), *_fit_parts(one)]
    if one.moves or one.counts is not None:
        laws += _fit_crosstalk(one)
        laws += _fit_curves(one)
    if one.moves and one.even:
        laws += [*late(one), *shifted(one), *filtered(one), *ac_coupled(one)]
    best = min((law for law in laws if law.sure), key=lambda law: one.cost(law.residual, law.count))
    rings = cache(lambda: list(ringing(one)))
    if one.counts is not None:
        # In a narrow band a resonance equals a gain with a delay, or another law with the same band.
        names = " or ".join([best.name, *_find_equal_laws(one, best, [*laws, *(rings() if one.moves else ())])])
        best = replace(best, name=" or ".join(dict.fromkeys(names.split(" or "))))
    rms = rms_of(before)
    if one.counts is None:
        if is_noise(best.residual) or rms_of(best.residual) < _EXPLAINED_PART * min(1.0, rms) + 1.0:
            return best
    elif rms < (_MAX_ROUNDING if one.moves else OUTLIER):
        return replace(best, sure=False)
    else:
        # Late samples have other noise, which is expected.
        # Impacts are too sharp to interpolate: the median over the rows counts.
        typical = 1.48 * float(np.median(np.abs(best.residual)))
        drawn = typical < _MAX_NOISE_FACTOR * one.noise / float(one.floor[0]) and _is_white(np.sign(best.residual))
        if is_noise(best.residual) or rms_of(best.residual) < (_RESAMPLED_PART if drawn else _EXACT_PART) * rms:
            return best
        twice = rms_of(best.residual) * float(one.floor[0]) / (math.sqrt(2.0) * one.noise) if one.noise > 0.0 else 0.0
        timed = best.name.split(" or ")[0] in _TIME_LAWS and one.cost(best.residual, best.count) < one.cost(before, 0)
        if timed and abs(twice - 1.0) < _EXACT_PART + 3.0 / math.sqrt(len(before)) and _is_white(best.residual):
            return best
        for law in rings():
            if rms_of(law.residual) < 2.0 * _EXACT_PART * rms:  # impacts between samples excite it, too
                return law
    return next(_fit_random(one), replace(best, sure=False))


def _find_equal_laws(one: Shown, best: Law, others: list[Law]) -> dict[str, None]:
    """Return the names of other laws with an equal residual, which even or small motion does not distinguish."""
    least, kind = one.cost(best.residual, 0) + MARGIN, best.name.partition(" ")[0]
    return dict.fromkeys(
        law.name
        for law in others
        if not {law.name, law.name.partition(" ")[0]} & {kind, *_KIN.get(kind, ())}
        and (law.count <= best.count + 1 or law.name in _COMPLEX_LAWS)
        and one.cost(law.residual, 0) < least
    )


def _is_white(residual: np.ndarray) -> bool:
    return abs(float(residual[1:] @ residual[:-1]) / max(float(residual @ residual), 1e-300)) < 0.1


def _fit_counts(one: Shown, counts: np.ndarray) -> Iterator[Law]:
    """Yield laws that are visible in counts, shape (n, 2), and explain them exactly."""
    code, sound = counts.T
    none = np.zeros(len(code))
    if (code == code[0]).all() and one.noise > 0.0 and one.at_begin(code[0] * one.channel.scale + one.channel.offset):
        level = one.channel.scale * code[0] + one.channel.offset
        yield one.law("freeze", 0.0, none, 1, f"at {level:.6g} {one.unit}")
        return
    for bit in range(one.channel.adc_bits - 1):
        mask = 1 << bit
        for value, shown in ((1, sound | mask), (0, sound & ~mask)):
            if (code == shown).all():
                yield one.law("stuck-bit", float(bit), none, 1, f"bit {bit} is {value}")
        if bit and (code == sound >> bit << bit).all():
            yield one.law("bits", float(bit), none)
    low, high = int(code.min()), int(code.max())
    ends = (sound > high).any() or (sound < low).any()
    if ends and (code == np.clip(sound, low, high)).all() and (one.noise > 0.0 or (code == sound).any()):
        part = max(abs(low), abs(high) + 1) / 2.0 ** (one.channel.adc_bits - 1)
        if part < 1.0:  # every converter has limits
            yield one.law("clip", part, none)
    off = code != sound
    sizes = np.abs(code - sound)[off]
    if off.mean() < _MAX_SPIKE_PART and len(sizes) and sizes.min() == sizes.max() > _MAX_ROUNDING:
        yield _make_spikes(one, off, none)


def _fit_steps(one: Shown) -> Iterator[Law]:
    """Yield a coarser rounding of a log's numbers."""
    levels, apart = np.unique(one.values), one.values - one.expected
    step = float(np.diff(levels).min(initial=np.inf))
    residual = (apart - np.clip(apart, -0.5 * step, 0.5 * step)) / one.floor
    ragged = np.abs((levels - levels[0]) / step % 1.0 - 0.5) < 0.5 - _LEVEL_PART
    if len(levels) > 1 and step > OUTLIER * one.noise and not ragged.any() and is_noise(residual):
        yield one.law("bits", step, residual, 1, f"in steps of {step:.4g} {one.unit}", unit=one.unit)


def _fit_rails(one: Shown) -> Iterator[Law]:
    """Yield limits at which a log's channel has equal numbers, if its expected signal exceeds them."""
    ends = [float(end) for end in (one.values.min(), one.values.max())]
    at = [int(np.count_nonzero(one.values == end)) >= RAIL_ROWS for end in ends]
    low, high = (end if there else sign * math.inf for end, there, sign in zip(ends, at, (-1.0, 1.0), strict=True))
    residual = (one.values - np.clip(one.expected, low, high)) / one.floor
    if low < high and excess(residual) < _EXPLAINED_PART * excess(one.apart):
        text = " and ".join(f"{end:.4g} {one.unit}" for end, there in zip(ends, at, strict=True) if there)
        yield one.law("clip", high if at[1] else low, residual, at.count(True), f"at {text}", unit=one.unit)


def _fit_parts(one: Shown) -> Iterator[Law]:
    """Yield, for a log, a gain during a part of the time, and values that wrap around at the ends of the range."""
    d, off = one.values - one.expected, np.flatnonzero(np.abs(one.apart) > OUTLIER)
    if one.counts is not None or not len(off):
        return
    rows = slice(off[0], off[-1] + 1)
    if MIN_ROWS <= rows.stop - rows.start < _MAX_STRETCH_PART * len(d):
        weights = (one.expected / one.floor)[rows]
        gain = float(weights @ (one.values / one.floor)[rows] / max(float(weights @ weights), 1e-300))
        factors = np.ones(len(d))
        factors[rows] = gain
        begin_s, end_s = one.times_s[[rows.start, rows.stop - 1]]
        change = f"{size_text('gain', gain - 1.0)} from {begin_s:.4f} to {end_s:.4f} s"
        yield one.law("gain", gain - 1.0, (one.values - factors * one.expected) / one.floor, 3, change)
    span = float(np.median(np.abs(d)[np.abs(d) > 0.5 * np.abs(d).max()]))
    turns = np.rint(d / span)
    span = float(turns @ d / max(float(turns @ turns), 1.0))
    if np.ptp(one.values) < span + 2.0 * OUTLIER * one.noise and turns.any() and not turns.all():
        yield one.law("wrap", span, (d - span * turns) / one.floor, 2)


def _make_spikes(one: Shown, rows: np.ndarray, residual: np.ndarray) -> Law:
    size = float(np.median(np.abs(one.values - one.expected)[rows]))
    rate = rows.sum() / max(float(one.times_s[-1] - one.times_s[0]), 1e-9)
    return one.law("spikes", size, residual, 2, f"{rows.sum()} of {size:.4g} {one.unit}, {rate:.3g} per second")


def _fit_levels(one: Shown) -> Iterator[Law]:
    """Yield offset, gain and constant signals."""
    ones, e = one.level, one.expected
    coupled = one.counts is not None and one.channel.highpass_hz > 0.0
    (shift,), residual = one.solve([ones], one.values - e)
    yield one.law("offset", float(shift), residual)
    rests = not one.moves
    if rests and one.counts is None:
        return
    # For a constant signal a gain fits as well as an offset, not better.
    for columns in [[e]] if rests else [[e], [e, ones]]:
        factors, residual = one.solve(columns)
        what, change = gain_words(gain := float(factors[0]))
        if (what == "signal" and one.counts is not None) or (rests and abs(float(e.mean())) < one.noise):
            continue  # the level is more specific
        if len(columns) > 1 and not one.exceeds_level(residual):
            continue
        if len(columns) > 1 and what == "gain" and not coupled:
            what, change = "gain and offset", f"{change}, {size_text('offset', factors[1], one.unit)}"
        numbers = {"gain": gain - 1.0} if "gain" in what else {}
        yield one.law(what, gain - 1.0, residual, len(columns), change, unit="", numbers=numbers)
    if one.counts is not None:
        (level,), residual = one.solve([ones])
        yield _make_level(one, float(level), residual)


def _make_level(one: Shown, level: float, residual: np.ndarray) -> Law:
    """Return the law of a constant level."""
    e, volts = one.expected, one.channel.bias_v + one.channel.sensitivity_v * level
    if one.channel.highpass_hz > 0.0:
        return one.law("open, short or stuck", 0.0, residual, 1, "nothing")
    if abs(volts) < 1e-3 * np.ptp(one.channel.range_v):
        return one.law("open or short", 0.0, residual, 1, DEFECTS["short"].words)
    if one.at_begin(level):
        return one.law("stuck", level, residual)
    middle = (np.mean(one.channel.range_v) - one.channel.bias_v) / one.channel.sensitivity_v
    beyond = bool(((e - middle) / (level - middle) > 1.0).all())
    return one.law("open or saturation" if beyond else "open", volts, residual, 1, size_text("open", volts))


def _fit_times(one: Shown) -> Iterator[Law]:
    """Yield functions of time that are added: a drift, a hum."""
    if not one.even:
        return
    t, d = one.times_s - one.times_s[0], one.values - one.expected
    ones, length_s = one.level, float(one.times_s[-1] - one.times_s[0])
    held = 2.0 * math.pi * one.channel.highpass_hz if one.counts is not None else 0.0
    slope = (1.0 - ones) / held if held else t
    (rate, level), residual = one.solve([slope, ones], d)
    law = one.law("drift", float(rate), residual, 2)
    yield from with_level(one, law, float(level), one.solve([slope], d)[1])

    def levelling(log_s: float) -> tuple[np.ndarray, np.ndarray]:
        return one.solve([-np.exp(-t / math.exp(log_s)), ones], d)

    ends = math.log(0.01 * length_s), math.log(3.0 * length_s)
    log_s = least_at(lambda log_s: rms_of(levelling(log_s)[1]), *ends)
    (far, level), residual = levelling(log_s)
    change = f"{far:+.4g} {one.unit} in {math.exp(log_s):.3g} s"
    law = one.law("drift", float(far), residual, 3, change, unit=one.unit)
    yield from with_level(one, law, float(level - far), one.solve([1.0 - np.exp(-t / math.exp(log_s))], d)[1])
    yield from _fit_runout(one)
    if not one.uniform:
        return
    period_s = length_s / (len(t) - 1)
    size = np.abs(spectrum((d - d.mean()) * np.hanning(len(d)), 4 * len(d)))
    hz = np.arange(len(size)) / (4 * len(d) * period_s)
    within = (hz * length_s > _MIN_HUM_PERIODS) & (hz < min(_MAX_HUM_HZ, 0.45 / period_s))
    if not within.any():
        return

    def columns(f: float, third: bool = False) -> list[np.ndarray]:
        turns = [2.0 * math.pi * f * t * k for k in ((1.0, 3.0) if third else (1.0,))]
        return [ones, *(wave(turn) for turn in turns for wave in (np.cos, np.sin))]

    peak, span = float(hz[within][size[within].argmax()]), 1.0 / length_s
    # An expected signal with a line there is not hum, unless the residual is noise.
    own, rest = one.solve(columns(peak), one.expected)
    alone = rms_of(rest) < _MAX_OTHER_PART * float(one.expected.std() / one.floor.min())
    for third in (False, True):
        f = least_at(
            lambda f, third=third: float(np.sum(one.solve(columns(f, third), d)[1] ** 2)), peak - span, peak + span
        )
        factors, residual = one.solve(columns(f, third), d)
        amplitude = math.hypot(factors[1], factors[2])
        if alone and math.hypot(*own[1:]) > _MAX_OWN_LINE * amplitude and not is_noise(residual):
            continue
        change = f"{f:.5g} Hz, {amplitude:.4g} {one.unit}" + (" with its third" if third else "")
        law = one.law("hum", amplitude, residual, 6 if third else 4, change)
        yield from with_level(one, law, float(factors[0]), one.solve(columns(f, third)[1:], d)[1])


def _fit_runout(one: Shown) -> Iterator[Law]:
    """Yield a waveform that is periodic with the angle of the shaft, for a probe of a log."""
    if one.turns is None or get_quantity(one.unit) != "length" or np.ptp(one.turns) < _MIN_HUM_PERIODS:
        return
    d, laws = one.values - one.expected, list[tuple[Law, float, np.ndarray]]()
    for n in _RUNOUT_ORDERS:
        angles = [2.0 * math.pi * k * one.turns for k in range(1, n + 1)]
        waves = [wave(angle) for angle in angles for wave in (np.cos, np.sin)]
        factors, residual = one.solve([one.level, *waves], d)
        sizes = np.hypot(factors[1::2], factors[2::2])
        one_turn = 2.0 * math.pi * np.outer(np.linspace(0.0, 1.0, 721), np.arange(1, n + 1))
        span = float(np.ptp(np.cos(one_turn) @ factors[1::2] + np.sin(one_turn) @ factors[2::2]))
        large = [k for k in np.argsort(-sizes)[:_MAX_SHOWN_ORDERS] if sizes[k] > _LEVEL_PART * span]
        parts = ", ".join(f"{k + 1}X {sizes[k]:.2g}" for k in sorted(large))
        change = f"{size_text('run-out', span, one.unit)} ({parts})"
        # Equal to hum near a higher order, it is hum.
        law = one.law("run-out", span, residual, 2 + n.bit_length(), change)
        laws.append((law, float(factors[0]), one.solve(waves, d)[1]))
    law, level, bare = min(laws, key=lambda fit: one.cost(fit[0].residual, fit[0].count))
    yield from with_level(one, law, level, bare)


def _fit_crosstalk(one: Shown) -> Iterator[Law]:
    """Yield crosstalk from another channel."""
    d, ones = one.values - one.expected, one.level
    laws, count = list[Law](), 4 if one.counts is None else 2
    for other, shown in one.neighbours().items():
        signal = one.coupled(*shown)
        (part, level), residual = one.solve([signal, ones], d)
        through = abs(part * one.channel.sensitivity_v / other.sensitivity_v)
        change = f"{part:.4g} {one.unit} for a {other.unit} of {other.name}"
        if one.counts is not None and through > 1.0:
            continue  # it cannot be larger than at its source
        if one.counts is not None and through > 0.0:
            change = f"{20.0 * math.log10(through):.3g} dB of {other.name}"
        law = one.law("crosstalk", float(part), residual, count, change, unit="")
        middle = float(signal.mean())
        bare = min((one.solve([signal - about], d)[1] for about in (0.0, middle)), key=rms_of)
        laws += with_level(one, law, float(level + part * middle), bare)
        if one.counts is None and other.unit == one.unit and get_quantity(one.unit) == "length":
            laws.append(_fit_angle(one, other.name, signal, count))
    if laws:
        # Channels with equal signals, such as opposite sides of a ring, are one source.
        best = min(laws, key=lambda law: one.cost(law.residual, count))
        least = one.cost(best.residual, count) + MARGIN
        alike = [law.change for law in laws if one.cost(law.residual, count) < least and law is not best]
        yield replace(best, change=" or ".join([best.change, *alike]))


def _fit_angle(one: Shown, other: str, signal: np.ndarray, count: int) -> Law:
    """Return the law of a probe at another angle, in the plane of a perpendicular one with an expected signal (n,)."""

    def turned(angle: float) -> np.ndarray:
        shown = math.cos(angle) * one.expected + math.sin(angle) * signal
        return one.solve([one.level], one.values - shown)[1]

    (own, part, _), _ = one.solve([one.expected, signal, one.level])
    about = math.atan2(part, own)
    angle = least_at(lambda angle: rms_of(turned(angle)), about - _MAX_ANGLE_STEP, about + _MAX_ANGLE_STEP)
    change = f"{math.degrees(abs(angle)):.3g} degrees {'toward' if angle > 0.0 else 'away from'} {other}"
    return one.law("angle", angle, turned(angle), count, change, unit="rad")


def _fit_curves(one: Shown) -> Iterator[Law]:
    """Yield a curved or limited characteristic."""
    e, reach, log = one.expected, float(np.abs(one.expected).max()), one.counts is None
    if reach == 0.0:
        return
    starts = [[reach * part] for part in (0.1, 0.3, 0.6, 1.0, 2.0, 5.0, 15.0)]
    # For a log, the level of the curve's centre is unknown.
    for about in (0.0, float(e.mean())) if log else (0.0,):
        (end,), residual = one.fitted(lambda p, at=about: at + p[0] * np.tanh((e - at) / p[0]), starts, [reach])
        plain = min(excess(one.solve(line)[1]) for line in ([e], [e - about + one.level])) if log else math.inf
        if abs(end) > _MIN_VISIBLE_PART * reach and excess(residual) < _MAX_CURVE_PART * plain:
            yield one.law("nonlinear", abs(float(end)), residual)
    low, high = float(one.values.min()), float(one.values.max())
    for _ in range(8):  # limits of the recorded signal, less the effect of noise on them
        over, under = e > high, e < low
        high = float(one.values[over].mean()) if over.any() else high
        low = float(one.values[under].mean()) if under.any() else low
    # In a log, impacts through a slow filter look limited.
    cut = (e > high).any() or (e < low).any()
    if one.counts is not None and cut and max(abs(low), abs(high)) > _MIN_VISIBLE_PART * reach:
        residual = (one.values - np.clip(e, low, high)) / one.floor
        change = f"from {low:.4g} to {high:.4g} {one.unit}"
        yield one.law("saturation", max(abs(low), abs(high)), residual, 2, change, unit=one.unit)


def _fit_random(one: Shown) -> Iterator[Law]:
    """Yield random changes: spikes, a loose contact, jitter, noise."""
    e, d = one.expected, one.values - one.expected
    off = np.abs(d) > OUTLIER * one.floor
    lengths = [end - begin for begin, end in find_true_runs(off)]
    if off.any() and off.mean() < _MAX_SPIKE_PART and max(lengths) < 3 and is_noise(one.apart[~off]):
        yield _make_spikes(one, off, one.apart[~off])
        return
    # The response of an AC-coupled channel to a level fades.
    fades = one.channel.highpass_hz > 0.0
    if one.counts is not None and one.moves and fades:
        near = _FADING_PART * float(np.ptp(e)) + 2.0 * OUTLIER * float(one.floor[0])
        loud = np.abs(e) > 5.0 * near
        gone, sound = (float((np.abs(values) < near)[loud].mean()) if loud.any() else 0.0 for values in (one.values, d))
        if gone + sound > _ALL_PART and min(gone, sound) > _FADING_PART:
            yield one.law("intermittent", gone, one.apart[~off], 2, f"{gone:.2g} of the time nothing")
            return
    if one.counts is not None and off.any() and not off.all() and one.moves:
        level = float(np.median(one.values[off]))
        # Filters approach the level.
        slack = (_FADING_PART if fades else _LEVEL_PART) * float(np.ptp(e)) + 2.0 * OUTLIER * one.floor
        there = off & (np.abs(one.values - level) < slack)
        varied = not fades or float(e[there].std()) > 5.0 * float(slack[0])
        if varied and there.sum() > max(MIN_ROWS, 0.5 * off.sum()):
            if there.mean() > _ALL_PART:  # the other rows are in transition
                yield _make_level(one, level, ((one.values - level) / one.floor)[there])
                return
            part, beyond = float(there.mean()), (e - level) * np.sign(float((e - level)[there].mean()))
            if (beyond[there] > -slack[there]).all() and (beyond[~off] < slack[~off]).all():
                change = f"at {level:.4g} {one.unit}"
                yield one.law("saturation", level, one.apart[~off], 2, change, unit=one.unit)
                return
            volts = one.channel.bias_v + one.channel.sensitivity_v * level
            change = f"{part:.2g} of the time at {level:.4g} {one.unit} ({volts:.3g} V)"
            yield one.law("intermittent", part, one.apart[~off], 2, change)
            return
    (_,), rest = one.solve([np.ones(len(d))], d)
    if one.moves and one.even and (one.counts is not None or _is_white(rest)):
        late_s, delayed, slope = delayed_by(one)
        timed, floor = one.values - delayed, (1.0 if one.counts is None else 1.5) * one.noise
        rms_s = math.sqrt(float(timed**2 @ slope**2) / float(slope**2 @ slope**2))
        bend = rms_s**2 * one.expected_at.derivative(2)(one.times_s - late_s) / math.sqrt(2.0)
        width = np.sqrt((rms_s * slope) ** 2 + bend**2 + floor**2)
        z, plain = (timed - bend / math.sqrt(2.0)) / width, float(rest.std()) * one.floor
        # The more probable of the two laws, each with one number.
        gain = float(np.sum(np.log(plain / width))) + 0.5 * float(rest @ rest / rest.var() - z @ z)
        visible = rms_s * rms_of(slope) > 2.0 * one.noise
        if gain > MARGIN and visible and (one.counts is None or _is_white(z)):
            change = f"{1e6 * rms_s:.4g} µs about {1e6 * late_s:.4g} µs"
            yield one.law("jitter", rms_s, z / z.std(), 2, change)
            return
    tied = one.moves and abs(float(np.corrcoef(rest, e)[0, 1])) > 0.1
    # Noise is stationary: differences at impacts alone are not noise.
    loud = 1.48 * float(np.median(np.abs(rest - np.median(rest)))) > _MIN_STEADINESS * float(rest.std())
    if _is_white(rest) and not tied and loud:
        ratio = float(rest.std())
        if one.counts is None:
            yield one.law("noise", ratio, rest / ratio)
            return
        spread = (one.channel.scale * one.counts[:, 0] + one.channel.offset - one.expected).std() / one.noise
        times = math.hypot(1.0, ratio * float(one.floor[0]) / one.noise)
        if abs(spread - 1.0) < abs(spread - times) and times > _MIN_NOISE_RATIO:
            change = "with the nominal level: samples are taken at other times"
            yield one.law("other noise", float(spread), rest / ratio, 1, change, unit="")
        else:
            yield one.law("noise", times, rest / ratio)
