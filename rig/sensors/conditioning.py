"""Signal conditioning of all sensors: sensitivity, range, anti-alias filter and AC coupling, noise, converter."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from rig.channels import Channel, Group, check_signals
from rig.kernels.signals import COLUMN
from rig.kernels.stage import kernel
from rig.sensors.noise import draw, noise_streams

_SECTIONS = 3
"""Second-order sections of the filter: two of the fourth-order Butterworth low-pass, one for AC coupling."""
_LANES = 16
"""Channels that one pass takes, side by side."""
_CHUNK = 64
"""Rows that are filtered at a time."""

_GAIN, _BIAS, _LOW, _HIGH, _NOISE, _LSB, _LIMIT = range(7)
"""Rows of the table of channels: volts per SI unit; volts at zero; output limits [V]; noise [V]; converter step [V];
largest count."""
_SECTION = 7
"""From here on three sections: b0, b1, b2, a1, a2 and both memories (direct form II transposed)."""
_SECTION_AT = tuple(_SECTION + 7 * section for section in range(_SECTIONS))
_TABLE = _SECTION + 7 * _SECTIONS
_A, _B, _D = (_LANES * at for at in _SECTION_AT)


@kernel
def _filter(table, volts):
    """From signals to volts behind the filters, in place, for `_LANES` channels.

    Every number of a channel stands at a fixed distance from the next one: only so can the compiler see that the
    channels may go side by side.

    Args:
        table: Of these channels, with their memory, in and out, shape (_TABLE * _LANES,).
        volts: In and out, row after row, shape (rows * _LANES,).
    """
    for n in range(len(volts) // _LANES):
        row = volts[n * _LANES : (n + 1) * _LANES]
        for c in range(_LANES):
            v = table[c + _BIAS * _LANES] + table[c + _GAIN * _LANES] * row[c]
            v = min(max(v, table[c + _LOW * _LANES]), table[c + _HIGH * _LANES])
            u = table[c + _A] * v + table[c + (_A + 5 * _LANES)]
            table[c + (_A + 5 * _LANES)] = (
                table[c + (_A + _LANES)] * v - table[c + (_A + 3 * _LANES)] * u + table[c + (_A + 6 * _LANES)]
            )
            table[c + (_A + 6 * _LANES)] = table[c + (_A + 2 * _LANES)] * v - table[c + (_A + 4 * _LANES)] * u
            v = table[c + _B] * u + table[c + (_B + 5 * _LANES)]
            table[c + (_B + 5 * _LANES)] = (
                table[c + (_B + _LANES)] * u - table[c + (_B + 3 * _LANES)] * v + table[c + (_B + 6 * _LANES)]
            )
            table[c + (_B + 6 * _LANES)] = table[c + (_B + 2 * _LANES)] * u - table[c + (_B + 4 * _LANES)] * v
            u = table[c + _D] * v + table[c + (_D + 5 * _LANES)]
            table[c + (_D + 5 * _LANES)] = (
                table[c + (_D + _LANES)] * v - table[c + (_D + 3 * _LANES)] * u + table[c + (_D + 6 * _LANES)]
            )
            table[c + (_D + 6 * _LANES)] = table[c + (_D + 2 * _LANES)] * v - table[c + (_D + 4 * _LANES)] * u
            row[c] = u


@kernel
def _convert(table, volts, every, noise):
    """From volts to counts, still as floats, in place.

    Args:
        table: As above.
        volts: In and out, from the row of the first sample on, shape (rows * _LANES,).
        every: Rows a sample.
        noise: Of each sample, shape (samples, _LANES).
    """
    for n in range(len(noise)):
        row = volts[n * every * _LANES : (n * every + 1) * _LANES]
        loud = noise[n]
        # A length that the compiler knew would be unrolled, one channel after the other.
        for c in range(len(row)):
            count = np.rint((row[c] + loud[c] * table[c + _NOISE * _LANES]) / table[c + _LSB * _LANES])
            limit = table[c + _LIMIT * _LANES]
            row[c] = min(max(count, -limit - 1.0), limit)


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def _condition(rows, first, every, columns, places, tables, streams, counts):
    """Filter every row, convert every `every`-th from row `first` on.

    Args:
        rows: Observed rows, shape (n, N_ROW).
        first: Row of the first sample.
        every: Rows a sample.
        columns: Column of each channel, shape (c,).
        places: Where its counts go: channels in the groups before its own, channels in its group, place in it,
            shape (c, 3).
        tables: Of the channels by sixteen, with the filters' memory, in and out, shape (sets, _TABLE, _LANES).
        streams: Of their noise, in and out, shape (c, 4); (0, 4): no noise.
        counts: Out, one group behind the other, each (samples, channels).
    """
    samples = len(counts) // len(columns)
    volts = np.zeros(_CHUNK * _LANES)
    noise = np.zeros((_CHUNK, _LANES))
    for part in range(len(tables)):
        table = tables[part].reshape(_TABLE * _LANES)
        at = part * _LANES
        lanes = min(_LANES, len(columns) - at)
        sample = 0
        due = first
        for begin in range(0, len(rows), _CHUNK):
            length = min(_CHUNK, len(rows) - begin)
            for c in range(lanes):
                column = columns[at + c]
                for n in range(length):
                    volts[n * _LANES + c] = rows[begin + n, column]
            _filter(table, volts[: length * _LANES])
            here = max(0, -(-(begin + length - due) // every))
            if len(streams) > 0:
                draw(streams[at : at + lanes], noise[:here])
            _convert(table, volts[(due - begin) * _LANES :], every, noise[:here])
            for c in range(lanes):
                before, width, place = places[at + c]
                to = before * samples + sample * width + place
                for n in range(here):
                    counts[to + n * width] = np.int32(volts[(due - begin + n * every) * _LANES + c])
            sample += here
            due += here * every


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
    """Turns rows into counts, block by block; cutting a run into blocks in another way changes no bit.

    An ideal one has range and converter only: no filter, no coupling, no noise.

    Each channel draws its noise from a stream of its own, keyed by seed and name: leaving a channel out does not
    change the others.

    Args:
        groups: Groups of one rate.
        row_rate_hz: Rows a second, a whole multiple of that rate.
        seed: Of the noise.
        noise: Whether there is any.
        ideal: Leave everything out but range and converter.
    """

    def __init__(
        self, groups: Sequence[Group], *, row_rate_hz: int, seed: int, noise: bool, ideal: bool = False
    ) -> None:
        self.groups = tuple(groups)
        self.ideal = ideal
        self.every = row_rate_hz // self.groups[0].rate_hz
        self.rows_seen = 0
        channels = [channel for group in self.groups for channel in group.channels]
        check_signals(channels, COLUMN)
        self._columns = np.array([COLUMN[channel.signal] for channel in channels])
        self._spans: list[tuple[str, int, int]] = []
        for group in self.groups:
            self._spans.append((group.name, sum(width for _, _, width in self._spans), len(group.channels)))
        self._places = np.array([(before, width, c) for _, before, width in self._spans for c in range(width)])
        # Lanes without a channel make zeros.
        self._tables = np.zeros((-(-len(channels) // _LANES), _TABLE, _LANES))
        self._tables[:, _LSB] = 1.0
        for c, channel in enumerate(channels):
            table = self._tables[c // _LANES, :, c % _LANES]
            table[:_SECTION] = (
                channel.sensitivity_v / channel.si,
                channel.bias_v,
                *channel.range_v,
                channel.noise_v,
                channel.lsb_v,
                2.0 ** (channel.adc_bits - 1) - 1.0,
            )
            for at, (b0, b1, b2, _, a1, a2) in zip(_SECTION_AT, channel_filter(channel, row_rate_hz), strict=True):
                table[at : at + 5] = b0, b1, b2, a1, a2
        self._streams = noise_streams([channel.name for channel in channels] if noise and not ideal else [], seed)

    def counts(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Samples that fall into the next rows.

        Args:
            rows: Observed rows that follow those of the last call, shape (n, N_ROW).

        Returns:
            ADC counts by group, int32, shape (samples, channels).
        """
        if self.rows_seen == 0 and not self.ideal:
            self._settle(rows[0])
        first = -self.rows_seen % self.every
        self.rows_seen += len(rows)
        samples = max(0, -(-(len(rows) - first) // self.every))
        counts = np.empty(samples * len(self._columns), dtype=np.int32)
        if self.ideal:
            self._ideal_counts(rows[first :: self.every], counts)
        else:
            # Sums of unsigned integers wrap, of which numpy would warn where nothing is compiled.
            with np.errstate(over="ignore"):
                _condition(rows, first, self.every, self._columns, self._places, self._tables, self._streams, counts)
        return {
            name: counts[samples * before : samples * (before + width)].reshape(samples, width)
            for name, before, width in self._spans
        }

    def _number(self, row: int) -> np.ndarray:
        """One row of the table for all channels, shape (c,)."""
        return self._tables[:, row].ravel()[: len(self._columns)]

    def _limited(self, rows: np.ndarray) -> np.ndarray:
        """Volts of the conditioners for rows [V], shape (n, c)."""
        volts = self._number(_BIAS) + self._number(_GAIN) * rows[:, self._columns]
        return np.clip(volts, self._number(_LOW), self._number(_HIGH))

    def _ideal_counts(self, rows: np.ndarray, counts: np.ndarray) -> None:
        limit = self._number(_LIMIT)
        values = np.clip(np.rint(self._limited(rows) / self._number(_LSB)), -limit - 1.0, limit)
        for _, before, width in self._spans:
            end = before + width
            counts[len(rows) * before : len(rows) * end] = values[:, before:end].ravel()

    def _settle(self, row: np.ndarray) -> None:
        # The instruments have been on for long: filters start in the steady state of the first row.
        for c, value in enumerate(self._limited(row[None, :])[0]):
            table = self._tables[c // _LANES, :, c % _LANES]
            for at in _SECTION_AT:
                b0, b1, b2, a1, a2 = table[at : at + 5]
                out = value * (b0 + b1 + b2) / (1.0 + a1 + a2)
                table[at + 5 : at + 7] = out - b0 * value, b2 * value - a2 * out
                value = out
