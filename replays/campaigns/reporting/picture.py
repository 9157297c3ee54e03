"""Picture of judged measurements: signals, their limits and levels, the judged moments, and numbered events."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.report.canvas import (
    BLACK,
    BLUE,
    ORANGE,
    RED,
    add_legend,
    axis_label,
    draw_signals,
    house_style,
    new_figure,
    save,
)  # fmt: skip
from rig.base import units

if TYPE_CHECKING:
    from recorder.reader import Recording
    from replays.campaigns.measurement import Measurement

_MAX_PANELS, _MAX_EVENTS = 4, 16
_HIDDEN_EVENTS = ("start", "end", "device")
_LINE_HEIGHT = 0.17
"""Height of a line of the list of events [inch]."""


@house_style()
def draw(
    recording: Recording, path: Path, judged: Sequence[Measurement], *, origin_s: float, about_s: float
) -> None:  # fmt: skip
    """Draw an excerpt of a recording and write it as PNG or SVG.

    Args:
        recording: The excerpt.
        path: Output file.
        judged: Measurements to show: their channels (both of an orbit as its radius), limits, levels and moments.
        origin_s: Simulated time at which the test began [s].
        about_s: Simulated time around which the excerpt was cut [s].
    """
    table = recording.table.channels
    panels = dict.fromkeys(names for each in judged if (names := tuple(n for n in each.channels if n in table)))
    panels = list(panels)[:_MAX_PANELS] or [(name,) for name in list(table)[:2]]
    rate = recording.catalogue["tick_rate_hz"]
    events = [
        event
        for event in recording.events
        if event["event"] not in _HIDDEN_EVENTS and event.get("tick") is not None and event.get("command") != "step"
    ]
    lines = [
        line
        for number, event in enumerate(events[:_MAX_EVENTS], 1)
        for line in textwrap.wrap(f"{number}  {event['tick'] / rate - origin_s:.4f} s  {_describe(event)}", 120)
    ] + ([f"{len(events) - _MAX_EVENTS} more"] if len(events) > _MAX_EVENTS else [])
    list_height = _LINE_HEIGHT * max(1, len(lines))
    figure = new_figure(1.0 + 2.1 * len(panels) + list_height)
    *axes, listed = figure.subplots(len(panels) + 1, height_ratios=[2.1] * len(panels) + [list_height])
    for panel, names in zip(axes, panels, strict=True):
        rows = recording.samples(*names)
        values = rows[names[0]] if len(names) == 1 else np.hypot(*(rows[name] for name in names[:2]))
        label = names[0] if len(names) == 1 else "radius of " + " and ".join(names[:2])
        draw_signals(panel, rows.times_s - origin_s, (values, BLUE, ""))
        for time_s, numbers in _group_events([event["tick"] / rate - origin_s for event in events[:_MAX_EVENTS]]):
            panel.axvline(time_s, color=ORANGE, lw=1.0, ls=":")
            panel.annotate(numbers, (time_s, 1.0), xycoords=("data", "axes fraction"), fontsize=8, va="bottom")
        for each in [each for each in judged if each.channels] or judged[:1]:
            if not each.channels or tuple(name for name in each.channels if name in table) == names:
                _mark(panel, each, table[names[0]].unit)
        panel.set(xlabel="test time [s]", ylabel=axis_label(label, table[names[0]].unit))
    if not any(each.at_s is not None for each in judged) and judged:
        axes[0].axvline(about_s - origin_s, color=RED, lw=1.2, label="end")
    listed.axis("off")
    listed.text(0.0, 1.0, "\n".join(lines) or "no events", va="top", fontsize=8.5, transform=listed.transAxes)
    add_legend(figure)
    save(figure, path)


def _mark(panel: Any, judged: Measurement, unit: str) -> None:
    """Draw the limit, the level, and the moments of a measurement."""
    if judged.must.unit == unit:
        for limit in judged.must.limit if isinstance(judged.must.limit, tuple) else (judged.must.limit,):
            panel.axhline(limit, color=RED, lw=0.9, ls="--", label="limit")
    if judged.level is not None:
        panel.axhline(judged.level, color=BLACK, lw=0.9, ls="-.", label=f"level {judged.level:.6g} {unit}")
    if judged.since_s is not None:
        panel.axvline(judged.since_s, color=BLACK, lw=1.2, label=f"from {judged.since_s:.4f} s")
    if judged.at_s is not None:
        panel.axvline(judged.at_s, color=RED, lw=1.2, label=f"judged at {judged.at_s:.4f} s")
    if judged.since_s is not None and units.get_quantity(judged.must.unit) == "time":
        limits = judged.must.limit if isinstance(judged.must.limit, tuple) else (judged.must.limit,)
        for limit in limits:
            time_s = judged.since_s + limit * units.size_si(judged.must.unit)
            panel.axvline(time_s, color=RED, lw=0.9, ls="--", label=f"must be {judged.must}")


def _group_events(times_s: Sequence[float]) -> Iterator[tuple[float, str]]:
    """Yield times with the numbers of the events there, such as "3" or "3-5"; close numbers would overlap."""
    near_s = 0.02 * (max(times_s) - min(times_s)) if times_s else 0.0
    first = 0
    for last in range(len(times_s)):
        if last + 1 == len(times_s) or times_s[last + 1] - times_s[first] > near_s:
            yield times_s[first], f"{first + 1}" if first == last else f"{first + 1}-{last + 1}"
            first = last + 1


def _describe(event: dict[str, Any]) -> str:
    """Return an event in words: a note's text, otherwise its name, sender and numbers."""
    if event["event"] == "note":
        return f"note {event.get('text', '')}"
    name = f"{event['event']} {event['command']}" if event["event"] == "command" else event["event"]
    return " ".join([name, *([f"from {event['from']}"] if event.get("from") else [])])
