"""Overlap of a recording with the session by their counts alone, whatever either holds before, after or in its stamps.

Groups of consecutive counts are hashed. The side with fewer rows is held sorted, the other one is read in pieces, so
that memory does not grow with the length of either.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from replays.score.records.rows import row_hashes, stretches

_GRAM = 16
"""Consecutive counts that are hashed together: a channel with few levels is then still distinct."""
_MIN_VOTES = 16
"""Groups that must agree on where the recording begins; chance agreements are single ones."""
_CANDIDATES, _RIVAL = 8, 0.25
"""Places that are told, at most, and part of the most votes that each must have."""
_EXACT = 2
"""Further places that are returned, at most, where all groups agree; chance ones have fewer votes."""
_MAX_HELD = 1 << 20
"""Groups of the shorter side that are held; of a longer one every n-th by its hash is taken on both sides."""
_MIN_UNEQUAL, _MAX_PART_UNEQUAL = 7.0, 0.2
"""Unequal rows that a run of equal ones would have if the signal only repeats: a chance of 0.1 %; and their part."""

_Pieces = Callable[[], Iterable[np.ndarray]]


def find_begins(recorded: Iterable[np.ndarray], sent: Iterable[np.ndarray], step: int, fewest: int) -> list[int]:
    """Return places among the sent rows at which the first recorded row may stand; negative ones before the session.

    The likeliest is first. Where a signal repeats, one that has most rows in common is not always the right one.

    Args:
        recorded: Counts of one channel in pieces, int64, each shape (n,).
        sent: Counts of the channel in the session in pieces, int64, each shape (m,).
        step: Sent rows from one recorded row to the next.
        fewest: Number of rows of the shorter side.
    """
    every = np.uint64(max(1, fewest // _MAX_HELD))
    hashes, rows = (np.concatenate(each) for each in zip(*_groups(recorded, 1, every), strict=True))
    hashes, first = np.unique(hashes, return_index=True)
    if len(hashes) < _MIN_VOTES:
        return []
    rows, pairs, last = rows[first], [np.empty((0, 2), dtype=np.int64)], -1
    for there, places in _groups(sent, step, every):
        at = np.minimum(np.searchsorted(hashes, there), len(hashes) - 1)
        same = hashes[at] == there
        pairs.append(np.column_stack([rows[at[same]], places[same] - step * rows[at[same]]]))
        last = int(places[-1]) if len(places) else last
    at, begins = np.concatenate(pairs).T
    if not len(at):
        return []
    values, which, votes = np.unique(begins, return_inverse=True, return_counts=True)
    most = which == np.argmax(votes)
    places, first = begins + step * at, int(np.argmin(np.where(most, at, at.max() + 1)))
    # Each lost row moves what follows: a stretch ahead of the longest one tells where it begins, unless it has rows
    # that come again in that one, as what stands before the session may have.
    clear = votes[which] >= max(_MIN_VOTES, 0.01 * votes.max())
    clear &= most | ((at < at[first]) & (places < places[first]))
    likeliest = begins[clear][np.argmin(at[clear])][None] if clear.any() else begins[:0]
    # Where a signal nearly repeats, most begins have some unequal rows: one that has none may have few in the session.
    held, ranked = np.sort(rows), np.argsort(-votes)[: len(votes) if votes.max() >= _MIN_VOTES else 0]
    inside = np.searchsorted(held, (last - values) // step, side="right") - np.searchsorted(held, -(values // step))
    exact = (votes >= _MIN_VOTES) & (votes == inside)
    others = [*ranked[votes[ranked] >= _RIVAL * votes.max()][:_CANDIDATES], *ranked[exact[ranked]][:_EXACT]]
    return list(dict.fromkeys([*likeliest.tolist(), *values[others].tolist()]))


def holds_session_rows(rows: np.ndarray, outside: np.ndarray, judged: range, sent: _Pieces) -> bool:
    """Return whether rows recorded outside the session equal rows in it over a longer run than by repetition alone.

    A signal that repeats does so within the session, too. Unequal rows between the session's rows at its end and those
    that stand as far before them give the rate at which a continued signal would differ.

    Args:
        rows: Hashes of consecutive recorded rows on both sides of an end of the session, int64, shape (n,).
        outside: Whether each stands outside the session, shape (n,).
        judged: Places in the session of rows that are not looked for.
        sent: Function that returns the hashes of the session's rows in pieces, int64, each shape (m,).
    """
    begins = np.array(find_begins([rows[outside]], sent(), 1, int(outside.sum())), dtype=np.int64)[:, None]
    places, at = begins - np.argmax(outside) + np.arange(len(rows)), 0
    there = np.zeros_like(places)
    for piece in sent():
        inside = (places >= at) & (places < at + len(piece))
        there[inside], at = piece[places[inside] - at], at + len(piece)
    equal, beside = there == rows, (there != 0) & ~outside
    part = np.min((1 + (beside & ~equal).sum(1)) / (1 + beside.sum(1)), initial=_MAX_PART_UNEQUAL)
    equal &= outside & ((places < judged.start) | (places >= judged.stop))
    moving = np.cumsum(np.tile(np.diff(rows, append=rows[-1:]) != 0, len(begins)))
    longest = np.diff(moving[stretches(np.flatnonzero(equal))]).max(initial=0)  # without rows that stand still
    return bool(part * longest > _MIN_UNEQUAL + math.log(1.0 + part * len(rows)))


def _groups(pieces: Iterable[np.ndarray], step: int, every: np.uint64) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield hashes and first rows of groups of counts that are not all equal; every n-th by its hash."""
    held, at, reach = np.empty(0, dtype=np.int64), 0, (_GRAM - 1) * step
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
        taken = np.flatnonzero(moving & ((hashes >> np.uint64(20)) % every == 0))
        yield hashes[taken], at + taken
        held, at = held[size:], at + size
