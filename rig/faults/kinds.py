"""What may go wrong with a channel: kinds of faults by the stage of its chain, each an equation with units and limits.

In the equations x is what the sensor feels [the channel's unit], v the conditioner's output [V], c the converter's
counts, t the time since the fault began [s], and u(n), g(n) uniform and normal numbers of the fault's own, of row or
sample n: the same in every run with the same seed, however it is cut into blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import Annotated, Literal, Protocol, get_args

import numpy as np
from pydantic import AfterValidator, Field, FiniteFloat

from rig.channels import Channel
from rig.errors import InputError
from rig.faults.blocks import BlockKind
from rig.faults.kind import SIGMAS, At, Kind, Setting
from rig.faults.pulses import PulseKind

Part = Annotated[FiniteFloat, Field(gt=0.0, lt=1.0)]
Positive = Annotated[FiniteFloat, Field(gt=0.0)]
NotNegative = Annotated[FiniteFloat, Field(ge=0.0)]
MOST_LATE_US = 10_000.0
"""Latest that a sample may be taken [us]."""


def _grown(at: At, ramp_s: float) -> np.ndarray | float:
    return np.minimum(at.t / ramp_s, 1.0) if ramp_s else 1.0


def _but(*values: float, must: str) -> AfterValidator:
    """Refuse values that would change nothing, or that another kind is for."""

    def other(value: float) -> float:
        if value in values:
            raise ValueError(must)
        return value

    return AfterValidator(other)


# ---- transducer ----


class Gain(Kind):
    """Sensitivity: x' = x (1 + (factor - 1) min(t / ramp_s, 1))."""

    stage = "transducer"
    kind: Literal["gain"] = "gain"
    factor: Annotated[FiniteFloat, _but(1.0, -1.0, must="other than 1, and than -1, which is polarity")]
    ramp_s: NotNegative = 0.0

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return x * (1.0 + (self.factor - 1.0) * _grown(at, self.ramp_s))


class Offset(Kind):
    """Zero: x' = x + value min(t / ramp_s, 1); value in the channel's unit."""

    stage = "transducer"
    kind: Literal["offset"] = "offset"
    value: Annotated[FiniteFloat, _but(0.0, must="other than 0")]
    ramp_s: NotNegative = 0.0

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return x + self.value * _grown(at, self.ramp_s)


class Drift(Kind):
    """x' = x + rate t, rate in the channel's unit a second; with tau_s: x' = x + rate tau_s (1 - exp(-t / tau_s))."""

    stage = "transducer"
    kind: Literal["drift"] = "drift"
    rate: Annotated[FiniteFloat, _but(0.0, must="other than 0")]
    tau_s: Positive | None = None

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        far_s = at.t if self.tau_s is None else -self.tau_s * np.expm1(-at.t / self.tau_s)
        return x + self.rate * far_s


class Polarity(Kind):
    """x' = -x."""

    stage = "transducer"
    kind: Literal["polarity"] = "polarity"

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return -x


class Stuck(Kind):
    """x'(t) = x(0): what follows in the chain, its noise too, goes on; `freeze` holds the counts."""

    stage = "transducer"
    kind: Literal["stuck"] = "stuck"

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return np.full(len(x), at.kept.setdefault(at.channel.name, float(x[0])))

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        return ticks[:0]


class Nonlinear(Kind):
    """Ends of the linear range: x' = end tanh(x / end), end in the channel's unit."""

    stage = "transducer"
    kind: Literal["nonlinear"] = "nonlinear"
    end: Positive

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        return self.end * np.tanh(x / self.end)


class Resonance(Kind):
    """A transducer that rings: x'' = w^2 (x - x') - (w / quality) dx'/dt, w = 2 pi frequency_hz, at rest before.

    Between rows of the model x is a straight line, over which this is solved exactly.
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
        # Rows begin with the last one of those before; samples do not.
        goes_on = before is not None and t is not None and times[0] > t + 1e-9
        if goes_on:
            values, times = [before, *values], [t, *times]
        found = [z]
        if len(values) > 1:
            step = p * round(1e9 * (times[1] - times[0])) * 1e-9
            turn = math.exp(step.real) * complex(math.cos(step.imag), math.sin(step.imag))
            second = r / p * ((turn - 1.0) / step - 1.0)
            first = r / p * (turn - 1.0) - second
            for one, other in pairwise(values):
                z = turn * z + first * one + second * other
                found.append(z)
        at.kept.update(zip(names, (z.real, z.imag, values[-1], times[-1]), strict=True))
        return 2.0 * np.real(found[1:] if goes_on else found)


# ---- cable and conditioner ----


class Open(Kind):
    """An open cable: v' = level_v."""

    stage = "cable"
    kind: Literal["open"] = "open"
    level_v: Annotated[FiniteFloat, Field(ge=-30.0, le=30.0)] = 0.0

    def volts(self, v: np.ndarray, at: At) -> np.ndarray:
        return np.full(len(v), self.level_v)

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        return ticks[:0]


class Short(Open):
    """A short circuit: v' = 0."""

    kind: Literal["short"] = "short"  # pyright: ignore[reportIncompatibleVariableOverride]
    level_v: Annotated[FiniteFloat, Field(ge=0.0, le=0.0)] = 0.0


class Intermittent(Open):
    """A loose contact: v' = level_v in those slots of slot_s whose u(slot) < part."""

    first = ("part",)
    kind: Literal["intermittent"] = "intermittent"  # pyright: ignore[reportIncompatibleVariableOverride]
    part: Part = 0.2
    slot_s: Annotated[FiniteFloat, Field(ge=1e-4, le=100.0)] = 0.01

    def volts(self, v: np.ndarray, at: At) -> np.ndarray:
        slots = np.floor(at.t / self.slot_s + 1e-9).astype(np.int64)
        slots_here = np.arange(slots[0], slots[-1] + 1)
        off = at.draw.uniform(slots_here)[:, 0] < self.part
        return np.where(off[slots - slots[0]], self.level_v, v)

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        return ticks[self.volts(np.full(len(ticks), np.inf), at) == np.inf] if len(ticks) else ticks


class Hum(Kind):
    """The mains: v' = v + amplitude_v (sin(2 pi f t) + third sin(6 pi f t)) + offset_v.

    Asked for of a group it is one hum in all its channels, as a loop through the ground makes it.
    """

    stage = "cable"
    kind: Literal["hum"] = "hum"
    amplitude_v: Positive
    frequency_hz: Annotated[FiniteFloat, Field(gt=0.0, le=1000.0)] = 50.0
    third: Annotated[FiniteFloat, Field(ge=0.0, le=1.0)] = 0.0
    offset_v: Annotated[FiniteFloat, Field(ge=-10.0, le=10.0)] = 0.0

    def volts(self, v: np.ndarray, at: At) -> np.ndarray:
        turn = 2.0 * math.pi * self.frequency_hz * at.t
        return v + self.amplitude_v * (np.sin(turn) + self.third * np.sin(3.0 * turn)) + self.offset_v


class Crosstalk(Kind):
    """v' = v + 10^(db / 20) (v_source - its bias)."""

    stage = "cable"
    kind: Literal["crosstalk"] = "crosstalk"
    source: str
    db: Annotated[FiniteFloat, Field(ge=-120.0, le=0.0)] = -40.0

    @property
    def reads(self) -> tuple[str, ...]:
        return (self.source,)

    def volts(self, v: np.ndarray, at: At) -> np.ndarray:
        return v + 10.0 ** (self.db / 20.0) * at.other(self.source)


class Saturation(Kind):
    """A conditioner that gives less: v' = v within part of its range about the middle."""

    stage = "cable"
    kind: Literal["saturation"] = "saturation"
    part: Part

    def volts(self, v: np.ndarray, at: At) -> np.ndarray:
        low, high = at.channel.range_v
        reach = self.part * (high - low) / 2.0
        return np.clip(v, (low + high) / 2.0 - reach, (low + high) / 2.0 + reach)


class Swap(Kind):
    """Two cables changed over: v' = v of the other channel, and the other way round; several, one after the other."""

    stage = "cable"
    kind: Literal["swap"] = "swap"
    other: str

    @property
    def reads(self) -> tuple[str, ...]:
        return (self.other,)

    def on(self, names: tuple[str, ...]) -> tuple[str, ...]:
        return (*names, self.other)


class _Acting(Protocol):
    """A fault that acts: what it is, and its channels."""

    what: Kind
    names: tuple[str, ...]


def plugged(active: Iterable[_Acting]) -> dict[str, str]:
    """Return whose conditioner each channel of a swap is connected to, after all swaps in their order."""
    found: dict[str, str] = {}
    for one in active:
        if isinstance(one.what, Swap):
            a, b = one.names
            found[a], found[b] = found.get(b, b), found.get(a, a)
    return found


# ---- filter ----


class NoFilter(Kind):
    """No anti-alias filter: what is above half of the rate folds back."""

    stage = "filter"
    kind: Literal["no-filter"] = "no-filter"

    @classmethod
    def needs(cls, channel: Channel, setting: Setting) -> str:
        none = "one that a scene without filters can have, such as clip" if setting.ideal else ""
        return none or super().needs(channel, setting)


class Bandwidth(NoFilter):
    """Another corner of the low-pass [Hz]; its order stays."""

    kind: Literal["bandwidth"] = "bandwidth"  # pyright: ignore[reportIncompatibleVariableOverride]
    corner_hz: Annotated[FiniteFloat, Field(ge=1.0, le=1e6)]

    def refuse(self, channel: Channel) -> None:
        if self.corner_hz > channel.bandwidth_hz:
            must = f"below its bandwidth of {channel.bandwidth_hz:g} Hz; no-filter takes the filter away"
            raise InputError("corner_hz", must, self.corner_hz)
        if self.corner_hz == channel.bandwidth_hz:
            raise InputError("corner_hz", f"other than the channel's own, {self.corner_hz:g}", self.corner_hz)

    def chain(self, channel: Channel) -> Channel:
        return channel.model_copy(update={"bandwidth_hz": self.corner_hz})


# ---- clock ----


class Late(Kind):
    """A sample of time s shows what was at s - late_us: a multiplexer's skew. Nothing from before the fault is shown.

    Nothing can be early: what is not yet cannot be shown. Make all the others late instead.
    """

    stage = "clock"
    kind: Literal["late"] = "late"
    late_us: Annotated[FiniteFloat, Field(gt=0.0, le=MOST_LATE_US)]

    def late_s(self, at: At) -> np.ndarray:
        return np.full(len(at.t), 1e-6 * self.late_us)


class Clock(Kind):
    """A clock that is fast: a sample of time t since it began is taken at t / (1 + ppm 1e-6), 10 ms late at most.

    One that is slow, with ppm below 0, begins 10 ms late, as none can be early, and is right 10 ms / (-1e-6 ppm) on.
    """

    stage = "clock"
    kind: Literal["clock"] = "clock"
    ppm: Annotated[FiniteFloat, Field(ge=-1e5, le=1e5), _but(0.0, must="other than 0")]

    def late_s(self, at: At) -> np.ndarray:
        most_s = 1e-6 * MOST_LATE_US
        begun_s = 0.0 if self.ppm > 0.0 else most_s
        return np.clip(begun_s + at.t * (1.0 - 1.0 / (1.0 + 1e-6 * self.ppm)), 0.0, most_s)


class Jitter(Kind):
    """Samples late by rms_us (4 + g(n)), white, g within 4: the mean of 4 rms_us is a delay, as none can be early."""

    stage = "clock"
    kind: Literal["jitter"] = "jitter"
    rms_us: Annotated[FiniteFloat, Field(gt=0.0, le=1000.0)]

    def late_s(self, at: At) -> np.ndarray:
        return 1e-6 * self.rms_us * (SIGMAS + np.clip(at.draw.normal(at.n), -SIGMAS, SIGMAS))


class Wander(Kind):
    """Samples late by amplitude_us (1 - cos(2 pi t / period_s))."""

    stage = "clock"
    kind: Literal["wander"] = "wander"
    amplitude_us: Annotated[FiniteFloat, Field(gt=0.0, le=MOST_LATE_US / 2.0)]
    period_s: Annotated[FiniteFloat, Field(ge=0.01, le=3600.0)] = 1.0

    def late_s(self, at: At) -> np.ndarray:
        return 1e-6 * self.amplitude_us * (1.0 - np.cos(2.0 * math.pi * at.t / self.period_s))


# ---- converter ----


class Noise(Kind):
    """c' = c + sqrt(factor^2 - 1) noise_v g(n) / step: its noise times factor."""

    stage = "converter"
    kind: Literal["noise"] = "noise"
    factor: Annotated[FiniteFloat, Field(gt=1.0, le=1e6)]

    @classmethod
    def needs(cls, channel: Channel, setting: Setting) -> str:
        if setting.ideal or not setting.noisy or not channel.noise_v:
            return f"one for a channel without noise, as {channel.name} here, such as spikes"
        return ""

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        more = math.sqrt(self.factor**2 - 1.0) * at.channel.noise_v / at.channel.lsb_v
        return c + np.rint(more * at.draw.normal(at.n))


class Spikes(Kind):
    """c' = c + size_v / step with either sign, in samples whose u(n) < rate_hz / their rate."""

    stage = "converter"
    kind: Literal["spikes"] = "spikes"
    rate_hz: Positive = 10.0
    size_v: Positive = 1.0

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        u = at.draw.uniform(at.n)
        size = np.where(u[:, 1] < 0.5, -1.0, 1.0) * np.rint(self.size_v / at.channel.lsb_v)
        return c + np.where(u[:, 0] < self.rate_hz / at.channel.rate_hz, size, 0.0)


class Bits(Kind):
    """The lowest bits are lost: c' = 2^lost floor(c / 2^lost)."""

    stage = "converter"
    kind: Literal["bits"] = "bits"
    lost: Annotated[int, Field(ge=1, le=31)]

    def refuse(self, channel: Channel) -> None:
        if self.lost >= channel.adc_bits:
            raise InputError("lost", f"below the converter's {channel.adc_bits} bits", self.lost)

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        return np.floor(c / 2.0**self.lost) * 2.0**self.lost


class StuckBit(Kind):
    """One bit of the counts, from 0 for the lowest, is always the same."""

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


class Clip(Kind):
    """A smaller reference: c' = c within part of the converter's range."""

    stage = "converter"
    kind: Literal["clip"] = "clip"
    part: Part

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        most = math.floor(self.part * 2.0 ** (at.channel.adc_bits - 1))
        return np.clip(c, -most, most - 1)


class Freeze(Kind):
    """c'(n) = c(0): one and the same number, without noise."""

    stage = "converter"
    kind: Literal["freeze"] = "freeze"

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        return np.full(len(c), at.kept.setdefault(at.channel.name, float(c[0])) if len(c) else 0.0)

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        return ticks[:0]


AnyKind = (
    Gain | Offset | Drift | Polarity | Stuck | Nonlinear | Open | Short | Intermittent | Hum | Crosstalk | Saturation
    | Swap | Resonance | NoFilter | Bandwidth | Late | Clock | Jitter | Wander | Noise | Spikes | Bits | StuckBit | Clip
    | Freeze | PulseKind | BlockKind
)  # fmt: skip
KINDS: dict[str, type[Kind]] = {kind.name(): kind for kind in get_args(AnyKind)}
