"""One rung measured: a scene run on a model, an engine and a step, with its quantities, its work and its wall time."""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from replays.studies.ladder.quantity import QUANTITIES, Trace, Value
from rig.engines import ENGINES
from rig.errors import InputError, SimulationError
from rig.kernels.signals import COLUMN
from rig.levels import ModelLevels
from rig.scenes import Scene, parse_scene
from rig.simulation import Simulation

GRID_TICKS = 1_000
"""Quantities are read every 1 ms."""
_BARE = {"chain": "ideal", "groups": ["hammer"], "rate_hz": 1_000, "truth_rate_hz": 1_000}
"""Sensors that leave the engine alone."""
_FINEST_ROW_US = 25
"""The first impact is looked for on rows this far apart, or a fixed step apart [us]."""
_ENOUGH_S = 1.0
"""No further run is timed once this much wall time is spent on one rung."""


@dataclass(frozen=True)
class Rung:
    """A model, an engine and its step: all that a pick is about."""

    levels: ModelLevels
    drive: str
    engine: str
    step_us: int
    tolerance: float = 0.0

    @property
    def method(self) -> str:
        """Engine and step in words."""
        finest = f", {self.tolerance:.0e}".replace("e-0", "e-") if self.tolerance else ""
        return f"{self.engine} {self.step_us} us{finest}"

    @property
    def model(self) -> dict[str, str]:
        """The levels by name, the drive among them."""
        return {**self.levels.model_dump(), "drive": self.drive}

    def with_model(self, **levels: str) -> Rung:
        """The same with some levels changed."""
        drive = levels.pop("drive", self.drive)
        return replace(self, levels=ModelLevels(**{**self.levels.model_dump(), **levels}), drive=drive)  # pyright: ignore[reportArgumentType]

    def with_engine(self, engine: str, step_us: int, tolerance: float) -> Rung:
        """The same on another engine."""
        return replace(self, engine=engine, step_us=step_us, tolerance=tolerance)

    def scene(self, scene: Scene, *, sensors: dict[str, Any] | None = None) -> Scene:
        """The scene on this rung.

        Args:
            scene: As it is given.
            sensors: Its sensors, changed; None for as good as none.

        Raises:
            InputError: The engine cannot take the model, or its step does not fit the rates of the sensors.
        """
        data = scene.model_dump()
        return parse_scene(
            {
                **data,
                "fidelity": "given",
                "pick": None,
                "model": self.levels.model_dump(),
                "drive": {**data["drive"], "mode": self.drive},
                "engine": {"name": self.engine, "step_us": self.step_us, "tolerance": self.tolerance},
                "sensors": _BARE if sensors is None else {**data["sensors"], **sensors},
            }
        )


@dataclass(frozen=True)
class Measurement:
    """What a rung gave.

    Attributes:
        rung: Which one.
        values: By quantity; nan where it has none, or cannot give it.
        trace: The run's rows.
        wall_s: Wall time of a simulated second, median of the runs, compiling apart [s].
        spread_s: Least and largest of the same.
        runs: Runs timed.
        steps: Steps of the engine.
        residual_share: Energy residual as a part of what was dissipated.
        failure: Why there is no result; empty where there is one.
    """

    rung: Rung
    values: dict[str, Value]
    trace: Trace | None
    wall_s: float
    spread_s: tuple[float, float]
    runs: int
    steps: int
    residual_share: float
    failure: str = ""

    def step_ns(self, simulated_s: float) -> float:
        """Wall time of a step [ns]."""
        return self.wall_s * simulated_s / max(self.steps, 1) * 1e9


def measure(
    scene: Scene,
    rung: Rung,
    quantities: list[str],
    *,
    runs: int,
    sensors: dict[str, Any] | None = None,
    limit_s: float = math.inf,
) -> Measurement:
    """Run a rung, and time it.

    Args:
        scene: The scene as it is given.
        rung: What to run it on.
        quantities: What to read.
        runs: Runs to time, fewer where they take long.
        sensors: Changes to the scene's own sensors; None to leave the sensors out.
        limit_s: Wall time after which a run is given up as a failure [s].
    """
    placed = rung.scene(scene, sensors=sensors)
    Simulation(placed).warm_up()  # compiling is no part of the cost
    simulated_s = Simulation(placed).end_tick * 1e-6
    walls: list[float] = []
    trace, health = None, {}
    try:
        while len(walls) < runs and (not walls or sum(walls) < _ENOUGH_S):
            simulation = Simulation(placed)
            _ = simulation.first_row
            first = trace is None
            rows, wall = _advance(simulation, keep=first, limit_s=limit_s)
            if not first or runs == 1 or wall > _ENOUGH_S:
                walls.append(wall)
            if first:
                health = simulation.health()
                trace = _trace(scene, rung, simulation, rows, health, "first_impact_time" in quantities)
    except SimulationError as error:
        nothing: dict[str, Value] = dict.fromkeys(quantities, math.nan)
        return Measurement(rung, nothing, None, math.nan, (math.nan, math.nan), 0, 0, math.nan, str(error))
    assert trace is not None
    each = [wall / simulated_s for wall in walls]
    values = {
        name: math.nan
        if QUANTITIES[name].needs_force and rung.levels.contact == "impact"
        else QUANTITIES[name].read(trace)
        for name in quantities
    }
    return Measurement(
        rung=rung,
        values=values,
        trace=trace,
        wall_s=statistics.median(each),
        spread_s=(min(each), max(each)),
        runs=len(each),
        steps=health["steps"],
        residual_share=health["energy"]["residual_share"],
    )


def _advance(simulation: Simulation, *, keep: bool, limit_s: float) -> tuple[list[np.ndarray], float]:
    """Run to the end; rows every 1 ms, and the wall time [s].

    Raises:
        SimulationError: It takes too long: an engine that stalls has to be told from one that is slow.
    """
    # Short blocks where a stall has to be noticed, long ones where time is measured.
    chunk = max(1, (GRID_TICKS if keep else 100_000) // simulation.block_ticks) * simulation.block_ticks
    every = max(1, GRID_TICKS // simulation.row_ticks)
    rows: list[np.ndarray] = []
    wall = 0.0
    while simulation.tick < simulation.end_tick:
        begin = time.perf_counter()
        frame = simulation.advance(min(chunk, simulation.end_tick - simulation.tick))
        wall += time.perf_counter() - begin
        if wall > limit_s:
            raise SimulationError(f"given up after {wall:.0f} s at {simulation.tick * 1e-6:g} s of the scene")
        if keep:
            rows.append(frame.rows[::every].copy())
    return rows, wall


def _trace(
    scene: Scene, rung: Rung, simulation: Simulation, rows: list[np.ndarray], health: dict[str, Any], first: bool
) -> Trace:
    whole = np.concatenate(rows)
    constants = simulation.model.constants
    spacing = max(GRID_TICKS, simulation.row_ticks) / simulation.tick_rate_hz
    return Trace(
        times_s=np.arange(len(whole)) * spacing,
        rows=whole,
        peak_force=health["peak_normal_force_n"],
        clearance=constants.contact.clearance,
        surface_radius=constants.shaft.radius,
        first_impact_s=first_impact(scene, rung) if first else math.nan,
    )


def first_impact(scene: Scene, rung: Rung) -> float:
    """Instant of the first contact [s], nan where there is none: from the gap, its rate and its acceleration before.

    A run of its own, with a row at every step; an adaptive engine's grid is 25 us for it.
    """
    adaptive = ENGINES[rung.engine].tolerance > 0.0
    step_us = min(rung.step_us, _FINEST_ROW_US) if adaptive else rung.step_us
    rate = 1_000_000 // step_us
    fine = replace(rung, step_us=step_us).scene(scene, sensors={**_BARE, "rate_hz": rate, "truth_rate_hz": rate})
    simulation = Simulation(fine)
    block = max(1, GRID_TICKS // simulation.block_ticks) * simulation.block_ticks
    last: np.ndarray | None = None
    while simulation.tick < simulation.end_tick:
        start = simulation.tick
        rows = simulation.advance(min(block, simulation.end_tick - start)).rows
        gap = rows[:, COLUMN["penetration"]]
        touched = np.flatnonzero((gap >= 0.0) | (rows[:, COLUMN["contact_impulse"]] > 0.0))
        hit = int(touched[0]) if len(touched) else len(rows)
        if len(touched) or simulation.health()["contacts"]:
            known = rows[:hit] if last is None else np.concatenate([last[None], rows[:hit]])
            return _crossing(known, start + (hit - 1) * simulation.row_ticks, simulation.row_ticks)
        last = rows[-1].copy()
    return math.nan


def _crossing(rows: np.ndarray, tick: int, row_ticks: int) -> float:
    """Where the gap closes after the last of some rows [s]."""
    if len(rows) == 0:
        return 0.0
    gap, rate = (float(rows[-1, COLUMN[name]]) for name in ("penetration", "penetration_rate"))
    bend = 0.0
    if len(rows) > 1:
        bend = (rate - float(rows[-2, COLUMN["penetration_rate"]])) / (row_ticks * 1e-6)
    root = rate * rate - 2.0 * bend * gap
    if rate <= 0.0 or root < 0.0:
        return tick * 1e-6
    return tick * 1e-6 - 2.0 * gap / (rate + math.sqrt(root))


def check_reads(scene: Scene, measured: Measurement) -> None:
    """Check that a scene has the quantities asked for.

    Raises:
        InputError: It has not.
    """
    for name, value in measured.values.items():
        if not isinstance(value, str) and not math.isfinite(value):
            raise InputError("--quantity", f"one that scene {scene.name} has ({QUANTITIES[name].title})", name)
