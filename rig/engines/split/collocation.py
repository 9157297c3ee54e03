"""The engine `split` where a scene asks for `engine.rolling = "collocation"`: rolling contact in long steps.

A module of its own, so that a run without it neither compiles nor imports any of it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rig.engines.split import method
from rig.engines.split.condensed import rolling_in
from rig.engines.split.layout import MEMORY, PLACES, READY_TICK
from rig.engines.split.method import ORDER, go_on
from rig.engines.split.rigid import plant_of
from rig.engines.split.rolling import (
    enter_rolling,
    leave_rolling,
    may_roll,
    next_step,
    watch_for_rolling,
    write_rolling_rows,
)
from rig.engines.taylor import march as series
from rig.engines.taylor.place import END_FRACTION, END_TICK, SPAN
from rig.kernels.stage import kernel

__all__ = ["MEMORY", "ORDER", "advance", "start"]


def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Prepare the memory for a state."""
    method.start(constants, inputs, y, memory, step_ticks, tolerance)
    memory[READY_TICK] = -1.0


@kernel
def _roll_on(constants, inputs, memory, rolling, room, y):
    """Take the next step of rolling by collocation; return False where a series has to continue."""
    if memory[PLACES] == 0.0:
        if not may_roll(memory):
            return False
        series.read_off(memory, room.Y, y, memory[END_TICK], memory[END_FRACTION])
        series.begin_series(constants, inputs, memory, room, y, int(memory[END_TICK]), memory[END_FRACTION], False)
        if not enter_rolling(constants, inputs, memory, rolling, room, y):
            return False
    if next_step(constants, inputs, memory, rolling):
        return True
    leave_rolling(constants, memory, rolling, y)
    series.begin_series(constants, inputs, memory, room, y, int(memory[END_TICK]), memory[END_FRACTION], False)
    return False


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """See `rig.engines`."""
    constants, inputs = constants[0], inputs[0]
    plant, room, rolling = plant_of(constants, inputs), series.room_in(memory), rolling_in(memory)
    if not series.same_inputs(inputs, memory) or memory[SPAN] < 0.0:
        if memory[PLACES] > 0.0:
            memory[PLACES], memory[SPAN] = 0.0, -1.0
        series.begin_series(constants, inputs, memory, room, y, tick, 0.0, False)
    grid, count = (tick, stride * step_ticks, tick + steps * step_ticks), (steps + stride - 1) // stride
    row, going = 0, True
    while going:
        if memory[PLACES] > 0.0:
            row = write_rolling_rows(constants, inputs, memory, rolling.Y, room.dy, room.out, y, grid, row, rows)
        else:
            row = series.write_rows(constants, inputs, memory, room.Y, room.dy, room.out, y, grid, row, rows)
        going = row <= count
        if going and not _roll_on(constants, inputs, memory, rolling, room, y):
            going = go_on(constants, inputs, plant, memory, room, y)
            if going:
                watch_for_rolling(constants, memory, room.Y[0])
    rows[row:].fill(np.nan)
