"""Line styles of the methods on all charts, and their legend."""

from __future__ import annotations

from typing import Any

from replays.studies.chart.methods import ADDED_FAMILY, RIG_FAMILY
from replays.studies.chart.phases import SMOOTHING
from replays.studies.common.engines import traits
from rig.physics.engines import ENGINES

Row = dict[str, Any]

# Peers have muted colours by family, so that our engines stand out.
_FAMILIES = {"heyoka": ("#111111", "*"), "SUNDIALS": ("#6e6e6e", "s"), "scipy": ("#a98a66", "o"),
             "MuJoCo": ("#a08cc0", "X"), ADDED_FAMILY: ("#7a8500", "P")}  # fmt: skip
_ADDED_COLOURS = ("#7a8500", "#00796b", "#c2185b", "#5d4037", "#3949ab")
"""Colours of added solvers, in turn."""
_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.6)), (0, (1.4, 1.2)), (0, (6, 1.5, 1.4, 1.5)), (0, (2.5, 1)), (0, (8, 3)),
                            (0, (1, 3)), (0, (9, 2, 3, 2)))  # fmt: skip
FAILURES = {
    "branch": ("B", "another branch of motion"),
    "nan": ("N", "not finite"),
    "hammer": ("H", "stepped over the hammer"),
    "budget": ("T", "out of time"),
    "error": ("E", "gave up"),
}
"""Letter and description by kind of failure."""
INK, QUIET, ALARM = "#222222", "#777777", "#b00020"


def point_style(row: Row, rows: list[Row]) -> dict[str, Any]:
    """Return the style of a method: bold in its own colour for our engines, thin in the family's colour for peers."""
    if row["family"] == RIG_FAMILY:
        own, main = traits(row["method"]), row["method"] == next(iter(ENGINES))
        width, size, order = (3.0, 7.5, 8) if main else (1.9, 6.0, 7)
        return {"color": own.colour, "marker": own.marker, "ls": "-", "lw": width, "ms": size, "mec": "white",
                "mew": 0.9, "zorder": order}  # fmt: skip
    color, marker = _FAMILIES.get(row["family"], ("#999999", "d"))
    family = list(dict.fromkeys(other["method"] for other in rows if other["family"] == row["family"]))
    dash = _DASHES[family.index(row["method"]) % len(_DASHES)]
    if row["family"] == ADDED_FAMILY:
        color = _ADDED_COLOURS[family.index(row["method"]) % len(_ADDED_COLOURS)]
    strong = row["family"] in ("heyoka", ADDED_FAMILY)
    return {"color": color, "marker": marker, "ls": dash, "lw": 1.0, "ms": 7.5 if strong else 4.0, "mec": color,
            "mew": 0.5, "zorder": 5 if strong else 4}  # fmt: skip


def bound_style(row: Row, rows: list[Row]) -> dict[str, Any]:
    """Return line and marker of a library's bound, without the time of the Python loop that drives it."""
    style = point_style(row, rows)
    return style | {"ls": (0, (1, 1.4)), "lw": 0.9, "mfc": "white", "mew": 0.8}


def draw_legend(
    figure: Any,
    rows: list[Row],
    panels: tuple[str, ...],
    place: Any,
    *,
    smoothed: bool = False,
    failures: bool = True,
    bounds: bool = True,
    drawn: list[Row] | None = None,
) -> None:
    """Draw the legend: our engines, then peers by family, then the marks.

    Args:
        figure: Figure.
        rows: The whole table, for styles that are equal on all panels.
        panels: Panels of the picture.
        place: Axes of the legend.
        smoothed: Add the smoothed law.
        failures: Add the kinds of failure.
        bounds: Add the bounds of libraries.
        drawn: Points of the picture; None for all of its panels.
    """
    from matplotlib.lines import Line2D

    entries: list[tuple[Any, Any]] = []
    inside = [row for row in rows if row["panel"] in panels] if drawn is None else drawn
    shown = {row["method"]: row for row in inside if row["family"] != "reference"}
    order = [RIG_FAMILY, ADDED_FAMILY, "heyoka", "SUNDIALS", "scipy", "MuJoCo"]
    blank = Line2D([], [], ls="none")
    headings = {RIG_FAMILY: "engines of the rig"}
    for family in [*order, *sorted({row["family"] for row in shown.values()} - set(order))]:
        members = [row for row in shown.values() if row["family"] == family]
        if not members:
            continue
        entries.append((blank, headings.get(family, family)))
        for row in members:
            style = {key: value for key, value in point_style(row, rows).items() if key != "zorder"}
            entries.append((Line2D([], [], **style), row["title"]))
            points = [one for one in rows if one["panel"] in panels and one["method"] == row["method"]]
            if bounds and any(one["own_cpu_s"] for one in points):
                style = {key: value for key, value in bound_style(row, rows).items() if key != "zorder"}
                entries.append((Line2D([], [], **style), f"{row['method']} alone: a bound"))
        if smoothed and family == RIG_FAMILY:
            color, dash = traits("tsit5").colour, (0, (1, 1.4))
            handle = Line2D([], [], color=color, ls=dash, marker=traits("tsit5").marker, mfc="white", ms=5.5)
            entries.append((handle, f"tsit5, smoothed, {SMOOTHING * 1e3:g} mm/s"))
    failed = {row["failure"] for row in rows if row["panel"] in panels}
    if failures and failed & {*FAILURES, "contacts"}:
        entries.append((blank, "failures"))
        if "contacts" in failed:
            entries.append((Line2D([], [], color="#b00020", ls="none", marker="x", ms=8, mew=1.6),
                            "wrong number of contacts"))  # fmt: skip
        entries += [
            (Line2D([], [], ls="none", marker=f"$\\mathrm{{{letter}}}$", color="#8a4040", ms=8), text)
            for kind, (letter, text) in FAILURES.items()
            if kind in failed
        ]
    legend = place.legend(
        [entry[0] for entry in entries], [entry[1] for entry in entries], loc="upper left", fontsize=9,
        handlelength=2.2, labelspacing=0.35, borderaxespad=0.0, bbox_to_anchor=(-0.15, 1.0),
    )  # fmt: skip
    for text in legend.get_texts():
        if text.get_text() in {*headings.values(), *order, "failures"}:
            text.set_fontweight("bold")
            text.set_color(INK)
    place.set_axis_off()
