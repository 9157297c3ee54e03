"""What a scene measures; how far apart rows of the model are for it, and where the samples of a rate fall between."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from rig.base.checks import Written
from rig.base.errors import InputError
from rig.channels.table import ChannelTable

TICKS_HZ = 1_000_000
ROW_TICKS = 25
"""How far apart rows are [ticks], ..."""
_ELSE = (25, 20, 10, 5, 4, 2)
"""... or where that does not divide the periods of samples and truth, ..."""
_A_WAVE = 7.5
"""... and how many there are at least in a period of the highest bandwidth."""
_MOST = 4096
"""Most places between rows that the samples of one rate may have: what each is made of is worked out beforehand."""


class SensorChoice(Written):
    """What is measured, and how often."""

    groups: tuple[str, ...] = ()
    """Groups of channels that are on; none named: all."""
    rate_hz: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Sample rate of every channel [Hz]; 0: that of each group in the channel table."""
    truth_rate_hz: Annotated[int, Field(ge=10, le=1_000_000)] = 2_000
    """Rate of the truth that is published beside the sensors [Hz]."""
    noise: bool = True
    """False leaves the sensors' noise out."""
    chain: Literal["ideal", "full"] = "full"
    """The full chain of filter, noise, offset and converter, or what the sensor measures and nothing else."""

    @field_validator("rate_hz")
    @classmethod
    def _a_rate(cls, rate_hz: int) -> int:
        if 0 < rate_hz < 100:
            raise ValueError("at least 100, or 0 for the channel table's own")
        return rate_hz

    @field_validator("truth_rate_hz")
    @classmethod
    def _whole_period(cls, rate_hz: int) -> int:
        if 1_000_000 % rate_hz:
            raise ValueError("a rate whose period is a whole number of microseconds, such as 1000, 2000 or 10000")
        return rate_hz


def row_ticks(table: ChannelTable, *, truth_rate_hz: int, ideal: bool) -> int:
    """Ticks between the rows that sensors and truth see: of the channels' making, whatever the engine's step.

    Args:
        table: What is measured.
        truth_rate_hz: Rate of the truth [Hz].
        ideal: Whether there are no filters.
    """
    rates = [group.rate_hz for group in table.groups.values()]
    # Samples and truth fall on rows where their periods are whole ticks.
    periods = [TICKS_HZ // rate for rate in (truth_rate_hz, *rates) if TICKS_HZ % rate == 0]
    if ideal and len(periods) > len(rates):
        return math.gcd(*periods)
    longest = TICKS_HZ / _A_WAVE / max(channel.bandwidth_hz for channel in table.channels.values())
    fit = [ticks for ticks in (*_ELSE, 1) if ticks <= longest and all(period % ticks == 0 for period in periods)]
    few = [ticks for ticks in fit if all(fits(rate, TICKS_HZ // ticks) for rate in rates)]
    return [*few, *fit, 1][0]


def check_rates(table: ChannelTable, row_rate_hz: int, *, field: str) -> None:
    """Refuse rates whose samples fall on too many places between rows.

    Args:
        table: What is measured.
        row_rate_hz: Rows a second [Hz].
        field: What errors call a rate; empty: that of its group.

    Raises:
        InputError: The first of them, and the nearest that would do.
    """
    for group in table.groups.values():
        rate = group.rate_hz
        if not fits(rate, row_rate_hz):
            near = [other for away in range(5000) for other in (rate - away, rate + away) if other > 0]
            such = sorted([other for other in near if fits(other, row_rate_hz)][:2])
            must = (
                f"one whose samples fall on at most {_MOST} places between the rows of {row_rate_hz} Hz that they are"
            )
            must += f" made of, such as {' or '.join(map(str, such))}" if such else " made of"
            raise InputError(field or f"groups.{group.name}.rate_hz", must, rate)


def between(rate_hz: int, row_rate_hz: int) -> tuple[int, int]:
    """From sample to sample in parts of a row, and how many parts a row has."""
    common = math.gcd(rate_hz, row_rate_hz)
    return row_rate_hz // common, rate_hz // common


def fits(rate_hz: int, row_rate_hz: int) -> bool:
    """Whether samples of a rate fall on few enough places between rows."""
    return between(rate_hz, row_rate_hz)[1] <= _MOST


def first_row(tick: int, rate_hz: int) -> int:
    """Number of the first of even rows at or behind a tick."""
    return -(-tick * rate_hz // TICKS_HZ)


def lagrange(places: np.ndarray, nodes: Sequence[int] | np.ndarray) -> np.ndarray:
    """Weights of the polynomial through nodes, at places, shape (nodes, places)."""
    apart = [places - node for node in nodes]
    found = np.ones((len(apart), *np.shape(places)))
    for weight, node in zip(found, nodes, strict=True):
        for other, distance in zip(nodes, apart, strict=True):
            if other != node:
                weight *= distance
        weight /= math.prod(node - other for other in nodes if other != node)
    return found
