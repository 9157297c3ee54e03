"""Rows of the digital path: which sent row each recorded one is, at any offset and after any loss."""

from __future__ import annotations

import numpy as np
import pytest

from replays.score.records.rows import Followed, follow

_RANDOM = np.random.default_rng(1).integers(-1_000_000, 1_000_000, (40_000, 3))
OFFSETS = [0, 1, 8192, 8193, 9012, 12_288, 26_000]


def followed(sent: np.ndarray, recorded: np.ndarray, start: int = 0, pieces: int = 1) -> Followed:
    found = Followed()
    for _, found in follow(np.array_split(sent, pieces), [recorded], sent.shape[1], start):  # noqa: B007
        pass
    return found


def list_wrong_rows(found: Followed) -> list[int]:
    """Return the numbers of missing, foreign, repeated, swapped and altered rows."""
    events = found.foreign, found.doubled, found.swapped
    missing = int(np.sum(found.lost[:, 1] - found.lost[:, 0] + 1))
    return [missing, *map(len, events), sum(each.rows for each in found.altered)]


@pytest.mark.parametrize("pieces", [1, 9])
@pytest.mark.parametrize("offset", OFFSETS)
def test_a_perfect_record_has_every_row_at_any_start(offset: int, pieces: int) -> None:
    found = followed(_RANDOM, _RANDOM[offset : offset + 14_000], 0, pieces)
    assert (list_wrong_rows(found), found.first, found.last) == ([0] * 5, offset, offset + 13_999)


@pytest.mark.parametrize("offset", OFFSETS)
def test_a_loss_of_any_length_is_these_rows(offset: int) -> None:
    at = 3000
    found = followed(_RANDOM, np.delete(_RANDOM[: offset + 14_000], np.s_[at : at + offset], axis=0))
    assert list_wrong_rows(found) == [offset, 0, 0, 0, 0]
    assert offset == 0 or found.lost.tolist() == [[at, at + offset - 1]]


@pytest.mark.parametrize("early", [0, 300])
@pytest.mark.parametrize("period", [250, 1000, 1024, 5000])
def test_a_periodic_record_has_every_row_in_order(period: int, early: int) -> None:
    sent = _RANDOM[np.arange(40_000) % period]
    found = followed(sent, sent[9012 : 9012 + 14_000], early)
    assert list_wrong_rows(found) == [0] * 5
    assert (found.first - 9012) % period == 0
