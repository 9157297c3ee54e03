"""Storage of measured points, written one by one, so that an interrupted chart can be resumed."""

from __future__ import annotations

import csv
import math
import platform
from pathlib import Path
from typing import Any

import rig
from replays.studies.common import provenance
from replays.studies.common.journal import Journal
from rig.base.errors import InputError
from rig.base.files import TextLines, open_file

KEY = ("mode", "panel", "phase", "case", "method", "rung")
"""Columns that identify a point."""
COLUMNS = (
    *KEY, "title", "family", "known_failure", "friction", "smoothing_speed", "step_us", "tolerance", "simulated_s",
    "runs", "cpu_s", "cpu_min_s", "cpu_max_s", "compile_s", "own_cpu_s", "speed", "speed_min", "speed_max", "error",
    "reference", "reference_error", "energy_residual", "steps", "evaluations", "contacts", "contacts_reference",
    "worst_frame_ms", "contact_fraction", "contact_fraction_low", "contact_fraction_high", "rms_force",
    "rms_force_low", "rms_force_high", "impacts_per_s", "impacts_per_s_low", "impacts_per_s_high", "failure",
    "message", "code", "commit", "date", "machine", "versions",
)  # fmt: skip
"""Columns of the table; speeds are multiples of real time, forces newtons. `own_cpu_s` is a bound: the time within a
library's own calls only, if a Python loop of ours drives it."""
_OPTIONAL_COLUMNS = {"own_cpu_s"}
"""Columns that tables of earlier versions do not have."""
_TEXT = {*KEY, "title", "family", "known_failure", "friction", "reference", "failure", "message", "code", "commit",
         "date", "machine", "versions"}  # fmt: skip
_LIBRARIES = (provenance.RIG, "numba", "numpy", "scipy", "heyoka", "scikit-sundae", "mujoco", "diffrax")
_MEASUREMENT_FILES = ("measure.py", "phases.py", "profile.py")

Row = dict[str, Any]


class Store:
    """Points in a folder: a journal that grows with every point, and finally Parquet and CSV.

    A point is valid only for the code that measured it.
    """

    def __init__(self, folder: Path, *, fresh: bool = False) -> None:
        """Open a folder, which is created if missing.

        Raises:
            InputError: If it cannot be written, or is a file.
        """
        self.folder = folder
        self.stamp = stamp()
        self._journal = Journal(folder, "chart.journal.jsonl", self.stamp["code"], fresh=fresh)
        self.outdated = self._journal.outdated
        self._rows = {_key(row): row for row in self._journal.rows}

    def has(self, row: Row) -> bool:
        """Return whether the point of a row has been measured."""
        return _key(row) in self._rows

    def rows(self, mode: str) -> list[Row]:
        """Return all points of a mode."""
        return [row for row in self._rows.values() if row["mode"] == mode]

    def add(self, row: Row) -> None:
        """Store a point; it is written to disk before this returns."""
        whole: Row = {name: row.get(name, "" if name in _TEXT else None) for name in COLUMNS} | self.stamp
        for name, value in whole.items():
            # JSON has no representation of values that are not finite; an empty field is equivalent.
            if isinstance(value, float) and not math.isfinite(value):
                whole[name] = None
        self._journal.add(whole)
        self._rows[_key(whole)] = whole

    def write(self, mode: str) -> list[Path]:
        """Write the points of a mode as Parquet and CSV."""
        import pyarrow as pa
        import pyarrow.csv
        import pyarrow.parquet

        rows = self.rows(mode)
        schema = pa.schema([(name, pa.string() if name in _TEXT else pa.float64()) for name in COLUMNS])
        table = pa.table(
            {
                name: [row[name] if name in _TEXT or row[name] is None else _digits(row[name]) for row in rows]
                for name in COLUMNS
            },
            schema=schema,
        )
        paths = [self.folder / "chart.parquet", self.folder / "chart.csv"]
        pyarrow.parquet.write_table(table, paths[0])
        pyarrow.csv.write_csv(table, paths[1], pyarrow.csv.WriteOptions(quoting_style="needed"))
        return paths


def _key(row: Row) -> tuple[Any, ...]:
    return tuple(row[name] for name in KEY)


def _digits(value: float) -> float:
    # Further digits are not significant and would double the size of the file.
    return float(f"{value:.6g}")


def read_table(folder: Path) -> list[Row]:
    """Return the points of an earlier chart's table in a folder.

    Raises:
        InputError: If there is no such table.
    """
    path = folder / "chart.csv"
    try:
        with TextLines(open_file(path), encoding="utf-8", newline="") as file:
            return [
                {key: row[key] if key in _TEXT else float(value) if (value := row[key]) else None for key in COLUMNS}
                for row in ({**dict.fromkeys(_OPTIONAL_COLUMNS), **row} for row in csv.DictReader(file))
            ]
    except (OSError, KeyError, ValueError, TypeError, csv.Error):
        raise InputError("output", f"a folder with {path.name} of an earlier chart", str(folder)) from None


def code_digest() -> str:
    """Return the digest of the engines, kernels and peers that a chart measures, and of the measurement."""
    here, simulator = Path(__file__).parent, Path(str(rig.__file__)).parent
    folders = (simulator / "physics" / "engines", simulator / "physics" / "kernels", here.parent / "peers")
    sources = [path for folder in folders for path in folder.rglob("*.py")]
    scenes = here.parent / "common" / "twelve_scenes.py"
    return provenance.digest([*sources, scenes, *(here / name for name in _MEASUREMENT_FILES)])


def stamp() -> dict[str, str]:
    """Return the provenance of a point: code, commit, date, machine, versions of libraries."""
    library_versions = {"Python": platform.python_version(), **provenance.versions(*_LIBRARIES)}
    return {
        "code": code_digest(),
        "commit": provenance.commit(),
        "date": provenance.today(),
        "machine": provenance.machine(),
        "versions": ", ".join(f"{name} {version}" for name, version in library_versions.items()),
    }
