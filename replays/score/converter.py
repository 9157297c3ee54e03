"""Quantities of the analogue path that need a special test signal, or several channels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from replays.estimate.intervals import scale_interval
from replays.score.analogue import Fitted
from replays.score.card.scorecard import Scorecard
from replays.score.quantities.crosstalk import find_crosstalk
from replays.score.quantities.nonlinearity import intermodulation, transfer_curve
from replays.score.quantities.rounding import find_rounding_errors
from replays.score.quantities.step import BAND, has_steps, step_response

_QUANTITIES = ("IMD", "INL", "DNL", "crosstalk", "rise time", "overshoot", "settling time")
_MAX_ROWS = 1 << 17
"""Rows by which crosstalk is judged: more cost time, and 1e5 resolve -100 dB."""


def score_converter(card: Scorecard, fits: Sequence[Fitted]) -> None:
    """Add intermodulation, INL, DNL, crosstalk and step response of the channels whose gain is found."""
    good = [one for one in fits if one.good]
    for one in good:
        _score_nonlinearity(card, one)
        _score_steps(card, one)
        _score_crosstalk(card, one, [each for each in good if each is not one])
    shown = {row.quantity for row in card.rows}
    for quantity in _QUANTITIES:
        if quantity not in shown:
            card.add(quantity, "", None)


def _score_nonlinearity(card: Scorecard, one: Fitted) -> None:
    clean, low, channel = one.clean, one.low, one.channel
    distortion = intermodulation(clean.times_s, clean.sent, clean.residual, clean.gain)
    if distortion is not None:
        card.add("IMD", one.name, distortion, of=channel)
    curve = transfer_curve(low.times_s, low.sent, low.values, 2.0 * channel.adc_v / abs(channel.sensitivity_v))
    if curve is not None:
        card.add("INL", one.name, curve.inl, of=channel, note=f"over {curve.coverage:.0%} of the range")
        card.add("DNL", one.name, curve.dnl, of=channel, note=f"{curve.code_samples:.3g} samples per code")


def _score_steps(card: Scorecard, one: Fitted) -> None:
    low, channel = one.low, one.channel
    if not has_steps(low.sent):
        return
    response = step_response(low.sent, low.values)
    row_s = float(np.median(np.diff(low.times_s)))
    rise = settling = overshoot = None
    note = "too few steps with long enough plateaus"
    if response is not None:
        rise, overshoot = scale_interval(response.rise_rows, row_s), response.overshoot
        settling = None if response.settling_rows is None else scale_interval(response.settling_rows, row_s)
        note = f"of {response.steps} steps"
    card.add("rise time", one.name, rise, of=channel, note=note)
    card.add("overshoot", one.name, overshoot, of=channel, note=note)
    card.add("settling time", one.name, settling, of=channel, note=f"{note}; to {BAND:.0%} of the step")


def _score_crosstalk(card: Scorecard, one: Fitted, others: Sequence[Fitted]) -> None:
    clean, rows = one.clean, slice(_MAX_ROWS)
    times_s = clean.times_s[rows]
    sources, names = [], []
    for other in others:
        volts = other.low.sent * abs(other.channel.sensitivity_v)
        if np.std(volts) > other.channel.noise_v and np.ptp(other.low.times_s) > 0.5 * np.ptp(times_s):
            sources.append(np.interp(times_s, other.low.times_s, volts))
            names.append(other.name)
    if not sources:
        return
    volts = clean.residual[rows] * abs(one.channel.sensitivity_v)
    size_v = abs(one.channel.sensitivity_v)
    own = [size_v * clean.sent[rows], clean.slope[rows]]
    errors = size_v * find_rounding_errors(clean, one.rounding, rows)
    worst, part = find_crosstalk(volts, own, sources, size_v * one.known_noise, errors)
    if part is None:
        card.add("crosstalk", one.name, None, of=one.channel, note=f"other signals equal that of {names[worst]}")
        return
    value, low, high = (20.0 * math.log10(max(each, 1e-15)) for each in part)
    card.add("crosstalk", one.name, (value, low, high), of=one.channel, note=f"from {names[worst]}")
