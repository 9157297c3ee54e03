"""Identification of recorded rows among those sent: missing, doubled, swapped and altered ones, in any number.

A row is identified by the hash of its counts, alone or with the next three, if that is unique among the rows nearby, or
else by its neighbours. Rows that arrive as sent are only compared. Memory holds the rows nearby, and events.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

NO_COUNT = np.iinfo(np.int64).min
"""Count of a recorded value that was not sent."""
_SEARCH_BACK, _PART = 1 << 14, 1 << 12
"""Rows before the next expected one among which a row is searched, and rows that are searched at a time."""
_SEARCH_AHEAD, _MAX_SEARCH_AHEAD = 1 << 13, 1 << 22
"""Rows ahead among which a row is searched first, and at most."""
_MAX_STRETCHES = 10_000
"""Largest number of stretches of altered values that are kept per channel."""
_MAX_ALTERED_PART = 0.5
"""Part of altered values above which a channel is not used to identify rows."""
_GROUP_ROWS = 4
"""Consecutive rows that are identified together if one alone is not unique."""
_MIN_RUN = 16
"""Fewest consecutive doubled rows after the last one that was sent: fewer are equal by chance."""


def row_hashes(counts: np.ndarray) -> np.ndarray:
    """Return a nearly unique number of each row, uint64, shape (n,), from counts, int64, shape (n, channels)."""
    hashes = np.zeros(len(counts), dtype=np.uint64)
    for c in range(counts.shape[1]):
        # splitmix64 (Steele, Lea & Flood 2014), with the column as its step.
        z = counts[:, c].astype(np.int64).view(np.uint64) + np.uint64((c + 1) * 0x9E3779B97F4A7C15 % (1 << 64))
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        hashes += z ^ (z >> np.uint64(31))
    return hashes


def group_hashes(hashes: np.ndarray, step: int = 1) -> np.ndarray:
    """Return a number of each row together with the next ones at a step; the last rows have fewer."""
    sums = hashes.copy()
    for n in range(1, _GROUP_ROWS):
        sums[: -n * step] += hashes[n * step :] * np.uint64(2 * n + 1) ^ np.uint64(n)
    return sums


def repeated_part(counts: np.ndarray) -> float:
    """Return the part of rows that recur together with the 63 rows that follow them.

    Args:
        counts: Counts of the rows, int64, shape (n, channels).
    """
    hashes = row_hashes(counts)
    for step in (1, _GROUP_ROWS, _GROUP_ROWS**2):
        hashes = group_hashes(hashes, step)
    _, inverse, times = np.unique(hashes[: -(_GROUP_ROWS**3)], return_inverse=True, return_counts=True)
    return float(np.mean(times[inverse] > 1)) if len(inverse) else 0.0


def take_rows(pieces: Iterable[np.ndarray], first: int, rows: int, columns: int) -> np.ndarray:
    """Return some rows of a table that is read in pieces, as far as there are any, shape (n, columns).

    Args:
        pieces: Rows in order, each shape (m, columns).
        first: Number of the first row that is taken.
        rows: Number of rows that are taken, at most.
        columns: Number of columns.
    """
    parts, at = [np.empty((0, columns), dtype=np.int64)], 0
    for piece in pieces:
        parts.append(piece[max(0, first - at) : max(0, first + rows - at)])
        at += len(piece)
        if at >= first + rows:
            break
    return np.concatenate(parts)


class Stretches:
    """Number of rows, and the first stretches of them, as there may be too many to keep.

    Attributes:
        rows: Number of rows.
    """

    def __init__(self, most: float = math.inf) -> None:
        """Set the largest number of stretches to keep."""
        self.rows, self._most = 0, most
        self._parts: list[np.ndarray] = []
        self._kept = 0

    def add(self, places: np.ndarray) -> None:
        """Add rows, approximately in ascending order, shape (n,)."""
        self.rows += len(places)
        if len(places) and self._kept < self._most:
            self._parts.append(stretches(np.unique(places)))
            self._kept += len(self._parts[-1])

    def pairs(self) -> np.ndarray:
        """Return the first and last row of each stretch, shape (n, 2)."""
        pairs = np.concatenate([*self._parts, np.empty((0, 2), dtype=np.int64)])
        begins = np.append(True, pairs[1:, 0] != pairs[:-1, 1] + 1)[: len(pairs)]
        return np.column_stack([pairs[begins, 0], pairs[np.append(begins[1:], True)[: len(pairs)], 1]])


def stretches(places: np.ndarray) -> np.ndarray:
    """Return the first and last of each stretch of consecutive ascending places, shape (n, 2)."""
    begins = np.diff(places, prepend=-2) != 1
    return np.column_stack([places[begins], places[np.append(begins[1:], True)[: len(places)]]])


@dataclass
class Followed:
    """Result of the comparison of rows.

    Attributes:
        sent: Number of rows that were sent.
        recorded: Number of rows that were recorded.
        last_row: Number of the last recorded row that was sent, or -1.
        first, last: Earliest and latest received row, by its place among those sent, or -1.
        doubled: Places of repeatedly received rows, and numbers of the recorded rows, int64, shape (n, 2).
        swapped: Places of rows received after later ones, and numbers of the recorded rows, shape (n, 2).
        altered: Rows with a different value, by channel.
        foreign: Numbers of recorded rows that were not sent, shape (n,).
        lost: First and last place of stretches between the first and the last row that are missing, shape (n, 2).
    """

    sent: int = 0
    recorded: int = 0
    last_row: int = -1
    first: int = -1
    last: int = -1
    doubled: np.ndarray = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))
    swapped: np.ndarray = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))
    altered: list[Stretches] = field(default_factory=list)
    foreign: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    lost: np.ndarray = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))


class _Sent:
    """Sent rows nearby, with the number of times each was received, and the missing ones among those before them."""

    def __init__(self, chunks: Iterable[np.ndarray], by: np.ndarray) -> None:
        self._chunks = iter(chunks)
        self.start = self.end = 0
        self.ended = False
        self.counts = np.empty((0, 0), dtype=np.int64)
        self.hashes = np.empty(0, dtype=np.uint64)
        self.times, self.absent = np.empty(0, dtype=np.uint8), Stretches()
        self.by = by

    def set_columns(self, by: np.ndarray) -> None:
        """Set the columns by which rows are identified."""
        if not np.array_equal(by, self.by):
            self.by = by
            self.hashes = row_hashes(self.counts[:, by])

    def read_range(self, begin: int, end: int) -> None:
        """Read rows from one place to another, as far as there are any, and release those before."""
        fresh = []
        while self.end < end and not self.ended:
            chunk = next(self._chunks, None)
            if chunk is None:
                self.ended = True
            elif len(chunk):
                fresh.append(chunk)
                self.end += len(chunk)
        if fresh or begin - self.start > 1 << 18:
            begin = min(max(begin, self.start), self.end)
            cut = begin - self.start
            new = np.concatenate(fresh) if fresh else self.counts[:0]
            self.times = np.append(self.times, np.zeros(len(new), dtype=np.uint8))
            self.absent.add(np.flatnonzero(self.times[:cut] == 0) + self.start)
            late = row_hashes(new[max(0, cut - len(self.hashes)) :, self.by])
            self.hashes = np.concatenate([self.hashes[cut:], late])
            self.counts = np.concatenate([self.counts, new])[cut:] if len(self.counts) else new[cut:]
            self.times, self.start = self.times[cut:], begin


def follow(
    sent: Iterable[np.ndarray], recorded: Iterable[np.ndarray], sound: int, start: int = 0
) -> Iterator[tuple[np.ndarray, Followed]]:
    """Compare recorded rows with those sent.

    Args:
        sent: Counts in chunks, int64, shape (n, channels).
        recorded: Recorded counts in chunks; `NO_COUNT` for other values.
        sound: Number of first channels by which rows are identified; the others are only compared.
        start: Place at which the first recorded row is expected.

    Yields:
        Place of each recorded row among those sent, -1 for a foreign one, shape (n,), chunk by chunk; and the results
        up to there, whose arrays are complete with the last chunk, which has no rows.
    """
    window, result = _Sent(sent, np.arange(sound)), Followed()
    events: dict[str, list[np.ndarray]] = {"doubled": [], "swapped": [], "foreign": []}
    due, highest = start, -1
    for place in range(0, start - _SEARCH_BACK, 1 << 18):
        window.read_range(place, place + (1 << 18))
    for chunk in recorded:
        result.altered = result.altered or [Stretches(_MAX_STRETCHES) for _ in range(chunk.shape[1])]
        before = np.array([each.rows for each in result.altered])
        hashes = row_hashes(chunk[:, window.by])
        places = np.empty(len(chunk), dtype=np.int64)
        at, low = 0, due - _SEARCH_BACK
        while at < len(chunk):
            window.read_range(low, due + len(chunk) - at)
            near = window.hashes[due - window.start : due - window.start + len(chunk) - at]
            same = near == hashes[at : at + len(near)]
            equal = len(near) if same.all() else int(np.argmin(same))
            places[at : at + equal] = due + np.arange(equal)
            at, due = at + equal, due + equal
            if at < len(chunk):
                part = slice(at, at + _PART)
                places[part] = _search_places(window, hashes[part], due, low)
                at = min(at + _PART, len(chunk))
                identified = places[part][places[part] >= 0]
                due = int(identified[-1]) + 1 if len(identified) else due + at - part.start
        highest = _count_events(result, events, places, chunk, window, highest)
        wrong = np.array([each.rows for each in result.altered]) - before
        by = np.flatnonzero(wrong[:sound] < _MAX_ALTERED_PART * len(chunk))
        window.set_columns(by if len(by) else np.arange(sound))
        yield places, result
    while not window.ended:
        window.read_range(window.end, window.end + 1)
    window.absent.add(np.flatnonzero(window.times == 0) + window.start)
    result.sent = window.end
    lost = window.absent.pairs()
    result.lost = lost[(lost[:, 0] > result.first) & (lost[:, 1] < result.last)]
    for name, parts in events.items():
        if parts:
            setattr(result, name, np.concatenate(parts))
    yield np.empty(0, dtype=np.int64), result


def _search_places(window: _Sent, hashes: np.ndarray, due: int, low: int) -> np.ndarray:
    """Return the places of rows; search farther ahead if few of the last are found, or some may be beyond."""
    ahead = _SEARCH_AHEAD
    while True:
        high = due + len(hashes) + ahead
        window.read_range(low, high)
        places, alone = _find_places(window, hashes, due, max(low, due - _SEARCH_BACK), high)
        placed = np.flatnonzero(places >= 0)
        inside = len(placed) and places[placed[-1]] + len(hashes) - placed[-1] <= high
        ended = window.ended and high >= window.end
        if (inside and alone[-len(hashes) // 2 :].mean() > 0.5) or ended or ahead >= _MAX_SEARCH_AHEAD:
            return places
        ahead *= 8


def _find_places(window: _Sent, hashes: np.ndarray, due: int, low: int, high: int) -> tuple[np.ndarray, np.ndarray]:
    """Return each row's place in a range, -1 if it has none, and whether it is identified without its neighbours."""
    start = max(window.start, low)
    nearby = window.hashes[start - window.start : high - window.start]
    if not len(nearby):  # all are expected after the last one
        return np.full(len(hashes), -1, dtype=np.int64), np.zeros(len(hashes), dtype=bool)
    end = start + len(nearby)
    n, rows = len(hashes), np.arange(len(hashes))
    places = np.full(n, -1, dtype=np.int64)
    ranks = {}
    for level, (there, here) in enumerate(((nearby, hashes), (group_hashes(nearby), group_hashes(hashes)))):
        order = np.argsort(there, kind="stable")
        ordered = there[order]
        left, right = np.searchsorted(ordered, here), np.searchsorted(ordered, here, side="right")
        alone = (right - left == 1) & (places < 0)
        if level:
            alone &= rows <= n - _GROUP_ROWS
        places[alone] = order[left[alone]] + start
        if not level:
            ranks = {"order": order, "ordered": ordered, "left": left, "right": right}
    if window.ended and end == window.end:
        _forget_chance_places(places, due, end)
    identified = places >= 0
    open_ = np.flatnonzero(~identified)
    behind = np.maximum.accumulate(np.where(identified, rows, -1))[open_]
    next_ = np.minimum.accumulate(np.where(identified, rows, n)[::-1])[::-1][open_]
    forward = np.where(behind >= 0, places[behind] + open_ - behind, due + open_)
    backward = np.where(next_ < n, places[np.minimum(next_, n - 1)] - (next_ - open_), -1)
    for guess in (forward, backward):
        inside = (guess >= start) & (guess < end) & (places[open_] < 0)
        at = np.where(inside, guess - start, 0)
        right_one = inside & (nearby[at] == hashes[open_])
        places[open_[right_one]] = guess[right_one]
    left = np.flatnonzero(places[open_] < 0)
    if window.ended and end == window.end:  # rows after the last one are not those of earlier periods
        left = left[forward[left] < end]
    if len(left):
        if not identified.any():  # a periodic signal: all rows follow the first one
            _place_nearest(places, open_[left[:1]], forward[left[:1]], ranks, start)
            forward[left] += max(0, places[open_[left[0]]] - forward[left[0]])
        _place_nearest(places, open_[left], forward[left], ranks, start)
    left = np.flatnonzero(places[open_] < 0)
    # An unidentified row at the place of an expected one is that row, altered.
    stop = np.where(next_[left] < n, places[np.minimum(next_[left], n - 1)], end)
    fits = (forward[left] < stop) & (forward[left] < end)
    places[open_[left[fits]]] = forward[left[fits]]
    return places, identified


def _forget_chance_places(places: np.ndarray, due: int, end: int) -> None:
    """Remove places of rows after the last one that was sent, unless all of them follow earlier rows in long runs.

    Rows after a session resemble it if its signal repeats, so that many are equal by chance.
    """
    after = 0 if due >= end else len(places) if (last := np.flatnonzero(places == end - 1)).size == 0 else last[0] + 1
    rest = places[after:]
    begins = np.flatnonzero(np.diff(rest, prepend=-3) != 1)
    if len(rest) and np.diff(np.append(begins, len(rest))).min() < min(_MIN_RUN, len(rest)):
        rest[:] = -1


def _place_nearest(places: np.ndarray, rows: np.ndarray, guess: np.ndarray, ranks: dict, start: int) -> None:
    """Set the place of rows that equal several sent ones to the one nearest to the expected place."""
    left, right, order = ranks["left"][rows], ranks["right"][rows], ranks["order"]
    several = right > left
    rows, guess, left, right = rows[several], guess[several] - start, left[several], right[several]
    if not len(rows):
        return
    # Places ascend among equal hashes: one search for all, in numbers that combine hash and place.
    ordered = ranks["ordered"]
    group = np.cumsum(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    whole = group * (len(order) + 1) + order
    rank = np.searchsorted(whole, group[left] * (len(order) + 1) + np.clip(guess, 0, len(order)))
    low, high = np.clip(rank - 1, left, right - 1), np.clip(rank, left, right - 1)
    nearer = np.abs(order[low] - guess) < np.abs(order[high] - guess)
    places[rows] = np.where(nearer, order[low], order[high]) + start


def _count_events(
    result: Followed, events: dict[str, list[np.ndarray]], places: np.ndarray, counts: np.ndarray, window: _Sent,
    highest: int,
) -> int:  # fmt: skip
    """Count the events of a chunk; return the latest place of all."""
    numbers = result.recorded + np.arange(len(places))
    result.recorded += len(places)
    real = places >= 0
    events["foreign"].append(numbers[~real])
    came, numbers, counts = places[real], numbers[real], counts[real]
    if not len(came):
        return highest
    result.last_row = int(numbers[-1])
    near, there = came - window.start, window.times
    tops = np.maximum.accumulate(np.concatenate([[highest], came]))
    if (np.diff(tops) > 0).all():  # ascending: neither doubled nor swapped
        there[near] = 1
    else:
        again = there[near] > 0
        order = np.argsort(came, kind="stable")
        again[order[1:]] |= came[order[1:]] == came[order[:-1]]
        events["doubled"].append(np.column_stack([came, numbers])[again])
        late = (came < tops[:-1]) & ~again
        events["swapped"].append(np.column_stack([came, numbers])[late])
        there[near] = 1
    for column, wrong in enumerate((window.counts[near] != counts).T):
        result.altered[column].add(came[wrong])
    result.first = int(came.min()) if result.first < 0 else min(result.first, int(came.min()))
    result.last = max(result.last, int(came.max()))
    return int(tops[-1])
