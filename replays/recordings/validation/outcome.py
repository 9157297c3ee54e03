"""A validation: a recording held against its own experiment, and everything that comes out of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from recorder.reader import Recording
from replays.recordings.experiment import Experiment
from replays.recordings.identification.nuisance import Tuned, is_imported, tune
from replays.recordings.prediction import Measured, Prediction, bare, measured, predict
from replays.recordings.sensitivity import value_of, with_values
from replays.recordings.validation.attribution import Explained, attribute
from replays.recordings.validation.bits import Bits, StreamBits
from replays.recordings.validation.criteria import Criteria, load_criteria
from replays.recordings.validation.phases import (
    QUANTITIES,
    SPECTRA,
    Phase,
    View,
    find_phases,
    quantities,
    spectra,
    view_of,
)
from replays.recordings.validation.trajectory import ChannelResidual, foreseeable_s, residuals
from rig.channels import default_table
from rig.kernels.signals import COLUMN, TRUTH
from rig.model import build_model
from rig.simulation import DISSIPATED
from rig.wire import TRUTH as TRUTH_KEY

_CENTRE = 0.99
"""Contact truth is compared where the gap is below this part of the clearance."""
_TRUTH = {"dissipated": DISSIPATED, "drive_work": ("drive_work",)}


@dataclass(frozen=True)
class StatisticResult:
    """One quantity of one phase.

    Attributes:
        number: Place of the phase among the phases found.
        phase: The phase's name.
        quantity: The quantity's name.
        unit: Its unit.
        recorded: Read off the recording.
        foretold: Median over the ensemble.
        spread: Standard deviation over the ensemble.
        limit: Largest difference allowed; None where there is no criterion.
        reason: The criterion's.
    """

    number: int
    phase: str
    quantity: str
    unit: str
    recorded: float
    foretold: float
    spread: float
    limit: float | None
    reason: str

    @property
    def title(self) -> str:
        """The quantity with its unit."""
        return f"{self.quantity} [{self.unit}]" if self.unit else self.quantity

    @property
    def good(self) -> bool | None:
        """Within the criterion; None where there is none."""
        if self.limit is None:
            return None
        off = self.recorded - self.foretold
        # Spectra cannot be too much alike.
        return bool((off if self.quantity in SPECTRA else abs(off)) <= self.limit)


@dataclass(frozen=True)
class TruthResult:
    """One truth table inside the window: largest difference as a part of each column's largest value."""

    table: str
    column: str
    relative: float
    limit: float

    @property
    def good(self) -> bool:
        """Within the criterion."""
        return self.relative <= self.limit


@dataclass(frozen=True)
class Failure:
    """One criterion that is not met, as what reads it wants to say it.

    Attributes:
        criterion: What is asked for, with its unit.
        recorded: What the recording has.
        foretold: What it should have.
        limit: What is allowed.
    """

    criterion: str
    recorded: str
    foretold: str
    limit: str

    @property
    def line(self) -> str:
        """All of it in one line."""
        return f"{self.criterion}: {self.recorded} against {self.foretold} ({self.limit})"


@dataclass(frozen=True)
class Validation:
    """What a validation came to.

    Attributes:
        path: The recording.
        scene: Name of its scene.
        criteria: Title of the criteria.
        changes: What was changed against the recording.
        bits: By key; empty where bits were not compared.
        bit_exact: Every payload is equal.
        declared: Judged by the declared comparison even so.
        window_s: The trajectory is judged from the first to the second of these times [s].
        window_reason: How its end was found.
        residuals: Of every channel in the window.
        truth: Of every truth table in the window.
        phases: The phases found.
        statistics: Of every phase.
        calibration: How the recording's channels differ from the rig's own table, in words.
        skipped: Rows that the recording lost.
        explained: Where something failed, what it may come from.
        fitted: What was fitted before, as an imported log does not tell it exactly.
        parts: What was recorded.
        nominal: What was foretold.
        files: Number of files that the recording was in.
        doubts: What in the recording does not fit the rest of it: then nothing that is left of it is good.
    """

    path: Path
    scene: str
    criteria: str
    changes: dict[str, Any]
    bits: dict[str, StreamBits]
    bit_exact: bool
    declared: bool
    window_s: tuple[float, float]
    window_reason: str
    residuals: tuple[ChannelResidual, ...]
    truth: tuple[TruthResult, ...]
    phases: tuple[Phase, ...]
    statistics: tuple[StatisticResult, ...]
    calibration: tuple[str, ...]
    skipped: int
    explained: Explained | None
    fitted: tuple[str, ...] = ()
    parts: dict[str, Measured] = field(repr=False, default_factory=dict)
    nominal: Prediction | None = field(repr=False, default=None)
    files: int = 1
    doubts: tuple[str, ...] = ()

    @property
    def good(self) -> bool:
        """Bit-exact, or within every criterion, and all of it is there."""
        return not self.doubts and ((self.bit_exact and not self.declared) or not self.failures)

    @property
    def failures(self) -> list[Failure]:
        """Every criterion that is not met."""
        found = []
        for one in self.residuals:
            if one.good is False and one.broken is not None:
                measure, value, limit = one.broken
                criterion = f"{one.channel}, residual over noise: {measure}"
                found.append(Failure(criterion, f"{value:.3g}", one.alone(measure), f"at most {limit:.3g}"))
        for one in self.truth:
            if not one.good:
                criterion = f"truth {one.table}.{one.column}, part that it is off"
                found.append(Failure(criterion, f"{one.relative:.2g}", "0", f"at most {one.limit:.2g}"))
        for one in self.statistics:
            if one.good is False and one.limit is not None:
                limit = f"+- {one.limit:.2g}"
                found.append(Failure(f"{one.phase}, {one.title}", f"{one.recorded:.5g}", f"{one.foretold:.5g}", limit))
        return found

    @property
    def title(self) -> str:
        """Name of the recording, of several parts that of the first."""
        return self.path.name + (f" and {self.files - 1} more" if self.files > 1 else "")

    @property
    def calibration_line(self) -> str:
        """How the recording's channels differ from the rig's own table, in one line; empty where they do not."""
        if len(self.calibration) < 2:
            return "".join(self.calibration)
        names = [line.partition(":")[0] for line in self.calibration]
        shown = ", ".join(names[:3]) + (", ..." if names[3:] else "")
        return f"{len(names)} channels ({shown}) differ from the rig's own table; the report says how"

    @property
    def bits_line(self) -> str:
        """How the payloads compare, in one line."""
        if not self.bits:
            return "imported: there are no payloads of this rig to compare"
        rows = sum(one.rows for one in self.bits.values())
        lost = f"; {self.skipped} rows that the recording lost are passed over" if self.skipped else ""
        cut = [f"{key.rpartition('/')[2]} {one.picked}" for key, one in self.bits.items() if one.picked]
        lost += f"; of the channels, by name: {', '.join(cut)}" if cut else ""
        if self.bit_exact:
            there = " that are there" if self.doubts else ""
            return f"bit-exact: all payloads{there} of {len(self.bits)} streams, {rows} rows{lost}"
        off = [(key, one) for key, one in self.bits.items() if not one.equal]
        if not off:
            return f"bits: nothing to compare{lost}"
        timed = [(one.first_s, key) for key, one in off if one.first_s is not None]
        first = f", first {min(timed)[1]} at {min(timed)[0]:.6f} s" if timed else ""
        truth = [key for key, _ in off if key.startswith(TRUTH_KEY)]
        held = any(key.startswith(TRUTH_KEY) for key in self.bits)
        motion = "; truth is equal to the bit: another noise, calibration or sensor" if held and not truth else ""
        return f"not bit-exact: {len(off)} of {len(self.bits)} streams differ{first}{motion}{lost}"

    @property
    def verdict_line(self) -> str:
        """The outcome in one line."""
        if self.good:
            basis = "bit by bit" if self.bit_exact and not self.declared else f"by the criteria: {self.criteria}"
            return f"good, {basis}"
        if self.doubts:
            more = f", and {len(self.doubts) - 1} more" if self.doubts[1:] else ""
            return f"NOT GOOD, the recording does not fit together: {self.doubts[0]}{more}"
        channels = [one.channel for one in self.residuals if one.good is False]
        tables = [one.table for one in self.truth if not one.good]
        phases = [one.phase for one in self.statistics if one.good is False]
        parts = [f"trajectory of {_few(channels)}"] if channels else []
        parts += [f"truth of {_few(tables)}"] if tables else []
        if phases:
            parts.append(
                "quantities: " + ", ".join(f"{phases.count(name)} of {name}" for name in dict.fromkeys(phases))
            )
        asked = sum(one.good is not None for one in (*self.residuals, *self.statistics)) + len(self.truth)
        return f"FAILS {len(self.failures)} of {asked} criteria: {'; '.join(parts)}"

    def document(self) -> dict[str, Any]:
        """All of it but the samples, as a JSON document."""
        return _plain(
            {
                "file": str(self.path),
                "scene": self.scene,
                "criteria": self.criteria,
                "changes": self.changes,
                "good": self.good,
                "bit_exact": self.bit_exact,
                "bits": {key: {**asdict(one), "equal": one.equal} for key, one in self.bits.items()},
                "rows_lost": self.skipped,
                "doubts": list(self.doubts),
                "fitted": list(self.fitted),
                "calibration": list(self.calibration),
                "window": {"from_s": self.window_s[0], "to_s": self.window_s[1], "reason": self.window_reason},
                "trajectory": [asdict(one) for one in self.residuals],
                "truth": [{**asdict(one), "good": one.good} for one in self.truth],
                "phases": [asdict(one) for one in self.phases],
                "statistics": [{**asdict(one), "good": one.good} for one in self.statistics],
                "failures": [asdict(one) for one in self.failures],
                "explained": None if self.explained is None else asdict(self.explained),
            }
        )


def _few(names: list[str]) -> str:
    return " and ".join(names) if len(names) < 3 else f"{names[0]}, {names[1]} and {len(names) - 2} more"


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
    again = _again(recording, experiment, criteria, step)
    begin, end, reason = _window(again)
    trajectory = residuals(again.parts, again.nominal, again.perturbed, again.criteria, end_s=end)
    tables = _recorded_truth(recording, longest_s=begin + criteria.window.longest_s)
    truth = _judge_truth(tables, again.nominal, again.perturbed, criteria, end_s=end)
    step("statistics by phase, and their spread")
    phases, statistics = _statistics(again.quick, again.parts, again.nominal, tables, criteria)
    validation = Validation(
        path=recording.path, scene=experiment.scene.name, criteria=criteria.title, changes=dict(changes or {}),
        bits=again.bits, bit_exact=bool(again.bits) and all(one.equal for one in again.bits.values()),
        declared=declared, window_s=(begin, end), window_reason=reason, residuals=tuple(trajectory),
        truth=tuple(truth), phases=tuple(phases), statistics=tuple(statistics),
        calibration=tuple(_calibration(recording)), skipped=sum(stream.lost for stream in recording.streams.values()),
        explained=None, fitted=tuple(one.line for one in again.tuned.fitted) if again.tuned is not None else (),
        parts=again.parts, nominal=again.nominal, files=len(recording.parts),
        doubts=recording.doubts,
    )  # fmt: skip
    firsts = [one.first_s for one in trajectory if one.first_s is not None]
    if validation.good or validation.doubts or not firsts:
        return validation
    step("what explains the difference")
    return replace(validation, explained=_explained(again, from_s=min(firsts), step=step))


@dataclass(frozen=True)
class _Again:
    """The recording done again.

    Attributes:
        quick: The same motion, with sensors that cost little.
        criteria: Loosened for an imported log.
        parts: What was recorded, on the model's clock.
        nominal: What was foretold.
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


def _again(recording: Recording, experiment: Experiment, criteria: Criteria, step: Callable[[str], None]) -> _Again:
    rules = criteria.window
    parts = measured(recording, experiment.scene.sensors, longest_s=rules.longest_s)
    aside = "perturbed, to see how far it can be foretold"
    if is_imported(recording):
        tuned = tune(recording, experiment, criteria.imported.nuisances, progress=lambda text: step(f"log: {text}"))
        nominal = tuned.predict(parts)
        step(aside)
        return _Again(
            quick=bare(tuned.experiment), criteria=criteria.loosened(criteria.imported.noise),
            parts=tuned.on_time(parts), nominal=nominal, perturbed=tuned.predict(parts, aside=True), bits={},
            tuned=tuned,
        )  # fmt: skip
    bits = Bits(recording, experiment.simulation().table)
    step("re-simulated, payload by payload")
    nominal = predict(experiment, parts, follow=bits.follow)
    quick = bare(experiment)
    step(aside)
    perturbed = predict(_perturbed(quick, rules.parameters, rules.perturbation), parts)
    return _Again(quick, criteria, parts, nominal, perturbed, bits.finish(), None)


def _window(again: _Again) -> tuple[float, float, str]:
    """Begin and end of what is compared sample by sample [s], and how the end was found."""
    rules, parts = again.criteria.window, again.parts
    begin = min(float(part.times_s[0]) for part in parts.values())
    parted = foreseeable_s(parts, again.nominal, again.perturbed, share=rules.share)
    change = "what the fit leaves open" if again.tuned is not None else f"a change of {rules.perturbation:g}"
    if parted is None:
        end = max(float(part.times_s[-1]) for part in parts.values()) + 1e-9
        return begin, end, f"to the end: {change} stays below {rules.share:g} of every channel's noise"
    return begin, parted, f"{change} reaches {rules.share:g} of a channel's noise at {parted:.4f} s"


def _explained(again: _Again, *, from_s: float, step: Callable[[str], None]) -> Explained:
    rules = again.criteria.attribution
    if again.tuned is not None:  # numbers of the model hang together with what was fitted: `rig identify` fits all
        rules = rules.model_copy(update={"candidates": ()})
    explained = attribute(again.quick, again.parts, again.nominal, rules, from_s=from_s, step=step)
    if again.tuned is not None and not explained.best:
        told = "neither a sensor nor the clock explains it: the model is off; `rig identify` fits numbers of it"
        explained = replace(explained, conclusion=told)
    return explained


def _perturbed(experiment: Experiment, keys: tuple[str, ...], part: float) -> Experiment:
    return with_values(experiment, {key: value_of(experiment, key) * (1.0 + part) for key in keys})


# Truth.


def _recorded_truth(recording: Recording, *, longest_s: float) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Row numbers and values of the truth tables that are as this version makes them."""
    found = {}
    for name, columns in TRUTH.items():
        if name not in recording.catalogue.get("truth", {}):
            continue
        samples = recording.truth(name)
        if samples.names == columns and len(samples.index):
            kept = samples.times_s < longest_s
            found[name] = (samples.index[kept], samples.values[kept])
    return found


def _judge_truth(
    tables: dict[str, tuple[np.ndarray, np.ndarray]],
    nominal: Prediction,
    perturbed: Prediction,
    criteria: Criteria,
    *,
    end_s: float,
) -> list[TruthResult]:
    found = []
    for name, (index, values) in tables.items():
        here, there = nominal.truth[name], perturbed.truth[name]
        kept = (index < min(len(here), len(there))) & (index < end_s * nominal.truth_rate_hz)
        if name == "contact":  # at the very centre it has no direction, nor a speed along it
            kept &= np.append(here[:, 0], 0.0)[np.minimum(index, len(here))] > _CENTRE * here[:, 0].min()
        rows, recorded = index[kept], values[kept]
        if not len(rows):
            continue
        scale = np.abs(here).max(axis=0)
        scale[scale == 0.0] = 1.0
        off = np.abs(recorded - here[rows]).max(axis=0) / scale
        allowed = criteria.truth.relative + 10.0 * np.abs(there[rows] - here[rows]).max(axis=0) / scale
        worst = int(np.argmax(off / allowed))
        found.append(TruthResult(name, TRUTH[name][worst], float(off[worst]), float(allowed[worst])))
    return found


# Statistics.


def _whole(parts: dict[str, Measured]) -> Phase:
    begin = min(float(part.times_s[0]) for part in parts.values())
    return Phase("", begin, max(float(part.times_s[-1]) for part in parts.values()) + 1e-9)


def _statistics(
    experiment: Experiment,
    parts: dict[str, Measured],
    nominal: Prediction,
    tables: dict[str, tuple[np.ndarray, np.ndarray]],
    criteria: Criteria,
) -> tuple[list[Phase], list[StatisticResult]]:
    look = _viewer(experiment, parts)
    recorded = {name: part.values for name, part in parts.items()}
    floors = {name: _floor(parts, names) for name, names in SPECTRA.items()}
    phases = find_phases(look(recorded, _whole(parts)), floor_n=_floor(parts, ("P_N", "P_S", "P_E", "P_W")))
    members = _ensemble(experiment, parts, criteria)
    results = []
    for number, phase in enumerate(phases):
        seen, there = look(recorded, phase), look(nominal.values, phase)
        others = [look(loud, phase) for loud, _ in members]
        samples: dict[str, tuple[float, list[float]]] = {}  # recorded, and of every member
        read = [quantities(other, phase.name) for other in others]
        for name, value in quantities(seen, phase.name).items():
            samples[name] = value, [one[name] for one in read]
        distances = [spectra(other, there, floors) for other in others]
        for name, value in spectra(seen, there, floors).items():
            samples[name] = value, [one.get(name, 1.0) for one in distances]
        for name, columns in _TRUTH.items() if "energy" in tables else ():
            ends = [_energy(tables["energy"], columns, phase, prediction) for _, prediction in members]
            samples[name] = _energy(tables["energy"], columns, phase, nominal)[0], [foretold for _, foretold in ends]
        results += [_judge(number, phase, name, *sample, criteria) for name, sample in samples.items()]
    return phases, results


def _floor(parts: dict[str, Measured], names: tuple[str, ...]) -> float:
    """Floor of the sum of those channels that are there."""
    floors = [part.floor[c] for part in parts.values() for c, name in enumerate(part.names) if name in names]
    return math.hypot(*floors)


def _viewer(experiment: Experiment, parts: dict[str, Measured]) -> Callable[[dict[str, np.ndarray], Phase], View]:
    """What shows a phase of values, with what the model tells of the transducers at rest and of the clearance."""
    model = build_model(experiment.scene.load_parameters(), experiment.scene.model)
    row = experiment.simulation().first_row
    channels = {channel.name: channel for part in parts.values() for channel in part.channels}
    base = {name: float(row[COLUMN[channel.signal]] / channel.si)
            for name, channel in channels.items() if name.startswith("P_")}  # fmt: skip
    touches = math.nan
    if "ring_x" in channels:
        touches = model.constants.contact.clearance * 1e3 + 6.0 * _floor(parts, ("ring_x",))
    return lambda values, phase: view_of(parts, values, phase, base=base, touches=touches)


def _ensemble(
    experiment: Experiment, parts: dict[str, Measured], criteria: Criteria
) -> list[tuple[dict[str, np.ndarray], Prediction]]:
    """Perturbed runs: what the channels show with noise of their own, and what is foretold without."""
    generator = np.random.default_rng(0)  # of the ensemble's noise and perturbations: the same in every validation
    members = []
    for _ in range(criteria.ensemble.members):
        part = criteria.ensemble.perturbation * generator.uniform(-1.0, 1.0)
        prediction = predict(_perturbed(experiment, criteria.window.parameters, part), parts)
        loud = {
            name: values + parts[name].floor * parts[name].random * generator.standard_normal(values.shape)
            for name, values in prediction.values.items()
        }
        members.append((loud, prediction))
    return members


def _judge(
    number: int, phase: Phase, name: str, value: float, sample: list[float], criteria: Criteria
) -> StatisticResult:
    foretold, deviation = float(np.median(sample)), float(np.std(sample, ddof=1))
    criterion = criteria.statistic_of(phase.name, name)
    limit = None
    if criterion is not None:
        limit = criterion.relative * abs(foretold) + criterion.absolute + criterion.spread * deviation
    return StatisticResult(
        number=number, phase=phase.name, quantity=name, unit=QUANTITIES[name].unit, recorded=value, foretold=foretold,
        spread=deviation, limit=limit, reason=criterion.reason if criterion else "",
    )  # fmt: skip


def _energy(
    table: tuple[np.ndarray, np.ndarray], columns: tuple[str, ...], phase: Phase, prediction: Prediction
) -> tuple[float, float]:
    """Recorded and foretold change of a sum of integrals over a phase [J]."""
    index, values = table
    picked = [TRUTH["energy"].index(column) for column in columns]
    rate = prediction.truth_rate_hz
    rows = np.flatnonzero((index >= phase.from_s * rate) & (index < phase.to_s * rate))
    rows = rows[index[rows] < len(prediction.truth["energy"])]
    if len(rows) < 2:
        return 0.0, 0.0
    ends = [rows[0], rows[-1]]
    recorded = values[np.ix_(ends, picked)].sum(axis=1)
    foretold = prediction.truth["energy"][np.ix_(index[ends], picked)].sum(axis=1)
    return float(recorded[1] - recorded[0]), float(foretold[1] - foretold[0])


# What the recording says of its own sensors.


def _calibration(recording: Recording) -> list[str]:
    """How the recording's channels differ from the rig's own table."""
    own = default_table().channels
    found = []
    if is_imported(recording):
        mapped = recording.scene["import"]["mapping"]["channels"]
        untold = [name for name, entry in mapped.items() if "bandwidth_hz" not in entry]
        return [f"no bandwidth told of {', '.join(untold)}: taken for half of the rate"] if untold else []
    for name, channel in recording.table.channels.items():
        if name not in own:
            found.append(f"{name}: not in the rig's own channel table")
            continue
        like = default_table().only((own[name].group,), channel.rate_hz).channels[name]
        fields = ("signal", "unit", "sensitivity_v", "bias_v", "range_v", "bandwidth_hz", "highpass_hz", "noise_v",
                  "adc_v", "adc_bits")  # fmt: skip
        off = [f"{key} {getattr(channel, key)} instead of {getattr(like, key)}" for key in fields
               if getattr(channel, key) != getattr(like, key)]  # fmt: skip
        if off:
            found.append(f"{name}: {', '.join(off)}")
    return found


def _plain(value: Any) -> Any:
    """Without numpy's types and numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
