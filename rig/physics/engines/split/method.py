"""Default engine: the series of `rig.physics.engines.taylor`, with a tolerance for the accuracy of a whole run.

The error of each step is a ten-thousandth of `engine.tolerance`, as impacts amplify small errors about a thousandfold.
In flight, steps last for milliseconds; an impact takes about eleven of them.

Lasting rolling contact changes to collocation (`rig.physics.engines.split.rolling`). Its kernels compile at that time,
or earlier by `warm_up`.

A rigid contact is a sequence of impacts at the instants where the gap closes (`rig.physics.engines.split.rigid`); where
it lasts, it is compliant.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rig.physics.engines.common.memory import ONSET, PHASE
from rig.physics.engines.split.condensed import body_matrices
from rig.physics.engines.split.layout import MEMORY, PLACES, READY_TICK, STALE_RESPONSES, STEP_S
from rig.physics.engines.split.memory import MAX_IMPACT_SPEED, STEP_SHARE
from rig.physics.engines.split.rigid import apply_impact, make_plant
from rig.physics.engines.split.rolling import may_roll, roll, watch_for_rolling
from rig.physics.engines.taylor import march as series
from rig.physics.engines.taylor.events import FIRST
from rig.physics.engines.taylor.memory import END_FRACTION, END_TICK, EVENT, FRACTION, ORDER, SERIES_ORDER, SPAN, TICK
from rig.physics.engines.taylor.ringing import set_modes
from rig.physics.kernels.laws.contact import FLIGHT
from rig.physics.kernels.signals import N_ROW, N_VECTOR
from rig.physics.kernels.stage import kernel

__all__ = ["MEMORY", "ORDER", "advance", "start", "warm_up"]

_COARSE_TOLERANCE, _COARSE_ORDER = 1e-5, 12
"""Tolerance from which a lower order of the series is faster, by a sixth in impacts at 0.01; and that order."""


def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Initialise the memory for a state."""
    series.start(constants, inputs, y, memory, step_ticks, STEP_SHARE * tolerance if tolerance > 0.0 else 1e-9)
    if len(memory) == MEMORY:
        memory[READY_TICK] = -1.0
        if constants[0].levels.inner_house:
            matrices = getattr(body_matrices, "py_func", body_matrices)(constants[0], inputs[0])[1]
            set_modes(constants[0].house, matrices, memory)
        if tolerance >= _COARSE_TOLERANCE:
            memory[SERIES_ORDER] = _COARSE_ORDER


@kernel
def _continue_after_event(constants, inputs, plant, memory, room, y):
    """Start the next series after the event that ends one; return whether the numbers are finite."""
    bounced = lasts = False
    ends = memory[SPAN] >= 0.0 and memory[EVENT] == FIRST and memory[PHASE] == FLIGHT
    if ends and not constants.levels.compliant:
        series.read_state(memory, room.Y, y, memory[END_TICK], memory[END_FRACTION])
        bounced = apply_impact(constants, inputs, plant, memory, room, y)
        lasts = not bounced
    if bounced:
        end = int(memory[END_TICK])
        series.begin_series(constants, inputs, memory, room, y, end, memory[END_FRACTION], True)
    elif not series.continue_series(constants, inputs, memory, room, y):
        return False
    if lasts and memory[MAX_IMPACT_SPEED] > memory[ONSET]:
        # Keep the impact's speed: after a slower onset, the law's damping would be stiff.
        series.read_state(memory, room.Y, y, memory[TICK], memory[FRACTION])
        memory[ONSET] = memory[MAX_IMPACT_SPEED]
        series.begin_series(constants, inputs, memory, room, y, int(memory[TICK]), memory[FRACTION], False)
    return True


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def _march(constants, inputs, y, memory, tick, fraction, grid, row, rows):
    """Take series up to the end of the grid, or up to a state at which collocation may take over.

    Without a current series, the first starts from the state y at `tick` + `fraction`.

    Returns:
        Number of the next row: beyond the last row, unless collocation may continue from the state y.
    """
    constants, inputs = constants[0], inputs[0]
    plant, room, collocates = make_plant(constants, inputs), series.room_in(memory), len(memory) == MEMORY
    if not series.compare_inputs(inputs, memory) or memory[SPAN] < 0.0:
        series.begin_series(constants, inputs, memory, room, y, tick, fraction, False)
    first, every, end = grid
    count = (end - first + every - 1) // every
    while True:
        row = series.write_rows(constants, inputs, memory, room.Y, room.dy, room.out, y, grid, row, rows)
        if row > count:
            return row
        if collocates and may_roll(constants, memory):
            series.read_state(memory, room.Y, y, memory[END_TICK], memory[END_FRACTION])
            series.begin_series(constants, inputs, memory, room, y, int(memory[END_TICK]), memory[END_FRACTION], False)
            return row
        if not _continue_after_event(constants, inputs, plant, memory, room, y):
            rows[row:].fill(np.nan)
            return count + 1
        if collocates:
            watch_for_rolling(constants, memory, room.Y[0])


def advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """Advance as in `rig.physics.engines`; rolling is by collocation if the memory has room for it, else by series."""
    grid, count = (tick, stride * step_ticks, tick + steps * step_ticks), -(-steps // stride)
    rolls = len(memory) == MEMORY and memory[PLACES] > 0.0
    row = roll(constants, inputs, y, memory, grid, 0, rows) if rolls else 0
    while row <= count:
        at = (int(memory[END_TICK]), memory[END_FRACTION]) if row else (tick, 0.0)
        row = _march(constants, inputs, y, memory, *at, grid, row, rows)
        if row <= count:
            row = roll(constants, inputs, y, memory, grid, row, rows)


def warm_up(constants, inputs):
    """Compile rolling by collocation. The call returns at once, as the memory is of other inputs."""
    memory = np.zeros(MEMORY)
    memory[STEP_S], memory[STALE_RESPONSES] = 1e-3, 1.0
    roll(constants, inputs, np.zeros(N_VECTOR), memory, (0, 1, 1), 0, np.zeros((1, N_ROW)))
