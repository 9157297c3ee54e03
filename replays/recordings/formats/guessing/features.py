"""What the numbers of a signal look like, alone and beside another: for a guess at what it is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from replays.estimate.runs import block_means
from replays.estimate.spectra import spectrum
from replays.recordings.formats import clock
from replays.recordings.formats.guessing import noise
from replays.recordings.formats.source import FileSignal, even_rate_hz
from rig.base.errors import InputError

_MOST = 2_000_000
"""Longer signals are looked at up to here [samples]."""
_SLOW = 1 << 16
"""Samples that two signals are compared on: means of as many as it takes."""
_NEAR, _TWO_LEVELS = 0.2, 0.85
"""A pulse train is for such a part of its samples nearer than this part of its extent to one of its ends ..."""
_EDGES, _REGULAR = 3, 0.3
"""... and has at least so many edges, whose distances have at most this relative spread, or change slowly."""
_BLOW, _SELDOM = 20.0, 0.02
"""A blow is so many times what is usual, in at most so much of the time."""
_FEW = 20
"""Values of which nothing is said."""
_AROUND = 4
"""Lines of a spectrum on either side of its peak."""
_BLOCKS = " ▁▂▃▄▅▆▇█"


@dataclass(frozen=True)
class Look:
    """What the numbers of one signal look like.

    Attributes:
        values: In the file's unit, without what is missing, shape (n,).
        axis: When they were taken; of a signal without times and rate at 1 Hz, and `timed` is False.
        timed: Whether the file tells times or a rate.
        missing: Number of values that are none.
    """

    values: np.ndarray
    axis: clock.Axis
    timed: bool
    missing: int

    @cached_property
    def mean(self) -> float:
        """Mean."""
        return float(self.values.mean())

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
        """Rising edges of a signal that is at one of two levels [s], shape (k,), however few; else none."""
        low, high = self.extent
        reach = _NEAR * (high - low)
        if not reach or np.mean((self.values < low + reach) | (self.values > high - reach)) < _TWO_LEVELS:
            return np.empty(0)
        return clock.crossings(self.values, self.axis, threshold=None, hysteresis=None)[0]

    @cached_property
    def edges(self) -> np.ndarray:
        """Rising edges of a pulse train [s], shape (k,); none where it is no pulse train."""
        found = self.pulses
        if len(found) < _EDGES:
            return np.empty(0)
        apart = np.diff(found)
        uneven = np.abs(np.diff(apart)) / apart[1:] if len(apart) > 1 else np.zeros(1)
        return found if float(np.median(uneven)) < _REGULAR else np.empty(0)

    @cached_property
    def threshold(self) -> float:
        """Level half way between lowest and highest."""
        return 0.5 * sum(self.extent)

    @cached_property
    def blows(self) -> bool:
        """Whether it rests, but for short and strong pulses to one side."""
        rest = float(np.median(self.values))
        off = np.abs(self.values - rest)
        usual = float(np.median(off)) / 0.6745
        peak = float(off.max())
        return peak > _BLOW * usual and float(np.mean(off > 0.3 * peak)) < _SELDOM and not len(self.edges)

    @property
    def struck_s(self) -> float:
        """When it first goes a tenth of the way to its largest pulse [s]."""
        off = np.abs(self.values - float(np.median(self.values)))
        return float(self.axis.instants()[int(np.argmax(off > 0.1 * off.max()))])

    @cached_property
    def corner_hz(self) -> float | None:
        """Where its noise ends [Hz], if it shows."""
        return noise.corner_hz(self.values, self.axis.rate_hz) if self.timed and self.axis.times_s is None else None

    @cached_property
    def unevenness(self) -> float:
        """How far values lie from the line between their neighbours at even times, over the same at their stamps, rms.

        Above 1 they were taken when the stamps say, below it evenly; 1 where the stamps are even.
        """
        if self.axis.times_s is None or len(self.values) < _FEW:
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
        """The same as means of several samples, without their mean, shape (m,)."""
        whole = block_means(self.values, -(-len(self.values) // _SLOW))
        return whole - whole.mean()

    def sparkline(self, width: int) -> str:
        """Its course in a line of blocks: in each the value that is farthest from the mean."""
        low, high = self.extent
        parts = np.array_split(self.values, min(width, len(self.values)))
        far = [part[np.argmax(np.abs(part - self.mean))] for part in parts]
        scale = (len(_BLOCKS) - 2) / (high - low) if high > low else 0.0
        return "".join(_BLOCKS[1 + round((float(value) - low) * scale)] for value in far)


def look(signal: FileSignal) -> Look:
    """Look at the numbers of a signal."""
    values = signal.physical[:_MOST]
    good = np.isfinite(values)
    rows = len(values)
    timed = signal.times_s is not None or signal.rate_hz is not None
    axis = clock.Axis(signal.first_s, signal.rate_hz or 1.0, rows)
    if signal.times_s is not None:
        times_s = signal.times_s[:rows]
        try:
            axis = clock.axis_of_stamps(times_s, line=False, what="")
        except InputError:  # the import says so
            axis = clock.Axis(0.0, even_rate_hz(times_s) or 1.0, rows)
        values, good = axis.placed(values), axis.placed(np.where(good, 1.0, np.nan)) == 1.0
    mean = float(values[good].mean()) if good.any() else 0.0
    return Look(np.where(good, values, mean), axis, timed, int(len(good) - good.sum()))


@dataclass(frozen=True)
class Relation:
    """How a signal goes with another.

    Attributes:
        hz: Frequency at which both move most [Hz].
        phase_deg: By how much the first leads there [degrees].
        coherence: How firmly, 0 to 1.
        likeness: Correlation of all of it, -1 to 1.
    """

    hz: float
    phase_deg: float
    coherence: float
    likeness: float

    @property
    def quadrature(self) -> bool:
        """Whether they are a quarter of a turn apart."""
        return self.coherence > 0.8 and abs(abs(self.phase_deg) - 90.0) < 30.0

    @property
    def together(self) -> bool:
        """Whether they go up and down at the same time, or one up and the other down."""
        return self.coherence > 0.8 and abs(abs(self.phase_deg) - 90.0) > 60.0


def relation(a: Look, b: Look) -> Relation | None:
    """How two signals go together; None where they were not taken at the same instants, or do not move."""
    if len(a.values) != len(b.values) or abs(a.axis.rate_hz / b.axis.rate_hz - 1.0) > 1e-3:
        return None
    x, y = a.slow, b.slow
    norm = math.sqrt(float(x @ x) * float(y @ y))
    if len(x) < 64 or norm == 0.0:
        return None
    window, rows = np.hanning(len(x)), 1 << (len(x) - 1).bit_length()
    ax, by = spectrum(x * window, rows), spectrum(y * window, rows)
    power = np.abs(ax) * np.abs(by)
    power[:3] = 0.0
    peak = int(np.argmax(power))
    near = slice(max(1, peak - _AROUND), peak + _AROUND + 1)
    cross = complex(np.sum(ax[near] * np.conj(by[near])))
    whole = math.sqrt(float(np.sum(np.abs(ax[near]) ** 2)) * float(np.sum(np.abs(by[near]) ** 2)))
    slow_hz = a.axis.rate_hz * len(x) / len(a.values)
    return Relation(
        hz=peak * slow_hz / rows, phase_deg=math.degrees(math.atan2(cross.imag, cross.real)),
        coherence=abs(cross) / whole if whole else 0.0, likeness=float(x @ y) / norm,
    )  # fmt: skip
