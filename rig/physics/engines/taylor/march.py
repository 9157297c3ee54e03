"""Taylor series of order 16 on the full model: the engine for errors below 1e-6.

The solution's own power series by the recurrences of automatic differentiation; length of step from the last two terms
(A. Jorba and M. Zou, A software package for the numerical integration of ODEs by means of high-order Taylor methods,
Experimental Mathematics 14 (2005) 99-117). Their code, `rig.physics.engines.taylor.series`, is made of the equations in
`rig.physics.kernels.dynamics` (`rig.physics.engines.tape` says how); here is how the series are marched.

Events are roots of polynomials: onset, lift-off, a sliding speed that comes to 0, friction that rolling needs beyond
mu F_n, a normal law that asks for tension, a transducer that loses its preload. Steps end there; friction by Filippov,
as in `rig.physics.engines.common.events`.

Contact. delta^1.5 has branch points at onset and lift-off, next to which a series in time converges as far as to the
nearer one: a hundred steps a contact. While it slides, the series is therefore in tau with dt = s dtau, s the root of
delta, itself a state, s' = delta'/2 by tau: the force goes as s^3, onset and lift-off are simple zeros of s, and an
impact takes some 16 steps. (Levi-Civita and Sundman treat collisions of bodies so.) Where the law's exponent is neither
1 nor 1.5, contacts begin at a depth of 1e-11 of the clearance. Rolling ends before the lift-off and stays with time.

Steps run on beyond the rows, which are read off the series; so the memory holds one. Where the inputs change, it is
dropped at that instant. So neither calls nor the density of rows change a bit of the motion.

Smoothed friction is taken too, but a very small smoothing speed makes it stiff, and the steps short.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from rig.physics.engines.common.events import sliding_phase
from rig.physics.engines.common.memory import (
    CEILING,
    CONTACT_STEPS,
    EVALUATIONS,
    ONSET,
    PEAK_FORCE,
    PHASE,
    STEPS,
    TOLERANCE,
)
from rig.physics.engines.common.method import PER_SCALE, fill, rates
from rig.physics.engines.tape.columns import EVENTS, FORCE, ROOT, TIME, WIDTH
from rig.physics.engines.taylor.events import FIRST, NOTHING, change_phase, enter_events, preload_end, ring_at
from rig.physics.engines.taylor.place import (
    EAST,
    END_FRACTION,
    END_TICK,
    EVENT,
    FRACTION,
    INPUTS,
    KNOWN,
    LENGTH,
    NORTH,
    ORDER,
    RINGING,
    SERIES,
    SERIES_ORDER,
    SPAN,
    STALLED,
    TICK,
)
from rig.physics.engines.taylor.polynomial import column_at, first_zero, refine, series_at
from rig.physics.engines.taylor.ringing import RINGS, add_ringing, keep_clear, let_ring
from rig.physics.engines.taylor.series import LANES, flight, rolling, sliding
from rig.physics.kernels import signals as S
from rig.physics.kernels.forces import drive_speed
from rig.physics.kernels.laws.contact import FLIGHT, ROLLING, TOUCHING, held_speed, normal_force
from rig.physics.kernels.stage import kernel

_SAFETY = 0.9
_LONGEST_S, _SHORTEST_S = 6e-2, 1e-12
"""Longest step, and the shortest that is no sign of trouble [s], in the variable of the series."""
_NOTHING = 1e-60
"""What counts as 0 in a state."""
_ROUNDING = 1e-16
"""Tolerance that no step can vouch for."""
_SCALE_T, _SCALE_ROOT = 1e-4, 3e-3
"""What counts as 1 in a step's error: 0.1 ms, 9 µm."""


class Room(NamedTuple):
    """Arrays that the series are worked out in."""

    Y: np.ndarray  # the series at hand, shape (order + 1, WIDTH): in the memory, so that it outlives the call
    A: np.ndarray  # factors of products, shape (order + 1, LANES)
    B: np.ndarray
    D: np.ndarray  # rates, shape (order + 1, WIDTH)
    acc: np.ndarray  # sums over lanes, shape (LANES,)
    x: np.ndarray  # state, integrals and the columns up to the root, shape (ROOT + 1,)
    dy: np.ndarray  # shape (N_VECTOR,)
    out: np.ndarray  # shape (N_OBSERVED,)


@kernel
def _aligned(rows, columns):
    """Zeros whose rows begin on cache lines: the sums over lanes take half as long again without."""
    room = np.zeros(rows * columns + 8)
    first = (-room.ctypes.data % 64) // 8
    return room[first : first + rows * columns].reshape((rows, columns))


@kernel
def room_in(memory):
    """Room for a call."""
    rows = int(memory[SERIES_ORDER]) + 1
    return Room(
        memory[SERIES : SERIES + rows * WIDTH].reshape((rows, WIDTH)),
        _aligned(rows, LANES),
        _aligned(rows, LANES),
        _aligned(rows, WIDTH),
        _aligned(1, LANES)[0],
        np.zeros(ROOT + 1),
        np.empty(S.N_VECTOR),
        np.full(S.N_OBSERVED, np.nan),  # a signal that no stage computes stays nan
    )


@kernel
def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Prepare the memory for a state: a state that begins in contact holds the floored impact speed."""
    constants, inputs = constants[0], inputs[0]
    memory[:] = 0.0
    memory[ONSET] = held_speed(0.0, constants.contact)
    memory[TOLERANCE] = tolerance
    memory[SPAN], memory[SERIES_ORDER] = -1.0, ORDER
    ring, _ = ring_at(constants, inputs, y)
    if ring.delta > 0.0:
        memory[PHASE] = sliding_phase(constants, ring.sliding)


@kernel
def _make_series(constants, inputs, memory, room):
    """All coefficients of a series from the state in its first row.

    Returns:
        Whether it is a series in slowed time.
    """
    Y, A, B, D, acc = room.Y, room.A, room.B, room.D, room.acc
    now, phase = int(memory[TICK]), int(memory[PHASE])
    aim = drive_speed(inputs, now, memory[FRACTION])
    pulse = along = 0.0
    if inputs.hammer_start <= now < inputs.hammer_end:
        pulse = math.pi / float(inputs.hammer_end - inputs.hammer_start)
        along = pulse * (float(now - inputs.hammer_start) + memory[FRACTION])
        pulse /= inputs.tick_s
    if phase == FLIGHT:
        flight(constants, inputs, memory, aim, pulse, along, 0.0, Y, A, B, D, acc)
    elif phase == ROLLING:
        per_friction = -1.0 / ring_at(constants, inputs, Y[0])[1]
        rolling(constants, inputs, memory, aim, pulse, along, per_friction, Y, A, B, D, acc)
    else:
        sliding(constants, inputs, memory, aim, pulse, along, 0.0, Y, A, B, D, acc)
    enter_events(constants, memory, Y)
    return phase != FLIGHT and phase != ROLLING


@kernel
def _length(memory, Y, slowed):
    """How far a series holds: its last two terms stay within the tolerance."""
    tolerance, order = memory[TOLERANCE], len(Y) - 1
    last = before = known = 0.0
    for i in range(S.N_STATE):
        known += Y[order, i]
        last = max(last, abs(Y[order, i]) * PER_SCALE[i])
        before = max(before, abs(Y[order - 1, i]) * PER_SCALE[i])
    if slowed:
        last = max(last, abs(Y[order, TIME]) / _SCALE_T, abs(Y[order, ROOT]) / _SCALE_ROOT)
        before = max(before, abs(Y[order - 1, TIME]) / _SCALE_T, abs(Y[order - 1, ROOT]) / _SCALE_ROOT)
    if not math.isfinite(known):  # max leaves out what is none
        return math.nan
    return _SAFETY * min(
        (tolerance / max(last, 1e-200)) ** (1.0 / order), (tolerance / max(before, 1e-200)) ** (1.0 / (order - 1.0))
    )


@kernel
def _law_length(memory, Y):
    """How far the normal law and its losses hold in a series."""
    tolerance, law, loss, order = memory[TOLERANCE], EVENTS + 2, S.CONTACT_LOSS, len(Y) - 1
    most = tolerance * max(1.0, abs(Y[0, law]))
    last = max(abs(Y[order - 1, law]) / most, abs(Y[order - 1, loss]) / tolerance)
    before = max(abs(Y[order - 2, law]) / most, abs(Y[order - 2, loss]) / tolerance)
    return _SAFETY * min(max(last, 1e-200) ** (-1.0 / (order - 1.0)), max(before, 1e-200) ** (-1.0 / (order - 2.0)))


@kernel
def _force_at(constants, inputs, memory, Y, s, x):
    """Normal force by the law, at s of a series [N]. Its own column says less: no length of step vouches for it."""
    series_at(Y, s, x)
    ring, _ = ring_at(constants, inputs, x)
    return normal_force(ring.delta, ring.rate, memory[ONSET], constants.contact)[0]


@kernel
def _note_peak(constants, inputs, memory, Y, x):
    """The largest normal force within a series; x is room for a state."""
    h = memory[LENGTH]
    most, power = Y[0, FORCE], 1.0
    for k in range(1, len(Y) - 1):
        power *= h
        most += max(0.0, Y[k, FORCE] * power)
    if not most > memory[PEAK_FORCE]:
        return
    slope_before, before = Y[1, FORCE], 0.0
    peak = max(memory[PEAK_FORCE], Y[0, FORCE])
    for i in range(1, 9):
        s = 0.125 * i * h
        value, slope = column_at(Y, FORCE, 0, s)
        if value > peak:
            peak = max(peak, _force_at(constants, inputs, memory, Y, s, x))
        if slope_before > 0.0 and slope < 0.0:
            low, high = before, s
            for _ in range(30):
                middle = 0.5 * (low + high)
                if column_at(Y, FORCE, 0, middle)[1] > 0.0:
                    low = middle
                else:
                    high = middle
            if column_at(Y, FORCE, 0, high)[0] > peak:
                peak = max(peak, _force_at(constants, inputs, memory, Y, high, x))
        before, slope_before = s, slope
    memory[PEAK_FORCE] = peak


@kernel
def _state_at(memory, Y, s, x):
    """State and integrals at s of the series at hand into x."""
    series_at(Y, s, x)
    if memory[RINGING] != 0.0:
        add_ringing(memory, s, x)


@kernel
def _rings(constants, inputs, memory, x, y):
    """Take the housings out of the state x in flight where they ring by themselves; y is room for a state."""
    memory[RINGING] = 0.0
    if memory[RINGS] == 0.0 or memory[PHASE] != FLIGHT or memory[NORTH] != 0.0 or memory[EAST] != 0.0:
        return False
    fill(y[: S.N_VECTOR], x)
    for row in range(S.X_IH, S.Y_OH + 1):
        y[row] = y[row + S.VX_IH - S.X_IH] = 0.0
    ring, _ = ring_at(constants, inputs, y)
    return let_ring(constants, memory, x, ring.delta, ring.rate)


@kernel
def _next_series(constants, inputs, memory, room, y):
    """From the end of one series to the next; y is room for a state.

    Returns:
        False where there is none: the numbers are no longer finite.
    """
    Y, x = room.Y, room.x
    if memory[SPAN] >= 0.0:
        if memory[PHASE] != FLIGHT:
            _note_peak(constants, inputs, memory, Y, x)
        _state_at(memory, Y, memory[LENGTH], x)
        memory[TICK], memory[FRACTION] = memory[END_TICK], memory[END_FRACTION]
    change_phase(constants, inputs, memory, x, y, room.dy, room.out)
    rings = _rings(constants, inputs, memory, x, y)
    fill(Y[0, : ROOT + 1], x)
    for i in range(S.N_STATE):
        # At rest, rates decay to where a processor takes a hundred times as long for a product.
        if abs(Y[0, i]) < _NOTHING:
            Y[0, i] = 0.0
    slowed = _make_series(constants, inputs, memory, room)
    memory[STEPS] += 1.0
    memory[EVALUATIONS] += memory[SERIES_ORDER]
    if memory[PHASE] != FLIGHT:
        memory[CONTACT_STEPS] += 1.0
    if memory[TOLERANCE] < _ROUNDING:
        memory[CEILING] += 1.0
    h = _length(memory, Y, slowed)
    if not math.isfinite(h):
        return False
    if slowed and not (constants.contact.exponent == 1.5 or constants.contact.exponent == 1.0):
        # The law, by which events and losses go, has a radius that a motion it hardly moves yet does not show.
        h = min(h, _law_length(memory, Y))
    # Never further than it holds: what a series says beyond its radius is no number to go on with.
    if h < _SHORTEST_S:
        memory[CEILING] += 1.0
    # No further than a corner of the hammer's pulse.
    now = memory[TICK]
    corner = math.inf
    if inputs.hammer_end > inputs.hammer_start:
        if inputs.hammer_start > now:
            corner = float(inputs.hammer_start)
        elif inputs.hammer_end > now:
            corner = float(inputs.hammer_end)
    limit = min(_LONGEST_S, ((corner - now) - memory[FRACTION]) * inputs.tick_s)
    at_corner = False
    if slowed:
        span = column_at(Y, TIME, 0, h)[0]
        if span > limit:
            h = refine(Y, TIME, 0, limit, 0.0, h)
            at_corner = limit < _LONGEST_S
    elif h >= limit:
        h = limit
        at_corner = limit < _LONGEST_S
    event = NOTHING
    if rings:
        keep_clear(constants, memory, Y, EVENTS)
        zero = first_zero(Y, EVENTS, 0, h)
        if zero <= h:
            h, at_corner = zero, False
    else:
        for i in range(3):
            shift = int(memory[KNOWN + i])
            zero = first_zero(Y, EVENTS + i, shift, h)
            if zero <= h:
                h, event, at_corner = zero, FIRST + i, False
        zero, which = preload_end(constants, memory, Y, h)
        if zero <= h:
            h, event, at_corner = zero, which, False
    span = column_at(Y, TIME, 0, h)[0] if slowed else h
    memory[STALLED] = memory[STALLED] + 1.0 if span < 1e-13 else 0.0
    memory[LENGTH], memory[SPAN], memory[EVENT] = h, span, event
    if at_corner:
        memory[END_TICK], memory[END_FRACTION] = corner, 0.0
    else:
        ticks = memory[FRACTION] + span / inputs.tick_s
        whole = math.floor(ticks)
        memory[END_TICK], memory[END_FRACTION] = now + whole, ticks - whole
    return True


@kernel
def holds(memory, tick, fraction):
    """Whether the series at hand holds at an instant: a whole tick and the ticks beyond it."""
    return memory[SPAN] >= 0.0 and (tick - memory[END_TICK]) + (fraction - memory[END_FRACTION]) <= 0.0


@kernel
def continue_series(constants, inputs, memory, room, y):
    """Go over to the next series; y is room for a state, and nan where the numbers are no longer finite.

    Returns:
        Whether they are.
    """
    if memory[STALLED] > 1000.0 or not _next_series(constants, inputs, memory, room, y):
        memory[CEILING] += 1.0
        memory[STALLED] = 1e9
        y[:] = np.nan
        return False
    return True


@kernel
def read_off(memory, Y, y, tick, fraction):
    """State at an instant of the series at hand, into y."""
    time = ((tick - memory[TICK]) + (fraction - memory[FRACTION])) * memory[INPUTS]
    s = time
    if time >= memory[SPAN]:
        s = memory[LENGTH]
    elif time > 0.0 and memory[PHASE] != FLIGHT and memory[PHASE] != ROLLING:
        s = refine(Y, TIME, 0, time, 0.0, memory[LENGTH])
    _state_at(memory, Y, s, y[: S.N_VECTOR])


@kernel
def same_inputs(inputs, memory):
    """Whether the inputs are what they were; keeps them."""
    kept = memory[INPUTS : INPUTS + 11]
    same = (
        kept[0] == inputs.tick_s
        and kept[1] == inputs.hammer_force
        and kept[2] == inputs.hammer_x
        and kept[3] == inputs.hammer_y
        and kept[4] == inputs.hammer_start
        and kept[5] == inputs.hammer_end
        and kept[6] == inputs.speed
        and kept[7] == inputs.speed_slope
        and kept[8] == inputs.speed_tick
        and (kept[9] != 0.0) == inputs.ideal_drive
        and (kept[10] != 0.0) == inputs.magnet_engaged
    )
    kept[0], kept[1], kept[2], kept[3] = inputs.tick_s, inputs.hammer_force, inputs.hammer_x, inputs.hammer_y
    kept[4], kept[5], kept[6] = inputs.hammer_start, inputs.hammer_end, inputs.speed
    kept[7], kept[8] = inputs.speed_slope, inputs.speed_tick
    kept[9] = 1.0 if inputs.ideal_drive else 0.0
    kept[10] = 1.0 if inputs.magnet_engaged else 0.0
    return same


@kernel
def begin_series(constants, inputs, memory, room, y, tick, fraction, leaves):
    """A new beginning from the state y, at a whole tick and the ticks beyond it, for the next series to continue from.

    `leaves` says that a contact ends there: its gap counts as closed, whatever rounding makes of it.
    """
    if memory[SPAN] >= 0.0 and memory[PHASE] != FLIGHT:
        _note_peak(constants, inputs, memory, room.Y, room.x)
    fill(room.x[: S.N_VECTOR], y)
    memory[SPAN] = -1.0
    memory[EVENT] = NOTHING
    if leaves:
        memory[EVENT], memory[PHASE] = FIRST, TOUCHING
    memory[TICK], memory[FRACTION] = float(tick), fraction
    memory[END_TICK], memory[END_FRACTION] = float(tick), fraction


@kernel
def write_row(constants, inputs, memory, now, dy, out, y, row, rows):
    """Write the row of the state y at a tick, where `rows` has room for it."""
    if row < len(rows):
        rates(constants, inputs, now, 0.0, memory[ONSET], int(memory[PHASE]), True, y, dy, out)
        fill(rows[row, : S.N_VECTOR], y)
        fill(rows[row, S.N_VECTOR :], out)


@kernel
def write_rows(constants, inputs, memory, Y, dy, out, y, grid, row, rows):
    """The rows that lie on the series at hand, and the state at the last of them into y.

    In a loop of its own without `Room`: to hand its arrays on takes as long as to read off a state.

    Args:
        constants: Numbers of the model.
        inputs: Hammer, drive, magnets.
        memory: Of the engine.
        Y: The series.
        dy: Room for rates, shape (N_VECTOR,).
        out: Room for what is observed, shape (N_OBSERVED,).
        y: State and integrals, out, shape (N_VECTOR,).
        grid: Tick of the first row, ticks a row, that at the end.
        row: Number of the next row.
        rows: Out; instants beyond them are read off and not written.

    Returns:
        Number of the next row: it does not lie on it, or is behind the end.
    """
    first, every, end = grid
    now = min(first + row * every, end)
    while holds(memory, now, 0.0):
        read_off(memory, Y, y, now, 0.0)
        write_row(constants, inputs, memory, now, dy, out, y, row, rows)
        row += 1
        if now == end:
            break
        now = min(first + row * every, end)
    return row


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """Take `steps` steps in place and write every `stride`-th instant's row (see `rig.physics.engines`).

    Args:
        constants: Numbers of the model.
        inputs: Hammer, drive, magnets; constant over the call.
        y: State and integrals, in and out, shape (N_VECTOR,). Read only where no series goes on.
        memory: In and out, shape (MEMORY,).
        tick: Time at the start.
        step_ticks: Ticks a step of the grid that rows and calls lie on.
        steps: Number of steps.
        stride: Steps a row.
        rows: Out, shape (ceil(steps / stride), N_ROW), or one longer: the last is that at the end.
    """
    constants, inputs = constants[0], inputs[0]
    room = room_in(memory)
    if not same_inputs(inputs, memory) or memory[SPAN] < 0.0:
        begin_series(constants, inputs, memory, room, y, tick, 0.0, False)
    grid, count = (tick, stride * step_ticks, tick + steps * step_ticks), (steps + stride - 1) // stride
    row = write_rows(constants, inputs, memory, room.Y, room.dy, room.out, y, grid, 0, rows)
    while row <= count and continue_series(constants, inputs, memory, room, y):
        row = write_rows(constants, inputs, memory, room.Y, room.dy, room.out, y, grid, row, rows)
    rows[row:].fill(np.nan)
