"""Batch kernel: many runs at once, one per SIMD lane, by Dormand and Prince's method of order 8.

Each lane has its own run, step length and contact phase; the lanes share only the arithmetic, so that a run's bits do
not depend on its neighbours. A lane whose run has ended takes the next run. No rows are written: what a run is for
(peaks, impulses, times, whirl) is collected while it runs.

The equations are those of `rig.physics.kernels.dynamics`, with the direction u of the shaft's axis and its rate p in
place of two angles (`rig.physics.kernels.frames.axis`); a test compares both. With I = Ixx = Iyy, L the sum of arm
times lateral force, and w the spin about the axis:

    p' = -|p|^2 u + (L - u (u L)) / I + (Izz w / I) u x p

Sliding contacts use tau with dt = s dtau, where s is the root of the penetration, as in
`rig.physics.engines.taylor.march`: the force is then smooth at onset and lift-off. Events are located by repeating the
step with another length.

All compiled code of the ensembles is in this file, as numba's cache checks only the file of the function it loads.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

import rig.physics.kernels  # noqa: F401  sets the folder of the compiled code

LANES = 8
"""Runs that advance together: doubles in a register of AVX-512; narrower registers take the loop in parts."""

# Rows of the workspace, each of LANES numbers: the integrated vector.
UX, UY, PX, PY, SPIN, THETA, X_IH, Y_IH, X_OH, Y_OH, VX_IH, VY_IH, VX_OH, VY_OH = range(14)
TIME, ROOT, IMPULSE, WORK, LOSS = range(14, 19)
"""Time [s]; root of the penetration [m^0.5]; integral of the normal force [N s]; supplied less dissipated energy [J];
dissipated energy [J]."""
N_STATE, N_VECTOR = 14, 19
N_START = N_STATE + 2
"""Numbers that a run starts from: state, contact phase, impact speed of the contact [m/s]."""

# Constants of a run; reciprocals where the equations divide.
(
    ARM_RING, ARM_MAGNET, ARM_DISK, WEIGHT_MOMENT, PER_INERTIA, POLAR_INERTIA, PER_POLAR, RADIUS, UNBALANCE,
    UNBALANCE_PHASE, LARGE, STIFFNESS, DAMPING_FACTOR, VISCOUS, CLEARANCE, OFFSET_X, OFFSET_Y, FRICTION, SPEED_FLOOR,
    MAGNET, A3, A5, A7, MAGNET_DAMPING_X, MAGNET_DAMPING_Y, PER_INNER, PER_OUTER, INNER_BEAM, INNER_BEAM_DAMPING,
    OUTER_BEAM, OUTER_BEAM_DAMPING, PAIR_VERTICAL, PAIR_HORIZONTAL, PRELOAD, TORQUE_GAIN,
    FREE_RADIUS, REST_X, REST_Y, PER_FREQUENCY,
) = range(39)  # fmt: skip
N_CONSTANTS = 39
"""The last four decide that a run stays free: largest amplitude at the ring without contact [m], the axis at rest, and
the reciprocal of the lower natural frequency [s]."""
# Inputs, constant between two instants of a run's schedule.
HAMMER, HAMMER_X, HAMMER_Y, HAMMER_START, PER_HAMMER, SPEED, SLOPE, SPEED_TIME, ENGAGED = range(N_CONSTANTS, 48)
N_INPUTS = 9
# Contact of a run, as factors of the equations.
TOUCHING, SLOWED, SIGN, ROLLS, ONSET = range(48, 53)
"""1 in contact; 1 where the variable of the steps is tau; sign of the sliding speed, 0 for no sliding friction; 1 while
it rolls; impact speed [m/s]."""
_RUN_ROWS = 53
# Results of an evaluation, besides the rates.
DELTA, RATE, FORCE, FORCE_RATE, HELD, SLIDING, NORMAL_X, NORMAL_Y, SLIDING_RATE, WORST = range(10)
"""Penetration [m] and its rate, normal force [N] and its rate, friction force [N], sliding speed [m/s], normal, and the
largest value of the phase's event function since it was reset."""
_N_EVALUATION = 10

_Y = 0
_Z = _Y + N_VECTOR
_C = _Z + N_VECTOR
_EVALUATION = _C + _RUN_ROWS
_H = _EVALUATION + _N_EVALUATION
_D = _H + N_VECTOR
_K = _D + N_VECTOR
_SCRATCH = _K + 13 * N_VECTOR
_ROWS = _SCRATCH + 2 * (ROOT + 1)
"""First rows of: state, state of a stage, constants, results of an evaluation, step length (repeated), rates,
rates of the stages, error estimates."""
_STAGE, _SIZE = (ROOT + 1) * LANES, N_VECTOR * LANES
"""Numbers of a stage's state, without the integrals that nothing depends on; of the whole vector."""
_K0, _K1, _K2, _K3, _K4, _K5, _K6, _K7, _K8, _K9, _K10, _K11, _K12 = range(_K * LANES, _SCRATCH * LANES, _SIZE)

FLIGHT, FREE_SLIDING, FORWARD, BACKWARD, ROLLING = range(5)
"""Contact phases, as in `rig.physics.kernels.laws.contact`; FREE_SLIDING is contact without friction."""

# Results of a run.
(
    STATUS, END, CONTACTS, FIRST_CONTACT, LAST_CONTACT, CONTACT_TIME, WHIRL_TIME, PEAK_FORCE, PEAK_RADIUS, PEAK_X,
    PEAK_Y, CONTACT_IMPULSE, RESIDUAL, DISSIPATED, STEPS, REPEATED, TURNED, WATCHED_CONTACT, WATCHED_TURN,
    WATCHED, END_STATE,
) = range(21)  # fmt: skip
N_RESULTS = END_STATE + N_START
UNFINISHED, RAN, STAYS_FREE, STAYS_WHIRLING, GIVEN_UP = range(5)
"""Status of a run: not finished; reached its end; ended early, as it stays free or in backward whirl; given up after
too many steps, or numbers that are not finite."""

_MAGIC = 6755399441055744.0
"""1.5 * 2^52: adding and subtracting it rounds to the nearest whole number, without a call."""
_PER_QUARTER, _QUARTER_HIGH, _QUARTER_LOW = 2.0 / math.pi, 1.5707963267948966, 6.123233995736766e-17
_MAX_STEP = 2e-3
"""Longest step [s]: a tenth of a turn at 50 Hz."""
_MIN_STEP = 1e-13
"""Shortest step that does not indicate a failure [s], in the variable of the step."""
_MAX_STEPS = 400_000
"""Steps after which a run is given up: a hammer run of 0.25 s takes 1,500, one of 3 s with much damping 150,000."""
_WHIRL_TURNS, _WHIRL_MARGIN = 3.0, 0.85
"""Turns of rolling, and the largest share of the friction limit in the last, from which a run stays in whirl: none of
6,000 random runs then left it within 3 s."""
_MAX_LOCATIONS = 40
"""Number of trials after which an event counts as located; bisection alone then has 1e-12 of the step."""
_WORTHWHILE_GROWTH = 1.3
"""Smallest growth of a step: the error of ringing housings varies with their phase."""
_NEW_PEAK, _MAX_HALVINGS = 1.001, 3
"""Ratio to all before from which a peak is worth a shorter step, and the number of times that its step is halved."""
_ROLLING_GAIN = 0.01
"""Error per step of a rolling contact as a share: it is not amplified by impacts."""


def _coefficients() -> tuple[Any, ...]:
    """Return scipy's coefficients of the method: a, b, and the weights of the error estimates of order 3 and 5."""
    from scipy.integrate import DOP853

    tables = DOP853.A[:12, :12], DOP853.B, DOP853.E3, DOP853.E5  # pyright: ignore[reportAttributeAccessIssue]
    return tuple(tuple(map(tuple, table.tolist())) if table.ndim == 2 else tuple(table.tolist()) for table in tables)


_A, _B, _COARSE, _FINE = _coefficients()


@njit(inline="always", error_model="numpy", fastmath=False)
def _sine_cosine(x):
    """Return sine and cosine, exact to rounding for |x| < 1e5, without a call or a branch."""
    n = (x * _PER_QUARTER + _MAGIC) - _MAGIC
    r = x - n * _QUARTER_HIGH - n * _QUARTER_LOW
    s = r * r
    sine = 1.0 - s * (1.0 / 110.0) * (1.0 - s * (1.0 / 156.0) * (1.0 - s * (1.0 / 210.0)))
    sine = r * (
        1.0 - s * (1.0 / 6.0) * (1.0 - s * (1.0 / 20.0) * (1.0 - s * (1.0 / 42.0) * (1.0 - s * (1.0 / 72.0) * sine)))
    )
    cosine = 1.0 - s * (1.0 / 90.0) * (1.0 - s * (1.0 / 132.0) * (1.0 - s * (1.0 / 182.0)))
    cosine = 1.0 - s * 0.5 * (1.0 - s * (1.0 / 12.0) * (1.0 - s * (1.0 / 30.0) * (1.0 - s * (1.0 / 56.0) * cosine)))
    quadrant = n - 4.0 * ((n * 0.25 - 0.375 + _MAGIC) - _MAGIC)
    odd = 1.0 if quadrant == 1.0 else (1.0 if quadrant == 3.0 else 0.0)
    first = cosine if odd != 0.0 else sine
    second = sine if odd != 0.0 else cosine
    first = -first if quadrant >= 2.0 else first
    second = -second if quadrant == 1.0 else second
    second = -second if quadrant == 2.0 else second
    return first, second


@njit(inline="always", error_model="numpy", fastmath=False)
def _positive(x):
    """Return max(0, x), which the compiler takes for all lanes at once."""
    return x if x > 0.0 else 0.0


@njit(cache=True, error_model="numpy", fastmath=False)
def evaluate(m):
    """Compute the rates of all lanes at the state at `_Z` into `_D`, and what events need.

    The body has no calls and no branches with effects: the compiler turns each line into one instruction for all lanes.
    """
    for i in range(LANES):
        z, c = _Z * LANES + i, _C * LANES + i
        ux, uy, px, py = m[z + UX * LANES], m[z + UY * LANES], m[z + PX * LANES], m[z + PY * LANES]
        w, theta = m[z + SPIN * LANES], m[z + THETA * LANES]
        x_ih, y_ih, x_oh, y_oh = m[z + X_IH * LANES], m[z + Y_IH * LANES], m[z + X_OH * LANES], m[z + Y_OH * LANES]
        vx_ih, vy_ih = m[z + VX_IH * LANES], m[z + VY_IH * LANES]
        vx_oh, vy_oh = m[z + VX_OH * LANES], m[z + VY_OH * LANES]
        time, root = m[z + TIME * LANES], m[z + ROOT * LANES]
        large, lA = m[c + LARGE * LANES], m[c + ARM_RING * LANES]
        lB, lI = m[c + ARM_MAGNET * LANES], m[c + ARM_DISK * LANES]
        per_I, per_inner, R = m[c + PER_INERTIA * LANES], m[c + PER_INNER * LANES], m[c + RADIUS * LANES]
        per_polar = m[c + PER_POLAR * LANES]
        # Pose.
        uz = math.sqrt(1.0 - large * (ux * ux + uy * uy))
        pz = -large * (ux * px + uy * py) / uz
        theta_rate = w - large * ux * (uy * pz - uz * py) / (1.0 - ux * ux)
        # Magnets, unbalance, hammer, drive.
        engaged = m[c + ENGAGED * LANES]
        x, y = lB * ux, lB * uy
        s = x * x + y * y
        gain = 1.0 + s * (m[c + A3 * LANES] + s * (m[c + A5 * LANES] + s * m[c + A7 * LANES]))
        gain *= -engaged * m[c + MAGNET * LANES]
        damping_x = -engaged * m[c + MAGNET_DAMPING_X * LANES] * lB * px
        damping_y = -engaged * m[c + MAGNET_DAMPING_Y * LANES] * lB * py
        sine, cosine = _sine_cosine(theta + m[c + UNBALANCE_PHASE * LANES])
        unbalance = m[c + UNBALANCE * LANES] * theta_rate * theta_rate
        part = (time - m[c + HAMMER_START * LANES]) * m[c + PER_HAMMER * LANES]
        pulse, _ = _sine_cosine(math.pi * part)
        hammer = m[c + HAMMER * LANES] * pulse if part * (1.0 - part) > 0.0 else 0.0
        disk_x = unbalance * cosine + hammer * m[c + HAMMER_X * LANES]
        disk_y = unbalance * sine + hammer * m[c + HAMMER_Y * LANES]
        aim = m[c + SPEED * LANES] + m[c + SLOPE * LANES] * (time - m[c + SPEED_TIME * LANES])
        torque = m[c + TORQUE_GAIN * LANES] * (aim - theta_rate)
        Lx = lB * (gain * x + damping_x) + lI * disk_x
        Ly = lB * (gain * y + damping_y) + lI * disk_y - m[c + WEIGHT_MOMENT * LANES]
        # Housings.
        preload, per_outer = m[c + PRELOAD * LANES], m[c + PER_OUTER * LANES]
        change = 0.5 * m[c + PAIR_VERTICAL * LANES] * (y_ih - y_oh)
        vertical = _positive(preload + change) - _positive(preload - change)
        change = 0.5 * m[c + PAIR_HORIZONTAL * LANES] * x_oh
        horizontal = _positive(preload + change) - _positive(preload - change)
        slip, damping, ground = vx_ih - vx_oh, m[c + INNER_BEAM_DAMPING * LANES], m[c + OUTER_BEAM_DAMPING * LANES]
        beam = m[c + INNER_BEAM * LANES] * (x_ih - x_oh) + damping * slip
        ax_ih, ay_ih = -beam * per_inner, -vertical * per_inner
        ax_oh = (beam - horizontal) * per_outer
        ay_oh = (vertical - m[c + OUTER_BEAM * LANES] * y_oh - ground * vy_oh) * per_outer
        # Contact.
        touching, slowed, sign = m[c + TOUCHING * LANES], m[c + SLOWED * LANES], m[c + SIGN * LANES]
        ex, ey = lA * ux - x_ih - m[c + OFFSET_X * LANES], lA * uy - y_ih - m[c + OFFSET_Y * LANES]
        vx, vy = lA * px - vx_ih, lA * py - vy_ih
        distance = math.sqrt(ex * ex + ey * ey)
        per_distance = 1.0 / (distance + 1e-300)
        nx, ny = ex * per_distance, ey * per_distance
        rate, along = vx * nx + vy * ny, vy * nx - vx * ny
        sliding, delta = along + R * w, distance - m[c + CLEARANCE * LANES]
        depth_root = root if slowed != 0.0 else math.sqrt(_positive(delta))
        ratio, viscous = m[c + DAMPING_FACTOR * LANES] / m[c + ONSET * LANES], touching * m[c + VISCOUS * LANES]
        hardness = touching * m[c + STIFFNESS * LANES] * depth_root
        elastic = hardness * depth_root * depth_root
        law = elastic * (1.0 + ratio * rate) + viscous * rate
        Fn = _positive(law)
        Ft = sign * m[c + FRICTION * LANES] * Fn
        Fx, Fy = -Fn * nx + Ft * ny, -Fn * ny - Ft * nx
        # Accelerations without the friction of rolling, then that friction, which keeps the sliding speed constant.
        Lx += lA * Fx
        Ly += lA * Fy
        radial, p2 = large * (ux * Lx + uy * Ly), large * (px * px + py * py + pz * pz)
        turn = w * m[c + POLAR_INERTIA * LANES] * per_I
        ddx = -p2 * ux + (Lx - ux * radial) * per_I + turn * (uy * pz - uz * py)
        ddy = -p2 * uy + (Ly - uy * radial) * per_I + turn * (uz * px - ux * pz)
        spin_rate = (torque - R * Ft) * per_polar
        ax_ih -= Fx * per_inner
        ay_ih -= Fy * per_inner
        across = large * (ux * ny - uy * nx)
        mobility = lA * lA * per_I * (1.0 - across * across) + per_inner + R * R * per_polar
        ax, ay = lA * ddx - ax_ih, lA * ddy - ay_ih
        holding = ay * nx - ax * ny - along * rate * per_distance + R * spin_rate
        sliding_rate = holding
        holding *= m[c + ROLLS * LANES] / mobility
        Ft += holding
        ddx += lA * per_I * holding * (ny - ux * across)
        ddy += lA * per_I * holding * (-nx - uy * across)
        spin_rate -= R * per_polar * holding
        ax_ih -= holding * ny * per_inner
        ay_ih += holding * nx * per_inner
        normal_acceleration = (lA * ddx - ax_ih) * nx + (lA * ddy - ay_ih) * ny + along * along * per_distance
        losses = damping * slip * slip + ground * vy_oh * vy_oh - damping_x * lB * px - damping_y * lB * py
        losses += (Fn - elastic) * rate + Ft * sliding
        supplied = torque * w + lI * (disk_x * px + disk_y * py)
        speed = root if slowed != 0.0 else 1.0
        d = _D * LANES + i
        m[d + UX * LANES], m[d + UY * LANES] = speed * px, speed * py
        m[d + PX * LANES], m[d + PY * LANES] = speed * ddx, speed * ddy
        m[d + SPIN * LANES], m[d + THETA * LANES] = speed * spin_rate, speed * theta_rate
        m[d + X_IH * LANES], m[d + Y_IH * LANES] = speed * vx_ih, speed * vy_ih
        m[d + X_OH * LANES], m[d + Y_OH * LANES] = speed * vx_oh, speed * vy_oh
        m[d + VX_IH * LANES], m[d + VY_IH * LANES] = speed * ax_ih, speed * ay_ih
        m[d + VX_OH * LANES], m[d + VY_OH * LANES] = speed * ax_oh, speed * ay_oh
        m[d + TIME * LANES], m[d + ROOT * LANES] = speed, 0.5 * slowed * rate
        m[d + IMPULSE * LANES], m[d + WORK * LANES] = speed * Fn, speed * (supplied - losses)
        m[d + LOSS * LANES] = speed * losses
        o = _EVALUATION * LANES + i
        m[o + DELTA * LANES], m[o + RATE * LANES], m[o + FORCE * LANES] = delta, rate, Fn
        force_rate = 1.5 * hardness * rate * (1.0 + ratio * rate) + (elastic * ratio + viscous) * normal_acceleration
        m[o + FORCE_RATE * LANES] = speed * force_rate
        m[o + HELD * LANES], m[o + SLIDING * LANES] = Ft, sliding
        m[o + NORMAL_X * LANES], m[o + NORMAL_Y * LANES] = nx, ny
        m[o + SLIDING_RATE * LANES] = speed * sliding_rate
        friction = Ft if Ft > 0.0 else -Ft
        excess = friction - m[c + FRICTION * LANES] * Fn
        event = delta if touching == 0.0 else -1.0
        event = excess if m[c + ROLLS * LANES] != 0.0 else event
        worst = m[o + WORST * LANES]
        m[o + WORST * LANES] = event if event > worst else worst


# Numbers of a lane besides its workspace.
(
    _RUN, _PHASE, _EVENT, _LOW, _HIGH, _LOW_VALUE, _HIGH_VALUE, _TRIALS, _STEP, _TAU_STEP, _CORNER, _STEPS,
    _REPEATED, _START_ENERGY, _ROLLS_SINCE, _TURN_START, _TURNS, _WORST_SHARE, _LAST_SHARE, _MARK_TIME, _MARK_TURNED,
    _ERROR, _FORCE_BEFORE, _FORCE_SLOPE, _OLD_X, _OLD_Y, _DEPTH, _SPEED, _MARGIN, _TRIAL, _CUT, _NEXT_INPUTS, _TRIES,
    _PER_TOLERANCE, _DEPTH_RATE, _SPEED_RATE,
    _CHANGED,
    _TOLERANCE,
    _HALVINGS,
    _PEAKS,
) = range(40)  # fmt: skip
_N_LANE = _PEAKS + 4
_NO_EVENT, _ONSET, _LIFT_OFF, _STICK, _SLIP, _CORNER_EVENT = range(6)


# fmt: off: the terms of a sum fill the lines.
@njit(cache=True, error_model="numpy", fastmath=False)
def _take_step(m):
    """Take one step in all lanes, from the state at `_Y` with its rates at `_K0`, to `_Z` with its rates at `_D`.

    Literal positions let the compiler see that the rows do not overlap, and so vectorise each loop.
    """
    y, z, h = _Y * LANES, _Z * LANES, _H * LANES
    for i in range(LANES):
        m[(_EVALUATION + WORST) * LANES + i] = -math.inf
    for stage in range(1, 13):
        if stage == 1:
            for n in range(_STAGE):
                m[z + n] = m[y + n] + m[h + n] * (_A[1][0] * m[_K0 + n])
        elif stage == 2:
            for n in range(_STAGE):
                m[z + n] = m[y + n] + m[h + n] * (_A[2][0] * m[_K0 + n] + _A[2][1] * m[_K1 + n])
        elif stage == 3:
            for n in range(_STAGE):
                m[z + n] = m[y + n] + m[h + n] * (_A[3][0] * m[_K0 + n] + _A[3][2] * m[_K2 + n])
        elif stage == 4:
            for n in range(_STAGE):
                m[z + n] = m[y + n] + m[h + n] * (_A[4][0] * m[_K0 + n] + _A[4][2] * m[_K2 + n] + _A[4][3] * m[_K3 + n])
        elif stage == 5:
            for n in range(_STAGE):
                m[z + n] = m[y + n] + m[h + n] * (_A[5][0] * m[_K0 + n] + _A[5][3] * m[_K3 + n] + _A[5][4] * m[_K4 + n])
        elif stage == 6:
            for n in range(_STAGE):
                m[z + n] = m[y + n] + m[h + n] * (
                    _A[6][0] * m[_K0 + n] + _A[6][3] * m[_K3 + n] + _A[6][4] * m[_K4 + n] + _A[6][5] * m[_K5 + n]
                )
        elif stage == 7:
            for n in range(_STAGE):
                m[z + n] = m[y + n] + m[h + n] * (
                    _A[7][0] * m[_K0 + n]
                    + _A[7][3] * m[_K3 + n]
                    + _A[7][4] * m[_K4 + n]
                    + _A[7][5] * m[_K5 + n]
                    + _A[7][6] * m[_K6 + n]
                )
        elif stage == 8:
            for n in range(_STAGE):
                m[z + n] = m[y + n] + m[h + n] * (
                    _A[8][0] * m[_K0 + n]
                    + _A[8][3] * m[_K3 + n]
                    + _A[8][4] * m[_K4 + n]
                    + _A[8][5] * m[_K5 + n]
                    + _A[8][6] * m[_K6 + n]
                    + _A[8][7] * m[_K7 + n]
                )
        elif stage == 9:
            for n in range(_STAGE):
                m[z + n] = m[y + n] + m[h + n] * (
                    _A[9][0] * m[_K0 + n]
                    + _A[9][3] * m[_K3 + n]
                    + _A[9][4] * m[_K4 + n]
                    + _A[9][5] * m[_K5 + n]
                    + _A[9][6] * m[_K6 + n]
                    + _A[9][7] * m[_K7 + n]
                    + _A[9][8] * m[_K8 + n]
                )
        elif stage == 10:
            for n in range(_STAGE):
                m[z + n] = m[y + n] + m[h + n] * (
                    _A[10][0] * m[_K0 + n]
                    + _A[10][3] * m[_K3 + n]
                    + _A[10][4] * m[_K4 + n]
                    + _A[10][5] * m[_K5 + n]
                    + _A[10][6] * m[_K6 + n]
                    + _A[10][7] * m[_K7 + n]
                    + _A[10][8] * m[_K8 + n]
                    + _A[10][9] * m[_K9 + n]
                )
        elif stage == 11:
            for n in range(_STAGE):
                m[z + n] = m[y + n] + m[h + n] * (
                    _A[11][0] * m[_K0 + n]
                    + _A[11][3] * m[_K3 + n]
                    + _A[11][4] * m[_K4 + n]
                    + _A[11][5] * m[_K5 + n]
                    + _A[11][6] * m[_K6 + n]
                    + _A[11][7] * m[_K7 + n]
                    + _A[11][8] * m[_K8 + n]
                    + _A[11][9] * m[_K9 + n]
                    + _A[11][10] * m[_K10 + n]
                )
        else:
            for n in range(_SIZE):
                m[z + n] = m[y + n] + m[h + n] * (
                    _B[0] * m[_K0 + n]
                    + _B[5] * m[_K5 + n]
                    + _B[6] * m[_K6 + n]
                    + _B[7] * m[_K7 + n]
                    + _B[8] * m[_K8 + n]
                    + _B[9] * m[_K9 + n]
                    + _B[10] * m[_K10 + n]
                    + _B[11] * m[_K11 + n]
                )
        evaluate(m)  # the only call: the compiler would insert the function at each of several
        into = m[_K0 + stage * _SIZE :]
        for n in range(_SIZE):
            into[n] = m[_D * LANES + n]


@njit(cache=True, error_model="numpy", fastmath=False)
def _estimate_errors(m, own, per_scale):
    """Write each lane's error over its limit, by Hairer's combination of two estimates."""
    coarse, fine, h = _SCRATCH * LANES, _SCRATCH * LANES + _STAGE, _H * LANES
    for n in range(_STAGE):
        m[coarse + n] = (
            _COARSE[0] * m[_K0 + n]
            + _COARSE[5] * m[_K5 + n]
            + _COARSE[6] * m[_K6 + n]
            + _COARSE[7] * m[_K7 + n]
            + _COARSE[8] * m[_K8 + n]
            + _COARSE[9] * m[_K9 + n]
            + _COARSE[10] * m[_K10 + n]
            + _COARSE[11] * m[_K11 + n]
        )
    for n in range(_STAGE):
        m[fine + n] = (
            _FINE[0] * m[_K0 + n]
            + _FINE[5] * m[_K5 + n]
            + _FINE[6] * m[_K6 + n]
            + _FINE[7] * m[_K7 + n]
            + _FINE[8] * m[_K8 + n]
            + _FINE[9] * m[_K9 + n]
            + _FINE[10] * m[_K10 + n]
            + _FINE[11] * m[_K11 + n]
        )
    for i in range(LANES):
        low = high = 0.0
        for row in range(ROOT + 1):
            first, second = m[coarse + row * LANES + i] * per_scale[row], m[fine + row * LANES + i] * per_scale[row]
            low += first * first
            high += second * second
        size = math.sqrt((high + 0.01 * low) * (ROOT + 1.0)) + 1e-300
        own[_ERROR, i] = own[_PER_TOLERANCE, i] * abs(m[h + i]) * high / size


# fmt: on


@njit(cache=True, error_model="numpy", fastmath=False)
def _evaluate_start(m, own):
    """Evaluate the rates at the start of the next step of the lanes that have changed.

    The rates of the other lanes stay, as they may differ in the last bits: a run must not depend on its neighbours.
    """
    for n in range(_SIZE):
        m[_Z * LANES + n] = m[_Y * LANES + n]
    evaluate(m)
    for i in range(LANES):
        if own[_CHANGED, i] != 0.0:
            for n in range(i, _SIZE, LANES):
                m[_K0 + n] = m[_D * LANES + n]


@njit(cache=True, error_model="numpy", fastmath=False)
def _depth(m, i):
    """Return the penetration of a lane's shaft into the ring [m], at least 1e-14 m."""
    y, c = _Y * LANES + i, _C * LANES + i
    ex = m[c + ARM_RING * LANES] * m[y + UX * LANES] - m[y + X_IH * LANES] - m[c + OFFSET_X * LANES]
    ey = m[c + ARM_RING * LANES] * m[y + UY * LANES] - m[y + Y_IH * LANES] - m[c + OFFSET_Y * LANES]
    return max(1e-14, math.sqrt(ex * ex + ey * ey) - m[c + CLEARANCE * LANES])


@njit(cache=True, error_model="numpy", fastmath=False)
def _energy(m, i):
    """Return the energy of a lane's rig [J]."""
    y, c = _Y * LANES + i, _C * LANES + i
    ux, uy, px, py = m[y + UX * LANES], m[y + UY * LANES], m[y + PX * LANES], m[y + PY * LANES]
    large, arm = m[c + LARGE * LANES], m[c + ARM_MAGNET * LANES]
    pz = -large * (ux * px + uy * py) / math.sqrt(1.0 - large * (ux * ux + uy * uy))
    total = 0.5 * (px * px + py * py + pz * pz) / m[c + PER_INERTIA * LANES]
    total += 0.5 * m[y + SPIN * LANES] ** 2 / m[c + PER_POLAR * LANES] + m[c + WEIGHT_MOMENT * LANES] * uy
    total += 0.5 * (m[y + VX_IH * LANES] ** 2 + m[y + VY_IH * LANES] ** 2) / m[c + PER_INNER * LANES]
    total += 0.5 * (m[y + VX_OH * LANES] ** 2 + m[y + VY_OH * LANES] ** 2) / m[c + PER_OUTER * LANES]
    s = arm * arm * (ux * ux + uy * uy)
    series = 1.0 + s * (m[c + A3 * LANES] / 2.0 + s * (m[c + A5 * LANES] / 3.0 + s * m[c + A7 * LANES] / 4.0))
    total += m[c + ENGAGED * LANES] * 0.5 * m[c + MAGNET * LANES] * s * series
    x_oh, y_oh, preload = m[y + X_OH * LANES], m[y + Y_OH * LANES], m[c + PRELOAD * LANES]
    total += 0.5 * m[c + INNER_BEAM * LANES] * (m[y + X_IH * LANES] - x_oh) ** 2
    total += 0.5 * m[c + OUTER_BEAM * LANES] * y_oh * y_oh
    for pair in range(2):
        stiffness = m[c + (PAIR_VERTICAL + pair) * LANES]
        change = 0.5 * stiffness * (m[y + Y_IH * LANES] - y_oh if pair == 0 else x_oh)
        first, second = max(0.0, preload + change), max(0.0, preload - change)
        total += (first * first + second * second - 2.0 * preload * preload) / stiffness
    depth = _depth(m, i)
    return total + m[c + TOUCHING * LANES] * 0.4 * m[c + STIFFNESS * LANES] * depth * depth * math.sqrt(depth)


@njit(cache=True, error_model="numpy", fastmath=False)
def _peak(before, slope, after, end_slope, h):
    """Return the largest magnitude of a cubic on a step, from values and slopes at both ends."""
    largest = max(abs(before), abs(after))
    if slope * end_slope >= 0.0:
        return largest
    rise, first, last = after - before, slope * h, end_slope * h
    cubic, square = first + last - 2.0 * rise, 3.0 * rise - 2.0 * first - last
    # 3 cubic t^2 + 2 square t + first = 0, without cancellation.
    root = math.sqrt(max(0.0, square * square - 3.0 * cubic * first))
    half = -(square + math.copysign(root, square))
    for n in range(2):
        t = (half / (3.0 * cubic) if cubic != 0.0 else -1.0) if n == 0 else (first / half if half != 0.0 else -1.0)
        if 0.0 < t < 1.0:
            largest = max(largest, abs(before + t * (first + t * (square + t * cubic))))
    return largest


@njit(cache=True, error_model="numpy", fastmath=False)
def _set_phase(m, own, i, phase):
    """Set the contact phase of a lane, and the factors of the equations that follow from it."""
    c = _C * LANES + i
    own[_PHASE, i] = phase
    slides = phase != FLIGHT and phase != ROLLING
    m[c + TOUCHING * LANES] = 0.0 if phase == FLIGHT else 1.0
    m[c + SLOWED * LANES] = 1.0 if slides else 0.0
    m[c + SIGN * LANES] = 1.0 if phase == FORWARD else (-1.0 if phase == BACKWARD else 0.0)
    m[c + ROLLS * LANES] = 1.0 if phase == ROLLING else 0.0
    if phase == ROLLING:
        own[_ROLLS_SINCE, i], own[_TURNS, i] = m[_Y * LANES + TIME * LANES + i], 0.0
        own[_WORST_SHARE, i], own[_LAST_SHARE, i] = 0.0, math.inf
    else:
        own[_ROLLS_SINCE, i] = math.nan


@njit(cache=True, error_model="numpy", fastmath=False)
def _load_run(m, own, i, run, batch, result):
    """Start a run in a lane."""
    constants, initial, schedule, ends, watch_s, tolerances = batch
    c, y = _C * LANES + i, _Y * LANES + i
    for n in range(N_CONSTANTS):
        m[c + n * LANES] = constants[run, n]
    for n in range(N_INPUTS):
        m[c + (N_CONSTANTS + n) * LANES] = schedule[run, 0, 1 + n]
    for n in range(N_VECTOR):
        m[y + n * LANES] = initial[run, n] if n < N_STATE else 0.0
    phase, m[c + ONSET * LANES] = initial[run, N_STATE], max(initial[run, N_STATE + 1], m[c + SPEED_FLOOR * LANES])
    for n in range(_N_LANE):
        own[n, i] = 0.0
    own[_RUN, i], own[_STEP, i], own[_CHANGED, i], own[_TOLERANCE, i] = run, 1e-5, 1.0, tolerances[run]
    if phase != FLIGHT:
        own[_TRIES, i] = 1.0 if phase == ROLLING else 0.0
        own[_TAU_STEP, i] = 1e-5 / math.sqrt(_depth(m, i))
        m[y + ROOT * LANES] = math.sqrt(_depth(m, i))
    _set_phase(m, own, i, phase)
    own[_START_ENERGY, i] = _energy(m, i)
    for n in range(N_RESULTS):
        result[i, n] = 0.0
    result[i, FIRST_CONTACT] = result[i, LAST_CONTACT] = result[i, WHIRL_TIME] = math.nan
    own[_CORNER, i] = _next_corner(schedule[run], 0, ends[run], watch_s[run], 0.0)


@njit(cache=True, error_model="numpy", fastmath=False)
def _next_corner(schedule, position, end, watch_s, now):
    """Return the next instant at which inputs change, the watch begins, or the run ends [s]."""
    corner = end
    if position + 1 < len(schedule):
        corner = min(corner, schedule[position + 1, 0])
    if now < end - watch_s:
        corner = min(corner, end - watch_s)
    return corner


@njit(cache=True, error_model="numpy", fastmath=False)
def _event_value(m, own, i, event):
    """Return an event's function at the end of a step, below 0 before the event, and its slope; nan if unknown."""
    seen, z = _EVALUATION * LANES + i, _Z * LANES + i
    if event == _ONSET:
        return m[seen + DELTA * LANES], m[seen + RATE * LANES]
    if event == _LIFT_OFF:
        if own[_PHASE, i] == ROLLING:
            return -m[seen + DELTA * LANES], -m[seen + RATE * LANES]
        return -m[z + ROOT * LANES], -0.5 * m[seen + RATE * LANES]
    if event == _STICK:
        sign = m[_C * LANES + SIGN * LANES + i]
        return -sign * m[seen + SLIDING * LANES], -sign * m[seen + SLIDING_RATE * LANES]
    if event == _SLIP:
        return abs(m[seen + HELD * LANES]) - m[_C * LANES + FRICTION * LANES + i] * m[seen + FORCE * LANES], math.nan
    return m[z + TIME * LANES] - own[_CORNER, i], m[_D * LANES + TIME * LANES + i]


@njit(cache=True, error_model="numpy", fastmath=False)
def _find_event(m, own, i):
    """Return an event within a step, by the end of the step."""
    phase = own[_PHASE, i]
    if phase == FLIGHT:
        return _ONSET if _event_value(m, own, i, _ONSET)[0] > 1e-12 else _NO_EVENT
    if _event_value(m, own, i, _LIFT_OFF)[0] > 0.0:
        if phase == ROLLING:
            return _SLIP
        return _LIFT_OFF
    if phase == ROLLING:
        return _SLIP if _event_value(m, own, i, _SLIP)[0] > 0.0 else _NO_EVENT
    if phase != FREE_SLIDING and _event_value(m, own, i, _STICK)[0] > 1e-7:
        return _STICK
    if m[_Z * LANES + TIME * LANES + i] > own[_CORNER, i] + 1e-12:
        return _CORNER_EVENT
    return _NO_EVENT


@njit(cache=True, error_model="numpy", fastmath=False)
def _start_value(m, own, i, event):
    """Return an event's function at the start of a step, below 0, and its slope; nan if unknown."""
    value, slope = own[_MARGIN, i], math.nan
    if event == _ONSET:
        value, slope = own[_DEPTH, i], own[_DEPTH_RATE, i]
    elif event == _LIFT_OFF:
        value, slope = -m[(_Y + ROOT) * LANES + i], -0.5 * own[_DEPTH_RATE, i]
    elif event == _STICK:
        sign = m[(_C + SIGN) * LANES + i]
        value, slope = -sign * own[_SPEED, i], -sign * own[_SPEED_RATE, i]
    elif event == _CORNER_EVENT:
        value, slope = m[(_Y + TIME) * LANES + i] - own[_CORNER, i], m[(_K + TIME) * LANES + i]
    return min(value, -1e-300), slope


@njit(cache=True, error_model="numpy", fastmath=False)
def _begin_location(m, own, i, h, event):
    """Start the location of an event in a step, with the zero of a cubic as the first trial where slopes are known."""
    start, first = _start_value(m, own, i, event)
    value, last = _event_value(m, own, i, event)
    own[_EVENT, i], own[_TRIALS, i], own[_LOW, i], own[_HIGH, i] = event, 0.0, 0.0, h
    own[_LOW_VALUE, i], own[_HIGH_VALUE, i] = start, value
    rise, first, last = value - start, first * h, last * h
    if not math.isfinite(first + last):
        first = last = rise
    cubic, square = first + last - 2.0 * rise, 3.0 * rise - 2.0 * first - last
    low, high, t = 0.0, 1.0, -start / rise
    for _ in range(12):
        at = start + t * (first + t * (square + t * cubic))
        if at < 0.0:
            low = t
        else:
            high = t
        slope = first + t * (2.0 * square + 3.0 * t * cubic)
        t = t - at / slope if slope > 0.0 else -1.0
        if not low < t < high:
            t = 0.5 * (low + high)
    own[_TRIAL, i] = t * h


@njit(cache=True, error_model="numpy", fastmath=False)
def _next_trial(own, i, h, value, slope):
    """Narrow the bracket of an event by a trial of length h, and return the length of the next."""
    if value < 0.0:
        own[_LOW, i], own[_LOW_VALUE, i] = h, value
        own[_HIGH_VALUE, i] *= 0.5 if own[_TRIALS, i] > 1.0 else 1.0
    else:
        own[_HIGH, i], own[_HIGH_VALUE, i] = h, value
        own[_LOW_VALUE, i] *= 0.5 if own[_TRIALS, i] > 1.0 else 1.0
    low, high = own[_LOW, i], own[_HIGH, i]
    trial = h - value / slope  # nan without a slope
    if not low < trial < high:
        low_value, high_value = own[_LOW_VALUE, i], own[_HIGH_VALUE, i]
        trial = high - high_value * (high - low) / (high_value - low_value)
        if not low < trial < high:
            trial = 0.5 * (low + high)
    return trial


@njit(cache=True, error_model="numpy", fastmath=False)
def _is_located(m, own, i, event, value):
    """Return whether an event's function is close enough to 0 at the end of a step."""
    if own[_TRIALS, i] >= _MAX_LOCATIONS or own[_HIGH, i] - own[_LOW, i] < 1e-14 * own[_HIGH, i]:
        return True
    if event in (_ONSET, _CORNER_EVENT):
        return abs(value) < 1e-12
    if event in (_LIFT_OFF, _STICK):
        return abs(value) < 1e-7
    return abs(value) < 1e-6 * (1e-3 + m[_EVALUATION * LANES + FORCE * LANES + i])


@njit(cache=True, error_model="numpy", fastmath=False)
def _find_peaks(m, own, i, result):
    """Find the peaks of force, squared radius and displacements of the transducers within a lane's step.

    Returns:
        True if one exceeds both ends of the step and all before it: a shorter step finds it more accurately.
    """
    y, z, k, d = _Y * LANES + i, _Z * LANES + i, _K * LANES + i, _D * LANES + i
    c, seen, h, coarse = _C * LANES + i, _EVALUATION * LANES + i, m[_H * LANES + i], False
    ratio = m[c + ARM_DISK * LANES] / m[c + ARM_RING * LANES]
    offset_x, offset_y, disk = ratio * m[c + OFFSET_X * LANES], ratio * m[c + OFFSET_Y * LANES], m[c + ARM_DISK * LANES]
    for n in range(4):
        if n == 0:
            start, end = own[_FORCE_BEFORE, i], m[seen + FORCE * LANES]
            slope, last = own[_FORCE_SLOPE, i], m[seen + FORCE_RATE * LANES]
        elif n == 1:
            x0, y0 = disk * m[y + UX * LANES] - offset_x, disk * m[y + UY * LANES] - offset_y
            x1, y1 = disk * m[z + UX * LANES] - offset_x, disk * m[z + UY * LANES] - offset_y
            start, end = x0 * x0 + y0 * y0, x1 * x1 + y1 * y1
            slope = 2.0 * disk * (x0 * m[k + UX * LANES] + y0 * m[k + UY * LANES])
            last = 2.0 * disk * (x1 * m[d + UX * LANES] + y1 * m[d + UY * LANES])
        elif n == 2:
            start, end = m[y + X_OH * LANES], m[z + X_OH * LANES]
            slope, last = m[k + X_OH * LANES], m[d + X_OH * LANES]
        else:
            start, end = m[y + Y_IH * LANES] - m[y + Y_OH * LANES], m[z + Y_IH * LANES] - m[z + Y_OH * LANES]
            slope, last = m[k + Y_IH * LANES] - m[k + Y_OH * LANES], m[d + Y_IH * LANES] - m[d + Y_OH * LANES]
        peak = _peak(start, slope, end, last, h)
        own[_PEAKS + n, i] = peak
        coarse = coarse or peak > _NEW_PEAK * max(abs(start), abs(end), result[i, PEAK_FORCE + n])
    return coarse


@njit(cache=True, error_model="numpy", fastmath=False)
def _accept(m, own, i, result):
    """Take over the end of a lane's step as its state, and collect the results within the step."""
    y, z, k, d = _Y * LANES + i, _Z * LANES + i, _K * LANES + i, _D * LANES + i
    seen, mine = _EVALUATION * LANES + i, result[i]
    own[_STEPS, i] += 1.0
    own[_HALVINGS, i] = 0.0
    if own[_PHASE, i] != FLIGHT:
        mine[CONTACT_TIME] += m[z + TIME * LANES] - m[y + TIME * LANES]
    for n in range(4):
        mine[PEAK_FORCE + n] = max(mine[PEAK_FORCE + n], own[_PEAKS + n, i])
    nx, ny = m[seen + NORMAL_X * LANES], m[seen + NORMAL_Y * LANES]
    cosine = own[_OLD_X, i] * nx + own[_OLD_Y, i] * ny
    sine = own[_OLD_X, i] * ny - own[_OLD_Y, i] * nx
    if cosine > 0.98:  # nearly always: the series is exact to 1e-12, and takes a tenth of the time
        q = sine * sine
        mine[TURNED] += sine * (1.0 + q * (1.0 / 6.0 + q * (0.075 + q * (15.0 / 336.0 + q * (105.0 / 3456.0)))))
    else:
        mine[TURNED] += math.atan2(sine, cosine)
    for n in range(N_VECTOR):
        m[y + n * LANES] = m[z + n * LANES]
        m[k + n * LANES] = m[d + n * LANES]
    _remember_start(m, own, i)


@njit(cache=True, error_model="numpy", fastmath=False)
def _remember_start(m, own, i):
    """Keep what the start of the next step has besides its state."""
    seen = _EVALUATION * LANES + i
    own[_FORCE_BEFORE, i], own[_FORCE_SLOPE, i] = m[seen + FORCE * LANES], m[seen + FORCE_RATE * LANES]
    own[_OLD_X, i], own[_OLD_Y, i] = m[seen + NORMAL_X * LANES], m[seen + NORMAL_Y * LANES]
    own[_DEPTH, i], own[_SPEED, i] = m[seen + DELTA * LANES], m[seen + SLIDING * LANES]
    own[_DEPTH_RATE, i], own[_SPEED_RATE, i] = m[seen + RATE * LANES], m[seen + SLIDING_RATE * LANES]
    own[_MARGIN, i] = abs(m[seen + HELD * LANES]) - m[_C * LANES + FRICTION * LANES + i] * m[seen + FORCE * LANES]


@njit(cache=True, error_model="numpy", fastmath=False)
def _apply_event(m, own, i, event, result):
    """Change the phase of a lane at an event, at the start of its next step."""
    y, c, seen, mine = _Y * LANES + i, _C * LANES + i, _EVALUATION * LANES + i, result[i]
    now, slide = m[y + TIME * LANES], m[seen + SLIDING * LANES]
    if event == _ONSET:
        speed = m[seen + RATE * LANES]
        m[c + ONSET * LANES] = max(speed, m[c + SPEED_FLOOR * LANES])
        m[y + ROOT * LANES] = 0.0
        if speed < 1e-6:
            m[y + ROOT * LANES] = 1e-6
        mine[CONTACTS] += 1.0
        mine[LAST_CONTACT] = now
        if mine[CONTACTS] == 1.0:
            mine[FIRST_CONTACT] = now
        phase = FREE_SLIDING
        if m[c + FRICTION * LANES] > 0.0:
            phase = FORWARD if slide > 0.0 else BACKWARD
        # About a tenth of the contact: s' = delta'/2, up to the root of a penetration by an effective mass of 1 kg.
        deepest = (1.25 * speed * speed / m[c + STIFFNESS * LANES]) ** 0.2
        own[_TAU_STEP, i] = 0.6 * deepest / max(speed, 1e-3)
        _set_phase(m, own, i, phase)
    elif event == _LIFT_OFF:
        m[y + ROOT * LANES] = 0.0
        mine[LAST_CONTACT] = now
        _set_phase(m, own, i, FLIGHT)
    elif event == _STICK:
        # Try to roll; `_resolve_stick` decides by the friction force that this needs.
        m[y + SPIN * LANES] -= slide / m[c + RADIUS * LANES]
        own[_TRIES, i] = 1.0
        _set_phase(m, own, i, ROLLING)
    elif event == _SLIP:
        forward = m[seen + HELD * LANES] > 0.0
        depth = max(m[seen + DELTA * LANES], 1e-14)
        m[y + ROOT * LANES] = math.sqrt(depth)
        own[_TAU_STEP, i] = own[_STEP, i] / math.sqrt(depth)
        _set_phase(m, own, i, FORWARD if forward else BACKWARD)


@njit(cache=True, error_model="numpy", fastmath=False)
def _resolve_stick(m, own, i):
    """Keep rolling if friction suffices, else slide in the direction of the force; return whether the phase changed."""
    c, seen = _C * LANES + i, _EVALUATION * LANES + i
    own[_TRIES, i] = 0.0
    needed = m[seen + HELD * LANES]
    if abs(needed) <= m[c + FRICTION * LANES] * m[seen + FORCE * LANES]:
        return False
    m[_Y * LANES + ROOT * LANES + i] = math.sqrt(max(m[seen + DELTA * LANES], 1e-14))
    _set_phase(m, own, i, FORWARD if needed > 0.0 else BACKWARD)
    return True


@njit(cache=True, error_model="numpy", fastmath=False)
def _reach_corner(m, own, i, batch, result):
    """Change a lane's inputs, begin the watch, or return True at the end of the run."""
    _, _, schedule, ends, watch_s, _ = batch
    run, y, c, mine = int(own[_RUN, i]), _Y * LANES + i, _C * LANES + i, result[i]
    now = own[_CORNER, i]
    m[y + TIME * LANES] = now
    if now >= ends[run]:
        return True
    if now == ends[run] - watch_s[run]:
        mine[WATCHED], mine[WATCHED_CONTACT], mine[WATCHED_TURN] = now, mine[CONTACT_TIME], mine[TURNED]
    position = int(own[_NEXT_INPUTS, i])
    if position + 1 < schedule.shape[1] and now == schedule[run, position + 1, 0]:
        own[_NEXT_INPUTS, i] = position + 1
        before = _energy(m, i)
        for n in range(N_INPUTS):
            m[c + (N_CONSTANTS + n) * LANES] = schedule[run, position + 1, 1 + n]
        m[y + WORK * LANES] += _energy(m, i) - before
    own[_CORNER, i] = _next_corner(schedule[run], int(own[_NEXT_INPUTS, i]), ends[run], watch_s[run], now)
    return False


@njit(cache=True, error_model="numpy", fastmath=False)
def _outcome_is_certain(m, own, i, batch):
    """Return the status of a run whose outcome no longer changes, or UNFINISHED.

    No input may change any more. A run stays free if its amplitudes cannot add up to a contact while they decay. It
    stays in backward whirl if it has rolled for several turns, with the friction force below its limit by a margin
    in the last.
    """
    run, y, c = int(own[_RUN, i]), _Y * LANES + i, _C * LANES + i
    schedule = batch[2]
    position = int(own[_NEXT_INPUTS, i])
    if position + 1 < schedule.shape[1] and schedule[run, position + 1, 0] < math.inf:
        return UNFINISHED
    if own[_PHASE, i] == FLIGHT:
        arm, per = m[c + ARM_RING * LANES], m[c + PER_FREQUENCY * LANES]
        x, dx = m[y + UX * LANES] - m[c + REST_X * LANES], m[y + PX * LANES] * per
        height, dy = m[y + UY * LANES] - m[c + REST_Y * LANES], m[y + PY * LANES] * per
        reach = arm * math.sqrt(x * x + dx * dx + height * height + dy * dy)
        reach += 2.0 * (abs(m[y + X_IH * LANES]) + abs(m[y + Y_IH * LANES]))
        return STAYS_FREE if reach < m[c + FREE_RADIUS * LANES] else UNFINISHED
    if own[_PHASE, i] == ROLLING and own[_TURNS, i] >= _WHIRL_TURNS:
        return STAYS_WHIRLING if own[_LAST_SHARE, i] < _WHIRL_MARGIN else UNFINISHED
    return UNFINISHED


@njit(cache=True, error_model="numpy", fastmath=False)
def _watch_whirl(m, own, i, result):
    """Count the turns of a rolling contact, and keep its largest share of the friction limit in a turn."""
    seen, mine, now = _EVALUATION * LANES + i, result[i], m[_Y * LANES + TIME * LANES + i]
    limit = m[_C * LANES + FRICTION * LANES + i] * m[seen + FORCE * LANES]
    own[_WORST_SHARE, i] = max(own[_WORST_SHARE, i], abs(m[seen + HELD * LANES]) / max(limit, 1e-300))
    if own[_TURNS, i] == 0.0 and own[_TURN_START, i] == 0.0:
        own[_TURN_START, i], own[_MARK_TIME, i] = mine[TURNED], math.nan
    if abs(mine[TURNED] - own[_TURN_START, i]) >= 2.0 * math.pi:
        own[_TURNS, i] += 1.0
        if own[_TURNS, i] == 1.0:
            own[_MARK_TIME, i], own[_MARK_TURNED, i] = now, mine[TURNED]
        own[_TURN_START, i] = mine[TURNED]
        own[_LAST_SHARE, i], own[_WORST_SHARE, i] = own[_WORST_SHARE, i], 0.0


@njit(cache=True, error_model="numpy", fastmath=False)
def _finish(m, own, i, status, result):
    """Complete the results of a lane's run."""
    y, c, mine = _Y * LANES + i, _C * LANES + i, result[i]
    now = m[y + TIME * LANES]
    mine[STATUS], mine[END] = status, now
    mine[STEPS], mine[REPEATED] = own[_STEPS, i], own[_REPEATED, i]
    mine[CONTACT_IMPULSE], mine[DISSIPATED] = m[y + IMPULSE * LANES], m[y + LOSS * LANES]
    mine[RESIDUAL] = _energy(m, i) - own[_START_ENERGY, i] - m[y + WORK * LANES]
    for pair in range(2):
        # A transducer that has lost its preload no longer contributes.
        change = 0.5 * m[c + (PAIR_VERTICAL + pair) * LANES] * mine[PEAK_Y - pair]
        mine[PEAK_Y - pair] = change + min(change, m[c + PRELOAD * LANES])
    mine[PEAK_RADIUS] = math.sqrt(mine[PEAK_RADIUS])
    for n in range(N_STATE):
        mine[END_STATE + n] = m[y + n * LANES]
    mine[END_STATE + N_STATE], mine[END_STATE + N_STATE + 1] = own[_PHASE, i], m[c + ONSET * LANES]
    if own[_PHASE, i] != FLIGHT:
        mine[LAST_CONTACT] = now
    if own[_PHASE, i] == ROLLING:
        mine[WHIRL_TIME] = own[_ROLLS_SINCE, i]
    if status == STAYS_WHIRLING:
        # Over the turns since the first.
        mine[WATCHED], mine[WATCHED_TURN] = own[_MARK_TIME, i], own[_MARK_TURNED, i]
        mine[WATCHED_CONTACT] = mine[CONTACT_TIME] - (now - own[_MARK_TIME, i])


@njit(inline="always", error_model="numpy", fastmath=False)
def _step_factor(error):
    """Return the factor of the next step by its error: 0.9 error^(-1/8)."""
    return 0.9 / math.sqrt(math.sqrt(math.sqrt(error)))


@njit(cache=True, error_model="numpy", fastmath=False)
def _decide(m, own, i, batch, early, result):
    """Accept or repeat a lane's step, and apply the event at its end.

    Returns:
        Status of the run, and whether its rates must be evaluated again.
    """
    h, error, event = m[_H * LANES + i], own[_ERROR, i], int(own[_EVENT, i])
    slowed = m[_C * LANES + SLOWED * LANES + i] != 0.0
    controlled = _TAU_STEP if slowed else _STEP
    own[_REPEATED, i] += 1.0
    if own[_REPEATED, i] > 3.0 * _MAX_STEPS or own[_STEPS, i] > _MAX_STEPS:
        return GIVEN_UP, True
    if not error <= 1.0 and event == _NO_EVENT:
        own[controlled, i] = h * (max(0.2, _step_factor(error)) if math.isfinite(error) else 0.1)
        return (UNFINISHED, False) if own[controlled, i] > _MIN_STEP else (GIVEN_UP, True)
    if event == _NO_EVENT:
        event = _find_event(m, own, i)
        if event != _NO_EVENT:
            _begin_location(m, own, i, h, event)
            if not _is_located(m, own, i, event, _event_value(m, own, i, event)[0]):
                return UNFINISHED, False
        elif (
            m[(_EVALUATION + WORST) * LANES + i] > 1e-12
            and h > 1e-6
            and (own[_PHASE, i] == FLIGHT or own[_MARGIN, i] < 0.0)
        ):
            own[controlled, i] = 0.5 * h
            return UNFINISHED, False
    if event != _NO_EVENT:
        value, slope = _event_value(m, own, i, event)
        if not _is_located(m, own, i, event, value):
            own[_TRIAL, i] = _next_trial(own, i, h, value, slope)
            own[_TRIALS, i] += 1.0
            return UNFINISHED, False
        other = _find_event(m, own, i)
        if other != _NO_EVENT and other != event:
            _begin_location(m, own, i, h, other)
            return UNFINISHED, False
    if _find_peaks(m, own, i, result) and event == _NO_EVENT and own[_HALVINGS, i] < _MAX_HALVINGS:
        own[controlled, i], own[_HALVINGS, i] = 0.5 * h, own[_HALVINGS, i] + 1.0
        return UNFINISHED, False
    own[_EVENT, i] = _NO_EVENT
    _accept(m, own, i, result)
    changed = False
    if event == _NO_EVENT:
        factor = _step_factor(max(error, 1e-9))
        if own[_CUT, i] != 0.0:
            factor = min(factor, 1.0)
        # Little growth is not worth it: the error of ringing housings varies, and would repeat every third step.
        if factor < 1.0 or factor > _WORTHWHILE_GROWTH:
            own[controlled, i] = h * min(3.0, factor)
    elif event != _CORNER_EVENT:
        _apply_event(m, own, i, event, result)
        changed = True
    if own[_PHASE, i] == ROLLING and not changed:
        m[_Y * LANES + SPIN * LANES + i] -= m[(_EVALUATION + SLIDING) * LANES + i] / m[_C * LANES + RADIUS * LANES + i]
        _watch_whirl(m, own, i, result)
    if event == _CORNER_EVENT or m[(_Y + TIME) * LANES + i] >= own[_CORNER, i] - 1e-12:
        changed = True
        if _reach_corner(m, own, i, batch, result):
            return RAN, True
    status = _outcome_is_certain(m, own, i, batch) if early else UNFINISHED
    return status, changed or status != UNFINISHED


@njit(cache=True, error_model="numpy", fastmath=False)
def _choose_step(m, own, i):
    """Set the length of a lane's next step or trial."""
    own[_CUT, i] = 0.0
    if own[_EVENT, i] != _NO_EVENT:
        h = own[_TRIAL, i]
    elif m[(_C + SLOWED) * LANES + i] != 0.0:
        h = own[_TAU_STEP, i]
    else:
        h, left = min(own[_STEP, i], _MAX_STEP), own[_CORNER, i] - m[(_Y + TIME) * LANES + i]
        if h >= left:
            h, own[_CUT, i] = left, 1.0
    for row in range(N_VECTOR):
        m[(_H + row) * LANES + i] = h


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def march(batch, per_scale, early, results):
    """Run a batch to the end, and write its results.

    Args:
        batch: Constants, shape (n, N_CONSTANTS); starts, shape (n, N_START); schedules, shape (n, k, 1 +
            N_INPUTS), each row an instant [s] and the inputs from then on, unused rows at infinity; ends [s], shape
            (n,); lengths of the watch before the end [s], and
            scaled errors per step, shape (n,).
        per_scale: Reciprocal of the scale of each state, time and root in a step's error, shape (ROOT + 1,).
        early: Whether runs end when their outcome is certain.
        results: Out, shape (n, N_RESULTS).
    """
    count = len(batch[0])
    room = np.zeros(_ROWS * LANES + 8)
    m = room[(-room.ctypes.data % 64) // 8 :]
    own, mine = np.zeros((_N_LANE, LANES)), np.zeros((LANES, N_RESULTS))
    busy, waiting = min(LANES, count), min(LANES, count)
    for i in range(LANES):
        _load_run(m, own, i, min(i, count - 1), batch, mine)  # an idle lane repeats the last run
        if i >= count:
            own[_RUN, i] = -1.0
    changed = True
    while busy > 0:
        if changed:
            _evaluate_start(m, own)
            again = False
            for i in range(LANES):
                if own[_TRIES, i] != 0.0:
                    again = _resolve_stick(m, own, i) or again
            if again:
                _evaluate_start(m, own)
            for i in range(LANES):
                if own[_CHANGED, i] != 0.0:
                    own[_CHANGED, i] = 0.0
                    _remember_start(m, own, i)
        for i in range(LANES):
            _choose_step(m, own, i)
            own[_PER_TOLERANCE, i] = (_ROLLING_GAIN if own[_PHASE, i] == ROLLING else 1.0) / own[_TOLERANCE, i]
        _take_step(m)
        _estimate_errors(m, own, per_scale)
        changed = False
        for i in range(LANES):
            if own[_RUN, i] < 0.0:
                continue
            status, new = _decide(m, own, i, batch, early, mine)
            if new:
                own[_CHANGED, i], changed = 1.0, True
            if status == UNFINISHED:
                continue
            _finish(m, own, i, status, mine)
            results[int(own[_RUN, i])] = mine[i]
            if waiting < count:
                _load_run(m, own, i, waiting, batch, mine)
                waiting += 1
            else:
                own[_RUN, i], own[_EVENT, i], busy = -1.0, _NO_EVENT, busy - 1
