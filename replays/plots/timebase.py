"""Timebase: signals over time, with the keyphasor's passages."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from replays.plots.plot import Plot, Table, describe_title, kind, make_axes
from replays.plots.signals import Signals, break_lines
from replays.report.canvas import BLUE, RED, axis_label
from rig.base.errors import InputError, Words

_PIXELS = 1000
"""Width of a panel; more than two rows per pixel are drawn as an envelope [pixels]."""
_MAX_MARKS = 150
"""Largest number of keyphasor marks that can be distinguished in a panel."""
_PANEL_INCHES = ((2, 2.4), (6, 1.5), (1 << 30, 0.85))
"""Height of a panel by the largest number of panels [inch]."""


class _Trace(NamedTuple):
    """One channel as drawn.

    Attributes:
        times_s: Times of the rows, or of the middle of each interval of an envelope [s], shape (n,).
        values: The values, or minimum and maximum of each interval, shape (n, 1 or 2); nan without a row.
        breaks: Whether a row does not continue the previous one, shape (n - 1,).
        missing: Gaps in words; empty without gaps.
    """

    times_s: np.ndarray
    values: np.ndarray
    breaks: np.ndarray
    missing: str


@kind()
def timebase(signals: Signals, *, channels: Sequence[str] = (), axes: Any = None) -> Plot:
    """Draw channels over time, each in its panel, with the keyphasor's passages as dots.

    More rows than a panel has pixels are drawn as an envelope from minimum to maximum, and labelled as one. Gaps are
    left open.

    Args:
        signals: The data.
        channels: Channels, pairs such as `disk`, or `truth.NAME`; none for all measured channels.
        axes: Axes to draw on, one for each channel; None for a new figure.

    Returns:
        Axes and table; the table has the times and values drawn, of an envelope `NAME.min` and `NAME.max`.
    """
    names = [name for name in signals.names if name != "keyphasor"] or list(signals.names)
    names = signals.list_channels(channels or names)
    edges_s = signals.edges_s
    traces = [_build_trace(signals, name) for name in names]
    marked = 0 < len(edges_s) <= _MAX_MARKS
    notes = ["gaps in the data are left open"]
    if any(trace.values.shape[1] == 2 for trace in traces):
        notes.append(f"envelope: minimum and maximum in each of {_PIXELS} intervals")
    if marked:
        notes.append("red: the keyphasor notch passes")
    note = "; ".join(notes)
    inches = next(inches for most, inches in _PANEL_INCHES if len(names) <= most)
    title = describe_title(signals, "Timebase")
    height = 1.3 + inches * len(names)
    panels = make_axes(axes, len(names), 1, height=height, title=title, note=note, sharex=True)
    columns: dict[str, tuple[str, np.ndarray, np.ndarray]] = {}
    for panel, name, trace in zip(panels, names, traces, strict=True):
        unit = signals.channels[name][1]
        if trace.values.shape[1] == 2:
            panel.plot(np.repeat(trace.times_s, 2), trace.values.ravel(), color=BLUE, lw=0.8)
            if marked:
                panel.plot(
                    edges_s,
                    np.zeros(len(edges_s)),
                    "|",
                    ms=9,
                    mew=1.4,
                    color=RED,
                    transform=panel.get_xaxis_transform(),
                )
            columns |= {
                f"{name}.{end}": (unit, trace.times_s, trace.values[:, at]) for at, end in enumerate(("min", "max"))
            }
        else:
            times_s, values = break_lines(trace.breaks, trace.times_s, trace.values[:, 0])
            panel.plot(times_s, values, color=BLUE, lw=0.9)
            if marked:
                panel.plot(edges_s, np.interp(edges_s, times_s, values), "o", ms=3.5, color=RED)
            columns[name] = (unit, trace.times_s, trace.values[:, 0])
        text = ", ".join(filter(None, ["envelope" * (trace.values.shape[1] == 2), trace.missing]))
        panel.set_title(text, loc="right", fontsize=8, fontweight="normal", color="0.35", pad=1.0)
        panel.set_ylabel(axis_label(f"{name}\n", unit), rotation=0, ha="right", va="center")
        panel.locator_params(axis="y", nbins=3 if len(names) > 6 else 5)
    panels[-1].set(xlabel="time [s]", xlim=signals.span_s)
    return Plot(tuple(panels), _join(columns, note))


def _build_trace(signals: Signals, name: str) -> _Trace:
    """Return a channel as drawn.

    Raises:
        InputError: The channel has no rows.
    """
    samples = signals.read(name)
    if not len(samples):
        raise InputError("times", f"with samples of {name}", Words("{:g} to {:g} s".format(*signals.span_s)))
    steps = np.diff(samples.index)
    gaps, rows = int(np.sum(steps > 1)), int(np.sum(steps[steps > 1] - 1))
    missing = f"{rows} rows missing in {gaps} gap{'s' * (gaps > 1)}" if gaps else ""
    values = samples.values[:, 0]
    if len(samples) <= 2 * _PIXELS:
        return _Trace(samples.times_s, values[:, None], steps != 1, missing)
    limits = np.linspace(*signals.span_s, _PIXELS + 1)
    first = np.searchsorted(samples.times_s, limits[:-1])
    filled = np.diff(np.append(first, len(values))) > 0
    envelope = np.full((_PIXELS, 2), np.nan)
    for at, function in enumerate((np.minimum, np.maximum)):
        envelope[filled, at] = function.reduceat(values, first[filled])
    middle = 0.5 * (limits[1:] + limits[:-1])
    return _Trace(middle, envelope, np.zeros(_PIXELS - 1, dtype=bool), missing)


def _join(columns: dict[str, tuple[str, np.ndarray, np.ndarray]], note: str) -> Table:
    """Return columns with their own times as one table, nan at times that a column does not have."""
    times_s = reduce(np.union1d, [times for _, times, _ in columns.values()])
    joined: dict[str, tuple[str, np.ndarray]] = {"time": ("s", times_s)}
    for name, (unit, times, values) in columns.items():
        filled = np.full(len(times_s), np.nan)
        filled[np.searchsorted(times_s, times)] = values
        joined[name] = (unit, filled)
    return Table.from_columns(note, **joined)
