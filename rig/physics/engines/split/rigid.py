"""Impulses at one instant: impacts of a rigid contact.

The direction of the shaft's axis is u = (ux, uy, uz) = (sin b, -sin G cos b, cos G cos b), its rate p: a point at arm l
is at l u, and the kinematics have no sines. With small angles uz is 1.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rig.physics.engines.common.events import latch_onset
from rig.physics.engines.common.memory import ONSET
from rig.physics.engines.common.method import rates
from rig.physics.engines.split.place import HARDEST
from rig.physics.engines.taylor.place import END_FRACTION, END_TICK
from rig.physics.kernels import signals as S
from rig.physics.kernels.frames.axis import angles_of, axis_of
from rig.physics.kernels.laws.contact import FLIGHT, NO_FRICTION
from rig.physics.kernels.stage import kernel

_PRESSED = 0.1
"""Acceleration towards the ring from which on a contact can last [m/s^2]: less is a rounding error of the weight's."""
_MOMENT_S = 1e-7
_APART = 1e-9
"""Least speed at which what leaves leaves [m/s]: 0 has rounding's sign."""


class Axis(NamedTuple):
    """Direction of the shaft's axis and its rate, their lateral parts."""

    ux: float  # [1]
    uy: float  # [1]
    px: float  # [1/s]
    py: float  # [1/s]


class Motion(NamedTuple):
    """Of the shaft against the ring, where it is nearest to it."""

    nx: float  # direction from the ring's centre to the shaft's
    ny: float
    rate: float  # of the penetration [m/s]
    sliding: float  # speed of the shaft's surface across [m/s]
    distance: float  # between both centres [m]


class Plant(NamedTuple):
    """What a call makes of the constants and the inputs, once."""

    per_Izz: float  # [1/(kg m^2)]
    per_inner: float  # one over the inner house's mass [1/kg]; 0: it does not move
    arm: float  # acceleration of the axis by a force at the ring [1/(kg m)]
    mobility: float  # speed of the shaft at the ring per impulse there [1/kg]
    spin_mobility: float  # speed of the shaft's surface per impulse along it, by the spin alone [1/kg]
    friction: float  # mu [1]


class Mobility(NamedTuple):
    """Speed of the shaft against the ring, per impulse [1/kg]."""

    nn: float  # normal, by a normal one
    tt: float  # across, by one across
    nt: float  # the one by the other


@kernel
def plant_of(constants, inputs):
    """What a call makes of the constants and the inputs."""
    levels, shaft = constants.levels, constants.shaft
    arm, per_Izz = shaft.arm_ring / shaft.transverse_inertia, 1.0 / shaft.polar_inertia
    return Plant(
        per_Izz,
        1.0 / constants.house.inner_mass if levels.inner_house else 0.0,
        arm,
        shaft.arm_ring * arm,
        0.0 if inputs.ideal_drive else shaft.radius * shaft.radius * per_Izz,
        constants.contact.friction if levels.friction != NO_FRICTION else 0.0,
    )


@kernel
def axis_at(constants, y):
    """The axis at the state y, and the spin about it [rad/s]."""
    euler = constants.levels.euler
    ux, uy, px, py = axis_of(euler, y[S.GAMMA], y[S.BETA], y[S.GAMMA_RATE], y[S.BETA_RATE])
    w = y[S.THETA_RATE] + y[S.GAMMA_RATE] * ux if euler else y[S.THETA_RATE]
    return Axis(ux, uy, px, py), w


@kernel
def upright(euler, axis):
    """What else is known of the axis: uz [1], and Gamma' sin b, by which the spin about it exceeds theta' [rad/s]."""
    if not euler:
        return 1.0, 0.0
    ux, uy, px, py = axis
    uz = math.sqrt(1.0 - (ux * ux + uy * uy))
    pz = -(ux * px + uy * py) / uz
    return uz, ux / (1.0 - ux * ux) * (uy * pz - uz * py)


@kernel
def motion_of(constants, axis, w, y):
    """Motion of the shaft against the ring, with the axis and the spin w about it at the state y."""
    contact, lA = constants.contact, constants.shaft.arm_ring
    both = contact.gap_counts_outer
    ex = lA * axis.ux - y[S.X_IH] - both * y[S.X_OH] - contact.offset_x
    ey = lA * axis.uy - y[S.Y_IH] - both * y[S.Y_OH] - contact.offset_y
    distance = math.sqrt(ex * ex + ey * ey)
    per_distance = 1.0 / distance if distance > 0.0 else 0.0
    nx, ny = ex * per_distance, ey * per_distance
    vx = lA * axis.px - y[S.VX_IH] - both * y[S.VX_OH]
    vy = lA * axis.py - y[S.VY_IH] - both * y[S.VY_OH]
    return Motion(nx, ny, vx * nx + vy * ny, vy * nx - vx * ny + constants.shaft.radius * w, distance)


@kernel
def mobility_of(plant, euler, axis, nx, ny):
    """Speed of the shaft against the ring per impulse: less where the axis tilts that way."""
    un = ut = 0.0
    if euler:
        un, ut = axis.ux * nx + axis.uy * ny, axis.uy * nx - axis.ux * ny
    nn = plant.mobility * (1.0 - un * un) + plant.per_inner
    tt = plant.mobility * (1.0 - ut * ut) + plant.per_inner + plant.spin_mobility
    return Mobility(nn, tt, -plant.mobility * un * ut)


@kernel
def strike(constants, inputs, plant, y, axis, w, motion, m, jn, jt):
    """Impulses jn, normal, and jt, across [N s], on the state y and in its integrals."""
    shaft, euler = constants.shaft, constants.levels.euler
    uz, share = upright(euler, axis)
    jx, jy = -jn * motion.nx + jt * motion.ny, -jn * motion.ny - jt * motion.nx
    lost = axis.ux * jx + axis.uy * jy if euler else 0.0
    px, py = axis.px + plant.arm * (jx - lost * axis.ux), axis.py + plant.arm * (jy - lost * axis.uy)
    spin = w
    if inputs.ideal_drive:
        w += upright(euler, Axis(axis.ux, axis.uy, px, py))[1] - share
    else:
        w -= shaft.radius * jt * plant.per_Izz
    angles = angles_of(euler, axis.ux, axis.uy, px, py)
    y[S.GAMMA], y[S.BETA], y[S.GAMMA_RATE], y[S.BETA_RATE] = angles
    y[S.THETA_RATE] = w - axis.ux * y[S.GAMMA_RATE] if euler else w
    y[S.VX_IH] -= plant.per_inner * jx
    y[S.VY_IH] -= plant.per_inner * jy
    torque = shaft.polar_inertia * (w - spin)
    y[S.DRIVE_WORK] += (torque + shaft.radius * jt) * 0.5 * (w + spin)
    y[S.CONTACT_LOSS] += jn * (motion.rate - 0.5 * (m.nn * jn + m.nt * jt))
    y[S.FRICTION_LOSS] += jt * (motion.sliding - 0.5 * (m.nt * jn + m.tt * jt))
    y[S.GAP_WORK] += constants.contact.gap_counts_outer * (jx * y[S.VX_OH] + jy * y[S.VY_OH])
    y[S.CONTACT_IMPULSE] += jn
    y[S.ANGULAR_IMPULSE_X] += torque * axis.ux - uz * shaft.arm_ring * jy
    y[S.ANGULAR_IMPULSE_Y] += torque * axis.uy + uz * shaft.arm_ring * jx
    y[S.ANGULAR_IMPULSE_Z] += torque * uz + shaft.arm_ring * (axis.ux * jy - axis.uy * jx)
    if constants.levels.inner_house:
        y[S.HOUSE_IMPULSE_X] -= jx
        y[S.HOUSE_IMPULSE_Y] -= jy


@kernel
def _pressed(constants, inputs, memory, room, y):
    """Acceleration of the closing gap in flight, at the end of the series at hand and the state y [m/s^2]."""
    tick, fraction = int(memory[END_TICK]), memory[END_FRACTION]
    rates(constants, inputs, tick, fraction, memory[ONSET], FLIGHT, True, y, room.dy, room.out)
    before = room.out[S.PENETRATION_RATE]
    rates(constants, inputs, tick, fraction, memory[ONSET], FLIGHT, True, y + _MOMENT_S * room.dy, room.dy, room.out)
    return (room.out[S.PENETRATION_RATE] - before) / _MOMENT_S


@kernel
def bounce(constants, inputs, plant, memory, room, y):
    """An impact at the state y, whose gap is closed: Newton's restitution, and Coulomb's friction.

    The impulse across is what would end the sliding, within mu times the normal one.

    Returns:
        False where the contact lasts: the shaft comes in no faster than the speed floor, and is pressed on. Then the
        compliant law takes it.
    """
    contact, mu = constants.contact, plant.friction
    axis, w = axis_at(constants, y)
    motion = motion_of(constants, axis, w, y)
    m = mobility_of(plant, constants.levels.euler, axis, motion.nx, motion.ny)
    if motion.rate <= contact.speed_floor and _pressed(constants, inputs, memory, room, y) > _PRESSED:
        return False
    latch_onset(memory, motion.rate, contact)
    memory[HARDEST] = max(memory[HARDEST], memory[ONSET])
    change = (1.0 + contact.restitution) * max(motion.rate, 0.0) + _APART
    # Both conditions at once where it sticks; else the limit holds, and the normal condition with it.
    determinant = m.nn * m.tt - m.nt * m.nt
    jn = (change * m.tt - motion.sliding * m.nt) / determinant
    jt = (motion.sliding * m.nn - change * m.nt) / determinant
    if abs(jt) > mu * jn:
        way = mu if motion.sliding > 0.0 else -mu
        jn = change / (m.nn + way * m.nt)
        jt = way * jn
    strike(constants, inputs, plant, y, axis, w, motion, m, jn, jt)
    return True
