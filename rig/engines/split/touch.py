"""A contact that lasts, in a step of `rig.engines.split`: its impulse in a kick, and what that does to the houses."""

from __future__ import annotations

from rig.engines.memory import CONTACT_STEPS, PEAK_FORCE
from rig.engines.split.impulse import (
    Impulse,
    compliant_push,
    flow_acceleration,
    friction_impulse,
    law_at,
    mobility_of,
)
from rig.engines.split.inner_motion import Houses, inlined
from rig.engines.split.levels import NONE, bears
from rig.engines.split.state import Touch
from rig.kernels import signals as S
from rig.kernels.contact import BACKWARD, FORWARD, ROLLING


@inlined
def no_impulse():
    """Of a step without contact."""
    return Impulse(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@inlined
def kick_contact(constants, call, memory, ledger, axis, houses, motion, spin, touch, step):
    """The contact's impulse over a kick, booked in memory and ledger.

    Args:
        constants: Of the model.
        call: What stays through the call.
        memory: Of the engine.
        ledger: Integrals since the last row, shape (N_VECTOR,).
        axis: Of the shaft.
        houses: Of the stator.
        motion: Of the shaft against the ring, halfway through what is smooth.
        spin: w [rad/s].
        touch: As the last kick left it.
        step: At hand.

    Returns:
        Impulse, and the contact after it. Where no level is wanted any more nothing is booked: the step is not one for
        kicks.
    """
    plant, h = call.plant, step.h
    contact, house = constants.contact, constants.house
    inner = constants.levels.inner_house
    nx, ny, per_distance, depth, rate, lateral = motion
    w = mobility_of(plant, constants.levels.euler, axis, nx, ny)
    law = law_at(contact, depth, touch.factor)
    flow_rate = flow_acceleration(constants, plant, axis, houses, motion)
    push = compliant_push(law, w, rate, flow_rate, h)
    jn, shift = push.jn, push.shift

    # Rolling holds along the arc, not at the corners of the polygon that the kicks make of it.
    sliding = lateral + constants.shaft.radius * spin + lateral * (1.0 / 12.0) * h * jn * w.nn * per_distance
    jt, wanted_jt = friction_impulse(w, jn, plant.friction * jn, sliding, touch.slid)
    if jn > 0.0:
        jn = max(0.0, jn - push.back * jt)
    phase = ROLLING
    if jt != wanted_jt:
        phase = FORWARD if wanted_jt > 0.0 else BACKWARD
    if plant.friction == 0.0:
        phase = touch.phase
    slid = sliding - w.tt * jt - w.nt * jn
    rate_mean = rate - 0.5 * (w.nn * jn + w.nt * jt)
    if jn <= 0.0 or phase != touch.phase or not bears(call, touch.wanted, h, law.slope * w.nn, push.taken):
        return no_impulse(), Touch(touch.phase, touch.slid, NONE, touch.factor)
    jx, jy = -jn * nx + jt * ny, -jn * ny - jt * nx
    force_x, force_y = jx, jy
    loss = (jn - push.held) * rate_mean
    if shift != 0.0:
        lateral_jump = shift * lateral * per_distance
        jx -= lateral_jump * ny
        jy += lateral_jump * nx
        # It comes after friction's clamp: the next target makes up for it, and takes it for no flow's.
        slid -= (w.tt - plant.spin_mobility) * lateral_jump
        springs = 0.0
        if inner:
            beam = house.inner_beam_stiffness * (houses.x0 - houses.x2)
            pair = house.pair_stiffness_vertical * (houses.y0 - houses.y2)
            springs = shift * plant.per_inner * (beam * nx + pair * ny)
            ledger[S.HOUSE_LOSS] += springs
        loss += law.elastic * w.nn * shift - lateral_jump * lateral - springs
    ledger[S.CONTACT_LOSS] += loss
    ledger[S.FRICTION_LOSS] += jt * 0.5 * (sliding + slid)
    ledger[S.CONTACT_IMPULSE] += jn
    memory[CONTACT_STEPS] += 1.0

    memory[PEAK_FORCE] = max(memory[PEAK_FORCE], law.elastic + law.damping * rate_mean)
    cx, cy = force_x * step.per_h, force_y * step.per_h
    growth, turn = law.relative * rate_mean, lateral * per_distance
    flow_rate *= law.damping
    dcx, dcy = growth * cx - turn * cy - flow_rate * nx, growth * cy + turn * cx - flow_rate * ny
    after = Touch(phase, slid, touch.wanted, touch.factor)
    return Impulse(jx, jy, jt, shift * nx, shift * ny, cx, cy, dcx, dcy), after


@inlined
def _loose(displacement, stiffness, preload):
    """What a pair of transducers pushes less than its linear spring, once one has lost its preload [N]."""
    change = 0.5 * stiffness * displacement
    if abs(change) <= preload:
        return 0.0
    return 2.0 * change - (max(0.0, preload + change) - max(0.0, preload - change))


@inlined
def house_kick(constants, plant, ledger, houses, impulse, h):
    """The houses after a kick of the contact's impulse on the inner one, and of transducers that have come loose.

    Returns:
        Houses, and whether a transducer is loose or nearly so.
    """
    house = constants.house
    x0, x1, x2, x3, y0, y1, y2, y3 = houses
    per_inner, per_outer = plant.per_inner, plant.per_outer
    fx, fy, work = -impulse.jx, -impulse.jy, 0.0
    x0 += impulse.shift_x * per_inner
    y0 += impulse.shift_y * per_inner
    rise = y0 - y2
    if abs(rise) > plant.loose_v:
        slack = h * _loose(rise, house.pair_stiffness_vertical, house.preload)
        fy += slack
        work -= slack * (y3 - 0.5 * slack * per_outer)
        y3 -= slack * per_outer
    if abs(x2) > plant.loose_h:
        slack = h * _loose(x2, house.pair_stiffness_horizontal, house.preload)
        work += slack * (x3 + 0.5 * slack * per_outer)
        x3 += slack * per_outer
    gx, gy = fx * per_inner, fy * per_inner
    ledger[S.HOUSE_LOSS] += work + fx * (x1 + 0.5 * gx) + fy * (y1 + 0.5 * gy)
    near = abs(rise) > 0.8 * plant.loose_v or abs(x2) > 0.8 * plant.loose_h
    return Houses(x0, x1 + gx, x2, x3, y0, y1 + gy, y2, y3), near
