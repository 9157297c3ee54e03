"""Comparison of the recorded truth of the model with its prediction, by table, and energies of a phase."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from recorder.reader import Recording
from replays.recordings.resimulation.prediction import Prediction
from replays.recordings.validation.criteria import Criteria
from replays.recordings.validation.phases import Phase
from rig.base.wire import truth_key
from rig.physics.kernels.signals import TRUTH

_ROUNDING = 1e-6
"""Relative difference by rounding, of tables of the same motion."""
_CENTRE = 0.99
"""Contact truth is compared where the gap is below this part of the clearance."""

TruthTables = dict[str, tuple[np.ndarray, np.ndarray]]
"""Row numbers, shape (n,), and values [SI], shape (n, columns), by the table's name."""


@dataclass(frozen=True)
class TruthResult:
    """Result for a truth table within the window: largest difference relative to each column's largest value."""

    table: str
    column: str
    relative: float
    limit: float

    @property
    def good(self) -> bool:
        """True if the criterion is met."""
        return self.relative <= self.limit


def recorded_truth(recording: Recording, *, longest_s: float) -> TruthTables:
    """Return row numbers and values of the truth tables with the columns of this version."""
    tables = {}
    for name, columns in TRUTH.items():
        if name not in recording.catalogue.get("truth", {}):
            continue
        samples = recording.truth(name)
        if samples.names == columns and len(samples.index):
            kept = samples.times_s < longest_s
            tables[name] = (samples.index[kept], samples.values[kept])
    return tables


def judge_truth(
    tables: TruthTables,
    nominal: Prediction,
    perturbed: Prediction,
    criteria: Criteria,
    *,
    end_s: float,
) -> list[TruthResult]:
    """Compare truth tables with the prediction up to a time [s]; limits include ten times a perturbation's effect."""
    results = []
    for name, (index, values) in tables.items():
        here, there = nominal.truth[name], perturbed.truth[name]
        kept = (index < min(len(here), len(there))) & (index < end_s * nominal.truth_rate_hz)
        if name == "contact":  # at the centre its direction and tangential speed are undefined
            kept &= np.append(here[:, 0], 0.0)[np.minimum(index, len(here))] > _CENTRE * here[:, 0].min()
        rows, recorded = index[kept], values[kept]
        if not len(rows):
            continue
        scale = np.abs(here).max(axis=0)
        scale[scale == 0.0] = 1.0
        off = np.abs(recorded - here[rows]).max(axis=0) / scale
        allowed = criteria.truth.relative + 10.0 * np.abs(there[rows] - here[rows]).max(axis=0) / scale
        worst = int(np.argmax(off / allowed))
        results.append(TruthResult(name, TRUTH[name][worst], float(off[worst]), float(allowed[worst])))
    return results


def find_contradictions(tables: TruthTables, nominal: Prediction, equal: Collection[str]) -> list[str]:
    """Return the truth tables that differ from those of the same motion, if the state is equal to the bit.

    Args:
        tables: Recorded tables.
        nominal: Prediction.
        equal: Keys of the streams that are equal to the bit.
    """
    found = []
    for name, (index, values) in tables.items() if truth_key("state") in equal else ():
        here = nominal.truth[name]
        index, values = index[index < len(here)], values[index < len(here)]
        off = np.abs(values - here[index]).max(axis=0, initial=0.0) / np.maximum(np.abs(here).max(axis=0), 1e-300)
        if off.max() > _ROUNDING:
            column = f"{TRUTH[name][int(off.argmax())]} by up to {off.max():.2g} of its largest value"
            found.append(f"truth/{name} contradicts truth/state, which is equal to the bit: {column}")
    return found


def energy_change(
    table: tuple[np.ndarray, np.ndarray], columns: tuple[str, ...], phase: Phase, prediction: Prediction
) -> tuple[float, float]:
    """Return the recorded and the predicted change of a sum of integrals over a phase [J]."""
    index, values = table
    picked = np.array([TRUTH["energy"].index(column) for column in columns])
    rate = prediction.truth_rate_hz
    rows = np.flatnonzero((index >= phase.from_s * rate) & (index < phase.to_s * rate))
    rows = rows[index[rows] < len(prediction.truth["energy"])]
    if len(rows) < 2:
        return 0.0, 0.0
    ends = rows[[0, -1]]
    recorded = values[np.ix_(ends, picked)].sum(axis=1)
    predicted = prediction.truth["energy"][np.ix_(index[ends], picked)].sum(axis=1)
    return float(recorded[1] - recorded[0]), float(predicted[1] - predicted[0])
