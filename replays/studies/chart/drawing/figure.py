"""Pictures of a chart, drawn from its table only."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from replays.report.canvas import WIDTH, house_style, new_figure, save
from replays.studies.chart.drawing.panel import (
    draw_energy,
    draw_frames,
    draw_profile,
    draw_work,
    label_lines,
    mark_better,
    own_speed,
    window,
)
from replays.studies.chart.drawing.scene_panel import draw_markers, draw_scenes
from replays.studies.chart.drawing.style import ALARM, INK, QUIET, Row, draw_legend, point_style
from replays.studies.chart.methods import ADDED_FAMILY, RIG_FAMILY
from replays.studies.chart.phases import MEMORY_CASES, PHASES, RUB, SCENE_TARGETS, SMOOTHING
from replays.studies.chart.profile import TARGET


@house_style()
def draw(rows: list[Row], folder: Path, panels: list[str], *, command: str, note: str = "") -> list[Path]:
    """Draw every panel that has points, as PNG and SVG.

    Args:
        rows: The table.
        folder: Output folder.
        panels: Panels to draw.
        command: Command that makes these pictures, for the caption.
        note: Additional remark for the caption.

    Returns:
        The files.
    """
    makers: dict[str, tuple[str, Callable[[Any, list[Row]], str]]] = {
        "chart": ("exact", _hero),
        "chart-exact": ("exact", _draw_exact),
        "chart-smoothed": ("smoothed", _draw_smoothed),
        "chart-memory": ("memory", _memory),
        "chart-rub": (RUB, _rub),
        "chart-profile": ("profile", _profile_figure),
        "chart-scenes": ("scenes", _scenes),
        "chart-work": ("exact", _work),
    }
    files: list[Path] = []
    for stem, (panel, make) in makers.items():
        points = [row for row in rows if row["panel"] == panel]
        if panel not in panels or not any(row["family"] != "reference" for row in points):
            continue
        if make is _work and all(row["family"] in (ADDED_FAMILY, "reference") for row in points):
            continue
        figure = new_figure(layout=None)
        caption = make(figure, rows)
        _caption(figure, rows, caption, command, note)
        source = ", ".join(sorted({f"code {row.get('code')}" for row in points}))
        files += save(figure, folder / f"{stem}.png", folder / f"{stem}.svg", source=source)
    return files


def _caption(figure: Any, rows: list[Row], caption: str, command: str, note: str) -> None:
    last = rows[-1]
    machine = " ".join(last["machine"].split())
    unbroken = command.replace(" ", "\N{NO-BREAK SPACE}")  # a command stays on one line
    text = (
        f"{caption} Made by `{unbroken}` ({last['mode']}): one thread on {machine}; {last['versions']}; "
        f"commit {last['commit'] or 'unknown'}, {last['date']}."
    )
    text = f"{text} {note[:1].upper()}{note[1:]}." if note else text
    lines = "\n".join(textwrap.wrap(text, 152, break_on_hyphens=False)).replace("\N{NO-BREAK SPACE}", " ")
    figure.text(0.01, 0.1 / figure.get_size_inches()[1], lines, fontsize=9, color=QUIET, va="bottom", linespacing=1.3)


def _grid(figure: Any, height: float, title: str, *, down: int = 1, across: int = 2, left: float = 0.7) -> Any:
    """Return a grid of panels between title and caption, with a column for the legend; lengths in inches."""
    figure.set_size_inches(WIDTH, height)
    figure.text(0.01, 1.0 - 0.38 / height, title, fontsize=13, fontweight="bold", color=INK)
    return figure.add_gridspec(
        down, across + 1, left=left / WIDTH, right=0.995, top=1.0 - 0.95 / height, bottom=1.5 / height,
        width_ratios=(*[1.0] * across, 1.42 / across), wspace=0.21, hspace=0.36,
    )  # fmt: skip


_NOTE = (
    "Points: median of at least 3 runs (in a quick chart, long runs count alone), bars from least to "
    "greatest, compile time apart; same equations, same corners of the hammer, right-hand sides compiled unless said. "
    "scipy's steps are Python. Error: RMS over 1 ms instants of 7 scaled states."
)


def _timing(rows: list[Row], panel: str) -> str:
    """Return remarks on points timed in another way: added by file, or driven by a Python loop."""
    added = {row["title"] for row in rows if row["panel"] == panel and row["family"] == ADDED_FAMILY}
    stated = (
        " Solvers added by file: one run, time and number of contacts as their authors' files state." if added else ""
    )
    led = sorted({row["method"] for row in rows if row["panel"] == panel and row["own_cpu_s"]})
    if not led:
        return stated
    return f"{stated} Hollow or dotted: {' and '.join(led)} alone, without the time of our Python loop that drives it."


def _select(rows: list[Row], panel: str, phase: str, cases: tuple[str, ...] = ()) -> list[Row]:
    kept = [row for row in rows if row["panel"] == panel and row["phase"] == phase]
    return [row for row in kept if row["case"] in cases] if cases else kept


def _phases(rows: list[Row], panel: str) -> list[str]:
    measured = {row["phase"] for row in rows if row["panel"] == panel and row["family"] != "reference"}
    return [phase for phase in PHASES if phase in measured]


def choose_main_phase(rows: list[Row]) -> str:
    """Return the phase that `chart.png` shows."""
    phases = _phases(rows, "exact")
    return "whirl" if "whirl" in phases else phases[-1]


def _hero(figure: Any, rows: list[Row]) -> str:
    phase = choose_main_phase(rows)
    chosen = _select(rows, "exact", phase)
    profile = [row for row in rows if row["panel"] == "profile"]
    details = bool(profile) or any(row["energy_residual"] for row in chosen)
    title = "Rotor-stator contact with Coulomb friction: how fast, and how true"
    grid = _grid(figure, 11.2 if details else 8.0, title, down=1 + details, across=1)
    grid.set_width_ratios((1.0, 0.4))
    if details:
        grid.set_height_ratios((1.0, 0.47))
        grid.update(hspace=0.22)
    axes = figure.add_subplot(grid[0, 0])
    window(axes, chosen, rows, title=f"Speed against total error: {PHASES[phase].title}")
    mark_better(axes)
    label_lines(axes, chosen, rows)
    draw_legend(figure, rows, ("exact",), figure.add_subplot(grid[0, 1]), smoothed=True, drawn=chosen + profile)
    if not details:
        return _NOTE + _timing(rows, "exact")
    below = grid[1, :].subgridspec(1, 2, wspace=0.21)
    draw_energy(figure.add_subplot(below[0, 0]), chosen, rows)
    right = figure.add_subplot(below[0, 1])
    if profile:
        draw_profile(right, rows)
    else:
        draw_frames(right, chosen, rows)
    return _NOTE + _timing(rows, "exact")


def _draw_exact(figure: Any, rows: list[Row]) -> str:
    return _windows(figure, rows, "exact", "Exact Coulomb friction, phase by phase: total error", smoothed=True)


def _draw_smoothed(figure: Any, rows: list[Row]) -> str:
    title = f"The smoothed law alone, vₛ = {SMOOTHING * 1e3:g} mm/s"
    return _windows(figure, rows, "smoothed", title) + (
        " All against the smoothed reference. What smoothing itself costs is on the exact charts."
    )


def _windows(figure: Any, rows: list[Row], panel: str, title: str, *, smoothed: bool = False) -> str:
    phases = _phases(rows, panel)
    down, across = math.ceil(len(phases) / 2), min(2, len(phases))
    # Next to a single row of windows, the legend is taller.
    grid = _grid(figure, 3.1 + 3.6 * down + (3.4 if down == 1 else 0.0), title, down=down, across=across)
    if across == 1:
        grid.set_width_ratios((1.0, 0.45))
    for i, phase in enumerate(phases):
        axes = figure.add_subplot(grid[i // across, i % across])
        window(axes, _select(rows, panel, phase), rows, title=PHASES[phase].title)
        mark_better(axes)
        if i % across:
            axes.set_ylabel("")
    draw_legend(figure, rows, (panel,), figure.add_subplot(grid[:, across]), smoothed=smoothed)
    return _NOTE + _timing(rows, panel)


def _memory(figure: Any, rows: list[Row]) -> str:
    phase = _phases(rows, "memory")[0]
    grid = _grid(figure, 9.0, f"Memory of the impact speed ({PHASES[phase].title})")
    titles = ("v₀ latched at each onset\n(Lankarani-Nikravesh)", "The same without memory\n(c = 0)")
    for i, case in enumerate(MEMORY_CASES):
        axes = figure.add_subplot(grid[0, i])
        window(axes, _select(rows, "memory", phase, (case,)), rows, title=titles[i])
        mark_better(axes)
        if i:
            axes.set_ylabel("")
    draw_legend(figure, rows, ("memory",), figure.add_subplot(grid[0, 2]))
    return (
        f"{_NOTE}{_timing(rows, 'memory')} Friction is left out here, so that every method runs. 'No events': v₀ is "
        "latched at a step's end, not where the contact begins."
    )


def _profile_figure(figure: Any, rows: list[Row]) -> str:
    grid = _grid(figure, 6.8, "Random pulses, speeds, friction and restitution", across=1)
    grid.set_width_ratios((1.0, 0.4))
    chaotic = draw_profile(figure.add_subplot(grid[0, 0]), rows)
    draw_legend(figure, rows, ("profile",), figure.add_subplot(grid[0, 1]), failures=False)
    chaos = f" Draws without a sharp reference (chaotic), left out for all: {chaotic}." if chaotic else ""
    return (
        f"Each method walks down its ladder to the first setting that comes within {TARGET:g} of the scene's own "
        "reference, exact Coulomb, 0.15 s, and is timed there; curves that end below 100 % did not get "
        f"there.{chaos}{_timing(rows, 'profile')}"
    )


def _scenes(figure: Any, rows: list[Row]) -> str:
    points = [row for row in rows if row["panel"] == "scenes"]
    scenes = len({row["phase"] for row in points})
    number = "Twelve scenes" if scenes == 12 else "One scene" if scenes == 1 else f"{scenes} scenes"
    grid = _grid(figure, 11.7, f"{number}: speed of each method at a given error", down=2, across=1, left=1.6)
    grid.set_width_ratios((1.0, 0.3))
    grid.update(wspace=0.3, top=0.88, bottom=0.135, hspace=0.38)
    for i, target in enumerate(SCENE_TARGETS):
        draw_scenes(figure.add_subplot(grid[i, 0]), points, f"{target:g}")
    draw_markers(figure.add_subplot(grid[:, 1]), points)
    short = " A quick chart leaves out scipy's methods." if points[0]["mode"] == "quick" else ""
    return (
        "Each method is timed at its coarsest setting whose error against the scene's own reference is below the "
        f"target.{short}{_timing(rows, 'scenes')}"
    )


def _work(figure: Any, rows: list[Row]) -> str:
    phase = choose_main_phase(rows)
    chosen = _select(rows, "exact", phase)
    grid = _grid(figure, 7.0, f"Work and frames, exact Coulomb friction ({PHASES[phase].title})")
    grid.update(wspace=0.3)
    draw_work(figure.add_subplot(grid[0, 0]), chosen, rows)
    draw_frames(figure.add_subplot(grid[0, 1]), chosen, rows)
    draw_legend(figure, rows, ("exact",), figure.add_subplot(grid[0, 2]), failures=False, bounds=False, drawn=chosen)
    return (
        "Evaluations as each library counts them: a Taylor series' are its order times its steps. "
        "Worst frame: the longest call of 1 ms, each frame's least of several passes, "
        "so that the machine's own pauses are left out; peers are not stepped frame by frame."
    )


def _rub(figure: Any, rows: list[Row]) -> str:
    points = [row for row in rows if row["panel"] == RUB]
    order = list(dict.fromkeys(row["method"] for row in points))
    points.sort(key=lambda row: (order.index(row["method"]), -(row["tolerance"] or row["step_us"] or 0.0)))
    n = len(points)
    grid = _grid(figure, 3.0 + 0.34 * n, "Chaotic partial rub: trajectories part, statistics stay", across=3, left=2.4)
    grid.set_width_ratios((1.0, 1.0, 1.0, 1.0))
    grid.update(wspace=0.14, right=0.975)
    good = [row for row in points if row["rms_force"] is not None]
    # The others are compared with the tightest setting of another code.
    unlike = [row for row in good if row["family"] != RIG_FAMILY] or good
    tight = min(unlike, key=lambda row: row["tolerance"] or math.inf) if unlike else None
    columns = (("contact_fraction", "time in contact\n[%]", 100.0), ("rms_force", "RMS elastic force\n[N]", 1.0),
               ("impacts_per_s", "impacts a second\n[1/s]", 1.0))  # fmt: skip
    y = np.arange(n)[::-1]
    names = [f"{row['title']}, {row['rung'].replace(' us', ' µs')}" for row in points]
    for i, (name, label, scale) in enumerate(columns):
        axes = figure.add_subplot(grid[0, i])
        if tight is not None:
            axes.axvspan(tight[f"{name}_low"] * scale, tight[f"{name}_high"] * scale, color="#e4ebf2", lw=0, zorder=0)
        for place, row in zip(y, points, strict=True):
            style = point_style(row, rows)
            if row[name] is None:
                axes.text(0.5, place, f"failed: {row['failure']}", transform=axes.get_yaxis_transform(), ha="center",
                          va="center", color=ALARM, fontsize=9)  # fmt: skip
                continue
            bar = np.array([[row[name] - row[f"{name}_low"]], [row[f"{name}_high"] - row[name]]]) * scale
            axes.errorbar(row[name] * scale, place, xerr=bar.clip(0.0), fmt=style["marker"], color=style["color"],
                          ms=style["ms"], elinewidth=0.55 * style["lw"] + 0.5, mec="white", mew=0.6)  # fmt: skip
        axes.set(xlabel=label, ylim=(-0.7, n - 0.3), yticks=y)
        axes.set_yticklabels(names if i == 0 else [])
        axes.margins(x=0.15)
    axes = figure.add_subplot(grid[0, 3])
    for place, row in zip(y, points, strict=True):
        axes.barh(place, row["speed"] or 0.0, color=point_style(row, rows)["color"], height=0.55, zorder=2)
        bound = own_speed(row) or 0.0
        axes.barh(place, bound, color="none", edgecolor=point_style(row, rows)["color"], height=0.55, lw=0.8, ls=":")
        caption = f"{row['speed'] or 0.0:.3g}" + (f", bound {bound:.3g}" if bound else "")
        axes.text(max(row["speed"] or 0.0, bound) * 1.08, place, caption, va="center", fontsize=9, color=INK)
    axes.set(xscale="log", xlabel="times real time\n[s/s]", ylim=(-0.7, n - 0.3), yticks=y)
    axes.set_yticklabels([])
    axes.minorticks_off()
    axes.set_xlim(right=axes.get_xlim()[1] * 20.0)
    against = f"{tight['title']}, {tight['rung']}" if tight is not None else "none"
    return (
        f"Ring moved sideways by 0.8 mm, unbalance 0.3 mm, 12 Hz, {points[0]['simulated_s']:g} s: two runs that begin "
        f"5e-10 rad apart are wholly apart after 0.4 s. Means with 95 % bootstrap bars over blocks of 0.5 s; "
        f"the band is {against}.{_timing(rows, RUB)}"
    )
