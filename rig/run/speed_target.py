"""Speed target of the drive, as in a scene and as linear segments of speed over time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, field_validator

from rig.base.checks import Written

_MIN_SPACING_S = 0.01
"""Minimum time between two points of a speed profile [s]: well above any step."""


class Drive(Written):
    """Speed target of the motor."""

    mode: Literal["torque", "ideal"] = "torque"
    """A torque law (the spin can dip), or a prescribed spin."""
    speed_hz: Annotated[FiniteFloat, Field(ge=0.0)] = 0.0
    """Constant speed [Hz], unless a profile is given."""
    profile: tuple[tuple[FiniteFloat, FiniteFloat], ...] = ()
    """Points (time [s], speed [Hz]), connected linearly; the last speed is held."""

    @field_validator("profile")
    @classmethod
    def _check_ascending(cls, profile: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        times = [time for time, _ in profile]
        if profile and (times[0] != 0.0 or any(b < a + _MIN_SPACING_S - 1e-9 for a, b in pairwise(times))):
            raise ValueError(f"points of ascending time, at least {_MIN_SPACING_S:g} s apart, the first at 0")
        if any(speed < 0.0 for _, speed in profile):
            raise ValueError("points of speed >= 0")
        return profile


@dataclass(frozen=True, slots=True)
class Segment:
    """Speed target from a tick: `speed + slope (t - tick)` [rad/s]."""

    tick: int
    speed: float
    slope: float


def segments(profile: Sequence[tuple[float, float]], tick_rate_hz: int) -> list[Segment]:
    """Return the segments between points (time [s], speed [Hz]), and the last one that holds."""
    points = [(round(time_s * tick_rate_hz), 2.0 * math.pi * hz) for time_s, hz in profile]
    pieces = [Segment(t0, w0, (w1 - w0) / (t1 - t0) * tick_rate_hz) for (t0, w0), (t1, w1) in pairwise(points)]
    return [*pieces, Segment(points[-1][0], points[-1][1], 0.0)]


def ramp(tick: int, now: float, speed_hz: float, rate: float, tick_rate_hz: int) -> list[Segment]:
    """Return the segments from a tick on: a ramp from the target `now` [rad/s] at a rate [rad/s^2], then the speed."""
    target = 2.0 * math.pi * speed_hz
    length = round(abs(target - now) / rate * tick_rate_hz)
    hold = Segment(tick=tick + length, speed=target, slope=0.0)
    return [Segment(tick=tick, speed=now, slope=(target - now) / length * tick_rate_hz), hold] if length else [hold]
