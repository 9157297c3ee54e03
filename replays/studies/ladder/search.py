"""Search down the ladder: single levels below the full model, then the passing ones together, then the cheapest engine.

The search never runs all combinations and never adds single errors; the pick itself has been run. Model errors compare
converged runs, numerical errors compare one model on two engines, and the total error compares the pick with the
reference of the full model. Every pick has the same outcome as the full model, and omits only what saves more than a
tenth of its cost: processor time with the scene's sensors.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, get_args

from replays.studies.ladder import settings
from replays.studies.ladder.measurement import Candidate, Measurement, check_reads, compute_saving, measure
from replays.studies.ladder.quantity import QUANTITIES, Value
from rig.base.errors import InputError
from rig.physics.engines import ENGINES
from rig.physics.levels import ModelLevels
from rig.run.scenes import Scene

LEVELS: dict[str, tuple[str, ...]] = {
    **{name: get_args(entry.annotation) for name, entry in ModelLevels.model_fields.items()},
    "drive": ("ideal", "torque"),
}
"""Choices of every level, simplest first."""
SENSORS = "sensors"
KEEPABLE = (*LEVELS, SENSORS)
STAND_INS = ("smoothed", "switch")
"""Friction laws that approximate the exact one: measured but not picked, because they save no work."""
MIN_SAVING = 0.1
"""Part of the cost that a simpler level must save; smaller differences of cost count as equal."""
_VERIFICATION_SHARE = 0.2
"""Part of the budget that is reserved for the verification."""


@dataclass(frozen=True)
class Errors:
    """Relative errors of one candidate by quantity; empty for kinds of error that were not computed."""

    model: dict[str, float] = field(default_factory=dict)
    numerical: dict[str, float] = field(default_factory=dict)
    total: dict[str, float] = field(default_factory=dict)

    def largest_error(self, tolerances: dict[str, float]) -> float:
        """Return the largest error in units of the tolerance; infinite if a quantity is missing."""
        ratios = [
            value / tolerances[name]
            for errors in (self.model, self.numerical, self.total)
            for name, value in errors.items()
            if not math.isnan(value)
        ]
        return max(ratios, default=math.inf)


@dataclass(frozen=True)
class Rung:
    """One candidate of the search and its verdict."""

    stage: str
    label: str
    measured: Measurement
    errors: Errors
    passes: bool
    cost: Measurement | None = None
    """Measurement with the scene's sensors, if `measured` is a converged run."""
    note: str = ""


@dataclass(frozen=True)
class Ladder:
    """Result of a search.

    Attributes:
        scene: The scene as given.
        tolerances: Tolerances by quantity.
        reference: Converged run of the full model.
        unlike: The same on the cross-check engine.
        reference_errors: Distance between the two.
        steps: All candidates in order.
        picked: The pick, with the scene's sensors.
        picked_errors: Errors of the pick.
        savings: Part of the cost saved by each omitted level.
        given: The scene as given.
        given_errors: Total errors of the scene as given.
        full: The full model on the reference engine, with the scene's own sensors.
        sensors: Sensor chain of the pick.
        spent_s: Wall time of the search [s].
        complete: False if the budget ended the search of engines.
    """

    scene: Scene
    tolerances: dict[str, float]
    reference: Measurement
    unlike: Measurement
    reference_errors: dict[str, float]
    steps: tuple[Rung, ...]
    picked: Measurement
    picked_errors: Errors
    savings: dict[str, float]
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
    runs: int = 5,
    budget_s: float = 300.0,
    progress: Callable[[str], None] = lambda _: None,
) -> Ladder:
    """Find the cheapest model, engine and step that meets every tolerance.

    Args:
        scene: The scene as given.
        tolerances: Allowed relative error of each quantity.
        keep: Levels that stay as full as they are.
        runs: Timed runs of each candidate.
        budget_s: Wall time [s].
        progress: Function that receives each candidate's name.

    Raises:
        InputError: If the scene has no such quantity or no certain outcome, the tolerance is below the reference's own
            error, no combination meets it, or the budget ends before there is a pick.
    """
    for name in keep:
        if name not in KEEPABLE:
            raise InputError("--keep", f"one of {', '.join(KEEPABLE)}", name)
    chain = scene.sensors.chain if SENSORS in keep else "ideal"
    work = _Search(scene, tolerances, runs, budget_s, progress, {"chain": chain})
    standard = _run_reference(work)
    single = _lower_each(work, standard, keep)
    chosen, best = _lower_together(work, standard, single, {level: next(iter(each)) for level, each in single.items()})
    picked, complete = None, True
    while True:
        fuller, savings = _restore_levels(work, standard, single, chosen, picked.measured.candidate if picked else None)
        if fuller != chosen:
            chosen, best = _lower_together(work, standard, single, fuller)
            picked = None
        elif picked is None:
            work.steps = [step for step in work.steps if step.stage != "engine"]
            passing, complete = _search_engines(work, standard, best)
            picked = _select_cheapest(work, passing)
        else:
            break
    scene_run = work.run(settings.own_candidate(scene), sensors={})
    setting = settings.own_setting(scene, standard.full, settings.REFERENCE[0])
    full = work.run(standard.full.with_engine(*setting), sensors={})
    own = _run_as_given(work, standard)
    if own.passes and work.compute_saving(picked.measured.candidate, own.measured.candidate) <= MIN_SAVING:
        picked, savings = own, savings if own.measured.candidate == picked.measured.candidate else {}
    return Ladder(
        scene=scene,
        tolerances=tolerances,
        reference=standard.reference,
        unlike=standard.unlike,
        reference_errors=standard.errors,
        steps=tuple(work.steps),
        picked=picked.measured,
        picked_errors=picked.errors,
        savings=savings,
        given=scene_run,
        given_errors=standard.compare(scene_run.values, standard.reference.values),
        full=full,
        sensors=chain,
        spent_s=work.spent_s,
        complete=complete,
    )


@dataclass
class _Search:
    """State of a search: settings, and all candidates until now."""

    scene: Scene
    tolerances: dict[str, float]
    runs: int
    budget_s: float
    progress: Callable[[str], None]
    sensors: dict[str, Any]
    """Sensor settings of the pick."""
    steps: list[Rung] = field(default_factory=list)
    _begin: float = field(default_factory=time.perf_counter)

    @property
    def spent_s(self) -> float:
        """Wall time spent [s]."""
        return time.perf_counter() - self._begin

    @property
    def left_s(self) -> float:
        """Remaining part of the budget [s]."""
        return self.budget_s - self.spent_s

    def run(self, candidate: Candidate, **options: Any) -> Measurement:
        """Measure a candidate if there is time left."""
        if self.left_s <= 0.0:
            raise InputError("--budget-s", "longer: the time ended before there was a pick", self.budget_s)
        options = {"runs": self.runs, "limit_s": self.left_s, **options}
        return measure(self.scene, candidate, list(self.tolerances), **options)

    def cost(self, candidate: Candidate) -> Measurement:
        """Measure a model with the scene's sensors, on the first engine that supports it, at its own step."""
        return self.run(self.assign_engine(candidate), sensors=self.sensors)

    def assign_engine(self, candidate: Candidate) -> Candidate:
        """Return a model on the first engine that supports it."""
        engine = next(engine for engine in ENGINES if settings.supports(engine, candidate))
        return candidate.with_engine(*settings.own_setting(self.scene, candidate, engine))

    def compute_saving(self, simpler: Candidate, fuller: Candidate) -> float:
        """Return the part of the fuller candidate's cost that the simpler one saves."""
        return compute_saving(self.scene, simpler, fuller, runs=self.runs, sensors=self.sensors, limit_s=self.left_s)


class _Reference(NamedTuple):
    """Reference that candidates are compared with."""

    full: Candidate
    reference: Measurement
    unlike: Measurement
    errors: dict[str, float]
    """Error of the reference itself."""
    allowed: dict[str, float]
    """Tolerances minus the reference's own error."""

    def compare(self, values: dict[str, Value], others: dict[str, Value]) -> dict[str, float]:
        """Return the errors of values against others."""
        return {name: QUANTITIES[name].error(values[name], others[name]) for name in values}

    def model_errors(self, converged: Measurement) -> Errors:
        """Return the errors of a model from its converged run."""
        return Errors(model=self.compare(converged.values, self.reference.values))

    def all_errors(self, done: Measurement, best: Measurement) -> Errors:
        """Return the errors of an engine's run of the picked model."""
        return Errors(
            self.compare(best.values, self.reference.values),
            self.compare(done.values, best.values),
            self.compare(done.values, self.reference.values),
        )

    def step(
        self,
        stage: str,
        label: str,
        measured: Measurement,
        errors: Errors,
        *,
        cost: Measurement | None = None,
        note: str = "",
    ) -> Rung:
        """Return a candidate with its verdict: errors within the tolerances, and the outcome of the full model."""
        alike = _have_same_outcome(measured, self.reference)
        passes = not measured.failure and errors.largest_error(self.allowed) <= 1.0 and alike
        if not alike and measured.ending is not None:
            note = f"another outcome: {measured.ending.outcome}"
        return Rung(stage, label, measured, errors, passes, cost=cost, note=measured.failure or note)


def _run_reference(work: _Search) -> _Reference:
    """Run the full model on two different engines.

    Raises:
        InputError: If one fails, the outcomes differ, a quantity is missing or uncertain, or a tolerance is below the
            distance between them.
    """
    # For model levels the last choice is the full one; the drive stays the scene's own.
    levels: Any = {name: choices[-1] for name, choices in LEVELS.items() if name != "drive"}
    full = Candidate(ModelLevels(**levels), work.scene.drive.mode, *settings.REFERENCE)
    other = full.with_engine(*settings.finest_setting(settings.UNLIKE))
    work.progress(f"full model, {full.method}, and {other.method} for comparison")
    reference = work.run(full)
    unlike = work.run(other, runs=1)
    for measured in (reference, unlike):
        if measured.failure:
            must = f"one that the reference can run ({measured.failure})"
            raise InputError("scene", must, measured.candidate.method)
    check_reads(work.scene, reference)
    if not _have_same_outcome(reference, unlike):
        endings = [measured.ending.outcome for measured in (reference, unlike) if measured.ending]
        must = f"one with the same outcome on two accurate engines ({' and '.join(endings)} depend on chance)"
        raise InputError("scene", must, work.scene.name)
    standard = _Reference(full, reference, unlike, {}, {})
    distances = standard.compare(unlike.values, reference.values)
    own = {name: max(error, _resolution(name, reference)) for name, error in distances.items()}
    for name, error in own.items():
        if error > 0.5:
            raise InputError("--quantity", f"one that two accurate engines agree on in scene {work.scene.name}", name)
        if error > 0.5 * work.tolerances[name]:
            must = f"at least {2.0 * error:.2g} for {name}, twice the reference's own error"
            raise InputError("--tolerance", must, work.tolerances[name])
    allowed = {name: tolerance - own[name] for name, tolerance in work.tolerances.items()}
    return standard._replace(errors=own, allowed=allowed)


def _resolution(name: str, reference: Measurement) -> float:
    """Return the resolution of a quantity, relative to its value."""
    quantity, value = QUANTITIES[name], reference.values[name]
    if quantity.resolution == 0.0 or isinstance(value, str) or value == 0.0:
        return 0.0
    return quantity.resolution / abs(value)


def _lower_each(work: _Search, standard: _Reference, keep: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Lower every level alone, and return for each level the choices that pass, with their largest errors."""
    full, steps = standard.full, work.steps
    top = work.cost(full)
    steps.append(standard.step("full", "full model", standard.reference, Errors(total=standard.errors), cost=top))
    passing: dict[str, dict[str, float]] = {}
    number, total = 0, sum(choices.index(full.model[level]) for level, choices in LEVELS.items())
    for level, choices in LEVELS.items():
        for choice in choices[: choices.index(full.model[level])]:
            lowered, number = full.with_model(**{level: choice}), number + 1
            work.progress(f"{level} {choice}, level {number} of {total}")
            converged = work.run(settings.converged(lowered), runs=1)
            cost = work.cost(lowered)
            part = 1.0 - cost.cpu_s / top.cpu_s
            note = "stands in for exact" if choice in STAND_INS else f"saves {max(part, 0.0):.0%}"
            errors = standard.model_errors(converged)
            steps.append(standard.step("single", f"{level} {choice}", converged, errors, cost=cost, note=note))
            if steps[-1].passes and choice not in STAND_INS and level not in keep:
                passing.setdefault(level, {})[choice] = errors.largest_error(standard.allowed)
    return passing


def _lower_together(
    work: _Search, standard: _Reference, single: dict[str, dict[str, float]], chosen: dict[str, str]
) -> tuple[dict[str, str], Measurement]:
    """Lower some levels together, raising the worst one while they fail; return the rest and its converged run."""
    while True:
        combined = standard.full.with_model(**chosen)
        label = ", ".join(f"{level} {choice}" for level, choice in chosen.items()) or "full model"
        work.progress(f"together: {label}")
        converged = work.run(settings.converged(combined), runs=1) if chosen else standard.reference
        errors, cost = standard.model_errors(converged), work.cost(combined)
        work.steps.append(standard.step("together", label, converged, errors, cost=cost))
        if work.steps[-1].passes:
            return chosen, converged
        worst = max(chosen, key=lambda level: single[level][chosen[level]])
        chosen = _raise_level(chosen, worst, next(iter(_fuller_choices(single, chosen, worst)), None))


def _fuller_choices(single: dict[str, dict[str, float]], chosen: dict[str, str], level: str) -> list[str]:
    """Return the passing choices of a level that are fuller than the chosen one, without the full choice."""
    choices = list(single[level])
    return choices[choices.index(chosen[level]) + 1 :]


def _raise_level(chosen: dict[str, str], level: str, choice: str | None) -> dict[str, str]:
    """Return the chosen levels with a fuller choice of one level; None selects the full choice."""
    others = {name: other for name, other in chosen.items() if name != level}
    return others if choice is None else {**chosen, level: choice}


def _restore_levels(
    work: _Search,
    standard: _Reference,
    single: dict[str, dict[str, float]],
    chosen: dict[str, str],
    setting: Candidate | None,
) -> tuple[dict[str, str], dict[str, float]]:
    """Put back levels that save no more than a tenth of the cost, each at the fullest choice of equal cost.

    Args:
        work: The search.
        standard: Reference of the comparison.
        single: Choices that pass alone, by level.
        chosen: Lowered levels.
        setting: Engine and step of the pick; None for the default ones.

    Returns:
        Levels that stay lowered, and the part of the cost that each saves.
    """
    savings: dict[str, float] = {}

    def combine(levels: dict[str, str], other: dict[str, str]) -> Candidate:
        both = [standard.full.with_model(**each) for each in (levels, other)]
        if setting is None or not all(settings.supports(setting.engine, each) for each in both):
            return work.assign_engine(both[0])
        return both[0].with_engine(setting.engine, setting.step_us, setting.tolerance)

    levels = list(chosen)
    for n, level in enumerate(levels, 1):
        for choice in (None, *reversed(_fuller_choices(single, chosen, level))):
            fuller = _raise_level(chosen, level, choice)
            work.progress(f"saving by {level} {chosen[level]}, {n} of {len(levels)}")
            part = work.compute_saving(combine(chosen, fuller), combine(fuller, chosen))
            if part <= MIN_SAVING:
                chosen = fuller
                savings.pop(level, None)
                break
            savings.setdefault(level, part)
    return chosen, savings


def _search_engines(work: _Search, standard: _Reference, best: Measurement) -> tuple[list[tuple[Rung, int]], bool]:
    """Run engines and steps, finest first; a setting passes only if all finer ones of its engine pass.

    Returns:
        Passing steps, each with the engine's index, and whether every engine was tried.
    """
    passing: list[tuple[Rung, int]] = []
    complete = True
    engines = settings.list_settings(work.scene, best.candidate)
    for place, (engine, step_settings) in enumerate(engines.items()):
        for step_us, tolerance in step_settings:
            if work.left_s <= _VERIFICATION_SHARE * work.budget_s and passing:
                complete = False
                break
            candidate = best.candidate.with_engine(engine, step_us, tolerance)
            work.progress(f"{candidate.method}, engine {place + 1} of {len(engines)}")
            # A run much longer than the reference may be a stall; the finest of small fixed steps takes five times as
            # long.
            limit_s = max(1.0, 10.0 * standard.reference.cpu_s * work.scene.duration_s)
            done = work.run(candidate, sensors=work.sensors, limit_s=limit_s)
            step = standard.step("engine", candidate.method, done, standard.all_errors(done, best))
            work.steps.append(step)
            if not step.passes:
                break
            passing.append((step, place))
    return passing, complete


def _select_cheapest(work: _Search, passing: list[tuple[Rung, int]]) -> Rung:
    """Return the cheapest passing step.

    Raises:
        InputError: If none passes.
    """
    if not passing:
        must = "wider: no engine meets it on the passing levels"
        raise InputError("--tolerance", must, list(work.tolerances.values()))
    least = min(step.measured.cpu_s for step, _ in passing)
    near = [entry for entry in passing if (1.0 - MIN_SAVING) * entry[0].measured.cpu_s <= least]
    return min(near, key=_sort_key)[0]


def _run_as_given(work: _Search, standard: _Reference) -> Rung:
    """Run the scene's own model, engine and step for comparison with the pick."""
    own = settings.own_candidate(work.scene)
    work.progress("the scene as it is given")
    converged, done = work.run(settings.converged(own), runs=1), work.run(own, sensors=work.sensors)
    work.steps.append(standard.step("given", f"as given: {own.method}", done, standard.all_errors(done, converged)))
    return work.steps[-1]


def _sort_key(entry: tuple[Rung, int]) -> tuple[float, ...]:
    """Return the sort key of equally cheap steps: earlier engine, longer step, wider tolerance."""
    step, place = entry
    return place, -step.measured.candidate.step_us, -step.measured.candidate.tolerance


def _have_same_outcome(one: Measurement, other: Measurement) -> bool:
    return one.ending is not None and other.ending is not None and one.ending.is_alike(other.ending)
