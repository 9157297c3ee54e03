"""Everything that the report is made of: what is run, what is measured, and the verdict on each statement."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from replays.report import Mark, Row
from replays.studies.paper import condition
from replays.studies.paper.claim import LAWS, Groups, Results, claim_groups, median
from replays.studies.paper.condition import Start, Threshold
from replays.studies.paper.pulse import Outcome, Pulse, outcomes
from replays.studies.paper.question import question_groups
from replays.studies.paper.reproduction import SPEEDS_HZ, Reproduction, reproduce
from replays.studies.paper.spread import hypercube
from replays.studies.paper.statement import SETS, Statement, claims, number, statements
from rig.kernels.constants import Constants
from rig.levels import ModelLevels
from rig.model import build_model
from rig.parameters import load_parameters

MARKS: dict[str, Mark] = {"agrees": "good", "differs": "bad", "cannot be judged": "open"}
"""Verdicts, and how a table shows them."""
SWEEP_HZ = (2.0, 3.2, 4.2, 5.2, 6.2, 8.0, 10.0, 12.0)
START_FORCES_N = (60.0, 100.0, 180.0)


@dataclass(frozen=True)
class Line:
    """One line of the summary.

    Attributes:
        statement: What is stated.
        values: Ours by parameter set; a claim has `corrected` alone.
    """

    statement: Statement
    values: dict[str, float]

    @property
    def verdicts(self) -> dict[str, str]:
        """By parameter set."""
        return {name: self.statement.verdict(value) for name, value in self.values.items()}

    @property
    def verdict(self) -> str:
        """In words, one where both sets have the same."""
        found = self.verdicts
        if len(set(found.values())) == 1:
            return next(iter(found.values()))
        return ", ".join(f"{name} {verdict}" for name, verdict in found.items())

    def row(self) -> Row:
        """As a row of the summary."""
        said = self.statement
        unit = "" if said.unit == "1" else f" {said.unit}"
        ours = [f"{number(self.values[name])}{unit}" if name in self.values else "-" for name in SETS]
        return Row((said.says, said.place, said.paper, *ours, self.verdict), MARKS[self.verdicts[SETS[-1]]])


@dataclass
class Findings:
    """Everything that was run and measured.

    Attributes:
        found: The paper's runs by parameter set.
        results: Outcomes of the scans by group.
        parts: Of the hypercube, shape (samples, values).
        spread: Its outcomes.
        sweep: Outcomes of the speed sweep by speed [Hz].
        starts: Friction needed to start, by pulse.
        slowest: Slowest sliding whirl that gains speed.
        least: Least friction that keeps up whirl.
        constants: Of the corrected rig.
        lines: The summary.
        claims: The part of it that scans tell.
    """

    found: dict[str, Reproduction]
    results: Results
    parts: np.ndarray
    spread: list[Outcome]
    sweep: dict[float, Outcome]
    starts: list[Start]
    slowest: list[Threshold]
    least: list[Threshold]
    constants: Constants
    lines: list[Line] = field(default_factory=list)
    claims: list[Line] = field(default_factory=list)


JUDGED_BY = (
    "assumed rule: a curve must stay inside the paper's axis and fill more than 2/5 of it, a number in the text be "
    "met to 1 %"
)
"""What agrees, in a line."""


def count(lines: list[Line]) -> dict[str, int]:
    """Lines by what comes out for the corrected rig."""
    return {verdict: sum(line.verdicts[SETS[-1]] == verdict for line in lines) for verdict in MARKS}


def planned_groups(*, quick: bool) -> Groups:
    """Every pulse that is run, by group."""
    ensemble = 2 if quick else 9
    return {
        **claim_groups(ensemble=ensemble),
        **question_groups(ensemble=ensemble),
        "hypercube": hypercube(32 if quick else 512)[1],
        "sweep": condition.sweep_pulses(SWEEP_HZ[1:6:2] if quick else SWEEP_HZ),
    }


def steps(*, quick: bool) -> int:
    """How many steps `find` tells of."""
    each = len(SETS) * (len(SPEEDS_HZ) + 3)
    return each + sum(len(group) for group in planned_groups(quick=quick).values()) + len(_forces(quick=quick)) + 2


def _forces(*, quick: bool) -> tuple[float, ...]:
    """Hammer pulses over which friction is scanned [N]; the paper's is one of them."""
    return START_FORCES_N[1:2] if quick else START_FORCES_N


def find(*, quick: bool = False, processes: int = 2, progress: Callable[[str], None] | None = None) -> Findings:
    """Run and measure everything.

    Args:
        quick: Fewer and shorter runs.
        processes: How many at a time in the scans.
        progress: Told what is done, `steps` times.
    """
    tell = progress or (lambda _: None)
    found = {name: reproduce(name, quick=quick, progress=tell) for name in SETS}
    groups = planned_groups(quick=quick)
    pulses: list[Pulse] = [pulse for group in groups.values() for pulse in group]
    done = list(outcomes(pulses, processes=processes, progress=tell))
    ends = np.cumsum([0, *(len(group) for group in groups.values())])
    results = {name: done[a:b] for name, (a, b) in zip(groups, pairwise(ends.tolist()), strict=True)}
    starts = []
    for force in _forces(quick=quick):
        starts.append(condition.start_by_pulse(force, points=12 if quick else 39))
        tell(f"friction over a pulse of {force:g} N")
    slowest = condition.start_thresholds((0.08, 0.25)) if quick else condition.start_thresholds()
    tell("slowest whirl that friction keeps up")
    least = condition.sustain_thresholds((6.2,)) if quick else condition.sustain_thresholds()
    tell("least friction that keeps up whirl")
    findings = Findings(
        found=found,
        results=results,
        parts=hypercube(len(groups["hypercube"]))[0],
        spread=results["hypercube"],
        sweep={pulse.speed_hz: result for pulse, result in zip(groups["sweep"], results["sweep"], strict=True)},
        starts=starts,
        slowest=slowest,
        least=least,
        constants=build_model(load_parameters("corrected"), ModelLevels()).constants,
    )
    findings.lines = [
        Line(said, {name: one.numbers[said.quantity] for name, one in found.items()}) for said in statements()
    ]
    numbers = claim_numbers(findings)
    findings.claims = [Line(said, {"corrected": numbers[said.quantity]}) for said in claims()]
    return findings


def claim_numbers(findings: Findings) -> dict[str, float]:
    """What each claim asks for."""
    results, constants = findings.results, findings.constants

    def ratio(above: str, below: str, quantity: str) -> float:
        return median(results[above], quantity) / median(results[below], quantity)

    def moved(quantity: str) -> float:
        values = [median(results[f"law {law}"], quantity) for law in LAWS]
        return max(values) / min(values) - 1.0

    own = condition.oscillator(constants)
    whirl = 2.0 * math.pi * abs(findings.found["corrected"].numbers["whirl_hz"])
    r0 = constants.contact.clearance
    restoring = own.mass * own.natural**2 * r0 + 2.0 * own.mass * own.ratio * own.natural * whirl * r0
    start = next(start for start in findings.starts if start.force_n == 100.0)
    return {
        "excess_inertia": ratio("base corrected", "alternative house rigid", "reaction_x_n"),
        "inertia_ripple": ratio("base corrected", "alternative house rigid", "ripple_n"),
        "mobility_contacts": ratio("mobility 10", "mobility 1", "contacts"),
        "mobility_peak": ratio("mobility 10", "mobility 1", "peak_normal_n"),
        "mobility_time": ratio("mobility 10", "mobility 1", "roll_s"),
        "mobility_reaction": ratio("mobility 10", "mobility 1", "peak_x_n"),
        "law_whirl": moved("reaction_x_n"),
        "law_peak": moved("peak_normal_n"),
        "centrifugal": constants.shaft.mass * r0 * whirl**2 / restoring,
        "critical": whirl / condition.critical_whirl(own, constants.contact.friction),
        "eigenfrequency": own.natural / whirl,
        "friction_start": constants.contact.friction / start.always,
        "law_error": max(abs(condition.law_error(result, speed)) for speed, result in findings.sweep.items()),
    }
