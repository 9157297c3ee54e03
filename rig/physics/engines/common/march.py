"""Steps of the grid, taken in parts that end at every event: onset, lift-off, changes of Coulomb's set-valued friction.

The method is not this file's: an engine says how one step of it is made and what its error is
(`rig.physics.engines.common.method`). What the engines share is here: where the parts end, the impact speed, the
counters, the rows. A step of the grid is taken in parts by rules on the state alone, so that a run does not depend on
how it is cut into calls:

- A part in which the shaft meets or leaves the ring, begins or ceases to slide, is taken again up to that instant,
  which a bracketing search finds on the method itself (`rig.physics.engines.common.events`). The impact speed is
  latched there, not at the end of the step: that alone would cap the accuracy at about 3e-3.
- The force starts and ends as t^1.5: parts shrink toward onset and lift-off if the method is `graded`; without that
  the order drops to 2.5.
- A part whose error estimate is above the tolerance is taken again, shorter; the next one follows the estimate.

The integrals of the ledger are part of the integrated vector: they share the quadrature.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rig.physics.engines.common.events import (
    NONE,
    change_phase,
    event_at_end,
    locate,
    note_force,
    rates_at_end,
    seen,
    sliding_phase,
    surplus,
    surplus_before,
)
from rig.physics.engines.common.memory import (
    CEILING,
    CLAMPS,
    CONTACT_STEPS,
    EVALUATIONS,
    ONSET,
    PHASE,
    REJECTED,
    SIZE,
    STEPS,
    TOLERANCE,
)
from rig.physics.engines.common.method import Step, fill, method_error, method_prepare, method_step, rates
from rig.physics.kernels import signals as S
from rig.physics.kernels.frames.geometry import gap
from rig.physics.kernels.laws.contact import FLIGHT, TOUCHING, held_speed
from rig.physics.kernels.stage import kernel

_LEAST = 1.0 / 64.0
"""Shortest part next to a crossing, in steps of the grid; ..."""
_GROWTH = 0.5
"""... away from it parts may last this times the time since or until the crossing."""
_SHORTEST = 1e-6
"""Shortest part that an error estimate can ask for, in steps of the grid."""
_MOST_PARTS = 20_000
"""Parts of one step of the grid; then it is given up and counted. Smoothed friction of 1 µm/s asks tsit5 for 15 000."""
_MOST_EVENTS = 200
"""Events in one step of the grid after which they are no longer located."""
_SAFETY = 0.9


@kernel
def _length(method, tick_s, memory, ticks, left, before, events):
    """Length of the next part [ticks]: as the error estimate, the contact's beginning or end, and the grid allow.

    Args:
        method: The method.
        tick_s: Seconds a tick.
        memory: Of the engine.
        ticks: Step of the grid.
        left: Of it.
        before: What is seen at the start of the part.
        events: Located in this step of the grid so far.
    """
    size = left
    if method.order > 0.0:
        size = min(size, memory[SIZE])
    if method.graded and memory[PHASE] != FLIGHT:
        # Time since onset or until lift-off, by the present rate.
        pace = abs(before.rate) * tick_s
        if before.depth < pace * ticks / _GROWTH:
            size = min(size, max(_LEAST * ticks, _GROWTH * before.depth / pace))
    if events >= _MOST_EVENTS:
        size = max(size, _LEAST * ticks)
    return left if size > 0.999 * left else size  # no slivers


@kernel
def _accepted(method, memory, ticks, size, error):
    """Whether a part of `size` with this scaled error will do; proposes the next one's length."""
    tolerance = memory[TOLERANCE]
    factor = _SAFETY * (tolerance / max(error, 1e-300)) ** (1.0 / method.order)
    if error > tolerance:
        if size > _SHORTEST * ticks:
            memory[REJECTED] += 1.0
            memory[SIZE] = size * max(0.1, factor)
            return False
        memory[CEILING] += 1.0
    proposal = size * min(5.0, max(0.2, factor))
    # A part that a crossing or the grid has cut short says nothing against longer ones.
    if size < memory[SIZE] and factor >= 1.0:
        proposal = max(memory[SIZE], proposal)
    memory[SIZE] = min(ticks, proposal)
    return True


@kernel
def _to_event(event, events, method, constants, inputs, step, before, memory, y, k, z, end, out):
    """Go to the instant of an event and over to the phase behind it; y and k[0] are there then.

    Returns:
        Length of the part up to there [ticks].
    """
    size = step.ticks
    after, first = surplus(event, constants.contact, out), surplus_before(event, before)
    if events == _MOST_EVENTS:
        memory[CEILING] += 1.0
    if events >= _MOST_EVENTS:
        # They pile up (a chatter, or bounces without end): from here on the phase changes at ends of parts.
        fill(y, end)
    elif first * after < 0.0:
        size *= locate(event, first, after, method, constants, inputs, step, memory, y, k, z, end, out)
        fill(y, end)
    else:
        # It was there at the start already, by rounding: change the phase, stay.
        size = 0.0
        rates(
            constants, inputs, step.tick, step.fraction, step.onset_speed, step.phase, False, y, k[method.rows - 1], out
        )
    fraction = step.fraction + size
    change_phase(event, constants, inputs, step.tick, fraction, memory, y, k[method.rows - 1], out)
    rates(constants, inputs, step.tick, fraction, memory[ONSET], int(memory[PHASE]), False, y, k[0], out)
    memory[EVALUATIONS] += 1.0
    return size


@kernel
def _grid_step(method, constants, inputs, tick, ticks, memory, y, k, z, end, scratch, out):
    """One step of the grid in as many parts as events, crossings and error estimates ask for.

    Entered with the rates at `y` in k[0] and what is observed there in `out`; leaves both for the end.
    """
    contact = constants.contact
    fraction, stale, events = 0.0, True, 0
    before = seen(contact, out)
    for _ in range(_MOST_PARTS):
        left = ticks - fraction
        onset_speed, phase = memory[ONSET], int(memory[PHASE])
        size = _length(method, inputs.tick_s, memory, ticks, left, before, events)
        if stale:
            longest = Step(tick, fraction, left, onset_speed, phase)
            memory[EVALUATIONS] += method_prepare(method, constants, inputs, longest, y, k, z, out)
            stale = False
        step = Step(tick, fraction, size, onset_speed, phase)
        evaluations = method_step(method, constants, inputs, step, y, k, z, end, out)
        rates_at_end(method, constants, inputs, step, end, k, out)
        memory[EVALUATIONS] += evaluations + 1.0
        memory[STEPS] += 1.0
        if method.order > 0.0:
            error = method_error(method, size * inputs.tick_s, k, scratch)
            if np.isnan(error):
                fill(y, end)
                return
            if not _accepted(method, memory, ticks, size, error):
                continue
        stale = True
        event = event_at_end(phase, before, contact, out)
        if event == NONE:
            fill(y, end)
            k[0] = k[method.rows - 1]
        else:
            events += 1
            size = _to_event(event, events, method, constants, inputs, step, before, memory, y, k, z, end, out)
        if phase != FLIGHT:
            memory[CONTACT_STEPS] += 1.0
            if out[S.NORMAL_FORCE] == 0.0 and out[S.PENETRATION] > 0.0:
                memory[CLAMPS] += 1.0
            note_force(memory, out[S.NORMAL_FORCE], size)
        before = seen(contact, out)
        fraction += size
        if fraction >= ticks:
            return
    memory[CEILING] += 1.0


@kernel
def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Prepare the memory for a state: a state that begins in contact holds the floored impact speed."""
    constants, inputs = constants[0], inputs[0]
    memory[:] = 0.0
    memory[ONSET] = held_speed(0.0, constants.contact)
    memory[SIZE] = step_ticks
    memory[TOLERANCE] = tolerance
    if gap(constants, y)[0] > 0.0:
        dy = np.empty(S.N_VECTOR)
        out = np.full(S.N_OBSERVED, np.nan)  # a signal that no stage computes stays nan
        rates(constants, inputs, 0, 0.0, memory[ONSET], TOUCHING, False, y, dy, out)
        memory[PHASE] = sliding_phase(constants, out[S.SLIDING_SPEED])


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def advance(method, constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """Take `steps` steps in place and write every `stride`-th instant's row (see `rig.physics.engines`).

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
        rows: Out, shape (ceil(steps / stride), N_ROW), or one longer: the last is that at the end.
    """
    constants, inputs = constants[0], inputs[0]
    k = np.zeros((method.rows, S.N_VECTOR))
    scratch = np.empty((2, S.N_STATE))
    z = np.empty(S.N_VECTOR)
    end = np.empty(S.N_VECTOR)
    out = np.full(S.N_OBSERVED, np.nan)  # a signal that no stage computes stays nan
    ticks = float(step_ticks)
    row = 0
    for n in range(steps + 1):
        now = tick + n * step_ticks
        if n % stride == 0 and row < len(rows):
            rates(constants, inputs, now, 0.0, memory[ONSET], int(memory[PHASE]), True, y, k[0], out)
            fill(rows[row, : S.N_VECTOR], y)
            fill(rows[row, S.N_VECTOR :], out)
            row += 1
        if n < steps:
            _grid_step(method, constants, inputs, now, ticks, memory, y, k, z, end, scratch, out)
