"""Worst-case response times of periodic messages on a bus, and the bus load.

Implements the sufficient and necessary test of Davis, Burns, Bril, Lukkien (2007), Controller Area Network (CAN)
schedulability analysis: refuted, revisited and revised, Real-Time Systems 35, 239-272, with every instance of the busy
period, and the error overhead of Tindell, Burns, Wellings (1995), Calculating controller area network (CAN) message
response times, Control Engineering Practice 3, 1163-1169. For CAN FD it uses the lengths of FD frames; the equations
depend only on the durations of frames.

Assumptions: a message is queued at most once per period, within its jitter; each node offers its highest priority to
every arbitration (not a first-in-first-out queue); messages have different identifiers. Times are integers [ps]
internally, so that no rounding decides how many frames fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drivers.can.bus import frame as frames
from drivers.can.bus.timing import Speed, speed
from rig.base.errors import InputError

if TYPE_CHECKING:
    import can

_ERROR_BITS = 31
"""Maximum overhead of an error in addition to the frame: two flags 12, delimiter 8, intermission 3, suspension 8 bits.
"""
_PS = 10**12


class PeriodicMessage(NamedTuple):
    """A periodic message.

    Attributes:
        identifier: 11 bits, or 29 if `extended`.
        period_s: Shortest time between two of its frames [s].
        length: Length of the data [bytes].
        jitter_s: Longest delay from the event to its queueing [s].
        deadline_s: Longest allowed response time [s]; None for the period.
        extended: Whether the identifier has 29 bits.
        fd: Whether it is a CAN FD frame.
        brs: Whether its data phase has the higher bit rate.
        bits: Nominal and fast bits with the intermission if the content is known, as
            `drivers.can.bus.timing.frame_bits` counts them; None for the maximum over all contents.
    """

    identifier: int
    period_s: float
    length: int = 8
    jitter_s: float = 0.0
    deadline_s: float | None = None
    extended: bool = False
    fd: bool = False
    brs: bool = False
    bits: tuple[int, int] | None = None


class Errors(NamedTuple):
    """Errors to allow for: a burst, then one per period.

    Attributes:
        burst: Largest number of errors at once.
        period_s: Shortest time between the others [s]; infinite for none.
    """

    burst: int = 1
    period_s: float = math.inf


class Response(NamedTuple):
    """Worst case of one message.

    Attributes:
        message: The message.
        transmission_s: Longest time on the bus, with the intermission [s].
        blocking_s: Longest frame of lower priority [s].
        busy_s: Longest time in which the bus is never free for lower priorities [s].
        instances: Frames of this message in that time.
        worst_s: Longest time from the event to the end of the intermission [s]; the frame itself ends 3 bits earlier.
            Infinite if this and higher priorities load the bus with 100 % or more.
        schedulable: Whether `worst_s` is within the deadline.
    """

    message: PeriodicMessage
    transmission_s: float
    blocking_s: float
    busy_s: float
    instances: int
    worst_s: float
    schedulable: bool


def worst_bits(message: PeriodicMessage) -> tuple[int, int]:
    """Return the largest number of bits that a message can have, at the nominal rate and at the data rate.

    Includes stuffing and intermission. Classic: g + 8 n + 13 + floor((g + 8 n - 1) / 4), g 34 or 54 (Davis et al. 2007,
    equation 1), for any identifier and CRC. FD: exact for the given identifier and any data; with a bit rate switch the
    largest number of nominal bits and the largest total, which need not occur in the same content.
    """
    if message.bits is not None:
        return message.bits
    return _worst_bits(_shape(message))


def best_bits(message: PeriodicMessage) -> tuple[int, int]:
    """Return the smallest number of bits that a message of this shape can have: without stuff bits by content."""
    shape = _shape(message)
    header = 32 if shape.extended else 12  # Start of frame, identifier, in extended ones SRR and IDE.
    tail = 10 + frames.INTERMISSION
    n = len(shape.data)
    if not shape.fd:
        return header + 7 + 8 * n + 15 + tail, 0
    crc = 4 + 17 + 6 if n <= 16 else 4 + 21 + 7
    slow = header + (4 if shape.extended else 5)  # RRS, in base frames IDE, FDF, res, BRS.
    fast = 5 + 8 * n + crc
    return (slow + tail - 1, fast + 1) if shape.brs else (slow + fast + tail, 0)


def load(messages: Sequence[PeriodicMessage], rate: str | float | Speed | can.BitTiming | can.BitTimingFd) -> float:
    """Return the largest share of the bus that messages take: the sum of transmission time over period."""
    timing = speed(rate)
    return math.fsum(_transmission_ps(message, timing) / _ps(message.period_s) for message in messages)


def worst_case(
    messages: Sequence[PeriodicMessage],
    rate: str | float | Speed | can.BitTiming | can.BitTimingFd,
    *,
    errors: Errors | None = None,
) -> list[Response]:
    """Calculate worst-case response times.

    Args:
        messages: All messages of the bus.
        rate: Its bit rates.
        errors: Errors to allow for; None for a bus without errors.

    Returns:
        One result for each message, the highest priority first.
    """
    from drivers.can.bus import kernels

    timing = speed(rate)
    order = sorted(messages, key=lambda message: kernels.priority(_word(message), 0))
    for one, other in pairwise(order):
        if (one.identifier, one.extended) == (other.identifier, other.extended):
            raise InputError("identifier", "of one message only", hex(one.identifier))
    times = [_transmission_ps(message, timing) for message in order]
    return [_response(order, times, index, timing, errors) for index in range(len(order))]


def _response(
    order: Sequence[PeriodicMessage], times: Sequence[int], index: int, timing: Speed, errors: Errors | None
) -> Response:
    message = order[index]
    c = times[index]
    b = max(times[index + 1 :], default=0)
    t_own, j_own = _ps(message.period_s), _ps(message.jitter_s)
    higher = [
        (_ps(other.period_s), _ps(other.jitter_s), time)
        for other, time in zip(order[:index], times[:index], strict=True)
    ]
    overhead = _ERROR_BITS * timing.nominal_ps + max(times[: index + 1])

    def error_time(t: int) -> int:
        """Return the time that errors cost in t."""
        if errors is None:
            return 0
        more = 0 if math.isinf(errors.period_s) else -(-t // _ps(errors.period_s))
        return (errors.burst + more) * overhead

    deadline = message.period_s if message.deadline_s is None else message.deadline_s
    utilisation = c / t_own + math.fsum(time / period for period, _, time in higher)
    if errors is not None:
        utilisation += overhead * 1e-12 / errors.period_s
    if utilisation >= 1.0:
        return Response(message, c / _PS, b / _PS, math.inf, 0, math.inf, False)

    busy = c
    while True:
        next_value = b + error_time(busy) + -(-(busy + j_own) // t_own) * c
        next_value += sum(-(-(busy + jitter) // period) * time for period, jitter, time in higher)
        if next_value == busy:
            break
        busy = next_value
    instances = -(-(busy + j_own) // t_own)
    worst = 0
    wait = b
    for q in range(instances):
        wait = max(wait, b + q * c)
        while True:
            next_value = b + q * c + error_time(wait + c)
            next_value += sum(
                -(-(wait + jitter + timing.nominal_ps) // period) * time for period, jitter, time in higher
            )
            if next_value == wait:
                break
            wait = next_value
        worst = max(worst, j_own + wait - q * t_own + c)
    return Response(message, c / _PS, b / _PS, busy / _PS, instances, worst / _PS, worst <= _ps(deadline))


def _ps(seconds: float) -> int:
    return round(seconds * _PS)


def _word(message: PeriodicMessage) -> int:
    return message.identifier | (frames.EXTENDED if message.extended else 0)


def _shape(message: PeriodicMessage) -> frames.Frame:
    """Return a frame with the message's identifier, length and flags, and zero data."""
    shape = frames.Frame(
        message.identifier, bytes(message.length), extended=message.extended, fd=message.fd, brs=message.brs
    )
    frames.make_record(shape)
    return shape


def _transmission_ps(message: PeriodicMessage, timing: Speed) -> int:
    if not 0.0 < message.period_s < math.inf:
        raise InputError("period_s", "above zero and finite", message.period_s)
    if not 0.0 <= message.jitter_s < math.inf:
        raise InputError("jitter_s", "not negative and finite", message.jitter_s)
    if message.fd and not timing.fd:
        raise InputError("message", f"classic on a bus of {timing}", message)
    nominal, fast = worst_bits(message)
    return nominal * timing.nominal_ps + fast * timing.data_ps


@lru_cache(maxsize=4096)
def _worst_bits(shape: frames.Frame) -> tuple[int, int]:
    n = len(shape.data)
    if not shape.fd:
        g = 54 if shape.extended else 34
        return g + 8 * n + 13 + (g + 8 * n - 1) // 4, 0
    from drivers.can.bus import kernels

    record = frames.records([shape])[0]
    raw = np.zeros(kernels.MAX_BITS, np.uint8)
    count, switch = kernels.header_and_data(
        int(record["identifier"]), int(record["length"]), int(record["flags"]), record["data"], raw
    )
    error_state = count - 8 * n - 5
    choices: list[tuple[int, ...]] = [(int(level),) for level in raw[:count]]
    for k in (error_state, *range(error_state + 5, count)):
        choices[k] = (0, 1)
    all_stuffing = _max_stuffing(choices, count)
    slow, fast = best_bits(PeriodicMessage(shape.identifier, 1.0, n, 0.0, None, shape.extended, True, shape.brs))
    if not shape.brs:
        return slow + all_stuffing, 0
    slow_stuffing = _max_stuffing(choices, switch - 1)
    return slow + slow_stuffing, fast + all_stuffing - slow_stuffing


def _max_stuffing(choices: Sequence[tuple[int, ...]], counted: int) -> int:
    """Return the largest number of stuff bits after one of the first `counted` bits, over all allowed levels.

    No stuff bit follows the very last bit, where a fixed stuff bit follows.
    """
    best = {(1, 1): 0}
    for k, levels in enumerate(choices):
        next_value: dict[tuple[int, int], int] = {}
        for (last, run), stuffed in best.items():
            for level in levels:
                length = run + 1 if level == last else 1
                state, total = (level, length), stuffed
                if length == 5 and k < len(choices) - 1:
                    state, total = (1 - level, 1), stuffed + (k < counted)
                next_value[state] = max(next_value.get(state, 0), total)
        best = next_value
    return max(best.values())
