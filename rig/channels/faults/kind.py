"""What a kind of fault is made of: where it acts, its numbers, and what it may change."""

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
"""A jitter is late by so many of its deviations on the mean, and no sample by more than twice that."""


Part = Annotated[FiniteFloat, Field(gt=0.0, lt=1.0)]
Positive = Annotated[FiniteFloat, Field(gt=0.0)]


def but(*values: float, must: str) -> AfterValidator:
    """Refuse values that would change nothing, or that another kind is for."""

    def other(value: float) -> float:
        if value in values:
            raise ValueError(must)
        return value

    return AfterValidator(other)


class Draws:
    """Numbers of a fault, by place: uniform in (0, 1), four a place, of counters (Philox), so that no order matters."""

    def __init__(self, *key: int) -> None:
        self._key = np.random.SeedSequence(key).generate_state(2, np.uint64)
        self._next, self._bits = -1, np.random.Philox()

    def uniform(self, n: np.ndarray) -> np.ndarray:
        """Four numbers at each place, shape (len(n), 4).

        Args:
            n: Places, ascending; few are left out.
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
        """A normal number at each place, shape (len(n),), by Box and Muller."""
        u = self.uniform(n)
        return np.sqrt(-2.0 * np.log(u[:, 0])) * np.cos(2.0 * math.pi * u[:, 1])


@dataclass(slots=True)
class At:
    """Where a fault acts: rows of the model, or samples.

    Attributes:
        t: Time since it began [s], shape (n,).
        n: Numbers of the rows or samples, shape (n,).
        channel: On which channel.
        draw: Numbers of the fault.
        kept: What it keeps from block to block.
        other: The same signal, or volts, of another channel by name, shape (n,).
        angle: Of the shaft [rad], shape (n,).
        rate: Of that [rad/s], shape (n,).
        mark: What the keyphasor sees at an angle of the shaft.
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
    """What of a scene decides which faults make sense.

    Attributes:
        ideal: It leaves filters and noise out.
        noisy: Its sensors are noisy.
        generated: Generators stand for the physics.
    """

    ideal: bool = False
    noisy: bool = True
    generated: bool = False


def swing_v(channel: Channel) -> float:
    """Return how far a conditioner's output can be from its bias [V]."""
    return max(abs(limit - channel.bias_v) for limit in channel.range_v)


def late_v(channel: Channel, late_s: float) -> float:
    """Return the largest change of a channel that is late, with a signal as fast as its bandwidth lets through [V]."""
    return swing_v(channel) * min(1.0, 2.0 * math.pi * min(channel.bandwidth_hz, 1e9) * late_s)


class Kind(Written):
    """One kind of fault. What it does not change stays as it was."""

    model_config = ConfigDict(strict=True)

    number: ClassVar[int] = 0
    """Its number in CAN frames and in rig.dbc, 1 to 255; no other kind has or had it."""
    stage: ClassVar[str]
    channel_only: ClassVar[str] = ""
    """Signal of the only channels that it is for."""
    first: ClassVar[tuple[str, ...]] = ()
    """Its main number, where that is not the first."""
    sized: ClassVar[str] = ""
    """The number that is its size, where that is not the main one."""
    neutral: ClassVar[float] = 0.0
    """Size with which it would change nothing."""
    of_blocks: ClassVar[bool] = False
    """It is about blocks, not about what stands in them (`rig.channels.faults.blocks`)."""

    def __init_subclass__(cls, *, number: int = 0) -> None:
        """Set the number of a kind: `class Gain(Kind, number=1)`."""
        super().__init_subclass__()
        cls.number = number

    @classmethod
    def name(cls) -> str:
        """As it is called."""
        return get_args(cls.model_fields["kind"].annotation)[0]

    @classmethod
    def main(cls) -> str:
        """The number that says most, for where there is room for one; empty where it has none."""
        own = [(key, field) for key, field in cls.model_fields.items() if key not in ("kind", "door", "block_s")]
        required = [key for key, field in own if field.is_required()]
        return next(iter((*required, *cls.first, *(key for key, _ in own))), "")

    @property
    def reads(self) -> tuple[str, ...]:
        """Other channels that it takes signals of."""
        return ()

    def on(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Channels that it changes, where it is asked for of some."""
        return names

    @classmethod
    def needs(cls, channel: Channel, setting: Setting) -> str:
        """What would have to be given in its place on a channel; empty where it makes sense there."""
        if setting.generated and (cls.stage == "filter" or cls.channel_only):
            return "one that test signals can have, such as clip: they have no filter and no shaft"
        return ""

    def refuse(self, channel: Channel) -> None:
        """Raise InputError where with these numbers it would change nothing, or nothing that makes sense."""

    def reach_v(self, channel: Channel, lasts_s: float, source: Channel) -> float:
        """Return the largest change that it can make at a channel's converter [V]; infinite where no size decides."""
        return math.inf

    def times(self, factor: float) -> Self:
        """Return the same with its size farther from where it has no effect, by a factor."""
        name = self.sized or self.main()
        size = self.neutral + factor * (getattr(self, name) - self.neutral)
        return self.model_copy(update={name: size})

    def chance(self, rate_hz: int) -> tuple[str, float, float] | None:
        """Return the field that decides how often it happens, u(n) that one of it is, and seconds from n to n + 1."""
        return None

    def signal(self, x: np.ndarray, at: At) -> np.ndarray:
        """What the sensor feels [its unit], shape (n,)."""
        return x

    def volts(self, v: np.ndarray, at: At) -> np.ndarray:
        """What comes from the conditioner [V], shape (n,)."""
        return v

    def chain(self, channel: Channel) -> Channel:
        """The channel with another filter."""
        return channel

    def late_s(self, at: At) -> np.ndarray:
        """Return how late samples are taken [s], shape (n,)."""
        return np.zeros(len(at.t))

    def counts(self, c: np.ndarray, at: At) -> np.ndarray:
        """What the converter says, before it is limited, shape (n,)."""
        return c

    def edges(self, ticks: np.ndarray, at: At) -> np.ndarray:
        """Keyphasor edges as they are shown [ticks], where there were these, shape (edges,).

        `at.angle` and `at.rate` are the shaft's at the edges.
        """
        return ticks


@cache
def _methods(kind: type[Kind]) -> frozenset[str]:
    """Names of the methods by which a kind acts."""
    return frozenset(name for name in _ACTING if getattr(kind, name) is not getattr(Kind, name))


def acts(what: Kind, *methods: str) -> bool:
    """Whether a fault acts by one of these methods of a kind."""
    return not _methods(type(what)).isdisjoint(methods)


_ACTING = ("signal", "volts", "chain", "late_s", "counts", "edges")
