"""Frame rate of a live view, with viewers of a few lines and a simulated clock."""

from __future__ import annotations

import math
from collections import deque

import pytest

from recorder.viewer.pace import MAX_WAIT_S, MIN_INTERVAL_S, Pace

TICK_S = 0.04


class Viewer:
    """Receives pictures one after the other, each in a fixed time; draws and uses simulated time as wall time."""

    def __init__(self, cost_s: float) -> None:
        self.cost_s = cost_s
        self.pace = Pace()
        self.waiting: deque[tuple[int, float]] = deque()
        self.busy_until_s = 0.0
        self.taken = 0
        self.drawn: list[float] = []
        self.behind_s: list[float] = []
        self.now_s = 0.0

    def run(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += TICK_S
            while self.waiting:
                done_s = max(self.busy_until_s, self.waiting[0][1]) + self.cost_s
                if done_s > self.now_s:
                    break
                self.busy_until_s = done_s
                self.taken, _ = self.waiting.popleft()
            self.pace.record_displayed(self.taken, now_s=self.now_s)
            if self.pace.due(self.now_s):
                self.drawn.append(self.now_s)
                self.pace.record_drawn(len(self.drawn), now_s=self.now_s)
                self.waiting.append((len(self.drawn), self.now_s))
            if (behind_s := self.pace.behind_s(self.now_s)) is not None:
                self.behind_s.append(behind_s)


@pytest.mark.parametrize("cost_s", [0.01, 0.1, 0.5, 1.5, 4.0])
def test_a_viewer_of_any_speed_stays_current(cost_s: float) -> None:
    viewer = Viewer(cost_s)
    viewer.run(300.0)
    assert max(viewer.behind_s) < 2.0 + 2.5 * cost_s
    # And it is not idle: it receives a good part of its capacity.
    could = min(1.0 / MIN_INTERVAL_S, 1.0 / cost_s)
    assert 0.6 * could < len(viewer.drawn) / 300.0 < 1.1 * could


def test_the_frame_rate_follows_a_viewer_that_slows_down_and_recovers() -> None:
    viewer = Viewer(0.01)
    viewer.run(20.0)
    assert viewer.pace.every_s == pytest.approx(MIN_INTERVAL_S)
    viewer.cost_s = 1.0
    viewer.run(60.0)
    assert len(viewer.waiting) <= 2
    viewer.cost_s = 0.01
    viewer.run(30.0)
    assert viewer.pace.every_s == pytest.approx(MIN_INTERVAL_S)
    assert viewer.behind_s[-1] < 0.2


def test_a_stalled_viewer_gets_an_occasional_picture() -> None:
    viewer = Viewer(math.inf)
    viewer.run(100.0)
    late = [time for time in viewer.drawn if time > 2.0]
    assert len(late) == pytest.approx(100.0 / MAX_WAIT_S, abs=1)
    assert viewer.pace.behind_s(viewer.now_s) is None


def test_without_a_viewer_nothing_is_drawn() -> None:
    pace = Pace()
    drawn = 0
    for tick in range(1000):
        now_s = tick * TICK_S
        pace.record_displayed(None, now_s=now_s)
        if pace.due(now_s):
            drawn += 1
            pace.record_drawn(drawn, now_s=now_s)
    assert drawn == pytest.approx(1000 * TICK_S / MAX_WAIT_S, abs=1)
    assert not pace.is_viewed
