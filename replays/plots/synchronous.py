"""Synchronous vibration: Bode and polar plots over the speed, and the trend over time, of 1X, 2X and further orders."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from replays.plots.plot import Plot, Table, describe_phase, describe_title, kind, make_axes
from replays.plots.signals import Signals, break_lines, check_speeds, fit_orders
from replays.report.canvas import BLACK, BLUE, GREEN, ORANGE, PINK, RED, SKY, axis_label
from rig.base.errors import InputError, Words

_COLOURS = (BLUE, ORANGE, GREEN, RED, PINK, SKY, BLACK)
_MIN_AMPLITUDE = 0.03
"""Amplitude relative to the largest below which a phase is not drawn."""
_NO_PHASE = f"phases of amplitudes below {_MIN_AMPLITUDE:.0%} left out"
_MIN_WAY = 0.05
"""Change of speed relative to the largest that counts as a run-up or a coast-down."""
_SPEED_LABELS = 6
"""Speeds written along a curve of a polar plot."""


class _Turns(NamedTuple):
    """Synchronous components per revolution.

    Attributes:
        times_s: Middle of each revolution [s], shape (turns,).
        speed_hz: Speed [Hz], shape (turns,).
        breaks: Whether a revolution does not follow the previous one, shape (turns - 1,).
        curves: Order, channel, unit, and complex components, shape (turns,); order by order.
        channels: The channels.
    """

    times_s: np.ndarray
    speed_hz: np.ndarray
    breaks: np.ndarray
    curves: list[tuple[int, str, str, np.ndarray]]
    channels: list[str]

    def split_ways(self) -> list[tuple[slice, str, str, float]]:
        """Return run-up and coast-down, as far as the data have them: rows, name, line style and marker fill."""
        top, speed_hz = int(np.argmax(self.speed_hz)), self.speed_hz
        ways = [(slice(0, top + 1), "run-up", "-", 1.0), (slice(top, None), "coast-down", "--", 0.0)]
        return [way for way in ways if np.ptp(speed_hz[way[0]]) > _MIN_WAY * speed_hz[top]] or [
            (slice(None), "", "-", 1.0)
        ]

    def build_table(self, note: str) -> Table:
        """Return the table of amplitudes and phase lags."""
        columns = {"time": ("s", self.times_s), "speed": ("Hz", self.speed_hz)}
        for order, channel, unit, vectors in self.curves:
            columns |= {
                f"{channel} {order}X": (unit, np.abs(vectors)),
                f"{channel} {order}X lag": ("deg", _lag(vectors)),
            }
        return Table.from_columns(note, **columns)


def _fit(signals: Signals, channels: Sequence[str], orders: Sequence[int], what: str) -> _Turns:
    """Return the components of channels at orders.

    Raises:
        InputError: There is no keyphasor, or no whole revolution.
    """
    names, edges_s = signals.list_channels(channels), signals.require_edges(what)
    samples = signals.read(*names)
    turns, fitted = signals.recall(
        "fit", lambda: fit_orders(samples, samples.values, edges_s, tuple(orders)), *names, *orders
    )
    if not len(turns):
        raise InputError(
            "times", f"with a whole revolution for a {what} plot", Words("{:g} to {:g} s".format(*signals.span_s))
        )
    curves = [
        (order, name, samples.units[c], fitted[:, k, c])
        for (k, order), (c, name) in product(enumerate(orders, 1), enumerate(names))
    ]
    times_s = 0.5 * (edges_s[1:] + edges_s[:-1])[turns]
    return _Turns(times_s, 1.0 / np.diff(edges_s)[turns], np.diff(turns) != 1, curves, names)


def _lag(vectors: np.ndarray) -> np.ndarray:
    """Return the phase lag of complex components, 0 to 360 [degrees]."""
    return np.degrees(-np.angle(vectors)) % 360.0


def _draw_lag(vectors: np.ndarray) -> np.ndarray:
    """Return the phase lag for a picture: nan for small components, whose phase is noise."""
    amplitude = np.abs(vectors)
    return np.where(amplitude < _MIN_AMPLITUDE * amplitude.max(), np.nan, _lag(vectors))


def _add_legend(panel: Any, source: Any) -> None:
    """Draw the legend of a panel's lines above another one, beside its title."""
    handles, labels = source.get_legend_handles_labels()
    panel.legend(handles, labels, loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=2, fontsize=8, borderpad=0.1)


@kind()
def bode(signals: Signals, *, channels: Sequence[str] = (), orders: Sequence[int] = (1, 2), axes: Any = None) -> Plot:
    """Draw a Bode plot: phase lag and amplitude over the speed, of 1X and 2X, of a run-up or a coast-down.

    Args:
        signals: The data.
        channels: Channels or pairs, such as `disk`; none for the first pair.
        orders: Multiples of the speed.
        axes: Axes to draw on: the phases of all orders, then the amplitudes; None for a new figure.

    Returns:
        Axes and table: time, speed, amplitude and phase lag of each revolution.

    Raises:
        InputError: The speed changes by less than a tenth, or there is no keyphasor.
    """
    turns = _fit(signals, channels, orders, "Bode")
    check_speeds(turns.speed_hz)
    note = f"{describe_phase()}; run-up: filled, coast-down: hollow; {_NO_PHASE}"
    title = describe_title(signals, "Bode plot")
    panels = make_axes(axes, 2, len(orders), height=6.4, title=title, note=note, sharex=True)
    for order, name, unit, vectors in turns.curves:
        column = list(orders).index(order)
        phase, amplitude = panels[column], panels[len(orders) + column]
        colour = _COLOURS[turns.channels.index(name) % len(_COLOURS)]
        for rows, way, line, filled in turns.split_ways():
            speed_hz, values = turns.speed_hz[rows], vectors[rows]
            phase.plot(
                speed_hz, _draw_lag(vectors)[rows], "o", ms=2.5, color=colour, mfc=colour if filled else "none", mew=0.7
            )
            broken = break_lines(turns.breaks[rows][: len(values) - 1], speed_hz, np.abs(values))
            amplitude.plot(*broken, line, color=colour, lw=1.3, label=f"{name}, {way}")
        phase.set(
            title=f"{order}X", ylabel="phase lag [°]" if column == 0 else "", ylim=(365, -5), yticks=range(0, 361, 90)
        )
        amplitude.set(xlabel="speed [Hz]", ylabel=axis_label("amplitude", unit) if column == 0 else "", ylim=(0, None))
    _add_legend(panels[0], panels[len(orders)])
    return Plot(tuple(panels), turns.build_table(note))


@kind()
def polar(signals: Signals, *, channels: Sequence[str] = (), orders: Sequence[int] = (1, 2), axes: Any = None) -> Plot:
    """Draw polar plots of 1X and 2X over a run-up or a coast-down, each from the direction of its probe.

    Args:
        signals: The data.
        channels: Channels or pairs, such as `disk`; none for the first pair.
        orders: Multiples of the speed.
        axes: Polar axes to draw on, all channels of the first order, then of the next; None for a new figure.

    Returns:
        Axes and table, as for `bode`.

    Raises:
        InputError: There is no keyphasor.
    """
    from matplotlib.ticker import MaxNLocator

    turns = _fit(signals, channels, orders, "polar")
    note = f"{describe_phase()}; 0° at the probe, lag against the rotation; numbers: speed [Hz]"
    title, rows = describe_title(signals, "Polar plot"), len(orders)
    settings = {"subplot_kw": {"projection": "polar"}}
    panels = make_axes(axes, rows, len(turns.channels), height=0.8 + 4.3 * rows, title=title, note=note, **settings)
    for panel, (order, name, unit, vectors) in zip(panels, turns.curves, strict=True):
        radius, lag = np.abs(vectors), _lag(vectors)
        for (rows, way, line, _), colour in zip(turns.split_ways(), (BLUE, ORANGE), strict=False):
            broken = break_lines(turns.breaks[rows][: len(lag[rows]) - 1], np.radians(lag[rows]), radius[rows])
            panel.plot(*broken, line, marker=".", color=colour, lw=1.0, ms=3, label=way)
        path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(vectors)))])
        marks = np.unique(np.searchsorted(path, path[-1] * np.linspace(0.0, 1.0, _SPEED_LABELS + 2)[1:-1]))
        for row in marks[radius[marks] > 0.2 * radius.max()]:
            panel.annotate(f"{turns.speed_hz[row]:.1f}", (np.radians(lag[row]), radius[row]), fontsize=8)
        panel.set_theta_offset(np.radians(signals.get_direction_deg(name)))
        panel.set_theta_direction(-1)
        panel.set_rmax(1.12 * radius.max())
        panel.set_title(f"{name}, {order}X [{unit}]", pad=14.0)
        panel.yaxis.set_major_locator(MaxNLocator(4))
        panel.tick_params(labelsize=8)
    if len(turns.split_ways()) > 1:
        panels[0].legend(loc="lower left", bbox_to_anchor=(-0.3, -0.12), fontsize=8.5)
    return Plot(tuple(panels), turns.build_table(note))


@kind()
def trend(signals: Signals, *, channels: Sequence[str] = (), orders: Sequence[int] = (1, 2), axes: Any = None) -> Plot:
    """Draw amplitude and phase lag of 1X and 2X over time, and the speed.

    Args:
        signals: The data.
        channels: Channels or pairs, such as `disk`; none for the first pair.
        orders: Multiples of the speed.
        axes: Axes to draw on: the amplitudes of all orders, their phases, then the speed; None for a new figure.

    Returns:
        Axes and table, as for `bode`.

    Raises:
        InputError: There is no keyphasor.
    """
    turns = _fit(signals, channels, orders, "trend")
    note, count = f"{describe_phase()}; {_NO_PHASE}", len(orders)
    title = describe_title(signals, "Trend")
    panels = make_axes(axes, 3, count, height=7.6, title=title, note=note, sharex=True)
    for order, name, unit, vectors in turns.curves:
        column = list(orders).index(order)
        amplitude, phase, speed = panels[column::count]
        colour = _COLOURS[turns.channels.index(name) % len(_COLOURS)]
        amplitude.plot(*break_lines(turns.breaks, turns.times_s, np.abs(vectors)), color=colour, lw=1.2, label=name)
        phase.plot(turns.times_s, _draw_lag(vectors), "o", ms=2.5, color=colour)
        if name == turns.channels[0]:
            speed.plot(*break_lines(turns.breaks, turns.times_s, turns.speed_hz), color=BLACK, lw=1.2)
        amplitude.set(title=f"{order}X", ylabel=axis_label("amplitude", unit) if column == 0 else "", ylim=(0, None))
        phase.set(ylabel="phase lag [°]" if column == 0 else "", ylim=(365, -5), yticks=range(0, 361, 90))
        speed.ticklabel_format(axis="y", useOffset=False)
        speed.set(xlabel="time [s]", ylabel="speed [Hz]" if column == 0 else "")
    _add_legend(panels[0], panels[0])
    return Plot(tuple(panels), turns.build_table(note))
