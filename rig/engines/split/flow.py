"""The exact flow of everything linear, in `rig.engines.split`: shaft on linear magnets, drive, both houses.

Steps have levels: a step of level l lasts 2**(l - GRID) steps of the grid, and flows are kept for half of each.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rig.engines.split.inner_motion import FAST, Axis, Houses, inlined
from rig.kernels.magnet import magnet_force

GRID = 5
"""Level of the grid's own step."""
LEVELS = GRID + 8
"""Number of levels."""
HOUSE_FLOW = 32
"""Numbers of a flow of the houses: its horizontal and vertical block on (inner, rate, outer, rate), (4, 4) each."""

_FALL_X, _FALL_Y, _PUSH, _RUSH, _DECAY, _LAG = 0, 4, 8, 9, 10, 11
HALF = 12
"""Columns of the flows of shaft and drive: a block (2, 2) of each lateral direction; what gravity or the rest adds to
uy and py; decay of the distance to the drive's speed, and its integral; the flow's time, half a step [s]."""


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _exponential(a, t):
    """exp(a t) of a small matrix by scaled and squared Taylor series, to rounding."""
    n = len(a)
    size = 0.0
    for i in range(n):
        row = 0.0
        for j in range(n):
            row += abs(a[i, j] * t)
        size = max(size, row)
    halvings = 0
    while size > 0.25:
        size *= 0.5
        halvings += 1
    scaled = a * (t / 2.0**halvings)
    total = np.eye(n)
    term = np.eye(n)
    for k in range(1, 16):
        new = np.zeros((n, n))
        for i in range(n):
            for j in range(n):
                for m in range(n):
                    new[i, j] += term[i, m] * scaled[m, j]
        term = new / k
        total += term
    for _ in range(halvings):
        new = np.zeros((n, n))
        for i in range(n):
            for j in range(n):
                for m in range(n):
                    new[i, j] += total[i, m] * total[m, j]
        total = new
    return total


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _house_rates(constants):
    """Matrices of the houses' linear motion: horizontal and vertical, each on (inner, rate, outer, rate)."""
    house, levels = constants.house, constants.levels
    across = np.zeros((4, 4))
    upright = np.zeros((4, 4))
    if levels.inner_house:
        k, d = house.inner_beam_stiffness, house.inner_beam_damping
        across[0, 1] = 1.0
        across[1] = np.array([-k, -d, k, d]) / house.inner_mass
        upright[0, 1] = 1.0
        kv = house.pair_stiffness_vertical
        upright[1] = np.array([-kv, 0.0, kv, 0.0]) / house.inner_mass
        if levels.outer_house:
            across[2, 3] = 1.0
            across[3] = np.array([k, d, -k - house.pair_stiffness_horizontal, -d]) / house.outer_mass
            upright[2, 3] = 1.0
            upright[3] = (
                np.array([kv, 0.0, -kv - house.outer_beam_stiffness, -house.outer_beam_damping]) / house.outer_mass
            )
    return across, upright


@njit(cache=True, error_model="numpy", fastmath=FAST)
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


@njit(cache=True, error_model="numpy", fastmath=FAST)
def magnet_springs(constants):
    """Where the shaft rests on its magnets, uy [1], and their torque per tilt u about it, x and y [N m]."""
    shaft, magnet = constants.shaft, constants.magnet
    lB, weight = shaft.arm_magnet, shaft.arm_centre * shaft.mass * shaft.gravity
    rest, slope, eps = 0.0, 0.0, 1e-6
    for _ in range(50):
        torque = lB * magnet_force(0.0, lB * rest, magnet)[1] - weight
        slope = lB * (magnet_force(0.0, lB * (rest + eps), magnet)[1] - magnet_force(0.0, lB * (rest - eps), magnet)[1])
        rest -= torque / (slope / (2.0 * eps))
    return rest, -lB * magnet_force(lB * eps, lB * rest, magnet)[0] / eps, -slope / (2.0 * eps)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def house_flows(constants, grid_step, flows):
    """Flows of the houses for half a step of every level.

    Args:
        constants: Of the model.
        grid_step: The grid's own step [s].
        flows: Out, shape (LEVELS, HOUSE_FLOW).
    """
    across, upright = _house_rates(constants)
    for level in range(LEVELS):
        t = 0.5 * 2.0 ** (level - GRID) * grid_step
        flows[level, :16] = _exponential(across, t).ravel()
        flows[level, 16:] = _exponential(upright, t).ravel()


@njit(cache=True, error_model="numpy", fastmath=FAST)
def shaft_flows(plant, engaged, grid_step):
    """Flows of shaft and drive for half a step of every level, shape (LEVELS, 13); `grid_step` in s."""
    flows = np.empty((LEVELS, 13))
    for level in range(LEVELS):
        f = flows[level]
        t = 0.5 * 2.0 ** (level - GRID) * grid_step
        f[_FALL_X : _FALL_X + 4] = _axis_flow(plant.spring_x * plant.per_Ixx, plant.damper_x * plant.per_Ixx, t)
        f[_FALL_Y : _FALL_Y + 4] = _axis_flow(plant.spring_y * plant.per_Ixx, plant.damper_y * plant.per_Ixx, t)
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
