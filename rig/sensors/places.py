"""Where the samples of a rate fall between the rows that they are made of."""

from __future__ import annotations

import math

from rig.errors import InputError

_MOST = 4096
"""Most places between rows that the samples of one rate may have: what each is made of is worked out beforehand."""


def between(rate_hz: int, row_rate_hz: int) -> tuple[int, int]:
    """From sample to sample in parts of a row, and how many parts a row has."""
    common = math.gcd(rate_hz, row_rate_hz)
    return row_rate_hz // common, rate_hz // common


def fits(rate_hz: int, row_rate_hz: int) -> bool:
    """Whether samples of a rate fall on few enough places between rows."""
    return between(rate_hz, row_rate_hz)[1] <= _MOST


def unfit(field: str, rate_hz: int, row_rate_hz: int) -> InputError:
    """What to say of a rate that does not fit."""
    near = [rate for away in range(5000) for rate in (rate_hz - away, rate_hz + away) if rate > 0]
    such = [rate for rate in near if fits(rate, row_rate_hz)][:2]
    must = (
        f"one whose samples fall on at most {_MOST} places between the rows of {row_rate_hz} Hz that they are made of"
    )
    return InputError(field, f"{must}, such as {' or '.join(map(str, sorted(such)))}", rate_hz)
