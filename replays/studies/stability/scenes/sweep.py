"""Truth sweep: random scenes by number, each measured once and stored, and a summary for every engine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from replays.studies.common.journal import Journal
from replays.studies.common.provenance import commit, machine
from replays.studies.common.random_scene import draw_scene
from replays.studies.stability.scenes.truth import CHAOS_GROWTH, WRONG_ERROR, measure
from replays.studies.stability.scenes.worker import SceneRun, Task, Worker
from rig.base.errors import InputError
from rig.physics.kernels import source_digest

Row = dict[str, Any]
QUANTILES = (0.10, 0.25, 0.50, 0.75, 0.90, 0.95)
NAME = "sweep.jsonl"
_TOLERANCE_MARGIN = 10.0
"""Factor on the requested error up to which an error counts as kept."""
_LIMIT_S = 20.0
"""Processor time per run [s]."""


def select_numbers(only: str | None, count: int) -> list[int]:
    """Return the numbers of a comma-separated list; None selects all from 0.

    Raises:
        InputError: If the list contains anything but whole numbers from 0.
    """
    if only is None:
        return list(range(count))
    parts = [part.strip() for part in only.split(",")]
    if not all(part.isdecimal() for part in parts):
        raise InputError("--only", "numbers of scenes joined by commas", only)
    return [int(part) for part in parts]


def sweep(
    numbers: list[int],
    *,
    seed: int,
    engines: list[str],
    folder: Path | None = None,
    run: Callable[[Task], SceneRun] | None = None,
) -> Iterator[Row]:
    """Yield the measured scenes, those in the folder's journal first.

    Args:
        numbers: Numbers of the scenes.
        seed: Seed of the scenes.
        engines: Engines under test.
        folder: Folder of the journal; None for no journal.
        run: Function that executes a run; None uses a separate process.

    Raises:
        InputError: If the folder cannot be written.
    """
    code = source_digest()
    journal = None if folder is None else Journal(folder, NAME, code)
    wanted, kept = set(numbers), {}
    for row in journal.rows if journal else []:
        if row["seed"] == seed and row["number"] in wanted and {one["engine"] for one in row["tested"]} >= set(engines):
            kept[row["number"]] = row
    yield from kept.values()
    missing = [number for number in numbers if number not in kept]
    if not missing:
        return
    stamp = {"code": code, "commit": commit(), "machine": machine()}
    with Worker() as worker:
        for number in missing:
            measured = measure(draw_scene(seed, number), engines, run or worker.run, limit_s=_LIMIT_S)
            row = {"seed": seed, "number": number, **measured, **stamp}
            if journal is not None:
                journal.add(row)
            yield row


def summary(rows: list[Row], engines: list[str]) -> Row:
    """Return a summary of the scenes.

    Returns:
        `scenes`: number of each status; `undecided`: scenes on which accurate runs differ without being chaotic;
        `distance` of the accurate runs; `engines`: a summary of each, with the accurate ones as "NAME (accurate)".
    """
    statuses = [row["status"] for row in rows]
    by_name = {name: [(row, one) for row in rows for one in row["tested"] if one["engine"] == name] for name in engines}
    for name in dict.fromkeys(one["engine"] for row in rows for one in row["accurate"]):
        by_name[f"{name} (accurate)"] = [(row, one) for row in rows for one in row["accurate"] if one["engine"] == name]
    return {
        "scenes": {
            status: statuses.count(status) for status in ("decided", "chaotic", "undecided", "untold", "unbounded")
        },
        "undecided": [
            {name: row[name] for name in ("number", "distance", "odd", "growth", "growth_per_s")}
            for row in rows
            if row["status"] == "undecided"
        ],
        "distance": _quantiles([row["distance"] for row in rows if row["status"] == "decided"]),
        "engines": {name: _engine(runs) for name, runs in by_name.items()},
    }


def is_silent(one: Row) -> bool:
    """Return whether a run is wrong without a warning."""
    return one["error"] is not None and one["error"] > WRONG_ERROR and not one["doubted"]


def false_alarm(one: Row) -> bool:
    """Return whether a run warns although it has kept the requested error."""
    return bool(one["error"] is not None and one["doubted"] and one["error"] < _TOLERANCE_MARGIN * one["asked"])


def _engine(runs: list[tuple[Row, Row]]) -> Row:
    """Return the summary of one engine over all scenes; lists contain numbers of scenes."""

    def scenes(kind: Callable[[Row], bool]) -> list[int]:
        return [row["number"] for row, one in runs if kind(one) and row["status"] != "unbounded"]

    ran = [(row, one) for row, one in runs if one["failure"] != "refused"]
    compared = [(row, one) for row, one in ran if one["error"] is not None]
    calm = [one for row, one in compared if not (row["growth"] and row["growth"] >= CHAOS_GROWTH)]
    speeds = [one["speed"] for _, one in ran if one["speed"]]
    refused: dict[str, int] = {}
    for _, one in runs:
        if one["failure"] == "refused":
            refused[one["message"]] = refused.get(one["message"], 0) + 1
    return {
        "runs": len(ran),
        "compared": len(compared),
        "asked": max((one["asked"] for _, one in runs), default=None),
        "error": _quantiles([one["error"] for _, one in compared]),
        "calm": len(calm),
        "within": sum(one["error"] <= _TOLERANCE_MARGIN * one["asked"] for one in calm) / len(calm) if calm else None,
        "wrong": scenes(lambda one: one["error"] is not None and one["error"] > WRONG_ERROR),
        "silent": scenes(is_silent),
        "false_alarms": scenes(false_alarm),
        "crashes": scenes(lambda one: one["failure"] == "crash"),
        "hangs": scenes(lambda one: one["failure"] == "hang"),
        "absurd": scenes(lambda one: bool(one["absurd"])),
        "slowest": min(speeds, default=None),
        "slowest_scene": min(((one["speed"], row["number"]) for row, one in ran if one["speed"]), default=(None, None))[
            1
        ],
        "median_speed": float(np.median(speeds)) if speeds else None,
        "refused": refused,
    }


def _quantiles(values: list[float]) -> list[float] | None:
    return [float(value) for value in np.quantile(values, QUANTILES)] if values else None
