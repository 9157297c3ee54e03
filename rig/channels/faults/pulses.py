"""What may go wrong with the pulses of the keyphasor: kinds about turns, beside those of `faults.kinds`."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, FiniteFloat

from rig.channels.faults.kind import SIGMAS, At, Kind, late_v
from rig.channels.table import Channel

MAX_TURNS_HZ = 100.0
"""No shaft here turns faster: a fault of turns has no more of them [1/s]."""


class MissPulses(Kind, number=27):
    """No pulse in turns whose u(turn) < part."""

    stage = "keyphasor"
    channel_only = "keyphasor"
    kind: Literal["miss-pulses"] = "miss-pulses"
    part: Annotated[FiniteFloat, Field(gt=0.0, le=1.0)] = 0.2

    def chance(self, rate_hz: int) -> tuple[str, float, float]:
        return "part", 1.0, 1.0 / MAX_TURNS_HZ

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return np.where(_picked(at, self.part), 0.0, x)

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        return ticks[~_picked(at, self.part)] if len(ticks) else ticks


class ExtraPulses(MissPulses, number=28):
    """A pulse half a turn behind that of turns whose u(turn) < part."""

    kind: Literal["extra-pulses"] = "extra-pulses"  # pyrefly: ignore[bad-override]

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return np.maximum(x, np.where(_picked(at, self.part), at.mark(at.angle - math.pi), 0.0))

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        if not len(ticks):
            return ticks
        extra = ticks + 1e6 * math.pi / at.rate
        return np.sort(np.concatenate([ticks, extra[_picked(at, self.part)]]))


class EdgeJitter(Kind, number=29):
    """The pulse of a turn is late by rms_us (4 + g(turn)), g within 4."""

    stage = "keyphasor"
    channel_only = "keyphasor"
    kind: Literal["edge-jitter"] = "edge-jitter"
    rms_us: Annotated[FiniteFloat, Field(gt=0.0, le=1000.0)]

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        return late_v(channel, 2e-6 * SIGMAS * self.rms_us)

    def _late_s(self, at: At) -> np.ndarray:
        turns, known = _turns(at)
        late_s = 1e-6 * self.rms_us * (SIGMAS + np.clip(at.draw.normal(known), -SIGMAS, SIGMAS))
        return late_s[turns - known[0]]

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return at.mark(at.angle - at.rate * self._late_s(at))

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        return ticks + 1e6 * self._late_s(at) if len(ticks) else ticks


def _turns(at: At) -> tuple[np.ndarray, np.ndarray]:
    """Number of each row's turn, counted from a quarter before its mark, shape (n,); and all that there are."""
    turns = np.floor(at.angle / (2.0 * math.pi) + 0.25).astype(np.int64)
    return turns, np.arange(turns.min(), turns.max() + 1)


def _picked(at: At, part: float) -> np.ndarray:
    """Whether rows are of turns that are hit, shape (n,)."""
    turns, known = _turns(at)
    return (at.draw.uniform(known)[:, 0] < part)[turns - known[0]]


PulseKind = MissPulses | ExtraPulses | EdgeJitter
