"""Position and velocity of the shaft: sines of its tilt, direction of its axis, position in the ring.

Frames and signs: x horizontal (EAST +), y up, z along the shaft toward its free end. Gamma rotates about x, beta about
the rotated y, theta is the spin. A point of the axis at arm l is at l u with u = (sin b, -sin G cos b, cos G cos b).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rig.physics.kernels.frames.angles import sin_cos
from rig.physics.kernels.stage import kernel, stage


class State(NamedTuple):
    """State by name (`rig.physics.kernels.signals.STATE` has units and meaning)."""

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
    """Tilt of the shaft, its rates, and derived quantities."""

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
    """Position and velocity of the shaft's centre relative to the ring's, in the ring's plane."""

    ex: float  # [m]
    ey: float  # [m]
    vx: float  # [m/s]
    vy: float  # [m/s]


@stage
def large_tilt_factor(levels):
    """Return 1 for large tilts, else 0: a factor of all terms that small angles neglect."""
    return 1.0 if levels.euler else 0.0


@stage
def tilt_sines(levels, angle):
    """Return sine and cosine of a tilt; with small angles, the angle and 1."""
    if levels.euler:
        return sin_cos(angle)
    return angle, 1.0


@stage
def compute_pose(levels, state):
    """Return the pose of the shaft in a state."""
    dG, db = state.dG, state.db
    sG, cG = tilt_sines(levels, state.Gamma)
    sb, cb = tilt_sines(levels, state.beta)
    large = large_tilt_factor(levels)
    cross = large * (sb * sG)
    w = state.dth + large * (dG * sb)
    return Pose(sG, cG, sb, cb, w, large, cross, sb, -sG * cb, cG * cb, cb * db, -cG * cb * dG + cross * db)


@stage
def compute_eccentricity(constants, state, pose):
    """Return position and velocity of the shaft in the ring."""
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
    """Return penetration of the shaft into the ring [m] (negative: gap) and its rate [m/s].

    Args:
        constants: Model constants.
        y: State and integrals, shape (N_VECTOR,); only the state is read.
    """
    state = State(y[0], y[1], y[2], y[3], y[4], y[5], y[6], y[7], y[8], y[9], y[10], y[11], y[12], y[13])
    e = compute_eccentricity(constants, state, compute_pose(constants.levels, state))
    distance = math.sqrt(e.ex * e.ex + e.ey * e.ey)
    if distance == 0.0:
        return -constants.contact.clearance, 0.0
    return distance - constants.contact.clearance, (e.ex * e.vx + e.ey * e.vy) / distance
