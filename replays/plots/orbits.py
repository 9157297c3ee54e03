"""Orbit and shaft centreline: the path of the shaft in the plane of two perpendicular probes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from replays.plots.plot import Plot, Table, describe_frame, describe_span, describe_title, kind, make_axes
from replays.plots.signals import Pair, Signals, break_lines, compute_revolutions, fit_orders
from replays.report.canvas import BLACK, BLUE, RED, axis_label
from rig.base.errors import InputError, UnknownNameError
from rig.channels.orbit import mean_rotation, whirl_frequency

COMPONENTS = ("raw", "1X", "2X")
_ORBIT_S = 1.0
"""Length of the end of the data that an orbit shows by default [s]; longer orbits are solid areas."""
_STILL = 1e-9
"""Ratio of forward and backward amplitude within which the orbit is a line, which has no sense of rotation."""
_MIN_WHIRLS = 2.0
"""Revolutions of the whirl from which its frequency is given."""
_MIN_PATH = 0.2
"""Size of a path relative to the clearance, below which it is drawn without the circle."""
_LOOP = 180
"""Points of a filtered orbit."""
_BLOCK_S = 0.1
"""Interval of a mean position without a keyphasor [s]."""


@kind(last_s=_ORBIT_S)
def orbit(
    signals: Signals,
    *,
    pair: str | None = None,
    components: Sequence[str] = (),
    clearance: float | None = None,
    axes: Any = None,
) -> Plot:
    """Draw the orbit of the shaft: raw, 1X and 2X, with the clearance circle and the keyphasor's passages as dots.

    1X and 2X are fitted to each revolution and averaged. The arrow shows the sense of the whirl. Without a keyphasor,
    only the raw orbit is drawn.

    Args:
        signals: The data; by default the last second.
        pair: Common part of the two probes' names, such as `disk`; None for the first pair.
        components: Some of `raw`, `1X` and `2X`; none for all that the data have.
        clearance: Radius of the clearance circle, in the unit of the probes; None for that of the rig.
        axes: Axes to draw on, one for each component; None for a new figure.

    Returns:
        Axes and table: time, and x and y of each component.
    """
    probes, edges_s = signals.read_pair(pair), signals.edges_s
    if isinstance(components, str):
        components = [components]
    for name in components:
        if name not in COMPONENTS:
            raise UnknownNameError("components", "some of raw, 1X and 2X", name, COMPONENTS)
    times_s = probes.samples.times_s
    _, turns = fit_orders(probes.samples, probes.xy, edges_s, (1, 2))
    if not len(turns) and set(components) - {"raw"}:
        raise InputError("components", "raw, as there is no whole revolution in these data", list(components))
    shown = list(components) or list(COMPONENTS if len(turns) else COMPONENTS[:1])
    radius = probes.clearance if clearance is None else clearance
    note = f"{describe_frame(signals)}; dots: the keyphasor notch passes" + "; dashed: clearance, if it is near" * bool(
        radius
    )
    title = f"{describe_title(signals, f'Orbit at {probes.name}')}, {describe_span(probes)}"
    panels = make_axes(axes, 1, len(shown), height=4.4 if len(shown) > 1 else 6.5, title=title, note=note)
    columns: dict[str, tuple[str, Any]] = {"time": ("s", times_s)}
    for panel, name in zip(panels, shown, strict=True):
        if name == "raw":
            path, dots, rows, caption = _follow_raw(probes, edges_s)
            values = probes.x + 1j * probes.y
        else:
            order = int(name[0])
            vectors = turns[:, order].mean(axis=0)
            path, dots, rows, caption = _follow_ellipse(vectors, probes.unit)
            values = _rebuild(vectors, 2.0 * math.pi * order * compute_revolutions(times_s, edges_s))
        columns |= {f"x {name}": (probes.unit, values.real), f"y {name}": (probes.unit, values.imag)}
        panel.plot(path.real, path.imag, color=BLUE, lw=0.7 if name == "raw" else 1.4)
        begin = len(path) - 1 - 3 * rows // 4
        tail, tip = path[begin], path[min(begin + max(1, rows // 60), len(path) - 1)]
        if rows and abs(tip - tail) > 0.0:
            arrow = {"arrowstyle": "-|>", "color": BLACK, "mutation_scale": 16, "shrinkA": 0, "shrinkB": 0}
            panel.annotate("", (tip.real, tip.imag), (tail.real, tail.imag), arrowprops=arrow)
        panel.plot(dots.real, dots.imag, "o", ms=4.5, color=RED)
        panel.set(title=f"{name}{caption}", xlabel=axis_label("x", probes.unit))
        _finish(panel, radius if name == "raw" else None)
    panels[0].set_ylabel(axis_label("y", probes.unit))
    return Plot(tuple(panels), Table.from_columns(note, **columns))


def _follow_raw(probes: Pair, edges_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, int, str]:
    """Return the path of the raw orbit, its points at the keyphasor's passages, rows per whirl, and a caption.

    The rows are 0 without a steady whirl.
    """
    times_s = probes.samples.times_s
    lines = list(break_lines(np.diff(probes.samples.index) != 1, times_s, probes.x, probes.y))
    inside = edges_s[(edges_s >= times_s[0]) & (edges_s <= times_s[-1])]
    dots = np.interp(inside, lines[0], lines[1]) + 1j * np.interp(inside, lines[0], lines[2])
    path, hz = lines[1] + 1j * lines[2], whirl_frequency(probes.x, probes.y, times_s)
    steady = (
        abs(hz) * np.ptp(times_s) > _MIN_WHIRLS and hz * mean_rotation(probes.x, probes.y, probes.samples.rate_hz) > 0.0
    )
    if not steady:
        return path, dots, 0, "\n"
    rows = min(round(probes.samples.rate_hz / abs(hz)), len(path) - 2)
    return path, dots, rows, f": {'forward' if hz > 0.0 else 'backward'}\n{abs(hz):.2f} Hz"


def _follow_ellipse(vectors: np.ndarray, unit: str) -> tuple[np.ndarray, np.ndarray, int, str]:
    """Return the same of a filtered orbit, about its centre.

    Args:
        vectors: Complex components of x and y, shape (2,).
        unit: Their unit.
    """
    path = _rebuild(vectors, np.linspace(0.0, 2.0 * math.pi, _LOOP + 1))
    forward, backward = abs(vectors[0] + 1j * vectors[1]) / 2.0, abs(vectors[0] - 1j * vectors[1]) / 2.0
    major, minor = forward + backward, abs(forward - backward)
    sense = "a line" if minor <= _STILL * major else "forward" if forward > backward else "backward"
    return path, path[:1], _LOOP, f": {sense}\nhalf axes {major:.3g}, {minor:.2g} {unit}"


def _rebuild(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return x + j y of complex components at angles [rad], shape (n,)."""
    waves = np.real(np.outer(np.exp(1j * angle), vectors))
    return waves[:, 0] + 1j * waves[:, 1]


def _finish(panel: Any, radius: float | None) -> None:
    """Draw the clearance circle, unless the path would be a dot in it, and set limits of equal length."""
    (left, bottom), (right, top) = panel.dataLim.min, panel.dataLim.max
    half = 0.56 * max(right - left, top - bottom) or 1.0
    x, y = 0.5 * (left + right), 0.5 * (bottom + top)
    if radius and max(half, abs(x), abs(y)) < _MIN_PATH * radius:
        panel.set_title(
            f"clearance {radius:.3g} lies outside", loc="right", fontsize=8, fontweight="normal", color="0.35"
        )
    elif radius:
        circle = radius * np.exp(2j * math.pi * np.linspace(0.0, 1.0, 361))
        panel.plot(circle.real, circle.imag, color=BLACK, ls="--", lw=0.9)
        half, x, y = max(1.1 * radius, half + max(abs(x), abs(y))), 0.0, 0.0
    panel.set(aspect="equal", xlim=(x - half, x + half), ylim=(y - half, y + half))
    panel.locator_params(nbins=5)


@kind()
def centreline(signals: Signals, *, pair: str | None = None, clearance: float | None = None, axes: Any = None) -> Plot:
    """Draw the shaft centreline: the mean position per revolution, within the clearance circle.

    Args:
        signals: The data.
        pair: Common part of the two probes' names; None for the first pair.
        clearance: Radius of the clearance circle, in the unit of the probes; None for that of the rig.
        axes: Axes to draw on; None for a new figure.

    Returns:
        Axes and table: time, speed and mean position per revolution; without a keyphasor per 0.1 s, with speed nan.
    """
    probes, edges_s = signals.read_pair(pair), signals.edges_s
    times_s = probes.samples.times_s
    limits_s = edges_s if len(edges_s) > 1 else np.arange(times_s[0], times_s[-1], _BLOCK_S)
    turns, means = fit_orders(probes.samples, probes.xy, limits_s)
    if not len(turns):
        raise InputError("times", "with a whole revolution", describe_span(probes))
    (x, y), at_s = means[:, 0].real.T, 0.5 * (limits_s[1:] + limits_s[:-1])[turns]
    speed_hz = 1.0 / np.diff(limits_s)[turns] if len(edges_s) > 1 else np.full(len(turns), np.nan)
    radius = probes.clearance if clearance is None else clearance
    note = f"{describe_frame(signals)}; mean position of each revolution; dot: the end" + "; dashed: clearance" * bool(
        radius
    )
    title = f"{describe_title(signals, f'Shaft centreline at {probes.name}')}, {describe_span(probes)}"
    (panel,) = make_axes(axes, 1, 1, height=6.5, title=title, note=note)
    panel.plot(*break_lines(np.diff(turns) != 1, x, y), ".-", color=BLUE, lw=0.9, ms=4)
    panel.plot(x[-1:], y[-1:], "o", ms=6, color=RED)
    panel.set(xlabel=axis_label("x", probes.unit), ylabel=axis_label("y", probes.unit))
    _finish(panel, radius)
    columns = {"time": ("s", at_s), "speed": ("Hz", speed_hz), "x": (probes.unit, x), "y": (probes.unit, y)}
    return Plot((panel,), Table.from_columns(note, **columns))
