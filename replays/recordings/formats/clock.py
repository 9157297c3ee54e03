"""Time axes: even and uneven time stamps, resampling, edges, and the offset between two clocks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from replays.estimate.clock import Line, find_rate, find_resolution, fit_line
from replays.estimate.spectra import parabola_top
from replays.estimate.spool import (
    blocks,
    find_extent,
    find_median,
    find_rows,
    nan_mean,
    running_sum,
    spool,
    steps_of,
    transform,
)
from rig.base.errors import InputError, Words

EVENNESS_TOLERANCE = 0.05
"""Tolerance within which time stamps must fit a straight line to count as even [samples]."""
_MIN_STEP_S = 0.999e-9
"""Smallest mean interval of time stamps [s]: 1 ns, the resolution of the formats, less rounding."""
_MIN_STEP, _MAX_SCATTER, _STEP_ROWS = 1.5, 12.0, 8
"""Smallest step of a clock [sample intervals], over the median scatter of the intervals (8 standard deviations), and
rows on each side that decide whether it persists: rounded stamps are off by up to one interval, late ones recover."""
_SHOWN_STEPS, _DAY_S = 3, 86_400.0
_MAX_GAPS, _MAX_ROWS = 4, 1e15
"""Ratio of rows with and without gaps up to which steps stand for missing rows, and largest number of these."""
_HALF_TAPS = 48
"""Taps of the interpolation filter on each side, in samples of the slower rate."""
_CUTOFF, _KAISER_BETA = 0.94, 9.0
_TABLE_POINTS = 4096
"""Table points per sample of the interpolation filter; linear interpolation between them is accurate to 2e-8."""
_CHUNK_WEIGHTS = 1 << 20
"""Filter weights computed at a time, which bounds memory."""
PASS_BAND = 0.88
"""Fraction of the lower Nyquist rate up to which the filter is flat. A Kaiser window of beta 9 (A = 90 dB) has a
transition band of (A - 8) / (2.285 N) (Kaiser; Oppenheim & Schafer, Discrete-Time Signal Processing, eq. 7.76)."""
FILTER = (
    f"band-limited polyphase: Kaiser-windowed sinc, {2 * _HALF_TAPS} taps, flat to {PASS_BAND:g} of the lower Nyquist "
    "rate, 90 dB down above it, no delay"
)


_NOISE_BAND, _MAX_BAND_PART, _NOISE_RANGE = 0.1, 0.4, 9.0
"""Signal without a pulse: more than this part is within this part of the range from its middle (0.13 of a sine, 0.2 of
a ramp, 0.45 or more of noise), and the range is below this multiple of the interquartile one (bipolar pulses: more)."""


@dataclass(frozen=True)
class TimeAxis:
    """Time axis of a signal.

    Attributes:
        first_s: Time of the first sample [s].
        rate_hz: Mean sample rate [Hz].
        rows: Number of samples.
        times_s: Time of each sample [s], shape (n,); None for an even rate.
        jitter_s: Residual of the time stamps from their fitted line, rms and maximum [s].
        note: Origin of the axis.
        numbers: Index of each received sample on the even axis if some are missing, int64, shape (received,).
        steps: Steps of the clock.
    """

    first_s: float
    rate_hz: float
    rows: int
    times_s: np.ndarray | None = None
    jitter_s: tuple[float, float] = (0.0, 0.0)
    note: str = ""
    numbers: np.ndarray | None = None
    steps: tuple[ClockStep, ...] = ()

    def place_samples(self, values: np.ndarray) -> np.ndarray:
        """Return received samples on the full axis, nan for missing ones, shape (rows,)."""
        if self.numbers is None:
            return values

        def place(rows: slice) -> np.ndarray:
            part = np.full(rows.stop - rows.start, np.nan)
            first, last = np.searchsorted(self.numbers, (rows.start, rows.stop))
            part[self.numbers[first:last] - rows.start] = values[first:last]
            return part

        return spool(place(rows) for rows in blocks(self.rows, values, self.numbers))

    @property
    def last_s(self) -> float:
        """Time of the last sample [s]."""
        return self.first_s + (self.rows - 1) / self.rate_hz if self.times_s is None else float(self.times_s[-1])

    def instants(self, part: slice | None = None) -> np.ndarray:
        """Return the time of each sample, or of some [s], shape (n,)."""
        start, stop, _ = slice(None).indices(self.rows) if part is None else part.indices(self.rows)
        return (
            self.first_s + np.arange(start, stop) / self.rate_hz if self.times_s is None else self.times_s[start:stop]
        )

    def shift(self, offset_s: float, stretch: float = 1.0) -> TimeAxis:
        """Return the axis on another clock, on which t becomes offset_s + stretch * t."""
        times_s = None if self.times_s is None else offset_s + stretch * self.times_s
        return replace(self, first_s=offset_s + stretch * self.first_s, rate_hz=self.rate_hz / stretch, times_s=times_s)


@dataclass(frozen=True)
class ClockStep:
    """Step of the clock of time stamps.

    Attributes:
        row: Row before the step, from 1.
        time_s: Its time stamp [s].
        size_s: Change of the clock in excess of one sample interval [s]; 0 if rows are missing by a right clock.
        missing: Number of rows that are treated as missing.
    """

    row: int
    time_s: float
    size_s: float
    missing: int


def remove_steps(times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[ClockStep]]:
    """Return time stamps without steps of their clock, the rows from each to the next, and the steps.

    A step is a change that persists: a late stamp is none. A step forward stands for missing rows, unless these would
    be more than the limit; other steps for one missing row, and midnight of a time of day for none.

    Args:
        times_s: Time stamps [s], shape (n,).

    Returns:
        Time stamps [s], shape (n,), rows, int64, shape (n - 1,), and the steps in order.
    """
    steps, rows, period_s = steps_of(times_s), len(times_s), 0.0
    if (rate := find_rate(times_s, 1.0 / _MIN_STEP_S)) is not None:
        period_s = 1.0 / rate
    noise_s = _MAX_SCATTER * find_median(transform(lambda part: np.abs(part - period_s), steps))
    least_s = max(_MIN_STEP * max(period_s, find_resolution(steps)), noise_s)
    odd = find_rows(lambda part: (np.abs(part - period_s) > least_s) & (period_s > 0.0), steps)
    counts = transform(lambda part: np.ones(len(part), dtype=np.int64), steps)
    if not len(odd):
        return times_s, counts, []
    excess, counts = steps - period_s, np.array(counts)
    if noise_s < EVENNESS_TOLERANCE * period_s:  # single rows may be missing too
        counts = np.clip(np.rint(steps / period_s), 1, _MAX_ROWS).astype(np.int64)
        counts[odd] = 1
    numbers = np.append(0, np.cumsum(counts))
    late_s = times_s - times_s[0] - period_s * numbers

    def persists(at: int) -> bool:
        before = late_s[max(0, at + 1 - _STEP_ROWS) : at + 1]
        after = late_s[at + 1 : at + 1 + _STEP_ROWS]
        return bool(abs(np.median(after) - np.median(before) - excess[at]) < 0.5 * abs(excess[at]))

    odd = odd[[persists(at) for at in odd.tolist()]]
    slack_s = max(EVENNESS_TOLERANCE * period_s, noise_s)
    part = np.searchsorted(odd, np.arange(rows), side="left")  # rows between steps have one line each
    first_s = times_s[np.append(0, odd + 1)]
    period_s = _fit_parts(numbers, times_s - first_s[part], part)
    counts[odd] = np.maximum(2, np.rint(np.minimum(steps[odd] / period_s, _MAX_ROWS)))
    order = odd[np.argsort(-counts[odd])]
    surplus = rows + int(np.sum(counts - 1)) - _MAX_GAPS * rows
    counts[order[: int(np.sum(np.cumsum(counts[order] - 2) - counts[order] + 2 < surplus))]] = 2
    counts[odd[np.abs(excess[odd] + _DAY_S) < slack_s]] = 1
    numbers = np.append(0, np.cumsum(counts))
    level_s = first_s + np.bincount(part, times_s - first_s[part] - period_s * numbers) / np.bincount(part)
    moved = np.diff(level_s)
    moved[np.abs(moved) < slack_s] = 0.0
    mended = times_s - np.append(0.0, np.cumsum(moved))[part]
    if np.ptp(fit_line(numbers, mended).residual) > 0.5 * np.ptp(fit_line(np.arange(rows), times_s).residual):
        return times_s, np.ones_like(counts), []  # late stamps that recover
    return (
        mended,
        counts,
        [
            ClockStep(at + 1, float(times_s[at]), float(excess[at]) if size else 0.0, int(counts[at]) - 1)
            for at, size in zip(odd.tolist(), moved.tolist(), strict=True)
        ],
    )


def _fit_parts(numbers: np.ndarray, times_s: np.ndarray, part: np.ndarray) -> float:
    """Return the common time per row of several parts with a line each [s]."""
    sizes = np.bincount(part)
    x, y = (each - (np.bincount(part, each) / sizes)[part] for each in (numbers, times_s))
    return float(x @ y) / float(x @ x)


def describe_steps(steps: Sequence[ClockStep]) -> str:
    """Return the place and size of clock steps as text; empty if there are none."""
    texts = []
    for one in steps[:_SHOWN_STEPS]:
        step = f"the clock steps by {one.size_s:+.6g} s: " if one.size_s else ""
        gap = f"{step}{one.missing} {'row' if one.missing == 1 else 'rows'} missing" if one.missing else "midnight"
        texts.append(f"{gap} after row {one.row}, at {one.time_s:.9g} s")
    return "; ".join([*texts, *([f"{len(steps) - len(texts)} more"] if len(steps) > len(texts) else [])])


def make_axis(times_s: np.ndarray, *, line: bool, what: str) -> TimeAxis:
    """Return the time axis of time stamps, with gaps for the steps of their clock.

    Args:
        times_s: Time stamps [s], shape (n,).
        line: Use the fitted line as the axis, whatever the jitter.
        what: Name of the signal, for errors.

    Raises:
        InputError: There are fewer than two stamps, they do not ascend, or their mean interval is below 1 ns.
    """
    n = len(times_s)
    if n < 2 or len(find_rows(lambda part: ~np.isfinite(part), times_s)):
        raise InputError("time stamps", "two or more finite numbers", Words(f"{what} with {n}"))
    times_s, counts, found = remove_steps(times_s)
    steps, note = steps_of(times_s), "straight line through the time stamps"
    if not find_extent(steps)[0] > 0.0 and not line:
        at = int(np.argmax(steps <= 0.0)) + 1
        must = 'ascending (or set time.stamps = "line" or time.rate_hz)'
        raise InputError(
            "time stamps", must, Words(f"{what}, {times_s[at]:g} s after {times_s[at - 1]:g} s (row {at + 1})")
        )
    numbers = running_sum(counts)
    whole = fit_line(numbers, times_s)
    step, jitter = whole.slope, _jitter(whole)
    if not step >= _MIN_STEP_S:
        must = "ascending by 1 ns or more on average (or set time.rate_hz)"
        raise InputError("time stamps", must, Words(f"{what}, {step:g} s a sample"))
    even = line or jitter[1] < EVENNESS_TOLERANCE * step
    if not even:
        # Samples may be missing from an even axis, for example when a network dropped them.
        usual = find_median(steps)
        apart = transform(lambda part: np.rint(part / usual), steps)
        places = transform(lambda part: part.astype(np.int64), running_sum(apart))
        if find_extent(apart)[0] > 0.0 and n <= places[-1] < _MAX_GAPS * n:
            kept = fit_line(places, times_s)
            if (spread := _jitter(kept))[1] < EVENNESS_TOLERANCE * kept.slope:
                whole, numbers, jitter, even = kept, places, spread, True
    if not even:
        note = "time stamps as they are"
        return TimeAxis(float(times_s[0]), 1.0 / step, n, times_s, jitter, note, steps=tuple(found))
    if (rows := int(numbers[-1]) + 1) == n:
        return TimeAxis(whole.at_zero, 1.0 / whole.slope, n, None, jitter, note, steps=tuple(found))
    note += f", {rows - n} samples missing"
    return TimeAxis(whole.at_zero, 1.0 / whole.slope, rows, None, jitter, note, numbers, tuple(found))


def _jitter(line: Line) -> tuple[float, float]:
    """Return the residual of the time stamps from their fitted line, rms and maximum [s]."""
    low, high = find_extent(line.residual)
    return math.sqrt(nan_mean(transform(np.square, line.residual))), max(-low, high)


def interpolate_linear(values: np.ndarray, axis: TimeAxis, instants_s: np.ndarray) -> np.ndarray:
    """Return values interpolated linearly; beyond the ends, the end values."""
    return np.interp(instants_s, axis.instants(), values)


def linear_gain(axis: TimeAxis, instants_s: np.ndarray) -> float:
    """Return the rms gain of linear interpolation for white noise [1]."""
    place = np.interp(instants_s, axis.instants(), np.arange(axis.rows, dtype=float))
    part = place - np.floor(place)
    return float(np.sqrt(np.mean(part**2 + (1.0 - part) ** 2)))


def polyphase_gain(axis: TimeAxis, rate_hz: float) -> float:
    """Return the rms gain of `resample_polyphase` for white noise, given by its bandwidth [1]."""
    return math.sqrt(_CUTOFF * min(1.0, rate_hz / axis.rate_hz))


def resample_polyphase(values: np.ndarray, axis: TimeAxis, first_s: float, rate_hz: float, rows: int) -> np.ndarray:
    """Resample an even signal to another rate and start with a band-limited polyphase filter.

    The ratio of the rates is arbitrary, so a clock error of some ppm is corrected without drift.

    Args:
        values: Samples, shape (n,).
        axis: Their time axis; must be even.
        first_s: Time of the first output sample [s].
        rate_hz: Output rate [Hz].
        rows: Number of output samples.

    Returns:
        Shape (rows,). Beyond the ends the signal is extended by point reflection.
    """
    wide = max(1.0, axis.rate_hz / rate_hz)  # input samples per sample of the slower rate
    half = math.ceil(_HALF_TAPS * wide)
    u = np.arange(_HALF_TAPS * _TABLE_POINTS + 1) / _TABLE_POINTS
    # Zero beyond the last tap; the extra entry serves the interpolation between table points.
    window = np.i0(_KAISER_BETA * np.sqrt(1.0 - (u / _HALF_TAPS) ** 2)) / np.i0(_KAISER_BETA)
    table = np.append(np.sinc(_CUTOFF * u) * window, [0.0, 0.0])
    padded = (
        np.pad(values, half, mode="reflect", reflect_type="odd") if len(values) > 1 else np.pad(values, half, "edge")
    )
    wanted = (first_s - axis.first_s) * axis.rate_hz + np.arange(rows) * (axis.rate_hz / rate_hz)
    near = np.clip(np.floor(wanted).astype(np.int64), 0, len(values) - 1)
    offsets = np.arange(1 - half, half + 1)
    out = np.empty(rows)
    step = max(1, _CHUNK_WEIGHTS // len(offsets))
    for start in range(0, rows, step):
        part = slice(start, start + step)
        away = np.abs((wanted[part] - near[part])[:, None] - offsets) * (_TABLE_POINTS / wide)
        cell = np.minimum(away.astype(np.int64), len(table) - 2)
        weights = table[cell] + (table[cell + 1] - table[cell]) * np.minimum(away - cell, 1.0)
        neighbours = padded[np.minimum(near[part][:, None] + offsets + half, len(padded) - 1)]
        out[part] = np.einsum("ij,ij->i", weights, neighbours) / weights.sum(axis=1)
    return out


def find_crossings(
    values: np.ndarray, axis: TimeAxis, *, threshold: float | None, hysteresis: float | None, falling: bool = False
) -> tuple[np.ndarray, float]:
    """Return the instants at which a signal crosses a level, interpolated linearly between samples.

    Args:
        values: The signal, shape (n,).
        axis: Its time axis.
        threshold: The level; None: midway between the lowest and the highest value.
        hysteresis: Distance by which the signal must fall back before the next crossing counts; None: a tenth of its
            range.
        falling: Find falling instead of rising crossings.

    Returns:
        Instants [s], shape (k,), and the level. Without a threshold, a signal of noise alone has none.
    """
    low, high = find_extent(values)
    level = 0.5 * (low + high) if threshold is None else threshold
    back = 0.1 * (high - low) if hysteresis is None else hysteresis
    if threshold is None and high > low and _is_noise(values, level, high - low):
        return np.empty(0), level
    sign = -1.0 if falling else 1.0
    # A crossing counts if the signal has been below the hysteresis band since the previous one. The first row may be on
    # a rising flank, from which the band is left upwards, or on a falling one, where noise crosses the level.
    rising, last, below, until, kept = 0, -1, 0, 0, [np.empty(0)]

    def load(rows: slice) -> np.ndarray:
        return sign * (np.nan_to_num(values[rows.start : rows.stop + 1], nan=low) - level)

    for rows in blocks(len(values) - 1, values):
        if len(outside := np.flatnonzero(np.abs(signal := load(rows)) > back)):
            rising = rows.start + int(outside[0]) if signal[outside[0]] > 0.0 else 0
            break
    for rows in blocks(len(values) - 1, values):
        signal = load(rows)
        counts = below + np.cumsum(signal[:-1] < -back)
        found = []
        for at in np.flatnonzero((signal[:-1] < 0.0) & (signal[1:] >= 0.0)).tolist():
            if counts[at] > until or (last < 0 and rows.start + at < rising):
                found.append(at)
                last, until = rows.start + at, int(counts[at])
        below = int(counts[-1]) if len(counts) else below
        at, times_s = np.array(found, dtype=int), axis.instants(slice(rows.start, rows.stop + 1))
        part = -signal[at] / (signal[at + 1] - signal[at])
        kept.append(times_s[at] + part * (times_s[at + 1] - times_s[at]))
    return np.concatenate(kept), level


def _is_noise(values: np.ndarray, level: float, spread: float) -> bool:
    """Return whether a signal has no pulse: it is spread about the middle of its range, as noise is."""
    near = total = 0
    for rows in blocks(len(values), values):
        held = values[rows][np.isfinite(values[rows])]
        near, total = near + int((np.abs(held - level) < _NOISE_BAND * spread).sum()), total + len(held)
    if not near > _MAX_BAND_PART * total:
        return False
    low, high = np.quantile(values[np.isfinite(values)], (0.25, 0.75))
    return bool(spread < _NOISE_RANGE * (high - low))


@dataclass(frozen=True)
class Shift:
    """Conversion of times to another clock: t becomes offset_s + stretch * t.

    Attributes:
        offset_s: Offset [s].
        stretch: Rate of the clock [1].
        note: Method and quality.
    """

    offset_s: float
    stretch: float
    note: str


def shift_by_edges(
    reference: tuple[np.ndarray, TimeAxis],
    shifted: tuple[np.ndarray, TimeAxis],
    *,
    threshold: float | None,
    within_s: float,
) -> Shift:
    """Return the shift that aligns the rising edges of a common trigger.

    If both signals have the same number of edges, two or more, the fitted line also gives the relative clock rate.

    Raises:
        InputError: A signal has no edge, or the shift exceeds within_s.
    """
    edges = [find_crossings(*signal, threshold=threshold, hysteresis=None)[0] for signal in (reference, shifted)]
    if not len(edges[0]) or not len(edges[1]):
        must = "an edge through the threshold in both signals"
        raise InputError("align", must, Words(f"{len(edges[0])} in the reference, {len(edges[1])} in the moved signal"))
    a, b = edges
    if len(a) == len(b) > 1:
        line = fit_line(b, a)
        stretch, offset, residual = line.slope, line.at_zero, _jitter(line)[1]
        how = f"{len(a)} common edges, clock {1e6 * (stretch - 1.0):+.2f} ppm, worst edge {residual * 1e6:.2f} µs off"
    else:
        stretch, offset = 1.0, float(a[0] - b[0])
        how = f"first edges ({len(a)} and {len(b)} in all)"
    moves = max(abs(offset + (stretch - 1.0) * t) for t in (b[0], b[-1]))
    if moves > within_s:
        raise InputError("align", f"within {within_s:g} s (align.within_s)", Words(f"{moves:g} s"))
    return Shift(offset, stretch, f"by {how}")


def shift_by_correlation(
    reference: tuple[np.ndarray, TimeAxis], shifted: tuple[np.ndarray, TimeAxis], *, within_s: float
) -> Shift:
    """Return the shift of maximum cross-correlation, refined between samples by a parabola.

    Raises:
        InputError: No lag within within_s has a correlation of 0.3 or more.
    """
    from scipy.signal import correlate, correlation_lags

    (x, ax), (y, ay) = reference, shifted
    rate = max(ax.rate_hz, ay.rate_hz)
    first = min(ax.first_s, ay.first_s)

    def even(values: np.ndarray, axis: TimeAxis) -> tuple[np.ndarray, float]:
        start = first + math.ceil((axis.first_s - first) * rate - 1e-9) / rate
        instants = start + np.arange(math.floor((axis.last_s - start) * rate + 1e-9) + 1) / rate
        even_values = interpolate_linear(np.nan_to_num(values, nan=float(np.nanmean(values))), axis, instants)
        return even_values - even_values.mean(), start

    x, x_start = even(x, ax)
    y, y_start = even(y, ay)
    norm = math.sqrt(float(x @ x) * float(y @ y))
    correlation = correlate(x, y, method="fft") / max(norm, 1e-300)
    lags = correlation_lags(len(x), len(y)) / rate + x_start - y_start
    near = np.abs(lags) <= within_s
    if norm == 0.0 or not near.any():
        raise InputError("align", "two varying signals that overlap within align.within_s", Words(f"{within_s:g} s"))
    best = int(np.flatnonzero(near)[np.argmax(correlation[near])])
    peak = float(correlation[best])
    if peak < 0.3:
        raise InputError("align", "two signals with a correlation of 0.3 or more", round(peak, 3))
    offset = float(lags[best])
    if 0 < best < len(correlation) - 1:
        offset += float(parabola_top(*correlation[best - 1 : best + 2])[0]) / rate
    return Shift(offset, 1.0, f"by cross-correlation {peak:.3f}")
