"""Signal conditioning of one sensor group: sensitivity, range, anti-alias filter and AC coupling, noise, converter."""

from __future__ import annotations

import math
import zlib

import numpy as np
from numba import njit

from rig.channels import Channel, Group
from rig.kernels.signals import COLUMN

_STORE = 4096
"""Samples of noise drawn at a time: how many does not show in the result."""
_SECTIONS = 3
"""Second-order sections of the filter: two of the fourth-order Butterworth low-pass, one for AC coupling."""


@njit(cache=True, error_model="numpy", nogil=True)
def _condition(rows, first, every, columns, gain, bias, low, high, sections, memory, noise, lsb, limit, counts):
    """Filter every row, convert every `every`-th from row `first` on.

    Args:
        rows: Observed rows, shape (n, N_ROW).
        first: Row of the first sample.
        every: Rows a sample.
        columns: Column of each channel, shape (c,).
        gain: Volts per SI unit, shape (c,).
        bias: Volts at zero, shape (c,).
        low: Lower output limit [V], shape (c,).
        high: Upper output limit [V], shape (c,).
        sections: Filter, shape (c, _SECTIONS, 6) as second-order sections.
        memory: Filter memory (direct form II transposed), in and out, shape (c, _SECTIONS, 2).
        noise: Added at the converter [V], shape (c, samples).
        lsb: Converter step [V], shape (c,).
        limit: Largest count, shape (c,).
        counts: Out, shape (samples, c).
    """
    for c in range(len(columns)):
        column = columns[c]
        m00, m01 = memory[c, 0, 0], memory[c, 0, 1]
        m10, m11 = memory[c, 1, 0], memory[c, 1, 1]
        m20, m21 = memory[c, 2, 0], memory[c, 2, 1]
        a = sections[c, 0]
        b = sections[c, 1]
        d = sections[c, 2]
        sample = 0
        due = first
        for n in range(len(rows)):
            v = min(max(bias[c] + gain[c] * rows[n, column], low[c]), high[c])
            u = a[0] * v + m00
            m00 = a[1] * v - a[4] * u + m01
            m01 = a[2] * v - a[5] * u
            v = b[0] * u + m10
            m10 = b[1] * u - b[4] * v + m11
            m11 = b[2] * u - b[5] * v
            u = d[0] * v + m20
            m20 = d[1] * v - d[4] * u + m21
            m21 = d[2] * v - d[5] * u
            if n == due:
                value = np.rint((u + noise[c, sample]) / lsb[c])
                counts[sample, c] = np.int32(min(max(value, -limit[c] - 1.0), limit[c]))
                sample += 1
                due += every
        memory[c, 0, 0], memory[c, 0, 1] = m00, m01
        memory[c, 1, 0], memory[c, 1, 1] = m10, m11
        memory[c, 2, 0], memory[c, 2, 1] = m20, m21


def channel_filter(channel: Channel, row_rate_hz: float) -> np.ndarray:
    """The channel's filter as second-order sections at the rate of the rows, shape (3, 6).

    Fourth-order Butterworth low-pass at the channel's bandwidth (left out where that is no longer below the row
    rate's own limit), and a first-order high-pass where the channel is AC-coupled.
    """
    # Butterworth's poles by the bilinear transform: importing a library for it takes half a second of every start.
    sections = np.tile([1.0, 0.0, 0.0, 1.0, 0.0, 0.0], (_SECTIONS, 1))
    if channel.bandwidth_hz < 0.45 * row_rate_hz:
        k = math.tan(math.pi * channel.bandwidth_hz / row_rate_hz)
        for n in range(2):
            width = 2.0 * k * math.sin(math.pi * (2 * n + 1) / 8.0)
            scale = 1.0 / (1.0 + width + k * k)
            low = np.array([k * k, 2.0 * k * k, k * k])
            sections[n] = [*(low * scale), 1.0, 2.0 * (k * k - 1.0) * scale, (1.0 - width + k * k) * scale]
    if channel.highpass_hz > 0.0:
        k = math.tan(math.pi * channel.highpass_hz / row_rate_hz)
        sections[2] = [1.0 / (1.0 + k), -1.0 / (1.0 + k), 0.0, 1.0, (k - 1.0) / (k + 1.0), 0.0]
    return sections


class Conditioner:
    """Turns rows into counts for one group, block by block; cutting a run into blocks in another way changes no bit.

    An ideal one has range and converter only: no filter, no coupling, no noise.

    Each channel draws its noise from a generator of its own, keyed by seed and name: leaving a channel out does not
    change the others.
    """

    def __init__(self, group: Group, *, row_rate_hz: int, seed: int, noise: bool, ideal: bool = False) -> None:
        self.group = group
        self.ideal = ideal
        self.every = row_rate_hz // group.rate_hz
        self.rows_seen = 0
        channels = group.channels
        self._columns = np.array([COLUMN[channel.signal] for channel in channels])
        self._gain = np.array([channel.sensitivity_v / channel.si for channel in channels])
        self._bias = np.array([channel.bias_v for channel in channels])
        self._low = np.array([channel.range_v[0] for channel in channels])
        self._high = np.array([channel.range_v[1] for channel in channels])
        self._sections = np.stack([channel_filter(channel, row_rate_hz) for channel in channels])
        self._memory = np.zeros((len(channels), _SECTIONS, 2))
        self._noise_v = np.array([channel.noise_v if noise else 0.0 for channel in channels])
        self._lsb = np.array([channel.lsb_v for channel in channels])
        self._store, self._drawn = np.empty((len(channels), 0)), 0
        self._limit = np.array([2.0 ** (channel.adc_bits - 1) - 1.0 for channel in channels])
        self._generators = [
            np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, zlib.crc32(channel.name.encode())])))
            for channel in channels
        ]

    def counts(self, rows: np.ndarray) -> np.ndarray:
        """Samples that fall into the next rows.

        Args:
            rows: Observed rows that follow those of the last call, shape (n, N_ROW).

        Returns:
            ADC counts, int32, shape (samples, channels).
        """
        if self.rows_seen == 0:
            self._settle(rows[0])
        first = -self.rows_seen % self.every
        if self.ideal:
            self.rows_seen += len(rows)
            volts = np.clip(self._bias + self._gain * rows[first :: self.every, self._columns], self._low, self._high)
            return np.clip(np.rint(volts / self._lsb), -self._limit - 1.0, self._limit).astype(np.int32)
        samples = max(0, -(-(len(rows) - first) // self.every))
        noise = self._next_noise(samples)
        counts = np.empty((samples, len(self._columns)), dtype=np.int32)
        _condition(
            rows, first, self.every, self._columns, self._gain, self._bias, self._low, self._high, self._sections,
            self._memory, noise, self._lsb, self._limit, counts,
        )  # fmt: skip
        self.rows_seen += len(rows)
        return counts

    def _next_noise(self, samples: int) -> np.ndarray:
        """Noise of the next samples [V], shape (channels, samples), out of a store that is filled now and then."""
        if self._drawn + samples > self._store.shape[1]:
            left = self._store[:, self._drawn :]
            fresh = np.zeros((len(left), max(_STORE, samples - left.shape[1])))
            for generator, noise_v, draws in zip(self._generators, self._noise_v, fresh, strict=True):
                if noise_v:
                    generator.standard_normal(out=draws)
                    draws *= noise_v
            self._store, self._drawn = np.concatenate([left, fresh], axis=1), 0
        self._drawn += samples
        return self._store[:, self._drawn - samples : self._drawn]

    def _settle(self, row: np.ndarray) -> None:
        # The instruments have been on for long: filters start in the steady state of the first row.
        volts = np.clip(self._bias + self._gain * row[self._columns], self._low, self._high)
        for c, value in enumerate(volts):
            for s in range(_SECTIONS):
                b0, b1, b2, _, a1, a2 = self._sections[c, s]
                out = value * (b0 + b1 + b2) / (1.0 + a1 + a2)
                self._memory[c, s] = out - b0 * value, b2 * value - a2 * out
                value = out
