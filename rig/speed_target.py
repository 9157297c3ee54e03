"""What the drive aims at: straight pieces of speed over time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise


@dataclass(frozen=True, slots=True)
class Segment:
    """The speed target from a tick on: `speed + slope (t - tick)` [rad/s]."""

    tick: int
    speed: float
    slope: float


def segments(profile: Sequence[tuple[float, float]], tick_rate_hz: int) -> list[Segment]:
    """The pieces between points (time [s], speed [Hz]), and the last one held."""
    points = [(round(time_s * tick_rate_hz), 2.0 * math.pi * hz) for time_s, hz in profile]
    pieces = [Segment(t0, w0, (w1 - w0) / (t1 - t0) * tick_rate_hz) for (t0, w0), (t1, w1) in pairwise(points)]
    return [*pieces, Segment(points[-1][0], points[-1][1], 0.0)]
