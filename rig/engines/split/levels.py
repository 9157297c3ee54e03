"""How long a step of `rig.engines.split` lasts in contact: its level.

What a step errs by is measured against a series (`rig.engines.split.method`); here is what it must never exceed.
"""

from __future__ import annotations

from rig.engines.split.flow import GRID
from rig.engines.split.inner_motion import inlined

NONE = -1
"""No level: the step is not one for kicks."""
SHORTEST, LONGEST = GRID - 1, GRID + 2
"""Steps that a lasting contact is worth; below it the series are no slower."""
_STABLE = 0.9
"""Square of the angle that the contact's own oscillation may turn by in a step: the houses' modes take kicks in up to
twice as far."""
_DAMPED = 0.5
"""Largest part of the gap's speed that the contact's damping takes in a step: the commutators are a series in it."""


@inlined
def span_of(call, level):
    """Half a step of a level [s]."""
    return call.half_s * float(1 << level)


@inlined
def bears(call, level, h, stiff, taken):
    """Whether a contact bears steps of a level.

    Args:
        call: What stays through the call.
        level: The level.
        h: Step at hand [s].
        stiff: The contact's stiffness over the mass that it moves [1/s^2].
        taken: Part of the gap's speed that the damping takes in the step at hand.
    """
    span = 2.0 * span_of(call, level)
    return span * span * stiff < _STABLE and taken * span < _DAMPED * h
