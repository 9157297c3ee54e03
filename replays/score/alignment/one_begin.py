"""A record's rows in the session from one begin: what is known of its signals, and the track of its rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from replays.score.alignment.row_times import Follower, Track, follow_record
from replays.score.records.stimulus import Stimulus
from replays.score.records.wiring import Wire
from replays.score.waveform import Waveform, fit_stretch
from rig.channels.table import Channel

FEWEST = 400
"""Rows of a stretch, at least."""
SOUND = 0.5
"""Part of its power that the known signal explains in a channel by which a record is followed."""
_NEAR_S = 5e-4
"""Time about a begin in which a stretch is looked for: correlation with clocks apart is off by so much."""
_SHARPER = 0.7
"""Part of the residual that the shorter stretch must leave, as it shows less of the clock."""
_FOLLOWERS = 6
"""Channels by which a record is followed: more cost time, and fewer may all be faulty."""
_WHOLE = 0.999
"""Part of the rows in the session that are explained in a record that lies in it as a whole."""
_MAX_DRIFT = 0.02
"""Clock error of a DAQ, at most: a fit with more of it found something else."""
_FINER = 8
"""Places between two samples at which the begin of a stretch is looked for."""
_TRIED = 4
"""Times near a begin from which a stretch is fitted."""


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
        steps_doubted: Whether another begin explains more rows, with steps that this one does not need.
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
    steps_doubted: bool = False

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

    def rows_at(self, times_s: np.ndarray) -> np.ndarray:
        """Return the rows of the record at some of the times of `even` at which there are values, shape (n,)."""
        explained, at = self.track.places(self.rows)
        low = int(at.min())
        rows = np.zeros(int(at.max()) - low + 1, int)
        rows[at - low] = np.flatnonzero(explained)
        return rows[np.rint((times_s - self.first_s) * self.rate_hz).astype(int) - low]

    @property
    def inside_s(self) -> tuple[float, float]:
        """Times of the session at the first and the last row in it [s]."""
        own_s = self.first_s + next(iter(self.own_s.values()))
        return own_s + self.track.inside[0] / self.rate_hz, own_s + self.track.inside[1] / self.rate_hz

    @property
    def whole(self) -> bool:
        """Return whether nearly all rows in the session are explained."""
        return self.judged() > _WHOLE

    def judged(self) -> float:
        """Part of the rows in the session that are explained."""
        return self.track.explained / max(1, self.track.inside[1] - self.track.inside[0])


def busiest(sources: Sequence[Source], within: tuple[int, int], length: int) -> tuple[int, int]:
    """The stretch of a table where its signals change most."""
    first, last = within
    length = min(last - first, max(FEWEST, length))
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
        if fit is not None and fit.likeness > SOUND and abs(fit.drift) < _MAX_DRIFT:
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
    at = at[np.argsort(-alike[at])][:_TRIED]
    shifts = [shift_s, *(shift_s + (at - reach) * period_s / _FINER)]
    fits = [fit_stretch(one.values, one.times_s, one.stimulus, one.late_s + each, stretch) for each in shifts]
    left = [math.inf if fit is None else float(np.var(fit.residual)) for fit in fits]
    return float(shifts[int(np.argmin(left))])


def follow(sources: Sequence[Source], shift_s: float, stretches: Sequence[tuple[int, int]]) -> Alignment | None:
    """The record from one begin."""
    best: tuple[float, tuple[int, int], dict[str, Waveform]] | None = None
    near_s = _refined_s(sources[0], shift_s, stretches[0])
    for n, stretch in enumerate(stretches):
        at_s = shift_s if n else near_s
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
