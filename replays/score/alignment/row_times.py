"""Times of a record's rows in the session, with lost samples, duplicated samples, and unexplained rows.

A record has one clock. From a matched stretch, its time error is followed in both directions, each block starting at
its neighbour's value. If a block does not match, steps by whole samples are tried, then the whole session is searched.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from replays.estimate.clock import fit_line, time_error
from replays.estimate.least_squares import solve
from replays.score.records.stimulus import Stimulus

_CHUNK_ROWS = 8192
"""Rows for which the known signal is evaluated at a time."""
_REACH = 300
"""Largest step that is tried in a block [samples]; larger ones are found by correlation with the session."""
_RESOLUTION = 0.05
"""Standard deviation of a block's time error [samples]: a twentieth, so that a step of one sample is certain."""
_MIN_BLOCK_ROWS = 128
"""Fewest rows of a block, which limits the number of blocks."""
_STEP_THRESHOLD = 0.3
"""Time error from which a step is tried [samples]: half a sample less four standard deviations of a block."""
_MAX_SLOPE_ERROR = 0.1
"""Time error from which the known signal is evaluated again [samples]; smaller ones are corrected by its slope."""
_MAX_HISTORY = 24
"""Number of blocks from which the next one is predicted."""
_MAX_RESIDUAL_RATIO = 2.5
"""Residual power over the usual one, above which the explained part of a block is checked."""
_MIN_EXPLAINED_PART = 0.5
"""Part of a block's power that must be explained in this check."""
_LIKELIHOOD_THRESHOLD = 15.0
"""Half of the log-likelihood ratio that locates a step between neighbouring rows: four standard deviations."""
_MIN_END_ROWS = 8
"""Fewest rows between a step and an end of the record: fewer may match another part of the signal by chance."""
_MAX_END_PART = 0.01
"""Largest part of the residual power up to an end that may remain with a step, if it exceeds the usual noise."""
_SEARCH_ROWS = 4096
"""Rows that are searched for in the whole session."""
_MAX_SEARCHES = 24
"""Searches of the whole session per record, which limits the time spent on noise."""
_MAX_STEPS = 2000
"""Steps that are followed, which limits the time spent on a record of random rows."""
_SEARCH_INSTANTS = 1 << 20
"""Instants of a session that are searched at a time."""


@dataclass(frozen=True)
class Follower:
    """A channel by which a record is followed.

    Attributes:
        values: Recorded values [unit], shape (rows,).
        stimulus: The known signal.
        late_s: Time of the session less time of the record, to which the track's time error is relative [s].
        gain, offset: Gain [1] and offset [unit] of the matched stretch.
        noise: Residual of that stretch [unit rms].
    """

    values: np.ndarray
    stimulus: Stimulus
    late_s: float
    gain: float
    offset: float
    noise: float


@dataclass(frozen=True)
class RowRun:
    """Consecutive rows that the known signal explains, without a step.

    Attributes:
        start, end: First row, and the row after the last.
        lag: Delay of these rows in the session relative to the rows of the first stretch [samples].
        doubt: First and last possible row of the step before this run.
    """

    start: int
    end: int
    lag: int
    doubt: tuple[int, int]


@dataclass(frozen=True)
class Track:
    """Rows of a record in the session.

    Attributes:
        runs: Explained rows, in order.
        blocks: Middle row plus lag, and time error of each block [samples], shape (n, 2).
        inside: First row in the session, and the row after the last.
    """

    runs: list[RowRun]
    blocks: np.ndarray
    inside: tuple[int, int]

    @property
    def explained(self) -> int:
        """Number of rows that the known signal explains."""
        return sum(run.end - run.start for run in self.runs)

    @property
    def unexplained(self) -> list[tuple[int, int]]:
        """First and last row of each unexplained stretch between rows of the same lag."""
        return [(a.end, b.start - 1) for a, b in pairwise(self.runs) if a.end < b.start and a.lag == b.lag]

    def steps(self) -> list[tuple[int, int, int]]:
        """Return the steps: first and last possible row, and the samples lost (above 0) or duplicated (below 0)."""
        return [
            (min(before.end, after.doubt[0]), max(after.start, after.doubt[1]), after.lag - before.lag)
            for before, after in pairwise(self.runs)
            if after.lag != before.lag
        ]

    def line(self, centre: float) -> np.ndarray:
        """Return the time error as powers 0 to 2 of row plus lag from a centre [samples], least squares, shape (3,)."""
        if len(self.blocks) < 4:
            return np.array([float(np.mean(self.blocks[:, 1])) if len(self.blocks) else 0.0, 0.0, 0.0])
        scale = float(np.ptp(self.blocks[:, 0]))
        parts = solve(np.vander((self.blocks[:, 0] - centre) / scale, 3, increasing=True), self.blocks[:, 1])
        return parts / scale ** np.arange(3.0)

    def places(self, rows: int) -> tuple[np.ndarray, np.ndarray]:
        """Return whether each row is explained, and the instants of those that are, from that of row 0 without lag."""
        explained, at = np.zeros(rows, bool), np.arange(rows)
        for run in self.runs:
            explained[run.start : run.end] = True
            at[run.start : run.end] += run.lag
        return explained, at[explained]


class _Reversed:
    """A known signal with time reversed."""

    def __init__(self, stimulus: Stimulus) -> None:
        self._stimulus = stimulus
        self.span_s = (-stimulus.span_s[1], -stimulus.span_s[0])

    def __call__(self, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values, slopes = self._stimulus(-times_s[::-1])
        return values[::-1], -slopes[::-1]


class _Walk:
    """A track from a row towards later rows.

    Attributes:
        runs, blocks: As in `Track`.
        end: Row after the last one in the session.
    """

    def __init__(self, followers: Sequence[Follower], first_s: float, period_s: float, rows: int) -> None:
        self._followers, self._first_s, self._period_s, self._rows = followers, first_s, period_s, rows
        self.runs: list[RowRun] = []
        self.blocks: list[tuple[float, float]] = []
        self.end = 0
        self._need = _RESOLUTION**-2.0
        self._next_search = self._steps = 0

    def _evaluate(self, first: int, last: int, line: np.ndarray, lag: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rows, known signal and slope per sample, over noise, each shape (followers, rows); nan if unknown.

        `line` is row plus lag, the time error there, and its slope by row [samples].
        """
        rows = np.arange(first, last)
        there = (rows >= 0) & (rows < self._rows)
        y, s, ds = (np.full((len(self._followers), len(rows)), np.nan) for _ in range(3))
        place = rows + lag + line[1] + line[2] * (rows + lag - line[0])
        for k, one in enumerate(self._followers):
            at_s = self._first_s + one.late_s + place * self._period_s
            inside = (at_s >= one.stimulus.span_s[0]) & (at_s <= one.stimulus.span_s[1])
            if inside.any():
                value, slope = one.stimulus(at_s[inside])
                s[k, inside] = one.gain * value / one.noise
                ds[k, inside] = one.gain * slope * self._period_s / one.noise
            y[k, there] = (one.values[rows[there]] - one.offset) / one.noise
        return y, s, ds

    def calibrate(self, first: int, last: int, line: np.ndarray) -> None:
        """Extend the blocks if the time errors of the first stretch scatter more than white noise would."""
        y, s, ds = self._evaluate(first, last, line, 0)
        edges = self._cut_blocks(ds)
        errors = [_fit(y[:, a:b], s[:, a:b], ds[:, a:b])[0] for a, b in pairwise(edges)]
        if len(errors) > 8:
            scatter = 1.4826 * float(np.median(np.abs(np.diff(errors)))) / math.sqrt(2.0)
            self._need *= min(100.0, max(1.0, scatter / _RESOLUTION) ** 2)

    def _cut_blocks(self, ds: np.ndarray) -> list[int]:
        """Return the edges of blocks that are long enough to determine their time error."""
        information = np.cumsum(np.nan_to_num(ds**2).sum(axis=0))
        edges = [0]
        while True:
            begun = information[edges[-1] - 1] if edges[-1] else 0.0
            at = max(edges[-1] + _MIN_BLOCK_ROWS, int(np.searchsorted(information, begun + self._need)) + 1)
            if at > len(information):
                return edges
            edges.append(at)

    def follow(self, row: int, late: float, pace: float) -> None:
        """Follow the record from a row with a known time error and slope of this error by row [samples]."""
        line, lag, length = np.array([row, late, pace]), 0, _CHUNK_ROWS
        history: list[tuple[float, float]] = []
        start = good_row = floor = row
        doubt = row, row
        while row < self._rows:
            count = min(length, self._rows - row)
            y, s, ds = self._evaluate(row - _REACH, row + count + _REACH, line, lag)
            within = np.asarray(np.isfinite(s[:, _REACH : _REACH + count]).all(axis=0))
            if not within[0]:
                break
            inside = count if within.all() else int(np.argmin(within))
            edges = self._cut_blocks(ds[:, _REACH : _REACH + inside])
            if inside < count or row + inside == self._rows:
                edges = [*(edges if len(edges) == 1 else edges[:-1]), inside]
            elif len(edges) == 1:
                if length < _SEARCH_INSTANTS:
                    length *= 2
                    continue
                edges.append(inside)
            step, length, n = None, _CHUNK_ROWS, 0
            final = inside < count or row + inside == self._rows
            for n, (a, b) in enumerate(pairwise(edges)):
                part = slice(_REACH + a, _REACH + b)
                error, good, information = _fit(y[:, part], s[:, part], ds[:, part])
                shown = information >= self._need
                if (shown and abs(error) > _STEP_THRESHOLD) or not good:
                    if n > 0 and len(edges) - n < 4 and not final:
                        edges = edges[: n + 1]  # the blocks that follow are needed
                        break
                    step = self._find(y, s, ds, edges[n:], row) or (None if good else self._search(row + a, line, lag))
                    if step is not None and self._steps < _MAX_STEPS:
                        break
                    step = None
                if final and n == len(edges) - 2 and self._steps < _MAX_STEPS:
                    step = self._find_end_step(y, s, ds, _REACH + a, _REACH + b, row)
                    if step is not None and inside < count and _is_period(y, s, ds, _REACH + a, step[0]):
                        # The last rows of a session are less well known than those of a period earlier.
                        step = self._find_end_step(y, s, ds, _REACH + a, _REACH + b, row, abs(step[0]) // 2)
                    if step is not None:
                        break
                if not good:
                    self._add_run(start, row + a, lag, doubt)
                    start, doubt = row + b, (row + b, row + b)
                elif shown:
                    middle, good_row = row + lag + 0.5 * (a + b), row + a
                    history = [*history[1 - _MAX_HISTORY :], (middle, line[1] + line[2] * (middle - line[0]) + error)]
                    self.blocks.append(history[-1])
                    if abs(error) > _MAX_SLOPE_ERROR:
                        edges = edges[: n + 2]
                        break
            if step is None:
                row += edges[-1]
            else:
                moved, at = step
                bad = row + edges[n]
                back = max(floor, good_row if bad - good_row < _CHUNK_ROWS else bad)
                earliest, row = self._locate_step(line, lag, moved, back, max(at, back + 1))
                self._add_run(start, row, lag, doubt)
                start, doubt, lag, floor = row, (earliest, row), lag + moved, row + 1
                self._steps += 1
            line = _predict(history, line, row + lag)
        self._add_run(start, row, lag, doubt)
        self.end = row

    def _add_run(self, start: int, end: int, lag: int, doubt: tuple[int, int]) -> None:
        if end > start:
            self.runs.append(RowRun(start, end, lag, doubt))

    def _find(self, y: np.ndarray, s: np.ndarray, ds: np.ndarray, edges: list[int], row: int) -> tuple[int, int] | None:
        """Return a step that explains the next block, this one, or the second next one: samples, and a row after it."""
        for n in (1, 0, 2):
            if n + 1 >= len(edges):
                continue
            a, b = edges[n] + _REACH, edges[n + 1] + _REACH
            moved = _best_step(y[:, a:b], s[:, a - _REACH : b + _REACH], ds[:, a - _REACH : b + _REACH], self._limit)
            if moved == 0:
                return None
            if moved is not None:
                return moved, row + edges[n + 1]
        return None

    def _find_end_step(
        self, y: np.ndarray, s: np.ndarray, ds: np.ndarray, first: int, last: int, row: int, reach: int = _REACH
    ) -> tuple[int, int] | None:
        """Return the smallest step within the last block that explains the rows from it to the end, or None.

        Args:
            y: Rows over noise, shape (followers, n).
            s: The known signal over noise, shape (followers, n).
            ds: Its slope per sample, shape (followers, n).
            first: Column of the first row of the block, at least `_REACH`.
            last: Column after its last row, at most n - `_REACH`.
            row: Row of column `_REACH`.
            reach: Largest step that is tried [samples].

        Returns:
            Samples of the step and the row after the last, or None.
        """
        first = max(first, last - _CHUNK_ROWS)
        values, counted = y[:, first:last], int(np.isfinite(y[:, first:last]).any(axis=1).sum())

        def to_end(moved: int) -> np.ndarray:
            """Return the residual power from each row to the last, with a small common time error, shape (rows,)."""
            part = slice(first + moved, last + moved)
            missing = np.isnan(s[:, part]) & np.isfinite(values)
            r, slope = (
                np.nan_to_num(values - s[:, part]),
                np.where(np.isfinite(values), np.nan_to_num(ds[:, part]), 0.0),
            )
            sums = [(1e6 * missing + r**2), r * slope, slope**2]
            rest, pull, info = (np.cumsum(each.sum(axis=0)[::-1])[::-1][: 1 - _MIN_END_ROWS] for each in sums)
            error = np.clip(pull / np.maximum(info, 1e-300), -_STEP_THRESHOLD, _STEP_THRESHOLD)
            return rest - error * (2.0 * pull - error * info)

        usual = counted * np.arange(last - first, 0, -1.0)[: 1 - _MIN_END_ROWS]
        unmoved, least = to_end(0), 2.0 * self._limit
        if not len(usual) or (unmoved - usual).max() < least:
            return None
        steps: list[tuple[int, float, bool]] = []
        for moved in sorted(set(range(-reach, reach + 1)) - {0}, key=abs):
            rest = to_end(moved)
            at = int((unmoved - rest).argmax())
            good = rest[at] <= max(_MAX_RESIDUAL_RATIO * usual[at], _MAX_END_PART * unmoved[at])
            steps.append((moved, float(unmoved[at] - rest[at]), bool(good)))
        most = max(gained for _, gained, _ in steps)
        moved, gained, good = next(each for each in steps if each[1] >= most - least)
        return (moved, row + last - _REACH) if gained > least and good else None

    @property
    def _limit(self) -> float:
        """Half of the log-likelihood ratio that counts as certain, for coloured noise."""
        return _LIKELIHOOD_THRESHOLD * self._need * _RESOLUTION**2

    def _search(self, row: int, line: np.ndarray, lag: int) -> tuple[int, int] | None:
        """Return a step with which the session explains the rows from one on, whatever precedes it; or None."""
        from scipy.signal import correlate

        if row < self._next_search or self._rows - row < 2 * _MIN_BLOCK_ROWS:
            return None
        self._next_search = row + max(_SEARCH_ROWS, (self._rows - row) // _MAX_SEARCHES)
        count = min(_SEARCH_ROWS, self._rows - row)
        one, best = self._followers[0], (math.inf, 0)
        here = np.nan_to_num(one.values[row : row + count] - one.offset)
        low, high = (
            ((each - self._first_s - one.late_s) / self._period_s - line[1] + line[2] * line[0]) / (1.0 + line[2])
            for each in one.stimulus.span_s
        )
        for start in range(math.ceil(low), math.floor(high) - count, _SEARCH_INSTANTS - count):
            at = np.arange(start, min(math.floor(high), start + _SEARCH_INSTANTS))
            place = at + line[1] + line[2] * (at - line[0])
            sent = one.gain * one.stimulus(self._first_s + one.late_s + place * self._period_s)[0]
            sums = np.cumsum(np.concatenate([[0.0], sent**2]))
            power = float(here @ here) - 2.0 * correlate(sent, here, "valid", "fft") + sums[count:] - sums[:-count]
            near = np.flatnonzero(power <= power.min() + 2.0 * self._limit * one.noise**2)
            moved = near + start - row - lag
            best = min(best, (float(power.min()), int(moved[np.argmin(np.abs(moved))])))
        if best[0] > _MIN_EXPLAINED_PART * count * float(np.var(here)):
            return None
        return (best[1], row) if best[1] else None

    def _locate_step(self, line: np.ndarray, lag: int, moved: int, first: int, last: int) -> tuple[int, int]:
        """Return the first and last row at which a step may start."""
        sums = []
        for each in (lag, lag + moved):
            y, s, _ = self._evaluate(first, last, line, each)
            sums.append(np.concatenate([[0.0], np.cumsum(np.nan_to_num((y - s) ** 2, nan=1e6).sum(axis=0))]))
        cost = sums[0] + sums[1][-1] - sums[1]
        place = int(np.argmin(cost))
        near = np.flatnonzero(cost <= cost[place] + 2.0 * self._limit)
        return first + int(near[0]), first + int(near[-1])


def _fit(y: np.ndarray, s: np.ndarray, ds: np.ndarray, least: float = _MIN_EXPLAINED_PART) -> tuple[float, bool, float]:
    """Return a block's time error [samples], whether the known signal explains it, and its information about time.

    A block is explained if its residual is the usual noise, or at most a part `least` of its power.
    """
    use = np.isfinite(y) & np.isfinite(s)
    r, slope = np.where(use, y - s, 0.0), np.where(use, ds, 0.0)
    information, error = float(np.sum(slope**2)), time_error(slope, r)
    if abs(error) < 1.0:
        r = r - error * slope
    rows = use.sum(axis=1)
    power = np.where(use, y, 0.0)
    whole = np.sum(power**2, axis=1) - power.sum(axis=1) ** 2 / np.maximum(rows, 1)
    squares = np.sum(r**2, axis=1)
    good = ((squares <= _MAX_RESIDUAL_RATIO * rows) | (squares <= least * whole))[rows > 0]
    return error, bool(2 * good.sum() >= len(good)), information


def _is_period(y: np.ndarray, s: np.ndarray, ds: np.ndarray, last: int, moved: int) -> bool:
    """Return whether a step explains the rows before it as well, and half of the step does not.

    Args:
        y: Rows over noise, shape (followers, n).
        s: The known signal over noise, shape (followers, n).
        ds: Its slope per sample, shape (followers, n).
        last: Column after the last row before the step.
        moved: Samples of the step.
    """
    first = max(0, -moved)
    whole, half = (
        _fit(y[:, first:last], s[:, first + each : last + each], ds[:, first + each : last + each], 0.0)[1]
        for each in (moved, moved // 2)
    )
    return whole and not half


def _best_step(y: np.ndarray, s: np.ndarray, ds: np.ndarray, certain: float) -> int | None:
    """Return the smallest of the steps that explain a block best [samples]; None if none does.

    Args:
        y: Rows of the block over noise, shape (followers, n).
        s: The known signal over noise, from `_REACH` rows before the block to as many after it.
        ds: Its slope per sample there.
        certain: Half of the log-likelihood ratio that distinguishes two steps.
    """
    from scipy.signal import correlate

    power, pull, info = (np.zeros(2 * _REACH + 1) for _ in range(3))
    usable = ~np.isnan(s).any(axis=0)
    for values, signal, slope in zip(np.nan_to_num(y), np.nan_to_num(s), np.nan_to_num(ds), strict=True):
        kept = np.isfinite(values).astype(float)
        power += values @ values - 2.0 * correlate(signal, values, "valid") + correlate(signal**2, kept, "valid")
        pull += correlate(slope, values, "valid") - correlate(slope * signal, kept, "valid")
        info += correlate(slope**2, kept, "valid")
    error = np.clip(pull / np.maximum(info, 1e-300), -0.6, 0.6)
    power -= error * (2.0 * pull - error * info)
    power[correlate(usable.astype(float), np.ones(y.shape[1]), "valid") < y.shape[1] - 0.5] = np.inf
    near = np.flatnonzero(power <= power.min() + 2.0 * certain)
    at = int(near[np.argmin(np.abs(near - _REACH))])
    part = slice(at, at + y.shape[1])
    return at - _REACH if _fit(y, s[:, part], ds[:, part], 0.0)[1] else None


def _predict(history: list[tuple[float, float]], line: np.ndarray, row: int) -> np.ndarray:
    """Return the row plus lag, and the predicted time error and its slope there, from the last blocks."""
    late = line[1] + line[2] * (row - line[0])
    if len(history) < 4:
        if history:
            late += history[-1][1] - line[1] - line[2] * (history[-1][0] - line[0])
        return np.array([row, late, line[2]])
    fitted = fit_line(*np.array(history).T)
    return np.array([row, fitted(row), fitted.slope if len(history) == _MAX_HISTORY else line[2]])


def follow_record(
    followers: Sequence[Follower], first_s: float, period_s: float, rows: int, stretch: tuple[int, int], pace: float
) -> Track:
    """Follow a record's rows through the session.

    Args:
        followers: Channels whose signal is found, the one that shows time best first.
        first_s: Time of the first row by the record's clock [s].
        period_s: Sampling period [s].
        rows: Number of rows.
        stretch: Rows in which the signal is found: the first row, and the row after the last.
        pace: Slope of the time error there, by row [samples].
    """
    middle = (stretch[0] + stretch[1]) // 2
    onward = _Walk(followers, first_s, period_s, rows)
    turned = [
        replace(one, values=one.values[::-1], stimulus=_Reversed(one.stimulus), late_s=-one.late_s) for one in followers
    ]
    back = _Walk(turned, -(first_s + (rows - 1) * period_s), period_s, rows)
    for walk, low, high in ((onward, *stretch), (back, rows - stretch[1], rows - stretch[0])):
        walk.calibrate(low, high, np.array([middle if walk is onward else rows - middle, 0.0, pace]))
    onward.follow(middle, 0.0, pace)
    back.follow(rows - middle, 0.0, pace)
    doubts = [*(run.doubt for run in back.runs), (rows - middle, rows - middle)]
    runs = [
        RowRun(rows - run.end, rows - run.start, -run.lag, (rows - doubt[1], rows - doubt[0]))
        for run, doubt in zip(back.runs, doubts[1:], strict=True)
    ][::-1]
    merged: list[RowRun] = []
    for run in [*runs, *onward.runs]:
        if merged and (merged[-1].end, merged[-1].lag) == (run.start, run.lag):
            merged[-1] = replace(merged[-1], end=run.end)
        else:
            merged.append(run)
    blocks = [(rows - 1 - row, -late) for row, late in reversed(back.blocks)] + onward.blocks
    return Track(merged, np.array(blocks).reshape(-1, 2), (rows - back.end, onward.end))
