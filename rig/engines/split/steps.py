"""Steps of exact flow and one kick, in contact that has settled.

A step of flow and kick is half a flow, a kick, half a flow. The flow solves shaft on linear magnets, drive and both
houses exactly: the houses ring at up to 1.6 kHz and cost no accuracy. The kick holds the contact, the magnets'
hardening, gravity, unbalance and the turning of the axis; the hammer's blows are for the series.

State inside: the direction of the axis, u = (sin b, -sin G cos b), and its rate p. In these, a point at arm l is l u,
the kinematics have no sines, and with S the sum of arm times lateral force

    Ixx u'' = S - (S.u) u - Ixx |u'|^2 u + Izz w (u x u')

Errors of second order of such a step are two commutators of flow A and kick B. [B,[A,B]] goes into the kick: with the
contact's force f on the relative motion at the ring and the flow's acceleration a of it, that is
2 (f.grad) f + (v.grad f_v) f - f_v (v.grad f + f_v a) on the speed and -f_v f on the position, h^3/24 of each. For an
undamped contact it is Takahashi and Imada's F* = F (1 - h^2/12 F' w_n) (J. Phys. Soc. Jpn. 53 (1984) 3765); what comes
next in h^2 F' w_n is chosen for a lasting contact to keep its true depth. [A,[A,B]] is a change of coordinates by
h^2/24 [A,B] (the processing of Blanes, Casas and Murua, SIAM J. Sci. Comput. 27 (2006) 1817): at the end of a step,
where the next one is of another length, and for the rows it is carried out. Left out of both commutators: the houses'
damping, and friction where it rolls. What is left was measured to fall with h^4 in whirl, from 50 to 10 us.

The normal impulse holds its damping in closed form. Coulomb's friction is a clamp on the tangential impulse: what
would bring the sliding speed to its target, held within mu times the normal impulse. The target is minus half of what
the flow changed since the last kick, so that the speed is 0 in the mean of a step and not at its end: with a target
of 0 the order is 1.

The houses' momentum ledger is the flow's own, so its residual is 0 by construction; the energy residual is not.
"""

from __future__ import annotations

from numba import njit

from rig.engines.memory import EVALUATIONS, ONSET, PHASE, STEPS
from rig.engines.split.flow import HOUSE_FLOW, LEVELS, flow
from rig.engines.split.inner_motion import (
    FAST,
    Axis,
    Houses,
    eccentricity,
    geometry_of,
    house_energy,
    inlined,
    into_coordinates,
    motion_of,
)
from rig.engines.split.kick import Kick, along, continued, processed, smooth_forces, turned, turning
from rig.engines.split.levels import NONE, span_of
from rig.engines.split.place import (
    ANGLE,
    CONJUGATE,
    COS,
    FLOWS,
    FLOWS_END,
    KICK,
    KICKED,
    PX,
    PY,
    SIN,
    SLID,
    SPIN,
    TURNED,
    UX,
    UY,
    WANTED,
    X0,
    Y0,
)
from rig.engines.split.state import Coordinates, Direction, Smooth, Step, Touch, Work
from rig.engines.split.touch import house_kick, kick_contact, no_impulse
from rig.kernels import signals as S
from rig.kernels.contact import damping_per_speed
from rig.kernels.forces import drive_speed


@inlined
def _kept(memory):
    """Axis, spin, spin angle and houses from the memory."""
    x, y = memory[X0 : X0 + 4], memory[Y0 : Y0 + 4]
    axis = Axis(memory[UX], memory[UY], memory[PX], memory[PY])
    return axis, memory[SPIN], memory[ANGLE], Houses(x[0], x[1], x[2], x[3], y[0], y[1], y[2], y[3])


@inlined
def keep(memory, axis, w, theta, houses):
    """Put the motion into the memory."""
    memory[UX], memory[UY], memory[PX], memory[PY] = axis
    memory[SPIN], memory[ANGLE] = w, theta
    memory[X0], memory[X0 + 1], memory[X0 + 2], memory[X0 + 3] = houses.x0, houses.x1, houses.x2, houses.x3
    memory[Y0], memory[Y0 + 1], memory[Y0 + 2], memory[Y0 + 3] = houses.y0, houses.y1, houses.y2, houses.y3


@inlined
def _kept_state(constants, memory):
    """Contact, coordinates and the unbalance's direction from the memory."""
    k = memory[KICK : KICK + 8]
    factor = damping_per_speed(memory[ONSET], constants.contact)
    touch = Touch(int(memory[PHASE]), memory[SLID], int(memory[WANTED]), factor)
    kick = Kick(k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7])
    return (
        touch,
        Coordinates(int(memory[KICKED]), memory[CONJUGATE], kick),
        Direction(memory[COS], memory[SIN], memory[TURNED]),
    )


@inlined
def keep_state(memory, touch, coordinates, direction):
    """Put them into the memory."""
    memory[PHASE], memory[SLID] = float(touch.phase), touch.slid
    memory[WANTED] = float(touch.wanted)
    memory[KICKED], memory[CONJUGATE] = float(coordinates.kicked), coordinates.conjugate
    k = memory[KICK : KICK + 8]
    k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7] = coordinates.kick
    memory[COS], memory[SIN], memory[TURNED] = direction.cosine, direction.sine, direction.angle


@inlined
def struck(inputs, begin, end):
    """Whether the hammer strikes between two ticks."""
    return inputs.hammer_start < end and inputs.hammer_end > begin


@inlined
def _step_of(inputs, call, touch, kicked, owed, now, n, last):
    """The next step: as long as is wanted; it starts at a multiple of its length, and ends at the row.

    Args:
        inputs: Of this call.
        call: What stays through the call.
        touch: The contact.
        kicked: Level of the last kick, -1 before the first.
        owed: Level of the half flow that the last kick still owes, -1 for none.
        now: Tick of the row.
        n: Start, in shortest steps from the row on.
        last: The next row.

    Returns:
        The step; its level is NONE where it is not one for kicks.
    """
    begin = now + n * call.part_ticks
    level = touch.wanted
    if level != NONE:
        if kicked < 0:
            level = 0  # what the conjugate coordinates need is known after a kick
        while n & ((1 << level) - 1) != 0 or n + (1 << level) > last:
            level -= 1
        if struck(inputs, begin, begin + float(1 << level) * call.part_ticks):
            level = NONE
    count = 1 << max(level, 0)
    return Step(level, count, 2.0 * call.half_s * count, call.per_s / count, begin, n + count, owed)


@inlined
def _flow_to_middle(constants, inputs, call, shaft_table, house_table, step, aim, axis, w, theta, houses, coordinates):
    """The half flow that is still owed, the change of coordinates for a step of another length, and half a flow."""
    plant, level, owed = call.plant, step.level, step.owed
    inner = constants.levels.inner_house
    merged = owed == level
    conjugate, kicked = coordinates.conjugate, coordinates.kicked
    if owed >= 0 and not merged:
        axis, w, theta, houses = flow(shaft_table, house_table, owed, inner, axis, w, theta, aim, houses)
    if level != kicked:
        # Each length of step has its own conjugate coordinates, at the ends of the steps.
        since = span_of(call, kicked) if kicked >= 0 else 0.0
        carried = continued(constants, plant, inputs.magnet_engaged, coordinates.kick, axis, w, since)
        axis, houses = processed(conjugate - step.h * step.h * (1.0 / 24.0), plant, carried, axis, houses)
        conjugate = step.h * step.h * (1.0 / 24.0)
        kicked = level
    at = level + 1 if merged else level
    axis, w, theta, houses = flow(shaft_table, house_table, at, inner, axis, w, theta, aim, houses)
    return axis, w, theta, houses, Coordinates(kicked, conjugate, coordinates.kick)


@inlined
def _smooth(constants, inputs, call, axis, geometry, w, direction):
    """Everything smooth, in the middle of the step: sum of arm times force, without the flow's linear magnets."""
    shaft, lI = constants.shaft, constants.shaft.arm_disk
    rotation = w - geometry.share  # theta'
    pull = lI * shaft.unbalance * rotation * rotation
    pull_x, pull_y = pull * direction.cosine, pull * direction.sine
    Sx, Sy, ax, ay = smooth_forces(constants, call.plant, inputs.magnet_engaged, axis, pull_x, pull_y)
    # What depends on the rates: they are taken again in the middle of the kick, for order 2.
    turning_x, turning_y = turning(
        constants.levels.euler, call.plant, axis, geometry.uz, axis.px, axis.py, geometry.pz, w
    )
    return Smooth(Sx, Sy, ax, ay, turning_x, turning_y, pull_x, pull_y, rotation)


@inlined
def _contact(constants, call, memory, ledger, step, axis, w, houses, smooth, touch):
    """The contact's impulse, and the contact after it."""
    h, r0 = step.h, constants.contact.clearance
    qx = axis.px + 0.5 * h * (smooth.ax + smooth.turning_x)
    qy = axis.py + 0.5 * h * (smooth.ay + smooth.turning_y)
    ex, ey = eccentricity(constants, axis, houses)
    if ex * ex + ey * ey <= r0 * r0:
        return no_impulse(), Touch(touch.phase, touch.slid, NONE, touch.factor)
    motion = motion_of(constants, qx, qy, houses, ex, ey)
    return kick_contact(constants, call, memory, ledger, axis, houses, motion, w, touch, step)


@inlined
def _kick_shaft(
    constants, inputs, call, step, axis, geometry, w, theta, gained, moved, direction, smooth, impulse, work
):
    """The kick of shaft and drive, with its powers and torques; all forces in the middle of it.

    Args:
        constants: Of the model.
        inputs: Of this call.
        call: What stays through the call.
        step: At hand.
        axis: Of the shaft.
        geometry: Of the axis.
        w: Spin [rad/s].
        theta: Spin angle [rad].
        gained: Energy that the flow gave to the spin [J].
        moved: Angular momentum that it gave to it [N m s].
        direction: Of the unbalance.
        smooth: Smooth forces.
        impulse: Of the contact.
        work: Booked so far.

    Returns:
        Axis, spin, spin angle, the kick, and the work.
    """
    shaft, plant, h = constants.shaft, call.plant, step.h
    euler, ideal, arm = constants.levels.euler, inputs.ideal_drive, call.plant.arm
    R, lA, lI, per_Ixx = shaft.radius, shaft.arm_ring, shaft.arm_disk, call.plant.per_Ixx
    Sx, Sy, ax, ay, turning_x, turning_y, pull_x, pull_y, rotation = smooth
    share = geometry.share
    ux, uy, px, py = axis
    uz = geometry.uz
    jx, jy, jt = impulse.jx, impulse.jy, impulse.jt
    lost = along(euler, axis, arm * jx, arm * jy)
    dx, dyy = arm * jx - lost * ux, arm * jy - lost * uy
    w_mid = w
    if jt != 0.0 and not ideal:
        # The spin that counts is the one in the middle of the kick, for the unbalance too.
        w_mid = w - 0.5 * R * jt * plant.per_Izz
        more = lI * shaft.unbalance * ((w_mid - share) ** 2 - rotation * rotation)
        more_x, more_y = more * direction.cosine, more * direction.sine
        lost = along(euler, axis, more_x, more_y)
        pull_x, pull_y = pull_x + more_x, pull_y + more_y
        Sx, Sy = Sx + more_x, Sy + more_y
        ax, ay = ax + (more_x - lost * ux) * per_Ixx, ay + (more_y - lost * uy) * per_Ixx
    mx, my = px + 0.5 * (h * (ax + turning_x) + dx), py + 0.5 * (h * (ay + turning_y) + dyy)
    mz = -(ux * mx + uy * my) * geometry.per_uz
    turning_x, turning_y = turning(euler, plant, axis, uz, mx, my, mz, w_mid)
    share = geometry.share_per * (uy * mz - uz * my)
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
        ax + turning_x,
        ay + turning_y,
        -rotation * pull_y * per_Ixx,
        rotation * pull_x * per_Ixx,
        impulse.cx,
        impulse.cy,
        impulse.dcx,
        impulse.dcy,
    )
    damped_x, damped_y = plant.damper_x * mx, plant.damper_y * my
    Lx, Ly = h * (Sx - damped_x) + lA * jx, h * (Sy - damped_y) + lA * jy
    work = Work(
        work.drive + gained + torque * w_mid,
        work.unbalance + h * (pull_x * mx + pull_y * my),
        work.bearing + h * (damped_x * mx + damped_y * my),
        work.turn_x + (net * ux - uz * Ly),
        work.turn_y + (net * uy + uz * Lx),
        work.turn_z + (net * uz + ux * Ly - uy * Lx),
    )
    return axis, w, theta, kick, work


@inlined
def _book(constants, y, ledger, work, axis, houses, moved, gained):
    """The integrals since the last row into y; `moved` [N m s] and `gained` [J] by the last flow of the spin."""
    house = constants.house
    ledger[S.DRIVE_WORK] = work.drive + gained
    ledger[S.UNBALANCE_WORK] = work.unbalance
    ledger[S.BEARING_LOSS] = work.bearing
    ledger[S.HOUSE_LOSS] -= house_energy(constants, houses)
    ledger[S.ANGULAR_IMPULSE_X] = work.turn_x + moved * axis.ux
    ledger[S.ANGULAR_IMPULSE_Y] = work.turn_y + moved * axis.uy
    ledger[S.ANGULAR_IMPULSE_Z] = work.turn_z + moved
    for i in range(S.N_STATE, S.N_VECTOR):
        y[i] += ledger[i]
    y[S.HOUSE_IMPULSE_X] = house.inner_mass * houses.x1 + house.outer_mass * houses.x3
    y[S.HOUSE_IMPULSE_Y] = house.inner_mass * houses.y1 + house.outer_mass * houses.y3


@njit(cache=True, error_model="numpy", fastmath=FAST, nogil=True)
def kicks(constants, inputs, call, memory, shaft_table, ledger, y, now, n, last):
    """Kicks from one instant on, as long as they may, at most up to the next row; the state there into y.

    Args:
        constants: Of the model.
        inputs: Of this call.
        call: What stays through the call.
        memory: Of the engine.
        shaft_table: Flows of shaft and drive.
        ledger: Room for the integrals.
        y: State and integrals at the start, in and out.
        now: Tick of the row.
        n: Start, in shortest steps from the row on.
        last: The next row.

    Returns:
        Where they ended, in shortest steps from the row on.
    """
    euler, inner, ideal = constants.levels.euler, constants.levels.inner_house, inputs.ideal_drive
    Izz, plant = constants.shaft.polar_inertia, call.plant
    house_table = memory[FLOWS:FLOWS_END].reshape(LEVELS, HOUSE_FLOW)
    axis, w, theta, houses = _kept(memory)
    touch, coordinates, direction = _kept_state(constants, memory)
    # Integrals of this piece start at 0.
    ledger[:] = 0.0
    ledger[S.HOUSE_LOSS] = house_energy(constants, houses)
    work = Work(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    # The unbalance's direction is turned step by step; its length is kept here.
    q = 1.5 - 0.5 * (direction.cosine * direction.cosine + direction.sine * direction.sine)
    direction = Direction(direction.cosine * q, direction.sine * q, direction.angle)
    taken = 0.0
    owed = -1
    while n < last:
        step = _step_of(inputs, call, touch, coordinates.kicked, owed, now, n, last)
        if step.level == NONE:
            break
        before = (axis, w, theta, houses, coordinates, direction)

        # Flow to the middle of the step. The drive's speed is that in the middle of the flow up to there.
        middle = (n + 0.5 * step.parts) * call.part_ticks
        back = 0.25 * step.parts if owed < 0 else 0.25 * (step.parts + (1 << owed))
        aim = drive_speed(inputs, now, middle - back * call.part_ticks)
        spin = w
        if ideal:
            w = aim
        axis, w, theta, houses, coordinates = _flow_to_middle(
            constants, inputs, call, shaft_table, house_table, step, aim, axis, w, theta, houses, coordinates
        )
        geometry = geometry_of(euler, axis)
        if ideal:
            w = drive_speed(inputs, now, middle) + geometry.share
        gained, moved = 0.5 * Izz * (w * w - spin * spin), Izz * (w - spin)
        cosine, sine = turned(direction.cosine, direction.sine, theta - direction.angle)
        direction = Direction(cosine, sine, theta)

        # The kick.
        smooth = _smooth(constants, inputs, call, axis, geometry, w, direction)
        impulse, touch = _contact(constants, call, memory, ledger, step, axis, w, houses, smooth, touch)
        if touch.wanted == NONE:
            axis, w, theta, houses, coordinates, direction = before
            break
        axis, w, theta, kick, work = _kick_shaft(
            constants, inputs, call, step, axis, geometry, w, theta, gained, moved, direction, smooth, impulse, work
        )
        coordinates = Coordinates(coordinates.kicked, coordinates.conjugate, kick)
        if inner:
            houses, near = house_kick(constants, plant, ledger, houses, impulse, step.h)
            if near:
                touch = Touch(touch.phase, touch.slid, NONE, touch.factor)
        taken += 1.0
        owed = step.level
        n = step.end
        if touch.wanted == NONE:
            break

    gained = moved = 0.0
    if owed >= 0:
        # The half flow that is owed.
        spin = w
        aim = drive_speed(inputs, now, (n - 0.25 * (1 << owed)) * call.part_ticks)
        if ideal:
            w = aim
        axis, w, theta, houses = flow(shaft_table, house_table, owed, inner, axis, w, theta, aim, houses)
        if ideal:
            w = drive_speed(inputs, now, n * call.part_ticks) + geometry_of(euler, axis).share
        gained, moved = 0.5 * Izz * (w * w - spin * spin), Izz * (w - spin)
    _book(constants, y, ledger, work, axis, houses, moved, gained)
    own_axis, own_houses = processed(coordinates.conjugate, plant, coordinates.kick, axis, houses)
    into_coordinates(constants, own_axis, w, theta, own_houses, y)
    keep(memory, axis, w, theta, houses)
    keep_state(memory, touch, coordinates, direction)
    memory[STEPS] += taken
    memory[EVALUATIONS] += taken
    return n
