"""Pictures of stability: step and stiffness, ladders of v_s and v0, boundary of whirl."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from replays.report.canvas import BLACK, RED, add_legend, house_style, new_figure, save
from replays.studies.common.engines import is_adaptive, supported_friction, traits
from replays.studies.stability.maps import atlas
from replays.studies.stability.trials import boundary
from replays.studies.stability.trials.hammer import LEAST_SMOOTHING, least_smoothing_speed, smoothing_distance
from replays.studies.stability.trials.impacts import first_impact, push_error
from rig.physics.engines import ENGINES

_LEAST, _GROWS = 1e-14, 10.0
"""Smallest change of energy drawn [1], and position of unlimited growth [1]."""


def draw_all(folder: Path, engines: list[str], *, quick: bool) -> list[Path]:
    """Draw all pictures to a folder, as PNG and SVG.

    Args:
        folder: Output folder, created if missing.
        engines: Engines to draw.
        quick: Draw coarse maps and short ladders.

    Returns:
        The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    for name, draw in (("map", draw_map), ("ladders", draw_ladders), ("whirl", draw_whirl)):
        files += save(
            draw(engines, quick=quick), *(folder / f"stability-{name}{suffix}" for suffix in (".png", ".svg"))
        )
    return files


@house_style()
def draw_map(engines: list[str], *, quick: bool) -> Any:
    """Draw the energy of an undamped oscillator after 60 periods over step times frequency, with a line per engine."""
    figure = new_figure(5.4, "What becomes of an undamped oscillator's energy in 60 periods")
    panels = figure.subplots(1, 2, sharey=True)
    titles = {"house": "Inner house on its beam", "contact": "Shaft on a linear contact"}
    for ax, (oscillator, title) in zip(panels, titles.items(), strict=True):
        ax.axhspan(0.6 * _GROWS, 8.0 * _GROWS, color=RED, alpha=0.12, lw=0)
        for engine in engines:
            _draw_oscillator(ax, atlas.chart(engine, oscillator, points=16 if quick else 40))
        ax.text(0.02, 0.985, "grows without end", transform=ax.transAxes, va="top", color="#A04000", fontsize=9.5)
        ax.set(title=title, xlabel="step times angular frequency, h ω [1]", xscale="log", yscale="log")
    panels[0].set(ylabel="change of the energy, |E/E₀ − 1| [1]", ylim=(_LEAST, 8.0 * _GROWS))
    panels[0].plot([], [], color="0.4", ls=":", lw=1.5, label="limit by theory")
    panels[0].fill_between([], [], [], color="0.4", alpha=0.2, lw=0, label="5 to 95 % of all stiffnesses")
    add_legend(figure, panels[0], columns=5)
    return figure


def _draw_oscillator(ax: Any, chart: atlas.Map) -> None:
    """Draw one engine on one oscillator: median over all stiffnesses and spread; growth is drawn at the top."""
    run = np.isfinite(chart.ratio) | (chart.ratio == np.inf)
    product = (chart.steps_us * 1e-6 * np.sqrt(chart.stiffness / chart.mass)[:, None])[run]
    change = np.where(chart.ratio <= atlas.GROWN, np.maximum(np.abs(chart.ratio - 1.0), _LEAST), np.inf)[run]
    edges = np.geomspace(product.min(), 1.001 * product.max(), 25)
    place = np.digitize(product, edges)
    kept = [n for n in range(1, len(edges)) if np.any(place == n)]
    x = np.array([np.exp(np.log(product[place == n]).mean()) for n in kept])
    low, middle, high = np.transpose(
        [np.quantile(change[place == n], (0.05, 0.5, 0.95), method="nearest") for n in kept]
    )
    own = traits(chart.engine)
    lasts = np.isfinite(middle)
    ax.fill_between(x[lasts], low[lasts], np.minimum(high[lasts], _GROWS), color=own.colour, alpha=0.15, lw=0)
    drawn = np.where(lasts, middle, _GROWS)
    # Points beyond the first growing one add no information.
    drawn = drawn[: int(np.argmin(lasts)) + 1] if not lasts.all() else drawn
    ax.plot(x[: len(drawn)], drawn, color=own.colour, marker=own.marker, ms=5, lw=1.6, label=chart.engine)
    if np.isfinite(chart.limit):
        ax.axvline(chart.limit, color=own.colour, ls=":", lw=1.5, zorder=1)


@house_style()
def draw_ladders(engines: list[str], *, quick: bool) -> Any:
    """Draw smoothing speed against the exact limit, approach speed, and outdated v0 in a lasting contact."""
    figure = new_figure(5.6, "Small speeds: every engine at its own step and tolerance")
    smooth, graze, stale = figure.subplots(1, 3)
    speeds = np.geomspace(1e-2, 1e-5, 7).tolist() if quick else np.geomspace(1e-2, 1e-9, 15).tolist()
    for engine in engines:
        own = traits(engine)
        style = {"color": own.colour, "marker": own.marker, "lw": 1.5, "ms": 5, "label": engine}
        if "smoothed" in ENGINES[engine].frictions:
            # With error control, a v_s far below its need takes minutes and shows nothing new.
            reach = [v for v in speeds if not is_adaptive(engine) or v > LEAST_SMOOTHING]
            smooth.loglog(reach, [smoothing_distance(engine, v) for v in reach], **style)
        places = np.geomspace(1e-5, 1.0, 11 if quick else 21)
        graze.loglog(places, [max(1e-12, first_impact(engine, float(v))["restitution"]) for v in places], **style)
        stale.loglog(places, [max(1e-12, push_error(engine, speed_floor=float(v))) for v in places], **style)
    slope = smoothing_distance("tsit5", 1e-3) / 1e-3
    smooth.loglog(speeds, [slope * v for v in speeds], color="0.6", lw=5, alpha=0.5, zorder=0, label="linear in vₛ")
    lowest = 1e-5 if quick else 1e-6
    if "rk4" in engines:
        smooth.axvline(least_smoothing_speed("rk4"), color=traits("rk4").colour, ls=":", lw=1.2)
        smooth.annotate(
            "rk4's 5 µs are too\nlong below this:\nh µ F/(vₛ m) > 2.785",
            (least_smoothing_speed("rk4"), 0.15), xytext=(-5, 0), textcoords="offset points", ha="right", va="top",
            fontsize=9, color=traits("rk4").colour,
        )  # fmt: skip
    smooth.set(
        title="Smoothed friction, first\nimpacts of scene hammer",
        xlabel="smoothing speed vₛ [m/s]", ylabel="scaled RMS off exact Coulomb [1]", ylim=(lowest, 0.2),
    )  # fmt: skip
    graze.axvline(1e-3, color="0.5", lw=1.0, ls=":")
    graze.annotate("limit of v₀", (1e-3, 0.02), xytext=(4, 2), textcoords="offset points", color="0.35", fontsize=9)
    graze.set(
        title="One impact, grazing to\nhard, against quadrature", xlabel="approach speed v₀ [m/s]",
        ylabel="relative error of the restitution [1]", ylim=(1e-12, 1e-1),
    )  # fmt: skip
    stale.axhspan(2e-2, 1e3, color=RED, alpha=0.08)
    stale.annotate("beyond the limit of trial T14", (1.0, 3e2), ha="right", va="top", color="#A04000", fontsize=9)
    stale.set(
        title="Lasting contact, stale v₀:\npushed in with up to 1.6 kN",
        xlabel="v₀ held, its lower limit [m/s]", ylabel="error of the depth over the deepest [1]", ylim=(1e-12, 1e3),
    )  # fmt: skip
    add_legend(figure, stale, smooth, columns=5)
    return figure


@house_style()
def draw_whirl(engines: list[str], *, quick: bool) -> Any:
    """Draw the class of the run over friction and impulse, and the points at which an engine gives another class."""
    from matplotlib.colors import BoundaryNorm, ListedColormap

    able = [engine for engine in engines if supported_friction(engine) == "exact"]
    points = 12 if quick else 28
    right = boundary.chart("taylor", points=points, tolerance=1e-12)
    figure = new_figure(5.2, "A pulse of 5 ms at 6.2 Hz: what has become of it after 0.6 s")
    plane, counts = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    colours = ListedColormap([colour for colour, _ in boundary.STYLES])
    impulses = right.forces * 5e-3 * 2.0 / np.pi  # half sine of 5 ms
    plane.pcolormesh(right.frictions, impulses, right.classes, cmap=colours, norm=BoundaryNorm(np.arange(5) - 0.5, 4),
                     shading="nearest", alpha=0.55, rasterized=True)  # fmt: skip
    for number in np.unique(right.classes):
        plane.plot([], [], "s", ms=9, color=colours(int(number)), alpha=0.55, mec="0.5", label=boundary.NAMES[number])
    clear = boundary.find_clear_points(right.classes)
    width, bars = 0.38, []
    for row, engine in enumerate(able):
        wrong = boundary.chart(engine, points=points).classes != right.classes
        own, (rows, columns) = traits(engine), np.nonzero(wrong)
        if len(rows):
            plane.plot(right.frictions[columns], impulses[rows], own.marker, color=own.colour, mec=BLACK, ms=9,
                       label=f"{engine} tells another")  # fmt: skip
        wrong_counts = int(wrong.sum()), int(np.sum(wrong & clear))
        for offset, number, fill in ((-width / 2, wrong_counts[0], own.colour), (width / 2, wrong_counts[1], "white")):
            counts.barh(row + offset, number, height=width, color=fill, ec=own.colour, lw=1.2)
            counts.text(number, row + offset, f" {number}", va="center", fontsize=9.5)
        bars.append(wrong_counts[0])
    plane.set(title=f"By taylor at a tolerance of 1e-12, {points} x {points} runs", xlabel="friction coefficient µ [1]",
              ylabel="impulse of the pulse [N s]")  # fmt: skip
    counts.set(title="Runs that end in another class", xlabel=f"runs of {right.classes.size} [1]",
               xlim=(0, 1.15 * max([*bars, 4])), ylim=(len(able) - 0.4, -0.6))  # fmt: skip
    counts.set_yticks(range(len(able)), able)
    counts.fill_between([], [], [], color="0.5", label="all of them")
    counts.fill_between([], [], [], fc="white", ec="0.5", label="of these off the boundary")
    add_legend(figure, columns=6)
    return figure
