"""Signal conditioning of all sensors: sensitivity, range, anti-alias filter, AC coupling, noise and converter.

A channel is a chain in continuous time (`rig.channels.sensors.filters`), so samples lie exactly at the times of its
rate.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numba import njit

from rig.channels.sampling import sample_spacing
from rig.channels.sensors.filters import (
    POLE,
    channel_poles,
    coefficients,
    digital_coefficients,
    linear_phase_taps,
)
from rig.channels.sensors.noise import draw, noise_streams
from rig.channels.table import Channel, Group, check_signals
from rig.physics.kernels.signals import COLUMN
from rig.physics.kernels.stage import kernel

_LANES = 16
"""Channels processed in one pass, in SIMD lanes."""
_WEIGHED_ROWS = 512
"""Rows of one channel that are weighted at once, as they stay in the processor's cache."""
_TRANSFORMED_ROWS = 2048
"""Rows that are filtered at once by Fourier transforms."""
_SUBNORMAL_GUARD_V = 1e-25
"""Offset of all voltages [V]: without it, filters of silent channels decay to subnormal numbers, 100 times slower."""
_CHUNK = 64
"""Rows filtered at a time."""

_GAIN, _BIAS, _LOW, _HIGH, _NOISE, _LSB, _LIMIT = range(7)
"""Rows of the channel table: gain [V per SI unit], bias [V], output limits [V], noise [V rms], converter step [V],
largest count."""


@kernel
def _filter(step, wave, phases, volts, rows, late, apart, parts, out):
    """Step the filters from row to row and compute every sample on the way, for `_LANES` channels.

    All numbers of a channel have the same stride, so that the compiler can vectorise over the channels.

    Args:
        step: Pole coefficients, shape (poles * POLE * _LANES,).
        wave: Pole states, in and out, shape (poles * 2 * _LANES,).
        phases: Sample weights by position, shape (parts * (4 + 2 * poles) * _LANES,).
        volts: Two rows before the first, the first, and `rows` more, shape ((rows + 3) * _LANES,).
        rows: Number of row intervals to step.
        late: Position of the next sample after the first row, in parts of a row interval.
        apart: Sample interval, in such parts.
        parts: Parts per row interval.
        out: Samples, out, shape (samples * _LANES,).

    Returns:
        Position of the next sample after the last row.
    """
    poles = len(step) // (POLE * _LANES)
    sample = 0
    for n in range(rows):
        at = n * _LANES
        if late == 0:
            # A sample on the row itself is the direct gain times the voltage, plus the pole states.
            for c in range(_LANES):
                out[sample + c] = phases[_LANES + c] * volts[at + 2 * _LANES + c]
            for pole in range(poles):
                for c in range(_LANES):
                    out[sample + c] += wave[2 * pole * _LANES + c]
            sample += _LANES
            late = apart
        while late < parts:
            phase = late * (4 + 2 * poles) * _LANES
            for c in range(_LANES):
                out[sample + c] = (
                    phases[phase + c] * volts[at + 3 * _LANES + c]
                    + phases[phase + _LANES + c] * volts[at + 2 * _LANES + c]
                    + phases[phase + 2 * _LANES + c] * volts[at + _LANES + c]
                    + phases[phase + 3 * _LANES + c] * volts[at + c]
                )
            for pole in range(poles):
                real, of = 2 * pole * _LANES, phase + (4 + 2 * pole) * _LANES
                for c in range(_LANES):
                    out[sample + c] += (
                        phases[of + c] * wave[real + c] - phases[of + _LANES + c] * wave[real + _LANES + c]
                    )
            sample += _LANES
            late += apart
        late -= parts
        for pole in range(poles):
            real, of = 2 * pole * _LANES, pole * POLE * _LANES
            for c in range(_LANES):
                a, b = wave[real + c], wave[real + _LANES + c]
                before, now = volts[at + _LANES + c], volts[at + 2 * _LANES + c]
                first, last = volts[at + c], volts[at + 3 * _LANES + c]
                wave[real + c] = (step[of + c] * a - step[of + _LANES + c] * b) + (
                    (step[of + 2 * _LANES + c] * last + step[of + 3 * _LANES + c] * now)
                    + (step[of + 4 * _LANES + c] * before + step[of + 5 * _LANES + c] * first)
                )
                wave[real + _LANES + c] = (step[of + c] * b + step[of + _LANES + c] * a) + (
                    (step[of + 6 * _LANES + c] * last + step[of + 7 * _LANES + c] * now)
                    + (step[of + 8 * _LANES + c] * before + step[of + 9 * _LANES + c] * first)
                )
    return late


@kernel
def _weigh(taps, volts, out):
    """Write the weighted rows to `out`, shape (n, channels), from `volts`, shape (n + taps - 1, channels)."""
    for c in range(out.shape[1]):
        column, summed = np.ascontiguousarray(volts[:, c]), np.zeros(len(out))
        for first in range(0, len(out), _WEIGHED_ROWS):
            part = summed[first : first + _WEIGHED_ROWS]
            for tap in range(len(taps)):
                weight, moved = taps[tap, c], column[first + tap : first + tap + len(part)]
                for n in range(len(part)):
                    part[n] += weight * moved[n]
        out[:, c] = summed


@kernel
def _clip_volts(scale, volts):
    """Convert signals to volts within the conditioner's range, in place, shape (rows * _LANES,)."""
    for n in range(0, len(volts), _LANES):
        for c in range(_LANES):
            v = scale[c + _BIAS * _LANES] + scale[c + _GAIN * _LANES] * volts[n + c] + _SUBNORMAL_GUARD_V
            volts[n + c] = min(max(v, scale[c + _LOW * _LANES]), scale[c + _HIGH * _LANES])


@kernel
def _convert(scale, volts, noise):
    """Convert volts to counts, still as floats, in place.

    Args:
        scale: Channel table, shape (7 * _LANES,).
        volts: Volts in, counts out, shape (samples * _LANES,).
        noise: Noise of each sample, shape (samples, _LANES).
    """
    for n in range(len(noise)):
        row = volts[n * _LANES : (n + 1) * _LANES]
        loud = noise[n]
        # With a length known at compile time, the loop would be unrolled instead of vectorised.
        for c in range(len(row)):
            count = np.rint((row[c] + loud[c] * scale[c + _NOISE * _LANES]) / scale[c + _LSB * _LANES])
            limit = scale[c + _LIMIT * _LANES]
            row[c] = min(max(count, -limit - 1.0), limit)


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def _condition(rows, made, late, apart, parts, columns, places, scales, past, waves, steps, phases, streams, counts):
    """Filter from the first row to the last, and convert the samples before the last row.

    Args:
        rows: Observed rows, shape (n, N_ROW).
        made: Signals by formulas at the same instants, shape (n, formulas).
        late: Position of the first sample after the first row, in parts of a row interval.
        apart: Sample interval, in such parts.
        parts: Parts per row interval.
        columns: Column of each channel, those of `made` after those of `rows`, shape (c,).
        places: Position of each channel's counts: channels in the groups before its own, channels in its group, column
            in its group, shape (c, 3).
        scales: Channel tables by set of `_LANES`, shape (sets, 7, _LANES).
        past: Volts at the two rows before the first, in and out, shape (sets, 2 * _LANES).
        waves: Pole states, in and out, shape (sets, poles * 2 * _LANES).
        steps: Pole coefficients, shape (sets, poles * POLE * _LANES).
        phases: Sample weights, shape (sets, parts * (4 + 2 * poles) * _LANES).
        streams: Noise streams, in and out, shape (c, 4); (0, 4) for no noise.
        counts: Counts, out, group after group, each (samples, channels).
    """
    samples = len(counts) // len(columns)
    volts = np.zeros((_CHUNK + 3) * _LANES)
    most = _CHUNK * parts // apart + 2
    out = np.zeros(most * _LANES)
    noise = np.zeros((most, _LANES))
    for part in range(len(scales)):
        scale = scales[part].reshape(7 * _LANES)
        at = part * _LANES
        lanes = min(_LANES, len(columns) - at)
        sample, due = 0, late
        for n in range(2 * _LANES):
            volts[n] = past[part, n]
        for begin in range(0, len(rows) - 1, _CHUNK):
            length = min(_CHUNK, len(rows) - 1 - begin)
            for c in range(lanes):
                column = columns[at + c]
                if column < rows.shape[1]:
                    for n in range(length + 1):
                        volts[(n + 2) * _LANES + c] = rows[begin + n, column]
                else:
                    for n in range(length + 1):
                        volts[(n + 2) * _LANES + c] = made[begin + n, column - rows.shape[1]]
            _clip_volts(scale, volts[2 * _LANES : (length + 3) * _LANES])
            ready = max(0, -((due - length * parts) // apart))
            if len(streams) > 0:
                draw(streams[at : at + lanes], noise[:ready])
            due = _filter(steps[part], waves[part], phases[part], volts, length, due, apart, parts, out)
            for n in range(2 * _LANES):
                volts[n] = volts[length * _LANES + n]
            _convert(scale, out, noise[:ready])
            for c in range(lanes):
                before, width, place = places[at + c]
                to = before * samples + sample * width + place
                for n in range(ready):
                    counts[to + n * width] = np.int32(out[n * _LANES + c])
            sample += ready
        for n in range(2 * _LANES):
            past[part, n] = volts[n]


class Conditioner:
    """Conversion of rows to counts, block by block; the result does not depend on the division of a run into blocks.

    An ideal conditioner has only range and converter: no filter, no coupling, no noise.

    Each channel draws its noise from a separate stream, keyed by seed and name, so that omitting a channel does not
    change the others.

    Args:
        groups: Groups of one rate.
        row_rate_hz: Rows per second [Hz].
        seed: Seed of the noise.
        noise: Whether the channels have noise.
        ideal: Omit everything except range and converter.
        digital: Filters of tables of version 1: by the bilinear transform, at the rate of the rows.
        columns: Column of each channel's signal, in the rows or after them; None for the model's own.
    """

    def __init__(
        self,
        groups: Sequence[Group],
        *,
        row_rate_hz: int,
        seed: int,
        noise: bool,
        ideal: bool = False,
        digital: bool = False,
        columns: Sequence[int] | None = None,
    ) -> None:
        self.groups = tuple(groups)
        self._apart, self._parts = sample_spacing(self.groups[0].rate_hz, row_rate_hz)
        self._late = 0
        channels = [channel for group in self.groups for channel in group.channels]
        if columns is None:
            check_signals(channels, COLUMN)
            columns = [COLUMN[channel.signal] for channel in channels]
        self._columns = np.array(columns)
        self._spans: list[tuple[str, int, int]] = []
        for group in self.groups:
            self._spans.append((group.name, sum(width for _, _, width in self._spans), len(group.channels)))
        self._places = np.array([(before, width, c) for _, before, width in self._spans for c in range(width)])
        none = np.zeros(0, complex), np.zeros(0, complex), 1.0
        filters = [
            none if ideal or math.isinf(channel.bandwidth_hz) else channel_poles(channel, row_rate_hz)
            for channel in channels
        ]
        taps = {
            c: each for c, channel in enumerate(channels)
            if not ideal and len(each := linear_phase_taps(channel, row_rate_hz))
        }  # fmt: skip
        self._with_taps = list(taps)
        self._taps = np.zeros((max(map(len, taps.values()), default=1), len(taps)))
        for column, each in enumerate(taps.values()):
            self._taps[len(self._taps) - len(each) :, column] = each
        self._tail: np.ndarray | None = None
        """Signals of the linear-phase filters before the first row [V], shape (taps - 1, such channels)."""
        most = max(len(poles) for poles, _, _ in filters)
        sets = -(-len(channels) // _LANES)
        # Unused lanes produce zeros.
        self._scales = np.zeros((sets, 7, _LANES))
        self._scales[:, _LSB] = 1.0
        steps, self._settling = np.zeros((sets, most, POLE, _LANES)), np.zeros((sets, most, 2, _LANES))
        phases = np.zeros((sets, self._parts, 4 + 2 * most, _LANES))
        for c, (channel, (poles, residues, direct)) in enumerate(zip(channels, filters, strict=True)):
            of, lane = divmod(c, _LANES)
            self._scales[of, :, lane] = (
                channel.sensitivity_v / channel.si,
                channel.bias_v,
                *channel.range_v,
                channel.noise_v,
                channel.lsb_v,
                2.0 ** (channel.adc_bits - 1) - 1.0,
            )
            if digital and len(poles):
                step, settling, phase = digital_coefficients(channel, row_rate_hz)
            else:
                inside = (tuple((each / row_rate_hz).tolist()) for each in (poles, residues))
                step, settling, phase = coefficients(*inside, direct, self._parts)
            steps[of, : len(poles), :, lane], self._settling[of, : len(poles), :, lane] = step, settling
            phases[of, :, : phase.shape[1], lane] = phase
        self._steps, self._phases = steps.reshape(sets, -1), phases.reshape(sets, -1)
        self._waves = np.zeros((sets, most * 2 * _LANES))
        self._past: np.ndarray | None = None
        self._row_rate_hz, self._noise, self._ideal = row_rate_hz, noise, ideal
        self._lanes = {channel.name: divmod(c, _LANES) for c, channel in enumerate(channels)}
        self._inherited: list[tuple[str, np.ndarray, np.ndarray]] = []
        """Channels of a twin before its first rows, with their pole states and earlier volts."""
        self._inherited_tails: dict[int, np.ndarray] = {}
        self._streams = noise_streams([channel.name for channel in channels] if noise and not ideal else [], seed)

    @property
    def columns(self) -> np.ndarray:
        """Column of each channel's signal, in the rows or after them, shape (channels,)."""
        return self._columns

    def start_at(self, row: int) -> int:
        """Start at this row instead of row 0; return the number of the first sample from then on."""
        first = -(-row * self._parts // self._apart)
        self._late = first * self._apart - row * self._parts
        return first

    def twin(self, channels: Mapping[str, Channel], *, rate_hz: int, first: int, row: int, columns: int) -> Conditioner:
        """Return another chain of some of the channels, which continues from the state of this one.

        Args:
            channels: Channels by name; one with another filter starts in the steady state of its first row.
            rate_hz: Samples per second [Hz].
            first: Number of its first sample.
            row: Number of its first row.
            columns: First column of its signals; the others follow.
        """
        # Skip validation, which refuses channels without a range or a filter.
        group = Group.model_construct(name="twin", title="", rate_hz=rate_hz, channels=tuple(channels.values()))
        other = Conditioner(
            [group], row_rate_hz=self._row_rate_hz, seed=0, noise=self._noise, ideal=self._ideal,
            columns=range(columns, columns + len(channels)),
        )  # fmt: skip
        other._late = first * other._apart - row * other._parts
        other.take_over(self, list(channels))
        return other

    def take_over(self, other: Conditioner, names: Sequence[str]) -> None:
        """Copy another chain's noise streams and, for channels with equal filters, its states."""
        mine = {channel.name: channel for group in self.groups for channel in group.channels}
        theirs = {channel.name: channel for group in other.groups for channel in group.channels}
        for name in names:
            at = list(mine).index(name), list(theirs).index(name)
            if len(self._streams) and len(other._streams):
                self._streams[at[0]] = other._streams[at[1]]
            filters = [(one.low_pass, one.highpass_hz) for one in (mine[name], theirs[name])]
            if filters[0] == filters[1] and other._tail is not None and at[0] in self._with_taps:
                self._inherited_tails[at[0]] = other._tail[:, other._with_taps.index(at[1])].copy()
            if filters[0] == filters[1] and other._past is not None:
                part, lane = other._lanes[name]
                waves = other._waves[part].reshape(-1, _LANES)[:, lane].copy()
                self._inherited.append((name, waves, other._past[part].reshape(2, _LANES)[:, lane].copy()))

    def _restore_inherited(self) -> None:
        """Apply the inherited states after the other channels are settled."""
        assert self._past is not None
        for name, waves, past in self._inherited:
            part, lane = self._lanes[name]
            own = self._waves[part].reshape(-1, _LANES)
            own[: len(waves), lane] = waves[: len(own)]
            self._past[part].reshape(2, _LANES)[:, lane] = past
        self._inherited = []

    def __deepcopy__(self, memo: dict[int, Any]) -> Conditioner:
        """Return a copy with its own states; constant arrays are shared."""
        other = copy.copy(self)
        for name in ("_waves", "_past", "_streams", "_inherited", "_tail"):
            setattr(other, name, copy.copy(getattr(self, name)))
        return other

    def counts(self, rows: np.ndarray, made: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return the samples from the first of these rows to before the last one.

        Args:
            rows: Observed rows, starting with the last one of the previous call, shape (n, N_ROW).
            made: Additional signals at the same instants, whose columns follow those of the rows, shape (n, m).

        Returns:
            ADC counts by group, int32, shape (samples, channels).
        """
        if made is None:
            made = np.empty((len(rows), 0))
        columns = self._columns
        if self._with_taps:
            columns = columns.copy()
            columns[self._with_taps] = rows.shape[1] + made.shape[1] + np.arange(len(self._with_taps))
            made = np.hstack([made, self._convolve(rows, made)])
        if self._past is None:
            self._past = self._settle(rows, made, columns)
        if self._inherited:
            self._restore_inherited()
        span = (len(rows) - 1) * self._parts
        samples = max(0, -((self._late - span) // self._apart))
        counts = np.empty(samples * len(self._columns), dtype=np.int32)
        # Sums of unsigned integers wrap; without compilation, numpy would warn about it.
        with np.errstate(over="ignore"):
            _condition(
                rows, made, self._late, self._apart, self._parts, columns, self._places, self._scales, self._past,
                self._waves, self._steps, self._phases, self._streams, counts,
            )  # fmt: skip
        self._late += samples * self._apart - span
        return {
            name: counts[samples * before : samples * (before + width)].reshape(samples, width)
            for name, before, width in self._spans
        }

    def _convolve(self, rows: np.ndarray, made: np.ndarray) -> np.ndarray:
        """Return the signals of the channels with linear-phase filters after these [SI], shape (n, such channels)."""
        of = self._with_taps
        gain, bias, low, high = (self._scales[:, row].ravel()[of] for row in (_GAIN, _BIAS, _LOW, _HIGH))
        signals = [*rows.T, *made.T]
        volts = np.clip(bias + gain * np.column_stack([signals[c] for c in self._columns[of]]), low, high)
        if self._tail is None:
            self._tail = np.repeat(volts[:1], len(self._taps) - 1, axis=0)
            for c, tail in self._inherited_tails.items():
                self._tail[len(self._tail) - len(tail) :, of.index(c)] = tail[-len(self._tail) :]
        volts = np.concatenate([self._tail, volts])
        filtered = np.empty((len(rows), len(of)))
        if self._noise:
            _weigh(self._taps, volts, filtered)  # the same bits however the rows are divided into calls
        else:
            from scipy.signal import oaconvolve

            for first in range(0, len(rows), _TRANSFORMED_ROWS):
                part = volts[first : first + _TRANSFORMED_ROWS + len(self._taps) - 1]
                filtered[first : first + _TRANSFORMED_ROWS] = oaconvolve(part, self._taps[::-1], mode="valid", axes=0)
        self._tail = volts[len(rows) - 1 : -1]
        return (filtered - bias) / gain

    def _settle(self, rows: np.ndarray, made: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Set the filters to the steady state of the first row, and return its volts, twice."""
        first = np.zeros(len(self._scales) * _LANES)
        first[: len(self._columns)] = np.concatenate([rows[0], made[0]])[columns]
        volts = self._scales[:, _BIAS] + self._scales[:, _GAIN] * first.reshape(-1, _LANES)
        volts = np.clip(volts, self._scales[:, _LOW], self._scales[:, _HIGH])
        self._waves[:] = (self._settling * volts[:, None, None, :]).reshape(self._waves.shape)
        return np.hstack([volts, volts])
