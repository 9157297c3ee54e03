"""Begin and time track of each table of a record: which begin explains it, and its rows at even instants."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from replays.score.stimulus import Stimulus
from replays.score.track import Follower, Track, follow_record
from replays.score.waveform import Waveform, fit_stretch, fit_waveform
from replays.score.wiring import Wire
from rig.channels import Channel

_STRETCHES_S = (0.25, 0.03)
"""Lengths of the stretch that is fitted first; the second where clocks are apart, or samples lost, in the first [s]."""
_FEWEST = 400
"""Rows of a stretch, at least."""
_SHARPER = 0.7
"""Part of the residual that the shorter stretch must leave, as it shows less of the clock."""
_SOUND = 0.5
"""Part of its power that the known signal explains in a channel by which a record is followed."""
_FOLLOWERS = 6
"""Channels by which a record is followed: more cost time, and fewer may all be faulty."""
_NOISES = 1.5
"""Noises of the channel, the DAQ's and the session's together, in a residual that is nothing but noise."""
_BLOCK_ROWS = 200
"""Rows of a block by which residuals are compared: their variance is known to a tenth."""
_LOUD_PART = 0.25
"""Power of a block over the mean one, from which a begin shows in it."""
_SAME_BALANCE = 0.98
"""Part of the most explained rows, from which begins explain as many: a period is cut at the ends."""
_FOLLOWED = 4
"""Begins that are followed with all channels: the nearest ones, half a period later among them."""
_ALIKE = 1.05
"""Residual power over the least one up to which begins are not told from one another, at least."""
_DEVIATIONS = 6.0
"""Standard deviations of a residual's power within which begins are not told from one another."""
_MAX_DRIFT = 0.02
"""Clock error of a DAQ, at most: a fit with more of it found something else."""
_SAME_ROWS = 0.5
"""Rows within which two begins are one: half of a row is a quarter of the shortest period."""
_WORSE = 4.0
"""Residual power of a stretch over the least one, from which a begin is not followed: the clocks may differ."""
_MOST, _FINER, _LIKE = 1 << 17, 4, 12
"""Samples by which other beginnings are looked for, places between two of them, and how many are told."""

_EDGE_ROWS = 8
"""Rows before and after the session at which a begin is looked for, too: a peak needs both its sides."""


@dataclass
class Source:
    """One recorded signal and what is known of it.

    Attributes:
        name: Of the signal.
        channel: Its channel in the session.
        wire: How it is connected.
        values: As recorded, in the channel's unit, shape (rows,).
        first_s: Time of its first row by the clock of the file [s].
        rate_hz: Rows a second by that clock [Hz].
        stimulus: The known signal, below half of the rate.
        session_s: Time of the session's first row [s].
    """

    name: str
    channel: Channel
    wire: Wire
    values: np.ndarray
    first_s: float
    rate_hz: float
    stimulus: Stimulus
    session_s: float

    @property
    def late_s(self) -> float:
        """Time of the session less time of the file [s]."""
        return self.wire.own_s + self.session_s

    @property
    def times_s(self) -> np.ndarray:
        """Times of its rows by the clock of the file [s], shape (rows,)."""
        return self.first_s + np.arange(len(self.values)) / self.rate_hz


@dataclass(frozen=True)
class Alignment:
    """Where the rows of a table lie in the session.

    Attributes:
        names: Signals of the table.
        track: The rows.
        own_s: Session less file time where the track's time error is 0, of the signals that were followed [s].
        first_s, rate_hz, rows: Time of the first row [s], rows a second [Hz], and their number.
        upright: Number of signals with a positive gain.
        begin_s: Time by which the begin is later in the session than the wires have it [s].
        ambiguous: Whether other begins explain the record as well.
    """

    names: tuple[str, ...]
    track: Track
    own_s: dict[str, float]
    first_s: float
    rate_hz: float
    rows: int
    upright: int = 0
    begin_s: float = 0.0
    ambiguous: bool = False

    @property
    def balance(self) -> int:
        """Explained rows less those in the session that nothing explains."""
        return 2 * self.track.explained - (self.track.inside[1] - self.track.inside[0])

    def even(self, source: Source) -> tuple[np.ndarray, np.ndarray, tuple[float, float, float]]:
        """Values of a signal at even instants, nan where none is explained.

        Returns:
            Values, their times by the clock of the file [s], each shape (n,), and session less file time by powers of
            the time from the middle [s, 1, 1/s].
        """
        explained, at = self.track.places(self.rows)
        low, high = int(at.min()), int(at.max())
        values = np.full(high - low + 1, np.nan)
        values[at - low] = source.values[explained]
        line = self.track.line(0.5 * (low + high)) * self.rate_hz ** (np.arange(3.0) - 1.0)
        own_s = self.own_s.get(source.name, source.late_s + self.begin_s)
        curve = float(line[0]) + own_s, float(line[1]), float(line[2])
        return values, self.first_s + np.arange(low, high + 1) / self.rate_hz, curve

    def judged(self) -> float:
        """Part of the rows in the session that are explained."""
        return self.track.explained / max(1, self.track.inside[1] - self.track.inside[0])


def _busiest(sources: Sequence[Source], within: tuple[int, int], length: int) -> tuple[int, int]:
    """The stretch of a table where its signals change most."""
    first, last = within
    length = min(last - first, max(_FEWEST, length))
    power = np.zeros(last - first)
    for one in sources:
        steps = np.nan_to_num(np.diff(one.values[first:last], append=one.values[last - 1])) ** 2
        power += steps / max(float(steps.sum()), 1e-300)
    sums = np.concatenate([[0.0], np.cumsum(power)])
    begin = first + int(np.argmax(sums[length:] - sums[:-length]))
    return begin, begin + length


def _begin_fits(sources: Sequence[Source], shift_s: float, stretch: tuple[int, int]) -> dict[str, Waveform]:
    """Fits of a stretch from one begin, of the signals that are found in it."""
    found = {}
    for one in sources:
        fit = fit_stretch(one.values, one.times_s, one.stimulus, one.late_s + shift_s, stretch)
        if fit is not None and fit.likeness > _SOUND and abs(fit.drift) < _MAX_DRIFT:
            found[one.name] = fit
    return found


def _follow(sources: Sequence[Source], shift_s: float, stretches: Sequence[tuple[int, int]]) -> Alignment | None:
    """The record from one begin."""
    best: tuple[float, tuple[int, int], dict[str, Waveform]] | None = None
    for stretch in stretches:
        fits = _begin_fits(sources, shift_s, stretch)
        if fits:
            left = float(
                np.median([np.std(each.residual) / abs(each.gain) / np.std(each.known) for each in fits.values()])
            )
            if best is None or len(fits) > 2 * len(best[2]) or left < _SHARPER * best[0]:
                best = left, stretch, fits
    if best is None:
        return None
    _, stretch, fits = best
    one = sources[0]
    middle_s = one.first_s + (sum(stretch) // 2) / one.rate_hz

    def information(name: str) -> float:
        fit = fits[name]
        return float(np.mean(fit.slope**2)) * fit.gain**2 / max(float(np.var(fit.residual)), 1e-300)

    order = sorted(fits, key=information, reverse=True)
    pace = float(np.median([fits[name].drift for name in order[:_FOLLOWERS]]))
    own_s = {name: float(fits[name].late_at(np.array([middle_s]))[0]) for name in order}
    by_name = {each.name: each for each in sources}
    followers, rows = [], len(one.values)
    for name in order[:_FOLLOWERS]:
        fit, source = fits[name], by_name[name]
        step = source.channel.lsb_v / abs(source.channel.sensitivity_v)
        # A slow signal stays on one count for some rows, whose errors are then alike.
        held_rows = step * one.rate_hz / max(float(np.sqrt(np.mean(fit.slope**2))), 1e-300)
        alike = step * math.sqrt(min(float(rows), max(0.0, held_rows - 1.0)) / 12.0)
        noise = max(float(np.std(fit.residual)), 0.3 * step, 1e-9 * float(np.std(fit.values)))
        noise = math.hypot(noise, alike)
        followers.append(Follower(source.values, source.stimulus, own_s[name], fit.gain, fit.offset, noise))
    track = follow_record(followers, one.first_s, 1.0 / one.rate_hz, rows, stretch, pace)
    if not track.runs:
        return None
    return Alignment(
        tuple(by_name), track, own_s, one.first_s, one.rate_hz, rows,
        sum(each.gain > 0.0 for each in fits.values()), shift_s,
    )  # fmt: skip


def _beginnings(found: Waveform, stimulus: Stimulus) -> list[float]:
    """Shifts of time after which the known signal is as like what was recorded, by the clock of a fit [s].

    The likeliest are first. Where a signal nearly repeats, a fit finds its clock from any beginning.
    """
    from scipy.signal import correlate

    low, high = stimulus.span_s
    step_s = (1.0 + found.drift) * (found.times_s[-1] - found.times_s[0]) / (len(found.times_s) - 1)
    rows = math.floor((high - low) / step_s)
    y = found.values[: min(_MOST, rows // 2)]
    n = len(y)
    curve = np.zeros((rows - n + 2 * _EDGE_ROWS + 1, _FINER))
    for phase in range(_FINER):
        s, _ = stimulus(low + (np.arange(rows - 1) + phase / _FINER) * step_s)
        s = np.pad(s, (_EDGE_ROWS, _EDGE_ROWS + 1))  # so that a begin at the session's first row is a peak, too
        sums, squares = (np.cumsum(np.concatenate([[0.0], each])) for each in (s, s**2))
        power = squares[n:] - squares[:-n] - (sums[n:] - sums[:-n]) ** 2 / n
        alike = correlate(s, y - y.mean(), "valid", "fft") / np.sqrt(np.maximum(power, 1e-12 * power.max()))
        curve[:, phase] = np.abs(alike)
    curve = curve.ravel()
    at = np.flatnonzero((curve[1:-1] > curve[:-2]) & (curve[1:-1] >= curve[2:])) + 1
    bend = curve[at - 1] - 2.0 * curve[at] + curve[at + 1]
    aside = 0.5 * (curve[at - 1] - curve[at + 1]) / bend
    best = np.argsort(-(curve[at] - 0.25 * (curve[at - 1] - curve[at + 1]) * aside))[:_LIKE]
    began_s = found.times_s[0] + float(found.late_at(found.times_s[:1])[0])
    return (low + ((at[best] + aside[best]) / _FINER - _EDGE_ROWS) * step_s - began_s).tolist()


def align(sources: Sequence[Source]) -> Alignment | None:
    """Align the signals of one table with the session; None where none of them is found in it."""
    if not sources or len(sources[0].values) < _FEWEST:
        return None
    one = max(sources, key=lambda each: each.wire.likeness)
    rows = len(one.values)
    within_s = one.wire.within_s
    within = [min(rows, max(0, round((each - one.first_s) * one.rate_hz))) for each in within_s]
    if within[1] - within[0] < _FEWEST:
        within = [0, rows]
    stretches = [_busiest(sources, (within[0], within[1]), round(each * one.rate_hz)) for each in _STRETCHES_S]
    if not one.wire.others_s:
        return _follow(sources, 0.0, stretches)
    begins = _Begins(one, stretches)
    begins.try_all([0.0])
    begins.try_all(begins.repeats())
    begins.try_all([each - one.wire.late_s for each in one.wire.others_s])
    begins.try_all(begins.repeats())
    alike = begins.alike()
    found = [each for one in alike[:_FOLLOWED] if (each := _follow(sources, one.begin_s, stretches)) is not None]
    if not found:
        return _follow(sources, 0.0, stretches)
    most = max(each.balance for each in found)
    best = max(found, key=lambda each: (each.balance > _SAME_BALANCE * most, each.upright, -abs(each.begin_s)))
    return replace(best, ambiguous=len(alike) > 1)


class _Begins:
    """Begins that are tried for a table, by the residual power of one signal in blocks of rows.

    Rows outside the session are not compared: where a signal repeats, begins that explain the same rows alike are told
    apart by how many rows lie in the session, explained or not.
    """

    def __init__(self, one: Source, stretches: Sequence[tuple[int, int]]) -> None:
        self._one, self._stretches = one, stretches
        self._tried: list[tuple[np.ndarray, Alignment]] = []
        self._shifts: list[float] = []
        self._least = math.inf
        power = _block_means((one.values - np.nanmean(one.values)) ** 2)
        self._loud = power > _LOUD_PART * np.nanmean(power)

    def _residual_power(self, found: Alignment) -> np.ndarray:
        """Residual power by block [unit^2]; that of the signal where nothing explains it, nan outside the session."""
        one = self._one
        values, times_s, curve = found.even(one)
        fit = fit_waveform(values, times_s, one.stimulus, curve)
        left = np.full(found.rows, np.nan)
        left[slice(*found.track.inside)] = np.nanvar(one.values)
        if fit is not None:
            explained, at = found.track.places(found.rows)
            row_at = np.zeros(len(values), int)
            row_at[at - int(at.min())] = np.flatnonzero(explained)
            left[row_at[np.rint((fit.times_s - times_s[0]) * one.rate_hz).astype(int)]] = fit.residual**2
        return np.where(self._loud, _block_means(left), np.nan)

    def _is_worse(self, power: np.ndarray, other: np.ndarray) -> bool:
        """Whether a begin leaves more than another where both are in the session, by the median block."""
        both = np.isfinite(power) & np.isfinite(other)
        limit = max(_ALIKE, 1.0 + _DEVIATIONS * math.sqrt(2.0 / max(1, _BLOCK_ROWS * both.sum())))
        return bool(both.any()) and float(np.median(power[both])) > limit * float(np.median(other[both]))

    def alike(self) -> list[Alignment]:
        """Return the begins that none of the others surpasses: with most explained rows first, then the nearest."""
        kept = [
            each for power, each in self._tried if not any(self._is_worse(power, other) for other, _ in self._tried)
        ]
        if not kept and self._tried:
            kept = [min(self._tried, key=lambda each: float(np.nanmedian(each[0])))[1]]
        most = max((each.balance for each in kept), default=0)
        kept = [each for each in kept if each.balance >= 0.5 * most]
        return sorted(kept, key=lambda each: (each.balance <= _SAME_BALANCE * most, abs(each.begin_s)))

    @property
    def _settled(self) -> bool:
        """Whether two begins leave nothing but noise, the DAQ's and the session's."""
        noise = 2.0 * _NOISES * self._one.channel.noise_v / self._one.channel.sensitivity_v
        return self._least < noise**2 and len(self.alike()) > 1

    def repeats(self) -> list[float]:
        """Return shifts at which the known signal repeats, from the best begin [s]."""
        alike = self.alike()
        if not alike or self._settled:
            return []
        values, times_s, curve = alike[0].even(self._one)
        rows, held = np.arange(len(values)), np.isfinite(values)
        values = np.interp(rows, rows[held], values[held])
        fit = fit_stretch(values, times_s, self._one.stimulus, curve[0], (0, len(values)))
        shifts = [] if fit is None else _beginnings(fit, self._one.stimulus)
        return [alike[0].begin_s + sign * each for each in shifts for sign in (1.0, -1.0)]

    def try_all(self, shifts: Sequence[float]) -> None:
        """Try begins until two are alike and leave nothing but noise."""
        one = self._one
        left = math.inf
        for shift_s in shifts:
            if any(abs(shift_s - each) * one.rate_hz < _SAME_ROWS for each in self._shifts):
                continue
            if self._settled:
                return
            self._shifts.append(shift_s)
            fit = fit_stretch(one.values, one.times_s, one.stimulus, one.late_s + shift_s, self._stretches[0])
            if fit is None or float(np.var(fit.residual)) > _WORSE * left:
                continue
            left = min(left, float(np.var(fit.residual)))
            found = _follow([one], shift_s, self._stretches)
            own_s = found.own_s[one.name] if found else 0.0
            near = [abs(own_s - each.own_s[one.name]) * one.rate_hz for _, each in self._tried]
            if found is not None and min(near, default=math.inf) > _SAME_ROWS:
                power = self._residual_power(found)
                if np.isfinite(power).any():
                    self._tried.append((power, found))
                    self._least = min(self._least, float(np.nanmedian(power)))


def _block_means(values: np.ndarray) -> np.ndarray:
    """Return means over blocks of rows; nan where most of a block is nan."""
    blocks = values[: len(values) // _BLOCK_ROWS * _BLOCK_ROWS].reshape(-1, _BLOCK_ROWS)
    count = np.isfinite(blocks).sum(axis=1)
    return np.where(2 * count >= _BLOCK_ROWS, np.nansum(blocks, axis=1) / np.maximum(count, 1), np.nan)
