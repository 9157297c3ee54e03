"""The ladder drawn: what each level errs by and costs, and which engine and step carry the pick, with the evidence."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import Any

from replays.report.canvas import BLUE, RED, SKY, new_figure, save
from replays.studies.engines import traits
from replays.studies.ladder.document import python_line
from replays.studies.ladder.quantity import QUANTITIES
from replays.studies.ladder.search import Ladder, Step

_MOST = 3
"""Quantities drawn; the document has them all."""


def draw(ladder: Ladder, folder: Path) -> list[Path]:
    """Draw a search into ladder.png and ladder.svg of a folder that is made where needed."""
    names = list(ladder.tolerances)[:_MOST]
    columns = len(names) + 1
    figure = new_figure(
        (4.6 * columns + 2.2, 11.0),
        f"No more model than scene {ladder.scene.name} needs ({ladder.scene.duration_s:g} s; "
        f"parameters: {ladder.scene.parameters}, not validated on a rig)",
    )
    axes = figure.subplots(2, columns, squeeze=False, gridspec_kw={"width_ratios": [*[1.0] * len(names), 0.95]})
    levels = [step for step in ladder.steps if step.stage in ("full", "single", "together")]
    for column, name in enumerate(names):
        _draw_levels(axes[0, column], ladder, levels, name, named=column == 0)
        _draw_cost(axes[1, column], ladder, name, legend=column == 0)
    _draw_work(axes[0, -1], levels)
    _write_evidence(axes[1, -1], ladder)
    folder.mkdir(parents=True, exist_ok=True)
    return save(figure, folder / "ladder.png", folder / "ladder.svg")


def _range(ladder: Ladder, name: str) -> tuple[float, float]:
    """Errors drawn: what is smaller stands at the left edge, what is infinite at the right."""
    own, tolerance = ladder.reference_errors[name], ladder.tolerances[name]
    seen = [
        value
        for step in ladder.steps
        for errors in (step.errors.model, step.errors.numerical, step.errors.total)
        for key, value in errors.items()
        if key == name and math.isfinite(value) and value > 0.0
    ]
    low = max(min([own, *seen, tolerance]), 1e-10)
    return 10.0 ** math.floor(math.log10(low)) / 2.0, 10.0 ** math.ceil(math.log10(max([1.0, *seen]))) * 30.0


def _dress(axes: Any, ladder: Ladder, name: str) -> tuple[float, float]:
    low, high = _range(ladder, name)
    quantity, tolerance = QUANTITIES[name], ladder.tolerances[name]
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.axvspan(low, tolerance, color="0.94", zorder=0)
    axes.axvline(tolerance, color="0.3", lw=1.2, ls="--", zorder=1)
    axes.axvline(high / 8.0, color="0.7", lw=0.8)
    own = ladder.reference_errors[name]
    if own > low:
        axes.axvline(own, color=SKY, lw=2.0, zorder=1)
    axes.set_xlabel(f"error of {name.replace('_', ' ')},\nas part of {quantity.scale_title} [1]")
    axes.grid(visible=True, which="major", color="0.88", lw=0.6)
    axes.set_axisbelow(True)
    return low, high


def _placed(value: float, low: float, high: float) -> float:
    return min(max(value, low * 1.3), high / 8.5) if math.isfinite(value) else high / 2.8


def _draw_levels(axes: Any, ladder: Ladder, levels: list[Step], name: str, *, named: bool) -> None:
    low, high = _dress(axes, ladder, name)
    reference = ladder.reference.values[name]
    unit = f" {QUANTITIES[name].unit}" if QUANTITIES[name].unit else ""
    shown = reference if isinstance(reference, str) else f"{reference:.6g}{unit}"
    for row, step in enumerate(levels):
        error = step.errors.model.get(name, 0.0)
        if step.stage == "full":
            axes.annotate(
                f"reference {shown}", (low, row), xytext=(6, 0), textcoords="offset points", va="center", fontsize=9
            )
            continue
        good = error <= ladder.tolerances[name] - ladder.reference_errors[name]
        place = _placed(error, low, high)
        axes.plot([low, place], [row, row], color="0.75", lw=1.2, zorder=2)
        axes.plot(
            place,
            row,
            marker="o" if good else "X",
            ms=8,
            color=BLUE if good else RED,
            mec="white",
            ls="none",
            zorder=3,
        )
        text = "0" if error == 0.0 else f"{error:.1e}".replace("e-0", "e-").replace("e+00", "")
        text = text if math.isfinite(error) else "cannot give it"
        left = place > math.sqrt(low * high)
        axes.annotate(
            text, (place, row), xytext=(-8 if left else 8, 0), textcoords="offset points", va="center",
            ha="right" if left else "left", fontsize=8.5, bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 0.6},
        )  # fmt: skip
    axes.set_ylim(len(levels) - 0.4, -0.6)
    labels = [_row_label(step) for step in levels] if named else [""] * len(levels)
    axes.set_yticks(range(len(levels)), labels, fontsize=9)
    axes.set_title(f"{name.replace('_', ' ')}: model error of each level,\nconverged engines", fontsize=11)


def _row_label(step: Step) -> str:
    if step.stage == "together":
        parts = step.label.split(", ")
        return "together: " + ",\n".join(", ".join(parts[i : i + 2]) for i in range(0, len(parts), 2))
    return f"{step.label} *" if step.note else step.label


def _draw_work(axes: Any, levels: list[Step]) -> None:
    for row, step in enumerate(levels):
        cost = step.cost
        if cost is None:
            continue
        wall = cost.wall_s * 1e3
        axes.barh(row, wall, height=0.55, color=SKY if step.stage != "together" else BLUE, zorder=2)
        axes.plot([cost.spread_s[0] * 1e3, cost.spread_s[1] * 1e3], [row, row], color="0.2", lw=1.4, zorder=3)
        axes.annotate(
            f"{wall:.3g}  ({cost.candidate.label})", (max(wall, cost.spread_s[1] * 1e3), row), xytext=(5, 0),
            textcoords="offset points", va="center", fontsize=8.5,
        )  # fmt: skip
    walls = [wall * 1e3 for step in levels if step.cost for wall in step.cost.spread_s]
    axes.set_xscale("log")
    axes.set_xlim(0.5 * min(walls), (max(walls) / min(walls)) ** 0.6 * 2.0 * max(walls))
    axes.set_ylim(len(levels) - 0.4, -0.6)
    axes.set_yticks(range(len(levels)), [""] * len(levels))
    axes.grid(visible=True, axis="x", color="0.88", lw=0.6)
    axes.set_axisbelow(True)
    axes.set_xlabel("wall time of a simulated second [ms]\n(median, line: least to largest; no sensors)")
    axes.set_title("what each level costs,\nfirst engine that takes it at its own step", fontsize=11)


def _draw_cost(axes: Any, ladder: Ladder, name: str, *, legend: bool) -> None:
    low, high = _dress(axes, ladder, name)
    for step in ladder.steps:
        if step.stage == "single" and step.cost is not None:
            place = _placed(step.errors.model[name], low, high)
            axes.plot(place, step.cost.wall_s * 1e3, marker="x", ms=6, color="0.45", ls="none", zorder=2)
    engines: dict[str, list[Step]] = {}
    for step in ladder.steps:
        if step.stage == "engine" and not step.measured.failure:
            engines.setdefault(step.measured.candidate.engine, []).append(step)
    for engine, steps in engines.items():
        color, marker = traits(engine).colour, traits(engine).marker
        walls = [step.measured.wall_s * 1e3 for step in steps]
        numerical = [_placed(step.errors.numerical[name], low, high) for step in steps]
        total = [_placed(step.errors.total[name], low, high) for step in steps]
        axes.plot(numerical, walls, color=color, marker=marker, mfc="white", ms=6, ls=":", lw=1.0, zorder=3)
        axes.plot(total, walls, color=color, marker=marker, ms=6, lw=1.4, zorder=3, label=engine)
    picked, errors = ladder.picked, ladder.picked_errors
    chosen = next(
        step for step in ladder.steps if step.stage == "engine" and step.measured.candidate == picked.candidate
    )
    axes.plot(
        _placed(errors.total[name], low, high), chosen.measured.wall_s * 1e3, marker="*", ms=20, color=RED,
        mec="black", ls="none", zorder=4, label=f"pick: {picked.candidate.label}",
    )  # fmt: skip
    axes.plot([], [], color="0.3", marker="o", mfc="white", ls=":", label="numerical error alone")
    axes.plot([], [], color="0.3", marker="o", label="total error")
    axes.plot([], [], color="0.45", marker="x", ls="none", label="one level lowered: model error")
    axes.plot([], [], color="0.3", ls="--", label="tolerance")
    axes.plot([], [], color=SKY, lw=2.0, label="the reference's own error")
    axes.set_yscale("log")
    axes.set_ylabel("wall time of a simulated second, no sensors [ms]" if legend else "")
    axes.annotate(
        "cannot give it", (high / 2.8, 1.0), xycoords=("data", "axes fraction"), xytext=(0, -4),
        textcoords="offset points", ha="center", va="top", fontsize=8, rotation=90, color="0.4",
    )  # fmt: skip
    axes.set_title(f"{name.replace('_', ' ')}: cost against error,\nengines on the picked model", fontsize=11)
    if legend:
        axes.figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=9)


def _write_evidence(axes: Any, ladder: Ladder) -> None:
    picked, given, full, errors = ladder.picked, ladder.given, ladder.full, ladder.picked_errors
    axes.axis("off")
    model = picked.candidate.model
    lines = [
        "PICK, verified as it will run",
        *(f"  {level:8s} {choice}" for level, choice in model.items()),
        f"  {'sensors':8s} {ladder.sensors}",
        f"  {'engine':8s} {picked.candidate.label}",
        "",
        "errors (model, numerical, total)",
    ]
    for name, tolerance in ladder.tolerances.items():
        value, reference = picked.values[name], ladder.reference.values[name]
        both = (
            f"{value} / {reference}"
            if isinstance(value, str) or isinstance(reference, str)
            else f"{value:.6g} / {reference:.6g} {QUANTITIES[name].unit}"
        )
        lines += [
            f"  {name}: {both}",
            f"    {errors.model[name]:.1e}, {errors.numerical[name]:.1e}, {errors.total[name]:.1e}"
            f" of {tolerance:g} allowed",
            f"    reference's own error {ladder.reference_errors[name]:.1e}",
        ]
    lines += [
        "",
        "wall time of a simulated second, with sensors",
        f"  pick                {picked.wall_s * 1e3:8.3g} ms",
        f"  scene as given      {given.wall_s * 1e3:8.3g} ms",
        f"  full, {full.candidate.label:<13s} {full.wall_s * 1e3:8.3g} ms",
        "",
        f"reference: full model, {ladder.reference.candidate.label};",
        f"its own error: distance to {ladder.unlike.candidate.label}",
        f"seed {ladder.scene.seed}; {len(ladder.steps)} candidates tried in {ladder.spent_s:.0f} s"
        + ("" if ladder.complete else " (budget spent)"),
        *textwrap.wrap(python_line(), 56),
        "* not picked: stands in for another, or spares nothing",
    ]
    axes.text(0.0, 1.0, "\n".join(lines), transform=axes.transAxes, va="top", family="monospace", fontsize=8)
