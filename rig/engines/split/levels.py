"""How long a step of `rig.engines.split` lasts: its level, by rules on the state alone."""

from __future__ import annotations

import math

from rig.engines.split.flow import GRID
from rig.engines.split.inner_motion import eccentricity, house_energy, inlined
from rig.engines.split.place import SETTLED

_LONGEST = GRID + 3
"""A flight covers at most 2**3 steps of the grid ..."""
_FLIGHT_S = 1.1e-3
"""... and lasts at most this long [s]."""
STRUCK = GRID - 3
"""Longest step in a pulse of the hammer, or with a transducer loose."""
_CALM = 2.5e-4
"""Speed of the gap [m/s] up to which the grid's own step is taken; half the step for every four times that."""
_GAP_SPEEDS = tuple(_CALM * 4.0 ** (GRID - level) for level in range(GRID + 1))
"""Largest speed of the gap that each level up to the grid's own takes [m/s]."""
_ROUGH = 4.0
"""How many times (squared) a level's speed is exceeded before the step is halved."""
_DRIFT = 0.01
"""Weight of the gap's slow motion, squared, against its acceleration."""
_DAMPED = 0.3
"""Largest part of the gap's speed that the contact's damping takes in a step: the commutators are a series in it."""
_PATIENCE = 16
"""Calm kicks in a row before the step is doubled."""


@inlined
def span_of(call, level):
    """Half a step of a level [s]."""
    return call.half_s * float(1 << level)


@inlined
def flight_level(constants, call, axis, houses, owed_s, struck):
    """Level of the next step in flight: as long as the gap cannot close, through its second half as well.

    Args:
        constants: Of the model.
        call: What stays through the call.
        axis: Of the shaft.
        houses: Of the stator.
        owed_s: Flow that the last kick still owes [s].
        struck: Whether the hammer strikes.
    """
    ex, ey = eccentricity(constants, axis, houses)
    free = constants.contact.clearance - math.sqrt(ex * ex + ey * ey)
    speed = constants.shaft.arm_ring * math.sqrt(axis.px * axis.px + axis.py * axis.py)
    ringing = 0.0
    if constants.levels.inner_house:
        ringing = math.sqrt(2.0 * house_energy(constants, houses))
        outer = constants.contact.gap_counts_outer * math.sqrt(call.plant.per_outer)
        speed += ringing * (math.sqrt(call.plant.per_inner) + outer)
    level = GRID
    while level > 0 and _GAP_SPEEDS[level] < speed:
        level -= 1
    # Transducers that come loose are no part of the flow.
    highest = STRUCK if struck or ringing > call.plant.tightest else _LONGEST
    while level < highest:
        t = 2.0 * 2.0 * span_of(call, level)
        # Gravity, magnets, unbalance and hammer together stay below 100 m/s^2 at the ring.
        if t > _FLIGHT_S or free < (owed_s + t) * (speed + 100.0 * (owed_s + t)):
            break
        level += 1
    return level


@inlined
def contact_level(memory, wanted, rough, calm, end):
    """Level of the next step in contact.

    Args:
        memory: Of the engine.
        wanted: Level so far.
        rough: Whether it was too long.
        calm: Whether twice the step would do.
        end: End of this step, in parts of the grid's own from the row on.
    """
    if rough and wanted > 0:
        memory[SETTLED] = 0.0
        return wanted - 1
    if not calm or wanted >= GRID:
        memory[SETTLED] = 0.0
        return wanted
    memory[SETTLED] += 1.0
    if memory[SETTLED] >= _PATIENCE and end & ((2 << wanted) - 1) == 0:
        memory[SETTLED] = 0.0
        return wanted + 1
    return wanted


@inlined
def roughness(wanted, slow, change, stiff, taken):
    """Whether a level is too long for how fast the gap moves or is made to move, and whether twice that would do.

    Args:
        wanted: The level.
        slow: Rate of the gap [m/s].
        change: Of that rate [m/s^2].
        stiff: The contact's stiffness over the mass that it moves [1/s^2].
        taken: Part of the gap's speed that the damping takes in a step.
    """
    size = _DRIFT * slow * slow * stiff + change * change
    limit, longer = _GAP_SPEEDS[wanted], _GAP_SPEEDS[min(wanted + 1, GRID)]
    rough = size > _ROUGH * limit * limit * stiff or taken > _DAMPED
    return rough, size < longer * longer * stiff and 2.0 * taken < _DAMPED
