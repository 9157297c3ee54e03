"""Candidate starts of a record in the session, and the choice of those that explain it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from replays.score.alignment.repeats import find_repeats
from replays.score.alignment.single_start import MIN_LIKENESS, MIN_ROWS, Alignment, RowSource, find_busiest, follow
from replays.score.records.stimulus import Exact
from replays.score.waveform import Waveform, fit_stretch, fit_waveform

_NOISES = 1.2
"""Largest residual, in nominal noises, that counts as noise alone."""
_BLOCK_ROWS = 200
"""Rows of a block by which residuals are compared: its variance has a standard error of a tenth."""
_MIN_INVERTED = 4
"""Number of starts of which some must be upright, if inverted ones are due to a shift by half a period."""
_MIN_POWER_PART = 0.25
"""Power of a block over the mean one, above which the block is compared."""
EQUAL_BALANCE_PART = 0.98
"""Part of the largest balance above which balances count as equal: the ends of a record cut a period."""
_MAX_COMPARED = 3
"""Signals by which starts are compared; each costs a fit."""
_MAX_SEARCHED = 2
"""Number of these signals by which a start is selected for following."""
MAX_FOLLOWED = 4
"""Starts that are followed with all channels: the nearest ones, including those half a period later."""
_MIN_POWER_RATIO = 1.05
"""Ratio of residual powers below which starts are never distinguished."""
_DEVIATIONS = 6.0
"""Standard deviations of a residual's power within which starts are not distinguished."""
_SAME_ROWS = 0.5
"""Distance of starts that count as the same [rows]: half of a row is a quarter of the shortest period."""
_MAX_POWER_RATIO = 2.0
"""Residual power of a stretch over the least one, above which a start is not followed; clocks may differ."""
_EDGE_ROWS = 20
"""Tolerance at the ends of a session [rows], as it is not interpolated there."""
_OUTLIER_RATIO, _MAX_OUTLIER_PART = 10.0, 0.2
"""Residual over the median one above which a row is faulty, and the largest part of faulty rows."""
_STRETCH_QUANTILE = 0.25
"""Quantile of the stretches by which starts are compared: the correct one explains none after a lost sample."""
_MAX_LEFT, _MAX_LEFT_RATIO = 1e-3, 100.0
"""Part of a signal's power that is left by the best start, absolute and relative to the first signal's, above which the
signal is late or faulty."""
_STRETCHES = 6
"""Parts of a record, each with one stretch that is compared before the record is followed."""


class Candidates:
    """Candidate starts of a table, compared by the residual power of some signals in blocks of rows.

    Rows outside the session are not compared. Where a signal repeats, starts that explain their rows equally well are
    distinguished by the number of rows in the session, explained or not.
    """

    def __init__(
        self, one: RowSource, sources: Sequence[RowSource], stretches: Callable[[float], Sequence[tuple[int, int]]]
    ) -> None:
        """Select one signal to follow, and for comparison those that correlate least, as they repeat least."""
        others = sorted((each for each in sources if each is not one), key=lambda each: each.wire.likeness)
        self._one, self._default = one, stretches
        self._compared = [one, *(each for each in others if each.wire.likeness > MIN_LIKENESS)][:_MAX_COMPARED]
        self._searched = self._compared[:1]
        self._fits: list[tuple[np.ndarray, Alignment]] = []
        self._shifts: list[float] = []
        self._followed_numbers = set[int]()
        ends = np.linspace(0, len(one.values), _STRETCHES + 1).astype(int)
        length = stretches(0.0)[0][1] - stretches(0.0)[0][0]
        self._parts = [
            find_busiest([one], (low, high), length)
            for low, high in pairwise(ends.tolist())
            if high - low >= MIN_ROWS and np.isfinite(one.values[low:high]).any()
        ]
        loud = _MIN_POWER_PART * float(np.nanvar(one.values[slice(*stretches(0.0)[0])]))
        self._parts = [each for each in self._parts if np.nanvar(one.values[slice(*each)]) >= loud]
        self._busy = _busy_rows(one.values, stretches(0.0)[0])
        self._residuals: list[np.ndarray] = []
        self._least_power = math.inf

    def _measure_residuals(self, shift_s: float) -> np.ndarray:
        """Return the residual power of stretches from a start, nan for unexplained ones, shape (signals, n)."""
        powers = np.full((min(_MAX_SEARCHED, len(self._compared)), len(self._parts)), np.nan)
        for n, part in np.ndindex(powers.shape):
            one = self._compared[n]
            fit = fit_stretch(one.values, one.times_s, one.stimulus, one.offset_s + shift_s, self._parts[part])
            if fit is not None:
                powers[n, part] = max(float(np.var(fit.residual)), 1e-300)
        return powers

    def _residual_power(self, alignment: Alignment, one: RowSource) -> np.ndarray:
        """Return the residual power of blocks over that of noise; their whole power where unexplained, nan outside."""
        values, times_s, curve = alignment.even(one)
        fit = fit_waveform(values, times_s, one.stimulus, curve)
        if fit is not None and (odd := _find_outliers(fit)).any():
            # Without these rows, as a fault of a few rows would raise the residual of all blocks.
            values[np.rint((fit.times_s[odd] - times_s[0]) * one.rate_hz).astype(int)] = np.nan
            fit = fit_waveform(values, times_s, one.stimulus, curve)
        squares = np.full(alignment.rows, np.nan)
        squares[slice(*alignment.track.inside)] = np.nanvar(one.values)
        if fit is not None:
            squares[alignment.rows_at(fit.times_s)] = fit.residual**2
        power = _block_means((one.values - np.nanmean(one.values)) ** 2)
        # Noise of the DAQ, and of the session if its samples are the known signal.
        sources = 1.0 if isinstance(one.stimulus, Exact) else 2.0
        noise = (
            _NOISES * math.hypot(one.channel.noise_v, one.channel.lsb_v / math.sqrt(12.0)) / one.channel.sensitivity_v
        )
        loud = power > _MIN_POWER_PART * np.nanmean(power)
        return np.where(loud, _block_means(squares), np.nan) / (sources * noise**2)

    def _exceeds(self, power: np.ndarray, other: np.ndarray) -> bool:
        """Return whether a start has a higher residual than another, by the median blocks that both explain."""
        both = np.isfinite(power) & np.isfinite(other)
        compared = both.any(axis=1)
        limit = max(_MIN_POWER_RATIO, 1.0 + _DEVIATIONS * math.sqrt(2.0 / max(1, _BLOCK_ROWS * both.sum())))
        ratios = [
            np.median(here[use]) / max(np.median(there[use]), 1e-300)
            for here, there, use in zip(power[compared], other[compared], both[compared], strict=True)
        ]
        return bool(ratios) and float(np.mean(np.log(np.maximum(ratios, 1e-300)))) > math.log(limit)

    def find_best(self) -> list[Alignment]:
        """Return the starts that no other one surpasses: those with most explained rows first, then the nearest."""
        kept = [each for power, each in self._fits if not any(self._exceeds(power, other) for other, _ in self._fits)]
        if not kept and self._fits:
            kept = [min(self._fits, key=lambda each: float(np.nanmax(_medians(each[0]))))[1]]
        # A fault of a few rows raises the residual of all: a start must not win by placing them outside the session.
        least, excess = min(map(self.penalty, kept), default=0), self._stretch_excess()
        kept += [
            each for _, each in self._fits
            if excess[self._shifts.index(each.shift_s)] < math.log(_MIN_POWER_RATIO)
            and self.penalty(each) + MIN_ROWS // _EDGE_ROWS < least
        ]  # fmt: skip
        most = max((each.balance for each in kept), default=0)
        kept = [each for each in kept if each.balance >= 0.5 * most]

        def rank(each: Alignment) -> tuple[bool, int, float]:
            return each.balance <= EQUAL_BALANCE_PART * most, self.penalty(each), abs(each.shift_s)

        return sorted(kept, key=rank)

    @property
    def _settled(self) -> bool:
        """True if two starts have a residual of noise alone, and one of them has no unexplained row.

        A start that is off by half a period inverts the signal, so one of them must be upright, unless several are
        inverted: then the DAQ inverts.
        """
        alike = self.find_best() if self._least_power < 1.0 else []
        inverts = len(alike) >= _MIN_INVERTED and not any(each.upright for each in alike)
        return len(alike) > 1 and any(
            each.whole and (each.upright or inverts) and not self.count_outside(each) for each in alike
        )

    def search_more_signals(self) -> None:
        """Search starts by further signals, which may not repeat where the first one does."""
        self._searched, self._least_power = self._compared, math.inf
        self.follow_candidates(self.find_shifts())

    def count_outside(self, alignment: Alignment) -> int:
        """Return the number of rows outside the session, from a start, that are as loud as those in it."""
        first, last = alignment.track.inside
        loud = _MIN_POWER_PART * float(np.nanvar(self._one.values[first:last]))
        parts = [self._one.values[self._busy[0] : first], self._one.values[last : self._busy[1]]]
        return sum(len(part) for part in parts if len(part) >= _EDGE_ROWS and np.nanvar(part) >= loud)

    def penalty(self, alignment: Alignment) -> int:
        """Return the number of stretches of rows that are loud and outside the session, or in it and unexplained.

        A sample lost near an end must not place rows outside the session.
        """
        inside = alignment.track.inside[1] - alignment.track.inside[0]
        return (self.count_outside(alignment) + inside - alignment.track.explained) // _EDGE_ROWS

    def find_shifts(self) -> list[float]:
        """Return shifts at which the known signal repeats [s], by all rows and by those that the best start explains.

        A lost sample lowers the correlation of all rows, and the start that then explains most rows may place those
        before the lost sample outside the session.
        """
        alike = self.find_best()
        if not alike or self._settled:
            return []
        parts = [(0, len(self._one.values))]
        if self.count_outside(alike[0]) >= MIN_ROWS:
            parts.append(alike[0].track.inside)
        return [each for one in self._searched for each in self._find_shifts_in(one, alike[0], parts)]

    def _find_shifts_in(self, one: RowSource, best: Alignment, parts: Sequence[tuple[int, int]]) -> list[float]:
        """Return the shifts at which a signal matches parts of its record, by the clock of the best start [s]."""
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
        return [each - one.offset_s for each in late_s]

    def stretches(self, shift_s: float) -> list[tuple[int, int]]:
        """Return the stretches by which a start is followed; the last one is that with the least residual."""
        powers = self._residuals[self._shifts.index(shift_s)][0]
        best = [] if np.isnan(powers).all() else [self._parts[int(np.nanargmin(powers))]]
        return [*self._default(shift_s), *best]

    def _rows_inside(self, shift_s: float) -> int:
        """Return the number of rows in the session from a start, less quiet rows at the ends of the record.

        A DAQ that is started before the session, or stopped after it, records such rows.
        """
        one = self._one
        places = [(each - one.offset_s - shift_s - one.first_s) * one.rate_hz for each in one.stimulus.span_s]
        inside, busy = (min(b, places[1]) - max(a, places[0]) for a, b in ((0, len(one.values)), self._busy))
        return round(2.0 * max(0.0, busy) - inside)

    def _stretch_excess(self) -> np.ndarray:
        """Return the logarithm of each start's residual power over the least one, by its best stretches.

        A signal that no start explains, as a late input, distinguishes none.
        """
        residuals = np.array(self._residuals)
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # all-nan: unexplained stretches
            powers = [np.nanvar(each.values) for each in self._compared[: residuals.shape[1]]]
            left = np.nanmedian(np.nanmin(residuals, axis=0), axis=1) / powers
            shows = (left <= _MAX_LEFT) | (left <= _MAX_LEFT_RATIO * left[0])
            apart = np.log(residuals / np.nanmin(residuals, axis=0))[:, shows]
            return np.nanmean(np.nanquantile(apart, _STRETCH_QUANTILE, axis=2), axis=1)

    def follow_candidates(self, shifts: Sequence[float]) -> None:
        """Follow starts until two are equally good and have a residual of noise alone.

        Starts are ordered by the residual of their stretches, and at equal residuals by the number of rows in the
        session. Earlier candidates that were not followed are included.
        """
        one = self._one
        for shift_s in shifts:
            if all(abs(shift_s - each) * one.rate_hz >= _SAME_ROWS for each in self._shifts):
                self._shifts.append(shift_s)
                self._residuals.append(self._measure_residuals(shift_s))
        worse = self._stretch_excess()
        rows = np.array([-self._rows_inside(each) for each in self._shifts])
        order = np.lexsort((rows, np.floor(worse / math.log(_MIN_POWER_RATIO))))
        order = [n for n in order.tolist() if n not in self._followed_numbers][:MAX_FOLLOWED]
        # The very first one has the highest correlation over the whole record, and the most rows in the session.
        for n in order if self._fits else [0, *(each for each in order if each)]:
            if self._fits and (self._settled or not worse[n] < math.log(_MAX_POWER_RATIO)):
                return
            self._followed_numbers.add(n)
            shift_s = self._shifts[n]
            alignment = follow([one], shift_s, self.stretches(shift_s))
            own_s = alignment.own_s[one.name] if alignment else 0.0
            near = [abs(own_s - each.own_s[one.name]) * one.rate_hz for _, each in self._fits]
            if alignment is not None and min(near, default=math.inf) > _SAME_ROWS:
                power = np.array([self._residual_power(alignment, each) for each in self._compared])
                if np.isfinite(power).any():
                    self._fits.append((power, alignment))
                    self._least_power = min(self._least_power, float(np.nanmax(_medians(power))))


def _busy_rows(values: np.ndarray, stretch: tuple[int, int]) -> tuple[int, int]:
    """Return the rows of a record without quiet ones at its ends: the first row, and the row after the last.

    Args:
        values: Values of the record, shape (n,).
        stretch: Rows in which the signal changes most: the first row, and the row after the last.
    """
    centred = values - np.nanmean(values)
    power = _block_means(centred**2) - _block_means(centred) ** 2
    least = _MIN_POWER_PART * float(np.nanvar(centred[slice(*stretch)]))
    loud = np.flatnonzero(power >= min(least, _MIN_POWER_PART * float(np.nanmax(power, initial=0.0))))
    first, last = (int(loud[0]), int(loud[-1]) + 1) if len(loud) else (0, len(power))
    # The rows after the last whole block are as loud as that block.
    return first * _BLOCK_ROWS, len(values) if last == len(power) else last * _BLOCK_ROWS


def _find_outliers(fit: Waveform) -> np.ndarray:
    """Return whether the residual of each row is an outlier; none is if there are many, shape (n,)."""
    size = np.abs(fit.residual)
    odd = size > _OUTLIER_RATIO * float(np.median(size))
    return odd if odd.mean() < _MAX_OUTLIER_PART else np.zeros(len(odd), bool)


def trim_quiet_ends(alignment: Alignment, one: RowSource) -> Alignment:
    """Return an alignment without quiet rows at the ends of the session, when the DAQ was not connected yet."""
    values, times_s, curve = alignment.even(one)
    fit = fit_waveform(values, times_s, one.stimulus, curve)
    if fit is None:
        return alignment
    odd = alignment.rows_at(fit.times_s[_find_outliers(fit)])
    runs, (first, last) = list(alignment.track.runs), alignment.track.inside
    loud = _MIN_POWER_PART * float(np.nanvar(one.values[first:last]))
    start = int(odd[odd < runs[0].start + _BLOCK_ROWS].max(initial=runs[0].start - 1)) + 1
    if runs[0].start < start < runs[0].end and np.nanvar(one.values[runs[0].start : start]) < loud:
        first, runs[0] = start, replace(runs[0], start=start)
    end = int(odd[odd >= runs[-1].end - _BLOCK_ROWS].min(initial=runs[-1].end))
    if runs[-1].start < end < runs[-1].end and np.nanvar(one.values[end : runs[-1].end]) < loud:
        last, runs[-1] = end, replace(runs[-1], end=end)
    return replace(alignment, track=replace(alignment.track, runs=runs, inside=(first, last)))


def _medians(power: np.ndarray) -> np.ndarray:
    """Return the median block of each signal that has any."""
    return np.nanmedian(power[np.isfinite(power).any(axis=1)], axis=1)


def _block_means(values: np.ndarray) -> np.ndarray:
    """Return means over blocks of rows; nan for a block with mostly nan."""
    blocks = values[: len(values) // _BLOCK_ROWS * _BLOCK_ROWS].reshape(-1, _BLOCK_ROWS)
    count = np.isfinite(blocks).sum(axis=1)
    return np.where(2 * count >= _BLOCK_ROWS, np.nansum(blocks, axis=1) / np.maximum(count, 1), np.nan)
