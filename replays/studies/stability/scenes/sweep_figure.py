"""Picture of the truth sweep: error and speed of every engine over random scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from replays.report.canvas import RED, add_legend, house_style, new_figure, save
from replays.studies.common.engines import traits
from replays.studies.stability.scenes.sweep import summary
from replays.studies.stability.scenes.truth import WRONG_ERROR
from rig.physics.engines import ENGINES

_FLOOR, _CEILING = 1e-10, 10.0
"""Range of errors drawn [1]; values beyond it are drawn at the edge."""
_MIN_SPEED = 1e-3
"""Lowest speed drawn; lower ones are drawn at the edge."""


@house_style()
def draw_sweep(folder: Path, rows: list[dict[str, Any]], engines: list[str]) -> list[Path]:
    """Draw the share of scenes over error and over speed, with a line per engine, as PNG and SVG.

    Args:
        folder: Output folder.
        rows: Measured scenes.
        engines: Engines to draw.

    Returns:
        The files.
    """
    result = summary(rows, engines)
    scenes, main = result["scenes"], next(iter(ENGINES))
    figure = new_figure(
        5.4,
        f"{len(rows)} random scenes: {scenes['decided']} where two accurate engines agree, {scenes['chaotic']} chaotic",
    )
    errors, speeds = figure.subplots(1, 2, sharey=True, width_ratios=(1.25, 1.0))
    errors.axvspan(WRONG_ERROR, _CEILING, color=RED, alpha=0.10, lw=0)
    errors.text(WRONG_ERROR * 1.15, 2.0, "wrong", color="#A04000", fontsize=9.5)
    for engine in engines:
        ran = [(row, one) for row in rows for one in row["tested"] if one["engine"] == engine]
        ran = [(row, one) for row, one in ran if one["failure"] != "refused"]
        # An incomplete run counts as an infinite error.
        wrong = [
            one["error"] or (np.inf if one["failure"] else _FLOOR) for row, one in ran if row["status"] == "decided"
        ]
        silent = len(result["engines"][engine]["silent"])
        main_one = engine == main
        style = {"color": traits(engine).colour, "lw": 3.0 if main_one else 1.6, "zorder": 8 if main_one else 5}
        _shares(errors, wrong, label=f"{engine}: {silent} of {len(wrong)}", **style)
        _shares(speeds, [max(one["speed"] or 0.0, _MIN_SPEED) for _, one in ran], **style)
    distance = [row["distance"] for row in rows if row["status"] == "decided"]
    _shares(errors, distance, color="0.6", lw=5.0, alpha=0.5, zorder=1, label="the two accurate ones, from each other")
    errors.set(
        xscale="log", xlim=(_FLOOR, _CEILING), ylim=(0.0, 102.0), xlabel="scaled error [1]",
        ylabel="scenes with no more [%]",
        title="Error at its own step and tolerance; in the legend:\nwrong without a warning",
    )  # fmt: skip
    speeds.axvline(1.0, color=RED, lw=1.0, ls=(0, (4, 3)))
    speeds.set(
        xscale="log", xlabel="simulated s over processor s [s/s]", title="Speed: the further right the better",
        ylabel="scenes that are no faster [%]",
    )  # fmt: skip
    speeds.tick_params(labelleft=True)
    speeds.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    add_legend(figure, errors, columns=4)
    return save(figure, *(folder / f"stability-sweep{suffix}" for suffix in (".png", ".svg")))


def _shares(axes: Any, values: list[float], **style: Any) -> None:
    """Draw the cumulative share of values as a step function [%]."""
    axes.step(np.sort(values).clip(_FLOOR), 100.0 * np.arange(1, len(values) + 1) / len(values), where="post", **style)
