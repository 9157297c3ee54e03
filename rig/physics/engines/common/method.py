"""Interface between one-step methods and `rig.physics.engines.common.march`, and dispatch of compiled functions.

A method is a NamedTuple of a separate type with the fields

- `rows`: rows of its workspace k. The first holds the rates at the start of a step, the last those at its end; the
method uses the rest;
- `order`: order of the estimate's leading error; 0 for no estimate, with steps as long as possible;
- `graded`: whether steps shrink toward onset and lift-off.

The compiler selects a method's functions by that type (`numba.extending.overload`), as numba cannot cache machine code
that takes functions as arguments.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numba.extending import overload

from rig.physics.kernels import signals as S
from rig.physics.kernels.dynamics import evaluate
from rig.physics.kernels.stage import kernel

PER_SCALE = 1.0 / S.STATE_SCALE


class Step(NamedTuple):
    """Start and length of a step, and its contact law."""

    tick: int  # whole tick
    fraction: float  # ticks beyond it
    ticks: float  # length, not necessarily whole
    onset_speed: float  # v0 of the current contact [m/s]
    phase: int  # contact phase (rig.physics.kernels.laws.contact)


class Functions(NamedTuple):
    """Compiled functions of a type of method, with the parameters of the functions below."""

    step: Any
    error: Any
    prepare: Any


FUNCTIONS: dict[type, Functions] = {}
"""Functions by type of method, added by the method's module."""


def method_step(method, constants, inputs, step, y, k, z, end, out):
    """Take one step from `y`, with its rates in k[0], to `end`.

    Args:
        method: Method.
        constants: Model constants.
        inputs: Hammer, drive, magnets.
        step: Step.
        y: State and integrals, shape (N_VECTOR,).
        k: Workspace, shape (rows, N_VECTOR).
        z: Workspace for a stage's state, shape (N_VECTOR,).
        end: Out, shape (N_VECTOR,).
        out: Workspace for the observed quantities, shape (N_OBSERVED,).

    Returns:
        Number of evaluations of the equations.
    """
    return FUNCTIONS[type(method)].step(method, constants, inputs, step, y, k, z, end, out)


def method_error(method, h, k, scratch):
    """Return the scaled error estimate of the step in workspace k.

    Args:
        method: Method.
        h: Length of the step [s].
        k: Workspace, shape (rows, N_VECTOR).
        scratch: Workspace, shape (2, N_STATE).
    """
    return FUNCTIONS[type(method)].error(method, h, k, scratch)


def method_prepare(method, constants, inputs, step, y, k, z, out):
    """Prepare what all steps from one state share, regardless of their length; `step` is the longest of them.

    Returns:
        Number of evaluations of the equations.
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
    """Call `evaluate` as a separate function, so that only the stages' loop contains another copy of it."""
    evaluate(constants, inputs, tick, fraction, onset_speed, phase, observe, y, dy, out)


@kernel
def fill(target, source):
    """Copy as many numbers as `target` has. numpy's assignment also compiles error messages, which takes seconds."""
    for i in range(len(target)):
        target[i] = source[i]


@kernel
def skip_preparation(method, constants, inputs, step, y, k, z, out):
    """Return 0 evaluations, for a method without preparation."""
    return 0


@kernel
def zero_error(method, h, k, scratch):
    """Return 0, for a method without error estimate."""
    return 0.0
