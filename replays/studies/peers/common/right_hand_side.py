"""Compiled right-hand side of the rig for other authors' solvers, with its numbers in one C struct.

`rig.physics.kernels.dynamics.evaluate` is called for the 14 states alone. Its ledger goes to the stack, where the
compiler drops most of it. The switching functions for a solver's event location, and the changes of phase, are here
too. All machine code of the kernels is in this one file, because numba's cache checks no other.
"""

from __future__ import annotations

import functools
import time
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, cfunc, extending, from_dtype, njit, types
from numba.core import cgutils

from replays.studies.peers.common.problem import Problem
from rig.physics.kernels import signals as S
from rig.physics.kernels.constants import Constants, Inputs
from rig.physics.kernels.dynamics import evaluate
from rig.physics.kernels.frames.geometry import gap
from rig.physics.kernels.laws.contact import BACKWARD, EXACT, FLIGHT, FORWARD, ROLLING, TOUCHING, floor_onset_speed
from rig.physics.kernels.records import as_tuple, struct_dtype

N_STATE, N_VECTOR, N_OBSERVED = S.N_STATE, S.N_VECTOR, S.N_OBSERVED
N_SWITCH = 2
"""Number of switching functions: the gap, and the friction's (v_t in sliding, the margin below mu F_n in rolling)."""
STATE_SCALE = S.STATE_SCALE
_DIFFERENCE = 1.5e-8
"""Relative increment of differences: the root of the rounding unit."""

PARAMETERS = np.dtype(
    [
        ("constants", struct_dtype(Constants)),
        ("inputs", struct_dtype(Inputs)),
        ("phase", np.int64),
        ("onset_speed", np.float64),
        ("evaluations", np.int64),
        # Offset of the data address in CVODE's vectors, in words of 8 bytes.
        ("vector_word", np.int64),
    ],
    align=True,
)
"""Struct of the problem's numbers, followed by those that change during a solve."""


def pack(problem: Problem) -> np.ndarray:
    """Return the struct of a problem, shape (1,). Each solve needs its own, as the phase changes in place."""
    parameters = np.zeros(1, PARAMETERS)
    parameters[0] = (as_tuple(problem.constants), as_tuple(problem.inputs), problem.phase, problem.onset_speed, 0, 0)
    return parameters


def _stack_code(context, count):
    """Reserve `count` floats on the stack: without an allocation, the compiler can remove an array."""
    if not isinstance(count, types.IntegerLiteral):
        return None  # numba then tries the literal type
    size = count.literal_value

    def code(context, builder, signature, arguments):
        return cgutils.alloca_once(builder, ir.DoubleType(), size=size)

    return types.CPointer(types.float64)(count), code


def _pointer_code(context, address):
    """Convert an address to a pointer to floats."""

    def code(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], ir.DoubleType().as_pointer())

    return types.CPointer(types.float64)(address), code


def _word_code(context, address, index):
    """Load the word of 8 bytes at an address plus `index` words."""

    def code(context, builder, signature, arguments):
        words = builder.inttoptr(arguments[0], ir.IntType(64).as_pointer())
        return builder.load(builder.gep(words, [arguments[1]]))

    return types.int64(address, index), code


# numba calls these with values; the type checker sees the code generators.
_stack: Any = extending.intrinsic(_stack_code)
_pointer: Any = extending.intrinsic(_pointer_code)
_word: Any = extending.intrinsic(_word_code)


@njit(cache=True, forceinline=True)
def _rates(t, y, p, f):
    p.evaluations += 1
    dy = carray(_stack(N_VECTOR), (N_VECTOR,))
    out = carray(_stack(N_OBSERVED), (N_OBSERVED,))
    evaluate(p.constants, p.inputs, 0, t / p.inputs.tick_s, p.onset_speed, p.phase, False, y, dy, out)
    for i in range(N_STATE):
        f[i] = dy[i]


@njit(cache=True, forceinline=True)
def _rates_by_gap_sign(t, y, p, f):
    phase = p.phase
    p.phase = TOUCHING if gap(p.constants, y)[0] > 0.0 else FLIGHT
    _rates(t, y, p, f)
    p.phase = phase


@njit(cache=True)
def contact_at(t, y, p, phase):
    """Return penetration [m], its rate, sliding speed [m/s], normal and friction force [N] in a phase."""
    dy = carray(_stack(N_VECTOR), (N_VECTOR,))
    out = carray(_stack(N_OBSERVED), (N_OBSERVED,))
    evaluate(p.constants, p.inputs, 0, t / p.inputs.tick_s, p.onset_speed, phase, False, y, dy, out)
    return (
        out[S.PENETRATION],
        out[S.PENETRATION_RATE],
        out[S.SLIDING_SPEED],
        out[S.NORMAL_FORCE],
        out[S.FRICTION_FORCE],
    )


@njit(cache=True, forceinline=True)
def _switches(t, y, p, g):
    g[1] = 1.0
    if p.phase == FLIGHT:
        g[0] = -gap(p.constants, y)[0]
    elif p.phase == TOUCHING:
        g[0] = gap(p.constants, y)[0]
    else:
        penetration, _, sliding, normal, tangential = contact_at(t, y, p, p.phase)
        g[0] = penetration
        if p.phase == FORWARD:
            g[1] = sliding
        elif p.phase == BACKWARD:
            g[1] = -sliding
        else:
            g[1] = p.constants.contact.friction * normal - abs(tangential)


@njit(cache=True)
def derivative(t, y, parameters):
    """Return the rates of the 14 states at `t` [s] from the window's start, in the struct's phase."""
    f = np.empty(N_STATE)
    _rates(t, y, parameters[0], f)
    return f


@njit(cache=True)
def jacobian(t, y, parameters):
    """Return the derivatives of the rates by the states, by differences, shape (14, 14)."""
    slopes = np.empty((N_STATE, N_STATE))
    here, moved = derivative(t, y, parameters), y.copy()
    for i in range(N_STATE):
        moved[i] = y[i] + _DIFFERENCE * max(abs(y[i]), STATE_SCALE[i])
        slopes[:, i] = (derivative(t, moved, parameters) - here) / (moved[i] - y[i])
        moved[i] = y[i]
    return slopes


@njit(cache=True)
def derivative_by_gap_sign(t, y, parameters):
    """Return the rates for solvers without events, in the phase given by the sign of the gap."""
    f = np.empty(N_STATE)
    _rates_by_gap_sign(t, y, parameters[0], f)
    return f


@njit(cache=True)
def switching(t, y, parameters):
    """Return the switching functions, shape (N_SWITCH,): positive within the phase, which ends where one falls to 0."""
    g = np.empty(N_SWITCH)
    _switches(t, y, parameters[0], g)
    return g


@njit(cache=True)
def follow_gap_sign(t, y, parameters):
    """Set the phase by the sign of the gap, for solvers without events.

    v0 is latched at the end of the step in which the sign changes, not where the contact starts: the known error of
    this method.

    Returns:
        True if a contact started since the last call.
    """
    p = parameters[0]
    depth, rate = gap(p.constants, y)
    began = depth > 0.0 and p.phase == FLIGHT
    if began:
        p.onset_speed = floor_onset_speed(rate, p.constants.contact)
        p.phase = TOUCHING
    elif depth <= 0.0:
        p.phase = FLIGHT
    return began


@njit(cache=True)
def change_phase(t, y, parameters, which):
    """Set the phase after a zero of a switching function; an onset latches v0 at the located instant.

    Returns:
        True if a contact started.
    """
    p = parameters[0]
    before = p.phase
    if which == 0 and before != FLIGHT:
        p.phase = FLIGHT
        return False
    if which == 0:
        _, rate, sliding, _, _ = contact_at(t, y, p, FLIGHT)
        p.onset_speed = floor_onset_speed(rate, p.constants.contact)
        p.phase = TOUCHING
        if p.constants.levels.friction == EXACT:
            if sliding == 0.0:
                # Without sliding, the required friction determines the direction.
                needed = contact_at(t, y, p, ROLLING)[4]
                p.phase = ROLLING if needed == 0.0 else FORWARD if needed > 0.0 else BACKWARD
            else:
                p.phase = FORWARD if sliding > 0.0 else BACKWARD
        return True
    # Sliding has stopped, or rolling requires more friction than mu F_n.
    _, _, _, normal, needed = contact_at(t, y, p, ROLLING)
    if before != ROLLING and abs(needed) <= p.constants.contact.friction * normal:
        p.phase = ROLLING
    else:
        p.phase = FORWARD if needed > 0.0 else BACKWARD
    return False


def _vector_rates(t, y, ydot, user_data):
    """Evaluate the right-hand side with CVODE's signature CVRhsFn(t, y, ydot, user_data) -> 0."""
    p = carray(user_data, (1,), PARAMETERS)[0]
    _rates(t, _numbers(y, p.vector_word), p, _numbers(ydot, p.vector_word))
    return 0


def _vector_rates_by_sign(t, y, ydot, user_data):
    p = carray(user_data, (1,), PARAMETERS)[0]
    _rates_by_gap_sign(t, _numbers(y, p.vector_word), p, _numbers(ydot, p.vector_word))
    return 0


def _vector_switches(t, y, g, user_data):
    """Evaluate the switching functions with CVODE's signature CVRootFn(t, y, gout, user_data) -> 0."""
    p = carray(user_data, (1,), PARAMETERS)[0]
    _switches(t, _numbers(y, p.vector_word), p, carray(g, (N_SWITCH,), np.float64))
    return 0


@njit(cache=True, forceinline=True)
def _numbers(vector, word):
    # N_Vector -> its content -> {length, own_data, data}.
    content = carray(vector, (1,), np.int64)[0]
    data = _word(content, word)
    return carray(_pointer(data), (N_STATE,))


@functools.cache
def compile_s() -> float:
    """Compile the functions called from Python, or load them from numba's cache.

    Returns:
        Time of the first call [s].
    """
    begin = time.perf_counter()
    vector, struct = types.float64[::1], from_dtype(PARAMETERS)[::1]
    state_only: list[Any] = [derivative, jacobian, derivative_by_gap_sign, switching, follow_gap_sign]
    for function in state_only:
        function.compile((types.float64, vector, struct))
    take: Any = change_phase
    take.compile((types.float64, vector, struct, types.int64))
    return time.perf_counter() - begin


@functools.cache
def vector_callbacks() -> tuple[Any, Any, Any]:
    """Return rates, switching functions, and rates by the gap's sign as C functions for CVODE.

    The first call compiles them, or loads them from numba's cache. `.address` is the address of a function.
    """
    c_function = types.intc(types.double, types.voidptr, types.voidptr, types.voidptr)
    compiled = cfunc(c_function, cache=True)
    return compiled(_vector_rates), compiled(_vector_switches), compiled(_vector_rates_by_sign)
