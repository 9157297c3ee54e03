"""Tables of the report with verdicts, by the names used in its template."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from replays.report import Row
from replays.studies.common.closed_forms import impact
from replays.studies.paper.claim import Bar, bars, select_lower_ends
from replays.studies.paper.findings import LENGTHS_MS, MARKS, Findings, Line
from replays.studies.paper.scans.pulse import MEASURED_N
from replays.studies.paper.scans.spread import column
from replays.studies.paper.statement import SETS, distribution, number, printed_values
from rig.physics.parameters import load_parameters

IDLE_N = 1.0
"""Change of both forces below which a change is omitted from the table [N]."""


class Content(NamedTuple):
    """Content of a table."""

    headings: tuple[str, ...]
    rows: list[Row]


def summary(lines: list[Line]) -> Content:
    """Return statements with their verdicts."""
    headings = ("statement", "where", "the paper", "unit", *SETS, "inside", "verdict")
    return Content(headings, [line.row() for line in lines])


def _printed_values(findings: Findings) -> Content:
    sets = {name: load_parameters(name) for name in SETS}
    rows = []
    for printed in printed_values():
        verdict = printed.verdict(sets["corrected"])
        if verdict == "agrees":
            verdict = "as printed"
        elif sets["corrected"].entries[printed.key].kind == "corrected":
            verdict = "corrected"
        values = [number(parameters[printed.key]) for parameters in sets.values()]
        sources = [f"{name}: {each.entries[printed.key].source}" for name, each in sets.items()]
        source = "" if verdict == "as printed" else "; ".join(sources)
        unit = "" if printed.unit == "1" else printed.unit
        cells = (printed.symbol, printed.place, unit, number(printed.value), *values, source, verdict)
        rows.append(Row(cells, "plain" if verdict == "as printed" else MARKS.get(verdict, "open")))
    return Content(("symbol", "where", "unit", "printed", *SETS, "why it differs", "corrected set"), rows)


def _derived_numbers(findings: Findings) -> Content:
    """Return the numbers that the text derives from its own."""
    p = load_parameters("corrected")
    printed_outer = next(entry.value for entry in printed_values() if entry.key == "house.outer_mass")

    def damping(zeta: float, stiffness: str, mass: float) -> float:
        return 2 * zeta * math.sqrt(p[stiffness] * mass)

    inner, outer, support = p["house.inner_mass"], p["house.outer_mass"], "house.outer_beam_stiffness"
    # A free decay depends on the mass at the magnets, not on M.
    modal = p["shaft.transverse_inertia"] / p["shaft.arm_magnet"] ** 2
    zetas = {axis: p[f"shaft.damping_ratio_{axis}"] for axis in "xy"}
    derived: list[tuple[str, float | None, float]] = [
        ("D_bv = 2 ζ_x √(K_bv M_ih), ζ_x = 0.026 [N s/m]", 238.0,
         damping(0.026, "house.inner_beam_stiffness", inner)),
        ("D_bh = 2 ζ_y √(K_bh M_oh), ζ_y = 0.054, M_oh as printed [N s/m]", 1576.0,
         damping(0.054, support, printed_outer)),
        ("the same with M_ih + M_oh of eqs. 24, 25 [N s/m]", None, damping(0.054, support, printed_outer + inner)),
        ("the same with the corrected M_oh alone [N s/m]", None, damping(0.054, support, outer)),
    ]  # fmt: skip
    e = 0.90
    eq_44 = impact(mass=1.0, speed=0.1, stiffness=1e10, exponent=1.5, factor=0.75 * (1.0 - e**2), speed_floor=1e-3)
    derived.append(("e that eq. 44 returns for a specified 0.90 [1]", e, eq_44.restitution))
    for axis, zeta in zetas.items():
        of_mass = damping(zeta, "magnet.stiffness", p["shaft.mass"])
        decays = of_mass / damping(1.0, "magnet.stiffness", modal)
        derived.append((f"D_{axis} = 2 ζ_{axis} √(K_mag M), eq. 10, K_mag assumed [N s/m]", None, of_mass))
        derived.append((f"ζ_{axis} of that free decay, D_{axis}/(2 √(K_mag I_xx/l_0B²)), any K_mag", zeta, decays))
    rows = []
    for name, printed, ours in derived:
        if printed is None:
            rows.append(Row((name, "–", number(ours), "not printed")))
            continue
        verdict = "agrees" if abs(ours / printed - 1.0) < 5e-3 else "differs"
        rows.append(Row((name, number(printed), number(ours), verdict), MARKS[verdict]))
    return Content(("value derived in the text", "printed", "our result", "verdict"), rows)


def idle_changes(findings: Findings) -> list[str]:
    """Return the changes that move neither the force in whirl nor the highest one by `IDLE_N`."""
    peaks = {bar.name: bar for bar in bars(findings.results, "peak_x_n")}
    chart = bars(findings.results, "reaction_x_n")
    return [bar.name for bar in chart if max(bar.width, peaks[bar.name].width) < IDLE_N]


def _tornado(findings: Findings) -> Content:
    chart = bars(findings.results, "reaction_x_n")
    peaks = {bar.name: bar for bar in bars(findings.results, "peak_x_n")}
    reached = {bar.name for bar in select_lower_ends(chart)}
    idle = set(idle_changes(findings))

    def row(bar: Bar) -> Row:
        there = bar.name in reached
        cells = (bar.name, bar.kind, _range(bar.values), f"{bar.width:.1f}", _range(peaks[bar.name].values),
                 "yes" if there else "no")  # fmt: skip
        return Row(cells, "good" if there else "plain")

    headings = ("change", "kind", "E − W in whirl [N]", "change [N]", "highest E − W [N]")
    return Content((*headings, f"reaches {MEASURED_N:g} N"), [row(bar) for bar in chart if bar.name not in idle])


def _range(values: tuple[float, ...]) -> str:
    """Format the values; of more than three, only the lowest and the highest."""
    if len(values) > 3:
        values = (min(values), max(values))
    return " / ".join("none" if not math.isfinite(value) else f"{value:.0f}" for value in values)


def _lengths(findings: Findings) -> Content:
    """Return the highest reactions of Fig. 15 by pulse length, distributed over the phases of the shaft."""
    rows = []
    for name in SETS:
        for length_ms in LENGTHS_MS:
            group = findings.results[f"length {length_ms:g} {name}"]
            cells = [f"{name}, {length_ms:g} ms"]
            for entry in (line.statement for line in findings.lines if line.statement.quantity in ("peak_x", "peak_y")):
                values = column(group, f"true_{entry.quantity}_n")
                cells += [distribution(values), entry.format_share(values)]
            rows.append(Row(tuple(cells)))
    return Content(("pulse", "E − W [N]", "agree", "N − S [N]", "agree"), rows)


TABLES: dict[str, Callable[[Findings], Content]] = {
    "printed": _printed_values,
    "worked-out": _derived_numbers,
    "lengths": _lengths,
    "tornado": _tornado,
}
