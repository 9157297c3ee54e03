"""Taylor series of order 16 on the full model: the engine for errors below 1e-6.

The solution's own power series by the recurrences of automatic differentiation; length of step from the last two terms
(A. Jorba and M. Zou, A software package for the numerical integration of ODEs by means of high-order Taylor methods,
Experimental Mathematics 14 (2005) 99-117). The state has no angles: u is the direction of the axis and p its rate
(`rig.engines.split` has the equation), w the spin about it.

Events are roots of polynomials: onset, lift-off, a sliding speed that comes to 0, friction that rolling needs beyond
mu F_n, a normal law that asks for tension, a transducer that loses its preload. Steps end there; friction by Filippov,
as in `rig.engines.parts`.

Contact. delta^1.5 has branch points at onset and lift-off, next to which a series in time converges as far as to the
nearer one: a hundred steps a contact. While it slides, the series is therefore in tau with dt = s dtau, s the root of
delta, itself a state, s' = delta'/2 by tau: the force goes as s^3, onset and lift-off are simple zeros of s, and an
impact takes some 16 steps. (Levi-Civita and Sundman treat collisions of bodies so.) Where the law's exponent is neither
1 nor 1.5, contacts begin at a depth of 1e-14 m. Rolling ends before the lift-off and stays with time.

The friction of rolling is what keeps v_t' at 0. It enters the k-th coefficient of v_t' with one factor for all k, so
each coefficient of the force is one division.

Every product of two series is a lane: what the coefficients below the k-th give to the k-th is summed up for all lanes
at once. The ledger's powers are lanes too.

Steps run on beyond the rows, which are read off the series; so the memory holds one. Where the inputs change, it is
dropped at that instant. So neither calls nor the density of rows change a bit of the motion.

Smoothed friction is taken too, but a very small smoothing speed makes it stiff, and the steps short.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rig.engines.memory import (
    CEILING,
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
from rig.engines.parts import PER_SCALE, rates
from rig.kernels import signals as S
from rig.kernels.axis import angles_of, axis_of
from rig.kernels.contact import BACKWARD, EXACT, FLIGHT, FORWARD, ROLLING, SMOOTHED, TOUCHING
from rig.kernels.magnet import LINEAR, RIPPLED

_TOLERANCE = OWN
"""Scaled error a step."""
_TICK, _FRACTION, _END_TICK, _END_FRACTION = range(OWN + 2, OWN + 6)
"""Start and end of the series: whole tick and ticks beyond."""
_SPAN, _LENGTH = OWN + 6, OWN + 7
"""Its length in time [s], below 0 for none; and in the variable that it is a series in."""
_EVENT, _SLACK, _STALLED = OWN + 8, OWN + 9, OWN + 10
"""What ends it; whether the contact's law asks for tension, so that there is no force; steps in a row of no length."""
_KNOWN = OWN + 11
"""Leading coefficients of each event's function that are 0 at the start of the series, by what was before."""
_NORTH, _EAST = OWN + 14, OWN + 15
"""Which transducer of a pair has lost its preload: 0, or the sign of the displacement."""
_INPUTS = OWN + 16
_SERIES = OWN + 32

ORDER = 16
"""Of every series. From 12 to 18 the speed at equal error is the same within a tenth, through impacts and whirl; an
order that follows the tolerance makes the error a rough function of it."""
_WIDTH = 40
"""Columns of the series: the vector of state and integrals, with u, p and w in place of angles, then ..."""
_T, _UZ, _COS, _SIN, _SH, _CH, _ROOT, _FN, _E = range(S.N_VECTOR, S.N_VECTOR + 9)
"""Time [s]; u_z; unbalance's direction; sine and cosine of the hammer's pulse; root of the depth; normal force; the
three functions whose zeros are events."""
_FLOWING = _ROOT
"""Columns before this have a rate by time."""

_FREE_LANES, _TOUCHING_LANES, _ALL_LANES = 48, 72, 128
"""Lanes below the first are for any phase, below the second for contact; the others for what few scenes ask for: other
exponents, ripples of the magnets, Gamma'' of an ideal drive."""

_NOTHING, _FIRST, _SECOND, _THIRD, _HOUSE_NS, _HOUSE_EW = range(6)
"""What ends a series: a length or a corner of the hammer's; a zero of one of the events' functions; a transducer."""

_HAIR = 1e-9
"""Depth [m] up to which a contact that does not slide has no friction: rolling needs a normal force."""
_AT_REST = 1e-9
"""Sliding speed [m/s] at the onset below which a contact does not slide."""
_SLOWEST = 1e-6
"""Speed of an onset [m/s] below which the contact begins at the depth ..."""
_LEAST_ROOT = 1e-7
"""... of this squared: there dt = s dtau would stand still."""
_SAFETY = 0.9
_LONGEST_S, _SHORTEST_S = 2e-2, 1e-9
"""Longest and shortest step [s]; the latter not next to an event."""
_ROUNDING = 1e-16
"""Tolerance that no step can vouch for."""
_SCALE_T, _SCALE_ROOT = 1e-4, 3e-3
"""What counts as 1 in a step's error: 0.1 ms, 9 um."""


@njit(cache=True, error_model="numpy")
def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Prepare the memory for a state: a state that begins in contact holds the floored impact speed."""
    memory[:] = 0.0
    memory[ONSET] = constants.contact.speed_floor
    memory[_TOLERANCE] = tolerance
    memory[_SPAN] = -1.0
    x = np.empty(S.N_VECTOR)
    _to_series(constants, inputs, y, x)
    depth, _, sliding = _ring(constants, inputs, x)
    if depth > 0.0:
        memory[PHASE] = TOUCHING
        if constants.levels.friction == EXACT:
            memory[PHASE] = FORWARD if sliding > 0.0 else BACKWARD


@njit(cache=True, error_model="numpy")
def _to_series(constants, inputs, y, x):
    """State and integrals as the series has them, into x."""
    for i in range(S.N_VECTOR):
        x[i] = y[i]
    euler = constants.levels.euler
    x[0], x[1], x[7], x[8] = axis_of(euler, y[0], y[1], y[7], y[8])
    if euler and not inputs.ideal_drive:
        x[9] = y[9] + y[7] * x[0]


@njit(cache=True, error_model="numpy")
def _from_series(constants, inputs, x, y):
    """Back again."""
    for i in range(S.N_VECTOR):
        y[i] = x[i]
    euler = constants.levels.euler
    y[0], y[1], y[7], y[8] = angles_of(euler, x[0], x[1], x[7], x[8])
    if euler and not inputs.ideal_drive:
        y[9] = x[9] - x[0] * y[7]


@njit(cache=True, error_model="numpy")
def _ring(constants, inputs, x):
    """Penetration [m], its rate and the sliding speed [m/s] of a state as the series has it."""
    contact, shaft, lA = constants.contact, constants.shaft, constants.shaft.arm_ring
    both = contact.gap_counts_outer
    ux, uy, px, py, w = x[0], x[1], x[7], x[8], x[9]
    ex = lA * ux - x[3] - both * x[5] - contact.offset_x
    ey = lA * uy - x[4] - both * x[6] - contact.offset_y
    vx, vy = lA * px - x[10] - both * x[12], lA * py - x[11] - both * x[13]
    if inputs.ideal_drive and constants.levels.euler:
        across = 1.0 - ux * ux
        uz = math.sqrt(across - uy * uy)
        w -= ux * (uy * (ux * px + uy * py) / uz + uz * py) / across
    distance = math.sqrt(ex * ex + ey * ey)
    if distance == 0.0:
        return -contact.clearance, 0.0, 0.0
    sliding = (vy * ex - vx * ey) / distance + shaft.radius * w
    return distance - contact.clearance, (ex * vx + ey * vy) / distance, sliding


@njit(cache=True, error_model="numpy", forceinline=True)
def _product(below, left_0, right_0, later, left, right):
    """The k-th coefficient of a product; `later` is 0 for k = 0, else 1. No array goes in: that counts references."""
    return below + left_0 * right + left * (later * right_0)


@njit(cache=True, error_model="numpy", forceinline=True)
def _quotient(below, first, divisor, dividend, inverse):
    """The k-th coefficient of a quotient that begins with `first` (0 for k = 0), by the inverse of the divisor's."""
    return (dividend - below - divisor * first) * inverse


@njit(cache=True, error_model="numpy", forceinline=True)
def _root(below, k, square, first):
    """The k-th coefficient of a square root that begins with `first`."""
    return first if k == 0 else (square - below) * (0.5 / first)


@njit(cache=True, error_model="numpy")
def _value(Y, s, x):
    """All columns at s."""
    for i in range(_WIDTH):
        x[i] = Y[ORDER, i]
    for k in range(ORDER - 1, -1, -1):
        for i in range(_WIDTH):
            x[i] = x[i] * s + Y[k, i]


@njit(cache=True, error_model="numpy")
def _column(Y, column, shift, s):
    """One column at s without its first `shift` coefficients, over s**shift, and its slope."""
    value = slope = 0.0
    for k in range(ORDER, shift - 1, -1):
        slope = slope * s + value
        value = value * s + Y[k, column]
    return value, slope


@njit(cache=True, error_model="numpy")
def _refine(Y, column, shift, goal, low, high):
    """Where a column passes a value between low and high, by guarded Newton steps."""
    below = _column(Y, column, shift, low)[0] < goal
    s = 0.5 * (low + high)
    for _ in range(100):
        value, slope = _column(Y, column, shift, s)
        if value == goal:
            break
        if (value < goal) == below:
            low = s
        else:
            high = s
        new = s - (value - goal) / slope
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - s) <= 1e-16 * high or new in (low, high):
            s = new
            break
        s = new
    return s


@njit(cache=True, error_model="numpy")
def _first_zero(Y, column, shift, h):
    """The first zero of a column (without what is known to be 0) up to h, if it falls through 0; else infinity.

    A bound by the coefficients rules out most; then samples, between which a minimum is looked for.
    """
    first = Y[shift, column]
    if first <= 0.0:
        return 0.0
    least, power = first, 1.0
    for k in range(shift + 1, ORDER + 1):
        power *= h
        least += min(0.0, Y[k, column] * power)
    if least > 0.0:
        return math.inf
    before, falling = 0.0, Y[shift + 1, column] < 0.0
    for i in range(1, 9):
        s = 0.125 * i * h
        value, slope = _column(Y, column, shift, s)
        if value <= 0.0:
            return _refine(Y, column, shift, 0.0, before, s)
        if falling and slope > 0.0:
            low, high = before, s
            for _ in range(40):
                middle = 0.5 * (low + high)
                value, slope = _column(Y, column, shift, middle)
                if value <= 0.0:
                    return _refine(Y, column, shift, 0.0, before, middle)
                if slope < 0.0:
                    low = middle
                else:
                    high = middle
        before, falling = s, slope < 0.0
    return math.inf


@njit(cache=True, error_model="numpy")
def _pair(stiffness, preload, lost):
    """Stiffness and constant force of a pair of transducers of which one may have lost its preload."""
    return (stiffness, 0.0) if lost == 0.0 else (0.5 * stiffness, lost * preload)


@njit(cache=True, error_model="numpy")
def _loses(displacement, rate, stiffness, preload):
    """Which transducer of a pair has lost its preload, or is about to: 0, or the sign of the displacement."""
    change = 0.5 * stiffness * displacement
    sign = 1.0 if change > 0.0 else -1.0
    over = sign * change - preload
    edge = 1e-12 * preload
    return sign if over > edge or (over > -edge and sign * rate > 0.0) else 0.0


@njit(cache=True, error_model="numpy")
def _unit_friction(constants, inputs, ux, uy, uz, nx, ny):
    """What a friction force of 1 N changes: u'' (x, y, z), Gamma'', w', sliding speed's rate."""
    shaft, house = constants.shaft, constants.house
    lA, per_Ixx = shaft.arm_ring, 1.0 / shaft.transverse_inertia
    dSx, dSy = lA * ny, -lA * nx
    ax, ay, az, turn = dSx * per_Ixx, dSy * per_Ixx, 0.0, 0.0
    if constants.levels.euler:
        m = dSx * ux + dSy * uy
        ax -= m * ux * per_Ixx
        ay -= m * uy * per_Ixx
        az = -(ux * ax + uy * ay) / uz
        turn = (uy * az - uz * ay) / (1.0 - ux * ux)
    dw = -shaft.radius / shaft.polar_inertia
    if inputs.ideal_drive:
        dw = ux * turn if constants.levels.euler else 0.0
    response = lA * (ay * nx - ax * ny) + shaft.radius * dw
    if constants.levels.inner_house:
        response -= 1.0 / house.inner_mass
    return ax, ay, az, turn, dw, response


@njit(cache=True, error_model="numpy")
def _make_series(constants, inputs, memory, Y, A, B, D, acc):
    """All coefficients of a series from the state in its first row."""
    # params:
    levels, shaft, magnet = constants.levels, constants.shaft, constants.magnet
    contact, house = constants.contact, constants.house
    euler, ideal, engaged = levels.euler, inputs.ideal_drive, inputs.magnet_engaged
    phase, slack = int(memory[PHASE]), memory[_SLACK] != 0.0
    touching = phase != FLIGHT
    rolling = phase == ROLLING
    slowed = touching and not rolling
    per_Ixx, per_Izz, Ixx, Izz = (
        1.0 / shaft.transverse_inertia,
        1.0 / shaft.polar_inertia,
        shaft.transverse_inertia,
        shaft.polar_inertia,
    )
    lA, lB, lI, radius = shaft.arm_ring, shaft.arm_magnet, shaft.arm_disk, shaft.radius
    moment = shaft.arm_centre * shaft.mass * shaft.gravity
    both, clearance = contact.gap_counts_outer, contact.clearance
    per_inner = 1.0 / house.inner_mass if levels.inner_house else 0.0
    per_outer = 1.0 / house.outer_mass if levels.outer_house else 0.0
    k_ns, c_ns = _pair(house.pair_stiffness_vertical, house.preload, memory[_NORTH])
    k_ew, c_ew = _pair(house.pair_stiffness_horizontal, house.preload, memory[_EAST])
    gain = constants.torque_gain
    ticks_on = (memory[_TICK] - inputs.speed_tick) + memory[_FRACTION]
    aim_now, slope = inputs.speed + inputs.speed_slope * (ticks_on * inputs.tick_s), inputs.speed_slope
    memory_factor = contact.damping_factor / memory[ONSET]
    friction = contact.friction if phase == FORWARD else -contact.friction
    smoothed = levels.friction == SMOOTHED
    if phase == TOUCHING:
        friction = 0.0
    lanes_all = (ideal and euler) or (engaged and magnet.terms == RIPPLED)
    lanes_all = lanes_all or not (contact.exponent == 1.5 or contact.exponent == 1.0)

    # The first row: what follows from the state.
    ux0, uy0 = Y[0, 0], Y[0, 1]
    uz0 = math.sqrt(1.0 - ux0 * ux0 - uy0 * uy0) if euler else 1.0
    Y[0, _UZ] = uz0
    inverse_uz, inverse_across = 1.0 / uz0, 1.0 / (1.0 - ux0 * ux0)
    angle = Y[0, 2] + shaft.unbalance_phase
    Y[0, _COS], Y[0, _SIN] = math.cos(angle), math.sin(angle)
    Y[0, _T] = Y[0, _SH] = Y[0, _CH] = 0.0
    pulse = 0.0
    now = int(memory[_TICK])
    if inputs.hammer_start <= now < inputs.hammer_end:
        pulse = math.pi / float(inputs.hammer_end - inputs.hammer_start)
        along_pulse = pulse * (float(now - inputs.hammer_start) + memory[_FRACTION])
        Y[0, _SH], Y[0, _CH] = math.sin(along_pulse), math.cos(along_pulse)
        pulse /= inputs.tick_s
    ex0 = lA * ux0 - Y[0, 3] - both * Y[0, 5] - contact.offset_x
    ey0 = lA * uy0 - Y[0, 4] - both * Y[0, 6] - contact.offset_y
    distance0 = math.sqrt(ex0 * ex0 + ey0 * ey0)
    inverse_distance = 1.0 / distance0 if distance0 > 0.0 else 0.0
    nx0, ny0 = ex0 * inverse_distance, ey0 * inverse_distance
    root0 = Y[0, _ROOT] if slowed else math.sqrt(max(0.0, distance0 - clearance))
    Y[0, _ROOT] = root0
    inverse_root = 1.0 / root0 if root0 > 0.0 else 0.0
    per_friction = 0.0
    dax = day = daz = dturn = ddw = dsx = dsy = 0.0
    if rolling:
        dax, day, daz, dturn, ddw, response = _unit_friction(constants, inputs, ux0, uy0, uz0, nx0, ny0)
        dsx, dsy = lA * ny0, -lA * nx0
        per_friction = -1.0 / response
    for p in range(_ALL_LANES):
        A[0, p] = 0.0
        B[0, p] = 0.0
        acc[p] = 0.0

    z, later, sign = 1.0, 0.0, 0.0
    for k in range(ORDER):
        # Here and below: loops of fixed length in place, as a call would count references to every array.
        for p in range(_ALL_LANES):
            acc[p] = 0.0
        if lanes_all:
            for j in range(1, k):
                for p in range(_ALL_LANES):
                    acc[p] += A[j, p] * B[k - j, p]
        elif touching:
            for j in range(1, k):
                for p in range(_TOUCHING_LANES):
                    acc[p] += A[j, p] * B[k - j, p]
        else:
            for j in range(1, k):
                for p in range(_FREE_LANES):
                    acc[p] += A[j, p] * B[k - j, p]
        # state in:
        ux, uy, px, py, uz = Y[k, 0], Y[k, 1], Y[k, 7], Y[k, 8], Y[k, _UZ]
        xi, yi, xo, yo = Y[k, 3], Y[k, 4], Y[k, 5], Y[k, 6]
        vxi, vyi, vxo, vyo = Y[k, 10], Y[k, 11], Y[k, 12], Y[k, 13]

        # The axis.
        A[k, 0], B[k, 0] = ux, ux
        A[k, 1], B[k, 1] = uy, uy
        xx, yy = (_product(acc[0], A[0, 0], B[0, 0], later, ux, ux), _product(acc[1], A[0, 1], B[0, 1], later, uy, uy))
        A[k, 5], B[k, 5] = px, px
        A[k, 6], B[k, 6] = py, py
        pxpx, pypy = (
            _product(acc[5], A[0, 5], B[0, 5], later, px, px),
            _product(acc[6], A[0, 6], B[0, 6], later, py, py),
        )
        pz = share = turn = spread = uxpx = 0.0
        cx, cy = -py, px
        if euler:
            A[k, 2], B[k, 2] = ux, px
            uxpx = _product(acc[2], A[0, 2], B[0, 2], later, ux, px)
            A[k, 3], B[k, 3] = uy, py
            dot = uxpx + _product(acc[3], A[0, 3], B[0, 3], later, uy, py)
            pz = _quotient(acc[4], B[0, 4], uz, -dot, inverse_uz)
            A[k, 4], B[k, 4] = uz, pz
            A[k, 7], B[k, 7] = pz, pz
            spread = pxpx + pypy + _product(acc[7], A[0, 7], B[0, 7], later, pz, pz)
            A[k, 8], B[k, 8] = uy, pz
            A[k, 9], B[k, 9] = uz, py
            cx = _product(acc[8], A[0, 8], B[0, 8], later, uy, pz) - _product(acc[9], A[0, 9], B[0, 9], later, uz, py)
            A[k, 10], B[k, 10] = uz, px
            A[k, 11], B[k, 11] = ux, pz
            cy = _product(acc[10], A[0, 10], B[0, 10], later, uz, px) - _product(
                acc[11], A[0, 11], B[0, 11], later, ux, pz
            )
            turn = _quotient(acc[14], B[0, 14], z - xx, cx, inverse_across)
            A[k, 14], B[k, 14] = z - xx, turn
            A[k, 15], B[k, 15] = ux, turn
            share = _product(acc[15], A[0, 15], B[0, 15], later, ux, turn)
        if ideal:
            spin_rate = Y[k, 9]
            w = spin_rate + share
        else:
            w = Y[k, 9]
            spin_rate = w - share

        # Forces on the shaft but the ring's.
        A[k, 16], B[k, 16] = spin_rate, Y[k, _COS]
        tc = _product(acc[16], A[0, 16], B[0, 16], later, spin_rate, Y[k, _COS])
        A[k, 17], B[k, 17] = spin_rate, Y[k, _SIN]
        ts = _product(acc[17], A[0, 17], B[0, 17], later, spin_rate, Y[k, _SIN])
        A[k, 18], B[k, 18] = spin_rate, tc
        unbalance_x = shaft.unbalance * _product(acc[18], A[0, 18], B[0, 18], later, spin_rate, tc)
        A[k, 19], B[k, 19] = spin_rate, ts
        unbalance_y = shaft.unbalance * _product(acc[19], A[0, 19], B[0, 19], later, spin_rate, ts)
        blow = inputs.hammer_force * Y[k, _SH]
        Sx = lI * (unbalance_x + blow * inputs.hammer_x)
        Sy = lI * (unbalance_y + blow * inputs.hammer_y) - moment * z
        bearing_loss = 0.0
        if engaged:
            mx, my = lB * ux, lB * uy
            if magnet.terms == LINEAR:
                magnet_x, magnet_y = -magnet.stiffness * mx, -magnet.stiffness * my
            else:
                s = lB * lB * (xx + yy)
                inner = magnet.a5 * z + magnet.a7 * s
                A[k, 24], B[k, 24] = s, inner
                inner = magnet.a3 * z + _product(acc[24], A[0, 24], B[0, 24], later, s, inner)
                A[k, 25], B[k, 25] = s, inner
                stiff = -magnet.stiffness * (z + _product(acc[25], A[0, 25], B[0, 25], later, s, inner))
                side_x = side_y = 0.0
                if magnet.terms == RIPPLED:
                    # w = -y + i x, and w^(N-1) by squaring, as in rig.kernels.magnet.
                    qx, qy = -my, mx
                    bits = magnet.number - 1
                    lane = 78  # 35 lanes for 64 magnets
                    wave_x, wave_y = z, 0.0
                    begun = False
                    while bits > 0:
                        if bits & 1:
                            if begun:
                                A[k, lane], B[k, lane] = wave_x, qx
                                A[k, lane + 1], B[k, lane + 1] = wave_y, qy
                                one = _product(acc[lane], A[0, lane], B[0, lane], later, wave_x, qx) - _product(
                                    acc[lane + 1], A[0, lane + 1], B[0, lane + 1], later, wave_y, qy
                                )
                                A[k, lane + 2], B[k, lane + 2] = wave_x, qy
                                A[k, lane + 3], B[k, lane + 3] = wave_y, qx
                                wave_y = _product(
                                    acc[lane + 2], A[0, lane + 2], B[0, lane + 2], later, wave_x, qy
                                ) + _product(acc[lane + 3], A[0, lane + 3], B[0, lane + 3], later, wave_y, qx)
                                wave_x = one
                                lane += 4
                            else:
                                wave_x, wave_y = qx, qy
                                begun = True
                        bits >>= 1
                        if bits > 0:
                            A[k, lane], B[k, lane] = qx, qx
                            A[k, lane + 1], B[k, lane + 1] = qy, qy
                            one = _product(acc[lane], A[0, lane], B[0, lane], later, qx, qx) - _product(
                                acc[lane + 1], A[0, lane + 1], B[0, lane + 1], later, qy, qy
                            )
                            A[k, lane + 2], B[k, lane + 2] = qx, qy
                            qy = 2.0 * _product(acc[lane + 2], A[0, lane + 2], B[0, lane + 2], later, qx, qy)
                            qx = one
                            lane += 3
                    A[k, 74], B[k, 74] = wave_x, -my
                    A[k, 75], B[k, 75] = wave_y, mx
                    wave = _product(acc[74], A[0, 74], B[0, 74], later, wave_x, -my) - _product(
                        acc[75], A[0, 75], B[0, 75], later, wave_y, mx
                    )
                    amplitude = magnet.stiffness * magnet.ripple
                    stiff -= 2.0 * amplitude * magnet.growth * wave
                    side = magnet.number * amplitude * (z + magnet.growth * s)
                    A[k, 76], B[k, 76] = side, wave_y
                    side_x = _product(acc[76], A[0, 76], B[0, 76], later, side, wave_y)
                    A[k, 77], B[k, 77] = side, wave_x
                    side_y = _product(acc[77], A[0, 77], B[0, 77], later, side, wave_x)
                A[k, 26], B[k, 26] = stiff, mx
                magnet_x = _product(acc[26], A[0, 26], B[0, 26], later, stiff, mx) + side_x
                A[k, 27], B[k, 27] = stiff, my
                magnet_y = _product(acc[27], A[0, 27], B[0, 27], later, stiff, my) + side_y
            Sx += lB * (magnet_x - magnet.damping_x * lB * px)
            Sy += lB * (magnet_y - magnet.damping_y * lB * py)
            bearing_loss = lB * lB * (magnet.damping_x * pxpx + magnet.damping_y * pypy)

        # Houses.
        slip = vxi - vxo
        beam_x = house.inner_beam_stiffness * (xi - xo) + house.inner_beam_damping * slip
        beam_y = house.outer_beam_stiffness * yo + house.outer_beam_damping * vyo
        ns, ew = k_ns * (yi - yo) + c_ns * z, k_ew * xo + c_ew * z
        axi, ayi = -beam_x * per_inner, -ns * per_inner
        axo, ayo = (beam_x - ew) * per_outer, (ns - beam_y) * per_outer

        # The ring.
        ex = lA * ux - xi - both * xo - contact.offset_x * z
        ey = lA * uy - yi - both * yo - contact.offset_y * z
        A[k, 41], B[k, 41] = ex, ex
        A[k, 42], B[k, 42] = ey, ey
        square = _product(acc[41], A[0, 41], B[0, 41], later, ex, ex) + _product(
            acc[42], A[0, 42], B[0, 42], later, ey, ey
        )
        Fx = Fy = Fn = Ft = elastic = rate = sliding = pull = 0.0
        nx = ny = along = distance = depth = 0.0
        if touching:
            vx, vy = lA * px - vxi - both * vxo, lA * py - vyi - both * vyo
            distance = _root(acc[48], k, square, distance0)
            A[k, 48] = B[k, 48] = distance
            nx = _quotient(acc[49], B[0, 49], distance, ex, inverse_distance)
            A[k, 49], B[k, 49] = distance, nx
            ny = _quotient(acc[50], B[0, 50], distance, ey, inverse_distance)
            A[k, 50], B[k, 50] = distance, ny
            A[k, 51], B[k, 51] = vx, nx
            A[k, 52], B[k, 52] = vy, ny
            rate = _product(acc[51], A[0, 51], B[0, 51], later, vx, nx) + _product(
                acc[52], A[0, 52], B[0, 52], later, vy, ny
            )
            A[k, 53], B[k, 53] = vy, nx
            A[k, 54], B[k, 54] = vx, ny
            along = _product(acc[53], A[0, 53], B[0, 53], later, vy, nx) - _product(
                acc[54], A[0, 54], B[0, 54], later, vx, ny
            )
            sliding = along + radius * w
            if slowed:
                root = Y[k, _ROOT]
                A[k, 55], B[k, 55] = root, root
                depth = _product(acc[55], A[0, 55], B[0, 55], later, root, root)
            else:
                depth = distance - clearance * z
                root = _root(acc[55], k, depth, root0)
                A[k, 55] = B[k, 55] = root
            if contact.exponent == 1.5:
                A[k, 56], B[k, 56] = depth, root
                elastic = contact.stiffness * _product(acc[56], A[0, 56], B[0, 56], later, depth, root)
            elif contact.exponent == 1.0:
                elastic = contact.stiffness * depth
            else:
                # s P' = 2 n P s' for P = s^(2 n).
                n = 2.0 * contact.exponent
                if k == 0:
                    power = root0**n
                    A[0, 72] = B[0, 73] = 0.0
                    B[0, 72], A[0, 73] = power, 0.0
                else:
                    power = (n * (acc[72] + k * root * B[0, 72]) - acc[73]) * inverse_root / k
                    A[k, 72], B[k, 72], A[k, 73], B[k, 73] = k * root, power, k * power, root
                elastic = contact.stiffness * power
            pull = z + memory_factor * rate
            A[k, 57], B[k, 57] = elastic, pull
            normal = _product(acc[57], A[0, 57], B[0, 57], later, elastic, pull)
            if contact.viscous_damping != 0.0:
                normal += contact.viscous_damping * rate
                pull = normal
            if not slack:
                Fn = normal
                A[k, 58], B[k, 58] = Fn, nx
                A[k, 59], B[k, 59] = Fn, ny
                fx, fy = (
                    _product(acc[58], A[0, 58], B[0, 58], later, Fn, nx),
                    _product(acc[59], A[0, 59], B[0, 59], later, Fn, ny),
                )
                Fx, Fy = -fx, -fy
                if rolling:
                    # With the friction's own k-th coefficient left at 0, up to where it is known.
                    A[k, 60], B[k, 60] = 0.0, ny
                    Fx += _product(acc[60], A[0, 60], B[0, 60], later, 0.0, ny)
                    A[k, 61], B[k, 61] = 0.0, nx
                    Fy -= _product(acc[61], A[0, 61], B[0, 61], later, 0.0, nx)
                elif smoothed and phase == TOUCHING:
                    # T = tanh v: T' = (1 - T^2) v'.
                    v = sliding / contact.smoothing_speed
                    tangent = math.tanh(v) if k == 0 else (acc[66] + k * v * B[0, 66]) / k
                    A[k, 66] = k * v
                    A[k, 67], B[k, 67] = tangent, tangent
                    B[k, 66] = z - _product(acc[67], A[0, 67], B[0, 67], later, tangent, tangent)
                    A[k, 70], B[k, 70] = Fn, tangent
                    Ft = contact.friction * _product(acc[70], A[0, 70], B[0, 70], later, Fn, tangent)
                    A[k, 60], B[k, 60] = Ft, ny
                    Fx += _product(acc[60], A[0, 60], B[0, 60], later, Ft, ny)
                    A[k, 61], B[k, 61] = Ft, nx
                    Fy -= _product(acc[61], A[0, 61], B[0, 61], later, Ft, nx)
                else:
                    Ft = friction * Fn
                    Fx += friction * fy
                    Fy -= friction * fx
                Sx += lA * Fx
                Sy += lA * Fy
                axi -= Fx * per_inner
                ayi -= Fy * per_inner

        # Accelerations.
        A[k, 12], B[k, 12] = w, cx
        ax = (Sx + Izz * _product(acc[12], A[0, 12], B[0, 12], later, w, cx)) * per_Ixx
        A[k, 13], B[k, 13] = w, cy
        ay = (Sy + Izz * _product(acc[13], A[0, 13], B[0, 13], later, w, cy)) * per_Ixx
        if euler:
            A[k, 20], B[k, 20] = Sx, ux
            A[k, 21], B[k, 21] = Sy, uy
            inward = (
                _product(acc[20], A[0, 20], B[0, 20], later, Sx, ux)
                + _product(acc[21], A[0, 21], B[0, 21], later, Sy, uy)
                + Ixx * spread
            )
            A[k, 22], B[k, 22] = inward, ux
            ax -= _product(acc[22], A[0, 22], B[0, 22], later, inward, ux) * per_Ixx
            A[k, 23], B[k, 23] = inward, uy
            ay -= _product(acc[23], A[0, 23], B[0, 23], later, inward, uy) * per_Ixx
        torque = gain * (aim_now * z + slope * Y[k, _T] - spin_rate)
        dw = (torque - radius * Ft) * per_Izz
        if ideal:
            dw = slope * z
            if euler:
                # w = theta' + u_x Gamma', so w' asks for Gamma''.
                A[k, 114], B[k, 114] = ax, ux
                A[k, 115], B[k, 115] = ay, uy
                az = _quotient(
                    acc[116],
                    B[0, 116],
                    uz,
                    -(
                        _product(acc[114], A[0, 114], B[0, 114], later, ax, ux)
                        + _product(acc[115], A[0, 115], B[0, 115], later, ay, uy)
                        + spread
                    ),
                    inverse_uz,
                )
                A[k, 116], B[k, 116] = uz, az
                A[k, 117], B[k, 117] = az, uy
                A[k, 118], B[k, 118] = ay, uz
                turning = _product(acc[117], A[0, 117], B[0, 117], later, az, uy) - _product(
                    acc[118], A[0, 118], B[0, 118], later, ay, uz
                )
                A[k, 119], B[k, 119] = turn, uxpx
                turning += 2.0 * _product(acc[119], A[0, 119], B[0, 119], later, turn, uxpx)
                turning = _quotient(acc[120], B[0, 120], z - xx, turning, inverse_across)
                A[k, 120], B[k, 120] = z - xx, turning
                A[k, 121], B[k, 121] = px, turn
                A[k, 122], B[k, 122] = turning, ux
                dw += _product(acc[121], A[0, 121], B[0, 121], later, px, turn) + _product(
                    acc[122], A[0, 122], B[0, 122], later, turning, ux
                )
        if rolling:
            bx, by = lA * ax - axi - both * axo, lA * ay - ayi - both * ayo
            swing = _quotient(acc[64], B[0, 64], distance, along, inverse_distance)
            A[k, 64], B[k, 64] = distance, swing
            A[k, 68], B[k, 68] = by, nx
            A[k, 69], B[k, 69] = bx, ny
            change = (
                _product(acc[68], A[0, 68], B[0, 68], later, by, nx)
                - _product(acc[69], A[0, 69], B[0, 69], later, bx, ny)
                + radius * dw
            )
            A[k, 71], B[k, 71] = rate, swing
            change -= _product(acc[71], A[0, 71], B[0, 71], later, rate, swing)
            Ft = change * per_friction
            # Into everything that took it for 0.
            A[k, 60] = A[k, 61] = Ft
            Fx += Ft * ny0
            Fy -= Ft * nx0
            axi -= Ft * ny0 * per_inner
            ayi += Ft * nx0 * per_inner
            A[k, 68] = by + Ft * (lA * day - nx0 * per_inner)
            A[k, 69] = bx + Ft * (lA * dax + ny0 * per_inner)
            Sx += Ft * dsx
            Sy += Ft * dsy
            ax += Ft * dax
            ay += Ft * day
            dw += Ft * ddw
            if euler:
                A[k, 20] = Sx
                A[k, 21] = Sy
                more = Ft * (dsx * ux0 + dsy * uy0)
                A[k, 22] += more
                A[k, 23] += more
                if ideal:
                    A[k, 114] = ax
                    A[k, 115] = ay
                    B[k, 116] += Ft * daz
                    A[k, 117] += Ft * daz
                    A[k, 118] = ay
                    B[k, 120] += Ft * dturn
                    A[k, 122] += Ft * dturn
        if ideal:
            torque = Izz * dw + radius * Ft

        # out: rates of the state
        D[k, 0], D[k, 1], D[k, 2] = px, py, spin_rate
        D[k, 3], D[k, 4], D[k, 5], D[k, 6] = vxi, vyi, vxo, vyo
        D[k, 7], D[k, 8] = ax, ay
        D[k, 9] = slope * z if ideal else dw
        D[k, 10], D[k, 11], D[k, 12], D[k, 13] = axi, ayi, axo, ayo
        D[k, _T], D[k, _UZ] = z, pz
        D[k, _COS], D[k, _SIN] = -ts, tc
        D[k, _SH], D[k, _CH] = pulse * Y[k, _CH], -pulse * Y[k, _SH]

        # out: powers and forces behind the integrals
        net = torque - radius * Ft
        A[k, 28], B[k, 28] = torque, w
        D[k, S.DRIVE_WORK] = _product(acc[28], A[0, 28], B[0, 28], later, torque, w)
        A[k, 31], B[k, 31] = blow, inputs.hammer_x * px + inputs.hammer_y * py
        D[k, S.HAMMER_WORK] = lI * _product(
            acc[31], A[0, 31], B[0, 31], later, blow, inputs.hammer_x * px + inputs.hammer_y * py
        )
        A[k, 29], B[k, 29] = unbalance_x, px
        A[k, 30], B[k, 30] = unbalance_y, py
        D[k, S.UNBALANCE_WORK] = lI * (
            _product(acc[29], A[0, 29], B[0, 29], later, unbalance_x, px)
            + _product(acc[30], A[0, 30], B[0, 30], later, unbalance_y, py)
        )
        D[k, S.GAP_WORK] = 0.0
        D[k, S.RELEASE_WORK] = 0.0
        D[k, S.BEARING_LOSS] = bearing_loss
        A[k, 32], B[k, 32] = slip, slip
        A[k, 33], B[k, 33] = vyo, vyo
        D[k, S.HOUSE_LOSS] = house.inner_beam_damping * _product(
            acc[32], A[0, 32], B[0, 32], later, slip, slip
        ) + house.outer_beam_damping * _product(acc[33], A[0, 33], B[0, 33], later, vyo, vyo)
        D[k, S.CONTACT_LOSS] = D[k, S.FRICTION_LOSS] = 0.0
        if touching:
            A[k, 62], B[k, 62] = Fn - elastic, rate
            D[k, S.CONTACT_LOSS] = _product(acc[62], A[0, 62], B[0, 62], later, Fn - elastic, rate)
            A[k, 63], B[k, 63] = Ft, sliding
            D[k, S.FRICTION_LOSS] = _product(acc[63], A[0, 63], B[0, 63], later, Ft, sliding)
            if both != 0.0:
                A[k, 43], B[k, 43] = Fx, vxo
                A[k, 44], B[k, 44] = Fy, vyo
                D[k, S.GAP_WORK] = both * (
                    _product(acc[43], A[0, 43], B[0, 43], later, Fx, vxo)
                    + _product(acc[44], A[0, 44], B[0, 44], later, Fy, vyo)
                )
        D[k, S.CONTACT_IMPULSE] = Fn
        A[k, 38], B[k, 38] = net, ux
        A[k, 34], B[k, 34] = uz, Sy
        D[k, S.ANGULAR_IMPULSE_X] = _product(acc[38], A[0, 38], B[0, 38], later, net, ux) - _product(
            acc[34], A[0, 34], B[0, 34], later, uz, Sy
        )
        A[k, 39], B[k, 39] = net, uy
        A[k, 35], B[k, 35] = uz, Sx
        D[k, S.ANGULAR_IMPULSE_Y] = _product(acc[39], A[0, 39], B[0, 39], later, net, uy) + _product(
            acc[35], A[0, 35], B[0, 35], later, uz, Sx
        )
        A[k, 36], B[k, 36] = ux, Sy
        A[k, 37], B[k, 37] = uy, Sx
        A[k, 40], B[k, 40] = net, uz
        D[k, S.ANGULAR_IMPULSE_Z] = (
            _product(acc[36], A[0, 36], B[0, 36], later, ux, Sy)
            - _product(acc[37], A[0, 37], B[0, 37], later, uy, Sx)
            + _product(acc[40], A[0, 40], B[0, 40], later, net, uz)
        )
        across, upright = ew, beam_y
        if not levels.outer_house:
            across, upright = (beam_x, ns) if levels.inner_house else (-Fx, -Fy)
        D[k, S.HOUSE_IMPULSE_X] = -Fx - across
        D[k, S.HOUSE_IMPULSE_Y] = -Fy - upright

        # out: what events are made of
        Y[k, _FN] = Fn
        Y[k, _E] = Y[k, _E + 1] = Y[k, _E + 2] = z
        if phase == FLIGHT:
            Y[k, _E] = clearance * clearance * z - square
        elif slack:
            Y[k, _E] = Y[k, _ROOT]
            Y[k, _E + 2] = -pull
        elif rolling:
            Y[k, _E] = depth - _HAIR * z
            Y[k, _E + 1] = contact.friction * Fn - Ft
            Y[k, _E + 2] = contact.friction * Fn + Ft
        else:
            Y[k, _E] = Y[k, _ROOT]
            if phase == FORWARD:
                Y[k, _E + 1] = sliding
            elif phase == BACKWARD:
                Y[k, _E + 1] = -sliding
            elif smoothed:
                # Far out the tanh is 1 to rounding, and no coefficient tells of the turn ahead: halve the way to it.
                if k == 0:
                    sign = math.copysign(1.0, sliding) if abs(sliding) > 4.0 * contact.smoothing_speed else 0.0
                    Y[k, _E + 1] = 0.5 * abs(sliding)
                elif sign != 0.0:
                    Y[k, _E + 1] = sign * sliding
                if sign == 0.0:
                    Y[k, _E + 1] = z
            Y[k, _E + 2] = pull

        # The next coefficient of everything with a rate.
        portion = 1.0 / (k + 1.0)
        if slowed:
            for i in range(_FLOWING):
                Y[k + 1, i] = 0.0
            for j in range(k + 1):
                root = Y[k - j, _ROOT] * portion
                for i in range(_FLOWING):
                    Y[k + 1, i] += root * D[j, i]
            Y[k + 1, _ROOT] = 0.5 * rate * portion
        else:
            for i in range(_FLOWING):
                Y[k + 1, i] = D[k, i] * portion
            Y[k + 1, _ROOT] = 0.0
        z, later = 0.0, 1.0
    for i in range(_FN, _WIDTH):
        Y[ORDER, i] = 0.0
    if slowed:
        Y[ORDER, _E] = Y[ORDER, _ROOT]
        if phase == TOUCHING and levels.friction == EXACT and Y[1, _ROOT] > 0.0:
            # Frictionless as far as the hair, on the way in.
            for k in range(ORDER + 1):
                Y[k, _E + 1] = -Y[k, _ROOT]
            Y[0, _E + 1] += math.sqrt(_HAIR)
    return slowed


@njit(cache=True, error_model="numpy")
def _length(memory, Y, slowed):
    """How far a series holds: its last two terms stay within the tolerance."""
    tolerance = memory[_TOLERANCE]
    last = before = 0.0
    for i in range(S.N_STATE):
        last = max(last, abs(Y[ORDER, i]) * PER_SCALE[i])
        before = max(before, abs(Y[ORDER - 1, i]) * PER_SCALE[i])
    if slowed:
        last = max(last, abs(Y[ORDER, _T]) / _SCALE_T, abs(Y[ORDER, _ROOT]) / _SCALE_ROOT)
        before = max(before, abs(Y[ORDER - 1, _T]) / _SCALE_T, abs(Y[ORDER - 1, _ROOT]) / _SCALE_ROOT)
    return _SAFETY * min(
        (tolerance / max(last, 1e-200)) ** (1.0 / ORDER), (tolerance / max(before, 1e-200)) ** (1.0 / (ORDER - 1.0))
    )


@njit(cache=True, error_model="numpy")
def _settle(constants, inputs, memory, x, y, dy, out):
    """Phase of a contact whose sliding speed is 0: rolling if that is possible, else the way it is pushed."""
    _from_series(constants, inputs, x, y)
    # Written so that it is the very call of `advance`: each kind of arguments would be compiled anew.
    memory[PHASE] = ROLLING
    tick, phase = int(memory[_TICK]), int(memory[PHASE])
    rates(constants, inputs, tick, memory[_FRACTION], memory[ONSET], phase, True, y, dy, out)
    memory[EVALUATIONS] += 1.0
    needed = out[S.FRICTION_FORCE]
    if abs(needed) > constants.contact.friction * out[S.NORMAL_FORCE]:
        memory[PHASE] = FORWARD if needed > 0.0 else BACKWARD
        memory[_KNOWN + 1] = 1.0


@njit(cache=True, error_model="numpy")
def _change_phase(constants, inputs, memory, x, y, dy, out):
    """Go over to what is behind the event that has ended a series, at the state x where it happens."""
    event, phase = int(memory[_EVENT]), int(memory[PHASE])
    contact, exact = constants.contact, constants.levels.friction == EXACT
    memory[_EVENT] = _NOTHING
    known = memory[_KNOWN : _KNOWN + 3]
    for i in range(3):
        known[i] = 0.0
    depth, rate, sliding = _ring(constants, inputs, x)
    sliding_phase = TOUCHING
    if exact:
        sliding_phase = FORWARD if sliding > 0.0 else BACKWARD
    if phase == FLIGHT:
        if event == _FIRST:
            memory[CONTACTS] += 1.0
            if rate < contact.speed_floor:
                memory[FLOORED] += 1.0
            memory[ONSET] = max(rate, contact.speed_floor)
            memory[PHASE] = sliding_phase if abs(sliding) > _AT_REST else TOUCHING
            x[_ROOT] = 0.0
            known[0] = 1.0
            if rate < _SLOWEST or not (contact.exponent == 1.5 or contact.exponent == 1.0):
                x[_ROOT] = _LEAST_ROOT
                known[0] = 0.0
    elif memory[_SLACK] != 0.0:
        if event == _FIRST:
            memory[PHASE], memory[_SLACK] = FLIGHT, 0.0
            known[0] = 1.0
        elif event == _THIRD:
            memory[PHASE], memory[_SLACK] = sliding_phase, 0.0
            known[2] = 1.0
    elif event == _FIRST:
        if phase == ROLLING:
            memory[PHASE] = TOUCHING
        else:
            memory[PHASE] = FLIGHT
            known[0] = 1.0
    elif phase == ROLLING:
        if event != _NOTHING and event <= _THIRD:
            memory[PHASE] = FORWARD if event == _SECOND else BACKWARD
            known[1] = 2.0
    elif event == _THIRD:
        memory[_SLACK] = 1.0
        memory[CLAMPS] += 1.0
        known[2] = 1.0
    elif event == _SECOND and exact:
        if phase == TOUCHING and abs(sliding) > _AT_REST:
            memory[PHASE] = sliding_phase
        else:
            _settle(constants, inputs, memory, x, y, dy, out)
    # The depth itself, where it can be told, so that its root does not drift.
    slowed = memory[PHASE] != FLIGHT and memory[PHASE] != ROLLING
    if slowed and (depth > 1e-10 or phase == ROLLING or memory[_SPAN] < 0.0):
        x[_ROOT] = math.sqrt(max(depth, 1e-14))
    house = constants.house
    memory[_NORTH] = memory[_EAST] = 0.0
    if constants.levels.inner_house:
        memory[_NORTH] = _loses(x[4] - x[6], x[11] - x[13], house.pair_stiffness_vertical, house.preload)
    if constants.levels.outer_house:
        memory[_EAST] = _loses(x[5], x[12], house.pair_stiffness_horizontal, house.preload)


@njit(cache=True, error_model="numpy")
def _preload_end(constants, memory, Y, h):
    """Where within h a transducer loses or finds its preload; and which pair's."""
    house = constants.house
    nearest, which = math.inf, _NOTHING
    for pair in range(2):
        if not (constants.levels.inner_house if pair == 0 else constants.levels.outer_house):
            continue
        stiffness = house.pair_stiffness_vertical if pair == 0 else house.pair_stiffness_horizontal
        lost = memory[_NORTH + pair]
        # Bounds on the displacement by its coefficients.
        middle, swing, power = 0.0, 0.0, 1.0
        for k in range(ORDER + 1):
            value = Y[k, 4] - Y[k, 6] if pair == 0 else Y[k, 5]
            if k == 0:
                middle = value
            else:
                power *= h
                swing += abs(value * power)
        limit = 2.0 * house.preload / stiffness
        if lost == 0.0 and abs(middle) + swing < limit:
            continue
        for side in range(2):
            sign = lost if lost != 0.0 else (1.0 if side == 0 else -1.0)
            way = 1.0 if lost != 0.0 else -1.0
            # Above 0 while nothing changes; in the last column, which events no longer need.
            for k in range(ORDER + 1):
                value = Y[k, 4] - Y[k, 6] if pair == 0 else Y[k, 5]
                Y[k, _E + 2] = way * sign * value / limit
            Y[0, _E + 2] -= way
            shift = 1 if abs(Y[0, _E + 2]) < 1e-11 else 0
            zero = _first_zero(Y, _E + 2, shift, h)
            if zero < nearest and not (shift == 1 and zero == 0.0):
                nearest, which = zero, _HOUSE_NS + pair
            if lost != 0.0:
                break
    return nearest, which


@njit(cache=True, error_model="numpy")
def _note_peak(memory, Y):
    """The largest normal force within a series."""
    h = memory[_LENGTH]
    most, power = Y[0, _FN], 1.0
    for k in range(1, ORDER):
        power *= h
        most += max(0.0, Y[k, _FN] * power)
    if not most > memory[PEAK_FORCE]:
        return
    slope_before, before = Y[1, _FN], 0.0
    peak = max(memory[PEAK_FORCE], Y[0, _FN])
    for i in range(1, 9):
        s = 0.125 * i * h
        value, slope = _column(Y, _FN, 0, s)
        peak = max(peak, value)
        if slope_before > 0.0 and slope < 0.0:
            low, high = before, s
            for _ in range(30):
                middle = 0.5 * (low + high)
                value, slope_middle = _column(Y, _FN, 0, middle)
                peak = max(peak, value)
                if slope_middle > 0.0:
                    low = middle
                else:
                    high = middle
        before, slope_before = s, slope
    memory[PEAK_FORCE] = peak


@njit(cache=True, error_model="numpy")
def _next_series(constants, inputs, memory, Y, A, B, D, acc, x, y, dy, out):
    """From the end of one series to the next.

    Returns:
        False where there is none: the numbers are no longer finite.
    """
    if memory[_SPAN] >= 0.0:
        if memory[PHASE] != FLIGHT:
            _note_peak(memory, Y)
        _value(Y, memory[_LENGTH], x)
        memory[_TICK], memory[_FRACTION] = memory[_END_TICK], memory[_END_FRACTION]
    _change_phase(constants, inputs, memory, x, y, dy, out)
    for i in range(_WIDTH):
        Y[0, i] = x[i]
    slowed = _make_series(constants, inputs, memory, Y, A, B, D, acc)
    memory[STEPS] += 1.0
    memory[EVALUATIONS] += ORDER
    if memory[PHASE] != FLIGHT:
        memory[CONTACT_STEPS] += 1.0
    if memory[_TOLERANCE] < _ROUNDING:
        memory[CEILING] += 1.0
    h = _length(memory, Y, slowed)
    if not math.isfinite(h):
        return False
    least = _SHORTEST_S / max(Y[0, _ROOT], 1e-4) if slowed else _SHORTEST_S
    if h < least:
        h = least
        memory[CEILING] += 1.0
    # No further than a corner of the hammer's pulse.
    now = memory[_TICK]
    corner = math.inf
    if inputs.hammer_end > inputs.hammer_start:
        if inputs.hammer_start > now:
            corner = float(inputs.hammer_start)
        elif inputs.hammer_end > now:
            corner = float(inputs.hammer_end)
    limit = min(_LONGEST_S, ((corner - now) - memory[_FRACTION]) * inputs.tick_s)
    at_corner = False
    if slowed:
        span = _column(Y, _T, 0, h)[0]
        if span > limit:
            h = _refine(Y, _T, 0, limit, 0.0, h)
            at_corner = limit < _LONGEST_S
    elif h >= limit:
        h = limit
        at_corner = limit < _LONGEST_S
    event = _NOTHING
    for i in range(3):
        shift = int(memory[_KNOWN + i])
        zero = _first_zero(Y, _E + i, shift, h)
        if zero <= h:
            h, event, at_corner = zero, _FIRST + i, False
    zero, which = _preload_end(constants, memory, Y, h)
    if zero <= h:
        h, event, at_corner = zero, which, False
    span = _column(Y, _T, 0, h)[0] if slowed else h
    memory[_STALLED] = memory[_STALLED] + 1.0 if span < 1e-13 else 0.0
    memory[_LENGTH], memory[_SPAN], memory[_EVENT] = h, span, event
    if at_corner:
        memory[_END_TICK], memory[_END_FRACTION] = corner, 0.0
    else:
        ticks = memory[_FRACTION] + span / inputs.tick_s
        whole = math.floor(ticks)
        memory[_END_TICK], memory[_END_FRACTION] = now + whole, ticks - whole
    return True


@njit(cache=True, error_model="numpy")
def _reach(constants, inputs, memory, Y, A, B, D, acc, x, y, dy, out, tick):
    """State at a tick, into y: series after series up to there, the last one read off.

    Returns:
        Whether the numbers are still finite.
    """
    while (tick - memory[_END_TICK]) - memory[_END_FRACTION] > 0.0 or memory[_SPAN] < 0.0:
        if memory[_STALLED] > 1000.0 or not _next_series(constants, inputs, memory, Y, A, B, D, acc, x, y, dy, out):
            memory[CEILING] += 1.0
            y[:] = np.nan
            return False
    time = ((tick - memory[_TICK]) - memory[_FRACTION]) * inputs.tick_s
    s = time
    if time >= memory[_SPAN]:
        s = memory[_LENGTH]
    elif memory[PHASE] != FLIGHT and memory[PHASE] != ROLLING:
        s = _refine(Y, _T, 0, time, 0.0, memory[_LENGTH])
    _value(Y, s, x)
    _from_series(constants, inputs, x, y)
    return True


@njit(cache=True, error_model="numpy")
def _same_inputs(inputs, memory):
    """Whether the inputs are what they were; keeps them."""
    kept = memory[_INPUTS : _INPUTS + 11]
    same = (
        kept[0] == inputs.tick_s
        and kept[1] == inputs.hammer_force
        and kept[2] == inputs.hammer_x
        and kept[3] == inputs.hammer_y
        and kept[4] == inputs.hammer_start
        and kept[5] == inputs.hammer_end
        and kept[6] == inputs.speed
        and kept[7] == inputs.speed_slope
        and kept[8] == inputs.speed_tick
        and (kept[9] != 0.0) == inputs.ideal_drive
        and (kept[10] != 0.0) == inputs.magnet_engaged
    )
    kept[0], kept[1], kept[2], kept[3] = inputs.tick_s, inputs.hammer_force, inputs.hammer_x, inputs.hammer_y
    kept[4], kept[5], kept[6] = inputs.hammer_start, inputs.hammer_end, inputs.speed
    kept[7], kept[8] = inputs.speed_slope, inputs.speed_tick
    kept[9] = 1.0 if inputs.ideal_drive else 0.0
    kept[10] = 1.0 if inputs.magnet_engaged else 0.0
    return same


@njit(cache=True, error_model="numpy")
def _aligned(rows, columns):
    """Zeros whose rows begin on cache lines: the sums over lanes take half as long again without."""
    room = np.zeros(rows * columns + 8)
    first = (-room.ctypes.data % 64) // 8
    return room[first : first + rows * columns].reshape((rows, columns))


@njit(cache=True, error_model="numpy", nogil=True)
def advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """Take `steps` steps in place and write every `stride`-th instant's row (see `rig.engines`).

    Args:
        constants: Numbers of the model.
        inputs: Hammer, drive, magnets; constant over the call.
        y: State and integrals, in and out, shape (N_VECTOR,). Read only where no series goes on.
        memory: In and out, shape (MEMORY,).
        tick: Time at the start.
        step_ticks: Ticks a step of the grid that rows and calls lie on.
        steps: Number of steps.
        stride: Steps a row.
        rows: Out, shape (ceil(steps / stride), N_ROW).
    """
    Y = memory[_SERIES : _SERIES + (ORDER + 1) * _WIDTH].reshape((ORDER + 1, _WIDTH))
    A = _aligned(ORDER + 1, _ALL_LANES)
    B = _aligned(ORDER + 1, _ALL_LANES)
    D = _aligned(ORDER + 1, _WIDTH)
    acc = _aligned(1, _ALL_LANES)[0]
    x = np.zeros(_WIDTH)
    dy = np.empty(S.N_VECTOR)
    out = np.empty(S.N_OBSERVED)
    if not _same_inputs(inputs, memory) or memory[_SPAN] < 0.0:
        # A new beginning, from what is here now.
        _to_series(constants, inputs, y, x)
        if memory[_SPAN] >= 0.0 and memory[PHASE] != FLIGHT:
            _note_peak(memory, Y)
        memory[_SPAN] = -1.0
        memory[_EVENT] = _NOTHING
        memory[_TICK], memory[_FRACTION] = float(tick), 0.0
        memory[_END_TICK], memory[_END_FRACTION] = float(tick), 0.0
        if not _next_series(constants, inputs, memory, Y, A, B, D, acc, x, y, dy, out):
            memory[_STALLED] = 1e9
    for row in range((steps + stride - 1) // stride):
        now = tick + row * stride * step_ticks
        _reach(constants, inputs, memory, Y, A, B, D, acc, x, y, dy, out, now)
        rates(constants, inputs, now, 0.0, memory[ONSET], int(memory[PHASE]), True, y, dy, out)
        for i in range(S.N_VECTOR):
            rows[row, i] = y[i]
        for i in range(S.N_OBSERVED):
            rows[row, S.N_VECTOR + i] = out[i]
    _reach(constants, inputs, memory, Y, A, B, D, acc, x, y, dy, out, tick + steps * step_ticks)
