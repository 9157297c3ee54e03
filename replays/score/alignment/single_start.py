"""Alignment of a record with the session from one start: fits of its signals, and the track of its rows."""

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

MIN_ROWS = 400
"""Fewest rows of a stretch."""
MIN_LIKENESS = 0.5
"""Part of a channel's power that the known signal must explain for the channel to be followed."""
_SEARCH_RANGE_S = 5e-4
"""Search range for the start of a stretch [s]: the error of a correlation if clocks differ."""
_MAX_RESIDUAL_RATIO = 0.7
"""Largest ratio of residuals for which the shorter stretch is preferred, as it determines the clock less well."""
_MAX_FOLLOWERS = 6
"""Channels by which a record is followed: more cost time, and fewer might all be faulty."""
_MIN_EXPLAINED_PART = 0.999
"""Part of the rows in the session that must be explained in a record that is explained as a whole."""
_MAX_DRIFT = 0.02
"""Largest clock error of a DAQ; a fit with a larger one is wrong."""
_OVERSAMPLING = 8
"""Places per sample at which the start of a stretch is searched."""
_MAX_CANDIDATES = 4
"""Candidate times near a start from which a stretch is fitted."""


@dataclass
class RowSource:
    """A recorded signal, its connection and its known signal.

    Attributes:
        name: Name of the signal.
        channel: Its channel in the session.
        wire: Its connection.
        values: Recorded values in the channel's unit, shape (rows,).
        first_s: Time of its first row by the clock of the file [s].
        rate_hz: Sampling rate by that clock [Hz].
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
    def offset_s(self) -> float:
        """Time of the session less time of the file [s]."""
        return self.wire.own_s + self.session_s

    @property
    def times_s(self) -> np.ndarray:
        """Times of its rows by the clock of the file [s], shape (rows,)."""
        return self.first_s + np.arange(len(self.values)) / self.rate_hz


@dataclass(frozen=True)
class Alignment:
    """Rows of a table in the session.

    Attributes:
        names: Signals of the table.
        track: Track of the rows.
        own_s: Session less file time where the track's time error is 0, by followed signal [s].
        first_s, rate_hz, rows: Time of the first row [s], sampling rate [Hz], and number of rows.
        upright: Number of signals with a positive gain.
        shift_s: Delay of the start in the session relative to that of the wires [s].
        ambiguous: Whether other starts explain the record equally well.
        steps_doubted: Whether another start explains more rows, by steps that this one does not need.
    """

    names: tuple[str, ...]
    track: Track
    own_s: dict[str, float]
    first_s: float
    rate_hz: float
    rows: int
    upright: int = 0
    shift_s: float = 0.0
    ambiguous: bool = False
    steps_doubted: bool = False

    @property
    def balance(self) -> int:
        """Number of explained rows less that of unexplained rows in the session."""
        return 2 * self.track.explained - (self.track.inside[1] - self.track.inside[0])

    def even(self, source: RowSource) -> tuple[np.ndarray, np.ndarray, tuple[float, float, float]]:
        """Return a signal's values at even instants, with nan for unexplained ones.

        Returns:
            Values, their times by the clock of the file [s], each shape (n,), and session less file time by powers of
            the time from the middle [s, 1, 1/s].
        """
        explained, at = self.track.places(self.rows)
        low, high = int(at.min()), int(at.max())
        values = np.full(high - low + 1, np.nan)
        values[at - low] = source.values[explained]
        line = self.track.line(0.5 * (low + high)) * self.rate_hz ** (np.arange(3.0) - 1.0)
        own_s = self.own_s.get(source.name, source.offset_s + self.shift_s)
        curve = float(line[0]) + own_s, float(line[1]), float(line[2])
        return values, self.first_s + np.arange(low, high + 1) / self.rate_hz, curve

    def rows_at(self, times_s: np.ndarray) -> np.ndarray:
        """Return the rows of the record at some times of `even` that have values, shape (n,)."""
        explained, at = self.track.places(self.rows)
        low = int(at.min())
        rows = np.zeros(int(at.max()) - low + 1, int)
        rows[at - low] = np.flatnonzero(explained)
        return rows[np.rint((times_s - self.first_s) * self.rate_hz).astype(int) - low]

    @property
    def inside_s(self) -> tuple[float, float]:
        """Times of the first and the last row in the session [s]."""
        own_s = self.first_s + next(iter(self.own_s.values()))
        return own_s + self.track.inside[0] / self.rate_hz, own_s + self.track.inside[1] / self.rate_hz

    @property
    def whole(self) -> bool:
        """True if nearly all rows in the session are explained."""
        return self.explained_part() > _MIN_EXPLAINED_PART

    def explained_part(self) -> float:
        """Return the part of the rows in the session that are explained."""
        return self.track.explained / max(1, self.track.inside[1] - self.track.inside[0])


def find_busiest(sources: Sequence[RowSource], within: tuple[int, int], length: int) -> tuple[int, int]:
    """Return the stretch of a table in which its signals change most."""
    first, last = within
    length = min(last - first, max(MIN_ROWS, length))
    power = np.zeros(last - first)
    for one in sources:
        steps = np.nan_to_num(np.diff(one.values[first:last], append=one.values[last - 1])) ** 2
        power += steps / max(float(steps.sum()), 1e-300)
    sums = np.concatenate([[0.0], np.cumsum(power)])
    start = first + int(np.argmax(sums[length:] - sums[:-length]))
    return start, start + length


def _fit_stretches(sources: Sequence[RowSource], shift_s: float, stretch: tuple[int, int]) -> dict[str, Waveform]:
    """Return the fits of a stretch from one start, of the signals that are found in it."""
    fits = {}
    for one in sources:
        fit = fit_stretch(one.values, one.times_s, one.stimulus, one.offset_s + shift_s, stretch)
        if fit is not None and fit.likeness > MIN_LIKENESS and abs(fit.drift) < _MAX_DRIFT:
            fits[one.name] = fit
    return fits


def _refine_shift_s(one: RowSource, shift_s: float, stretch: tuple[int, int]) -> float:
    """Return the start near a given one from which a stretch has the least residual [s]."""
    y, period_s = np.nan_to_num(one.values[slice(*stretch)]), 1.0 / one.rate_hz
    reach, n = math.ceil(_SEARCH_RANGE_S * one.rate_hz * _OVERSAMPLING), len(y)
    first_s = one.first_s + stretch[0] * period_s + one.offset_s + shift_s
    grid_s = first_s + np.arange(-reach, _OVERSAMPLING * (n - 1) + reach + 1) * (period_s / _OVERSAMPLING)
    if grid_s[0] < one.stimulus.span_s[0] or grid_s[-1] > one.stimulus.span_s[1]:
        return shift_s
    sent, _ = one.stimulus(grid_s)
    windows = np.lib.stride_tricks.sliding_window_view(sent, _OVERSAMPLING * (n - 1) + 1)[:, ::_OVERSAMPLING]
    spread = np.maximum(windows.std(axis=1), 1e-12 * max(1e-300, float(sent.std())))
    alike = np.abs(windows @ (y - y.mean())) / spread
    at = np.flatnonzero((alike[1:-1] >= alike[:-2]) & (alike[1:-1] > alike[2:])) + 1
    at = at[np.argsort(-alike[at])][:_MAX_CANDIDATES]
    shifts = [shift_s, *(shift_s + (at - reach) * period_s / _OVERSAMPLING)]
    fits = [fit_stretch(one.values, one.times_s, one.stimulus, one.offset_s + each, stretch) for each in shifts]
    power = [math.inf if fit is None else float(np.var(fit.residual)) for fit in fits]
    return float(shifts[int(np.argmin(power))])


def follow(sources: Sequence[RowSource], shift_s: float, stretches: Sequence[tuple[int, int]]) -> Alignment | None:
    """Return the alignment of a record from one start, or None.

    Args:
        sources: Signals of the table.
        shift_s: Shift of the start relative to that of the wires [s].
        stretches: Stretches of rows that are tried first.
    """
    best: tuple[float, tuple[int, int], dict[str, Waveform]] | None = None
    near_s = _refine_shift_s(sources[0], shift_s, stretches[0])
    for n, stretch in enumerate(stretches):
        at_s = shift_s if n else near_s
        fits = _fit_stretches(sources, at_s, stretch)
        if fits:
            ratio = float(
                np.median([np.std(each.residual) / abs(each.gain) / np.std(each.sent) for each in fits.values()])
            )
            if best is None or len(fits) > 2 * len(best[2]) or ratio < _MAX_RESIDUAL_RATIO * best[0]:
                best = ratio, stretch, fits
    if best is None:
        return None
    _, stretch, fits = best
    one = sources[0]
    middle_s = one.first_s + (sum(stretch) // 2) / one.rate_hz

    def information(name: str) -> float:
        fit = fits[name]
        return float(np.mean(fit.slope**2)) * fit.gain**2 / max(float(np.var(fit.residual)), 1e-300)

    order = sorted(fits, key=information, reverse=True)
    pace = float(np.median([fits[name].drift for name in order[:_MAX_FOLLOWERS]]))
    own_s = {name: float(fits[name].late_at(np.array([middle_s]))[0]) for name in order}
    by_name = {each.name: each for each in sources}
    followers, rows = [], len(one.values)
    for name in order[:_MAX_FOLLOWERS]:
        fit, source = fits[name], by_name[name]
        step = source.channel.lsb_v / abs(source.channel.sensitivity_v)
        # A slow signal stays on one count for some rows, whose errors are then equal.
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
