"""Steps of the grid, taken in parts that end at every event: onset, lift-off, changes of Coulomb's set-valued friction.

The method is not this file's: an engine says how one step of it is made (`method_step`), and what its error is. What
the engines share is here: where the parts end, the impact speed, the phases of the contact, the counters, the rows.
A step of the grid is taken in parts by rules on the state alone, so that a run does not depend on how it is cut into
calls:

- A part in which the shaft meets or leaves the ring, begins or ceases to slide, is taken again up to that instant,
  which a bracketing search finds on the method itself. The impact speed is latched there, not at the end of the
  step: that alone would cap the accuracy at about 3e-3.
- The force starts and ends as t^1.5: parts shrink toward onset and lift-off if the method is `graded`; without that
  the order drops to 2.5.
- A part whose error estimate is above the tolerance is taken again, shorter; the next one follows the estimate.

Friction by Filippov: with the law EXACT the phase of the contact is sliding forward, sliding backward, or rolling.
Rolling lasts while the force that it needs stays within mu F_n; a sliding speed that comes to 0 goes over to rolling
where rolling is possible, else to sliding the other way.

The integrals of the ledger are part of the integrated vector: they share the quadrature.

A method is a NamedTuple of a type of its own, with the fields

- `rows`: rows of its workspace k. The first holds the rates at the start of a part, the last those at its end, the
  ones between are the method's;
- `order`: of the estimate's leading error; 0: no estimate, steps are as long as they may be;
- `graded`: parts shrink toward onset and lift-off.

The compiler picks a method's functions by that type (`numba.extending.overload`): numba cannot keep machine code that
takes functions as arguments from one process to the next.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.extending import overload

from rig.engines.memory import (
    CEILING,
    CLAMPS,
    CONTACT_STEPS,
    CONTACTS,
    EVALUATIONS,
    FLOORED,
    ONSET,
    OWN,
    PEAK_FORCE,
    PHASE,
    REJECTED,
    STEPS,
)
from rig.engines.peak import peak
from rig.kernels import signals as S
from rig.kernels.contact import BACKWARD, EXACT, FLIGHT, FORWARD, ROLLING, TOUCHING
from rig.kernels.dynamics import evaluate
from rig.kernels.geometry import gap

_TOLERANCE, _SIZE, _BEFORE, _BEFORE_SPAN, _LAST = range(OWN, OWN + 5)
"""Scaled error a step; length proposed for the next part [ticks]; normal force before the last [N], time between both
[ticks], last normal force [N]."""

PER_SCALE = 1.0 / S.STATE_SCALE

_LEAST = 1.0 / 64.0
"""Shortest part next to a crossing, in steps of the grid; ..."""
_GROWTH = 0.5
"""... away from it parts may last this times the time since or until the crossing."""
_SHORTEST = 1e-6
"""Shortest part that an error estimate can ask for, in steps of the grid."""
_MOST_PARTS = 20_000
"""Parts of one step of the grid; then it is given up and counted. Smoothed friction of 1 um/s asks tsit5 for 15 000."""
_MOST_EVENTS = 200
"""Events in one step of the grid after which they are no longer located."""
_SAFETY = 0.9

_NONE, _ONSET, _LIFT_OFF, _TURN, _BREAK = range(5)
"""Events: none; onset; lift-off; the sliding speed comes to 0; rolling needs more than mu F_n."""


class Functions(NamedTuple):
    """What a type of method does; compiled, with the parameters of the functions below."""

    step: Any
    error: Any
    prepare: Any


FUNCTIONS: dict[type, Functions] = {}
"""Of every type of method; its module enters it."""


def method_step(method, constants, inputs, tick, fraction, ticks, onset_speed, phase, y, k, z, end, out):
    """One step of `ticks` (any part of a tick) from `y`, whose rates are in k[0], to `end`.

    Returns:
        Evaluations of the equations.
    """
    return FUNCTIONS[type(method)].step(
        method, constants, inputs, tick, fraction, ticks, onset_speed, phase, y, k, z, end, out
    )


def method_error(method, h, k, scratch):
    """Scaled error estimate of the step whose workspace is k; h [s]; scratch, shape (2, N_STATE)."""
    return FUNCTIONS[type(method)].error(method, h, k, scratch)


def method_prepare(method, constants, inputs, tick, fraction, ticks, onset_speed, phase, y, k, z, out):
    """What all steps from one state share, whatever their length, before the first; at most `ticks` lie ahead.

    Returns:
        Evaluations of the equations.
    """
    return FUNCTIONS[type(method)].prepare(
        method, constants, inputs, tick, fraction, ticks, onset_speed, phase, y, k, z, out
    )


@overload(method_step)
def _compiled_step(method, constants, inputs, tick, fraction, ticks, onset_speed, phase, y, k, z, end, out):
    return FUNCTIONS[method.instance_class].step.py_func


@overload(method_error)
def _compiled_error(method, h, k, scratch):
    return FUNCTIONS[method.instance_class].error.py_func


@overload(method_prepare)
def _compiled_prepare(method, constants, inputs, tick, fraction, ticks, onset_speed, phase, y, k, z, out):
    return FUNCTIONS[method.instance_class].prepare.py_func


@njit(cache=True, error_model="numpy")
def rates(constants, inputs, tick, fraction, onset_speed, phase, observe, y, dy, out):
    """`evaluate` as a function of its own, so that only the stages' loop holds another copy of it."""
    evaluate(constants, inputs, tick, fraction, onset_speed, phase, observe, y, dy, out)


@njit(cache=True, error_model="numpy")
def nothing_to_prepare(method, constants, inputs, tick, fraction, ticks, onset_speed, phase, y, k, z, out):
    """`method_prepare` of a method that has nothing to prepare."""
    return 0


@njit(cache=True, error_model="numpy")
def no_estimate(method, h, k, scratch):
    """`method_error` of a method that has no estimate."""
    return 0.0


@njit(cache=True, error_model="numpy")
def _surplus(event, contact, out):
    """What is below 0 before an event and above 0 after it."""
    if event == _ONSET:
        return out[S.PENETRATION]
    if event == _LIFT_OFF:
        return -out[S.PENETRATION]
    if event == _BREAK:
        return abs(out[S.FRICTION_FORCE]) - contact.friction * out[S.NORMAL_FORCE]
    return out[S.SLIDING_SPEED]


@njit(cache=True, error_model="numpy")
def _locate(event, before, after, method, constants, inputs, tick, fraction, ticks, memory, y, k, z, end, out):
    """Part of `ticks` after which the event happens, by bracketing secants on steps of the method itself.

    `before` and `after` are the event's surplus at both ends of the step, of unlike sign; the step's first rates are in
    k[0]. Leaves the state at the event in `end`, its rates in the last row of k, what is observed there in `out`.
    """
    low, high, value_low, value_high = 0.0, 1.0, before, after
    cut, side = 1.0, 0
    for _ in range(60):
        cut = high - value_high * (high - low) / (value_high - value_low)
        if not low < cut < high:
            cut = 0.5 * (low + high)
        evaluations = method_step(
            method,
            constants,
            inputs,
            tick,
            fraction,
            cut * ticks,
            memory[ONSET],
            int(memory[PHASE]),
            y,
            k,
            z,
            end,
            out,
        )
        rates(
            constants,
            inputs,
            tick,
            fraction + cut * ticks,
            memory[ONSET],
            int(memory[PHASE]),
            False,
            end,
            k[method.rows - 1],
            out,
        )
        memory[EVALUATIONS] += evaluations + 1.0
        value = _surplus(event, constants.contact, out)
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
        if high - low < 1e-15 * ticks or abs(value) < 1e-14 * abs(after - before):
            break
    return cut


@njit(cache=True, error_model="numpy")
def _sliding_phase(constants, speed):
    """Phase of a contact that slides at a speed."""
    if constants.levels.friction != EXACT:
        return TOUCHING
    return FORWARD if speed > 0.0 else BACKWARD


@njit(cache=True, error_model="numpy")
def _change_phase(event, constants, inputs, tick, fraction, memory, y, dy, out):
    """Go over to the phase behind an event, at the state where it happens."""
    phase = int(memory[PHASE])
    if event == _ONSET:
        speed, floor = out[S.PENETRATION_RATE], constants.contact.speed_floor
        memory[CONTACTS] += 1.0
        if speed < floor:
            memory[FLOORED] += 1.0
        memory[ONSET] = max(speed, floor)
        memory[PHASE] = _sliding_phase(constants, out[S.SLIDING_SPEED])
        memory[_BEFORE] = memory[_LAST] = 0.0
    elif event == _LIFT_OFF:
        memory[PHASE] = FLIGHT
    elif event == _BREAK:
        memory[PHASE] = FORWARD if out[S.FRICTION_FORCE] > 0.0 else BACKWARD
    else:
        rates(constants, inputs, tick, fraction, memory[ONSET], ROLLING, False, y, dy, out)
        memory[EVALUATIONS] += 1.0
        held = abs(out[S.FRICTION_FORCE]) <= constants.contact.friction * out[S.NORMAL_FORCE]
        memory[PHASE] = ROLLING if held else (BACKWARD if phase == FORWARD else FORWARD)


@njit(cache=True, error_model="numpy")
def _event(phase, contact, out):
    """The event that has happened by the end of a part, the gravest first."""
    if phase == FLIGHT:
        return _ONSET if out[S.PENETRATION] > 0.0 else _NONE
    if out[S.PENETRATION] <= 0.0:
        return _LIFT_OFF
    if phase == ROLLING and _surplus(_BREAK, contact, out) > 0.0:
        return _BREAK
    if (phase == FORWARD and out[S.SLIDING_SPEED] < 0.0) or (phase == BACKWARD and out[S.SLIDING_SPEED] > 0.0):
        return _TURN
    return _NONE


@njit(cache=True, error_model="numpy")
def _note_force(memory, force, ticks):
    """Follow the largest normal force."""
    memory[PEAK_FORCE] = max(
        memory[PEAK_FORCE], peak(memory[_BEFORE], memory[_BEFORE_SPAN], memory[_LAST], ticks, force)
    )
    memory[_BEFORE], memory[_LAST], memory[_BEFORE_SPAN] = memory[_LAST], force, ticks


@njit(cache=True, error_model="numpy")
def _grid_step(method, constants, inputs, tick, ticks, memory, y, k, z, end, scratch, out):
    """One step of the grid in as many parts as events, crossings and error estimates ask for.

    Entered with the rates at `y` in k[0] and what is observed there in `out`; leaves both for the end.
    """
    contact = constants.contact
    last = k[method.rows - 1]
    tolerance = memory[_TOLERANCE]
    estimates = method.order > 0.0
    fraction, stale = 0.0, True
    depth, rate, sliding = out[S.PENETRATION], out[S.PENETRATION_RATE], out[S.SLIDING_SPEED]
    margin = _surplus(_BREAK, contact, out)
    events = 0
    for _ in range(_MOST_PARTS):
        left = ticks - fraction
        phase = int(memory[PHASE])
        size = left
        if estimates:
            size = min(size, memory[_SIZE])
        if method.graded and phase != FLIGHT:
            # Time since onset or until lift-off, by the present rate.
            pace = abs(rate) * inputs.tick_s
            if depth < pace * ticks / _GROWTH:
                size = min(size, max(_LEAST * ticks, _GROWTH * depth / pace))
        if events >= _MOST_EVENTS:
            size = max(size, _LEAST * ticks)
        if size > 0.999 * left:  # no slivers
            size = left
        if stale:
            memory[EVALUATIONS] += method_prepare(
                method, constants, inputs, tick, fraction, left, memory[ONSET], phase, y, k, z, out
            )
            stale = False
        evaluations = method_step(
            method, constants, inputs, tick, fraction, size, memory[ONSET], phase, y, k, z, end, out
        )
        rates(constants, inputs, tick, fraction + size, memory[ONSET], phase, False, end, last, out)
        memory[EVALUATIONS] += evaluations + 1.0
        memory[STEPS] += 1.0
        if estimates:
            error = method_error(method, size * inputs.tick_s, k, scratch)
            if np.isnan(error):
                y[:] = end
                return
            factor = _SAFETY * (tolerance / max(error, 1e-300)) ** (1.0 / method.order)
            if error > tolerance:
                if size > _SHORTEST * ticks:
                    memory[REJECTED] += 1.0
                    memory[_SIZE] = size * max(0.1, factor)
                    continue
                memory[CEILING] += 1.0
            proposal = size * min(5.0, max(0.2, factor))
            # A part that a crossing or the grid has cut short says nothing against longer ones.
            if size < memory[_SIZE] and factor >= 1.0:
                proposal = max(memory[_SIZE], proposal)
            memory[_SIZE] = min(ticks, proposal)
        stale = True
        event = _event(phase, contact, out)
        if event == _LIFT_OFF:
            # Friction may have changed on the way out.
            if phase == ROLLING and margin < 0.0 and _surplus(_BREAK, contact, out) > 0.0:
                event = _BREAK
            elif phase in (FORWARD, BACKWARD) and sliding * out[S.SLIDING_SPEED] < 0.0:
                event = _TURN
        if event == _NONE:
            y[:] = end
            k[0] = last
        else:
            after = _surplus(event, contact, out)
            before = depth
            if event == _LIFT_OFF:
                before = -depth
            elif event == _TURN:
                before = sliding
            elif event == _BREAK:
                before = margin
            events += 1
            if events == _MOST_EVENTS:
                memory[CEILING] += 1.0
            if events >= _MOST_EVENTS:
                # They pile up (a chatter, or bounces without end): from here on the phase changes at ends of parts.
                y[:] = end
            elif before * after < 0.0:
                size *= _locate(
                    event, before, after, method, constants, inputs, tick, fraction, size, memory, y, k, z, end, out
                )
                y[:] = end
            else:
                # It was there at the start already, by rounding: change the phase, stay.
                size = 0.0
                rates(constants, inputs, tick, fraction, memory[ONSET], phase, False, y, last, out)
            _change_phase(event, constants, inputs, tick, fraction + size, memory, y, last, out)
            rates(constants, inputs, tick, fraction + size, memory[ONSET], int(memory[PHASE]), False, y, k[0], out)
            memory[EVALUATIONS] += 1.0
        if phase != FLIGHT:
            memory[CONTACT_STEPS] += 1.0
            if out[S.NORMAL_FORCE] == 0.0 and out[S.PENETRATION] > 0.0:
                memory[CLAMPS] += 1.0
            _note_force(memory, out[S.NORMAL_FORCE], size)
        depth, rate, sliding = out[S.PENETRATION], out[S.PENETRATION_RATE], out[S.SLIDING_SPEED]
        margin = _surplus(_BREAK, contact, out)
        fraction += size
        if fraction >= ticks:
            return
    memory[CEILING] += 1.0


@njit(cache=True, error_model="numpy")
def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Prepare the memory for a state: a state that begins in contact holds the floored impact speed."""
    memory[:] = 0.0
    memory[ONSET] = constants.contact.speed_floor
    memory[_SIZE] = step_ticks
    memory[_TOLERANCE] = tolerance
    if gap(constants, y)[0] > 0.0:
        dy = np.empty(S.N_VECTOR)
        out = np.empty(S.N_OBSERVED)
        rates(constants, inputs, 0, 0.0, memory[ONSET], TOUCHING, False, y, dy, out)
        memory[PHASE] = _sliding_phase(constants, out[S.SLIDING_SPEED])


@njit(cache=True, error_model="numpy", nogil=True)
def advance(method, constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """Take `steps` steps in place and write every `stride`-th instant's row (see `rig.engines`).

    Args:
        method: The method.
        constants: Numbers of the model.
        inputs: Hammer, drive, magnets; constant over the call.
        y: State and integrals, in and out, shape (N_VECTOR,).
        memory: In and out, shape (MEMORY,).
        tick: Time at the start.
        step_ticks: Ticks a step.
        steps: Number of steps.
        stride: Steps a row.
        rows: Out, shape (ceil(steps / stride), N_ROW).
    """
    k = np.zeros((method.rows, S.N_VECTOR))
    scratch = np.empty((2, S.N_STATE))
    z = np.empty(S.N_VECTOR)
    end = np.empty(S.N_VECTOR)
    out = np.empty(S.N_OBSERVED)
    ticks = float(step_ticks)
    row = 0
    for n in range(steps):
        now = tick + n * step_ticks
        if n % stride == 0:
            rates(constants, inputs, now, 0.0, memory[ONSET], int(memory[PHASE]), True, y, k[0], out)
            rows[row, : S.N_VECTOR] = y
            rows[row, S.N_VECTOR :] = out
            row += 1
        _grid_step(method, constants, inputs, now, ticks, memory, y, k, z, end, scratch, out)
