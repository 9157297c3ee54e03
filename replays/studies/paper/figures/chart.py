"""Pictures of the whirl conditions and of the whirl frequency."""

from __future__ import annotations

import math
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from replays.report.canvas import BLACK, BLUE, GREEN, ORANGE, RED, add_legend, house_style, new_figure
from replays.studies.paper.scans.condition import (
    Start,
    Threshold,
    critical_whirl,
    law_error,
    law_hz,
    oscillator,
    rolling_whirl,
)
from replays.studies.paper.scans.pulse import PulseRun
from replays.studies.paper.scans.spread import percentiles
from replays.studies.stability.trials.boundary import NAMES, STYLES
from rig.physics.kernels.constants import Constants

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from replays.studies.paper.findings import Line

_EDGE_DISTANCE = 0.6
"""Largest distance from the allowed range that is drawn to scale, relative to the range."""
_VERDICTS = {"agrees": GREEN, "differs": RED, "cannot be judged": ORANGE}


@house_style()
def draw_conditions(
    slowest: list[Threshold], least: list[Threshold], starts: list[Start], constants: Constants
) -> Figure:
    """Draw thresholds in the plane of friction and whirl frequency, and outcomes of a pulse over friction."""
    figure = new_figure(5.8, "Bartha's second condition (eq. 43)")
    plane, scan = figure.subplots(1, 2)
    own = oscillator(constants)
    mu = np.geomspace(3e-3, 0.6, 200)
    plane.loglog(mu, [critical_whirl(own, float(m)) / (2 * math.pi) for m in mu], color=BLACK, lw=1.8,
                 label="closed form")  # fmt: skip
    plane.plot([t.friction for t in slowest], [t.bare for t in slowest], "o", color=RED, ms=7, mfc="none", mew=1.8,
               label="gains speed above this (bare rig)")  # fmt: skip
    spins = [abs(rolling_whirl(constants, 2 * math.pi * t.spin_hz)[0]) / (2 * math.pi) for t in least]
    plane.plot([t.bare for t in least], spins, "D", color=BLUE, ms=7, mfc="none", mew=1.8,
               label="continues to whirl above this (bare rig)")  # fmt: skip
    plane.plot([t.full for t in least], spins, "D", color=BLUE, ms=6, label="the same, full rig")
    plane.axhline(own.natural / (2 * math.pi), color="0.5", ls=":", lw=1.2, label="ωₙ on the magnets (eq. 42)")
    plane.plot(constants.contact.friction, 83.7, "*", color=ORANGE, ms=13, label="the paper: µ = 0.25, 83.7 Hz")
    plane.set(xlabel="friction µ [1]", ylabel="|whirl frequency| [Hz]", ylim=(6, 300), title="Friction and whirl")
    plane.legend(loc="upper center", bbox_to_anchor=(0.45, -0.13))
    shown = set()
    for row, start in enumerate(starts):
        for kind, (colour, mark) in enumerate(STYLES):
            there = start.frictions[start.classes == kind]
            label = NAMES[kind] if len(there) and kind not in shown else None
            if len(there):
                shown.add(kind)
            scan.plot(there, [row] * len(there), mark, color=colour, ms=5.5, mec="0.35", mew=0.7, label=label)
    scan.axvline(constants.contact.friction, color="0.5", ls=":", lw=1.2, label="the paper's µ")
    scan.set_yticks(range(len(starts)), [f"{start.force_n:g} N" for start in starts])
    scan.set(xlabel="friction µ [1]", ylabel="pulse of 5 ms at 6.2 Hz", ylim=(-0.6, len(starts) - 0.4),
             title="Motion after a pulse")  # fmt: skip
    scan.legend(loc="upper center", bbox_to_anchor=(0.45, -0.13), ncols=2)
    return figure


@house_style()
def draw_verdicts(lines: list[Line]) -> Figure:
    """Draw the share and the position of our values in the stated range, for every statement with a range."""
    judged = [line for line in lines if math.isfinite(line.statement.low)]
    labels = [_label(line) for line in judged]
    figure = new_figure(0.38 * len(judged) + 1.9, "Statements of the paper, and the spread of our results")
    inside, where = figure.subplots(1, 2, sharey=True, width_ratios=(0.7, 1.0))
    where.axvspan(0.0, 1.0, color="0.92", lw=0)
    looks = {"as-printed": (0.2, "s", "white"), "corrected": (-0.2, "o", None)}
    for row, line in enumerate(judged):
        statement = line.statement
        for name, values in line.values.items():
            up, marker, fill = looks[name]
            colour = _VERDICTS[line.verdicts[name]]
            bounds = 100.0 * np.array(statement.bounds(values))
            inside.plot(bounds, (row - up, row - up), color=colour, lw=2.2, alpha=0.55)
            mark = "x" if statement.is_short(values) else marker
            inside.plot(100.0 * statement.inside(values), row - up, mark, color=colour, mfc=fill or colour, ms=6.5,
                        mew=1.5, clip_on=False)  # fmt: skip
            if 0.0 < statement.low < statement.high < 20.0 * statement.low:
                places = (np.array(percentiles(values)) - statement.low) / (statement.high - statement.low)
                # Values farther away are drawn at the edge.
                low, middle, high = np.clip(places, -_EDGE_DISTANCE, 1.0 + _EDGE_DISTANCE)
                ends = "<" if places[1] < -_EDGE_DISTANCE else ">" if places[1] > 1.0 + _EDGE_DISTANCE else marker
                where.plot((low, high), (row - up, row - up), color=colour, lw=2.2, alpha=0.55)
                where.plot(middle, row - up, ends, color=colour, mfc=fill or colour, ms=6.5, mew=1.5)
    for name, (_, marker, fill) in looks.items():
        where.plot([], [], marker, color=BLACK, mfc=fill or BLACK, ms=7, mew=1.6, ls="none", label=name)
    for verdict, colour in _VERDICTS.items():
        where.plot([], [], color=colour, lw=5, label=verdict)
    inside.set_yticks(range(len(judged)), labels, linespacing=0.9)
    inside.set(xlim=(-3, 103), ylim=(len(judged) - 0.4, -0.6), xlabel="within the stated range [%]")
    where.set(
        xlim=(-1.1 * _EDGE_DISTANCE, 1.0 + 1.1 * _EDGE_DISTANCE),
        xlabel="our range between the paper's\nsmallest (0) and largest (1) value [1]",
    )
    add_legend(figure, columns=5)
    return figure


def _label(line: Line) -> str:
    """Return the place and the text of a statement, in lines of at most 62 characters."""
    place = line.statement.place.replace("sections ", "§").replace("section ", "§").removesuffix(", measured")
    unbroken = line.statement.says.replace("_", "").replace(" = ", "\u00a0=\u00a0").replace(" − ", "\u00a0−\u00a0")
    return fill(f"{place}: {unbroken}", 62)


@house_style()
def draw_law(sweep: dict[float, PulseRun]) -> Figure:
    """Draw the whirl frequency over spin, simulated and by closed form, and its error."""
    figure = new_figure(5.0, "Whirl frequency over spin")
    whirl, error = figure.subplots(1, 2)
    speeds = np.array(list(sweep))
    fine = np.linspace(min(speeds), max(speeds), 60)
    whirl.plot(fine, [law_hz(float(s))[1] for s in fine], color="0.6", lw=1.2, ls="--", label="rigid, −Ω Rₛ/r₀")
    whirl.plot(fine, [law_hz(float(s))[0] for s in fine], color=BLACK, lw=1.6, label="−Ω Rₛ/(r₀ + δ)")
    whirl.plot(speeds, [r.whirl_hz for r in sweep.values()], "o", color=RED, mfc="none", mew=1.8, label="simulated")
    whirl.plot(6.2, -83.7, "*", color=ORANGE, ms=13, label="the paper, Fig. 14")
    whirl.set(xlabel="spin [Hz]", ylabel="whirl frequency [Hz]")
    errors = [100 * law_error(result, speed) for speed, result in sweep.items()]
    rigid = [100 * (result.whirl_hz / law_hz(speed)[1] - 1) for speed, result in sweep.items()]
    error.plot(speeds, errors, "o-", color=RED, label="relative to −Ω Rₛ/(r₀ + δ)")
    error.plot(speeds, rigid, "s--", color="0.6", label="relative to the rigid ring")
    error.set(xlabel="spin [Hz]", ylabel="error [%]")
    for axes in (whirl, error):
        axes.legend(loc="upper center", bbox_to_anchor=(0.45, -0.15))
    return figure
