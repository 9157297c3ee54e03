"""Runs, results and verdicts of the report.

Each of our numbers is a distribution over the phases of the shaft at the pulse, over all assumed values at once, and
over the possible readings of the paper's text.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from replays.report import Mark, Row
from replays.studies.paper.claim import ENDS, LAWS, Groups, Results, claim_groups, median, stiffer_houses
from replays.studies.paper.open_questions import question_groups
from replays.studies.paper.reproduction import SPEEDS_HZ, Reproduction, drop_spread, pulse_spread, reproduce
from replays.studies.paper.scans import condition
from replays.studies.paper.scans.condition import Slip, Start, Threshold
from replays.studies.paper.scans.pulse import HAMMER_MS, Pulse, PulseRun, outcomes, pulse_model
from replays.studies.paper.scans.spread import column, hypercube, phases
from replays.studies.paper.statement import MIN_RUNS, SETS, Statement, claims, distribution, statements
from rig.physics.kernels.constants import Constants
from rig.physics.levels import ModelLevels
from rig.physics.model import build_model
from rig.physics.parameters import load_parameters

MARKS: dict[str, Mark] = {"agrees": "good", "differs": "bad", "cannot be judged": "open"}
"""Verdicts and their marks in a table."""
SWEEP_HZ = (2.0, 3.2, 4.2, 5.2, 6.2, 8.0, 10.0, 12.0)
START_FORCES_N = (60.0, 100.0, 180.0)


@dataclass(frozen=True)
class Line:
    """One line of the summary.

    Attributes:
        statement: Statement of the paper.
        values: Our values by parameter set, each of shape (n,); a claim has only `corrected`.
    """

    statement: Statement
    values: dict[str, np.ndarray]

    @property
    def verdicts(self) -> dict[str, str]:
        """Verdicts by parameter set."""
        return {name: self.statement.verdict(values) for name, values in self.values.items()}

    def row(self) -> Row:
        """Return the line as a table row, with the verdict on the corrected rig."""
        entry, best = self.statement, SETS[-1]
        ours = [distribution(self.values[name]) if name in self.values else "–" for name in SETS]
        cells = (entry.says, entry.place, entry.paper, "" if entry.unit == "1" else entry.unit, *ours)
        verdict, values = self.verdicts[best], self.values[best]
        why = entry.why or ("too few runs" if entry.is_short(values) else "")
        return Row((*cells, entry.format_share(values), f"{verdict}: {why}" if why else verdict), MARKS[verdict])


@dataclass
class Findings:
    """Everything that was run and measured.

    Attributes:
        runs_by_set: The paper's runs by parameter set.
        results: Outcomes of the scans by group.
        parts: Points of the hypercube, shape (samples, values).
        spread: Its outcomes with the corrected set.
        sweep: Outcomes of the speed sweep by speed [Hz].
        starts: Friction required to start a whirl, by pulse.
        slowest: Slowest sliding whirl that accelerates.
        least: Least friction that sustains whirl.
        slips: Transitions from sliding whirl to rolling.
        constants: Constants of the corrected rig.
        lines: The summary.
        claims: Lines of the summary from scans.
    """

    runs_by_set: dict[str, Reproduction]
    results: Results
    parts: np.ndarray
    spread: list[PulseRun]
    sweep: dict[float, PulseRun]
    starts: list[Start]
    slowest: list[Threshold]
    least: list[Threshold]
    slips: list[Slip]
    constants: Constants
    lines: list[Line] = field(default_factory=list)
    claims: list[Line] = field(default_factory=list)


JUDGED_BY = (
    "a result agrees if at least 95 % of it lies in the range that the paper states, differs if at most 5 % does, and "
    f"cannot be judged otherwise, or from fewer than {MIN_RUNS} runs; assumed: a curve fills more than 2/5 of the "
    "labelled range of its axis and ends before the next label would be, and a number in the text is accurate to 1 %"
)
"""Criterion of agreement, in a line."""
LENGTHS_MS = (4.0, 5.0, 6.0)
"""Pulse lengths for which the impacts of Fig. 15 are shown over the phases [ms]."""


def list_groups(*, quick: bool) -> Groups:
    """Return every pulse to run, by group."""
    ensemble, few = (2, 4) if quick else (9, 40)
    groups = {**claim_groups(ensemble=ensemble), **question_groups(ensemble=ensemble)}
    for name in SETS:
        for length_ms in LENGTHS_MS:
            pulse = Pulse(label=f"{length_ms:g} ms, {name}", parameters=name, changes={HAMMER_MS: length_ms})
            groups[f"length {length_ms:g} {name}"] = phases(pulse, 2 if quick else 12)
        _, groups[f"spread {name}"] = hypercube(16 if quick else 192, parameters=name)
        longer = 5.0 if quick else 20.0
        groups[f"lasting {name}"] = [
            replace(pulse, duration_s=longer) for pulse in groups[f"spread {name}"][: few // 4]
        ]
        groups[f"slow {name}"] = [replace(pulse, speed_hz=SPEEDS_HZ[0]) for pulse in groups[f"spread {name}"][:few]]
    for name, changed in stiffer_houses().items():
        some = groups["spread corrected"][:few]
        groups[f"spread {name}"] = [replace(pulse, changes={**pulse.changes, **changed}) for pulse in some]
    return {**groups, "sweep": condition.sweep_pulses(SWEEP_HZ[1:6:2] if quick else SWEEP_HZ)}


def steps(*, quick: bool) -> int:
    """Return the number of progress reports of `find`."""
    each = len(SETS) * (len(SPEEDS_HZ) + 4)
    return each + sum(len(group) for group in list_groups(quick=quick).values()) + len(_forces(quick=quick)) + 3


def _forces(*, quick: bool) -> tuple[float, ...]:
    """Return the hammer forces for which friction is scanned [N]; the paper's is one of them."""
    return START_FORCES_N[1:2] if quick else START_FORCES_N


def find(*, quick: bool = False, processes: int = 2, progress: Callable[[str], None] | None = None) -> Findings:
    """Run and measure everything.

    Args:
        quick: Use fewer and shorter runs.
        processes: Number of parallel processes for the scans.
        progress: Function that receives a text for each step, `steps` times in all.
    """
    report = progress or (lambda _: None)
    by_set = {name: reproduce(name, quick=quick, progress=report) for name in SETS}
    groups = list_groups(quick=quick)
    pulses: list[Pulse] = [pulse for group in groups.values() for pulse in group]
    done = list(outcomes(pulses, processes=processes, progress=report))
    ends = np.cumsum([0, *(len(group) for group in groups.values())])
    results = {name: done[a:b] for name, (a, b) in zip(groups, pairwise(ends.tolist()), strict=True)}
    starts = []
    for force in _forces(quick=quick):
        starts.append(condition.start_by_pulse(force, points=12 if quick else 77))
        report(f"friction over a pulse of {force:g} N")
    slowest = condition.start_thresholds((0.08, 0.25)) if quick else condition.start_thresholds()
    report("slowest whirl that friction keeps up")
    least = condition.sustain_thresholds((6.2,)) if quick else condition.sustain_thresholds()
    report("least friction that keeps up whirl")
    slips = condition.find_slips()
    report("from slipping to rolling")
    drops = {}
    for name in SETS:
        drops[name] = drop_spread(name, 4 if quick else 40)
        report(f"drops, {name}")
    findings = Findings(
        runs_by_set=by_set,
        results=results,
        parts=hypercube(len(groups["spread corrected"]))[0],
        spread=results["spread corrected"],
        sweep={pulse.speed_hz: result for pulse, result in zip(groups["sweep"], results["sweep"], strict=True)},
        starts=starts,
        slowest=slowest,
        least=least,
        slips=slips,
        constants=build_model(load_parameters("corrected"), ModelLevels()).constants,
    )
    ours = {
        name: {key: np.array([value]) for key, value in one.numbers.items()}
        | drops[name]
        | pulse_spread(*(results[f"{group} {name}"] for group in ("spread", "slow", "lasting")))
        for name, one in by_set.items()
    }
    findings.lines = [Line(entry, {name: ours[name][entry.quantity] for name in SETS}) for entry in statements()]
    numbers = claim_numbers(findings)
    findings.claims = [Line(entry, {"corrected": numbers[entry.quantity]}) for entry in claims()]
    return findings


def claim_numbers(findings: Findings) -> dict[str, np.ndarray]:
    """Return the numbers for each claim from all relevant runs and readings, each of shape (n,)."""
    results = findings.results

    def stiffness_ratios(houses: Iterable[str], *quantities: str) -> np.ndarray:
        """Return ratios of less mobile housings to the corrected ones in the same run; all are readings."""
        numbers = []
        for each in (results[f"spread {name}"] for name in houses):
            numbers += [column(each, name) / column(findings.spread[: len(each)], name) for name in quantities]
        return np.concatenate(numbers)

    def laws(name: str, *groups: str) -> np.ndarray:
        """Return medians with other contact laws relative to the default one."""
        return np.array([median(results[group], name) for group in groups]) / median(results["base corrected"], name)

    other = [f"law {law}" for law in LAWS[1:]]
    both_sides: list[tuple[float, ...]] = []
    for pulse, result in zip(
        hypercube(len(findings.spread))[1], findings.spread[: len(results["slow corrected"])], strict=False
    ):
        both_sides.append(conditions(pulse_model(pulse, pulse.changes).constants, result.whirl_hz))
    numbers = {
        "house_raises": 1.0 / stiffness_ratios(["rigid"], "reaction_x_n"),
        "house_ripple": 1.0 / stiffness_ratios(["rigid"], "ripple_n"),
        "stiff_bouncing": stiffness_ratios(stiffer_houses(), "contacts", "roll_s", "rebound_m_s"),
        "stiff_force": stiffness_ratios(stiffer_houses(), "peak_normal_n", "true_peak_x_n", "true_peak_y_n"),
        "law_whirl": laws("reaction_x_n", *other, *(f"{end} contact.stiffness" for end in ENDS)),
        "law_peak": 100.0 * np.abs(laws("peak_normal_n", *other) - 1.0),
        **dict(zip(("centrifugal", "critical", "eigenfrequency"), np.array(both_sides).T, strict=True)),
    }
    return {name: values[np.isfinite(values)] for name, values in numbers.items()}


def conditions(constants: Constants, whirl_hz: float) -> tuple[float, ...]:
    """Return ratios of both sides of eqs. 42 and 43, and of eigenfrequency and whirl frequency."""
    own, r0, whirl = condition.oscillator(constants), constants.contact.clearance, 2.0 * math.pi * abs(whirl_hz)
    restoring = own.mass * own.natural * r0 * (own.natural + 2.0 * own.ratio * whirl)
    friction = constants.contact.friction
    return (
        constants.shaft.mass * r0 * whirl**2 / restoring,
        whirl / condition.critical_whirl(own, friction),
        own.natural / whirl,
    )
