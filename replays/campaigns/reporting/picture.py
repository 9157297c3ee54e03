"""Picture of a failure: the signals around it, their events, and the limit that was exceeded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from replays.report.canvas import BLUE, ORANGE, RED, add_legend, axis_label, draw_signals, house_style, new_figure, save

if TYPE_CHECKING:
    from recorder.reader import Recording
    from replays.campaigns.measurement import Measurement

_MAX_PANELS = 4
_HIDDEN_EVENTS = ("command", "end")
"""Events that repeat what other events already show."""


@house_style()
def draw(
    recording: Recording, path: Path, failed: Sequence[Measurement], *, origin_s: float, channels: Sequence[str],
    about_s: float,
) -> None:  # fmt: skip
    """Draw an excerpt of a recording and write it as PNG or SVG.

    Args:
        recording: The excerpt.
        path: Output file.
        failed: Measurements that are outside their limits.
        origin_s: Simulated time at which the test began [s].
        channels: Channels to draw; if empty, the first two recorded channels.
        about_s: Simulated time of the failure [s].
    """
    known = recording.table.channels
    names = [name for name in channels if name in known][:_MAX_PANELS] or list(known)[:2]
    figure = new_figure(1.0 + 1.9 * len(names))
    marks = [e for e in recording.events if e["event"] not in _HIDDEN_EVENTS and e.get("tick") is not None]
    for axes, name in zip(figure.subplots(len(names), squeeze=False)[:, 0], names, strict=True):
        rows = recording.samples(name)
        draw_signals(axes, rows.times_s - origin_s, (rows[name], BLUE, ""))
        axes.axvline(about_s - origin_s, color=RED, lw=1.2, label="failure")
        for event in marks:
            text = event["event"] if event["event"] != "note" else f"note {event.get('text', '')[:20]}"
            time_s = event["tick"] / recording.catalogue["tick_rate_hz"] - origin_s
            axes.axvline(time_s, color=ORANGE, lw=1.0, ls=":", label=text)
        for each in failed:
            if name in each.channels and each.must.unit == known[name].unit:
                limits = each.must.limit if isinstance(each.must.limit, tuple) else (each.must.limit,)
                for limit in limits:
                    axes.axhline(limit, color=RED, lw=0.9, ls="--", label="limit")
        axes.set(xlabel="test time [s]", ylabel=axis_label(name, known[name].unit))
    add_legend(figure)
    save(figure, path)
