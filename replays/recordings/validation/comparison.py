"""Comparison of a recording with a re-simulation of its experiment: by bits, sample by sample and by phase."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from recorder.contents.consistency import calibration_off
from recorder.reader import Recording
from replays.recordings.identification.nuisance import Fitted, Tuned, tune, window_start_s
from replays.recordings.identification.request import ask, first_command_s
from replays.recordings.parameters import parameter_doubts
from replays.recordings.resimulation.experiment import Experiment, is_imported
from replays.recordings.resimulation.noise import foreseeable_s
from replays.recordings.resimulation.prediction import Measured, Prediction, predict, read_measured, simplify
from replays.recordings.resimulation.sensitivity import SCAN, with_values
from replays.recordings.validation.bits import Bits, StreamBits, missing_rows
from replays.recordings.validation.criteria import Criteria, load_criteria
from replays.recordings.validation.explanations.attribution import (
    FEW_CHANNELS,
    Explained,
    Rest,
    attribute,
    explain_by_defects,
    explain_log,
    settle_channels,
)
from replays.recordings.validation.explanations.budget import Budget, make_fit_budgets, make_quantity_budgets
from replays.recordings.validation.explanations.explanation import Explanation
from replays.recordings.validation.explanations.faults import find_common_delay, select_channels, sensor_faults
from replays.recordings.validation.explanations.model_parameters import find_changes
from replays.recordings.validation.explanations.signals import (
    SignalFault,
    edge_faults,
    find_copies,
    is_quiet,
    signal_faults,
)
from replays.recordings.validation.explanations.single_channels import find_other_runs, make_signal_faults, own_faults
from replays.recordings.validation.outcome import Validation
from replays.recordings.validation.phases import CONTACT, PHASES, Phase
from replays.recordings.validation.statistics import StatisticResult, make_quantity_reader, perturbed, statistics
from replays.recordings.validation.trajectory import (
    ChannelResidual,
    Tolerated,
    Uncertainty,
    residuals,
    scaled,
    tolerate,
)
from replays.recordings.validation.truth import TruthTables, find_contradictions, judge_truth, recorded_truth
from rig.base.errors import InputError, Words
from rig.base.wire import TRUTH
from rig.channels.table import default_table

_CONTACT_MARGIN_S = 1e-3
"""Time before the first contact in the signals by which a difference is earlier [s]: that of filters."""
_MIN_SCAN_RATIO = 3.0
"""Smallest time between a scanner's channels over its half width."""
_MAX_CHECKED = 3
"""Largest number of named numbers of the model that are checked by the phases."""
_MOTION = {"offset", "gain", "drift", "run-out"}
"""Defects of a probe that slow motion resembles."""
_LEAST_MAINS_HZ = 16.0
"""Lowest frequency of any mains [Hz]; slower hum resembles motion."""


def validate(
    recording: Recording,
    *,
    criteria: Criteria | None = None,
    changes: dict[str, Any] | None = None,
    declared: bool = False,
    blind: bool = False,
    budget: bool = False,
    step: Callable[[str], None] = lambda _text: None,
) -> Validation:
    """Validate a recording by a re-simulation of its experiment.

    Args:
        recording: The recording.
        criteria: Criteria; None for the default set.
        changes: Changed values of scene or parameters, by dotted key.
        declared: Whether the declared criteria decide even if every bit is equal, as for a recording of another
            build.
        blind: Whether to ignore the faults that were injected on command.
        budget: Whether to compute the uncertainties of the fitted numbers and quantities of a log.
        step: Function that is called with the current step.

    Raises:
        InputError: The recording cannot be resimulated, or a change is invalid.
    """
    criteria = load_criteria() if criteria is None else criteria
    experiment = Experiment.from_recording(recording)
    if changes:
        experiment = experiment.with_changes(changes)
    _check_request(recording, experiment, criteria, budget=budget)
    recording = recording.without_faults() if blind else recording.with_true_blocks()
    if blind:
        experiment = experiment.without_faults()
    again = _resimulate(recording, experiment, criteria, step)
    begin, end, reason = _window(again)
    trajectory, tolerated = again.judge_trajectory(end)
    tables = recorded_truth(recording, longest_s=begin + criteria.window.longest_s)
    truth = [] if criteria.floating else judge_truth(tables, again.nominal, again.others[0], criteria, end_s=end)
    doubts = [*recording.doubts, *parameter_doubts(recording)]
    lost = missing_rows(recording) if blind else {}
    doubts += [f"{rows} of {due} rows of {key} are missing" for key, (rows, due) in lost.items()]
    if not (criteria.floating or again.tuned or changes):
        doubts += find_contradictions(tables, again.nominal, [key for key, one in again.bits.items() if one.equal])
    back = [name for name, part in again.parts.items() if (np.diff(part.times_s) <= 0.0).any()]
    doubts += [f"times of {name} do not ascend: no quantity of its motion is judged" for name in back]
    # Test signals have no phases of motion, and no causes in it; unordered instants have no spectrum.
    moves = experiment.scene.generator is None and not back
    phases, judged = [], []
    if moves:
        step("statistics by phase, and their spread")
        phases, judged = statistics(again.quick, again.parts, again.nominal, tables, again.criteria, again.members)
    remarks = calibration(recording, experiment)
    touched = next((one.from_s for one in phases if one.name in CONTACT), math.inf)
    if again.tuned is not None and not first_command_s(experiment) and touched < math.inf:
        sound = tuple(one for one in again.faults if one.what != "noise" or one.to_s <= touched)
        again = replace(again, faults=sound, unjudged=tuple(again.parts))
    if again.unjudged:
        text = f"noise of {', '.join(again.unjudged)} not compared: too few rows before the first contact"
        remarks = ["; ".join([*remarks, text])]
    validation = Validation(
        path=recording.path, scene=experiment.scene.name, criteria=again.criteria.title, changes=dict(changes or {}),
        bits=again.bits, bit_exact=bool(again.bits) and all(one.equal for one in again.bits.values()),
        declared=declared, window_s=(begin, end), window_reason=reason, residuals=tuple(trajectory),
        truth=tuple(truth), phases=tuple(phases), statistics=tuple(judged), calibration=tuple(remarks),
        skipped=sum(rows for rows, _ in lost.values())
        or sum(one.skipped for one in again.bits.values())
        or sum(stream.lost - stream.declared for stream in recording.streams.values()),
        explained=None, fitted=again.fitted, floating=criteria.floating,
        parts=again.parts, nominal=again.nominal, files=len(recording.parts), **_contact(again, phases, end),
        doubts=tuple(doubts), faults=again.faults, complete=recording.complete, tolerated=tuple(tolerated),
        budgets=_make_budgets(again, phases, judged, step) if budget else (),
    )  # fmt: skip
    firsts = [one.first_s for one in trajectory if one.first_s is not None]
    if again.tuned is None and again.faults:
        text = "; ".join(one.line for one in again.faults)
        return replace(validation, explained=_unexplained(again.faults[0].from_s, text))
    # Without the truth a number of the model may be the cause, if the difference begins with the recording.
    if again.own and (again.same_motion or (not firsts and all(one.sure for one in again.own))):
        return replace(validation, faults=make_signal_faults(again.own), explained=explain_by_defects(again.own))
    if validation.good or validation.doubts or not moves:
        return validation
    touching = bool(phases) and phases[0].name not in (PHASES[0], PHASES[-1])
    untold = again.tuned is not None and first_command_s(experiment) == 0.0 and not touching
    if untold and any(one.quantity == "contact_fraction" and one.foretold == 0.0 < one.recorded for one in judged):
        return replace(validation, explained=_unexplained(
            next(one.from_s for one in phases if one.name in CONTACT), "the shaft touches the ring from there on, but "
            "the known experiment causes no contact: a hammer pulse may be missing from the mapping ([experiment])",
        ))  # fmt: skip
    if not firsts and again.tuned is not None and not again.faults:
        text = "up to there all channels agree; the later difference is due to contact (`rig identify --fit "
        text += "contact.friction,contact.restitution`), ring or housing, or to a sensor that changes there"
        text = text if validation.failures else f"outside the known uncertainty: {'; '.join(validation.beyond)}"
        return replace(validation, explained=_unexplained(end, text))
    if not firsts:
        return validation
    again = again.select_causes(min(firsts), touched)
    step("what explains the difference")
    if again.tuned is None:
        rules = again.criteria.attribution
        return replace(validation, explained=attribute(
            again.quick, again.parts, again.nominal, rules, from_s=min(firsts), own=again.own, step=step
        ))  # fmt: skip
    resimulate = partial(_resimulate_log, recording)
    explain = partial(_explain_log, from_s=min(firsts), touching=touching)
    passed = {one.channel: one.good for one in trajectory if one.good is not None}
    explained = _explain_with_refits(again, end, partial(resimulate, experiment, criteria, step), explain, passed)
    named = [one for one in explained.ranked if one.kind == "model" and one.name in explained.best][:_MAX_CHECKED]
    if named and any(one.good is False for one in judged):
        # A change that removes the first part may only be the closest one.
        off = []
        for one in named:
            step(f"the same with {one.name} {one.change}")
            changed = with_values(experiment, find_changes(experiment, criteria.attribution, one))
            off.append(_count_failures(resimulate(changed, criteria, step), tables))
        if min(off) > 0:
            text = f"closest is {explained.conclusion}; but {min(off)} of {len(judged)} quantities are still off"
            text += ": another number, or several at once; `rig identify` fits them"
            explained = replace(explained, conclusion=text, best=())
    return replace(validation, explained=explain_assumed(explained, recording, passed))


def _check_request(recording: Recording, experiment: Experiment, criteria: Criteria, *, budget: bool) -> None:
    """Report errors of the request before the long fit."""
    if budget and not is_imported(recording):
        raise InputError("--budget", "used with a log of another system", Words(str(recording.path)))
    if criteria.floating:
        try:
            ask(recording, experiment, criteria.floating)
        except InputError as error:
            raise InputError(error.field.replace("fit", "floating"), error.must, error.received) from None


def _make_budgets(
    again: _Resimulation, phases: Sequence[Phase], judged: Sequence[StatisticResult], step: Callable[[str], None]
) -> tuple[Budget, ...]:
    assert again.tuned is not None
    step("uncertainty budget")
    rules, models = again.criteria.imported, len(again.criteria.imported.variants) + 1
    named = {
        (one.number, one.quantity): (f"{one.phase} {one.number + 1}: {one.quantity}", one.unit, one.recorded)
        for one in judged
        if one.limit is not None
    }
    read = make_quantity_reader(again.quick, again.parts, phases)
    fits, filters, variants = again.members[::models], again.others[-2], again.others[-1 - models : -2]
    budgets = make_quantity_budgets(named, read, again.parts, again.nominal, fits, filters, variants, rules)
    return (*make_fit_budgets(again.tuned, rules), *budgets)


def _unexplained(from_s: float, conclusion: str) -> Explained:
    return Explained(from_s, from_s, (), conclusion, ())


def _contact(again: _Resimulation, phases: list[Phase], end_s: float) -> dict[str, float | None]:
    """Return the first contact of a log that was not compared, and whether it should have been."""
    first_s = next((one.from_s for one in phases if one.name in CONTACT), -math.inf)
    if again.tuned is None or first_s < end_s:
        return {}
    return {"contact_s": first_s, "due_s": first_s if first_s < again.tuned.longest_s else None}


@dataclass(frozen=True)
class _Resimulation:
    """Re-simulation of a recording.

    Attributes:
        quick: Experiment with the same motion and fast sensors.
        criteria: Criteria, widened for an imported log.
        parts: Recorded channels, on the model's clock.
        nominal: Prediction.
        uncertainties: Equally valid predictions: of another build, or of other fits and models.
        bits: Comparison of bits by key; empty for an imported log.
        tuned: Fit of an imported log.
        fitted: Fitted numbers, of any recording.
        faults: Faults that the signals of an imported log show without a model.
        members: Ensemble of an imported log: equally good fits of equally valid models; otherwise made from `quick`.
        unjudged: Groups of a log whose noise cannot be judged, as too few rows precede the hammer pulse.
        own: Defects of single channels whose counts differ while others are equal to the bit.
        same_motion: Whether the truth is equal, which excludes other causes.
    """

    quick: Experiment
    criteria: Criteria
    parts: dict[str, Measured]
    nominal: Prediction
    uncertainties: tuple[Uncertainty, ...]
    bits: dict[str, StreamBits]
    tuned: Tuned | None
    fitted: tuple[Fitted, ...] = ()
    members: tuple[Prediction, ...] = ()
    faults: tuple[SignalFault, ...] = ()
    unjudged: tuple[str, ...] = ()
    own: tuple[Explanation, ...] = ()
    same_motion: bool = False

    @property
    def others(self) -> tuple[Prediction, ...]:
        """Equally valid predictions."""
        return tuple(one.prediction for one in self.uncertainties)

    def select_causes(self, from_s: float, touched_s: float) -> _Resimulation:
        """Return the same with the candidates that can cause a log's difference, not contact before the first one."""
        if self.tuned is None or not from_s < touched_s - _CONTACT_MARGIN_S < math.inf:
            return self
        rules = self.criteria.attribution.before_contact()
        return replace(self, criteria=self.criteria.model_copy(update={"attribution": rules}))

    def judge_trajectory(self, end_s: float) -> tuple[list[ChannelResidual], list[Tolerated]]:
        """Return the residuals of every channel up to an end [s], and what a log's uncertainty explains of them."""
        tolerated = []
        if self.tuned is not None:
            z, tolerated = tolerate(self.parts, self.nominal, self.uncertainties, end_s=end_s)
        else:
            rows = {name: slice(part.count_rows(end_s)) for name, part in self.parts.items()}
            z = {
                name: scaled(
                    part, self.nominal.values[name][rows[name]], [o.values[name][rows[name]] for o in self.others]
                )
                for name, part in self.parts.items()
            }
        return residuals(self.parts, z, self.criteria), tolerated


def _resimulate(
    recording: Recording, experiment: Experiment, criteria: Criteria, step: Callable[[str], None]
) -> _Resimulation:
    if is_imported(recording):
        experiment.scene.check_physics()
        return _resimulate_log(recording, experiment, criteria, step)
    rules = criteria.window
    parts = read_measured(recording, experiment.scene, longest_s=rules.longest_s)
    bits = Bits(recording, experiment.simulation().table)
    floated = None
    if criteria.floating:
        priors = dict.fromkeys(criteria.floating)
        floated = tune(recording, experiment, (), priors=priors, progress=lambda text: step(f"fit: {text}"))
        experiment = floated.experiment
    step("re-simulated, payload by payload")
    # Only the bits of channels with injected faults are compared: the prediction has no faults.
    sound = {name: [one for one in part.names if one not in experiment.faulty_channels] for name, part in parts.items()}
    parts = {name: part.select_channels(sound[name]) for name, part in parts.items() if sound[name]} or parts
    nominal = predict(experiment, parts, follow=bits.follow)
    quick = simplify(experiment)
    step("perturbed, to find the predictable part")
    moved = predict(perturbed(quick, rules.parameters, rules.perturbation), parts)
    determined = floated is not None and all(one.is_determined for one in floated.fitted)
    members = _draw_predictions([floated], parts, criteria) if floated is not None and determined else ()
    streams = bits.finish()
    truth = [one.equal for key, one in streams.items() if key.startswith(TRUTH)]
    same = all(truth) and (bool(truth) or experiment.scene.generator is not None)
    names = [channel.name for part in parts.values() for channel in part.channels]
    off = {name for part in parts for name in bits.channels_off(part)}
    own: list[Explanation] = []
    if (
        floated is None
        and not all(one.equal for one in streams.values())
        and all(truth)
        and len(off) < (len(names) if same else FEW_CHANNELS * len(names))
    ):
        own = own_faults(
            parts, nominal, bits.differences, recording.edges(), bits.edges_s(), partial(predict, experiment), step
        )  # fmt: skip
    faults: list[SignalFault] = []
    if floated is None and not all(one.equal for one in streams.values()):
        faults = [*find_copies(parts), *find_other_runs(parts, bits.differences)]
    valid = (Uncertainty("another build", moved), *(Uncertainty("fit", one) for one in members))
    return _Resimulation(
        quick, criteria, parts, nominal, valid, streams, None, floated.fitted if floated else (), members,
        own=tuple(own), same_motion=same, faults=tuple(faults),
    )  # fmt: skip


def _draw_predictions(
    models: Sequence[Tuned], parts: dict[str, Measured], criteria: Criteria
) -> tuple[Prediction, ...]:
    """Return the ensemble of fits of equally valid models, with values drawn from their uncertainty."""
    generator = np.random.default_rng(0)  # the same in every validation
    drawn = [models[n % len(models)].draw_values(generator) for n in range(criteria.ensemble.members)]
    return tuple(one.predict(parts) for one in drawn)


def _resimulate_log(
    recording: Recording,
    experiment: Experiment,
    criteria: Criteria,
    step: Callable[[str], None],
    late_s: dict[str, float] | None = None,
    more: tuple[str, ...] = (),
    channels: Sequence[str] | None = None,
) -> _Resimulation:
    """Return the re-simulation of a log: unknown numbers are fitted, and their uncertainty is added to the floor.

    Args:
        recording: The log.
        experiment: Experiment, as far as it is known.
        criteria: Criteria.
        step: Function that is called with the current step.
        late_s: Assumed delay of some channels [s].
        more: Keys to fit in addition.
        channels: Channels to use; None for all.
    """
    rules, longest_s = criteria.imported, criteria.window.longest_s

    tuned = tune(
        recording, experiment, (*rules.nuisances, *more), priors=dict.fromkeys(criteria.floating), late_s=late_s,
        channels=channels, variants=[variant.set for variant in rules.variants],
        progress=lambda text: step(f"log: {text}"),
    )  # fmt: skip
    models = [tuned, *(tuned.with_changes(variant.set) for variant in rules.variants)]
    whole = read_measured(recording, tuned.baseline.scene)
    if channels is not None:
        whole = {name: part.select_channels(channels) for name, part in whole.items() if {*part.names} & {*channels}}
    begin_s = window_start_s(tuned.baseline)
    parts = {
        name: part.select_until(float(part.times_s[0]) + longest_s).select_from(begin_s) for name, part in whole.items()
    }
    nominal = tuned.predict(parts)
    step("perturbed, and with equally valid models, to find the predictable part")
    parts = {name: part.with_spectra(tuned.spectra) for name, part in parts.items()}
    uncertainties = [Uncertainty("fit", tuned.undo_last_growth().predict(parts))]
    uncertainties += [
        Uncertainty(", ".join(f"{key} = {value}" for key, value in variant.set.items()), model.predict(parts))
        for variant, model in zip(rules.variants, models[1:], strict=True)
    ]
    corners = tuned.predict({name: part.with_corner_factor(rules.bandwidth) for name, part in parts.items()})
    uncertainties += [Uncertainty(f"corner {rules.bandwidth - 1.0:+.1%}", corners, each=True)]
    gains = {name: v + rules.calibration * (v - v.mean(axis=0)) for name, v in nominal.values.items()}
    uncertainties += [Uncertainty(f"calibration {rules.calibration:+.1%}", replace(nominal, values=gains), each=True)]
    until_s = first_command_s(tuned.baseline) or math.inf
    if np.count_nonzero(recording.edges() < until_s) < 2:
        # The phase of the pulses is unknown: a pulse is possible at any time.
        pulses = _replace_pulses(parts, nominal, lambda pulses: 1.0 - pulses)
        uncertainties.insert(1, Uncertainty("phase of the pulses", pulses))
    faults = signal_faults(whole, until_s)
    key = next((name for name, part in whole.items() if "keyphasor" in part.names), min(whole))
    mapped = "keyphasor" in recording.scene["import"]["mapping"]
    faults += edge_faults(
        recording.edges(), min(until_s, float(whole[key].times_s[-1])), tuned.baseline.scene.drive.speed_hz,
        from_s=float(whole[key].times_s[0]) if mapped else math.inf, period_s=1.0 / whole[key].channels[0].rate_hz,
    )  # fmt: skip
    return _Resimulation(
        faults=tuple(faults), members=_draw_predictions(models, parts, criteria), fitted=tuned.fitted,
        unjudged=tuple(name for name, part in whole.items() if not is_quiet(part, until_s)),
        quick=simplify(tuned.experiment), criteria=criteria.for_log(),
        parts=tuned.to_model_clock(parts),
        nominal=nominal, uncertainties=tuple(uncertainties), bits={}, tuned=tuned,
    )  # fmt: skip


def _replace_pulses(
    parts: dict[str, Measured], nominal: Prediction, change: Callable[[np.ndarray], np.ndarray]
) -> Prediction:
    """Return a prediction with other pulses of the keyphasor."""
    pulses = {name: [channel.name == "keyphasor" for channel in part.channels] for name, part in parts.items()}
    return replace(nominal, values={k: np.where(pulses[k], change(v), v) for k, v in nominal.values.items()})


def _window(again: _Resimulation) -> tuple[float, float, str]:
    """Return begin and end of the comparison sample by sample [s], and the reason of the end."""
    rules, parts = again.criteria.window, again.parts
    begin = min(float(part.times_s[0]) for part in parts.values())
    if again.tuned is not None:
        # The uncertainty of the fit and of filters is added to the floor and does not end the window.
        parted = foreseeable_s(parts, again.nominal, again.others[1:-2], share=1.0)
        end = min(again.tuned.end_s, math.inf if parted is None else parted)
        return begin, end, "as far as fit and model agree" if end == again.tuned.end_s else "models differ from there"
    parted = foreseeable_s(parts, again.nominal, again.others, share=rules.share)
    change = f"a change of {rules.perturbation:g}"
    change += ", or of the fitted numbers by their uncertainty," * bool(again.fitted)
    if parted is None:
        end = max(float(part.times_s[-1]) for part in parts.values()) + 1e-9
        return begin, end, f"to the end: {change} stays below {rules.share:g} of every channel's noise"
    return begin, parted, f"{change} reaches {rules.share:g} of a channel's noise at {parted:.4f} s"


def _explain_log(again: _Resimulation, *, from_s: float, end_s: float, touching: bool) -> Explained:
    # Numbers of the model are correlated with the fitted ones: `rig identify` fits all.
    assert again.tuned is not None
    return explain_log(
        again.parts, again.nominal, again.others, again.tuned, again.criteria.attribution, from_s=from_s, end_s=end_s,
        faults=again.faults, touching=touching,
    )  # fmt: skip


def _count_failures(again: _Resimulation, tables: TruthTables) -> int:
    """Return the number of statistics that fail."""
    _, judged = statistics(again.quick, again.parts, again.nominal, tables, again.criteria, again.members)
    return sum(one.good is False for one in judged)


def _explain_with_refits(
    again: _Resimulation,
    end_s: float,
    resimulate: Callable[..., _Resimulation],
    explain: Callable[..., Explained],
    passed: Mapping[str, bool],
) -> Explained:
    """Return the explanation of a log.

    A further fit is made if channels seem late, of a kind together or in turn, and one without the channels that are
    named if others differ, too.
    """
    explained = explain(again, end_s=end_s)
    assert again.tuned is not None
    if late_s := find_common_delay(explained.ranked, again.parts):
        other = resimulate(late_s=late_s)
        if other.tuned is not None and other.tuned.is_better_than(again.tuned):
            again, end_s, resimulate = other, min(end_s, other.tuned.end_s), partial(resimulate, late_s=late_s)
            explained = explain(again, end_s=end_s)
    elif again.tuned.end_s < again.tuned.longest_s and any("delay" in one.name for one in explained.ranked):
        other = resimulate(more=(SCAN,))
        sizes = [abs(one.value) / one.half_width for one in other.fitted if one.key == SCAN]
        if other.tuned is not None and other.tuned.end_s > again.tuned.end_s and min(sizes) > _MIN_SCAN_RATIO:
            again, end_s, resimulate = other, other.tuned.end_s, partial(resimulate, more=(SCAN,))
            explained = explain(again, end_s=end_s)
    assert again.tuned is not None
    return settle_channels(explained, passed, [*again.tuned.scales], partial(_compare_rest, end_s, resimulate))


def _compare_rest(end_s: float, resimulate: Callable[..., _Resimulation], channels: list[str]) -> Rest:
    """Return the comparison of a log with a fit of some channels only."""
    other = resimulate(channels=channels)
    assert other.tuned is not None
    to_s = min(end_s, other.tuned.end_s)
    trajectory, _ = other.judge_trajectory(to_s)
    failed = [one.channel for one in trajectory if one.good is False]
    return Rest(sensor_faults(other.parts, other.nominal, to_s, other.others), failed, is_evidence=to_s >= end_s)


def find_assumed_corners(recording: Recording) -> dict[str, float]:
    """Return the assumed corner of each channel whose mapping has none [Hz], by name; empty for a rig's recording."""
    mapped = recording.scene["import"]["mapping"]["channels"] if is_imported(recording) else {}
    known = recording.table.channels
    return {name: known[name].bandwidth_hz for name, entry in mapped.items() if "bandwidth_hz" not in entry}


def explain_assumed(explained: Explained, recording: Recording, passed: Mapping[str, bool]) -> Explained:
    """Return an explanation of a log that distinguishes an assumed low-pass from a wrong one, and lists open channels.

    Args:
        explained: The explanation.
        recording: The log.
        passed: Whether each judged channel passes.
    """
    failed = [name for name, good in passed.items() if not good]
    corners, conclusion, ranked = find_assumed_corners(recording), explained.conclusion, []
    for one in explained.ranked:
        name, defect = one.channels_and_defect
        if defect == "bandwidth" and one.unit == "Hz" and name in corners:
            change = f"low-pass near {one.value:.3g} Hz; none was given ({corners[name]:g} Hz assumed)"
            advice = f"{name}: {change}. Add `bandwidth_hz = {one.value:.3g}` to [channels.{name}] and import again"
            conclusion = conclusion.replace(f"{one.name} {one.change}", advice)
            one = replace(one, change=change)
        ranked.append(one)
    best = [one for one in ranked if one.name in explained.best]
    if best and all(one.kind == "sensor" for one in best):
        known = select_channels(best, failed)
        rest = [name for name in failed if name not in known and explained.settled.get(name) != "effect"]
        doubt = ""
        if len(rest) > len(known) and len(failed) > FEW_CHANNELS * len(passed):
            # What many others contradict is not the cause, however large its part of the squares is; few others may
            # fail as it moved the fit.
            doubt = f"{len(rest)} of {len(failed)} channels that fail have no known cause"
        elif moving := _find_motion(best, rest):
            doubt = f"{', '.join(moving)} may show another motion"
        if doubt:
            closest = "; ".join(f"{one.name} {one.change}" for one in best)
            conclusion = f"{doubt}: the model differs, or several faults; closest is {closest}"
            return replace(explained, conclusion=conclusion, ranked=tuple(ranked), best=())
        for name in (name for name in rest if name not in explained.settled):
            assumed = f" (assumed: low-pass of {corners[name]:g} Hz)" if name in corners else ""
            conclusion += f"; {name} fails without a known cause{assumed}"
    return replace(explained, conclusion=conclusion, ranked=tuple(ranked))


def _is_slow(defect: Explanation) -> bool:
    """Return whether slow motion resembles a defect."""
    defects = defect.channels_and_defect[1].split(" and ")
    line = re.search(r"([\d.]+) Hz", defect.change) if "hum" in defects else None
    return not _MOTION.isdisjoint(defects) or (line is not None and float(line[1]) < _LEAST_MAINS_HZ)


def _find_motion(causes: Iterable[Explanation], rest: Sequence[str]) -> list[str]:
    """Return the probes whose differences may be motion, which both planes show, instead of defects.

    Args:
        causes: The defects found.
        rest: Channels that fail for no known cause.
    """
    probes = default_table().groups["probes"].names
    slow = [names for one in causes if _is_slow(one) and (names := select_channels([one], probes))]
    others = [name for name in rest if name in probes]
    directions = [direction for names in slow for direction in {name.rpartition("_")[2] for name in names}]
    in_both_planes = len(set(directions)) < len(directions)
    return [*chain(*slow), *others] if slow and (others or in_both_planes) else []


def calibration(recording: Recording, experiment: Experiment) -> list[str]:
    """Return the differences of the recording's channels from the scene's table, by default the rig's own."""
    if is_imported(recording):
        lacking = find_assumed_corners(recording)
        text = f"no bandwidth given for {', '.join(lacking)}: half of the rate is assumed" if lacking else ""
        return ["; ".join(filter(None, (text, recording.correction[0])))] if text or recording.correction[0] else []
    return calibration_off(recording.table, experiment.scene.table)
