"""The time of a record's rows in the session: lost samples, doubled samples, and rows that nothing explains.

A record has one clock. From a stretch that is found, its time error is followed in both directions, each block from its
neighbour's value; where a block does not fit, steps by whole samples are tried, and then the whole session is searched.
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

_CHUNK = 8192
"""Rows for which the known signal is evaluated at once."""
_REACH = 300
"""Largest step that is tried in a block [samples]; larger ones are found by correlation with the session."""
_RESOLUTION = 0.05
"""Standard deviation of a block's time error [samples]: a twentieth, so that a step by one sample is certain."""
_SHORTEST = 128
"""Fewest rows of a block, which bounds the time that the blocks take."""
_STEP = 0.3
"""Time error [samples] from which a step is tried: half a sample, less four standard deviations of a block."""
_DRIFTED = 0.1
"""Time error [samples] from which the known signal is evaluated again: up to there its slope is enough."""
_MEMORY = 24
"""Blocks by which the next one is predicted."""
_UNEXPLAINED = 2.5
"""Residual power over the usual one, from which a block is checked for the part of its power that is explained."""
_HALF = 0.5
"""Part of a block's power that must then be explained."""
_CERTAIN = 15.0
"""Half of the likelihood ratio by which a row of a step is told from its neighbour: four standard deviations."""
_MIN_END_ROWS = 8
"""Fewest rows between a step and an end of the record: fewer may agree with another part of the signal by chance."""
_MAX_END_PART = 0.01
"""Part of the residual power up to an end that a step there may leave, where that is more than the usual noise."""
_SEARCHED = 4096
"""Rows that are searched for in the whole session."""
_MAX_SEARCHES = 24
"""Searches of the whole session for a record, which bounds the time that noise takes."""
_MAX_STEPS = 2000
"""Steps that are followed, which bounds the time that a record without order takes."""
_SESSION_PARTS = 1 << 20
"""Instants of a session that are searched at once."""


@dataclass(frozen=True)
class Follower:
    """A channel by which a record is followed.

    Attributes:
        values: As recorded [unit], shape (rows,).
        stimulus: The known signal.
        late_s: Time of the session less time of the record [s], about which the track's own time error is.
        gain, offset: Of the stretch that is found [1, unit].
        noise: What is left there [unit rms].
    """

    values: np.ndarray
    stimulus: Stimulus
    late_s: float
    gain: float
    offset: float
    noise: float


@dataclass(frozen=True)
class Run:
    """Consecutive rows that the known signal explains, without a step.

    Attributes:
        begin, end: First row, and the one after the last.
        lag: Samples by which these rows are later in the session than the rows of the first stretch.
        doubt: First and last row at which the step before this run may be.
    """

    begin: int
    end: int
    lag: int
    doubt: tuple[int, int]


@dataclass(frozen=True)
class Track:
    """Where the rows of a record lie in the session.

    Attributes:
        runs: Rows that are explained, in order.
        blocks: Middle, row and lag together, and time error of each block [samples], shape (n, 2).
        inside: First row, and the one after the last, that lies in the session.
    """

    runs: list[Run]
    blocks: np.ndarray
    inside: tuple[int, int]

    @property
    def explained(self) -> int:
        """Number of rows that the known signal explains."""
        return sum(run.end - run.begin for run in self.runs)

    @property
    def foreign(self) -> list[tuple[int, int]]:
        """First and last row of each stretch that nothing explains, between rows of the same lag."""
        return [(a.end, b.begin - 1) for a, b in pairwise(self.runs) if a.end < b.begin and a.lag == b.lag]

    def steps(self) -> list[tuple[int, int, int]]:
        """Steps as first and last row where one may be, and its samples: above 0 lost, below 0 doubled."""
        return [
            (min(before.end, after.doubt[0]), max(after.begin, after.doubt[1]), after.lag - before.lag)
            for before, after in pairwise(self.runs)
            if after.lag != before.lag
        ]

    def line(self, centre: float) -> np.ndarray:
        """Time error [samples] by powers 0 to 2 of row and lag from a centre, least squares, shape (3,)."""
        if len(self.blocks) < 4:
            return np.array([float(np.mean(self.blocks[:, 1])) if len(self.blocks) else 0.0, 0.0, 0.0])
        scale = float(np.ptp(self.blocks[:, 0]))
        parts = solve(np.vander((self.blocks[:, 0] - centre) / scale, 3, increasing=True), self.blocks[:, 1])
        return parts / scale ** np.arange(3.0)

    def places(self, rows: int) -> tuple[np.ndarray, np.ndarray]:
        """Which rows are explained, and the instants of these, counted from that of row 0 without lag."""
        explained, at = np.zeros(rows, bool), np.arange(rows)
        for run in self.runs:
            explained[run.begin : run.end] = True
            at[run.begin : run.end] += run.lag
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
    """A track from a row on, towards later rows.

    Attributes:
        runs, blocks: As in `Track`.
        end: The row after the last that lies in the session.
    """

    def __init__(self, followers: Sequence[Follower], first_s: float, period_s: float, rows: int) -> None:
        self._followers, self._first_s, self._period_s, self._rows = followers, first_s, period_s, rows
        self.runs: list[Run] = []
        self.blocks: list[tuple[float, float]] = []
        self.end = 0
        self._need = _RESOLUTION**-2.0
        self._next_search = self._steps = 0

    def _evaluate(self, first: int, last: int, line: np.ndarray, lag: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows, known signal and slope a sample, over noise, each shape (followers, rows); nan where there is none.

        `line` is row and lag together, time error there, and its rise by row [samples].
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
        """Make blocks longer where the time errors of the first stretch scatter more than white noise would."""
        y, s, ds = self._evaluate(first, last, line, 0)
        edges = self._cut(ds)
        errors = [_fit(y[:, a:b], s[:, a:b], ds[:, a:b])[0] for a, b in pairwise(edges)]
        if len(errors) > 8:
            scatter = 1.4826 * float(np.median(np.abs(np.diff(errors)))) / math.sqrt(2.0)
            self._need *= min(100.0, max(1.0, scatter / _RESOLUTION) ** 2)

    def _cut(self, ds: np.ndarray) -> list[int]:
        """Edges of blocks that show their time well enough."""
        known = np.cumsum(np.nan_to_num(ds**2).sum(axis=0))
        edges = [0]
        while True:
            begun = known[edges[-1] - 1] if edges[-1] else 0.0
            at = max(edges[-1] + _SHORTEST, int(np.searchsorted(known, begun + self._need)) + 1)
            if at > len(known):
                return edges
            edges.append(at)

    def follow(self, row: int, late: float, pace: float) -> None:
        """Walk from a row on, whose time error and its rise by row are known [samples]."""
        line, lag, length = np.array([row, late, pace]), 0, _CHUNK
        history: list[tuple[float, float]] = []
        begin = good_row = floor = row
        doubt = row, row
        while row < self._rows:
            count = min(length, self._rows - row)
            y, s, ds = self._evaluate(row - _REACH, row + count + _REACH, line, lag)
            within = np.asarray(np.isfinite(s[:, _REACH : _REACH + count]).all(axis=0))
            if not within[0]:
                break
            inside = count if within.all() else int(np.argmin(within))
            edges = self._cut(ds[:, _REACH : _REACH + inside])
            if inside < count or row + inside == self._rows:
                edges = [*(edges if len(edges) == 1 else edges[:-1]), inside]
            elif len(edges) == 1:
                if length < _SESSION_PARTS:
                    length *= 2
                    continue
                edges.append(inside)
            step, length, n = None, _CHUNK, 0
            final = inside < count or row + inside == self._rows
            for n, (a, b) in enumerate(pairwise(edges)):
                part = slice(_REACH + a, _REACH + b)
                error, good, known = _fit(y[:, part], s[:, part], ds[:, part])
                shown = known >= self._need
                if (shown and abs(error) > _STEP) or not good:
                    if n > 0 and len(edges) - n < 4 and not final:
                        edges = edges[: n + 1]  # the blocks that follow are needed
                        break
                    step = self._step(y, s, ds, edges[n:], row) or (None if good else self._search(row + a, line, lag))
                    if step is not None and self._steps < _MAX_STEPS:
                        break
                    step = None
                if final and n == len(edges) - 2 and self._steps < _MAX_STEPS:
                    step = self._end_step(y, s, ds, _REACH + a, _REACH + b, row)
                    if step is not None and inside < count and _is_period(y, s, ds, _REACH + a, step[0]):
                        # The last rows of a session are not known as well as those of a period earlier.
                        step = self._end_step(y, s, ds, _REACH + a, _REACH + b, row, abs(step[0]) // 2)
                    if step is not None:
                        break
                if not good:
                    self._close(begin, row + a, lag, doubt)
                    begin, doubt = row + b, (row + b, row + b)
                elif shown:
                    middle, good_row = row + lag + 0.5 * (a + b), row + a
                    history = [*history[1 - _MEMORY :], (middle, line[1] + line[2] * (middle - line[0]) + error)]
                    self.blocks.append(history[-1])
                    if abs(error) > _DRIFTED:
                        edges = edges[: n + 2]
                        break
            if step is None:
                row += edges[-1]
            else:
                moved, at = step
                bad = row + edges[n]
                back = max(floor, good_row if bad - good_row < _CHUNK else bad)
                earliest, row = self._place(line, lag, moved, back, max(at, back + 1))
                self._close(begin, row, lag, doubt)
                begin, doubt, lag, floor = row, (earliest, row), lag + moved, row + 1
                self._steps += 1
            line = _predict(history, line, row + lag)
        self._close(begin, row, lag, doubt)
        self.end = row

    def _close(self, begin: int, end: int, lag: int, doubt: tuple[int, int]) -> None:
        if end > begin:
            self.runs.append(Run(begin, end, lag, doubt))

    def _step(self, y: np.ndarray, s: np.ndarray, ds: np.ndarray, edges: list[int], row: int) -> tuple[int, int] | None:
        """A step that explains the next block, this one, or that after the next: its samples, and a row after it."""
        for n in (1, 0, 2):
            if n + 1 >= len(edges):
                continue
            a, b = edges[n] + _REACH, edges[n + 1] + _REACH
            moved = _best_step(y[:, a:b], s[:, a - _REACH : b + _REACH], ds[:, a - _REACH : b + _REACH], self._certain)
            if moved == 0:
                return None
            if moved is not None:
                return moved, row + edges[n + 1]
        return None

    def _end_step(
        self, y: np.ndarray, s: np.ndarray, ds: np.ndarray, first: int, last: int, row: int, reach: int = _REACH
    ) -> tuple[int, int] | None:
        """Return the smallest step within the last block that explains the rows from it to the end, or None.

        Args:
            y: Rows over noise, shape (followers, n).
            s: The known signal over noise, shape (followers, n).
            ds: Its slope a sample, shape (followers, n).
            first: Column of the first row of the block, at least `_REACH`.
            last: Column after its last row, at most n - `_REACH`.
            row: Row of column `_REACH`.
            reach: Largest step that is tried [samples].

        Returns:
            Samples of the step and the row after the last, or None.
        """
        first = max(first, last - _CHUNK)
        values, counted = y[:, first:last], int(np.isfinite(y[:, first:last]).any(axis=1).sum())

        def to_end(moved: int) -> np.ndarray:
            """Return residual power from each row to the last, with a small time error of these, shape (rows,)."""
            part = slice(first + moved, last + moved)
            missing = np.isnan(s[:, part]) & np.isfinite(values)
            r, slope = (
                np.nan_to_num(values - s[:, part]),
                np.where(np.isfinite(values), np.nan_to_num(ds[:, part]), 0.0),
            )
            sums = [(1e6 * missing + r**2), r * slope, slope**2]
            left, pull, known = (np.cumsum(each.sum(axis=0)[::-1])[::-1][: 1 - _MIN_END_ROWS] for each in sums)
            error = np.clip(pull / np.maximum(known, 1e-300), -_STEP, _STEP)
            return left - error * (2.0 * pull - error * known)

        usual = counted * np.arange(last - first, 0, -1.0)[: 1 - _MIN_END_ROWS]
        unmoved, least = to_end(0), 2.0 * self._certain
        if not len(usual) or (unmoved - usual).max() < least:
            return None
        found: list[tuple[int, float, bool]] = []
        for moved in sorted(set(range(-reach, reach + 1)) - {0}, key=abs):
            left = to_end(moved)
            at = int((unmoved - left).argmax())
            good = left[at] <= max(_UNEXPLAINED * usual[at], _MAX_END_PART * unmoved[at])
            found.append((moved, float(unmoved[at] - left[at]), bool(good)))
        most = max(gained for _, gained, _ in found)
        moved, gained, good = next(each for each in found if each[1] >= most - least)
        return (moved, row + last - _REACH) if gained > least and good else None

    @property
    def _certain(self) -> float:
        """Half of the likelihood ratio that is certain, as coloured noise has it."""
        return _CERTAIN * self._need * _RESOLUTION**2

    def _search(self, row: int, line: np.ndarray, lag: int) -> tuple[int, int] | None:
        """A step by which the session explains the rows from one on, whatever lies between."""
        from scipy.signal import correlate

        if row < self._next_search or self._rows - row < 2 * _SHORTEST:
            return None
        self._next_search = row + max(_SEARCHED, (self._rows - row) // _MAX_SEARCHES)
        count = min(_SEARCHED, self._rows - row)
        one, best = self._followers[0], (math.inf, 0)
        here = np.nan_to_num(one.values[row : row + count] - one.offset)
        low, high = (
            ((each - self._first_s - one.late_s) / self._period_s - line[1] + line[2] * line[0]) / (1.0 + line[2])
            for each in one.stimulus.span_s
        )
        for begin in range(math.ceil(low), math.floor(high) - count, _SESSION_PARTS - count):
            at = np.arange(begin, min(math.floor(high), begin + _SESSION_PARTS))
            place = at + line[1] + line[2] * (at - line[0])
            known = one.gain * one.stimulus(self._first_s + one.late_s + place * self._period_s)[0]
            sums = np.cumsum(np.concatenate([[0.0], known**2]))
            left = float(here @ here) - 2.0 * correlate(known, here, "valid", "fft") + sums[count:] - sums[:-count]
            near = np.flatnonzero(left <= left.min() + 2.0 * self._certain * one.noise**2)
            moved = near + begin - row - lag
            best = min(best, (float(left.min()), int(moved[np.argmin(np.abs(moved))])))
        if best[0] > _HALF * count * float(np.var(here)):
            return None
        return (best[1], row) if best[1] else None

    def _place(self, line: np.ndarray, lag: int, moved: int, first: int, last: int) -> tuple[int, int]:
        """First and last row from which on a step may hold."""
        left = []
        for each in (lag, lag + moved):
            y, s, _ = self._evaluate(first, last, line, each)
            left.append(np.concatenate([[0.0], np.cumsum(np.nan_to_num((y - s) ** 2, nan=1e6).sum(axis=0))]))
        cost = left[0] + left[1][-1] - left[1]
        place = int(np.argmin(cost))
        near = np.flatnonzero(cost <= cost[place] + 2.0 * self._certain)
        return first + int(near[0]), first + int(near[-1])


def _fit(y: np.ndarray, s: np.ndarray, ds: np.ndarray, least: float = _HALF) -> tuple[float, bool, float]:
    """Time error of a block [samples], whether the known signal explains it, and how well it shows time.

    A block is explained where it leaves the usual noise, or for most of its power, at most `least` of which is left.
    """
    use = np.isfinite(y) & np.isfinite(s)
    r, slope = np.where(use, y - s, 0.0), np.where(use, ds, 0.0)
    known, error = float(np.sum(slope**2)), time_error(slope, r)
    if abs(error) < 1.0:
        r = r - error * slope
    rows = use.sum(axis=1)
    power = np.where(use, y, 0.0)
    whole = np.sum(power**2, axis=1) - power.sum(axis=1) ** 2 / np.maximum(rows, 1)
    left = np.sum(r**2, axis=1)
    good = ((left <= _UNEXPLAINED * rows) | (left <= least * whole))[rows > 0]
    return error, bool(2 * good.sum() >= len(good)), known


def _is_period(y: np.ndarray, s: np.ndarray, ds: np.ndarray, last: int, moved: int) -> bool:
    """Return whether a step explains the rows before it as well, and half of the step does not.

    Args:
        y: Rows over noise, shape (followers, n).
        s: The known signal over noise, shape (followers, n).
        ds: Its slope a sample, shape (followers, n).
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
    """The smallest of the steps that explain a block best [samples]; None where none does.

    Args:
        y: Rows of the block over noise, shape (followers, n).
        s: The known signal over noise, from `_REACH` rows before the block to as many after it.
        ds: Its slope a sample there.
        certain: Half of the likelihood ratio that tells two steps apart.
    """
    from scipy.signal import correlate

    left, pull, known = (np.zeros(2 * _REACH + 1) for _ in range(3))
    usable = ~np.isnan(s).any(axis=0)
    for values, signal, slope in zip(np.nan_to_num(y), np.nan_to_num(s), np.nan_to_num(ds), strict=True):
        kept = np.isfinite(values).astype(float)
        left += values @ values - 2.0 * correlate(signal, values, "valid") + correlate(signal**2, kept, "valid")
        pull += correlate(slope, values, "valid") - correlate(slope * signal, kept, "valid")
        known += correlate(slope**2, kept, "valid")
    error = np.clip(pull / np.maximum(known, 1e-300), -0.6, 0.6)
    left -= error * (2.0 * pull - error * known)
    left[correlate(usable.astype(float), np.ones(y.shape[1]), "valid") < y.shape[1] - 0.5] = np.inf
    near = np.flatnonzero(left <= left.min() + 2.0 * certain)
    at = int(near[np.argmin(np.abs(near - _REACH))])
    part = slice(at, at + y.shape[1])
    return at - _REACH if _fit(y, s[:, part], ds[:, part], 0.0)[1] else None


def _predict(history: list[tuple[float, float]], line: np.ndarray, row: int) -> np.ndarray:
    """Row and lag together, time error and its rise there, by the last blocks."""
    late = line[1] + line[2] * (row - line[0])
    if len(history) < 4:
        if history:
            late += history[-1][1] - line[1] - line[2] * (history[-1][0] - line[0])
        return np.array([row, late, line[2]])
    fitted = fit_line(*np.array(history).T)
    return np.array([row, fitted(row), fitted.slope if len(history) == _MEMORY else line[2]])


def follow_record(
    followers: Sequence[Follower], first_s: float, period_s: float, rows: int, stretch: tuple[int, int], pace: float
) -> Track:
    """Follow a record's rows through the session.

    Args:
        followers: Channels whose signal is found, the one that shows time best first.
        first_s: Time of the first row by the clock of the record [s].
        period_s: Time between two rows [s].
        rows: Number of rows.
        stretch: The rows where the signal is found: the first one, and the one after the last.
        pace: Rise of the time error there, by row [samples].
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
        Run(rows - run.end, rows - run.begin, -run.lag, (rows - doubt[1], rows - doubt[0]))
        for run, doubt in zip(back.runs, doubts[1:], strict=True)
    ][::-1]
    joined: list[Run] = []
    for run in [*runs, *onward.runs]:
        if joined and (joined[-1].end, joined[-1].lag) == (run.begin, run.lag):
            joined[-1] = replace(joined[-1], end=run.end)
        else:
            joined.append(run)
    blocks = [(rows - 1 - row, -late) for row, late in reversed(back.blocks)] + onward.blocks
    return Track(joined, np.array(blocks).reshape(-1, 2), (rows - back.end, onward.end))
