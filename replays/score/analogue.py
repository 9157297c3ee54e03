"""The analogue path: the DAQ sampled by itself, so the known signal is fitted to each channel that it recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from replays.score.limits import Limits
from replays.score.scorecard import Scorecard, judge_row
from replays.score.signals import Recorded, Session, rate_of
from replays.score.sine import fit_sine, is_sine, quality
from replays.score.stimulus import Exact, Sampled, Stimulus
from replays.score.waveform import (
    Response,
    Waveform,
    behind_filter,
    fit_waveform,
    response,
    split_noise,
    student,
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
"""The same without the filter."""
_LONGEST = 1 << 14
"""Samples by which a signal is told to be a sine."""

_ODD = "behind a low-pass that is none of Butterworth's"

Formula = Callable[[np.ndarray], np.ndarray]


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
        exact: Whether the known signal is a formula.
    """

    name: str
    channel: Channel
    low: Waveform
    clean: Waveform
    shown: Response | None
    corner_hz: tuple[float, float, float] | None
    odd: bool
    values: np.ndarray
    exact: bool


def fit_channels(
    recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], session: Session, formulas: Mapping[str, Formula],
    remarks: list[str],
) -> list[Fitted]:  # fmt: skip
    """Fit all signals that are connected; those that the known signal does not explain are left out."""
    found = []
    for name, wire in wires.items():
        if not wire.channel:
            continue
        signal, channel = recorded[name], session.channels[wire.channel]
        sent, first_s, sent_hz = session.whole(wire.channel)
        rate = rate_of(signal) or sent_hz
        if rate_of(signal) is None:
            remarks.append(f"{name}: the file tells no rate; taken for the session's, {sent_hz:g} Hz")
        values, unit_known = in_unit(signal, channel)
        if not unit_known:
            remarks.append(f"{name}: the unit {signal.unit or 'is not told'}; taken for {channel.unit}")
        formula = formulas.get(wire.channel)
        span = (first_s, first_s + len(sent) / sent_hz)
        stimulus: Stimulus = Sampled(sent, first_s, sent_hz) if formula is None else Exact(formula, span, rate)
        times_s = np.arange(len(values)) / rate
        one = _fit(name, channel, values, times_s, stimulus, first_s, wire, exact=formula is not None)
        if one is not None:
            found.append(one)
    return found


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
    wire: Wire, *, exact: bool,
) -> Fitted | None:  # fmt: skip
    whole = fit_waveform(values, times_s, stimulus, wire.late_s + first_s, within_s=wire.within_s)
    if whole is None or whole.likeness < _SOME:
        return None
    shown = response(whole)
    low = clean = whole
    corner_hz, odd = None, False
    if shown is not None and shown.corner_hz is not None:
        corner_hz, odd, clean = shown.corner_hz, True, through(whole)
        behind = behind_filter(whole, stimulus, shown)
        if behind is not None and np.var(behind[0].residual) < _AS_WELL * np.var(clean.residual):
            (low, corner_hz), odd = behind, False
            clean = low
    if clean.likeness < _GOOD:
        return None
    return Fitted(name, channel, low, clean, shown, corner_hz, odd, values, exact)


def _about(value: float, spread: float, quantile: float, size: float = 1.0) -> tuple[float, float, float]:
    return size * value, size * (value - quantile * spread), size * (value + quantile * spread)


def score_analogue(
    card: Scorecard, recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], session: Session, limits: Limits,
    formulas: Mapping[str, Formula],
) -> None:  # fmt: skip
    """Put the rows of the analogue path onto a scorecard."""
    found = fit_channels(recorded, wires, session, formulas, card.remarks)
    fitted = {one.name for one in found}
    for name, wire in wires.items():
        if name not in fitted:
            limit = limits.bounds("analogue", "gain")
            note = "nothing that was sent explains it" if wire.channel else "no channel is like it"
            card.rows.append(judge_row("analogue", "gain", name, None, limit=limit, note=note))
    if found:
        _score_time(card, found, wires, limits)
    for one in found:
        _score_fit(card, one, limits)
        _score_sine(card, one, limits)
        card.pictures[f"analogue {one.name}"] = one
    for quantity in ("alias rejection", "trigger row"):
        card.rows.append(judge_row("analogue", quantity, "", None, limit=limits.bounds("analogue", quantity)))


def _score_time(card: Scorecard, found: list[Fitted], wires: Mapping[str, Wire], limits: Limits) -> None:
    """Clock of all channels together, start of the first, and skew of the others against it."""

    def add(quantity: str, channel: str, estimate: Any, of: Channel | None, note: str = "") -> None:
        limit = limits.bounds("analogue", quantity, of)
        card.rows.append(judge_row("analogue", quantity, channel, estimate, limit=limit, note=note))

    spreads = np.array([one.low.spread[3] for one in found])
    drifts = np.array([one.low.drift for one in found])
    weights = np.maximum(spreads, 1e-15) ** -2.0
    drift, spread = float(weights @ drifts / weights.sum()), float(weights.sum() ** -0.5)
    quantile = student(found[0].low.freedom)
    # Its clock runs fast where the session's time goes slowly over its own.
    add("clock", "", _about(-drift / (1.0 + drift), spread, quantile, 1e6), None)
    first = found[0]
    turned = any(wires[one.name].turned for one in found)
    note = "a periodic signal: up to whole periods" if turned else ""
    begin_s = first.low.late_s - first.low.drift * first.low.middle_s
    add("start", first.name, _about(begin_s, first.low.spread[2], quantile), first.channel, note)
    for one in found[1:]:
        apart = one.low.late_s - first.low.late_s
        both = math.hypot(one.low.spread[2], first.low.spread[2])
        odd = _ODD if one.odd or first.odd else ""
        said = "; ".join(each for each in (f"against {first.name}", note, odd) if each)
        add("skew", one.name, None if odd else _about(apart, both, quantile, 1e9), one.channel, said)


def _score_fit(card: Scorecard, one: Fitted, limits: Limits) -> None:
    low, channel = one.low, one.channel
    quantile = student(low.freedom)
    unit = channel.unit

    def add(quantity: str, estimate: tuple[float, float, float] | None, note: str = "") -> None:
        limit = limits.bounds("analogue", quantity, channel)
        card.rows.append(judge_row("analogue", quantity, one.name, estimate, unit=unit, limit=limit, note=note))

    note = _ODD if one.odd else ""
    add("gain", None if one.odd else _about(abs(low.gain) - 1.0, low.spread[0], quantile, 1e6), note)
    add("offset", _about(low.offset, low.spread[1], quantile))
    # Nothing tells whether the rig's own noise, which is in its samples, was in what the DAQ was given.
    brought = 0.0 if one.exact else channel.noise_v / abs(channel.sensitivity_v)
    split = split_noise(one.clean, floor=brought)
    add("noise", split.noise)
    add("jitter", None if split.jitter_s is None else _scaled(split.jitter_s, 1e9))
    full = channel.adc_v / abs(channel.sensitivity_v)
    noises = [max(each, 1e-12 * full) for each in (split.noise[0], split.noise[2], split.noise[1])]
    bits = [math.log2(2.0 * full / (each * math.sqrt(12.0))) for each in noises]
    ranges = [20.0 * math.log10(full / math.sqrt(2.0) / each) for each in noises]
    add("effective bits", (bits[0], bits[1], bits[2]))
    add("dynamic range", (ranges[0], ranges[1], ranges[2]))
    _score_corner(card, one, limits)


def _score_corner(card: Scorecard, one: Fitted, limits: Limits) -> None:
    limit = limits.bounds("analogue", "corner", one.channel)
    estimate, note = None, ""
    if one.corner_hz is not None:
        estimate = one.corner_hz
    elif one.shown is not None:
        highest = float(one.shown.frequency_hz[-1])
        if limit is not None and highest >= limit.low:
            estimate, note = (highest, highest, math.inf), "no fall by 3 dB up to there"
        else:
            note = f"no fall by 3 dB up to {highest:.0f} Hz, beyond which the signal shows nothing"
    card.rows.append(judge_row("analogue", "corner", one.name, estimate, limit=limit, note=note))


def _score_sine(card: Scorecard, one: Fitted, limits: Limits) -> None:
    """The standard's sine fit beside the known signal, where that is a sine."""
    names = ("SINAD", "ENOB", "THD", "SFDR")
    gaps = not np.isfinite(one.values).all()
    if gaps or not is_sine(one.low.known[:_LONGEST]):
        for quantity in names:
            limit = limits.bounds("analogue", quantity, one.channel)
            note = "values are missing" if gaps else "the signal is no sine"
            card.rows.append(judge_row("analogue", quantity, one.name, None, limit=limit, note=note))
        return
    fit = fit_sine(one.values)
    told = quality(fit)
    noises = 1 if one.exact else 2
    for quantity, estimate in zip(names, (told.sinad_db, told.enob, told.thd_db, told.sfdr_db), strict=True):
        limit = limits.bounds("analogue", quantity, one.channel, amplitude=fit.amplitude[0], noises=noises)
        note = "" if one.exact else "of the record as it is: the rig's own noise is in it"
        card.rows.append(judge_row("analogue", quantity, one.name, estimate, limit=limit, note=note))


def _scaled(estimate: tuple[float, float, float], size: float) -> tuple[float, float, float]:
    return estimate[0] * size, estimate[1] * size, estimate[2] * size
