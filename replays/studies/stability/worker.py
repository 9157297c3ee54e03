"""One run of a scene by one engine, in a process of its own: a run that hangs or dies is a result like any other."""

from __future__ import annotations

import signal
import time
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, Self

import numpy as np

from replays.studies.run import bare_sensors, end_with_parent
from rig.errors import InputError, SimulationError
from rig.kernels.signals import COLUMN, N_STATE
from rig.scenes import Scene, change_scene
from rig.simulation import Simulation

RATE_HZ = 1_000
"""Instants at which runs are compared [Hz]."""
_CHUNK_TICKS = 10_000
"""How far a run goes between two looks at the clock [ticks]."""
_PATIENCE = 4.0
"""A process that says nothing for so many limits is ended: others may share the processor ..."""
COMPILING_S = 300.0
"""... and it may have to compile [s]."""


class Task(NamedTuple):
    """One run."""

    scene: Scene
    engine: str
    tolerance: float = 0.0
    """Of an adaptive engine; 0: its own."""
    nudge: float = 0.0
    """By how many clearances the shaft starts farther along x."""
    limit_s: float = 60.0
    """Processor time it may take [s]."""


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


def run_task(task: Task) -> Run:
    """Do a run, in this process."""
    done, kept = Run(), []
    try:
        changes: dict[str, Any] = {f"sensors.{key}": value for key, value in bare_sensors(RATE_HZ).items()}
        changes |= {"engine.name": task.engine} | ({"engine.tolerance": task.tolerance} if task.tolerance else {})
        scene = change_scene(task.scene, changes)
        simulation = Simulation(nudged(scene, task.nudge) if task.nudge else scene)
        _ = simulation.first_row  # compiles
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

    def __init__(self, *, compiling_s: float = COMPILING_S) -> None:
        """It is started on entering.

        Args:
            compiling_s: Wall time added to the first run of each engine [s].
        """
        self._compiling_s = compiling_s

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def run(self, task: Task) -> Run:
        """Do a run there."""
        patience_s = _PATIENCE * task.limit_s + (0.0 if task.engine in self._compiled else self._compiling_s)
        self._compiled.add(task.engine)
        try:
            self._pipe.send(task)
            if self._pipe.poll(patience_s):
                return self._pipe.recv()
            lost = Run("hang", f"no answer within {patience_s:.0f} s: the engine does not return")
        except (EOFError, OSError):
            self._process.join()
            lost = Run("crash", f"its process died (exit status {self._process.exitcode})")
        self._end()
        self._start()
        return lost

    def _start(self) -> None:
        context = get_context("spawn")
        self._compiled: set[str] = set()
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
        pipe.send(run_task(pipe.recv()))
