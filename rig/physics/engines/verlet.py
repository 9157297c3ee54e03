"""Velocity Verlet: half a kick, a drift, half a kick; order 2.

Forces that depend on the speeds (damping, gyroscopic and centrifugal terms, friction) are taken at the end with the
speeds that the first force alone would lead to, as is usual. That is of order 2 for them too, as Heun's method is, but
it is not symplectic: only where forces come from the positions is the energy error bounded. Two evaluations a step.
"""

from __future__ import annotations

from typing import NamedTuple

from rig.physics.engines.common.method import FUNCTIONS, Functions, no_estimate, nothing_to_prepare, rates
from rig.physics.kernels import signals as S
from rig.physics.kernels.stage import kernel

ORDER = 2
_N = S.N_STATE // 2


class Verlet(NamedTuple):
    """The method, as `rig.physics.engines.common.march` takes it."""

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


FUNCTIONS[Verlet] = Functions(step=_step, error=no_estimate, prepare=nothing_to_prepare)
