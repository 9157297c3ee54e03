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
from typing import Any, NamedTuple, get_args

from replays.studies.ladder.measurement import Candidate, Measurement, check_reads, measure
from replays.studies.ladder.quantity import QUANTITIES, Trace, Value
from rig.engines import ENGINES
from rig.errors import InputError
from rig.levels import ModelLevels
from rig.scenes import Scene

LEVELS: dict[str, tuple[str, ...]] = {
    **{name: get_args(entry.annotation) for name, entry in ModelLevels.model_fields.items()},
    "drive": ("ideal", "torque"),
}
"""Choices of every level, the simplest first."""
SENSORS = "sensors"
KEEPABLE = (*LEVELS, SENSORS)
STAND_INS = ("smoothed", "switch")
"""Friction laws that stand in for the exact one: measured, not picked, for they spare no work."""
TIE = 1.1
"""Costs this close are the same: timings have no finer meaning."""
COSTLIER = 1.25
"""A lowered level that takes this many times the steps of the higher one spares nothing."""
_REFERENCE = ("rk8", 25, 1e-10)
_UNLIKE = ("split", 1, 0.0)
"""Another method in other coordinates; the converged engine of models that the reference's cannot take."""
_GRIDS = (1000, 500, 250, 200, 125, 100, 50, 25, 20, 10, 5)
_STEPS = (1, 2, 5, 10, 20, 25, 40, 50, 100)
_SPARE = 0.2
"""Part of the budget that is left to the verification."""


@dataclass(frozen=True)
class Errors:
    """Errors of one candidate by quantity, as parts of their scales; empty where a part was not asked for."""

    model: dict[str, float] = field(default_factory=dict)
    numerical: dict[str, float] = field(default_factory=dict)
    total: dict[str, float] = field(default_factory=dict)

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


@dataclass(frozen=True)
class Ladder:
    """What a search has found.

    Attributes:
        scene: The scene as it is given.
        tolerances: By quantity.
        reference: The full model, converged.
        unlike: The same by the unlike engine.
        reference_errors: Their distance.
        steps: Everything tried, in order.
        picked: What is picked, as it will run.
        picked_errors: Its errors.
        given: The scene as it is given.
        given_errors: Its total errors.
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
    steps: tuple[Step, ...]
    picked: Measurement
    picked_errors: Errors
    given: Measurement
    given_errors: dict[str, float]
    full: Measurement
    sensors: str
    spent_s: float
    complete: bool


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
        runs: Timed runs of each candidate.
        budget_s: Wall time [s].
        progress: Told what is tried.

    Raises:
        InputError: The scene has no such quantity, the tolerance is below the reference's own error, no combination
            meets it, or the budget ends before there is a pick.
    """
    for name in keep:
        if name not in KEEPABLE:
            raise InputError("--keep", f"one of {', '.join(KEEPABLE)}", name)
    work = _Work(scene, tolerances, runs, budget_s, progress)
    standard = _standard(work)
    best = _together(work, standard, _one_at_a_time(work, standard, keep))
    passing, complete = _engines(work, standard, best)
    given = work.run(_given(scene), sensors={})
    full = work.run(standard.full.with_engine(*_usual("rk8")), sensors={})
    sensors = scene.sensors.chain if SENSORS in keep else "ideal"
    picked = _verified(work, standard, best, passing, sensors)
    return Ladder(
        scene=scene,
        tolerances=tolerances,
        reference=standard.reference,
        unlike=standard.unlike,
        reference_errors=standard.errors,
        steps=tuple(work.steps),
        picked=picked.measured,
        picked_errors=picked.errors,
        given=given,
        given_errors=standard.against(given.values, standard.reference.values),
        full=full,
        sensors=sensors,
        spent_s=work.spent_s,
        complete=complete,
    )


@dataclass
class _Work:
    """A search under way: what is asked, and everything tried so far."""

    scene: Scene
    tolerances: dict[str, float]
    runs: int
    budget_s: float
    progress: Callable[[str], None]
    steps: list[Step] = field(default_factory=list)
    _begin: float = field(default_factory=time.perf_counter)

    @property
    def spent_s(self) -> float:
        """Wall time so far [s]."""
        return time.perf_counter() - self._begin

    @property
    def left_s(self) -> float:
        """What is left of the budget [s]."""
        return self.budget_s - self.spent_s

    def run(self, candidate: Candidate, **options: Any) -> Measurement:
        """Measure a candidate while there is time."""
        if self.left_s <= 0.0:
            raise InputError("--budget-s", "longer: it ended before there was a pick", self.budget_s)
        options = {"runs": self.runs, "limit_s": self.left_s, **options}
        return measure(self.scene, candidate, list(self.tolerances), **options)

    def cost(self, candidate: Candidate) -> Measurement:
        """A model on the first engine that takes it, at that engine's own step."""
        return self.run(candidate.with_engine(*_usual(_cheap_engine(candidate))))


class _Standard(NamedTuple):
    """What everything is held against."""

    full: Candidate
    reference: Measurement
    unlike: Measurement
    errors: dict[str, float]
    """What the reference itself may be wrong by."""
    allowed: dict[str, float]
    """The tolerances less that."""
    trace: Trace

    def against(self, values: dict[str, Value], others: dict[str, Value]) -> dict[str, float]:
        """Errors of some values against others."""
        return {name: QUANTITIES[name].error(values[name], others[name], self.trace) for name in values}

    def model_errors(self, converged: Measurement) -> Errors:
        """Errors of a model by a converged run of it."""
        return Errors(model=self.against(converged.values, self.reference.values))

    def all_errors(self, done: Measurement, best: Measurement) -> Errors:
        """Errors of an engine's run of the picked model."""
        return Errors(
            self.against(best.values, self.reference.values),
            self.against(done.values, best.values),
            self.against(done.values, self.reference.values),
        )

    def step(self, stage: str, label: str, measured: Measurement, errors: Errors, **more: Any) -> Step:
        """One thing tried, with its verdict."""
        passes = not measured.failure and errors.worst(self.allowed) <= 1.0
        return Step(stage, label, measured, errors, passes, **more)


def _standard(work: _Work) -> _Standard:
    """The full model by two unlike engines.

    Raises:
        InputError: One of them fails, the scene has no such quantity, or a tolerance is finer than their distance.
    """
    # Of model levels the last choice is full, of the drive the scene's own.
    levels: Any = {name: choices[-1] for name, choices in LEVELS.items() if name != "drive"}
    full = Candidate(ModelLevels(**levels), work.scene.drive.mode, *_REFERENCE)
    work.progress(f"full model, {full.method}, and {_UNLIKE[0]} {_UNLIKE[1]} us beside it")
    reference = work.run(full)
    unlike = work.run(full.with_engine(*_UNLIKE), runs=1)
    for measured in (reference, unlike):
        if measured.failure:
            must = f"one that the reference can run ({measured.failure})"
            raise InputError("scene", must, measured.candidate.method)
    check_reads(work.scene, reference)
    assert reference.trace is not None  # it has not failed
    standard = _Standard(full, reference, unlike, {}, {}, reference.trace)
    distances = standard.against(unlike.values, reference.values)
    own = {name: max(error, _resolution(name, reference)) for name, error in distances.items()}
    for name, error in own.items():
        if error > 0.5 * work.tolerances[name]:
            must = f"at least {2.0 * error:.2g} for {name}, twice the reference's own error"
            raise InputError("--tolerance", must, work.tolerances[name])
    allowed = {name: tolerance - own[name] for name, tolerance in work.tolerances.items()}
    return standard._replace(errors=own, allowed=allowed)


def _resolution(name: str, reference: Measurement) -> float:
    """What the reading itself leaves open, as a part of the scale."""
    quantity, value = QUANTITIES[name], reference.values[name]
    if quantity.resolution == 0.0 or isinstance(value, str) or value == 0.0:
        return 0.0
    return quantity.resolution / abs(value)


def _one_at_a_time(work: _Work, standard: _Standard, keep: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Lower every level alone; by level, the choices that pass and spare work, each with its worst error."""
    full, steps = standard.full, work.steps
    top = work.run(full.with_engine(*_usual("split")))
    steps.append(standard.step("full", "full model", standard.reference, Errors(total=standard.errors), cost=top))
    passing: dict[str, dict[str, float]] = {}
    for level, choices in LEVELS.items():
        for choice in choices[: choices.index(full.model[level])]:
            lowered = full.with_model(**{level: choice})
            work.progress(f"{level} {choice}")
            converged = work.run(_converged(lowered), runs=1)
            cost = work.cost(lowered)
            stand_in = choice in STAND_INS
            # By count, not by clock: the way down has to be the same each time.
            costlier = not stand_in and cost.steps > COSTLIER * top.steps
            note = "stands in for exact, spares no work" if stand_in else "spares nothing" if costlier else ""
            errors = standard.model_errors(converged)
            step = standard.step("single", f"{level} {choice}", converged, errors, cost=cost, note=note)
            steps.append(step)
            if step.passes and not stand_in and not costlier and level not in keep:
                passing.setdefault(level, {})[choice] = errors.worst(standard.allowed)
    return passing


def _together(work: _Work, standard: _Standard, single: dict[str, dict[str, float]]) -> Measurement:
    """Lower all levels that pass alone; while they fail together the worst goes back up. The model, converged."""
    chosen = {level: next(iter(choices)) for level, choices in single.items()}
    while True:
        combined = standard.full.with_model(**chosen)
        label = ", ".join(f"{level} {choice}" for level, choice in chosen.items()) or "full model"
        work.progress(f"together: {label}")
        converged = work.run(_converged(combined), runs=1) if chosen else standard.reference
        errors, cost = standard.model_errors(converged), work.cost(combined)
        work.steps.append(standard.step("together", label, converged, errors, cost=cost))
        if work.steps[-1].passes:
            return converged
        worst = max(chosen, key=lambda level: single[level][chosen[level]])
        choices = list(single[worst])
        higher = choices[choices.index(chosen[worst]) + 1 :]
        if higher:
            chosen[worst] = higher[0]
        else:
            del chosen[worst]


def _engines(work: _Work, standard: _Standard, best: Measurement) -> tuple[list[tuple[Step, int]], bool]:
    """Engines and steps, the finest first: a setting holds only if every finer one of its engine holds.

    Returns:
        What passes, with the engine's place among all, and whether every engine was tried.
    """
    passing: list[tuple[Step, int]] = []
    complete = True
    for place, (engine, settings) in enumerate(_settings(work.scene, best.candidate).items()):
        for step_us, tolerance in settings:
            if work.left_s <= _SPARE * work.budget_s and passing:
                complete = False
                break
            candidate = best.candidate.with_engine(engine, step_us, tolerance)
            work.progress(candidate.method)
            # What takes longer than the reference is of no interest, and may be a stall.
            done = work.run(candidate, limit_s=max(1.0, 5.0 * standard.reference.wall_s * work.scene.duration_s))
            errors = standard.all_errors(done, best)
            step = standard.step("engine", candidate.method, done, errors, note=done.failure)
            work.steps.append(step)
            if not step.passes:
                break
            passing.append((step, place))
    return passing, complete


def _verified(
    work: _Work, standard: _Standard, best: Measurement, passing: list[tuple[Step, int]], sensors: str
) -> Step:
    """The cheapest, run as it will run; where that fails, the next.

    Raises:
        InputError: None of them passes.
    """
    passing = list(passing)
    while passing:
        least = min(step.measured.wall_s for step, _ in passing)
        near = [entry for entry in passing if entry[0].measured.wall_s <= TIE * least]
        taken = min(near, key=_preference)
        work.progress(f"verifying {taken[0].label} as it will run")
        done = work.run(taken[0].measured.candidate, sensors={"chain": sensors})
        errors = standard.all_errors(done, best)
        work.steps.append(standard.step("verified", taken[0].label, done, errors, note=done.failure))
        if work.steps[-1].passes:
            return work.steps[-1]
        passing.remove(taken)
    must = "wider: no engine meets it on the levels that do"
    raise InputError("--tolerance", must, list(work.tolerances.values()))


def _preference(entry: tuple[Step, int]) -> tuple[float, ...]:
    """Among equals the earlier engine, then the longer step, then the wider tolerance."""
    step, place = entry
    return place, -step.measured.candidate.step_us, -step.measured.candidate.tolerance


def _takes(engine: str, candidate: Candidate) -> bool:
    method = ENGINES[engine]
    return candidate.levels.friction in method.frictions and candidate.levels.contact in method.contacts


def _converged(candidate: Candidate) -> Candidate:
    """A model on the engine of the reference, or on the unlike one at its finest where that cannot take it."""
    return candidate.with_engine(*(_REFERENCE if _takes(_REFERENCE[0], candidate) else _UNLIKE))


def _cheap_engine(candidate: Candidate) -> str:
    """The default engine, or the first that takes the model."""
    return next(engine for engine in ENGINES if _takes(engine, candidate))


def _usual(engine: str) -> tuple[str, int, float]:
    method = ENGINES[engine]
    return engine, method.step_us, method.tolerance


def _given(scene: Scene) -> Candidate:
    return Candidate(scene.model, scene.drive.mode, scene.engine.name, scene.engine.step_us, scene.engine.tolerance)


def _settings(scene: Scene, candidate: Candidate) -> dict[str, list[tuple[int, float]]]:
    """Steps, or tolerances, of every engine that takes a model and fits the sample rates, the finest first."""
    settings: dict[str, list[tuple[int, float]]] = {}
    for engine, method in ENGINES.items():
        if not _takes(engine, candidate):
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
            candidate.with_engine(engine, step_us, 0.0).scene(scene, sensors=sensors)
    except InputError:
        return False
    return True
