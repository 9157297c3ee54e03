"""Deadlines and waits of `rig.serve.waiting`."""

from __future__ import annotations

import math
import threading

import pytest

from rig.serve.waiting import Deadline, wait_until


def test_a_deadline_returns_the_remaining_time() -> None:
    assert 0.0 < Deadline(60.0).left_s <= 60.0
    assert not Deadline(60.0).passed
    for past in (Deadline(0.0), Deadline(-1.0)):
        assert past.left_s == 0.0
        assert past.passed


def test_without_a_time_there_is_no_deadline() -> None:
    never = Deadline(None)
    assert math.isinf(never.left_s)
    assert not never.passed


@pytest.mark.parametrize("timeout_s", [None, 60.0])
def test_a_wait_on_a_condition_ends_with_a_notification(timeout_s: float | None) -> None:
    changed, items = threading.Condition(), list[int]()

    def add() -> None:
        with changed:
            items.append(1)
            changed.notify_all()

    deadline = Deadline(timeout_s)
    with changed:
        threading.Thread(target=add).start()
        while not items:
            assert deadline.wait(changed)


def test_a_wait_on_a_condition_after_the_deadline_returns_at_once() -> None:
    changed = threading.Condition()
    with changed:
        assert not Deadline(0.0).wait(changed)
        assert Deadline(0.001).wait(changed)  # one last check: the condition may have changed meanwhile


@pytest.mark.parametrize("timeout_s", [0.0, -5.0])
def test_a_condition_is_checked_once_even_without_time(timeout_s: float) -> None:
    assert wait_until(lambda: True, timeout_s)
    assert not wait_until(lambda: False, timeout_s)
    assert len(list(Deadline(timeout_s).polls())) == 1


def test_the_last_check_is_after_the_deadline() -> None:
    deadline = Deadline(0.01)
    looks = [deadline.passed for _ in deadline.polls(0.004)]
    assert looks[-1]
    assert not any(looks[:-1])
