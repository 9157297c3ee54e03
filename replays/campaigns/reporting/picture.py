"""The picture of a failure: the signals about it, the events there, and the limit that was not kept."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from replays.report.canvas import BLUE, ORANGE, RED, draw_signals, house_style, label_of, legend_below, new_figure, save

if TYPE_CHECKING:
    from recorder.reader import Recording
    from replays.campaigns.measurement import Measurement

_MOST = 4
"""Panels."""
_QUIET = ("command", "end")
"""Events that others tell already."""


@house_style()
def draw(
    recording: Recording, path: Path, failed: Sequence[Measurement], *, origin_s: float, channels: Sequence[str],
    about_s: float,
) -> None:  # fmt: skip
    """Draw a piece of a recording and write it as PNG or SVG.

    Args:
        recording: The piece.
        path: The file.
        failed: What was not as it must be.
        origin_s: Simulated time at which the test began [s].
        channels: What to draw; none: the first two that were recorded.
        about_s: The moment that it is about [s].
    """
    known = recording.table.channels
    names = [name for name in channels if name in known][:_MOST] or list(known)[:2]
    figure = new_figure(1.0 + 1.9 * len(names))
    marks = [event for event in recording.events if event["event"] not in _QUIET and event.get("tick") is not None]
    for axes, name in zip(figure.subplots(len(names), squeeze=False)[:, 0], names, strict=True):
        rows = recording.samples(name)
        draw_signals(axes, rows.times_s - origin_s, (rows[name], BLUE, ""))
        axes.axvline(about_s - origin_s, color=RED, lw=1.2, label="where it failed")
        for event in marks:
            text = event["event"] if event["event"] != "note" else f"note {event.get('text', '')[:20]}"
            time_s = event["tick"] / recording.catalogue["tick_rate_hz"] - origin_s
            axes.axvline(time_s, color=ORANGE, lw=1.0, ls=":", label=text)
        for each in failed:
            if name in each.channels and each.must.unit == known[name].unit:
                limits = each.must.limit if isinstance(each.must.limit, tuple) else (each.must.limit,)
                for limit in limits:
                    axes.axhline(limit, color=RED, lw=0.9, ls="--", label="limit")
        axes.set(xlabel="time of the test [s]", ylabel=label_of(name, known[name].unit))
    legend_below(figure)
    save(figure, path)
