"""The default engine: each phase of the motion by the cheapest method that keeps the tolerance asked for.

- Flight, impacts, slip, the turn of friction and all that is not settled: the Taylor series of `rig.engines.taylor`,
  with their events; some eleven series an impact. They could take everything, and do where nothing below holds.
- Contact without an event for a while: exact linear flow and kicks (`rig.engines.split.steps`), up to twice as fast.
  Their error is measured: a trial of both, from the same state, before they begin, and again every now and then.
- A rigid contact: impacts one by one where the gap closes (`rig.engines.split.rigid`); where it lasts, it is the
  compliant one.

Which one runs is decided at a row, and given up in the middle of one at the start of the step that was not to be a
kick's.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rig.engines.memory import ONSET, PHASE, STEPS
from rig.engines.method import PER_SCALE
from rig.engines.split.flow import GRID, house_flows, magnet_springs, shaft_flows
from rig.engines.split.inner_motion import (
    fast,
    from_coordinates,
    plant_of,
)
from rig.engines.split.kick import Kick
from rig.engines.split.levels import LONGEST, SHORTEST
from rig.engines.split.place import (
    AGAIN,
    FLOWS,
    FLOWS_END,
    GRID_TICKS,
    HARDEST,
    LIMIT,
    MODE,
    OWN_TICKS,
    REST,
    ROLLS,
    SPRING_X,
    SPRING_Y,
    WANTED,
)
from rig.engines.split.rigid import bounce, hold
from rig.engines.split.state import Call, Coordinates, Direction, Touch
from rig.engines.split.steps import keep, keep_state, kicks, struck
from rig.engines.taylor import march as series
from rig.engines.taylor.events import FIRST, NOTHING
from rig.engines.taylor.place import END_FRACTION, END_TICK, EVENT, FRACTION, SLACK, SPAN, TICK
from rig.kernels import signals as S
from rig.kernels.contact import FLIGHT, ROLLING
from rig.kernels.geometry import gap
from rig.kernels.stage import kernel

ORDER = 2

_SERIES, _KICKS, _TO_SERIES, _TO_KICKS = 0.0, 1.0, 2.0, 3.0
"""Modes: series, which take everything; flow and kicks, where they may; and what is to take over from here on: another
division into flow and kick, and another length or grid, has other conjugate coordinates."""
_SHARE = 1e-4
"""Part of the tolerance that one step of the series may err by: impacts make small errors a thousand times larger."""
_SETTLED_S = 2e-2
"""A contact is one for kicks after this time without an event [s]: what they err by grows in impacts that follow."""
_TRIAL, _LONGEST_TRIAL_S = 0.05, 2e-2
"""A trial lasts for this part of the time that the contact has lasted, at most this [s]; the next is due when it has
lasted twice as long."""
_ASTRAY, _LOST = 0.2, 5e-3
"""Part of the tolerance that kicks may err by in a trial, and of the losses in it."""
_FINEST = 1e-4
"""Below this tolerance kicks that keep it are no faster than series."""
_WORTH = 20.0
"""Kicks for each series that they save, at most: as many take two thirds of its time."""
_LOSSES = [S.BEARING_LOSS, S.HOUSE_LOSS, S.CONTACT_LOSS, S.FRICTION_LOSS]


def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Prepare the memory for a state: the series, and the flows for this step."""
    series.start(constants, inputs, y, memory, step_ticks, _SHARE * tolerance if tolerance > 0.0 else 1e-9)
    memory[LIMIT], memory[OWN_TICKS] = tolerance, step_ticks
    # The shaft's flow is linear about its rest on the magnets.
    memory[REST], memory[SPRING_X], memory[SPRING_Y] = magnet_springs(constants[0])
    _prepare_flows(constants, inputs, memory, step_ticks)


def _prepare_flows(constants, inputs, memory, step_ticks):
    """Flows of the houses for steps of another grid."""
    memory[GRID_TICKS] = step_ticks
    memory[FLOWS:FLOWS_END] = house_flows(constants[0], step_ticks * inputs[0].tick_s).ravel()


@fast
def _enter_kicks(constants, memory, y, phase, wanted):
    """From the series over to kicks, at the state y."""
    axis, w, theta, houses = from_coordinates(constants, y)
    keep(memory, axis, w, theta, houses)
    angle = theta + constants.shaft.unbalance_phase
    none = Kick(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    direction = Direction(math.cos(angle), math.sin(angle), theta)
    keep_state(memory, Touch(phase, np.nan, wanted, 0.0), Coordinates(-1, 0.0, none), direction)
    memory[MODE] = _KICKS


@kernel
def _series_to(constants, inputs, plant, memory, room, y, tick):
    """The series up to a tick, and the state there into y."""
    while not series.holds(memory, tick, 0.0):
        bounced = lasts = False
        if memory[SPAN] >= 0.0 and memory[EVENT] != NOTHING:
            memory[ROLLS] = memory[END_TICK]
            if memory[EVENT] == FIRST and memory[PHASE] == FLIGHT and not constants.levels.compliant:
                series.read_off(memory, room, y, memory[END_TICK], memory[END_FRACTION])
                bounced = bounce(constants, inputs, plant, memory, room, y)
                lasts = not bounced
        if bounced:
            end = int(memory[END_TICK])
            series.begin_series(constants, inputs, memory, room, y, end, memory[END_FRACTION], True)
        elif not series.continue_series(constants, inputs, memory, room, y):
            return
        if lasts and memory[HARDEST] > memory[ONSET]:
            # It has come of that impact: after so slow an onset the law's damping is stiff, and no other matters here.
            series.read_off(memory, room, y, memory[TICK], memory[FRACTION])
            memory[ONSET] = memory[HARDEST]
            series.begin_series(constants, inputs, memory, room, y, int(memory[TICK]), memory[FRACTION], False)
    series.read_off(memory, room, y, tick, 0.0)


@kernel
def _leave_kicks(constants, inputs, plant, memory, y):
    """What the series need to know of the state that kicks have left."""
    memory[MODE] = _SERIES
    memory[SLACK] = 0.0
    if memory[PHASE] != FLIGHT and gap(constants, y)[0] <= 0.0:
        memory[PHASE] = FLIGHT
    if memory[PHASE] == ROLLING:
        hold(constants, inputs, plant, y)


def _trial(constants, inputs, y, memory, mode, level, tick, step_ticks, steps):
    """State and memory after some steps in a mode."""
    y, memory = y.copy(), memory.copy()
    memory[AGAIN], memory[MODE], memory[WANTED] = np.inf, mode, level
    _advance(constants, inputs, y, memory, tick, step_ticks, 0, steps, steps, np.empty((1, S.N_ROW)))
    return y, memory


def _choose(constants, inputs, y, memory, tick, step_ticks):
    """Go over to kicks, to kicks of another length, or to the series, whichever a trial of all says."""
    tick_s = float(inputs["tick_s"][0])
    lasts = (tick - memory[ROLLS]) * tick_s
    steps = math.ceil(min(_TRIAL * lasts, _LONGEST_TRIAL_S) / (step_ticks * tick_s))
    memory[AGAIN] = tick + lasts / tick_s
    kicked, wanted = memory[MODE] == _KICKS, memory[WANTED]
    series_mode = _TO_SERIES if kicked else _SERIES
    truth, after = _trial(constants, inputs, y, memory, series_mode, wanted, tick, step_ticks, steps)
    if after[ROLLS] == memory[ROLLS]:
        for level in range(LONGEST, SHORTEST - 1, -1):
            if steps * 2.0 ** (GRID - level) > _WORTH * (after[STEPS] - memory[STEPS]):
                break
            mode = _KICKS if kicked and level == wanted else _TO_KICKS
            end, left = _trial(constants, inputs, y, memory, mode, level, tick, step_ticks, steps)
            away = (end - truth)[: S.N_STATE] * PER_SCALE
            lost, right = (float(np.sum((run - y)[_LOSSES])) for run in (end, truth))
            near = math.sqrt(float(away @ away) / S.N_STATE) < _ASTRAY * memory[LIMIT]
            if left[MODE] == _KICKS and near and abs(lost - right) < _LOST * right:
                memory[MODE], memory[WANTED] = mode, level
                return
    memory[MODE] = series_mode


def advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """See `rig.engines`."""
    if step_ticks != memory[GRID_TICKS]:
        _prepare_flows(constants, inputs, memory, step_ticks)
        if memory[MODE] == _KICKS:
            memory[MODE] = _TO_KICKS
    done = _advance(constants, inputs, y, memory, tick, step_ticks, 0, steps, stride, rows)
    while done < steps:
        _choose(constants, inputs, y, memory, tick + done * step_ticks, step_ticks)
        done = _advance(constants, inputs, y, memory, tick, step_ticks, done, steps, stride, rows)


@kernel
def _due(constants, inputs, memory, now, end):
    """Whether it is time for a trial of kicks and series at a row, before the next one at the tick `end`."""
    if now < memory[AGAIN] or (now - memory[ROLLS]) * inputs.tick_s < _SETTLED_S or memory[SPAN] < 0.0:
        return False
    if memory[LIMIT] < _FINEST or memory[GRID_TICKS] != memory[OWN_TICKS]:
        return False
    # On a fixed ring what the commutators leave of rolling friction drifts, and series are long.
    if not constants.levels.inner_house or constants.contact.gap_counts_outer != 0.0:
        return False
    return memory[PHASE] != FLIGHT and memory[SLACK] == 0.0 and not struck(inputs, now, end)


@njit(cache=True, error_model="numpy", fastmath=False, nogil=True)
def _advance(constants, inputs, y, memory, tick, step_ticks, first, steps, stride, rows):
    """The same from the step `first` on, up to the end or to a row at which a trial is due.

    Returns:
        Steps done by then.
    """
    constants, inputs = constants[0], inputs[0]
    plant = plant_of(constants, inputs, memory[REST], memory[SPRING_X], memory[SPRING_Y])
    shaft_table = shaft_flows(plant, inputs.magnet_engaged, step_ticks * inputs.tick_s)
    half_s = 0.5 * 2.0**-GRID * (step_ticks * inputs.tick_s)
    call = Call(plant, step_ticks / 2.0**GRID, half_s, 0.5 / half_s)
    room = series.room_in(memory)
    ledger = np.zeros(S.N_VECTOR)
    changed = not series.same_inputs(inputs, memory)
    if memory[MODE] == _TO_SERIES:
        _leave_kicks(constants, inputs, plant, memory, y)
        memory[SPAN] = -1.0
    if memory[MODE] == _TO_KICKS or (memory[MODE] == _KICKS and changed):
        _enter_kicks(constants, memory, y, int(memory[PHASE]), int(memory[WANTED]))
    elif memory[MODE] == _SERIES and (changed or memory[SPAN] < 0.0):
        series.begin_series(constants, inputs, memory, room, y, tick + first * step_ticks, 0.0, False)
    while first < steps:
        now, ahead = tick + first * step_ticks, min(stride, steps - first)
        end = now + ahead * step_ticks
        if _due(constants, inputs, memory, now, end):
            return first
        series.write_row(constants, inputs, memory, room, y, now, int(memory[PHASE]), rows, first // stride)
        n, last = 0, ahead * 2**GRID
        while n < last:
            if memory[MODE] == _KICKS:
                n = kicks(constants, inputs, call, memory, shaft_table, ledger, y, now, n, last)
                if n < last:
                    at = now + n * call.part_ticks
                    memory[ROLLS] = at
                    _leave_kicks(constants, inputs, plant, memory, y)
                    whole = math.floor(at)
                    series.begin_series(constants, inputs, memory, room, y, whole, at - whole, False)
            else:
                _series_to(constants, inputs, plant, memory, room, y, end)
                n = last
        first += ahead
    count = (steps + stride - 1) // stride
    if len(rows) > count:
        series.write_row(constants, inputs, memory, room, y, tick + steps * step_ticks, int(memory[PHASE]), rows, count)
    return first
