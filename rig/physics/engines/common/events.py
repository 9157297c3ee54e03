"""Events of a march: onset, lift-off and changes of Coulomb's set-valued friction, and the phases that follow.

Friction by Filippov: with the law EXACT the contact slides forward, slides backward, or rolls. Rolling lasts while its
friction force stays within mu F_n. When the sliding speed reaches 0, the contact rolls if that is possible, else it
slides in the other direction.
"""

from __future__ import annotations

from typing import NamedTuple

from rig.physics.engines.common.memory import (
    CONTACTS,
    EVALUATIONS,
    FLOORED,
    FORCE_SPAN,
    LAST_FORCE,
    OLD_FORCE,
    ONSET,
    PEAK_FORCE,
    PHASE,
)
from rig.physics.engines.common.method import Step, method_step, rates
from rig.physics.engines.common.peak import parabolic_peak
from rig.physics.kernels import signals as S
from rig.physics.kernels.laws.contact import BACKWARD, EXACT, FLIGHT, FORWARD, ROLLING, TOUCHING, floor_onset_speed
from rig.physics.kernels.stage import kernel

NO_EVENT, ONSET_EVENT, LIFT_OFF, TURN, BREAK = range(5)
"""Events: none; onset; lift-off; zero of the sliding speed; rolling friction above mu F_n."""


class EventQuantities(NamedTuple):
    """Quantities at the start of a step that decide about events."""

    depth: float  # penetration [m]
    rate: float  # its rate [m/s]
    sliding: float  # sliding speed [m/s]
    margin: float  # rolling friction force above mu F_n [N]


@kernel
def event_quantities(contact, out):
    """Return the quantities that decide about events."""
    margin = event_function(BREAK, contact, out)
    return EventQuantities(out[S.PENETRATION], out[S.PENETRATION_RATE], out[S.SLIDING_SPEED], margin)


@kernel
def event_function(event, contact, out):
    """Return the function of an event, below 0 before the event and above 0 after it."""
    if event == ONSET_EVENT:
        return out[S.PENETRATION]
    if event == LIFT_OFF:
        return -out[S.PENETRATION]
    if event == BREAK:
        return abs(out[S.FRICTION_FORCE]) - contact.friction * out[S.NORMAL_FORCE]
    return out[S.SLIDING_SPEED]


@kernel
def detect_event(phase, before, contact, out):
    """Return the event within a step; of several, the one with the largest effect on the phase."""
    if phase == FLIGHT:
        return ONSET_EVENT if out[S.PENETRATION] > 0.0 else NO_EVENT
    if out[S.PENETRATION] <= 0.0:
        # Friction may have changed before the lift-off.
        if phase == ROLLING and before.margin < 0.0 and event_function(BREAK, contact, out) > 0.0:
            return BREAK
        if phase in (FORWARD, BACKWARD) and before.sliding * out[S.SLIDING_SPEED] < 0.0:
            return TURN
        return LIFT_OFF
    if phase == ROLLING and event_function(BREAK, contact, out) > 0.0:
        return BREAK
    if (phase == FORWARD and out[S.SLIDING_SPEED] < 0.0) or (phase == BACKWARD and out[S.SLIDING_SPEED] > 0.0):
        return TURN
    return NO_EVENT


@kernel
def event_function_at_start(event, before):
    """Return the event's function at the start of the step."""
    if event == LIFT_OFF:
        return -before.depth
    if event == TURN:
        return before.sliding
    if event == BREAK:
        return before.margin
    return before.depth


@kernel
def rates_at_end(method, constants, inputs, step, end, k, out):
    """Compute the rates at the end of a step into the last row of k, and the observed quantities into `out`."""
    fraction = step.fraction + step.ticks
    rates(constants, inputs, step.tick, fraction, step.onset_speed, step.phase, False, end, k[method.rows - 1], out)


@kernel
def locate_event(event, before, after, method, constants, inputs, step, memory, y, k, z, end, out):
    """Locate an event within a step by bracketing secants on steps of the method itself.

    Leaves the state at the event in `end`, its rates in the last row of k, and the observed quantities in `out`. The
    step's first rates are in k[0].

    Args:
        event: Event.
        before: Event function at the start of the step.
        after: Event function at its end, of opposite sign.
        method: Method.
        constants: Model constants.
        inputs: Hammer, drive, magnets.
        step: Step.
        memory: Memory of the engine.
        y: State and integrals, shape (N_VECTOR,).
        k: Workspace, shape (rows, N_VECTOR).
        z: Workspace for a stage's state, shape (N_VECTOR,).
        end: Out, shape (N_VECTOR,).
        out: Out, shape (N_OBSERVED,).

    Returns:
        Fraction of the step up to the event.
    """
    low, high, value_low, value_high = 0.0, 1.0, before, after
    cut, side = 1.0, 0
    for _ in range(60):
        cut = high - value_high * (high - low) / (value_high - value_low)
        if not low < cut < high:
            cut = 0.5 * (low + high)
        part = Step(step.tick, step.fraction, cut * step.ticks, step.onset_speed, step.phase)
        evaluations = method_step(method, constants, inputs, part, y, k, z, end, out)
        rates_at_end(method, constants, inputs, part, end, k, out)
        memory[EVALUATIONS] += evaluations + 1.0
        value = event_function(event, constants.contact, out)
        if value == 0.0:
            break
        if (value > 0.0) == (value_high > 0.0):
            high, value_high = cut, value
            if side == 1:  # Illinois: halve the retained end to speed up convergence
                value_low *= 0.5
            side = 1
        else:
            low, value_low = cut, value
            if side == -1:
                value_high *= 0.5
            side = -1
        if high - low < 1e-15 * step.ticks or abs(value) < 1e-14 * abs(after - before):
            break
    return cut


@kernel
def sliding_phase(constants, speed):
    """Return the phase of a contact with a sliding speed."""
    if constants.levels.friction != EXACT:
        return TOUCHING
    return FORWARD if speed > 0.0 else BACKWARD


@kernel
def latch_onset(memory, speed, contact):
    """Count a contact and store its impact speed, from its approach speed [m/s]."""
    memory[CONTACTS] += 1.0
    if speed < contact.speed_floor:
        memory[FLOORED] += 1.0
    memory[ONSET] = floor_onset_speed(speed, contact)


@kernel
def change_phase(event, constants, inputs, tick, fraction, memory, y, dy, out):
    """Set the phase after an event, at the state where it happens."""
    phase = int(memory[PHASE])
    if event == ONSET_EVENT:
        latch_onset(memory, out[S.PENETRATION_RATE], constants.contact)
        memory[PHASE] = sliding_phase(constants, out[S.SLIDING_SPEED])
        memory[OLD_FORCE] = memory[LAST_FORCE] = 0.0
    elif event == LIFT_OFF:
        memory[PHASE] = FLIGHT
    elif event == BREAK:
        memory[PHASE] = FORWARD if out[S.FRICTION_FORCE] > 0.0 else BACKWARD
    else:
        rates(constants, inputs, tick, fraction, memory[ONSET], ROLLING, False, y, dy, out)
        memory[EVALUATIONS] += 1.0
        held = abs(out[S.FRICTION_FORCE]) <= constants.contact.friction * out[S.NORMAL_FORCE]
        memory[PHASE] = ROLLING if held else (BACKWARD if phase == FORWARD else FORWARD)


@kernel
def update_peak_force(memory, force, ticks):
    """Update the largest normal force.

    Args:
        memory: Memory of the engine.
        force: Normal force [N].
        ticks: Time since the last force [ticks].
    """
    peak = parabolic_peak(memory[OLD_FORCE], memory[FORCE_SPAN], memory[LAST_FORCE], ticks, force)
    memory[PEAK_FORCE] = max(memory[PEAK_FORCE], peak)
    memory[OLD_FORCE], memory[LAST_FORCE], memory[FORCE_SPAN] = memory[LAST_FORCE], force, ticks
