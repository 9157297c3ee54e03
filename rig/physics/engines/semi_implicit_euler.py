"""Semi-implicit (symplectic) Euler: new speeds by the forces at the start, new positions by the new speeds; order 1.

One evaluation a step and a bounded energy error where forces come from the positions. Explicit in the speeds.
"""

from __future__ import annotations

from typing import NamedTuple

from rig.physics.engines.common.method import FUNCTIONS, Functions, no_estimate, nothing_to_prepare
from rig.physics.kernels import signals as S
from rig.physics.kernels.stage import kernel

ORDER = 1
_N = S.N_STATE // 2


class SemiImplicitEuler(NamedTuple):
    """The method, as `rig.physics.engines.common.march` takes it."""

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


FUNCTIONS[SemiImplicitEuler] = Functions(step=_step, error=no_estimate, prepare=nothing_to_prepare)
