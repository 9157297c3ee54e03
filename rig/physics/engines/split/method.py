"""The default engine: the series of `rig.physics.engines.taylor`, asked for the accuracy of a whole run.

A step of theirs may err by a ten-thousandth of `engine.tolerance`: impacts make small errors a thousand times larger.
Through flight they last for milliseconds, through an impact there are some eleven of them.

Rolling that lasts goes over to collocation (`rig.physics.engines.split.rolling`), whose kernels compile when it first
does, or before by `warm_up`.

A rigid contact is a chain of impacts, one by one where the gap closes (`rig.physics.engines.split.rigid`); where it
lasts, it is the compliant one.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rig.physics.engines.common.memory import ONSET, PHASE
from rig.physics.engines.split.condensed import body_matrices
from rig.physics.engines.split.layout import MEMORY, PLACES, READY_TICK, STEP_S, WAITS
from rig.physics.engines.split.place import HARDEST, SHARE
from rig.physics.engines.split.rigid import bounce, plant_of
from rig.physics.engines.split.rolling import may_roll, roll, watch_for_rolling
from rig.physics.engines.taylor import march as series
from rig.physics.engines.taylor.events import FIRST
from rig.physics.engines.taylor.place import END_FRACTION, END_TICK, EVENT, FRACTION, ORDER, SERIES_ORDER, SPAN, TICK
from rig.physics.engines.taylor.ringing import set_modes
from rig.physics.kernels.laws.contact import FLIGHT
from rig.physics.kernels.signals import N_ROW, N_VECTOR
from rig.physics.kernels.stage import kernel

__all__ = ["MEMORY", "ORDER", "advance", "start", "warm_up"]

_COARSE, _COARSE_ORDER = 1e-5, 12
"""Tolerance from which a lower order of the series takes less time, a sixth in impacts at 0.01; and that order."""


def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Prepare the memory for a state."""
    series.start(constants, inputs, y, memory, step_ticks, SHARE * tolerance if tolerance > 0.0 else 1e-9)
    if len(memory) == MEMORY:
        memory[READY_TICK] = -1.0
        if constants[0].levels.inner_house:
            matrices = getattr(body_matrices, "py_func", body_matrices)(constants[0], inputs[0])[1]
            set_modes(constants[0].house, matrices, memory)
        if tolerance >= _COARSE:
            memory[SERIES_ORDER] = _COARSE_ORDER


@kernel
def _go_on(constants, inputs, plant, memory, room, y):
    """Over what ends a series to the next one; returns whether the numbers are finite."""
    bounced = lasts = False
    ends = memory[SPAN] >= 0.0 and memory[EVENT] == FIRST and memory[PHASE] == FLIGHT
    if ends and not constants.levels.compliant:
        series.read_off(memory, room.Y, y, memory[END_TICK], memory[END_FRACTION])
        bounced = bounce(constants, inputs, plant, memory, room, y)
        lasts = not bounced
    if bounced:
        end = int(memory[END_TICK])
        series.begin_series(constants, inputs, memory, room, y, end, memory[END_FRACTION], True)
    elif not series.continue_series(constants, inputs, memory, room, y):
        return False
    if lasts and memory[HARDEST] > memory[ONSET]:
        # It has come of that impact: after so slow an onset the law's damping is stiff, and no other matters here.
        series.read_off(memory, room.Y, y, memory[TICK], memory[FRACTION])
        memory[ONSET] = memory[HARDEST]
        series.begin_series(constants, inputs, memory, room, y, int(memory[TICK]), memory[FRACTION], False)
    return True


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def _march(constants, inputs, y, memory, tick, fraction, grid, row, rows):
    """Take series up to the end of the grid, or up to where rolling may go over to collocation.

    Where none is at hand, the first begins from the state y at a whole tick and the ticks beyond it.

    Returns:
        Number of the next row: behind the end, unless the state y is one to roll on from.
    """
    constants, inputs = constants[0], inputs[0]
    plant, room, collocates = plant_of(constants, inputs), series.room_in(memory), len(memory) == MEMORY
    if not series.same_inputs(inputs, memory) or memory[SPAN] < 0.0:
        series.begin_series(constants, inputs, memory, room, y, tick, fraction, False)
    first, every, end = grid
    count = (end - first + every - 1) // every
    while True:
        row = series.write_rows(constants, inputs, memory, room.Y, room.dy, room.out, y, grid, row, rows)
        if row > count:
            return row
        if collocates and may_roll(constants, memory):
            series.read_off(memory, room.Y, y, memory[END_TICK], memory[END_FRACTION])
            series.begin_series(constants, inputs, memory, room, y, int(memory[END_TICK]), memory[END_FRACTION], False)
            return row
        if not _go_on(constants, inputs, plant, memory, room, y):
            rows[row:].fill(np.nan)
            return count + 1
        if collocates:
            watch_for_rolling(constants, memory, room.Y[0])


def advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """See `rig.physics.engines`: rolling by collocation where the memory has room for it, else by series."""
    grid, count = (tick, stride * step_ticks, tick + steps * step_ticks), -(-steps // stride)
    rolls = len(memory) == MEMORY and memory[PLACES] > 0.0
    row = roll(constants, inputs, y, memory, grid, 0, rows) if rolls else 0
    while row <= count:
        at = (int(memory[END_TICK]), memory[END_FRACTION]) if row else (tick, 0.0)
        row = _march(constants, inputs, y, memory, *at, grid, row, rows)
        if row <= count:
            row = roll(constants, inputs, y, memory, grid, row, rows)


def warm_up(constants, inputs):
    """Compile rolling by collocation, by a call that returns at once: the memory is of other inputs."""
    memory = np.zeros(MEMORY)
    memory[STEP_S], memory[WAITS] = 1e-3, 1.0
    roll(constants, inputs, np.zeros(N_VECTOR), memory, (0, 1, 1), 0, np.zeros((1, N_ROW)))
