"""Analogue path: the DAQ sampled with its own converter, so the known signal is fitted to each recorded channel."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from replays.estimate.intervals import make_interval, pool_estimates, sandwich, scale_interval, student
from replays.estimate.least_squares import solve
from replays.estimate.sine import fit_sine, is_sine, quality
from replays.score.alignment.alignment import align
from replays.score.alignment.single_start import Alignment, RowSource
from replays.score.alignment.stamps import Stamps
from replays.score.card.scorecard import (
    ANALOGUE,
    FAIL,
    INCONCLUSIVE,
    NO_LIMIT,
    PASS,
    Interval,
    Scorecard,
    Verdict,
    text_row,
)
from replays.score.quantities.noise import split_noise
from replays.score.quantities.rounding import Converter, find_step, find_undithered, widen_intervals
from replays.score.records.recorded import Recorded
from replays.score.records.sent import MIN_SIGNAL_NOISES, Formula, Session
from replays.score.records.stimulus import Exact, Sampled, Stimulus, remove_noise, split_at_rate
from replays.score.records.wiring import Wire
from replays.score.waveform import Response, Waveform, fit_linear_response, fit_waveform, fit_with_filter, response
from rig.base import units
from rig.channels.table import Channel

_MAX_RESIDUAL_RATIO = 1.1
"""Largest residual with a Butterworth low-pass, over that with any linear response, for which the former is used."""
_MIN_LIKENESS = 0.9
"""Part of the power that the known signal, with the channel's filter, must explain for a fit to be valid."""
_MIN_UNFILTERED_LIKENESS = 0.05
"""Part of the power that it must explain without the filter, for a filter to be searched."""
_OWN_CLOCK = 3.0, 1e-6
"""Deviation from which a channel has its own clock: in half intervals of the other clocks, and absolute."""
_SINE = ("SINAD", "ENOB", "THD", "SFDR")
_MIN_ALIAS_NOISES = 4.0
"""Smallest component above half of the rate that is fitted, in noises of the channel."""
_MAX_SINE_SAMPLES = 1 << 14
"""Samples by which a signal is classified as a sine."""
_MIN_ROWS = 1000
"""Rows from which a sent signal must be found."""
_STEPS = 5
"""Steps that are named in a note; the JSON has all."""
_EDGE_ROWS = 100
"""Rows outside the session above which a remark is added: its ends are not interpolated."""

_AMBIGUOUS = "the sent signal repeats, and other begins explain the record equally well"
_FILTER = "with a low-pass that is not a Butterworth one"
_OTHER_CORNER = "with another low-pass, whose delay is known only from its order and corner"
_CORNER_TOLERANCE = 0.1
"""Relative difference of corners with the same nominal value: capacitors of 5 % in a filter of second order."""


@dataclass(frozen=True)
class Fitted:
    """Fits of one channel.

    Attributes:
        name: Name of the recorded signal.
        channel: Its channel.
        low: Fit with a low-pass if the channel has one: gain, offset and time at low frequencies.
        clean: Fit whose residual is noise: `low`, or with any linear response if it is `odd`.
        shown: Frequency response; None if the signal does not determine it.
        corner_hz: Frequency of -3 dB, with its 95 % interval [Hz]; None if the gain does not fall that far.
        odd: Whether there is a low-pass that is not a Butterworth one.
        values: Recorded values, in the channel's unit.
        known_noise: Noise of the known signal, by the session's noise and converter [unit rms]; 0 for a formula.
        folds: Aliased part of the signal above half of the rate, over the sent part [1], or None.
        alias: Aliased signal as recorded [unit], shape (n,).
        rounding: Converters whose steps are not dithered by the noise.
    """

    name: str
    channel: Channel
    low: Waveform
    clean: Waveform
    shown: Response | None
    corner_hz: Interval | None
    odd: bool
    values: np.ndarray
    known_noise: float
    folds: Interval | None
    alias: np.ndarray | float
    rounding: tuple[Converter, ...]

    @property
    def good(self) -> bool:
        """True if the known signal explains enough of the record."""
        return self.clean.likeness >= _MIN_LIKENESS

    @property
    def rounding_note(self) -> str:
        """Note on rounding that does not average out, or empty."""
        return "steps of a converter are larger than its noise" if self.rounding else ""


def fit_channels(
    recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], session: Session, formulas: Mapping[str, Formula],
    remarks: list[str], step: Callable[[str], None] = lambda _text: None,
) -> tuple[list[Fitted], list[Alignment]]:  # fmt: skip
    """Fit all connected signals, and align their tables with the session.

    A signal with several possible channels is fitted only if its channel explains it.
    """
    step("aligning the rows with the session")
    zero_s = min((signal.first_s for signal in recorded.values() if signal.first_s is not None), default=0.0)
    tables: dict[int, list[RowSource]] = {}
    parts_of: dict[str, tuple[Sampled, Sampled, Sampled] | None] = {}
    for name, wire in wires.items():
        signal = recorded[name]
        if not wire.channel or signal.rows < 2:
            continue
        channel = session.channels[wire.channel]
        if signal.rate_hz is None:
            remarks.append(f"{name}: the file gives no sample rate; the session's, {channel.rate_hz:g} Hz, is assumed")
        values, has_unit = in_unit(signal, channel)
        if not has_unit:
            unit_text = "no unit" if signal.unit in ("", "1") else f"the unit {signal.unit}"
            remarks.append(f"{name}: the file gives {unit_text}; {channel.unit} is assumed")
        sent, first_s, sent_hz = session.whole(wire.channel)
        formula, rate_hz = formulas.get(wire.channel), signal.rate_hz or sent_hz
        if formula is None:
            cleaned = remove_noise(sent, _converter(session, channel).error)
            stimulus: Stimulus = Sampled(cleaned, first_s, sent_hz)
        else:
            stimulus = Exact(formula, (first_s, first_s + len(sent) / sent_hz), rate_hz)
        least = _MIN_ALIAS_NOISES * math.hypot(channel.noise_v, channel.lsb_v) / abs(channel.sensitivity_v)
        parts = parts_of[name] = split_at_rate(stimulus, rate_hz, sent_hz, least)
        begin_s = 0.0 if signal.first_s is None else signal.first_s - zero_s
        within_s = wire.within_s[0] + begin_s, wire.within_s[1] + begin_s
        wire = replace(wire, own_s=wire.own_s - begin_s, within_s=within_s)
        source = RowSource(
            name, channel, wire, values, begin_s, rate_hz, stimulus if parts is None else parts[0], first_s
        )
        tables.setdefault(id(signal.table), []).append(source)
    fits, alignments = [], []
    number, total = 0, sum(map(len, tables.values()))
    for sources in tables.values():
        if (alignment := align(sources)) is None:
            continue
        alignments.append(alignment)
        for source in sources:
            number += 1
            step(f"fitting {source.name}, {number} of {total}")
            converter = None if source.wire.channel in formulas else _converter(session, source.channel)
            one = _fit(source, alignment, parts_of[source.name], converter)
            if one is not None and (one.good or source.name == source.wire.channel or not source.wire.rivals):
                fits.append(one)
    return fits, alignments


def _converter(session: Session, channel: Channel) -> Converter:
    """Return the converter of a channel's samples in the session."""
    return Converter(abs(channel.scale), channel.noise_v * session.noisy / abs(channel.sensitivity_v))


def in_unit(signal: Recorded, channel: Channel) -> tuple[np.ndarray, bool]:
    """Return values in the channel's unit, and whether the file has a unit; volts are divided by the sensitivity."""
    if signal.unit == channel.unit:
        return signal.values, True
    if units.get_quantity(signal.unit) == "voltage":
        return (signal.values * units.size_si(signal.unit) - channel.bias_v) / channel.sensitivity_v, True
    if units.get_quantity(signal.unit) and units.get_quantity(signal.unit) == units.get_quantity(channel.unit):
        return signal.values * units.factor(signal.unit, channel.unit, field=signal.name), True
    return signal.values, False


def _fit(
    source: RowSource, alignment: Alignment, parts: tuple[Sampled, Sampled, Sampled] | None, converter: Converter | None
) -> Fitted | None:
    name, channel, stimulus = source.name, source.channel, source.stimulus
    values, times_s, curve = alignment.even(source)
    whole = fit_waveform(values, times_s, stimulus, curve)
    if whole is None:
        return None
    shown = response(whole) if whole.likeness >= _MIN_UNFILTERED_LIKENESS else None
    low = clean = whole
    corner_hz, odd = None, False
    if shown is not None and shown.corner_hz is not None:
        corner_hz, odd, clean = shown.corner_hz, True, fit_linear_response(whole)
        behind = fit_with_filter(whole, stimulus, shown)
        if behind is not None and np.var(behind[0].residual) < _MAX_RESIDUAL_RATIO * np.var(clean.residual):
            (low, corner_hz), odd = behind, False
            clean = low
    folds, alias = None, 0.0
    if parts is not None:
        at_s = clean.times_s + low.late_at(clean.times_s)
        alias, amounts = _fit_alias(clean, [each(at_s)[0] for each in parts[1:]])
        folds = scale_interval(amounts, 1.0 / abs(low.gain))
        clean = replace(clean, residual=clean.residual - alias)
    if converter and isinstance(stimulus, Sampled):
        converter = replace(converter, values=stimulus.find_nearest(clean.times_s + low.late_at(clean.times_s)))
    rounding = find_undithered(clean, find_step(source.values), converter)
    low = widen_intervals(low, rounding)
    return Fitted(
        name,
        channel,
        low,
        clean,
        shown,
        corner_hz,
        odd,
        values,
        converter.error if converter else 0.0,
        folds,
        alias,
        rounding,
    )


def _fit_alias(fit: Waveform, above: Sequence[np.ndarray]) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Return the aliased part of a residual, and its gain relative to the sent part with its 95 % interval.

    Args:
        fit: A fit of the part below half of the rate.
        above: The part above at the fitted instants, and a quarter of a period later, each shape (n,).
    """
    matrix = np.column_stack([*above, fit.sent, fit.slope, np.ones(len(fit.sent))])
    parts = solve(matrix, fit.residual)
    covariance, dof = sandwich(matrix, fit.residual - matrix @ parts)
    amount = max(float(np.linalg.norm(parts[:2])), 1e-300)
    way = parts[:2] / amount
    half = float(student(dof[:2].min())) * math.sqrt(way @ covariance[:2, :2] @ way)
    return matrix @ parts, (amount, max(0.0, amount - half), amount + half)


def score_analogue(
    card: Scorecard, recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], session: Session,
    formulas: Mapping[str, Formula], as_mapped: Collection[str] = (), step: Callable[[str], None] = lambda _text: None,
) -> list[Fitted]:  # fmt: skip
    """Add the rows of the analogue path to a scorecard, and return the fits of its channels.

    Args:
        card: The scorecard.
        recorded: Signals of the file.
        wires: Their channels.
        session: The session.
        formulas: Exact signals by channel.
        as_mapped: Signals whose channel the user's mapping gives.
        step: Function that is called with the current step.
    """
    fits, alignments = fit_channels(recorded, wires, session, formulas, card.remarks, step)
    fitted = {one.name for one in fits}
    _score_rows(card, alignments, recorded)
    for name, wire in wires.items():
        if name not in fitted:
            note = "no sent signal explains it" if wire.channel else "no channel is similar"
            card.add("gain", name, None, note=note)
    ambiguous = {name for each in alignments if each.ambiguous for name in each.names}
    _score_time(card, [one for one in fits if one.good], ambiguous)
    _score_wires(card, recorded, wires, fits, ambiguous, session, alignments, as_mapped)
    sines = []
    for one in fits:
        _score_fit(card, one)
        sines.append(_score_sine(card, one))
        card.pictures[f"analogue {one.name}"] = one
    for quantity in (
        *(() if any(sines) else _SINE), *(() if any(one.folds for one in fits) else ("alias rejection",)),
        "trigger row",
    ):  # fmt: skip
        card.add(quantity, "", None)
    return fits


def _score_rows(card: Scorecard, alignments: list[Alignment], recorded: Mapping[str, Recorded]) -> None:
    """Add lost and doubled samples, and the judged part of each table."""
    if not alignments:
        card.evidence_gaps.append("no channel is found in the session")
        for quantity in ("lost samples", "doubled samples", "judged part"):
            card.add(quantity, "", None)
    for alignment in alignments:
        name = alignment.names[0] if len(alignments) > 1 else ""
        steps = alignment.track.steps() if len(alignment.track.blocks) else None
        note = "up to whole periods" if alignment.ambiguous else ""
        for quantity, sign in (("lost samples", 1), ("doubled samples", -1)):
            if steps is None:
                card.add(quantity, name, None, note="the signal is too slow to show a step by one sample")
                continue
            here = [(first, last, sign * size) for first, last, size in steps if sign * size > 0]
            rows = ", ".join(
                f"{size} at row {last}" if first == last else f"{size} in rows {first} to {last}"
                for first, last, size in here[:_STEPS]
            )
            text = "; ".join(each for each in (rows, f"and {len(here) - _STEPS} more" * (len(here) > _STEPS)) if each)
            count = float(sum(size for _, _, size in here))
            full_note = "; ".join(each for each in (text, note) if each)
            card.add(quantity, name, (count, count, count), note=full_note)
            if alignment.steps_doubted and not count:
                about, why = ANALOGUE[quantity], "there are some from another begin, which explains more rows"
                card.rows[-1] = replace(card.rows[-1], verdict=INCONCLUSIVE, run=about.run, note=why)
            card.runs[f"{quantity} {name}".strip()] = [(first, last) for first, last, _ in here]
        for channel, lost in _count_missing_values(alignment, recorded).items():
            card.add("lost samples", channel, (lost, lost, lost), note="rows without a value")
        # At an end of the record such rows affect the judged part only: a DAQ may start before its input is connected.
        foreign = alignment.track.unexplained
        count, rows = float(sum(b - a + 1 for a, b in foreign)), ", ".join(f"{a} to {b}" for a, b in foreign[:_STEPS])
        card.add("foreign rows", name, (count, count, count), note=f"rows {rows}" if foreign else "")
        card.runs[f"foreign rows {name}".strip()] = foreign
        card.add("judged part", name, (judged := alignment.explained_part(), judged, judged))
        one = recorded[alignment.names[0]]
        stamps, (explained, at) = Stamps(one.table), alignment.track.places(alignment.rows)
        stamps.times_s = np.concatenate([part[:, 0] for part in one.table.parts([one.column])])
        stamps.add_rows(0.0, at / alignment.rate_hz, np.flatnonzero(explained), alignment.rows)
        estimates = stamps.estimate_all(None)
        for quantity in ("stamp rate", "stamp jitter", "stamps that go back"):
            card.add(quantity, name, estimates[quantity])
        for rows, what in zip(
            (alignment.track.inside[0], alignment.rows - alignment.track.inside[1]),
            ("before the session's begin", "after the session's end"), strict=True,
        ):  # fmt: skip
            if rows > _EDGE_ROWS:
                card.remarks.append(f"{rows / alignment.rate_hz:.6g} s of the record are {what} and are not judged")


def _count_missing_values(alignment: Alignment, recorded: Mapping[str, Recorded]) -> dict[str, float]:
    """Return the number of rows in the session without a value, of the signals that lack some.

    Rows before the first value of all signals, or after the last one, are not lost.
    """
    inside = slice(*alignment.track.inside)
    held = {name: np.isfinite(recorded[name].values[inside]) for name in alignment.names}
    rows = np.flatnonzero(np.any(list(held.values()), axis=0))
    lost = {name: float((~has[rows[0] : rows[-1] + 1]).sum()) for name, has in held.items() if len(rows)}
    return {name: count for name, count in lost.items() if count}


def _score_time(card: Scorecard, fits: list[Fitted], ambiguous: set[str]) -> None:
    """Add the common clock of all channels, the start of the middle one, and the skew of the others against it."""
    # The median channel is the reference, so that a single wrong one does not change the others' results.
    middle_s = float(np.median([one.low.middle_s for one in fits])) if fits else 0.0

    def late_s(one: Fitted) -> float:
        # At the same instant, by the mean time error and the clock: the drift alone is known less well.
        return one.low.late_s + one.low.drift * (middle_s - one.low.middle_s)

    inner = sorted((one for one in fits if not one.odd), key=late_s) or fits
    if not inner:
        return
    reference = inner[(len(inner) - 1) // 2] if len(inner) > 2 else fits[0]
    low = reference.low
    halves = np.maximum([one.low.half_widths[3] for one in fits], 1e-15)
    drifts = np.array([one.low.drift for one in fits])
    middle = np.sort(drifts)[(len(fits) - 1) // 2] if len(fits) > 2 else low.drift
    own = np.abs(drifts - middle) > np.maximum(_OWN_CLOCK[0] * halves, _OWN_CLOCK[1])
    bend_halves = np.maximum([one.low.half_widths[4] for one in fits], 1e-15)
    bends = np.array([one.low.bend for one in fits])
    for quantity, values, half, others in (("clock", drifts, halves, own), ("clock drift", bends, bend_halves, own)):
        weights = np.where(others, 0.0, half**-2.0)
        clocks = [("", *pool_estimates(values, weights, equal_errors=any(one.rounding for one in fits)))]
        clocks += [(fits[n].name, values[n], half[n]) for n in np.flatnonzero(others) if quantity == "clock"]
        for name, value, wide in clocks:
            # Its clock runs fast if the session's time advances slowly relative to it.
            note = "differs from the clock of the others" if name else ""
            slow = value / (1.0 + value) if quantity == "clock" else value
            card.add(quantity, name, make_interval(-slow, wide, 1e6), note=note)
    open_ = reference.name in ambiguous
    note = _AMBIGUOUS if open_ else ""
    # To time zero of the file, by its own clock.
    back = np.array([0.0, 0.0, 1.0, -low.middle_s, 0.5 * low.middle_s**2 - low.half_s**2 / 6.0])
    spread = math.sqrt(back @ low.covariance @ back)
    start = make_interval(float(low.late_at(np.zeros(1))[0]), float(student(low.dof[2:].min())) * spread)
    card.add("start", reference.name, start, of=reference.channel, note=note)
    if open_:
        card.rows[-1] = replace(card.rows[-1], verdict=INCONCLUSIVE, run=ANALOGUE["start"].run)
    for one in fits:
        if one is not reference:
            apart = late_s(one) - late_s(reference)
            both = math.hypot(one.low.half_widths[2], low.half_widths[2])
            odd = _FILTER if one.odd or reference.odd else ""
            filtered = "" if _has_same_corner(one, reference) else _OTHER_CORNER
            said = "; ".join(each for each in (f"against {reference.name}", note, odd or filtered) if each)
            skew = None if odd else make_interval(apart, both, 1e9)
            card.add("skew", one.name, skew, of=one.channel, note=said)
            # A skew that fails does so from each of the starts.
            if (open_ and card.rows[-1].verdict != FAIL) or (filtered and card.rows[-1].verdict == FAIL):
                card.rows[-1] = replace(card.rows[-1], verdict=INCONCLUSIVE, run=ANALOGUE["skew"].run)


def _has_same_corner(one: Fitted, other: Fitted) -> bool:
    """Return whether two channels have equal low-passes, whose delays cancel in their skew, or none."""
    if one.corner_hz is None or other.corner_hz is None:
        return one.corner_hz is other.corner_hz
    return abs(one.corner_hz[0] / other.corner_hz[0] - 1.0) < _CORNER_TOLERANCE


def _is_biased(signal: Recorded, channel: Channel) -> bool:
    """Return whether an inverted signal would show in its offset: it is in volts, and the channel has a bias."""
    return units.get_quantity(signal.unit) == "voltage" and abs(channel.bias_v) > MIN_SIGNAL_NOISES * channel.noise_v


def _score_wires(
    card: Scorecard, recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], fitted: list[Fitted],
    ambiguous: set[str], session: Session, alignments: Sequence[Alignment], as_mapped: Collection[str],
) -> None:  # fmt: skip
    """Add mapping and polarity of the signals with a gain; a signal with a channel's name must be that channel."""
    fits = {one.name: one for one in fitted if one.good}
    signs = {name: one.low.gain > 0.0 for name, one in fits.items()}
    # A start half a period later inverts all channels of a table, not their biases: one known sign fixes the others.
    fixed = {
        name for each in alignments for name in each.names
        if any(not wires[n].ambiguous or _is_biased(recorded[n], fits[n].channel) for n in each.names if n in fits)
    }  # fmt: skip
    open_ = {name for name in fits if name in ambiguous and wires[name].ambiguous and name not in fixed}
    mixed = len({signs[name] for name in open_}) > 1
    if open_ and not mixed:
        card.remarks.append(f"the polarity of {', '.join(sorted(open_))} is open: it is inverted half a period later")
    rows = []
    for name, wire in wires.items():
        verdict: Verdict = NO_LIMIT
        note = f"correlation {wire.likeness:.4f}"
        absent = not wire.channel and name in session.channels and recorded[name].rows >= _MIN_ROWS
        if absent and session.is_loud(name, [end for each in alignments for end in each.inside_s]):
            verdict, note = FAIL, "it has no component of what was sent"
        elif name in fits and name in session.channels and name not in (wire.channel, *wire.rivals):
            verdict = FAIL
        elif not wire.channel or wire.rivals or name not in fits:
            verdict = INCONCLUSIVE
            note += f"; equally similar to {', '.join(wire.rivals)}" if wire.rivals else ""
            if name in fits and name == wire.channel and name in as_mapped:
                verdict, note = NO_LIMIT, f"as mapped; {note}"
        elif name in session.channels:
            verdict = PASS
        rows.append(text_row(card.path, "mapping", name, wire.channel or "-", verdict, note))
        if not wire.channel:
            continue
        upright = signs.get(name, wire.polarity > 0)
        verdict, note = PASS if upright else FAIL, ""
        if name not in fits:
            verdict = INCONCLUSIVE
        elif name in open_ and not (mixed and not upright):
            verdict, note = INCONCLUSIVE, "inverted half a period later"
            if name in as_mapped and upright:
                verdict, note = NO_LIMIT, f"as mapped; {note}"
        elif name in open_:
            note = "inverted relative to the others, from any begin"
        rows.append(text_row(card.path, "polarity", name, "as sent" if upright else "turned", verdict, note))
    card.rows[:0] = rows


def _score_fit(card: Scorecard, one: Fitted) -> None:
    low, channel = one.low, one.channel

    def add(quantity: str, estimate: Interval | None, note: str = "") -> None:
        card.add(quantity, one.name, estimate, of=channel, unit=channel.unit, note=note)

    note = _FILTER if one.odd else "" if one.good else f"the signal explains {max(0.0, one.clean.likeness):.1%} of it"
    gain = None if note else make_interval(abs(low.gain) - 1.0, low.half_widths[0], 1e6)
    add("gain", gain, note or one.rounding_note)
    add("offset", make_interval(low.offset, low.half_widths[1]) if one.good else None, one.rounding_note)
    # It is unknown whether the rig's own noise, which is in its samples, was in the DAQ's input.
    split = split_noise(one.clean, floor=one.known_noise, steps=bool(one.rounding))
    noise = split.noise if one.good else split.total
    add("noise", noise)
    add("jitter", scale_interval(split.jitter_s, 1e9) if one.good and split.jitter_s is not None else None)
    full = channel.adc_v / abs(channel.sensitivity_v)
    total = split_noise(replace(one.clean, residual=one.clean.residual + one.alias), floor=one.known_noise).total
    bits = [math.log2(full / max(total[n], 1e-12 * full) / math.sqrt(3.0)) for n in (0, 2, 1)]
    ranges = [20.0 * math.log10(full / max(noise[n], 1e-12 * full) / math.sqrt(2.0)) for n in (0, 2, 1)]
    add("effective bits", (bits[0], bits[1], bits[2]))
    add("dynamic range", (ranges[0], ranges[1], ranges[2]))
    limit = card.find_limit(card.path, "corner", channel)
    estimate, note = one.corner_hz, ""
    if estimate is None and one.shown is not None:
        highest = float(one.shown.frequency_hz[-1])
        if limit is not None and highest >= limit.low:
            estimate, note = (highest, highest, math.inf), "no fall by 3 dB up to there"
        else:
            note = f"no fall by 3 dB up to {highest:.0f} Hz, the signal's highest frequency"
    add("corner", estimate, note)
    if one.folds is not None:
        value, low_db, high_db = (-20.0 * math.log10(each) if each else math.inf for each in one.folds)
        add("alias rejection", (value, high_db, low_db))


def _score_sine(card: Scorecard, one: Fitted) -> bool:
    """Add the quantities of the standard's sine fit; return whether the signal is a sine with no missing value."""
    # The longest stretch without a lost sample.
    gaps = np.flatnonzero(~np.isfinite(np.concatenate([[np.nan], one.values, [np.nan]])))
    at = int(np.argmax(np.diff(gaps)))
    values = one.values[gaps[at] : gaps[at + 1] - 1]
    # A session's samples that are a sine within their noise may have harmonics below it.
    if one.known_noise or len(values) < _MIN_ROWS or not is_sine(one.low.sent[:_MAX_SINE_SAMPLES], 0.0):
        return False
    fit = fit_sine(values)
    score = quality(fit)
    for quantity, estimate in zip(_SINE, (score.sinad_db, score.enob, score.thd_db, score.sfdr_db), strict=True):
        card.add(quantity, one.name, estimate, of=one.channel, amplitude=fit.amplitude[0])
    return True
