"""Points that have been measured, kept as they come, so that a chart that was stopped goes on where it was."""

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

KEY = ("mode", "panel", "phase", "case", "method", "rung")
"""Columns that tell one point from another."""
COLUMNS = (
    *KEY, "title", "family", "known_failure", "friction", "smoothing_speed", "step_us", "tolerance", "simulated_s",
    "runs", "cpu_s", "cpu_min_s", "cpu_max_s", "compile_s", "own_cpu_s", "speed", "speed_min", "speed_max", "error",
    "reference", "reference_error", "energy_residual", "steps", "evaluations", "contacts", "contacts_reference",
    "worst_frame_ms", "contact_fraction", "contact_fraction_low", "contact_fraction_high", "rms_force",
    "rms_force_low", "rms_force_high", "impacts_per_s", "impacts_per_s_low", "impacts_per_s_high", "failure",
    "message", "code", "commit", "date", "machine", "versions",
)  # fmt: skip
"""Columns of the table; speeds are times real time, forces newtons. `own_cpu_s` is a bound: the time inside a library's
own calls alone, where a Python loop of ours drives it."""
_LATER = {"own_cpu_s"}
"""Columns that tables of earlier versions lack."""
_TEXT = {*KEY, "title", "family", "known_failure", "friction", "reference", "failure", "message", "code", "commit",
         "date", "machine", "versions"}  # fmt: skip
_LIBRARIES = (provenance.RIG, "numba", "numpy", "scipy", "heyoka", "scikit-sundae", "mujoco", "diffrax")
_MEASURING = ("measure.py", "phases.py", "profile.py")

Row = dict[str, Any]


class Store:
    """Points in a folder: a journal that grows with every point, and at the end Parquet and CSV.

    A point counts as measured only for the code that it was measured with.
    """

    def __init__(self, folder: Path, *, fresh: bool = False) -> None:
        """Open a folder, which is made where it is missing.

        Raises:
            InputError: It cannot be written, or is a file.
        """
        self.folder = folder
        self.stamp = stamp()
        self._journal = Journal(folder, "chart.journal.jsonl", self.stamp["code"], fresh=fresh)
        self.outdated = self._journal.outdated
        self._rows = {_key(row): row for row in self._journal.rows}

    def has(self, row: Row) -> bool:
        """Whether the point of a row has been measured."""
        return _key(row) in self._rows

    def rows(self, mode: str) -> list[Row]:
        """All points of a mode."""
        return [row for row in self._rows.values() if row["mode"] == mode]

    def add(self, row: Row) -> None:
        """Keep a point; it is on the disk when this returns."""
        whole: Row = {name: row.get(name, "" if name in _TEXT else None) for name in COLUMNS} | self.stamp
        for name, value in whole.items():
            # JSON has no words for what is not finite; an empty field says the same.
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
    # What follows is no evidence, and half of the file.
    return float(f"{value:.6g}")


def read_table(folder: Path) -> list[Row]:
    """The points of a table that a making of a chart has left in a folder.

    Raises:
        InputError: There is none, or it is no such table.
    """
    path = folder / "chart.csv"
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [
                {key: row[key] if key in _TEXT else float(value) if (value := row[key]) else None for key in COLUMNS}
                for row in ({**dict.fromkeys(_LATER), **row} for row in csv.DictReader(file))
            ]
    except (OSError, KeyError, ValueError, TypeError, csv.Error):
        raise InputError("output", f"a folder with {path.name} of an earlier chart", str(folder)) from None


def code_digest() -> str:
    """Digest of the engines, kernels and peers' drivers that a chart measures, and of how it does."""
    here, simulator = Path(__file__).parent, Path(str(rig.__file__)).parent
    folders = (simulator / "physics" / "engines", simulator / "physics" / "kernels", here.parent / "peers")
    sources = [path for folder in folders for path in folder.rglob("*.py")]
    scenes = here.parent / "common" / "twelve_scenes.py"
    return provenance.digest([*sources, scenes, *(here / name for name in _MEASURING)])


def stamp() -> dict[str, str]:
    """What a point is measured with: code, commit, date, machine, versions of libraries."""
    found = {"Python": platform.python_version(), **provenance.versions(*_LIBRARIES)}
    return {
        "code": code_digest(),
        "commit": provenance.commit(),
        "date": provenance.today(),
        "machine": provenance.machine(),
        "versions": ", ".join(f"{name} {version}" for name, version in found.items()),
    }
