"""The sine fit of IEEE 1057 with four parameters, and what of a record is neither the sine nor its offset.

Definitions are those of IEEE Std 1057-2017 as papers and tutorials give them; the standard itself was not at hand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from replays.estimate.intervals import chi2_mean_ends
from replays.estimate.least_squares import inverse_square, solve
from replays.estimate.spectra import parabola_top, periodic_hann, power, spectrum

HARMONICS = 10
"""The highest harmonic that counts for the total distortion."""
_PURE = 3e-5
"""Rest of a formula over its amplitude up to which it is a sine: a fitted clock bends it by 1e-6 and more."""
_ROUNDS = 20
_SAME_TURNS = 1.6e-13
"""Change of a phase over all rows that is rounding [cycles]."""
_NEIGHBOURS = 17
"""Lines by which the noise at a line is known, to a third."""


@dataclass(frozen=True)
class SineFit:
    """A sine in a record: offset + amplitude cos(2 pi f t + phase).

    Attributes:
        frequency: [cycles a sample], and its standard deviation.
        amplitude: [unit], and its standard deviation.
        residual: What is left, shape (n,).
    """

    frequency: tuple[float, float]
    amplitude: tuple[float, float]
    residual: np.ndarray

    @property
    def nad(self) -> float:
        """Noise and distortion, rms [unit]."""
        return math.sqrt(float(self.residual @ self.residual) / (len(self.residual) - 4))


def tone_columns(n: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return cosine and sine of each frequency [cycles a row] at rows, and a constant, shape (n, 2 frequencies + 1)."""
    phases = 2.0 * math.pi * np.outer(n, turns)
    return np.column_stack([np.cos(phases), np.sin(phases), np.ones(len(n))])


def fit_tones(
    n: np.ndarray, values: np.ndarray, turns: np.ndarray, settled: float = _SAME_TURNS
) -> tuple[np.ndarray, ...]:
    """Refine the frequencies of tones in a signal by Gauss and Newton's steps.

    Args:
        n: Numbers of the rows, about 0, shape (n,).
        values: The signal, shape (n,).
        turns: Frequencies near which the tones are [cycles a row], shape (k,).
        settled: Change of the phase over all rows by a step that is the last [cycles].

    Returns:
        Frequencies [cycles a row], shape (k,); cosine parts, sine parts and the constant, shape (2 k + 1,); slopes by
        frequency and by part, shape (n, 3 k + 1); and what is left, shape (n,).
    """
    k, moved, rounds = len(turns), np.full(len(turns), np.inf), 0
    while True:
        basis = tone_columns(n, turns)
        parts = solve(basis, values)
        slopes = 2.0 * math.pi * n[:, None] * (basis[:, :k] * parts[k : 2 * k] - basis[:, k : 2 * k] * parts[:k])
        matrix, residual = np.column_stack([slopes, basis]), values - basis @ parts
        if rounds == _ROUNDS or np.abs(moved).max() * len(n) < settled:
            return turns, parts, matrix, residual
        moved = solve(matrix, residual)[:k]
        turns, rounds = turns + moved, rounds + 1


def fit_sine(values: np.ndarray) -> SineFit:
    """Fit a sine with four parameters to values, shape (n,)."""
    n = np.arange(len(values)) - 0.5 * (len(values) - 1)
    turns, (cosine, sine, _), matrix, residual = fit_tones(n, values, np.array([_peak(values)]), _SAME_TURNS)
    spread = np.sqrt(np.diag(inverse_square(matrix)) * float(residual @ residual) / (len(n) - 4))
    return SineFit(
        (float(turns[0]), float(spread[0])), (math.hypot(cosine, sine), float(max(spread[1], spread[2]))), residual
    )


def _peak(values: np.ndarray) -> float:
    """Frequency of the largest line [cycles a sample]: with a Hann window, between two lines as the window has it."""
    lines = np.abs(spectrum((values - values.mean()) * periodic_hann(len(values))))
    k = int(np.argmax(lines[1:-1])) + 1
    side = 1 if lines[k + 1] > lines[k - 1] else -1
    ratio = lines[k + side] / lines[k] if lines[k] else 0.0
    return (k + side * (2.0 * ratio - 1.0) / (1.0 + ratio)) / len(values)


def is_sine(values: np.ndarray, noise: float) -> bool:
    """Whether a signal is a sine, and what else is in it is no more than noise of some rms [unit]."""
    spread = float(np.var(values))
    if len(values) < 64 or not spread > 0.0:
        return False
    fit = fit_sine(values)
    pure = fit.nad < max(noise, _PURE * fit.amplitude[0])
    return pure and fit.amplitude[0] > fit.nad and 2.0 / len(values) < fit.frequency[0] < 0.49


@dataclass(frozen=True)
class Quality:
    """What a sine record tells of a converter, each with its 95 % interval: value, low, high.

    Attributes:
        sinad_db: Sine over noise and distortion.
        enob: Effective bits of that ratio, (SINAD - 1.76) / 6.02.
        thd_db: Harmonics 2 to 10 over the sine; folded ones are counted where they fall.
        sfdr_db: Sine over the largest line besides it.
    """

    sinad_db: tuple[float, float, float]
    enob: tuple[float, float, float]
    thd_db: tuple[float, float, float]
    sfdr_db: tuple[float, float, float]


def quality(fit: SineFit) -> Quality:
    """Judge a converter by a sine.

    Intervals: SINAD by chi squared, with the degrees of freedom of the residual's spectrum; THD and SFDR by the noise
    around each harmonic, or line (delta method, with none the noise's own).
    """
    n, amplitude, nad = len(fit.residual), fit.amplitude[0], fit.nad
    ratio = 20.0 * math.log10(amplitude / math.sqrt(2.0) / nad)
    rows, lines = np.arange(n), power(fit.residual) * (2.0 / n)
    floor = _noise_floor(fit.residual)
    # A line of noise spreads as its own power, and one that stands out by twice the product of its power and the noise.
    spread = max(float(floor @ (2.0 * lines - floor)), 0.5 * float(floor @ floor))
    freedom = (1.0 - 4.0 / n) * 2.0 * float(lines.sum()) ** 2 / spread
    ends = [10.0 * math.log10(end) for end in chi2_mean_ends(freedom)]
    sinad = (ratio, ratio + ends[0], ratio + ends[1])
    enob = ((sinad[0] - 1.76) / 6.02, (sinad[1] - 1.76) / 6.02, (sinad[2] - 1.76) / 6.02)
    distortion, variance = 0.0, 0.0
    for harmonic in range(2, HARMONICS + 1):
        folded = abs((harmonic * fit.frequency[0] + 0.5) % 1.0 - 0.5)
        if not 2.0 / n < folded < 0.5 - 2.0 / n or abs(folded - fit.frequency[0]) < 2.0 / n:
            continue
        phase = 2.0 * math.pi * folded * rows
        parts = 2.0 / n * np.array([np.cos(phase) @ fit.residual, np.sin(phase) @ fit.residual])
        # Variance of one part of a line's amplitude.
        line, each = float(floor[round(folded * n)]), float(parts @ parts)
        distortion, variance = distortion + each - 2.0 * line, variance + 4.0 * line * each + 4.0 * line**2
    thd = decibels(distortion / amplitude**2, 1.96 * math.sqrt(variance) / amplitude**2)
    window = np.blackman(n)
    shown = (np.abs(spectrum(fit.residual * window)) * 2.0 / window.sum()) ** 2
    at = 3 + int(np.argmax(shown[3:])) if n > 8 else 0
    largest = _crest(shown[at - 1 : at + 2]) if n > 8 else 0.0
    # A window widens lines: of a line's noise it lets through 1.73 times as much power as none.
    wide = 1.96 * math.sqrt(4.0 * 1.73 * float(floor[at]) * largest)
    value, low, high = decibels(largest / amplitude**2, wide / amplitude**2)
    return Quality(sinad, enob, thd, (-value, -high, -low))


def _crest(powers: np.ndarray) -> float:
    """Return the power of a line between those of a window's spectrum, of which the largest is the middle one."""
    if len(powers) < 3 or not powers.min() > 0.0:
        return float(powers.max())
    return float(powers[1]) * math.exp(parabola_top(*np.log(powers))[1])


def _noise_floor(residual: np.ndarray) -> np.ndarray:
    """Return the noise's power at each line of a residual's spectrum [unit^2], by the median of its neighbours."""
    from scipy.ndimage import median_filter

    # Behind a window, lines that stand out do not leak to their neighbours.
    lines = power(residual, periodic_hann(len(residual))) * (2.0 / len(residual))
    # The median of chi squared with two degrees of freedom is ln 2 times its mean; the ends are mirrored.
    return median_filter(lines, size=_NEIGHBOURS, mode="mirror") / math.log(2.0)


def decibels(power: float, half: float) -> tuple[float, float, float]:
    """Return a ratio of powers and its half interval in dB: value, low, high."""
    least = 1e-30
    return tuple(10.0 * math.log10(max(least, each)) for each in (power, power - half, power + half))  # type: ignore[return-value]
