"""SUNDIALS CVODE (BDF and Adams), from the shared library of scikit-sundae.

Compiled: a compiled loop calls the library through its C interface, with right-hand side and switching functions as C
functions; Python only checks the clock now and then. As installed: scikit-sundae's own interface with plain Python
callbacks.

In both cases CVODE locates each change of phase by root finding, and is restarted there and at the corners of the
hammer pulse; v0 is latched at the located onset. By default, Adams uses fixed-point iteration, and BDF Newton's method
with a dense matrix by differences. Compiled, BDF is tuned for this problem (`_TUNED`), and Adams is available tuned and
with defaults; as installed, nothing is tuned.
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
    change_phase,
    compile_s,
    follow_gap_sign,
    pack,
    switching,
    vector_callbacks,
)
from replays.studies.peers.common.solution import DEFAULT, MISSED_HAMMER, SWITCH_CEILING, Manner, Setting, Solution
from replays.studies.peers.plain_python import PlainPython
from rig.physics.kernels.signals import STATE_SCALE

ADAMS, BDF = 1, 2
ONE_STEP, ROOT_RETURN = 2, 2
_STEPS_PER_CHECK = 5_000
"""Number of steps between two checks of the clock."""
_MIN_INTERVAL_S = 1e-14
"""Shortest resolved time [s]."""
_MAX_MISSED_GAP_M = -1e-12
"""Penetration [m] of the wrong sign that indicates a change of phase missed by root finding."""

_ANDERSON = 1
"""Number of earlier iterates in Anderson's acceleration of the fixed-point iteration."""
_TUNED: dict[int, tuple[tuple[str, float], ...]] = {
    ADAMS: (("CVodeSetNonlinConvCoef", 0.01), ("CVodeSetMaxNonlinIters", 5)),
    BDF: (("CVodeSetNonlinConvCoef", 0.03), ("CVodeSetLSetupFrequency", 40), ("CVodeSetJacEvalFrequency", 200)),
}
"""Settings that differ from CVODE's defaults, by method; Adams has Anderson's acceleration, too.

Measured with exact friction on unselected scenes: time over that of CVODE's defaults at the same geometric mean error
over the scenes, from ladders of six tolerances.

    error                            1e-2  1e-3  1e-4  1e-5
    Adams, whirl, 12 restitutions    0.86  0.79  0.79  0.81
    Adams, transient, 24 of them     0.94  1.00  0.98  0.96
    Adams, 27 random scenes          0.97  1.02  1.04  0.98
    BDF, whirl                       0.83  0.86  0.87
    BDF, transient                   0.96  1.03  0.97  0.97
    BDF, random                      1.00  0.98  0.99  0.99

A coefficient of 0.01 alone slows Adams down at coarse tolerances (1.95 in whirl): its three iterations no longer
suffice, and steps are rejected. Five iterations without Anderson: 0.85 in the transient, but 1.32 in whirl at 1e-2.
Coefficients of 0.3, 0.03, 0.003 and 0.001 gain no more. BDF is slower with orders below 5, with its stability limit
detection, and with a coefficient of 0.01. In a single scene, chance changes an error more than any setting: in the
chart's hammer scene Adams' defaults are faster (1e-3 to whirl in 15 ms, tuned in 18 to 27).
"""

_MESSAGES = {
    -2: "required accuracy exceeds rounding",
    -3: "error test failed too often",
    -4: "iteration did not converge",
    -8: "right-hand side failed",
    -12: "root finding failed",
}

# Indices of the compiled loop's variables.
_T, _CORNER, _SAMPLE, _ONSETS, _SWITCHES, _STEPS, _FLAG, _PULSE_SEEN = range(8)


@functools.cache
def _library() -> Any:
    """Return the C library with the signatures of the functions used here.

    The extension module of scikit-sundae is linked with the library, so its handle finds every symbol wherever a wheel
    has put the library itself.
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
def _compile_loop() -> tuple[Any, float]:
    """Return the compiled loop and its compile time [s]. It contains addresses of the library, so it is not cached."""
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
    def run(memory, place, y, spare_place, spare, parameters, times, corners, pulse, states, onsets, progress, events):
        """Run to the last corner, a failure, or the next check of the clock; return whether it is done.

        One step per call of CVODE, with samples from its history: with the samples as targets, CVODE would choose
        the first step after a restart by the distance to the next sample.
        """
        t = np.empty(1)
        found = np.zeros(N_SWITCH, np.int32)
        sample = int(progress[_SAMPLE])
        for _ in range(_STEPS_PER_CHECK):
            end = corners[int(progress[_CORNER])]
            flag = step(memory, end, place, t.ctypes, ONE_STEP)
            progress[_FLAG] = flag
            if flag < 0:
                return True
            progress[_T] = t[0]
            progress[_STEPS] += 1
            if pulse[0] < t[0] < pulse[1]:
                progress[_PULSE_SEEN] = 1.0
            sampled = False
            while sample < len(times) and times[sample] <= t[0]:
                sampled = True
                interpolate(memory, times[sample], 0, spare_place)
                states[sample] = spare
                sample += 1
            progress[_SAMPLE] = sample
            which = -1
            began = False
            if not events:
                began = follow_gap_sign(t[0], y, parameters)
            elif flag == ROOT_RETURN:
                root_info(memory, found.ctypes)
                which = 0 if found[0] != 0 else 1
            elif sampled and switching(t[0], y, parameters)[0] < _MAX_MISSED_GAP_M:
                which = 0
            if which >= 0:
                progress[_SWITCHES] += 1
                began = change_phase(t[0], y, parameters, which)
            if began:
                if progress[_ONSETS] < len(onsets):
                    onsets[int(progress[_ONSETS]), 0] = t[0]
                    onsets[int(progress[_ONSETS]), 1] = parameters[0].onset_speed
                progress[_ONSETS] += 1
            # CVODE rejects a first step within rounding, in which nothing moves.
            at_corner = t[0] > end - _MIN_INTERVAL_S
            if at_corner:
                progress[_CORNER] += 1
                if progress[_CORNER] == len(corners):
                    states[sample:] = y
                    return True
            if at_corner or which >= 0:
                restart(memory, t[0], place)
                stop_at(memory, corners[int(progress[_CORNER])])
        return False

    return run, time.perf_counter() - begin


def solve(
    problem: Problem, *, setting: Setting, budget_s: float, method: int, manner: Manner = DEFAULT, tuned: bool = True
) -> Solution:
    """Solve a problem by CVODE.

    Args:
        problem: Problem.
        setting: Tolerances.
        budget_s: Permitted wall time [s].
        method: ADAMS or BDF.
        manner: Mode of operation.
        tuned: Whether to use the settings of `_TUNED`, or CVODE's defaults.
    """
    if manner.plain:
        return _solve_plain(problem, setting=setting, budget_s=budget_s, method=method)
    if not manner.events and problem.exact_friction:
        raise NotImplementedError("exact friction needs events")
    run, compiling_s = _compile_loop()
    library = _library()
    parameters = pack(problem)
    pulse = problem.pulse
    corners = np.array([*(problem.corners if manner.stops else ()), problem.duration_s])
    onsets = np.empty((SWITCH_CEILING, 2))
    progress = np.zeros(8)
    progress[_SAMPLE] = 1.0

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
                corners, np.array(pulse or (0.0, 0.0)), solution.states, onsets, progress, manner.events,
            )  # fmt: skip
            solution.steps, solution.switches = int(progress[_STEPS]), int(progress[_SWITCHES])
            done = done or solution.overrun()
    flag = int(progress[_FLAG])
    if solution.failure is None and flag < 0:
        solution.failure = f"CVODE failed at {progress[_T]:.6g} s: {_MESSAGES.get(flag, f'flag {flag}')}"
    if solution.failure is None and not manner.stops and pulse is not None and progress[_PULSE_SEEN] == 0.0:
        solution.failure = MISSED_HAMMER
    solution.onsets = [(float(t), float(speed)) for t, speed in onsets[: int(progress[_ONSETS])]]
    solution.evaluations = int(parameters[0]["evaluations"])
    return solution.close()


class _Session:
    """Solver of the library, freed with the exit stack.

    Attributes:
        memory: Address of the solver.
        place: Address of the solver's vector, whose numbers are `y`.
        y: State, shape (14,).
        spare_place: Address of a second vector, whose numbers are `spare`.
        spare: Second state, shape (14,).
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
            handle = library.N_VMake_Serial(N_STATE, numbers.ctypes.data, context)
            stack.callback(library.N_VDestroy_Serial, handle)
            return handle

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
    """Return the offset of the data address in a vector's content, in words; an index of 4 or 8 bytes precedes it."""
    content = ctypes.cast(place, ctypes.POINTER(ctypes.c_size_t))[0]
    words = ctypes.cast(content, ctypes.POINTER(ctypes.c_size_t))
    for word in (1, 2):
        if words[word] == numbers.ctypes.data:
            return word
    raise NotImplementedError("this build of SUNDIALS has an unknown vector layout")


def _check(name: str, flag: int) -> None:
    if flag != 0:
        raise RuntimeError(f"{name} returned {flag}")


def _solve_plain(problem: Problem, *, setting: Setting, budget_s: float, method: int) -> Solution:
    """Solve a problem through scikit-sundae's own interface, which does not report its steps."""
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
        num_events=1, max_num_steps=_STEPS_PER_CHECK,
    )  # fmt: skip
    t, sample = 0.0, 1
    corners = [*problem.corners, problem.duration_s]
    solver.init_step(t, y)
    while corners and not solution.overrun():
        if sample < len(problem.times) and problem.times[sample] - t < _MIN_INTERVAL_S:
            solution.states[sample] = y
            sample += 1
            continue
        target = float(min(problem.times[sample], corners[0])) if sample < len(problem.times) else corners[0]
        result = solver.step(target, method="normal", tstop=corners[0])
        if not result.success:
            solution.failure = f"CVODE failed at {t:.6g} s: {result.message}"
            break
        t, y = float(result.t), np.array(result.y, dtype=float).ravel()
        if sample < len(problem.times) and t >= problem.times[sample]:
            solution.states[sample] = y
            sample += 1
        switched = result.status == ROOT_RETURN
        if switched:
            solution.switches += 1
            began = change_phase(t, y, parameters, 0)
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
