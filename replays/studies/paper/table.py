"""The report's tables, each by the name that its template places it by."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from replays.report import Row
from replays.studies.paper import condition
from replays.studies.paper.claim import (
    BANDWIDTHS_HZ,
    LAWS,
    MEASURED_N,
    SCALES,
    Bar,
    bars,
    median,
    toward_measured,
)
from replays.studies.paper.findings import MARKS, Findings, Line
from replays.studies.paper.reproduction import Reproduction
from replays.studies.paper.spread import assumed_values, column, free_values, present, rank_correlation
from replays.studies.paper.statement import SETS, number, printed_values
from rig.kernels.constants import Constants
from rig.parameters import load_parameters

IDLE_N = 1.0
"""What moves both forces by less has no line of its own in the table [N]."""


class Content(NamedTuple):
    """What a table holds."""

    headings: tuple[str, ...]
    rows: list[Row] | list[tuple[str, ...]]


def summary(lines: list[Line]) -> Content:
    """Statements with their verdicts."""
    return Content(("statement", "where", "the paper", *SETS, "verdict"), [line.row() for line in lines])


def _speeds(findings: Findings) -> Content:
    found = findings.found
    rows = [
        (f"{speed:g}", *(number(one.numbers[f"force_{speed:g}"]) for one in found.values()),
         number(closed_force(findings.constants, whirling_spin(found["corrected"], speed))))
        for speed in found["corrected"].speeds
    ]  # fmt: skip
    names = [f"E - W, {name} [N]" for name in found]
    return Content(("speed [Hz]", *names, "closed form, m r (w^2 - w_n^2) [N]"), rows)


def whirling_spin(one: Reproduction, speed_hz: float) -> float:
    """Spin while it whirls, of the run at a speed of the drive [Hz]."""
    run = one.speeds[speed_hz]
    return float(np.mean(run["spin_rate"][run.times_s > run.times_s[-1] - 0.3]) / (2.0 * math.pi))


def closed_force(constants: Constants, spin_hz: float) -> float:
    """Force on a rigid ring in a rolling whirl at a spin [N], by closed form."""
    whirl, depth = condition.rolling_whirl(constants, 2.0 * math.pi * spin_hz)
    return condition.normal_force(condition.oscillator(constants), whirl, constants.contact.clearance + depth)


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
        ("D_bv = 2 zeta_x sqrt(K_bv M_ih), zeta_x = 0.026 [N s/m]", 238.0,
         damping(0.026, "house.inner_beam_stiffness", inner)),
        ("D_bh = 2 zeta_y sqrt(K_bh M_oh), zeta_y = 0.054, M_oh as printed [N s/m]", 1576.0,
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


def _mobility(findings: Findings) -> Content:
    groups = [(f"x {scale:g}", f"mobility {scale:g}") for scale in SCALES] + [("rigid", "alternative house rigid")]
    columns = {
        "peak_normal_n": "highest normal force [N]",
        "contacts": "impacts",
        "roll_s": "rolls after [s]",
        "reaction_x_n": "E - W in whirl [N]",
        "ripple_n": "ripple [N]",
    }
    rows = [(name, *(number(median(findings.results[group], key)) for key in columns)) for name, group in groups]
    return Content(("supports", *columns.values()), rows)


def _bandwidth(findings: Findings) -> Content:
    rows = [
        (f"{hz:g}", f"{result.reaction_x_n:.0f}", f"{result.peak_x_n:.0f}")
        for hz, result in zip(BANDWIDTHS_HZ, findings.results["bandwidth"], strict=True)
    ]
    return Content(("corner of a low-pass of order 2 [Hz]", "E - W in whirl [N]", "highest E - W [N]"), rows)


def _laws(findings: Findings) -> Content:
    columns = {
        "reaction_x_n": "E - W in whirl [N]",
        "normal_n": "mean normal force [N]",
        "peak_normal_n": "highest normal force [N]",
    }
    rows = [(law, *(f"{median(findings.results[f'law {law}'], key):.1f}" for key in columns)) for law in LAWS]
    return Content(("damping law", *columns.values()), rows)


def _spread(findings: Findings) -> Content:
    shown = {
        "reaction_x_n": "E - W in whirl [N]",
        "reaction_y_n": "N - S in whirl [N]",
        "normal_n": "mean normal force in whirl [N]",
        "peak_normal_n": "highest normal force [N]",
        "peak_x_n": "highest E - W [N]",
        "whirl_hz": "whirl frequency [Hz]",
        "spin_hz": "spin in whirl [Hz]",
    }

    def percentiles(name: str) -> list[str]:
        values = column(findings.spread, name)
        there = values[np.isfinite(values)]
        found = np.percentile(there, [5, 50, 95]).tolist() if len(there) else [math.nan] * 3
        return [number(value) for value in found]

    rows = [(label, *percentiles(name)) for name, label in shown.items()]
    return Content(("quantity", "5 %", "median", "95 %"), rows)


def _ranks(findings: Findings) -> Content:
    names = ("reaction_x_n", "peak_x_n", "whirl_hz")
    ranks = [rank_correlation(findings.parts, np.abs(column(findings.spread, name))) for name in names]
    rows = [(entry.key, *(number(float(each[k])) for each in ranks)) for k, entry in enumerate(free_values())]
    return Content(("assumed value", "with force in whirl", "with highest E - W", "with |whirl frequency|"), rows)


def _slowest(findings: Findings) -> Content:
    headings = ("friction mu", "slowest whirl that gains speed, simulated [Hz]", "closed form [Hz]", "error")
    rows = [(f"{t.friction:g}", number(t.bare), number(t.closed), f"{t.error:+.2%}") for t in findings.slowest]
    return Content(headings, rows)


def _least(findings: Findings) -> Content:
    headings = (
        "spin [Hz]", "least mu that keeps up whirl, bare rig", "closed form", "error", "full rig",
        "closed form with the houses' loss", "error", "rolls without slip from",
    )  # fmt: skip
    rows = [
        (f"{t.spin_hz:g}", number(t.bare), number(t.closed), f"{t.error:+.2%}", number(t.full),
         number(t.with_houses), f"{t.full / t.with_houses - 1.0:+.1%}", number(t.used[1]))
        for t in findings.least
    ]  # fmt: skip
    return Content(headings, rows)


def _starts(findings: Findings) -> Content:
    headings = ("blow of 5 ms at 6.2 Hz", "least mu that ends in rolling", "all above do from", "how the scan ends")
    rows = [(f"{each.force_n:g} N", number(each.first), number(each.always), each.words) for each in findings.starts]
    return Content(headings, rows)


def _sweep(findings: Findings) -> Content:
    rows = []
    for speed, result in findings.sweep.items():
        law, rigid = condition.law_hz(speed)
        error = f"{condition.law_error(result, speed):+.3%}"
        depth_um = f"{result.depth_m * 1e6:.2f}"
        rows.append((f"{speed:g}", number(result.whirl_hz), number(law), error, number(rigid), depth_um))
    headings = ("spin [Hz]", "simulated [Hz]", "-Omega R_S / (r0 + delta) [Hz]", "error", "rigid ring [Hz]")
    return Content((*headings, "penetration [um]"), rows)


def _assumed(findings: Findings) -> Content:
    rows = []
    for entry in assumed_values():
        unit = entry.unit or load_parameters("corrected").entries[entry.key].unit
        span = f"follows {entry.tied} / {entry.ratio:g}" if entry.tied else f"{entry.low:g} to {entry.high:g} {unit}"
        if entry.name:
            span += ", from there"
        rows.append((entry.key, present(entry), span, entry.why))
    return Content(("value", "taken", "range", "why"), rows)


TABLES: dict[str, Callable[[Findings], Content]] = {
    "statements": lambda findings: summary(findings.lines),
    "claims": lambda findings: summary(findings.claims),
    "speeds": _speeds,
    "printed": _printed,
    "worked-out": _worked_out,
    "tornado": _tornado,
    "mobility": _mobility,
    "bandwidth": _bandwidth,
    "laws": _laws,
    "spread": _spread,
    "ranks": _ranks,
    "slowest": _slowest,
    "least": _least,
    "starts": _starts,
    "sweep": _sweep,
    "assumed": _assumed,
}
"""All but those of the open questions."""
