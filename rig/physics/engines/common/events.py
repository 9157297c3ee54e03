"""Events of a march: onset, lift-off, and the changes of Coulomb's set-valued friction; phases behind them.

Friction by Filippov: with the law EXACT the phase of the contact is sliding forward, sliding backward, or rolling.
Rolling lasts while the force that it needs stays within mu F_n; a sliding speed that comes to 0 goes over to rolling
where rolling is possible, else to sliding the other way.
"""

from __future__ import annotations

from typing import NamedTuple

from rig.physics.engines.common.memory import (
    BEFORE,
    BEFORE_SPAN,
    CONTACTS,
    EVALUATIONS,
    FLOORED,
    LAST,
    ONSET,
    PEAK_FORCE,
    PHASE,
)
from rig.physics.engines.common.method import Step, method_step, rates
from rig.physics.engines.common.peak import peak
from rig.physics.kernels import signals as S
from rig.physics.kernels.laws.contact import BACKWARD, EXACT, FLIGHT, FORWARD, ROLLING, TOUCHING, held_speed
from rig.physics.kernels.stage import kernel

NONE, ONSET_EVENT, LIFT_OFF, TURN, BREAK = range(5)
"""Events: none; onset; lift-off; the sliding speed comes to 0; rolling needs more than mu F_n."""


class Before(NamedTuple):
    """What events are judged by, at the start of a step."""

    depth: float  # penetration [m]
    rate: float  # of it [m/s]
    sliding: float  # speed [m/s]
    margin: float  # what rolling needs beyond mu F_n [N]


@kernel
def seen(contact, out):
    """What events are judged by, of what is observed."""
    margin = surplus(BREAK, contact, out)
    return Before(out[S.PENETRATION], out[S.PENETRATION_RATE], out[S.SLIDING_SPEED], margin)


@kernel
def surplus(event, contact, out):
    """What is below 0 before an event and above 0 after it."""
    if event == ONSET_EVENT:
        return out[S.PENETRATION]
    if event == LIFT_OFF:
        return -out[S.PENETRATION]
    if event == BREAK:
        return abs(out[S.FRICTION_FORCE]) - contact.friction * out[S.NORMAL_FORCE]
    return out[S.SLIDING_SPEED]


@kernel
def event_at_end(phase, before, contact, out):
    """The event that has happened by the end of a step, the gravest first."""
    if phase == FLIGHT:
        return ONSET_EVENT if out[S.PENETRATION] > 0.0 else NONE
    if out[S.PENETRATION] <= 0.0:
        # Friction may have changed on the way out.
        if phase == ROLLING and before.margin < 0.0 and surplus(BREAK, contact, out) > 0.0:
            return BREAK
        if phase in (FORWARD, BACKWARD) and before.sliding * out[S.SLIDING_SPEED] < 0.0:
            return TURN
        return LIFT_OFF
    if phase == ROLLING and surplus(BREAK, contact, out) > 0.0:
        return BREAK
    if (phase == FORWARD and out[S.SLIDING_SPEED] < 0.0) or (phase == BACKWARD and out[S.SLIDING_SPEED] > 0.0):
        return TURN
    return NONE


@kernel
def surplus_before(event, before):
    """The event's surplus at the start of the step."""
    if event == LIFT_OFF:
        return -before.depth
    if event == TURN:
        return before.sliding
    if event == BREAK:
        return before.margin
    return before.depth


@kernel
def rates_at_end(method, constants, inputs, step, end, k, out):
    """Rates at the end of a step into the last row of k, what is observed there into `out`."""
    fraction = step.fraction + step.ticks
    rates(constants, inputs, step.tick, fraction, step.onset_speed, step.phase, False, end, k[method.rows - 1], out)


@kernel
def locate(event, before, after, method, constants, inputs, step, memory, y, k, z, end, out):
    """Part of a step after which the event happens, by bracketing secants on steps of the method itself.

    `before` and `after` are the event's surplus at both ends of the step, of unlike sign; the step's first rates are in
    k[0]. Leaves the state at the event in `end`, its rates in the last row of k, what is observed there in `out`.
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
        value = surplus(event, constants.contact, out)
        if value == 0.0:
            break
        if (value > 0.0) == (value_high > 0.0):
            high, value_high = cut, value
            if side == 1:  # Illinois: halve the end that stays, or the secants creep
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
    """Phase of a contact that slides at a speed."""
    if constants.levels.friction != EXACT:
        return TOUCHING
    return FORWARD if speed > 0.0 else BACKWARD


@kernel
def latch_onset(memory, speed, contact):
    """Count a contact that begins at a speed [m/s], and keep the impact speed that it holds."""
    memory[CONTACTS] += 1.0
    if speed < contact.speed_floor:
        memory[FLOORED] += 1.0
    memory[ONSET] = held_speed(speed, contact)


@kernel
def change_phase(event, constants, inputs, tick, fraction, memory, y, dy, out):
    """Go over to the phase behind an event, at the state where it happens."""
    phase = int(memory[PHASE])
    if event == ONSET_EVENT:
        latch_onset(memory, out[S.PENETRATION_RATE], constants.contact)
        memory[PHASE] = sliding_phase(constants, out[S.SLIDING_SPEED])
        memory[BEFORE] = memory[LAST] = 0.0
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
def note_force(memory, force, ticks):
    """Follow the largest normal force."""
    memory[PEAK_FORCE] = max(memory[PEAK_FORCE], peak(memory[BEFORE], memory[BEFORE_SPAN], memory[LAST], ticks, force))
    memory[BEFORE], memory[LAST], memory[BEFORE_SPAN] = memory[LAST], force, ticks
