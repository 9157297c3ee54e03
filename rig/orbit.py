"""Figures of an orbit, read off samples of it: how often it goes round, in which sense, and its two-sided spectrum.

One definition of each, for recordings and simulations, predictions and live views. An orbit is z = x + j y; forward is
with the spin, from x to y, and positive; backward is negative. Lengths keep the unit of x and y.
"""

from __future__ import annotations

import math

import numpy as np

SPECTRUM_HZ = 200.0
"""Spectra are shown up to this frequency, to both sides: the rig whirls below 130 Hz."""
_LAG_S = 1e-3
_TURN_SAMPLES = 8


def phase(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Angle of x + j y about the origin, without jumps [rad], shape (n,)."""
    return np.unwrap(np.arctan2(y, x))


def whirl_frequency(times_s: np.ndarray, x: np.ndarray, y: np.ndarray, *, about: complex | None = None) -> float:
    """Slope of the phase of x + j y about a centre [Hz]; forward is positive.

    Unlike the bin of a spectrum this has no resolution limit; the orbit must go round the centre.

    Args:
        times_s: Times [s], shape (n,).
        x: Horizontal, shape (n,).
        y: Vertical, shape (n,).
        about: The centre, in the unit of x; None: the orbit's own mean.

    Example:
        >>> times_s = np.arange(2000) / 20_000.0
        >>> angle = -2.0 * np.pi * 81.7 * times_s
        >>> round(whirl_frequency(times_s, np.cos(angle), np.sin(angle)), 1)  # backward
        -81.7
    """
    centre = complex(x.mean(), y.mean()) if about is None else about
    angle = phase(x - centre.real, y - centre.imag)
    return float(np.polyfit(times_s - times_s[0], angle, 1)[0] / (2.0 * math.pi))


def mean_rotation(x: np.ndarray, y: np.ndarray, rate_hz: float) -> float:
    """Mean rotation of x + j y about its mean [Hz], weighted by the square of the radius; 0 of less than 2 ms.

    For an orbit that may be as small as the probes' noise, where a phase would jump. The phase is advanced over 1 ms:
    short against any whirl of the rig (unambiguous to +-500 Hz), long against the correlation time of that noise, which
    would otherwise pull the slope of a small orbit towards zero.

    Args:
        x: Horizontal, shape (n,).
        y: Vertical, shape (n,).
        rate_hz: Samples per second [Hz].
    """
    lag = max(1, round(_LAG_S * rate_hz))
    if len(x) < 2 * lag:
        return 0.0
    turning = _centred(x, y)
    advance = np.vdot(turning[:-lag], turning[lag:])
    return math.atan2(advance.imag, advance.real) * rate_hz / (2.0 * math.pi * lag)


def rms_radius(x: np.ndarray, y: np.ndarray) -> float:
    """Root mean square distance of the orbit from its own mean, in the unit of x."""
    return float(np.sqrt(np.mean(np.abs(_centred(x, y)) ** 2)))


def full_spectrum(
    x: np.ndarray, y: np.ndarray, rate_hz: float, *, lines: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Two-sided spectrum: the amplitude of each circular component of x + j y about its centre.

    Hann window over all samples, scaled so that a steady whirl of radius r has its peak at r.

    Args:
        x: Horizontal, shape (n,).
        y: Vertical, shape (n,).
        rate_hz: Sample rate [Hz].
        lines: Number of lines, at least n: the samples are padded with zeros, so that lines stand closer. None: n.

    Returns:
        Frequencies [Hz], ascending, and amplitudes in the unit of x, each shape (lines,).

    Example:
        >>> angle = -2.0 * np.pi * 80.0 * np.arange(2000) / 20_000.0
        >>> frequency, amplitude = full_spectrum(0.9 * np.cos(angle), 0.9 * np.sin(angle), 20_000.0)
        >>> f"{amplitude.max():.2f} at {frequency[amplitude.argmax()]:.0f} Hz"
        '0.90 at -80 Hz'
    """
    orbit = x + 1j * y
    # Without its zeros at both ends, which would leave two samples out.
    window = np.hanning(len(orbit) + 2)[1:-1]
    total = window.sum()
    # The plain mean of an unfinished revolution is not zero: taking it off would put a line at 0 Hz.
    centre = np.dot(window, orbit) / total
    count = len(orbit) if lines is None else lines
    amplitude = np.abs(np.fft.fftshift(np.fft.fft((orbit - centre) * window, n=count))) / total
    return np.fft.fftshift(np.fft.fftfreq(count, 1.0 / rate_hz)), amplitude


def waterfall(
    times_s: np.ndarray, x: np.ndarray, y: np.ndarray, rate_hz: float, *, window_s: float = 0.5, hop_s: float = 0.1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Full spectra over time, up to `SPECTRUM_HZ`.

    Args:
        times_s: Times [s], shape (n,).
        x: Horizontal, shape (n,).
        y: Vertical, shape (n,).
        rate_hz: Sample rate [Hz].
        window_s: Length of a window [s].
        hop_s: From one window to the next [s].

    Returns:
        Times of the windows' centres [s], shape (t,); frequencies [Hz], shape (f,); amplitudes in the unit of x, shape
        (t, f).

    Example:
        >>> times_s = np.arange(4000) / 2000.0
        >>> angle = 2.0 * np.pi * 10.0 * times_s * times_s  # from standstill to 40 Hz, forward
        >>> at_s, frequency, amplitude = waterfall(times_s, np.cos(angle), np.sin(angle), 2000.0)
        >>> [f"{at:.2f} s: {frequency[row.argmax()]:.0f} Hz" for at, row in zip(at_s, amplitude)][::7]
        ['0.25 s: 4 Hz', '0.95 s: 18 Hz', '1.65 s: 32 Hz']
    """
    size, hop = (max(1, round(each * rate_hz)) for each in (window_s, hop_s))
    starts = range(0, max(1, len(x) - size + 1), hop)
    spectra = [full_spectrum(x[s : s + size], y[s : s + size], rate_hz) for s in starts]
    frequency = spectra[0][0]
    near = np.abs(frequency) <= SPECTRUM_HZ
    centres = np.array([times_s[min(s + size // 2, len(x) - 1)] for s in starts])
    return centres, frequency[near], np.array([amplitude[near] for _, amplitude in spectra])


def synchronous(times_s: np.ndarray, values: np.ndarray, edges_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What of a signal goes once around with the shaft, turn by turn: what a Bode plot of a run-up shows.

    Args:
        times_s: Times [s], ascending, shape (n,).
        values: A signal, such as one probe, shape (n,).
        edges_s: Keyphasor edges [s], ascending, shape (edges,).

    Returns:
        Speed of each turn between two edges [Hz], and as one complex number the signal's amplitude in it (`np.abs`, in
        the unit of the values) with its phase from the edge on (`np.angle` [rad]; negative lags), each shape (turns,);
        turns with fewer than 8 samples are left out.

    Example:
        >>> times_s = np.arange(4000) / 2000.0
        >>> lags = 0.3 * np.cos(2.0 * np.pi * 8.0 * times_s - 0.5)
        >>> speed_hz, vector = synchronous(times_s, lags, np.arange(0.0, 2.0, 0.125))
        >>> f"{speed_hz[0]:.1f} Hz: {abs(vector[0]):.3f} at {np.angle(vector[0]):.3f} rad"
        '8.0 Hz: 0.300 at -0.500 rad'
    """
    places = np.searchsorted(times_s, edges_s)
    speeds, vectors = [], []
    for first, last, begin_s, end_s in zip(places, places[1:], edges_s, edges_s[1:], strict=False):
        if last - first >= _TURN_SAMPLES:
            turns = (times_s[first:last] - begin_s) / (end_s - begin_s)
            turn = values[first:last] - values[first:last].mean()
            speeds.append(1.0 / (end_s - begin_s))
            vectors.append(2.0 * np.mean(turn * np.exp(-2j * np.pi * turns)))
    return np.array(speeds), np.array(vectors, dtype=complex)


def _centred(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """X + j y about its mean, complex, shape (n,)."""
    orbit = x + 1j * y
    return orbit - orbit.mean()
