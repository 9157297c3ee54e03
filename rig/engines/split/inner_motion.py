"""The motion inside `rig.engines.split`: the axis by its direction, the houses, and what is read off them.

The direction of the axis is u = (ux, uy, uz) = (sin b, -sin G cos b, cos G cos b), its rate p: a point at arm l is at
l u, and the kinematics have no sines. With small angles uz is 1 and pz is 0.

The functions here and in the files beside it that take part in every step are put in place by the compiler: they and
their tuples cost next to nothing over the same lines in one long loop.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import njit

from rig.kernels import signals as S
from rig.kernels.axis import angles_of, axis_of
from rig.kernels.contact import NO_FRICTION

FAST = {"contract", "reassoc", "arcp", "nsz"}
"""What the compiler may do beyond the rules of IEEE 754: fuse, reorder, take reciprocals. One build makes the same bits
every time all the same, in 5/6 of the time. Nothing that assumes that there is no nan."""

fast = njit(cache=True, error_model="numpy", fastmath=FAST)
inlined = njit(cache=True, error_model="numpy", fastmath=FAST, forceinline=True, no_cpython_wrapper=True)  # pyright: ignore[reportCallIssue]
"""Put in place by the compiler wherever it is called, and only from compiled code: no wrapper for Python to compile."""


class Axis(NamedTuple):
    """Direction of the shaft's axis and its rate, their lateral parts."""

    ux: float  # [1]
    uy: float  # [1]
    px: float  # [1/s]
    py: float  # [1/s]


class Houses(NamedTuple):
    """Displacements and speeds of both houses, horizontal and vertical."""

    x0: float  # inner [m]
    x1: float  # its rate [m/s]
    x2: float  # outer [m]
    x3: float  # its rate [m/s]
    y0: float  # inner [m]
    y1: float  # its rate [m/s]
    y2: float  # outer [m]
    y3: float  # its rate [m/s]


class Geometry(NamedTuple):
    """What else is known of the axis, by its direction and rate."""

    uz: float  # [1]
    pz: float  # [1/s]
    per_uz: float  # 1 / uz
    share: float  # Gamma' sin b, by which the spin w about the axis exceeds theta' [rad/s]
    share_per: float  # ux / (1 - ux^2): the share, per (uy pz - uz py)


class Motion(NamedTuple):
    """Of the shaft against the ring, where it is nearest to it."""

    nx: float  # direction from the ring's centre to the shaft's
    ny: float
    per_distance: float  # 1 / distance of the centres [1/m]
    depth: float  # penetration [m]; negative is the gap
    rate: float  # of it [m/s]
    lateral: float  # speed of the shaft's centre across [m/s]


class Plant(NamedTuple):
    """What a call makes of the constants and the inputs, once. Torques of the shaft count per tilt u."""

    per_Ixx: float  # [1/(kg m^2)]
    per_Izz: float  # [1/(kg m^2)]
    per_inner: float  # one over the inner house's mass [1/kg]; 0: it does not move
    per_outer: float  # one over the outer house's mass [1/kg]; 0: it does not move
    arm: float  # acceleration of the axis by a force at the ring [1/(kg m)]
    mobility: float  # speed of the shaft at the ring per impulse there [1/kg]
    spin_mobility: float  # speed of the shaft's surface per impulse along it, by the spin alone [1/kg]
    per_w: float  # one over the mobility along the ring, all together, of an upright shaft [kg]
    gyro: float  # Izz / Ixx [1]
    weight: float  # torque of gravity [N m]
    rest: float  # of the shaft on its magnets [1], about which ...
    spring_x: float  # ... their torque is linear, [N m]: the flow's part
    spring_y: float  # [N m]
    damper_x: float  # [N m s]
    damper_y: float  # [N m s]
    drive_rate: float  # at which the spin nears the drive's speed [1/s]; 0 of an ideal drive
    friction: float  # mu [1]
    loose_v: float  # displacement at which a vertical transducer comes loose [m]
    loose_h: float  # the same, horizontal [m]
    tightest: float  # root of twice the houses' energy at which one of them can come loose [J^0.5]


@fast
def plant_of(constants, inputs, rest, spring_x, spring_y):
    """What a call makes of the constants and the inputs.

    Args:
        constants: Of the model.
        inputs: Of this call.
        rest: uy of the shaft at rest on its magnets [1].
        spring_x: Torque of the magnets per tilt about it, horizontal [N m].
        spring_y: The same, vertical [N m].
    """
    levels = constants.levels
    shaft, magnet, contact, house = constants.shaft, constants.magnet, constants.contact, constants.house
    lA, lB, R = shaft.arm_ring, shaft.arm_magnet, shaft.radius
    ideal, engaged = inputs.ideal_drive, inputs.magnet_engaged
    per_Ixx, per_Izz = 1.0 / shaft.transverse_inertia, 1.0 / shaft.polar_inertia
    per_inner = 1.0 / house.inner_mass if levels.inner_house else 0.0
    mobility = lA * lA * per_Ixx
    spin_mobility = 0.0 if ideal else R * R * per_Izz
    loose_v = 2.0 * house.preload / house.pair_stiffness_vertical
    loose_h = 2.0 * house.preload / house.pair_stiffness_horizontal
    return Plant(
        per_Ixx,
        per_Izz,
        per_inner,
        1.0 / house.outer_mass if levels.outer_house else 0.0,
        lA * per_Ixx,
        mobility,
        spin_mobility,
        1.0 / (mobility + per_inner + spin_mobility),
        shaft.polar_inertia * per_Ixx,
        -shaft.mass * shaft.gravity * shaft.arm_centre,
        rest if engaged else 0.0,
        spring_x if engaged else 0.0,
        spring_y if engaged else 0.0,
        magnet.damping_x * lB * lB if engaged else 0.0,
        magnet.damping_y * lB * lB if engaged else 0.0,
        0.0 if ideal else constants.torque_gain * per_Izz,
        contact.friction if levels.friction != NO_FRICTION else 0.0,
        loose_v,
        loose_h,
        min(
            loose_v * math.sqrt(house.pair_stiffness_vertical),
            loose_h * math.sqrt(house.pair_stiffness_horizontal),
        ),
    )


@fast
def from_coordinates(constants, y):
    """Generalised coordinates y as axis, spin about it [rad/s], spin angle [rad], houses."""
    euler = constants.levels.euler
    ux, uy, px, py = axis_of(euler, y[S.GAMMA], y[S.BETA], y[S.GAMMA_RATE], y[S.BETA_RATE])
    axis = Axis(ux, uy, px, py)
    w = y[S.THETA_RATE] + y[S.GAMMA_RATE] * ux if euler else y[S.THETA_RATE]
    houses = Houses(y[S.X_IH], y[S.VX_IH], y[S.X_OH], y[S.VX_OH], y[S.Y_IH], y[S.VY_IH], y[S.Y_OH], y[S.VY_OH])
    return axis, w, y[S.THETA], houses


@fast
def into_coordinates(constants, axis, w, theta, houses, y):
    """The same the other way, into y."""
    euler = constants.levels.euler
    y[S.THETA] = theta
    angles = angles_of(euler, axis.ux, axis.uy, axis.px, axis.py)
    y[S.GAMMA], y[S.BETA], y[S.GAMMA_RATE], y[S.BETA_RATE] = angles
    y[S.THETA_RATE] = w - axis.ux * y[S.GAMMA_RATE] if euler else w
    y[S.X_IH], y[S.VX_IH], y[S.X_OH], y[S.VX_OH] = houses.x0, houses.x1, houses.x2, houses.x3
    y[S.Y_IH], y[S.VY_IH], y[S.Y_OH], y[S.VY_OH] = houses.y0, houses.y1, houses.y2, houses.y3


@inlined
def geometry_of(euler, axis):
    """What else is known of the axis."""
    ux, uy, px, py = axis
    if not euler:
        return Geometry(1.0, 0.0, 1.0, 0.0, 0.0)
    tilt2 = ux * ux + uy * uy
    q = ux * ux
    if tilt2 < 2e-3:  # series to rounding
        uz = 1.0 - tilt2 * (0.5 + tilt2 * (0.125 + tilt2 * (0.0625 + tilt2 * (0.0390625 + tilt2 * 0.02734375))))
        per_uz = 1.0 + tilt2 * (0.5 + tilt2 * (0.375 + tilt2 * (0.3125 + tilt2 * (0.2734375 + tilt2 * 0.24609375))))
        share_per = ux * (1.0 + q * (1.0 + q * (1.0 + q * (1.0 + q * (1.0 + q)))))
    else:
        uz = math.sqrt(1.0 - tilt2)
        per_uz = 1.0 / uz
        share_per = ux / (1.0 - q)
    pz = -(ux * px + uy * py) * per_uz
    return Geometry(uz, pz, per_uz, share_per * (uy * pz - uz * py), share_per)


@inlined
def eccentricity(constants, axis, houses):
    """Centre of the shaft in the ring, from the ring's: horizontal, vertical [m]."""
    contact, lA = constants.contact, constants.shaft.arm_ring
    both = contact.gap_counts_outer
    ex = lA * axis.ux - houses.x0 - both * houses.x2 - contact.offset_x
    ey = lA * axis.uy - houses.y0 - both * houses.y2 - contact.offset_y
    return ex, ey


@inlined
def motion_of(constants, px, py, houses, ex, ey):
    """Motion of the shaft against the ring, with rate (px, py) of the axis and eccentricity (ex, ey)."""
    contact, lA = constants.contact, constants.shaft.arm_ring
    both = contact.gap_counts_outer
    distance = math.sqrt(ex * ex + ey * ey)
    per_distance = 1.0 / distance if distance > 0.0 else 0.0
    nx, ny = ex * per_distance, ey * per_distance
    vx = lA * px - houses.x1 - both * houses.x3
    vy = lA * py - houses.y1 - both * houses.y3
    return Motion(nx, ny, per_distance, distance - contact.clearance, vx * nx + vy * ny, vy * nx - vx * ny)


@inlined
def house_energy(constants, houses):
    """Kinetic and potential energy of the houses with their linear springs [J]."""
    x0, x1, x2, x3, y0, y1, y2, y3 = houses
    house = constants.house
    stretch, rise = x0 - x2, y0 - y2
    return 0.5 * (
        house.inner_mass * (x1 * x1 + y1 * y1)
        + house.outer_mass * (x3 * x3 + y3 * y3)
        + house.inner_beam_stiffness * stretch * stretch
        + house.pair_stiffness_horizontal * x2 * x2
        + house.pair_stiffness_vertical * rise * rise
        + house.outer_beam_stiffness * y2 * y2
    )
