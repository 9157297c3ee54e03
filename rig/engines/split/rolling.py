"""Rolling as a phase of its own: entry from a series, steps of part of a whirl turn, their error, exit to a series.

A settled whirl has few harmonics, but a series resolves the contact's own frequency, which no longer appears in the
motion. `rig.engines.split.condensed` takes from two to `MAX_PLACES` steps a turn, which does not resolve it. Each
place keeps the inverse of its last solution; its unknowns are predicted from those of the last three turns.

A step that the contact may slip or lift off in, or a transducer lose its preload, that a hammer pulse falls into, or
that cannot be solved, is not taken: a series continues from its start. The limits have a margin, so that no event is
missed between nodes; the series locates it.
"""

from __future__ import annotations

import math

import numpy as np

from rig.engines.events import note_force
from rig.engines.memory import CONTACT_STEPS, EVALUATIONS, ONSET, PHASE, STEPS, TOLERANCE
from rig.engines.method import fill, rates
from rig.engines.split.condensed import (
    FN,
    FT,
    FX,
    N_UNKNOWNS,
    body_matrices,
    estimate,
    keeps_rolling,
    set_step,
    solve_step,
    write_nodes,
)
from rig.engines.split.layout import (
    LAST_UNKNOWNS,
    MAX_PLACES,
    NORMAL_X,
    NORMAL_Y,
    PLACE,
    PLACES,
    READY_TICK,
    ROLLING_S,
    ROLLING_STEPS,
    STEP_S,
    TURNS,
    WHIRL_RATE,
    WORST,
)
from rig.engines.split.method import SHARE
from rig.engines.split.radau import NODES, STAGES, interpolation
from rig.engines.split.rigid import axis_at, motion_of
from rig.engines.taylor.events import NOTHING
from rig.engines.taylor.march import holds
from rig.engines.taylor.place import EAST, END_FRACTION, END_TICK, EVENT, FRACTION, INPUTS, NORTH, SPAN, TICK
from rig.kernels import signals as S
from rig.kernels.contact import ROLLING
from rig.kernels.stage import kernel

_LADDER = (2, 3, 4, 6, 8, 12, 16, 24, MAX_PLACES)
"""Steps a turn."""
_LONGEST_TURN_S = 0.1
"""A contact that takes longer to go round does not whirl."""
_ORDER = 4.5
"""Power of the step that the estimate is proportional to, as measured in settled whirl: a sum over harmonics."""
_SPARE = 0.3
"""Part of the limit that the estimate may come to with fewer steps."""
_ITERATED = 0.02
"""Change of the force, over the largest, at which iterations stop, over the tolerance."""
_REJECTED = 10.0
"""Estimate over its limit from which a step is taken again, shorter."""
_STATE_GAIN = 10.0
"""Scaled state error over the square of the relative force estimate, as measured in settled whirl."""


@kernel
def _normal_and_rate(constants, y):
    """Contact normal, and about the rate of its angle [rad/s]."""
    axis, w = axis_at(constants, y)
    motion = motion_of(constants, axis, w, y)
    return motion.nx, motion.ny, (motion.sliding - constants.shaft.radius * w) / constants.contact.clearance


@kernel
def _hammer_within(inputs, tick, fraction, ticks):
    """Return whether a hammer pulse overlaps a step."""
    return (
        inputs.hammer_end > inputs.hammer_start
        and inputs.hammer_end > tick
        and inputs.hammer_start < tick + fraction + ticks
    )


@kernel
def _set_places(constants, inputs, memory, rolling, places, turns):
    """Take `places` steps a turn from now on."""
    memory[PLACES], memory[PLACE], memory[TURNS], memory[WORST] = places, 0.0, turns, 0.0
    memory[STEP_S] = 2.0 * math.pi / abs(memory[WHIRL_RATE]) / places
    set_step(constants, inputs, rolling, memory[STEP_S])


@kernel
def watch_for_rolling(constants, memory, y):
    """Wait one turn from the start of rolling in a series; y is its first state."""
    if memory[PHASE] != ROLLING:
        memory[READY_TICK] = -1.0
    elif memory[READY_TICK] < 0.0:
        _wait(constants, memory, y, memory[TICK])


@kernel
def _wait(constants, memory, y, tick):
    """Set the tick from which rolling may be tried, one whirl turn after a state."""
    rate = abs(_normal_and_rate(constants, y)[2])
    turn_s = 2.0 * math.pi / max(rate, 2.0 * math.pi / _LONGEST_TURN_S)
    memory[READY_TICK] = tick + math.ceil(turn_s / memory[INPUTS])


@kernel
def may_roll(memory):
    """Return whether collocation may replace the current series at its end."""
    return (
        memory[SPAN] >= 0.0
        and memory[PHASE] == ROLLING
        and memory[EVENT] == NOTHING
        and 0.0 <= memory[READY_TICK] <= memory[END_TICK]
        and memory[NORTH] == 0.0
        and memory[EAST] == 0.0
    )


@kernel
def enter_rolling(constants, inputs, memory, rolling, room, y):
    """Prepare rolling by collocation from the state y at the end of a series; returns whether it can be tried."""
    nx, ny, rate = _normal_and_rate(constants, y)
    if not abs(rate) > 2.0 * math.pi / _LONGEST_TURN_S:
        _wait(constants, memory, y, memory[END_TICK])
        return False
    dy, out, tick, phase = room.dy, room.out, int(memory[END_TICK]), int(memory[PHASE])
    rates(constants, inputs, tick, memory[END_FRACTION], memory[ONSET], phase, True, y, dy, out)
    shafts, _ = body_matrices(constants, inputs)
    ax = dy[S.BETA_RATE] - shafts[0, 1, 0] * y[S.BETA] - shafts[0, 1, 1] * y[S.BETA_RATE]
    ay = -(dy[S.GAMMA_RATE] - shafts[1, 1, 0] * y[S.GAMMA] - shafts[1, 1, 1] * y[S.GAMMA_RATE])
    last = memory[LAST_UNKNOWNS : LAST_UNKNOWNS + N_UNKNOWNS]
    last[0], last[1] = -out[S.NORMAL_FORCE], -out[S.FRICTION_FORCE]
    last[2], last[3] = ax * nx + ay * ny, ay * nx - ax * ny
    last[4] = dy[S.THETA_RATE] - shafts[2, 1, 1] * y[S.THETA_RATE]
    last[5] = out[S.PENETRATION]
    memory[WHIRL_RATE] = rate
    _set_places(constants, inputs, memory, rolling, MAX_PLACES, 0)
    fill(rolling.Y[STAGES], y)
    return True


@kernel
def _turn_unknowns(m, cosine, sine):
    """Turn force and accelerations by an angle."""
    for p in range(0, 4, 2):
        for i in range(STAGES):
            x, y = m[FX + p * STAGES + i], m[FX + (p + 1) * STAGES + i]
            m[FX + p * STAGES + i], m[FX + (p + 1) * STAGES + i] = cosine * x - sine * y, sine * x + cosine * y


@kernel
def _predict(m, rolling, nx, ny):
    """First guess of the unknowns: by the last turns at this place, else by those of the last node as it turns."""
    place, turns = int(m[PLACE]), m[TURNS]
    first, second, third = rolling.history[0, place], rolling.history[1, place], rolling.history[2, place]
    if turns == 0.0:
        for i in range(STAGES):
            angle = m[WHIRL_RATE] * m[STEP_S] * NODES[i]
            c, s = math.cos(angle), math.sin(angle)
            for p in range(0, 4, 2):
                x, y = m[LAST_UNKNOWNS + p], m[LAST_UNKNOWNS + p + 1]
                m[FX + p * STAGES + i], m[FX + (p + 1) * STAGES + i] = c * x - s * y, s * x + c * y
            m[FX + 4 * STAGES + i], m[FX + 5 * STAGES + i] = m[LAST_UNKNOWNS + 4], m[LAST_UNKNOWNS + 5]
    else:
        one, two, three = 1.0, 0.0, 0.0
        if turns == 2.0:
            one, two = 2.0, -1.0
        elif turns > 2.0:
            one, two, three = 3.0, -3.0, 1.0
        for p in range(N_UNKNOWNS):
            for i in range(STAGES):
                m[FX + p * STAGES + i] = one * first[p, i] + two * second[p, i] + three * third[p, i]
    _turn_unknowns(m, nx, ny)


@kernel
def _keep(m, rolling, nx, ny):
    """Keep the unknowns of a step, as seen from the contact normal at its start, and those of its last node."""
    place, last = int(m[PLACE]), STAGES - 1
    _turn_unknowns(m, nx, -ny)
    rolling.history[2, place] = rolling.history[1, place]
    rolling.history[1, place] = rolling.history[0, place]
    rolling.history[0, place] = m[FX : FX + N_UNKNOWNS * STAGES].reshape((N_UNKNOWNS, STAGES))
    # From the normal at the start to that at the end.
    Fx, Fy = m[FX + last], m[FX + STAGES + last]
    Fn, Ft = m[FN + last], m[FT + last]
    size = Fn * Fn + Ft * Ft
    c, s = -(Fx * Fn + Fy * Ft) / size, (Fx * Ft - Fy * Fn) / size
    for p in range(0, 4, 2):
        x, y = m[FX + p * STAGES + last], m[FX + (p + 1) * STAGES + last]
        m[LAST_UNKNOWNS + p], m[LAST_UNKNOWNS + p + 1] = c * x + s * y, -s * x + c * y
    m[LAST_UNKNOWNS + 4], m[LAST_UNKNOWNS + 5] = m[FX + 4 * STAGES + last], m[FX + 5 * STAGES + last]


@kernel
def _coarsen(constants, inputs, memory, rolling, places):
    """Go over to fewer steps a turn; predictions by the polynomials of the last turn."""
    before, h = int(memory[PLACES]), memory[STEP_S]
    old = rolling.history[1]
    old[:before] = rolling.history[0, :before]
    # The turn as the contact has really taken.
    _set_places(constants, inputs, memory, rolling, places, 1)
    ratio, rate, weights = before / places, memory[WHIRL_RATE], np.empty(STAGES + 1)
    for place in range(places):
        for i in range(STAGES):
            at = (place + NODES[i]) * ratio
            source = min(int(at), before - 1)
            interpolation(False, at - source, weights)
            angle = rate * h * (source - place * ratio)
            c, s = math.cos(angle), math.sin(angle)
            for p in range(N_UNKNOWNS):
                total = 0.0
                for j in range(STAGES):
                    total += weights[j + 1] * old[source, p, j]
                rolling.history[0, place, p, i] = total
            for p in range(0, 4, 2):
                x, y = rolling.history[0, place, p, i], rolling.history[0, place, p + 1, i]
                rolling.history[0, place, p, i], rolling.history[0, place, p + 1, i] = c * x - s * y, s * x + c * y


@kernel
def _choose_places(constants, inputs, memory, rolling):
    """At the end of a turn, as many steps for the next as its estimate asks for; returns whether there are as many."""
    places, worst, wanted = memory[PLACES], memory[WORST], memory[PLACES]
    if worst > 1.0:
        return _refine(constants, inputs, memory, rolling)
    for fewer in _LADDER:
        if 0.5 * places <= fewer < wanted and worst * (places / fewer) ** _ORDER < _SPARE:
            wanted = fewer
    if wanted < places:
        _coarsen(constants, inputs, memory, rolling, int(wanted))
    memory[WORST] = 0.0
    return True


@kernel
def _refine(constants, inputs, memory, rolling):
    """Go over to more steps a turn; returns False where there are no more."""
    for places in _LADDER:
        if places > memory[PLACES]:
            _set_places(constants, inputs, memory, rolling, places, 0)
            return True
    return False


@kernel
def next_step(constants, inputs, memory, rolling):
    """Take the next step of rolling by collocation, from the last node on.

    Returns:
        False where none is taken: a series has to continue from the state in the first row of Y.
    """
    Y, tolerance, tick_s = rolling.Y, memory[TOLERANCE] / SHARE, memory[INPUTS]
    fill(Y[0], Y[STAGES])
    memory[TICK], memory[FRACTION] = memory[END_TICK], memory[END_FRACTION]
    nx, ny, _ = _normal_and_rate(constants, Y[0])
    if memory[PLACE] == 0.0:
        if memory[TURNS] > 0.0:
            # The turn as the contact takes it.
            behind = math.atan2(
                ny * memory[NORMAL_X] - nx * memory[NORMAL_Y], nx * memory[NORMAL_X] + ny * memory[NORMAL_Y]
            )
            turn_s = memory[PLACES] * memory[STEP_S]
            memory[WHIRL_RATE] = (math.copysign(2.0 * math.pi, memory[WHIRL_RATE]) + behind) / turn_s
            if not _choose_places(constants, inputs, memory, rolling):
                return False
        memory[NORMAL_X], memory[NORMAL_Y] = nx, ny
    goal = min(max(_ITERATED * tolerance, 1e-10), 1e-5)
    limit = math.sqrt(tolerance / _STATE_GAIN)
    while True:
        h = memory[STEP_S]
        if _hammer_within(inputs, memory[TICK], memory[FRACTION], h / tick_s):
            return False
        _predict(memory, rolling, nx, ny)
        place, made = int(memory[PLACE]), memory[TURNS] > 0.0
        iterations = solve_step(constants, inputs, memory, rolling, h, place, made, goal)
        memory[EVALUATIONS] += STAGES * max(iterations, 1)
        if iterations > 0:
            worst = estimate(memory) / limit
            if worst < _REJECTED:
                break
        if not _refine(constants, inputs, memory, rolling):
            return False
        memory[NORMAL_X], memory[NORMAL_Y] = nx, ny
    if memory[PLACES] == MAX_PLACES and worst > 1.0:
        return False
    write_nodes(constants, inputs, memory, h)
    if not keeps_rolling(constants, memory):
        return False
    memory[WORST] = max(memory[WORST], worst)
    _keep(memory, rolling, nx, ny)
    _finish(memory, h)
    return True


@kernel
def _finish(memory, h):
    """Count a step and go on to the next place."""
    tick_s, at = memory[INPUTS], 0.0
    for i in range(STAGES):
        note_force(memory, memory[FN + i], (NODES[i] - at) * h / tick_s)
        at = NODES[i]
    memory[STEPS] += 1.0
    memory[CONTACT_STEPS] += 1.0
    memory[ROLLING_STEPS] += 1.0
    memory[ROLLING_S] += h
    memory[PLACE] += 1.0
    if memory[PLACE] == memory[PLACES]:
        memory[PLACE], memory[TURNS] = 0.0, min(memory[TURNS] + 1.0, 3.0)
    ticks = memory[FRACTION] + h / tick_s
    whole = math.floor(ticks)
    memory[END_TICK], memory[END_FRACTION], memory[SPAN] = memory[TICK] + whole, ticks - whole, h


@kernel
def leave_rolling(constants, memory, rolling, y):
    """Leave collocation: the state that a series has to continue from, into y."""
    memory[PLACES], memory[SPAN] = 0.0, -1.0
    fill(y, rolling.Y[0])
    _wait(constants, memory, y, memory[END_TICK])


@kernel
def write_rolling_rows(constants, inputs, memory, Y, dy, out, y, grid, row, rows):
    """As `rig.engines.taylor.march.write_rows`, of the step at hand."""
    first, every, end = grid
    now, weights = min(first + row * every, end), np.empty(STAGES + 1)
    phase = int(memory[PHASE])
    while holds(memory, now, 0.0):
        part = ((now - memory[TICK]) - memory[FRACTION]) * memory[INPUTS] / memory[SPAN]
        interpolation(True, min(max(part, 0.0), 1.0), weights)
        y[: S.N_VECTOR] = 0.0
        for i in range(STAGES + 1):
            weight = weights[i]
            for k in range(S.N_VECTOR):
                y[k] += weight * Y[i, k]
        if row < len(rows):
            rates(constants, inputs, now, 0.0, memory[ONSET], phase, True, y, dy, out)
            fill(rows[row, : S.N_VECTOR], y)
            fill(rows[row, S.N_VECTOR :], out)
        row += 1
        if now == end:
            break
        now = min(first + row * every, end)
    return row
