"""Least-squares fit of the known signal: y = gain s(t + late + drift t + bend t^2 / 2) + offset, and its residual.

The covariance of these five parameters is a block sandwich: the spread of scores summed over consecutive blocks. Their
intervals are therefore valid for noise of any spectrum, and for noise that is larger where the signal is steep. Errors
of the known signal itself, as between its samples, are part of the residual, and so of the intervals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from replays.estimate.intervals import refine, student
from replays.estimate.least_squares import inverse_square, solve
from replays.estimate.spectra import Spectrum, transfer
from replays.score.records.stimulus import Stimulus

_MAX_STEPS, _MAX_FINAL_STEPS = 4, 3
_STEP_TOLERANCE = 1e-3
"""Step, as a fraction of the parameter's standard deviation, below which the iteration ends."""
_MIN_SAMPLES = 400
"""Fewest samples that are fitted."""
_TAPS = 96
_PASSES = 3
"""Fits with a filter, each with the signal at the times that the previous one found."""
_ORDERS = 8
"""Orders of Butterworth low-passes that are tried."""
_TRANSIENT_PERIODS = 8.0
"""Periods of the corner that are excluded at each end of a record, for a filter to settle."""
_LOG_STEP, _MAX_LOG_CHANGE = 1e-4, 0.5
"""Logarithm of the corner: step of its numerical derivative, and largest change from its first estimate."""
_MIN_COHERENCE = 0.8
"""Coherence from which the response at a frequency is valid."""


@dataclass(frozen=True)
class Waveform:
    """Result of the fit of one channel.

    Attributes:
        gain, offset, late_s, drift, bend: Fitted values [1, unit, s, s/s, 1/s]; `late_s`, `drift` are means.
        covariance: Covariance of the five parameters, shape (5, 5).
        dof: Degrees of freedom of the five variances, shape (5,).
        middle_s, half_s: Middle of the fitted rows by the clock of the file, and half of their length [s].
        times_s: Times of the fitted rows by the clock of the file [s], shape (n,).
        values: Recorded values [unit], shape (n,).
        sent, slope: The sent signal and its slope there, without gain [unit, unit/s], shape (n,).
        residual: Residual [unit], shape (n,).
    """

    gain: float
    offset: float
    late_s: float
    drift: float
    bend: float
    covariance: np.ndarray
    dof: np.ndarray
    middle_s: float
    half_s: float
    times_s: np.ndarray
    values: np.ndarray
    sent: np.ndarray
    slope: np.ndarray
    residual: np.ndarray

    @property
    def spread(self) -> np.ndarray:
        """Standard deviations of the five, shape (5,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def half_widths(self) -> np.ndarray:
        """Half of the 95 % intervals of the five, shape (5,)."""
        return student(self.dof) * self.spread

    def late_at(self, times_s: np.ndarray) -> np.ndarray:
        """Return the time of the stimulus less time of the record, at times of the record [s], shape (n,)."""
        return np.polynomial.polynomial.polyval(times_s - self.middle_s, self.curve)

    @property
    def curve(self) -> tuple[float, float, float]:
        """Coefficients of `late_at` by powers of the time from the middle [s, 1, 1/s]."""
        return self.late_s - self.bend * self.half_s**2 / 6.0, self.drift, 0.5 * self.bend

    @property
    def likeness(self) -> float:
        """Part of the recorded power that the known signal explains."""
        whole = float(np.var(self.values))
        return 1.0 - float(np.var(self.residual)) / whole if whole else 0.0


def fit_waveform(
    values: np.ndarray, times_s: np.ndarray, stimulus: Stimulus, curve: tuple[float, float, float]
) -> Waveform | None:
    """Fit a channel; return None if the known signal is not in it, or too little of it.

    Args:
        values: Recorded values [unit], nan if one is missing, shape (n,).
        times_s: Equidistant times by the clock of the file [s], shape (n,).
        stimulus: The known signal.
        curve: First estimate of the time of the stimulus less that of the file, accurate to a fraction of a signal
            period: coefficients of the powers of the time from the middle of the file [s, 1, 1/s].
    """
    return _solve(values, times_s, stimulus, curve, slice(0, len(values)), final=True)


def fit_stretch(
    values: np.ndarray, times_s: np.ndarray, stimulus: Stimulus, late_s: float, stretch: tuple[int, int]
) -> Waveform | None:
    """Fit a channel over a stretch of its rows, as `fit_waveform`, without intervals."""
    return _solve(values, times_s, stimulus, (late_s, 0.0, 0.0), slice(*stretch), final=False)


def _solve(
    values: np.ndarray, times_s: np.ndarray, stimulus: Stimulus, curve: tuple[float, float, float], rows: slice, *,
    final: bool,
) -> Waveform | None:  # fmt: skip
    """Fit some rows by Gauss-Newton steps; time is centred on these rows, but in `curve` on all rows.

    `bend` is fitted only with `final`; otherwise its standard deviation is set to 1 1/s.
    """
    y, t = values[rows], times_s[rows]
    low, high = stimulus.span_s
    start_s = np.polynomial.polynomial.polyval(t - 0.5 * (times_s[0] + times_s[-1]), curve)
    held = np.isfinite(y) & (t + start_s >= low) & (t + start_s <= high)
    if held.sum() < _MIN_SAMPLES:
        return None
    y, t, start_s = y[held], t[held], start_s[held]
    centre, span = 0.5 * (t[0] + t[-1]), 0.5 * max(t[-1] - t[0], 1e-300)
    u = (t - centre) / span
    shape = np.column_stack([np.ones(len(u)), u, u**2 - 1.0 / 3.0][: 3 if final else 2])
    moved, number = np.zeros(shape.shape[1]), 0
    while True:
        at = t + start_s + shape @ moved
        use = (at >= low) & (at <= high)
        if use.sum() < _MIN_SAMPLES:
            return None
        s, ds = stimulus(at[use])
        ones = np.ones(len(s))
        # Gain and offset are linear; the step of time is computed about them.
        gain, offset = solve(np.column_stack([s, ones]), y[use])
        if not gain:
            return None
        jacobian = np.column_stack([s, ones, gain * ds[:, None] * shape[use]])
        residual = y[use] - gain * s - offset
        inverse = inverse_square(jacobian)
        step = inverse @ (jacobian.T @ residual)
        moved = moved + step[2:]
        small = (
            np.abs(step[2:])
            < (_STEP_TOLERANCE if final else 0.1) * np.sqrt(np.diag(inverse)[2:] * np.mean(residual**2)) + 1e-300
        )
        number += 1
        if number > 1 and (small.all() or number >= _MAX_STEPS + (_MAX_FINAL_STEPS if final else 0)):
            break
    # Add the initial curve, expanded about this centre, to the fitted changes.
    begun = solve(np.column_stack([np.ones(len(u)), u, u**2 - 1.0 / 3.0]), start_s)
    begun[: len(moved)] += moved
    residual = residual - jacobian @ step
    units = np.array([1.0, 1.0, 1.0, span, 0.5 * span**2])
    covariance, dof = np.diag([0.0, 0.0, 0.0, 0.0, units[4] ** 2]), np.ones(5)
    if final:
        fitted = slice(jacobian.shape[1])
        change, residual, covariance[fitted, fitted], dof[fitted] = refine(jacobian, residual)
        step = step + change
        begun[: len(moved)] += change[2:]
    return Waveform(
        float(gain + step[0]), float(offset + step[1]), float(begun[0]), float(begun[1] / span),
        float(2.0 * begun[2] / span**2), covariance / np.outer(units, units), dof, centre, span,
        t[use], y[use], s, ds, residual,
    )  # fmt: skip


@dataclass(frozen=True)
class Response:
    """Frequency response of a channel at the frequencies at which the signal determines it.

    Attributes:
        frequency_hz: Frequencies [Hz], shape (n,).
        gain: Gain over that of the lowest frequencies, shape (n,).
        spread: Standard deviation of the gain's logarithm, shape (n,).
        corner_hz: Frequency of -3 dB, with its 95 % interval [Hz]; None if the gain does not fall that far.
    """

    frequency_hz: np.ndarray
    gain: np.ndarray
    spread: np.ndarray
    corner_hz: tuple[float, float, float] | None


def response(fit: Waveform) -> Response | None:
    """Return the response by Welch's cross spectra; None if the signal has too few frequencies.

    Spread: sqrt((1 - coherence) / (2 coherence segments)) (Bendat & Piersol, Random Data, table 9.6). The corner is
    where a parabola through the logarithms near it passes -3 dB.
    """
    n = len(fit.sent)
    rate = (n - 1) / (fit.times_s[-1] - fit.times_s[0])
    length = int(min(2048, n // 16))
    f, power, gain, coherence = transfer(fit.sent, fit.values, rate, length)
    shown = (coherence > _MIN_COHERENCE) & (power > 1e-5 * power.max()) & (f > 0.0)
    if shown.sum() < 16:
        return None
    f, gain, coherence = f[shown], gain[shown] / abs(fit.gain), coherence[shown]
    segments = 2.0 * n / length * 0.9
    spread = np.sqrt((1.0 - coherence) / (2.0 * coherence * segments)) + 1e-9
    lowest = f <= max(f[7], 0.1 * f[-1])
    weight = spread**-2.0
    base = math.exp(float(np.sum(weight[lowest] * np.log(gain[lowest])) / np.sum(weight[lowest])))
    gain = gain / base
    return Response(f, gain, spread, _find_corner(f, np.log(gain), spread))


def _find_corner(f: np.ndarray, log: np.ndarray, spread: np.ndarray) -> tuple[float, float, float] | None:
    level = -0.5 * math.log(2.0)
    below = log < level
    # The gain must stay below: single lines in the noise do not count.
    runs = np.convolve(below, np.ones(5), mode="valid") >= 5
    if not runs.any() or not runs.argmax():
        return None
    at = f[int(runs.argmax())]
    near = (f > 0.7 * at) & (f < 1.4 * at)
    if near.sum() < 8:
        return None
    x, weights = np.log(f[near] / at), 1.0 / spread[near]
    matrix = np.vander(x, 3) * weights[:, None]
    parts = solve(matrix, weights * log[near])
    residual = weights * log[near] - matrix @ parts
    inverse = inverse_square(matrix) * max(1.0, float(residual @ residual) / (len(x) - 3))
    roots = [r.real for r in np.roots(parts - [0.0, 0.0, level]) if abs(r.imag) < 1e-9]
    if not roots:
        return None
    root = roots[int(np.argmin(np.abs(roots)))]
    row = np.array([root**2, root, 1.0])
    # Lines of a Hann window are not independent: 1.9 of them count as one.
    half = 1.96 * math.sqrt(1.9 * float(row @ inverse @ row)) / max(abs(parts[1] + 2.0 * parts[0] * root), 1e-300)
    return at * math.exp(root), at * math.exp(root - half), at * math.exp(root + half)


def _number_rows(times_s: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the numbers of rows on an even grid, of which some may be missing, shape (n,), and its step [s]."""
    step_s = float(np.median(np.diff(times_s)))
    places = np.rint((times_s - times_s[0]) / step_s).astype(int)
    return places, (times_s[-1] - times_s[0]) / max(1, int(places[-1]))


def fit_linear_response(fit: Waveform) -> Waveform:
    """Return the fit with the linear response of the channel, 96 taps by least squares, whose residual is noise."""
    from scipy.linalg import solve_toeplitz
    from scipy.signal import correlate

    x = fit.sent - fit.sent.mean()
    y = fit.values - fit.values.mean()
    n, half = len(x), _TAPS // 2
    auto = correlate(x, x, method="fft")[n - 1 :][:_TAPS]
    cross = correlate(y, x, method="fft")[n - 1 - half :][:_TAPS]
    auto[0] *= 1.0 + 1e-9
    taps = np.asarray(solve_toeplitz(auto, cross))
    sent = np.convolve(x, taps)[half : half + n]
    slope = np.convolve(fit.slope, taps)[half : half + n]
    places, _ = _number_rows(fit.times_s)
    kept = np.zeros(n, bool)  # rows whose taps include no lost sample
    kept[_TAPS:-_TAPS] = places[_TAPS + half : n - half] - places[half : n - _TAPS - half] == _TAPS
    residual = (y - sent)[kept]
    return replace(
        fit, gain=1.0, times_s=fit.times_s[kept], values=y[kept], sent=sent[kept], slope=slope[kept],
        residual=residual - residual.mean(),
    )  # fmt: skip


def find_order(shown: Response) -> int:
    """Return the order of the Butterworth low-pass that matches a response with a corner best."""
    assert shown.corner_hz is not None
    log, weights = np.log(shown.gain), np.maximum(shown.spread, 0.01) ** -2.0
    # The corner has an error, which is larger for an incorrect order.
    ratios = shown.frequency_hz[:, None] / (shown.corner_hz[0] * np.linspace(0.9, 1.1, 41))
    costs = [np.min(weights @ (log[:, None] + 0.5 * np.log1p(ratios ** (2 * n))) ** 2) for n in range(1, _ORDERS + 1)]
    return int(np.argmin(costs)) + 1


Corner = tuple[float, float, float]


def fit_with_filter(start: Waveform, stimulus: Stimulus, shown: Response) -> tuple[Waveform, Corner] | None:
    """Return the fit with a Butterworth low-pass between signal and record, and its corner with interval, or None.

    Gain is that at low frequencies, and time is without the filter's delay. None if no corner fits.

    Args:
        start: The fit without the filter.
        stimulus: The known signal.
        shown: The response by that fit, with a corner.
    """
    assert shown.corner_hz is not None
    order, corner_hz, near, late_s = find_order(shown), shown.corner_hz[0], start, None
    better = None
    for _ in range(_PASSES):
        better = _fit_filter(near, stimulus, corner_hz, order, late_s)
        if better is None:
            return None
        # Repeat with the signal at the updated times.
        fit, (corner_hz, _, _) = better
        sent, slope = stimulus(start.times_s + fit.late_at(start.times_s))
        near, late_s = replace(fit, times_s=start.times_s, values=start.values, sent=sent, slope=slope), 0.0
    assert better is not None
    fit, (corner_hz, low, high) = better
    true = 1.0 / (1.0 + fit.drift)  # converts seconds of the file to those of the session
    return fit, (true * corner_hz, true * low, true * high)


def _fit_filter(
    start: Waveform, stimulus: Stimulus, corner_hz: float, order: int, late_s: float | None
) -> tuple[Waveform, Corner] | None:
    """Return the fit from an initial corner and delay; by default the filter's delay at low frequencies."""
    span_s = start.times_s[-1] - start.times_s[0]
    places, step_s = _number_rows(start.times_s)
    n = int(places[-1]) + 1
    # The filter's delay at low frequencies, by default.
    delay_s = 1.0 / (2.0 * math.pi * corner_hz * math.sin(math.pi / (2.0 * order))) if late_s is None else late_s
    cut = math.ceil(_TRANSIENT_PERIODS / (corner_hz * step_s))
    # Without the transients of the filter at the ends.
    kept = slice(*np.searchsorted(places, (cut, n - cut)))
    if n < 8 * cut + _MIN_SAMPLES or kept.stop - kept.start < _MIN_SAMPLES:
        return None
    y, sent, slope = start.values, start.sent, start.slope
    if n > len(places):  # the filter also needs the instants of lost samples
        even_s = start.times_s[0] + step_s * np.arange(n)
        sent, slope = stimulus(even_s + start.late_at(even_s))
    spectra = [Spectrum.from_samples(values, step_s) for values in (sent, slope)]
    poles = np.exp(1j * np.pi * (2.0 * np.arange(1, order + 1) + order - 1.0) / (2.0 * order))
    log = math.log(corner_hz)

    def passed(spectrum: Spectrum, log_corner: float) -> np.ndarray:
        s = spectrum.turn / (2.0 * math.pi * math.exp(log_corner))
        loss = np.prod([1.0 - s / pole for pole in poles], axis=0)
        return spectrum.apply_response(np.exp(spectrum.turn * delay_s) / loss)[places[kept]]

    u = (2.0 * (start.times_s - start.middle_s) / span_s)[kept]
    ones = np.ones(len(u))
    solved = None
    for _ in range(2 * _MAX_STEPS):
        s, ds = (passed(spectrum, log) for spectrum in spectra)
        moved = (passed(spectra[0], log + _LOG_STEP) - passed(spectra[0], log - _LOG_STEP)) / (2.0 * _LOG_STEP)
        gain = float(solve(np.column_stack([s, ones]), y[kept])[0])
        matrix = np.column_stack([s, ones, gain * ds, gain * ds * u, gain * ds * (u**2 - 1.0 / 3.0), gain * moved])
        parts = solve(matrix, y[kept])
        delay_s, log = delay_s + parts[2], log + float(np.clip(parts[5], -0.2, 0.2))
        if abs(log - math.log(corner_hz)) > _MAX_LOG_CHANGE:
            return None
        solved = s, ds, matrix, parts
        if abs(parts[5]) < 1e-9 and abs(parts[2]) < 1e-13:
            break
    assert solved is not None
    s, ds, matrix, parts = solved
    change, residual, covariance, dof = refine(matrix, y[kept] - matrix @ parts)
    parts = parts + change
    delay_s, log = delay_s + float(change[2]), log + float(change[5])
    units = np.array([1.0, 1.0, 1.0, 0.5 * span_s, 0.125 * span_s**2, 1.0])
    covariance = covariance / np.outer(units, units)
    half = float(student(dof[5])) * math.sqrt(covariance[5, 5])
    fitted = Waveform(
        float(parts[0]), float(parts[1]), start.late_s + float(delay_s),
        start.drift + float(parts[3]) / (0.5 * span_s), start.bend + float(parts[4]) / (0.125 * span_s**2),
        covariance[:5, :5], dof[:5], start.middle_s, start.half_s, start.times_s[kept], y[kept], s, ds, residual,
    )  # fmt: skip
    return fitted, (math.exp(log), math.exp(log - half), math.exp(log + half))
