"""Features of a signal, and of signal pairs, used to guess its channel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from replays.estimate.runs import block_means
from replays.estimate.spectra import spectrum
from replays.recordings.formats import clock
from replays.recordings.formats.guessing import noise
from replays.recordings.formats.source import FileSignal, even_rate_hz
from rig.base.errors import InputError

_MAX_SAMPLES = 2_000_000
"""Samples evaluated at most, which bounds the time for long signals."""
_COMPARED_SAMPLES = 1 << 16
"""Samples on which two signals are compared; longer ones are averaged in blocks."""
_LEVEL_TOLERANCE, _MIN_LEVEL_FRACTION = 0.2, 0.85
"""A pulse train stays within this fraction of its range from either end for at least this fraction of its samples."""
_MIN_EDGES, _MAX_INTERVAL_CHANGE = 3, 0.3
"""Minimum number of edges of a pulse train, and limit of the relative change of their intervals."""
_MIN_PEAK, _MAX_TIME = 20.0, 0.02
"""Peak of a hammer signal over its typical deviation, and the largest fraction of time spent in pulses."""
_MAX_REBOUND, _NOISE_PEAK = 0.3, 8.0
"""Limits of a hammer signal's other side: fraction of the peak, and multiple of the typical deviation."""
_MIN_SAMPLES = 20
"""Minimum number of samples for a comparison of stamps."""
_BURST_KURTOSIS, _MIN_STEP_RATIO = 10.0, 0.1
"""Bursts of vibration: least kurtosis, and least ratio of the rms step between samples to the rms value."""
_ONSET_RATIO, _ONSET_PART = 3.0, 0.1
"""Onset of motion: multiple of the largest deviation in this first part of a signal."""
_PEAK_HALF_WIDTH = 4
"""Spectral lines evaluated on each side of a peak."""
_BLOCKS = " ▁▂▃▄▅▆▇█"


@dataclass(frozen=True)
class SignalFeatures:
    """Features of one signal.

    Attributes:
        values: Values in the file's unit; missing ones are replaced by the mean, shape (n,).
        axis: Time axis; 1 Hz if the signal has neither times nor rate (`timed` is False).
        timed: True if the file has times or a rate.
        missing: Number of missing values.
    """

    values: np.ndarray
    axis: clock.TimeAxis
    timed: bool
    missing: int

    @cached_property
    def mean(self) -> float:
        """Mean value."""
        return float(self.values.mean())

    @cached_property
    def median(self) -> float:
        """Median value."""
        return float(np.median(self.values))

    @cached_property
    def spread(self) -> float:
        """Standard deviation."""
        return float(self.values.std())

    @cached_property
    def extent(self) -> tuple[float, float]:
        """Lowest and highest value."""
        return float(self.values.min()), float(self.values.max())

    @cached_property
    def pulses(self) -> np.ndarray:
        """Rising edges of a two-level signal [s], shape (k,); empty for other signals."""
        low, high = self.extent
        reach = _LEVEL_TOLERANCE * (high - low)
        if not reach or np.mean((self.values < low + reach) | (self.values > high - reach)) < _MIN_LEVEL_FRACTION:
            return np.empty(0)
        return clock.find_crossings(self.values, self.axis, threshold=None, hysteresis=None)[0]

    @cached_property
    def edges(self) -> np.ndarray:
        """Rising edges of a regular pulse train [s], shape (k,); empty for other signals."""
        edges = self.pulses
        if len(edges) < _MIN_EDGES:
            return np.empty(0)
        apart = np.diff(edges)
        uneven = np.abs(np.diff(apart)) / apart[1:] if len(apart) > 1 else np.zeros(1)
        return edges if float(np.median(uneven)) < _MAX_INTERVAL_CHANGE else np.empty(0)

    @cached_property
    def threshold(self) -> float:
        """Level midway between the lowest and the highest value."""
        return 0.5 * sum(self.extent)

    @cached_property
    def is_hammer(self) -> bool:
        """True if the signal rests except for short, strong pulses to one side."""
        signed = self.values - self.median
        off = np.abs(signed)
        typical = float(np.median(off)) / 0.6745
        peak = float(off.max())
        if min(float(signed.max()), -float(signed.min())) > max(_MAX_REBOUND * peak, _NOISE_PEAK * typical):
            return False
        return peak > _MIN_PEAK * typical and float(np.mean(off > 0.3 * peak)) < _MAX_TIME and not len(self.edges)

    @cached_property
    def moves_in_bursts(self) -> bool:
        """True if the signal vibrates in bursts about zero, as an acceleration does at impacts."""
        off = self.values - self.mean
        steps = float(np.sqrt(np.mean(np.diff(off) ** 2))) if len(off) > 1 else 0.0
        fast = steps > _MIN_STEP_RATIO * self.spread and not len(self.pulses)
        return fast and self.kurtosis > _BURST_KURTOSIS and abs(self.mean) < 0.5 * self.spread

    @cached_property
    def kurtosis(self) -> float:
        """Fourth moment about the mean over the squared variance; 3 for a normal distribution."""
        return float(np.mean((self.values - self.mean) ** 4)) / max(self.spread, 1e-75) ** 4

    @cached_property
    def onset_s(self) -> float:
        """Time at which the signal leaves the range of its beginning [s]; infinite if it does not."""
        first = max(1, int(_ONSET_PART * len(self.values)))
        off = np.abs(self.values - float(np.median(self.values[:first])))
        late = np.flatnonzero(off > _ONSET_RATIO * off[:first].max())
        return float(self.axis.instants()[late[0]]) if len(late) and not len(self.pulses) else math.inf

    def before(self, end_s: float) -> SignalFeatures:
        """Return the features of the part before a time [s]."""
        rows = int(np.searchsorted(self.axis.instants(), end_s))
        times_s = None if self.axis.times_s is None else self.axis.times_s[:rows]
        return replace(self, values=self.values[:rows], axis=replace(self.axis, rows=rows, times_s=times_s))

    @property
    def pulse_start_s(self) -> float:
        """Time at which the signal first exceeds a tenth of its largest pulse [s]."""
        off = np.abs(self.values - self.median)
        return float(self.axis.instants()[int(np.argmax(off > 0.1 * off.max()))])

    @cached_property
    def corner_hz(self) -> float | None:
        """Corner of the signal's noise [Hz]; None if it is not visible."""
        return noise.corner_hz(self.values, self.axis.rate_hz) if self.timed and self.axis.times_s is None else None

    @cached_property
    def unevenness(self) -> float:
        """Residual of linear interpolation at even times, over that at the time stamps, rms [1].

        Above 1 the samples were taken at their stamps, below 1 at even times; 1 if the stamps are even.
        """
        if self.axis.times_s is None or len(self.values) < _MIN_SAMPLES:
            return 1.0

        def off(times: np.ndarray) -> float:
            part = (times[1:-1] - times[:-2]) / (times[2:] - times[:-2])
            between = (1.0 - part) * self.values[:-2] + part * self.values[2:]
            return float(np.sqrt(np.mean((self.values[1:-1] - between) ** 2)))

        at_stamps = off(self.axis.times_s)
        evenly = off(np.arange(len(self.values), dtype=float))
        return evenly / at_stamps if evenly and at_stamps else 1.0

    @cached_property
    def slow(self) -> np.ndarray:
        """Block means of the signal without their mean, shape (m,)."""
        whole = block_means(self.values, -(-len(self.values) // _COMPARED_SAMPLES))
        return whole - whole.mean()

    @cached_property
    def lines(self) -> np.ndarray:
        """Spectrum of `slow` with a Hann window, complex."""
        return spectrum(self.slow * np.hanning(len(self.slow)), 1 << (len(self.slow) - 1).bit_length())

    def sparkline(self, width: int) -> str:
        """Return the signal as a line of block characters, each the value farthest from the mean in its interval."""
        low, high = self.extent
        parts = np.array_split(self.values, min(width, len(self.values)))
        far = [part[np.argmax(np.abs(part - self.mean))] for part in parts]
        scale = (len(_BLOCKS) - 2) / (high - low) if high > low else 0.0
        return "".join(_BLOCKS[1 + round((float(value) - low) * scale)] for value in far)


def compute_features(signal: FileSignal) -> SignalFeatures:
    """Return the features of a signal."""
    values = signal.physical[:_MAX_SAMPLES]
    good = np.isfinite(values)
    rows = len(values)
    timed = signal.times_s is not None or signal.rate_hz is not None
    axis = clock.TimeAxis(signal.first_s, signal.rate_hz or 1.0, rows)
    if signal.times_s is not None:
        times_s = signal.times_s[:rows]
        try:
            axis = clock.make_axis(times_s, line=False, what="")
        except InputError:  # reported by the import
            axis = clock.TimeAxis(0.0, even_rate_hz(times_s) or 1.0, rows)
        values, good = axis.place_samples(values), axis.place_samples(np.where(good, 1.0, np.nan)) == 1.0
    mean = float(values[good].mean()) if good.any() else 0.0
    return SignalFeatures(np.where(good, values, mean), axis, timed, int(len(good) - good.sum()))


@dataclass(frozen=True)
class Relation:
    """Relation of two signals.

    Attributes:
        hz: Frequency of the strongest common line [Hz].
        phase_deg: Phase lead of the first signal at that frequency [degrees].
        coherence: Coherence at that frequency, 0 to 1.
        likeness: Correlation coefficient over all frequencies, -1 to 1.
        size: Ratio of the first signal's standard deviation to the second's.
    """

    hz: float
    phase_deg: float
    coherence: float
    likeness: float
    size: float

    @property
    def quadrature(self) -> bool:
        """True if the signals are in quadrature."""
        return self.coherence > 0.8 and abs(abs(self.phase_deg) - 90.0) < 30.0


def compute_relation(a: SignalFeatures, b: SignalFeatures) -> Relation | None:
    """Return the relation of two signals; None if they were not sampled together, or one is constant."""
    if len(a.values) != len(b.values) or abs(a.axis.rate_hz / b.axis.rate_hz - 1.0) > 1e-3:
        return None
    x, y = a.slow, b.slow
    norm = math.sqrt(float(x @ x) * float(y @ y))
    if len(x) < 64 or norm == 0.0:
        return None
    rows, ax, by = 1 << (len(x) - 1).bit_length(), a.lines, b.lines
    power = np.abs(ax) * np.abs(by)
    power[:3] = 0.0
    peak = int(np.argmax(power))
    near = slice(max(1, peak - _PEAK_HALF_WIDTH), peak + _PEAK_HALF_WIDTH + 1)
    cross = complex(np.sum(ax[near] * np.conj(by[near])))
    whole = math.sqrt(float(np.sum(np.abs(ax[near]) ** 2)) * float(np.sum(np.abs(by[near]) ** 2)))
    slow_hz = a.axis.rate_hz * len(x) / len(a.values)
    return Relation(
        hz=peak * slow_hz / rows, phase_deg=math.degrees(math.atan2(cross.imag, cross.real)),
        coherence=abs(cross) / whole if whole else 0.0, likeness=float(x @ y) / norm,
        size=math.sqrt(float(x @ x) / float(y @ y)),
    )  # fmt: skip
