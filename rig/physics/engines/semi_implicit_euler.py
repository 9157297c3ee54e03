"""Semi-implicit (symplectic) Euler method of order 1: speeds by the initial forces, then positions by the new speeds.

One evaluation a step; the energy error is bounded for forces that depend on the positions alone. Explicit in the
speeds.
"""

from __future__ import annotations

from typing import NamedTuple

from rig.physics.engines.common.method import FUNCTIONS, Functions, skip_preparation, zero_error
from rig.physics.kernels import signals as S
from rig.physics.kernels.stage import kernel

ORDER = 1
_N = S.N_STATE // 2


class SemiImplicitEuler(NamedTuple):
    """Semi-implicit Euler method in the form that `rig.physics.engines.common.march` requires."""

    rows: int = 2
    order: float = 0.0
    graded: bool = False


METHOD = SemiImplicitEuler()


@kernel
def _step(method, constants, inputs, step, y, k, z, end, out):
    h = step.ticks * inputs.tick_s
    for i in range(_N):
        end[_N + i] = y[_N + i] + h * k[0, _N + i]
        end[i] = y[i] + h * end[_N + i]
    for i in range(S.N_STATE, S.N_VECTOR):
        end[i] = y[i] + h * k[0, i]
    return 0


FUNCTIONS[SemiImplicitEuler] = Functions(step=_step, error=zero_error, prepare=skip_preparation)
