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
"""Noises of the channel within which a record's end counts as idle."""
_IDLE_ROWS = 200
"""Rows by which idleness is judged: their variance is known to a tenth."""
_ALIKE = 1.05
"""Residual power over the least one up to which begins are not told from one another, at least."""
_DEVIATIONS = 6.0
"""Standard deviations of a residual's power within which begins are not told from one another."""
_MAX_DRIFT = 0.02
"""Clock error of a DAQ, at most: a fit with more of it found something else."""
_SAME_ROWS = 2.0
"""Rows within which two begins are one."""
_WORSE = 4.0
"""Residual power of a stretch over the least one, from which a begin is not followed: the clocks may differ."""
_MOST, _FINER, _LIKE = 1 << 17, 4, 12
"""Samples by which other beginnings are looked for, places between two of them, and how many are told."""


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
        alike: Other begins that explain the record as well.
    """

    names: tuple[str, ...]
    track: Track
    own_s: dict[str, float]
    first_s: float
    rate_hz: float
    rows: int
    upright: int = 0
    begin_s: float = 0.0
    alike: tuple[Alignment, ...] = ()

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

    def judged(self) -> tuple[float, float, float]:
        """Part of the rows in the session that are explained; and its least and most over all begins that are alike."""
        tracks = [self.track, *(each.track for each in self.alike)]
        parts = [each.explained / max(1, each.inside[1] - each.inside[0]) for each in tracks]
        return parts[0], min(parts), max(parts)


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
    followers = []
    for name in order[:_FOLLOWERS]:
        fit, source = fits[name], by_name[name]
        step = source.channel.lsb_v / abs(source.channel.sensitivity_v)
        noise = max(float(np.std(fit.residual)), 0.3 * step, 1e-9 * float(np.std(fit.values)))
        followers.append(Follower(source.values, source.stimulus, own_s[name], fit.gain, fit.offset, noise))
    rows = len(one.values)
    track = follow_record(followers, one.first_s, 1.0 / one.rate_hz, rows, stretch, pace)
    if not track.runs:
        return None
    return Alignment(
        tuple(by_name), track, own_s, one.first_s, one.rate_hz, rows,
        sum(each.gain > 0.0 for each in fits.values()), shift_s,
    )  # fmt: skip


def _active(source: Source) -> tuple[int, int]:
    """First and last row of a signal that is not idle at the record's ends."""
    parts = len(source.values) // _IDLE_ROWS
    if not parts:
        return 0, len(source.values)
    blocks = np.nan_to_num(source.values[: parts * _IDLE_ROWS]).reshape(parts, -1)
    quiet = _NOISES * math.hypot(source.channel.noise_v, source.channel.lsb_v) / abs(source.channel.sensitivity_v)
    busy = np.flatnonzero(blocks.std(axis=1) > quiet)
    return (int(busy[0]) * _IDLE_ROWS, (int(busy[-1]) + 1) * _IDLE_ROWS) if len(busy) else (0, len(source.values))


def _cost(found: Alignment, source: Source, active: tuple[int, int]) -> tuple[float, float]:
    """Power that a begin leaves, a row that is not idle, and a row that is explained [unit^2]."""
    values, times_s, curve = found.even(source)
    fit = fit_waveform(values, times_s, source.stimulus, curve[0], curve=curve)
    explained, _ = found.track.places(found.rows)
    rows, held = active[1] - active[0], int(explained[slice(*active)].sum())
    whole = float(np.nanvar(source.values[slice(*active)]))
    left = whole if fit is None else float(np.var(fit.residual))
    return (held * left + (rows - held) * whole) / max(1, rows), left


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
    curve = np.zeros((rows - n, _FINER))
    for phase in range(_FINER):
        s, _ = stimulus(low + (np.arange(rows - 1) + phase / _FINER) * step_s)
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
    return (low + (at[best] + aside[best]) * (step_s / _FINER) - began_s).tolist()


def align(sources: Sequence[Source]) -> Alignment | None:
    """Align the signals of one table with the session; None where none of them is found in it.

    A begin counts only where all that is not idle lies in the session, if one does.
    """
    if not sources or len(sources[0].values) < _FEWEST:
        return None
    one = max(sources, key=lambda each: each.wire.likeness)
    rows = len(one.values)
    within_s = one.wire.within_s
    within = [min(rows, max(0, round((each - one.first_s) * one.rate_hz))) for each in within_s]
    if within[1] - within[0] < _FEWEST:
        within = [0, rows]
    stretches = [_busiest(sources, (within[0], within[1]), round(each * one.rate_hz)) for each in _STRETCHES_S]
    first = _follow(sources, 0.0, stretches)
    if not one.wire.others_s:
        return first
    begins = _Begins(sources, one, stretches)
    if first is not None:
        begins.add(first)
    begins.try_all(begins.repeats())
    begins.try_all([each - one.wire.late_s for each in one.wire.others_s])
    begins.try_all(begins.repeats())
    return begins.best() or first


class _Begins:
    """Begins that are tried for a table, by what each leaves of one signal.

    Rows outside the session count as unexplained, so that a begin from which the record stays inside is preferred.
    """

    def __init__(self, sources: Sequence[Source], one: Source, stretches: Sequence[tuple[int, int]]) -> None:
        self._sources, self._one, self._stretches, self._active = sources, one, stretches, _active(one)
        self._tried: list[tuple[float, float, Alignment]] = []
        self._shifts: list[float] = []
        self._left = math.inf

    def add(self, found: Alignment) -> None:
        """Add a begin."""
        self._tried.append((*_cost(found, self._one, self._active), found))

    def _alike(self) -> list[Alignment]:
        least = min((cost for cost, _, _ in self._tried), default=math.inf)
        limit = max(_ALIKE, 1.0 + _DEVIATIONS * math.sqrt(2.0 / len(self._one.values)))
        return [found for cost, _, found in self._tried if cost <= limit * least]

    @property
    def _settled(self) -> bool:
        """Whether the best begin leaves nothing but noise, the DAQ's and the session's."""
        noise = 2.0 * _NOISES * self._one.channel.noise_v / self._one.channel.sensitivity_v
        return bool(self._tried) and min(self._tried, key=lambda each: each[0])[1] < noise**2

    def best(self) -> Alignment | None:
        """Return that of the alike begins at which most signals are upright, then the nearest."""
        alike = self._alike()
        if not alike:
            return None
        best = max(alike, key=lambda each: (each.upright, -abs(each.begin_s)))
        return replace(best, alike=tuple(each for each in alike if each is not best))

    def repeats(self) -> list[float]:
        """Return shifts at which the known signal repeats, from the best begin [s]."""
        best = self.best()
        if best is None or (best.alike and self._settled):
            return []
        values, times_s, curve = best.even(self._one)
        rows, held = np.arange(len(values)), np.isfinite(values)
        values = np.interp(rows, rows[held], values[held])
        fit = fit_stretch(values, times_s, self._one.stimulus, curve[0], (0, len(values)))
        shifts = [] if fit is None else _beginnings(fit, self._one.stimulus)
        return [best.begin_s + sign * each for each in shifts for sign in (1.0, -1.0)]

    def try_all(self, shifts: Sequence[float]) -> None:
        """Try begins until two are alike and leave nothing but noise."""
        one = self._one
        for shift_s in shifts:
            near = [*self._shifts, *(found.begin_s for _, _, found in self._tried)]
            if any(abs(shift_s - each) * one.rate_hz < _SAME_ROWS for each in near):
                continue
            if len(self._alike()) > 1 and self._settled:
                return
            self._shifts.append(shift_s)
            fit = fit_stretch(one.values, one.times_s, one.stimulus, one.late_s + shift_s, self._stretches[0])
            if fit is None or float(np.var(fit.residual)) > _WORSE * self._left:
                continue
            self._left = min(self._left, float(np.var(fit.residual)))
            if (found := _follow(self._sources, shift_s, self._stretches)) is not None:
                self.add(found)
