"""Where the shaft is and how it moves: sines of its tilt, direction of its axis, and its place in the ring.

Frames and signs: x horizontal (EAST +), y up, z along the shaft toward its free end; Gamma turns about x, beta about
the turned y, theta is the spin. A point of the axis at arm l is at l u with u = (sin b, -sin G cos b, cos G cos b).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rig.physics.kernels.frames.angles import sin_cos
from rig.physics.kernels.stage import kernel, stage


class State(NamedTuple):
    """The state by name (`rig.physics.kernels.signals.STATE` has units and meaning)."""

    Gamma: float
    beta: float
    theta: float
    x_ih: float
    y_ih: float
    x_oh: float
    y_oh: float
    dG: float
    db: float
    dth: float
    vx_ih: float
    vy_ih: float
    vx_oh: float
    vy_oh: float


class Pose(NamedTuple):
    """The shaft's tilt and its rates, and what the equations make of them."""

    sG: float  # sin Gamma
    cG: float
    sb: float  # sin beta
    cb: float
    w: float  # spin about the axis, theta' + Gamma' sin b [rad/s]
    large: float  # 1, or 0 with small angles
    cross: float  # sin b sin G; 0 with small angles
    ux: float  # direction of the axis
    uy: float
    uz: float
    dux: float  # its rate [1/s]
    duy: float


class Eccentricity(NamedTuple):
    """The shaft's centre from the ring's, in the ring's plane, and its rate."""

    ex: float  # [m]
    ey: float  # [m]
    vx: float  # [m/s]
    vy: float  # [m/s]


@stage
def large_of(levels):
    """1 where tilts count as large, else 0: a factor of everything that small angles leave out."""
    return 1.0 if levels.euler else 0.0


@stage
def sines_of(levels, angle):
    """Sine and cosine of a tilt; with small angles the angle and 1."""
    if levels.euler:
        return sin_cos(angle)
    return angle, 1.0


@stage
def pose_of(levels, state):
    """Pose of the shaft in a state."""
    dG, db = state.dG, state.db
    sG, cG = sines_of(levels, state.Gamma)
    sb, cb = sines_of(levels, state.beta)
    large = large_of(levels)
    cross = large * (sb * sG)
    w = state.dth + large * (dG * sb)
    return Pose(sG, cG, sb, cb, w, large, cross, sb, -sG * cb, cG * cb, cb * db, -cG * cb * dG + cross * db)


@stage
def eccentricity_of(constants, state, pose):
    """Place and speed of the shaft in the ring."""
    contact, arm = constants.contact, constants.shaft.arm_ring
    both = contact.gap_counts_outer
    return Eccentricity(
        arm * pose.ux - state.x_ih - both * state.x_oh - contact.offset_x,
        arm * pose.uy - state.y_ih - both * state.y_oh - contact.offset_y,
        arm * pose.dux - state.vx_ih - both * state.vx_oh,
        arm * pose.duy - state.vy_ih - both * state.vy_oh,
    )


@kernel
def gap(constants, y):
    """Penetration of the shaft into the ring [m] (negative: gap) and its rate [m/s], by y, shape (N_VECTOR,)."""
    state = State(y[0], y[1], y[2], y[3], y[4], y[5], y[6], y[7], y[8], y[9], y[10], y[11], y[12], y[13])
    e = eccentricity_of(constants, state, pose_of(constants.levels, state))
    distance = math.sqrt(e.ex * e.ex + e.ey * e.ey)
    if distance == 0.0:
        return -constants.contact.clearance, 0.0
    return distance - constants.contact.clearance, (e.ex * e.vx + e.ey * e.vy) / distance
