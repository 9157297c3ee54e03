"""Down the ladder: one level at a time from the full model, then what passes together, then the cheapest engine.

Never all combinations, and never the sum of single errors: what is picked has been run. Model errors compare converged
runs; numerical errors compare one model on two engines; the total compares the pick with the full model's reference.
The path depends on errors alone, but for the last choice between engines, where a tenth in cost decides nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, get_args

from replays.studies.ladder.measurement import Measurement, Rung, check_reads, measure
from replays.studies.ladder.quantity import QUANTITIES, Value
from rig.engines import ENGINES
from rig.errors import InputError
from rig.levels import ModelLevels
from rig.scenes import Scene

LEVELS: dict[str, tuple[str, ...]] = {
    **{name: get_args(entry.annotation) for name, entry in ModelLevels.model_fields.items()},
    "drive": ("ideal", "torque"),
}
"""Rungs of every level, the simplest first."""
SENSORS = "sensors"
KEEPABLE = (*LEVELS, SENSORS)
STAND_INS = ("smoothed", "switch")
"""Friction laws that stand in for the exact one: measured, not picked, for they spare no work."""
TIE = 1.1
"""Costs this close are the same: timings have no finer meaning."""
DEARER = 1.25
"""A lowered level that takes this many times the steps of the higher one spares nothing."""
_REFERENCE = ("rk8", 25, 1e-10)
_UNLIKE = ("split", 1, 0.0)
"""Another method in other coordinates; the converged engine of models that the reference's cannot take."""
_GRIDS = (1000, 500, 250, 200, 125, 100, 50, 25, 20, 10, 5)
_STEPS = (1, 2, 5, 10, 20, 25, 40, 50, 100)


@dataclass(frozen=True)
class Errors:
    """Errors of one rung by quantity, as parts of their scales; nan where a part was not asked for."""

    model: dict[str, float]
    numerical: dict[str, float]
    total: dict[str, float]

    def worst(self, tolerances: dict[str, float]) -> float:
        """The largest of all in units of the tolerance, infinite where a quantity cannot be given."""
        ratios = [
            value / tolerances[name]
            for errors in (self.model, self.numerical, self.total)
            for name, value in errors.items()
            if not math.isnan(value)
        ]
        return max(ratios, default=math.inf)


@dataclass(frozen=True)
class Step:
    """One thing tried."""

    stage: str
    label: str
    measured: Measurement
    errors: Errors
    passes: bool
    cost: Measurement | None = None
    """On an engine for use, where `measured` is a converged run."""
    note: str = ""


@dataclass
class Ladder:
    """What a search has found.

    Attributes:
        scene: The scene as it is given.
        tolerances: By quantity.
        reference: The full model, converged.
        reference_errors: Its distance from the unlike engine.
        steps: Everything tried, in order.
        picked: What is picked, as it will run.
        picked_errors: Its errors.
        given: The scene as it is given.
        full: The full model on the engine of the reference, with the scene's own sensors.
        sensors: The chain that is picked.
        spent_s: Wall time of the search [s].
        complete: False where the budget ended the search of engines.
    """

    scene: Scene
    tolerances: dict[str, float]
    reference: Measurement
    unlike: Measurement
    reference_errors: dict[str, float]
    steps: list[Step] = field(default_factory=list)
    picked: Measurement | None = None
    picked_errors: Errors | None = None
    given: Measurement | None = None
    given_errors: Errors | None = None
    full: Measurement | None = None
    sensors: str = "full"
    spent_s: float = 0.0
    complete: bool = True


def search(
    scene: Scene,
    tolerances: dict[str, float],
    *,
    keep: tuple[str, ...] = (),
    runs: int = 3,
    budget_s: float = 300.0,
    progress: Callable[[str], None] = lambda _: None,
) -> Ladder:
    """Find the cheapest model, engine and step that meets every tolerance.

    Args:
        scene: The scene as it is given.
        tolerances: Error allowed to each quantity, as a part of its scale.
        keep: Levels that stay as full as they are.
        runs: Timed runs of each rung.
        budget_s: Wall time [s].
        progress: Told what is tried.

    Raises:
        InputError: The scene has no such quantity, the tolerance is below the reference's own error, no combination
            meets it, or the budget ends before there is a pick.
    """
    for name in keep:
        if name not in KEEPABLE:
            raise InputError("--keep", f"one of {', '.join(KEEPABLE)}", name)
    begin = time.perf_counter()
    names = list(tolerances)

    def left() -> float:
        return budget_s - (time.perf_counter() - begin)

    def run(rung: Rung, **options: Any) -> Measurement:
        if left() <= 0.0:
            raise InputError("--budget-s", "longer: it ended before there was a pick", budget_s)
        return measure(scene, rung, names, **{"runs": runs, "limit_s": left(), **options})

    # Of model levels the top rung is full, of the drive the scene's own.
    full = Rung(ModelLevels(**{name: rungs[-1] for name, rungs in LEVELS.items() if name != "drive"}),  # pyright: ignore[reportArgumentType]
                scene.drive.mode, *_REFERENCE)  # fmt: skip
    progress(f"full model, {full.method}, and {_UNLIKE[0]} {_UNLIKE[1]} us beside it")
    reference = run(full)
    unlike = run(full.with_engine(*_UNLIKE), runs=1)
    _raise_failure(reference, unlike)
    check_reads(scene, reference)
    base = reference.trace
    assert base is not None

    def against(value: dict[str, Value], reference: dict[str, Value]) -> dict[str, float]:
        return {name: QUANTITIES[name].error(value[name], reference[name], base) for name in names}

    own = {
        name: max(error, _resolution(name, reference))
        for name, error in against(unlike.values, reference.values).items()
    }
    for name, error in own.items():
        if error > 0.5 * tolerances[name]:
            must = f"at least {2.0 * error:.2g} for {name}, twice the reference's own error"
            raise InputError("--tolerance", must, tolerances[name])
    # What the reference may be wrong by is taken off what is allowed.
    allowed = {name: tolerances[name] - own[name] for name in names}
    ladder = Ladder(scene, tolerances, reference, unlike, own)

    # One level at a time.
    top = full.with_engine(*_usual("split"))
    top_cost = run(top)
    _note(ladder, "full", "full model", reference, Errors({}, {}, own), allowed, cost=top_cost)
    single: dict[str, dict[str, float]] = {}
    for level, rungs in LEVELS.items():
        own_rung = full.model[level]
        for rung in rungs[: rungs.index(own_rung)]:
            lowered = full.with_model(**{level: rung})
            progress(f"{level} {rung}")
            converged = run(_converged(lowered), runs=1)
            cost = run(lowered.with_engine(*_usual(_cheap_engine(lowered))))
            errors = Errors(against(converged.values, reference.values), {}, {})
            stand_in = rung in STAND_INS
            # By count, not by clock: the way down has to be the same each time.
            dearer = not stand_in and cost.steps > DEARER * top_cost.steps
            note = "stands in for exact, spares no work" if stand_in else "spares nothing" if dearer else ""
            step = _note(ladder, "single", f"{level} {rung}", converged, errors, allowed, cost=cost, note=note)
            if step.passes and not stand_in and not dearer and level not in keep:
                single.setdefault(level, {})[rung] = errors.worst(allowed)

    # Together: all that pass alone; where they fail together, the worst of them goes back up.
    chosen = {level: next(iter(rungs)) for level, rungs in single.items()}
    best: Measurement | None = None
    while best is None:
        combined = full.with_model(**chosen)
        label = ", ".join(f"{level} {rung}" for level, rung in chosen.items()) or "full model"
        progress(f"together: {label}")
        converged = run(_converged(combined), runs=1) if chosen else reference
        errors = Errors(against(converged.values, reference.values), {}, {})
        cost = run(combined.with_engine(*_usual(_cheap_engine(combined))))
        if _note(ladder, "together", label, converged, errors, allowed, cost=cost).passes:
            best = converged
            break
        worst = max(chosen, key=lambda level: single[level][chosen[level]])
        rungs = list(single[worst])
        higher = rungs[rungs.index(chosen[worst]) + 1 :]
        if higher:
            chosen[worst] = higher[0]
        else:
            del chosen[worst]

    # Engines and steps, the finest first: a setting holds only if every finer one of its engine holds.
    passing: list[tuple[Step, int]] = []
    for place, (engine, settings) in enumerate(_settings(scene, best.rung).items()):
        for step_us, tolerance in settings:
            if left() <= 0.2 * budget_s and passing:
                ladder.complete = False
                break
            rung = best.rung.with_engine(engine, step_us, tolerance)
            progress(rung.method)
            # What takes longer than the reference is of no interest, and may be a stall.
            done = run(rung, limit_s=max(1.0, 5.0 * reference.wall_s * scene.duration_s))
            errors = Errors(
                against(best.values, reference.values),
                against(done.values, best.values),
                against(done.values, reference.values),
            )
            step = _note(ladder, "engine", rung.method, done, errors, allowed, note=done.failure)
            if not step.passes:
                break
            passing.append((step, place))

    # The cheapest, verified as it will run.
    ladder.given = run(_given(scene), sensors={})
    ladder.given_errors = Errors({}, {}, against(ladder.given.values, reference.values))
    ladder.full = run(full.with_engine(*_usual("rk8")), sensors={})
    ladder.sensors = scene.sensors.chain if SENSORS in keep else "ideal"
    while passing:
        least = min(step.measured.wall_s for step, _ in passing)
        near = [entry for entry in passing if entry[0].measured.wall_s <= TIE * least]
        taken = min(
            near, key=lambda entry: (entry[1], -entry[0].measured.rung.step_us, -entry[0].measured.rung.tolerance)
        )
        progress(f"verifying {taken[0].label} as it will run")
        done = run(taken[0].measured.rung, sensors={"chain": ladder.sensors})
        errors = Errors(
            against(best.values, reference.values),
            against(done.values, best.values),
            against(done.values, reference.values),
        )
        if _note(ladder, "verified", taken[0].label, done, errors, allowed, note=done.failure).passes:
            ladder.picked, ladder.picked_errors = done, errors
            break
        passing.remove(taken)
    ladder.spent_s = time.perf_counter() - begin
    if ladder.picked is None:
        raise InputError("--tolerance", "wider: no engine meets it on the levels that do", list(tolerances.values()))
    return ladder


def _note(
    ladder: Ladder,
    stage: str,
    label: str,
    measured: Measurement,
    errors: Errors,
    allowed: dict[str, float],
    *,
    cost: Measurement | None = None,
    note: str = "",
) -> Step:
    passes = not measured.failure and errors.worst(allowed) <= 1.0
    step = Step(stage, label, measured, errors, passes, cost, note)
    ladder.steps.append(step)
    return step


def _raise_failure(*runs: Measurement) -> None:
    for measured in runs:
        if measured.failure:
            raise InputError("scene", f"one that the reference can run ({measured.failure})", measured.rung.method)


def _resolution(name: str, reference: Measurement) -> float:
    """What the reading itself leaves open, as a part of the scale."""
    quantity, value = QUANTITIES[name], reference.values[name]
    if quantity.resolution == 0.0 or isinstance(value, str) or value == 0.0:
        return 0.0
    return quantity.resolution / abs(value)


def _takes(engine: str, rung: Rung) -> bool:
    method = ENGINES[engine]
    return rung.levels.friction in method.frictions and rung.levels.contact in method.contacts


def _converged(rung: Rung) -> Rung:
    """A model on the engine of the reference, or on the unlike one at its finest where that cannot take it."""
    return rung.with_engine(*(_REFERENCE if _takes(_REFERENCE[0], rung) else _UNLIKE))


def _cheap_engine(rung: Rung) -> str:
    """The default engine, or the first that takes the model."""
    return next(engine for engine in ENGINES if _takes(engine, rung))


def _usual(engine: str) -> tuple[str, int, float]:
    method = ENGINES[engine]
    return engine, method.step_us, method.tolerance


def _given(scene: Scene) -> Rung:
    return Rung(scene.model, scene.drive.mode, scene.engine.name, scene.engine.step_us, scene.engine.tolerance)


def _settings(scene: Scene, rung: Rung) -> dict[str, list[tuple[int, float]]]:
    """Steps, or tolerances, of every engine that takes a model and fits the sample rates, the finest first."""
    settings: dict[str, list[tuple[int, float]]] = {}
    for engine, method in ENGINES.items():
        if not _takes(engine, rung):
            continue
        if method.tolerance:
            grids = [step for step in _GRIDS if step <= method.step_us and _fits(scene, rung, engine, step)]
            scales = (1e-2, 1.0, 1e2)
            settings[engine] = [(grids[0], method.tolerance * scale) for scale in scales] if grids else []
        else:
            steps = [step for step in _STEPS if 0.2 * method.step_us <= step <= 4.0 * method.step_us]
            settings[engine] = [(step, 0.0) for step in steps if _fits(scene, rung, engine, step)]
    return settings


def _fits(scene: Scene, rung: Rung, engine: str, step_us: int) -> bool:
    try:
        for sensors in ({}, None):  # as it will run, and as it is measured
            rung.with_engine(engine, step_us, 0.0).scene(scene, sensors=sensors)
    except InputError:
        return False
    return True
