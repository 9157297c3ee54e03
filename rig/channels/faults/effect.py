"""Checks that a fault can change at least one count, by its size, its duration and its random draws.

A refused fault could change nothing for any signal. An accepted fault may still have no effect on a constant signal.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from rig.base.errors import InputError
from rig.channels.faults.blocks import StaleStamps
from rig.channels.faults.kind import Draws, Kind
from rig.channels.sampling import TICKS_HZ, first_row

if TYPE_CHECKING:
    from rig.channels.table import Channel

_MAX_DURATION_S = 86_400.0
"""Assumed duration of a fault without an end: the largest `for_s`."""
_MAX_PLACES = 200_000
"""Draws of a random fault that are checked: 10 s of samples at 20 kHz."""
_MAX_STEPS = 1.05
"""The smallest sufficient size is rounded to as few digits as keep its effect below this number of steps."""
_MAX_FACTOR = 1e40
"""Largest factor by which a size is raised in the search for a sufficient one."""


def check_time(what: Kind, rate_hz: int, tick: int, row_ticks: int, for_s: float | None) -> None:
    """Raise InputError if a fault ends before the first sample that it would change.

    Args:
        what: The fault.
        rate_hz: Sampling rate [Hz].
        tick: Tick of the command.
        row_ticks: Ticks between rows of the model; faults begin and end on rows.
        for_s: Duration [s]; None: until it is cleared.

    Raises:
        InputError: The duration is too short; the message has the shortest sufficient one.
    """
    if for_s is None:
        return
    begin = -(-tick // row_ticks) * row_ticks
    sample = -(-first_row(begin, rate_hz) * TICKS_HZ // rate_hz)
    if isinstance(what, StaleStamps):  # its first block keeps the correct time
        sample = begin + what.ticks
    needed = sample // row_ticks * row_ticks + 1 - tick
    if max(1, round(for_s * TICKS_HZ)) < needed:
        raise InputError("for_s", f"at least {needed / TICKS_HZ:g}, to reach a sample at {rate_hz} Hz", for_s)


def check_size(what: Kind, channel: Channel, source: Channel | None, for_s: float | None) -> None:
    """Raise InputError if the largest effect of a fault stays below one step of a channel's converter.

    Args:
        what: The fault.
        channel: The channel.
        source: The channel whose signal the fault reads, if any.
        for_s: Duration [s]; None: until it is cleared.

    Raises:
        InputError: The size is too small; the message has the smallest sufficient one.
    """
    lasts_s = _MAX_DURATION_S if for_s is None else for_s

    def reach(other: Kind) -> float:
        """Return the largest change [steps of the converter]."""
        return other.reach_v(channel, lasts_s, source or channel) / channel.lsb_v

    if reach(what) >= 1.0:
        return
    low, high = 0.0, math.log(_MAX_FACTOR)
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if reach(what.times(math.exp(middle))) >= 1.0 else (middle, high)
    name = what.sized or what.main()
    size = getattr(what.times(math.exp(high)), name)
    rounded = (float(f"{size:.{digits}g}") for digits in range(1, 17))
    size = next((one for one in rounded if 1.0 <= reach(what.model_copy(update={name: one})) < _MAX_STEPS), size)
    bound = f"{size!r} to change a count of {channel.name}, whose converter's step is {channel.lsb_v:.3g} V"
    raise InputError(name, f"at {'least' if size > getattr(what, name) else 'most'} {bound}", getattr(what, name))


def check_draws(what: Kind, rate_hz: int, row: int, tick: int, for_s: float | None, draws: Draws) -> None:
    """Raise InputError if no draw of a random fault selects a sample, slot, block or turn.

    Args:
        what: The fault.
        rate_hz: Sampling rate [Hz].
        row: Number of its first sample.
        tick: Tick of the command.
        for_s: Duration [s]; None: until it is cleared.
        draws: Random numbers of the fault.

    Raises:
        InputError: Nothing is selected; the message has the smallest sufficient number.
    """
    if (chance := what.chance(rate_hz)) is None:
        return
    field, per_unit, every_s = chance
    lasts_s = _MAX_DURATION_S if for_s is None else for_s
    # Turns are counted from the start of the run.
    first, lasts_s = (
        (0, lasts_s + tick / TICKS_HZ) if what.channel_only else (row if field == "rate_hz" else 0, lasts_s)
    )
    places = first + np.arange(min(_MAX_PLACES, math.ceil(lasts_s / every_s) + 1))
    value = getattr(what, field)
    for some in (places[:1000], places):
        least = float(draws.uniform(some)[:, 0].min()) / per_unit
        if least < value:
            return
    raise InputError(field, f"above {least:.3g} to happen once in the {len(places)} places that were drawn", value)
