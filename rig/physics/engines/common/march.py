"""March of one-step methods: grid steps, divided at each onset, lift-off and change of Coulomb's set-valued friction.

An engine defines one step of its method and its error (`rig.physics.engines.common.method`). This module has the common
rest: division of grid steps, impact speed, counters, rows. The rules for dividing a grid step depend on the state
alone, so that a run does not depend on how it is divided into calls:

- A part in which the shaft meets or leaves the ring, or starts or stops sliding, is repeated up to that instant, which
a bracketing search finds with the method itself (`rig.physics.engines.common.events`). The impact speed is latched
there. Latching it at the end of the step would limit the accuracy to about 3e-3.
- The force starts and ends as t^1.5. If the method is `graded`, parts shrink toward onset and lift-off; otherwise the
order drops to 2.5.
- A part with an error estimate above the tolerance is repeated with a shorter length; the estimate also sets the next
length.

The integrals of the ledger are part of the integrated vector and share its quadrature.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rig.physics.engines.common.events import (
    NO_EVENT,
    change_phase,
    detect_event,
    event_function,
    event_function_at_start,
    event_quantities,
    locate_event,
    rates_at_end,
    sliding_phase,
    update_peak_force,
)
from rig.physics.engines.common.memory import (
    CEILING,
    CLAMPS,
    CONTACT_STEPS,
    EVALUATIONS,
    ONSET,
    PART_LENGTH,
    PHASE,
    REJECTED,
    STEPS,
    TOLERANCE,
)
from rig.physics.engines.common.method import Step, fill, method_error, method_prepare, method_step, rates
from rig.physics.kernels import signals as S
from rig.physics.kernels.frames.geometry import gap
from rig.physics.kernels.laws.contact import FLIGHT, TOUCHING, floor_onset_speed
from rig.physics.kernels.stage import kernel

_MIN_CROSSING_PART = 1.0 / 64.0
"""Shortest part next to an onset or lift-off, in grid steps."""
_PART_GROWTH = 0.5
"""Longest part elsewhere over the time since or until the onset or lift-off."""
_MIN_PART = 1e-6
"""Shortest part by the error estimate, in grid steps."""
_MAX_PARTS = 20_000
"""Largest number of parts in a grid step, which is then given up and counted. Smoothed friction of 1 µm/s needs 15 000
with tsit5."""
_MAX_EVENTS = 200
"""Number of events in a grid step after which events are no longer located."""
_SAFETY = 0.9


@kernel
def _choose_length(method, tick_s, memory, ticks, left, before, events):
    """Return the length of the next part [ticks], limited by error estimate, onset or lift-off, and grid.

    Args:
        method: Method.
        tick_s: Length of a tick [s].
        memory: Memory of the engine.
        ticks: Length of a grid step [ticks].
        left: Remaining length of the grid step [ticks].
        before: Event quantities at the start of the part.
        events: Number of events located in this grid step.
    """
    size = left
    if method.order > 0.0:
        size = min(size, memory[PART_LENGTH])
    if method.graded and memory[PHASE] != FLIGHT:
        # Time since onset or until lift-off, by the present rate.
        pace = abs(before.rate) * tick_s
        if before.depth < pace * ticks / _PART_GROWTH:
            size = min(size, max(_MIN_CROSSING_PART * ticks, _PART_GROWTH * before.depth / pace))
    if events >= _MAX_EVENTS:
        size = max(size, _MIN_CROSSING_PART * ticks)
    return left if size > 0.999 * left else size  # no slivers


@kernel
def _accept_part(method, memory, ticks, size, error):
    """Return whether a part's scaled error is acceptable, and set the length of the next part."""
    tolerance = memory[TOLERANCE]
    factor = _SAFETY * (tolerance / max(error, 1e-300)) ** (1.0 / method.order)
    if error > tolerance:
        if size > _MIN_PART * ticks:
            memory[REJECTED] += 1.0
            memory[PART_LENGTH] = size * max(0.1, factor)
            return False
        memory[CEILING] += 1.0
    proposal = size * min(5.0, max(0.2, factor))
    # A part shortened by an event or the grid does not prevent longer ones.
    if size < memory[PART_LENGTH] and factor >= 1.0:
        proposal = max(memory[PART_LENGTH], proposal)
    memory[PART_LENGTH] = min(ticks, proposal)
    return True


@kernel
def _advance_to_event(event, events, method, constants, inputs, step, before, memory, y, k, z, end, out):
    """Advance to the instant of an event and change the phase; y and k[0] are those of the event then.

    Returns:
        Length of the part up to the event [ticks].
    """
    size = step.ticks
    after, first = event_function(event, constants.contact, out), event_function_at_start(event, before)
    if events == _MAX_EVENTS:
        memory[CEILING] += 1.0
    if events >= _MAX_EVENTS:
        # Events accumulate (chatter, or endless bounces): from now on the phase changes at the ends of parts.
        fill(y, end)
    elif first * after < 0.0:
        size *= locate_event(event, first, after, method, constants, inputs, step, memory, y, k, z, end, out)
        fill(y, end)
    else:
        # Within rounding, the event is at the start: change the phase without advancing.
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
def _take_grid_step(method, constants, inputs, tick, ticks, memory, y, k, z, end, scratch, out):
    """Take one grid step in the parts that events and error estimates require.

    At entry and return, k[0] holds the rates at `y`, and `out` the observed quantities.
    """
    contact = constants.contact
    fraction, stale, events = 0.0, True, 0
    before = event_quantities(contact, out)
    for _ in range(_MAX_PARTS):
        left = ticks - fraction
        onset_speed, phase = memory[ONSET], int(memory[PHASE])
        size = _choose_length(method, inputs.tick_s, memory, ticks, left, before, events)
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
            if not _accept_part(method, memory, ticks, size, error):
                continue
        stale = True
        event = detect_event(phase, before, contact, out)
        if event == NO_EVENT:
            fill(y, end)
            k[0] = k[method.rows - 1]
        else:
            events += 1
            size = _advance_to_event(event, events, method, constants, inputs, step, before, memory, y, k, z, end, out)
        if phase != FLIGHT:
            memory[CONTACT_STEPS] += 1.0
            if out[S.NORMAL_FORCE] == 0.0 and out[S.PENETRATION] > 0.0:
                memory[CLAMPS] += 1.0
            update_peak_force(memory, out[S.NORMAL_FORCE], size)
        before = event_quantities(contact, out)
        fraction += size
        if fraction >= ticks:
            return
    memory[CEILING] += 1.0


@kernel
def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Initialise the memory for a state; a state in contact gets the floored impact speed."""
    constants, inputs = constants[0], inputs[0]
    memory[:] = 0.0
    memory[ONSET] = floor_onset_speed(0.0, constants.contact)
    memory[PART_LENGTH] = step_ticks
    memory[TOLERANCE] = tolerance
    if gap(constants, y)[0] > 0.0:
        dy = np.empty(S.N_VECTOR)
        out = np.full(S.N_OBSERVED, np.nan)  # a signal that no stage computes stays nan
        rates(constants, inputs, 0, 0.0, memory[ONSET], TOUCHING, False, y, dy, out)
        memory[PHASE] = sliding_phase(constants, out[S.SLIDING_SPEED])


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def advance(method, constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """Take `steps` steps in place and write a row every `stride` steps (see `rig.physics.engines`).

    Args:
        method: Method.
        constants: Model constants.
        inputs: Hammer, drive, magnets; constant over the call.
        y: State and integrals, in and out, shape (N_VECTOR,).
        memory: Memory, in and out, shape (MEMORY,).
        tick: Time at the start.
        step_ticks: Length of a step [ticks].
        steps: Number of steps.
        stride: Steps per row.
        rows: Out, shape (ceil(steps / stride), N_ROW), or one longer, with the row at the end.
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
            _take_grid_step(method, constants, inputs, now, ticks, memory, y, k, z, end, scratch, out)
