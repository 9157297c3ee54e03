"""Impulses at one instant: impacts of a rigid contact, and what ends a sliding speed that should be none."""

from __future__ import annotations

from rig.engines.events import latch_onset
from rig.engines.memory import ONSET
from rig.engines.method import rates
from rig.engines.split.impulse import mobility_of
from rig.engines.split.inner_motion import (
    Axis,
    Houses,
    eccentricity,
    fast,
    from_coordinates,
    geometry_of,
    into_coordinates,
    motion_of,
)
from rig.engines.split.place import HARDEST
from rig.engines.taylor.place import END_FRACTION, END_TICK
from rig.kernels import signals as S
from rig.kernels.contact import FLIGHT
from rig.kernels.stage import kernel

_PRESSED = 0.1
"""Acceleration towards the ring from which on a contact can last [m/s^2]: less is a rounding error of the weight's."""
_MOMENT_S = 1e-7
_APART = 1e-9
"""Least speed at which what leaves leaves [m/s]: 0 has rounding's sign."""


@fast
def _seen(constants, plant, y):
    """Motion at the ring, mobility there and sliding speed [m/s] at the state y."""
    axis, w, _, houses = from_coordinates(constants, y)
    ex, ey = eccentricity(constants, axis, houses)
    motion = motion_of(constants, axis.px, axis.py, houses, ex, ey)
    m = mobility_of(plant, constants.levels.euler, axis, motion.nx, motion.ny)
    return motion, m, motion.lateral + constants.shaft.radius * w


@fast
def _strike(constants, inputs, plant, y, motion, m, sliding, jn, jt):
    """Impulses jn, normal, and jt, across [N s], on the state y and in its integrals."""
    shaft, euler, per_inner = constants.shaft, constants.levels.euler, plant.per_inner
    axis, w, theta, houses = from_coordinates(constants, y)
    geometry = geometry_of(euler, axis)
    jx, jy = -jn * motion.nx + jt * motion.ny, -jn * motion.ny - jt * motion.nx
    lost = axis.ux * jx + axis.uy * jy if euler else 0.0
    axis = Axis(
        axis.ux,
        axis.uy,
        axis.px + plant.arm * (jx - lost * axis.ux),
        axis.py + plant.arm * (jy - lost * axis.uy),
    )
    spin = w
    if inputs.ideal_drive:
        w += geometry_of(euler, axis).share - geometry.share
    else:
        w -= shaft.radius * jt * plant.per_Izz
    houses = Houses(
        houses.x0, houses.x1 - per_inner * jx, houses.x2, houses.x3,
        houses.y0, houses.y1 - per_inner * jy, houses.y2, houses.y3,
    )  # fmt: skip
    into_coordinates(constants, axis, w, theta, houses, y)
    torque = shaft.polar_inertia * (w - spin)
    y[S.DRIVE_WORK] += (torque + shaft.radius * jt) * 0.5 * (w + spin)
    y[S.CONTACT_LOSS] += jn * (motion.rate - 0.5 * (m.nn * jn + m.nt * jt))
    y[S.FRICTION_LOSS] += jt * (sliding - 0.5 * (m.nt * jn + m.tt * jt))
    y[S.GAP_WORK] += constants.contact.gap_counts_outer * (jx * houses.x3 + jy * houses.y3)
    y[S.CONTACT_IMPULSE] += jn
    y[S.ANGULAR_IMPULSE_X] += torque * axis.ux - geometry.uz * shaft.arm_ring * jy
    y[S.ANGULAR_IMPULSE_Y] += torque * axis.uy + geometry.uz * shaft.arm_ring * jx
    y[S.ANGULAR_IMPULSE_Z] += torque * geometry.uz + shaft.arm_ring * (axis.ux * jy - axis.uy * jx)
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


@fast
def bounce(constants, inputs, plant, memory, room, y):
    """An impact at the state y, whose gap is closed: Newton's restitution, and Coulomb's friction.

    The impulse across is what would end the sliding, within mu times the normal one.

    Returns:
        False where the contact lasts: the shaft comes in no faster than the speed floor, and is pressed on. Then the
        compliant law takes it.
    """
    contact, mu = constants.contact, plant.friction
    motion, m, sliding = _seen(constants, plant, y)
    if motion.rate <= contact.speed_floor and _pressed(constants, inputs, memory, room, y) > _PRESSED:
        return False
    latch_onset(memory, motion.rate, contact)
    memory[HARDEST] = max(memory[HARDEST], memory[ONSET])
    change = (1.0 + contact.restitution) * max(motion.rate, 0.0) + _APART
    # Both conditions at once where it sticks; else the limit holds, and the normal condition with it.
    determinant = m.nn * m.tt - m.nt * m.nt
    jn = (change * m.tt - sliding * m.nt) / determinant
    jt = (sliding * m.nn - change * m.nt) / determinant
    if abs(jt) > mu * jn:
        way = mu if sliding > 0.0 else -mu
        jn = change / (m.nn + way * m.nt)
        jt = way * jn
    _strike(constants, inputs, plant, y, motion, m, sliding, jn, jt)
    return True


@fast
def hold(constants, inputs, plant, y):
    """End the sliding at the state y of a contact that rolls: kicks leave it none in the mean of a step only."""
    motion, m, sliding = _seen(constants, plant, y)
    _strike(constants, inputs, plant, y, motion, m, sliding, 0.0, sliding / m.tt)
