"""How every study runs: one engine on a bare system, or one scene to its end, each with the time that it took."""

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
    """Sensors that leave the engine alone: ideal ones, of the hammer alone, with rows at a rate [Hz]."""
    return {"chain": "ideal", "groups": ["hammer"], "rate_hz": rate_hz, "truth_rate_hz": rate_hz}


class Course:
    """One engine on one system, without scene, sensors or commands.

    Attributes:
        y: State and integrals now, shape (N_VECTOR,).
        memory: The engine's memory now, shape (memory_size,).
        tick: Present time, in ticks of the inputs.
        step: Ticks a step.
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
            engine: Its name.
            constants: The model.
            inputs: What acts on it.
            y0: State at the start, shape (N_STATE,) or, with integrals, (N_VECTOR,).
            step: Ticks a step; 0 for the engine's own (in ticks of 1 µs).
            tolerance: Of an adaptive engine; 0 for its own.
        """
        method = ENGINES[engine]
        self._engine, self._constants, self._inputs = load_chosen_engine(engine), constants, inputs
        self.step, self.tick = step or method.step_us, 0
        self.y, self.memory = np.zeros(N_VECTOR), np.zeros(self._engine.memory_size)
        self.y[: len(y0)] = y0
        tolerance = tolerance or method.tolerance
        self._engine.start(constants, inputs, self.y, self.memory, float(self.step), tolerance)

    def advance(self, steps: int, stride: int, rows: np.ndarray) -> None:
        """Go on.

        Args:
            steps: How many steps.
            stride: Steps between rows, the first of which is now.
            rows: Where observed rows go, shape (steps / stride, N_ROW).
        """
        self._engine.advance(
            self._constants, self._inputs, self.y, self.memory, self.tick, self.step, steps, stride, rows
        )
        self.tick += steps * self.step

    def look(self, rows: np.ndarray) -> None:
        """Write the row of now, shape (1, N_ROW), and stay."""
        y, memory = self.y.copy(), self.memory.copy()
        self._engine.advance(self._constants, self._inputs, y, memory, self.tick, self.step, 1, 1, rows)


class Timed(NamedTuple):
    """A scene that was run to an end.

    Attributes:
        rows: Observed rows, shape (n, N_ROW): of the whole run, or of its last block where they were not kept.
        cpu_s: Processor time of this thread for the steps [s]: other load on the machine does not count.
    """

    rows: np.ndarray
    cpu_s: float


def run_scene(
    simulation: Simulation, *, block_ticks: int, every: int = 1, keep: bool = True, limit_s: float = math.inf
) -> Timed:
    """Run a simulation to the end of its scene.

    Args:
        simulation: What to run.
        block_ticks: Ticks a call, a whole multiple of the simulation's own blocks.
        every: Rows between those that are kept.
        keep: Whether the rows of the whole run are kept.
        limit_s: Processor time allowed [s].

    Raises:
        SimulationError: It takes too long: an engine may stall.
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
    """A worker would wait for work for ever when the process that started it was killed."""
    import os
    from multiprocessing import parent_process
    from threading import Thread

    parent = parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
        os._exit(1)

    Thread(target=watch, daemon=True).start()
