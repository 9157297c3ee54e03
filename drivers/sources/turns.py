"""Turns of the shaft in rows of channels: what machinery protection shows of each."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drivers.sources.samples import Samples
from rig.channels.orbit import synchronous

HALF = 0.5
"""A keyphasor's pulse begins where its signal, 0 to 1, rises through this."""


@dataclass(frozen=True, slots=True)
class Turn:
    """One turn of the shaft, from pulse to pulse of the keyphasor.

    Attributes:
        begin_s: Simulated time at which it begins [s].
        speed_hz: Turns a second in it [Hz].
        peak_to_peak: Largest less smallest value of each channel, in its unit.
        gap: Mean of each channel, in its unit.
        once: What goes once around with the shaft (1X) of each channel: amplitude in its unit, with the phase from the
            pulse on (negative lags).
        samples: Its rows.
    """

    begin_s: float
    speed_hz: float
    peak_to_peak: dict[str, float]
    gap: dict[str, float]
    once: dict[str, complex]
    samples: Samples


def edges(samples: Samples) -> np.ndarray:
    """When the keyphasor's pulses begin [s], between rows by a straight line, shape (edges,)."""
    signal, times_s = samples["keyphasor"], samples.times_s
    rows = np.flatnonzero((signal[:-1] < HALF) & (signal[1:] >= HALF))
    part = (HALF - signal[rows]) / (signal[rows + 1] - signal[rows])
    return times_s[rows] + part / samples.rate_hz


def turn_in(samples: Samples, begin_s: float, end_s: float) -> Turn:
    """The turn of the shaft between two times [s]."""
    first, last = np.searchsorted(samples.times_s, [begin_s, end_s])
    rows = samples.rows(int(first), int(last))
    once = {}
    for name in rows.names:
        _, vector = synchronous(rows[name], rows.times_s, [begin_s, end_s])
        once[name] = complex(vector[0]) if len(vector) else complex(math.nan, math.nan)
    return Turn(
        begin_s=float(begin_s), speed_hz=float(1.0 / (end_s - begin_s)),
        peak_to_peak={name: float(np.ptp(rows[name])) for name in rows.names},
        gap={name: float(rows[name].mean()) for name in rows.names}, once=once, samples=rows,
    )  # fmt: skip
