"""Rigid impacts as impulses at one instant.

The direction of the shaft's axis is u = (ux, uy, uz) = (sin b, -sin G cos b, cos G cos b), its rate p. A point at arm l
is at l u, and the kinematics need no sines. With small angles uz is 1.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rig.physics.engines.common.events import latch_onset
from rig.physics.engines.common.memory import ONSET
from rig.physics.engines.common.method import rates
from rig.physics.engines.split.memory import MAX_IMPACT_SPEED
from rig.physics.engines.taylor.memory import END_FRACTION, END_TICK
from rig.physics.kernels import signals as S
from rig.physics.kernels.frames.axis import angles_from_axis, axis_from_angles
from rig.physics.kernels.laws.contact import FLIGHT, NO_FRICTION
from rig.physics.kernels.stage import kernel

_MIN_PRESSING = 0.1
"""Minimum acceleration towards the ring of a lasting contact [m/s^2]: smaller values are rounding errors of the
weight's."""
_DELTA_S = 1e-7
"""Time increment of the acceleration's difference quotient [s]."""
_MIN_SEPARATION_SPEED = 1e-9
"""Minimum speed of separation [m/s]: rounding determines the sign of 0."""


class Axis(NamedTuple):
    """Lateral components of the direction of the shaft's axis and of its rate."""

    ux: float  # [1]
    uy: float  # [1]
    px: float  # [1/s]
    py: float  # [1/s]


class RelativeMotion(NamedTuple):
    """Motion of the shaft relative to the ring, at the point of contact."""

    nx: float  # direction from the ring's centre to the shaft's
    ny: float
    rate: float  # rate of the penetration [m/s]
    sliding: float  # speed of the shaft's surface along the ring [m/s]
    distance: float  # between both centres [m]


class Plant(NamedTuple):
    """Quantities that a call derives once from constants and inputs."""

    per_Izz: float  # [1/(kg m^2)]
    per_inner: float  # inverse mass of the inner housing [1/kg]; 0 for a fixed one
    arm: float  # acceleration of the axis by a force at the ring [1/(kg m)]
    mobility: float  # speed of the shaft at the ring per impulse there [1/kg]
    spin_mobility: float  # speed of the shaft's surface per impulse along it, by the spin alone [1/kg]
    friction: float  # mu [1]


class Mobility(NamedTuple):
    """Speed of the shaft relative to the ring, per impulse [1/kg]."""

    nn: float  # normal speed by normal impulse
    tt: float  # tangential speed by tangential impulse
    nt: float  # cross term


@kernel
def make_plant(constants, inputs):
    """Return the quantities derived from constants and inputs."""
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
def axis_state(constants, y):
    """Return the axis in the state y, and the spin about it [rad/s]."""
    euler = constants.levels.euler
    ux, uy, px, py = axis_from_angles(euler, y[S.GAMMA], y[S.BETA], y[S.GAMMA_RATE], y[S.BETA_RATE])
    w = y[S.THETA_RATE] + y[S.GAMMA_RATE] * ux if euler else y[S.THETA_RATE]
    return Axis(ux, uy, px, py), w


@kernel
def complete_axis(euler, axis):
    """Return uz [1] of an axis, and Gamma' sin b, the difference between spin and theta' [rad/s]."""
    if not euler:
        return 1.0, 0.0
    ux, uy, px, py = axis
    uz = math.sqrt(1.0 - (ux * ux + uy * uy))
    pz = -(ux * px + uy * py) / uz
    return uz, ux / (1.0 - ux * ux) * (uy * pz - uz * py)


@kernel
def relative_motion(constants, axis, w, y):
    """Return the motion of the shaft relative to the ring.

    Args:
        constants: Model constants.
        axis: Axis in the state y.
        w: Spin about the axis [rad/s].
        y: State, shape (N_VECTOR,).
    """
    contact, lA = constants.contact, constants.shaft.arm_ring
    both = contact.gap_counts_outer
    ex = lA * axis.ux - y[S.X_IH] - both * y[S.X_OH] - contact.offset_x
    ey = lA * axis.uy - y[S.Y_IH] - both * y[S.Y_OH] - contact.offset_y
    distance = math.sqrt(ex * ex + ey * ey)
    per_distance = 1.0 / distance if distance > 0.0 else 0.0
    nx, ny = ex * per_distance, ey * per_distance
    vx = lA * axis.px - y[S.VX_IH] - both * y[S.VX_OH]
    vy = lA * axis.py - y[S.VY_IH] - both * y[S.VY_OH]
    return RelativeMotion(nx, ny, vx * nx + vy * ny, vy * nx - vx * ny + constants.shaft.radius * w, distance)


@kernel
def contact_mobility(plant, euler, axis, nx, ny):
    """Return the speed of the shaft relative to the ring per impulse, which decreases with the axis's tilt."""
    un = ut = 0.0
    if euler:
        un, ut = axis.ux * nx + axis.uy * ny, axis.uy * nx - axis.ux * ny
    nn = plant.mobility * (1.0 - un * un) + plant.per_inner
    tt = plant.mobility * (1.0 - ut * ut) + plant.per_inner + plant.spin_mobility
    return Mobility(nn, tt, -plant.mobility * un * ut)


@kernel
def apply_impulse(constants, inputs, plant, y, axis, w, motion, m, jn, jt):
    """Apply impulses jn, normal, and jt, tangential [N s], to the state y and its integrals."""
    shaft, euler = constants.shaft, constants.levels.euler
    uz, share = complete_axis(euler, axis)
    jx, jy = -jn * motion.nx + jt * motion.ny, -jn * motion.ny - jt * motion.nx
    lost = axis.ux * jx + axis.uy * jy if euler else 0.0
    px, py = axis.px + plant.arm * (jx - lost * axis.ux), axis.py + plant.arm * (jy - lost * axis.uy)
    spin = w
    if inputs.ideal_drive:
        w += complete_axis(euler, Axis(axis.ux, axis.uy, px, py))[1] - share
    else:
        w -= shaft.radius * jt * plant.per_Izz
    angles = angles_from_axis(euler, axis.ux, axis.uy, px, py)
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
def _gap_acceleration(constants, inputs, memory, room, y):
    """Return the acceleration of the closing gap without contact force in the state y at the series' end [m/s^2]."""
    tick, fraction = int(memory[END_TICK]), memory[END_FRACTION]
    rates(constants, inputs, tick, fraction, memory[ONSET], FLIGHT, True, y, room.dy, room.out)
    before = room.out[S.PENETRATION_RATE]
    rates(constants, inputs, tick, fraction, memory[ONSET], FLIGHT, True, y + _DELTA_S * room.dy, room.dy, room.out)
    return (room.out[S.PENETRATION_RATE] - before) / _DELTA_S


@kernel
def apply_impact(constants, inputs, plant, memory, room, y):
    """Apply an impact to the state y with closed gap: Newton's restitution and Coulomb's friction.

    The tangential impulse ends the sliding if it is within mu times the normal one, which limits it.

    Returns:
        False for a lasting contact, which the compliant law takes: an approach below the speed floor, with the shaft
            pressed against the ring.
    """
    contact, mu = constants.contact, plant.friction
    axis, w = axis_state(constants, y)
    motion = relative_motion(constants, axis, w, y)
    m = contact_mobility(plant, constants.levels.euler, axis, motion.nx, motion.ny)
    if motion.rate <= contact.speed_floor and _gap_acceleration(constants, inputs, memory, room, y) > _MIN_PRESSING:
        return False
    latch_onset(memory, motion.rate, contact)
    memory[MAX_IMPACT_SPEED] = max(memory[MAX_IMPACT_SPEED], memory[ONSET])
    change = (1.0 + contact.restitution) * max(motion.rate, 0.0) + _MIN_SEPARATION_SPEED
    # Sticking satisfies both conditions; otherwise the limit replaces the tangential one.
    determinant = m.nn * m.tt - m.nt * m.nt
    jn = (change * m.tt - motion.sliding * m.nt) / determinant
    jt = (motion.sliding * m.nn - change * m.nt) / determinant
    if abs(jt) > mu * jn:
        way = mu if motion.sliding > 0.0 else -mu
        jn = change / (m.nn + way * m.nt)
        jt = way * jn
    apply_impulse(constants, inputs, plant, y, axis, w, motion, m, jn, jt)
    return True
