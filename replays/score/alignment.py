"""Begin and time track of each table of a record: which begin explains it, and its rows at even instants."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from replays.score.repeats import find_repeats
from replays.score.stimulus import Stimulus
from replays.score.track import Follower, Track, follow_record
from replays.score.waveform import Waveform, fit_stretch, fit_waveform
from replays.score.wiring import Wire
from rig.channels import Channel

_STRETCHES_S = (0.25, 0.03)
"""Lengths of the stretch that is fitted first; the second where clocks are apart, or samples lost, in the first [s]."""
_NEAR_S = 5e-4
"""Time about a begin in which a stretch is looked for: correlation with clocks apart is off by so much."""
_FEWEST = 400
"""Rows of a stretch, at least."""
_SHARPER = 0.7
"""Part of the residual that the shorter stretch must leave, as it shows less of the clock."""
_SOUND = 0.5
"""Part of its power that the known signal explains in a channel by which a record is followed."""
_FOLLOWERS = 6
"""Channels by which a record is followed: more cost time, and fewer may all be faulty."""
_NOISES = 1.2
"""Nominal noises that a residual may have, for it to be nothing but noise."""
_BLOCK_ROWS = 200
"""Rows of a block by which residuals are compared: their variance is known to a tenth."""
_LOUD_PART = 0.25
"""Power of a block over the mean one, from which a begin shows in it."""
_SAME_BALANCE = 0.98
"""Part of the most explained rows, from which begins explain as many: a period is cut at the ends."""
_WHOLE = 0.999
"""Part of the rows in the session that are explained in a record that lies in it as a whole."""
_COMPARED = 3
"""Signals by which begins are compared: each costs a fit."""
_SEARCHED = 2
"""Number of these signals by which a begin is chosen before its record is followed."""
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
_WORSE = 2.0
"""Residual power of a stretch over the least one, from which a begin is not followed: the clocks may differ."""
_ROUNDS = 3
"""Searches for begins where the signal repeats, each by the clock that the last one found."""
_SOUND_PARTS = 0.25
"""Quantile of the stretches by which begins are compared: behind a lost sample, the right one explains none."""
_PARTS = 6
"""Parts of a record, of each of which a stretch is compared before all of it is followed."""
_FINER = 8
"""Places between two samples at which the begin of a stretch is looked for."""


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

    @property
    def inside_s(self) -> tuple[float, float]:
        """Times of the session at the first and the last row in it [s]."""
        own_s = self.first_s + next(iter(self.own_s.values()))
        return own_s + self.track.inside[0] / self.rate_hz, own_s + self.track.inside[1] / self.rate_hz

    @property
    def whole(self) -> bool:
        """Whether nearly all rows in the session are explained."""
        return self.judged() > _WHOLE

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


def _refined_s(one: Source, shift_s: float, stretch: tuple[int, int]) -> float:
    """Return the begin near another one from which a stretch is explained best [s]."""
    y, period_s = np.nan_to_num(one.values[slice(*stretch)]), 1.0 / one.rate_hz
    reach, n = math.ceil(_NEAR_S * one.rate_hz * _FINER), len(y)
    first_s = one.first_s + stretch[0] * period_s + one.late_s + shift_s
    grid_s = first_s + np.arange(-reach, _FINER * (n - 1) + reach + 1) * (period_s / _FINER)
    if grid_s[0] < one.stimulus.span_s[0] or grid_s[-1] > one.stimulus.span_s[1]:
        return shift_s
    known, _ = one.stimulus(grid_s)
    windows = np.lib.stride_tricks.sliding_window_view(known, _FINER * (n - 1) + 1)[:, ::_FINER]
    spread = np.maximum(windows.std(axis=1), 1e-12 * max(1e-300, float(known.std())))
    alike = np.abs(windows @ (y - y.mean())) / spread
    at = np.flatnonzero((alike[1:-1] >= alike[:-2]) & (alike[1:-1] > alike[2:])) + 1
    at = at[np.argsort(-alike[at])][:_FOLLOWED]
    shifts = [shift_s, *(shift_s + (at - reach) * period_s / _FINER)]
    fits = [fit_stretch(one.values, one.times_s, one.stimulus, one.late_s + each, stretch) for each in shifts]
    left = [math.inf if fit is None else float(np.var(fit.residual)) for fit in fits]
    return float(shifts[int(np.argmin(left))])


def _follow(sources: Sequence[Source], shift_s: float, stretches: Sequence[tuple[int, int]]) -> Alignment | None:
    """The record from one begin."""
    best: tuple[float, tuple[int, int], dict[str, Waveform]] | None = None
    near_s = _refined_s(sources[0], shift_s, stretches[0])
    for stretch, at_s in ((stretches[0], near_s), (stretches[1], shift_s)):
        fits = _begin_fits(sources, at_s, stretch)
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
    default = [_busiest(sources, (within[0], within[1]), round(each * one.rate_hz)) for each in _STRETCHES_S]

    def stretches(shift_s: float) -> list[tuple[int, int]]:
        """Stretches that lie in the session from a begin."""
        ends_s = [each - one.late_s - shift_s - one.first_s for each in one.stimulus.span_s]
        first, last = (min(rows, max(0, round(each * one.rate_hz))) for each in ends_s)
        if last - first < _FEWEST or (first <= default[0][0] and default[0][1] <= last):
            return default
        return [_busiest(sources, (first, last), round(each * one.rate_hz)) for each in _STRETCHES_S]

    if not one.wire.others_s:
        return _follow(sources, 0.0, default)
    begins = _Begins(one, sources, stretches)
    begins.try_all([0.0, *(each - one.wire.late_s for each in one.wire.others_s)])
    for _ in range(_ROUNDS):
        begins.try_all(begins.repeats())
    alike = begins.alike()
    found = [
        each for one in alike[:_FOLLOWED] if (each := _follow(sources, one.begin_s, stretches(one.begin_s))) is not None
    ]
    if not found:
        return _follow(sources, 0.0, default)
    most = max(each.balance for each in found)
    best = max(
        found, key=lambda each: (each.balance > _SAME_BALANCE * most, each.whole, each.upright, -abs(each.begin_s))
    )
    return replace(best, ambiguous=len(alike) > 1)


class _Begins:
    """Begins that are tried for a table, by the residual power of some signals in blocks of rows.

    Rows outside the session are not compared: where a signal repeats, begins that explain the same rows alike are told
    apart by how many rows lie in the session, explained or not.
    """

    def __init__(
        self, one: Source, sources: Sequence[Source], stretches: Callable[[float], Sequence[tuple[int, int]]]
    ) -> None:
        """Follow one signal, and compare others as well: of these the ones that are least like what repeats."""
        others = sorted((each for each in sources if each is not one), key=lambda each: each.wire.likeness)
        self._one, self._stretches = one, stretches
        self._compared = [one, *(each for each in others if each.wire.likeness > _SOUND)][:_COMPARED]
        self._tried: list[tuple[np.ndarray, Alignment]] = []
        self._shifts: list[float] = []
        ends = np.linspace(0, len(one.values), _PARTS + 1).astype(int)
        length = stretches(0.0)[0][1] - stretches(0.0)[0][0]
        self._parts = [
            _busiest([one], (low, high), length) for low, high in pairwise(ends.tolist()) if high - low >= _FEWEST
        ]
        loud = _LOUD_PART * float(np.nanvar(one.values[slice(*stretches(0.0)[0])]))
        self._parts = [each for each in self._parts if np.nanvar(one.values[slice(*each)]) >= loud]
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
        left = np.full(found.rows, np.nan)
        left[slice(*found.track.inside)] = np.nanvar(one.values)
        if fit is not None:
            explained, at = found.track.places(found.rows)
            row_at = np.zeros(len(values), int)
            row_at[at - int(at.min())] = np.flatnonzero(explained)
            left[row_at[np.rint((fit.times_s - times_s[0]) * one.rate_hz).astype(int)]] = fit.residual**2
        power = _block_means((one.values - np.nanmean(one.values)) ** 2)
        # The DAQ's and the session's.
        noise = (
            _NOISES * math.hypot(one.channel.noise_v, one.channel.lsb_v / math.sqrt(12.0)) / one.channel.sensitivity_v
        )
        return np.where(power > _LOUD_PART * np.nanmean(power), _block_means(left), np.nan) / (2.0 * noise**2)

    def _is_worse(self, power: np.ndarray, other: np.ndarray) -> bool:
        """Whether a begin leaves more than another where both are in the session, by the median blocks of signals."""
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
        most = max((each.balance for each in kept), default=0)
        kept = [each for each in kept if each.balance >= 0.5 * most]
        return sorted(kept, key=lambda each: (each.balance <= _SAME_BALANCE * most, not each.whole, abs(each.begin_s)))

    @property
    def _settled(self) -> bool:
        """Whether two begins leave nothing but the noise of DAQ and session, and one of them no row unexplained."""
        alike = self.alike() if self._least < 1.0 else []
        return len(alike) > 1 and any(each.whole and not self._goes_on(each) for each in alike)

    def _goes_on(self, found: Alignment) -> bool:
        """Return whether rows before or behind the session, from a begin, are as loud as those in it."""
        first, last = found.track.inside
        loud = _LOUD_PART * float(np.nanvar(self._one.values[first:last]))
        parts = [self._one.values[:first], self._one.values[last:]]
        return any(len(part) >= _FEWEST and np.nanvar(part) >= loud for part in parts)

    def repeats(self) -> list[float]:
        """Return shifts at which the known signal repeats, by all rows and by those that the best begin explains [s].

        A lost sample spoils the correlation of all rows, and the begin that then explains its rows best may leave those
        before the lost sample outside the session.
        """
        alike = self.alike()
        if not alike or self._settled:
            return []
        one = self._one
        values, times_s, curve = alike[0].even(one)
        rows, held = np.arange(len(values)), np.isfinite(values)
        values = np.interp(rows, rows[held], values[held])
        fit = fit_stretch(values, times_s, one.stimulus, curve[0], (0, len(values)))
        whole = np.nan_to_num(one.values, nan=float(np.nanmean(one.values)))
        if fit is None:
            return []
        late_s = [
            each
            for first, last in [(0, len(whole)), *([alike[0].track.inside] if self._goes_on(alike[0]) else [])]
            for each in find_repeats(whole[first:last], one.first_s + first / one.rate_hz, fit, one.stimulus)
        ]
        return [each - one.late_s for each in late_s]

    def try_all(self, shifts: Sequence[float]) -> None:
        """Try begins until two are alike and leave nothing but noise: first those that leave least of stretches."""
        one, fresh = self._one, list[float]()
        for shift_s in shifts:
            if all(abs(shift_s - each) * one.rate_hz >= _SAME_ROWS for each in [*self._shifts, *fresh]):
                fresh.append(shift_s)
        self._shifts += fresh
        self._left += [self._left_of(each) for each in fresh]
        if not fresh:
            return
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of stretches that no begin explains
            apart = np.log(np.array(self._left[-len(fresh) :]) / np.nanmin(self._left, axis=0))
            worse = np.nanmean(np.nanquantile(apart, _SOUND_PARTS, axis=2), axis=1)
        order = np.argsort(np.floor(worse / math.log(_ALIKE)), kind="stable")[:_FOLLOWED].tolist()
        # The first of all is what the whole record is most like, with the most rows in the session.
        for n in order if self._tried else [0, *(each for each in order if each)]:
            if self._tried and (self._settled or not worse[n] < math.log(_WORSE)):
                return
            shift_s = fresh[n]
            stretches = self._stretches(shift_s)
            found = _follow([one], shift_s, stretches)
            own_s = found.own_s[one.name] if found else 0.0
            near = [abs(own_s - each.own_s[one.name]) * one.rate_hz for _, each in self._tried]
            if found is not None and min(near, default=math.inf) > _SAME_ROWS:
                power = np.array([self._residual_power(found, each) for each in self._compared])
                if np.isfinite(power).any():
                    self._tried.append((power, found))
                    self._least = min(self._least, float(np.nanmax(_medians(power))))


def _medians(power: np.ndarray) -> np.ndarray:
    """Return the median block of each signal, of those that have any."""
    return np.nanmedian(power[np.isfinite(power).any(axis=1)], axis=1)


def _block_means(values: np.ndarray) -> np.ndarray:
    """Return means over blocks of rows; nan where most of a block is nan."""
    blocks = values[: len(values) // _BLOCK_ROWS * _BLOCK_ROWS].reshape(-1, _BLOCK_ROWS)
    count = np.isfinite(blocks).sum(axis=1)
    return np.where(2 * count >= _BLOCK_ROWS, np.nansum(blocks, axis=1) / np.maximum(count, 1), np.nan)
