"""The default engine: the series of `rig.engines.taylor`, asked for the accuracy of a whole run.

A step of theirs may err by a ten-thousandth of `engine.tolerance`: impacts make small errors a thousand times larger.
Through flight they last for milliseconds, through an impact there are some eleven of them.

A rigid contact is a chain of impacts, one by one where the gap closes (`rig.engines.split.rigid`); where it lasts, it
is the compliant one.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rig.engines.memory import ONSET, PHASE
from rig.engines.split.place import HARDEST
from rig.engines.split.rigid import bounce, plant_of
from rig.engines.taylor import march as series
from rig.engines.taylor.events import FIRST
from rig.engines.taylor.place import END_FRACTION, END_TICK, EVENT, FRACTION, ORDER, SPAN, TICK
from rig.kernels.contact import FLIGHT
from rig.kernels.stage import kernel

__all__ = ["ORDER", "SHARE", "advance", "go_on", "start"]

SHARE = 1e-4
"""Part of the tolerance that one step of the series may err by."""


def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Prepare the memory for a state."""
    series.start(constants, inputs, y, memory, step_ticks, SHARE * tolerance if tolerance > 0.0 else 1e-9)


@kernel
def go_on(constants, inputs, plant, memory, room, y):
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
def advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """See `rig.engines`."""
    constants, inputs = constants[0], inputs[0]
    plant, room = plant_of(constants, inputs), series.room_in(memory)
    if not series.same_inputs(inputs, memory) or memory[SPAN] < 0.0:
        series.begin_series(constants, inputs, memory, room, y, tick, 0.0, False)
    grid, count = (tick, stride * step_ticks, tick + steps * step_ticks), (steps + stride - 1) // stride
    row = series.write_rows(constants, inputs, memory, room.Y, room.dy, room.out, y, grid, 0, rows)
    while row <= count and go_on(constants, inputs, plant, memory, room, y):
        row = series.write_rows(constants, inputs, memory, room.Y, room.dy, room.out, y, grid, row, rows)
    rows[row:].fill(np.nan)
