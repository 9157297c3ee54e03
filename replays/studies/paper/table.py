"""The report's tables whose rows carry a verdict, each by the name that its template places it by."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from replays.report import Row
from replays.studies.paper.claim import MEASURED_N, Bar, bars, toward_measured
from replays.studies.paper.findings import MARKS, Findings, Line
from replays.studies.paper.statement import SETS, number, printed_values
from rig.parameters import load_parameters

IDLE_N = 1.0
"""What moves both forces by less has no line of its own in the table [N]."""


class Content(NamedTuple):
    """What a table holds."""

    headings: tuple[str, ...]
    rows: list[Row]


def summary(lines: list[Line]) -> Content:
    """Statements with their verdicts."""
    return Content(("statement", "where", "the paper", *SETS, "verdict"), [line.row() for line in lines])


def _printed(findings: Findings) -> Content:
    sets = {name: load_parameters(name) for name in SETS}
    rows = []
    for printed in printed_values():
        said = printed.verdict(sets["corrected"])
        if said == "differs" and sets["corrected"].entries[printed.key].kind == "corrected":
            said = "corrected"
        values = [number(parameters[printed.key]) for parameters in sets.values()]
        sources = [f"{name}: {each.entries[printed.key].source}" for name, each in sets.items()]
        source = "" if said == "agrees" else "; ".join(sources)
        shown = f"{number(printed.value)} {printed.unit}".removesuffix(" 1")
        cells = (printed.symbol, printed.place, shown, *values, source, said)
        rows.append(Row(cells, MARKS.get(said, "open")))
    return Content(("symbol", "where", "printed", *SETS, "why it differs", "corrected set"), rows)


def _worked_out(findings: Findings) -> Content:
    """Numbers that the text derives from its own."""
    p = load_parameters("corrected")
    printed_outer = next(entry.value for entry in printed_values() if entry.key == "house.outer_mass")

    def damping(zeta: float, stiffness: str, mass: float) -> float:
        return 2 * zeta * math.sqrt(p[stiffness] * mass)

    inner, outer, support = p["house.inner_mass"], p["house.outer_mass"], "house.outer_beam_stiffness"
    worked = (
        ("D_bv = 2 ζ_x √(K_bv M_ih), ζ_x = 0.026 [N s/m]", 238.0,
         damping(0.026, "house.inner_beam_stiffness", inner)),
        ("D_bh = 2 ζ_y √(K_bh M_oh), ζ_y = 0.054, M_oh as printed [N s/m]", 1576.0,
         damping(0.054, support, printed_outer)),
        ("the same with M_ih + M_oh of eqs. 24, 25 [N s/m]", 1576.0, damping(0.054, support, printed_outer + inner)),
        ("the same with the corrected M_oh alone [N s/m]", 1576.0, damping(0.054, support, outer)),
        ("whirl frequency 6.2 R_S / r0 [Hz]", 83.7, 6.2 * p["shaft.radius"] / p["ring.clearance"]),
    )  # fmt: skip
    rows = []
    for name, printed, ours in worked:
        verdict = "agrees" if abs(ours / printed - 1.0) < 5e-3 else "differs"
        rows.append(Row((name, number(printed), number(ours), verdict), MARKS[verdict]))
    return Content(("what the text works out", "printed", "ours", "verdict"), rows)


def idle_changes(findings: Findings) -> list[str]:
    """Changes that move neither the force in whirl nor the highest one by `IDLE_N`."""
    peaks = {bar.name: bar for bar in bars(findings.results, "peak_x_n")}
    found = bars(findings.results, "reaction_x_n")
    return [bar.name for bar in found if max(bar.width, peaks[bar.name].width) < IDLE_N]


def _tornado(findings: Findings) -> Content:
    found = bars(findings.results, "reaction_x_n")
    peaks = {bar.name: bar for bar in bars(findings.results, "peak_x_n")}
    reached = {bar.name for bar in toward_measured(found)}
    idle = set(idle_changes(findings))

    def row(bar: Bar) -> Row:
        there = bar.name in reached
        cells = (bar.name, bar.kind, _range(bar.values), f"{bar.width:.1f}", _range(peaks[bar.name].values),
                 "yes" if there else "no")  # fmt: skip
        return Row(cells, "good" if there else "plain")

    headings = ("change", "kind", "E - W in whirl [N]", "moves it by [N]", "highest E - W [N]")
    return Content((*headings, f"reaches {MEASURED_N:g} N"), [row(bar) for bar in found if bar.name not in idle])


def _range(values: tuple[float, ...]) -> str:
    """The ends and what is between; of many the lowest and the highest."""
    if len(values) > 3:
        values = (min(values), max(values))
    return " / ".join("none" if not math.isfinite(value) else f"{value:.0f}" for value in values)


TABLES: dict[str, Callable[[Findings], Content]] = {
    "statements": lambda findings: summary(findings.lines),
    "claims": lambda findings: summary(findings.claims),
    "printed": _printed,
    "worked-out": _worked_out,
    "tornado": _tornado,
}
