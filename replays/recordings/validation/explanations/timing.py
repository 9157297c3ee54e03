"""Laws of a delayed channel, and of a channel with another filter."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from replays.estimate.clock import fit_line, time_error
from replays.estimate.least_squares import solve
from replays.estimate.spectra import Spectrum
from replays.recordings.validation.explanations.channel_fit import (
    MARGIN,
    MIN_ROWS,
    Law,
    Shown,
    gain_words,
    least_at,
    rms_of,
    with_level,
)
from rig.channels.faults.defects import size_text
from rig.channels.sensors.filters import low_pass_response

_MAX_LOG_DELAY_S = 4e-3
"""Largest delay of a log's channel in the search."""
_MIN_DELAY_S, _MAX_DELAY_S = -1e-6, 0.011
"""Delays of one of the rig's channels: a negative one is impossible, as the future is unknown."""
_MAX_SEGMENTS = 40
"""Segments of a channel whose delays are compared."""
_SETTLING_PERIODS = 5.0
"""Settling time of a filter, in periods of its corner."""
_ENDS_S = 1e-3
"""Time before the end of the known signal that a filter's inverse affects."""
_MAX_ALIAS_PART = 0.3
"""Remaining part of the difference without the alias above which a missing filter is not tried."""
_SETTLES_S = 0.02
"""Time after which the difference is due to the other filter."""
_RINGS_HZ, _RING_STARTS = (20.0, 4000.0), 60
"""Range of resonances, and number of initial values in it."""
_MAX_QUALITY = 1000.0
"""Quality factor that no transducer reaches."""
_MAX_RATIO, _MIN_PASS = 0.97, 0.1
"""For a log: largest residual of a low-pass relative to that of a delay, and smallest passed part of the signal."""
_KINDS: dict[str, dict[str, Any]] = {
    name: {"filter": name.split()[0], "filter_order": order, "group_delay_us": late_us}
    for name, order, late_us in (
        ("butterworth 4", 4, None), ("butterworth 2", 2, None), ("bessel 4", 4, None), ("chebyshev 4", 4, None),
        ("sinc 3", 3, None), ("sinc 3 compensated", 3, 0.0), ("fir 64", 64, None), ("fir 64 compensated", 64, 0.0),
    )
}  # fmt: skip
"""Low-passes tried for a channel of a log."""
_KIND_TOLERANCE = 1.2
"""Ratio of the sums of squares of two kinds that are not distinguished, as samples do not show what is aliased."""
_MAX_CORNER_RATIO, _MIN_RESPONSE = 2.0, 1e-3
"""Largest corner tried, relative to the told one, and smallest response of the told filter that is inverted."""
_MIN_SETTLED_PART = 0.3
"""Part of the difference that must remain after a filter has settled."""
_MAX_SHIFT_ROWS = 400
"""Largest number of lost or repeated rows of a channel in the search."""
_MIN_COUPLING_TURNS, _MAX_COUPLING_PART = 0.02, 0.05
"""Lowest corner of an AC coupling that is searched, in periods in the window, and highest, as part of the rate."""
_MAX_NOISE_PART = 0.8
"""Residual over noise below which it contains no independent noise."""


def late(one: Shown) -> Iterator[Law]:
    """Yield laws with another time: delay, clock and wander."""
    ones, spline, t = np.ones(len(one.values)), one.expected_at, one.times_s - one.times_s[0]
    late_s, delayed, _ = delayed_by(one)
    if one.counts is not None:
        (late_s,), _ = one.fitted(lambda p: spline(one.times_s - p[0]), [[late_s]], [1e-6])
        delayed = spline(one.times_s - late_s)
    earliest_s, latest_s = (-_MAX_LOG_DELAY_S, _MAX_LOG_DELAY_S) if one.counts is None else (_MIN_DELAY_S, _MAX_DELAY_S)
    if earliest_s <= late_s <= latest_s + 2.0 * one.period_s:  # otherwise it is an end of the search range
        (shift,), residual = one.solve([ones], one.values - delayed)
        change, of = size_text("delay", late_s), {"delay": late_s}
        yield one.law("delay", late_s, (one.values - delayed) / one.floor, numbers=of)
        if abs(shift) > one.noise and one.exceeds_level(residual):
            text = f"{change}, {size_text('offset', shift, one.unit)}"
            yield one.law("delay and offset", late_s, residual, 2, text, numbers=of)
        if one.counts is not None and abs(late_s) < -_MIN_DELAY_S:
            return  # the delay is negligible
        for columns in [[delayed], [delayed, ones]][one.counts is not None :]:
            factors, residual = one.solve(columns)
            what, also = gain_words(gain := float(factors[0]))
            if what == "signal":
                continue  # a missing signal has no delay
            count, text = 1 + len(columns), f"{also}, {change}"
            law = one.law(f"{what} and delay", gain - 1.0, residual, count, text, numbers=of)
            bare = one.solve([delayed])[1]
            yield from with_level(one, law, float([*factors, 0.0][1]), bare)
    if one.counts is None or one.channel.signal == "keyphasor":
        return  # a log's common time is fitted earlier; pulses are judged by their edges
    at, delays = _find_delays(one)
    if len(at) < 6:
        return
    line = fit_line(at, delays)
    (start, rate), residual = one.fitted(
        lambda p: spline(one.times_s - p[0] - p[1] * t), [[line.at_zero, line.slope], [0.0, line.slope]], [1e-6, 1e-6]
    )
    if min(start, start + rate * t[-1]) > _MIN_DELAY_S:
        yield one.law("clock", 1e6 * float(rate), residual, 2)
    length_s = float(t[-1])
    starts = []
    for period_s in 2.0 * length_s / np.arange(1.0, 2.0 * _MAX_SEGMENTS / 3.0):
        turn = 2.0 * math.pi * at / period_s
        table = np.column_stack([np.ones(len(at)), np.cos(turn), np.sin(turn)])
        starts.append([*solve(table, delays).tolist(), period_s])
    (mean_s, a, b, period_s), residual = one.fitted(
        lambda p: spline(
            one.times_s - p[0] - p[1] * np.cos(2.0 * math.pi * t / p[3]) - p[2] * np.sin(2.0 * math.pi * t / p[3])
        ),
        starts, [1e-6, 1e-6, 1e-6, length_s],
    )  # fmt: skip
    size = math.hypot(a, b)
    if mean_s - size > _MIN_DELAY_S:
        yield one.law("wander", size, residual, 4, f"{1e6 * size:.4g} µs in {abs(period_s):.4g} s")


def _find_delays(one: Shown) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles of segments after the first row [s], and their delays [s]."""
    spline, t = one.expected_at, one.times_s - one.times_s[0]
    slope, at, delays_s = spline.derivative(), [], []
    pieces = np.array_split(np.arange(len(t)), min(_MAX_SEGMENTS, len(t) // MIN_ROWS))
    late_s = delayed_by(one.at(one.times_s[: max(MIN_ROWS, len(t) // 8)]))[0]
    for rows in pieces:
        for _ in range(8):
            places = one.times_s[rows] - late_s
            falls, off = -slope(places), one.values[rows] - spline(places)
            step = time_error(falls, off)
            late_s = float(np.clip(late_s + np.clip(step, -20.0 * one.period_s, 20.0 * one.period_s), -0.02, 0.02))
        at.append(float(t[rows].mean()))
        delays_s.append(late_s)
    return np.array(at), np.array(delays_s)


def delayed_by(one: Shown) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the delay of a channel [s], its expected signal with it, and the slope of that [its unit/s]."""
    spline = one.expected_at
    slope, period_s = spline.derivative(), one.period_s

    def cost(late_s: float) -> float:
        shown = spline(one.times_s - late_s)
        if one.counts is None:
            return rms_of(one.solve([shown, np.ones(len(shown))])[1])
        return rms_of(one.solve([one.level], one.values - shown)[1])

    if one.counts is None:
        far = np.linspace(-_MAX_LOG_DELAY_S, _MAX_LOG_DELAY_S, 81) / period_s
        rows = np.unique(np.rint(np.concatenate([np.arange(-16, 17), far])))
    else:
        rows = np.arange(0.0, _MAX_DELAY_S / period_s)

    def refined(late_s: float) -> float:
        for _ in range(6):
            at = one.times_s - late_s
            (_, step, _), _ = one.solve([spline(at), -slope(at), np.ones(len(at))])
            late_s = float(np.clip(late_s + np.clip(step, -period_s, period_s), -_MAX_DELAY_S, _MAX_DELAY_S))
        return late_s

    # A ringing signal is similar a period later: between rows another minimum may be the best.
    costs = np.array([cost(late_s) for late_s in rows * period_s])
    least = np.flatnonzero((costs <= np.r_[np.inf, costs[:-1]]) & (costs <= np.r_[costs[1:], np.inf]))
    late_s = min((refined(late_s) for late_s in (rows[least] * period_s).tolist()), key=cost)
    at = one.times_s - late_s
    return late_s, spline(at), slope(at)


def filtered(one: Shown) -> Iterator[Law]:
    """Yield a low-pass with another corner."""
    if one.counts is None:
        slope = one.expected_at.derivative()(one.times_s)
        factors, residual = one.solve([slope, np.gradient(slope, one.times_s)], one.values - one.expected)
        lower = "lower" if factors[1] > 0.0 else "higher"
        yield one.law("bandwidth", float(factors[1]), residual, 2, f"{lower} than given", unit="")
    channel = one.channel
    if not one.uniform or not channel.bandwidth_hz:
        return
    begin, wave = _find_wave(one)

    def through(corner_hz: float, shape: Mapping[str, Any] = MappingProxyType({})) -> np.ndarray:
        return low_pass_response(channel.model_copy(update={"bandwidth_hz": corner_hz, **shape}), wave.turn)

    nominal = through(channel.bandwidth_hz)
    nominal = np.where(np.abs(nominal) > _MIN_RESPONSE, nominal, np.inf)
    margin = min(len(one.values) // 8, round(_SETTLES_S / one.period_s))
    if len(one.values) - margin - round(_ENDS_S / one.period_s) < 2 * MIN_ROWS:
        return  # too short

    def residual_by(other: np.ndarray | float) -> np.ndarray:
        y = one.values - wave.apply_response(other / nominal)[begin:][: len(one.values)]
        y = one.solve([one.level], y)[1] if channel.highpass_hz and one.counts is not None else y / one.floor
        judged = slice(margin, -round(_ENDS_S / one.period_s))  # the later signal affects the inverse of a filter
        y[: judged.start] = y[judged.stop :] = rms_of(y[judged])
        return y

    def find_corner(shape: Mapping[str, Any], most_hz: float) -> float:
        def cost(log_hz: float) -> float:
            settled = min(len(one.values) // 2, round(_SETTLING_PERIODS / math.exp(log_hz) / one.period_s))
            return rms_of(residual_by(through(math.exp(log_hz), shape))[max(margin, settled) :])

        grid = np.log(np.geomspace(10.0, most_hz, 40))
        near, step = min(grid, key=cost), grid[1] - grid[0]
        return math.exp(least_at(cost, near - step, min(near + step, grid[-1])))

    corner_hz = find_corner({}, 0.98 * channel.bandwidth_hz)
    margin = max(margin, min(len(one.values) // 2, round(_SETTLING_PERIODS / corner_hz / one.period_s)))
    residual, differs = residual_by(through(corner_hz)), one.apart[margin : -round(_ENDS_S / one.period_s)]
    if one.counts is None:
        delayed = (one.values - delayed_by(one)[1]) / one.floor
        passed = float((one.values - residual * one.floor).std())
        most_hz = min(_MAX_CORNER_RATIO * channel.bandwidth_hz, 0.5 / one.period_s)
        corners = {kind: find_corner(shape, most_hz) for kind, shape in _KINDS.items()}
        fits = {kind: residual_by(through(hz, _KINDS[kind])) for kind, hz in corners.items()}
        squares = {kind: float(fit @ fit) for kind, fit in fits.items()}
        best = min(squares, key=lambda kind: squares[kind])
        told = float(residual @ residual)
        if squares[best] < told - one.price and rms_of(fits[best]) < _MAX_RATIO * rms_of(delayed):
            alike = [
                f"{kind} of {float(f'{corners[kind]:.3g}'):g} Hz" for kind in squares
                if kind != best and squares[kind] < _KIND_TOLERANCE * squares[best] + MARGIN
            ]  # fmt: skip
            text = f"low-pass of kind {best} near {float(f'{corners[best]:.3g}'):g} Hz, told {channel.filter} of "
            text += f"{channel.bandwidth_hz:g} Hz" + f" (not distinguished from {', '.join(alike)})" * bool(alike)
            yield one.law("bandwidth", corners[best], fits[best], 2, text)
        # For a slow signal a low-pass is a delay; and a low-pass that passes nothing is not an explanation.
        if max(1.0, rms_of(residual)) < _MAX_RATIO * rms_of(delayed) and passed > _MIN_PASS * float(one.expected.std()):
            yield one.law("bandwidth", corner_hz, residual, 1, f"lower than given: {corner_hz:.3g} Hz")
        return
    if rms_of(residual) < _MAX_NOISE_PART * max(1.0, one.noise / float(one.floor[0])):  # else independent noise
        resolved = rms_of(differs) > _MIN_SETTLED_PART * rms_of(one.apart)
        yield one.law("bandwidth", corner_hz, residual, sure=resolved)
    if one.bare is not None and (rms_of(residual_by(1.0)) < _MAX_ALIAS_PART * rms_of(one.apart)):
        column = one.level if channel.highpass_hz else np.zeros(len(one.values))
        yield one.law("no-filter", 0.0, one.solve([column], one.values - one.bare())[1])


def shifted(one: Shown) -> Iterator[Law]:
    """Yield, for a log, a channel that lost or repeated rows: from one row on it is early or late by whole rows."""
    if one.counts is not None or not one.uniform:
        return
    times_s, signal = one.around or (one.times_s, one.expected)
    first, n = int(np.searchsorted(times_s, one.times_s[0])), len(one.values)
    before = np.append(0.0, np.cumsum(one.apart[:-1] ** 2))
    least = (math.inf, 0, 0, one.apart)
    signal, first = np.pad(signal, _MAX_SHIFT_ROWS, mode="edge"), first + _MAX_SHIFT_ROWS
    for rows in range(-_MAX_SHIFT_ROWS, _MAX_SHIFT_ROWS + 1):
        residual = (one.values - signal[first + rows :][:n]) / one.floor
        costs = before + np.cumsum(residual[::-1] ** 2)[::-1]
        if costs.min() < least[0]:
            least = (float(costs.min()), rows, int(costs.argmin()), residual)
    _, rows, at, residual = least
    # From the first row on it would be a delay.
    if rows and at > MIN_ROWS:
        what = "lost samples" if rows > 0 else "doubled samples"
        change = f"{abs(rows)} rows from {one.times_s[at]:.4f} s"
        yield one.law(what, float(abs(rows)), np.concatenate([one.apart[:at], residual[at:]]), 2, change, unit="")


def ac_coupled(one: Shown) -> Iterator[Law]:
    """Yield, for a log, an AC coupling of a higher corner than told: a first-order high-pass, already settling."""
    if one.counts is not None or not one.uniform:
        return
    from scipy.signal import lfilter

    told, t = 2.0 * math.pi * one.channel.highpass_hz, one.times_s - one.times_s[0]
    doubled = np.concatenate([one.expected[:1], one.expected])

    def through(log_hz: float) -> np.ndarray:
        """Return the residual: the high-pass subtracts a low-pass of the signal, whose initial value is fitted."""
        held = 2.0 * math.pi * math.exp(log_hz)
        kept = math.exp(-held * one.period_s)
        slow = lfilter([0.5 - 0.5 * kept] * 2, [1.0, -kept], doubled)[1:]
        shown = one.expected - (1.0 - told / held) * slow
        return one.solve([np.exp(-held * t)], one.values - shown)[1]

    low, high = max(one.channel.highpass_hz, _MIN_COUPLING_TURNS / t[-1]), _MAX_COUPLING_PART / one.period_s
    if not low < high:
        return
    grid = np.log(np.geomspace(low, high, 40))
    near, step = min(grid, key=lambda log_hz: rms_of(through(log_hz))), grid[1] - grid[0]
    log_hz = least_at(lambda log_hz: rms_of(through(log_hz)), max(near - step, grid[0]), min(near + step, grid[-1]))
    hz, residual = math.exp(log_hz), through(log_hz)
    # Ends of the search range are no corner.
    if low / _MAX_RATIO < hz < high * _MAX_RATIO and one.exceeds_level(residual):
        change = f"{size_text('AC coupling', hz)}, told {one.channel.highpass_hz:g} Hz" if told else ""
        yield one.law("AC coupling", hz, residual, 2, change)


def _find_wave(one: Shown) -> tuple[int, Spectrum]:
    """Return the first row and the spectrum of the expected signal with its margins, followed by its reverse."""
    times_s, e = one.around or (one.times_s, one.expected)
    round_trip = np.concatenate([e, e[::-1]])
    return int(np.searchsorted(times_s, one.times_s[0])), Spectrum.from_samples(round_trip, one.period_s)


def ringing(one: Shown) -> Iterator[Law]:
    """Yield a transducer with a resonance, which may still ring from before."""
    if not one.uniform or not one.moves:
        return
    from scipy.interpolate import make_interp_spline
    from scipy.optimize import minimize

    begin, wave = _find_wave(one)
    t = one.times_s - one.times_s[0]

    def residual(logs: np.ndarray) -> np.ndarray:
        w, quality = 2.0 * math.pi * math.exp(logs[0]), 0.5 + math.exp(logs[1])
        response = w**2 / (wave.turn**2 + wave.turn * w / quality + w**2)
        shown = wave.apply_response(response)[begin:][: len(t)]
        fading, angle = np.exp(-0.5 * w / quality * t), w * math.sqrt(1.0 - 0.25 / quality**2) * t
        return one.solve([fading * np.cos(angle), fading * np.sin(angle), one.level], one.values - shown)[1]

    def cost(logs: np.ndarray) -> float:
        return math.log(rms_of(residual(logs)))

    # x'' = w^2 (e - x) - (w / quality) x' has both numbers, approximately for impacts; else one of many starts.
    shown = make_interp_spline(t, one.values, k=5)
    pulls = [one.expected - one.values, -shown.derivative()(t)]
    (stiff, damping), _ = one.solve(pulls, shown.derivative(2)(t))
    starts = [
        np.log([hz, quality - 0.5])
        for hz in np.geomspace(*_RINGS_HZ, _RING_STARTS)
        for quality in (1.0, 10.0, 100.0)
    ]  # fmt: skip
    if stiff > 0.0 and damping > 0.0 and math.sqrt(stiff) > 0.5 * damping:
        starts.append(np.log([math.sqrt(stiff) / 2.0 / math.pi, math.sqrt(stiff) / damping - 0.5]))
    close = {"xatol": 1e-7, "fatol": 1e-3}
    minimum: Any = minimize(cost, min(starts, key=cost), method="Nelder-Mead", options=close)
    hz, quality = math.exp(minimum.x[0]), 0.5 + math.exp(minimum.x[1])
    if 0.5 * _RINGS_HZ[0] < hz < 2.0 * _RINGS_HZ[1] and quality < _MAX_QUALITY:
        yield one.law("resonance", hz, residual(minimum.x), 4, f"at {hz:.4g} Hz, quality {quality:.3g}")
