"""Kinds of faults of a channel by the stage of its signal chain, each an equation with units and limits.

In the equations x is the sensor's input [the channel's unit], v the conditioner's output [V], c the converter's
counts, t the time since the fault began [s], and u(n), g(n) uniform and normal random numbers of the fault for row or
sample n. They are the same in every run with the same seed, whatever the lengths of its blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import Annotated, Literal, Protocol, Self, get_args

import numpy as np
from pydantic import Field, FiniteFloat

from rig.base.errors import InputError
from rig.channels.faults.blocks import BlockKind
from rig.channels.faults.converter import ConverterKind
from rig.channels.faults.kind import At, Kind, Part, Positive, Setting, but, swing_v
from rig.channels.faults.pulses import PulseKind
from rig.channels.table import Channel

NotNegative = Annotated[FiniteFloat, Field(ge=0.0)]


def _ramp(at: At, ramp_s: float) -> np.ndarray | float:
    return np.minimum(at.t / ramp_s, 1.0) if ramp_s else 1.0


def _ramp_end(lasts_s: float, ramp_s: float) -> float:
    return min(lasts_s / ramp_s, 1.0) if ramp_s else 1.0


# ---- transducer ----


class Gain(Kind, number=1):
    """Sensitivity error: x' = x (1 + (factor - 1) min(t / ramp_s, 1))."""

    stage = "transducer"
    kind: Literal["gain"] = "gain"
    factor: Annotated[FiniteFloat, but(1.0, -1.0, must="other than 1, and than -1, which is polarity")]
    ramp_s: NotNegative = 0.0
    neutral = 1.0

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        return abs(self.factor - 1.0) * swing_v(channel) * _ramp_end(lasts_s, self.ramp_s)

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return x * (1.0 + (self.factor - 1.0) * _ramp(at, self.ramp_s))


class Offset(Kind, number=2):
    """Zero error: x' = x + value min(t / ramp_s, 1); value in the channel's unit."""

    stage = "transducer"
    kind: Literal["offset"] = "offset"
    value: Annotated[FiniteFloat, but(0.0, must="other than 0")]
    ramp_s: NotNegative = 0.0

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        return abs(self.value * channel.sensitivity_v) * _ramp_end(lasts_s, self.ramp_s)

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return x + self.value * _ramp(at, self.ramp_s)


class Drift(Kind, number=3):
    """x' = x + rate t, rate in the channel's unit per second; with tau_s: x' = x + rate tau_s (1 - exp(-t / tau_s))."""

    stage = "transducer"
    kind: Literal["drift"] = "drift"
    rate: Annotated[FiniteFloat, but(0.0, must="other than 0")]
    tau_s: Positive | None = None

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        far_s = lasts_s if self.tau_s is None else -self.tau_s * math.expm1(-lasts_s / self.tau_s)
        return abs(self.rate * channel.sensitivity_v) * far_s

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        far_s = at.t if self.tau_s is None else -self.tau_s * np.expm1(-at.t / self.tau_s)
        return x + self.rate * far_s


class Polarity(Kind, number=4):
    """x' = -x."""

    stage = "transducer"
    kind: Literal["polarity"] = "polarity"

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return -x


class Stuck(Kind, number=5):
    """x'(t) = x(0): the later stages of the chain and their noise continue; `freeze` holds the counts."""

    stage = "transducer"
    kind: Literal["stuck"] = "stuck"

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return np.full(len(x), at.kept.setdefault(at.channel.name, float(x[0])))

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        return ticks[:0]


class Nonlinear(Kind, number=6):
    """Limited linear range: x' = end tanh(x / end), end in the channel's unit."""

    stage = "transducer"
    kind: Literal["nonlinear"] = "nonlinear"
    end: Positive

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        end_v = self.end * channel.sensitivity_v
        return swing_v(channel) - end_v * math.tanh(swing_v(channel) / end_v)

    def times(self, factor: float) -> Self:
        return self.model_copy(update={"end": self.end / factor})

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return self.end * np.tanh(x / self.end)


class Resonance(Kind, number=14):
    """A ringing transducer: x'' = w^2 (x - x') - (w / quality) dx'/dt, w = 2 pi frequency_hz, initially at rest.

    Between rows of the model x is linear, which makes the solution exact.
    """

    stage = "transducer"
    kind: Literal["resonance"] = "resonance"
    frequency_hz: Annotated[FiniteFloat, Field(ge=1.0, le=5000.0)]
    quality: Annotated[FiniteFloat, Field(gt=0.5, le=1000.0)] = 10.0

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        w, names = 2.0 * math.pi * self.frequency_hz, [f"{at.channel.name} {part}" for part in ("re", "im", "x", "t")]
        # x' = 2 Re(z) with dz/dt = p z + r x, of one pole p and its residue r.
        p = complex(-0.5 / self.quality, math.sqrt(1.0 - 0.25 / self.quality**2)) * w
        r = -0.5j * w * w / p.imag
        re, im, before, t = (at.kept.get(name) for name in names)
        values, times = x.tolist(), at.t.tolist()
        z = -r / p * values[0] if re is None or im is None else complex(re, im)
        # Blocks of rows begin with the last row of the previous block; blocks of samples do not.
        goes_on = before is not None and t is not None and times[0] > t + 1e-9
        if goes_on:
            values, times = [before, *values], [t, *times]
        states = [z]
        if len(values) > 1:
            step = p * round(1e9 * (times[1] - times[0])) * 1e-9
            turn = math.exp(step.real) * complex(math.cos(step.imag), math.sin(step.imag))
            second = r / p * ((turn - 1.0) / step - 1.0)
            first = r / p * (turn - 1.0) - second
            for one, other in pairwise(values):
                z = turn * z + first * one + second * other
                states.append(z)
        at.kept.update(zip(names, (z.real, z.imag, values[-1], times[-1]), strict=True))
        return 2.0 * np.real(states[1:] if goes_on else states)


# ---- cable and conditioner ----


class Open(Kind, number=7):
    """An open cable: v' = level_v."""

    stage = "cable"
    kind: Literal["open"] = "open"
    level_v: Annotated[FiniteFloat, Field(ge=-30.0, le=30.0)] = 0.0

    def volts(self, v: np.ndarray, at: At) -> np.ndarray:
        return np.full(len(v), self.level_v)

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        return ticks[:0]


class Short(Open, number=8):
    """A short circuit: v' = 0."""

    kind: Literal["short"] = "short"  # pyrefly: ignore[bad-override]
    level_v: Annotated[FiniteFloat, Field(ge=0.0, le=0.0)] = 0.0


class Intermittent(Open, number=9):
    """A loose contact: v' = level_v in the slots of slot_s with u(slot) < part."""

    first = ("part",)
    kind: Literal["intermittent"] = "intermittent"  # pyrefly: ignore[bad-override]
    part: Part = 0.2
    slot_s: Annotated[FiniteFloat, Field(ge=1e-4, le=100.0)] = 0.01

    def chance(self, rate_hz: int) -> tuple[str, float, float]:
        return "part", 1.0, self.slot_s

    def volts(self, v: np.ndarray, at: At) -> np.ndarray:
        slots = np.floor(at.t / self.slot_s + 1e-9).astype(np.int64)
        slots_here = np.arange(slots[0], slots[-1] + 1)
        off = at.draw.uniform(slots_here)[:, 0] < self.part
        return np.where(off[slots - slots[0]], self.level_v, v)

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        return ticks[self.volts(np.full(len(ticks), np.inf), at) == np.inf] if len(ticks) else ticks


class Hum(Kind, number=10):
    """Mains hum: v' = v + amplitude_v (sin(2 pi f t) + third sin(6 pi f t)) + offset_v.

    On a group it is the same hum in all its channels, as a ground loop causes it.
    """

    stage = "cable"
    kind: Literal["hum"] = "hum"
    amplitude_v: Positive
    frequency_hz: Annotated[FiniteFloat, Field(gt=0.0, le=1000.0)] = 50.0
    third: Annotated[FiniteFloat, Field(ge=0.0, le=1.0)] = 0.0
    offset_v: Annotated[FiniteFloat, Field(ge=-10.0, le=10.0)] = 0.0

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        turn = min(0.5 * math.pi, 2.0 * math.pi * self.frequency_hz * lasts_s)
        return self.amplitude_v * (math.sin(turn) + self.third) + abs(self.offset_v)

    def volts(self, v: np.ndarray, at: At) -> np.ndarray:
        turn = 2.0 * math.pi * self.frequency_hz * at.t
        return v + self.amplitude_v * (np.sin(turn) + self.third * np.sin(3.0 * turn)) + self.offset_v


class Crosstalk(Kind, number=11):
    """v' = v + 10^(db / 20) (v_source - its bias)."""

    stage = "cable"
    kind: Literal["crosstalk"] = "crosstalk"
    source: str
    db: Annotated[FiniteFloat, Field(ge=-120.0, le=0.0)] = -40.0
    sized = "db"

    @property
    def reads(self) -> tuple[str, ...]:
        return (self.source,)

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        return 10.0 ** (self.db / 20.0) * swing_v(source)

    def times(self, factor: float) -> Self:
        return self.model_copy(update={"db": self.db + 20.0 * math.log10(factor)})

    def volts(self, v: np.ndarray, at: At) -> np.ndarray:
        return v + 10.0 ** (self.db / 20.0) * at.other(self.source)


class Saturation(Kind, number=12):
    """A conditioner with a reduced output range: v' = v, limited to a part of its range about the middle."""

    stage = "cable"
    kind: Literal["saturation"] = "saturation"
    part: Part
    neutral = 1.0

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        return (1.0 - self.part) * 0.5 * (channel.range_v[1] - channel.range_v[0])

    def volts(self, v: np.ndarray, at: At) -> np.ndarray:
        low, high = at.channel.range_v
        reach = self.part * (high - low) / 2.0
        return np.clip(v, (low + high) / 2.0 - reach, (low + high) / 2.0 + reach)


class Swap(Kind, number=13):
    """Two exchanged cables: v' = v of the other channel, and vice versa; several swaps act one after the other."""

    stage = "cable"
    kind: Literal["swap"] = "swap"
    other: str

    @property
    def reads(self) -> tuple[str, ...]:
        return (self.other,)

    def on(self, names: tuple[str, ...]) -> tuple[str, ...]:
        return (*names, self.other)


class _ActiveFault(Protocol):
    """An active fault: its kind and its channels."""

    what: Kind
    names: tuple[str, ...]


def connect_swaps(active: Iterable[_ActiveFault]) -> dict[str, str]:
    """Return the channel whose conditioner each swapped channel is connected to, after all swaps in their order."""
    connections: dict[str, str] = {}
    for one in active:
        if isinstance(one.what, Swap):
            a, b = one.names
            connections[a], connections[b] = connections.get(b, b), connections.get(a, a)
    return connections


# ---- filter ----


class NoFilter(Kind, number=15):
    """No anti-alias filter: components above half of the sampling rate fold back."""

    stage = "filter"
    kind: Literal["no-filter"] = "no-filter"

    @classmethod
    def needs(cls, channel: Channel, setting: Setting) -> str:
        none = "one that a scene without filters supports, such as clip" if setting.ideal else ""
        return none or super().needs(channel, setting)


class Bandwidth(NoFilter, number=16):
    """A lower corner of the low-pass [Hz]; its order is unchanged."""

    kind: Literal["bandwidth"] = "bandwidth"  # pyrefly: ignore[bad-override]
    corner_hz: Annotated[FiniteFloat, Field(ge=1.0, le=1e6)]

    def refuse(self, channel: Channel) -> None:
        if self.corner_hz > channel.bandwidth_hz:
            must = f"below its bandwidth of {channel.bandwidth_hz:g} Hz; no-filter removes the filter"
            raise InputError("corner_hz", must, self.corner_hz)
        if self.corner_hz == channel.bandwidth_hz:
            raise InputError("corner_hz", f"other than the channel's own, {self.corner_hz:g}", self.corner_hz)

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        return (1.0 - self.corner_hz / channel.bandwidth_hz) * channel.filter_order * swing_v(channel)

    def times(self, factor: float) -> Self:
        return self.model_copy(update={"corner_hz": self.corner_hz / factor})

    def chain(self, channel: Channel) -> Channel:
        return channel.model_copy(update={"bandwidth_hz": self.corner_hz})


AnyKind = (
    Gain | Offset | Drift | Polarity | Stuck | Nonlinear | Open | Short | Intermittent | Hum | Crosstalk | Saturation
    | Swap | Resonance | NoFilter | Bandwidth | ConverterKind | PulseKind | BlockKind
)  # fmt: skip
KINDS: dict[str, type[Kind]] = {kind.name(): kind for kind in get_args(AnyKind)}
