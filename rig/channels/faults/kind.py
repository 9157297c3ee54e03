"""Base of all kinds of faults: where a fault acts, its numbers, and the methods by which it acts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Annotated, ClassVar, NamedTuple, Self, get_args

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, FiniteFloat

from rig.base.checks import Written
from rig.channels.table import Channel

SIGMAS = 4.0
"""Mean delay of a jitter in standard deviations; no sample is later than twice this."""


Part = Annotated[FiniteFloat, Field(gt=0.0, lt=1.0)]
Positive = Annotated[FiniteFloat, Field(gt=0.0)]


def but(*values: float, must: str) -> AfterValidator:
    """Return a validator that refuses values without effect, or for which another kind exists."""

    def other(value: float) -> float:
        if value in values:
            raise ValueError(must)
        return value

    return AfterValidator(other)


class Draws:
    """Random numbers of a fault by place: four uniform numbers in (0, 1) each, counter-based (Philox), in any order."""

    def __init__(self, *key: int) -> None:
        self._key = np.random.SeedSequence(key).generate_state(2, np.uint64)
        self._next, self._bits = -1, np.random.Philox()

    def uniform(self, n: np.ndarray) -> np.ndarray:
        """Return four numbers at each place, shape (len(n), 4).

        Args:
            n: Places, ascending, with few gaps.
        """
        if not len(n):
            return np.empty((0, 4))
        first, count = int(n[0]), int(n[-1] - n[0]) + 1
        if first != self._next:  # a generator costs more than the numbers of a block
            self._bits = np.random.Philox(key=self._key, counter=[first + (1 << 62), 0, 0, 0])
        self._next = first + count
        bits = self._bits.random_raw(4 * count).reshape(-1, 4)
        return ((bits >> np.uint64(11)) + 0.5)[n - first] * 2.0**-53

    def normal(self, n: np.ndarray) -> np.ndarray:
        """Return a normal number at each place, shape (len(n),), by the Box-Muller transform."""
        u = self.uniform(n)
        return np.sqrt(-2.0 * np.log(u[:, 0])) * np.cos(2.0 * math.pi * u[:, 1])


@dataclass(slots=True)
class At:
    """Place at which a fault acts: rows of the model, or samples.

    Attributes:
        t: Time since the fault began [s], shape (n,).
        n: Numbers of the rows or samples, shape (n,).
        channel: Channel.
        draw: Random numbers of the fault.
        kept: State of the fault between blocks.
        other: Function that returns the same signal, or volts, of another channel by name, shape (n,).
        angle: Angle of the shaft [rad], shape (n,).
        rate: Speed of the shaft [rad/s], shape (n,).
        mark: Function that returns the keyphasor's signal at angles of the shaft.
    """

    t: np.ndarray
    n: np.ndarray
    channel: Channel
    draw: Draws
    kept: dict[str, float]
    other: Callable[[str], np.ndarray]
    angle: np.ndarray
    rate: np.ndarray
    mark: Callable[[np.ndarray], np.ndarray]


class Setting(NamedTuple):
    """Properties of a scene that decide which faults it supports.

    Attributes:
        ideal: It has neither filters nor noise.
        noisy: Its sensors have noise.
        generated: Test signals replace the physics.
    """

    ideal: bool = False
    noisy: bool = True
    generated: bool = False


def swing_v(channel: Channel) -> float:
    """Return the largest deviation of a conditioner's output from its bias [V]."""
    return max(abs(limit - channel.bias_v) for limit in channel.range_v)


def late_v(channel: Channel, late_s: float) -> float:
    """Return the largest change of a delayed channel, for a signal at the limit of its bandwidth [V]."""
    return swing_v(channel) * min(1.0, 2.0 * math.pi * min(channel.bandwidth_hz, 1e9) * late_s)


class Kind(Written):
    """A kind of fault. Methods that it does not override change nothing."""

    model_config = ConfigDict(strict=True)

    number: ClassVar[int] = 0
    """Its number in CAN frames and in rig.dbc, 1 to 255; no other kind has or had it."""
    stage: ClassVar[str]
    channel_only: ClassVar[str] = ""
    """Signal of the only channels that the kind supports."""
    first: ClassVar[tuple[str, ...]] = ()
    """Main number, if that is not the first one."""
    sized: ClassVar[str] = ""
    """Number that is the size, if that is not the main one."""
    neutral: ClassVar[float] = 0.0
    """Size without effect."""
    of_blocks: ClassVar[bool] = False
    """True if the kind acts on blocks as a whole (`rig.channels.faults.blocks`)."""

    def __init_subclass__(cls, *, number: int = 0) -> None:
        """Set the number of a kind: `class Gain(Kind, number=1)`."""
        super().__init_subclass__()
        cls.number = number

    @classmethod
    def name(cls) -> str:
        """Return the name of the kind."""
        return get_args(cls.model_fields["kind"].annotation)[0]

    @classmethod
    def main(cls) -> str:
        """Return the name of the main number, for short texts, or an empty text."""
        own = [(key, field) for key, field in cls.model_fields.items() if key not in ("kind", "door", "block_s")]
        required = [key for key, field in own if field.is_required()]
        return next(iter((*required, *cls.first, *(key for key, _ in own))), "")

    @property
    def reads(self) -> tuple[str, ...]:
        """Other channels whose signals it reads."""
        return ()

    def on(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the channels that it changes if it is injected into some."""
        return names

    @classmethod
    def needs(cls, channel: Channel, setting: Setting) -> str:
        """Return what a channel requires instead of this kind; empty if it supports the kind."""
        if setting.generated and (cls.stage == "filter" or cls.channel_only):
            return "one that test signals can have, such as clip: they have no filter and no shaft"
        return ""

    def refuse(self, channel: Channel) -> None:
        """Raise InputError if, with these numbers, it would have no effect on a channel, or a meaningless one."""

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        """Return the largest possible change at a channel's converter [V]; infinite if it has no size."""
        return math.inf

    def times(self, factor: float) -> Self:
        """Return the fault with its size, measured from the size without effect, multiplied by a factor."""
        name = self.sized or self.main()
        size = self.neutral + factor * (getattr(self, name) - self.neutral)
        return self.model_copy(update={name: size})

    def chance(self, rate_hz: int) -> tuple[str, float, float] | None:
        """Return the field that sets how often it occurs, u(n) per unit of it, and the time of a place [s], or None."""
        return None

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        """Return the sensor's input [its unit], shape (n,)."""
        return x

    def volts(self, v: np.ndarray, at: At) -> np.ndarray:
        """Return the conditioner's output [V], shape (n,)."""
        return v

    def chain(self, channel: Channel) -> Channel:
        """Return the channel with another filter."""
        return channel

    def late_s(self, at: At) -> np.ndarray:
        """Return the delays of samples [s], shape (n,)."""
        return np.zeros(len(at.t))

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        """Return the converter's counts before they are limited, shape (n,)."""
        return c

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        """Return the changed keyphasor edges [ticks], shape (edges,).

        `at.angle` and `at.rate` are those of the shaft at the edges.
        """
        return ticks


@cache
def _methods(kind: type[Kind]) -> frozenset[str]:
    """Return the names of the methods by which a kind acts."""
    return frozenset(name for name in _ACTING if getattr(kind, name) is not getattr(Kind, name))


def acts(what: Kind, *methods: str) -> bool:
    """Return whether a fault acts by one of these methods."""
    return not _methods(type(what)).isdisjoint(methods)


_ACTING = ("signal", "volts", "chain", "late_s", "counts", "edges")
