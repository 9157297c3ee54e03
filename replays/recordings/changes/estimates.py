"""Statistics of a signal within a phase, each with its standard error and degrees of freedom.

Steady signals are divided into blocks: the scatter and the correlation of the blocks give the error, whatever the
colour of the noise. A transient occurs once in a phase: its error contains the noise of the channel and the uncertainty
of the phase's begin and end, and not the scatter of repeated runs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from replays.estimate.intervals import sandwich, student
from replays.estimate.least_squares import solve, solve_normal
from replays.estimate.runs import block_means
from replays.estimate.spectra import parabola_top, periodic_hann, power
from replays.recordings.formats.guessing.noise import segment_spectra

HUM_HZ = (50.0, 60.0)
"""Frequencies of the mains [Hz]."""
MIN_STEADY_ROWS = 256
"""Smallest number of rows for 64 blocks."""
_MIN_TURNS = 3.0
"""Smallest number of revolutions, or of periods between two tones, for their amplitudes."""
_MAX_FIT_ROWS = 1 << 16
"""Largest number of rows in a fit of tones; longer signals are averaged first."""
_MIN_AMPLITUDE = 5.0
"""Amplitude of a tone over its standard error from which its phase is known."""
_MIN_SEGMENTS = 8
_NEIGHBOURS = 65
"""Lines of a spectrum whose median is the noise at a line."""
_MIN_LINE_RATIO = 30.0
"""Power of a line over the noise from which it is fitted; noise alone reaches it once in 1e9 lines."""
_MAX_LINES = 8
"""Number of lines beyond the known tones, or of steps of their modulation, that are fitted."""
_EDGE_ROWS = 2
"""Uncertainty of the begin and end of a phase [rows]."""
_KNOWN_DOF = 60.0
"""Degrees of freedom of a noise level from a whole recording."""
_DECAY_BLOCKS = 20
_MIN_DECAY_BLOCKS = 6
_DECAY_FLOORS = 5.0
"""RMS over noise to which a decay is fitted."""


@dataclass(frozen=True)
class Estimate:
    """A value with its standard error and degrees of freedom."""

    value: float
    deviation: float
    dof: float

    @property
    def half(self) -> float:
        """Half width of the 95 % interval."""
        return float(student(self.dof)) * self.deviation


def _mean(values: np.ndarray) -> Estimate:
    ones, mean = np.ones((len(values), 1)), float(values.mean())
    covariance, dof = sandwich(ones, values - mean)
    return Estimate(mean, math.sqrt(float(covariance[0, 0])), float(dof[0]))


class _Fit:
    """Fit of a constant and of tones to a steady signal, with other lines of its spectrum and their modulation.

    A line beyond the known tones, such as free vibration, is fitted with a slowly varying amplitude, so that it does
    not count as noise. The variation of the constant or of a known tone, such as the beat with a free vibration of
    almost that frequency, is part of its variance: another stretch of the signal has another mean or amplitude.
    """

    def __init__(self, values: np.ndarray, tones: np.ndarray) -> None:
        """Fit tones of given angles [cycles], shape (n, k), to values, shape (n,)."""
        n = len(values)
        span, known = np.linspace(-1.0, 1.0, n), tones.shape[1] + 1
        # Periods per record, angle [cycles] and highest degree of modulation of each tone; the constant comes first.
        lines = [(0.0, np.zeros(n), 0), *((abs(float(turn[-1] - turn[0])), turn, 0) for turn in tones.T)]
        matrix = np.column_stack([np.ones(n), *(wave for turn in tones.T for wave in _waves(turn))])
        drifts: list[tuple[int, int, int]] = []  # column of a known line, column of its variation, degree
        while True:
            parts = solve_normal(matrix.T @ matrix, matrix.T @ values)
            residual = values - matrix @ parts
            place = _find_line(residual)
            if place is None or matrix.shape[1] > 2 * known + 4 * _MAX_LINES:
                break
            near = [k for k, (line, _, _) in enumerate(lines) if abs(line - place) < 2.0]
            if near:
                line, turn, degree = lines[near[0]]
                degrees = (degree + 1, degree + 2)
                lines[near[0]] = line, turn, degree + 2
            else:
                turn, degrees = place / n * np.arange(n), (0, 1, 2)
                lines.append((place, turn, 2))
            shapes = [np.polynomial.legendre.Legendre.basis(degree)(span) for degree in degrees]
            waves = _waves(turn) if turn.any() else (np.ones(n),)
            if near and near[0] < known:
                first = max(2 * near[0] - 1, 0)
                places = [(first + k, degree) for degree in degrees for k in range(len(waves))]
                drifts += [(of, matrix.shape[1] + k, degree) for k, (of, degree) in enumerate(places)]
            matrix = np.column_stack([matrix, *(shape * wave for shape in shapes for wave in waves)])
        self.parts = parts
        self.covariance, self.dof = sandwich(matrix, residual)
        for of, column, degree in drifts:
            self.covariance[of, of] += parts[column] ** 2 / (2 * degree + 1)

    def constant(self) -> Estimate:
        """Return the constant."""
        return Estimate(float(self.parts[0]), math.sqrt(float(self.covariance[0, 0])), float(self.dof[0]))


def _waves(turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.cos(2.0 * math.pi * turns), np.sin(2.0 * math.pi * turns)


def _find_line(residual: np.ndarray) -> float | None:
    """Return the place of the most distinct line of a spectrum [periods per record]; None without one."""
    from scipy.ndimage import median_filter

    lines = power(residual, periodic_hann(len(residual)))
    ratios = lines / np.maximum(median_filter(lines, size=_NEIGHBOURS, mode="mirror"), 1e-300)
    k = int(np.argmax(ratios[: len(ratios) // 2]))
    if not ratios[k] > _MIN_LINE_RATIO:
        return None
    return k + parabola_top(*np.log(lines[k - 1 : k + 2]))[0] if k > 1 else 0.0


def steady(values: np.ndarray, turns: np.ndarray | None, rate_hz: float, unit: str) -> dict[tuple[str, str], Estimate]:
    """Return the statistics of a steady signal, by quantity and unit.

    Args:
        values: Signal, shape (n,), n at least `MIN_STEADY_ROWS`.
        turns: Angle of the shaft [revolutions], shape (n,); None if it is unknown.
        rate_hz: Sample rate [Hz].
        unit: Unit of the signal.
    """
    found = _tones(values, turns, rate_hz, unit)
    if (spread := values - values.mean()).any():
        n = -(-len(values) // _MAX_FIT_ROWS)
        turning = turns is not None and abs(turns[-1] - turns[0]) > _MIN_TURNS
        orders = np.arange(1, 5) if turning else np.empty(0)
        angles = np.outer(block_means(spread if turns is None else turns, n), orders)
        square = _Fit(block_means(spread**2, n), angles).constant()
        rms = math.sqrt(max(square.value, 0.0))
        if rms > 0.0:
            found["RMS", unit] = Estimate(rms, square.deviation / (2.0 * rms), square.dof)
        peaks = np.array([np.abs(block).max() for block in np.array_split(spread, 64)])
        found["peak", unit] = Estimate(float(peaks.max()), float(peaks.std(ddof=1)), 63.0)
    levels = np.median(segment_spectra(values), axis=1) / math.log(2.0)
    if len(levels) >= _MIN_SEGMENTS and levels.min() > 0.0:
        level = _mean(np.log(levels))
        size = math.sqrt(math.exp(level.value) / (0.5 * rate_hz))
        found["noise", f"{unit}/√Hz"] = Estimate(size, 0.5 * size * level.deviation, level.dof)
    return found


def _tones(values: np.ndarray, turns: np.ndarray | None, rate_hz: float, unit: str) -> dict[tuple[str, str], Estimate]:
    """Return the mean, amplitudes of 1X, 2X and mains hum, and the phase of 1X."""
    n = -(-len(values) // _MAX_FIT_ROWS)
    length_s, rows = len(values) / rate_hz, block_means(values, n)
    speed_hz = 0.0 if turns is None else abs(float(turns[-1] - turns[0])) / length_s
    tones: dict[str, tuple[float, np.ndarray]] = {}
    if turns is not None and speed_hz * length_s > _MIN_TURNS:
        tones = {f"{order}X": (order * speed_hz, order * block_means(turns, n)) for order in (1, 2)}
    for hum in HUM_HZ:
        if all(abs(hum - order * speed_hz) * length_s > _MIN_TURNS for order in range(9)):
            tones[f"{hum:g} Hz"] = hum, hum * (np.arange(len(rows)) + 0.5) * n / rate_hz
    tones = {name: tone for name, tone in tones.items() if tone[0] < 0.4 * rate_hz / n}
    fit = _Fit(rows, np.column_stack([angle for _, angle in tones.values()]) if tones else np.empty((len(rows), 0)))
    found = {("mean", unit): fit.constant()}
    for place, (name, (frequency, _)) in enumerate(tones.items()):
        pair = slice(2 * place + 1, 2 * place + 3)
        gain = float(np.sinc(frequency * n / rate_hz))
        cosine, sine = fit.parts[pair] / gain
        size = math.hypot(cosine, sine)
        if not size > 0.0:
            continue
        along, across = np.array([cosine, sine]) / size, np.array([-sine, cosine]) / size
        radial, tangential = (
            math.sqrt(float(axis @ fit.covariance[pair, pair] @ axis)) / gain for axis in (along, across)
        )
        dof = float(fit.dof[pair].min())
        found[name, unit] = Estimate(size, radial, dof)
        if name == "1X" and size > _MIN_AMPLITUDE * tangential:
            degrees = math.degrees(math.atan2(-sine, cosine))
            found["1X phase", "°"] = Estimate(degrees, math.degrees(tangential / size), dof)
    return found


def transient(
    variants: Sequence[np.ndarray], noise: float, colour: float, unit: str
) -> dict[tuple[str, str], Estimate]:
    """Return the statistics of a signal that occurs once, by quantity and unit.

    Args:
        variants: Signal with `_EDGE_ROWS` further rows at both ends, shape (n,), and equally valid versions of it.
        noise: Standard deviation of the noise.
        colour: Power density of the noise at low frequencies over that of white noise of equal variance.
        unit: Unit of the signal.
    """
    n = len(variants[0]) - 2 * _EDGE_ROWS
    versions = [values[shift : shift + n] for values in variants for shift in range(2 * _EDGE_ROWS + 1)]
    sizes = np.array([(v.mean(), v.std(), np.abs(v - v.mean()).max()) for v in versions])
    own = sizes[_EDGE_ROWS]
    jitter = np.abs(sizes - own).max(axis=0)
    error = noise * np.array([math.sqrt(colour / n), math.sqrt(colour / n), 1.0])
    deviations = np.hypot(error, jitter)
    return {
        (name, unit): Estimate(float(value), float(deviation), _KNOWN_DOF)
        for name, value, deviation in zip(("mean", "RMS", "peak"), own, deviations, strict=True)
    }


def widen(values: np.ndarray, begin: int, end: int) -> np.ndarray:
    """Return rows with `_EDGE_ROWS` further ones at both ends, which repeat the last ones where a signal ends."""
    return values[np.clip(np.arange(begin - _EDGE_ROWS, end + _EDGE_ROWS), 0, len(values) - 1)]


def rotation(angle: np.ndarray, rate_hz: float) -> Estimate:
    """Return the mean frequency of an unwrapped angle [rad], shape (n,)."""
    n = len(angle)
    matrix = np.column_stack([np.arange(n) - 0.5 * (n - 1), np.ones(n)])
    parts = solve(matrix, angle)
    covariance, dof = sandwich(matrix, angle - matrix @ parts)
    scale = rate_hz / (2.0 * math.pi)
    return Estimate(float(parts[0]) * scale, math.sqrt(float(covariance[0, 0])) * scale, float(dof[0]))


def decay_rate(values: np.ndarray, noise: float, rate_hz: float) -> Estimate | None:
    """Return the rate at which the RMS of a signal about its end value decays [1/s]; None if it does not."""
    rows = len(values) // _DECAY_BLOCKS
    if rows < 2:
        return None
    sizes = np.sqrt(block_means((values - values[-2 * rows :].mean()) ** 2, rows))
    loud = int(np.argmin(np.append(sizes > _DECAY_FLOORS * noise, False)))
    if loud < _MIN_DECAY_BLOCKS:
        return None
    times = np.arange(loud) * rows / rate_hz
    matrix = np.column_stack([times - times.mean(), np.ones(loud)])
    parts = solve(matrix, np.log(sizes[:loud]))
    residual = np.log(sizes[:loud]) - matrix @ parts
    deviation = math.sqrt(float(residual @ residual) / (loud - 2) / float(matrix[:, 0] @ matrix[:, 0]))
    return Estimate(-float(parts[0]), deviation, loud - 2.0) if -parts[0] > 3.0 * deviation else None
