"""Explicit Runge-Kutta steps for the tableaus of `rk4`, `tsit5` and `rk8`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rig.physics.engines.common.method import FUNCTIONS, PER_SCALE, Functions, skip_preparation
from rig.physics.kernels import signals as S
from rig.physics.kernels.dynamics import evaluate
from rig.physics.kernels.stage import kernel


class Tableau(NamedTuple):
    """Explicit Runge-Kutta method of s stages with its error estimate."""

    a: np.ndarray  # (s, s)
    b: np.ndarray  # (s,)
    c: np.ndarray  # (s,)
    coarse: np.ndarray  # (s + 1,) weights of a lower-order estimate, the last for the rates at the end
    fine: np.ndarray  # (s + 1,) weights of a higher-order estimate; all 0 for none
    order: float  # order of the estimate's leading error; 0: no estimate
    rows: int  # s + 1
    graded: bool = True


@kernel
def _step(method, constants, inputs, step, y, k, z, end, out):
    """Take one step; k holds the stages' rates, then those at the end."""
    a, b, c = method.a, method.b, method.c
    h = step.ticks * inputs.tick_s
    for stage in range(1, len(b)):
        for i in range(S.N_STATE):
            z[i] = 0.0
        for j in range(stage):
            weight = h * a[stage, j]
            if weight != 0.0:
                for i in range(S.N_STATE):
                    z[i] += weight * k[j, i]
        for i in range(S.N_STATE):
            z[i] += y[i]
        fraction = step.fraction + c[stage] * step.ticks
        evaluate(constants, inputs, step.tick, fraction, step.onset_speed, step.phase, False, z, k[stage], out)
    for i in range(S.N_VECTOR):
        z[i] = 0.0
    for stage in range(len(b)):
        weight = h * b[stage]
        if weight != 0.0:
            for i in range(S.N_VECTOR):
                z[i] += weight * k[stage, i]
    for i in range(S.N_VECTOR):
        end[i] = y[i] + z[i]
    return len(b) - 1


@kernel
def _error(method, h, k, scratch):
    """Return the scaled error estimate of a step, in Hairer's form where there are two estimates."""
    low, high = scratch[0], scratch[1]
    low[:] = 0.0
    high[:] = 0.0
    for stage in range(len(k)):
        weight, other = method.coarse[stage], method.fine[stage]
        if weight != 0.0 or other != 0.0:
            for i in range(S.N_STATE):
                low[i] += weight * k[stage, i]
                high[i] += other * k[stage, i]
    coarse = 0.0
    fine = 0.0
    for i in range(S.N_STATE):
        coarse += (low[i] * PER_SCALE[i]) ** 2
        fine += (high[i] * PER_SCALE[i]) ** 2
    if fine == 0.0:
        return h * np.sqrt(coarse / S.N_STATE)
    return h * fine / np.sqrt((fine + 0.01 * coarse) * S.N_STATE)


FUNCTIONS[Tableau] = Functions(step=_step, error=_error, prepare=skip_preparation)
