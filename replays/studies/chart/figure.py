"""The pictures of a chart, drawn from its table alone."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from replays.report.canvas import BLUE, GREEN, ORANGE, PINK, RED, SKY, new_figure, save
from replays.studies.chart.methods import OURS
from replays.studies.chart.phases import MEMORY_CASES, PHASES, RUB, SMOOTHING
from replays.studies.chart.profile import TARGET, shares

Row = dict[str, Any]

# Strong colours for our engines; peers in quiet tones by family.
_OURS = {
    "split": (RED, "o"),
    "taylor": ("#882255", "h"),
    "rk8": (BLUE, "s"),
    "tsit5": (SKY, "D"),
    "rk4": (GREEN, "^"),
    "rosenbrock": (PINK, "P"),
    "verlet": (ORANGE, "v"),
    "semi-implicit-euler": ("#9a8600", "<"),
}
_FAMILIES = {"heyoka": ("#111111", "*"), "SUNDIALS": ("#6e6e6e", "s"), "scipy": ("#a98a66", "o"),
             "MuJoCo": ("#5b4a8a", "X")}  # fmt: skip
_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.6)), (0, (1.4, 1.2)), (0, (6, 1.5, 1.4, 1.5)), (0, (2.5, 1)), (0, (8, 3)))
_FAILURES = {
    "branch": ("B", "another branch of motion"),
    "nan": ("N", "not finite"),
    "hammer": ("H", "stepped over the hammer"),
    "budget": ("T", "out of time"),
    "error": ("E", "gave up"),
}
_RIGHT, _EDGE = 2.0, 60.0
"""Error at which the strip of failures begins and ends."""
_LEFT = 1e-9
_INK, _QUIET = "#222222", "#777777"


def draw(rows: list[Row], folder: Path, panels: list[str], *, command: str, note: str = "") -> list[Path]:
    """Draw every panel that has points, as PNG and SVG.

    Args:
        rows: The table.
        folder: Where to.
        panels: Panels that are wanted.
        command: The command that makes these pictures, for the caption.
        note: What the reader must know besides, for the caption.

    Returns:
        The files.
    """
    import matplotlib as mpl

    style: Any = {
        "font.size": 11,
        "font.family": "DejaVu Sans",
        "axes.edgecolor": "#888888",
        "axes.labelcolor": _INK,
        "axes.titlesize": 12,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "xtick.color": "#555555",
        "ytick.color": "#555555",
        "svg.fonttype": "none",
    }
    makers: dict[str, tuple[str, Callable[[Any, list[Row]], str]]] = {
        "chart": ("exact", _hero),
        "chart-exact": ("exact", _exact),
        "chart-smoothed": ("smoothed", _smoothed),
        "chart-memory": ("memory", _memory),
        "chart-rub": (RUB, _rub),
        "chart-profile": ("profile", _profile_figure),
        "chart-work": ("exact", _work),
    }
    files: list[Path] = []
    for stem, (panel, make) in makers.items():
        points = [row for row in rows if row["panel"] == panel]
        if panel not in panels or not any(row["family"] != "reference" for row in points):
            continue
        with mpl.rc_context(style):
            figure = new_figure(layout=None)
            said = make(figure, rows)
            _caption(figure, rows, said, command, note)
            files += save(figure, folder / f"{stem}.png", folder / f"{stem}.svg", colours=256)
    return files


def look(row: Row, rows: list[Row]) -> dict[str, Any]:
    """Line and marker of a method: bold in its own colour if ours, thin in its family's if not."""
    if row["family"] == OURS:
        color, marker = _OURS.get(row["method"], ("#333333", "h"))
        main = row["method"] == "split"
        return {"color": color, "marker": marker, "ls": "-", "lw": 3.6 if main else 2.4, "ms": 8.5 if main else 7.0,
                "mec": "white", "mew": 0.9, "zorder": 8 if main else 7}  # fmt: skip
    color, marker = _FAMILIES.get(row["family"], ("#999999", "d"))
    family = list(dict.fromkeys(other["method"] for other in rows if other["family"] == row["family"]))
    dash = _DASHES[family.index(row["method"]) % len(_DASHES)]
    return {"color": color, "marker": marker, "ls": dash, "lw": 1.2, "ms": 8.0 if marker == "*" else 4.5, "mec": color,
            "mew": 0.5, "zorder": 5 if marker == "*" else 4}  # fmt: skip


def window(axes: Any, rows: list[Row], all_rows: list[Row], *, title: str, floors: bool = True) -> None:
    """Speed against error in one window: lines of methods, failures on the strip at the right, the reference's bar.

    Args:
        axes: Where to.
        rows: Points of this window.
        all_rows: The whole table, for looks that stay the same over all panels.
        title: Said above.
        floors: Whether the distances of the smoothed laws are drawn, where there are any.
    """
    points = [row for row in rows if row["family"] != "reference"]
    lines: dict[tuple[str, str], list[Row]] = {}
    for row in points:
        lines.setdefault((row["method"], row["case"]), []).append(row)
    axes.set(xscale="log", yscale="log")
    speeds = [row["speed"] for row in points if row["speed"] and row["error"]] or [1.0, 100.0]
    low, high = 0.45 * min(speeds), 2.2 * max(speeds)
    axes.set(xlim=(_LEFT, _EDGE), ylim=(low, high))
    axes.axvspan(_RIGHT, _EDGE, color="#f4ecec", zorder=0, lw=0)
    axes.grid(True, color="#ececec", lw=0.8, zorder=0)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for (method, case), line in lines.items():
        style = look(line[0], all_rows)
        smoothed = case == "smoothed"
        if smoothed:
            style |= {"ls": (0, (1, 1.4)), "mfc": "white", "mec": style["color"], "lw": 1.6, "ms": 5.5}
        good = [row for row in line if row["error"] and row["failure"] in ("", "contacts")]
        good.sort(key=lambda row: row["tolerance"] or row["step_us"] or 0.0)
        x = np.array([max(row["error"], 1.2 * _LEFT) for row in good])
        y = np.array([row["speed"] for row in good])
        spread = np.array([[row["speed"] - row["speed_min"], row["speed_max"] - row["speed"]] for row in good])
        axes.plot(x, y, gid=f"{method}{'-smoothed' if smoothed else ''}", **style)
        if len(good):
            axes.errorbar(x, y, yerr=spread.T.clip(0.0), fmt="none", ecolor=style["color"], elinewidth=1.0, zorder=3,
                          alpha=0.65)  # fmt: skip
        for row in good:
            if row["failure"] == "contacts":
                axes.plot(max(row["error"], 1.2 * _LEFT), row["speed"], "x", color="#b00020", ms=9, mew=1.6, zorder=9)
    _failures(axes, points, all_rows)
    _reference_bar(axes, rows)
    if floors:
        _floors(axes, rows)
    axes.set_title(title)
    ticks = [10.0**n for n in range(-9, 1)]
    axes.set_xticks(ticks)
    axes.minorticks_off()
    axes.set_xlabel("scaled error against the reference [1]")
    axes.set_ylabel("times real time [s/s]")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")


def _failures(axes: Any, points: list[Row], all_rows: list[Row]) -> None:
    """Every failed point, at its speed, as a letter on the strip."""
    kinds = list(_FAILURES)
    places = np.geomspace(_RIGHT, _EDGE, 2 * len(kinds) + 1)[1::2]
    for row in points:
        if row["failure"] not in _FAILURES:
            continue
        color = look(row, all_rows)["color"]
        # What has got nowhere stands on the frame.
        bottom, top = axes.get_ylim()
        speed = min(max(row["speed"] or 0.0, 1.12 * bottom), top / (top / bottom) ** 0.05)
        axes.text(
            places[kinds.index(row["failure"])], speed, _FAILURES[row["failure"]][0], color=color, ha="center",
            va="center", fontsize=9, fontweight="bold", zorder=9, gid=f"failure-{row['method']}-{row['rung']}",
            clip_on=False,
        )  # fmt: skip
    axes.text(math.sqrt(_RIGHT * _EDGE), 0.992, "failed", transform=axes.get_xaxis_transform(), ha="center", va="top",
              fontsize=9, color="#a06060")  # fmt: skip


def _reference_bar(axes: Any, rows: list[Row]) -> None:
    bars = [row["reference_error"] for row in rows if row["method"] == "reference" and row["reference_error"]]
    if not bars:
        return
    axes.axvspan(_LEFT, max(max(bars), 1.3 * _LEFT), color="#e4ebf2", zorder=0, lw=0)
    axes.text(max(max(bars), 1.3 * _LEFT) * 1.15, 0.012, f"reference's own error {max(bars):.0e}".replace("e-0", "e-"),
              transform=axes.get_xaxis_transform(), fontsize=8, color="#6b7f93", va="bottom")  # fmt: skip


def _floors(axes: Any, rows: list[Row]) -> None:
    for row in rows:
        if row["case"] == "floor" and row["error"] and _LEFT < row["error"] < _RIGHT:
            axes.axvline(row["error"], color="#8a6fae", lw=1.0, ls=(0, (4, 3)), zorder=2)
            axes.text(row["error"], 0.06, f"{row['rung']}", rotation=90, transform=axes.get_xaxis_transform(),
                      fontsize=8.5, color="#6d5490", ha="right", va="bottom")  # fmt: skip


def _better(axes: Any, *, at: tuple[float, float] = (0.055, 0.955)) -> None:
    x, y = at
    axes.annotate(
        "", (x, y), (x + 0.075, y - 0.1), xycoords="axes fraction",
        arrowprops={"arrowstyle": "-|>", "lw": 2.2, "color": "#3a3a3a"},
    )  # fmt: skip
    axes.text(x + 0.085, y - 0.1, "better", transform=axes.transAxes, ha="left", va="center", fontsize=11,
              fontstyle="italic", color="#3a3a3a")  # fmt: skip


def _legend(
    figure: Any, rows: list[Row], panels: tuple[str, ...], place: Any, *, smoothed: bool = False, failures: bool = True
) -> None:
    """Our engines first, then peers by family, then what the marks mean."""
    from matplotlib.lines import Line2D

    entries: list[tuple[Any, Any]] = []
    shown = {row["method"]: row for row in rows if row["panel"] in panels and row["family"] != "reference"}
    order = [OURS, "heyoka", "SUNDIALS", "scipy", "MuJoCo"]
    blank = Line2D([], [], ls="none")
    headings = {OURS: "engines of the rig"}
    for family in [*order, *sorted({row["family"] for row in shown.values()} - set(order))]:
        members = [row for row in shown.values() if row["family"] == family]
        if not members:
            continue
        entries.append((blank, headings.get(family, family)))
        for row in members:
            style = {key: value for key, value in look(row, rows).items() if key != "zorder"}
            entries.append((Line2D([], [], **style), row["title"]))
        if smoothed and family == OURS:
            entries.append((Line2D([], [], color="#56B4E9", ls=(0, (1, 1.4)), marker="D", mfc="white", ms=5.5),
                            f"tsit5, smoothed, {SMOOTHING * 1e3:g} mm/s"))  # fmt: skip
    failed = {row["failure"] for row in rows if row["panel"] in panels}
    if failures and failed & {*_FAILURES, "contacts"}:
        entries.append((blank, "failures"))
        if "contacts" in failed:
            entries.append((Line2D([], [], color="#b00020", ls="none", marker="x", ms=8, mew=1.6),
                            "wrong number of contacts"))  # fmt: skip
        entries += [
            (Line2D([], [], ls="none", marker=f"$\\mathrm{{{letter}}}$", color="#8a4040", ms=8), text)
            for kind, (letter, text) in _FAILURES.items()
            if kind in failed
        ]
    size = 10.0 if len(entries) < 26 else 8.8
    legend = place.legend(
        [entry[0] for entry in entries], [entry[1] for entry in entries], loc="upper left", frameon=False,
        fontsize=size, handlelength=2.9, labelspacing=0.042 * size, borderaxespad=0.0,
    )  # fmt: skip
    for text in legend.get_texts():
        if text.get_text() in {*headings.values(), *order, "failures"}:
            text.set_fontweight("bold")
            text.set_color(_INK)
    place.set_axis_off()


def _caption(figure: Any, rows: list[Row], said: str, command: str, note: str) -> None:
    last = rows[-1]
    machine = " ".join(last["machine"].split())
    text = (
        f"{said} Made by `{command}` ({last['mode']}): one thread on {machine}; {last['versions']}; "
        f"commit {last['commit'] or 'unknown'}, {last['date']}."
    )
    text = f"{text} {note[:1].upper()}{note[1:]}." if note else text
    width, height = figure.get_size_inches()
    figure.text(0.012, 0.12 / height, "\n".join(textwrap.wrap(text, int(width * 12.6))), fontsize=8.5, color=_QUIET,
                va="bottom", linespacing=1.35)  # fmt: skip


_HOW = (
    "Points: median of at least 3 runs (in a quick chart, long runs count alone), bars from least to "
    "greatest, compile time apart; same equations, same corners of the hammer, right-hand sides compiled unless said. "
    "Error: RMS over 1 ms instants of 7 scaled states."
)


def _select(rows: list[Row], panel: str, phase: str, cases: tuple[str, ...] = ()) -> list[Row]:
    kept = [row for row in rows if row["panel"] == panel and row["phase"] == phase]
    return [row for row in kept if row["case"] in cases] if cases else kept


def _phases(rows: list[Row], panel: str) -> list[str]:
    found = {row["phase"] for row in rows if row["panel"] == panel and row["family"] != "reference"}
    return [phase for phase in PHASES if phase in found]


def _hero(figure: Any, rows: list[Row]) -> str:
    figure.set_size_inches(17.0, 9.6)
    phases = _phases(rows, "exact")
    phase = "whirl" if "whirl" in phases else phases[-1]
    chosen = _select(rows, "exact", phase)
    grid = figure.add_gridspec(
        2, 3, left=0.055, right=0.99, top=0.885, bottom=0.165, width_ratios=(1.9, 0.66, 1.02), wspace=0.12, hspace=0.36
    )
    figure.text(0.012, 0.955, "Rotor-stator contact: how fast, and how true", fontsize=19, fontweight="bold",
                color=_INK)  # fmt: skip
    figure.text(0.012, 0.925, f"Hammer to rolling whirl, exact Coulomb friction ({PHASES[phase].title}). Upper left is "
                "better." if phase == "whirl" else PHASES[phase].title, fontsize=12, color=_QUIET)  # fmt: skip
    axes = figure.add_subplot(grid[:, 0])
    window(axes, chosen, rows, title="speed against total error")
    _better(axes)
    _direct_labels(axes, chosen, rows)
    _legend(figure, rows, ("exact",), figure.add_subplot(grid[:, 1]), smoothed=True)
    _energy(figure.add_subplot(grid[0, 2]), chosen, rows)
    lower = figure.add_subplot(grid[1, 2])
    if any(row["panel"] == "profile" for row in rows):
        _profile(lower, rows)
    else:
        _frames(lower, chosen, rows)
    return _HOW


def _exact(figure: Any, rows: list[Row]) -> str:
    return _windows(figure, rows, "exact", "Exact Coulomb friction, phase by phase: total error", smoothed=True)


def _smoothed(figure: Any, rows: list[Row]) -> str:
    title = f"The smoothed law alone, v_s = {SMOOTHING * 1e3:g} mm/s"
    return _windows(figure, rows, "smoothed", title) + (
        " All against the smoothed reference; split takes exact Coulomb only. What smoothing itself costs is on the "
        "exact charts."
    )


def _windows(figure: Any, rows: list[Row], panel: str, title: str, *, smoothed: bool = False) -> str:
    phases = _phases(rows, panel)
    down = 2 if len(phases) > 2 else 1
    across = math.ceil(len(phases) / down)
    width = max(4.4 + 6.1 * across, 12.6)
    height = 2.5 + 4.9 * down + (0.9 if down == 1 else 0.0)
    figure.set_size_inches(width, height)
    bottom = 1.7 if down == 1 else 1.35
    grid = figure.add_gridspec(
        down, across + 1, left=0.85 / width, right=0.995, top=1.0 - 1.0 / height, bottom=bottom / height,
        width_ratios=(*[1.0] * across, 0.56), wspace=0.14, hspace=0.3,
    )  # fmt: skip
    figure.text(0.012, 1.0 - 0.48 / height, title, fontsize=17, fontweight="bold", color=_INK)
    for i, phase in enumerate(phases):
        axes = figure.add_subplot(grid[i // across, i % across])
        window(axes, _select(rows, panel, phase), rows, title=PHASES[phase].title)
        _better(axes)
        if i % across:
            axes.set_ylabel("")
    _legend(figure, rows, (panel,), figure.add_subplot(grid[:, across]), smoothed=smoothed)
    return _HOW


def _memory(figure: Any, rows: list[Row]) -> str:
    phase = _phases(rows, "memory")[0]
    figure.set_size_inches(16.6, 8.0)
    grid = figure.add_gridspec(1, 3, left=0.045, right=0.995, top=0.86, bottom=0.18, width_ratios=(1, 1, 0.52),
                               wspace=0.15)  # fmt: skip
    figure.text(0.012, 0.935, f"Memory of the impact speed ({PHASES[phase].title})", fontsize=17, fontweight="bold",
                color=_INK)  # fmt: skip
    titles = ("Lankarani-Nikravesh: v0 is latched at each onset", "the same without memory (c = 0)")
    for i, case in enumerate(MEMORY_CASES):
        axes = figure.add_subplot(grid[0, i])
        window(axes, _select(rows, "memory", phase, (case,)), rows, title=titles[i])
        _better(axes)
    _legend(figure, rows, ("memory",), figure.add_subplot(grid[0, 2]))
    return _HOW + (
        " Friction is left out here, so that every method runs. 'No events': v0 is latched at a step's end, not where "
        "the contact begins."
    )


def _direct_labels(axes: Any, rows: list[Row], all_rows: list[Row]) -> None:
    """Names beside the true end of each line of ours, and of the best peers, kept apart."""
    ends: list[tuple[float, float, str, str]] = []
    for method in dict.fromkeys(row["method"] for row in rows if row["family"] in (OURS, "heyoka")):
        line = [row for row in rows if row["method"] == method and row["case"] == "" and row["error"]]
        line = [row for row in line if row["failure"] in ("", "contacts")]
        if line:
            end = min(line, key=lambda row: row["error"])
            ends.append((end["error"], end["speed"], method, look(end, all_rows)["color"]))
    taken: list[tuple[float, float]] = []
    scale = axes.transData
    figure = axes.figure
    figure.canvas.draw()
    for error, speed, name, color in sorted(ends, key=lambda end: -end[1]):
        x, y = scale.transform((max(error, 1.2 * _LEFT), speed))
        x -= 13
        while any(abs(x - other_x) < 110 and abs(y - other_y) < 19 for other_x, other_y in taken):
            y -= 4
        taken.append((x, y))
        place = scale.inverted().transform((x, y))
        # At the frame there is room only above the line.
        outside = place[0] < 30 * _LEFT
        axes.text(
            max(error, 1.2 * _LEFT) * (1.3 if outside else 1.0),
            place[1] * (1.1 if outside else 1.0),
            name if outside else f"{name}  ",
            color=color, fontsize=12, fontweight="bold", ha="left" if outside else "right",
            va="bottom" if outside else "center", zorder=10,
        )  # fmt: skip


def _small(axes: Any, title: str) -> None:
    axes.grid(True, color="#ececec", lw=0.8, zorder=0)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.set_title(title)


def _energy(axes: Any, rows: list[Row], all_rows: list[Row]) -> None:
    """Energy residual: an error that needs no reference. Peers keep no ledger."""
    axes.set(xscale="log", yscale="log")
    least = 1.0
    for method in dict.fromkeys(row["method"] for row in rows if row["family"] == OURS):
        line = [row for row in rows if row["method"] == method and row["case"] == "" and row["energy_residual"]]
        if line:
            line.sort(key=lambda row: row["tolerance"] or row["step_us"] or 0.0)
            x = [max(row["energy_residual"], 1e-15) for row in line]
            least = min(least, *x)
            axes.plot(x, [row["speed"] for row in line], **look(line[0], all_rows))
    axes.set_xlim(min(0.3 * least, 1e-4), 0.1)
    axes.axvline(1e-3, color="#b00020", lw=1.0, ls=(0, (4, 3)))
    axes.text(1e-3, 0.02, " alarm", transform=axes.get_xaxis_transform(), color="#b00020", fontsize=8.5, va="bottom")
    axes.set(xlabel="energy residual over energy dissipated [1]", ylabel="times real time [s/s]")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.minorticks_off()
    _small(axes, "energy ledger: needs no reference")


def _frames(axes: Any, rows: list[Row], all_rows: list[Row]) -> None:
    """The worst 1 ms frame against the error."""
    axes.set(xscale="log", yscale="log")
    for method in dict.fromkeys(row["method"] for row in rows if row["family"] == OURS):
        line = [row for row in rows if row["method"] == method and row["case"] == "" and row["worst_frame_ms"]]
        line = [row for row in line if row["error"]]
        if line:
            line.sort(key=lambda row: row["tolerance"] or row["step_us"] or 0.0)
            axes.plot([max(row["error"], 1.2 * _LEFT) for row in line], [row["worst_frame_ms"] * 1e3 for row in line],
                      **look(line[0], all_rows))  # fmt: skip
    slowest = max((row["worst_frame_ms"] or 0.0 for row in rows), default=0.0) * 1e3
    axes.set(xlim=(_LEFT, _RIGHT), ylim=(10.0, max(2.0 * slowest, 2e3)))
    axes.axhline(1e3, color="#b00020", lw=1.0, ls=(0, (4, 3)))
    axes.set(xlabel="scaled error against the reference [1]", ylabel="worst 1 ms frame [us]")
    _small(axes, "worst frame of 1 ms: lower left is better")


def _profile(axes: Any, rows: list[Row]) -> int:
    """Share of scenes solved against the cost ratio to the best; how many scenes count."""
    points = [row for row in rows if row["panel"] == "profile"]
    fair = [row for row in points if row["failure"] != "reference"]
    scenes = len({row["phase"] for row in fair})
    axes.set_xscale("log")
    curves = shares(fair) if fair else {}
    top = max((float(ratios[-1]) for ratios, _ in curves.values() if len(ratios)), default=10.0) * 1.6
    for method, (ratios, share) in curves.items():
        row = next(one for one in fair if one["method"] == method)
        style = {key: value for key, value in look(row, rows).items() if key not in ("marker", "ms", "mec", "mew")}
        x = np.concatenate([[1.0], ratios, [top]]) if len(ratios) else np.array([1.0, top])
        y = np.concatenate([[0.0], share, [share[-1]]]) if len(ratios) else np.zeros(2)
        axes.step(x, 100.0 * y, where="post", gid=f"profile-{method}", clip_on=False, **style)
    axes.set(xlim=(1.0, top), ylim=(0.0, 102.0), xlabel="processor time over that of the best [1]",
             ylabel=f"scenes within {TARGET:g} [%]")  # fmt: skip
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    _small(axes, f"performance profile, {scenes} random scenes")
    return len({row["phase"] for row in points}) - scenes


def _profile_figure(figure: Any, rows: list[Row]) -> str:
    figure.set_size_inches(12.6, 7.2)
    grid = figure.add_gridspec(1, 2, left=0.065, right=0.995, top=0.85, bottom=0.2, width_ratios=(1, 0.4), wspace=0.06)
    figure.text(0.012, 0.93, "Not one hero scene: random blows, speeds, friction and restitution", fontsize=17,
                fontweight="bold", color=_INK)  # fmt: skip
    chaotic = _profile(figure.add_subplot(grid[0, 0]), rows)
    _legend(figure, rows, ("profile",), figure.add_subplot(grid[0, 1]), failures=False)
    aside = f" {chaotic} draws without a sharp reference (chaotic) are left out for all." if chaotic else ""
    return (
        f"Each method walks down its ladder to the first setting that comes within {TARGET:g} of the scene's own "
        f"reference, exact Coulomb, 0.15 s, and is timed there; curves that end below 100 % did not get there.{aside}"
    )


def _work(figure: Any, rows: list[Row]) -> str:
    phases = _phases(rows, "exact")
    phase = "whirl" if "whirl" in phases else phases[-1]
    chosen = _select(rows, "exact", phase)
    figure.set_size_inches(16.6, 7.2)
    grid = figure.add_gridspec(1, 3, left=0.05, right=0.995, top=0.85, bottom=0.2, width_ratios=(1, 1, 0.52),
                               wspace=0.17)  # fmt: skip
    figure.text(0.012, 0.93, f"Work and frames, exact Coulomb friction ({PHASES[phase].title})", fontsize=17,
                fontweight="bold", color=_INK)  # fmt: skip
    axes = figure.add_subplot(grid[0, 0])
    axes.set(xscale="log", yscale="log", xlim=(_LEFT, _RIGHT))
    for method in dict.fromkeys(row["method"] for row in chosen if row["family"] != "reference"):
        line = [row for row in chosen if row["method"] == method and row["case"] == "" and row["error"]]
        line = [row for row in line if row["evaluations"]]
        if line:
            line.sort(key=lambda row: row["tolerance"] or row["step_us"] or 0.0)
            x = [max(row["error"], 1.2 * _LEFT) for row in line]
            axes.plot(x, [row["evaluations"] / row["simulated_s"] for row in line], **look(line[0], rows))
    axes.set(xlabel="scaled error against the reference [1]", ylabel="evaluations a simulated second [1/s]")
    _small(axes, "evaluations of the equations: lower left is better")
    _frames(figure.add_subplot(grid[0, 1]), chosen, rows)
    _legend(figure, rows, ("exact",), figure.add_subplot(grid[0, 2]), failures=False)
    return (
        "Evaluations as each library counts them: split's are its kicks, a Taylor series' its order times its steps. "
        "Worst frame: the longest call of 1 ms, each frame's least of several passes, so that the machine's own pauses "
        "are left out; peers are not stepped frame by frame."
    )


def _rub(figure: Any, rows: list[Row]) -> str:
    points = [row for row in rows if row["panel"] == RUB]
    order = list(dict.fromkeys(row["method"] for row in points))
    points.sort(key=lambda row: (order.index(row["method"]), -(row["tolerance"] or row["step_us"] or 0.0)))
    n = len(points)
    height = 2.9 + 0.34 * n
    figure.set_size_inches(13.5, height)
    grid = figure.add_gridspec(1, 4, left=0.195, right=0.985, top=1.0 - 0.85 / height, bottom=1.55 / height, wspace=0.1)
    figure.text(0.012, 1.0 - 0.5 / height, "Chaotic partial rub: trajectories part, statistics stay", fontsize=17,
                fontweight="bold", color=_INK)  # fmt: skip
    good = [row for row in points if row["rms_force"] is not None]
    # The tightest setting of an unlike code is what the others are held against.
    unlike = [row for row in good if row["family"] != OURS] or good
    tight = min(unlike, key=lambda row: row["tolerance"] or math.inf) if unlike else None
    columns = (("contact_fraction", "share of time in contact [%]", 100.0), ("rms_force", "RMS elastic force [N]", 1.0),
               ("impacts_per_s", "impacts a second [1/s]", 1.0))  # fmt: skip
    y = np.arange(n)[::-1]
    for i, (name, label, scale) in enumerate(columns):
        axes = figure.add_subplot(grid[0, i])
        if tight is not None:
            axes.axvspan(tight[f"{name}_low"] * scale, tight[f"{name}_high"] * scale, color="#e4ebf2", lw=0, zorder=0)
        for place, row in zip(y, points, strict=True):
            style = look(row, rows)
            if row[name] is None:
                axes.text(0.5, place, f"failed: {row['failure']}", transform=axes.get_yaxis_transform(), ha="center",
                          va="center", color="#b00020", fontsize=9)  # fmt: skip
                continue
            bar = np.array([[row[name] - row[f"{name}_low"]], [row[f"{name}_high"] - row[name]]]) * scale
            axes.errorbar(row[name] * scale, place, xerr=bar.clip(0.0), fmt=style["marker"], color=style["color"],
                          ms=style["ms"], elinewidth=0.55 * style["lw"] + 0.5, mec="white", mew=0.6)  # fmt: skip
        _small(axes, "")
        axes.set(xlabel=label, ylim=(-0.7, n - 0.3), yticks=y)
        axes.set_yticklabels([f"{row['title']}, {row['rung']}" for row in points] if i == 0 else [])
        axes.margins(x=0.15)
    axes = figure.add_subplot(grid[0, 3])
    for place, row in zip(y, points, strict=True):
        axes.barh(place, row["speed"] or 0.0, color=look(row, rows)["color"], height=0.55, zorder=2)
        axes.text(
            (row["speed"] or 0.0) * 1.08, place, f"{row['speed'] or 0.0:.3g}", va="center", fontsize=9, color=_INK
        )
    _small(axes, "")
    axes.set(xscale="log", xlabel="times real time [s/s]", ylim=(-0.7, n - 0.3), yticks=y)
    axes.set_yticklabels([])
    axes.set_xlim(right=axes.get_xlim()[1] * 2.5)
    against = f"{tight['title']}, {tight['rung']}" if tight is not None else "none"
    return (
        f"Ring moved sideways by 0.8 mm, unbalance 0.3 mm, 12 Hz, {points[0]['simulated_s']:g} s: two runs that begin "
        f"5e-10 rad apart are wholly apart after 0.4 s. Means with 95 % bootstrap bars over blocks of 0.5 s; "
        f"the band is {against}."
    )
