"""SUNDIALS CVODE (BDF and Adams), from the shared library that scikit-sundae brings.

Compiled: the library is driven through its C interface by a loop that is compiled as well, with the right-hand side
and the switching functions as C functions; no Python between start and end but for a look at the clock. As installed:
scikit-sundae's own interface with plain Python callbacks.

Either way CVODE locates each change of phase with its root finding, and is started anew there and at the hammer's
corners; v0 is latched at the located onset. Adams iterates by fixed point, BDF by Newton with a dense matrix that
CVODE makes by differences: its defaults. Compiled, BDF is tuned to this problem (`_TUNED`), and of Adams both are
there, tuned and by its defaults; as installed, nothing is.
"""

from __future__ import annotations

import ctypes
import functools
import time
from contextlib import ExitStack
from ctypes import byref, c_double, c_int, c_void_p
from importlib import import_module
from typing import Any

import numpy as np

from replays.studies.peers.common.problem import Problem
from replays.studies.peers.common.right_hand_side import (
    N_STATE,
    N_SWITCH,
    PARAMETERS,
    compile_s,
    follow_sign,
    pack,
    switching,
    take_switch,
    vector_callbacks,
)
from replays.studies.peers.common.solution import MISSED_HAMMER, PROPER, SWITCH_CEILING, Manner, Setting, Solution
from replays.studies.peers.plain_python import PlainPython
from rig.physics.kernels.signals import STATE_SCALE

ADAMS, BDF = 1, 2
ONE_STEP, ROOT_RETURN = 2, 2
_CHUNK = 5_000
"""Steps between two looks at the clock."""
_INSTANT = 1e-14
"""Less time than this [s] is none."""
_LATE = -1e-12
"""Penetration [m] of the wrong sign that tells of a change of phase that root finding has missed."""

_ANDERSON = 1
"""Earlier iterates that its fixed point looks back to."""
_TUNED: dict[int, tuple[tuple[str, float], ...]] = {
    ADAMS: (("CVodeSetNonlinConvCoef", 0.01), ("CVodeSetMaxNonlinIters", 5)),
    BDF: (("CVodeSetNonlinConvCoef", 0.03), ("CVodeSetLSetupFrequency", 40), ("CVodeSetJacEvalFrequency", 200)),
}
"""What is set otherwise than CVODE has it, by method; Adams has Anderson's acceleration, too.

Measured with exact friction, no scene chosen: time over that of CVODE's defaults at the same geometric mean error over
the scenes, from ladders of six tolerances.

    error                            1e-2  1e-3  1e-4  1e-5
    Adams, whirl, 12 restitutions    0.86  0.79  0.79  0.81
    Adams, transient, 24 of them     0.94  1.00  0.98  0.96
    Adams, 27 random scenes          0.97  1.02  1.04  0.98
    BDF, whirl                       0.83  0.86  0.87
    BDF, transient                   0.96  1.03  0.97  0.97
    BDF, random                      1.00  0.98  0.99  0.99

A coefficient of 0.01 alone is a loss for Adams at loose tolerances (1.95 in whirl): its three iterations no longer
suffice, and steps are rejected. Five of them without Anderson: 0.85 in the transient, but 1.32 in whirl at 1e-2.
Coefficients of 0.3, 0.03, 0.003 and 0.001 gain no more. Of BDF, orders below 5, the detection of its stability limit
and a coefficient of 0.01 lose. In a single scene chance moves an error more than any of this: in the chart's own
hammer scene it favours Adams' defaults (1e-3 to whirl in 15 ms, tuned in 18 to 27).
"""

_MESSAGES = {
    -2: "more accuracy asked than there is",
    -3: "error test failed too often",
    -4: "iteration did not converge",
    -8: "right-hand side failed",
    -12: "root finding failed",
}

# What the compiled loop keeps, by index.
_T, _CORNER, _SAMPLE, _ONSETS, _SWITCHES, _STEPS, _FLAG, _PULSE_SEEN = range(8)


@functools.cache
def _library() -> Any:
    """The C library with the signatures of what is called here.

    The extension module of scikit-sundae is linked with it, so its handle finds every symbol wherever a wheel has put
    the library itself.
    """
    library = ctypes.CDLL(import_module("sksundae._cy_cvode").__file__)
    address, real, integer = c_void_p, c_double, c_int
    signatures: dict[str, tuple[list[Any], Any]] = {
        "SUNContext_Create": ([integer, address], integer),
        "SUNContext_ClearErrHandlers": ([address], integer),
        "SUNContext_Free": ([address], integer),
        "N_VMake_Serial": ([integer, address, address], address),
        "N_VDestroy_Serial": ([address], None),
        "SUNDenseMatrix": ([integer, integer, address], address),
        "SUNMatDestroy": ([address], None),
        "SUNLinSol_Dense": ([address, address, address], address),
        "SUNLinSolFree": ([address], integer),
        "SUNNonlinSol_FixedPoint": ([address, integer, address], address),
        "SUNNonlinSolFree": ([address], integer),
        "CVodeCreate": ([integer, address], address),
        "CVodeFree": ([address], None),
        "CVodeInit": ([address, address, real, address], integer),
        "CVodeReInit": ([address, real, address], integer),
        "CVodeSVtolerances": ([address, real, address], integer),
        "CVodeSetUserData": ([address, address], integer),
        "CVodeSetLinearSolver": ([address, address, address], integer),
        "CVodeSetNonlinearSolver": ([address, address], integer),
        "CVodeSetStopTime": ([address, real], integer),
        "CVodeSetNonlinConvCoef": ([address, real], integer),
        "CVodeSetMaxNonlinIters": ([address, integer], integer),
        "CVodeSetLSetupFrequency": ([address, ctypes.c_long], integer),
        "CVodeSetJacEvalFrequency": ([address, ctypes.c_long], integer),
        "CVodeRootInit": ([address, integer, address], integer),
        "CVodeSetRootDirection": ([address, address], integer),
        "CVodeSetNoInactiveRootWarn": ([address], integer),
        "CVodeGetRootInfo": ([address, address], integer),
        "CVodeGetDky": ([address, real, integer, address], integer),
        "CVode": ([address, real, address, address, integer], integer),
    }
    for name, (arguments, result) in signatures.items():
        function = getattr(library, name)
        function.argtypes, function.restype = arguments, result
    return library


@functools.cache
def _loop() -> tuple[Any, float]:
    """The compiled loop, and what compiling took [s]. It holds addresses of the library, so it is not cached."""
    from numba import boolean, from_dtype, njit, types

    begin = time.perf_counter()
    compile_s()
    vector_callbacks()
    library = _library()
    step, restart, stop_at = library.CVode, library.CVodeReInit, library.CVodeSetStopTime
    root_info, interpolate = library.CVodeGetRootInfo, library.CVodeGetDky
    number, vector, table = types.int64, types.float64[::1], types.float64[:, ::1]

    @njit(
        boolean(*[number, number, vector, number, vector], from_dtype(PARAMETERS)[::1], *[vector] * 3, table, table,
                vector, boolean)
    )  # fmt: skip
    def run(memory, place, y, spare_place, spare, parameters, times, corners, pulse, states, onsets, now, events):
        """Go on until the last corner, a failure, or enough work to look at the clock; whether it is done.

        One step a call of CVODE, and the samples from its history: asked for samples instead, CVODE would choose the
        first step after a restart by the distance to the next one.
        """
        t = np.empty(1)
        found = np.zeros(N_SWITCH, np.int32)
        sample = int(now[_SAMPLE])
        for _ in range(_CHUNK):
            end = corners[int(now[_CORNER])]
            flag = step(memory, end, place, t.ctypes, ONE_STEP)
            now[_FLAG] = flag
            if flag < 0:
                return True
            now[_T] = t[0]
            now[_STEPS] += 1
            if pulse[0] < t[0] < pulse[1]:
                now[_PULSE_SEEN] = 1.0
            sampled = False
            while sample < len(times) and times[sample] <= t[0]:
                sampled = True
                interpolate(memory, times[sample], 0, spare_place)
                states[sample] = spare
                sample += 1
            now[_SAMPLE] = sample
            which = -1
            began = False
            if not events:
                began = follow_sign(t[0], y, parameters)
            elif flag == ROOT_RETURN:
                root_info(memory, found.ctypes)
                which = 0 if found[0] != 0 else 1
            elif sampled and switching(t[0], y, parameters)[0] < _LATE:
                which = 0
            if which >= 0:
                now[_SWITCHES] += 1
                began = take_switch(t[0], y, parameters, which)
            if began:
                if now[_ONSETS] < len(onsets):
                    onsets[int(now[_ONSETS]), 0] = t[0]
                    onsets[int(now[_ONSETS]), 1] = parameters[0].onset_speed
                now[_ONSETS] += 1
            # CVODE refuses a first step as short as rounding; nothing moves in it.
            at_corner = t[0] > end - _INSTANT
            if at_corner:
                now[_CORNER] += 1
                if now[_CORNER] == len(corners):
                    states[sample:] = y
                    return True
            if at_corner or which >= 0:
                restart(memory, t[0], place)
                stop_at(memory, corners[int(now[_CORNER])])
        return False

    return run, time.perf_counter() - begin


def solve(
    problem: Problem, *, setting: Setting, budget_s: float, method: int, manner: Manner = PROPER, tuned: bool = True
) -> Solution:
    """Solve a problem by CVODE.

    Args:
        problem: The problem.
        setting: Tolerances.
        budget_s: Wall time allowed [s].
        method: ADAMS or BDF.
        manner: How it is driven.
        tuned: Whether it iterates as suits this problem (`_TUNED`), or as CVODE does by itself.
    """
    if manner.plain:
        return _solve_plain(problem, setting=setting, budget_s=budget_s, method=method)
    if not manner.events and problem.exact_friction:
        raise NotImplementedError("exact friction needs events")
    run, compiling_s = _loop()
    library = _library()
    parameters = pack(problem)
    pulse = problem.pulse
    corners = np.array([*(problem.corners if manner.stops else ()), problem.duration_s])
    onsets = np.empty((SWITCH_CEILING, 2))
    now = np.zeros(8)
    now[_SAMPLE] = 1.0

    solution = Solution(problem.times, budget_s, compiling_s)
    solution.states[0] = problem.y0
    with ExitStack() as stack:
        session = _Session(
            library, problem, parameters, setting, method=method, events=manner.events, tuned=tuned, stack=stack
        )
        library.CVodeSetStopTime(session.memory, corners[0])
        done = False
        while not done:
            done = run(
                session.memory, session.place, session.y, session.spare_place, session.spare, parameters, problem.times,
                corners, np.array(pulse or (0.0, 0.0)), solution.states, onsets, now, manner.events,
            )  # fmt: skip
            solution.steps, solution.switches = int(now[_STEPS]), int(now[_SWITCHES])
            done = done or solution.overrun()
    flag = int(now[_FLAG])
    if solution.failure is None and flag < 0:
        solution.failure = f"CVODE gave up at {now[_T]:.6g} s: {_MESSAGES.get(flag, f'flag {flag}')}"
    if solution.failure is None and not manner.stops and pulse is not None and now[_PULSE_SEEN] == 0.0:
        solution.failure = MISSED_HAMMER
    solution.onsets = [(float(t), float(speed)) for t, speed in onsets[: int(now[_ONSETS])]]
    solution.evaluations = int(parameters[0]["evaluations"])
    return solution.close()


class _Session:
    """One solver of the library, freed with the stack that it is given.

    Attributes:
        memory: Address of the solver.
        place: Address of the vector that it works on, whose numbers are `y`.
        y: State, shape (14,).
        spare_place: Address of another vector, whose numbers are `spare`.
        spare: Shape (14,).
    """

    def __init__(
        self,
        library: Any,
        problem: Problem,
        parameters: np.ndarray,
        setting: Setting,
        *,
        method: int,
        events: bool,
        tuned: bool,
        stack: ExitStack,
    ) -> None:
        rates, switches, rates_by_sign = vector_callbacks()
        holder = c_void_p()
        _check("SUNContext_Create", library.SUNContext_Create(0, byref(holder)))
        stack.callback(library.SUNContext_Free, byref(holder))
        context = holder.value
        library.SUNContext_ClearErrHandlers(context)

        self.y, self.spare = problem.y0.copy(), np.empty(N_STATE)
        tolerances = setting.tolerance * STATE_SCALE if setting.absolute is None else np.full(N_STATE, setting.absolute)

        def vector(numbers: np.ndarray) -> int:
            made = library.N_VMake_Serial(N_STATE, numbers.ctypes.data, context)
            stack.callback(library.N_VDestroy_Serial, made)
            return made

        self.place, self.spare_place, absolute = vector(self.y), vector(self.spare), vector(tolerances)
        parameters[0]["vector_word"] = _vector_word(self.place, self.y)
        self.memory = library.CVodeCreate(method, context)
        memory_holder = c_void_p(self.memory)
        stack.callback(library.CVodeFree, byref(memory_holder))
        callback = rates if events else rates_by_sign
        _check("CVodeInit", library.CVodeInit(self.memory, callback.address, 0.0, self.place))
        _check("CVodeSVtolerances", library.CVodeSVtolerances(self.memory, setting.tolerance, absolute))
        _check("CVodeSetUserData", library.CVodeSetUserData(self.memory, parameters.ctypes.data))
        if method == ADAMS:
            iteration = library.SUNNonlinSol_FixedPoint(self.place, _ANDERSON if tuned else 0, context)
            stack.callback(library.SUNNonlinSolFree, iteration)
            _check("CVodeSetNonlinearSolver", library.CVodeSetNonlinearSolver(self.memory, iteration))
        else:
            matrix = library.SUNDenseMatrix(N_STATE, N_STATE, context)
            stack.callback(library.SUNMatDestroy, matrix)
            linear = library.SUNLinSol_Dense(self.place, matrix, context)
            stack.callback(library.SUNLinSolFree, linear)
            _check("CVodeSetLinearSolver", library.CVodeSetLinearSolver(self.memory, linear, matrix))
        for name, value in _TUNED[method] if tuned else ():
            _check(name, getattr(library, name)(self.memory, value))
        if events:
            _check("CVodeRootInit", library.CVodeRootInit(self.memory, N_SWITCH, switches.address))
            falling = np.full(N_SWITCH, -1, np.int32)
            _check("CVodeSetRootDirection", library.CVodeSetRootDirection(self.memory, falling.ctypes.data))
            library.CVodeSetNoInactiveRootWarn(self.memory)


def _vector_word(place: int, numbers: np.ndarray) -> int:
    """Where a vector's content keeps the address of its numbers, in words: an index of 4 or of 8 bytes comes first."""
    content = ctypes.cast(place, ctypes.POINTER(ctypes.c_size_t))[0]
    words = ctypes.cast(content, ctypes.POINTER(ctypes.c_size_t))
    for word in (1, 2):
        if words[word] == numbers.ctypes.data:
            return word
    raise NotImplementedError("this build of SUNDIALS lays its vectors out in an unknown way")


def _check(name: str, flag: int) -> None:
    if flag != 0:
        raise RuntimeError(f"{name} returned {flag}")


def _solve_plain(problem: Problem, *, setting: Setting, budget_s: float, method: int) -> Solution:
    """The same through scikit-sundae's own interface; it does not tell its steps."""
    sundae: Any = import_module("sksundae.cvode")
    law = PlainPython(problem)
    parameters = pack(problem)

    def rates(t: float, y: np.ndarray, yp: np.ndarray) -> None:
        yp[:] = law.rates(t, y)

    def gap(t: float, y: np.ndarray, g: np.ndarray) -> None:
        g[0] = law.switching(t, y)[0]

    gap.direction = [-1]  # pyrefly: ignore[missing-attribute]
    atol = setting.tolerance * STATE_SCALE if setting.absolute is None else setting.absolute
    solution = Solution(problem.times, budget_s)
    solution.states[0] = y = problem.y0.copy()
    solver = sundae.CVODE(
        rates, method="Adams" if method == ADAMS else "BDF", rtol=setting.tolerance, atol=atol, eventsfn=gap,
        num_events=1, max_num_steps=_CHUNK,
    )  # fmt: skip
    t, sample = 0.0, 1
    corners = [*problem.corners, problem.duration_s]
    solver.init_step(t, y)
    while corners and not solution.overrun():
        if sample < len(problem.times) and problem.times[sample] - t < _INSTANT:
            solution.states[sample] = y
            sample += 1
            continue
        target = float(min(problem.times[sample], corners[0])) if sample < len(problem.times) else corners[0]
        result = solver.step(target, method="normal", tstop=corners[0])
        if not result.success:
            solution.failure = f"CVODE gave up at {t:.6g} s: {result.message}"
            break
        t, y = float(result.t), np.array(result.y, dtype=float).ravel()
        if sample < len(problem.times) and t >= problem.times[sample]:
            solution.states[sample] = y
            sample += 1
        switched = result.status == ROOT_RETURN
        if switched:
            solution.switches += 1
            began = take_switch(t, y, parameters, 0)
            law.phase, law.onset_speed = int(parameters[0]["phase"]), float(parameters[0]["onset_speed"])
            if began:
                solution.onsets.append((t, law.onset_speed))
        at_corner = t >= corners[0]
        if at_corner:
            corners.pop(0)
        if (at_corner or switched) and corners:
            solver.init_step(t, y)
    solution.evaluations = law.evaluations
    return solution.close()
