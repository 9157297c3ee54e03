"""A recording held against its own experiment: done again, and compared by bits, sample by sample and by phase."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from recorder.agreement import calibration_off
from recorder.reader import Recording
from replays.recordings.experiment import Experiment, parameter_doubts
from replays.recordings.identification.nuisance import Tuned, is_imported, tune
from replays.recordings.prediction import Measured, Prediction, bare, measured, predict
from replays.recordings.validation.attribution import Explained, attribute
from replays.recordings.validation.bits import Bits, StreamBits
from replays.recordings.validation.criteria import Criteria, load_criteria
from replays.recordings.validation.outcome import Validation
from replays.recordings.validation.statistics import perturbed, statistics
from replays.recordings.validation.trajectory import foreseeable_s, residuals
from replays.recordings.validation.truth import judge_truth, recorded_truth


def validate(
    recording: Recording,
    *,
    criteria: Criteria | None = None,
    changes: dict[str, Any] | None = None,
    declared: bool = False,
    step: Callable[[str], None] = lambda _text: None,
) -> Validation:
    """Hold a recording against its own experiment.

    Args:
        recording: The recording.
        criteria: What is asked; None for the rig's own.
        changes: Other values of scene or parameters than the recorded ones, by dotted key.
        declared: Judge by the declared comparison even where every bit is equal: what another build, on which it is
            not, would be judged by.
        step: Told what is being done.

    Raises:
        InputError: The recording is none that can be done again, or a change is none.
    """
    criteria = load_criteria() if criteria is None else criteria
    experiment = Experiment.of(recording)
    if changes:
        experiment = experiment.changed(changes)
    again = _done_again(recording, experiment, criteria, step)
    begin, end, reason = _window(again)
    trajectory = residuals(again.parts, again.nominal, again.perturbed, again.criteria, end_s=end)
    tables = recorded_truth(recording, longest_s=begin + criteria.window.longest_s)
    truth = judge_truth(tables, again.nominal, again.perturbed, criteria, end_s=end)
    step("statistics by phase, and their spread")
    phases, judged = statistics(again.quick, again.parts, again.nominal, tables, criteria)
    validation = Validation(
        path=recording.path, scene=experiment.scene.name, criteria=criteria.title, changes=dict(changes or {}),
        bits=again.bits, bit_exact=bool(again.bits) and all(one.equal for one in again.bits.values()),
        declared=declared, window_s=(begin, end), window_reason=reason, residuals=tuple(trajectory),
        truth=tuple(truth), phases=tuple(phases), statistics=tuple(judged),
        calibration=tuple(calibration(recording, experiment)),
        skipped=sum(stream.lost for stream in recording.streams.values()),
        explained=None, fitted=tuple(one.line for one in again.tuned.fitted) if again.tuned is not None else (),
        parts=again.parts, nominal=again.nominal, files=len(recording.parts),
        doubts=(*recording.doubts, *parameter_doubts(recording)),
    )  # fmt: skip
    firsts = [one.first_s for one in trajectory if one.first_s is not None]
    if validation.good or validation.doubts or not firsts:
        return validation
    step("what explains the difference")
    return replace(validation, explained=_explained(again, from_s=min(firsts), step=step))


@dataclass(frozen=True)
class _DoneAgain:
    """The recording done again.

    Attributes:
        quick: The same motion, with sensors that cost little.
        criteria: Loosened for an imported log.
        parts: What was recorded, on the model's clock.
        nominal: What was predicted.
        perturbed: The same, as far off as another build or a fit may be.
        bits: By key; empty for an imported log.
        tuned: What was fitted before, of an imported log.
    """

    quick: Experiment
    criteria: Criteria
    parts: dict[str, Measured]
    nominal: Prediction
    perturbed: Prediction
    bits: dict[str, StreamBits]
    tuned: Tuned | None


def _done_again(
    recording: Recording, experiment: Experiment, criteria: Criteria, step: Callable[[str], None]
) -> _DoneAgain:
    rules = criteria.window
    parts = measured(recording, experiment.scene, longest_s=rules.longest_s)
    how_far = "perturbed, to see how far it can be predicted"
    if is_imported(recording):
        tuned = tune(recording, experiment, criteria.imported.nuisances, progress=lambda text: step(f"log: {text}"))
        nominal = tuned.predict(parts)
        step(how_far)
        return _DoneAgain(
            quick=bare(tuned.experiment), criteria=criteria.loosened(criteria.imported.noise),
            parts=tuned.on_time(parts), nominal=nominal, perturbed=tuned.predict(parts, perturbed=True), bits={},
            tuned=tuned,
        )  # fmt: skip
    bits = Bits(recording, experiment.simulation().table)
    step("re-simulated, payload by payload")
    nominal = predict(experiment, parts, follow=bits.follow)
    quick = bare(experiment)
    step(how_far)
    moved = predict(perturbed(quick, rules.parameters, rules.perturbation), parts)
    return _DoneAgain(quick, criteria, parts, nominal, moved, bits.finish(), None)


def _window(again: _DoneAgain) -> tuple[float, float, str]:
    """Begin and end of what is compared sample by sample [s], and how the end was found."""
    rules, parts = again.criteria.window, again.parts
    begin = min(float(part.times_s[0]) for part in parts.values())
    parted = foreseeable_s(parts, again.nominal, again.perturbed, share=rules.share)
    change = "what the fit leaves open" if again.tuned is not None else f"a change of {rules.perturbation:g}"
    if parted is None:
        end = max(float(part.times_s[-1]) for part in parts.values()) + 1e-9
        return begin, end, f"to the end: {change} stays below {rules.share:g} of every channel's noise"
    return begin, parted, f"{change} reaches {rules.share:g} of a channel's noise at {parted:.4f} s"


def _explained(again: _DoneAgain, *, from_s: float, step: Callable[[str], None]) -> Explained:
    rules = again.criteria.attribution
    if again.tuned is not None:  # numbers of the model hang together with what was fitted: `rig identify` fits all
        rules = rules.model_copy(update={"candidates": ()})
    explained = attribute(again.quick, again.parts, again.nominal, rules, from_s=from_s, step=step)
    if again.tuned is not None and not explained.best:
        told = "neither a sensor nor the clock explains it: the model is off; `rig identify` fits numbers of it"
        explained = replace(explained, conclusion=told)
    return explained


def calibration(recording: Recording, experiment: Experiment) -> list[str]:
    """How the recording's channels differ from the table of its scene, the rig's own where that has none."""
    if is_imported(recording):
        mapped = recording.scene["import"]["mapping"]["channels"]
        lacking = [name for name, entry in mapped.items() if "bandwidth_hz" not in entry]
        return [f"no bandwidth told of {', '.join(lacking)}: taken for half of the rate"] if lacking else []
    return calibration_off(recording.table, experiment.scene.table)
