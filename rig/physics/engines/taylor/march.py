"""Taylor series of order 16 on the full model: the engine for errors below 1e-6.

The solution's power series by the recurrences of automatic differentiation, with the step length from the last two
terms (A. Jorba and M. Zou, A software package for the numerical integration of ODEs by means of high-order Taylor
methods, Experimental Mathematics 14 (2005) 99-117). The recurrences, `rig.physics.engines.taylor.series`, are generated
from the equations in `rig.physics.kernels.dynamics` (see `rig.physics.engines.tape`). This module marches the series.

Events are roots of polynomials: onset, lift-off, zero of the sliding speed, rolling friction above mu F_n, a normal law
that would pull, loss of a transducer's preload. Steps end there; friction by Filippov, as in
`rig.physics.engines.common.events`.

Contact: delta^1.5 has branch points at onset and lift-off, and a series in time converges only as far as the nearer
one, which takes a hundred steps per contact. A sliding contact therefore uses tau with dt = s dtau, where s, the root
of delta, is itself a state, s' = delta'/2 by tau. The force is proportional to s^3, onset and lift-off are simple zeros
of s, and an impact takes about 16 steps. (Levi-Civita and Sundman treat collisions of bodies in this way.) Where the
law's exponent is neither 1 nor 1.5, contacts start at a depth of 1e-11 of the clearance. Rolling ends before the
lift-off and uses time.

Steps extend beyond the rows, which are read from the series; so the memory holds one series. A change of the inputs
discards it at that instant. Thus neither the division into calls nor the density of rows changes a bit of the motion.

Smoothed friction is supported, but a very small smoothing speed makes it stiff and the steps short.
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
from rig.physics.engines.taylor.events import (
    FIRST,
    NO_EVENT,
    change_phase,
    preload_end,
    ring_at,
    set_events,
)
from rig.physics.engines.taylor.memory import (
    EAST,
    END_FRACTION,
    END_TICK,
    EVENT,
    FRACTION,
    INPUTS,
    LENGTH,
    NORTH,
    ORDER,
    RINGING,
    SERIES,
    SERIES_ORDER,
    SPAN,
    STALLED_STEPS,
    TICK,
    ZERO_COEFFICIENTS,
)
from rig.physics.engines.taylor.polynomial import column_at, first_zero, refine, series_at
from rig.physics.engines.taylor.ringing import RINGS, add_clearance_margin, add_ringing, start_ringing
from rig.physics.engines.taylor.series import LANES, flight, rolling, sliding
from rig.physics.kernels import signals as S
from rig.physics.kernels.forces import drive_speed
from rig.physics.kernels.laws.contact import FLIGHT, ROLLING, TOUCHING, floor_onset_speed, normal_force
from rig.physics.kernels.stage import kernel

_SAFETY = 0.9
_MAX_STEP_S, _MIN_STEP_S = 6e-2, 1e-12
"""Longest step, and the shortest that does not indicate a failure [s], in the variable of the series."""
_MIN_STATE = 1e-60
"""Magnitude below which a state is set to 0."""
_MIN_TOLERANCE = 1e-16
"""Smallest tolerance that rounding permits."""
_SCALE_T, _SCALE_ROOT = 1e-4, 3e-3
"""Scales of time and root in a step's error: 0.1 ms, 9 µm."""


class Room(NamedTuple):
    """Workspace of the series."""

    Y: np.ndarray  # current series, shape (order + 1, WIDTH), in the memory
    A: np.ndarray  # factors of products, shape (order + 1, LANES)
    B: np.ndarray
    D: np.ndarray  # rates, shape (order + 1, WIDTH)
    acc: np.ndarray  # sums over lanes, shape (LANES,)
    x: np.ndarray  # state, integrals and the columns up to the root, shape (ROOT + 1,)
    dy: np.ndarray  # shape (N_VECTOR,)
    out: np.ndarray  # shape (N_OBSERVED,)


@kernel
def _aligned(rows, columns):
    """Return zeros with rows on cache lines; without alignment the sums over lanes take half as long again."""
    room = np.zeros(rows * columns + 8)
    first = (-room.ctypes.data % 64) // 8
    return room[first : first + rows * columns].reshape((rows, columns))


@kernel
def room_in(memory):
    """Return the workspace of a call."""
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
    """Initialise the memory for a state; a state in contact gets the floored impact speed."""
    constants, inputs = constants[0], inputs[0]
    memory[:] = 0.0
    memory[ONSET] = floor_onset_speed(0.0, constants.contact)
    memory[TOLERANCE] = tolerance
    memory[SPAN], memory[SERIES_ORDER] = -1.0, ORDER
    ring, _ = ring_at(constants, inputs, y)
    if ring.delta > 0.0:
        memory[PHASE] = sliding_phase(constants, ring.sliding)


@kernel
def _make_series(constants, inputs, memory, room):
    """Compute all coefficients of a series from the state in its first row.

    Returns:
        True for a series in tau, the variable of sliding contacts.
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
    set_events(constants, memory, Y)
    return phase != FLIGHT and phase != ROLLING


@kernel
def _length(memory, Y, slowed):
    """Return the length of a series at which its last two terms are within the tolerance."""
    tolerance, order = memory[TOLERANCE], len(Y) - 1
    last = before = known = 0.0
    for i in range(S.N_STATE):
        known += Y[order, i]
        last = max(last, abs(Y[order, i]) * PER_SCALE[i])
        before = max(before, abs(Y[order - 1, i]) * PER_SCALE[i])
    if slowed:
        last = max(last, abs(Y[order, TIME]) / _SCALE_T, abs(Y[order, ROOT]) / _SCALE_ROOT)
        before = max(before, abs(Y[order - 1, TIME]) / _SCALE_T, abs(Y[order - 1, ROOT]) / _SCALE_ROOT)
    if not math.isfinite(known):  # max ignores nan
        return math.nan
    return _SAFETY * min(
        (tolerance / max(last, 1e-200)) ** (1.0 / order), (tolerance / max(before, 1e-200)) ** (1.0 / (order - 1.0))
    )


@kernel
def _law_length(memory, Y):
    """Return the length of a series at which the normal law and its losses are within the tolerance."""
    tolerance, law, loss, order = memory[TOLERANCE], EVENTS + 2, S.CONTACT_LOSS, len(Y) - 1
    most = tolerance * max(1.0, abs(Y[0, law]))
    last = max(abs(Y[order - 1, law]) / most, abs(Y[order - 1, loss]) / tolerance)
    before = max(abs(Y[order - 2, law]) / most, abs(Y[order - 2, loss]) / tolerance)
    return _SAFETY * min(max(last, 1e-200) ** (-1.0 / (order - 1.0)), max(before, 1e-200) ** (-1.0 / (order - 2.0)))


@kernel
def _force_at(constants, inputs, memory, Y, s, x):
    """Return the normal force by the law at s of a series [N]; the error of its column is not bounded."""
    series_at(Y, s, x)
    ring, _ = ring_at(constants, inputs, x)
    return normal_force(ring.delta, ring.rate, memory[ONSET], constants.contact)[0]


@kernel
def _note_peak(constants, inputs, memory, Y, x):
    """Update the largest normal force by that within a series; x is workspace for a state."""
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
    """Evaluate state and integrals at s of the current series into x."""
    series_at(Y, s, x)
    if memory[RINGING] != 0.0:
        add_ringing(memory, s, x)


@kernel
def _ring(constants, inputs, memory, x, y):
    """Remove the ringing housings from the state x in flight where possible; y is workspace for a state."""
    memory[RINGING] = 0.0
    if memory[RINGS] == 0.0 or memory[PHASE] != FLIGHT or memory[NORTH] != 0.0 or memory[EAST] != 0.0:
        return False
    fill(y[: S.N_VECTOR], x)
    for row in range(S.X_IH, S.Y_OH + 1):
        y[row] = y[row + S.VX_IH - S.X_IH] = 0.0
    ring, _ = ring_at(constants, inputs, y)
    return start_ringing(constants, memory, x, ring.delta, ring.rate)


@kernel
def _next_series(constants, inputs, memory, room, y):
    """Advance from the end of one series to the next; y is workspace for a state.

    Returns:
        False if the numbers are no longer finite.
    """
    Y, x = room.Y, room.x
    if memory[SPAN] >= 0.0:
        if memory[PHASE] != FLIGHT:
            _note_peak(constants, inputs, memory, Y, x)
        _state_at(memory, Y, memory[LENGTH], x)
        memory[TICK], memory[FRACTION] = memory[END_TICK], memory[END_FRACTION]
    change_phase(constants, inputs, memory, x, y, room.dy, room.out)
    rings = _ring(constants, inputs, memory, x, y)
    fill(Y[0, : ROOT + 1], x)
    for i in range(S.N_STATE):
        # At rest, rates decay to denormal numbers, which slow down products a hundredfold.
        if abs(Y[0, i]) < _MIN_STATE:
            Y[0, i] = 0.0
    slowed = _make_series(constants, inputs, memory, room)
    memory[STEPS] += 1.0
    memory[EVALUATIONS] += memory[SERIES_ORDER]
    if memory[PHASE] != FLIGHT:
        memory[CONTACT_STEPS] += 1.0
    if memory[TOLERANCE] < _MIN_TOLERANCE:
        memory[CEILING] += 1.0
    h = _length(memory, Y, slowed)
    if not math.isfinite(h):
        return False
    if slowed and not (constants.contact.exponent == 1.5 or constants.contact.exponent == 1.0):
        # The law's radius of convergence limits events and losses, and may not show in the motion yet.
        h = min(h, _law_length(memory, Y))
    # A series is never used beyond its radius of convergence.
    if h < _MIN_STEP_S:
        memory[CEILING] += 1.0
    # At most up to a corner of the hammer pulse.
    now = memory[TICK]
    corner = math.inf
    if inputs.hammer_end > inputs.hammer_start:
        if inputs.hammer_start > now:
            corner = float(inputs.hammer_start)
        elif inputs.hammer_end > now:
            corner = float(inputs.hammer_end)
    limit = min(_MAX_STEP_S, ((corner - now) - memory[FRACTION]) * inputs.tick_s)
    at_corner = False
    if slowed:
        span = column_at(Y, TIME, 0, h)[0]
        if span > limit:
            h = refine(Y, TIME, 0, limit, 0.0, h)
            at_corner = limit < _MAX_STEP_S
    elif h >= limit:
        h = limit
        at_corner = limit < _MAX_STEP_S
    event = NO_EVENT
    if rings:
        add_clearance_margin(constants, memory, Y, EVENTS)
        zero = first_zero(Y, EVENTS, 0, h)
        if zero <= h:
            h, at_corner = zero, False
    else:
        for i in range(3):
            shift = int(memory[ZERO_COEFFICIENTS + i])
            zero = first_zero(Y, EVENTS + i, shift, h)
            if zero <= h:
                h, event, at_corner = zero, FIRST + i, False
        zero, which = preload_end(constants, memory, Y, h)
        if zero <= h:
            h, event, at_corner = zero, which, False
    span = column_at(Y, TIME, 0, h)[0] if slowed else h
    memory[STALLED_STEPS] = memory[STALLED_STEPS] + 1.0 if span < 1e-13 else 0.0
    memory[LENGTH], memory[SPAN], memory[EVENT] = h, span, event
    if at_corner:
        memory[END_TICK], memory[END_FRACTION] = corner, 0.0
    else:
        ticks = memory[FRACTION] + span / inputs.tick_s
        whole = math.floor(ticks)
        memory[END_TICK], memory[END_FRACTION] = now + whole, ticks - whole
    return True


@kernel
def covers(memory, tick, fraction):
    """Return whether the current series covers an instant, a whole tick and the ticks beyond it."""
    return memory[SPAN] >= 0.0 and (tick - memory[END_TICK]) + (fraction - memory[END_FRACTION]) <= 0.0


@kernel
def continue_series(constants, inputs, memory, room, y):
    """Start the next series; y is workspace for a state, and nan if the numbers are no longer finite.

    Returns:
        True if the numbers are finite.
    """
    if memory[STALLED_STEPS] > 1000.0 or not _next_series(constants, inputs, memory, room, y):
        memory[CEILING] += 1.0
        memory[STALLED_STEPS] = 1e9
        y[:] = np.nan
        return False
    return True


@kernel
def read_state(memory, Y, y, tick, fraction):
    """Evaluate the state at an instant of the current series into y."""
    time = ((tick - memory[TICK]) + (fraction - memory[FRACTION])) * memory[INPUTS]
    s = time
    if time >= memory[SPAN]:
        s = memory[LENGTH]
    elif time > 0.0 and memory[PHASE] != FLIGHT and memory[PHASE] != ROLLING:
        s = refine(Y, TIME, 0, time, 0.0, memory[LENGTH])
    _state_at(memory, Y, s, y[: S.N_VECTOR])


@kernel
def compare_inputs(inputs, memory):
    """Return whether the inputs are unchanged, and store them."""
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
    """Prepare the memory for a new series from the state y at `tick` + `fraction`.

    `leaves` marks the end of a contact: its gap counts as closed, regardless of rounding.
    """
    if memory[SPAN] >= 0.0 and memory[PHASE] != FLIGHT:
        _note_peak(constants, inputs, memory, room.Y, room.x)
    fill(room.x[: S.N_VECTOR], y)
    memory[SPAN] = -1.0
    memory[EVENT] = NO_EVENT
    if leaves:
        memory[EVENT], memory[PHASE] = FIRST, TOUCHING
    memory[TICK], memory[FRACTION] = float(tick), fraction
    memory[END_TICK], memory[END_FRACTION] = float(tick), fraction


@kernel
def write_row(constants, inputs, memory, now, dy, out, y, row, rows):
    """Write the row of the state y at a tick, if `rows` has room for it."""
    if row < len(rows):
        rates(constants, inputs, now, 0.0, memory[ONSET], int(memory[PHASE]), True, y, dy, out)
        fill(rows[row, : S.N_VECTOR], y)
        fill(rows[row, S.N_VECTOR :], out)


@kernel
def write_rows(constants, inputs, memory, Y, dy, out, y, grid, row, rows):
    """Write the rows within the current series, and the state at the last of them into y.

    A separate loop without `Room`: passing its arrays takes as long as reading a state.

    Args:
        constants: Model constants.
        inputs: Hammer, drive, magnets.
        memory: Memory of the engine.
        Y: Series.
        dy: Workspace for rates, shape (N_VECTOR,).
        out: Workspace for the observed quantities, shape (N_OBSERVED,).
        y: State and integrals, out, shape (N_VECTOR,).
        grid: Tick of the first row, ticks per row, tick at the end.
        row: Number of the next row.
        rows: Out; instants without a row are read and not written.

    Returns:
        Number of the next row, which is beyond the series or the last row.
    """
    first, every, end = grid
    now = min(first + row * every, end)
    while covers(memory, now, 0.0):
        read_state(memory, Y, y, now, 0.0)
        write_row(constants, inputs, memory, now, dy, out, y, row, rows)
        row += 1
        if now == end:
            break
        now = min(first + row * every, end)
    return row


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """Take `steps` steps in place and write a row every `stride` steps (see `rig.physics.engines`).

    Args:
        constants: Model constants.
        inputs: Hammer, drive, magnets; constant over the call.
        y: State and integrals, in and out, shape (N_VECTOR,). Read only if no series continues.
        memory: Memory, in and out, shape (MEMORY,).
        tick: Time at the start.
        step_ticks: Length of a step of the grid of rows and calls [ticks].
        steps: Number of steps.
        stride: Steps per row.
        rows: Out, shape (ceil(steps / stride), N_ROW), or one longer, with the row at the end.
    """
    constants, inputs = constants[0], inputs[0]
    room = room_in(memory)
    if not compare_inputs(inputs, memory) or memory[SPAN] < 0.0:
        begin_series(constants, inputs, memory, room, y, tick, 0.0, False)
    grid, count = (tick, stride * step_ticks, tick + steps * step_ticks), (steps + stride - 1) // stride
    row = write_rows(constants, inputs, memory, room.Y, room.dy, room.out, y, grid, 0, rows)
    while row <= count and continue_series(constants, inputs, memory, room, y):
        row = write_rows(constants, inputs, memory, room.Y, room.dy, room.out, y, grid, row, rows)
    rows[row:].fill(np.nan)
