"""Velocity Verlet method of order 2: half a velocity step, a position step, half a velocity step.

Forces that depend on the speeds (damping, gyroscopic and centrifugal terms, friction) are evaluated at the end with the
speeds predicted by the first force alone, as is usual. For them the order is also 2, as with Heun's method, but the
method is not symplectic: the energy error is bounded only for forces that depend on the positions alone. Two
evaluations a step.
"""

from __future__ import annotations

from typing import NamedTuple

from rig.physics.engines.common.method import FUNCTIONS, Functions, rates, skip_preparation, zero_error
from rig.physics.kernels import signals as S
from rig.physics.kernels.stage import kernel

ORDER = 2
_N = S.N_STATE // 2


class Verlet(NamedTuple):
    """Verlet method in the form that `rig.physics.engines.common.march` requires."""

    rows: int = 3
    order: float = 0.0
    graded: bool = False


METHOD = Verlet()


@kernel
def _step(method, constants, inputs, step, y, k, z, end, out):
    h = step.ticks * inputs.tick_s
    half = 0.5 * h
    for i in range(_N):
        z[i] = y[i] + h * (y[_N + i] + half * k[0, _N + i])
        z[_N + i] = y[_N + i] + h * k[0, _N + i]
    rates(constants, inputs, step.tick, step.fraction + step.ticks, step.onset_speed, step.phase, False, z, k[1], out)
    for i in range(_N):
        end[i] = z[i]
    for i in range(_N, S.N_VECTOR):
        end[i] = y[i] + half * (k[0, i] + k[1, i])
    return 1


FUNCTIONS[Verlet] = Functions(step=_step, error=zero_error, prepare=skip_preparation)
