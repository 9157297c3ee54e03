"""Nonlinearity of a converter: intermodulation of two tones, and INL and DNL by a ramp.

Definitions follow IEEE Std 1241-2010 as quoted in papers and tutorials; the standard itself was not available.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from replays.estimate.clock import fit_line
from replays.estimate.intervals import bound_maximum
from replays.estimate.least_squares import compute_inverse, solve
from replays.estimate.runs import block_means, split_at_breaks
from replays.estimate.sine import decibels, fit_sine, fit_tones, tone_columns
from replays.score.card.scorecard import Interval

_MAX_OTHER_POWER = 1e-4
"""Largest part of its power that a two-tone signal may have in other components: session noise is 1e-6 of it."""
_MAX_FIRST_RESIDUAL = 0.05
"""The same limit after fits of the tones one after the other."""
_TONE_RATIO = 400.0
"""Largest power of one tone over the other (26 dB)."""
_SEARCH_ROWS = 1 << 14
"""Rows by which the two tones are found; their frequencies are then refined over all."""
_PHASE_TOLERANCE = 1e-9
"""Change of a tone's phase over all rows in the last step [cycles]: a thousandth of the error by session noise."""
_ORDERS = (1, -1), (1, 1), (2, -1), (-1, 2), (2, 1), (1, 2), (2, 0), (0, 2), (3, 0), (0, 3)
"""Multiples of the two tones that are fitted: products of second and third order, and harmonics."""
_COUNTED_ORDERS = 4
"""Number of the first ones that count: second order, and third order near the tones (IEEE 1241)."""
_JUMP, _MAX_CURVATURE = 0.05, 2e-3
"""Smallest backward jump of a ramp, and its largest deviation from a line, rms, as parts of the full scale."""
_RING_ROWS, _SEGMENT_ROWS = 80, 1000
"""Rows excluded next to a jump, as the band-limited known signal rings there, and fewest rows of a ramp."""
_KNOTS = 64
"""Knots of the transfer curve over the converter's range."""
_COVERAGE, _MIN_SWEEP = 0.9, 0.01
"""Part of the range that a ramp must cover for INL, and part below which a signal is not a ramp."""
_CODE_SAMPLES = 16.0
"""Samples per code from which code widths are judged."""
_EDGE_NOISES = 4.0
"""Distance from the ends of the ramp, in noises, within which the converter may limit."""


def _fit_two_tones(n: np.ndarray, sent: np.ndarray) -> tuple[list[float], float] | None:
    """Return the frequencies [cycles per row] and the power [unit^2] of two tones; None for any other signal."""
    if len(sent) < _SEGMENT_ROWS or not np.var(sent):
        return None
    first = fit_sine(sent[:_SEARCH_ROWS])
    second = fit_sine(first.residual)
    if np.var(second.residual) > _MAX_FIRST_RESIDUAL * np.var(sent):
        return None
    tones, parts, _, rest = fit_tones(n, sent, np.array([first.frequency[0], second.frequency[0]]), _PHASE_TOLERANCE)
    powers = 0.5 * (parts[:2] ** 2 + parts[2:4] ** 2)
    if np.var(rest) > _MAX_OTHER_POWER * np.var(sent) or powers.max() > _TONE_RATIO * powers.min():
        return None
    return sorted(tones.tolist()), float(powers.sum())


def intermodulation(times_s: np.ndarray, sent: np.ndarray, residual: np.ndarray, gain: float) -> Interval | None:
    """Return the intermodulation distortion [dB]: products of second and third order over the two tones, rms.

    Args:
        times_s: Times of the rows, even except for lost ones [s], shape (n,).
        sent: The known signal, shape (n,).
        residual: Residual of the record [unit], shape (n,).
        gain: Gain of the record.

    Returns:
        Value and 95 % interval (delta method), or None if the known signal is not two tones.
    """
    n = np.rint((times_s - times_s[0]) / np.median(np.diff(times_s)))
    n -= 0.5 * n[-1]
    tones = _fit_two_tones(n, sent)
    if tones is None:
        return None
    (low, high), power = tones
    least, turns, counted = 2.0 / len(n), list[float](), 0
    for number, (a, b) in enumerate(_ORDERS):
        # A product beyond half of the rate, or close to a tone or another product, is not separable.
        product = abs(a * high + b * low)
        if product < 0.5 - least and min(abs(product - each) for each in (0.0, low, high, *turns)) > least:
            turns.append(product)
            counted += number < _COUNTED_ORDERS
    if not counted:
        return None
    basis = tone_columns(n, np.array(turns))
    parts = solve(basis, residual)
    line = 2.0 * float(np.var(residual - basis @ parts)) / len(n)  # variance of one part of a line
    squares = (parts[: len(turns)] ** 2 + parts[len(turns) : -1] ** 2)[:counted].tolist()
    half = 1.96 * math.sqrt(sum(4.0 * line * each + 4.0 * line**2 for each in squares))
    return decibels(0.5 * sum(squares) / (gain**2 * power), 0.5 * half / (gain**2 * power))


@dataclass(frozen=True)
class Transfer:
    """A converter's transfer curve by a ramp.

    Attributes:
        inl: Largest deviation of the curve from the fitted line [ppm of the range]; None if the ramp is too short.
        dnl: Largest deviation of a code's width from the mean [LSB]; None if there are too few samples per code.
        coverage: Part of the converter's range that the ramp covers.
        code_samples: Mean samples per code.
    """

    inl: Interval | None
    dnl: Interval | None
    coverage: float
    code_samples: float


def _fit_ramp(times_s: np.ndarray, sent: np.ndarray, span: float) -> np.ndarray | None:
    """Return the lines of a ramp through the known signal, nan next to its jumps, shape (n,); or None."""
    ramp = np.full(len(sent), np.nan)
    for a, b in split_at_breaks(np.abs(np.diff(sent)) > _JUMP * span):
        if b - a > _SEGMENT_ROWS + 2 * _RING_ROWS:
            part = slice(a + _RING_ROWS, b - _RING_ROWS)
            line = fit_line(times_s[part], sent[part])
            ramp[part] = line(times_s[part])
            if np.std(line.residual) > _MAX_CURVATURE * span:
                return None
    held = np.isfinite(ramp)
    return ramp if held.any() and np.ptp(ramp[held]) > _MIN_SWEEP * span else None


def transfer_curve(times_s: np.ndarray, sent: np.ndarray, values: np.ndarray, span: float) -> Transfer | None:
    """Return INL and DNL by a slow ramp; None for another signal.

    The transfer curve is piecewise linear between 64 knots; intervals are simultaneous over knots and codes.

    Args:
        times_s: Times of the rows [s], shape (n,).
        sent: The known signal, without gain [unit], shape (n,).
        values: Recorded values [unit], shape (n,).
        span: The converter's range, from end to end [unit].
    """
    from scipy.sparse import csr_array

    ramp = _fit_ramp(times_s, sent, span)
    if ramp is None:
        return None
    low, high = np.nanmin(ramp), np.nanmax(ramp)
    held = np.isfinite(ramp)
    edge = _EDGE_NOISES * float(np.std(np.diff(fit_line(ramp[held], values[held]).residual))) / math.sqrt(2.0)
    held[held] = (ramp[held] > low + edge) & (ramp[held] < high - edge)
    if held.sum() < _SEGMENT_ROWS:
        return None
    x, y = ramp[held], values[held]
    line = fit_line(x, y)
    place = (x - x.min()) / (np.ptp(x) / _KNOTS)
    knot = np.minimum(place.astype(int), _KNOTS - 1)
    part, row = place - knot, np.arange(len(x))
    entries = np.concatenate([1.0 - part, part]), (np.tile(row, 2), np.concatenate([knot, knot + 1]))
    hats = csr_array(entries, shape=(len(x), _KNOTS + 1))
    inverse = compute_inverse((hats.T @ hats).toarray())
    curve = inverse @ (hats.T @ line.residual)
    residual = line.residual - hats @ curve
    block = max(1, len(x) // (8 * _KNOTS))  # coloured noise has block means with a larger variance
    variance = max(float(np.var(residual)), block * float(np.var(block_means(residual, block))))
    inl = bound_maximum(np.abs(curve), np.sqrt(np.diag(inverse) * variance))
    coverage = float(high - low) / span
    dnl, samples = _code_widths(y, line(x), float(np.std(residual)))
    size = 1e6 / span
    judged = (inl[0] * size, inl[1] * size, inl[2] * size) if coverage > _COVERAGE else None
    return Transfer(judged, dnl, coverage, samples)


def _code_widths(values: np.ndarray, line: np.ndarray, noise: float) -> tuple[Interval | None, float]:
    """Return the DNL by the code density of a ramp [LSB], and the mean samples per code."""
    codes = np.unique(values)
    steps = np.diff(codes)
    steps = steps[steps > 1e-9 * np.ptp(codes)]
    if len(steps) < 8:
        return None, math.inf
    count = round(np.ptp(codes) / float(np.median(steps)))
    step, samples = np.ptp(codes) / count, len(values) / count
    if samples < _CODE_SAMPLES:
        return None, samples
    there, due = (
        np.bincount(np.clip(np.rint((each - codes[0]) / step), 0, count).astype(int), minlength=count + 1)[2:-2]
        for each in (values, line)
    )
    full = due > 0.5 * samples
    there, due = there[full], due[full]
    # Noise changes the count at a transition by 0.564 noise per sample (IEEE 1241, ramp); a code has two transitions.
    spread = np.sqrt(2.0 * 0.564 * noise / step / due)
    value, low, high = bound_maximum(np.abs(there / due - 1.0), spread)
    return (value, max(0.0, low - 1.0 / samples), high + 1.0 / samples), samples
