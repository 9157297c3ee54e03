"""Orbit analysis: rotation frequency and sense, radius, two-sided spectrum, and 1X vector.

One definition of each serves recordings, simulations, predictions and live views. An orbit is z = x + j y; forward is
with the spin, from x to y, and positive; backward is negative. Lengths keep the unit of x and y. Functions take samples
first, then their timing: `rate_hz`, `times_s`, `edges_s`, in this order.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from rig.base.errors import InputError, Words

SPECTRUM_HZ = 200.0
"""Frequency limit of displayed spectra, both sides [Hz]; the rig whirls below 130 Hz."""
PULSE_LEVEL = 0.5
"""Keyphasor signal, 0 to 1, at whose rise a pulse begins."""
_LAG_S = 1e-3
_MIN_TURN_SAMPLES = 8
_MAX_TURN_GAP = 0.25
"""Largest fraction of a revolution without samples for which a fit is accepted."""
_INSTANTS = ("times_s", "edges_s")


def phase(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the unwrapped angle of x + j y about the origin [rad], shape (n,)."""
    return np.unwrap(np.arctan2(y, x))


def whirl_frequency(x: ArrayLike, y: ArrayLike, times_s: ArrayLike, *, about: complex | None = None) -> float:
    """Return the mean rotation frequency of x + j y about a centre, from the slope of its phase [Hz]; forward positive.

    Unlike a line of a spectrum it has no resolution limit; the orbit must enclose the centre.

    Args:
        x: Horizontal, shape (n,).
        y: Vertical, shape (n,).
        times_s: Times [s], ascending, shape (n,).
        about: Centre, in the unit of x; None for the orbit's mean.

    Raises:
        InputError: The arguments are not rows of numbers of equal length with at least two samples.

    Example:
        >>> times_s = np.arange(2000) / 20_000.0
        >>> angle = -2.0 * np.pi * 81.7 * times_s
        >>> round(whirl_frequency(np.cos(angle), np.sin(angle), times_s), 1)  # backward
        -81.7
    """
    x, y, times_s = _check_rows(x=x, y=y, times_s=times_s, at_least=2)
    centre = complex(x.mean(), y.mean()) if about is None else about
    angle = phase(x - centre.real, y - centre.imag)
    return float(np.polyfit(times_s - times_s[0], angle, 1)[0] / (2.0 * math.pi))


def mean_rotation(x: np.ndarray, y: np.ndarray, rate_hz: float) -> float:
    """Return the mean rotation of x + j y about its mean [Hz], weighted by the squared radius; 0 for less than 2 ms.

    Suitable for an orbit as small as the probes' noise, where an unwrapped phase would jump. The phase advance is taken
    over 1 ms: short against any whirl of the rig (unambiguous to +-500 Hz), long against the correlation time of that
    noise, which would otherwise bias the result of a small orbit towards zero.

    Args:
        x: Horizontal, shape (n,).
        y: Vertical, shape (n,).
        rate_hz: Samples per second [Hz].
    """
    lag = max(1, round(_LAG_S * rate_hz))
    if len(x) < 2 * lag:
        return 0.0
    turning = _subtract_mean(x, y)
    advance = np.vdot(turning[:-lag], turning[lag:])
    return math.atan2(advance.imag, advance.real) * rate_hz / (2.0 * math.pi * lag)


def rms_radius(x: np.ndarray, y: np.ndarray) -> float:
    """Return the root mean square distance of the orbit from its mean, in the unit of x."""
    return float(np.sqrt(np.mean(np.abs(_subtract_mean(x, y)) ** 2)))


def full_spectrum(
    x: ArrayLike, y: ArrayLike, rate_hz: float, *, lines: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the two-sided spectrum: the amplitude of each circular component of x + j y about its centre.

    Hann window over all samples, scaled so that a steady whirl of radius r has its peak at r.

    Args:
        x: Horizontal, shape (n,).
        y: Vertical, shape (n,).
        rate_hz: Sample rate [Hz].
        lines: Number of lines, at least n; zero padding makes the lines denser. None for n.

    Returns:
        Frequencies [Hz], ascending, and amplitudes in the unit of x, each shape (lines,).

    Raises:
        InputError: The samples are not rows of numbers of equal length, or the rate or the lines are invalid.

    Example:
        >>> angle = -2.0 * np.pi * 80.0 * np.arange(2000) / 20_000.0
        >>> frequency, amplitude = full_spectrum(0.9 * np.cos(angle), 0.9 * np.sin(angle), 20_000.0)
        >>> f"{amplitude.max():.2f} at {frequency[amplitude.argmax()]:.0f} Hz"
        '0.90 at -80 Hz'
    """
    x, y = _check_rows(x=x, y=y)
    _check_positive(rate_hz=rate_hz)
    count = len(x) if lines is None else lines
    if not isinstance(count, int | np.integer) or count < len(x):
        raise InputError("lines", f"a whole number of at least the {len(x)} samples", lines)
    orbit = x + 1j * y
    # Omit the zeros at both ends of the window, which would discard two samples.
    window = np.hanning(len(orbit) + 2)[1:-1]
    total = window.sum()
    # The unweighted mean of an incomplete revolution is not its centre; subtracting it would add a line at 0 Hz.
    centre = np.dot(window, orbit) / total
    amplitude = np.abs(np.fft.fftshift(np.fft.fft((orbit - centre) * window, n=count))) / total
    return np.fft.fftshift(np.fft.fftfreq(count, 1.0 / rate_hz)), amplitude


def waterfall(
    x: ArrayLike,
    y: ArrayLike,
    rate_hz: float,
    times_s: ArrayLike,
    *,
    window_s: float = 0.5,
    hop_s: float = 0.1,
    limit_hz: float = SPECTRUM_HZ,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return full spectra over time.

    Args:
        x: Horizontal, shape (n,).
        y: Vertical, shape (n,).
        rate_hz: Sample rate [Hz].
        times_s: Times [s], ascending, shape (n,).
        window_s: Length of a window [s].
        hop_s: Time between two windows [s].
        limit_hz: Largest frequency, both sides [Hz].

    Returns:
        Times of the windows' centres [s], shape (t,); frequencies [Hz], shape (f,); amplitudes in the unit of x, shape
        (t, f).

    Raises:
        InputError: As in `full_spectrum`.

    Example:
        >>> times_s = np.arange(4000) / 2000.0
        >>> angle = 2.0 * np.pi * 10.0 * times_s * times_s  # from standstill to 40 Hz, forward
        >>> at_s, frequency, amplitude = waterfall(np.cos(angle), np.sin(angle), 2000.0, times_s)
        >>> [f"{at:.2f} s: {frequency[row.argmax()]:.0f} Hz" for at, row in zip(at_s, amplitude)][::7]
        ['0.25 s: 4 Hz', '0.95 s: 18 Hz', '1.65 s: 32 Hz']
    """
    x, y, times_s = _check_rows(x=x, y=y, times_s=times_s)
    _check_positive(rate_hz=rate_hz, window_s=window_s, hop_s=hop_s, limit_hz=limit_hz)
    size, hop = (max(1, round(each * rate_hz)) for each in (window_s, hop_s))
    starts = range(0, max(1, len(x) - size + 1), hop)
    spectra = [full_spectrum(x[s : s + size], y[s : s + size], rate_hz) for s in starts]
    frequency = spectra[0][0]
    in_range = np.abs(frequency) <= limit_hz
    centres = np.array([times_s[min(s + size // 2, len(x) - 1)] for s in starts])
    return centres, frequency[in_range], np.array([amplitude[in_range] for _, amplitude in spectra])


def synchronous(
    values: ArrayLike, times_s: ArrayLike, edges_s: ArrayLike, *, order: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Return the 1X component of a signal for each revolution, as shown in a Bode plot of a run-up.

    Fitted to each revolution together with its mean, so that the number of samples need not be whole.

    Args:
        values: A signal, such as one probe, shape (n,).
        times_s: Times [s], ascending, shape (n,).
        edges_s: Keyphasor edges [s], ascending, shape (edges,).
        order: Multiple of the speed: 2 for the 2X component.

    Returns:
        Speed of each revolution between two edges [Hz], and its complex 1X amplitude: magnitude (`np.abs`, in the unit
        of the values) and phase from the edge (`np.angle` [rad]; negative lags), each shape (turns,). Revolutions
        with fewer than 8 samples (or 4 per period of the order), or with a gap of a quarter revolution, are omitted.

    Raises:
        InputError: The arguments are not rows of numbers, values and times differ in length, or the order is invalid.

    Example:
        >>> times_s = np.arange(4000) / 2000.0
        >>> lags = 1.5 + 0.3 * np.cos(2.0 * np.pi * 8.0 * times_s - 0.5)
        >>> speed_hz, vector = synchronous(lags, times_s, np.arange(0.0, 2.0, 0.125))
        >>> f"{speed_hz[0]:.1f} Hz: {abs(vector[0]):.3f} at {np.angle(vector[0]):.3f} rad"
        '8.0 Hz: 0.300 at -0.500 rad'
    """
    values, times_s = _check_rows(values=values, times_s=times_s)
    (edges_s,) = _check_rows(edges_s=edges_s, at_least=0)
    if not isinstance(order, int | np.integer) or order < 1:
        raise InputError("order", "a whole number of at least 1", order)
    turns, vectors = fit_turns(values[:, None], times_s, edges_s, (int(order),))
    return 1.0 / np.diff(edges_s)[turns], vectors[:, 1, 0]


def fit_turns(
    values: np.ndarray,
    times_s: np.ndarray,
    edges_s: np.ndarray,
    orders: tuple[int, ...] = (1,),
    *,
    revolutions: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and synchronous components of several signals for each revolution, fitted together.

    Args:
        values: Signals, shape (n, signals).
        times_s: Times [s], ascending, shape (n,).
        edges_s: Keyphasor edges [s], ascending, shape (edges,).
        orders: Multiples of the speed.
        revolutions: Angle of the shaft from the first edge [revolutions], shape (n,); None for uniform rotation within
            each revolution.

    Returns:
        Number of each revolution, that of its first edge, shape (turns,); and its complex components as of
        `synchronous`, shape (turns, 1 + orders, signals), the mean first. Revolutions are omitted as there.
    """
    places = np.searchsorted(times_s, edges_s)
    least, found = max(_MIN_TURN_SAMPLES, 4 * max(orders)), list[int]()
    vectors = []
    for turn, (first, last) in enumerate(pairwise(places)):
        if revolutions is None:
            turns = (times_s[first:last] - edges_s[turn]) / (edges_s[turn + 1] - edges_s[turn])
        else:
            turns = revolutions[first:last] - turn
        if len(turns) >= least and np.diff(turns, append=turns[0] + 1.0).max() < _MAX_TURN_GAP:
            angles = 2.0 * math.pi * np.outer(turns, orders)
            parts = np.concatenate([np.cos(angles), np.sin(angles), np.ones_like(angles[:, :1])], axis=1)
            fitted, *_ = np.linalg.lstsq(parts, values[first:last])
            count = len(orders)
            found.append(turn)
            vectors.append(np.concatenate([fitted[-1:], fitted[:count] - 1j * fitted[count:-1]]))
    shape = (len(found), 1 + len(orders), values.shape[1])
    return np.array(found, dtype=int), np.array(vectors, dtype=complex).reshape(shape)


def find_edges(signal: np.ndarray, times_s: np.ndarray, level: float = PULSE_LEVEL) -> np.ndarray:
    """Return the times at which pulses of a signal rise through a level [s], interpolated, shape (pulses,).

    Args:
        signal: Keyphasor signal, shape (n,).
        times_s: Times [s], ascending, shape (n,).
        level: Level, in the unit of the signal.
    """
    rows = np.flatnonzero((signal[:-1] < level) & (signal[1:] >= level))
    fraction = (level - signal[rows]) / (signal[rows + 1] - signal[rows])
    return times_s[rows] + fraction * (times_s[rows + 1] - times_s[rows])


def _check_rows(*, at_least: int = 1, **arrays: ArrayLike) -> list[np.ndarray]:
    """Return finite rows of equal length as float64, each shape (n,); instants must ascend.

    Raises:
        InputError: The rows are invalid.
    """
    rows: list[np.ndarray] = []
    for name, values in arrays.items():
        try:
            row = np.asarray(values)
        except ValueError:  # lists of different lengths
            raise InputError(name, "one row of numbers", Words("rows of different lengths")) from None
        if row.ndim != 1 or row.dtype.kind not in "iuf":
            raise InputError(name, "one row of numbers", Words(f"{row.dtype} of shape {row.shape}"))
        if len(row) < at_least:
            raise InputError(name, f"a row of at least {at_least}", Words(f"{len(row)}"))
        if not np.isfinite(row).all():
            raise InputError(name, "finite numbers", Words(f"{np.sum(~np.isfinite(row))} that are not"))
        if rows and len(row) != len(rows[0]):
            raise InputError(name, f"as long as {next(iter(arrays))}, {len(rows[0])}", Words(f"{len(row)}"))
        if name in _INSTANTS and (np.diff(row) <= 0.0).any():
            raise InputError(name, "ascending", Words("instants that are not"))
        rows.append(row.astype(float, copy=False))
    return rows


def _check_positive(**numbers: float) -> None:
    """Raise an error unless each value is a number greater than 0.

    Raises:
        InputError: A value is not.
    """
    for name, value in numbers.items():
        if not isinstance(value, int | float | np.integer | np.floating) or not 0.0 < value < math.inf:
            raise InputError(name, "a number greater than 0", value)


def _subtract_mean(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return x + j y minus its mean, complex, shape (n,)."""
    orbit = x + 1j * y
    return orbit - orbit.mean()
