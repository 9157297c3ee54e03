"""Reading and writing of universal files, dataset 58 (a function of time at a degree of freedom).

The format is common in modal analysis. pyuff reads binary and text files. Files are written here block by block, binary
(58b) in float64, as pyuff packs each value separately. The layout follows the SDRC test data exchange documentation.
"""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from replays.recordings.formats.exporting import export
from replays.recordings.formats.source import Entry, FileSignal, Source, load_library, read_error
from rig.base import units
from rig.base.errors import InputError
from rig.base.files import open_file
from rig.base.text import printable

if TYPE_CHECKING:
    from recorder.reader import Recording
    from replays.recordings.formats.exporting.selection import Column, ExportChunk, ExportTable, Selection
    from replays.recordings.formats.mapping import FileOptions

_TIME_RESPONSE = (0, 1)
"""Function types that are time histories: general, time response."""
_REAL = (2, 4)
"""Ordinates in single or double precision; 5 and 6 are complex."""
_DELIMITER, _BLANK = b"    -1", b"\0\x1a\r\n "
"""Line before and after a dataset, and bytes that may follow it."""
_TAIL_BYTES = 4096
"""Bytes at the end of a file in which the delimiter is searched."""
_EXACT = r"\b{}=([0-9.eE+-]+)"
"""Pattern of values in our files for which the header has too few digits."""
_START = ("%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S")
_TIME, _GENERAL, _UNKNOWN = 17, 1, 0
_ORDINATE = {
    "length": (8, 1, 0),
    "force": (9, 0, 1),
    "acceleration": (12, 1, 0),
    "speed of rotation": (_GENERAL, 0, 0),
}
"""Specific data type, and exponents of length and force, by the kind of unit (9: reaction force)."""
_DIRECTIONS = {"x": 1, "y": 2, "z": 3, "E": 1, "W": -1, "N": 2, "S": -2}
_ALONG = {
    0: "none", 1: "x, EAST", -1: "-x, WEST", 2: "y, up", -2: "-y, down", 3: "z, along the shaft", 6: "about z",
}  # fmt: skip
_IMPACT_DIRECTIONS = {"x": 1, "-x": -1, "y": 2, "-y": -2}
_AXIS = re.compile(r"(\w+)_[av]?([xyz])")
_SIDE = re.compile(r"\w+_([ENWS])")


def look_into(path: Path, options: FileOptions) -> Source:
    """Open a universal file and list its signals.

    Raises:
        InputError: The file is not universal, is truncated or has no time history, or pyuff is missing.
    """
    pyuff = load_library("UFF", "pyuff")
    if not _ends(path):
        raise read_error(path, "universal (UFF)", "it is truncated")
    file = pyuff.UFF(str(path))
    kinds = list(np.atleast_1d(file.get_set_types()).astype(int))
    heads = {n: file.read_sets(n, header_only=True) for n, kind in enumerate(kinds) if kind == 58}
    entries: list[Entry] = []
    for n, head in heads.items():
        if head["func_type"] not in _TIME_RESPONSE or head["ord_data_type"] not in _REAL:
            continue
        name = next((text for text in (head["id1"].strip(), head["rsp_ent_name"].strip()) if text not in ("", "NONE")),
                    f"set {n + 1}")  # fmt: skip
        unit = head["ordinate_axis_units_lab"].strip()
        label = " ".join(head[f"id{k}"].strip() for k in (2, 5) if head[f"id{k}"].strip() not in ("", "NONE"))
        unit = "" if unit == "NONE" else unit
        entries.append(Entry(name, "", unit, int(head["num_pts"]), _rate_hz(head), n, label))
    if not entries:
        raise InputError("file", "a universal file with time histories (dataset 58, real)", str(path))

    def read(entry: Entry) -> FileSignal:
        data = file.read_sets(entry.place)
        values = np.array(data["data"], dtype=float)[: entry.rows]
        if len(values) < entry.rows:
            raise ValueError(f"{len(values)} of {entry.rows} values")
        if int(data["abscissa_spacing"]) == 0:
            return FileSignal(values=values, times_s=np.array(data["x"], dtype=float)[: entry.rows])
        return FileSignal(
            values=values, rate_hz=_rate_hz(data), first_s=_exact(data, "first_s") or float(data["abscissa_min"])
        )

    others = len(kinds) - len(entries)
    remarks = (f"{others} datasets without a time history ignored",) if others else ()
    start = _start([str(head["id3"]) for head in heads.values()])
    return Source(path=path, format="UFF58", entries=tuple(entries), read=read, remarks=remarks, start=start)


def _ends(path: Path) -> bool:
    """Return whether the file ends with a complete dataset; pyuff ignores an incomplete one."""
    with open_file(path) as file:
        file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
        end = file.read().rstrip(_BLANK)
    # Binary numbers are followed by it without a new line; after one that closes, another opens the next dataset.
    return end.endswith(_DELIMITER) and not end.removesuffix(_DELIMITER).rstrip(_BLANK).endswith(_DELIMITER)


def _rate_hz(head: dict) -> float | None:
    step = float(head["abscissa_inc"])
    return _exact(head, "rate_hz") or (1.0 / step if head["abscissa_spacing"] and step > 0.0 else None)


def _exact(head: dict, name: str) -> float | None:
    match = re.search(_EXACT.format(name), str(head.get("id4", "")))
    return float(match[1]) if match else None


def _start(texts: list[str]) -> datetime | None:
    for text in texts:
        for form in _START:
            try:
                return datetime.strptime(text.strip(), form)
            except ValueError:
                continue
    return None


class DegreeOfFreedom(NamedTuple):
    """Place and direction of a channel in a universal file.

    Attributes:
        node: Number of the place, from 1, in the order of the channel table.
        direction: 1, 2, 3: along x (EAST), y (up), z (the shaft); negative: opposite; 6: rotation about z; 0: none.
        place: Name of the place.
    """

    node: int
    direction: int
    place: str


def degrees_of_freedom(recording: Recording) -> dict[str, DegreeOfFreedom]:
    """Return place and direction of each channel of a recording by its name, independent of the export.

    They follow from the names of the channel table: `disk_x` is at the disk along x, `P_W` at a separate place,
    against x. The hammer hits the disk, along the direction of its impacts if that is a common axis.
    """
    directions = {str(event.get("direction")) for event in recording.events if event["event"] == "hammer"}
    axes: dict[str, tuple[str, int]] = {}
    for channel in recording.table.channels.values():
        axes[channel.name] = _node_of(channel.name, 6 if units.get_quantity(channel.unit) == "speed of rotation" else 0)
    if "hammer" in axes:
        axes["hammer"] = ("disk", _IMPACT_DIRECTIONS.get(directions.pop(), 0) if len(directions) == 1 else 0)
    for table, about in recording.catalogue.get("truth", {}).items():
        for column in about["columns"]:
            axes[f"truth.{table}.{column['name']}"] = _node_of(column["name"], 0)
    nodes = {place: number for number, place in enumerate(dict.fromkeys(place for place, _ in axes.values()), 1)}
    return {name: DegreeOfFreedom(nodes[place], direction, place) for name, (place, direction) in axes.items()}


def _node_of(name: str, otherwise: int) -> tuple[str, int]:
    """Return place and direction from a name; one without an axis is a separate place."""
    if (side := _SIDE.fullmatch(name)) is not None:
        return name, _DIRECTIONS[side[1]]
    if (axis := _AXIS.fullmatch(name)) is not None:
        return axis[1], _DIRECTIONS[axis[2]]
    return name, otherwise


class UffWriter(export.FormatWriter):
    """Writer of universal files: one binary dataset 58 per channel in float64, with its node and direction."""

    documents = "left out, as UFF58 has no place for them"

    def __init__(self, path: Path, selection: Selection) -> None:
        self._file = path.open("wb")
        self._at: dict[str, list[int]] = {}
        freedoms = degrees_of_freedom(selection.recording)
        for table in selection.tables:
            for column in table.columns:
                self._file.write(_header(table, column, selection, freedoms[column.name]))
                self._at.setdefault(table.name, []).append(self._file.tell())
                self._file.seek(8 * table.rows, 1)
                self._file.write(b"\n    -1\n")

    def write(self, table: ExportTable, chunk: ExportChunk) -> None:
        """Write rows; missing ones are nan, as the format has no times."""
        for c, at in enumerate(self._at[table.name]):
            self._file.seek(at + 8 * chunk.index)
            self._file.write(table.convert_column(c, chunk).astype("<f8").tobytes())


def _header(table: ExportTable, column: Column, selection: Selection, at: DegreeOfFreedom) -> bytes:
    kind, length, force = _ORDINATE.get(units.get_quantity(column.unit), (_UNKNOWN, 0, 0))
    about = selection.metadata
    texts = (
        column.name,
        column.label or "NONE",
        selection.start.strftime("%d-%b-%y %H:%M:%S"),
        f"rate_hz={table.rate_hz:.17g} first_s={float(table.first_s)!r} scene={about['scene']} seed={about['seed']} "
        f"parameters={about['parameter_set']}",
        f"node {at.node}: {at.place}; direction {at.direction}: {_ALONG[at.direction]}; group={table.name}",
    )
    lines = [
        f"{-1:6d}",
        f"{58:6d}b{1:6d}{2:6d}{11:12d}{8 * table.rows:12d}{0:6d}{0:6d}{0:12d}{0:12d}",
        *(f"{_ascii(text, 80):<80}" for text in texts),
        f"{1:5d}{0:10d}{0:5d}{0:10d} {_ascii(column.name, 10):<10}{at.node:10d}{at.direction:4d}"
        f" {'NONE':<10}{0:10d}{0:4d}",
        f"{4:10d}{table.rows:10d}{1:10d}{_e_format(table.first_s):>13}{_e_format(1.0 / table.rate_hz):>13}{0.0:13.5E}",
        f"{_TIME:10d}{0:5d}{0:5d}{0:5d} {'Time':<20} {'s':<20}",
        f"{kind:10d}{length:5d}{force:5d}{0:5d} {_ascii(column.name, 20):<20} {_ascii(column.unit, 20):<20}",
        *(f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':<20} {'NONE':<20}" for _ in range(2)),
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def _e_format(value: float) -> str:
    """Return a number with the most digits that fit a field of 13 columns after a blank."""
    return next(text for digits in range(12, 0, -1) if len(text := f"{value:#.{digits}G}") < 13)


def _ascii(text: str, width: int) -> str:
    return printable(text).encode("ascii", "replace").decode()[:width]
