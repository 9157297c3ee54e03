"""One step of Radau IIA on the rolling constraint, condensed to the ring's force at the nodes.

Shaft, spin and housings are linear bodies (`rig.physics.engines.split.radau`), driven by the ring's force F and the
nonlinear part of their accelerations. Two conditions apply at each node: the penetration gives F_n by the normal law,
and the sliding speed is 0, or that at which smoothed friction gives F_t. The laws are inverted because Newton's method
on K delta^1.5 does not converge from a distant guess. Newton's method solves for F alone, shape (2, STAGES): the other
unknowns follow from F or change little and slowly.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rig.physics.engines.common.memory import ONSET
from rig.physics.engines.split import layout
from rig.physics.engines.split.radau import INTEGRALS, NODES, STAGES, TAIL, collocate, invert
from rig.physics.engines.taylor.memory import FRACTION, TICK
from rig.physics.kernels import signals as S
from rig.physics.kernels.dynamics import accelerations
from rig.physics.kernels.forces import disk_forces, drive_torque, magnet_forces, stator_forces, support_forces, torques
from rig.physics.kernels.frames.geometry import State, compute_eccentricity, compute_pose
from rig.physics.kernels.laws.contact import SMOOTHED, RingForce
from rig.physics.kernels.ledger import get_powers
from rig.physics.kernels.stage import kernel, stage

_ITERATIONS = 8
"""Largest number of iterations; three are usual."""
_MAX_CONTRACTION = 0.4
"""Largest ratio of successive changes with an inverse from an earlier step."""
FORCE_FLOOR_N = 100.0
"""Smallest reference force for relative errors of the force, as in `rig.physics.accuracy`."""
_MAX_UNLOADING = 0.9
"""Largest unloading of a transducer at the nodes, as a share of the preload; it may be larger between them."""
_MIN_MARGIN = 0.25
"""Minimum distance from slip and lift-off, over its range at the nodes; it may be smaller between them."""
FX, _FY, _AX, _AY, _AS, _Z = (layout.UNKNOWNS + row * STAGES for row in range(6))
"""Unknowns: ring's force [N]; nonlinear part of the accelerations; penetration [m]."""
N_UNKNOWNS = 6
_NX, _NY, _DISTANCE, _RATE, _ALONG, FN, FT, _BY_RATE, _BY_FORCE = (layout.AT_NODES + row * STAGES for row in range(9))
_SLIP_BY_FORCE = layout.AT_NODES + 18 * STAGES
"""Contact at the nodes: normal, distance [m], velocities [m/s], forces [N], derivatives of the penetration, and of the
friction law's sliding speed by the friction force [m/s/N]."""
_RHO_X, _RHO_Y, _RHO_S, _EX, _EY, _VX, _VY, _SPIN, _ROTATION = (layout.AT_NODES + row * STAGES for row in range(9, 18))
"""Accelerations at the nodes minus the unknowns; the resulting eccentricity, velocity and spin; rotation [rad/s]."""
_R1, _R2 = layout.RESIDUALS, layout.RESIDUALS + STAGES
_X = layout.NODE_STATES
_B, _DB, _Q, _DQ, _TH, _DTH, _XI, _XO, _VXI, _VXO, _YI, _YO, _VYI, _VYO = (_X + row * STAGES for row in range(14))
"""Node states, one body after another; q is -Gamma."""
ROWS_OF_STATE = np.array([
    S.BETA, S.BETA_RATE, S.GAMMA, S.GAMMA_RATE, S.THETA, S.THETA_RATE, S.X_IH, S.X_OH, S.VX_IH, S.VX_OH,
    S.Y_IH, S.Y_OH, S.VY_IH, S.VY_OH,
])  # fmt: skip
_INTEGRALS_BY_NODE = np.ascontiguousarray(INTEGRALS.T)
SIGN_OF_STATE = np.array([1.0, 1.0, -1.0, -1.0] + 10 * [1.0])


class Rolling(NamedTuple):
    """Arrays of rolling by collocation. Linear responses are by direction, x and y."""

    Y: np.ndarray  # state and integrals at start and nodes, shape (STAGES + 1, N_VECTOR)
    shaft_free: np.ndarray  # of shaft x, shaft y and spin, shape (3, 2, 2, STAGES)
    shaft_forced: np.ndarray  # shape (3, 2, STAGES, STAGES)
    house_free: np.ndarray  # shape (2, 4, 4, STAGES)
    house_forced: np.ndarray  # shape (2, 4, STAGES, STAGES)
    inverses: np.ndarray  # inverse Jacobians, shape (MAX_PLACES, 2, 2, STAGES, STAGES): F, residual, their nodes
    history: np.ndarray  # unknowns of the last three turns, shape (3, MAX_PLACES, 6, STAGES)


@kernel
def view_rolling(memory):
    """Return views on the memory, with workspace for a step."""
    n = STAGES
    return Rolling(
        memory[layout.NODE_VALUES : layout.SHAFT_FREE].reshape((n + 1, S.N_VECTOR)),
        memory[layout.SHAFT_FREE : layout.SHAFT_FORCED].reshape((3, 2, 2, n)),
        memory[layout.SHAFT_FORCED : layout.HOUSE_FREE].reshape((3, 2, n, n)),
        memory[layout.HOUSE_FREE : layout.HOUSE_FORCED].reshape((2, 4, 4, n)),
        memory[layout.HOUSE_FORCED : layout.INVERSES].reshape((2, 4, n, n)),
        memory[layout.INVERSES : layout.HISTORY].reshape((layout.MAX_PLACES, 2, 2, n, n)),
        memory[layout.HISTORY : layout.UNKNOWNS].reshape((3, layout.MAX_PLACES, N_UNKNOWNS, n)),
    )


@kernel
def body_matrices(constants, inputs):
    """Return matrices of shaft x, shaft y and spin, shape (3, 2, 2), and of housings x and y, shape (2, 4, 4)."""
    levels, shaft, magnet, house = constants.levels, constants.shaft, constants.magnet, constants.house
    shafts, houses = np.zeros(12).reshape((3, 2, 2)), np.zeros(32).reshape((2, 4, 4))
    lever = shaft.arm_magnet * shaft.arm_magnet / shaft.transverse_inertia if inputs.magnet_engaged else 0.0
    for body in range(3):
        shafts[body, 0, 1] = 1.0
    shafts[0, 1, 0] = shafts[1, 1, 0] = -magnet.stiffness * lever
    shafts[0, 1, 1], shafts[1, 1, 1] = -magnet.damping_x * lever, -magnet.damping_y * lever
    if not inputs.ideal_drive:
        shafts[2, 1, 1] = -constants.torque_gain / shaft.polar_inertia
    for i in range(2):
        houses[i, 0, 2] = houses[i, 1, 3] = 1.0
        if levels.inner_house:
            inner = house.inner_beam_stiffness if i == 0 else house.pair_stiffness_vertical
            damping = house.inner_beam_damping if i == 0 else 0.0
            houses[i, 2, 0], houses[i, 2, 1] = -inner / house.inner_mass, inner / house.inner_mass
            houses[i, 2, 2], houses[i, 2, 3] = -damping / house.inner_mass, damping / house.inner_mass
            if levels.outer_house:
                outer = house.pair_stiffness_horizontal if i == 0 else house.outer_beam_stiffness
                lost = 0.0 if i == 0 else house.outer_beam_damping
                houses[i, 3, 0], houses[i, 3, 1] = inner / house.outer_mass, -(inner + outer) / house.outer_mass
                houses[i, 3, 2], houses[i, 3, 3] = damping / house.outer_mass, -(damping + lost) / house.outer_mass
    return shafts, houses


@kernel
def set_step(constants, inputs, memory):
    """Compute the responses of the linear bodies over steps of the length in the memory.

    Called from Python: each compiled caller would compile all of it again.
    """
    constants, inputs = constants[0], inputs[0]
    shafts, houses = body_matrices(constants, inputs)
    per_inner = 1.0 / constants.house.inner_mass if constants.levels.inner_house else 0.0
    rolling, h = view_rolling(memory), memory[layout.STEP_S]
    for body in range(3):
        collocate(shafts[body], 1, 1.0, h, rolling.shaft_free[body], rolling.shaft_forced[body])
    for i in range(2):
        collocate(houses[i], 2, -per_inner, h, rolling.house_free[i], rolling.house_forced[i])
    memory[layout.STALE_RESPONSES] = 0.0


@kernel
def _respond(m, forced, u, out, n=STAGES):
    """Add the response of one component to u at the nodes.

    Arguments are positions in the memory, as views would be slower. The number `n` is an argument because a loop of
    constant length would be unrolled instead of vectorised.
    """
    a, b, c, d, e, f, g, h = m[u], m[u + 1], m[u + 2], m[u + 3], m[u + 4], m[u + 5], m[u + 6], m[u + 7]
    F, G, H, K, L, M, N, P = (
        m[forced : forced + n], m[forced + 8 : forced + 8 + n], m[forced + 16 : forced + 16 + n],
        m[forced + 24 : forced + 24 + n], m[forced + 32 : forced + 32 + n], m[forced + 40 : forced + 40 + n],
        m[forced + 48 : forced + 48 + n], m[forced + 56 : forced + 56 + n],
    )  # fmt: skip
    for i in range(n):
        m[out + i] += F[i] * a + G[i] * b + H[i] * c + K[i] * d + L[i] * e + M[i] * f + N[i] * g + P[i] * h


@kernel
def _compute_undriven_states(m):
    """Compute the node states for zero unknowns, from the state at the start."""
    for body in range(5):
        n = 2 if body < 3 else 4
        first = 2 * body if body < 3 else 4 * body - 6
        free = layout.SHAFT_FREE + 4 * STAGES * body if body < 3 else layout.HOUSE_FREE + 16 * STAGES * (body - 3)
        for c in range(n):
            out = layout.UNDRIVEN + (first + c) * STAGES
            for i in range(STAGES):
                m[out + i] = 0.0
            for d in range(n):
                value = SIGN_OF_STATE[first + d] * m[layout.NODE_VALUES + ROWS_OF_STATE[first + d]]
                for i in range(STAGES):
                    m[out + i] += m[free + (c * n + d) * STAGES + i] * value


@stage
def _begin_row(m, row):
    """Initialise a row of node states with those for zero unknowns."""
    for i in range(STAGES):
        m[_X + row * STAGES + i] = m[layout.UNDRIVEN + row * STAGES + i]


@stage
def _place_rotor(m):
    """Compute the node states of shaft and spin from the unknowns."""
    for row in range(6):
        _begin_row(m, row)
        _respond(m, layout.SHAFT_FORCED + row * STAGES**2, _AX + row // 2 * STAGES, _X + row * STAGES)


@stage
def _place_houses(m, every):
    """Compute every `every`-th row (2 or 1) of the housings' node states from the unknowns, the inner housing first."""
    for row in range(0, 8, every):
        _begin_row(m, 6 + row)
        _respond(m, layout.HOUSE_FORCED + row * STAGES**2, FX + row // 4 * STAGES, _XI + row * STAGES)


@stage
def _state_at(m, i):
    """Return the state at a node."""
    return State(
        -m[_Q + i], m[_B + i], m[_TH + i], m[_XI + i], m[_YI + i], m[_XO + i], m[_YO + i],
        -m[_DQ + i], m[_DB + i], m[_DTH + i], m[_VXI + i], m[_VYI + i], m[_VXO + i], m[_VYO + i],
    )  # fmt: skip


@stage
def root_of_law(load, guess, exponent):
    """Solve penetration^exponent = load; for exponent 1.5 by Halley's method from a guess."""
    if load <= 0.0:
        return 0.0
    if exponent == 1.0:
        return load
    if exponent != 1.5 or guess <= 0.0:
        return load ** (1.0 / exponent)
    square = load * load
    for _ in range(12):
        cube = guess * guess * guess
        new = guess * (cube + 2.0 * square) / (2.0 * cube + square)
        done = abs(new - guess) <= 1e-5 * new
        guess = new
        if done:
            break
    return guess


@stage
def slip_of_law(contact, friction, share):
    """Return the sliding speed [m/s] at which a friction law gives a share of mu F_n: 0 unless it is smoothed."""
    return contact.smoothing_speed * math.atanh(share) if friction == SMOOTHED else 0.0


@stage
def _evaluate_node(constants, inputs, m, h, i):
    """Evaluate contact and motion at a node; geometry and force components go to the memory, the rest is returned."""
    state = _state_at(m, i)
    pose = compute_pose(constants.levels, state)
    e = compute_eccentricity(constants, state, pose)
    distance = math.sqrt(e.ex * e.ex + e.ey * e.ey)
    nx, ny = e.ex / distance, e.ey / distance
    m[_NX + i], m[_NY + i], m[_DISTANCE + i], m[_ROTATION + i] = nx, ny, distance, pose.w
    m[_RATE + i], m[_ALONG + i] = e.vx * nx + e.vy * ny, e.vy * nx - e.vx * ny
    Fx, Fy = m[FX + i], m[_FY + i]
    m[FN + i], m[FT + i] = -(Fx * nx + Fy * ny), Fx * ny - Fy * nx
    tick, at = int(m[TICK]), m[FRACTION] + NODES[i] * h / inputs.tick_s
    magnets, disk = magnet_forces(constants, inputs, pose), disk_forces(constants, inputs, tick, at, state)
    Lx, Ly = torques(constants, magnets, disk)
    drive, stator = drive_torque(constants, inputs, tick, at, state), stator_forces(constants, state)
    motion = accelerations(constants, inputs, state, pose, stator, Lx, Ly, drive, Fx, Fy, m[FT + i])
    return state, pose, magnets, disk, stator, motion


@stage
def linear_coefficients(constants, inputs):
    """Return stiffness [1/s^2] and damping x, y [1/s] of the shaft's linear bodies, and the spin's damping [1/s]."""
    shaft, magnet = constants.shaft, constants.magnet
    lever = shaft.arm_magnet * shaft.arm_magnet / shaft.transverse_inertia if inputs.magnet_engaged else 0.0
    gain = 0.0 if inputs.ideal_drive else constants.torque_gain / shaft.polar_inertia
    return magnet.stiffness * lever, magnet.damping_x * lever, magnet.damping_y * lever, gain


@stage
def _evaluate_nodes(constants, inputs, m, h):
    """Compute residuals and acceleration defects at the nodes; return whether all are finite."""
    shaft, contact = constants.shaft, constants.contact
    stiffness, damping_x, damping_y, gain = linear_coefficients(constants, inputs)
    friction = constants.levels.friction
    creeps = friction == SMOOTHED
    known = 0.0
    for i in range(STAGES):
        state, _, _, _, _, motion = _evaluate_node(constants, inputs, m, h, i)
        rate = m[_RATE + i]
        m[_RHO_X + i] = motion.ddb + stiffness * state.beta + damping_x * state.db - m[_AX + i]
        m[_RHO_Y + i] = -(motion.ddG + stiffness * state.Gamma + damping_y * state.dG) - m[_AY + i]
        m[_RHO_S + i] = motion.ddth + gain * state.dth - m[_AS + i]
        slope = contact.damping_factor / m[ONSET]
        ratio, load = 1.0 + slope * rate, m[FN + i] - contact.viscous_damping * rate
        z = root_of_law(load / (contact.stiffness * ratio), m[_Z + i], contact.exponent)
        m[_Z + i] = z
        by_force = z / (contact.exponent * load)
        m[_BY_FORCE + i] = by_force
        m[_BY_RATE + i] = -contact.viscous_damping * by_force - z / contact.exponent * slope / ratio
        m[_R1 + i] = (m[_DISTANCE + i] - contact.clearance - z) / h
        most = contact.friction * m[FN + i]
        slip = slip_of_law(contact, friction, m[FT + i] / most)
        m[_SLIP_BY_FORCE + i] = (
            contact.smoothing_speed * most / (most * most - m[FT + i] * m[FT + i]) if creeps else 0.0
        )
        m[_R2 + i] = m[_ALONG + i] + shaft.radius * m[_ROTATION + i] - slip
        known += m[_R1 + i] + m[_R2 + i] + m[_RHO_X + i] + m[_RHO_Y + i] + m[_RHO_S + i]
    return math.isfinite(known)


@stage
def _add_acceleration_defects(constants, inputs, m, h):
    """Add the effect of the acceleration defects to the residuals."""
    shaft = constants.shaft
    for i in range(5 * STAGES):
        m[_EX + i] = 0.0
    for row in range(2):
        _respond(m, layout.SHAFT_FORCED + 2 * row * STAGES**2, _RHO_X + row * STAGES, _EX + row * STAGES)
        _respond(m, layout.SHAFT_FORCED + (2 * row + 1) * STAGES**2, _RHO_X + row * STAGES, _VX + row * STAGES)
    lA = shaft.arm_ring
    for i in range(STAGES):
        te = lA * (m[_EY + i] * m[_NX + i] - m[_EX + i] * m[_NY + i])
        if not inputs.ideal_drive:
            m[_RHO_S + i] += shaft.radius / shaft.polar_inertia * m[FN + i] / m[_DISTANCE + i] * te
    _respond(m, layout.SHAFT_FORCED + 5 * STAGES**2, _RHO_S, _SPIN)
    for i in range(STAGES):
        nx, ny, per = m[_NX + i], m[_NY + i], 1.0 / m[_DISTANCE + i]
        ne, te = lA * (m[_EX + i] * nx + m[_EY + i] * ny), lA * (m[_EY + i] * nx - m[_EX + i] * ny)
        nv, tv = lA * (m[_VX + i] * nx + m[_VY + i] * ny), lA * (m[_VY + i] * nx - m[_VX + i] * ny)
        change = ne - m[_BY_RATE + i] * (nv + m[_ALONG + i] * per * te) - m[_BY_FORCE + i] * m[FT + i] * per * te
        m[_R1 + i] += change / h
        friction = (m[FN + i] + m[FT + i] * m[FT + i] / m[FN + i]) * per * te
        m[_R2 + i] += tv - m[_RATE + i] * per * te + shaft.radius * m[_SPIN + i] + m[_SLIP_BY_FORCE + i] * friction


@kernel
def _make_inverse(constants, inputs, m, rolling, h, inverse):
    """Compute the inverse of the residuals' derivative by F at the current node states; return False if singular."""
    n, shaft = STAGES, constants.shaft
    arm = shaft.arm_ring * shaft.arm_ring / shaft.transverse_inertia
    both = constants.contact.gap_counts_outer
    spin = 0.0 if inputs.ideal_drive else shaft.radius * shaft.radius / shaft.polar_inertia
    turned, J = np.zeros(2 * n * n).reshape((n, 2 * n)), np.zeros(4 * n * n).reshape((2 * n, 2 * n))
    for direction in range(2):
        shaft_q, shaft_v = rolling.shaft_forced[direction, 0], rolling.shaft_forced[direction, 1]
        house = rolling.house_forced[direction]
        for i in range(n):
            nx, ny, per = m[_NX + i], m[_NY + i], 1.0 / m[_DISTANCE + i]
            along_n, along_t = (nx, -ny) if direction == 0 else (ny, nx)
            for j in range(n):
                column, same = direction * n + j, 1.0 if i == j else 0.0
                e = arm * shaft_q[j, i] - house[0, j, i] - both * house[1, j, i]
                v = arm * shaft_v[j, i] - house[2, j, i] - both * house[3, j, i]
                te = along_t * e
                by_rate = m[_BY_RATE + i] * (along_n * v + m[_ALONG + i] * per * te)
                by_force = m[_BY_FORCE + i] * (same * along_n - m[FT + i] * per * te)
                J[i, column] = (along_n * e - by_rate + by_force) / h
                turned[i, column] = same * along_t + m[FN + i] * per * te
                friction = turned[i, column] - m[FT + i] / m[FN + i] * (same * along_n - m[FT + i] * per * te)
                J[n + i, column] = along_t * v - m[_RATE + i] * per * te + m[_SLIP_BY_FORCE + i] * friction
    spun = rolling.shaft_forced[2, 1]
    for i in range(n):
        for k in range(n):
            factor = spin * spun[k, i]
            for column in range(2 * n):
                J[n + i, column] += factor * turned[k, column]
    regular = invert(J, 2 * n)
    for i in range(2 * n):
        for j in range(2 * n):
            inverse[i // n, j // n, j % n, i % n] = J[i, j]
    return regular


@stage
def _improve(constants, inputs, m, inverse):
    """Apply Newton's step; return its size over the largest normal force."""
    n, shaft = STAGES, constants.shaft
    for i in range(2 * n):
        m[layout.CHANGES + i] = 0.0
    for row in range(2):
        for column in range(2):
            block = inverse + (2 * row + column) * n * n
            _respond(m, block, layout.RESIDUALS + column * n, layout.CHANGES + row * n)
    arm = shaft.arm_ring / shaft.transverse_inertia
    spin = 0.0 if inputs.ideal_drive else shaft.radius / shaft.polar_inertia
    size = force = 0.0
    for i in range(n):
        x, y = -m[layout.CHANGES + i], -m[layout.CHANGES + n + i]
        size, force = max(size, abs(x), abs(y)), max(force, abs(m[FN + i]))
        m[FX + i] += x
        m[_FY + i] += y
        m[_AX + i] += m[_RHO_X + i] + arm * x
        m[_AY + i] += m[_RHO_Y + i] + arm * y
        m[_AS + i] += m[_RHO_S + i] + spin * (y * m[_NX + i] - x * m[_NY + i])
    return size / force


@kernel
def solve_step(constants, inputs, m, rolling, h, number, has_inverse, goal):
    """Solve a step from the state in the first row of Y and a guess of the unknowns.

    Args:
        constants: Model constants.
        inputs: Hammer, drive, magnets.
        m: Memory of the engine; node states and unknowns are out.
        rolling: Views on the memory.
        h: Length of the step [s].
        number: Index of the step in its turn, which selects the inverse.
        has_inverse: Whether this inverse has been computed.
        goal: Change of F over the largest normal force at which to stop.

    Returns:
        Number of iterations, 0 without convergence.
    """
    inverse = layout.INVERSES + number * 4 * STAGES**2
    _compute_undriven_states(m)
    before = math.inf
    every = 2 if constants.contact.gap_counts_outer == 0.0 else 1
    for iteration in range(_ITERATIONS):
        _place_rotor(m)
        _place_houses(m, every)
        if not _evaluate_nodes(constants, inputs, m, h):
            return 0
        if not has_inverse:
            if not _make_inverse(constants, inputs, m, rolling, h, rolling.inverses[number]):
                return 0
            has_inverse = True
        _add_acceleration_defects(constants, inputs, m, h)
        size = _improve(constants, inputs, m, inverse)
        if not math.isfinite(size):
            return 0
        if size < goal:
            return iteration + 1
        if size > _MAX_CONTRACTION * before:
            has_inverse = False
        before = size
    return 0


@kernel
def write_nodes(constants, inputs, m, h):
    """Write states and integrals at the nodes of a solved step to Y."""
    _place_rotor(m)
    _place_houses(m, 1)
    contact = constants.contact
    for i in range(STAGES):
        state, pose, magnets, disk, stator, motion = _evaluate_node(constants, inputs, m, h, i)
        Fx, Fy, Fn, Ft, rate = m[FX + i], m[_FY + i], m[FN + i], m[FT + i], m[_RATE + i]
        elastic = (Fn - contact.viscous_damping * rate) / (1.0 + contact.damping_factor * rate / m[ONSET])
        sliding, gap = m[_ALONG + i] + constants.shaft.radius * pose.w, m[_DISTANCE + i] - contact.clearance
        ring = RingForce(Fx, Fy, Fn, elastic, Ft, gap, rate, sliding, m[_NX + i], m[_NY + i])
        Lx, Ly = torques(constants, magnets, disk)
        support = support_forces(constants, stator, Fx, Fy)
        powers = get_powers(
            constants, state, pose, ring, magnets, disk, stator, support, Lx, Ly, Fx, Fy, Ft, motion.torque
        )
        for k, power in enumerate(powers):
            m[layout.POWERS + k * STAGES + i] = power
        first = layout.NODE_VALUES + (i + 1) * S.N_VECTOR
        for row in range(14):
            m[first + ROWS_OF_STATE[row]] = SIGN_OF_STATE[row] * m[_X + row * STAGES + i]
    for k in range(S.N_VECTOR - S.N_STATE):
        first = layout.NODE_VALUES + S.N_STATE + k
        for i in range(STAGES):
            m[_EX + i] = 0.0
        for i in range(STAGES):
            for j in range(STAGES):
                m[_EX + i] += INTEGRALS[i, j] * m[layout.POWERS + k * STAGES + j]
        for i in range(STAGES):
            m[first + (i + 1) * S.N_VECTOR] = m[first] + h * m[_EX + i]


@stage
def _sum_last_coefficients(m, row):
    """Return the sum of the magnitudes of the last two Legendre coefficients of node values."""
    last = before = 0.0
    for i in range(STAGES):
        before += TAIL[0, i] * m[row + i]
        last += TAIL[1, i] * m[row + i]
    return abs(before) + abs(last)


@kernel
def estimate(m):
    """Return the error estimate of a solved step, from the last polynomials.

    Returns:
        Error of the force [N], and the larger of the relative errors of the force and of the inner housing's speed [1].
    """
    force = FORCE_FLOOR_N
    for i in range(STAGES):
        force = max(force, abs(m[FN + i]))
    house = max(_sum_last_coefficients(m, _VXI), _sum_last_coefficients(m, _VYI)) / S.STATE_SCALE[S.VX_IH]
    added = max(_sum_last_coefficients(m, FN), _sum_last_coefficients(m, FT))
    return added, max(added / force, house)


@stage
def _stays_positive(low, high):
    """Return whether a quantity with these limits at the nodes stays above 0 between the nodes."""
    return low > _MIN_MARGIN * (high - low)


@kernel
def keeps_rolling(constants, m):
    """Return whether a step excludes slip, separation and loss of a transducer's preload."""
    contact, house, levels = constants.contact, constants.house, constants.levels
    least = least_margin = math.inf
    most = most_margin = vertical = horizontal = 0.0
    for i in range(STAGES):
        Fn = m[FN + i]
        margin = contact.friction * Fn - abs(m[FT + i])
        least, most = min(least, Fn), max(most, Fn)
        least_margin, most_margin = min(least_margin, margin), max(most_margin, margin)
        vertical = max(vertical, abs(m[_YI + i] - m[_YO + i]))
        horizontal = max(horizontal, abs(m[_XO + i]))
    limit = 2.0 * house.preload * _MAX_UNLOADING
    return (
        _stays_positive(least, most)
        and _stays_positive(least_margin, most_margin)
        and (not levels.inner_house or house.pair_stiffness_vertical * vertical < limit)
        and (not levels.outer_house or house.pair_stiffness_horizontal * horizontal < limit)
    )
