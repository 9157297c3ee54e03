"""Engines and steps for a candidate: the reference's, those that stand beside it, those that are tried."""

from __future__ import annotations

from replays.studies.ladder.measurement import Candidate
from rig.base.errors import InputError
from rig.physics.engines import ENGINES
from rig.run.scenes import Scene

REFERENCE = ("rk8", 25, 1e-10)
UNLIKE = "split"
"""Another method at its finest; it converges the models that the reference's cannot take."""
_FINEST = 1e-3
"""Of an engine's own tolerance; an engine without one is at its finest with steps of 1 us."""
_GRIDS = (1000, 500, 250, 200, 125, 100, 50, 25, 20, 10, 5)
_STEPS = (1, 2, 5, 10, 20, 25, 40, 50, 100)


def takes(engine: str, candidate: Candidate) -> bool:
    """Whether an engine takes a model."""
    method = ENGINES[engine]
    return candidate.levels.friction in method.frictions and candidate.levels.contact in method.contacts


def converged(candidate: Candidate) -> Candidate:
    """A model on the engine of the reference, or on the unlike one at its finest where that cannot take it."""
    return candidate.with_engine(*(REFERENCE if takes(REFERENCE[0], candidate) else finest(UNLIKE)))


def finest(engine: str) -> tuple[str, int, float]:
    """An engine at its finest."""
    method = ENGINES[engine]
    return (engine, method.step_us, _FINEST * method.tolerance) if method.tolerance else (engine, 1, 0.0)


def usual(scene: Scene, candidate: Candidate, engine: str) -> tuple[str, int, float]:
    """An engine at its own tolerance, and its own step or the longest below it that fits the sample rates."""
    method = ENGINES[engine]
    steps = (step for step in _GRIDS if step <= method.step_us and _fits(scene, candidate, engine, step))
    return engine, next(steps, method.step_us), method.tolerance


def as_given(scene: Scene) -> Candidate:
    """The scene's own model, engine and step."""
    engine = scene.engine
    return Candidate(
        scene.model, scene.drive.mode, engine.name, engine.step_us, engine.tolerance, companion=engine.companion
    )


def tried(scene: Scene, candidate: Candidate) -> dict[str, list[tuple[int, float]]]:
    """Steps, or tolerances, of every engine that takes a model and fits the sample rates, the finest first."""
    found: dict[str, list[tuple[int, float]]] = {}
    for engine, method in ENGINES.items():
        if not takes(engine, candidate):
            continue
        if method.tolerance:
            grids = [step for step in _GRIDS if step <= method.step_us and _fits(scene, candidate, engine, step)]
            scales = (1e-2, 1.0, 1e2)
            found[engine] = [(grids[0], method.tolerance * scale) for scale in scales] if grids else []
        else:
            steps = [step for step in _STEPS if 0.2 * method.step_us <= step <= 4.0 * method.step_us]
            found[engine] = [(step, 0.0) for step in steps if _fits(scene, candidate, engine, step)]
    return found


def _fits(scene: Scene, candidate: Candidate, engine: str, step_us: int) -> bool:
    try:
        for sensors in ({}, None):  # as it will run, and as it is measured
            candidate.with_engine(engine, step_us, ENGINES[engine].tolerance).scene(scene, sensors=sensors)
    except InputError:
        return False
    return True
