"""Kinds of faults of the sampling clock and of the converter, in addition to those of `rig.channels.faults.kinds`."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, FiniteFloat

from rig.base.errors import InputError
from rig.channels.faults.kind import SIGMAS, At, Kind, Part, Positive, Setting, but, late_v
from rig.channels.table import Channel

MAX_DELAY_US = 10_000.0
"""Largest delay of a sample [us]."""


# ---- clock ----


class Late(Kind, number=17):
    """A sample of time s shows the signal at s - late_us: a multiplexer's skew. No signal before the fault is shown.

    A sample cannot be early, as its future is not known. Delay all other channels instead.
    """

    stage = "clock"
    kind: Literal["late"] = "late"
    late_us: Annotated[FiniteFloat, Field(gt=0.0, le=MAX_DELAY_US)]

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        return late_v(channel, 1e-6 * self.late_us)

    def late_s(self, at: At) -> np.ndarray:
        return np.full(len(at.t), 1e-6 * self.late_us)


class Clock(Kind, number=18):
    """A fast clock: the sample at time t of the fault is taken at t / (1 + ppm 1e-6), at most 10 ms late.

    A slow clock (ppm below 0) begins 10 ms late, as no sample can be early, and is exact after 10 ms / (-1e-6 ppm).
    """

    stage = "clock"
    kind: Literal["clock"] = "clock"
    ppm: Annotated[FiniteFloat, Field(ge=-1e5, le=1e5), but(0.0, must="other than 0")]

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        return math.inf if self.ppm < 0.0 else late_v(channel, 1e-6 * self.ppm * lasts_s)

    def late_s(self, at: At) -> np.ndarray:
        most_s = 1e-6 * MAX_DELAY_US
        begun_s = 0.0 if self.ppm > 0.0 else most_s
        return np.clip(begun_s + at.t * (1.0 - 1.0 / (1.0 + 1e-6 * self.ppm)), 0.0, most_s)


class Jitter(Kind, number=19):
    """Samples late by rms_us (4 + g(n)), g within -4 to 4. The mean delay, 4 rms_us, avoids samples that are early."""

    stage = "clock"
    kind: Literal["jitter"] = "jitter"
    rms_us: Annotated[FiniteFloat, Field(gt=0.0, le=1000.0)]

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        return late_v(channel, 2e-6 * SIGMAS * self.rms_us)

    def late_s(self, at: At) -> np.ndarray:
        return 1e-6 * self.rms_us * (SIGMAS + np.clip(at.draw.normal(at.n), -SIGMAS, SIGMAS))


class Wander(Kind, number=20):
    """Samples late by amplitude_us (1 - cos(2 pi t / period_s))."""

    stage = "clock"
    kind: Literal["wander"] = "wander"
    amplitude_us: Annotated[FiniteFloat, Field(gt=0.0, le=MAX_DELAY_US / 2.0)]
    period_s: Annotated[FiniteFloat, Field(ge=0.01, le=3600.0)] = 1.0

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        part = 1.0 - math.cos(min(math.pi, 2.0 * math.pi * lasts_s / self.period_s))
        return late_v(channel, 1e-6 * self.amplitude_us * part)

    def late_s(self, at: At) -> np.ndarray:
        return 1e-6 * self.amplitude_us * (1.0 - np.cos(2.0 * math.pi * at.t / self.period_s))


# ---- converter ----


class Noise(Kind, number=21):
    """The channel's noise times factor: c' = c + sqrt(factor^2 - 1) noise_v g(n) / step."""

    stage = "converter"
    kind: Literal["noise"] = "noise"
    factor: Annotated[FiniteFloat, Field(gt=1.0, le=1e6)]
    neutral = 1.0

    @classmethod
    def needs(cls, channel: Channel, setting: Setting) -> str:
        if setting.ideal or not setting.noisy or not channel.noise_v:
            return f"one for a channel without noise, as {channel.name} here, such as spikes"
        return ""

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        return (self.factor - 1.0) * SIGMAS * channel.noise_v

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        more = math.sqrt(self.factor**2 - 1.0) * at.channel.noise_v / at.channel.lsb_v
        return c + np.rint(more * at.draw.normal(at.n))


class Spikes(Kind, number=22):
    """c' = c + size_v / step, of random sign, in samples with u(n) < rate_hz / their rate."""

    stage = "converter"
    kind: Literal["spikes"] = "spikes"
    rate_hz: Positive = 10.0
    size_v: Positive = 1.0
    sized = "size_v"

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        return self.size_v

    def chance(self, rate_hz: int) -> tuple[str, float, float]:
        return "rate_hz", 1.0 / rate_hz, 1.0 / rate_hz

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        u = at.draw.uniform(at.n)
        size = np.where(u[:, 1] < 0.5, -1.0, 1.0) * np.rint(self.size_v / at.channel.lsb_v)
        return c + np.where(u[:, 0] < self.rate_hz / at.channel.rate_hz, size, 0.0)


class Bits(Kind, number=23):
    """The lowest bits are lost: c' = 2^lost floor(c / 2^lost)."""

    stage = "converter"
    kind: Literal["bits"] = "bits"
    lost: Annotated[int, Field(ge=1, le=31)]

    def refuse(self, channel: Channel) -> None:
        if self.lost >= channel.adc_bits:
            raise InputError("lost", f"below the converter's {channel.adc_bits} bits", self.lost)

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        return np.floor(c / 2.0**self.lost) * 2.0**self.lost


class StuckBit(Kind, number=24):
    """One bit of the counts, 0 being the lowest, has a constant value."""

    stage = "converter"
    kind: Literal["stuck-bit"] = "stuck-bit"
    bit: Annotated[int, Field(ge=0, le=30)]
    value: Literal[0, 1] = 1

    def refuse(self, channel: Channel) -> None:
        if self.bit > channel.adc_bits - 2:
            raise InputError("bit", f"at most {channel.adc_bits - 2}, below the sign", self.bit)

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        whole, mask = c.astype(np.int64), np.int64(1 << self.bit)
        return ((whole | mask) if self.value else (whole & ~mask)).astype(float)


class Clip(Kind, number=25):
    """A smaller reference voltage: c' = c, limited to a part of the converter's range."""

    stage = "converter"
    kind: Literal["clip"] = "clip"
    part: Part
    neutral = 1.0

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        far_v = max(map(abs, channel.range_v)) + 2.0 * SIGMAS * channel.noise_v
        return min(far_v, channel.adc_v) - self.part * channel.adc_v

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        most = math.floor(self.part * 2.0 ** (at.channel.adc_bits - 1))
        return np.clip(c, -most, most - 1)


class Freeze(Kind, number=26):
    """c'(n) = c(0): a constant count, without noise."""

    stage = "converter"
    kind: Literal["freeze"] = "freeze"

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        return np.full(len(c), at.kept.setdefault(at.channel.name, float(c[0])) if len(c) else 0.0)

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        return ticks[:0]


ConverterKind = Late | Clock | Jitter | Wander | Noise | Spikes | Bits | StuckBit | Clip | Freeze
