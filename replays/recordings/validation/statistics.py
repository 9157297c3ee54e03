"""Quantities of every phase of a recording, compared with predictions and their spread over perturbed runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.prediction import Measured, Prediction, predict
from replays.recordings.resimulation.sensitivity import get_value, with_values
from replays.recordings.validation.criteria import Criteria
from replays.recordings.validation.phases import (
    QUANTITIES,
    SPECTRA,
    Phase,
    View,
    find_phases,
    quantities,
    select_view,
    spectra,
)
from replays.recordings.validation.truth import TruthTables, energy_change
from rig.physics.kernels.signals import COLUMN
from rig.physics.model import build_model
from rig.run.motion import DISSIPATED

_ENERGIES = {"dissipated": DISSIPATED, "drive_work": ("drive_work",)}
"""Columns of the truth that sum up to a quantity."""


NOT_JUDGED = "not judged"
"""Verdict where the limit is wider than the value itself."""
_SIGNED = ("mean_x", "mean_y", "sense")
"""Quantities with a sign, for which a limit wider than the value has a meaning."""


@dataclass(frozen=True)
class StatisticResult:
    """Result for a quantity of a phase.

    Attributes:
        number: Index of the phase.
        phase: Name of the phase.
        quantity: Name of the quantity.
        unit: Unit.
        recorded: Value of the recording.
        foretold: Predicted value: median over the ensemble.
        spread: Standard deviation over the ensemble.
        limit: Largest allowed difference; None without a criterion.
        reason: Reason of the criterion.
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
        """Quantity with its unit."""
        return f"{self.quantity} [{self.unit or '1'}]"

    @property
    def too_wide(self) -> bool:
        """True if the criterion is met only because its limit is wider than the value itself."""
        off, size = abs(self.recorded - self.foretold), max(abs(self.recorded), abs(self.foretold))
        wide = self.limit is not None and off <= self.limit and self.limit > size > 0.0
        return wide and self.quantity not in (*SPECTRA, *_SIGNED)

    @property
    def good(self) -> bool | None:
        """True if the criterion is met; None without a criterion, or if it does not judge."""
        if self.limit is None or self.too_wide:
            return None
        off = self.recorded - self.foretold
        # A distance of spectra cannot be too small.
        return bool((off if self.quantity in SPECTRA else abs(off)) <= self.limit)


def perturbed(experiment: Experiment, keys: tuple[str, ...], part: float) -> Experiment:
    """Return the experiment with some values increased by a relative amount."""
    return with_values(experiment, {key: get_value(experiment, key) * (1.0 + part) for key in keys})


def _whole(parts: dict[str, Measured]) -> Phase:
    begin = min(float(part.times_s[0]) for part in parts.values())
    return Phase("", begin, max(float(part.times_s[-1]) for part in parts.values()) + 1e-9)


def statistics(
    experiment: Experiment,
    parts: dict[str, Measured],
    nominal: Prediction,
    tables: TruthTables,
    criteria: Criteria,
    members: Sequence[Prediction] = (),
) -> tuple[list[Phase], list[StatisticResult]]:
    """Return the phases of a recording, and every quantity of each with its spread over perturbed runs.

    Args:
        experiment: The experiment, with fast sensors.
        parts: Recorded channels.
        nominal: Prediction.
        tables: Recorded truth.
        criteria: Criteria.
        members: Equally valid predictions; if empty, the experiment is perturbed.
    """
    look = _viewer(experiment, parts)
    recorded = {name: part.values for name, part in parts.items()}
    floors = {name: _floor(parts, names) for name, names in SPECTRA.items()}
    phases = find_phases(look(recorded, _whole(parts)), floor_n=_floor(parts, ("P_N", "P_S", "P_E", "P_W")))
    shown = _ensemble(experiment, parts, criteria, members)
    results = []
    for number, phase in enumerate(phases):
        measured, there = look(recorded, phase), look(nominal.values, phase)
        others = [look(loud, phase) for loud, _ in shown]
        samples: dict[str, tuple[float, list[float]]] = {}  # recorded value, and that of each member
        read = [quantities(other, phase.name) for other in others]
        for name, value in quantities(measured, phase.name).items():
            samples[name] = value, [one[name] for one in read]
        distances = [spectra(other, there, floors) for other in others]
        for name, value in spectra(measured, there, floors).items():
            samples[name] = value, [one.get(name, 1.0) for one in distances]
        for name, columns in _ENERGIES.items() if "energy" in tables else ():
            ends = [energy_change(tables["energy"], columns, phase, prediction) for _, prediction in shown]
            samples[name] = (
                energy_change(tables["energy"], columns, phase, nominal)[0],
                [predicted for _, predicted in ends],
            )
        results += [_judge(number, phase, name, *sample, criteria) for name, sample in samples.items()]
    return phases, results


def make_quantity_reader(
    experiment: Experiment, parts: dict[str, Measured], phases: Sequence[Phase]
) -> Callable[[dict[str, np.ndarray]], dict[tuple[int, str], float]]:
    """Return a function that returns the quantities of values, by the phase's number and the quantity's name."""
    look = _viewer(experiment, parts)
    return lambda values: {
        (number, name): value
        for number, phase in enumerate(phases)
        for name, value in quantities(look(values, phase), phase.name).items()
    }


def _floor(parts: dict[str, Measured], names: tuple[str, ...]) -> float:
    """Return the standard deviation of the noise of the sum of those channels that are present."""
    floors = [part.deviation[c] for part in parts.values() for c, name in enumerate(part.names) if name in names]
    return math.hypot(*floors)


def _viewer(experiment: Experiment, parts: dict[str, Measured]) -> Callable[[dict[str, np.ndarray], Phase], View]:
    """Return a function that returns the view of a phase, with the model's force at rest and clearance."""
    model = build_model(experiment.scene.load_parameters(), experiment.scene.model)
    row = experiment.simulation().first_row
    channels = {channel.name: channel for part in parts.values() for channel in part.channels}
    base = {name: float(row[COLUMN[channel.signal]] / channel.si)
            for name, channel in channels.items() if name.startswith("P_") and channel.signal in COLUMN}  # fmt: skip
    touches = math.nan
    if "ring_x" in channels:
        touches = model.constants.contact.clearance * 1e3 + 6.0 * _floor(parts, ("ring_x",))
    return lambda values, phase: select_view(parts, values, phase, base=base, touches=touches)


def _ensemble(
    experiment: Experiment, parts: dict[str, Measured], criteria: Criteria, predictions: Sequence[Prediction]
) -> list[tuple[dict[str, np.ndarray], Prediction]]:
    """Return perturbed runs: signals with independent noise, and the predictions without."""
    generator = np.random.default_rng(0)  # the same noise and perturbations in every validation
    members = []
    for number in range(criteria.ensemble.members):
        part = criteria.ensemble.perturbation * generator.uniform(-1.0, 1.0)
        moved = None if predictions else perturbed(experiment, criteria.window.parameters, part)
        prediction = predictions[number] if moved is None else predict(moved, parts)
        loud = {
            name: values + parts[name].random * parts[name].draw_noise(generator, len(values))
            for name, values in prediction.values.items()
        }
        members.append((loud, prediction))
    return members


def _judge(
    number: int, phase: Phase, name: str, value: float, sample: list[float], criteria: Criteria
) -> StatisticResult:
    predicted, deviation = float(np.median(sample)), float(np.std(sample, ddof=1))
    criterion = criteria.find_statistic(phase.name, name)
    limit = None
    if criterion is not None:
        size = 1.0 if name in SPECTRA else abs(predicted)
        limit = criterion.relative * size + criterion.absolute + criterion.spread * deviation
    return StatisticResult(
        number=number, phase=phase.name, quantity=name, unit=QUANTITIES[name].unit, recorded=value, foretold=predicted,
        spread=deviation, limit=limit, reason=criterion.reason if criterion else "",
    )  # fmt: skip
