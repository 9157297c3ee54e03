"""Rolling by collocation: entry from a series, steps of part of a whirl turn, their error, exit to a series.

A settled whirl has few harmonics, but a series resolves the contact's natural frequency, which is no longer excited.
`rig.physics.engines.split.condensed` takes from two to `MAX_PLACES` steps per turn and does not resolve it. Each step
of a turn keeps the inverse of its last solution; its unknowns are predicted from those of the last three turns.

A step is rejected if the contact may slip or lift off, a transducer may lose its preload, a hammer pulse overlaps it,
or it cannot be solved: a series then continues from its start. Margins on these limits ensure that no event is missed
between nodes; the series locates it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rig.physics.engines.common.events import update_peak_force
from rig.physics.engines.common.memory import (
    CONTACT_STEPS,
    EVALUATIONS,
    ONSET,
    PEAK_FORCE,
    PHASE,
    ROLLED_S,
    STEPS,
    TOLERANCE,
)
from rig.physics.engines.common.method import fill, rates
from rig.physics.engines.split.condensed import (
    FN,
    FORCE_FLOOR_N,
    FT,
    FX,
    N_UNKNOWNS,
    estimate,
    keeps_rolling,
    linear_coefficients,
    root_of_law,
    set_step,
    slip_of_law,
    solve_step,
    view_rolling,
    write_nodes,
)
from rig.physics.engines.split.layout import (
    LAST_UNKNOWNS,
    MAX_PLACES,
    NORMAL_X,
    NORMAL_Y,
    PLACE,
    PLACES,
    READY_TICK,
    ROLLING_STEPS,
    STALE_RESPONSES,
    START_FORCE,
    START_FRICTION,
    STEP_S,
    TURN_ERROR,
    TURNS,
    WHIRL_RATE,
)
from rig.physics.engines.split.memory import STEP_SHARE
from rig.physics.engines.split.radau import NODES, STAGES, interpolation
from rig.physics.engines.split.rigid import apply_impulse, axis_state, contact_mobility, make_plant, relative_motion
from rig.physics.engines.taylor.events import NO_EVENT
from rig.physics.engines.taylor.march import compare_inputs, covers, write_row
from rig.physics.engines.taylor.memory import (
    EAST,
    END_FRACTION,
    END_TICK,
    EVENT,
    FRACTION,
    INPUTS,
    NORTH,
    SLACK,
    SPAN,
    TICK,
)
from rig.physics.kernels import signals as S
from rig.physics.kernels.laws.contact import ROLLING, SMOOTHED, TOUCHING
from rig.physics.kernels.stage import kernel

_TURN_STEPS = (2, 3, 4, 6, 8, 12, 16, 24, MAX_PLACES)
"""Possible numbers of steps per turn."""
_MAX_TURN_S = 0.1
"""Longest turn of a whirl [s]; slower contacts do not whirl."""
_ORDER, _FEW_STEPS_ORDER = 4.5, 8.0
"""Exponent of the error estimate as a function of the step, measured in settled whirl; that with 2 or 3 steps."""
_MAX_COARSENED_ERROR = 0.3
"""Largest error estimate that permits fewer steps, over its limit."""
_ITERATION_TOLERANCE = 0.02
"""Relative change of the force at which iterations stop, over the tolerance."""
_MAX_STEP_ERROR = 2.0
"""Error estimate over its limit from which a step is repeated with a shorter length."""
_STATE_GAIN = 15.0
"""Scaled state error over the square of the relative force estimate, measured in settled whirl."""


@kernel
def _normal_and_rate(constants, y):
    """Return the contact normal and the approximate rate of its angle [rad/s]."""
    axis, w = axis_state(constants, y)
    motion = relative_motion(constants, axis, w, y)
    return motion.nx, motion.ny, (motion.sliding - constants.shaft.radius * w) / constants.contact.clearance


@kernel
def _overlaps_hammer(inputs, tick, fraction, ticks):
    """Return whether a hammer pulse overlaps a step."""
    return (
        inputs.hammer_end > inputs.hammer_start
        and inputs.hammer_end > tick
        and inputs.hammer_start < tick + fraction + ticks
    )


@kernel
def _set_places(memory, places, turns):
    """Set the number of steps per turn."""
    memory[PLACES], memory[PLACE], memory[TURNS], memory[TURN_ERROR] = places, 0.0, turns, 0.0
    memory[STEP_S] = 2.0 * math.pi / abs(memory[WHIRL_RATE]) / places
    memory[STALE_RESPONSES] = 1.0


@kernel
def _is_rolling(constants, memory):
    """Return whether the current series rolls, or creeps with smoothed friction."""
    smoothed = constants.levels.friction == SMOOTHED and constants.contact.friction > 0.0
    creeps = smoothed and memory[PHASE] == TOUCHING and memory[SLACK] == 0.0
    return memory[PHASE] == ROLLING or creeps


@kernel
def watch_for_rolling(constants, memory, y):
    """Wait one turn from the start of rolling in a series; y is its first state."""
    if not _is_rolling(constants, memory):
        memory[READY_TICK] = -1.0
    elif memory[READY_TICK] < 0.0:
        _delay_entry(constants, memory, y, memory[TICK])


@kernel
def _delay_entry(constants, memory, y, tick):
    """Set the tick from which collocation may start: one whirl turn after a state."""
    rate = abs(_normal_and_rate(constants, y)[2])
    turn_s = 2.0 * math.pi / max(rate, 2.0 * math.pi / _MAX_TURN_S)
    memory[READY_TICK] = tick + math.ceil(turn_s / memory[INPUTS])


@kernel
def may_roll(constants, memory):
    """Return whether collocation may replace the current series at its end."""
    return (
        memory[SPAN] >= 0.0
        and _is_rolling(constants, memory)
        and memory[EVENT] == NO_EVENT
        and 0.0 <= memory[READY_TICK] <= memory[END_TICK]
        and memory[NORTH] == 0.0
        and memory[EAST] == 0.0
    )


@kernel
def _first_places(tolerance):
    """Return the initial number of steps per turn, from twelve at a tolerance of 0.01; failing steps increase it."""
    for places in _TURN_STEPS:
        if places >= 12.0 * (0.01 / tolerance) ** (0.5 / _ORDER):
            return float(places)
    return float(MAX_PLACES)


@kernel
def _enter(constants, inputs, memory, rolling, dy, out, y):
    """Prepare collocation from the state y at the end of a series; return whether it can be tried."""
    nx, ny, rate = _normal_and_rate(constants, y)
    if not abs(rate) > 2.0 * math.pi / _MAX_TURN_S:
        _delay_entry(constants, memory, y, memory[END_TICK])
        return False
    tick, phase = int(memory[END_TICK]), int(memory[PHASE])
    rates(constants, inputs, tick, memory[END_FRACTION], memory[ONSET], phase, True, y, dy, out)
    stiffness, damping_x, damping_y, gain = linear_coefficients(constants, inputs)
    ax = dy[S.BETA_RATE] + stiffness * y[S.BETA] + damping_x * y[S.BETA_RATE]
    ay = -(dy[S.GAMMA_RATE] + stiffness * y[S.GAMMA] + damping_y * y[S.GAMMA_RATE])
    last = memory[LAST_UNKNOWNS : LAST_UNKNOWNS + N_UNKNOWNS]
    last[0], last[1] = -out[S.NORMAL_FORCE], -out[S.FRICTION_FORCE]
    last[2], last[3] = ax * nx + ay * ny, ay * nx - ax * ny
    last[4] = dy[S.THETA_RATE] + gain * y[S.THETA_RATE]
    last[5] = out[S.PENETRATION]
    memory[WHIRL_RATE] = rate
    _set_places(memory, _first_places(memory[TOLERANCE] / STEP_SHARE), 0.0)
    fill(rolling.Y[STAGES], y)
    return True


@kernel
def _turn_unknowns(m, cosine, sine):
    """Rotate force and accelerations by an angle."""
    for p in range(0, 4, 2):
        for i in range(STAGES):
            x, y = m[FX + p * STAGES + i], m[FX + (p + 1) * STAGES + i]
            m[FX + p * STAGES + i], m[FX + (p + 1) * STAGES + i] = cosine * x - sine * y, sine * x + cosine * y


@kernel
def _predict(m, rolling, nx, ny):
    """Predict the unknowns from the last turns at this place, or else from those of the last node, rotated."""
    place, turns = int(m[PLACE]), m[TURNS]
    first, second, third = rolling.history[0, place], rolling.history[1, place], rolling.history[2, place]
    if turns == 0.0:
        for i in range(STAGES):
            angle = m[WHIRL_RATE] * m[STEP_S] * NODES[i]
            c, s = math.cos(angle), math.sin(angle)
            for p in range(0, 4, 2):
                x, y = m[LAST_UNKNOWNS + p], m[LAST_UNKNOWNS + p + 1]
                m[FX + p * STAGES + i], m[FX + (p + 1) * STAGES + i] = c * x - s * y, s * x + c * y
            m[FX + 4 * STAGES + i], m[FX + 5 * STAGES + i] = m[LAST_UNKNOWNS + 4], m[LAST_UNKNOWNS + 5]
    else:
        one, two, three = 1.0, 0.0, 0.0
        if turns == 2.0:
            one, two = 2.0, -1.0
        elif turns > 2.0:
            one, two, three = 3.0, -3.0, 1.0
        for p in range(N_UNKNOWNS):
            for i in range(STAGES):
                m[FX + p * STAGES + i] = one * first[p, i] + two * second[p, i] + three * third[p, i]
    _turn_unknowns(m, nx, ny)


@kernel
def _store_unknowns(m, rolling, nx, ny):
    """Store the unknowns of a step relative to the contact normal at its start, and those of its last node."""
    place, last = int(m[PLACE]), STAGES - 1
    _turn_unknowns(m, nx, -ny)
    first, second, third = rolling.history[0, place], rolling.history[1, place], rolling.history[2, place]
    for p in range(N_UNKNOWNS):
        for i in range(STAGES):
            third[p, i], second[p, i], first[p, i] = second[p, i], first[p, i], m[FX + p * STAGES + i]
    # Rotate from the normal at the start to that at the end.
    Fx, Fy = m[FX + last], m[FX + STAGES + last]
    Fn, Ft = m[FN + last], m[FT + last]
    size = Fn * Fn + Ft * Ft
    c, s = -(Fx * Fn + Fy * Ft) / size, (Fx * Ft - Fy * Fn) / size
    for p in range(0, 4, 2):
        x, y = m[FX + p * STAGES + last], m[FX + (p + 1) * STAGES + last]
        m[LAST_UNKNOWNS + p], m[LAST_UNKNOWNS + p + 1] = c * x + s * y, -s * x + c * y
    m[LAST_UNKNOWNS + 4], m[LAST_UNKNOWNS + 5] = m[FX + 4 * STAGES + last], m[FX + 5 * STAGES + last]


@kernel
def _coarsen(memory, rolling, places):
    """Reduce the number of steps per turn; the polynomials of the last turn predict the unknowns."""
    before, h = int(memory[PLACES]), memory[STEP_S]
    old = rolling.history[1]
    for place in range(before):
        for p in range(N_UNKNOWNS):
            fill(old[place, p], rolling.history[0, place, p])
    # Time of the contact's actual turn.
    _set_places(memory, float(places), 1.0)
    ratio, rate, weights = before / places, memory[WHIRL_RATE], np.empty(STAGES + 1)
    for place in range(places):
        for i in range(STAGES):
            at = (place + NODES[i]) * ratio
            source = min(int(at), before - 1)
            interpolation(False, at - source, weights)
            angle = rate * h * (source - place * ratio)
            c, s = math.cos(angle), math.sin(angle)
            for p in range(N_UNKNOWNS):
                total = 0.0
                for j in range(STAGES):
                    total += weights[j + 1] * old[source, p, j]
                rolling.history[0, place, p, i] = total
            for p in range(0, 4, 2):
                x, y = rolling.history[0, place, p, i], rolling.history[0, place, p + 1, i]
                rolling.history[0, place, p, i], rolling.history[0, place, p + 1, i] = c * x - s * y, s * x + c * y


@kernel
def _choose_places(memory, rolling):
    """Choose the number of steps of the next turn by the error estimate; return False if it exceeds the maximum."""
    places, worst, wanted = memory[PLACES], memory[TURN_ERROR], memory[PLACES]
    if worst > 1.0:
        return _refine(memory)
    for fewer in _TURN_STEPS:
        order = _ORDER if fewer > 3 else _FEW_STEPS_ORDER
        if 0.5 * places <= fewer < wanted and worst * (places / fewer) ** order < _MAX_COARSENED_ERROR:
            wanted = fewer
    if wanted < places:
        _coarsen(memory, rolling, int(wanted))
    memory[TURN_ERROR] = 0.0
    return True


@kernel
def _refine(memory):
    """Increase the number of steps per turn; return False at the maximum."""
    for places in _TURN_STEPS:
        if places > memory[PLACES]:
            _set_places(memory, float(places), 0.0)
            return True
    return False


@kernel
def _begin_step(constants, memory, rolling):
    """Start the next step at the last node; return False if its turn would need too many steps."""
    Y = rolling.Y
    fill(Y[0], Y[STAGES])
    memory[TICK], memory[FRACTION] = memory[END_TICK], memory[END_FRACTION]
    if memory[PLACE] > 0.0:
        return True
    nx, ny, _ = _normal_and_rate(constants, Y[0])
    if memory[TURNS] > 0.0:
        # Rate of the contact's actual turn.
        lead = math.atan2(ny * memory[NORMAL_X] - nx * memory[NORMAL_Y], nx * memory[NORMAL_X] + ny * memory[NORMAL_Y])
        turn_s = memory[PLACES] * memory[STEP_S]
        memory[WHIRL_RATE] = (math.copysign(2.0 * math.pi, memory[WHIRL_RATE]) + lead) / turn_s
        if not _choose_places(memory, rolling):
            return False
    memory[NORMAL_X], memory[NORMAL_Y] = nx, ny
    return True


@kernel
def _take_step(constants, inputs, memory, rolling):
    """Take the step that was started.

    Returns:
        False for a rejected step: a series has to continue from its start, unless the responses are stale.
    """
    tolerance, tick_s = memory[TOLERANCE] / STEP_SHARE, memory[INPUTS]
    nx, ny, _ = _normal_and_rate(constants, rolling.Y[0])
    goal = min(max(_ITERATION_TOLERANCE * tolerance, 1e-10), 1e-5)
    limit = math.sqrt(tolerance / _STATE_GAIN)
    while True:
        h = memory[STEP_S]
        if memory[STALE_RESPONSES] > 0.0 or _overlaps_hammer(inputs, memory[TICK], memory[FRACTION], h / tick_s):
            return False
        _predict(memory, rolling, nx, ny)
        place, has_inverse = int(memory[PLACE]), memory[TURNS] > 0.0
        iterations = solve_step(constants, inputs, memory, rolling, h, place, has_inverse, goal)
        memory[EVALUATIONS] += STAGES * max(iterations, 1)
        if iterations > 0:
            force, relative = estimate(memory)
            # Rows between the nodes hold the interpolated force.
            worst = max(relative / limit, force / (tolerance * max(memory[PEAK_FORCE], FORCE_FLOOR_N)))
            if worst < _MAX_STEP_ERROR:
                break
        if not _refine(memory):
            return False
        memory[NORMAL_X], memory[NORMAL_Y] = nx, ny
    if memory[PLACES] == MAX_PLACES and worst > 1.0:
        return False
    write_nodes(constants, inputs, memory, h)
    if not keeps_rolling(constants, memory):
        return False
    memory[TURN_ERROR] = max(memory[TURN_ERROR], worst)
    memory[START_FORCE], memory[START_FRICTION] = -memory[LAST_UNKNOWNS], -memory[LAST_UNKNOWNS + 1]
    _store_unknowns(memory, rolling, nx, ny)
    _finish_step(memory, h)
    return True


@kernel
def _finish_step(memory, h):
    """Count a step and advance to the next place."""
    tick_s, at = memory[INPUTS], 0.0
    for i in range(STAGES):
        update_peak_force(memory, memory[FN + i], (NODES[i] - at) * h / tick_s)
        at = NODES[i]
    memory[STEPS] += 1.0
    memory[CONTACT_STEPS] += 1.0
    memory[ROLLING_STEPS] += 1.0
    memory[ROLLED_S] += h
    memory[PLACE] += 1.0
    if memory[PLACE] == memory[PLACES]:
        memory[PLACE], memory[TURNS] = 0.0, min(memory[TURNS] + 1.0, 3.0)
    ticks = memory[FRACTION] + h / tick_s
    whole = math.floor(ticks)
    memory[END_TICK], memory[END_FRACTION], memory[SPAN] = memory[TICK] + whole, ticks - whole, h


@kernel
def _match_force(constants, memory, y, force, friction):
    """Move the shaft in the state y to the position at which the laws give the interpolated forces.

    The interpolated motion has errors of a hundredth of a micrometre between nodes, which the laws would convert to
    newtons.
    """
    contact, shaft = constants.contact, constants.shaft
    axis, w = axis_state(constants, y)
    motion = relative_motion(constants, axis, w, y)
    gap = motion.distance - contact.clearance
    ratio = 1.0 + contact.damping_factor / memory[ONSET] * motion.rate
    load = force - contact.viscous_damping * motion.rate
    closer = (gap - root_of_law(load / (contact.stiffness * ratio), gap, contact.exponent)) / shaft.arm_ring
    y[S.BETA] -= closer * motion.nx
    y[S.GAMMA] += closer * motion.ny
    if constants.levels.friction == SMOOTHED:
        slip = slip_of_law(contact, SMOOTHED, friction / (contact.friction * force))
        faster = (slip - motion.sliding) / shaft.arm_ring
        y[S.BETA_RATE] -= faster * motion.ny
        y[S.GAMMA_RATE] -= faster * motion.nx


@kernel
def _write_rows(constants, inputs, memory, Y, dy, out, y, grid, row, rows):
    """Write rows within the current step, as `rig.physics.engines.taylor.march.write_rows`."""
    first, every, end = grid
    now, weights = min(first + row * every, end), np.empty(STAGES + 1)
    while covers(memory, now, 0.0):
        part = ((now - memory[TICK]) - memory[FRACTION]) * memory[INPUTS] / memory[SPAN]
        interpolation(True, min(max(part, 0.0), 1.0), weights)
        force, friction = weights[0] * memory[START_FORCE], weights[0] * memory[START_FRICTION]
        for i in range(STAGES):
            force += weights[i + 1] * memory[FN + i]
            friction += weights[i + 1] * memory[FT + i]
        for k in range(S.N_VECTOR):
            y[k] = 0.0
            for i in range(STAGES + 1):
                y[k] += weights[i] * Y[i, k]
        _match_force(constants, memory, y, force, friction)
        write_row(constants, inputs, memory, now, dy, out, y, row, rows)
        row += 1
        if now == end:
            break
        now = min(first + row * every, end)
    return row


@kernel
def _leave(constants, inputs, memory, y):
    """Leave collocation at the state y, from which a series has to continue.

    A series keeps its initial sliding speed. An impulse removes the sliding speed left by Newton's method and
    interpolation.
    """
    memory[PLACES], memory[SPAN] = 0.0, -1.0
    if constants.levels.friction == SMOOTHED:
        return
    plant, (axis, w) = make_plant(constants, inputs), axis_state(constants, y)
    motion = relative_motion(constants, axis, w, y)
    mobility = contact_mobility(plant, constants.levels.euler, axis, motion.nx, motion.ny)
    apply_impulse(constants, inputs, plant, y, axis, w, motion, mobility, 0.0, motion.sliding / mobility.tt)


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def _roll(constants, inputs, y, memory, grid, row, rows, started):
    """Advance as `roll` does, until the responses are stale.

    Args:
        constants: Constants as a record.
        inputs: Inputs as a record.
        y: State and integrals, in and out, shape (N_VECTOR,).
        memory: Memory, in and out, shape (MEMORY,).
        grid: Tick of the first row, ticks per row, tick at the end.
        row: Number of the next row.
        rows: Rows, out.
        started: Whether the current step was started before the responses were computed.

    Returns:
        Number of the next row.
    """
    constants, inputs = constants[0], inputs[0]
    rolling, dy, out = view_rolling(memory), np.empty(S.N_VECTOR), np.full(S.N_OBSERVED, np.nan)
    if not compare_inputs(inputs, memory):
        _leave(constants, inputs, memory, y)
        return row
    if memory[PLACES] == 0.0 and not _enter(constants, inputs, memory, rolling, dy, out, y):
        return row
    first, every, end = grid
    count = (end - first + every - 1) // every
    while True:
        if memory[SPAN] >= 0.0 and not started:
            row = _write_rows(constants, inputs, memory, rolling.Y, dy, out, y, grid, row, rows)
            if row > count:
                return row
        advanced = (started or _begin_step(constants, memory, rolling)) and _take_step(
            constants, inputs, memory, rolling
        )
        started = False
        if not advanced:
            if memory[STALE_RESPONSES] == 0.0:
                fill(y, rolling.Y[0])
                _leave(constants, inputs, memory, y)
                _delay_entry(constants, memory, y, memory[END_TICK])
            return row


def roll(constants, inputs, y, memory, grid, row, rows):
    """Advance by collocation, from the current step or the state y at the end of a series.

    Returns:
        Number of the next row: beyond the last row, unless a series has to continue from the state y.
    """
    row = _roll(constants, inputs, y, memory, grid, row, rows, False)
    while memory[STALE_RESPONSES] > 0.0:
        set_step(constants, inputs, memory)
        row = _roll(constants, inputs, y, memory, grid, row, rows, True)
    return row
