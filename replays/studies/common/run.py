"""Runs for the studies: one engine on a bare system, or one scene to its end, with processor times."""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

import numpy as np

from rig.base.errors import SimulationError
from rig.physics.engine_choice import load_chosen_engine
from rig.physics.engines import ENGINES
from rig.physics.kernels.constants import Constants, Inputs
from rig.physics.kernels.signals import N_VECTOR
from rig.run.simulation import Simulation


def bare_sensors(rate_hz: int = 1_000) -> dict[str, Any]:
    """Return sensor settings with little effect on the engine: ideal hammer channels only, with rows at a rate [Hz]."""
    return {"chain": "ideal", "groups": ["hammer"], "rate_hz": rate_hz, "truth_rate_hz": rate_hz}


class Course:
    """An engine on a system without scene, sensors or commands.

    Attributes:
        y: Current state and integrals, shape (N_VECTOR,).
        memory: Current memory of the engine, shape (memory_size,).
        tick: Current time in ticks of the inputs.
        step: Ticks per step.
    """

    def __init__(
        self,
        engine: str,
        constants: Constants,
        inputs: Inputs,
        y0: np.ndarray,
        *,
        step: int = 0,
        tolerance: float = 0.0,
    ) -> None:
        """Start an engine.

        Args:
            engine: Name of the engine.
            constants: The model.
            inputs: Inputs of the model.
            y0: Initial state, shape (N_STATE,) or, with integrals, (N_VECTOR,).
            step: Ticks per step; 0 for the engine's own (in ticks of 1 µs).
            tolerance: Tolerance of an adaptive engine; 0 for its own.
        """
        method = ENGINES[engine]
        self._engine, self._constants, self._inputs = load_chosen_engine(engine), constants, inputs
        self.step, self.tick = step or method.step_us, 0
        self.y, self.memory = np.zeros(N_VECTOR), np.zeros(self._engine.memory_size)
        self.y[: len(y0)] = y0
        tolerance = tolerance or method.tolerance
        self._engine.start(constants, inputs, self.y, self.memory, float(self.step), tolerance)

    def advance(self, steps: int, stride: int, rows: np.ndarray) -> None:
        """Advance by a number of steps.

        Args:
            steps: Number of steps.
            stride: Steps between output rows; the first row is the current state.
            rows: Output rows, shape (steps / stride, N_ROW).
        """
        self._engine.advance(
            self._constants, self._inputs, self.y, self.memory, self.tick, self.step, steps, stride, rows
        )
        self.tick += steps * self.step

    def look(self, rows: np.ndarray) -> None:
        """Write the row of the current state, shape (1, N_ROW), without advancing."""
        y, memory = self.y.copy(), self.memory.copy()
        self._engine.advance(self._constants, self._inputs, y, memory, self.tick, self.step, 1, 1, rows)


class Timed(NamedTuple):
    """A completed run of a scene.

    Attributes:
        rows: Observed rows, shape (n, N_ROW): of the whole run, or of its last block if they were not kept.
        cpu_s: Processor time of this thread for the steps [s], unaffected by other load on the machine.
    """

    rows: np.ndarray
    cpu_s: float


def run_scene(
    simulation: Simulation, *, block_ticks: int, every: int = 1, keep: bool = True, limit_s: float = math.inf
) -> Timed:
    """Run a simulation to the end of its scene.

    Args:
        simulation: The simulation.
        block_ticks: Ticks per call, a multiple of the simulation's own blocks.
        every: Decimation factor of the rows.
        keep: Whether to keep the rows of the whole run.
        limit_s: Allowed processor time [s].

    Raises:
        SimulationError: If it takes too long, as when an engine stalls.
    """
    kept: list[np.ndarray] = []
    cpu_s = 0.0
    while simulation.tick < simulation.end_tick:
        begin = time.thread_time()
        frame = simulation.advance(min(block_ticks, simulation.end_tick - simulation.tick))
        cpu_s += time.thread_time() - begin
        if cpu_s > limit_s:
            raise SimulationError(f"given up after {cpu_s:.0f} s at {simulation.tick * 1e-6:g} s of the scene")
        if not keep:
            kept.clear()
        kept.append(frame.rows[::every].copy())
    return Timed(np.concatenate(kept), cpu_s)


def end_with_parent() -> None:
    """Exit when the parent process ends; otherwise a worker would wait for work forever."""
    import os
    from multiprocessing import parent_process
    from threading import Thread

    parent = parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
        os._exit(1)

    Thread(target=watch, daemon=True).start()
