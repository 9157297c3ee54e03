"""How long a step of `rig.engines.split` lasts: its level, by rules on the state and the tolerance; or that none does.

All rules are free of dimensions, or made of the scene's own masses, springs and speeds.
"""

from __future__ import annotations

import math

from rig.engines.split.flow import GRID, LEVELS
from rig.engines.split.inner_motion import eccentricity, house_energy, inlined
from rig.kernels.magnet import magnet_force

NONE, ANY = -1, -2
"""No level: the step is not one for kicks; or whichever the contact asks for, which is known after a kick."""
_SHORTEST = GRID - 1
"""Shortest step that a contact is worth; below it the series are no slower."""
_NEAREST = GRID
"""Shortest flight that is worth it."""
_FLIGHT = 0.04
"""Angle that the shaft's fastest swing, or its spin, may turn by in a step of flight [rad], ..."""
_CONTACT = 0.35
"""... and the square of that of the contact's own, where it is settled; ..."""
_AT = 1e-4
"""... at this tolerance; both go with its fourth root, for what is left is of order 4."""
_STABLE = 0.6
"""The most of it, whatever the tolerance: the houses' own modes take the kicks in up to twice as far."""
_SWING = 5.0
"""How many times the tolerance the swing may err by: it dies out, where errors of an impact grow."""
_OVER = 1.5
"""How much stiffer the contact may become before its step is chosen anew."""
_DRIFT = 0.01
"""Weight of the gap's slow motion, squared, against its acceleration."""
_DAMPED = 0.5
"""Largest part of the gap's speed that the contact's damping takes in a step: the commutators are a series in it."""


@inlined
def span_of(call, level):
    """Half a step of a level [s]."""
    return call.half_s * float(1 << level)


@inlined
def flight_level(constants, inputs, call, axis, spin, houses, owed_s):
    """Level of the next step in flight: as long as the gap cannot close in it; NONE where it may.

    The bound is on half of the gap: up to there the magnets pull no harder, and swing the shaft no faster, than there.

    Args:
        constants: Of the model.
        inputs: Of this call.
        call: What stays through the call.
        axis: Of the shaft.
        spin: w [rad/s].
        houses: Of the stator.
        owed_s: Flow that the last kick still owes [s].
    """
    plant, shaft, lA = call.plant, constants.shaft, constants.shaft.arm_ring
    ex, ey = eccentricity(constants, axis, houses)
    half = 0.5 * (constants.contact.clearance - math.sqrt(ex * ex + ey * ey))
    if half <= 0.0:
        return NONE
    torque, swing = abs(plant.weight), 0.0
    if inputs.magnet_engaged:
        place = shaft.arm_magnet * (math.sqrt(axis.ux * axis.ux + axis.uy * axis.uy) + half / lA)
        held = abs(magnet_force(0.0, -place, constants.magnet)[1])
        stiffness = (abs(magnet_force(0.0, -1.01 * place, constants.magnet)[1]) - held) / (0.01 * place)
        torque += shaft.arm_magnet * held
        swing = shaft.arm_magnet * math.sqrt(max(0.0, stiffness) * plant.per_Ixx)
    pull = plant.arm * lA * (torque + 2.0 * shaft.arm_disk * shaft.unbalance * spin * spin)
    speed = lA * math.sqrt(axis.px * axis.px + axis.py * axis.py)
    if constants.levels.inner_house:
        ringing = math.sqrt(2.0 * house_energy(constants, houses))
        # Transducers that come loose are no part of the flow.
        if ringing > plant.tightest:
            return NONE
        outer = constants.contact.gap_counts_outer * math.sqrt(plant.per_outer)
        speed += ringing * (math.sqrt(plant.per_inner) + outer)
    longest_s = 2.0 * span_of(call, GRID)
    if call.tolerance > 0.0:
        longest_s = _FLIGHT * math.sqrt(math.sqrt(call.tolerance / _AT)) / max(swing, abs(spin))
    level = NONE
    longer = _NEAREST
    while longer < LEVELS - 1:
        t = 2.0 * span_of(call, longer)
        reach = owed_s + 2.0 * t
        if t > longest_s or half < reach * (speed + pull * reach):
            break
        level = longer
        longer += 1
    return level


@inlined
def contact_level(call, arm, wanted, h, before, slow, change, stiff, taken):
    """Level of the next step in contact; NONE where it is too rough for kicks.

    One length for all of a contact: each change of it is an error of its own. What is left of the gap's speed, its
    swing, errs by that times the square of the angle that the contact's own oscillation turns by in a step; it is held
    against an axis's rate of 1 rad/s (`STATE_SCALE`).

    Args:
        call: What stays through the call.
        arm: Of the ring [m].
        wanted: Level so far.
        h: This step [s].
        before: The one before it [s]; only where both are as long as they are to be the swing can be told.
        slow: Rate of the gap [m/s].
        change: Of that rate [m/s^2].
        stiff: The contact's stiffness over the mass that it moves [1/s^2].
        taken: Part of the gap's speed that the damping takes in a step.
    """
    if call.tolerance == 0.0:
        return GRID
    most = min(_CONTACT * math.sqrt(call.tolerance / _AT), _STABLE)
    level = wanted
    if wanted == ANY:
        level, grown = NONE, h
        for longer in range(_SHORTEST, LEVELS - 1):
            grown = 2.0 * span_of(call, longer)
            if grown * grown * stiff > most or taken * grown > _DAMPED * h:
                break
            level = longer
        if level == NONE:
            return NONE
    span = 2.0 * span_of(call, level)
    turn = span * span * stiff
    error = turn * math.sqrt(_DRIFT * slow * slow + change * change / stiff) if h == span and before == span else 0.0
    if error > _SWING * arm * call.tolerance or turn > _OVER * most or taken * span > _OVER * _DAMPED * h:
        return NONE
    return level
