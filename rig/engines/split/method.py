"""The default engine: each phase of the motion by the cheapest method that keeps the tolerance asked for.

- Impacts, slip, the turn of friction and all that is not settled: the Taylor series of `rig.engines.taylor`, with their
  events; some eleven series an impact. They could take everything, and do where nothing below holds.
- Flight, as long as no bound lets the gap close: exact linear flow, and a kick a step for what is not linear.
- Contact that rolls, or slides, without an event for a while and has no swing left: flow and kicks as well.
- A rigid contact: impacts one by one where the gap closes (`rig.engines.split.rigid`); where it lasts, kicks.

Which one runs is decided at a row, by rules on the state (`rig.engines.split.levels`), and given up in the middle of
one at the start of the step that was not to be a kick's.

How a step of flow and kick is made: `rig.engines.split.steps`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rig.engines.memory import PHASE
from rig.engines.split.flow import GRID, house_flows, magnet_springs, shaft_flows
from rig.engines.split.inner_motion import (
    FAST,
    eccentricity,
    from_coordinates,
    motion_of,
    plant_of,
)
from rig.engines.split.kick import Kick
from rig.engines.split.levels import ANY, flight_level
from rig.engines.split.place import (
    AGAIN,
    BOUNCE,
    FLOWS,
    FLOWS_END,
    GRID_TICKS,
    LAST_STEP,
    LIMIT,
    MODE,
    REST,
    ROLLS,
    SPRING_X,
    SPRING_Y,
    WANTED,
)
from rig.engines.split.rigid import bounce, hold, part
from rig.engines.split.state import Call, Coordinates, Direction, Touch
from rig.engines.split.steps import keep, keep_state, kicks, struck
from rig.engines.taylor import march as series
from rig.engines.taylor.events import FIRST, NOTHING
from rig.engines.taylor.place import END_FRACTION, END_TICK, EVENT, SLACK, SPAN
from rig.kernels import signals as S
from rig.kernels.contact import FLIGHT, ROLLING
from rig.kernels.geometry import gap

ORDER = 2

_SERIES, _KICKS = 0.0, 1.0
"""Modes: series, which take everything; flow and kicks, where they may."""
_SHARE = 1e-3
"""Part of the tolerance that one step of the series may err by: impacts make small errors a thousand times larger."""
_FAR_S = 1e-2
"""Where a series reaches this far [s], because no house rings, flow and kicks are no faster."""
_SETTLED_S = 1e-3
"""A contact is one for kicks after this time without an event [s]; and if they had to leave it, after this time."""


def start(constants, inputs, y, memory, step_ticks, tolerance):
    """Prepare the memory for a state: the series, and the flows for this step."""
    series.start(constants, inputs, y, memory, step_ticks, _SHARE * tolerance if tolerance > 0.0 else 1e-9)
    memory[LIMIT] = tolerance
    # The shaft's flow is linear about its rest on the magnets.
    memory[REST], memory[SPRING_X], memory[SPRING_Y] = magnet_springs(constants)
    _prepare_flows(constants, inputs, memory, step_ticks)


def _prepare_flows(constants, inputs, memory, step_ticks):
    """Flows of the houses for steps of another grid."""
    memory[GRID_TICKS] = step_ticks
    memory[FLOWS:FLOWS_END] = house_flows(constants, step_ticks * inputs.tick_s).ravel()


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _enter_kicks(constants, memory, y, phase, wanted):
    """From the series over to kicks, at the state y."""
    axis, w, theta, houses = from_coordinates(constants, y)
    keep(memory, axis, w, theta, houses)
    angle = theta + constants.shaft.unbalance_phase
    none = Kick(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    direction = Direction(math.cos(angle), math.sin(angle), theta)
    ex, ey = eccentricity(constants, axis, houses)
    rate = motion_of(constants, axis.px, axis.py, houses, ex, ey).rate
    keep_state(memory, Touch(phase, np.nan, rate, wanted, 0.0), Coordinates(-1, 0.0, none), direction)
    memory[BOUNCE], memory[LAST_STEP] = rate, 0.0
    memory[MODE] = _KICKS


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _try_kicks(constants, inputs, call, memory, y, now, end):
    """Go over to kicks where the next steps, up to the tick `end`, are likely to be theirs."""
    phase = int(memory[PHASE])
    if memory[SPAN] < 0.0 or now < memory[AGAIN] or struck(inputs, now, end):
        return
    if phase == FLIGHT:
        if memory[SPAN] > _FAR_S and memory[LIMIT] > 0.0:
            return
        axis, w, _, houses = from_coordinates(constants, y)
        level = flight_level(constants, inputs, call, axis, w, houses, 0.0)
        if level >= GRID + 1 or (level == GRID and memory[LIMIT] == 0.0):
            _enter_kicks(constants, memory, y, phase, GRID)
        return
    lasts = (now - memory[ROLLS]) * inputs.tick_s > _SETTLED_S and memory[SLACK] == 0.0
    if lasts and constants.levels.compliant and constants.contact.gap_counts_outer == 0.0:
        _enter_kicks(constants, memory, y, phase, ANY)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _series_to(constants, inputs, plant, memory, room, y, tick):
    """The series up to a tick, and the state there into y.

    Returns:
        Whether a rigid contact has begun to last on the way, at the end of the series at hand; y is the state there.
    """
    rigid = not constants.levels.compliant
    while not series.holds(memory, tick, 0.0):
        if memory[EVENT] != NOTHING:
            memory[ROLLS] = memory[END_TICK]
        if rigid and memory[EVENT] == FIRST:
            series.read_off(memory, room, y, memory[END_TICK], memory[END_FRACTION])
            if bounce(constants, inputs, plant, memory, room, y):
                return True
            end = int(memory[END_TICK])
            series.begin_series(constants, inputs, memory, room, y, end, memory[END_FRACTION], True)
            if not np.isfinite(y[0]):
                return False
        elif not series.continue_series(constants, inputs, memory, room, y):
            return False
    series.read_off(memory, room, y, tick, 0.0)
    return False


@njit(cache=True, error_model="numpy")
def _leave_kicks(constants, inputs, plant, memory, y):
    """What the series need to know of the state that kicks have left.

    Returns:
        Whether a rigid contact ends there.
    """
    memory[MODE] = _SERIES
    memory[SLACK] = 0.0
    if not constants.levels.compliant:
        touched = memory[PHASE] != FLIGHT
        memory[PHASE] = FLIGHT
        return touched and part(constants, inputs, plant, y)
    if memory[PHASE] != FLIGHT and gap(constants, y)[0] <= 0.0:
        memory[PHASE] = FLIGHT
    if memory[PHASE] == ROLLING:
        hold(constants, inputs, plant, y)
    return False


def advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """See `rig.engines`."""
    regridded = step_ticks != memory[GRID_TICKS]
    if regridded:
        _prepare_flows(constants, inputs, memory, step_ticks)
    _advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows, regridded)


@njit(cache=True, error_model="numpy", nogil=True)
def _advance(constants, inputs, y, memory, tick, step_ticks, steps, stride, rows, regridded):
    """The same, on flows for this grid; `regridded` says that they are new."""
    plant = plant_of(constants, inputs, memory[REST], memory[SPRING_X], memory[SPRING_Y])
    shaft_table = shaft_flows(plant, inputs.magnet_engaged, step_ticks * inputs.tick_s)
    half_s = 0.5 * 2.0**-GRID * (step_ticks * inputs.tick_s)
    call = Call(plant, step_ticks / 2.0**GRID, half_s, 0.5 / half_s, memory[LIMIT])
    room = series.room_in(memory)
    ledger = np.zeros(S.N_VECTOR)
    changed = not series.same_inputs(inputs, memory)
    if memory[SPAN] < 0.0 or (changed and memory[MODE] == _SERIES):
        series.begin_series(constants, inputs, memory, room, y, tick, 0.0, False)
    elif memory[MODE] == _KICKS and (changed or regridded):
        # Another division into flow and kick, or another grid, has other conjugate coordinates.
        _enter_kicks(constants, memory, y, int(memory[PHASE]), int(memory[WANTED]))
    row = first = 0
    while first < steps:
        now, ahead = tick + first * step_ticks, min(stride, steps - first)
        end = now + ahead * step_ticks
        if memory[MODE] == _SERIES:
            _try_kicks(constants, inputs, call, memory, y, now, end)
        # Rigid impacts have no force over time.
        seen = int(memory[PHASE]) if constants.levels.compliant else FLIGHT
        series.write_row(constants, inputs, memory, room, y, now, seen, rows, row)
        row += 1
        n, last = 0, ahead * 2**GRID
        while n < last:
            if memory[MODE] == _KICKS:
                n = kicks(constants, inputs, call, memory, shaft_table, ledger, y, now, n, last)
                if n < last:
                    at = now + n * call.part_ticks
                    memory[AGAIN] = memory[ROLLS] = at + _SETTLED_S / inputs.tick_s
                    ends = _leave_kicks(constants, inputs, plant, memory, y)
                    whole = math.floor(at)
                    series.begin_series(constants, inputs, memory, room, y, whole, at - whole, ends)
            elif _series_to(constants, inputs, plant, memory, room, y, end):
                since = (memory[END_TICK] - now) + memory[END_FRACTION]
                n = math.ceil(since / call.part_ticks)
                _enter_kicks(constants, memory, y, ROLLING, GRID)
            else:
                n = last
        first += ahead
