"""What a channel may have by itself: laws with few numbers, fitted to what it shows beside what it should show."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np

from replays.estimate.runs import true_runs
from replays.estimate.spectra import spectrum
from replays.recordings.validation.explanations.channel_fit import (
    DECIDES,
    FEW,
    OFF,
    Law,
    Shown,
    gain_words,
    least_at,
    rms_of,
)
from replays.recordings.validation.explanations.explanation import excess, is_noise
from replays.recordings.validation.explanations.signals import steady_rows
from replays.recordings.validation.explanations.timing import delayed_by, filtered, late, ringing
from rig.channels.faults.defects import DEFECTS, size_text

_EXACTLY = 0.01
"""The same where all else is known to the bit."""
_NEARLY = 0.05
"""A change that takes away all but this part is it, though the model leaves something."""
_PERIODS = 1.5
"""So many periods of a hum must be there."""
_HIGHEST_HZ = 1000.0
"""Of a hum."""
_BENDS = ("resonance", "wander")
"""Laws of more numbers that look like simpler ones where little is seen of them."""
_MORE = {"offset": ("drift", "hum", "crosstalk", "delay", "gain and offset"), "delay": ("clock", "wander", "gain")}
"""Laws that are one with another number."""
_TIMES = ("delay", "clock", "wander")
"""Laws by which noise is drawn again, so that there is exactly that of two draws."""
_LOUD = 0.5
"""Less than this part of what it should show is left without its loudest line."""
_OWN = 0.25
"""A line of its own, over that of a hum, by which it is not told from it."""
_HALF = 0.5
"""What is left where noise was drawn again may be this part of what was there."""
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
_NOTHING = 0.02
"""What shows no more than this part of its signal shows nothing."""
_CLEARLY = 0.25
"""Of what a straight line leaves of a log, that a curve may leave: what is off elsewhere bends, too."""
_STEADY = 0.6
"""Of what noise is by its deviation, that it is by its median at least."""
_SPARSE = 0.3
"""Fewer than this part of the samples are spikes."""


def law_of(one: Shown) -> Law:
    """The simplest law of a channel that leaves noise, else the one that leaves least."""
    before = one.apart
    for law in _in_steps(one) if one.counts is None else _by_counts(one, one.counts):
        return law
    held = steady_rows(one.values) if one.noise > 0.0 and one.counts is None else np.zeros(len(before), dtype=bool)
    if held.any() and excess(before[held]) > 0.5 * excess(before):
        times_s = one.times_s[held]
        return one.law("freeze", 0.0, before[~held], 1, f"from {times_s[0]:.4f} s, {len(times_s)} rows")
    laws = [*_of_level(one), *_of_time(one)]
    if one.moves or one.counts is not None:
        laws += _of_others(one)
        laws += _bent(one)
    if one.moves and one.even:
        laws += [*late(one), *filtered(one)]
    best = min((law for law in laws if law.sure), key=lambda law: one.cost(law.left, law.count))
    rings = cache(lambda: list(ringing(one)))
    if one.counts is not None:
        # Of a narrow band, a resonance is a gain with a delay, or what has the same band.
        names = " or ".join([best.name, *_alike(one, best, [*laws, *(rings() if one.moves else ())])])
        best = replace(best, name=" or ".join(dict.fromkeys(names.split(" or "))))
    rms = rms_of(before)
    if one.counts is None:
        if is_noise(best.left) or rms_of(best.left) < _NEARLY * min(1.0, rms) + 1.0:
            return best
    elif rms < (_ROUNDED if one.moves else OFF):
        return replace(best, sure=False)
    else:
        # Late samples have noise of their own, which is as good as none.
        # Knocks are too sharp to be told between samples: most rows count.
        typical = 1.48 * float(np.median(np.abs(best.left)))
        drawn = typical < _DRAWN * one.noise / float(one.floor[0]) and _white(np.sign(best.left))
        if is_noise(best.left) or rms_of(best.left) < (_HALF if drawn else _EXACTLY) * rms:
            return best
        twice = rms_of(best.left) * float(one.floor[0]) / (math.sqrt(2.0) * one.noise) if one.noise > 0.0 else 0.0
        timed = best.name.split(" or ")[0] in _TIMES and one.cost(best.left, best.count) < one.cost(before, 0)
        if timed and abs(twice - 1.0) < _EXACTLY + 3.0 / math.sqrt(len(before)) and _white(best.left):
            return best
        for law in rings():
            if rms_of(law.left) < 2.0 * _EXACTLY * rms:  # knocks between samples ring, too
                return law
    return next(_at_random(one), replace(best, sure=False))


def _alike(one: Shown, best: Law, others: list[Law]) -> dict[str, None]:
    """Names of other laws than the best that leave as little: what moves evenly, or little, tells them not apart."""
    least, kind = one.cost(best.left, 0) + DECIDES, best.name.partition(" ")[0]
    return dict.fromkeys(
        law.name
        for law in others
        if not {law.name, law.name.partition(" ")[0]} & {kind, *_MORE.get(kind, ())}
        and (law.count <= best.count + 1 or law.name in _BENDS)
        and one.cost(law.left, 0) < least
    )


def _white(left: np.ndarray) -> bool:
    return abs(float(left[1:] @ left[:-1]) / max(float(left @ left), 1e-300)) < 0.1


def _by_counts(one: Shown, counts: np.ndarray) -> Iterator[Law]:
    """What is seen in counts alone, shape (n, 2), and leaves nothing."""
    said, sound = counts.T
    none = np.zeros(len(said))
    if (said == said[0]).all() and one.noise > 0.0 and one.at_begin(said[0] * one.channel.scale + one.channel.offset):
        level = one.channel.scale * said[0] + one.channel.offset
        yield one.law("freeze", 0.0, none, 1, f"at {level:.6g} {one.unit}")
        return
    for bit in range(one.channel.adc_bits - 1):
        mask = 1 << bit
        for value, shown in ((1, sound | mask), (0, sound & ~mask)):
            if (said == shown).all():
                yield one.law("stuck-bit", float(bit), none, 1, f"bit {bit} is {value}")
        if bit and (said == sound >> bit << bit).all():
            yield one.law("bits", float(bit), none)
    low, high = int(said.min()), int(said.max())
    ends = (sound > high).any() or (sound < low).any()
    if ends and (said == np.clip(sound, low, high)).all() and (one.noise > 0.0 or (said == sound).any()):
        part = max(abs(low), abs(high) + 1) / 2.0 ** (one.channel.adc_bits - 1)
        if part < 1.0:  # every converter has its own ends
            yield one.law("clip", part, none)
    off = said != sound
    sizes = np.abs(said - sound)[off]
    if off.mean() < _SPARSE and len(sizes) and sizes.min() == sizes.max() > _ROUNDED:
        yield _spikes(one, off, none)


def _in_steps(one: Shown) -> Iterator[Law]:
    """A log's numbers that are rounded far more than they should be."""
    levels, apart = np.unique(one.values), one.values - one.foretold
    step = float(np.diff(levels).min(initial=np.inf))
    left = (apart - np.clip(apart, -0.5 * step, 0.5 * step)) / one.floor
    ragged = np.abs((levels - levels[0]) / step % 1.0 - 0.5) < 0.5 - _SLACK
    if len(levels) > 1 and step > OFF * one.noise and not ragged.any() and is_noise(left):
        yield one.law("bits", step, left, 1, f"in steps of {step:.4g} {one.unit}", unit=one.unit)


def _spikes(one: Shown, rows: np.ndarray, left: np.ndarray) -> Law:
    size = float(np.median(np.abs(one.values - one.foretold)[rows]))
    rate = rows.sum() / max(float(one.times_s[-1] - one.times_s[0]), 1e-9)
    return one.law("spikes", size, left, 2, f"{rows.sum()} of {size:.4g} {one.unit}, {rate:.3g} a second")


def _of_level(one: Shown) -> Iterator[Law]:
    """Offset, gain and what is left of a signal."""
    ones, e = one.level, one.foretold
    coupled = one.counts is not None and one.channel.highpass_hz > 0.0
    (shift,), left = one.left([ones], one.values - e)
    yield one.law("offset", float(shift), left)
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
            what, change = "gain and offset", f"{change}, {size_text('offset', factors[1], one.unit)}"
        numbers = {"gain": gain - 1.0} if "gain" in what else {}
        yield one.law(what, gain - 1.0, left, len(columns), change, unit="", numbers=numbers)
    if one.counts is not None:
        (level,), left = one.left([ones])
        yield _level_law(one, float(level), left)


def _level_law(one: Shown, level: float, left: np.ndarray) -> Law:
    """Nothing but a level."""
    e, volts = one.foretold, one.channel.bias_v + one.channel.sensitivity_v * level
    if one.channel.highpass_hz > 0.0:
        return one.law("open, short or stuck", 0.0, left, 1, "nothing")
    if abs(volts) < 1e-3 * np.ptp(one.channel.range_v):
        return one.law("open or short", 0.0, left, 1, DEFECTS["short"].words)
    if one.at_begin(level):
        return one.law("stuck", level, left)
    middle = (np.mean(one.channel.range_v) - one.channel.bias_v) / one.channel.sensitivity_v
    beyond = bool(((e - middle) / (level - middle) > 1.0).all())
    return one.law("open or saturation" if beyond else "open", volts, left, 1, size_text("open", volts))


def _of_time(one: Shown) -> Iterator[Law]:
    """What is added as a function of time: a drift, a hum."""
    if not one.even:
        return
    t, d = one.times_s - one.times_s[0], one.values - one.foretold
    ones, length_s = one.level, float(one.times_s[-1] - one.times_s[0])
    held = 2.0 * math.pi * one.channel.highpass_hz if one.counts is not None else 0.0
    (rate, _), left = one.left([(1.0 - ones) / held if held else t, ones], d)
    yield one.law("drift", float(rate), left, 2)

    def levelling(log_s: float) -> tuple[np.ndarray, np.ndarray]:
        return one.left([-np.exp(-t / math.exp(log_s)), ones], d)

    ends = math.log(0.01 * length_s), math.log(3.0 * length_s)
    log_s = least_at(lambda log_s: rms_of(levelling(log_s)[1]), *ends)
    (far, _), left = levelling(log_s)
    change = f"{far:+.4g} {one.unit} in {math.exp(log_s):.3g} s"
    yield one.law("drift", float(far), left, 3, change, unit=one.unit)
    if not one.uniform:
        return
    period_s = length_s / (len(t) - 1)
    size = np.abs(spectrum((d - d.mean()) * np.hanning(len(d)), 4 * len(d)))
    hz = np.arange(len(size)) / (4 * len(d) * period_s)
    within = (hz * length_s > _PERIODS) & (hz < min(_HIGHEST_HZ, 0.45 / period_s))
    if not within.any():
        return

    def columns(f: float, third: bool = False) -> list[np.ndarray]:
        turns = [2.0 * math.pi * f * t * k for k in ((1.0, 3.0) if third else (1.0,))]
        return [ones, *(wave(turn) for turn in turns for wave in (np.cos, np.sin))]

    peak, span = float(hz[within][size[within].argmax()]), 1.0 / length_s
    # What is as loud there by itself is not hum, unless that leaves noise.
    own, rest = one.left(columns(peak), one.foretold)
    alone = rms_of(rest) < _LOUD * float(one.foretold.std() / one.floor.min())
    for third in (False, True):
        f = least_at(
            lambda f, third=third: float(np.sum(one.left(columns(f, third), d)[1] ** 2)), peak - span, peak + span
        )
        factors, left = one.left(columns(f, third), d)
        amplitude = math.hypot(factors[1], factors[2])
        if alone and math.hypot(*own[1:]) > _OWN * amplitude and not is_noise(left):
            continue
        change = f"{f:.5g} Hz, {amplitude:.4g} {one.unit}" + (" with its third" if third else "")
        yield one.law("hum", amplitude, left, 6 if third else 4, change)


def _of_others(one: Shown) -> Iterator[Law]:
    """What comes over from another channel."""
    d, ones = one.values - one.foretold, one.level
    found, count = list[Law](), 4 if one.counts is None else 2
    for other, shown in one.beside().items():
        (part, _), left = one.left([one.coupled(*shown), ones], d)
        through = abs(part * one.channel.sensitivity_v / other.sensitivity_v)
        change = f"{part:.4g} {one.unit} for a {other.unit} of {other.name}"
        if one.counts is not None and through > 1.0:
            continue  # none is louder there than at home
        if one.counts is not None and through > 0.0:
            change = f"{20.0 * math.log10(through):.3g} dB of {other.name}"
        found.append(one.law("crosstalk", float(part), left, count, change, unit=""))
    if found:
        # Channels that show the same, as two sides of a ring, are one source.
        best = min(found, key=lambda law: one.cost(law.left, count))
        least = one.cost(best.left, count) + DECIDES
        alike = [law.change for law in found if one.cost(law.left, count) < least and law is not best]
        yield replace(best, change=" or ".join([best.change, *alike]))


def _bent(one: Shown) -> Iterator[Law]:
    """A curve, or an end, of what it can show."""
    e, reach, log = one.foretold, float(np.abs(one.foretold).max()), one.counts is None
    if reach == 0.0:
        return
    starts = [[reach * part] for part in (0.1, 0.3, 0.6, 1.0, 2.0, 5.0, 15.0)]
    # Of a log, nobody knows about what level.
    for about in (0.0, float(e.mean())) if log else (0.0,):
        (end,), left = one.fitted(lambda p, at=about: at + p[0] * np.tanh((e - at) / p[0]), starts, [reach])
        plain = min(excess(one.left(line)[1]) for line in ([e], [e - about + one.level])) if log else math.inf
        if abs(end) > _NOTHING * reach and excess(left) < _CLEARLY * plain:
            yield one.law("nonlinear", abs(float(end)), left)
    low, high = float(one.values.min()), float(one.values.max())
    for _ in range(8):  # the ends of what it shows, less what noise adds to them
        over, under = e > high, e < low
        high = float(one.values[over].mean()) if over.any() else high
        low = float(one.values[under].mean()) if under.any() else low
    # Of a log, knocks behind a slow filter look as if they were cut off.
    cut = (e > high).any() or (e < low).any()
    if one.counts is not None and cut and max(abs(low), abs(high)) > _NOTHING * reach:
        left = (one.values - np.clip(e, low, high)) / one.floor
        change = f"from {low:.4g} to {high:.4g} {one.unit}"
        yield one.law("saturation", max(abs(low), abs(high)), left, 2, change, unit=one.unit)


def _at_random(one: Shown) -> Iterator[Law]:
    """What no sample tells of the next: spikes, a loose contact, jitter, noise."""
    e, d = one.foretold, one.values - one.foretold
    off = np.abs(d) > OFF * one.floor
    lengths = [end - begin for begin, end in true_runs(off)]
    if off.any() and off.mean() < _SPARSE and max(lengths) < 3 and is_noise(one.apart[~off]):
        yield _spikes(one, off, one.apart[~off])
        return
    # An AC-coupled one shows nothing of a level but what fades away.
    fades = one.channel.highpass_hz > 0.0
    if one.counts is not None and one.moves and fades:
        near = _FADING * float(np.ptp(e)) + 2.0 * OFF * float(one.floor[0])
        loud = np.abs(e) > 5.0 * near
        gone, sound = (float((np.abs(left) < near)[loud].mean()) if loud.any() else 0.0 for left in (one.values, d))
        if gone + sound > _ALL and min(gone, sound) > _FADING:
            yield one.law("intermittent", gone, one.apart[~off], 2, f"{gone:.2g} of the time nothing")
            return
    if one.counts is not None and off.any() and not off.all() and one.moves:
        level = float(np.median(one.values[off]))
        # Filters go towards it.
        slack = (_FADING if fades else _SLACK) * float(np.ptp(e)) + 2.0 * OFF * one.floor
        there = off & (np.abs(one.values - level) < slack)
        varied = not fades or float(e[there].std()) > 5.0 * float(slack[0])
        if varied and there.sum() > max(FEW, 0.5 * off.sum()):
            if there.mean() > _ALL:  # the rest is on the way
                yield _level_law(one, level, ((one.values - level) / one.floor)[there])
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
    (_,), rest = one.left([np.ones(len(d))], d)
    if one.moves and one.even and (one.counts is not None or _white(rest)):
        late_s, delayed, slope = delayed_by(one)
        timed, floor = one.values - delayed, (1.0 if one.counts is None else 1.5) * one.noise
        rms_s = math.sqrt(float(timed**2 @ slope**2) / float(slope**2 @ slope**2))
        bend = rms_s**2 * one.foretold_at.derivative(2)(one.times_s - late_s) / math.sqrt(2.0)
        width = np.sqrt((rms_s * slope) ** 2 + bend**2 + floor**2)
        z, plain = (timed - bend / math.sqrt(2.0)) / width, float(rest.std()) * one.floor
        # The more likely of the two; each has a number of its own.
        gain = float(np.sum(np.log(plain / width))) + 0.5 * float(rest @ rest / rest.var() - z @ z)
        seen = rms_s * rms_of(slope) > 2.0 * one.noise
        if gain > DECIDES and seen and (one.counts is None or _white(z)):
            change = f"{1e6 * rms_s:.4g} µs about {1e6 * late_s:.4g} µs"
            yield one.law("jitter", rms_s, z / z.std(), 2, change)
            return
    tied = one.moves and abs(float(np.corrcoef(rest, e)[0, 1])) > 0.1
    # Noise is loud all the time: what is off at impacts alone is none.
    loud = 1.48 * float(np.median(np.abs(rest - np.median(rest)))) > _STEADY * float(rest.std())
    if _white(rest) and not tied and loud:
        ratio = float(rest.std())
        if one.counts is None:
            yield one.law("noise", ratio, rest / ratio)
            return
        said = (one.channel.scale * one.counts[:, 0] + one.channel.offset - one.foretold).std() / one.noise
        times = math.hypot(1.0, ratio * float(one.floor[0]) / one.noise)
        if abs(said - 1.0) < abs(said - times) and times > _ANOTHER:
            change = "as loud as told: samples are taken at other times"
            yield one.law("other noise", float(said), rest / ratio, 1, change, unit="")
        else:
            yield one.law("noise", times, rest / ratio)
