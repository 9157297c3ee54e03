"""Four-parameter sine fit of IEEE 1057, and the noise and distortion of the record.

Definitions follow papers and tutorials on IEEE Std 1057-2017; the standard itself was not available.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from replays.estimate.intervals import chi2_mean_ends
from replays.estimate.least_squares import inverse_square, solve
from replays.estimate.spectra import parabola_top, periodic_hann, power, spectrum

HARMONICS = 10
"""Highest harmonic included in the total harmonic distortion."""
_MAX_SINE_RESIDUAL = 3e-5
"""Largest residual of a sine over its amplitude for a formula; a fitted clock deforms it by 1e-6 and more."""
_MAX_ROUNDS = 20
_PHASE_ROUNDING = 1.6e-13
"""Change of a phase over all rows at the level of rounding errors [cycles]."""
_NEIGHBOURS = 17
"""Number of spectral lines whose median gives the noise at a line to within a third."""


@dataclass(frozen=True)
class SineFit:
    """A sine in a record: offset + amplitude cos(2 pi f t + phase).

    Attributes:
        frequency: Frequency and its standard deviation [cycles/sample].
        amplitude: Amplitude and its standard deviation [unit].
        residual: Record minus sine, shape (n,).
    """

    frequency: tuple[float, float]
    amplitude: tuple[float, float]
    residual: np.ndarray

    @property
    def nad(self) -> float:
        """Rms of noise and distortion [unit]."""
        return math.sqrt(float(self.residual @ self.residual) / (len(self.residual) - 4))


def tone_columns(n: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return cosine and sine of each frequency [cycles/row] at rows, and a constant, shape (n, 2 frequencies + 1)."""
    phases = 2.0 * math.pi * np.outer(n, turns)
    return np.column_stack([np.cos(phases), np.sin(phases), np.ones(len(n))])


def fit_tones(
    n: np.ndarray, values: np.ndarray, turns: np.ndarray, settled: float = _PHASE_ROUNDING
) -> tuple[np.ndarray, ...]:
    """Refine the frequencies of tones in a signal by Gauss-Newton steps.

    Args:
        n: Row numbers, centred on 0, shape (n,).
        values: Signal, shape (n,).
        turns: Initial frequencies [cycles/row], shape (k,).
        settled: Change of phase over all rows below which the iteration ends [cycles].

    Returns:
        Frequencies [cycles/row], shape (k,); cosine parts, sine parts and the constant, shape (2 k + 1,); derivatives
        by frequency and by part, shape (n, 3 k + 1); and residual, shape (n,).
    """
    k, moved, rounds = len(turns), np.full(len(turns), np.inf), 0
    while True:
        basis = tone_columns(n, turns)
        parts = solve(basis, values)
        slopes = 2.0 * math.pi * n[:, None] * (basis[:, :k] * parts[k : 2 * k] - basis[:, k : 2 * k] * parts[:k])
        matrix, residual = np.column_stack([slopes, basis]), values - basis @ parts
        if rounds == _MAX_ROUNDS or np.abs(moved).max() * len(n) < settled:
            return turns, parts, matrix, residual
        moved = solve(matrix, residual)[:k]
        turns, rounds = turns + moved, rounds + 1


def fit_sine(values: np.ndarray) -> SineFit:
    """Fit a four-parameter sine to values, shape (n,)."""
    n = np.arange(len(values)) - 0.5 * (len(values) - 1)
    turns, (cosine, sine, _), matrix, residual = fit_tones(n, values, np.array([_peak(values)]), _PHASE_ROUNDING)
    spread = np.sqrt(np.diag(inverse_square(matrix)) * float(residual @ residual) / (len(n) - 4))
    return SineFit(
        (float(turns[0]), float(spread[0])), (math.hypot(cosine, sine), float(max(spread[1], spread[2]))), residual
    )


def _peak(values: np.ndarray) -> float:
    """Return the frequency of the largest line [cycles/sample], interpolated between two lines with a Hann window."""
    lines = np.abs(spectrum((values - values.mean()) * periodic_hann(len(values))))
    k = int(np.argmax(lines[1:-1])) + 1
    side = 1 if lines[k + 1] > lines[k - 1] else -1
    ratio = lines[k + side] / lines[k] if lines[k] else 0.0
    return (k + side * (2.0 * ratio - 1.0) / (1.0 + ratio)) / len(values)


def is_sine(values: np.ndarray, noise: float) -> bool:
    """Return whether a signal is a sine plus noise of at most the given rms [unit]."""
    spread = float(np.var(values))
    if len(values) < 64 or not spread > 0.0:
        return False
    fit = fit_sine(values)
    pure = fit.nad < max(noise, _MAX_SINE_RESIDUAL * fit.amplitude[0])
    return pure and fit.amplitude[0] > fit.nad and 2.0 / len(values) < fit.frequency[0] < 0.49


@dataclass(frozen=True)
class Quality:
    """Quality of a converter from a sine record, each with its 95 % interval: value, low, high.

    Attributes:
        sinad_db: Ratio of the sine to noise and distortion.
        enob: Effective number of bits, (SINAD - 1.76) / 6.02.
        thd_db: Ratio of harmonics 2 to 10, including aliased ones, to the sine.
        sfdr_db: Ratio of the sine to the largest other line.
    """

    sinad_db: tuple[float, float, float]
    enob: tuple[float, float, float]
    thd_db: tuple[float, float, float]
    sfdr_db: tuple[float, float, float]


def quality(fit: SineFit) -> Quality:
    """Compute the quality of a converter from a sine fit.

    The interval of SINAD is chi squared, with the degrees of freedom of the residual's spectrum. Those of THD and SFDR
    follow from the noise around each harmonic or line by the delta method; without one, from the noise itself.
    """
    n, amplitude, nad = len(fit.residual), fit.amplitude[0], fit.nad
    ratio = 20.0 * math.log10(amplitude / math.sqrt(2.0) / nad)
    rows, lines = np.arange(n), power(fit.residual) * (2.0 / n)
    floor = _noise_floor(fit.residual)
    # The power of a noise line has its own value as spread; a distinct line adds twice its product with the noise.
    spread = max(float(floor @ (2.0 * lines - floor)), 0.5 * float(floor @ floor))
    dof = (1.0 - 4.0 / n) * 2.0 * float(lines.sum()) ** 2 / spread
    ends = [10.0 * math.log10(end) for end in chi2_mean_ends(dof)]
    sinad = (ratio, ratio + ends[0], ratio + ends[1])
    enob = ((sinad[0] - 1.76) / 6.02, (sinad[1] - 1.76) / 6.02, (sinad[2] - 1.76) / 6.02)
    distortion, variance = 0.0, 0.0
    for harmonic in range(2, HARMONICS + 1):
        folded = abs((harmonic * fit.frequency[0] + 0.5) % 1.0 - 0.5)
        if not 2.0 / n < folded < 0.5 - 2.0 / n or abs(folded - fit.frequency[0]) < 2.0 / n:
            continue
        phase = 2.0 * math.pi * folded * rows
        parts = 2.0 / n * np.array([np.cos(phase) @ fit.residual, np.sin(phase) @ fit.residual])
        # Variance of one component of a line's amplitude.
        line, each = float(floor[round(folded * n)]), float(parts @ parts)
        distortion, variance = distortion + each - 2.0 * line, variance + 4.0 * line * each + 4.0 * line**2
    thd = decibels(distortion / amplitude**2, 1.96 * math.sqrt(variance) / amplitude**2)
    window = np.blackman(n)
    shown = (np.abs(spectrum(fit.residual * window)) * 2.0 / window.sum()) ** 2
    at = 3 + int(np.argmax(shown[3:])) if n > 8 else 0
    largest = _crest(shown[at - 1 : at + 2]) if n > 8 else 0.0
    # The window widens lines: the noise of a line contains 1.73 times the power without a window.
    wide = 1.96 * math.sqrt(4.0 * 1.73 * float(floor[at]) * largest)
    value, low, high = decibels(largest / amplitude**2, wide / amplitude**2)
    return Quality(sinad, enob, thd, (-value, -high, -low))


def _crest(powers: np.ndarray) -> float:
    """Return the peak power of a line from three lines of a windowed spectrum, the largest in the middle."""
    if len(powers) < 3 or not powers.min() > 0.0:
        return float(powers.max())
    return float(powers[1]) * math.exp(parabola_top(*np.log(powers))[1])


def _noise_floor(residual: np.ndarray) -> np.ndarray:
    """Return the noise power at each line of a residual's spectrum [unit^2], as the median of neighbouring lines."""
    from scipy.ndimage import median_filter

    # With a window, distinct lines do not leak into their neighbours.
    lines = power(residual, periodic_hann(len(residual))) * (2.0 / len(residual))
    # The median of chi squared with two degrees of freedom is ln 2 times its mean; the ends are mirrored.
    return median_filter(lines, size=_NEIGHBOURS, mode="mirror") / math.log(2.0)


def decibels(power: float, half: float) -> tuple[float, float, float]:
    """Return a power ratio and its interval in dB: value, low, high."""
    floor = 1e-30
    return tuple(10.0 * math.log10(max(floor, each)) for each in (power, power - half, power + half))  # type: ignore[return-value]
