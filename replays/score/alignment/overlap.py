"""Overlap of a recording with the session, found by counts alone: without stamps, whatever precedes or follows it.

Groups of consecutive counts are hashed. The side with fewer rows is kept sorted, the other one is read in pieces, so
that the memory used does not grow with the length of either.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from replays.score.records.rows import row_hashes, stretches

_GROUP_LENGTH = 16
"""Consecutive counts that are hashed together: enough to be distinct in a channel with few levels."""
_MIN_VOTES = 16
"""Groups that must agree on the start of the recording; chance agreements are single ones."""
_MAX_PLACES, _MIN_VOTE_PART = 8, 0.25
"""Largest number of returned places, and the part of the most votes that each must have."""
_MAX_EXACT = 2
"""Largest number of further places at which all groups agree; chance ones have fewer votes."""
_MAX_GROUPS = 1 << 20
"""Groups of the shorter side that are kept; of a longer one every n-th by its hash is used on both sides."""
_MIN_UNEQUAL, _MAX_PART_UNEQUAL = 7.0, 0.2
"""Expected unequal rows in a run of equal ones if the signal only repeats (a chance of 0.1 %), and largest part."""

_Pieces = Callable[[], Iterable[np.ndarray]]


def find_starts(recorded: Iterable[np.ndarray], sent: Iterable[np.ndarray], step: int, fewest: int) -> list[int]:
    """Return places among the sent rows at which the first recorded row may be; negative ones before the session.

    The most probable is first. Where a signal repeats, the place with most rows in common is not always correct.

    Args:
        recorded: Counts of one channel in pieces, int64, each shape (n,).
        sent: Counts of the channel in the session in pieces, int64, each shape (m,).
        step: Sent rows per recorded row.
        fewest: Number of rows of the shorter side.
    """
    every = np.uint64(max(1, fewest // _MAX_GROUPS))
    hashes, rows = (np.concatenate(each) for each in zip(*_hash_groups(recorded, 1, every), strict=True))
    hashes, first = np.unique(hashes, return_index=True)
    if len(hashes) < _MIN_VOTES:
        return []
    rows, pairs, last = rows[first], [np.empty((0, 2), dtype=np.int64)], -1
    for there, places in _hash_groups(sent, step, every):
        at = np.minimum(np.searchsorted(hashes, there), len(hashes) - 1)
        same = hashes[at] == there
        pairs.append(np.column_stack([rows[at[same]], places[same] - step * rows[at[same]]]))
        last = int(places[-1]) if len(places) else last
    at, starts = np.concatenate(pairs).T
    if not len(at):
        return []
    values, which, votes = np.unique(starts, return_inverse=True, return_counts=True)
    most = which == np.argmax(votes)
    places, first = starts + step * at, int(np.argmin(np.where(most, at, at.max() + 1)))
    # Each lost row moves the rows after it: an earlier stretch than the longest one shows where it begins, unless its
    # rows recur within the longest one, as rows before the session may.
    clear = votes[which] >= max(_MIN_VOTES, 0.01 * votes.max())
    clear &= most | ((at < at[first]) & (places < places[first]))
    likeliest = starts[clear][np.argmin(at[clear])][None] if clear.any() else starts[:0]
    # Most starts of a nearly repeating signal have some unequal rows: one without may have few rows in the session.
    held, ranked = np.sort(rows), np.argsort(-votes)[: len(votes) if votes.max() >= _MIN_VOTES else 0]
    inside = np.searchsorted(held, (last - values) // step, side="right") - np.searchsorted(held, -(values // step))
    exact = (votes >= _MIN_VOTES) & (votes == inside)
    others = [*ranked[votes[ranked] >= _MIN_VOTE_PART * votes.max()][:_MAX_PLACES], *ranked[exact[ranked]][:_MAX_EXACT]]
    return list(dict.fromkeys([*likeliest.tolist(), *values[others].tolist()]))


def holds_session_rows(rows: np.ndarray, outside: np.ndarray, judged: range, sent: _Pieces) -> bool:
    """Return whether rows recorded outside the session equal rows in it over a longer run than by repetition alone.

    A repeating signal also repeats within the session. The part of unequal rows between the session's last rows and the
    rows one period earlier is the rate at which a continued signal would differ.

    Args:
        rows: Hashes of consecutive recorded rows on both sides of an end of the session, int64, shape (n,).
        outside: Whether each row is outside the session, shape (n,).
        judged: Places in the session of rows that are excluded.
        sent: Function that returns the hashes of the session's rows in pieces, int64, each shape (m,).
    """
    starts = np.array(find_starts([rows[outside]], sent(), 1, int(outside.sum())), dtype=np.int64)[:, None]
    places, at = starts - np.argmax(outside) + np.arange(len(rows)), 0
    there = np.zeros_like(places)
    for piece in sent():
        inside = (places >= at) & (places < at + len(piece))
        there[inside], at = piece[places[inside] - at], at + len(piece)
    equal, beside = there == rows, (there != 0) & ~outside
    part = np.min((1 + (beside & ~equal).sum(1)) / (1 + beside.sum(1)), initial=_MAX_PART_UNEQUAL)
    equal &= outside & ((places < judged.start) | (places >= judged.stop))
    moving = np.cumsum(np.tile(np.diff(rows, append=rows[-1:]) != 0, len(starts)))
    longest = np.diff(moving[stretches(np.flatnonzero(equal))]).max(initial=0)  # without constant rows
    return bool(part * longest > _MIN_UNEQUAL + math.log(1.0 + part * len(rows)))


def _hash_groups(pieces: Iterable[np.ndarray], step: int, every: np.uint64) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield hashes and first rows of groups of counts that are not all equal; every n-th by its hash."""
    held, at, reach = np.empty(0, dtype=np.int64), 0, (_GROUP_LENGTH - 1) * step
    yield np.empty(0, dtype=np.uint64), held
    for piece in pieces:
        held = np.concatenate([held, piece])
        size = len(held) - reach
        if size < 1:
            continue
        single = row_hashes(held[:, None])
        hashes, moving = np.zeros(size, dtype=np.uint64), np.zeros(size, dtype=bool)
        for n in range(0, reach + 1, step):
            hashes = hashes * np.uint64(0x9E3779B97F4A7C15) + single[n : n + size]
            moving |= single[n : n + size] != single[:size]
        chosen = np.flatnonzero(moving & ((hashes >> np.uint64(20)) % every == 0))
        yield hashes[chosen], at + chosen
        held, at = held[size:], at + size
