"""One run of a scene by one engine, in a process of its own: a run that hangs or dies is a result like any other."""

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
"""Instants at which runs are compared [Hz]."""
_CHUNK_TICKS = 10_000
"""How far a run goes between two looks at the clock [ticks]."""
_BEYOND_S = 2.0
"""So much longer than a run may take, its process goes on: where it does not come back to the clock [s]."""
_COMPILING_S = 300.0
"""What the beginning of a run may take [s]."""


class Task(NamedTuple):
    """One run."""

    scene: Scene
    engine: str
    tolerance: float = 0.0
    """Of an adaptive engine; 0: its own."""
    nudge: float = 0.0
    """By how many clearances the shaft starts farther along x."""
    limit_s: float = 20.0
    """Processor time it may take [s]."""
    step_us: int = 0
    """Of the engine's steps or grid; 0: its own."""


@dataclass
class Run:
    """What became of it."""

    failure: str = ""
    """"", or its kind: refused, crash, hang."""
    message: str = ""
    states: np.ndarray = field(default_factory=lambda: np.empty((0, N_STATE)))
    """At `RATE_HZ`, as far as it got, shape (n, N_STATE)."""
    cpu_s: float = 0.0
    """Processor time of its steps [s]."""
    reached_s: float = 0.0
    """Simulated time [s]."""
    health: dict[str, Any] = field(default_factory=dict)
    """What `Simulation.health` tells at its end."""


def run_task(task: Task, begun: Callable[[], None] = lambda: None) -> Run:
    """Do a run, in this process.

    Args:
        task: The run.
        begun: Called where its first step is due, the engine being compiled.
    """
    done, kept = Run(), []
    asked = {"name": task.engine, "tolerance": task.tolerance, "step_us": task.step_us}
    try:
        changes: dict[str, Any] = {f"sensors.{key}": value for key, value in bare_sensors(RATE_HZ).items()}
        changes |= {f"engine.{key}": value for key, value in asked.items() if value}
        scene = change_scene(task.scene, changes)
        simulation = Simulation(nudged(scene, task.nudge) if task.nudge else scene)
        _ = simulation.first_row  # compiles
        begun()
    except InputError as error:
        return Run("refused", str(error))
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
    except Exception as error:  # whatever it is, it is what this study is about
        done.failure, done.message = "crash", f"{type(error).__name__}: {error}"
        if not isinstance(error, SimulationError):
            done.message += " (no SimulationError)"
    if kept:
        done.states = np.concatenate(kept)
    if not done.failure and not np.isfinite(done.states).all():
        done.failure, done.message = "crash", "a state is not finite"
    return done


def nudged(scene: Scene, clearances: float) -> Scene:
    """The scene with its shaft a little farther along x, and toward the ring's centre, at the start."""
    simulation = Simulation(scene)
    row, clearance = simulation.first_row, simulation.model.constants.contact.clearance
    x, y = ((1.0 - 3.0 * clearances) * float(row[COLUMN[name]]) for name in ("ring_x", "ring_y"))
    place = {"position": "given", "x_mm": 1e3 * (x + clearances * clearance), "y_mm": 1e3 * y}
    return change_scene(scene, {f"initial.{key}": value for key, value in place.items()})


class Worker:
    """A process that does runs, one after the other; another takes its place where it hangs or dies."""

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def run(self, task: Task) -> Run:
        """Do a run there."""
        try:
            self._pipe.send(task)
            return self._pipe.recv()
        except (EOFError, OSError):
            self._process.join()
        status = self._process.exitcode
        self._end()
        self._start()
        if status == -signal.SIGXCPU:
            return Run("hang", f"does not return in {task.limit_s:g} s of processor time")
        return Run("crash", f"its process died (exit status {status})")

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
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal's Ctrl-C is for the process that asks
    end_with_parent()
    while True:
        task = pipe.recv()
        end_after(_COMPILING_S)
        pipe.send(run_task(task, partial(end_after, task.limit_s + _BEYOND_S)))


def end_after(limit_s: float) -> None:
    """Have the system end this process when it has taken so much more processor time [s]; others' does not count."""
    most = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(time.process_time() + limit_s), most))
