"""Picture of the twelve scenes: speeds at a target error, and the default engine against the best peer."""

from __future__ import annotations

import math
import statistics
import textwrap
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from replays.studies.chart.drawing.panel import own_speed
from replays.studies.chart.drawing.style import ALARM, INK, QUIET, Row, point_style
from replays.studies.chart.methods import RIG_FAMILY
from replays.studies.common.twelve_scenes import TWELVE_SCENES
from replays.studies.peers import PEERS
from rig.physics.engines import ENGINES

_PEER_MARKERS = dict(
    zip([name for name in reversed(PEERS) if not PEERS[name].known_failure], "*21Xp>3x+|4_8Hd", strict=False)
)
"""Marker shapes that no engine of the rig uses; filled for heyoka and CVODE."""
_STRIP = 0.35
"""Width of the strip of methods without a speed, relative to the range of speeds."""
_SLOTS = 12
"""Methods for which the strip has room before its markers move closer."""
_MAIN = next(iter(ENGINES))
"""The default engine."""


class Ratio(NamedTuple):
    """Speed of the default engine in a scene relative to the best peer."""

    best: float
    """Infinite if no peer reached the target, 0 if the engine did not."""
    library: float
    """The same for the peers' time within their own libraries, where measured."""


def compare(rows: list[Row], case: str) -> dict[str, Ratio]:
    """Return the default engine's ratios by scene, without scenes that lack a reference, the engine or all peers.

    Args:
        rows: Points of the twelve scenes.
        case: Target.
    """
    ratios: dict[str, Ratio] = {}
    for scene in TWELVE_SCENES:
        points = [row for row in rows if row["phase"] == scene and row["case"] == case]
        ours = next((row for row in points if row["method"] == _MAIN), None)
        peers = [row for row in points if row["family"] != RIG_FAMILY]
        if ours is None or ours["failure"] == "reference" or not peers:
            continue
        reached = [row for row in peers if not row["failure"]]
        speed = 0.0 if ours["failure"] else ours["speed"]
        best = max((row["speed"] for row in reached), default=0.0)
        library = max((own_speed(row) or row["speed"] for row in reached), default=0.0)
        ratios[scene] = Ratio(*(speed / other if other else math.inf for other in (best, library)))
    return ratios


def _style(row: Row, rows: list[Row]) -> dict[str, Any]:
    """Return the unique marker of a method."""
    style = {name: value for name, value in point_style(row, rows).items() if name in ("color", "marker", "zorder")}
    style["marker"] = _PEER_MARKERS.get(row["method"], style["marker"])
    main = row["method"] == _MAIN
    return style | {"ls": "none", "ms": 10.0 if main else 6.0, "mec": INK if main else style["color"], "mew": 1.3}


def draw_scenes(axes: Any, rows: list[Row], case: str) -> None:
    """Draw a row per scene: methods by speed, those without a speed on the left, the ratios on the right.

    Args:
        axes: Axes to draw on.
        rows: Points of the twelve scenes.
        case: Target.
    """
    points = [row for row in rows if row["case"] == case]
    scenes = [scene for scene in TWELVE_SCENES if any(row["phase"] == scene for row in points)]
    speeds = [speed for row in points if not row["failure"] for speed in (row["speed"], own_speed(row)) if speed]
    low, high = 0.6 * min(speeds, default=1.0), 1.6 * max(speeds, default=100.0)
    left = low * (low / high) ** _STRIP
    axes.set(xscale="log", xlim=(left, high), ylim=(len(scenes) - 0.4, -0.6), xlabel="times real time [s/s]")
    axes.axvspan(left, low, color="#f4ecec", zorder=0, lw=0)
    for place, scene in enumerate(scenes):
        here = [row for row in points if row["phase"] == scene]
        failed = [row for row in here if row["failure"] not in ("", "reference")]
        if any(row["failure"] == "reference" for row in here):
            axes.text(low, place, "  no reference sharp enough", va="center", fontsize=9, color=QUIET)
        slots = np.geomspace(left, low, max(len(failed), _SLOTS) + 2)[1:]
        for slot, row in zip(slots, failed, strict=False):
            color = QUIET if row["failure"] == "law" else ALARM
            style = _style(row, rows) | {"color": color, "mec": color, "ms": 5.0, "mew": 0.9}
            axes.plot(slot, place, gid=f"failure-{row['method']}-{scene}", **style)
        for row in (row for row in here if not row["failure"]):
            if bound := own_speed(row):
                axes.plot(bound, place, **_style(row, rows) | {"mfc": "white", "mew": 0.8})
            axes.plot(row["speed"], place, gid=f"{row['method']}-{scene}", **_style(row, rows))
    axes.set_yticks(range(len(scenes)), [textwrap.fill(TWELVE_SCENES[scene].title, 22) for scene in scenes])
    axes.set_xticks([tick for tick in 10.0 ** np.arange(-4, 8) if low <= tick <= high])
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.minorticks_off()
    ratios = compare(points, case)
    title = f"Error below {case}"
    if ratios:
        best, library = (statistics.median(values) for values in zip(*ratios.values(), strict=True))
        below = sum(ratio.best < 1.0 for ratio in ratios.values())
        title += f": {_MAIN} at {best:.2g} times the speed of the best peer (median),\n"
        title += f"{library:.2g} times by its library's own time; slower in {below} of {len(ratios)} scenes"
        ratio_text = partial(axes.text, 1.02, transform=axes.get_yaxis_transform(), fontsize=9)
        ratio_text(-0.7, f"{_MAIN} / best peer\n(library alone)", va="bottom")
        for scene, (best, library) in ratios.items():
            text = f"{best:.2g}  ({library:.2g})" if math.isfinite(best) else "no peer"
            slower = {"color": ALARM, "fontweight": "bold"} if best < 1.0 else {}
            ratio_text(scenes.index(scene), text, va="center", **slower)
    axes.set_title(title, pad=30.0)


def draw_markers(place: Any, rows: list[Row]) -> None:
    """Draw the legend: the markers of the methods, then the marks of methods without a speed."""
    from matplotlib.lines import Line2D

    entries = []
    for row in {row["method"]: row for row in rows}.values():
        entries.append((Line2D([], [], **_style(row, rows)), row["method"].replace("-python", "\n(plain Python)")))
        if any(one["own_cpu_s"] for one in rows if one["method"] == row["method"]):
            entries.append((Line2D([], [], **_style(row, rows) | {"mfc": "white"}), f"{row['method']} alone"))
    for color, text in ((QUIET, "cannot run the\nfriction law"), (ALARM, "failed, or error\nabove the target")):
        entries.append((Line2D([], [], color=color, ls="none", marker="s", ms=6), text))
    place.legend(*zip(*entries, strict=True), loc="upper left", fontsize=9, labelspacing=0.5, borderaxespad=0.0)
    place.set_axis_off()
