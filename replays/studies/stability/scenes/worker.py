"""Execution of one run in a separate process, so that a hang or a crash is a result."""

from __future__ import annotations

import math
import resource
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, Self

import numpy as np

from replays.studies.common.run import bare_sensors, end_with_parent
from rig.base.errors import InputError, SimulationError
from rig.physics.kernels.signals import COLUMN, N_STATE
from rig.run.scenes import Scene, change_scene
from rig.run.simulation import Simulation

RATE_HZ = 1_000
"""Rate at which runs are compared [Hz]."""
_CHUNK_TICKS = 10_000
"""Ticks between two checks of the processor time."""
_GRACE_S = 2.0
"""Additional processor time after which the process is ended if the run does not check its own time [s]."""
_COMPILING_S = 300.0
"""Processor time for the compilation before a run [s]."""


class Task(NamedTuple):
    """Settings of one run."""

    scene: Scene
    engine: str
    tolerance: float = 0.0
    """Tolerance of an adaptive engine; 0: its own."""
    nudge: float = 0.0
    """Shift of the initial position along x, in clearances."""
    limit_s: float = 20.0
    """Allowed processor time [s]."""
    step_us: int = 0
    """Step or grid of the engine; 0: its own."""


@dataclass
class SceneRun:
    """Result of a run."""

    failure: str = ""
    """Kind of failure: refused, crash, hang; empty if there is none."""
    message: str = ""
    states: np.ndarray = field(default_factory=lambda: np.empty((0, N_STATE)))
    """States at `RATE_HZ` until the end or failure, shape (n, N_STATE)."""
    cpu_s: float = 0.0
    """Processor time of the steps [s]."""
    reached_s: float = 0.0
    """Simulated time reached [s]."""
    health: dict[str, Any] = field(default_factory=dict)
    """`Simulation.health` at the end."""


def run_task(task: Task, on_begin: Callable[[], None] = lambda: None) -> SceneRun:
    """Execute a run in this process.

    Args:
        task: The run.
        on_begin: Function called after compilation, before the first step.
    """
    done, kept = SceneRun(), []
    settings = {"name": task.engine, "tolerance": task.tolerance, "step_us": task.step_us}
    try:
        changes: dict[str, Any] = {f"sensors.{key}": value for key, value in bare_sensors(RATE_HZ).items()}
        changes |= {f"engine.{key}": value for key, value in settings.items() if value}
        scene = change_scene(task.scene, changes)
        simulation = Simulation(shift_start(scene, task.nudge) if task.nudge else scene)
        _ = simulation.first_row  # compiles
        on_begin()
    except InputError as error:
        return SceneRun("refused", str(error))
    try:
        while simulation.tick < simulation.end_tick:
            begin = time.thread_time()
            frame = simulation.advance(min(_CHUNK_TICKS, simulation.end_tick - simulation.tick))
            done.cpu_s += time.thread_time() - begin
            kept.append(frame.rows[:, :N_STATE].copy())
            done.reached_s = simulation.tick / simulation.tick_rate_hz
            if done.cpu_s > task.limit_s:
                done.failure, done.message = "hang", f"{done.cpu_s:.0f} s of processor time up to {done.reached_s:g} s"
                break
        done.health = simulation.health()
    except Exception as error:  # any error is a result of this study
        done.failure, done.message = "crash", f"{type(error).__name__}: {error}"
        if not isinstance(error, SimulationError):
            done.message += " (no SimulationError)"
    if kept:
        done.states = np.concatenate(kept)
    if not done.failure and not np.isfinite(done.states).all():
        done.failure, done.message = "crash", "a state is not finite"
    return done


def shift_start(scene: Scene, clearances: float) -> Scene:
    """Return the scene with the shaft shifted slightly along x and toward the ring's centre at the start."""
    simulation = Simulation(scene)
    row, clearance = simulation.first_row, simulation.model.constants.contact.clearance
    x, y = ((1.0 - 3.0 * clearances) * float(row[COLUMN[name]]) for name in ("ring_x", "ring_y"))
    place = {"position": "given", "x_mm": 1e3 * (x + clearances * clearance), "y_mm": 1e3 * y}
    return change_scene(scene, {f"initial.{key}": value for key, value in place.items()})


class Worker:
    """Process that executes runs one after the other; it is replaced when it hangs or crashes."""

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def run(self, task: Task) -> SceneRun:
        """Execute a run in the process."""
        try:
            self._pipe.send(task)
            return self._pipe.recv()
        except (EOFError, OSError):
            self._process.join()
        status = self._process.exitcode
        self._end()
        self._start()
        if status == -signal.SIGXCPU:
            return SceneRun("hang", f"does not return in {task.limit_s:g} s of processor time")
        return SceneRun("crash", f"its process died (exit status {status})")

    def _start(self) -> None:
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()

    def _end(self) -> None:
        self._process.kill()
        self._process.join()
        self._pipe.close()


def _serve(pipe: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent process
    end_with_parent()
    while True:
        task = pipe.recv()
        limit_processor_time(_COMPILING_S)
        pipe.send(run_task(task, partial(limit_processor_time, task.limit_s + _GRACE_S)))


def limit_processor_time(limit_s: float) -> None:
    """Limit the further processor time of this process [s], unaffected by other load."""
    most = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(time.process_time() + limit_s), most))
