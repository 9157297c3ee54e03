"""The report: everything is run, then judged, then written down; no number in it is written by hand.

What it says stands in `report.jinja`, beside the statements that it judges; here are the numbers, tables and pictures
that the text names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.report import Report
from replays.report.canvas import save
from replays.studies.paper import condition, figure
from replays.studies.paper.chart import draw_conditions, draw_law
from replays.studies.paper.claim import (
    BANDWIDTHS_HZ,
    MEASURED_N,
    bars,
    draw_mobility,
    draw_spread,
    draw_tornado,
    median,
    toward_measured,
)
from replays.studies.paper.findings import Findings, count
from replays.studies.paper.question import Question, all_questions
from replays.studies.paper.spread import column, free_values, rank_correlation
from replays.studies.paper.statement import number
from replays.studies.paper.table import IDLE_N, TABLES, closed_force, idle_changes, summary, whirling_spin

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PLACED = re.compile(r"\[(?P<kind>table|picture|verdicts) (?P<name>[^],]+)(, (?P<dpi>\d+) dpi)?\] ?(?P<caption>.*)")


def write_up(findings: Findings, *, quick: bool) -> Report:
    """The report of what was found."""
    import jinja2

    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True, autoescape=False)
    environment.filters |= {"as": format, "number": number}
    template = environment.from_string(files(__package__).joinpath("report.jinja").read_text(encoding="utf-8"))
    questions = all_questions(findings.found, findings.results)
    text = template.render(quick=quick, **_numbers(findings, questions))
    title, lead, *blocks = [" ".join(block.split()) for block in re.split(r"\n\s*\n", text.strip())]
    report = Report(title, lead)
    for block in blocks:
        placed = _PLACED.fullmatch(block)
        if placed:
            _place(report, findings, questions, placed)
        elif block.startswith("#"):
            marks, _, words = block.partition(" ")
            report.heading(words, level=len(marks))
        else:
            report.text(block)
    return report


def _place(report: Report, findings: Findings, questions: dict[str, Question], placed: re.Match[str]) -> None:
    """Put a table or picture, or the summary's lines of one figure once more, where the text names it."""
    kind, name, caption = placed["kind"], placed["name"], placed["caption"]
    if kind == "picture":
        dpi = {"dpi": int(placed["dpi"])} if placed["dpi"] else {}
        report.picture(_PICTURES[name](findings), caption, **dpi)
    elif kind == "verdicts":
        lines = [*findings.lines, *findings.claims]
        report.table(*summary([line for line in lines if line.statement.quantity.startswith(tuple(name.split()))]))
    elif name.endswith("-question"):
        question = questions[name.removesuffix("-question")]
        report.table(question.headings, question.rows, caption=caption)
    else:
        report.table(*TABLES[name](findings), caption=caption)


_PICTURES: dict[str, Callable[[Findings], Figure]] = {
    "magnets": lambda findings: figure.draw_magnets(findings.found["corrected"]),
    "drop": lambda findings: figure.draw_drop(findings.found),
    "hammer": lambda findings: figure.draw_hammer(findings.found),
    "waterfall": lambda findings: figure.draw_waterfall(findings.found),
    "reactions": lambda findings: figure.draw_reactions(findings.found),
    "east": lambda findings: figure.draw_east(findings.found),
    "speeds": lambda findings: figure.draw_speeds(findings.found),
    "tornado": lambda findings: draw_tornado(findings.results, findings.spread),
    "mobility": lambda findings: draw_mobility(findings.results),
    "spread": lambda findings: draw_spread(findings.parts, findings.spread),
    "conditions": lambda findings: draw_conditions(
        findings.slowest, findings.least, findings.starts, findings.constants
    ),
    "law": lambda findings: draw_law(findings.sweep),
}


def draw_pictures(findings: Findings, folder: Path) -> list[Path]:
    """Write the pictures that tell most, as PNG files in a folder.

    Raises:
        OSError: The disk refused.
    """
    drawn = {name: _PICTURES[name](findings) for name in ("tornado", "conditions", "drop")}
    return [
        path for name, each in drawn.items() for path in save(each, folder / f"paper-{name}.png", dpi=80, colours=256)
    ]


def _numbers(findings: Findings, questions: dict[str, Question]) -> dict[str, Any]:
    """What the text is filled with."""
    lines = [*findings.lines, *findings.claims]
    own, constants, fastest = condition.oscillator(findings.constants), findings.constants, findings.least[-1]
    spin = 2.0 * math.pi * fastest.spin_hz
    whirl, depth = condition.rolling_whirl(constants, spin)
    force = condition.normal_force(own, whirl, constants.contact.clearance + depth)
    turned = condition.blow_whirl(constants, force_n=100.0, duration_s=5e-3)
    share = 0.5 * (turned / own.natural - own.natural / turned)
    kinds = [result.outcome for result in findings.spread]
    return {
        "lines": len(lines),
        "counts": count(lines),
        "measured_n": MEASURED_N,
        **{name: question.numbers for name, question in questions.items()},
        "tornado": {"idle_n": IDLE_N, "idle": idle_changes(findings)},
        "moves": _moves(findings),
        "ring": {
            "closed_n": closed_force(constants, whirling_spin(findings.found["corrected"], 6.2)),
            "rigid_n": median(findings.results["alternative house rigid"], "normal_n"),
        },
        "spread": {
            "runs": len(kinds),
            "outcomes": ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds)),
            "chance": 2 / math.sqrt(max(1, len(kinds))),
        },
        "own": {"mass": own.mass, "natural_hz": own.natural / (2 * math.pi), "ratio": own.ratio},
        "fastest": {
            "spin_hz": fastest.spin_hz,
            "swing_n": condition.friction_swing(constants, spin),
            "asked_n": fastest.with_houses * force,
        },
        "turned": {"whirl_hz": turned / (2 * math.pi), "friction": own.ratio / share},
    }


def _moves(findings: Findings) -> dict[str, Any]:
    """What moves the force toward the measured one."""
    results = findings.results

    def of(group: str, quantity: str = "reaction_x_n") -> float:
        return median(results[group], quantity)

    reached = toward_measured(bars(results, "reaction_x_n"))
    whirling = [result for result in findings.spread if result.whirls]
    ranks = np.nan_to_num(rank_correlation(findings.parts, column(findings.spread, "reaction_x_n")))
    first, second = ({"key": free_values()[k].key, "rank": ranks[k]} for k in np.argsort(-np.abs(ranks))[:2])
    low_passes = zip(BANDWIDTHS_HZ, results["bandwidth"], strict=True)
    return {
        "printed": of("base as-printed"),
        "base": of("base corrected"),
        "base_peak": of("base corrected", "peak_x_n"),
        "stiffer": of("mobility 10"),
        "stiffer_peak": of("mobility 10", "peak_x_n"),
        "reached": {
            kind: ", ".join(bar.name for bar in reached if bar.kind == kind) or "none"
            for kind in ("correction", "assumed value", "house", "other reading")
        },
        "corners_hz": [hz for hz, result in low_passes if result.reaction_x_n <= MEASURED_N],
        "whirling": len(whirling),
        "share": float(np.mean([result.reaction_x_n <= MEASURED_N for result in whirling])) if whirling else math.nan,
        "first": first,
        "second": second,
    }
