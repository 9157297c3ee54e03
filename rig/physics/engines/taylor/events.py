"""Events of the series: functions with a zero at the event, and the phases that follow."""

from __future__ import annotations

import math

from rig.physics.engines.common.events import latch_onset, sliding_phase
from rig.physics.engines.common.memory import CLAMPS, EVALUATIONS, ONSET, PHASE
from rig.physics.engines.common.method import fill, rates
from rig.physics.engines.tape.columns import EVENTS, FORCE, ROOT
from rig.physics.engines.taylor.memory import EAST, EVENT, FRACTION, NORTH, SLACK, SPAN, TICK, ZERO_COEFFICIENTS
from rig.physics.engines.taylor.polynomial import first_zero
from rig.physics.kernels import signals as S
from rig.physics.kernels.dynamics import unit_response
from rig.physics.kernels.frames.geometry import State, compute_eccentricity, compute_pose
from rig.physics.kernels.laws.contact import (
    BACKWARD,
    EXACT,
    FLIGHT,
    FORWARD,
    NO_FRICTION,
    ROLLING,
    SMOOTHED,
    TOUCHING,
    ring_force,
)
from rig.physics.kernels.stage import kernel

NO_EVENT, FIRST, _SECOND_EVENT, _THIRD_EVENT, _HOUSE_NS, _HOUSE_EW = range(6)
"""Event that ends a series: none, or a corner of the hammer pulse; a zero of one of three event functions; a
transducer."""

_FRICTIONLESS_S = 1e-9
"""Time [s] after an onset and before a lift-off in which a contact that does not slide has no friction, as rolling
needs a normal force. A depth would not serve, as the static depth of a stiff contact may be smaller. The time is far
shorter than any contact, because the series of a rolling one (in time) shrink toward both."""
_REST_RATIO = 1e-9
"""Sliding speed over penetration speed below which a new contact does not slide."""
_MIN_ONSET_SPEED = 1e-6
"""Impact speed [m/s] below which the contact starts at the minimum depth."""
_MIN_DEPTH_RATIO = 1e-11
"""Minimum depth over the clearance: at 0, dt = s dtau would stop."""
_MIN_RESOLVED_DEPTH_RATIO = 1e-10
"""Minimum depth over the clearance that a difference of distances resolves."""

_ROUNDING_M = 1e-20
"""Rounding error of a housing's displacement [m]."""


@kernel
def _preload_tolerance(stiffness, preload):
    """Return the force tolerance [N] for loss of preload, common to state and series."""
    return max(1e-12 * preload, _ROUNDING_M * stiffness)


@kernel
def _lost_transducer(displacement, rate, stiffness, preload):
    """Return the transducer of a pair that has lost its preload or is about to: 0, or the sign of the displacement."""
    change = 0.5 * stiffness * displacement
    sign = 1.0 if change > 0.0 else -1.0
    over = sign * change - preload
    edge = _preload_tolerance(stiffness, preload)
    return sign if over > edge or (over > -edge and sign * rate > 0.0) else 0.0


@kernel
def ring_at(constants, inputs, x):
    """Return the ring's motion (penetration, its rate, sliding speed) without friction, and the friction response."""
    state = State(x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7], x[8], x[9], x[10], x[11], x[12], x[13])
    pose = compute_pose(constants.levels, state)
    e = compute_eccentricity(constants, state, pose)
    surface = constants.shaft.radius * pose.w
    ring = ring_force(e.ex, e.ey, e.vx, e.vy, surface, 1.0, NO_FRICTION, FLIGHT, constants.contact)
    return ring, unit_response(constants, inputs, pose, ring.nx, ring.ny)


@kernel
def _holds_at_rest(constants):
    """Return whether friction may keep the sliding speed at 0."""
    return constants.levels.friction == EXACT and constants.contact.friction > 0.0


@kernel
def set_events(constants, memory, Y):
    """Write the event functions, which fall through 0 at an event, from the series' columns."""
    contact, phase = constants.contact, int(memory[PHASE])
    first, second, third, order = Y[:, EVENTS], Y[:, EVENTS + 1], Y[:, EVENTS + 2], len(Y) - 1
    if phase == FLIGHT:
        for k in range(order):
            first[k] = -first[k]
            second[k] = third[k] = 0.0
        first[0] += contact.clearance * contact.clearance
        second[0] = third[0] = 1.0
        return
    if phase == ROLLING:
        for k in range(order):
            # Depth at `_FRICTIONLESS_S` ahead.
            first[k] += _FRICTIONLESS_S * (k + 1.0) * first[k + 1]
            friction, limit = second[k], contact.friction * Y[k, FORCE]
            second[k], third[k] = limit - friction, limit + friction
        return
    speed, sign = second[0], 0.0
    if phase == TOUCHING:
        if constants.levels.friction == SMOOTHED and abs(speed) > 4.0 * contact.smoothing_speed:
            sign = math.copysign(1.0, speed)
    elif _holds_at_rest(constants):
        sign = 1.0 if phase == FORWARD else -1.0
    away = memory[SLACK] != 0.0
    for k in range(order):
        first[k] = Y[k, ROOT]
        second[k] = sign * second[k]
        if away:
            third[k] = -third[k]
    first[order] = Y[order, ROOT]
    if away or sign == 0.0:
        second[:] = 0.0
        second[0] = 1.0
    elif phase == TOUCHING:
        # At high speed tanh is 1 within rounding, and no coefficient shows a later reversal: stop half-way.
        second[0] = 0.5 * abs(speed)
    if phase == TOUCHING and _holds_at_rest(constants) and Y[1, ROOT] > 0.0:
        # While approaching, frictionless up to the depth of `_FRICTIONLESS_S`: s' = delta'/2.
        for k in range(order + 1):
            second[k] = -Y[k, ROOT]
        least = 2.0 * math.sqrt(_MIN_DEPTH_RATIO * contact.clearance)  # slow contacts start at half of it
        second[0] += max(least, math.sqrt(_FRICTIONLESS_S * 2.0 * Y[1, ROOT]))


@kernel
def _resolve_rest(constants, inputs, memory, x, y, dy, out):
    """Set the phase of a contact with zero sliding speed: rolling if possible, else sliding in the force direction."""
    fill(y, x)
    # Same argument types as the call in `advance`: other types would be compiled separately.
    memory[PHASE] = ROLLING
    tick, phase = int(memory[TICK]), int(memory[PHASE])
    rates(constants, inputs, tick, memory[FRACTION], memory[ONSET], phase, True, y, dy, out)
    memory[EVALUATIONS] += 1.0
    needed = out[S.FRICTION_FORCE]
    if abs(needed) > constants.contact.friction * out[S.NORMAL_FORCE]:
        memory[PHASE] = FORWARD if needed > 0.0 else BACKWARD
        memory[ZERO_COEFFICIENTS + 1] = 1.0


@kernel
def change_phase(constants, inputs, memory, x, y, dy, out):
    """Set the phase after the event that ends a series, at its state x."""
    event, phase = int(memory[EVENT]), int(memory[PHASE])
    contact = constants.contact
    memory[EVENT] = NO_EVENT
    known = memory[ZERO_COEFFICIENTS : ZERO_COEFFICIENTS + 3]
    for i in range(3):
        known[i] = 0.0
    ring, _ = ring_at(constants, inputs, x)
    depth, rate, sliding = ring.delta, ring.rate, ring.sliding
    slides = sliding_phase(constants, sliding)
    if phase == FLIGHT:
        if event == FIRST:
            latch_onset(memory, rate, contact)
            memory[PHASE] = slides if abs(sliding) > _REST_RATIO * rate else TOUCHING
            x[ROOT] = 0.0
            known[0] = 1.0
            if rate < _MIN_ONSET_SPEED or not (contact.exponent == 1.5 or contact.exponent == 1.0):
                x[ROOT] = math.sqrt(_MIN_DEPTH_RATIO * contact.clearance)
                known[0] = 0.0
    elif memory[SLACK] != 0.0:
        if event == FIRST:
            memory[PHASE], memory[SLACK] = FLIGHT, 0.0
            known[0] = 1.0
        elif event == _THIRD_EVENT:
            memory[PHASE], memory[SLACK] = slides, 0.0
            known[2] = 1.0
    elif event == FIRST:
        if phase == ROLLING:
            memory[PHASE] = TOUCHING
        else:
            memory[PHASE] = FLIGHT
            known[0] = 1.0
    elif phase == ROLLING:
        if event != NO_EVENT and event <= _THIRD_EVENT:
            memory[PHASE] = FORWARD if event == _SECOND_EVENT else BACKWARD
            known[1] = 2.0
    elif event == _THIRD_EVENT:
        memory[SLACK] = 1.0
        memory[CLAMPS] += 1.0
        known[2] = 1.0
    elif event == _SECOND_EVENT and _holds_at_rest(constants):
        if phase == TOUCHING and abs(sliding) > _REST_RATIO * abs(rate):
            memory[PHASE] = slides
        else:
            _resolve_rest(constants, inputs, memory, x, y, dy, out)
    # Reset the root from the depth where that is resolved, to prevent drift.
    slowed = memory[PHASE] != FLIGHT and memory[PHASE] != ROLLING
    if slowed and (depth > _MIN_RESOLVED_DEPTH_RATIO * contact.clearance or phase == ROLLING or memory[SPAN] < 0.0):
        x[ROOT] = math.sqrt(max(depth, _MIN_DEPTH_RATIO * contact.clearance))
    house = constants.house
    memory[NORTH] = memory[EAST] = 0.0
    if constants.levels.inner_house:
        memory[NORTH] = _lost_transducer(
            x[S.Y_IH] - x[S.Y_OH], x[S.VY_IH] - x[S.VY_OH], house.pair_stiffness_vertical, house.preload
        )
    if constants.levels.outer_house:
        memory[EAST] = _lost_transducer(x[S.X_OH], x[S.VX_OH], house.pair_stiffness_horizontal, house.preload)


@kernel
def preload_end(constants, memory, Y, h):
    """Return the position within h at which a transducer loses or regains its preload, and its pair."""
    house = constants.house
    nearest, which = math.inf, NO_EVENT
    for pair in range(2):
        if not (constants.levels.inner_house if pair == 0 else constants.levels.outer_house):
            continue
        stiffness = house.pair_stiffness_vertical if pair == 0 else house.pair_stiffness_horizontal
        lost = memory[NORTH + pair]
        # Bounds on the displacement by its coefficients.
        middle, swing, power = 0.0, 0.0, 1.0
        for k in range(len(Y)):
            value = Y[k, S.Y_IH] - Y[k, S.Y_OH] if pair == 0 else Y[k, S.X_OH]
            if k == 0:
                middle = value
            else:
                power *= h
                swing += abs(value * power)
        limit = 2.0 * house.preload / stiffness
        if lost == 0.0 and abs(middle) + swing < limit:
            continue
        for side in range(2):
            sign = lost if lost != 0.0 else (1.0 if side == 0 else -1.0)
            way = 1.0 if lost != 0.0 else -1.0
            # Above 0 while nothing changes; stored in the last column, which events no longer need.
            for k in range(len(Y)):
                value = Y[k, S.Y_IH] - Y[k, S.Y_OH] if pair == 0 else Y[k, S.X_OH]
                Y[k, EVENTS + 2] = way * sign * value / limit
            Y[0, EVENTS + 2] -= way
            shift = 1 if abs(Y[0, EVENTS + 2]) * house.preload < _preload_tolerance(stiffness, house.preload) else 0
            zero = first_zero(Y, EVENTS + 2, shift, h)
            if zero < nearest and not (shift == 1 and zero == 0.0):
                nearest, which = zero, _HOUSE_NS + pair
            if lost != 0.0:
                break
    return nearest, which
