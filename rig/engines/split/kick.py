"""Kicks of `rig.engines.split`: everything smooth that is no part of the flow, and the coordinates of steps."""

from __future__ import annotations

import math
from typing import NamedTuple

from rig.engines.split.inner_motion import Axis, Houses, inlined
from rig.kernels.magnet import magnet_force


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


@inlined
def processed(s, plant, kick, axis, houses):
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
def continued(constants, plant, engaged, kick, axis, w, since):
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


@inlined
def turned(cos_a, sin_a, by):
    """A direction turned by an angle [rad], mostly a small one."""
    if abs(by) < 0.02:
        q = by * by
        c = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0)))
        s = by * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0)))
    else:
        c, s = math.cos(by), math.sin(by)
    return cos_a * c - sin_a * s, sin_a * c + cos_a * s


@inlined
def along(euler, axis, x, y):
    """Part along the axis of something lateral, by which the direction does not change; none with small angles."""
    return x * axis.ux + y * axis.uy if euler else 0.0


@inlined
def smooth_forces(constants, plant, engaged, axis, Sx, Sy):
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
    lost = along(constants.levels.euler, axis, Sx, Sy) * plant.per_Ixx
    return Sx, Sy, (Sx - linear_x) * plant.per_Ixx - lost * ux, (Sy - linear_y) * plant.per_Ixx - lost * uy


@inlined
def turning(euler, plant, axis, uz, px, py, pz, w):
    """Acceleration of the axis by its own turning at a rate p and a spin w [1/s^2]."""
    g = plant.gyro * w
    if not euler:
        return -g * py, g * px
    ux, uy = axis.ux, axis.uy
    spread = px * px + py * py + pz * pz - (plant.damper_x * px * ux + plant.damper_y * py * uy) * plant.per_Ixx
    return g * (uy * pz - uz * py) - spread * ux, g * (uz * px - ux * pz) - spread * uy
