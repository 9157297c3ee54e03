"""Engines and steps for a candidate: the reference's, the cross-check's, and those of the search."""

from __future__ import annotations

from replays.studies.ladder.measurement import Candidate
from rig.base.errors import InputError
from rig.physics.engines import ENGINES
from rig.run.scenes import Scene

REFERENCE = ("rk8", 25, 1e-10)
UNLIKE = "split"
"""Engine for the cross-check, at its finest setting; also converges models that the reference engine cannot run."""
_FINEST_FACTOR = 1e-3
"""Factor on an engine's own tolerance for its finest setting; a fixed-step engine uses steps of 1 us."""
_GRIDS = (1000, 500, 250, 200, 125, 100, 50, 25, 20, 10, 5)
_STEPS = (1, 2, 5, 10, 20, 25, 40, 50, 100)


def supports(engine: str, candidate: Candidate) -> bool:
    """Return whether an engine supports a model."""
    method = ENGINES[engine]
    return candidate.levels.friction in method.frictions and candidate.levels.contact in method.contacts


def converged(candidate: Candidate) -> Candidate:
    """Return a model on the reference engine, or on the cross-check engine if the former does not support it."""
    return candidate.with_engine(*(REFERENCE if supports(REFERENCE[0], candidate) else finest_setting(UNLIKE)))


def finest_setting(engine: str) -> tuple[str, int, float]:
    """Return an engine at its finest setting."""
    method = ENGINES[engine]
    return (engine, method.step_us, _FINEST_FACTOR * method.tolerance) if method.tolerance else (engine, 1, 0.0)


def own_setting(scene: Scene, candidate: Candidate, engine: str) -> tuple[str, int, float]:
    """Return an engine at its own tolerance and step, or at the longest shorter step that fits the sample rates."""
    method = ENGINES[engine]
    steps = (step for step in _GRIDS if step <= method.step_us and _fits(scene, candidate, engine, step))
    return engine, next(steps, method.step_us), method.tolerance


def own_candidate(scene: Scene) -> Candidate:
    """Return the scene's own model, engine and step."""
    engine = scene.engine
    return Candidate(
        scene.model, scene.drive.mode, engine.name, engine.step_us, engine.tolerance, companion=engine.companion
    )


def list_settings(scene: Scene, candidate: Candidate) -> dict[str, list[tuple[int, float]]]:
    """Return steps and tolerances, finest first, of every engine that supports a model and fits the sample rates."""
    settings: dict[str, list[tuple[int, float]]] = {}
    for engine, method in ENGINES.items():
        if not supports(engine, candidate):
            continue
        if method.tolerance:
            grids = [step for step in _GRIDS if step <= method.step_us and _fits(scene, candidate, engine, step)]
            scales = (1e-2, 1.0, 1e2)
            settings[engine] = [(grids[0], method.tolerance * scale) for scale in scales] if grids else []
        else:
            steps = [step for step in _STEPS if 0.2 * method.step_us <= step <= 4.0 * method.step_us]
            settings[engine] = [(step, 0.0) for step in steps if _fits(scene, candidate, engine, step)]
    return settings


def _fits(scene: Scene, candidate: Candidate, engine: str, step_us: int) -> bool:
    try:
        for sensors in ({}, None):  # as it will run, and as it is measured
            candidate.with_engine(engine, step_us, ENGINES[engine].tolerance).scene(scene, sensors=sensors)
    except InputError:
        return False
    return True
