"""Time axes: how even time stamps are, samples at other instants, edges, and the shift between two clocks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from replays.estimate.clock import Line, fit_line
from replays.estimate.spectra import parabola_top
from rig.base.errors import InputError, Words

EVEN = 0.05
"""Part of a sample within which time stamps must lie on their straight line to be even."""
_MIN_STEP_S = 0.999e-9
"""Least mean step of time stamps: of those in ns, less rounding [s]."""
_HALF_TAPS = 48
"""Taps of the interpolation filter on each side, in samples of the slower rate."""
_CUTOFF, _KAISER = 0.94, 9.0
_FINE = 4096
"""Points a sample at which the filter is tabulated; straight lines between them are off by 2e-8."""
_CHUNK = 1 << 20
"""Weights that are worked out at a time."""
PASS_BAND = 0.88
"""Part of the lower Nyquist rate up to which the filter is flat: for a Kaiser window of beta 9, A = 90 dB, the
transition is (A - 8) / (2.285 N) wide (Kaiser; Oppenheim & Schafer, Discrete-Time Signal Processing, eq. 7.76)."""
FILTER = (
    f"band-limited polyphase: Kaiser-windowed sinc, {2 * _HALF_TAPS} taps, flat to {PASS_BAND:g} of the lower Nyquist "
    "rate, 90 dB down above it, no delay"
)


@dataclass(frozen=True)
class Axis:
    """When the samples of a signal were taken.

    Attributes:
        first_s: Time of the first [s].
        rate_hz: Mean rate [Hz].
        rows: Number of samples.
        times_s: Their times where they are not even [s], shape (n,).
        jitter_s: Residual of the stamps from their straight line, rms and largest [s].
        note: Where the axis is from.
        numbers: Number of each sample on the even axis where some are missing, int64, shape (samples that came,).
    """

    first_s: float
    rate_hz: float
    rows: int
    times_s: np.ndarray | None = None
    jitter_s: tuple[float, float] = (0.0, 0.0)
    note: str = ""
    numbers: np.ndarray | None = None

    def placed(self, values: np.ndarray) -> np.ndarray:
        """The samples that came, on the axis: nan where one is missing, shape (rows,)."""
        if self.numbers is None:
            return values
        whole = np.full(self.rows, np.nan)
        whole[self.numbers] = values
        return whole

    @property
    def last_s(self) -> float:
        """Time of the last sample [s]."""
        return self.first_s + (self.rows - 1) / self.rate_hz if self.times_s is None else float(self.times_s[-1])

    def instants(self) -> np.ndarray:
        """Time of each sample [s], shape (n,)."""
        return self.first_s + np.arange(self.rows) / self.rate_hz if self.times_s is None else self.times_s

    def moved(self, offset_s: float, stretch: float = 1.0) -> Axis:
        """On another clock, where t becomes offset + stretch t."""
        times_s = None if self.times_s is None else offset_s + stretch * self.times_s
        return replace(self, first_s=offset_s + stretch * self.first_s, rate_hz=self.rate_hz / stretch, times_s=times_s)


def axis_of_stamps(times_s: np.ndarray, *, line: bool, what: str) -> Axis:
    """The time axis that time stamps make.

    Args:
        times_s: Stamps [s], shape (n,).
        line: Take the straight line through them for the axis, however they jitter.
        what: Whose they are, for errors.

    Raises:
        InputError: There are fewer than two, or they do not ascend, or too slowly for a rate.
    """
    n = len(times_s)
    if n < 2 or not np.isfinite(times_s).all():
        raise InputError("time stamps", "two or more finite numbers", Words(f"{what} with {n}"))
    steps = np.diff(times_s)
    if not np.all(steps > 0.0) and not line:
        at = int(np.argmax(steps <= 0.0)) + 1
        must = 'ascending (or time.stamps = "line", or time.rate_hz given)'
        raise InputError(
            "time stamps", must, Words(f"{what}, {times_s[at]:g} s after {times_s[at - 1]:g} s (row {at + 1})")
        )
    whole = fit_line(np.arange(n), times_s)
    step, jitter = whole.slope, _jitter(whole)
    if not step >= _MIN_STEP_S:
        must = "ascending by 1 ns a sample or more, on the whole (or time.rate_hz given)"
        raise InputError("time stamps", must, Words(f"{what}, {step:g} s a sample"))
    even = line or jitter[1] < EVEN * step
    if not even:
        # Samples may be missing from an even axis, as where a network has lost some.
        numbers = np.concatenate([[0], np.cumsum(np.rint(steps / np.median(steps)))]).astype(np.int64)
        if np.all(np.diff(numbers) > 0) and n <= numbers[-1] < 4 * n:
            kept = fit_line(numbers, times_s)
            if (spread := _jitter(kept))[1] < EVEN * kept.slope:
                rows = int(numbers[-1]) + 1
                note = f"straight line through the time stamps, {rows - n} samples missing"
                return Axis(kept.at_zero, 1.0 / kept.slope, rows, None, spread, note, numbers)
        return Axis(float(times_s[0]), 1.0 / step, n, times_s, jitter, "time stamps as they are")
    return Axis(whole.at_zero, 1.0 / step, n, None, jitter, "straight line through the time stamps")


def _jitter(line: Line) -> tuple[float, float]:
    """Return the residual of stamps from their line, rms and largest [s]."""
    return float(np.sqrt(np.mean(line.residual**2))), float(np.abs(line.residual).max())


def linear(values: np.ndarray, axis: Axis, instants_s: np.ndarray) -> np.ndarray:
    """Values on straight lines between samples; beyond the ends, the end values."""
    return np.interp(instants_s, axis.instants(), values)


def linear_gain(axis: Axis, instants_s: np.ndarray) -> float:
    """By how much straight lines between samples make white noise smaller, rms: of two samples, both noises a part."""
    place = np.interp(instants_s, axis.instants(), np.arange(axis.rows, dtype=float))
    part = place - np.floor(place)
    return float(np.sqrt(np.mean(part**2 + (1.0 - part) ** 2)))


def polyphase_gain(axis: Axis, rate_hz: float) -> float:
    """By how much `polyphase` makes white noise smaller: what it cuts off [1]."""
    return math.sqrt(_CUTOFF * min(1.0, rate_hz / axis.rate_hz))


def polyphase(values: np.ndarray, axis: Axis, first_s: float, rate_hz: float, rows: int) -> np.ndarray:
    """Even samples at another rate and of another start, band-limited: a filter at each wanted sample's own phase.

    Any ratio of rates is met exactly, so that a clock that is off by some ppm is put right and does not drift.

    Args:
        values: Samples, shape (n,).
        axis: When they were taken; must be even.
        first_s: Time of the first wanted one [s].
        rate_hz: Wanted rate [Hz].
        rows: Number wanted.

    Returns:
        Shape (rows,); beyond the ends the signal is taken to go on as its mirror image through the end point.
    """
    wide = max(1.0, axis.rate_hz / rate_hz)  # source samples to one of the slower rate
    half = math.ceil(_HALF_TAPS * wide)
    u = np.arange(_HALF_TAPS * _FINE + 1) / _FINE
    # Nothing beyond the last tap; its neighbour in the table is for the straight line.
    window = np.i0(_KAISER * np.sqrt(1.0 - (u / _HALF_TAPS) ** 2)) / np.i0(_KAISER)
    table = np.append(np.sinc(_CUTOFF * u) * window, [0.0, 0.0])
    padded = (
        np.pad(values, half, mode="reflect", reflect_type="odd") if len(values) > 1 else np.pad(values, half, "edge")
    )
    wanted = (first_s - axis.first_s) * axis.rate_hz + np.arange(rows) * (axis.rate_hz / rate_hz)
    near = np.clip(np.floor(wanted).astype(np.int64), 0, len(values) - 1)
    offsets = np.arange(1 - half, half + 1)
    out = np.empty(rows)
    step = max(1, _CHUNK // len(offsets))
    for start in range(0, rows, step):
        part = slice(start, start + step)
        away = np.abs((wanted[part] - near[part])[:, None] - offsets) * (_FINE / wide)
        cell = np.minimum(away.astype(np.int64), len(table) - 2)
        weights = table[cell] + (table[cell + 1] - table[cell]) * np.minimum(away - cell, 1.0)
        taken = padded[np.minimum(near[part][:, None] + offsets + half, len(padded) - 1)]
        out[part] = np.einsum("ij,ij->i", weights, taken) / weights.sum(axis=1)
    return out


def crossings(
    values: np.ndarray, axis: Axis, *, threshold: float | None, hysteresis: float | None, falling: bool = False
) -> tuple[np.ndarray, float]:
    """Instants at which a signal passes a level, between samples by a straight line.

    Args:
        values: The signal, shape (n,).
        axis: Its time axis.
        threshold: The level; None: half way between the lowest and the highest value.
        hysteresis: How far the signal must go back before the next one counts; None: a tenth of its extent.
        falling: Downward instead of upward.

    Returns:
        Instants [s], shape (k,), and the level.
    """
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    level = 0.5 * (low + high) if threshold is None else threshold
    back = 0.1 * (high - low) if hysteresis is None else hysteresis
    sign = -1.0 if falling else 1.0
    signal = sign * (np.nan_to_num(values, nan=low) - level)
    upward = np.flatnonzero((signal[:-1] < 0.0) & (signal[1:] >= 0.0))
    if not len(upward):
        return np.empty(0), level
    # An edge counts if the signal has been below the band since the one before.
    below = np.concatenate([[0], np.cumsum(signal < -back)])
    kept, last = [], -1
    for at in upward.tolist():
        if last < 0 or below[at + 1] > below[last + 1]:
            kept.append(at)
            last = at
    at = np.array(kept)
    times_s = axis.instants()
    part = -signal[at] / (signal[at + 1] - signal[at])
    return times_s[at] + part * (times_s[at + 1] - times_s[at]), level


@dataclass(frozen=True)
class Shift:
    """How a clock is brought to another: t becomes offset + stretch t.

    Attributes:
        offset_s: Added to its times [s].
        stretch: Its seconds in those of the other.
        note: How it was found, and how well.
    """

    offset_s: float
    stretch: float
    note: str


def shift_by_edges(
    reference: tuple[np.ndarray, Axis], moved: tuple[np.ndarray, Axis], *, threshold: float | None, within_s: float
) -> Shift:
    """The shift that lays the rising edges of a common trigger upon each other.

    With two or more edges in both, that many, their straight line also tells how much faster one clock goes.

    Raises:
        InputError: One of them has no edge, or they lie too far apart.
    """
    found = [crossings(*signal, threshold=threshold, hysteresis=None)[0] for signal in (reference, moved)]
    if not len(found[0]) or not len(found[1]):
        must = "an edge through the threshold in both signals"
        raise InputError("align", must, Words(f"{len(found[0])} in the reference, {len(found[1])} in what is moved"))
    a, b = found
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
    reference: tuple[np.ndarray, Axis], moved: tuple[np.ndarray, Axis], *, within_s: float
) -> Shift:
    """The shift at which two signals are most alike, between samples by a parabola.

    Raises:
        InputError: They are alike nowhere.
    """
    from scipy.signal import correlate, correlation_lags

    (x, ax), (y, ay) = reference, moved
    rate = max(ax.rate_hz, ay.rate_hz)
    first = min(ax.first_s, ay.first_s)

    def even(values: np.ndarray, axis: Axis) -> tuple[np.ndarray, float]:
        start = first + math.ceil((axis.first_s - first) * rate - 1e-9) / rate
        instants = start + np.arange(math.floor((axis.last_s - start) * rate + 1e-9) + 1) / rate
        even_values = linear(np.nan_to_num(values, nan=float(np.nanmean(values))), axis, instants)
        return even_values - even_values.mean(), start

    x, x_start = even(x, ax)
    y, y_start = even(y, ay)
    norm = math.sqrt(float(x @ x) * float(y @ y))
    alike = correlate(x, y, method="fft") / max(norm, 1e-300)
    lags = correlation_lags(len(x), len(y)) / rate + x_start - y_start
    near = np.abs(lags) <= within_s
    if norm == 0.0 or not near.any():
        raise InputError("align", "two signals that vary, and overlap within align.within_s", Words(f"{within_s:g} s"))
    best = int(np.flatnonzero(near)[np.argmax(alike[near])])
    peak = float(alike[best])
    if peak < 0.3:
        raise InputError("align", "alike by a correlation of 0.3 or more", round(peak, 3))
    offset = float(lags[best])
    if 0 < best < len(alike) - 1:
        offset += float(parabola_top(*alike[best - 1 : best + 2])[0]) / rate
    return Shift(offset, 1.0, f"by cross-correlation {peak:.3f}")
