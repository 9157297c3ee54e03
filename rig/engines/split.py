"""Splitting: the exact flow of everything linear, one kick a step for everything else; order 2, cheap, and bounded.

A step is half a flow, a kick, half a flow. The flow solves shaft on linear magnets, drive and both houses exactly:
the houses ring at up to 1.6 kHz and cost no accuracy. The kick holds the contact, the magnets' hardening, gravity,
unbalance, the hammer and the turning of the axis.

State inside: the direction of the axis, u = (sin b, -sin G cos b), and its rate p. In these, a point at arm l is l u,
the kinematics have no sines, and with S the sum of arm times lateral force

    Ixx u'' = S - (S.u) u - Ixx |u'|^2 u + Izz w (u x u')

Errors of second order of such a step are two commutators of flow A and kick B. [B,[A,B]] goes into the kick: with the
contact's force f on the relative motion at the ring and the flow's acceleration a of it, that is
2 (f.grad) f + (v.grad f_v) f - f_v (v.grad f + f_v a) on the speed and -f_v f on the position, h^3/24 of each. For an
undamped contact it is Takahashi and Imada's F* = F (1 - h^2/12 F' w_n) (J. Phys. Soc. Jpn. 53 (1984) 3765); what comes
next in h^2 F' w_n is chosen for a lasting contact to keep its true depth. [A,[A,B]] is a change of coordinates by
h^2/24 [A,B] (the processing of Blanes, Casas and Murua, SIAM J. Sci. Comput. 27 (2006) 1817): it vanishes out of
contact, so an impact returns the right speeds; at the end of a step, where the next one is of another length, and for
the rows it is carried out. Where a contact begins and ends, its force goes as t^n between two kicks; what the sum
misses there is Hurwitz' zeta(-n, q). Left out of both commutators: the houses' damping, and friction where it rolls.

The normal impulse holds its damping in closed form. Coulomb's friction is a clamp on the tangential impulse: what
would bring the sliding speed to its target, held within mu times the normal impulse. The target is minus half of what
the flow changed since the last kick, so that the speed is 0 in the mean of a step and not at its end: with a target
of 0 the order is 1. Rolling is not processed, so order 2 is all there is.

Steps are powers of two of the grid's step, by rules on the state alone: long in flight as far as the gap cannot
close, short through impacts (they make small errors a thousand times larger), the grid's own in settled contact.

The houses' momentum ledger is the flow's own, so its residual is 0 by construction; the energy residual is not.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rig.engines.memory import (
    CLAMPS,
    CONTACT_STEPS,
    CONTACTS,
    EVALUATIONS,
    FLOORED,
    ONSET,
    OWN,
    PEAK_FORCE,
    PHASE,
    STEPS,
)
from rig.engines.peak import peak
from rig.kernels import signals as S
from rig.kernels.angles import arc_sine, sin_cos
from rig.kernels.contact import BACKWARD, FLIGHT, FORWARD, NO_FRICTION, ROLLING, elastic_force
from rig.kernels.dynamics import drive_speed, evaluate
from rig.kernels.magnet import magnet_force

ORDER = 2

_FAST = {"contract", "reassoc", "arcp", "nsz"}
"""What the compiler may do beyond the rules of IEEE 754: fuse, reorder, take reciprocals. One build makes the same bits
every time all the same, in 5/6 of the time. Nothing that assumes that there is no nan."""

_UX, _UY, _PX, _PY, _SPIN, _THETA = range(OWN, OWN + 6)
_X = OWN + 6  # inner displacement and rate, outer displacement and rate, horizontal
_Y = OWN + 10  # the same, vertical
_SLID, _DEPTH, _RATE, _AGO = range(OWN + 14, OWN + 18)
"""Sliding speed after the last kick, nan before the first of a contact; penetration, its rate and the time since the
last kick in flight."""
_BEFORE, _LAST, _BEFORE_SPAN, _LAST_STEP = OWN + 18, OWN + 19, OWN + 40, OWN + 41
"""Normal force at the last kick but one, and at the last [N]; time between both; length of the last's step [s]."""
_WANTED, _SETTLED, _BOUNCE = OWN + 20, OWN + 21, OWN + 22
_REST, _SPRING_X, _SPRING_Y = OWN + 23, OWN + 24, OWN + 25
"""Level asked for in contact, calm kicks in a row, mean rate of the gap in the last kick; rest of the shaft on its
magnets and the springs of its flow about it."""
_KICKED, _CONJUGATE, _S, _ENGAGED = OWN + 26, OWN + 27, OWN + 28, OWN + 36
"""Level of the last kick, -1 before the first; h^2/24 of the coordinates in use; accelerations by the last kick and
their rates, of shaft and contact; whether the flow has the magnets."""
_COS, _SIN, _ANGLE = OWN + 37, OWN + 38, OWN + 39
_FLOWS = OWN + 42
_GRID = 5
"""Level of the grid's own step: level l lasts 2**(l - _GRID) steps of the grid."""
_LEVELS = _GRID + 8
"""Flows are kept for half a step of every level; each: horizontal and vertical block of the houses, (4, 4)."""
_LONGEST = _GRID + 3
"""A flight covers at most 2**3 steps of the grid ..."""
_FLIGHT_S = 1.1e-3
"""... and lasts at most this long [s]."""
_BLOW = _GRID - 3
"""Longest step in a blow of the hammer."""
_CALM = 2.5e-4
"""Speed of the gap [m/s] up to which the grid's own step is taken; half the step for every four times that."""
_ROUGH = 4.0
"""How many times (squared) a level's speed is exceeded before the step is halved."""
_DRIFT = 0.01
"""Weight of the gap's slow motion, squared, against its acceleration."""
_DAMPED = 0.3
"""Largest part of the gap's speed that the contact's damping takes in a step: the commutators are a series in it."""
_PATIENCE = 16
"""Calm kicks in a row before the step is doubled."""
_SLOP = 200.0
"""Depth that a rigid ring keeps in lasting contact, over the step squared [m/s^2]: a chord of the arc stays inside."""
_RETURN = 0.1
"""Part of a depth beyond it that is taken back in a step."""


@njit(cache=True, error_model="numpy", fastmath=_FAST)
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


@njit(cache=True, error_model="numpy", fastmath=_FAST)
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


@njit(cache=True, error_model="numpy", fastmath=_FAST)
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


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _house_energy(constants, x0, x1, x2, x3, y0, y1, y2, y3):
    """Kinetic and potential energy of the houses with their linear springs [J]."""
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


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Prepare the memory for a state: the inner state, and the flows for this step."""
    memory[:] = 0.0
    memory[ONSET] = constants.contact.speed_floor
    if constants.levels.euler:
        sG, cG = sin_cos(y[0])
        sb, cb = sin_cos(y[1])
        memory[_UX], memory[_UY] = sb, -sG * cb
        memory[_PX], memory[_PY] = cb * y[8], -(cG * cb * y[7] - sG * sb * y[8])
        memory[_SPIN] = y[9] + y[7] * sb
    else:
        memory[_UX], memory[_UY], memory[_PX], memory[_PY], memory[_SPIN] = y[1], -y[0], y[8], -y[7], y[9]
    memory[_THETA] = memory[_ANGLE] = y[2]
    memory[_COS], memory[_SIN] = (
        math.cos(y[2] + constants.shaft.unbalance_phase),
        math.sin(y[2] + constants.shaft.unbalance_phase),
    )
    memory[_X : _X + 4] = np.array([y[3], y[10], y[5], y[12]])
    memory[_Y : _Y + 4] = np.array([y[4], y[11], y[6], y[13]])
    memory[_SLID] = np.nan
    memory[_WANTED] = _GRID
    memory[_KICKED] = -1.0
    memory[_ENGAGED] = 1.0 if inputs.magnet_engaged else 0.0
    # The shaft's flow is linear about its rest on the magnets.
    shaft, magnet = constants.shaft, constants.magnet
    lB, weight = shaft.arm_magnet, shaft.arm_centre * shaft.mass * shaft.gravity
    rest, eps = 0.0, 1e-6
    for _ in range(50):
        torque = lB * magnet_force(0.0, lB * rest, magnet)[1] - weight
        slope = lB * (magnet_force(0.0, lB * (rest + eps), magnet)[1] - magnet_force(0.0, lB * (rest - eps), magnet)[1])
        rest -= torque / (slope / (2.0 * eps))
    memory[_REST] = rest
    memory[_SPRING_X] = -lB * magnet_force(lB * eps, lB * rest, magnet)[0] / eps
    memory[_SPRING_Y] = -slope / (2.0 * eps)
    across, upright = _house_rates(constants)
    for level in range(_LEVELS):
        t = 0.5 * 2.0 ** (level - _GRID) * step_ticks * inputs.tick_s
        at = _FLOWS + 32 * level
        memory[at : at + 16] = _exponential(across, t).ravel()
        memory[at + 16 : at + 32] = _exponential(upright, t).ravel()


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _coordinates(constants, ux, uy, px, py, w, theta, x0, x1, x2, x3, y0, y1, y2, y3, y):
    """The inner state as generalised coordinates, into y."""
    y[2] = theta
    if constants.levels.euler:
        cb2 = 1.0 - ux * ux
        cb = math.sqrt(cb2)
        uz = math.sqrt(cb2 - uy * uy)
        pz = -(ux * px + uy * py) / uz
        y[0] = arc_sine(-uy / cb)
        y[1] = arc_sine(ux)
        y[7] = (uy * pz - uz * py) / cb2
        y[8] = px / cb
        y[9] = w - ux * y[7]
    else:
        y[0], y[1], y[7], y[8], y[9] = -uy, ux, -py, px, w
    y[3], y[10], y[5], y[12] = x0, x1, x2, x3
    y[4], y[11], y[6], y[13] = y0, y1, y2, y3


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _crossing(before, rate_before, now, rate_now, h):
    """Where a gap crosses 0 between two kicks, on its cubic Hermite interpolant: part of h, and the rate there."""
    s = before / (before - now)
    for _ in range(3):
        s2 = s * s
        value = (
            before * (1.0 + s2 * (2.0 * s - 3.0))
            + h * rate_before * s * (1.0 - s) * (1.0 - s)
            + now * s2 * (3.0 - 2.0 * s)
            + h * rate_now * s2 * (s - 1.0)
        )
        slope = (
            6.0 * s * (s - 1.0) * (before - now)
            + h * rate_before * (1.0 - s) * (1.0 - 3.0 * s)
            + h * rate_now * s * (3.0 * s - 2.0)
        )
        if slope * (now - before) <= 0.0:
            break
        s = min(max(s - value / slope, 0.0), 1.0)
    rate = (
        6.0 * s * (s - 1.0) * (before - now)
        + h * rate_before * (1.0 - s) * (1.0 - 3.0 * s)
        + h * rate_now * s * (3.0 * s - 2.0)
    ) / h
    return s, rate


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _end_error(power, q):
    """Hurwitz' zeta(-power, q): error of the sum of (q + j)^power, j = 0, 1, ... against its integral from 0."""
    far = q + 3.0
    total = q**power + (q + 1.0) ** power + (q + 2.0) ** power
    total -= far ** (power + 1.0) / (power + 1.0) - 0.5 * far**power + power / 12.0 * far ** (power - 1.0)
    return total + power * (1.0 - power) * (2.0 - power) / 720.0 * far ** (power - 3.0)


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def _loose(displacement, stiffness, preload):
    """What a pair of transducers pushes less than its linear spring, once one has lost its preload [N]."""
    change = 0.5 * stiffness * displacement
    if abs(change) <= preload:
        return 0.0
    return 2.0 * change - (max(0.0, preload + change) - max(0.0, preload - change))


@njit(cache=True, error_model="numpy", fastmath=_FAST, forceinline=True)
def _flow(memory, level, inner, f, ux, px, uy, py, w, theta, aim, x0, x1, x2, x3, y0, y1, y2, y3):
    """The exact flow over half a step times 2**level."""
    ux, px = f[0] * ux + f[1] * px, f[2] * ux + f[3] * px
    uy, py = f[4] * uy + f[5] * py + f[11], f[6] * uy + f[7] * py + f[12]
    away = w - aim
    theta += aim * f[10] + away * f[9]
    w = aim + away * f[8]
    if inner:
        at = _FLOWS + 32 * level
        m = memory[at : at + 32]
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
    return ux, px, uy, py, w, theta, x0, x1, x2, x3, y0, y1, y2, y3


@njit(cache=True, error_model="numpy", fastmath=_FAST, forceinline=True)
def _processed(s, arm, per_inner, ux, uy, px, py, x0, x1, y0, y1, sx, sy, dsx, dsy, cx, cy, dcx, dcy):
    """Coordinates changed by -s [A,B]: with s = h^2/24 from those of a step h to the motion's own.

    A is the flow, B the kick: accelerations of the shaft and their rates (s, ds), forces of the contact and theirs
    (c, dc), which act on the shaft at the ring and the other way on the inner house.
    """
    ux, px = ux - s * (sx + arm * cx), px + s * (dsx + arm * dcx)
    uy, py = uy - s * (sy + arm * cy), py + s * (dsy + arm * dcy)
    x0, x1 = x0 + s * per_inner * cx, x1 - s * per_inner * dcx
    y0, y1 = y0 + s * per_inner * cy, y1 - s * per_inner * dcy
    return ux, uy, px, py, x0, x1, y0, y1


@njit(cache=True, error_model="numpy", fastmath=_FAST, nogil=True)
def advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """See `rig.engines`."""
    # params:
    levels = constants.levels
    shaft, magnet, contact, house = constants.shaft, constants.magnet, constants.contact, constants.house
    euler, inner, compliant = levels.euler, levels.inner_house, levels.compliant
    Ixx, Izz, R = shaft.transverse_inertia, shaft.polar_inertia, shaft.radius
    lA, lB, lI = shaft.arm_ring, shaft.arm_magnet, shaft.arm_disk
    per_Ixx, per_Izz = 1.0 / Ixx, 1.0 / Izz
    per_inner = 1.0 / house.inner_mass if inner else 0.0
    per_outer = 1.0 / house.outer_mass if levels.outer_house else 0.0
    ideal, engaged = inputs.ideal_drive, inputs.magnet_engaged
    r0, both = contact.clearance, contact.gap_counts_outer
    mu = contact.friction if levels.friction != NO_FRICTION else 0.0
    x_ring, y_ring = contact.offset_x, contact.offset_y
    K, exponent, factor, viscous = contact.stiffness, contact.exponent, contact.damping_factor, contact.viscous_damping
    mobility = lA * lA * per_Ixx
    spin_mobility = 0.0 if ideal else R * R * per_Izz
    per_w = 1.0 / (mobility + per_inner + spin_mobility)
    weight_torque = -shaft.mass * shaft.gravity * shaft.arm_centre
    rest, spring_x, spring_y = 0.0, 0.0, 0.0
    if engaged:
        rest, spring_x, spring_y = memory[_REST], memory[_SPRING_X], memory[_SPRING_Y]
    damper_x = magnet.damping_x * lB * lB if engaged else 0.0
    damper_y = magnet.damping_y * lB * lB if engaged else 0.0
    drive_rate = 0.0 if ideal else constants.torque_gain * per_Izz
    gyro = Izz * per_Ixx
    h0 = step_ticks * inputs.tick_s
    loose_v = 2.0 * house.preload / house.pair_stiffness_vertical
    loose_h = 2.0 * house.preload / house.pair_stiffness_horizontal
    # Root of twice the houses' energy at which a transducer can come loose.
    tightest = min(
        loose_v * math.sqrt(house.pair_stiffness_vertical), loose_h * math.sqrt(house.pair_stiffness_horizontal)
    )
    # Flows of the shaft and the drive, for every length that a half step can have.
    flows = np.empty((_LEVELS, 14))
    for level in range(_LEVELS):
        t = 0.5 * 2.0 ** (level - _GRID) * h0
        flows[level, 0:4] = _axis_flow(spring_x * per_Ixx, damper_x * per_Ixx, t)
        flows[level, 4:8] = _axis_flow(spring_y * per_Ixx, damper_y * per_Ixx, t)
        if engaged:
            flows[level, 11] = (1.0 - flows[level, 4]) * rest
            flows[level, 12] = -flows[level, 6] * rest
        else:
            flows[level, 11] = 0.5 * t * t * weight_torque * per_Ixx
            flows[level, 12] = t * weight_torque * per_Ixx
        decay = math.exp(-drive_rate * t)
        flows[level, 8] = decay
        flows[level, 9] = (1.0 - decay) / drive_rate if drive_rate > 0.0 else t
        flows[level, 10] = t
        flows[level, 13] = 0.5 / t
    # Largest speed of the gap that each level takes.
    limits = np.empty(_GRID + 1)
    for level in range(_GRID + 1):
        limits[level] = _CALM * 4.0 ** (_GRID - level)
    part_ticks = step_ticks / 2.0**_GRID
    # state in:
    ux, uy, px, py, w, theta = memory[_UX], memory[_UY], memory[_PX], memory[_PY], memory[_SPIN], memory[_THETA]
    x0, x1, x2, x3 = memory[_X], memory[_X + 1], memory[_X + 2], memory[_X + 3]
    y0, y1, y2, y3 = memory[_Y], memory[_Y + 1], memory[_Y + 2], memory[_Y + 3]
    phase = int(memory[PHASE])
    wanted_level, settled, bounce = int(memory[_WANTED]), int(memory[_SETTLED]), memory[_BOUNCE]
    level = wanted_level
    kicked, conjugate = int(memory[_KICKED]), memory[_CONJUGATE]
    sx, sy, dsx, dsy = memory[_S], memory[_S + 1], memory[_S + 2], memory[_S + 3]
    cx, cy, dcx, dcy = memory[_S + 4], memory[_S + 5], memory[_S + 6], memory[_S + 7]
    cos_a, sin_a, angle = memory[_COS], memory[_SIN], memory[_ANGLE]
    arm = lA * per_Ixx
    if engaged != (memory[_ENGAGED] == 1.0):
        # Another division into flow and kick has other conjugate coordinates.
        ux, uy, px, py, x0, x1, y0, y1 = _processed(
            conjugate, arm, per_inner, ux, uy, px, py, x0, x1, y0, y1, sx, sy, dsx, dsy, cx, cy, dcx, dcy
        )
        sx = sy = dsx = dsy = cx = cy = dcx = dcy = conjugate = 0.0
        kicked = -1
        memory[_ENGAGED] = 1.0 if engaged else 0.0
    onset_speed, slid = memory[ONSET], memory[_SLID]
    factor_per_speed = factor / onset_speed
    depth_before, rate_before, ago = memory[_DEPTH], memory[_RATE], memory[_AGO]
    force_before, force_last, largest = memory[_BEFORE], memory[_LAST], memory[PEAK_FORCE]
    force_span, force_step = memory[_BEFORE_SPAN], memory[_LAST_STEP]
    contacts, floored, clamps, contact_steps, kicks = 0.0, 0.0, 0.0, 0.0, 0.0
    dy = np.empty(S.N_VECTOR)
    row = 0
    first = 0
    while first < steps:
        now = tick + first * step_ticks
        uxt, uyt, pxt, pyt, x0t, x1t, y0t, y1t = _processed(
            conjugate, arm, per_inner, ux, uy, px, py, x0, x1, y0, y1, sx, sy, dsx, dsy, cx, cy, dcx, dcy
        )
        _coordinates(constants, uxt, uyt, pxt, pyt, w, theta, x0t, x1t, x2, x3, y0t, y1t, y2, y3, y)
        # Rigid impacts have no force over time.
        out = rows[row, S.N_VECTOR :]
        evaluate(constants, inputs, now, 0.0, onset_speed, phase if compliant else FLIGHT, True, y, dy, out)
        for i in range(S.N_VECTOR):
            rows[row, i] = y[i]
        row += 1

        # The steps up to the next row. Integrals of this row start at 0.
        on_houses = drive_work = hammer_work = unbalance_work = gap_work = bearing_loss = 0.0
        contact_loss = friction_loss = impulse = turn_x = turn_y = turn_z = 0.0
        house_before = _house_energy(constants, x0, x1, x2, x3, y0, y1, y2, y3)
        # The unbalance's direction is turned step by step; its length is kept here.
        q = 1.5 - 0.5 * (cos_a * cos_a + sin_a * sin_a)
        cos_a, sin_a = cos_a * q, sin_a * q
        last = min(stride, steps - first) * 2**_GRID
        n = 0
        owed = -1  # level of the half flow that the last kick still owes
        while n < last:
            start_tick = now + n * part_ticks
            struck = inputs.hammer_start <= start_tick < inputs.hammer_end
            if phase == FLIGHT:
                # How long a step: as long as the gap cannot close, through the second half as well.
                ex = lA * ux - x0 - both * x2 - x_ring
                ey = lA * uy - y0 - both * y2 - y_ring
                distance = math.sqrt(ex * ex + ey * ey)
                free = r0 - distance
                t0 = flows[owed, 10] if owed >= 0 else 0.0
                speed = lA * math.sqrt(px * px + py * py)
                ringing = 0.0
                if inner:
                    ringing = math.sqrt(2.0 * _house_energy(constants, x0, x1, x2, x3, y0, y1, y2, y3))
                    speed += ringing * (math.sqrt(per_inner) + both * math.sqrt(per_outer))
                level = _GRID
                while level > 0 and limits[level] < speed:
                    level -= 1
                # Transducers that come loose are no part of the flow.
                highest = _BLOW if struck or ringing > tightest else _LONGEST
                while level < highest:
                    t = 2.0 * 2.0 * flows[level, 10]
                    # Gravity, magnets, unbalance and hammer together stay below 100 m/s^2 at the ring.
                    if t > _FLIGHT_S or free < (t0 + t) * (speed + 100.0 * (t0 + t)):
                        break
                    level += 1
            if kicked < 0:
                level = 0  # what the conjugate coordinates need is known after a kick
            # Steps start at whole multiples of their length, and end at the row.
            while n & ((1 << level) - 1) != 0 or n + (1 << level) > last:
                level -= 1
            count = 1 << level
            h = 2.0 * flows[level, 10]
            per_h = flows[level, 13]

            # Flow to the middle of the step.
            middle = (n + 0.5 * count) * part_ticks
            spin = w
            # The drive's speed in the middle of the flow up to there.
            back = 0.25 * count if owed < 0 else 0.25 * (count + (1 << owed))
            aim = drive_speed(inputs, now, middle - back * part_ticks)
            if ideal:
                w = aim
            merged = owed == level
            if owed >= 0 and not merged:
                ux, px, uy, py, w, theta, x0, x1, x2, x3, y0, y1, y2, y3 = _flow(
                    memory, owed, inner, flows[owed], ux, px, uy, py, w, theta, aim, x0, x1, x2, x3, y0, y1, y2, y3
                )
                ago = 0.0
            if level != kicked:
                # Each length of step has its own conjugate coordinates, at the ends of the steps.
                s_new = h * h * (1.0 / 24.0)
                change = s_new - conjugate
                conjugate = s_new
                since = flows[kicked, 10] if kicked >= 0 else 0.0
                kicked = level
                # Rates of the smooth accelerations: by the turning of the axis, by the flow's damping of them, ...
                pulled_x, pulled_y = -spring_x * ux * per_Ixx, -spring_y * (uy - rest) * per_Ixx
                if not engaged:
                    pulled_y = weight_torque * per_Ixx
                mx = dsx + damper_x * per_Ixx * sx - gyro * w * pulled_y
                my = dsy + damper_y * per_Ixx * sy + gyro * w * pulled_x
                if engaged:
                    # ... and of what the magnets have beyond their linear part.
                    tau = 1e-5
                    force_x, force_y, _ = magnet_force(lB * ux, lB * uy, magnet)
                    ahead_x, ahead_y, _ = magnet_force(lB * (ux + tau * px), lB * (uy + tau * py), magnet)
                    mx += (lB * (ahead_x - force_x) / tau + spring_x * px) * per_Ixx
                    my += (lB * (ahead_y - force_y) / tau + spring_y * py) * per_Ixx
                ax, ay = sx + since * mx, sy + since * my
                bx, by = cx + since * dcx, cy + since * dcy
                ux, uy, px, py, x0, x1, y0, y1 = _processed(
                    -change, arm, per_inner, ux, uy, px, py, x0, x1, y0, y1, ax, ay, mx, my, bx, by, dcx, dcy
                )
            at = level + 1 if merged else level
            if phase == FLIGHT and level <= _GRID and not merged:
                # Where an onset in the half step ahead is measured from.
                ex = lA * ux - x0 - both * x2 - x_ring
                ey = lA * uy - y0 - both * y2 - y_ring
                distance = math.sqrt(ex * ex + ey * ey)
                depth_before = distance - r0
                rate_before = (
                    (ex * (lA * px - x1 - both * x3) + ey * (lA * py - y1 - both * y3)) / distance
                    if distance > 0.0
                    else 0.0
                )
                ago = 0.0
            ux, px, uy, py, w, theta, x0, x1, x2, x3, y0, y1, y2, y3 = _flow(
                memory, at, inner, flows[at], ux, px, uy, py, w, theta, aim, x0, x1, x2, x3, y0, y1, y2, y3
            )
            ago += flows[at, 10]

            # Geometry of the axis.
            uz, pz, w_share, per_uz, share_x = 1.0, 0.0, 0.0, 1.0, 0.0
            if euler:
                lean = ux * ux + uy * uy
                q = ux * ux
                if lean < 2e-3:  # series to rounding
                    uz = 1.0 - lean * (0.5 + lean * (0.125 + lean * (0.0625 + lean * (0.0390625 + lean * 0.02734375))))
                    per_uz = 1.0 + lean * (
                        0.5 + lean * (0.375 + lean * (0.3125 + lean * (0.2734375 + lean * 0.24609375)))
                    )
                    share_x = ux * (1.0 + q * (1.0 + q * (1.0 + q * (1.0 + q * (1.0 + q)))))
                else:
                    uz = math.sqrt(1.0 - lean)
                    per_uz = 1.0 / uz
                    share_x = ux / (1.0 - q)
                pz = -(ux * px + uy * py) * per_uz
                w_share = share_x * (uy * pz - uz * py)
            if ideal:
                w = drive_speed(inputs, now, middle) + w_share
            drive_work += 0.5 * Izz * (w * w - spin * spin)
            moved = Izz * (w - spin)
            rotation = w - w_share  # theta'

            # Everything smooth: sum of arm times force, without the linear magnets of the flow.
            step_angle = theta - angle
            if abs(step_angle) < 0.02:
                q = step_angle * step_angle
                c = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0)))
                d = step_angle * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0)))
            else:
                c, d = math.cos(step_angle), math.sin(step_angle)
            cos_a, sin_a = cos_a * c - sin_a * d, sin_a * c + cos_a * d
            angle = theta
            pull = lI * shaft.unbalance * rotation * rotation
            pull_x, pull_y = pull * cos_a, pull * sin_a
            blow = 0.0
            if struck:
                # The pulse's own integral over the step.
                width = math.pi / (inputs.hammer_end - inputs.hammer_start)
                begin = width * (start_tick - inputs.hammer_start)
                blow = lI * inputs.hammer_force * (math.cos(begin) - math.cos(begin + width * count * part_ticks))
                blow /= width * count * part_ticks
            Sx, Sy = pull_x + blow * inputs.hammer_x, pull_y + blow * inputs.hammer_y + weight_torque
            linear_x, linear_y = 0.0, weight_torque
            if engaged:
                force_x, force_y, _ = magnet_force(lB * ux, lB * uy, magnet)
                Sx += lB * force_x
                Sy += lB * force_y
                linear_x, linear_y = -spring_x * ux, -spring_y * (uy - rest)
            ax, ay = (Sx - linear_x) * per_Ixx, (Sy - linear_y) * per_Ixx
            turning_x = turning_y = 0.0
            if euler:
                along = (Sx * ux + Sy * uy) * per_Ixx
                ax -= along * ux
                ay -= along * uy
                # What depends on the rates: they are taken again in the middle of the kick, for order 2.
                spread = px * px + py * py + pz * pz - (damper_x * px * ux + damper_y * py * uy) * per_Ixx
                g = gyro * w
                turning_x = g * (uy * pz - uz * py) - spread * ux
                turning_y = g * (uz * px - ux * pz) - spread * uy
            else:
                turning_x, turning_y = -gyro * w * py, gyro * w * px
            half = 0.5 * h
            qx, qy = px + half * (ax + turning_x), py + half * (ay + turning_y)

            # Contact.
            jx = jy = jt = 0.0  # impulse on the shaft; friction's part
            shift = 0.0  # of the relative position, as an impulse times a time
            nx = ny = 0.0
            end_impulse = 0.0
            touched = False
            aside = 0.0
            ex = lA * ux - x0 - both * x2 - x_ring
            ey = lA * uy - y0 - both * y2 - y_ring
            square = ex * ex + ey * ey
            if square > r0 * r0:
                distance = math.sqrt(square)
                per_distance = 1.0 / distance
                depth = distance - r0
                nx, ny = ex * per_distance, ey * per_distance
                vx, vy = lA * qx - x1 - both * x3, lA * qy - y1 - both * y3
                rate = vx * nx + vy * ny
                sliding = vy * nx - vx * ny + R * w
                if phase == FLIGHT:
                    speed, since = rate, 0.5
                    if depth_before < 0.0 and ago > 0.0:
                        part, speed = _crossing(depth_before, rate_before, depth, rate, ago)
                        since = (1.0 - part) * ago / h
                    contacts += 1.0
                    if speed < contact.speed_floor:
                        floored += 1.0
                        speed = contact.speed_floor
                    onset_speed = speed
                    factor_per_speed = factor / onset_speed
                    if compliant and rate > 0.0:
                        end_impulse = -h * K * (h * rate) ** exponent * (1.0 + factor * rate / onset_speed)
                        end_impulse *= _end_error(exponent, since)
                        end_impulse -= h * viscous * rate * (0.5 - since)
                    slid = np.nan
                    force_before = force_last = force_span = 0.0
                    wanted_level = min(level, _GRID)
                    settled = 0
                    bounce = rate
                contact_steps += 1.0
                touched = True
                un = ut = 0.0
                if euler:
                    un, ut = ux * nx + uy * ny, uy * nx - ux * ny
                w_nn = mobility * (1.0 - un * un) + per_inner
                w_tt = mobility * (1.0 - ut * ut) + per_inner + spin_mobility
                w_nt = -mobility * un * ut
                q = mobility * ut * ut * per_w
                per_w_tt = per_w * (1.0 + q * (1.0 + q * (1.0 + q * (1.0 + q))))
                held = 0.0
                damping = 0.0
                lateral = sliding - R * w
                if compliant:
                    per_depth = 1.0 / depth
                    if exponent == 1.5:
                        root = math.sqrt(depth)
                        elastic = K * depth * root
                        slope = 1.5 * K * root
                    else:
                        elastic = elastic_force(depth, K, exponent)
                        slope = exponent * elastic * per_depth
                    damping_rate = elastic * factor_per_speed + viscous
                    damping = h * damping_rate
                    z = damping * w_nn
                    share = 1.0 / (1.0 + z * (0.5 + z * (1.0 / 12.0)))
                    jn = (h * elastic + damping * rate) * share
                    relative = exponent * per_depth
                    # What the flow alone would add to the rate of the gap.
                    swerve = lateral * lateral * per_distance - lA * per_Ixx * (
                        spring_x * ux * nx + spring_y * (uy - rest) * ny
                    )
                    if inner:
                        swerve += per_inner * (
                            (house.inner_beam_stiffness * (x0 - x2) + house.inner_beam_damping * (x1 - x3)) * nx
                            + house.pair_stiffness_vertical * (y0 - y2) * ny
                        )
                    bend = jn * relative * h * w_nn * (1.0 / 12.0)
                    held = h * elastic + end_impulse - jn * bend * (1.0 + 0.25 * z - (7.0 / 6.0) * bend)
                    held += damping * damping * w_nn * h * swerve * (1.0 / 24.0)
                    jn = (held + damping * rate) * share
                    shift = h * jn * damping * w_nn * (1.0 / 24.0)
                    jn = max(0.0, jn)
                else:
                    # Newton's law at an onset, Moreau's in lasting contact: no speed in the mean of a step.
                    goal = -0.5 * (rate - rate_before) - _RETURN * (depth - _SLOP * h * h) * per_h
                    if phase == FLIGHT:
                        goal = -contact.restitution * rate if rate > contact.speed_floor else 0.0
                    jn = max(0.0, (rate - goal) / w_nn)
                # Rolling holds along the arc, not at the corners of the polygon that the kicks make of it.
                sliding += lateral * (1.0 / 12.0) * h * jn * w_nn * per_distance
                target = -0.5 * (sliding - slid) if slid == slid else 0.0
                limit = mu * jn
                wanted = (sliding - target - w_nt * jn) * per_w_tt
                jt = min(max(wanted, -limit), limit)
                if jn > 0.0 and compliant:
                    jn = max(0.0, jn - 0.5 * damping * w_nt * jt * share)
                elif jn > 0.0:
                    jn = max(0.0, jn - w_nt * jt / w_nn)
                elif compliant:
                    clamps += 1.0
                phase = ROLLING
                if jt != wanted:
                    phase = FORWARD if wanted > 0.0 else BACKWARD
                if mu == 0.0:
                    phase = FORWARD if sliding > 0.0 else BACKWARD
                slid = sliding - w_tt * jt - w_nt * jn
                rate_mean = rate - 0.5 * (w_nn * jn + w_nt * jt)
                jx, jy = -jn * nx + jt * ny, -jn * ny - jt * nx
                contact_loss += (jn - held) * rate_mean
                if shift != 0.0:
                    aside = shift * lateral * per_distance
                    jx -= aside * ny
                    jy += aside * nx
                    # It comes after friction's clamp: the next target makes up for it, and takes it for no flow's.
                    slid -= (w_tt - spin_mobility) * aside
                    springs = 0.0
                    if inner:
                        springs = (
                            shift
                            * per_inner
                            * (
                                house.inner_beam_stiffness * (x0 - x2) * nx
                                + house.pair_stiffness_vertical * (y0 - y2) * ny
                            )
                        )
                        on_houses += springs
                    contact_loss += elastic * w_nn * shift - aside * lateral - springs
                friction_loss += jt * 0.5 * (sliding + slid)
                gap_work += both * (jx * x3 + jy * y3)
                impulse += jn
                if compliant:
                    force = max(0.0, elastic + damping_rate * rate_mean)
                    span = 0.5 * (force_step + h)
                    largest = max(largest, peak(force_before, force_span, force_last, span, force))
                    force_before, force_last, force_span, force_step = force_last, force, span, h
                # The next step's level, from how fast the gap moves or is made to move; rigid contact is always calm.
                rough, calm = False, True
                if compliant:
                    change = (rate_mean - bounce) * per_h
                    bounce = rate_mean
                    stiff = slope * w_nn
                    size = _DRIFT * rate_mean * rate_mean * stiff + change * change
                    limit = limits[wanted_level]
                    rough = size > _ROUGH * limit * limit * stiff or z > _DAMPED
                    limit = limits[min(wanted_level + 1, _GRID)]
                    calm = size < limit * limit * stiff and 2.0 * z < _DAMPED
                if rough and wanted_level > 0:
                    wanted_level -= 1
                    settled = 0
                elif calm and wanted_level < _GRID:
                    settled += 1
                    if settled >= _PATIENCE and (n + count) & ((2 << wanted_level) - 1) == 0:
                        wanted_level += 1
                        settled = 0
                else:
                    settled = 0
                depth_before, rate_before, ago = depth, rate - w_nn * jn - w_nt * jt, 0.0
            elif phase != FLIGHT:
                distance = math.sqrt(square)
                per_distance = 1.0 / distance
                nx, ny = ex * per_distance, ey * per_distance
                depth = distance - r0
                vx, vy = lA * qx - x1 - both * x3, lA * qy - y1 - both * y3
                rate = vx * nx + vy * ny
                if compliant and depth_before > 0.0:
                    part, speed = _crossing(depth_before, rate_before, depth, rate, ago)
                    size = 1.0 + factor * speed / onset_speed
                    if speed < 0.0 and size > 0.0:
                        jn = -h * K * (-h * speed) ** exponent * size * _end_error(exponent, part * ago / h)
                        jt = 0.0
                        if phase == FORWARD:
                            jt = mu * jn
                        elif phase == BACKWARD:
                            jt = -mu * jn
                        jx, jy = -jn * nx + jt * ny, -jn * ny - jt * nx
                        impulse += jn
                phase = FLIGHT
                depth_before, rate_before, ago = depth, rate, 0.0
            else:
                if level <= _GRID:
                    distance = math.sqrt(square)
                    depth_before = distance - r0
                    vx, vy = lA * qx - x1 - both * x3, lA * qy - y1 - both * y3
                    rate_before = (ex * vx + ey * vy) / distance if distance > 0.0 else 0.0
                ago = 0.0
            kicks += 1.0

            # The kick.
            dx, dyy = lA * jx * per_Ixx, lA * jy * per_Ixx
            if euler:
                along = dx * ux + dyy * uy
                dx -= along * ux
                dyy -= along * uy
            w_mid = w
            if jt != 0.0 and not ideal:
                # The spin that counts is the one in the middle of the kick, for the unbalance too.
                w_mid = w - 0.5 * R * jt * per_Izz
                more = lI * shaft.unbalance * ((w_mid - w_share) ** 2 - rotation * rotation)
                more_x, more_y = more * cos_a, more * sin_a
                pull_x, pull_y = pull_x + more_x, pull_y + more_y
                Sx, Sy = Sx + more_x, Sy + more_y
                ax, ay = ax + more_x * per_Ixx, ay + more_y * per_Ixx
                if euler:
                    along = (more_x * ux + more_y * uy) * per_Ixx
                    ax, ay = ax - along * ux, ay - along * uy
            mx, my = px + 0.5 * (h * (ax + turning_x) + dx), py + 0.5 * (h * (ay + turning_y) + dyy)
            if euler:
                mz = -(ux * mx + uy * my) * per_uz
                spread = mx * mx + my * my + mz * mz - (damper_x * mx * ux + damper_y * my * uy) * per_Ixx
                g = gyro * w_mid
                turning_x = g * (uy * mz - uz * my) - spread * ux
                turning_y = g * (uz * mx - ux * mz) - spread * uy
                w_share = share_x * (uy * mz - uz * my)
            else:
                turning_x, turning_y = -gyro * w_mid * my, gyro * w_mid * mx
            if shift != 0.0:
                step = lA * per_Ixx * shift
                ux -= step * nx
                uy -= step * ny
                x0 += shift * per_inner * nx
                y0 += shift * per_inner * ny
            px += h * (ax + turning_x) + dx
            py += h * (ay + turning_y) + dyy
            theta -= h * w_share if not ideal else 0.0
            torque = h * (constants.torque_gain * w_share) if not ideal else R * jt
            drive_work += torque * w_mid
            if not ideal:
                w += (torque - R * jt) * per_Izz
            net = moved + torque - R * jt
            # What the next change of step and the rows need: accelerations by this kick, and their rates.
            sx = ax + turning_x + blow * inputs.hammer_x * per_Ixx
            sy = ay + turning_y + blow * inputs.hammer_y * per_Ixx
            # Of what is smooth, only the unbalance changes fast.
            dsx, dsy = -rotation * pull_y * per_Ixx, rotation * pull_x * per_Ixx
            cx = cy = dcx = dcy = 0.0
            if touched and compliant:
                cx, cy = (jx + aside * ny) * per_h, (jy - aside * nx) * per_h
                growth, turn = relative * rate_mean, lateral * per_distance
                swerve *= damping_rate
                dcx, dcy = growth * cx - turn * cy - swerve * nx, growth * cy + turn * cx - swerve * ny
            # Houses.
            fx = -jx
            fy = -jy
            if inner:
                rise = y0 - y2
                if abs(rise) > loose_v:
                    slack = h * _loose(rise, house.pair_stiffness_vertical, house.preload)
                    fy += slack
                    on_houses -= slack * (y3 - 0.5 * slack * per_outer)
                    y3 -= slack * per_outer
                if abs(x2) > loose_h:
                    slack = h * _loose(x2, house.pair_stiffness_horizontal, house.preload)
                    on_houses += slack * (x3 + 0.5 * slack * per_outer)
                    x3 += slack * per_outer
                if abs(rise) > 0.8 * loose_v or abs(x2) > 0.8 * loose_h:
                    wanted_level = min(wanted_level, _BLOW)
                gx, gy = fx * per_inner, fy * per_inner
                on_houses += fx * (x1 + 0.5 * gx) + fy * (y1 + 0.5 * gy)
                x1 += gx
                y1 += gy
            # Powers and torques of the smooth forces, in the middle of the kick.
            hammer_work += h * blow * (inputs.hammer_x * mx + inputs.hammer_y * my)
            unbalance_work += h * (pull_x * mx + pull_y * my)
            bearing_loss += h * (damper_x * mx * mx + damper_y * my * my)
            Lx = h * (Sx - damper_x * mx) + lA * jx
            Ly = h * (Sy - damper_y * my) + lA * jy
            turn_x += -uz * Ly + net * ux
            turn_y += uz * Lx + net * uy
            turn_z += ux * Ly - uy * Lx + net * uz
            owed = level
            n += count
            level = wanted_level

        # The half flow that is owed up to the row.
        spin = w
        aim = drive_speed(inputs, now, (last - 0.25 * (1 << owed)) * part_ticks)
        if ideal:
            w = aim
        ux, px, uy, py, w, theta, x0, x1, x2, x3, y0, y1, y2, y3 = _flow(
            memory, owed, inner, flows[owed], ux, px, uy, py, w, theta, aim, x0, x1, x2, x3, y0, y1, y2, y3
        )
        ago += flows[owed, 10]
        if ideal:
            w = drive_speed(inputs, now, last * part_ticks)
            if euler:
                uz = math.sqrt(1.0 - ux * ux - uy * uy)
                w += ux * (-uy * (ux * px + uy * py) / uz - uz * py) / (1.0 - ux * ux)
        drive_work += 0.5 * Izz * (w * w - spin * spin)
        moved = Izz * (w - spin)
        house_now = _house_energy(constants, x0, x1, x2, x3, y0, y1, y2, y3)
        y[S.DRIVE_WORK] += drive_work
        y[S.HAMMER_WORK] += hammer_work
        y[S.UNBALANCE_WORK] += unbalance_work
        y[S.GAP_WORK] += gap_work
        y[S.BEARING_LOSS] += bearing_loss
        y[S.HOUSE_LOSS] += on_houses - (house_now - house_before)
        y[S.CONTACT_LOSS] += contact_loss
        y[S.FRICTION_LOSS] += friction_loss
        y[S.CONTACT_IMPULSE] += impulse
        y[S.ANGULAR_IMPULSE_X] += turn_x + moved * ux
        y[S.ANGULAR_IMPULSE_Y] += turn_y + moved * uy
        y[S.ANGULAR_IMPULSE_Z] += turn_z + moved
        y[S.HOUSE_IMPULSE_X] = house.inner_mass * x1 + house.outer_mass * x3
        y[S.HOUSE_IMPULSE_Y] = house.inner_mass * y1 + house.outer_mass * y3
        first += last // 2**_GRID

    memory[_UX], memory[_UY], memory[_PX], memory[_PY], memory[_SPIN], memory[_THETA] = ux, uy, px, py, w, theta
    memory[_X], memory[_X + 1], memory[_X + 2], memory[_X + 3] = x0, x1, x2, x3
    memory[_Y], memory[_Y + 1], memory[_Y + 2], memory[_Y + 3] = y0, y1, y2, y3
    uxt, uyt, pxt, pyt, x0t, x1t, y0t, y1t = _processed(
        conjugate, arm, per_inner, ux, uy, px, py, x0, x1, y0, y1, sx, sy, dsx, dsy, cx, cy, dcx, dcy
    )
    _coordinates(constants, uxt, uyt, pxt, pyt, w, theta, x0t, x1t, x2, x3, y0t, y1t, y2, y3, y)
    memory[PHASE], memory[ONSET], memory[_SLID] = float(phase), onset_speed, slid
    memory[_KICKED], memory[_CONJUGATE] = float(kicked), conjugate
    memory[_COS], memory[_SIN], memory[_ANGLE] = cos_a, sin_a, angle
    memory[_S], memory[_S + 1], memory[_S + 2], memory[_S + 3] = sx, sy, dsx, dsy
    memory[_S + 4], memory[_S + 5], memory[_S + 6], memory[_S + 7] = cx, cy, dcx, dcy
    memory[_WANTED], memory[_SETTLED], memory[_BOUNCE] = float(wanted_level), float(settled), bounce
    memory[_DEPTH], memory[_RATE], memory[_AGO] = depth_before, rate_before, ago
    memory[_BEFORE], memory[_LAST], memory[PEAK_FORCE] = force_before, force_last, largest
    memory[_BEFORE_SPAN], memory[_LAST_STEP] = force_span, force_step
    memory[CONTACTS] += contacts
    memory[FLOORED] += floored
    memory[CLAMPS] += clamps
    memory[CONTACT_STEPS] += contact_steps
    memory[STEPS] += kicks
    memory[EVALUATIONS] += kicks
