"""RODAS, an L-stable Rosenbrock method of order 4(3) in six stages: linearly implicit, for stiff problems.

E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (1996), section IV.7 and its code RODAS (method 1).
A stage solves one linear system in the Jacobian J, in the form without products of matrices:

    (1/(g h) - J) U_i = f(y + sum_j a_ij U_j) + sum_j c_ij U_j / h + g_i h df/dt

J is computed by differences once a step. The rates of the positions are the speeds, so the system of 14 reduces to one
of 7. The integrals of the ledger affect nothing else and follow by substitution.

A step costs 21 evaluations, against 12 of rk8. This engine pays off where the contact is over-damped, or friction is
smoothed over a small speed: both make the step of explicit methods equally short.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rig.physics.engines.common.method import FUNCTIONS, PER_SCALE, Functions, rates
from rig.physics.kernels import signals as S
from rig.physics.kernels.stage import kernel

ORDER = 4
_N = S.N_STATE // 2
_STAGES = 6
_GAMMA = 0.25

_A = np.zeros((_STAGES, _STAGES))
_A[1, :1] = [1.544]
_A[2, :2] = [0.9466785280815826, 0.2557011698983284]
_A[3, :3] = [3.314825187068521, 2.896124015972201, 0.9986419139977817]
_A[4, :4] = [1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950]
# The last stage is the fourth-order solution's correction of the third-order one: its U is the error estimate.
_A[5, :5] = [*_A[4, :4], 1.0]
_C = np.zeros((_STAGES, _STAGES))
_C[1, :1] = [-5.6688]
_C[2, :2] = [-2.430093356833875, -0.2063599157091915]
_C[3, :3] = [-0.1073529058151375, -9.594562251023355, -20.47028614809616]
_C[4, :4] = [7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160]
_C[5, :5] = [8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054]
_ALPHA = np.array([0.0, 0.386, 0.21, 0.63, 1.0, 1.0])
_GAMMAS = np.array([0.25, -0.1043, 0.1035, -0.0362, 0.0, 0.0])

# Rows of the workspace: rates at the start; the stages' U; derivatives by each state and by time; a stage's state; the
# right-hand side; the reduced matrix, factorised in place.
_U = 1
_J = _U + _STAGES
_BY_TIME = _J + S.N_STATE
_STATE = _BY_TIME + 1
_RIGHT = _STATE + 1
_LU = _RIGHT + 1
_ROWS = _LU + _N + 1

_INCREMENTS = 1e-8 * S.STATE_SCALE
"""Increment of each state for differences: in a sliding speed some nm/s, far below any smoothing speed."""


class Rosenbrock(NamedTuple):
    """Rosenbrock method in the form that `rig.physics.engines.common.march` requires."""

    rows: int = _ROWS
    order: float = 4.0
    graded: bool = True


METHOD = Rosenbrock()


@kernel
def _prepare(method, constants, inputs, step, y, k, z, out):
    """Compute the Jacobian of all rates by the state and by time, as forward differences."""
    for j in range(S.N_STATE):
        for i in range(S.N_STATE):
            z[i] = y[i]
        z[j] = y[j] + _INCREMENTS[j]
        per_change = 1.0 / (z[j] - y[j])
        column = k[_J + j]
        rates(constants, inputs, step.tick, step.fraction, step.onset_speed, step.phase, False, z, column, out)
        for i in range(S.N_VECTOR):
            column[i] = (column[i] - k[0, i]) * per_change
    ahead = 1e-3 * step.ticks
    per_change = 1.0 / (ahead * inputs.tick_s)
    column = k[_BY_TIME]
    rates(constants, inputs, step.tick, step.fraction + ahead, step.onset_speed, step.phase, False, y, column, out)
    for i in range(S.N_VECTOR):
        column[i] = (column[i] - k[0, i]) * per_change
    return S.N_STATE + 1


@kernel
def _factor(k, g):
    """Factorise 1/g - J_v - g J_x for speeds v and positions x, with row pivoting."""
    for i in range(_N):
        for j in range(_N):
            k[_LU + i, j] = -k[_J + _N + j, _N + i] - g * k[_J + j, _N + i]
        k[_LU + i, i] += 1.0 / g
        k[_LU + i, _N] = float(i)  # index of the original row
    for p in range(_N):
        best = p
        for i in range(p + 1, _N):
            if abs(k[_LU + i, p]) > abs(k[_LU + best, p]):
                best = i
        if best != p:
            for j in range(_N + 1):
                k[_LU + p, j], k[_LU + best, j] = k[_LU + best, j], k[_LU + p, j]
        per_pivot = 1.0 / k[_LU + p, p]
        for i in range(p + 1, _N):
            factor = k[_LU + i, p] * per_pivot
            k[_LU + i, p] = factor
            if factor != 0.0:
                for j in range(p + 1, _N):
                    k[_LU + i, j] -= factor * k[_LU + p, j]


@kernel
def _solve(k, g, u):
    """Solve (1/g - J) u = right for the whole vector."""
    right = k[_RIGHT]
    # Positions: u_x = g (r_x + u_v).
    for i in range(_N):
        row = int(k[_LU + i, _N])
        value = right[_N + row]
        for j in range(_N):
            value += g * k[_J + j, _N + row] * right[j]
        for j in range(i):
            value -= k[_LU + i, j] * u[_N + j]
        u[_N + i] = value
    for i in range(_N - 1, -1, -1):
        value = u[_N + i]
        for j in range(i + 1, _N):
            value -= k[_LU + i, j] * u[_N + j]
        u[_N + i] = value / k[_LU + i, i]
    for i in range(_N):
        u[i] = g * (right[i] + u[_N + i])
    for i in range(S.N_STATE, S.N_VECTOR):
        u[i] = right[i]
    for j in range(S.N_STATE):
        for i in range(S.N_STATE, S.N_VECTOR):
            u[i] += k[_J + j, i] * u[j]
    for i in range(S.N_STATE, S.N_VECTOR):
        u[i] *= g


@kernel
def _step(method, constants, inputs, step, y, k, z, end, out):
    h = step.ticks * inputs.tick_s
    _factor(k, _GAMMA * h)
    state, right = k[_STATE], k[_RIGHT]
    for stage in range(_STAGES):
        if stage == 0:
            for i in range(S.N_VECTOR):
                right[i] = k[0, i]
        else:
            for i in range(S.N_VECTOR):
                state[i] = y[i]
            for j in range(stage):
                for i in range(S.N_VECTOR):
                    state[i] += _A[stage, j] * k[_U + j, i]
            fraction = step.fraction + _ALPHA[stage] * step.ticks
            rates(constants, inputs, step.tick, fraction, step.onset_speed, step.phase, False, state, right, out)
            for j in range(stage):
                weight = _C[stage, j] / h
                for i in range(S.N_VECTOR):
                    right[i] += weight * k[_U + j, i]
        if _GAMMAS[stage] != 0.0:
            for i in range(S.N_VECTOR):
                right[i] += _GAMMAS[stage] * h * k[_BY_TIME, i]
        _solve(k, _GAMMA * h, k[_U + stage])
    for i in range(S.N_VECTOR):
        end[i] = state[i] + k[_U + _STAGES - 1, i]
    return _STAGES - 1


@kernel
def _error(method, h, k, scratch):
    total = 0.0
    for i in range(S.N_STATE):
        total += (k[_U + _STAGES - 1, i] * PER_SCALE[i]) ** 2
    return np.sqrt(total / S.N_STATE)


FUNCTIONS[Rosenbrock] = Functions(step=_step, error=_error, prepare=_prepare)
