"""Report of the reproduction: runs, verdicts, and text whose numbers are all computed.

The text is in `report.jinja`, next to the statements it discusses; this module provides numbers, tables and pictures.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.report import Report, Row
from replays.report.canvas import save
from replays.studies.paper import open_questions
from replays.studies.paper.claim import (
    BANDWIDTHS_HZ,
    LAWS,
    SCALES,
    bars,
    draw_mobility,
    draw_spread,
    draw_tornado,
    median,
    select_lower_ends,
)
from replays.studies.paper.figures import figure
from replays.studies.paper.figures.chart import draw_conditions, draw_law, draw_verdicts
from replays.studies.paper.figures.table import IDLE_N, TABLES, Content, idle_changes, summary
from replays.studies.paper.findings import JUDGED_BY, Findings
from replays.studies.paper.scans import condition
from replays.studies.paper.scans.pulse import MEASURED_N
from replays.studies.paper.scans.spread import (
    assumed_values,
    column,
    format_value,
    free_values,
    percentiles,
    rank_correlation,
)
from replays.studies.paper.statement import MIN_RUNS, number, wilson_bounds
from rig.physics.parameters import load_parameters

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PLACED = re.compile(r"\[(?P<kind>table|picture|verdicts) (?P<name>[^],]+)\] ?(?P<caption>.*)")
_PRINT = (
    (re.compile(r"(?<![\w.])([A-Za-zωζνµ])_([A-Za-z0-9]{1,3})(?![A-Za-z0-9_])"), r"\1_{\2}"),
    (re.compile(r"(?<=\d)e([+-])0*(\d+)"), lambda power: f"·10^{{{power[1].strip('+')}{power[2]}}}"),
    (re.compile(r"(?<![\w.)])-(?=\d)|(?<=\{)-"), "−"),
    (re.compile(r"\^(\w)"), r"^{\1}"),
    (re.compile(r"(?<=\d) count$"), ""),
)
"""Typesetting: subscripts (R_S, but not names of parameters), powers, minus signs; a count has no unit."""
_CELLS = " | "
"""Separator of table cells in the text."""


def write_up(findings: Findings, *, quick: bool, origin: Mapping[str, str] | None = None) -> Report:
    """Return the report on the findings.

    Args:
        findings: The findings.
        quick: Whether they come from few, short runs.
        origin: Sources of the report by name.
    """
    import jinja2

    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, autoescape=False
    )
    environment.filters |= {"as": format, "number": number}
    template = environment.from_string(
        files("replays.studies.paper").joinpath("report.jinja").read_text(encoding="utf-8")
    )
    text = template.render(quick=quick, **_numbers(findings))
    title, lead, *blocks = re.split(r"\n\s*\n", text.strip())
    report = Report(typeset(title), typeset(lead), origin=origin)
    for block in blocks:
        words = typeset(block)
        placed = _PLACED.fullmatch(words)
        if placed:
            _place(report, findings, placed)
        elif block.startswith("#"):
            marks, _, heading = words.partition(" ")
            report.heading(heading, level=len(marks))
        elif _CELLS in block:
            _add_table(report, block)
        else:
            report.text(words)
    return report


def typeset(text: str) -> str:
    """Join the lines of a text and typeset its symbols, powers of ten and signs."""
    words = " ".join(text.split())
    for written, printed in _PRINT:
        words = written.sub(printed, words)
    return words


def _typeset_table(content: Content) -> Content:
    """Format the cells of a table as in print."""
    rows = [Row(tuple(map(typeset, row.cells)), row.mark) for row in content.rows]
    return Content(tuple(map(typeset, content.headings)), rows)


def _add_table(report: Report, block: str) -> None:
    """Add a table from the text: caption, headings, rows; an indented line continues the previous one."""
    lines = re.sub(r"\n\s+", " ", block).split("\n")
    first = next(n for n, line in enumerate(lines) if _CELLS in line)
    headings, *rows = ([typeset(cell) for cell in line.split(_CELLS)] for line in lines[first:])
    report.table(headings, rows, caption=typeset(" ".join(lines[:first])))


def _place(report: Report, findings: Findings, placed: re.Match[str]) -> None:
    """Insert a picture, a table or statements at their place in the text."""
    name, caption = placed["name"], placed["caption"]
    if placed["kind"] == "picture":
        report.picture(_PICTURES[name](findings), caption)
    elif placed["kind"] == "verdicts":
        lines = [*findings.lines, *findings.claims]
        kept = [line for line in lines if line.statement.quantity.startswith(tuple(name.split()))]
        report.table(*_typeset_table(summary(kept)))
    else:
        report.table(*_typeset_table(TABLES[name](findings)), caption=caption)


_PICTURES: dict[str, Callable[[Findings], Figure]] = {
    "verdicts": lambda findings: draw_verdicts([*findings.lines, *findings.claims]),
    "magnets": lambda findings: figure.draw_magnets(findings.runs_by_set["corrected"]),
    "drop": lambda findings: figure.draw_drop(findings.runs_by_set),
    "hammer": lambda findings: figure.draw_hammer(findings.runs_by_set),
    "waterfall": lambda findings: figure.draw_waterfall(findings.runs_by_set),
    "reactions": lambda findings: figure.draw_reactions(findings.runs_by_set),
    "east": lambda findings: figure.draw_east(findings.runs_by_set),
    "speeds": lambda findings: figure.draw_speeds(findings.runs_by_set),
    "tornado": lambda findings: draw_tornado(findings.results, findings.spread),
    "mobility": lambda findings: draw_mobility(findings.results),
    "spread": lambda findings: draw_spread(findings.parts, findings.spread),
    "conditions": lambda findings: draw_conditions(
        findings.slowest, findings.least, findings.starts, findings.constants
    ),
    "law": lambda findings: draw_law(findings.sweep),
}


def draw_pictures(findings: Findings, folder: Path) -> list[Path]:
    """Write the most important pictures as PNG files to a folder.

    Raises:
        OSError: If a file cannot be written.
    """
    drawn = {name: _PICTURES[name](findings) for name in ("verdicts", "tornado", "conditions", "drop")}
    return [path for name, each in drawn.items() for path in save(each, folder / f"paper-{name}.png")]


def _numbers(findings: Findings) -> dict[str, Any]:
    """Return the values for the template."""
    results, reproductions = findings.results, findings.runs_by_set
    return {
        "judged_by": JUDGED_BY,
        "min_runs": MIN_RUNS,
        "runs_by_set": reproductions,
        "median": lambda group, quantity: median(results[group], quantity),
        "measured_n": MEASURED_N,
        "resolution_hz": 2.0 / (0.5 * reproductions["corrected"].whirl.times_s[-1]),
        "unbalance_n": findings.constants.shaft.unbalance * (2.0 * math.pi * 6.2) ** 2,
        "drop": open_questions.drop_numbers(reproductions),
        **open_questions.house_numbers(results),
        "magnet": open_questions.magnet_numbers(),
        "running": open_questions.running_numbers(),
        "clearance": open_questions.clearance_numbers(reproductions),
        "tornado": {"idle_n": IDLE_N, "idle": idle_changes(findings)},
        "moves": _moves(findings),
        "mobility": {f"× {each:g}": f"mobility {each:g}" for each in SCALES} | {"rigid": "alternative rigid housing"},
        "low_passes": dict(zip(BANDWIDTHS_HZ, results["bandwidth"], strict=True)),
        "laws": LAWS,
        "ring": _ring_forces(findings),
        "spread": _spread(findings),
        **_whirl(findings),
        "assumed": [
            (entry, format_value(entry), entry.unit or load_parameters("corrected").entries[entry.key].unit)
            for entry in assumed_values()
        ],
    }


def _moves(findings: Findings) -> dict[str, Any]:
    """Return the changes that move the force toward the measured one."""
    results = findings.results

    def get(group: str, quantity: str = "reaction_x_n") -> float:
        return median(results[group], quantity)

    reached = select_lower_ends(bars(results, "reaction_x_n"))
    whirling = [result for result in findings.spread if result.whirls]
    share = float(np.mean([result.reaction_x_n <= MEASURED_N for result in whirling])) if whirling else math.nan
    ranks = np.nan_to_num(rank_correlation(findings.parts, column(findings.spread, "reaction_x_n")))
    first = int(np.argmax(np.abs(ranks)))
    low_passes = zip(BANDWIDTHS_HZ, results["bandwidth"], strict=True)
    return {
        "printed": get("base as-printed"),
        "base": get("base corrected"),
        "base_peak": get("base corrected", "peak_x_n"),
        "stiffer": get("mobility 10"),
        "stiffer_peak": get("mobility 10", "peak_x_n"),
        "reached": {
            kind: ", ".join(bar.name for bar in reached if bar.kind == kind) or "none"
            for kind in ("correction", "assumed value", "housing", "other reading")
        },
        "corners_hz": [hz for hz, result in low_passes if result.reaction_x_n <= MEASURED_N],
        "whirling": len(whirling),
        "share": share,
        "bounds": wilson_bounds(share, max(1, len(whirling))),
        "first": {"called": free_values()[first].called, "rank": ranks[first]},
    }


def _ring_forces(findings: Findings) -> dict[str, Any]:
    """Return the force on a rigid ring in whirl by closed form [N], by drive speed [Hz], at the simulated spin."""
    constants = findings.constants
    own, closed = condition.oscillator(constants), {}
    for speed, run in findings.runs_by_set["corrected"].speeds.items():
        spin = float(np.mean(run["spin_rate"][run.times_s > run.times_s[-1] - 0.3]))
        closed[speed] = condition.normal_force(own, *condition.rolling_circle(constants, spin))
    rigid = median(findings.results["alternative rigid housing"], "normal_n")
    return {"speeds": closed, "closed_n": closed[6.2], "rigid_n": rigid}


def _spread(findings: Findings) -> dict[str, Any]:
    """Return the distributions with all assumed values varied together."""
    shown = {
        "E − W in whirl [N]": "reaction_x_n",
        "N − S in whirl [N]": "reaction_y_n",
        "mean normal force in whirl [N]": "normal_n",
        "highest normal force [N]": "peak_normal_n",
        "highest E − W [N]": "peak_x_n",
        "whirl frequency [Hz]": "whirl_hz",
        "spin in whirl [Hz]": "spin_hz",
    }
    spread = findings.spread
    kinds = [result.outcome for result in spread]
    return {
        "runs": len(kinds),
        "outcomes": ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds)),
        "chance": 2 / math.sqrt(max(1, len(kinds))),
        "quantities": {label: percentiles(column(spread, name)) for label, name in shown.items()},
    }


def _whirl(findings: Findings) -> dict[str, Any]:
    """Return the conditions of whirl and its frequency."""
    constants, fastest = findings.constants, findings.least[-1]
    own = condition.oscillator(constants)
    modal = constants.shaft.transverse_inertia / constants.shaft.arm_magnet**2
    magnet, friction = constants.magnet, constants.contact.friction
    # Eq. 43 taken literally.
    literal = condition.Oscillator(constants.shaft.mass, math.sqrt(magnet.stiffness / constants.shaft.mass), math.nan)
    eq_10 = magnet.damping_x, magnet.damping_y
    spin = 2.0 * math.pi * fastest.spin_hz
    force = condition.normal_force(own, *condition.rolling_circle(constants, spin))
    turned = condition.pulse_whirl(constants, force_n=100.0, duration_s=5e-3)
    share = 0.5 * (turned / own.natural - own.natural / turned)
    sweep = []
    for speed, result in findings.sweep.items():
        law, rigid = condition.law_hz(speed)
        error = condition.law_error(result, speed)
        sweep.append({"speed_hz": speed, "law_hz": law, "rigid_hz": rigid, "error": error, **vars(result)})
    return {
        "own": {
            "modal": modal,
            "decays": math.sqrt(constants.shaft.mass / modal),
            "mass": own.mass,
            "natural_hz": own.natural / (2 * math.pi),
            "ratio": own.ratio,
            "literal_hz": [
                condition.critical_whirl(literal._replace(ratio=d), friction) / (2 * math.pi) for d in eq_10
            ],
        },
        "slowest": findings.slowest,
        "least": findings.least,
        "fastest": {
            "spin_hz": fastest.spin_hz,
            "swing_n": condition.friction_swing(constants, spin),
            "asked_n": fastest.with_houses * force,
        },
        "starts": findings.starts,
        "slips": findings.slips,
        "kept": {"share": condition.remaining_spin(constants), "spin_hz": 6.2 * condition.remaining_spin(constants)},
        "lowest_hz": percentiles(column(findings.spread, "slowest_hz")),
        "turned": {"whirl_hz": turned / (2 * math.pi), "friction": own.ratio / share},
        "sweep": sweep,
    }
