"""The exact flow of everything linear, in `rig.engines.split`: shaft on linear magnets, drive, both houses.

Steps have levels: a step of level l lasts 2**(l - GRID) steps of the grid, and flows are kept for half of each.
"""

from __future__ import annotations

import math

import numpy as np

from rig.engines.split.inner_motion import Axis, Houses, fast, inlined
from rig.kernels.constants import Constants
from rig.kernels.magnet import magnet_force

GRID = 5
"""Level of the grid's own step."""
LEVELS = GRID + 4
"""Number of levels."""
HOUSE_FLOW = 32
"""Numbers of a flow of the houses: its horizontal and vertical block on (inner, rate, outer, rate), (4, 4) each."""

_FALL_Y, _PUSH, _RUSH, _DECAY, _LAG = 4, 8, 9, 10, 11
HALF = 12
"""Columns of the flows of shaft and drive: a block (2, 2) of each lateral direction; what gravity or the rest adds to
uy and py; decay of the distance to the drive's speed, and its integral; the flow's time, half a step [s]."""


def _exponential(a: np.ndarray, t: float) -> np.ndarray:
    """Exp of matrices a t, shape (..., n, n), by a Taylor series: to rounding where a t is below 1/4."""
    total = np.broadcast_to(np.eye(a.shape[-1]), a.shape).copy()
    term = total.copy()
    for k in range(1, 16):
        term = term @ a * (t / k)
        total += term
    return total


def _house_rates(constants: Constants) -> np.ndarray:
    """Matrices of the houses' linear motion: horizontal and vertical, each on (inner, rate, outer, rate)."""
    house, levels = constants.house, constants.levels
    rates = np.zeros((2, 4, 4))
    across, upright = rates
    if levels.inner_house:
        k, d, kv = house.inner_beam_stiffness, house.inner_beam_damping, house.pair_stiffness_vertical
        across[0, 1] = upright[0, 1] = 1.0
        across[1] = np.array([-k, -d, k, d]) / house.inner_mass
        upright[1] = np.array([-kv, 0.0, kv, 0.0]) / house.inner_mass
        if levels.outer_house:
            ground = house.pair_stiffness_horizontal, house.outer_beam_stiffness, house.outer_beam_damping
            across[2, 3] = upright[2, 3] = 1.0
            across[3] = np.array([k, d, -k - ground[0], -d]) / house.outer_mass
            upright[3] = np.array([kv, 0.0, -kv - ground[1], -ground[2]]) / house.outer_mass
    return rates


@fast
def _axis_flow(stiffness, damping, t):
    """Exp of [[0, 1], [-stiffness, -damping]] t, row by row."""
    decay = math.exp(-0.5 * damping * t)
    square = stiffness - 0.25 * damping * damping
    if square > 0.0:
        rate = math.sqrt(square)
        c, s = math.cos(rate * t), math.sin(rate * t) / rate
    elif square < 0.0:
        rate = math.sqrt(-square)
        c, s = math.cosh(rate * t), math.sinh(rate * t) / rate
    else:
        c, s = 1.0, t
    half = 0.5 * damping
    return decay * (c + half * s), decay * s, -decay * stiffness * s, decay * (c - half * s)


def magnet_springs(constants: Constants) -> tuple[float, float, float]:
    """Where the shaft rests on its magnets, uy [1], and their torque per tilt u about it, x and y [N m]."""
    shaft, magnet = constants.shaft, constants.magnet
    lB, weight = shaft.arm_magnet, shaft.arm_centre * shaft.mass * shaft.gravity
    force = getattr(magnet_force, "py_func", magnet_force)  # once a run: not worth a compilation
    rest, slope, eps = 0.0, 0.0, 1e-6
    for _ in range(50):
        torque = lB * force(0.0, lB * rest, magnet)[1] - weight
        slope = lB * (force(0.0, lB * (rest + eps), magnet)[1] - force(0.0, lB * (rest - eps), magnet)[1])
        rest -= torque / (slope / (2.0 * eps))
    return rest, -lB * force(lB * eps, lB * rest, magnet)[0] / eps, -slope / (2.0 * eps)


def house_flows(constants: Constants, grid_step: float) -> np.ndarray:
    """Flows of the houses for half a step of every level, shape (LEVELS, HOUSE_FLOW); the grid's own step in s.

    The shortest, or one that the series takes, by its series; each of the others is the one before it, twice.
    """
    rates, t = _house_rates(constants), 0.5 * 2.0**-GRID * grid_step
    halvings = max(0, math.ceil(math.log2(max(1e-30, 4.0 * t * float(np.abs(rates).sum(axis=-1).max())))))
    flow = _exponential(rates, t * 2.0**-halvings)
    for _ in range(halvings):
        flow = flow @ flow
    flows = [flow]
    for _ in range(1, LEVELS):
        flows.append(flows[-1] @ flows[-1])
    return np.array(flows).reshape(LEVELS, HOUSE_FLOW)


@fast
def shaft_flows(plant, engaged, grid_step):
    """Flows of shaft and drive for half a step of every level, shape (LEVELS, 13); `grid_step` in s."""
    flows = np.empty((LEVELS, 13))
    for level in range(LEVELS):
        f = flows[level]
        t = 0.5 * 2.0 ** (level - GRID) * grid_step
        f[0], f[1], f[2], f[3] = _axis_flow(plant.spring_x * plant.per_Ixx, plant.damper_x * plant.per_Ixx, t)
        f[4], f[5], f[6], f[7] = _axis_flow(plant.spring_y * plant.per_Ixx, plant.damper_y * plant.per_Ixx, t)
        if engaged:
            f[_PUSH] = (1.0 - f[_FALL_Y]) * plant.rest
            f[_RUSH] = -f[_FALL_Y + 2] * plant.rest
        else:
            f[_PUSH] = 0.5 * t * t * plant.weight * plant.per_Ixx
            f[_RUSH] = t * plant.weight * plant.per_Ixx
        f[_DECAY] = math.exp(-plant.drive_rate * t)
        f[_LAG] = (1.0 - f[_DECAY]) / plant.drive_rate if plant.drive_rate > 0.0 else t
        f[HALF] = t
    return flows


@inlined
def flow(shaft_table, house_table, level, inner, axis, w, theta, aim, houses):
    """The exact flow over half a step of a level.

    Args:
        shaft_table: Flows of shaft and drive, shape (LEVELS, 13).
        house_table: Flows of the houses, shape (LEVELS, HOUSE_FLOW).
        level: Of the step.
        inner: Whether the inner house moves.
        axis: Of the shaft.
        w: Spin [rad/s].
        theta: Spin angle [rad].
        aim: Speed of the drive [rad/s].
        houses: Of the stator.

    Returns:
        Axis, spin, spin angle and houses at its end.
    """
    f = shaft_table[level]
    ux, uy, px, py = axis
    ux, px = f[0] * ux + f[1] * px, f[2] * ux + f[3] * px
    uy, py = f[4] * uy + f[5] * py + f[_PUSH], f[6] * uy + f[7] * py + f[_RUSH]
    away = w - aim
    theta += aim * f[HALF] + away * f[_LAG]
    w = aim + away * f[_DECAY]
    x0, x1, x2, x3, y0, y1, y2, y3 = houses
    if inner:
        m = house_table[level]
        x0, x1, x2, x3 = (
            (m[0] * x0 + m[1] * x1) + (m[2] * x2 + m[3] * x3),
            (m[4] * x0 + m[5] * x1) + (m[6] * x2 + m[7] * x3),
            (m[8] * x0 + m[9] * x1) + (m[10] * x2 + m[11] * x3),
            (m[12] * x0 + m[13] * x1) + (m[14] * x2 + m[15] * x3),
        )
        y0, y1, y2, y3 = (
            (m[16] * y0 + m[17] * y1) + (m[18] * y2 + m[19] * y3),
            (m[20] * y0 + m[21] * y1) + (m[22] * y2 + m[23] * y3),
            (m[24] * y0 + m[25] * y1) + (m[26] * y2 + m[27] * y3),
            (m[28] * y0 + m[29] * y1) + (m[30] * y2 + m[31] * y3),
        )
    return Axis(ux, uy, px, py), w, theta, Houses(x0, x1, x2, x3, y0, y1, y2, y3)
