"""Begins of a record in the session: which of those that are tried explains it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from replays.score.alignment.one_begin import FEWEST, SOUND, Alignment, Source, busiest, follow
from replays.score.alignment.repeats import find_repeats
from replays.score.records.stimulus import Exact
from replays.score.waveform import Waveform, fit_stretch, fit_waveform

_NOISES = 1.2
"""Nominal noises that a residual may have, for it to be nothing but noise."""
_BLOCK_ROWS = 200
"""Rows of a block by which residuals are compared: their variance is known to a tenth."""
_SEVERAL = 4
"""Number of begins among which some are upright where a signal is inverted half a period later."""
_LOUD_PART = 0.25
"""Power of a block over the mean one, from which a begin shows in it."""
SAME_BALANCE = 0.98
"""Part of the most explained rows, from which begins explain as many: a period is cut at the ends."""
_COMPARED = 3
"""Signals by which begins are compared: each costs a fit."""
_SEARCHED = 2
"""Number of these signals by which a begin is chosen before its record is followed."""
FOLLOWED = 4
"""Begins that are followed with all channels: the nearest ones, half a period later among them."""
_ALIKE = 1.05
"""Residual power over the least one up to which begins are not distinguished, at least."""
_DEVIATIONS = 6.0
"""Standard deviations of a residual's power within which begins are not distinguished."""
_SAME_ROWS = 0.5
"""Rows within which two begins are one: half of a row is a quarter of the shortest period."""
_WORSE = 2.0
"""Residual power of a stretch over the least one, from which a begin is not followed: the clocks may differ."""
_EDGE_ROWS = 20
"""Rows that begins may differ by at the ends of a session, as it is not interpolated there."""
_FAR, _FEW = 10.0, 0.2
"""Residual over the median one from which a row is faulty, and the part of the rows that may be."""
_SOUND_PARTS = 0.25
"""Quantile of the stretches by which begins are compared: after a lost sample, the right one explains none."""
_PARTS = 6
"""Parts of a record, of each of which a stretch is compared before all of it is followed."""


class Begins:
    """Begins that are tried for a table, by the residual power of some signals in blocks of rows.

    Rows outside the session are not compared: where a signal repeats, begins that explain the same rows alike are told
    apart by how many rows lie in the session, explained or not.
    """

    def __init__(
        self, one: Source, sources: Sequence[Source], stretches: Callable[[float], Sequence[tuple[int, int]]]
    ) -> None:
        """Follow one signal, and compare others as well: of these the ones that are least like what repeats."""
        others = sorted((each for each in sources if each is not one), key=lambda each: each.wire.likeness)
        self._one, self._default = one, stretches
        self._compared = [one, *(each for each in others if each.wire.likeness > SOUND)][:_COMPARED]
        self._searched = self._compared[:1]
        self._tried: list[tuple[np.ndarray, Alignment]] = []
        self._shifts: list[float] = []
        self._followed = set[int]()
        ends = np.linspace(0, len(one.values), _PARTS + 1).astype(int)
        length = stretches(0.0)[0][1] - stretches(0.0)[0][0]
        self._parts = [
            busiest([one], (low, high), length)
            for low, high in pairwise(ends.tolist())
            if high - low >= FEWEST and np.isfinite(one.values[low:high]).any()
        ]
        loud = _LOUD_PART * float(np.nanvar(one.values[slice(*stretches(0.0)[0])]))
        self._parts = [each for each in self._parts if np.nanvar(one.values[slice(*each)]) >= loud]
        self._busy = _busy_rows(one.values, stretches(0.0)[0])
        self._left: list[np.ndarray] = []
        self._least = math.inf

    def _left_of(self, shift_s: float) -> np.ndarray:
        """Residual power of the stretches of signals from a begin, nan where nothing explains one, shape (k, n)."""
        found = np.full((min(_SEARCHED, len(self._compared)), len(self._parts)), np.nan)
        for n, part in np.ndindex(found.shape):
            one = self._compared[n]
            fit = fit_stretch(one.values, one.times_s, one.stimulus, one.late_s + shift_s, self._parts[part])
            if fit is not None:
                found[n, part] = max(float(np.var(fit.residual)), 1e-300)
        return found

    def _residual_power(self, found: Alignment, one: Source) -> np.ndarray:
        """Residual power of a signal by block over that of noise; of all where nothing explains it, nan outside."""
        values, times_s, curve = found.even(one)
        fit = fit_waveform(values, times_s, one.stimulus, curve)
        if fit is not None and (odd := _outlying(fit)).any():
            # A fault of some rows would be in all blocks.
            values[np.rint((fit.times_s[odd] - times_s[0]) * one.rate_hz).astype(int)] = np.nan
            fit = fit_waveform(values, times_s, one.stimulus, curve)
        left = np.full(found.rows, np.nan)
        left[slice(*found.track.inside)] = np.nanvar(one.values)
        if fit is not None:
            left[found.rows_at(fit.times_s)] = fit.residual**2
        power = _block_means((one.values - np.nanmean(one.values)) ** 2)
        # The DAQ's, and the session's where its samples are the known signal.
        sources = 1.0 if isinstance(one.stimulus, Exact) else 2.0
        noise = (
            _NOISES * math.hypot(one.channel.noise_v, one.channel.lsb_v / math.sqrt(12.0)) / one.channel.sensitivity_v
        )
        return np.where(power > _LOUD_PART * np.nanmean(power), _block_means(left), np.nan) / (sources * noise**2)

    def _is_worse(self, power: np.ndarray, other: np.ndarray) -> bool:
        """Return whether a begin leaves more than another, by the median blocks of signals that both explain."""
        both = np.isfinite(power) & np.isfinite(other)
        compared = both.any(axis=1)
        limit = max(_ALIKE, 1.0 + _DEVIATIONS * math.sqrt(2.0 / max(1, _BLOCK_ROWS * both.sum())))
        ratios = [
            np.median(here[use]) / max(np.median(there[use]), 1e-300)
            for here, there, use in zip(power[compared], other[compared], both[compared], strict=True)
        ]
        return bool(ratios) and float(np.mean(np.log(np.maximum(ratios, 1e-300)))) > math.log(limit)

    def alike(self) -> list[Alignment]:
        """Return the begins that none of the others surpasses: with most explained rows first, then the nearest."""
        kept = [
            each for power, each in self._tried if not any(self._is_worse(power, other) for other, _ in self._tried)
        ]
        if not kept and self._tried:
            kept = [min(self._tried, key=lambda each: float(np.nanmax(_medians(each[0]))))[1]]
        # A fault of some rows spoils the residual of all: a begin must not win by leaving these outside the session.
        least, excess = min(map(self.unaccounted, kept), default=0), self._stretch_excess()
        kept += [
            each for _, each in self._tried
            if excess[self._shifts.index(each.begin_s)] < math.log(_ALIKE)
            and self.unaccounted(each) + FEWEST // _EDGE_ROWS < least
        ]  # fmt: skip
        most = max((each.balance for each in kept), default=0)
        kept = [each for each in kept if each.balance >= 0.5 * most]

        def rank(each: Alignment) -> tuple[bool, int, float]:
            return each.balance <= SAME_BALANCE * most, self.unaccounted(each), abs(each.begin_s)

        return sorted(kept, key=rank)

    @property
    def _settled(self) -> bool:
        """Return whether two begins leave nothing but noise of DAQ and session, and one of them no row unexplained.

        A begin half a period off inverts the signal, so that one must be upright; where none of several is, the DAQ
        inverts.
        """
        alike = self.alike() if self._least < 1.0 else []
        inverts = len(alike) >= _SEVERAL and not any(each.upright for each in alike)
        return len(alike) > 1 and any(
            each.whole and (each.upright or inverts) and not self.outside(each) for each in alike
        )

    def search_all(self) -> None:
        """Search begins by other signals as well: the first one may repeat where these do not."""
        self._searched, self._least = self._compared, math.inf
        self.try_all(self.repeats())

    def outside(self, found: Alignment) -> int:
        """Return how many rows before and behind the session, from a begin, are as loud as those in it."""
        first, last = found.track.inside
        loud = _LOUD_PART * float(np.nanvar(self._one.values[first:last]))
        parts = [self._one.values[self._busy[0] : first], self._one.values[last : self._busy[1]]]
        return sum(len(part) for part in parts if len(part) >= _EDGE_ROWS and np.nanvar(part) >= loud)

    def unaccounted(self, found: Alignment) -> int:
        """Return how many stretches of rows are loud and outside the session, or inside and not explained.

        A sample that is lost near an end must not stand outside of the session.
        """
        inside = found.track.inside[1] - found.track.inside[0]
        return (self.outside(found) + inside - found.track.explained) // _EDGE_ROWS

    def repeats(self) -> list[float]:
        """Return shifts at which the known signal repeats, by all rows and by those that the best begin explains [s].

        A lost sample spoils the correlation of all rows, and the begin that then explains its rows best may leave those
        before the lost sample outside the session.
        """
        alike = self.alike()
        if not alike or self._settled:
            return []
        parts = [(0, len(self._one.values))]
        if self.outside(alike[0]) >= FEWEST:
            parts.append(alike[0].track.inside)
        return [each for one in self._searched for each in self._repeats_of(one, alike[0], parts)]

    def _repeats_of(self, one: Source, best: Alignment, parts: Sequence[tuple[int, int]]) -> list[float]:
        """Return shifts at which a signal is like some parts of its record, by the clock of the best begin [s]."""
        values, times_s, curve = best.even(one)
        rows, held = np.arange(len(values)), np.isfinite(values)
        values = np.interp(rows, rows[held], values[held])
        fit = fit_stretch(values, times_s, one.stimulus, curve[0], (0, len(values)))
        whole = np.nan_to_num(one.values, nan=float(np.nanmean(one.values)))
        if fit is None:
            return []
        late_s = [
            each
            for first, last in parts
            for each in find_repeats(whole[first:last], one.first_s + first / one.rate_hz, fit, one.stimulus)
        ]
        return [each - one.late_s for each in late_s]

    def stretches(self, shift_s: float) -> list[tuple[int, int]]:
        """Return stretches by which a begin is followed, the last without a lost sample if another one has one."""
        left = self._left[self._shifts.index(shift_s)][0]
        best = [] if np.isnan(left).all() else [self._parts[int(np.nanargmin(left))]]
        return [*self._default(shift_s), *best]

    def _rows_inside(self, shift_s: float) -> int:
        """Return how many rows lie in the session from a begin; quiet ones at the ends of the record count against it.

        A DAQ that was started before the session, or stopped after it, has such rows.
        """
        one = self._one
        places = [(each - one.late_s - shift_s - one.first_s) * one.rate_hz for each in one.stimulus.span_s]
        inside, busy = (min(b, places[1]) - max(a, places[0]) for a, b in ((0, len(one.values)), self._busy))
        return round(2.0 * max(0.0, busy) - inside)

    def _stretch_excess(self) -> np.ndarray:
        """Return the logarithm of each begin's residual power over the least, by its soundest stretches."""
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of stretches that no begin explains
            apart = np.log(np.array(self._left) / np.nanmin(self._left, axis=0))
            return np.nanmean(np.nanquantile(apart, _SOUND_PARTS, axis=2), axis=1)

    def try_all(self, shifts: Sequence[float]) -> None:
        """Follow begins until two are alike and leave nothing but noise.

        First come those that leave least of stretches; of those that leave as little, those with most rows in the
        session. Those that were looked at before and not followed count as well.
        """
        one = self._one
        for shift_s in shifts:
            if all(abs(shift_s - each) * one.rate_hz >= _SAME_ROWS for each in self._shifts):
                self._shifts.append(shift_s)
                self._left.append(self._left_of(shift_s))
        worse = self._stretch_excess()
        rows = np.array([-self._rows_inside(each) for each in self._shifts])
        order = np.lexsort((rows, np.floor(worse / math.log(_ALIKE))))
        order = [n for n in order.tolist() if n not in self._followed][:FOLLOWED]
        # The first of all is what the whole record is most like, with the most rows in the session.
        for n in order if self._tried else [0, *(each for each in order if each)]:
            if self._tried and (self._settled or not worse[n] < math.log(_WORSE)):
                return
            self._followed.add(n)
            shift_s = self._shifts[n]
            found = follow([one], shift_s, self.stretches(shift_s))
            own_s = found.own_s[one.name] if found else 0.0
            near = [abs(own_s - each.own_s[one.name]) * one.rate_hz for _, each in self._tried]
            if found is not None and min(near, default=math.inf) > _SAME_ROWS:
                power = np.array([self._residual_power(found, each) for each in self._compared])
                if np.isfinite(power).any():
                    self._tried.append((power, found))
                    self._least = min(self._least, float(np.nanmax(_medians(power))))


def _busy_rows(values: np.ndarray, stretch: tuple[int, int]) -> tuple[int, int]:
    """Return the rows of a record without quiet ones at its ends: the first one, and the one after the last.

    Args:
        values: Of the record, shape (n,).
        stretch: Rows in which the signal changes most: the first one, and the one after the last.
    """
    centred = values - np.nanmean(values)
    power = _block_means(centred**2) - _block_means(centred) ** 2
    least = _LOUD_PART * float(np.nanvar(centred[slice(*stretch)]))
    loud = np.flatnonzero(power >= min(least, _LOUD_PART * float(np.nanmax(power, initial=0.0))))
    first, last = (int(loud[0]), int(loud[-1]) + 1) if len(loud) else (0, len(power))
    # What is left after the last whole block counts as that block does.
    return first * _BLOCK_ROWS, len(values) if last == len(power) else last * _BLOCK_ROWS


def _outlying(fit: Waveform) -> np.ndarray:
    """Return which rows of a fit are far off what most are, if few are, shape (n,)."""
    size = np.abs(fit.residual)
    odd = size > _FAR * float(np.median(size))
    return odd if odd.mean() < _FEW else np.zeros(len(odd), bool)


def trimmed(found: Alignment, one: Source) -> Alignment:
    """Return an alignment without quiet rows at the ends of the session: the DAQ was not connected yet."""
    values, times_s, curve = found.even(one)
    fit = fit_waveform(values, times_s, one.stimulus, curve)
    if fit is None:
        return found
    odd = found.rows_at(fit.times_s[_outlying(fit)])
    runs, (first, last) = list(found.track.runs), found.track.inside
    loud = _LOUD_PART * float(np.nanvar(one.values[first:last]))
    begin = int(odd[odd < runs[0].begin + _BLOCK_ROWS].max(initial=runs[0].begin - 1)) + 1
    if runs[0].begin < begin < runs[0].end and np.nanvar(one.values[runs[0].begin : begin]) < loud:
        first, runs[0] = begin, replace(runs[0], begin=begin)
    end = int(odd[odd >= runs[-1].end - _BLOCK_ROWS].min(initial=runs[-1].end))
    if runs[-1].begin < end < runs[-1].end and np.nanvar(one.values[end : runs[-1].end]) < loud:
        last, runs[-1] = end, replace(runs[-1], end=end)
    return replace(found, track=replace(found.track, runs=runs, inside=(first, last)))


def _medians(power: np.ndarray) -> np.ndarray:
    """Return the median block of each signal, of those that have any."""
    return np.nanmedian(power[np.isfinite(power).any(axis=1)], axis=1)


def _block_means(values: np.ndarray) -> np.ndarray:
    """Return means over blocks of rows; nan where most of a block is nan."""
    blocks = values[: len(values) // _BLOCK_ROWS * _BLOCK_ROWS].reshape(-1, _BLOCK_ROWS)
    count = np.isfinite(blocks).sum(axis=1)
    return np.where(2 * count >= _BLOCK_ROWS, np.nansum(blocks, axis=1) / np.maximum(count, 1), np.nan)
