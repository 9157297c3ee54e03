"""Trials of whole simulations (T12, T13): independence of block lengths, and warnings."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from replays.studies.common.engines import is_adaptive, supported_friction, traits
from replays.studies.common.run import bare_sensors
from replays.studies.stability.trials.cell import Cell
from rig.base.errors import SimulationError
from rig.physics.engine_choice import EngineChoice
from rig.physics.engines import ENGINES
from rig.run.scenes import Scene, load_scene
from rig.run.simulation import Simulation


def engine_scene(name: str, **choice: float) -> Scene:
    """Return the hammer scene for an engine, by default at its own step and tolerance, with minimal sensors."""
    scene = load_scene("hammer")
    method = ENGINES[name]
    settings = {"name": name, "step_us": method.step_us, "tolerance": method.tolerance, **choice}
    engine = EngineChoice.model_validate(settings)
    levels = scene.model.model_copy(update={"friction": supported_friction(name)})
    sensors = scene.sensors.model_copy(update={**bare_sensors(), "groups": ("hammer",)})
    return scene.model_copy(update={"engine": engine, "model": levels, "sensors": sensors})


def bit_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T12: equal bits for any block length and after a restart."""
    scene = engine_scene(engine)
    total = 200 if quick else 1000
    whole = Simulation(scene).advance(total * 1000).rows
    cut = Simulation(scene)
    parts = np.vstack([cut.advance(1000).rows.copy() for _ in range(total)])
    yield Cell("frames of 1 ms against one run", float(np.sum(parts != whole)), 0.0,
               "a call's length is none of the engine's business", unit="numbers differ")  # fmt: skip
    first, second = Simulation(scene), Simulation(scene)
    first.advance(total * 500)
    kept = first.snapshot()
    first.advance(total * 500)
    second.restore(kept)
    again = second.advance(total * 500).rows
    yield Cell("restart from a snapshot", float(np.sum(again != whole[total // 2 :])), 0.0,
               "a snapshot holds all that changes", unit="numbers differ")  # fmt: skip


def _is_poisoned(engine: str) -> bool:
    """Return whether a force law that turns to NaN ends the run with an error."""
    simulation = Simulation(engine_scene(engine))
    constants = simulation.model.constants
    shaft = constants.shaft._replace(gravity=math.nan)
    simulation.model = replace(simulation.model, constants=constants._replace(shaft=shaft))
    try:
        with np.errstate(all="ignore"):
            simulation.advance(10_000)
    except SimulationError:
        return True
    return False


def collect_warnings(scene: Scene, ticks: int) -> list[str]:
    """Return the warnings and remarks of a run at its end, or the error that ended it."""
    simulation = Simulation(scene)
    try:
        # In blocks of 1 ms, so that a value that is not finite ends the run at once.
        with np.errstate(all="ignore"):
            for _ in range(ticks // 1000):
                simulation.advance(1000)
    except SimulationError as error:
        return [str(error)]
    health = simulation.health()
    return health["warnings"] + health["remarks"]


def _is_silent(warnings: list[str], *words: str) -> float:
    """Return 0 if a warning contains one of the words, otherwise 1."""
    return float(not any(word in warning for warning in warnings for word in words))


def warning_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T13: a run warns of problems."""
    yield Cell("nan", float(not _is_poisoned(engine)), 0.0, "the state is checked", unit="silent")
    # A step of 1 ms is much too long without error control; with it, use a tolerance that cannot be met.
    if is_adaptive(engine):
        warnings = collect_warnings(engine_scene(engine, step_us=500, tolerance=1e-30), 1000)
        yield Cell("tolerance out of reach", _is_silent(warnings, "engine.tolerance"), 0.0,
                   "the step's ceiling is counted", unit="silent")  # fmt: skip
    else:
        for case, step in (("step of 100 us", 100), ("step of 1 ms", 1000)):
            warnings = collect_warnings(engine_scene(engine, step_us=step), traits(engine).warned_within_ticks)
            silent, because = _is_silent(warnings, "energy residual ", "finite"), "the ledger sees it"
            yield Cell(case, silent, 0.0, because, unit="silent")
    base = engine_scene(engine)
    for case, word, floor_mm_s in (("v0 at its floor", "speed_floor", 50.0), ("law that would pull", "pulled", 1.0)):
        drop = load_scene("drop", {"contact.damping_factor": 1.4328, "contact.speed_floor": floor_mm_s})
        drop = drop.model_copy(update={"engine": base.engine, "model": base.model, "sensors": base.sensors})
        yield Cell(case, _is_silent(collect_warnings(drop, 500_000), word), 0.0, "counted", unit="silent")
