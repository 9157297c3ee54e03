"""Splitting: the exact flow of everything linear, one kick a step for everything else; order 2, cheap, and bounded.

A step is half a flow, a kick, half a flow. The flow solves shaft on linear magnets, drive and both houses exactly:
the houses ring at up to 1.6 kHz and cost no accuracy. The kick holds the contact, the magnets' hardening, gravity,
unbalance, the hammer and the turning of the axis.

State inside: the direction of the axis, u = (sin b, -sin G cos b), and its rate p. In these, a point at arm l is l u,
the kinematics have no sines, and with S the sum of arm times lateral force

    Ixx u'' = S - (S.u) u - Ixx |u'|^2 u + Izz w (u x u')

Errors of second order of such a step are two commutators of flow A and kick B. [B,[A,B]] goes into the kick: with the
contact's force f on the relative motion at the ring and the flow's acceleration a of it, that is
2 (f.grad) f + (v.grad f_v) f - f_v (v.grad f + f_v a) on the speed and -f_v f on the position, h^3/24 of each. For an
undamped contact it is Takahashi and Imada's F* = F (1 - h^2/12 F' w_n) (J. Phys. Soc. Jpn. 53 (1984) 3765); what comes
next in h^2 F' w_n is chosen for a lasting contact to keep its true depth. [A,[A,B]] is a change of coordinates by
h^2/24 [A,B] (the processing of Blanes, Casas and Murua, SIAM J. Sci. Comput. 27 (2006) 1817): it vanishes out of
contact, so an impact returns the right speeds; at the end of a step, where the next one is of another length, and for
the rows it is carried out. Where a contact begins and ends, its force goes as t^n between two kicks; what the sum
misses there is Hurwitz' zeta(-n, q). Left out of both commutators: the houses' damping, and friction where it rolls.

The normal impulse holds its damping in closed form. Coulomb's friction is a clamp on the tangential impulse: what
would bring the sliding speed to its target, held within mu times the normal impulse. The target is minus half of what
the flow changed since the last kick, so that the speed is 0 in the mean of a step and not at its end: with a target
of 0 the order is 1. Rolling is not processed, so order 2 is all there is.

Steps are powers of two of the grid's step, by rules on the state alone: long in flight as far as the gap cannot
close, short through impacts (they make small errors a thousand times larger), the grid's own in settled contact.

The houses' momentum ledger is the flow's own, so its residual is 0 by construction; the energy residual is not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from rig.engines.memory import (
    CLAMPS,
    CONTACT_STEPS,
    CONTACTS,
    EVALUATIONS,
    FLOORED,
    ONSET,
    OWN,
    PEAK_FORCE,
    PHASE,
    STEPS,
)
from rig.engines.peak import peak
from rig.engines.split.flow import (
    GRID,
    HALF,
    HOUSE_FLOW,
    LEVELS,
    PER_STEP,
    flow,
    house_flows,
    magnet_springs,
    shaft_flows,
)
from rig.engines.split.impulse import (
    Impulse,
    Law,
    Push,
    compliant_push,
    crossing,
    end_impulse,
    flow_swerve,
    friction_impulse,
    law_at,
    mobility_of,
    onset_error,
)
from rig.engines.split.inner_motion import (
    FAST,
    Axis,
    Houses,
    eccentricity,
    from_coordinates,
    geometry_of,
    house_energy,
    inlined,
    into_coordinates,
    motion_of,
    plant_of,
)
from rig.kernels import signals as S
from rig.kernels.contact import BACKWARD, FLIGHT, FORWARD, ROLLING
from rig.kernels.dynamics import evaluate
from rig.kernels.forces import drive_speed
from rig.kernels.magnet import magnet_force

ORDER = 2

_UX, _UY, _PX, _PY, _SPIN, _THETA = range(OWN, OWN + 6)
_X = OWN + 6  # inner displacement and rate, outer displacement and rate, horizontal
_Y = OWN + 10  # the same, vertical
_SLID, _DEPTH, _RATE, _AGO = range(OWN + 14, OWN + 18)
"""Sliding speed after the last kick, nan before the first of a contact; penetration, its rate and the time since the
last kick in flight."""
_BEFORE, _LAST, _BEFORE_SPAN, _LAST_STEP = OWN + 18, OWN + 19, OWN + 40, OWN + 41
"""Normal force at the last kick but one, and at the last [N]; time between both; length of the last's step [s]."""
_WANTED, _SETTLED, _BOUNCE = OWN + 20, OWN + 21, OWN + 22
_REST, _SPRING_X, _SPRING_Y = OWN + 23, OWN + 24, OWN + 25
"""Level asked for in contact, calm kicks in a row, mean rate of the gap in the last kick; rest of the shaft on its
magnets and the springs of its flow about it."""
_KICKED, _CONJUGATE, _KICK, _ENGAGED = OWN + 26, OWN + 27, OWN + 28, OWN + 36
"""Level of the last kick, -1 before the first; h^2/24 of the coordinates in use; the last kick (`Kick`); whether the
flow has the magnets."""
_COS, _SIN, _ANGLE = OWN + 37, OWN + 38, OWN + 39
_FLOWS = OWN + 42
_FLOWS_END = _FLOWS + HOUSE_FLOW * LEVELS
_LONGEST = GRID + 3
"""A flight covers at most 2**3 steps of the grid ..."""
_FLIGHT_S = 1.1e-3
"""... and lasts at most this long [s]."""
_BLOW = GRID - 3
"""Longest step in a blow of the hammer."""
_CALM = 2.5e-4
"""Speed of the gap [m/s] up to which the grid's own step is taken; half the step for every four times that."""
_ROUGH = 4.0
"""How many times (squared) a level's speed is exceeded before the step is halved."""
_DRIFT = 0.01
"""Weight of the gap's slow motion, squared, against its acceleration."""
_DAMPED = 0.3
"""Largest part of the gap's speed that the contact's damping takes in a step: the commutators are a series in it."""
_PATIENCE = 16
"""Calm kicks in a row before the step is doubled."""
_SLOP = 200.0
"""Depth that a rigid ring keeps in lasting contact, over the step squared [m/s^2]: a chord of the arc stays inside."""
_RETURN = 0.1
"""Part of a depth beyond it that is taken back in a step."""


class Kick(NamedTuple):
    """The last kick: accelerations of the axis, forces of the contact on the shaft, and their rates."""

    sx: float  # all that is smooth [1/s^2]
    sy: float
    dsx: float  # its rate [1/s^3]
    dsy: float
    cx: float  # contact [N]
    cy: float
    dcx: float  # its rate [N/s]
    dcy: float


@njit(cache=True, error_model="numpy", fastmath=FAST)
def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Prepare the memory for a state: the inner state, and the flows for this step."""
    memory[:] = 0.0
    memory[ONSET] = constants.contact.speed_floor
    axis, w, theta, houses = from_coordinates(constants, y)
    _keep(memory, axis, w, theta, houses)
    memory[_ANGLE] = theta
    memory[_COS] = math.cos(theta + constants.shaft.unbalance_phase)
    memory[_SIN] = math.sin(theta + constants.shaft.unbalance_phase)
    memory[_SLID] = np.nan
    memory[_WANTED] = GRID
    memory[_KICKED] = -1.0
    memory[_ENGAGED] = 1.0 if inputs.magnet_engaged else 0.0
    # The shaft's flow is linear about its rest on the magnets.
    memory[_REST], memory[_SPRING_X], memory[_SPRING_Y] = magnet_springs(constants)
    house_flows(constants, step_ticks * inputs.tick_s, memory[_FLOWS:_FLOWS_END].reshape(LEVELS, HOUSE_FLOW))


@inlined
def _keep(memory, axis, w, theta, houses):
    """Put the motion into the memory."""
    memory[_UX], memory[_UY], memory[_PX], memory[_PY] = axis
    memory[_SPIN], memory[_THETA] = w, theta
    memory[_X], memory[_X + 1], memory[_X + 2], memory[_X + 3] = houses.x0, houses.x1, houses.x2, houses.x3
    memory[_Y], memory[_Y + 1], memory[_Y + 2], memory[_Y + 3] = houses.y0, houses.y1, houses.y2, houses.y3


@inlined
def _kept(memory):
    """Axis, spin, spin angle and houses from the memory."""
    x, y = memory[_X : _X + 4], memory[_Y : _Y + 4]
    axis = Axis(memory[_UX], memory[_UY], memory[_PX], memory[_PY])
    return axis, memory[_SPIN], memory[_THETA], Houses(x[0], x[1], x[2], x[3], y[0], y[1], y[2], y[3])


@inlined
def _processed(s, plant, kick, axis, houses):
    """Axis and houses changed by -s [A,B]: with s = h^2/24 from the coordinates of a step h to the motion's own.

    A is the flow, B the kick, whose contact acts on the shaft at the ring and the other way on the inner house.
    """
    ux, uy, px, py = axis
    x0, x1, x2, x3, y0, y1, y2, y3 = houses
    arm, per_inner = plant.arm, plant.per_inner
    ux, px = ux - s * (kick.sx + arm * kick.cx), px + s * (kick.dsx + arm * kick.dcx)
    uy, py = uy - s * (kick.sy + arm * kick.cy), py + s * (kick.dsy + arm * kick.dcy)
    x0, x1 = x0 + s * per_inner * kick.cx, x1 - s * per_inner * kick.dcx
    y0, y1 = y0 + s * per_inner * kick.cy, y1 - s * per_inner * kick.dcy
    return Axis(ux, uy, px, py), Houses(x0, x1, x2, x3, y0, y1, y2, y3)


@inlined
def _continued(constants, plant, engaged, kick, axis, w, since):
    """The last kick as it would be a time `since` [s] later, with the rates of its smooth part in full."""
    magnet, lB = constants.magnet, constants.shaft.arm_magnet
    ux, uy, px, py = axis
    # Rates of the smooth accelerations: by the turning of the axis, by the flow's damping of them, ...
    pulled_x, pulled_y = -plant.spring_x * ux * plant.per_Ixx, -plant.spring_y * (uy - plant.rest) * plant.per_Ixx
    if not engaged:
        pulled_y = plant.weight * plant.per_Ixx
    mx = kick.dsx + plant.damper_x * plant.per_Ixx * kick.sx - plant.gyro * w * pulled_y
    my = kick.dsy + plant.damper_y * plant.per_Ixx * kick.sy + plant.gyro * w * pulled_x
    if engaged:
        # ... and of what the magnets have beyond their linear part.
        tau = 1e-5
        force_x, force_y, _ = magnet_force(lB * ux, lB * uy, magnet)
        ahead_x, ahead_y, _ = magnet_force(lB * (ux + tau * px), lB * (uy + tau * py), magnet)
        mx += (lB * (ahead_x - force_x) / tau + plant.spring_x * px) * plant.per_Ixx
        my += (lB * (ahead_y - force_y) / tau + plant.spring_y * py) * plant.per_Ixx
    return Kick(
        kick.sx + since * mx,
        kick.sy + since * my,
        mx,
        my,
        kick.cx + since * kick.dcx,
        kick.cy + since * kick.dcy,
        kick.dcx,
        kick.dcy,
    )


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _gap_speeds():
    """Largest speed of the gap that each level up to the grid's own takes [m/s], shape (GRID + 1,)."""
    speeds = np.empty(GRID + 1)
    for level in range(GRID + 1):
        speeds[level] = _CALM * 4.0 ** (GRID - level)
    return speeds


@inlined
def _flight_level(constants, plant, spans, gap_speeds, axis, houses, owed_s, struck):
    """Level of the next step in flight: as long as the gap cannot close, through its second half as well.

    Args:
        constants: Of the model.
        plant: Of this call.
        spans: Half a step of every level [s].
        gap_speeds: Largest speed of the gap that each level takes [m/s].
        axis: Of the shaft.
        houses: Of the stator.
        owed_s: Flow that the last kick still owes [s].
        struck: Whether the hammer strikes.
    """
    ex, ey = eccentricity(constants, axis, houses)
    free = constants.contact.clearance - math.sqrt(ex * ex + ey * ey)
    speed = constants.shaft.arm_ring * math.sqrt(axis.px * axis.px + axis.py * axis.py)
    ringing = 0.0
    if constants.levels.inner_house:
        ringing = math.sqrt(2.0 * house_energy(constants, houses))
        outer = constants.contact.gap_counts_outer * math.sqrt(plant.per_outer)
        speed += ringing * (math.sqrt(plant.per_inner) + outer)
    level = GRID
    while level > 0 and gap_speeds[level] < speed:
        level -= 1
    # Transducers that come loose are no part of the flow.
    highest = _BLOW if struck or ringing > plant.tightest else _LONGEST
    while level < highest:
        t = 2.0 * 2.0 * spans[level]
        # Gravity, magnets, unbalance and hammer together stay below 100 m/s^2 at the ring.
        if t > _FLIGHT_S or free < (owed_s + t) * (speed + 100.0 * (owed_s + t)):
            break
        level += 1
    return level


@inlined
def _contact_level(memory, wanted, rough, calm, end):
    """Level of the next step in contact.

    Args:
        memory: Of the engine.
        wanted: Level so far.
        rough: Whether it was too long.
        calm: Whether twice the step would do.
        end: End of this step, in parts of the grid's own from the row on.
    """
    if rough and wanted > 0:
        memory[_SETTLED] = 0.0
        return wanted - 1
    if not calm or wanted >= GRID:
        memory[_SETTLED] = 0.0
        return wanted
    memory[_SETTLED] += 1.0
    if memory[_SETTLED] >= _PATIENCE and end & ((2 << wanted) - 1) == 0:
        memory[_SETTLED] = 0.0
        return wanted + 1
    return wanted


@inlined
def _roughness(gap_speeds, wanted, slow, change, stiff, taken):
    """Whether a level is too long for how fast the gap moves or is made to move, and whether twice that would do.

    Args:
        gap_speeds: Largest speed of the gap that each level takes [m/s].
        wanted: The level.
        slow: Rate of the gap [m/s].
        change: Of that rate [m/s^2].
        stiff: The contact's stiffness over the mass that it moves [1/s^2].
        taken: Part of the gap's speed that the damping takes in a step.
    """
    size = _DRIFT * slow * slow * stiff + change * change
    limit, longer = gap_speeds[wanted], gap_speeds[min(wanted + 1, GRID)]
    rough = size > _ROUGH * limit * limit * stiff or taken > _DAMPED
    return rough, size < longer * longer * stiff and 2.0 * taken < _DAMPED


@inlined
def _turned(cos_a, sin_a, by):
    """A direction turned by an angle [rad], mostly a small one."""
    if abs(by) < 0.02:
        q = by * by
        c = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0)))
        s = by * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0)))
    else:
        c, s = math.cos(by), math.sin(by)
    return cos_a * c - sin_a * s, sin_a * c + cos_a * s


@inlined
def _blow(inputs, start_tick, ticks):
    """Mean force of the hammer over a step that it strikes in [N]: the pulse's own integral."""
    width = math.pi / (inputs.hammer_end - inputs.hammer_start)
    begin = width * (start_tick - inputs.hammer_start)
    return inputs.hammer_force * (math.cos(begin) - math.cos(begin + width * ticks)) / (width * ticks)


@inlined
def _along(euler, axis, x, y):
    """Part along the axis of something lateral, by which the direction does not change; none with small angles."""
    return x * axis.ux + y * axis.uy if euler else 0.0


@inlined
def _smooth_forces(constants, plant, engaged, axis, Sx, Sy):
    """Gravity and magnets added to a sum of arm times force (Sx, Sy) [N m].

    Returns:
        The sum; and what it makes of the axis beyond the flow, without the turning [1/s^2].
    """
    ux, uy = axis.ux, axis.uy
    Sy += plant.weight
    linear_x, linear_y = 0.0, plant.weight
    if engaged:
        lB = constants.shaft.arm_magnet
        force_x, force_y, _ = magnet_force(lB * ux, lB * uy, constants.magnet)
        Sx += lB * force_x
        Sy += lB * force_y
        linear_x, linear_y = -plant.spring_x * ux, -plant.spring_y * (uy - plant.rest)
    along = _along(constants.levels.euler, axis, Sx, Sy) * plant.per_Ixx
    return Sx, Sy, (Sx - linear_x) * plant.per_Ixx - along * ux, (Sy - linear_y) * plant.per_Ixx - along * uy


@inlined
def _turning(euler, plant, axis, uz, px, py, pz, w):
    """Acceleration of the axis by its own turning at a rate p and a spin w [1/s^2]."""
    g = plant.gyro * w
    if not euler:
        return -g * py, g * px
    ux, uy = axis.ux, axis.uy
    spread = px * px + py * py + pz * pz - (plant.damper_x * px * ux + plant.damper_y * py * uy) * plant.per_Ixx
    return g * (uy * pz - uz * py) - spread * ux, g * (uz * px - ux * pz) - spread * uy


@inlined
def _begin_contact(constants, memory, depth_before, rate_before, ago, motion, h):
    """Latch the onset speed of a contact that has begun since the last kick; what this kick misses of it [N s].

    Args:
        constants: Of the model.
        memory: Of the engine.
        depth_before: Penetration after the last kick [m].
        rate_before: Its rate [m/s].
        ago: Time since then [s].
        motion: Now.
        h: Step [s].
    """
    contact = constants.contact
    speed, since = motion.rate, 0.5
    if depth_before < 0.0 and ago > 0.0:
        part, speed = crossing(depth_before, rate_before, motion.depth, motion.rate, ago)
        since = (1.0 - part) * ago / h
    memory[CONTACTS] += 1.0
    if speed < contact.speed_floor:
        memory[FLOORED] += 1.0
        speed = contact.speed_floor
    memory[ONSET] = speed
    memory[_BEFORE] = memory[_LAST] = memory[_BEFORE_SPAN] = 0.0
    memory[_SETTLED], memory[_BOUNCE] = 0.0, motion.rate
    if not constants.levels.compliant or motion.rate <= 0.0:
        return 0.0
    return onset_error(contact, motion.rate, since, speed, h)


@inlined
def _record_force(memory, force, h):
    """Follow the largest normal force [N]: this is the one in the middle of the kick of a step h [s]."""
    span = 0.5 * (memory[_LAST_STEP] + h)
    largest = peak(memory[_BEFORE], memory[_BEFORE_SPAN], memory[_LAST], span, force)
    memory[PEAK_FORCE] = max(memory[PEAK_FORCE], largest)
    memory[_BEFORE], memory[_LAST], memory[_BEFORE_SPAN], memory[_LAST_STEP] = memory[_LAST], force, span, h


@inlined
def _rigid_push(contact, motion, w, begins, rate_before, h):
    """Normal impulse of a rigid contact: Newton's law at an onset, Moreau's in lasting contact.

    The latter leaves no speed in the mean of a step.
    """
    goal = -0.5 * (motion.rate - rate_before) - _RETURN * (motion.depth - _SLOP * h * h) / h
    if begins:
        goal = -contact.restitution * motion.rate if motion.rate > contact.speed_floor else 0.0
    return Push(max(0.0, (motion.rate - goal) / w.nn), 0.0, 0.0, w.nt / w.nn, 0.0)


@inlined
def _touch(
    constants,
    plant,
    gap_speeds,
    memory,
    ledger,
    axis,
    houses,
    motion,
    spin,
    factor_per_speed,
    rate_before,
    phase,
    slid,
    missed,
    wanted,
    h,
    per_h,
    end,
):
    """The contact's impulse over a kick, booked in memory and ledger.

    Args:
        constants: Of the model.
        plant: Of this call.
        gap_speeds: Largest speed of the gap that each level takes [m/s].
        memory: Of the engine.
        ledger: Integrals since the last row, shape (N_VECTOR,).
        axis: Of the shaft.
        houses: Of the stator.
        motion: Of the shaft against the ring, halfway through what is smooth.
        spin: w [rad/s].
        factor_per_speed: Damping factor over the onset speed [s/m].
        rate_before: Rate of the gap after the last kick [m/s].
        phase: Of the contact so far: FLIGHT at an onset.
        slid: Sliding speed after the last kick [m/s], nan at an onset.
        missed: What the kick misses of an onset [N s].
        wanted: Level asked for.
        h: Step [s].
        per_h: 1/h.
        end: End of this step, in parts of the grid's own from the row on.

    Returns:
        Impulse; phase; sliding speed and rate of the gap after it [m/s]; level asked for.
    """
    contact, house = constants.contact, constants.house
    compliant, inner = constants.levels.compliant, constants.levels.inner_house
    nx, ny, per_distance, depth, rate, lateral = motion
    w = mobility_of(plant, constants.levels.euler, axis, nx, ny)
    swerve = 0.0
    if compliant:
        law = law_at(contact, depth, factor_per_speed)
        swerve = flow_swerve(constants, plant, axis, houses, motion)
        push = compliant_push(law, w, rate, swerve, missed, h)
    else:
        law = Law(0.0, 0.0, 0.0, 0.0)
        push = _rigid_push(contact, motion, w, phase == FLIGHT, rate_before, h)
    jn, shift = push.jn, push.shift

    # Rolling holds along the arc, not at the corners of the polygon that the kicks make of it.
    sliding = lateral + constants.shaft.radius * spin + lateral * (1.0 / 12.0) * h * jn * w.nn * per_distance
    jt, wanted_jt = friction_impulse(w, jn, plant.friction * jn, sliding, slid)
    if jn > 0.0:
        jn = max(0.0, jn - push.back * jt)
    elif compliant:
        memory[CLAMPS] += 1.0
    phase = ROLLING
    if jt != wanted_jt:
        phase = FORWARD if wanted_jt > 0.0 else BACKWARD
    if plant.friction == 0.0:
        phase = FORWARD if sliding > 0.0 else BACKWARD
    slid = sliding - w.tt * jt - w.nt * jn
    rate_after = rate - w.nn * jn - w.nt * jt
    rate_mean = rate - 0.5 * (w.nn * jn + w.nt * jt)
    jx, jy = -jn * nx + jt * ny, -jn * ny - jt * nx
    force_x, force_y = jx, jy
    loss = (jn - push.held) * rate_mean
    if shift != 0.0:
        aside = shift * lateral * per_distance
        jx -= aside * ny
        jy += aside * nx
        # It comes after friction's clamp: the next target makes up for it, and takes it for no flow's.
        slid -= (w.tt - plant.spin_mobility) * aside
        springs = 0.0
        if inner:
            beam = house.inner_beam_stiffness * (houses.x0 - houses.x2)
            pair = house.pair_stiffness_vertical * (houses.y0 - houses.y2)
            springs = shift * plant.per_inner * (beam * nx + pair * ny)
            ledger[S.HOUSE_LOSS] += springs
        loss += law.elastic * w.nn * shift - aside * lateral - springs
    ledger[S.CONTACT_LOSS] += loss
    ledger[S.FRICTION_LOSS] += jt * 0.5 * (sliding + slid)
    ledger[S.GAP_WORK] += contact.gap_counts_outer * (jx * houses.x3 + jy * houses.y3)
    ledger[S.CONTACT_IMPULSE] += jn
    memory[CONTACT_STEPS] += 1.0

    # A rigid contact is always calm, and its force no function of time.
    rough, calm = False, True
    cx = cy = dcx = dcy = 0.0
    if compliant:
        _record_force(memory, max(0.0, law.elastic + law.damping * rate_mean), h)
        change = (rate_mean - memory[_BOUNCE]) * per_h
        memory[_BOUNCE] = rate_mean
        rough, calm = _roughness(gap_speeds, wanted, rate_mean, change, law.slope * w.nn, push.taken)
        cx, cy = force_x * per_h, force_y * per_h
        growth, turn = law.relative * rate_mean, lateral * per_distance
        swerve *= law.damping
        dcx, dcy = growth * cx - turn * cy - swerve * nx, growth * cy + turn * cx - swerve * ny
    wanted = _contact_level(memory, wanted, rough, calm, end)
    return Impulse(jx, jy, jt, shift * nx, shift * ny, cx, cy, dcx, dcy), phase, slid, rate_after, wanted


@inlined
def _end_contact(constants, plant, ledger, depth_before, rate_before, ago, motion, phase, onset_speed, h):
    """Impulse that makes up for what the last kick missed of a contact that has ended since.

    Args:
        constants: Of the model.
        plant: Of this call.
        ledger: Integrals since the last row, shape (N_VECTOR,).
        depth_before: Penetration after the last kick [m].
        rate_before: Its rate [m/s].
        ago: Time since then [s].
        motion: Now.
        phase: Of the contact.
        onset_speed: Of the contact [m/s].
        h: Step [s].
    """
    jn = jt = 0.0
    if constants.levels.compliant and depth_before > 0.0:
        part, speed = crossing(depth_before, rate_before, motion.depth, motion.rate, ago)
        jn = end_impulse(constants.contact, part, speed, onset_speed, ago, h)
        if phase == FORWARD:
            jt = plant.friction * jn
        elif phase == BACKWARD:
            jt = -plant.friction * jn
        ledger[S.CONTACT_IMPULSE] += jn
    jx, jy = -jn * motion.nx + jt * motion.ny, -jn * motion.ny - jt * motion.nx
    return Impulse(jx, jy, jt, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@inlined
def _loose(displacement, stiffness, preload):
    """What a pair of transducers pushes less than its linear spring, once one has lost its preload [N]."""
    change = 0.5 * stiffness * displacement
    if abs(change) <= preload:
        return 0.0
    return 2.0 * change - (max(0.0, preload + change) - max(0.0, preload - change))


@inlined
def _house_kick(constants, plant, ledger, houses, impulse, h):
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


@njit(cache=True, error_model="numpy", fastmath=FAST, nogil=True)
def advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """See `rig.engines`."""
    # params:
    shaft, house = constants.shaft, constants.house
    euler, inner, compliant = constants.levels.euler, constants.levels.inner_house, constants.levels.compliant
    ideal, engaged = inputs.ideal_drive, inputs.magnet_engaged
    Izz, R, r0 = shaft.polar_inertia, shaft.radius, constants.contact.clearance
    lA, lI = shaft.arm_ring, shaft.arm_disk
    plant = plant_of(constants, inputs, memory[_REST], memory[_SPRING_X], memory[_SPRING_Y])
    per_Ixx, arm = plant.per_Ixx, plant.arm
    shaft_table = shaft_flows(plant, engaged, step_ticks * inputs.tick_s)
    house_table = memory[_FLOWS:_FLOWS_END].reshape(LEVELS, HOUSE_FLOW)
    spans = shaft_table[:, HALF].copy()
    gap_speeds = _gap_speeds()
    part_ticks = step_ticks / 2.0**GRID
    # state in:
    axis, w, theta, houses = _kept(memory)
    phase, slid = int(memory[PHASE]), memory[_SLID]
    depth_before, rate_before, ago = memory[_DEPTH], memory[_RATE], memory[_AGO]
    wanted_level = level = int(memory[_WANTED])
    kicked, conjugate = int(memory[_KICKED]), memory[_CONJUGATE]
    k = memory[_KICK : _KICK + 8]
    kick = Kick(k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7])
    cos_a, sin_a, angle = memory[_COS], memory[_SIN], memory[_ANGLE]
    if engaged != (memory[_ENGAGED] == 1.0):
        # Another division into flow and kick has other conjugate coordinates.
        axis, houses = _processed(conjugate, plant, kick, axis, houses)
        kick = Kick(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        conjugate = 0.0
        kicked = -1
        memory[_ENGAGED] = 1.0 if engaged else 0.0
    factor_per_speed = constants.contact.damping_factor / memory[ONSET]
    kicks = 0.0
    ledger = np.zeros(S.N_VECTOR)
    dy = np.empty(S.N_VECTOR)
    row = 0
    first = 0
    while first < steps:
        now = tick + first * step_ticks
        own_axis, own_houses = _processed(conjugate, plant, kick, axis, houses)
        into_coordinates(constants, own_axis, w, theta, own_houses, y)
        # Rigid impacts have no force over time.
        seen = phase if compliant else FLIGHT
        evaluate(constants, inputs, now, 0.0, memory[ONSET], seen, True, y, dy, rows[row, S.N_VECTOR :])
        for i in range(S.N_VECTOR):
            rows[row, i] = y[i]
        row += 1

        # The steps up to the next row. Integrals of this row start at 0.
        ledger[:] = 0.0
        ledger[S.HOUSE_LOSS] = house_energy(constants, houses)
        drive_work = hammer_work = unbalance_work = bearing_loss = turn_x = turn_y = turn_z = 0.0
        # The unbalance's direction is turned step by step; its length is kept here.
        q = 1.5 - 0.5 * (cos_a * cos_a + sin_a * sin_a)
        cos_a, sin_a = cos_a * q, sin_a * q
        last = min(stride, steps - first) * 2**GRID
        n = 0
        owed = -1  # level of the half flow that the last kick still owes
        while n < last:
            start_tick = now + n * part_ticks
            struck = inputs.hammer_start <= start_tick < inputs.hammer_end
            if phase == FLIGHT:
                owed_s = spans[owed] if owed >= 0 else 0.0
                level = _flight_level(constants, plant, spans, gap_speeds, axis, houses, owed_s, struck)
            if kicked < 0:
                level = 0  # what the conjugate coordinates need is known after a kick
            # Steps start at whole multiples of their length, and end at the row.
            while n & ((1 << level) - 1) != 0 or n + (1 << level) > last:
                level -= 1
            count = 1 << level
            h = 2.0 * spans[level]
            per_h = shaft_table[level, PER_STEP]

            # Flow to the middle of the step.
            middle = (n + 0.5 * count) * part_ticks
            spin = w
            # The drive's speed in the middle of the flow up to there.
            back = 0.25 * count if owed < 0 else 0.25 * (count + (1 << owed))
            aim = drive_speed(inputs, now, middle - back * part_ticks)
            if ideal:
                w = aim
            merged = owed == level
            if owed >= 0 and not merged:
                axis, w, theta, houses = flow(shaft_table, house_table, owed, inner, axis, w, theta, aim, houses)
                ago = 0.0
            if level != kicked:
                # Each length of step has its own conjugate coordinates, at the ends of the steps.
                since = spans[kicked] if kicked >= 0 else 0.0
                carried = _continued(constants, plant, engaged, kick, axis, w, since)
                axis, houses = _processed(conjugate - h * h * (1.0 / 24.0), plant, carried, axis, houses)
                conjugate = h * h * (1.0 / 24.0)
                kicked = level
            if phase == FLIGHT and level <= GRID and not merged:
                # Where an onset in the half step ahead is measured from.
                ex, ey = eccentricity(constants, axis, houses)
                motion = motion_of(constants, axis.px, axis.py, houses, ex, ey)
                depth_before, rate_before, ago = motion.depth, motion.rate, 0.0
            at = level + 1 if merged else level
            axis, w, theta, houses = flow(shaft_table, house_table, at, inner, axis, w, theta, aim, houses)
            ago += spans[at]

            # Everything smooth: sum of arm times force, without the linear magnets of the flow.
            ux, uy, px, py = axis
            uz, pz, per_uz, share, share_per = geometry_of(euler, axis)
            if ideal:
                w = drive_speed(inputs, now, middle) + share
            drive_work += 0.5 * Izz * (w * w - spin * spin)
            moved = Izz * (w - spin)
            rotation = w - share  # theta'
            cos_a, sin_a = _turned(cos_a, sin_a, theta - angle)
            angle = theta
            pull = lI * shaft.unbalance * rotation * rotation
            pull_x, pull_y = pull * cos_a, pull * sin_a
            blow = lI * _blow(inputs, start_tick, count * part_ticks) if struck else 0.0
            blow_x, blow_y = blow * inputs.hammer_x, blow * inputs.hammer_y
            Sx, Sy, ax, ay = _smooth_forces(constants, plant, engaged, axis, pull_x + blow_x, pull_y + blow_y)
            # What depends on the rates: they are taken again in the middle of the kick, for order 2.
            turning_x, turning_y = _turning(euler, plant, axis, uz, px, py, pz, w)
            qx, qy = px + 0.5 * h * (ax + turning_x), py + 0.5 * h * (ay + turning_y)

            # Contact.
            impulse = Impulse(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            ex, ey = eccentricity(constants, axis, houses)
            if ex * ex + ey * ey > r0 * r0:
                motion = motion_of(constants, qx, qy, houses, ex, ey)
                missed = 0.0
                if phase == FLIGHT:
                    missed = _begin_contact(constants, memory, depth_before, rate_before, ago, motion, h)
                    factor_per_speed = constants.contact.damping_factor / memory[ONSET]
                    slid, wanted_level = np.nan, min(level, GRID)
                impulse, phase, slid, rate_before, wanted_level = _touch(
                    constants,
                    plant,
                    gap_speeds,
                    memory,
                    ledger,
                    axis,
                    houses,
                    motion,
                    w,
                    factor_per_speed,
                    rate_before,
                    phase,
                    slid,
                    missed,
                    wanted_level,
                    h,
                    per_h,
                    n + count,
                )
                depth_before, ago = motion.depth, 0.0
            elif phase != FLIGHT:
                motion = motion_of(constants, qx, qy, houses, ex, ey)
                impulse = _end_contact(
                    constants, plant, ledger, depth_before, rate_before, ago, motion, phase, memory[ONSET], h
                )
                phase = FLIGHT
                depth_before, rate_before, ago = motion.depth, motion.rate, 0.0
            else:
                if level <= GRID:
                    motion = motion_of(constants, qx, qy, houses, ex, ey)
                    depth_before, rate_before = motion.depth, motion.rate
                ago = 0.0
            kicks += 1.0

            # The kick, shaft and drive.
            jx, jy, jt = impulse.jx, impulse.jy, impulse.jt
            along = _along(euler, axis, arm * jx, arm * jy)
            dx, dyy = arm * jx - along * ux, arm * jy - along * uy
            w_mid = w
            if jt != 0.0 and not ideal:
                # The spin that counts is the one in the middle of the kick, for the unbalance too.
                w_mid = w - 0.5 * R * jt * plant.per_Izz
                more = lI * shaft.unbalance * ((w_mid - share) ** 2 - rotation * rotation)
                more_x, more_y = more * cos_a, more * sin_a
                along = _along(euler, axis, more_x, more_y)
                pull_x, pull_y = pull_x + more_x, pull_y + more_y
                Sx, Sy = Sx + more_x, Sy + more_y
                ax, ay = ax + (more_x - along * ux) * per_Ixx, ay + (more_y - along * uy) * per_Ixx
            mx, my = px + 0.5 * (h * (ax + turning_x) + dx), py + 0.5 * (h * (ay + turning_y) + dyy)
            mz = -(ux * mx + uy * my) * per_uz
            turning_x, turning_y = _turning(euler, plant, axis, uz, mx, my, mz, w_mid)
            share = share_per * (uy * mz - uz * my)
            ux, uy = ux - arm * impulse.shift_x, uy - arm * impulse.shift_y
            axis = Axis(ux, uy, px + h * (ax + turning_x) + dx, py + h * (ay + turning_y) + dyy)
            torque = R * jt
            if not ideal:
                theta -= h * share
                torque = h * (constants.torque_gain * share)
                w += (torque - R * jt) * plant.per_Izz
            net = moved + torque - R * jt
            # What the next change of step and the rows need. Of what is smooth, only the unbalance changes fast.
            kick = Kick(
                ax + turning_x + blow_x * per_Ixx,
                ay + turning_y + blow_y * per_Ixx,
                -rotation * pull_y * per_Ixx,
                rotation * pull_x * per_Ixx,
                impulse.cx,
                impulse.cy,
                impulse.dcx,
                impulse.dcy,
            )
            # The kick, houses.
            if inner:
                houses, near = _house_kick(constants, plant, ledger, houses, impulse, h)
                if near:
                    wanted_level = min(wanted_level, _BLOW)
            # Powers and torques of the smooth forces, in the middle of the kick.
            damped_x, damped_y = plant.damper_x * mx, plant.damper_y * my
            Lx, Ly = h * (Sx - damped_x) + lA * jx, h * (Sy - damped_y) + lA * jy
            drive_work += torque * w_mid
            hammer_work += h * (blow_x * mx + blow_y * my)
            unbalance_work += h * (pull_x * mx + pull_y * my)
            bearing_loss += h * (damped_x * mx + damped_y * my)
            turn_x += net * ux - uz * Ly
            turn_y += net * uy + uz * Lx
            turn_z += net * uz + ux * Ly - uy * Lx
            owed = level
            n += count
            level = wanted_level

        # The half flow that is owed up to the row.
        spin = w
        aim = drive_speed(inputs, now, (last - 0.25 * (1 << owed)) * part_ticks)
        if ideal:
            w = aim
        axis, w, theta, houses = flow(shaft_table, house_table, owed, inner, axis, w, theta, aim, houses)
        ago += spans[owed]
        if ideal:
            w = drive_speed(inputs, now, last * part_ticks) + geometry_of(euler, axis).share
        moved = Izz * (w - spin)
        ledger[S.DRIVE_WORK] = drive_work + 0.5 * Izz * (w * w - spin * spin)
        ledger[S.HAMMER_WORK] = hammer_work
        ledger[S.UNBALANCE_WORK] = unbalance_work
        ledger[S.BEARING_LOSS] = bearing_loss
        ledger[S.HOUSE_LOSS] -= house_energy(constants, houses)
        ledger[S.ANGULAR_IMPULSE_X] = turn_x + moved * axis.ux
        ledger[S.ANGULAR_IMPULSE_Y] = turn_y + moved * axis.uy
        ledger[S.ANGULAR_IMPULSE_Z] = turn_z + moved
        for i in range(S.N_STATE, S.N_VECTOR):
            y[i] += ledger[i]
        y[S.HOUSE_IMPULSE_X] = house.inner_mass * houses.x1 + house.outer_mass * houses.x3
        y[S.HOUSE_IMPULSE_Y] = house.inner_mass * houses.y1 + house.outer_mass * houses.y3
        first += last // 2**GRID

    # out:
    own_axis, own_houses = _processed(conjugate, plant, kick, axis, houses)
    into_coordinates(constants, own_axis, w, theta, own_houses, y)
    _keep(memory, axis, w, theta, houses)
    memory[PHASE], memory[_SLID], memory[_WANTED] = float(phase), slid, float(wanted_level)
    memory[_DEPTH], memory[_RATE], memory[_AGO] = depth_before, rate_before, ago
    memory[_KICKED], memory[_CONJUGATE] = float(kicked), conjugate
    k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7] = kick
    memory[_COS], memory[_SIN], memory[_ANGLE] = cos_a, sin_a, angle
    memory[STEPS] += kicks
    memory[EVALUATIONS] += kicks
