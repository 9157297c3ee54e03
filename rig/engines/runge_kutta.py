"""Explicit Runge-Kutta on a fixed step grid, divided inside a step where it has to be.

The methods are the tableaus of `rk4` and `rk8`. Only what happens inside a step varies, by rules on the state alone:

- A step in which the shaft meets or leaves the ring is cut at the crossing, found on the cubic Hermite interpolant of
  the gap. The impact speed is latched there, not at the end of the step: that alone would cap the accuracy at about
  3e-3. Since the force starts and ends as t^1.5, the cut step is taken in parts that shrink toward the crossing, and
  the contact steps next to it in equal parts; without that the order drops to 2.5.
- A step whose error estimate is above the tableau's tolerance is taken again in as many parts as the estimate asks for.

The integrals of the ledger are part of the integrated vector: they share the quadrature.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from rig.kernels import signals as S
from rig.kernels.dynamics import evaluate, gap

ONSET, CONTACTS, CLAMPS, PEAK_FORCE, CONTACT_STEPS, FLOORED, STEPS, TOUCHING, DIVIDED = range(9)
MEMORY = 9
"""Impact speed of the running contact [m/s]; contacts begun; steps at whose start the law would have pulled; largest
normal force [N]; steps in contact; onsets below the speed floor; steps taken; 1 in contact; steps taken in parts."""

SCALES = np.array([5e-3, 5e-3, 1.0, 20e-6, 20e-6, 20e-6, 20e-6, 1.0, 1.0, 40.0, 0.04, 0.04, 0.04, 0.04])
"""What counts as 1 in each state when errors are added up: 5 mrad, 1 rad of spin, 20 um, 1 and 40 rad/s, 40 mm/s."""
_PER_SCALE = 1.0 / SCALES

_GRADING = np.array([1, 1, 1, 1, 2, 2, 4, 4, 8, 8, 16, 16]) / 64
"""Parts of a cut step behind its crossing, fine to coarse."""
_NEAR = 4.0
"""A contact step within so many steps of a crossing is divided, ..."""
_NEAR_PARTS = 8
"""... into so many parts."""
_MOST_PARTS = 16
_LANDING = 1e-15
"""Gap at which an onset counts as located [m]."""


class Tableau(NamedTuple):
    """An explicit Runge-Kutta method of s stages, with its error estimate."""

    a: np.ndarray  # (s, s)
    b: np.ndarray  # (s,)
    c: np.ndarray  # (s,)
    coarse: np.ndarray  # (s + 1,) weights of a lower-order estimate, the last for the rates at the end
    fine: np.ndarray  # (s + 1,) weights of a higher-order estimate
    order: float  # of the estimate
    tolerance: float  # scaled error a step; infinite: never estimated


@njit(cache=True)
def _step(tableau, constants, inputs, tick, fraction, ticks, onset_speed, touching, y, k, z, end, out):
    """One Runge-Kutta step of `ticks` (any part of a tick) from `y`, whose rates are in k[0], to `end`."""
    a, b, c = tableau.a, tableau.b, tableau.c
    h = ticks * inputs.tick_s
    for stage in range(1, len(b)):
        for i in range(S.N_STATE):
            z[i] = 0.0
        for j in range(stage):
            weight = h * a[stage, j]
            if weight != 0.0:
                for i in range(S.N_STATE):
                    z[i] += weight * k[j, i]
        for i in range(S.N_STATE):
            z[i] += y[i]
        evaluate(constants, inputs, tick, fraction + c[stage] * ticks, onset_speed, touching, False, z, k[stage], out)
    for i in range(S.N_VECTOR):
        z[i] = 0.0
    for stage in range(len(b)):
        weight = h * b[stage]
        if weight != 0.0:
            for i in range(S.N_VECTOR):
                z[i] += weight * k[stage, i]
    for i in range(S.N_VECTOR):
        end[i] = y[i] + z[i]


@njit(cache=True)
def _parts_wanted(tableau, h, k, scratch):
    """Into how many parts a step should have been divided, by its error estimate (Hairer's form for two estimates)."""
    low, high = scratch[0], scratch[1]
    low[:] = 0.0
    high[:] = 0.0
    for stage in range(len(k)):
        weight, other = tableau.coarse[stage], tableau.fine[stage]
        if weight != 0.0 or other != 0.0:
            for i in range(S.N_STATE):
                low[i] += weight * k[stage, i]
                high[i] += other * k[stage, i]
    coarse = 0.0
    fine = 0.0
    for i in range(S.N_STATE):
        coarse += (low[i] * _PER_SCALE[i]) ** 2
        fine += (high[i] * _PER_SCALE[i]) ** 2
    if fine == 0.0:
        return 1
    error = h * fine / np.sqrt((fine + 0.01 * coarse) * S.N_STATE)
    if error <= tableau.tolerance:
        return 1
    return min(_MOST_PARTS, int(np.ceil((error / tableau.tolerance) ** (1.0 / tableau.order))))


@njit(cache=True)
def _divided_step(tableau, constants, inputs, tick, ticks, parts, onset_speed, touching, y, k, z, end, out):
    """One step in equal parts, from `y` to `end`."""
    part = ticks / parts
    end[:] = y
    for n in range(parts):
        if n > 0:
            evaluate(constants, inputs, tick, n * part, onset_speed, touching, False, end, k[0], out)
        _step(tableau, constants, inputs, tick, n * part, part, onset_speed, touching, end, k, z, end, out)


@njit(cache=True)
def _crossing(d0, rate0, d1, rate1, h):
    """Part of a step at which the gap crosses zero, on the gap's cubic Hermite interpolant.

    Args:
        d0: Penetration at the start [m].
        rate0: Its rate [m/s].
        d1: Penetration at the end [m], of the opposite sign.
        rate1: Its rate [m/s].
        h: Length of the step [s].
    """
    low, high = 0.0, 1.0
    # Bisection guards Newton: the bracket always holds the crossing.
    s = d0 / (d0 - d1)
    for _ in range(60):
        s2 = s * s
        value = (
            d0 * (1.0 + s2 * (2.0 * s - 3.0))
            + h * rate0 * s * (1.0 - s) * (1.0 - s)
            + d1 * s2 * (3.0 - 2.0 * s)
            + h * rate1 * s2 * (s - 1.0)
        )
        if (value > 0.0) == (d0 > 0.0):
            low = s
        else:
            high = s
        slope = (
            6.0 * s * (s - 1.0) * (d0 - d1) + h * rate0 * (1.0 - s) * (1.0 - 3.0 * s) + h * rate1 * s * (3.0 * s - 2.0)
        )
        new = s - value / slope if slope != 0.0 else 0.5 * (low + high)
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - s) < 1e-15:
            return new
        s = new
    return s


@njit(cache=True)
def _cut_step(tableau, constants, inputs, tick, ticks, memory, y, k, z, end, out):
    """One step in which contact begins or ends, cut at the crossing.

    Entered with the end of the uncut trial step in `end`, which only tells where to cut; the parts are then
    integrated anew. Leaves the end of the step in `y` and `memory`.
    """
    d0, rate0 = gap(constants, y)
    d1, rate1 = gap(constants, end)
    cut = _crossing(d0, rate0, d1, rate1, ticks * inputs.tick_s)
    n = len(_GRADING)
    fraction = 0.0
    if memory[TOUCHING] == 0.0:
        evaluate(constants, inputs, tick, fraction, memory[ONSET], False, False, y, k[0], out)
        # The interpolant is of order 4 only: Newton on the flight itself puts right the cut and the impact speed.
        speed = rate0
        for _ in range(3):
            _step(tableau, constants, inputs, tick, fraction, cut * ticks, memory[ONSET], False, y, k, z, end, out)
            miss, speed = gap(constants, end)
            if abs(miss) < _LANDING or speed <= 0.0:
                break
            cut = min(max(cut - miss / (speed * ticks * inputs.tick_s), 0.0), 1.0)
        y[:] = end
        fraction = cut * ticks
        floor = constants.contact.speed_floor
        memory[CONTACTS] += 1.0
        if speed < floor:
            memory[FLOORED] += 1.0
        memory[ONSET] = max(speed, floor)
        memory[TOUCHING] = 1.0
        for part in range(n):
            size = _GRADING[part] * (1.0 - cut) * ticks
            evaluate(constants, inputs, tick, fraction, memory[ONSET], True, False, y, k[0], out)
            _step(tableau, constants, inputs, tick, fraction, size, memory[ONSET], True, y, k, z, y, out)
            fraction += size
        # A contact shorter than the rest of its first step has ended already.
        if gap(constants, y)[0] <= 0.0:
            memory[TOUCHING] = 0.0
    else:
        for part in range(n):
            size = _GRADING[n - 1 - part] * cut * ticks
            evaluate(constants, inputs, tick, fraction, memory[ONSET], True, False, y, k[0], out)
            _step(tableau, constants, inputs, tick, fraction, size, memory[ONSET], True, y, k, z, y, out)
            fraction += size
        memory[TOUCHING] = 0.0
        evaluate(constants, inputs, tick, fraction, memory[ONSET], False, False, y, k[0], out)
        _step(tableau, constants, inputs, tick, fraction, ticks - fraction, memory[ONSET], False, y, k, z, y, out)
        # Left and met again within one step: the same contact goes on.
        if gap(constants, y)[0] > 0.0:
            memory[TOUCHING] = 1.0


@njit(cache=True)
def start(constants, inputs, y, memory):
    """Prepare the memory for a state: a state that begins in contact holds the floored impact speed."""
    memory[:] = 0.0
    memory[ONSET] = constants.contact.speed_floor
    memory[TOUCHING] = 1.0 if gap(constants, y)[0] > 0.0 else 0.0


@njit(cache=True, nogil=True)
def advance(tableau, constants, inputs, y, memory, tick, step_ticks, steps, stride, rows):
    """Take `steps` steps in place and write every `stride`-th instant's row (see `rig.engines`).

    Args:
        tableau: The method.
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
    stages = len(tableau.b)
    k = np.zeros((stages + 1, S.N_VECTOR))
    estimates = tableau.tolerance < np.inf
    scratch = np.empty((2, S.N_STATE))
    z = np.empty(S.N_VECTOR)
    end = np.empty(S.N_VECTOR)
    out = np.empty(S.N_OBSERVED)
    ticks = float(step_ticks)
    h = ticks * inputs.tick_s
    row = 0
    touching = memory[TOUCHING] == 1.0
    evaluate(constants, inputs, tick, 0.0, memory[ONSET], touching, True, y, k[0], out)
    for n in range(steps):
        now = tick + n * step_ticks
        if n % stride == 0:
            rows[row, : S.N_VECTOR] = y
            rows[row, S.N_VECTOR :] = out
            row += 1
        memory[STEPS] += 1.0
        parts = 1
        if touching:
            memory[CONTACT_STEPS] += 1.0
            memory[PEAK_FORCE] = max(memory[PEAK_FORCE], out[S.NORMAL_FORCE])
            if out[S.NORMAL_FORCE] == 0.0 and out[S.PENETRATION] > 0.0:
                memory[CLAMPS] += 1.0
            if out[S.PENETRATION] < _NEAR * h * abs(out[S.PENETRATION_RATE]):
                parts = _NEAR_PARTS
        if parts > 1:
            memory[DIVIDED] += 1.0
            _divided_step(tableau, constants, inputs, now, ticks, parts, memory[ONSET], touching, y, k, z, end, out)
        else:
            _step(tableau, constants, inputs, now, 0.0, ticks, memory[ONSET], touching, y, k, z, end, out)
        # The rates at the end are the next step's first, and tell whether contact began or ended on the way.
        observe = (n + 1) % stride == 0
        last = k[stages]
        evaluate(constants, inputs, now + step_ticks, 0.0, memory[ONSET], touching, observe, end, last, out)
        crossed = (out[S.PENETRATION] > 0.0) != touching
        if estimates and parts == 1 and not crossed:
            parts = _parts_wanted(tableau, h, k, scratch)
            if parts > 1:
                memory[DIVIDED] += 1.0
                evaluate(constants, inputs, now, 0.0, memory[ONSET], touching, False, y, k[0], out)
                _divided_step(tableau, constants, inputs, now, ticks, parts, memory[ONSET], touching, y, k, z, end, out)
                evaluate(constants, inputs, now + step_ticks, 0.0, memory[ONSET], touching, observe, end, last, out)
                crossed = (out[S.PENETRATION] > 0.0) != touching
        if crossed:
            _cut_step(tableau, constants, inputs, now, ticks, memory, y, k, z, end, out)
            touching = memory[TOUCHING] == 1.0
            evaluate(constants, inputs, now + step_ticks, 0.0, memory[ONSET], touching, observe, y, k[0], out)
        else:
            y[:] = end
            k[0] = last
