"""Measurement of one candidate: a scene run with a model, an engine and a step, its quantities and its cost."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from replays.studies.common.run import Timed, bare_sensors, run_scene
from replays.studies.ladder.quantity import QUANTITIES, Ending, Trace, Value, find_ending, find_sliding
from rig.base.errors import InputError, SimulationError
from rig.physics.engines import ENGINES
from rig.physics.kernels.signals import COLUMN
from rig.physics.levels import ModelLevels
from rig.run.scenes import Scene, parse_scene
from rig.run.simulation import Simulation

GRID_TICKS = 1_000
"""Ticks between the rows from which quantities are computed, 1 ms."""
_FINEST_ROW_US = 25
"""Largest spacing of rows, or a fixed step, for locating instants [us]."""
_MAX_CPU_S = 1.0
"""Processor time after which no further run of a candidate is timed [s]."""
_MIN_COMPARISON_S = 0.1
"""Least processor time of a comparison of two candidates [s]."""


@dataclass(frozen=True)
class Candidate:
    """A model, an engine and its step, as stored in a pick."""

    levels: ModelLevels
    drive: str
    engine: str
    step_us: int
    tolerance: float = 0.0
    companion: bool = False
    """True with a companion run, only for a scene as given; the search itself determines all other errors."""

    @property
    def method(self) -> str:
        """Engine and step in words."""
        finest = f", {self.tolerance:.0e}".replace("e-0", "e-") if self.tolerance else ""
        return f"{self.engine} {self.step_us} us{finest}{', companion' if self.companion else ''}"

    @property
    def label(self) -> str:
        """Engine and step with the unit as in a figure."""
        return self.method.replace(" us", " µs")

    @property
    def model(self) -> dict[str, str]:
        """Levels by name, including the drive."""
        return {**self.levels.model_dump(), "drive": self.drive}

    def with_model(self, **levels: str) -> Candidate:
        """Return the candidate with some levels changed."""
        drive = levels.pop("drive", self.drive)
        changed = ModelLevels.model_validate({**self.levels.model_dump(), **levels})
        return replace(self, levels=changed, drive=drive)

    def with_engine(self, engine: str, step_us: int, tolerance: float) -> Candidate:
        """Return the candidate on another engine, without a companion run."""
        return replace(self, engine=engine, step_us=step_us, tolerance=tolerance, companion=False)

    def scene(self, scene: Scene, *, sensors: dict[str, Any] | None = None) -> Scene:
        """Return the scene for this candidate.

        Args:
            scene: The scene as given.
            sensors: Changes to its sensors; None for the minimum of sensors.

        Raises:
            InputError: If the engine does not support the model, or its step does not fit the sample rates.
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
    """Result of a candidate.

    Attributes:
        candidate: The candidate.
        values: Values by quantity; NaN if there is none.
        ending: Outcome of the run.
        cpu_s: Processor time per simulated second, median of the runs without compilation [s].
        spread_s: Minimum and maximum of the same.
        runs: Number of timed runs.
        steps: Steps of the engine.
        residual_share: Energy residual as a part of the dissipated energy.
        failure: Reason for a missing result; otherwise empty.
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
        """Return the processor time per step [ns]."""
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
    """Run a candidate and time it.

    Args:
        scene: The scene as given.
        candidate: Model, engine and step to run.
        quantities: Quantities to compute.
        runs: Number of timed runs, reduced for long runs; 1 if only values matter and a rough time is sufficient.
        sensors: Changes to the scene's own sensors; None to leave the sensors out.
        limit_s: Processor time after which a run counts as failed [s].
    """
    placed = candidate.scene(scene, sensors=sensors)
    Simulation(placed).warm_up()  # excludes compilation from the cost
    simulated_s = Simulation(placed).end_tick * 1e-6
    spent: list[float] = []
    trace, health = None, {}
    try:
        while len(spent) < runs and (not spent or sum(spent) < _MAX_CPU_S):
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
        ending=find_ending(trace),
        cpu_s=statistics.median(each),
        spread_s=(min(each), max(each)),
        runs=len(each),
        steps=health["steps"],
        residual_share=health["energy"]["residual_share"],
    )


def compute_saving(
    scene: Scene, simpler: Candidate, fuller: Candidate, *, runs: int, sensors: dict[str, Any], limit_s: float
) -> float:
    """Return the part of a fuller candidate's processor time that a simpler one saves, with the scene's sensors [1].

    Compares medians of alternating runs, so that other load affects both; short runs are repeated more than `runs`
    times. Both candidates must have been measured before, so that they are compiled.
    """
    placed = [candidate.scene(scene, sensors=sensors) for candidate in (simpler, fuller)]
    spent: list[list[float]] = []
    total_s = 0.0
    while total_s < (_MAX_CPU_S if len(spent) < runs else _MIN_COMPARISON_S):
        turn = [_run(each, limit_s)[1].cpu_s for each in placed]
        spent.append(turn)
        total_s += sum(turn)
    medians = np.median(spent, axis=0)
    return float(1.0 - medians[0] / medians[1])


def _run(placed: Scene, limit_s: float, *, first: bool = False) -> tuple[Simulation, Timed]:
    """Run a scene: the first time with rows and in short blocks, which detect a stall; later only for timing."""
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
        rolls_s=_find_rolling_start(scene, candidate) if "time_to_roll" in quantities else math.nan,
    )


def _run_every_step(scene: Scene, candidate: Candidate) -> Iterator[tuple[Simulation, int, np.ndarray]]:
    """Yield blocks of a separate run, with their start ticks: a row per step, or every 25 us for an adaptive engine."""
    adaptive = ENGINES[candidate.engine].tolerance > 0.0
    step_us = min(candidate.step_us, _FINEST_ROW_US) if adaptive else candidate.step_us
    rate = 1_000_000 // step_us
    fine = replace(candidate, step_us=step_us).scene(scene, sensors=bare_sensors(rate))
    simulation = Simulation(fine)
    block = max(1, GRID_TICKS // simulation.block_ticks) * simulation.block_ticks
    while (start := simulation.tick) < simulation.end_tick:
        yield simulation, start, simulation.advance(min(block, simulation.end_tick - start)).rows


def _find_rolling_start(scene: Scene, candidate: Candidate) -> float:
    """Return the start of lasting rolling [s]; NaN if there is none."""
    rolls = end = 0
    for simulation, start, rows in _run_every_step(scene, candidate):
        loose = find_sliding(rows, simulation.model.constants.shaft.radius) | (rows[:, COLUMN["penetration"]] <= 0.0)
        if loose.any():
            rolls = start + (int(np.flatnonzero(loose)[-1]) + 1) * simulation.row_ticks
        end = simulation.end_tick
    return rolls * 1e-6 if rolls < end else math.nan


def first_impact(scene: Scene, candidate: Candidate) -> float:
    """Return the time of first contact [s], extrapolated from gap, gap rate and acceleration; NaN if none."""
    last: np.ndarray | None = None
    for simulation, start, rows in _run_every_step(scene, candidate):
        gap = rows[:, COLUMN["penetration"]]
        touched = np.flatnonzero((gap >= 0.0) | (rows[:, COLUMN["contact_impulse"]] > 0.0))
        hit = int(touched[0]) if len(touched) else len(rows)
        if len(touched) or simulation.health()["contacts"]:
            table = rows[:hit] if last is None else np.concatenate([last[None], rows[:hit]])
            return _find_crossing(table, start + (hit - 1) * simulation.row_ticks, simulation.row_ticks)
        last = rows[-1].copy()
    return math.nan


def _find_crossing(rows: np.ndarray, tick: int, row_ticks: int) -> float:
    """Return the time at which the gap closes after the last row [s]."""
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
    """Check that a scene has the requested quantities.

    Raises:
        InputError: If a quantity is missing.
    """
    for name, value in measured.values.items():
        if not isinstance(value, str) and not math.isfinite(value):
            raise InputError("--quantity", f"one that scene {scene.name} has ({QUANTITIES[name].title})", name)
