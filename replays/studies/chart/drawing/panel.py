"""Panels of a chart: speed against error, energy, frames, work, performance profile."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from replays.studies.chart.drawing.style import ALARM, FAILURES, Row, bound_style, point_style
from replays.studies.chart.methods import ADDED_FAMILY, RIG_FAMILY
from replays.studies.chart.profile import TARGET, profile_curves

_STRIP_BEGIN, _STRIP_END = 2.0, 60.0
"""Begin and end of the strip of failures on the error axis."""
_MIN_DRAWN_ERROR = 1e-9
_ERROR_LABEL, _SPEED_LABEL = "scaled error against the reference [1]", "times real time [s/s]"


def _clip_error(error: float) -> float:
    return max(error, 1.2 * _MIN_DRAWN_ERROR)


def _error_position(row: Row) -> float:
    """Return the position of a point on the error axis."""
    return _clip_error(row["error"])


def own_speed(row: Row) -> float | None:
    """Return times real time by a library's own time only, if a Python loop drives it and that time was measured."""
    return row["speed"] * row["cpu_s"] / row["own_cpu_s"] if row["own_cpu_s"] and row["speed"] else None


def _fineness(row: Row) -> float:
    return row["tolerance"] or row["step_us"] or 0.0


def window(axes: Any, rows: list[Row], all_rows: list[Row], *, title: str) -> None:
    """Draw speed against error in one window: lines of methods, failures on the strip, the reference's own error.

    Args:
        axes: Axes to draw on.
        rows: Points of this window.
        all_rows: The whole table, for styles that are equal on all panels.
        title: Title above.
    """
    points = [row for row in rows if row["family"] != "reference"]
    lines: dict[tuple[str, str], list[Row]] = {}
    for row in points:
        lines.setdefault((row["method"], row["case"]), []).append(row)
    axes.set(xscale="log", yscale="log")
    speeds = [own_speed(row) or row["speed"] for row in points if row["speed"] and row["error"]]
    speeds += [row["speed"] for row in points if row["speed"] and row["error"]] or [1.0, 100.0]
    low, high = 0.45 * min(speeds), 2.2 * max(speeds)
    axes.set(xlim=(_MIN_DRAWN_ERROR, _STRIP_END), ylim=(low, high))
    axes.axvspan(_STRIP_BEGIN, _STRIP_END, color="#f4ecec", zorder=0, lw=0)
    for (method, case), line in lines.items():
        style = point_style(line[0], all_rows)
        smoothed = case == "smoothed"
        if smoothed:
            style |= {"ls": (0, (1, 1.4)), "mfc": "white", "mec": style["color"], "lw": 1.6, "ms": 5.5}
        good = [row for row in line if row["error"] and row["failure"] in ("", "contacts")]
        good.sort(key=_fineness)
        x = np.array([_error_position(row) for row in good])
        y = np.array([row["speed"] for row in good])
        spread = np.array([[row["speed"] - row["speed_min"], row["speed_max"] - row["speed"]] for row in good])
        axes.plot(x, y, gid=f"{method}{'-smoothed' if smoothed else ''}", **style)
        if len(good):
            axes.errorbar(x, y, yerr=spread.T.clip(0.0), fmt="none", ecolor=style["color"], elinewidth=1.0, zorder=3,
                          alpha=0.65)  # fmt: skip
        bounds = [(_error_position(row), speed) for row in good if (speed := own_speed(row)) is not None]
        if bounds:
            axes.plot(*zip(*bounds, strict=True), gid=f"{method}-bound", **bound_style(line[0], all_rows))
        for row in good:
            if row["failure"] == "contacts":
                axes.plot(_error_position(row), row["speed"], "x", color=ALARM, ms=9, mew=1.6, zorder=9)
    _failures(axes, points, all_rows)
    _reference_bar(axes, rows)
    _limits(axes, rows)
    axes.set_title(title)
    axes.set_xticks([10.0**n for n in range(-8, 1, 2)])
    axes.minorticks_off()
    axes.set(xlabel=_ERROR_LABEL, ylabel=_SPEED_LABEL)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")


def _failures(axes: Any, points: list[Row], all_rows: list[Row]) -> None:
    """Draw every failed point as a letter on the strip, at its speed."""
    kinds = list(FAILURES)
    places = np.geomspace(_STRIP_BEGIN, _STRIP_END, 2 * len(kinds) + 1)[1::2]
    for row in points:
        if row["failure"] not in FAILURES:
            continue
        color = point_style(row, all_rows)["color"]
        # Points without progress are drawn at the frame.
        bottom, top = axes.get_ylim()
        speed = min(max(row["speed"] or 0.0, 1.12 * bottom), top / (top / bottom) ** 0.05)
        axes.text(
            places[kinds.index(row["failure"])], speed, FAILURES[row["failure"]][0], color=color, ha="center",
            va="center", fontsize=9, fontweight="bold", zorder=9, gid=f"failure-{row['method']}-{row['rung']}",
            clip_on=False,
        )  # fmt: skip
    axes.text(math.sqrt(_STRIP_BEGIN * _STRIP_END), 1.0, "failed", transform=axes.get_xaxis_transform(), ha="center",
              va="bottom", fontsize=9, color="#a06060")  # fmt: skip


def _reference_bar(axes: Any, rows: list[Row]) -> None:
    bars = [row["reference_error"] for row in rows if row["method"] == "reference" and row["reference_error"]]
    if not bars:
        return
    axes.axvspan(_MIN_DRAWN_ERROR, max(max(bars), 1.3 * _MIN_DRAWN_ERROR), color="#e4ebf2", zorder=0, lw=0)
    axes.text(max(max(bars), 1.3 * _MIN_DRAWN_ERROR) * 1.15, 0.012, f"reference ±{max(bars):.0e}".replace("e-0", "e-"),
              transform=axes.get_xaxis_transform(), fontsize=9, color="#56687a", va="bottom")  # fmt: skip


def _limits(axes: Any, rows: list[Row]) -> None:
    """Draw the distances of the smoothed laws from the exact one, where measured."""
    for row in rows:
        if row["case"] == "floor" and row["error"] and _MIN_DRAWN_ERROR < row["error"] < _STRIP_BEGIN:
            axes.axvline(row["error"], color="#8a6fae", lw=1.0, ls=(0, (4, 3)), zorder=2)
            label = row["rung"].replace("v_s", "vₛ")
            axes.text(row["error"], 0.06, label, rotation=90, transform=axes.get_xaxis_transform(), fontsize=9,
                      color="#6d5490", ha="right", va="bottom")  # fmt: skip


def mark_better(axes: Any) -> None:
    """Draw an arrow to the upper left."""
    x, y = 0.045, 0.97
    axes.annotate(
        "", (x, y), (x + 0.06, y - 0.07), xycoords="axes fraction",
        arrowprops={"arrowstyle": "-|>", "lw": 2.2, "color": "#3a3a3a"},
    )  # fmt: skip
    axes.text(x + 0.07, y - 0.07, "better", transform=axes.transAxes, ha="left", va="center", fontsize=10,
              fontstyle="italic", color="#3a3a3a")  # fmt: skip


def label_lines(axes: Any, rows: list[Row], all_rows: list[Row]) -> None:
    """Label the accurate end of each line of our engines and of the best peers, without overlaps."""
    ends: list[tuple[float, float, str, str]] = []
    for method in dict.fromkeys(row["method"] for row in rows if row["family"] in (RIG_FAMILY, ADDED_FAMILY, "heyoka")):
        line = [row for row in rows if row["method"] == method and row["case"] == "" and row["error"]]
        line = [row for row in line if row["failure"] in ("", "contacts")]
        if line:
            end = min(line, key=lambda row: row["error"])
            ends.append((end["error"], end["speed"], method, point_style(end, all_rows)["color"]))
    occupied: list[tuple[float, float]] = []
    scale = axes.transData
    figure = axes.figure
    figure.canvas.draw()
    for error, speed, name, color in sorted(ends, key=lambda end: -end[1]):
        x, y = scale.transform((_clip_error(error), speed))
        x -= 13
        while any(abs(x - other_x) < 110 and abs(y - other_y) < 19 for other_x, other_y in occupied):
            y -= 4
        occupied.append((x, y))
        place = scale.inverted().transform((x, y))
        # At the frame there is room only above the line.
        outside = place[0] < 30 * _MIN_DRAWN_ERROR
        axes.text(
            _clip_error(error) * (1.3 if outside else 1.0),
            place[1] * (1.1 if outside else 1.0),
            name if outside else f"{name}  ",
            color=color, fontsize=11, fontweight="bold", ha="left" if outside else "right",
            va="bottom" if outside else "center", zorder=10,
        )  # fmt: skip


def _lines(rows: list[Row], *needed: str, ours: bool) -> Iterator[list[Row]]:
    """Yield the points of each method on the panel's own law, by setting, without those that lack a needed column."""
    taking_part = [row for row in rows if row["family"] == RIG_FAMILY or (not ours and row["family"] != "reference")]
    for method in dict.fromkeys(row["method"] for row in taking_part):
        line = [row for row in taking_part if row["method"] == method and row["case"] == ""]
        line = sorted((row for row in line if all(row[name] for name in needed)), key=_fineness)
        if line:
            yield line


def draw_energy(axes: Any, rows: list[Row], all_rows: list[Row]) -> None:
    """Draw the energy residual, an error that needs no reference; peers have none."""
    axes.set(xscale="log", yscale="log")
    least = 1.0
    for line in _lines(rows, "energy_residual", ours=True):
        x = [max(row["energy_residual"], 1e-15) for row in line]
        least = min(least, *x)
        axes.plot(x, [row["speed"] for row in line], **point_style(line[0], all_rows))
    axes.set_xlim(min(0.3 * least, 1e-4), 0.1)
    axes.axvline(1e-3, color=ALARM, lw=1.0, ls=(0, (4, 3)))
    axes.text(1e-3, 0.02, " alarm", transform=axes.get_xaxis_transform(), color=ALARM, fontsize=9, va="bottom")
    axes.set(xlabel="energy residual over energy dissipated [1]", ylabel=_SPEED_LABEL)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.minorticks_off()
    axes.set_title("Energy ledger: needs no reference")


def draw_frames(axes: Any, rows: list[Row], all_rows: list[Row]) -> None:
    """Draw the worst 1 ms frame against the error."""
    axes.set(xscale="log", yscale="log")
    for line in _lines(rows, "worst_frame_ms", "error", ours=True):
        walls_us = [row["worst_frame_ms"] * 1e3 for row in line]
        axes.plot([_error_position(row) for row in line], walls_us, **point_style(line[0], all_rows))
    slowest = max((row["worst_frame_ms"] or 0.0 for row in rows), default=0.0) * 1e3
    axes.set(xlim=(_MIN_DRAWN_ERROR, _STRIP_BEGIN), ylim=(10.0, max(2.0 * slowest, 2e3)))
    axes.axhline(1e3, color=ALARM, lw=1.0, ls=(0, (4, 3)))
    axes.set(xlabel=_ERROR_LABEL, ylabel="worst 1 ms frame [µs]")
    axes.set_title("Worst frame of 1 ms:\nlower left is better")


def draw_work(axes: Any, rows: list[Row], all_rows: list[Row]) -> None:
    """Draw evaluations of the equations against the error."""
    axes.set(xscale="log", yscale="log", xlim=(_MIN_DRAWN_ERROR, _STRIP_BEGIN))
    for line in _lines(rows, "error", "evaluations", ours=False):
        evaluations = [row["evaluations"] / row["simulated_s"] for row in line]
        axes.plot([_error_position(row) for row in line], evaluations, **point_style(line[0], all_rows))
    axes.set(xlabel=_ERROR_LABEL, ylabel="evaluations a simulated second [1/s]")
    axes.set_title("Evaluations of the equations:\nlower left is better")


def draw_profile(axes: Any, rows: list[Row]) -> int:
    """Draw the share of solved scenes against the relative cost; return the number of excluded scenes."""
    points = [row for row in rows if row["panel"] == "profile"]
    fair = [row for row in points if row["failure"] != "reference"]
    scenes = len({row["phase"] for row in fair})
    axes.set_xscale("log")
    curves = profile_curves(fair) if fair else {}
    top = max((float(ratios[-1]) for ratios, _ in curves.values() if len(ratios)), default=10.0) * 1.6
    for method, (ratios, share) in curves.items():
        row = next(one for one in fair if one["method"] == method)
        style = {key: v for key, v in point_style(row, rows).items() if key not in ("marker", "ms", "mec", "mew")}
        x = np.concatenate([[1.0], ratios, [top]]) if len(ratios) else np.array([1.0, top])
        y = np.concatenate([[0.0], share, [share[-1]]]) if len(ratios) else np.zeros(2)
        axes.step(x, 100.0 * y, where="post", gid=f"profile-{method}", clip_on=False, **style)
    for method, (ratios, share) in (profile_curves(fair, column="own_cpu_s") if fair else {}).items():
        row = next(one for one in fair if one["method"] == method)
        style = bound_style(row, rows)
        # A bound below the best cost is drawn at that cost.
        x = np.concatenate([[1.0], ratios.clip(1.0), [top]])
        y = np.concatenate([[0.0], share, [share[-1] if len(share) else 0.0]])
        axes.step(x, 100.0 * y, where="post", gid=f"profile-{method}-bound", color=style["color"], ls=style["ls"],
                  lw=style["lw"], zorder=style["zorder"])  # fmt: skip
    axes.set(xlim=(1.0, top), ylim=(0.0, 102.0), xlabel="processor time over that of the best [1]",
             ylabel=f"scenes within {TARGET:g} [%]")  # fmt: skip
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_title(f"Performance profile, {scenes} random scenes")
    return len({row["phase"] for row in points}) - scenes
