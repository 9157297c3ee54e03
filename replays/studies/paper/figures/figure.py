"""The paper's figures for the parameter sets `as-printed` and `corrected`, with the last labels of the paper's axes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.report.canvas import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PINK,
    RED,
    SKY,
    add_legend,
    draw_signals,
    house_style,
    new_figure,
)
from replays.studies.paper.reproduction import FIG_7_M, PULSE_S, SPEEDS_HZ, Reproduction, fine_spectrum, spectra
from rig.physics.magnets import map_force

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PAPER = {"color": "0.45", "lw": 1.0, "ls": (0, (4, 3)), "zorder": 1}
_IMPACTS_MS = 14.0
_BEFORE, _IMPACTS, _SETTLED = GREEN, RED, BLUE


def _axis_lines(axes: Any, *levels: float, text: str = "the paper's labels", measured: bool = False) -> None:
    """Draw dashed lines at the last labels of the paper's axis."""
    look = {**_PAPER, "color": PINK, "lw": 1.5, "ls": (0, (1, 1.5))} if measured else _PAPER
    for level in levels:
        axes.axhline(level, **look)
    axes.plot([], [], label=text, **look)


def _time_from_rise_ms(times_s: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return the time from the first rise of a force through 0 [ms], as in the paper's figures."""
    rises = np.flatnonzero((force[:-1] < 0.0) & (force[1:] >= 0.0))
    return (times_s - times_s[int(rises[0]) if len(rises) else 0]) * 1e3


def _columns(
    by_set: dict[str, Reproduction], title: str, height: float, *, heights: tuple[float, ...] = (1.0,)
) -> tuple[Figure, list[tuple[Reproduction, Any]]]:
    """Return a figure with a column of panels for each parameter set, on the same scales for comparison."""
    figure = new_figure(height, title)
    panels = figure.subplots(len(heights), len(by_set), squeeze=False, sharey="row", height_ratios=heights)
    for one, axes in zip(by_set.values(), panels[0], strict=True):
        axes.set_title(one.parameters)
    return figure, list(zip(by_set.values(), panels.T, strict=True))


def _label_first(columns: list[tuple[Reproduction, Any]], *labels: str) -> None:
    """Label the vertical axes of the first column."""
    for axes, label in zip(columns[0][1], labels, strict=True):
        axes.set_ylabel(label)


@house_style()
def draw_magnets(one: Reproduction) -> Figure:
    """Draw figure 7: both components over the plane, and the line through the centre."""
    model = one.whirl.simulation.model
    axis = np.linspace(-FIG_7_M, FIG_7_M, 81)
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis))
    force = map_force(x, y, model.constants.magnet)
    figure = new_figure(4.2, "Fig. 7: force of the magnets on the shaft (the same in both sets)")
    panels = figure.subplots(1, 3)
    # The map is valid to 10 mm from the centre, which excludes the corners of the square.
    inside = np.hypot(x, y) <= FIG_7_M
    filled: Any = None
    for axes, component, name in zip(panels[:2], force.T, ("x", "y"), strict=True):
        shown = np.where(inside, component, np.nan).reshape(81, 81)
        filled = axes.contourf(axis * 1e3, axis * 1e3, shown, levels=np.linspace(-40, 40, 17), cmap="RdBu_r",
                               extend="both")  # fmt: skip
        axes.set(title=f"Force along {name}", xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    figure.colorbar(filled, ax=panels[:2], orientation="horizontal", shrink=0.6, ticks=[-40, -20, 0, 20, 40],
                    label="force [N]")  # fmt: skip
    line = panels[2]
    along = map_force(axis, np.zeros_like(axis), model.constants.magnet)[:, 0]
    line.plot(
        axis * 1e3, along, color=BLUE, lw=2.2, label=f"map, {model.constants.magnet.stiffness / 1e3:g} kN/m (assumed)"
    )
    line.plot(axis * 1e3, -model.constants.magnet.stiffness * axis, color=ORANGE, lw=1.4, label="linear spring")
    _axis_lines(line, -40.0, 40.0)
    line.set(title="Through the centre", xlabel="x [mm]", ylabel="force along x [N]", xlim=(-10, 10), ylim=(-46, 46))
    line.legend(loc="upper center", bbox_to_anchor=(0.45, -0.24))
    return figure


def first_impacts(penetration: np.ndarray, times_ms: np.ndarray) -> tuple[float, float]:
    """Return a time range [ms] from just before the first contact, short enough to resolve the housings' vibration.

    Args:
        penetration: Depth of contact [m], shape (n,).
        times_ms: Times [ms], shape (n,).
    """
    touching = np.flatnonzero(penetration > 0.0)
    start = float(times_ms[touching[0]]) if len(touching) else float(times_ms[0])
    return start - 1.0, start + _IMPACTS_MS


@house_style()
def draw_drop(by_set: dict[str, Reproduction]) -> Figure:
    """Draw figures 10 and 11: trajectory, y(t), SOUTH reaction, inner housing."""
    figure, columns = _columns(
        by_set, "Figs. 10, 11: drop at standstill from the top of the ring, magnets out", 11.4, heights=(1.25, 1, 1, 1)
    )
    for one, (path, height, force, house) in columns:
        run, t = one.drop, one.drop.times_s * 1e3
        angle = np.linspace(0, 2 * math.pi, 181)
        r0 = run.simulation.model.constants.contact.clearance * 1e3
        path.plot(r0 * np.cos(angle), r0 * np.sin(angle), color="0.6", lw=1.0, label="clearance r₀ (assumed)")
        path.plot(run["ring_x"] * 1e3, run["ring_y"] * 1e3, color=BLUE, lw=1.6)
        path.set(xlabel="x in the ring [mm]", aspect="equal", xlim=(-1.3, 1.3), ylim=(-1.3, 1.3))
        _axis_lines(path, -1.0, 1.0)
        height.plot(t, run["ring_y"] * 1e3, color=BLUE, lw=1.6, label="shaft in the ring, truth")
        height.plot(t, run["disk_y"] * 1e3, color=SKY, lw=1.2, label="at the probes")
        _axis_lines(height, -1.0, 1.0)
        height.set(xlabel="time [ms]", xlim=(0, 200))
        force.plot(t, run["P_S"] - run["P_N"], color=BLUE, lw=1.6)
        force.plot(t, run.samples["P_S"] - run.samples["P_N"], color=RED, lw=0.8, label="transducers")
        _axis_lines(force, 0.0, 100.0)
        _axis_lines(force, 80.0, text="the paper's labels, measured", measured=True)
        house.plot(t, run["inner_ay"], color=BLUE, lw=1.2)
        _axis_lines(house, -100.0, 100.0)
        _axis_lines(house, -40.0, 40.0, text="the paper's labels, measured", measured=True)
        for axes in (force, house):
            axes.set(xlabel="time, first impacts [ms]", xlim=first_impacts(run["penetration"], t))
    _label_first(
        columns, "y in the ring [mm]", "y [mm]", "SOUTH reaction [N]", "acceleration of the\ninner housing [m/s²]"
    )
    add_legend(figure, columns=5)
    return figure


def _phases(one: Reproduction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return masks over the rows for the time before the pulse, the impacts, and the whirl."""
    run = one.whirl
    t = run.times_s
    touching = run["penetration"] > 0.0
    loose = np.flatnonzero(~touching & (t >= PULSE_S))
    lasting = t[loose[-1]] if len(loose) else PULSE_S
    return t < PULSE_S, (t >= PULSE_S) & (t <= lasting), t > lasting


@house_style()
def draw_hammer(by_set: dict[str, Reproduction]) -> Figure:
    """Draw figures 12 and 13: orbit, spin, x(t), y(t)."""
    figure, columns = _columns(
        by_set, "Figs. 12, 13: hammer pulse of 100 N, 5 ms (shape assumed) at 6.2 Hz", 11.4, heights=(1.5, 0.9, 1, 1)
    )
    for one, (orbit, spin, across, up) in columns:
        run, t = one.whirl, one.whirl.times_s
        for part, colour, name in zip(
            _phases(one), (_BEFORE, _IMPACTS, _SETTLED), ("before", "impacts", "whirl"), strict=True
        ):
            kept = np.flatnonzero(part)[-2000:] if name == "whirl" else np.flatnonzero(part)
            orbit.plot(run["ring_x"][kept] * 1e3, run["ring_y"][kept] * 1e3, color=colour, lw=1.1, label=name)
            for axes, column in ((across, "disk_x"), (up, "disk_y")):
                draw_signals(axes, t[part], (run.samples[column][part], colour, ""))
        orbit.set(xlabel="x in the ring [mm]", aspect="equal", xlim=(-1.3, 1.3), ylim=(-1.3, 1.3))
        _axis_lines(orbit, -1.0, 1.0)
        draw_signals(spin, t, (run["spin_rate"] / (2 * math.pi), BLACK, ""))
        for axes in (across, up):
            _axis_lines(axes, -2.0, 2.0)
        for axes in (spin, across, up):
            axes.set(xlabel="time [s]")
    _label_first(columns, "y in the ring [mm]", "spin [Hz]", "x at the probes [mm]", "y at the probes [mm]")
    add_legend(figure, columns=5)
    return figure


@house_style()
def draw_waterfall(by_set: dict[str, Reproduction]) -> Figure:
    """Draw figure 14: full spectrum over time, and that of the settled whirl, which separates 81.7 from 83.7 Hz."""
    figure, columns = _columns(by_set, "Fig. 14: full spectrum at the disk", 7.4, heights=(1.2, 1.0))
    mesh: Any = None
    for one, (axes, lines) in columns:
        times, frequencies, amplitude = spectra(one.whirl)
        level = 20.0 * np.log10(np.maximum(amplitude, 1e-5))
        mesh = axes.pcolormesh(times, frequencies, level.T, cmap="magma", vmin=-80, vmax=5, shading="nearest",
                               rasterized=True)  # fmt: skip
        axes.axhline(-83.7, color="white", lw=0.8, ls=(0, (4, 3)))
        axes.annotate("the paper: 83.7 Hz, backward", (times[0], -83.7), xytext=(4, -13), textcoords="offset points",
                      color="white")  # fmt: skip
        axes.set(xlabel="time [s]", ylim=(-150, 150))
        for run, colour, label in ((one.whirl, BLUE, "as run"), (one.held, GREEN, "drive held at 6.2 Hz")):
            lines.plot(*fine_spectrum(run), color=colour, lw=1.6, label=label)
        lines.axvline(-83.7, color=RED, lw=1.4, ls=(0, (4, 3)), label="the paper, 83.7 Hz")
        lines.set(xlim=(-88.0, -78.0), xlabel="frequency [Hz]")
    _label_first(columns, "frequency [Hz]\n← backward      forward →", "amplitude [mm]")
    figure.colorbar(mesh, ax=[column[0] for _, column in columns], label="amplitude [dB re 1 mm]", pad=0.02)
    add_legend(figure)
    return figure


@house_style()
def draw_reactions(by_set: dict[str, Reproduction]) -> Figure:
    """Draw figure 15: horizontal and vertical reactions, with separate scales for impacts and whirl."""
    figure, columns = _columns(
        by_set, "Fig. 15: reactions, the difference of opposed transducers", 11.0, heights=(1, 1, 1, 1)
    )
    for one, panels in columns:
        run, t = one.whirl, one.whirl.times_s
        last = t > t[-1] - 0.05
        for place, (a, b) in enumerate((("P_E", "P_W"), ("P_N", "P_S"))):
            truth, sensed = run[a] - run[b], run.samples[a] - run.samples[b]
            whole, settled = panels[place], panels[2 + place]
            draw_signals(whole, t, (truth, BLUE, ""))
            _axis_lines(whole, -5000.0, 5000.0, text="the paper's labels: simulated above, measured below")
            whole.set(xlabel="time [s]")
            settled.plot(t[last], truth[last], color=BLUE, lw=1.8, label="truth")
            settled.plot(t[last], sensed[last], color=RED, lw=0.9, label="transducers")
            _axis_lines(settled, -500.0, 500.0, text="the paper's labels: simulated above, measured below")
            settled.set(xlabel="time, settled whirl [s]")
    _label_first(columns, "E − W [N]", "N − S [N]", "E − W [N]", "N − S [N]")
    add_legend(figure)
    return figure


@house_style()
def draw_east(by_set: dict[str, Reproduction]) -> Figure:
    """Draw figure 16: EAST in full annular whirl, over a turn and a half."""
    figure, columns = _columns(by_set, "Fig. 16: EAST in full annular whirl", 4.9)
    for one, (axes,) in columns:
        run = one.whirl
        last = np.flatnonzero(run.times_s > run.times_s[-1] - 0.030)
        pair = (run["P_E"] - run["P_W"])[last]
        t = _time_from_rise_ms(run.times_s[last], pair)
        preload = run.simulation.model.constants.house.preload
        axes.plot(t, pair, color=BLUE, lw=2.0, label="E − W, truth")
        axes.plot(t, (run.samples["P_E"] - run.samples["P_W"])[last], color=RED, lw=0.9, label="E − W, transducers")
        axes.plot(t, run["P_E"][last] - preload, color=GREEN, lw=1.5, label="EAST alone, less its preload")
        axes.plot(t, run["normal_force"][last], color="0.3", lw=1.2, ls=":", label="normal force in the contact")
        _axis_lines(axes, 0.0, 900.0, text="the paper's labels, simulated and measured")
        axes.axhline(500.0, color=PINK, lw=1.4, ls=(0, (1, 2)), zorder=1, label="Fig. 15's last label, measured")
        axes.set(xlabel="time [ms]", xlim=(0, 12))
    _label_first(columns, "force [N]")
    add_legend(figure, columns=3)
    return figure


@house_style()
def draw_speeds(by_set: dict[str, Reproduction]) -> Figure:
    """Draw figure 17: EAST at four speeds."""
    figure, columns = _columns(by_set, "Fig. 17: EAST (E − W) in full annular whirl at four speeds", 4.6)
    for one, (axes,) in columns:
        for speed, colour in zip(SPEEDS_HZ, (SKY, GREEN, ORANGE, PINK), strict=True):
            run = one.speeds[speed]
            pair = run["P_E"] - run["P_W"]
            last = np.flatnonzero(run.times_s > run.times_s[-1] - 0.08)
            t = _time_from_rise_ms(run.times_s[last], pair[last])
            axes.plot(t, pair[last], color=colour, lw=1.8, label=f"{speed:g} Hz")
        axes.set(xlabel="time [ms]", xlim=(0, 24))
    _label_first(columns, "E − W [N]")
    add_legend(figure)
    return figure
