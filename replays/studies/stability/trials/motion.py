"""Run of one engine on one small system, without scenes, sensors or commands."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from replays.studies.common.run import Course
from rig.physics.engines.common.memory import CONTACTS, PEAK_FORCE
from rig.physics.kernels.constants import Constants, Inputs
from rig.physics.kernels.signals import COLUMN, N_ROW, N_STATE, N_VECTOR
from rig.physics.levels import ModelLevels
from rig.physics.model import Model, build_model
from rig.physics.parameters import load_parameters

TICK_S = 1e-6
"""Default length of a tick [s]."""


@cache
def base_model(levels: ModelLevels) -> Model:
    """Return the model with default parameters at the given levels; cached, because the magnets' map is fitted."""
    return build_model(load_parameters(), levels)


def quiet_inputs(
    *,
    tick_s: float = TICK_S,
    spin: float = 0.0,
    magnets: bool = False,
    ideal: bool = False,
    pulse: tuple[float, int, int] = (0.0, 0, 0),
) -> Inputs:
    """Return inputs without commands except for an optional pulse along x.

    Args:
        tick_s: Length of a tick [s].
        spin: Set speed of the drive [rad/s].
        magnets: Whether the magnets are engaged.
        ideal: Whether the drive prescribes the spin instead of a torque.
        pulse: Peak force [N], first tick and end of the pulse.
    """
    return Inputs(
        tick_s=tick_s, hammer_force=pulse[0], hammer_x=1.0, hammer_y=0.0, hammer_start=pulse[1], hammer_end=pulse[2],
        speed=spin, speed_slope=0.0, speed_tick=0, ideal_drive=ideal, magnet_engaged=magnets,
    )  # fmt: skip


@dataclass(frozen=True)
class MotionResult:
    """Motion of a system computed by an engine.

    Attributes:
        times: Times of the rows [s], shape (n,).
        rows: Observed rows, shape (n, N_ROW), without the end.
        end: State and integrals at the end, shape (N_VECTOR,).
        memory: The engine's memory at the end, shape (MEMORY,).
    """

    times: np.ndarray
    rows: np.ndarray
    end: np.ndarray
    memory: np.ndarray

    @property
    def states(self) -> np.ndarray:
        """States at the rows and at the end, shape (n + 1, 14)."""
        return np.vstack([self.rows[:, :N_STATE], self.end[None, :N_STATE]])

    def column(self, name: str) -> np.ndarray:
        """Return one column of the rows, shape (n,)."""
        return self.rows[:, COLUMN[name]]

    def final_value(self, name: str) -> float:
        """Return one state or integral at the end."""
        return float(self.end[COLUMN[name]])

    @property
    def contacts(self) -> int:
        """Number of contacts."""
        return int(self.memory[CONTACTS])

    @property
    def peak_force(self) -> float:
        """Largest normal force at the engine's own steps [N]."""
        return float(self.memory[PEAK_FORCE])


def move(
    engine: str,
    constants: Constants,
    inputs: Inputs,
    y0: np.ndarray,
    *,
    ticks: int,
    step: int = 0,
    every: int = 0,
    tolerance: float = 0.0,
) -> MotionResult:
    """Run an engine on a system.

    Args:
        engine: Name of the engine.
        constants: The model.
        inputs: Inputs of the model.
        y0: Initial state and integrals, shape (N_VECTOR,).
        ticks: Length in ticks of `inputs`, truncated to whole rows.
        step: Ticks per step; 0 for the engine's own (in ticks of 1 us).
        every: Ticks between rows, at least one step; 0 for a single row.
        tolerance: Tolerance of an adaptive engine; 0 for its own.
    """
    course = Course(engine, constants, inputs, y0, step=step, tolerance=tolerance)
    stride = max(1, (every or ticks) // course.step)
    steps = max(1, ticks // (stride * course.step)) * stride
    rows = np.empty((steps // stride, N_ROW))
    course.advance(steps, stride, rows)
    times = np.arange(len(rows)) * stride * course.step * inputs.tick_s
    return MotionResult(times=times, rows=rows, end=course.y, memory=course.memory)


def state(**values: float) -> np.ndarray:
    """Return state and integrals, 0 except for the named columns, shape (N_VECTOR,)."""
    y = np.zeros(N_VECTOR)
    for name, value in values.items():
        y[COLUMN[name]] = value
    return y


def pivoted_mass(constants: Constants) -> float:
    """Return the effective mass of the shaft at the ring [kg]."""
    return constants.shaft.transverse_inertia / constants.shaft.arm_ring**2


def bare_shaft(*, gravity: bool = False, **contact: float) -> Constants:
    """Return a planar shaft in a rigid, centred, frictionless ring; along x it is a mass on one line.

    Args:
        gravity: Whether gravity acts.
        contact: Contact parameters that differ from the rig's with Hertz's exponent, by field.
    """
    levels = ModelLevels(magnet="linear", shaft="planar", stator="rigid", friction="none")
    own = base_model(levels).constants
    centred = {"offset_x": 0.0, "offset_y": 0.0, "exponent": 1.5, "viscous_damping": 0.0}
    return own._replace(
        contact=own.contact._replace(**{**centred, **contact}),
        shaft=own.shaft._replace(unbalance=0.0, gravity=own.shaft.gravity if gravity else 0.0),
        magnet=own.magnet._replace(damping_x=0.0, damping_y=0.0),
    )


def hammer_run(law: str, *, force_n: float = 100.0, **contact: float) -> tuple[Constants, Inputs, np.ndarray]:
    """Return the full rig at 6.2 Hz with a pulse of 5 ms along x at 20 ms, as in scene `hammer`, with a friction law.

    Args:
        law: Friction law.
        force_n: Peak of the pulse [N].
        contact: Contact parameters that differ from the rig's, by field.
    """
    model = base_model(ModelLevels.model_validate({"friction": law}))
    spin = 2.0 * np.pi * 6.2
    inputs = quiet_inputs(spin=spin, magnets=True, pulse=(force_n, 20_000, 25_000))
    changed = model.constants.contact._replace(**contact)
    return model.constants._replace(contact=changed), inputs, model.state(spin=spin)
