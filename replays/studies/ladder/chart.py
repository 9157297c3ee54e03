"""Picture of a search: error and cost of each level, and the engines and steps that run the pick."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import Any

from replays.report.canvas import BLACK, house_style, new_figure, save
from replays.studies.common.engines import traits
from replays.studies.ladder.document import python_line
from replays.studies.ladder.quantity import QUANTITIES
from replays.studies.ladder.search import Ladder, Rung

_MAX_QUANTITIES = 3
"""Number of quantities drawn; the document contains all."""
_GOOD, _BAD, _OWN = "0.2", "#b00020", "#8a6fae"
"""Colours for errors within and beyond the tolerance and for the reference's own error; no engine uses them."""


@house_style()
def draw(ladder: Ladder, folder: Path) -> list[Path]:
    """Draw a search to ladder.png and ladder.svg in a folder, which is created if missing."""
    names = list(ladder.tolerances)[:_MAX_QUANTITIES]
    columns = len(names) + 1
    figure = new_figure(
        10.4 + 0.8 * len(names),  # leaves room for the evidence above the legend
        f"No more model than scene {ladder.scene.name} needs\n({ladder.scene.duration_s:g} s; parameters: "
        f"{ladder.scene.parameters}, not validated on a rig)",
    )
    axes = figure.subplots(2, columns, squeeze=False, height_ratios=(1.0, 1.0 + 0.23 * len(names)))
    levels = [step for step in ladder.steps if step.stage in ("full", "single", "together")]
    for column, name in enumerate(names):
        _draw_levels(axes[0, column], ladder, levels, name, named=column == 0)
        _draw_cost(axes[1, column], ladder, name, first=column == 0)
    _draw_work(axes[0, -1], levels)
    _write_evidence(axes[1, -1], ladder)
    axes[1, -1].legend(*axes[1, 0].get_legend_handles_labels(), loc="lower left", borderaxespad=0.0)
    figure.supxlabel(_caption(ladder), x=0.01, ha="left", fontsize=9, color="0.35")
    folder.mkdir(parents=True, exist_ok=True)
    return save(figure, folder / "ladder.png", folder / "ladder.svg")


def _range(ladder: Ladder, name: str) -> tuple[float, float]:
    """Return the range of errors drawn; smaller ones are drawn at the left edge, infinite ones at the right."""
    own, tolerance = ladder.reference_errors[name], ladder.tolerances[name]
    visible = [
        value
        for step in ladder.steps
        for errors in (step.errors.model, step.errors.numerical, step.errors.total)
        for key, value in errors.items()
        if key == name and math.isfinite(value) and value > 0.0
    ]
    low = max(min([own, *visible, tolerance]), 1e-10)
    return 10.0 ** math.floor(math.log10(low)) / 2.0, 10.0 ** math.ceil(math.log10(max([1.0, *visible]))) * 30.0


def _style_axes(axes: Any, ladder: Ladder, name: str) -> tuple[float, float]:
    low, high = _range(ladder, name)
    tolerance = ladder.tolerances[name]
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.axvspan(low, tolerance, color="0.95", zorder=0)
    axes.axvline(tolerance, color="0.3", lw=1.2, ls="--", zorder=1)
    axes.axvline(high / 8.0, color="0.7", lw=0.8)
    own = ladder.reference_errors[name]
    if own > low:
        axes.axvline(own, color=_OWN, lw=2.0, zorder=1)
    axes.set_xlabel("error, part of its value [1]")
    return low, high


def _clip_value(value: float, low: float, high: float) -> float:
    return min(max(value, low * 1.3), high / 8.5) if math.isfinite(value) else high / 2.8


def _draw_levels(axes: Any, ladder: Ladder, levels: list[Rung], name: str, *, named: bool) -> None:
    low, high = _style_axes(axes, ladder, name)
    reference = ladder.reference.values[name]
    unit = f" {QUANTITIES[name].unit}" if QUANTITIES[name].unit else ""
    shown = reference if isinstance(reference, str) else f"{reference:.6g}{unit}"
    for row, step in enumerate(levels):
        error = step.errors.model.get(name, 0.0)
        if step.stage == "full":
            axes.annotate(f"reference {shown}", (low, row), xytext=(6, 0), textcoords="offset points", va="center")
            continue
        good = error <= ladder.tolerances[name] - ladder.reference_errors[name]
        place = _clip_value(error, low, high)
        axes.plot([low, place], [row, row], color="0.75", lw=1.2, zorder=2)
        marker, colour = ("o", _GOOD) if good else ("X", _BAD)
        axes.plot(place, row, marker=marker, ms=8, color=colour, mec="white", ls="none", zorder=3)
        text = "0" if error == 0.0 else f"{error:.1e}".replace("e-0", "e-").replace("e+00", "")
        text = text if math.isfinite(error) else "cannot give it"
        on_left = place > math.sqrt(low * high)
        axes.annotate(
            text, (place, row), xytext=(-8 if on_left else 8, 0), textcoords="offset points", va="center",
            ha="right" if on_left else "left", fontsize=9, bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 0.6},
        )  # fmt: skip
    axes.set_ylim(len(levels) - 0.4, -0.6)
    labels = [_row_label(step) for step in levels] if named else [""] * len(levels)
    axes.set_yticks(range(len(levels)), labels)
    axes.set_title(f"{name.replace('_', ' ').capitalize()}:\nmodel error of each level")


def _row_label(step: Rung) -> str:
    if step.stage == "together":
        return "all that pass, together"
    return f"{step.label} *" if step.note else step.label


def _draw_work(axes: Any, levels: list[Rung]) -> None:
    for row, step in enumerate(levels):
        cost = step.cost
        if cost is None:
            continue
        spent = cost.cpu_s * 1e3
        axes.barh(row, spent, height=0.6, color=traits(cost.candidate.engine).colour, zorder=2)
        axes.plot([cost.spread_s[0] * 1e3, cost.spread_s[1] * 1e3], [row, row], color="0.2", lw=1.4, zorder=3)
        text = f"{float(f'{spent:.3g}'):g}  ({cost.candidate.label})"
        axes.annotate(
            text, (max(spent, cost.spread_s[1] * 1e3), row), xytext=(4, 0),
            textcoords="offset points", va="center", fontsize=9,
        )  # fmt: skip
    spans = [spent * 1e3 for step in levels if step.cost for spent in step.cost.spread_s]
    axes.set_xscale("log")
    axes.set_xlim(0.5 * min(spans), (max(spans) / min(spans)) ** 1.2 * 4.0 * max(spans))
    axes.set_ylim(len(levels) - 0.4, -0.6)
    axes.set_yticks(range(len(levels)), [""] * len(levels))
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("processor time of a\nsimulated second [ms]")
    axes.set_title("What each level costs by the\nfirst engine that takes it")


def _draw_cost(axes: Any, ladder: Ladder, name: str, *, first: bool) -> None:
    low, high = _style_axes(axes, ladder, name)
    for step in ladder.steps:
        if step.stage == "single" and step.cost is not None:
            place = _clip_value(step.errors.model[name], low, high)
            axes.plot(place, step.cost.cpu_s * 1e3, marker="x", ms=6, color="0.45", ls="none", zorder=2)
    engines: dict[str, list[Rung]] = {}
    for step in ladder.steps:
        if step.stage == "engine" and not step.measured.failure:
            engines.setdefault(step.measured.candidate.engine, []).append(step)
    for engine, steps in engines.items():
        color, marker = traits(engine).colour, traits(engine).marker
        spent = [step.measured.cpu_s * 1e3 for step in steps]
        numerical = [_clip_value(step.errors.numerical[name], low, high) for step in steps]
        total = [_clip_value(step.errors.total[name], low, high) for step in steps]
        axes.plot(numerical, spent, color=color, marker=marker, mfc="white", ms=6, ls=":", lw=1.0, zorder=3)
        axes.plot(total, spent, color=color, marker=marker, ms=6, lw=1.6, zorder=3, label=engine)
    picked, errors = ladder.picked, ladder.picked_errors
    axes.plot(
        _clip_value(errors.total[name], low, high), picked.cpu_s * 1e3, marker="*", ms=18,
        color=traits(picked.candidate.engine).colour, mec=BLACK, ls="none", zorder=4,
        label=f"pick: {picked.candidate.label}",
    )  # fmt: skip
    axes.plot([], [], color="0.3", marker="o", mfc="white", ls=":", label="numerical error alone")
    axes.plot([], [], color="0.3", marker="o", label="total error")
    axes.plot([], [], color="0.45", marker="x", ls="none", label="one level lowered: model error")
    axes.plot([], [], color="0.3", ls="--", label="tolerance")
    axes.plot([], [], color=_OWN, lw=2.0, label="the reference's own error")
    axes.set_yscale("log")
    for formatted in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        formatted(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "125" else "")
    axes.set_ylabel("processor time of a simulated second [ms]" if first else "")
    axes.annotate(
        "cannot give it", (high / 2.8, 1.0), xycoords=("data", "axes fraction"), xytext=(0, -4),
        textcoords="offset points", ha="center", va="top", fontsize=9, rotation=90, color="0.4",
    )  # fmt: skip
    axes.set_title(f"{name.replace('_', ' ').capitalize()}:\nengines on the picked model")


def _write_evidence(axes: Any, ladder: Ladder) -> None:
    """Draw the pick, its values and its cost as text."""
    picked, errors = ladder.picked, ladder.picked_errors
    axes.axis("off")
    levels = ", ".join(f"{level} {choice}" for level, choice in picked.candidate.model.items())
    lines = textwrap.wrap(f"{levels}, sensors {ladder.sensors}; {picked.candidate.label}", 40)
    for name, tolerance in ladder.tolerances.items():
        value, reference = picked.values[name], ladder.reference.values[name]
        plain = isinstance(value, str) or isinstance(reference, str)
        both = f"{value}, {reference}" if plain else f"{value:.6g}, {reference:.6g} {QUANTITIES[name].unit}"
        lines += [
            "",
            f"{name.replace('_', ' ')}, and the reference's:",
            f"  {both}",
            f"  total error {errors.total[name]:.1e} of {tolerance:g} allowed",
            f"  model {errors.model[name]:.1e}, numerical {errors.numerical[name]:.1e}",
        ]
    axes.set_title("Pick, as it will run")
    axes.text(0.0, 0.98, "\n".join(lines), transform=axes.transAxes, va="top", fontsize=9.5)


def _caption(ladder: Ladder) -> str:
    """Return the caption: reference, costs and environment."""
    names = ", ".join(name.replace("_", " ") for name in ladder.tolerances)
    pick, own, full = (run.cpu_s * 1e3 for run in (ladder.picked, ladder.given, ladder.full))
    text = (
        f"Processor times are medians as it will run, sensors {ladder.sensors}, lines from least to largest: the pick "
        f"takes {pick:.3g} ms; with the scene's sensors the scene as given {own:.3g} ms, the full model {full:.3g} "
        f"ms by {ladder.full.candidate.label}. Errors of {names} against the full model by "
        f"{ladder.reference.candidate.label}, whose own error is its distance to "
        f"{ladder.unlike.candidate.label}. * with a remark in the table. Seed "
        f"{ladder.scene.seed}; {len(ladder.steps)} candidates tried in {ladder.spent_s:.0f} s"
        f"{'' if ladder.complete else ' (budget spent)'}; {python_line()}."
    )
    return "\n".join(textwrap.wrap(text, 132))
