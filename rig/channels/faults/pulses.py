"""Kinds of faults of the keyphasor's pulses, counted in turns, in addition to those of `faults.kinds`."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, FiniteFloat

from rig.channels.faults.kind import SIGMAS, At, Kind, late_v
from rig.channels.table import Channel

MAX_TURNS_HZ = 100.0
"""Largest number of turns per second [1/s]; no shaft of the rig is faster."""


class MissPulses(Kind, number=27):
    """No pulse in turns with u(turn) < part."""

    stage = "keyphasor"
    channel_only = "keyphasor"
    kind: Literal["miss-pulses"] = "miss-pulses"
    part: Annotated[FiniteFloat, Field(gt=0.0, le=1.0)] = 0.2

    def chance(self, rate_hz: int) -> tuple[str, float, float]:
        return "part", 1.0, 1.0 / MAX_TURNS_HZ

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return np.where(_select_rows(at, self.part), 0.0, x)

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        return ticks[~_select_rows(at, self.part)] if len(ticks) else ticks


class ExtraPulses(MissPulses, number=28):
    """A second pulse half a turn after that of turns with u(turn) < part."""

    kind: Literal["extra-pulses"] = "extra-pulses"  # pyrefly: ignore[bad-override]

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return np.maximum(x, np.where(_select_rows(at, self.part), at.mark(at.angle - math.pi), 0.0))

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        if not len(ticks):
            return ticks
        extra = ticks + 1e6 * math.pi / at.rate
        return np.sort(np.concatenate([ticks, extra[_select_rows(at, self.part)]]))


class EdgeJitter(Kind, number=29):
    """The pulse of a turn is late by rms_us (4 + g(turn)), g within 4."""

    stage = "keyphasor"
    channel_only = "keyphasor"
    kind: Literal["edge-jitter"] = "edge-jitter"
    rms_us: Annotated[FiniteFloat, Field(gt=0.0, le=1000.0)]

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        return late_v(channel, 2e-6 * SIGMAS * self.rms_us)

    def _late_s(self, at: At) -> np.ndarray:
        turns, turn_range = _number_turns(at)
        late_s = 1e-6 * self.rms_us * (SIGMAS + np.clip(at.draw.normal(turn_range), -SIGMAS, SIGMAS))
        return late_s[turns - turn_range[0]]

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return at.mark(at.angle - at.rate * self._late_s(at))

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        return ticks + 1e6 * self._late_s(at) if len(ticks) else ticks


def _number_turns(at: At) -> tuple[np.ndarray, np.ndarray]:
    """Return each row's turn, counted from a quarter turn before the mark, shape (n,), and all turn numbers between."""
    turns = np.floor(at.angle / (2.0 * math.pi) + 0.25).astype(np.int64)
    return turns, np.arange(turns.min(), turns.max() + 1)


def _select_rows(at: At, part: float) -> np.ndarray:
    """Return whether the fault selects each row's turn, shape (n,)."""
    turns, turn_range = _number_turns(at)
    return (at.draw.uniform(turn_range)[:, 0] < part)[turns - turn_range[0]]


PulseKind = MissPulses | ExtraPulses | EdgeJitter
