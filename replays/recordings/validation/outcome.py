"""Result of a validation: all comparisons with their criteria, the verdict, and a JSON document."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, astuple, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from replays.recordings.identification.nuisance import Fitted
from replays.recordings.identification.request import fit_unit
from replays.recordings.resimulation.prediction import Measured, Prediction
from replays.recordings.validation.bits import StreamBits
from replays.recordings.validation.explanations.attribution import Explained
from replays.recordings.validation.explanations.budget import Budget
from replays.recordings.validation.explanations.signals import SignalFault
from replays.recordings.validation.phases import QUANTITIES, Phase
from replays.recordings.validation.statistics import StatisticResult
from replays.recordings.validation.trajectory import ChannelResidual, Tolerated
from replays.recordings.validation.truth import TruthResult
from rig.base.outcome import Outcome
from rig.base.text import build_html_table
from rig.base.wire import TRUTH as TRUTH_KEY
from rig.channels.faults.defects import defects_in, earlier_name

_MIN_JUDGED = 0.99
"""Part of a recording's rows that must have been compared for a pass."""
_MAX_UNSEEN = 0.01
"""Time after the compared samples of a log without phases, over theirs, that a pass does not need."""


@dataclass(frozen=True)
class Failure:
    """A criterion that is not met, as text.

    Attributes:
        criterion: Criterion with its unit.
        recorded: Recorded value.
        foretold: Predicted value.
        limit: Allowed difference.
    """

    criterion: str
    recorded: str
    foretold: str
    limit: str

    @property
    def line(self) -> str:
        """Criterion, values and limit in one line."""
        return f"{self.criterion}: {self.recorded} against {self.foretold} ({self.limit})"


@dataclass(frozen=True)
class Validation:
    """Result of a validation.

    Attributes:
        path: The recording.
        scene: Name of the scene.
        criteria: Title of the criteria.
        changes: Changes relative to the recording.
        bits: Comparison of bits by key; empty if bits were not compared.
        bit_exact: Whether every payload is equal.
        declared: Whether the declared criteria decide even then.
        window_s: Begin and end of the judged trajectory [s].
        window_reason: Reason of its end.
        residuals: Residuals of every channel in the window.
        truth: Results of every truth table in the window.
        phases: Phases of the run.
        statistics: Results of every phase.
        calibration: Differences of the recording's channels from the rig's channel table, as text.
        skipped: Number of rows that the recording lost.
        explained: Explanation of a failure.
        fitted: Numbers fitted before the comparison, as an imported log does not state them exactly.
        parts: Recorded channels.
        nominal: Prediction.
        floating: Keys of the fitted numbers that have no prior and are not judged, on request.
        files: Number of files of the recording.
        faults: Faults that a log's signals show without a model.
        doubts: Inconsistencies within the recording; with any of them the validation fails.
        complete: Whether the recording was finished.
        contact_s: First contact of a log, if the trajectory ends before it [s]; otherwise None.
        tolerated: Parts of a log's residuals that what is uncertain explains.
        budgets: Uncertainties of fitted numbers and quantities of a log, on request.
        due_s: The same if the trajectory would have reached it with a valid model.
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
    fitted: tuple[Fitted, ...] = ()
    parts: dict[str, Measured] = field(repr=False, default_factory=dict)
    nominal: Prediction | None = field(repr=False, default=None)
    floating: tuple[str, ...] = ()
    files: int = 1
    faults: tuple[SignalFault, ...] = ()
    doubts: tuple[str, ...] = ()
    contact_s: float | None = None
    due_s: float | None = None
    tolerated: tuple[Tolerated, ...] = ()
    complete: bool = True
    budgets: tuple[Budget, ...] = ()

    def _repr_html_(self) -> str:
        title = f"{self.title}, by {self.criteria}: {self.outcome}; {self.bits_line}"
        return build_html_table(title, ("criterion not met", "recorded", "model", "limit"), map(astuple, self.failures))

    @property
    def outcome(self) -> Outcome:
        """Pass if the recording is bit-exact, or within every criterion, and enough of it was compared."""
        held = (self.bit_exact and not self.declared) or not self.failures
        failed = bool(self.doubts or self.faults or self.beyond) or not held
        return Outcome.judge(failed=failed, has_evidence=not self.unjudged)

    @property
    def good(self) -> bool:
        """True if nothing is wrong; `outcome` also requires that enough was compared."""
        return self.outcome is not Outcome.FAIL

    @property
    def unjudged(self) -> str:
        """Return the reason why too little was compared for a pass; empty if enough was."""
        if not self.complete:
            return "the recording is not complete, by an unknown number of rows; the existing rows pass"
        unknown = [one.key for one in self.fitted if one.key in self.floating and not one.is_determined]
        if unknown:
            return f"the recording does not determine {', '.join(unknown)}; the rest passes"
        if unsure := [one.line for one in self.fitted if one.is_at_limit]:
            return (
                f"at the limit of what is known, but not determined by this log: {'; '.join(unsure)}; the rest passes"
            )
        if self.bit_exact and not self.declared:
            rows = sum(one.rows for one in self.bits.values())
            if rows < _MIN_JUDGED * (rows + self.skipped):
                return f"{self.skipped} of {rows + self.skipped} rows are lost and were not compared"
            return "" if rows else "no row was compared"
        (begin_s, end_s), last_s = self.window_s, self.phases[-1].to_s if self.phases else 0.0
        if not (self.bits or self.statistics) and last_s > end_s + _MAX_UNSEEN * (end_s - begin_s):
            text = f"the samples to {end_s:.4f} s pass; the {last_s - end_s:.3g} s after them were not compared, as"
            return f"{text} no pair of probes and no four forces show the phases of motion"
        return "" if self.judged else "no criterion was applied"

    @property
    def judged(self) -> int:
        """Number of applied criteria."""
        count = sum(one.good is not None for one in (*self.residuals, *self.statistics)) + len(self.truth)
        return count + (self.due_s is not None)

    @property
    def beyond(self) -> list[str]:
        """Fitted numbers outside their known uncertainty, as text; each is a failure even if the model fits."""
        return [one.line for one in self.fitted if one.contradicts_prior]

    @property
    def failures(self) -> list[Failure]:
        """Criteria that are not met."""
        rows = []
        for one in self.residuals:
            if one.good is False and one.broken is not None:
                measure, value, limit = one.broken
                criterion = f"{one.channel}, residual over noise: {measure}"
                rows.append(Failure(criterion, f"{value:.3g}", one.alone(measure), f"≤ {limit:.3g}"))
        if self.due_s is not None:
            reached = f"{self.window_s[1]:.4f}"
            rows.append(Failure("trajectory, to the first contact [s]", reached, f"{self.due_s:.4f}", "beyond it"))
        for one in self.truth:
            if not one.good:
                criterion = f"truth {one.table}.{one.column}, relative error"
                rows.append(Failure(criterion, f"{one.relative:.2g}", "0", f"≤ {one.limit:.2g}"))
        for one in self.statistics:
            if one.good is False and one.limit is not None:
                limit = f"± {one.limit:.2g}"
                rows.append(Failure(f"{one.phase}, {one.title}", f"{one.recorded:.5g}", f"{one.foretold:.5g}", limit))
        return rows

    @property
    def title(self) -> str:
        """Name of the recording; of several parts that of the first."""
        return self.path.name + (f" and {self.files - 1} more" if self.files > 1 else "")

    @property
    def calibration_line(self) -> str:
        """Differences of the recording's channels from the rig's channel table in one line, or empty."""
        if len(self.calibration) < 2:
            return "".join(self.calibration)
        names = [line.partition(":")[0] for line in self.calibration]
        shown = ", ".join(names[:3]) + (", ..." if names[3:] else "")
        return f"{len(names)} channels ({shown}) differ from the rig's own table; the report says how"

    def legend(self, shown: Callable[[str, str], bool] = lambda _unit, _name: True) -> str:
        """Return the meaning of the quantities of phases, for those that `shown` selects by unit and name."""
        units = {one.quantity: one.unit or "1" for one in self.statistics}
        return "; ".join(f"{name}: {QUANTITIES[name].title}" for name, unit in units.items() if shown(unit, name))

    @property
    def bits_line(self) -> str:
        """Comparison of payloads in one line."""
        if not self.bits:
            return "imported: there are no payloads of this rig to compare"
        rows = sum(one.rows for one in self.bits.values())
        lost = f"; {self.skipped} rows that the recording lost are skipped" if self.skipped else ""
        cut = [f"{key.rpartition('/')[2]} {one.picked}" for key, one in self.bits.items() if one.picked]
        lost += f"; channels by name: {', '.join(cut)}" if cut else ""
        if self.bit_exact:
            there = " present" if self.doubts else ""
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
        """Outcome in one line."""
        if self.outcome is Outcome.INCONCLUSIVE:
            return f"inconclusive: {self.unjudged}"
        if self.outcome is Outcome.PASS:
            basis = "bit by bit" if self.bit_exact and not self.declared else f"by the criteria: {self.criteria}"
            unseen = "; no contact was compared sample by sample" if self.contact_s is not None else ""
            floated = f"; fitted, and not judged: {', '.join(self.floating)}" if self.floating else ""
            return f"pass, {basis}{unseen}{floated}"
        if self.doubts:
            more = f", and {len(self.doubts) - 1} more" if self.doubts[1:] else ""
            return f"fail, the recording is inconsistent: {self.doubts[0]}{more}"
        if self.faults and not self.failures:
            return f"fail, a signal shows a fault: {'; '.join(one.line for one in self.faults)}"
        if self.beyond and not self.failures:
            return f"fail, outside the known uncertainty: {'; '.join(self.beyond)}"
        channels = [one.channel for one in self.residuals if one.good is False]
        tables = [one.table for one in self.truth if not one.good]
        phases = [one.phase for one in self.statistics if one.good is False]
        parts = [f"trajectory of {_few(channels)}"] if channels else []
        parts += ["trajectory, which ends before the first contact"] if self.due_s is not None else []
        parts += [f"truth of {_few(tables)}"] if tables else []
        if phases:
            parts.append(
                "quantities: " + ", ".join(f"{phases.count(name)} of {name}" for name in dict.fromkeys(phases))
            )
        return f"fail, {len(self.failures)} of {self.judged} criteria: {'; '.join(parts)}"

    def document(self) -> dict[str, Any]:
        """Return everything except for the samples as a JSON document."""
        json_name = str if self.bits else earlier_name
        explained = None
        if (cause := self.explained) is not None:
            ranked = [{**asdict(one), "name": json_name(one.name), "defects": one.defects} for one in cause.ranked]
            explained = {**asdict(cause), "ranked": ranked, "best": [json_name(name) for name in cause.best]}
        return _plain(
            {
                "file": str(self.path),
                "scene": self.scene,
                "criteria": self.criteria,
                "changes": self.changes,
                "outcome": self.outcome.value,
                "good": self.outcome is Outcome.PASS,
                "bit_exact": self.bit_exact,
                "bits": {key: {**asdict(one), "equal": one.equal} for key, one in self.bits.items()},
                "rows_lost": self.skipped,
                "doubts": list(self.doubts),
                "faults": [
                    {**one._asdict(), "what": json_name(one.what), "defects": defects_in(one.what)}
                    for one in self.faults
                ],
                "fitted": [one.line for one in self.fitted],
                "floated": {
                    one.key: {"value": one.value, "half_width": one.half_width, "unit": fit_unit(one.key)}
                    for one in self.fitted
                    if one.key in self.floating
                },
                "budget": [{**asdict(one), "expanded": one.expanded} for one in self.budgets],
                "calibration": list(self.calibration),
                "window": {"from_s": self.window_s[0], "to_s": self.window_s[1], "reason": self.window_reason},
                "trajectory": [asdict(one) for one in self.residuals],
                "truth": [{**asdict(one), "good": one.good} for one in self.truth],
                "phases": [asdict(one) for one in self.phases],
                "statistics": [{**asdict(one), "good": one.good} for one in self.statistics],
                "failures": [asdict(one) for one in self.failures],
                "explained": explained,
            }
        )


def _few(names: list[str]) -> str:
    return " and ".join(names) if len(names) < 3 else f"{names[0]}, {names[1]} and {len(names) - 2} more"


def _plain(value: Any) -> Any:
    """Return a value without numpy's types, and with None for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
