"""One candidate measured: a scene run on a model, an engine and a step, with its quantities and its cost."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from replays.studies.common.run import Timed, bare_sensors, run_scene
from replays.studies.ladder.quantity import QUANTITIES, Ending, Trace, Value, ending, slides
from rig.base.errors import InputError, SimulationError
from rig.physics.engines import ENGINES
from rig.physics.kernels.signals import COLUMN
from rig.physics.levels import ModelLevels
from rig.run.scenes import Scene, parse_scene
from rig.run.simulation import Simulation

GRID_TICKS = 1_000
"""Quantities are read every 1 ms."""
_FINEST_ROW_US = 25
"""Instants are looked for on rows this far apart, or a fixed step apart [us]."""
_ENOUGH_S = 1.0
"""No further run is timed once this much processor time is spent on one candidate."""
_LEAST_S = 0.1
"""Two candidates are compared for at least this much processor time."""


@dataclass(frozen=True)
class Candidate:
    """A model, an engine and its step: all that a pick is about."""

    levels: ModelLevels
    drive: str
    engine: str
    step_us: int
    tolerance: float = 0.0
    companion: bool = False
    """Only where a scene as given has one: of all others the search itself tells the error."""

    @property
    def method(self) -> str:
        """Engine and step in words."""
        finest = f", {self.tolerance:.0e}".replace("e-0", "e-") if self.tolerance else ""
        return f"{self.engine} {self.step_us} us{finest}{', companion' if self.companion else ''}"

    @property
    def label(self) -> str:
        """The same with its unit as a figure shows it."""
        return self.method.replace(" us", " µs")

    @property
    def model(self) -> dict[str, str]:
        """The levels by name, the drive among them."""
        return {**self.levels.model_dump(), "drive": self.drive}

    def with_model(self, **levels: str) -> Candidate:
        """The same with some levels changed."""
        drive = levels.pop("drive", self.drive)
        changed = ModelLevels.model_validate({**self.levels.model_dump(), **levels})
        return replace(self, levels=changed, drive=drive)

    def with_engine(self, engine: str, step_us: int, tolerance: float) -> Candidate:
        """The same on another engine, without a companion."""
        return replace(self, engine=engine, step_us=step_us, tolerance=tolerance, companion=False)

    def scene(self, scene: Scene, *, sensors: dict[str, Any] | None = None) -> Scene:
        """The scene on this candidate.

        Args:
            scene: As it is given.
            sensors: Its sensors, changed; None for as good as none.

        Raises:
            InputError: The engine cannot take the model, or its step does not fit the rates of the sensors.
        """
        data = scene.model_dump()
        engine = {"name": self.engine, "step_us": self.step_us, "tolerance": self.tolerance}
        return parse_scene(
            {
                **data,
                "fidelity": "given",
                "pick": None,
                "channels": None,
                "model": self.levels.model_dump(),
                "drive": {**data["drive"], "mode": self.drive},
                "engine": {**engine, "companion": self.companion},
                "sensors": bare_sensors() if sensors is None else {**data["sensors"], **sensors},
            }
        )


@dataclass(frozen=True)
class Measurement:
    """What a candidate gave.

    Attributes:
        candidate: Which one.
        values: By quantity; nan where it has none, or cannot give it.
        ending: How the run ends.
        cpu_s: Processor time of a simulated second, median of the runs, compiling apart [s].
        spread_s: Least and largest of the same.
        runs: Runs timed.
        steps: Steps of the engine.
        residual_share: Energy residual as a part of what was dissipated.
        failure: Why there is no result; empty where there is one.
    """

    candidate: Candidate
    values: dict[str, Value]
    ending: Ending | None
    cpu_s: float
    spread_s: tuple[float, float]
    runs: int
    steps: int
    residual_share: float
    failure: str = ""

    def step_ns(self, simulated_s: float) -> float:
        """Processor time of a step [ns]."""
        return self.cpu_s * simulated_s / max(self.steps, 1) * 1e9


def measure(
    scene: Scene,
    candidate: Candidate,
    quantities: list[str],
    *,
    runs: int,
    sensors: dict[str, Any] | None = None,
    limit_s: float = math.inf,
) -> Measurement:
    """Run a candidate, and time it.

    Args:
        scene: The scene as it is given.
        candidate: What to run it on.
        quantities: What to read.
        runs: Runs to time, fewer where they take long; 1 for values alone, whose time is a rough one.
        sensors: Changes to the scene's own sensors; None to leave the sensors out.
        limit_s: Processor time after which a run is given up as a failure [s].
    """
    placed = candidate.scene(scene, sensors=sensors)
    Simulation(placed).warm_up()  # compiling is no part of the cost
    simulated_s = Simulation(placed).end_tick * 1e-6
    spent: list[float] = []
    trace, health = None, {}
    try:
        while len(spent) < runs and (not spent or sum(spent) < _ENOUGH_S):
            first = trace is None
            simulation, done = _run(placed, limit_s, first=first)
            if not first or runs == 1:
                spent.append(done.cpu_s)
            if first:
                health = simulation.health()
                trace = _trace(scene, candidate, simulation, done.rows, health, quantities)
    except SimulationError as error:
        nothing: dict[str, Value] = dict.fromkeys(quantities, math.nan)
        return Measurement(candidate, nothing, None, math.nan, (math.nan, math.nan), 0, 0, math.nan, str(error))
    assert trace is not None
    each = [seconds / simulated_s for seconds in spent]
    values = {
        name: math.nan
        if QUANTITIES[name].needs_force and candidate.levels.contact == "impact"
        else QUANTITIES[name].read(trace)
        for name in quantities
    }
    return Measurement(
        candidate=candidate,
        values=values,
        ending=ending(trace),
        cpu_s=statistics.median(each),
        spread_s=(min(each), max(each)),
        runs=len(each),
        steps=health["steps"],
        residual_share=health["energy"]["residual_share"],
    )


def saving(
    scene: Scene, simpler: Candidate, fuller: Candidate, *, runs: int, sensors: dict[str, Any], limit_s: float
) -> float:
    """Part of the processor time of a fuller candidate that a simpler one saves, as both will run [1].

    Medians of runs that take turns, so that what else the machine does falls on both; more than `runs` where they are
    short. Both have been measured before, and are compiled.
    """
    placed = [candidate.scene(scene, sensors=sensors) for candidate in (simpler, fuller)]
    spent: list[list[float]] = []
    total_s = 0.0
    while total_s < (_ENOUGH_S if len(spent) < runs else _LEAST_S):
        turn = [_run(each, limit_s)[1].cpu_s for each in placed]
        spent.append(turn)
        total_s += sum(turn)
    medians = np.median(spent, axis=0)
    return float(1.0 - medians[0] / medians[1])


def _run(placed: Scene, limit_s: float, *, first: bool = False) -> tuple[Simulation, Timed]:
    """Run a scene: at first in short blocks, which cost, to notice a stall, and with its rows; else for the time."""
    simulation = Simulation(placed)
    _ = simulation.first_row
    blocks = max(1, (GRID_TICKS if first else 100_000) // simulation.block_ticks)
    every = max(1, GRID_TICKS // simulation.row_ticks)
    ticks = blocks * simulation.block_ticks
    return simulation, run_scene(simulation, block_ticks=ticks, every=every, keep=first, limit_s=limit_s)


def _trace(
    scene: Scene,
    candidate: Candidate,
    simulation: Simulation,
    rows: np.ndarray,
    health: dict[str, Any],
    quantities: list[str],
) -> Trace:
    constants = simulation.model.constants
    spacing = max(GRID_TICKS, simulation.row_ticks) / simulation.tick_rate_hz
    return Trace(
        times_s=np.arange(len(rows)) * spacing,
        rows=rows,
        peak_force=health["peak_normal_force_n"],
        clearance=constants.contact.clearance,
        surface_radius=constants.shaft.radius,
        first_impact_s=first_impact(scene, candidate) if "first_impact_time" in quantities else math.nan,
        rolls_s=_rolls_from(scene, candidate) if "time_to_roll" in quantities else math.nan,
    )


def _finely(scene: Scene, candidate: Candidate) -> Iterator[tuple[Simulation, int, np.ndarray]]:
    """A run of its own with a row at every step, of an adaptive engine every 25 us: blocks, with the tick of each."""
    adaptive = ENGINES[candidate.engine].tolerance > 0.0
    step_us = min(candidate.step_us, _FINEST_ROW_US) if adaptive else candidate.step_us
    rate = 1_000_000 // step_us
    fine = replace(candidate, step_us=step_us).scene(scene, sensors=bare_sensors(rate))
    simulation = Simulation(fine)
    block = max(1, GRID_TICKS // simulation.block_ticks) * simulation.block_ticks
    while (start := simulation.tick) < simulation.end_tick:
        yield simulation, start, simulation.advance(min(block, simulation.end_tick - start)).rows


def _rolls_from(scene: Scene, candidate: Candidate) -> float:
    """When it begins to roll for good [s], nan where it does not."""
    rolls = end = 0
    for simulation, start, rows in _finely(scene, candidate):
        loose = slides(rows, simulation.model.constants.shaft.radius) | (rows[:, COLUMN["penetration"]] <= 0.0)
        if loose.any():
            rolls = start + (int(np.flatnonzero(loose)[-1]) + 1) * simulation.row_ticks
        end = simulation.end_tick
    return rolls * 1e-6 if rolls < end else math.nan


def first_impact(scene: Scene, candidate: Candidate) -> float:
    """Instant of the first contact [s], nan where there is none: from the gap, its rate and its acceleration before."""
    last: np.ndarray | None = None
    for simulation, start, rows in _finely(scene, candidate):
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
