"""Picture of a map: its classes or a quantity over two axes, with border, conditions in closed form and marks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.report.canvas import BLACK, BLUE, GREEN, ORANGE, RED, SKY, add_legend, axis_label, house_style, new_figure
from replays.studies.maps.plan import Side
from replays.studies.maps.results import Map
from replays.studies.paper.scans.condition import (
    critical_whirl,
    friction_with_houses,
    least_friction,
    oscillator,
    pulse_whirl,
    rolling_whirl,
)
from rig.ensemble.batch import QUANTITIES
from rig.physics.model import build_model

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LOOKS = {
    "free": ("#F2F2F2", ""), "impacts": ("#F0E442", ".."), "backward whirl": (BLUE, ""),
    "forward whirl": (ORANGE, "//"), "resting": (GREEN, "\\\\"), "failed": ("#FFFFFF", "xx"),
}  # fmt: skip
"""Colour and hatch by class; the colours also differ in grey."""
_STEPS = (("#F2F2F2", ""), (SKY, "//"), (BLUE, ""), (ORANGE, ".."), (RED, "xx"))
"""The same by number, for classes of a quantity."""
_CONTOURS = 5


@house_style()
def draw_map(found: Map, band: tuple[np.ndarray, np.ndarray] | None = None) -> Figure:
    """Draw a map.

    Args:
        found: The map.
        band: Places along x, and quantiles of the quantity at them, shapes (n,) and (3, n), drawn in a second panel.
    """
    work, plan = found.work, found.work.plan
    count = len(work.panel_values)
    columns = min(count, 4)
    rows = -(-count // columns)
    figure = new_figure(1.6 + (3.6 if columns > 1 else 4.6) * rows, plan.title)
    if band is None:
        axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    else:
        axes = figure.subplots(1, 2, squeeze=False, width_ratios=(1.3, 1.0))
    for panel, (ax, value) in enumerate(zip(axes.flat, work.panel_values, strict=False)):
        (_draw_classes if work.classes else _draw_quantity)(ax, found, panel)
        if plan.overlay:
            _draw_conditions(ax, found, value)
        for mark in plan.marks:
            ax.plot(mark.x, mark.y, "*", color=ORANGE, mec=BLACK, ms=13, ls="none", label=mark.label, zorder=9)
        low, high = ((side.start, side.stop) for side in (plan.x, plan.y))
        ax.set(xscale=plan.x.scale, yscale=plan.y.scale, xlim=low, ylim=high)
        ax.grid(visible=False)
        if work.unit(plan.x.key) == work.unit(plan.y.key) == "mm":
            ax.set_aspect("equal")
        _set_ticks(ax.xaxis, plan.x.scale)
        _set_ticks(ax.yaxis, plan.y.scale)
        if value is not None and plan.panels:
            ax.set_title(f"{plan.panels.label or plan.panels.key} {value:g} {work.unit(plan.panels.key)}".rstrip("1 "))
    for side, (name, places) in zip((plan.x, plan.y), (("x", axes[-1]), ("y", axes[:, 0])), strict=True):
        for ax in places[: 1 if band is not None else None]:
            ax.set(**{f"{name}label": _label(side, found)})
    if (second := plan.y.second) and band is None:
        factor = second.factor
        for ax in axes[:, -1]:
            extra = ax.secondary_yaxis("right", functions=(lambda y: y * factor, lambda y: y / factor))
            extra.set_ylabel(axis_label(second.label, second.unit))
            _set_ticks(extra.yaxis, plan.y.scale)
    if band is not None:
        _draw_band(axes[0, 1], found, *band)
    add_legend(figure, columns=4)
    return figure


def _set_ticks(axis: Any, scale: str) -> None:
    """Label a logarithmic axis at 1, 2 and 5, in plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    if scale == "log":
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _label(side: Side, found: Map) -> str:
    return axis_label(side.label or side.key, found.work.unit(side.key))


def _draw_classes(ax: Any, found: Map, panel: int) -> None:
    """Draw the finest cells by class, and border cells in black."""
    from matplotlib.colors import ListedColormap

    work, lattice = found.work, found.lattice
    classes, border = (each[panel] for each in lattice.paint())
    steps = np.arange(lattice.size + 1) / lattice.size
    x, y = work.plan.x.place(steps), work.plan.y.place(steps)
    inner = np.concatenate([[0.0], steps[1:-2] + 0.5 / lattice.size, [1.0]])
    middle = work.plan.x.place(inner), work.plan.y.place(inner)
    looks = [_LOOKS.get(name) or _STEPS[min(number, 4)] for number, name in enumerate(work.classes)]
    colours = ListedColormap([*(colour for colour, _ in looks), BLACK])
    shown = np.where(border, len(looks), classes)
    ax.pcolormesh(x, y, shown, cmap=colours, vmin=-0.5, vmax=len(looks) + 0.5, rasterized=True, zorder=0)
    for code in np.unique(found.lattice.codes[found.lattice.codes >= 0]):
        colour, hatch = looks[code]
        if hatch and (inside := shown == code).any():
            with_hatch = ax.contourf(*middle, inside.astype(float), levels=[0.5, 1.5], colors="none", hatches=[hatch])
            with_hatch.set(edgecolor="0.35", linewidth=0.0)
        label = work.classes[code].replace("failed", "failed, or cannot start")
        ax.fill_between([], [], [], facecolor=colour, hatch=hatch, edgecolor="0.35", lw=0.8, label=label)


def _draw_quantity(ax: Any, found: Map, panel: int) -> None:
    """Draw a quantity as a colour map with contour lines."""
    work, points = found.work, found.points
    plan, own, size = work.plan, found.points["panel"] == panel, found.lattice.size
    values = np.full((size + 1, size + 1), np.nan)
    values[points["row"][own], points["column"][own]] = work.read_quantity(points)[own]
    steps = np.arange(size + 1) / size
    x, y = plan.x.place(steps), plan.y.place(steps)
    quantity = QUANTITIES[plan.quantity]
    colours = ax.pcolormesh(x, y, values, cmap="cividis", shading="gouraud", rasterized=True)
    bar = ax.figure.colorbar(colours, ax=ax, label=axis_label(quantity.label.partition(",")[0], quantity.unit))
    if np.nanmax(values) > np.nanmin(values):
        bar.add_lines(ax.contour(x, y, values, levels=_CONTOURS, colors="white", linewidths=0.9))


def _draw_band(ax: Any, found: Map, places: np.ndarray, quantiles: np.ndarray) -> None:
    plan, quantity = found.work.plan, QUANTITIES[found.work.plan.quantity]
    low, middle, high = quantiles
    ax.fill_between(places, low, high, color=SKY, alpha=0.4, lw=0, label="95 % over the assumed values")
    ax.plot(places, middle, color=BLUE, lw=1.8, label="median")
    label = axis_label(quantity.label.partition(",")[0], quantity.unit)
    ax.set(xscale=plan.x.scale, xlabel=_label(plan.x, found), ylabel=label)
    _set_ticks(ax.xaxis, plan.x.scale)


def _draw_conditions(ax: Any, found: Map, speed_hz: float | None) -> None:
    """Draw eq. 43 for rolling, for the same with moving housings, and for a whirl that the pulse alone starts.

    They apply only if the whirl of rolling is faster than the shaft on its magnets (eq. 42).
    """
    scene, plan = found.work.scene, found.work.plan
    changes = {plan.panels.key: speed_hz} if plan.panels and plan.panels.key in scene.load_parameters().entries else {}
    constants = build_model(scene.load_parameters().override(changes), scene.model).constants
    own = oscillator(constants)
    is_speed = plan.panels is not None and plan.panels.key == "drive.speed_hz"
    spin = 2.0 * math.pi * float(speed_hz if is_speed and speed_hz else scene.drive.speed_hz)
    whirl = -rolling_whirl(constants, spin)[0]
    pulse = next(each.request for each in scene.commands if each.request.command == "hammer")
    newton = pulse_whirl(constants, force_n=1.0, duration_s=1e-3 * pulse.duration_ms)  # type: ignore[attr-defined]
    if whirl <= own.natural:
        ax.text(0.5, 0.02, "no rolling whirl (eq. 42)", transform=ax.transAxes, ha="center", color=RED)
        return
    least, moving = least_friction(own, whirl), friction_with_houses(constants, spin)
    text = f"eq. 43, rolling: µ > {least:.2g}\nwith housings: µ > {moving:.2g}"
    ax.text(0.97, 0.02, text, transform=ax.transAxes, ha="right", fontsize=8.5, color="0.2", linespacing=1.3)
    for place, style in ((least, "--"), (moving, ":")):
        if plan.x.start < place < plan.x.stop:
            ax.axvline(place, color=RED, ls=style, lw=1.6)
    friction = np.linspace(max(plan.x.start, 1e-3), plan.x.stop, 200)
    force = [critical_whirl(own, float(each)) / newton for each in friction]
    ax.plot(friction, force, color=ORANGE, lw=2.0, label="the pulse alone starts a whirl that gains speed (eq. 43)")
