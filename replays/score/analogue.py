"""The analogue path: the DAQ sampled by itself, so the known signal is fitted to each channel that it recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from replays.score.intervals import student
from replays.score.recorded import Recorded
from replays.score.scorecard import Interval, Scorecard
from replays.score.sent import Formula, Session
from replays.score.sine import fit_sine, is_sine, quality
from replays.score.stimulus import Exact, Sampled, Stimulus, parted
from replays.score.waveform import (
    Response,
    Waveform,
    beginnings,
    behind_filter,
    fit_waveform,
    folded,
    response,
    split_noise,
    through,
)
from replays.score.wiring import Wire
from rig import units
from rig.channels import Channel

_AS_WELL = 1.1
"""A low-pass of Butterworth's is taken where it leaves at most this much of what any linear response leaves."""
_GOOD = 0.9
"""Part of the power that the known signal, behind the channel's filter, must explain for a fit to be one of it."""
_SOME = 0.05
"""The same without the filter, for one to be looked for."""
_OWN_CLOCK = 3.0, 1e-6
"""A clock is a channel's own where it is off the others' by more than so many half intervals, and by so much."""
_PURER = 1.5
"""Noises of a channel that what is not the sine in a sine may come to."""
_BETTER = 0.8
"""A fit of less than this part of what another leaves is the better one."""
_SINE = ("SINAD", "ENOB", "THD", "SFDR")
_SEEN = 4.0
"""Noises of a channel that what is above half of the rate has to come to."""
_LONGEST = 1 << 14
"""Samples by which a signal is told to be a sine."""

_NOT_SURE = "what was sent nearly repeats, and no beginning leaves noise alone: what is left may be of a wrong one"
_ODD = "behind a low-pass that is none of Butterworth's"


@dataclass(frozen=True)
class Fitted:
    """One channel's fits.

    Attributes:
        name: Of the recorded signal.
        channel: What it is of.
        low: The fit, behind a low-pass where the channel shows one: gain, offset and time at low frequencies.
        clean: The fit of which noise is left: `low`, or behind any linear response if it is `odd`.
        shown: The response; None where the signal does not show it.
        corner_hz: Where it has fallen by 3 dB, with its 95 % interval; None where it does not.
        odd: Whether there is a low-pass that is none of the known ones.
        values: As recorded, in the channel's unit.
        exact: Whether the known signal has no noise of its own.
        folds: What is left of the signal above half of the rate, over its part below [1]; None where it has nothing.
        alias: The same as recorded [unit], shape (n,).
    """

    name: str
    channel: Channel
    low: Waveform
    clean: Waveform
    shown: Response | None
    corner_hz: Interval | None
    odd: bool
    values: np.ndarray
    exact: bool
    folds: Interval | None
    alias: np.ndarray | float

    @property
    def good(self) -> bool:
        """Whether the known signal explains enough of the record."""
        return self.clean.likeness >= _GOOD


def fit_channels(
    recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], session: Session, formulas: Mapping[str, Formula],
    remarks: list[str],
) -> list[Fitted]:  # fmt: skip
    """Fit all signals that are connected; those of which it is not sure to what, only where that explains them."""
    zero_s = min((signal.first_s for signal in recorded.values() if signal.first_s is not None), default=0.0)

    def known(name: str, wire: Wire) -> Stimulus:
        sent, first_s, sent_hz = session.whole(wire.channel)
        formula = formulas.get(wire.channel)
        if formula is None:
            return Sampled(sent, first_s, sent_hz)
        return Exact(formula, (first_s, first_s + len(sent) / sent_hz), recorded[name].rate_hz or sent_hz)

    def fit(name: str, wire: Wire) -> Fitted | None:
        signal, channel = recorded[name], session.channels[wire.channel]
        _, first_s, sent_hz = session.whole(wire.channel)
        rate = signal.rate_hz or sent_hz
        begin_s = 0.0 if signal.first_s is None else signal.first_s - zero_s
        times_s = begin_s + np.arange(signal.rows) / rate
        within_s = wire.within_s[0] + begin_s, wire.within_s[1] + begin_s
        wire = replace(wire, own_s=wire.own_s - begin_s, within_s=within_s)
        exact = wire.channel in formulas or not session.noisy
        values = in_unit(signal, channel)[0]
        return _fit(name, channel, values, times_s, known(name, wire), first_s, wire, sent_hz, exact=exact)

    wires = {name: wire for name, wire in wires.items() if wire.channel}
    wires |= _begun(fit, known, wires, remarks)
    found = []
    for name, wire in wires.items():
        signal, channel = recorded[name], session.channels[wire.channel]
        if signal.rate_hz is None:
            remarks.append(f"{name}: the file tells no rate; taken for the session's, {channel.rate_hz:g} Hz")
        if not in_unit(signal, channel)[1]:
            remarks.append(f"{name}: the unit {signal.unit or 'is not told'}; taken for {channel.unit}")
        one = fit(name, wire)
        if one is not None and (one.good or name == wire.channel or not wire.rivals):
            found.append(one)
    return found


def _begun(
    fit: Callable[[str, Wire], Fitted | None], known: Callable[[str, Wire], Stimulus], wires: Mapping[str, Wire],
    remarks: list[str],
) -> dict[str, Wire]:  # fmt: skip
    """Wires with another beginning, where what is nearly periodic fits better from there."""
    if not wires:
        return {}
    name = max(wires, key=lambda each: (len(wires[each].others_s) > 0, wires[each].likeness))
    wire, best = wires[name], (math.inf, 0.0)
    shifts = [0.0, *(other_s - wire.late_s for other_s in wire.others_s)]
    for n, shift in enumerate(shifts):
        one = fit(name, replace(wire, own_s=wire.own_s + shift))
        if one is not None:
            if not n and wire.others_s:
                shifts[1:1] = beginnings(one.clean, known(name, wire))
            left = float(np.std(one.clean.residual))
            best = (left, shift) if left < _BETTER * best[0] else best
            if left < _PURER * one.channel.noise_v / abs(one.channel.sensitivity_v):
                break
    else:
        if len(set(wire.others_s) - {wire.late_s}) > 1:
            remarks.append(_NOT_SURE)
    return {each: replace(wire, own_s=wire.own_s + best[1]) for each, wire in wires.items() if wire.others_s}


def in_unit(signal: Recorded, channel: Channel) -> tuple[np.ndarray, bool]:
    """Values in the channel's unit, and whether the file tells how; volts go through the channel's sensitivity."""
    if signal.unit == channel.unit:
        return signal.values, True
    if units.kind(signal.unit) == "voltage":
        return (signal.values * units.size_si(signal.unit) - channel.bias_v) / channel.sensitivity_v, True
    if units.kind(signal.unit) and units.kind(signal.unit) == units.kind(channel.unit):
        return signal.values * units.factor(signal.unit, channel.unit, field=signal.name), True
    return signal.values, False


def _fit(
    name: str, channel: Channel, values: np.ndarray, times_s: np.ndarray, stimulus: Stimulus, first_s: float,
    wire: Wire, sent_hz: float, *, exact: bool,
) -> Fitted | None:  # fmt: skip
    rate = (len(times_s) - 1) / (times_s[-1] - times_s[0])
    parts = parted(
        stimulus, rate, sent_hz, _SEEN * math.hypot(channel.noise_v, channel.lsb_v) / abs(channel.sensitivity_v)
    )
    stimulus = stimulus if parts is None else parts[0]
    whole = fit_waveform(values, times_s, stimulus, wire.own_s + first_s, within_s=wire.within_s)
    if whole is None:
        return None
    shown = response(whole) if whole.likeness >= _SOME else None
    low = clean = whole
    corner_hz, odd = None, False
    if shown is not None and shown.corner_hz is not None:
        corner_hz, odd, clean = shown.corner_hz, True, through(whole)
        behind = behind_filter(whole, stimulus, shown)
        if behind is not None and np.var(behind[0].residual) < _AS_WELL * np.var(clean.residual):
            (low, corner_hz), odd = behind, False
            clean = low
    folds, alias = None, 0.0
    if parts is not None:
        at_s = clean.times_s + low.late_s + low.drift * (clean.times_s - low.middle_s)
        alias, amounts = folded(clean, [each(at_s)[0] for each in parts[1:]])
        folds = _scaled(amounts, 1.0 / abs(low.gain))
        clean = replace(clean, residual=clean.residual - alias)
    return Fitted(name, channel, low, clean, shown, corner_hz, odd, values, exact, folds, alias)


def _about(value: float, half: float, size: float = 1.0) -> Interval:
    return size * value, size * (value - half), size * (value + half)


def score_analogue(
    card: Scorecard, recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], session: Session,
    formulas: Mapping[str, Formula],
) -> None:  # fmt: skip
    """Put the rows of the analogue path onto a scorecard."""
    found = fit_channels(recorded, wires, session, formulas, card.remarks)
    fitted = {one.name for one in found}
    for name, wire in wires.items():
        if name not in fitted:
            note = "nothing that was sent explains it" if wire.channel else "no channel is like it"
            card.add("gain", name, None, note=note)
    _score_time(card, [one for one in found if one.good], wires)
    sines = []
    for one in found:
        _score_fit(card, one)
        sines.append(_score_sine(card, one))
        card.pictures[f"analogue {one.name}"] = one
    for quantity in (
        *(() if any(sines) else _SINE), *(() if any(one.folds for one in found) else ("alias rejection",)),
        "trigger row",
    ):  # fmt: skip
        card.add(quantity, "", None)


def _score_time(card: Scorecard, found: list[Fitted], wires: Mapping[str, Wire]) -> None:
    """Clock of all channels together, start of one in the middle of them, and skew of the others against it."""
    # One channel that is off has no say in what the others are: the reference is in the middle of them.
    inner = sorted((one for one in found if not one.odd), key=lambda one: one.low.late_s) or found
    if not inner:
        return
    reference = inner[(len(inner) - 1) // 2] if len(inner) > 2 else found[0]
    halves = np.maximum([one.low.half[3] for one in found], 1e-15)
    drifts = np.array([one.low.drift for one in found])
    middle = np.sort(drifts)[(len(found) - 1) // 2] if len(found) > 2 else reference.low.drift
    own = np.abs(drifts - middle) > np.maximum(_OWN_CLOCK[0] * halves, _OWN_CLOCK[1])
    weights = np.where(own, 0.0, halves**-2.0)
    told = [("", float(weights @ drifts / weights.sum()), float(weights.sum() ** -0.5))]
    told += [(found[n].name, drifts[n], halves[n]) for n in np.flatnonzero(own)]
    for name, drift, half in told:
        # Its clock runs fast where the session's time goes slowly over its own.
        note = "off the clock of the others" if name else ""
        card.add("clock", name, _about(-drift / (1.0 + drift), half, 1e6), note=note)
    turned = any(wires[one.name].turned for one in found)
    note = "a periodic signal: up to whole periods" if turned else ""
    back = np.array([0.0, 0.0, 1.0, -reference.low.middle_s])  # to time zero of the file, at its own clock
    spread = math.sqrt(back @ reference.low.covariance @ back)
    begin_s = reference.low.late_s - reference.low.drift * reference.low.middle_s
    start = _about(begin_s, float(student(reference.low.freedom[2:].min())) * spread)
    card.add("start", reference.name, start, of=reference.channel, note=note)
    for one in found:
        if one is not reference:
            apart = one.low.late_s - reference.low.late_s
            both = math.hypot(one.low.half[2], reference.low.half[2])
            odd = _ODD if one.odd or reference.odd else ""
            said = "; ".join(each for each in (f"against {reference.name}", note, odd) if each)
            skew = None if odd else _about(apart, both, 1e9)
            card.add("skew", one.name, skew, of=one.channel, note=said)


def _score_fit(card: Scorecard, one: Fitted) -> None:
    low, channel = one.low, one.channel

    def add(quantity: str, estimate: Interval | None, note: str = "") -> None:
        card.add(quantity, one.name, estimate, of=channel, unit=channel.unit, note=note)

    note = _ODD if one.odd else "" if one.good else f"what was sent explains {max(0.0, one.clean.likeness):.1%} of it"
    add("gain", None if note else _about(abs(low.gain) - 1.0, low.half[0], 1e6), note)
    add("offset", _about(low.offset, low.half[1]) if one.good else None)
    # Nothing tells whether the rig's own noise, which is in its samples, was in what the DAQ was given.
    brought = 0.0 if one.exact else channel.noise_v / abs(channel.sensitivity_v)
    split = split_noise(one.clean, floor=brought)
    noise = split.noise if one.good else split.left
    add("noise", noise)
    add("jitter", _scaled(split.jitter_s, 1e9) if one.good and split.jitter_s is not None else None)
    full = channel.adc_v / abs(channel.sensitivity_v)
    left = split_noise(replace(one.clean, residual=one.clean.residual + one.alias), floor=brought).left
    bits = [math.log2(full / max(left[n], 1e-12 * full) / math.sqrt(3.0)) for n in (0, 2, 1)]
    ranges = [20.0 * math.log10(full / max(noise[n], 1e-12 * full) / math.sqrt(2.0)) for n in (0, 2, 1)]
    add("effective bits", (bits[0], bits[1], bits[2]))
    add("dynamic range", (ranges[0], ranges[1], ranges[2]))
    limit = card.asked(card.path, "corner", channel)
    estimate, note = one.corner_hz, ""
    if estimate is None and one.shown is not None:
        highest = float(one.shown.frequency_hz[-1])
        if limit is not None and highest >= limit.low:
            estimate, note = (highest, highest, math.inf), "no fall by 3 dB up to there"
        else:
            note = f"no fall by 3 dB up to {highest:.0f} Hz, beyond which the signal shows nothing"
    add("corner", estimate, note)
    if one.folds is not None:
        value, low_db, high_db = (-20.0 * math.log10(each) if each else math.inf for each in one.folds)
        add("alias rejection", (value, high_db, low_db))


def _score_sine(card: Scorecard, one: Fitted) -> bool:
    """The standard's sine fit beside the known signal; whether that is a sine, and no value is missing."""
    gaps = not np.isfinite(one.values).all()
    noises = 1 if one.exact else 2
    quiet = _PURER * math.hypot(one.channel.noise_v, one.channel.lsb_v) / abs(one.channel.sensitivity_v)
    if gaps or not is_sine(one.low.known[:_LONGEST], quiet):
        return False
    fit = fit_sine(one.values)
    told = quality(fit)
    for quantity, estimate in zip(_SINE, (told.sinad_db, told.enob, told.thd_db, told.sfdr_db), strict=True):
        note = "" if noises == 1 else "of the record as it is: the rig's own noise is in it"
        card.add(quantity, one.name, estimate, of=one.channel, note=note, amplitude=fit.amplitude[0], noises=noises)
    return True


def _scaled(estimate: Interval, size: float) -> Interval:
    return estimate[0] * size, estimate[1] * size, estimate[2] * size
