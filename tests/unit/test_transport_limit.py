"""Commands per second, on a simulated clock."""

from __future__ import annotations

import pytest

from rig.base.errors import InputError
from rig.serve.transport.limit import CommandLimit


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def let_through(limit: CommandLimit, sender: str, count: int) -> int:
    passed = 0
    for _ in range(count):
        try:
            limit.check(sender)
        except InputError:
            continue
        passed += 1
    return passed


def test_a_flood_is_refused_beyond_a_burst_and_a_rate() -> None:
    clock = Clock()
    limit = CommandLimit(20.0, 50, now_s=clock)
    assert let_through(limit, "a", 2000) == 50
    assert limit.refused == 1950
    clock.now_s = 1.0
    assert let_through(limit, "a", 2000) == 20
    for _ in range(100):
        clock.now_s += 0.1
        assert let_through(limit, "a", 1) == 1, "ten a second are never refused"
    clock.now_s += 1e6
    assert let_through(limit, "a", 2000) == 50
    with pytest.raises(
        InputError, match=r"^commands must be at most 20 per second from one sender, 80 from all; .*from a"
    ):
        limit.check("a")


def test_senders_have_separate_limits_and_false_names_a_common_one() -> None:
    clock = Clock()
    limit = CommandLimit(20.0, 50, now_s=clock)
    assert let_through(limit, "loud", 2000) == 50
    assert let_through(limit, "quiet", 50) == 50
    clock.now_s = 100.0
    assert sum(let_through(limit, f"name {n}", 10) for n in range(1000)) == 200
    clock.now_s = 101.0
    assert sum(let_through(limit, f"name {n}", 10) for n in range(1000, 2000)) == 80
    assert len(limit.senders) <= 64
