"""Pictures of where engines hold and fail: step against stiffness, the v_s and v0 ladders, whirl or no whirl."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from replays.report.canvas import RED, draw_grid, new_figure, save
from replays.studies.engines import friction_of, is_adaptive, traits
from replays.studies.stability import atlas, boundary
from replays.studies.stability.hammer import LEAST_SMOOTHING, least_smoothing_speed, smoothing_distance
from replays.studies.stability.impacts import first_impact, pushed
from rig.engines import ENGINES


def draw_all(folder: Path, engines: list[str], *, quick: bool) -> list[Path]:
    """Draw all pictures into a folder, each as PNG and SVG.

    Args:
        folder: Made if it is not there.
        engines: Which engines.
        quick: Coarse maps and short ladders.

    Returns:
        The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    for name, draw in (("map", draw_map), ("ladders", draw_ladders), ("whirl", draw_whirl)):
        figure = draw(engines, quick=quick)
        files += save(figure, *(folder / f"stability-{name}{suffix}" for suffix in (".png", ".svg")))
    return files


def draw_map(engines: list[str], *, quick: bool) -> Any:
    """Energy of an undamped oscillator after 60 periods over step and stiffness, a row an oscillator."""
    figure = new_figure(
        (2.75 * len(engines) + 1.6, 7.4),
        "Undamped oscillators over step and stiffness (dotted: the engine's own step; line: the limit by theory; "
        "grey: not run, too slow or far beyond)",
        title_size=12,
    )
    axes = figure.subplots(2, len(engines), squeeze=False)
    points = 16 if quick else 40
    image: Any = None
    titles = {"house": "inner house on its beam", "contact": "shaft on a linear contact"}
    for row, oscillator in enumerate(titles):
        for column, engine in enumerate(engines):
            ax = axes[row][column]
            image = _draw_oscillator(ax, atlas.chart(engine, oscillator, points=points))
            if row == 0:
                ax.set_title(engine, fontsize=12)
            else:
                ax.set_xlabel("step h [µs]")
            if column == 0:
                ax.set_ylabel(f"{titles[oscillator]}\nstiffness [N/m]")
            else:
                ax.tick_params(labelleft=False)
    bar = figure.colorbar(image, ax=axes.ravel().tolist(), shrink=0.8, pad=0.01)
    bar.set_label("|E/E₀ - 1| after 60 periods [1]; orange: grows without end")
    return figure


def _draw_oscillator(ax: Any, chart: atlas.Map) -> Any:
    """One engine on one oscillator: its map with the limit by theory; returns the image for a colour bar."""
    from matplotlib.colors import ListedColormap, LogNorm

    stable = np.where(chart.ratio <= atlas.GROWN, np.abs(chart.ratio - 1.0), np.nan)
    unstable = np.where(chart.ratio > atlas.GROWN, 1.0, np.nan)
    x, y = chart.steps_us, chart.stiffness
    ax.set_facecolor("0.86")
    image = ax.pcolormesh(
        x, y, np.clip(stable, 1e-6, 1.0), norm=LogNorm(1e-6, 1.0), cmap="Blues", shading="nearest", rasterized=True
    )
    ax.pcolormesh(x, y, unstable, cmap=ListedColormap([RED]), shading="nearest", rasterized=True)
    said = f"no limit: {_why_boundless(chart.engine)}"
    if np.isfinite(chart.limit):
        ax.plot(x, chart.mass * (chart.limit / (x * 1e-6)) ** 2, color="black", lw=2.2)
        said = f"limit h ω = {chart.limit:.4g}"
    box = {"fc": "white", "ec": "0.6", "pad": 2.5}
    ax.text(0.05, 0.05, said, transform=ax.transAxes, fontsize=9, bbox=box)
    ax.axvline(ENGINES[chart.engine].step_us, color="0.25", lw=1.0, ls=":")
    ax.set(xscale="log", yscale="log", xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    return image


def draw_ladders(engines: list[str], *, quick: bool) -> Any:
    """Smoothing speed against the set-valued limit; approach speed; v0 gone stale in a lasting contact."""
    figure = new_figure(
        (16.0, 6.4), "Ladders of $v_s$ and $v_0$, every engine at its own step and tolerance", title_size=13
    )
    smooth, graze, stale = figure.subplots(1, 3)
    speeds = np.geomspace(1e-2, 1e-5, 7).tolist() if quick else np.geomspace(1e-2, 1e-9, 15).tolist()
    for engine in engines:
        own = traits(engine)
        style = {"color": own.colour, "marker": own.marker, "lw": 1.6, "ms": 6.5, "label": engine}
        if "smoothed" in ENGINES[engine].frictions:
            # Error control at a v_s far below its need costs minutes and shows nothing new.
            reach = [v for v in speeds if not is_adaptive(engine) or v > LEAST_SMOOTHING]
            smooth.loglog(reach, [smoothing_distance(engine, v) for v in reach], **style)
        places = np.geomspace(1e-5, 1.0, 11 if quick else 21)
        graze.loglog(places, [max(1e-12, first_impact(engine, float(v))["restitution"]) for v in places], **style)
        limits = np.geomspace(1e-5, 1.0, 11 if quick else 21)
        stale.loglog(limits, [max(1e-12, pushed(engine, speed_floor=float(v))) for v in limits], **style)
    slope = smoothing_distance("tsit5", 1e-3) / 1e-3
    smooth.loglog(speeds, [slope * v for v in speeds], color="0.6", lw=5, alpha=0.5, zorder=0, label="linear in $v_s$")
    lowest = 1e-5 if quick else 1e-6
    if "rk4" in engines:
        smooth.axvline(least_smoothing_speed("rk4"), color=traits("rk4").colour, ls=":", lw=1.2)
        smooth.annotate(
            "below this $v_s$ a 5 µs step of rk4\nis too long: $h µ F / (v_s m) > 2.785$",
            (least_smoothing_speed("rk4"), 2.0 * lowest), xytext=(-6, 0), textcoords="offset points", ha="right",
            fontsize=9, color=traits("rk4").colour,
        )  # fmt: skip
    smooth.set(
        title="Smoothed friction against Coulomb's law\n(first impacts of the hammer scene)",
        xlabel="smoothing speed $v_s$ [m/s]", ylabel="distance to exact Coulomb, scaled RMS [1]", ylim=(lowest, 0.2),
    )  # fmt: skip
    graze.axvline(1e-3, color="0.5", lw=1.0, ls=":")
    graze.annotate("limit of $v_0$", (1e-3, 0.02), xytext=(4, 2), textcoords="offset points", color="0.35", fontsize=9)
    graze.set(
        title="One impact, grazing to hard,\nagainst its quadrature", xlabel="approach speed $v_0$ [m/s]",
        ylabel="relative error of the restitution [1]", ylim=(1e-12, 1e-1),
    )  # fmt: skip
    stale.axhspan(2e-2, 1e3, color=RED, alpha=0.08)
    stale.annotate("beyond the limit of trial T14", (1.0, 2.6e-2), ha="right", color="#A04000", fontsize=9)
    stale.set(
        title="Lasting contact, stale $v_0$: pushed in\nfrom rest with up to 1.6 kN",
        xlabel="$v_0$ held, its lower limit [m/s]", ylabel="error of the depth over the deepest [1]", ylim=(1e-12, 1e3),
    )  # fmt: skip
    draw_grid(smooth, graze, stale)
    shown = dict(zip(*reversed(stale.get_legend_handles_labels()), strict=True))
    shown |= dict(zip(*reversed(smooth.get_legend_handles_labels()), strict=True))
    figure.legend(
        shown.values(), shown.keys(), loc="outside lower center", ncols=len(shown), fontsize=10, frameon=False
    )
    return figure


def draw_whirl(engines: list[str], *, quick: bool) -> Any:
    """Class of the run over friction and the pulse's impulse, each engine with its disagreements marked."""
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    able = [engine for engine in engines if friction_of(engine) == "exact"]
    points = 12 if quick else 28
    right = boundary.chart("taylor", points=points, tolerance=1e-12)
    figure = new_figure(
        (3.3 * max(1, len(able)) + 0.6, 4.9),
        "A 5 ms pulse at 6.2 Hz, after 0.6 s; line: boundary by taylor at 1e-12; x: another class than there",
        title_size=12,
    )
    panels = figure.subplots(1, max(1, len(able)), squeeze=False)[0]
    colours, norm = (
        ListedColormap([colour for colour, _ in boundary.STYLES]),
        BoundaryNorm([-0.5, 0.5, 1.5, 2.5, 3.5], 4),
    )
    clear = boundary.clear_of_boundary(right.classes)
    impulses = right.forces * 5e-3 * 2.0 / np.pi  # half sine of 5 ms

    def fine(axis: np.ndarray) -> np.ndarray:
        # Twenty places a cell, so that the line runs along the cells' edges.
        half = 0.5 * (axis[1] - axis[0])
        return np.linspace(axis[0] - 0.95 * half, axis[-1] + 0.95 * half, 20 * len(axis))

    shown = set(right.classes.ravel().tolist())
    for ax, engine in zip(panels, able, strict=False):
        found = boundary.chart(engine, points=points)
        ax.pcolormesh(found.frictions, impulses, found.classes, cmap=colours, norm=norm, shading="nearest")
        ax.contour(fine(right.frictions), fine(impulses), np.kron(right.classes == boundary.ROLLING, np.ones((20, 20))),
                   levels=[0.5], colors="black", linewidths=2.0)  # fmt: skip
        shown |= set(found.classes.ravel().tolist())
        wrong = found.classes != right.classes
        rows, columns = np.nonzero(wrong)
        ax.plot(found.frictions[columns], impulses[rows], "x", color=RED, ms=8, mew=2.4)
        grave = int(np.sum(wrong & clear))
        ax.set_title(f"{engine}\n{int(wrong.sum())} of {wrong.size} differ, {grave} off the boundary", fontsize=10.5)
        ax.set_xlabel("friction coefficient µ [1]")
        if ax is panels[0]:
            ax.set_ylabel("impulse of the pulse [N s]")
        else:
            ax.tick_params(labelleft=False)
    handles: list[Any] = [
        Patch(fc=boundary.STYLES[number][0], ec="0.5", label=boundary.NAMES[number]) for number in sorted(shown)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=10, frameon=False)
    return figure


def _why_boundless(engine: str) -> str:
    if is_adaptive(engine):
        return "error control"
    return "exact flow" if traits(engine).oscillator_limit is not None else "none known"
