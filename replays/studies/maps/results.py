"""Results of a map: a folder with its plan, the evaluated points, a check by random runs, and a summary."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from concurrent.futures import CancelledError
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np

from replays.studies.maps.lattice import UNKNOWN, Lattice
from replays.studies.maps.plan import MapWork, Side
from rig.base.checks import read_json
from rig.base.errors import InputError, Words
from rig.base.files import PART_SUFFIX, Closing, lock_folder, read_file, whole_file, write_file
from rig.ensemble.batch import QUANTITIES, Batch
from rig.ensemble.ensemble import Workers, iterate_results
from rig.ensemble.keys import vary
from rig.ensemble.plan import find_difference
from rig.run.scenes import Scene

PLAN, POINTS, CHECK, SUMMARY = "plan.json", "points.parquet", "check.parquet", "summary.json"
_MAX_BYTES = 1 << 24
_PART_RUNS = 256
_PLACES = ("panel", "row", "column")
Table = dict[str, np.ndarray]
Simulate = Callable[[np.ndarray], Table]
"""Function of values, shape (n, keys), that returns the quantities of the runs."""


def simulate_points(batch: Batch, workers: Workers, step: Callable[[int], None], values: np.ndarray) -> Table:
    """Return the quantities of runs, in parts on threads.

    Args:
        batch: The batch.
        workers: Threads.
        step: Called with the number of finished runs.
        values: Values of the keys, shape (n, keys).
    """
    parts: dict[int, Table] = {}
    begins = range(0, len(values), _PART_RUNS)
    for begin, part in iterate_results(workers, begins, partial(_run_part, batch, values)):
        parts[begin] = part
        step(len(part["outcome"]))
    return {name: np.concatenate([parts[begin][name] for begin in begins]) for name in QUANTITIES}


def _run_part(batch: Batch, values: np.ndarray, begin: int, stop: Event) -> Table:
    if stop.is_set():
        raise CancelledError
    return batch.run(values[begin : begin + _PART_RUNS])


class Map(Closing):
    """A map in a folder, locked until `close`.

    Attributes:
        work: The plan.
        folder: The folder.
        lattice: Classes of the evaluated points.
        points: Table of the evaluated points; the first columns are panel, row and column of the lattice.
        resumed: Number of points that were found in the folder.
        check: Table of the random runs.
    """

    def __init__(self, work: MapWork, folder: Path) -> None:
        """Create the folder, or continue one with the same plan.

        Raises:
            InputError: The folder has another plan, or other files, or is in use.
            DiskError: It cannot be written.
        """
        self._lock = lock_folder(folder, "map")
        self.work, self.folder = work, folder
        try:
            if not (folder / PLAN).exists():
                if any(folder.iterdir()):
                    raise InputError("--output", "a new or empty folder, or one of a map", str(folder))
                write_file(folder / PLAN, work.text, sync=True)
            elif difference := find_difference(read_map_text(folder), work.text):
                raise InputError("--output", f"a folder with the same plan and versions in {PLAN}", Words(difference))
        except InputError:
            self.close()
            raise
        for draft in folder.glob(f"*{PART_SUFFIX}"):
            draft.unlink()
        self.points, self.check = _read_table(folder / POINTS), _read_table(folder / CHECK)
        self.resumed = len(self.points.get("panel", ()))
        self.lattice = Lattice(len(work.panel_values), work.plan.cells, work.levels, margins=work.plan.margins)

    def close(self) -> None:
        """Release the lock."""
        os.close(self._lock)

    def run(self, simulate: Simulate, show: Callable[[int, int], None] = lambda level, runs: None) -> None:
        """Evaluate the points that are missing, and write them after each level.

        Args:
            simulate: Returns the quantities of runs.
            show: Called with level and number of runs, before they are simulated.
        """
        rows = np.full(self.lattice.codes.shape, UNKNOWN)
        rows[tuple(self.points[name] for name in _PLACES) if self.points else ([], [], [])] = np.arange(self.resumed)
        for level, places in self.lattice.refine():
            missing = places[rows[tuple(places.T)] == UNKNOWN]
            if len(missing):
                show(level, len(missing))
                table = dict(zip(_PLACES, missing.T.astype(np.int32), strict=True)) | self._simulate(
                    simulate, missing[:, 0], missing[:, 2] / self.lattice.size, missing[:, 1] / self.lattice.size
                )
                rows[tuple(missing.T)] = np.arange(len(missing)) + len(self.points.get("panel", ()))
                self.points = _join(self.points, table)
                self._write(POINTS, _select(self.points, np.lexsort([self.points[name] for name in _PLACES[::-1]])))
            found = _select(self.points, rows[tuple(places.T)])
            self.lattice.codes[tuple(places.T)] = self.work.classify(found)
        if self.work.classes and not self.check and (count := self.work.plan.check_runs):
            show(self.work.levels, count)
            parts = np.random.default_rng(self.work.plan.seed).random((3, count))
            panel = np.sort((parts[0] * len(self.work.panel_values)).astype(np.int32))
            self.check = {"panel": panel} | self._simulate(simulate, panel, parts[1], parts[2])
            self._write(CHECK, self.check)
        write_file(self.folder / SUMMARY, json.dumps(self.summarise(), indent=1) + "\n")

    def _simulate(self, simulate: Simulate, panel: np.ndarray, x: np.ndarray, y: np.ndarray) -> Table:
        plan, keys = self.work.plan, self.work.keys
        values = [plan.y.place(y), plan.x.place(x)]
        if plan.panels:
            values.insert(0, np.array(plan.panels.values)[panel])
        return dict(zip(keys, values, strict=True)) | simulate(np.column_stack(values))

    def _write(self, name: str, table: Table) -> None:
        import pyarrow
        from pyarrow import parquet

        units = {key: self.work.unit(key) for key in self.work.keys} | {k: each.unit for k, each in QUANTITIES.items()}
        arrays = {key: pyarrow.array(column.tolist() if column.dtype == object else column)
                  for key, column in table.items()}  # fmt: skip
        fields = [pyarrow.field(key, each.type, metadata={"unit": units.get(key, "")}) for key, each in arrays.items()]
        with whole_file(self.folder / name) as draft:
            parquet.write_table(pyarrow.Table.from_arrays([*arrays.values()], schema=pyarrow.schema(fields)), draft)

    def find_class(self, panel: Any, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return class and whether in a border cell, of points in fractions of the axes; there, the nearest corner."""
        classes, border = self.lattice.paint()
        size, last = self.lattice.size, self.lattice.size - 1
        column, row = (np.clip((np.asarray(each) * size).astype(int), 0, last) for each in (x, y))
        inside = border[panel, row, column]
        nearest = self.lattice.codes[panel, np.rint(y * size).astype(int), np.rint(x * size).astype(int)]
        return np.where(inside, nearest, classes[panel, row, column]), inside

    def summarise(self) -> dict[str, Any]:
        """Return shares of the classes, width and area of the border cells, number of runs, and result of the check."""
        work, plan, lattice = self.work, self.work.plan, self.lattice
        runs, untrusted = (
            len(self.points["panel"]),
            int(np.sum(~self.points["trusted"] & (self.points["outcome"] != "failed"))),
        )
        document: dict[str, Any] = {
            "title": plan.title,
            "quantity": plan.quantity,
            "runs": runs,
            "untrusted": untrusted,
        }
        document |= {"x": _describe(plan.x, work, lattice.size), "y": _describe(plan.y, work, lattice.size)}
        if not work.classes:
            values = work.read_quantity(self.points)
            return document | {"smallest": float(np.nanmin(values)), "largest": float(np.nanmax(values))}
        classes, border = lattice.paint()
        document["full_grid_runs"] = lattice.codes.size
        document["full_grid_ratio"] = round(lattice.codes.size / runs, 2)
        document["border_share"] = round(float(border.mean()), 6)
        document["panels"] = [
            {"value": value, "border_cells": int(edge.sum()), "border_share": round(float(edge.mean()), 6),
             "shares": {name: round(float(share), 5) for name, share in zip(work.classes, row, strict=True) if share}}
            for value, edge, row in zip(work.panel_values, border, lattice.shares(classes, border, len(work.classes)),
                                        strict=True)
        ]  # fmt: skip
        document["marks"] = [
            {"label": mark.label, "panel": value, "class": work.classes[int(code)], "in_border": bool(inside)}
            for mark in plan.marks for panel, value in enumerate(work.panel_values)
            for code, inside in [self.find_class(panel, plan.x.find_part(mark.x), plan.y.find_part(mark.y))]
        ]  # fmt: skip
        if self.check:
            document["check"] = self._compare_check()
        return document

    def _compare_check(self) -> dict[str, Any]:
        """Compare the random runs with the map."""
        from scipy.stats import beta

        plan, check = self.work.plan, self.check
        x, y = (np.array([side.find_part(value) for value in check[side.key]]) for side in (plan.x, plan.y))
        code, inside = self.find_class(check["panel"], x, y)
        wrong = code != self.work.classify(check)
        runs, errors = int(np.sum(~inside)), int(np.sum(wrong & ~inside))
        bound = float(beta.ppf(0.95, errors + 1, runs - errors)) if errors < runs else 1.0
        return {
            "runs": len(wrong), "in_border": int(inside.sum()), "errors_in_border": int(np.sum(wrong & inside)),
            "outside_border": runs, "errors_outside_border": errors,
            "error_share_below_95": round(bound, 5),
        }  # fmt: skip


def read_summary(folder: Path) -> dict[str, Any]:
    """Return the summary of a finished map.

    Raises:
        InputError: The folder has none.
    """
    read_map_text(folder)
    if not (folder / SUMMARY).exists():
        raise InputError("FOLDER", "of a finished map (`rig map PLAN -o FOLDER` continues it)", str(folder))
    return read_json(read_file(folder / SUMMARY, _MAX_BYTES), field=SUMMARY)


def pick_scene(work: MapWork, x: float, y: float, panel: float | None) -> Scene:
    """Return the scene of a point of a map.

    Raises:
        InputError: The panel is missing or unknown, or the scene does not accept a value.
    """
    if panel not in work.panel_values:
        known = ", ".join(f"{each:g}" for each in work.panel_values if each is not None)
        raise InputError("--panel", f"one of {known}" if known else "left out for a map without panels", panel)
    values = (y, x) if panel is None else (panel, y, x)
    return vary(work.scene, dict(zip(work.keys, values, strict=True)))


def read_map_text(folder: Path) -> str:
    """Return the plan's document of a folder.

    Raises:
        InputError: The folder has none.
    """
    try:
        text = read_file(folder / PLAN, _MAX_BYTES).decode()
        if "plan" not in read_json(text.encode(), field=PLAN):
            raise InputError(PLAN, "the plan of a map", str(folder))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("FOLDER", "a folder of `rig map`", Words(f"{folder} ({error})")) from None
    return text


def _describe(side: Side, work: MapWork, size: int) -> dict[str, Any]:
    """Return key, unit and cell width of an axis: a difference, or a ratio less 1 on a logarithmic axis."""
    first, second = side.place(np.array([0.0, 1.0 / size])).tolist()
    width = {"cell_width": second - first} if side.scale == "linear" else {"cell_ratio": second / first}
    return {"key": side.key, "unit": work.unit(side.key), "from": side.start, "to": side.stop, **width}


def _read_table(path: Path) -> Table:
    from pyarrow import parquet

    if not path.exists():
        return {}
    table = parquet.read_table(path)
    return {name: table.column(name).to_numpy() for name in table.column_names}


def _join(table: Table, other: Table) -> Table:
    return {name: np.concatenate([table[name], column]) if table else column for name, column in other.items()}


def _select(table: Table, rows: np.ndarray) -> Table:
    return {name: column[rows] for name, column in table.items()}
