"""Sensor settings of a scene, the interval of the model's rows, and the positions of samples between rows."""

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
"""Default interval of the rows [ticks]."""
_OTHER_ROW_TICKS = (25, 20, 10, 5, 4, 2)
"""Alternative intervals [ticks], if the default does not divide the periods of samples and truth."""
_MIN_ROWS_PER_PERIOD = 7.5
"""Smallest number of rows per period of the highest bandwidth."""
_MAX_POSITIONS = 4096
"""Largest number of positions between rows for the samples of one rate; coefficients are precomputed for each."""


class SensorChoice(Written):
    """Channel groups and rates of a scene."""

    groups: tuple[str, ...] = ()
    """Channel groups that are on; empty for all."""
    rate_hz: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Sample rate of every channel [Hz]; 0 for the rates of the channel table."""
    truth_rate_hz: Annotated[int, Field(ge=10, le=1_000_000)] = 2_000
    """Rate of the published truth tables [Hz]."""
    noise: bool = True
    """True if the sensors have noise."""
    chain: Literal["ideal", "full"] = "full"
    """`full` for filter, noise, offset and converter; `ideal` for the measured quantity only."""

    @field_validator("rate_hz")
    @classmethod
    def _check_rate(cls, rate_hz: int) -> int:
        if 0 < rate_hz < 100:
            raise ValueError("at least 100, or 0 for the channel table's own")
        return rate_hz

    @field_validator("truth_rate_hz")
    @classmethod
    def _check_period(cls, rate_hz: int) -> int:
        if 1_000_000 % rate_hz:
            raise ValueError("a rate whose period is a whole number of microseconds, such as 1000, 2000 or 10000")
        return rate_hz


def row_ticks(table: ChannelTable, *, truth_rate_hz: int, ideal: bool) -> int:
    """Return the interval of the rows for sensors and truth [ticks]; it is independent of the engine's step.

    Args:
        table: Channel table.
        truth_rate_hz: Rate of the truth [Hz].
        ideal: Whether the channels have no filters.
    """
    rates = [group.rate_hz for group in table.groups.values()]
    # Samples and truth with periods of whole ticks coincide with rows.
    periods = [TICKS_HZ // rate for rate in (truth_rate_hz, *rates) if TICKS_HZ % rate == 0]
    if ideal and len(periods) > len(rates):
        return math.gcd(*periods)
    longest = TICKS_HZ / _MIN_ROWS_PER_PERIOD / max(channel.bandwidth_hz for channel in table.channels.values())
    fit = [
        ticks for ticks in (*_OTHER_ROW_TICKS, 1) if ticks <= longest and all(period % ticks == 0 for period in periods)
    ]
    fitting = [ticks for ticks in fit if all(has_few_positions(rate, TICKS_HZ // ticks) for rate in rates)]
    return [*fitting, *fit, 1][0]


def check_rates(table: ChannelTable, row_rate_hz: int, *, field: str) -> None:
    """Refuse rates whose samples have too many different positions between rows.

    Args:
        table: Channel table.
        row_rate_hz: Rows per second [Hz].
        field: Name of the rate in errors; empty for that of its group.

    Raises:
        InputError: A rate is invalid; the message suggests the nearest valid ones.
    """
    for group in table.groups.values():
        rate = group.rate_hz
        if not has_few_positions(rate, row_rate_hz):
            nearby = [other for offset in range(5000) for other in (rate - offset, rate + offset) if other > 0]
            valid = sorted([other for other in nearby if has_few_positions(other, row_rate_hz)][:2])
            must = f"a rate with at most {_MAX_POSITIONS} sample positions between the rows of {row_rate_hz} Hz"
            must += f", such as {' or '.join(map(str, valid))}" if valid else ""
            raise InputError(field or f"groups.{group.name}.rate_hz", must, rate)


def sample_spacing(rate_hz: int, row_rate_hz: int) -> tuple[int, int]:
    """Return the sample interval in parts of a row interval, and the number of parts per row interval."""
    common = math.gcd(rate_hz, row_rate_hz)
    return row_rate_hz // common, rate_hz // common


def has_few_positions(rate_hz: int, row_rate_hz: int) -> bool:
    """Return whether the samples of a rate have few enough different positions between rows."""
    return sample_spacing(rate_hz, row_rate_hz)[1] <= _MAX_POSITIONS


def first_row(tick: int, rate_hz: int) -> int:
    """Return the number of the first row at or after a tick."""
    return -(-tick * rate_hz // TICKS_HZ)


def lagrange(places: np.ndarray, nodes: Sequence[int] | np.ndarray) -> np.ndarray:
    """Return the weights of the polynomial through nodes, evaluated at places, shape (nodes, places)."""
    distances = [places - node for node in nodes]
    weights = np.ones((len(distances), *np.shape(places)))
    for weight, node in zip(weights, nodes, strict=True):
        for other, distance in zip(nodes, distances, strict=True):
            if other != node:
                weight *= distance
        weight /= math.prod(node - other for other in nodes if other != node)
    return weights
