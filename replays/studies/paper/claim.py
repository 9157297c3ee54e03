"""The paper's conclusion as a claim: which changes move the force toward the measured one."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.report.canvas import BLACK, BLUE, GREEN, ORANGE, RED, SKY, add_legend, house_style, new_figure
from replays.studies.paper.scans.pulse import BANDWIDTH, MEASURED_N, Pulse, PulseRun
from replays.studies.paper.scans.spread import column, free_values, one_at_a_time, percentiles, phases, rank_correlation
from rig.physics.parameters import load_parameters

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HOUSE_KEYS = (
    "house.inner_beam_stiffness", "house.outer_beam_stiffness", "house.pair_stiffness_vertical",
    "house.pair_stiffness_horizontal", "house.inner_beam_damping", "house.outer_beam_damping",
)  # fmt: skip
CORRECTIONS = {
    "contact.damping_factor": "damping factor of eq. 44",
    "house.outer_mass": "outer mass of eqs. 24, 25",
    "house.pair_stiffness_vertical": "N/S pair of eqs. 23, 25",
    "house.pair_stiffness_horizontal": "E/W pair of eq. 24",
    "house.gap_counts_outer": "gap of eqs. 13, 14, 40",
}
"""Corrections by parameter in which `corrected` differs from `as-printed`."""
SCALES = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Factors on stiffness and damping of the housings' supports; larger ones reduce the mobility."""
BANDWIDTHS_HZ = (50.0, 100.0, 200.0, 500.0, 1000.0, 4900.0)
ENDS = ("low", "high")
LAWS = ("exact", "lankarani-nikravesh", "none", "hunt-crossley", "flores", "kelvin-voigt")

Groups = dict[str, list[Pulse]]
Results = dict[str, list[PulseRun]]


def correction_keys() -> list[str]:
    """Return the parameters in which `corrected` differs from `as-printed`."""
    printed, corrected = (load_parameters(name).entries for name in ("as-printed", "corrected"))
    return [key for key, entry in corrected.items() if entry.value != printed[key].value]


def claim_groups(*, ensemble: int) -> Groups:
    """Return every pulse for testing the claim, by group; a group of one change contains it at `ensemble` shaft phases.

    Args:
        ensemble: Number of shaft phases.
    """
    corrected = load_parameters("corrected").entries
    base = Pulse(label="corrected")
    groups: Groups = {
        "base corrected": phases(base, ensemble),
        "base as-printed": phases(Pulse(label="as-printed", parameters="as-printed"), ensemble),
    }
    for key in correction_keys():
        changed = Pulse(label=key, parameters="as-printed", changes={key: corrected[key].value})
        groups[f"correction {key}"] = phases(changed, ensemble)
    for scale in SCALES:
        changed = replace(base, label=f"housing x {scale:g}", changes=scale_supports(scale))
        groups[f"mobility {scale:g}"] = phases(changed, ensemble)
    for name, changed in alternatives().items():
        groups[f"alternative {name}"] = phases(replace(changed, label=name), ensemble)
    for law in LAWS:
        changes = {"contact.damping_factor": law}
        groups[f"law {law}"] = phases(replace(base, label=law, changes=changes), ensemble)
    groups["bandwidth"] = [replace(base, label=f"{hz:g} Hz", changes={BANDWIDTH: hz}) for hz in BANDWIDTHS_HZ]
    for entry, low, high in one_at_a_time():
        # The phase of the pulse is itself an assumed value, so it is not varied here.
        alone = entry.key == "hammer.at"
        groups[f"low {entry.key}"] = [low] if alone else phases(low, ensemble)
        groups[f"high {entry.key}"] = [high] if alone else phases(high, ensemble)
    return groups


def scale_supports(scale: float) -> dict[str, Any]:
    """Return scaled stiffness and damping of all supports of the housings."""
    corrected = load_parameters("corrected").entries
    return {key: float(corrected[key].value) * scale for key in HOUSE_KEYS}


def stiffer_houses() -> dict[str, dict[str, Any]]:
    """Return less mobile housings by name."""
    return {"× 3": scale_supports(3.0), "× 10": scale_supports(10.0), "rigid": {"model.stator": "rigid"}}


def alternatives() -> dict[str, Pulse]:
    """Return other readings of the model and of printed values."""
    return {
        "rigid housing": Pulse(changes={"model.stator": "rigid"}),
        "outer housing fixed": Pulse(changes={"model.stator": "inner-house"}),
        "housings as identified in 2019": Pulse(parameters="dtu-2019"),
        "restitution 0.5": Pulse(changes={"contact.restitution": 0.5}),
        "friction 0.15": Pulse(changes={"contact.friction": 0.15}),
        "drive held at 6.2 Hz": Pulse(changes={"drive.mode": "ideal"}),
    }


def median(results: list[PulseRun], name: str) -> float:
    """Return the median over the runs of a group that have the number; NaN if none has."""
    values = column(results, name)
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else math.nan


@dataclass(frozen=True)
class Bar:
    """A bar of the tornado chart: the force after a change, or at both ends of a range."""

    name: str
    kind: str
    values: tuple[float, ...]

    @property
    def width(self) -> float:
        """Distance between the smallest and the largest value, including the base."""
        there = [value for value in self.values if math.isfinite(value)]
        return max(there) - min(there) if there else 0.0


_MAX_BARS = 16
_ENDS = (("white", "low end, or as printed"), (BLACK, "high end, or corrected"))
"""Fill colour and meaning of the marks at the ends of a bar."""
COLOURS = {"assumed value": ORANGE, "correction": BLUE, "housing": GREEN, "other reading": SKY}


def bars(results: Results, quantity: str) -> list[Bar]:
    """Return all bars of the tornado chart for one number, widest first.

    A correction starts from `as-printed` and changes one parameter; all other bars start from `corrected`.
    """
    base, printed = (median(results[f"base {name}"], quantity) for name in ("corrected", "as-printed"))

    def get(group: str) -> float:
        return median(results[group], quantity)

    chart = [
        Bar(entry.called, "assumed value", (get(f"low {entry.key}"), base, get(f"high {entry.key}")))
        for entry in free_values()
    ]
    chart += [Bar(CORRECTIONS[key], "correction", (printed, get(f"correction {key}"))) for key in correction_keys()]
    chart.append(Bar("all corrections", "correction", (printed, base)))
    chart.append(Bar("supports, 1/10 to 10 times as stiff", "housing", (get("mobility 0.1"), base, get("mobility 10"))))
    chart += [Bar(name, "other reading", (base, get(f"alternative {name}"))) for name in alternatives()]
    chart.append(Bar("contact law", "other reading", tuple(get(f"law {law}") for law in LAWS)))
    return sorted(chart, key=lambda bar: -bar.width)


def select_lower_ends(chart: list[Bar]) -> list[Bar]:
    """Return the bars with an end below the last label of the measured axis."""
    return [bar for bar in chart if any(value <= MEASURED_N for value in bar.values)]


@house_style()
def draw_tornado(results: Results, spread: list[PulseRun]) -> Figure:
    """Draw the effect of each change on the force in whirl and on the highest reaction."""
    from matplotlib.patches import Patch

    figure = new_figure(11.6, "Effect of single changes on the force (ranges of assumed values are assumed)")
    panels = figure.subplots(2, 1)
    shown = {
        "reaction_x_n": ("E − W amplitude in whirl [N]", MEASURED_N, "last label of the measured axis"),
        "peak_x_n": (
            "highest E − W in the impacts, median over the phases [N]",
            5000.0,
            "last label of the simulated axis",
        ),
    }
    for axes, (quantity, (label, level, text)) in zip(panels, shown.items(), strict=True):
        _draw_bars(axes, bars(results, quantity)[:_MAX_BARS][::-1], level)
        values = column(spread, quantity)
        values = values[np.isfinite(values)]
        if len(values):
            low, middle, high = percentiles(values)
            varied = f"all assumed values varied,\n{len(values)} runs: {low:.0f} to {high:.0f} N"
            axes.axvspan(low, high, color="0.93", zorder=0, label=varied)
            axes.axvline(middle, color="0.6", lw=1.0, zorder=0)
        axes.axvline(median(results["base corrected"], quantity), color=BLACK, lw=1.2, label="corrected")
        axes.axvline(median(results["base as-printed"], quantity), color=BLUE, lw=1.4, ls=":", label="as-printed")
        axes.axvline(level, color=RED, lw=1.4, ls=(0, (4, 3)), label=f"{text}, {level:g} N")
        axes.set(xlabel=label)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    handles: list[Any] = [Patch(color=colour, label=kind) for kind, colour in COLOURS.items()]
    handles += [panels[0].plot([], [], "o", color=BLACK, mfc=fill, ms=6.5, label=label)[0] for fill, label in _ENDS]
    figure.legend(handles=handles, loc="outside lower center", ncols=6)
    return figure


def _draw_bars(axes: Any, widest: list[Bar], level: float) -> None:
    """Draw the bars of a tornado chart, with marks at the ends of each change."""
    ends = [level, *(value for bar in widest for value in bar.values if math.isfinite(value))]
    room = 0.05 * (max(ends) - min(ends))
    for row, bar in enumerate(widest):
        there = [value for value in bar.values if math.isfinite(value)]
        if not there:
            continue
        # A minimum width keeps bars without an effect visible.
        axes.barh(row, max(bar.width, 0.05 * room), left=min(there), height=0.62, color=COLOURS[bar.kind])
        for end, (fill, _) in zip((bar.values[0], bar.values[-1]), _ENDS, strict=True):
            if bar.kind != "other reading" and math.isfinite(end):
                axes.plot(end, row, "o", color=BLACK, mfc=fill, ms=6.5)
    axes.set_yticks(range(len(widest)), [bar.name for bar in widest])
    axes.set(xlim=(min(ends) - room, max(ends) + room), ylim=(-0.7, len(widest) - 0.3))


@house_style()
def draw_spread(parts: np.ndarray, spread: list[PulseRun]) -> Figure:
    """Draw the distributions with all assumed values varied together, and the rank correlation of each value."""
    figure = new_figure(8.4, f"All assumed values varied together: Latin hypercube, {len(spread)} runs")
    panels = figure.subplots(2, 2).ravel()
    shown = {
        "reaction_x_n": ("E − W amplitude in whirl [N]", MEASURED_N, "last label of the measured axis"),
        "peak_x_n": ("highest E − W [N]", None, ""),
        "whirl_hz": ("whirl frequency [Hz]", -83.7, "the paper, Fig. 14"),
    }
    for axes, (name, (label, paper, text)) in zip(panels[:3], shown.items(), strict=True):
        values = column(spread, name)
        values = values[np.isfinite(values)]
        if name != "peak_x_n":
            values = values[[result.whirls for result in spread if math.isfinite(getattr(result, name))]]
        axes.hist(values, bins=30, color=SKY)
        if paper is not None:
            axes.axvline(paper, color=RED, ls=(0, (4, 3)), lw=1.4)
            axes.set_title(f"dashed: {text}, {paper:g}".replace("-", "−"), color=RED, fontweight="normal")
        axes.set(xlabel=label, ylabel="runs [1]")
    entries = free_values()
    rows = np.arange(len(entries))
    ranked = (
        ("reaction_x_n", BLUE, "force in whirl"),
        ("peak_x_n", ORANGE, "highest force"),
        ("whirl_hz", GREEN, "|whirl|"),
    )
    for place, (name, colour, label) in enumerate(ranked):
        ranks = np.nan_to_num(rank_correlation(parts, np.abs(column(spread, name))))
        panels[3].barh(rows + 0.27 * (place - 1), ranks, height=0.26, color=colour, label=label)
    panels[3].set_yticks(rows, [entry.called for entry in entries])
    panels[3].invert_yaxis()
    panels[3].set(xlabel="rank correlation [1]", xlim=(-1.05, 1.05))
    add_legend(figure)
    return figure


@house_style()
def draw_mobility(results: Results) -> Figure:
    """Draw peak force, impacts, time to rolling and whirl force over the stiffness of the supports."""
    figure = new_figure(7.2, "Mobility of the housings: stiffness and damping of all supports scaled")
    panels = figure.subplots(2, 2, sharex=True)
    shown = {
        "peak_normal_n": "highest normal force [N]",
        "contacts": "impacts before whirl [1]",
        "roll_s": "time from pulse to rolling [s]",
        "reaction_x_n": "E − W amplitude in whirl [N]",
    }
    for axes, (name, label) in zip(panels.ravel(), shown.items(), strict=True):
        for scale in SCALES:
            values = column(results[f"mobility {scale:g}"], name)
            axes.semilogx([scale] * len(values), values, "o", color=SKY, ms=4.5, label="each shaft phase")
        middle = [median(results[f"mobility {scale:g}"], name) for scale in SCALES]
        axes.semilogx(SCALES, middle, color=BLUE, lw=1.8, label="median over the phases")
        axes.axhline(median(results["alternative rigid housing"], name), color="0.4", ls=":", lw=1.6, label="rigid")
        axes.set(ylabel=label)
    for axes in panels[-1]:
        axes.set_xlabel("factor on the supports [1]")
    add_legend(figure)
    return figure
