"""What a one-step method is to `rig.physics.engines.common.march`, and how the compiler finds its functions.

A method is a NamedTuple of a type of its own, with the fields

- `rows`: rows of its workspace k. The first holds the rates at the start of a step, the last those at its end, the
  ones between are the method's;
- `order`: of the estimate's leading error; 0: no estimate, steps are as long as they may be;
- `graded`: steps shrink toward onset and lift-off.

The compiler picks a method's functions by that type (`numba.extending.overload`): numba cannot keep machine code that
takes functions as arguments from one process to the next.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numba.extending import overload

from rig.physics.kernels import signals as S
from rig.physics.kernels.dynamics import evaluate
from rig.physics.kernels.stage import kernel

PER_SCALE = 1.0 / S.STATE_SCALE


class Step(NamedTuple):
    """Where a step begins, how long it is, and under which law it is taken."""

    tick: int  # whole tick
    fraction: float  # ticks beyond it
    ticks: float  # length, any part of a tick
    onset_speed: float  # v0 of the running contact [m/s]
    phase: int  # of the contact (rig.physics.kernels.laws.contact)


class Functions(NamedTuple):
    """What a type of method does; compiled, with the parameters of the functions below."""

    step: Any
    error: Any
    prepare: Any


FUNCTIONS: dict[type, Functions] = {}
"""Of every type of method; its module enters it."""


def method_step(method, constants, inputs, step, y, k, z, end, out):
    """One step from `y`, whose rates are in k[0], to `end`.

    Args:
        method: The method.
        constants: Numbers of the model.
        inputs: Hammer, drive, magnets.
        step: The step.
        y: State and integrals, shape (N_VECTOR,).
        k: Workspace, shape (rows, N_VECTOR).
        z: Room for a stage's state, shape (N_VECTOR,).
        end: Out, shape (N_VECTOR,).
        out: Room for what is observed, shape (N_OBSERVED,).

    Returns:
        Evaluations of the equations.
    """
    return FUNCTIONS[type(method)].step(method, constants, inputs, step, y, k, z, end, out)


def method_error(method, h, k, scratch):
    """Scaled error estimate of the step whose workspace is k; h [s]; scratch, shape (2, N_STATE)."""
    return FUNCTIONS[type(method)].error(method, h, k, scratch)


def method_prepare(method, constants, inputs, step, y, k, z, out):
    """What all steps from one state share, whatever their length, before the first; the step is the longest of them.

    Returns:
        Evaluations of the equations.
    """
    return FUNCTIONS[type(method)].prepare(method, constants, inputs, step, y, k, z, out)


@overload(method_step)
def _compiled_step(method, constants, inputs, step, y, k, z, end, out):
    return FUNCTIONS[method.instance_class].step.py_func


@overload(method_error)
def _compiled_error(method, h, k, scratch):
    return FUNCTIONS[method.instance_class].error.py_func


@overload(method_prepare)
def _compiled_prepare(method, constants, inputs, step, y, k, z, out):
    return FUNCTIONS[method.instance_class].prepare.py_func


@kernel
def rates(constants, inputs, tick, fraction, onset_speed, phase, observe, y, dy, out):
    """`evaluate` as a function of its own, so that only the stages' loop holds another copy of it."""
    evaluate(constants, inputs, tick, fraction, onset_speed, phase, observe, y, dy, out)


@kernel
def fill(target, source):
    """Copy as many numbers as `target` has. numpy's own assignment compiles texts of errors as well, for seconds."""
    for i in range(len(target)):
        target[i] = source[i]


@kernel
def nothing_to_prepare(method, constants, inputs, step, y, k, z, out):
    """`method_prepare` of a method that has nothing to prepare."""
    return 0


@kernel
def no_estimate(method, h, k, scratch):
    """`method_error` of a method that has no estimate."""
    return 0.0
