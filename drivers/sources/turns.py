"""Shaft turns in samples, with the values that a machinery protection monitor shows for each."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np

from drivers.sources.samples import Samples
from rig.channels.orbit import find_edges, synchronous


@dataclass(frozen=True, slots=True)
class Turn:
    """One turn of the shaft, from one keyphasor pulse to the next.

    Attributes:
        begin_s: Simulated time of its start [s].
        speed_hz: Mean speed [Hz].
        peak_to_peak: Peak-to-peak value of each channel, in its unit.
        gap: Mean of each channel, in its unit (DC gap of a probe).
        synchronous: 1X vector of each channel: amplitude in its unit, phase relative to the pulse (negative: lag).
        samples: Samples of the turn.
    """

    begin_s: float
    speed_hz: float
    peak_to_peak: dict[str, float]
    gap: dict[str, float]
    synchronous: dict[str, complex]
    samples: Samples

    @property
    def once(self) -> dict[str, complex]:
        """The attribute `synchronous` under its old name."""
        warnings.warn("Turn.once is Turn.synchronous now", DeprecationWarning, stacklevel=2)
        return self.synchronous


def find_pulses(samples: Samples) -> np.ndarray:
    """Return the times at which keyphasor pulses begin [s], interpolated between samples, shape (pulses,)."""
    return find_edges(samples["keyphasor"], samples.times_s)


def measure_turn(samples: Samples, begin_s: float, end_s: float) -> Turn:
    """Return the turn of the shaft between two pulse times [s]."""
    first, last = np.searchsorted(samples.times_s, [begin_s, end_s])
    rows = samples.rows(int(first), int(last))
    vectors = {}
    for name in rows.names:
        _, vector = synchronous(rows[name], rows.times_s, [begin_s, end_s])
        vectors[name] = complex(vector[0]) if len(vector) else complex(math.nan, math.nan)
    return Turn(
        begin_s=float(begin_s), speed_hz=float(1.0 / (end_s - begin_s)),
        peak_to_peak={name: float(np.ptp(rows[name])) for name in rows.names},
        gap={name: float(rows[name].mean()) for name in rows.names}, synchronous=vectors, samples=rows,
    )  # fmt: skip
