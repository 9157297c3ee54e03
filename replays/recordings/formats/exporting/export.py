"""Export of recordings, by the suffix: MDF4, TDMS, UFF58, CSV, Parquet, WAV."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from replays.recordings.formats import clock
from replays.recordings.formats.exporting.selection import ROWS, ExportChunk, ExportTable, Selection
from replays.recordings.formats.source import formats, load_format
from rig.base.errors import InputError, Words
from rig.base.files import check_new_file, check_output_differs, whole_file

Method = Literal["polyphase", "linear"]
_MAX_MISSING = 1_000_000
"""Missing rows that a format without times may fill in, in addition to half of the table."""


class FormatWriter:
    """Writer for the tables of a selection; each format has a subclass.

    Attributes:
        merged: True if the format holds one table, with all channels at one rate.
        sparse: True if rows that no stream has are left out.
        sidecar: True if the format has no metadata, which are then written to FILE.json.
    """

    merged = False
    sparse = False
    sidecar = False
    documents = "in the file"
    """Location of events, catalogue, parameters and scene."""
    _file: Any
    """Destination of the values; has `close`."""

    def __init__(self, path: Path, selection: Selection) -> None:
        raise NotImplementedError

    def write(self, table: ExportTable, chunk: ExportChunk) -> None:
        """Write rows; missing ones are nan in a format without times."""
        raise NotImplementedError

    def close(self) -> None:
        """Write pending rows, and close the file."""
        self._file.close()

    def abandon(self) -> None:
        """Close the file, which will be removed."""
        self._file.close()


@dataclass(frozen=True)
class Written:
    """File that was written.

    Attributes:
        path: The file.
        tables: Name, rate [Hz], rows and missing rows of each table.
        columns: Total number of columns.
        documents: Location of events, catalogue, parameters and scene, in words.
    """

    path: Path
    tables: tuple[tuple[str, float, int, int], ...]
    columns: int
    documents: str


def written_suffixes() -> tuple[str, ...]:
    """Return the suffixes of formats that can be written."""
    return tuple(form.suffixes[0] for form in formats().values() if form.writer)


def check_output(path: Path, *, force: bool, suffixes: tuple[str, ...] = ()) -> None:
    """Check that a file can be written, before anything is computed.

    Raises:
        InputError: Another suffix, a folder that is missing or read-only, or an existing file.
    """
    check_new_file(path, field="output", suffixes=suffixes or written_suffixes(), force=force)


def holds_one_table(path: Path) -> bool:
    """Return whether a format holds one table at one rate."""
    return _writer_class(path).merged


def _writer_class(path: Path) -> type[FormatWriter]:
    form = next(form for form in formats().values() if form.writer and path.suffix == form.suffixes[0])
    return getattr(load_format(form), form.writer)


def export(
    selection: Selection,
    path: Path,
    *,
    rate_hz: float | None = None,
    method: Method = "polyphase",
    force: bool = False,
    progress: Callable[[float], None] = lambda part: None,
) -> list[Written]:
    """Write a selection, block by block; remove the files on an error.

    A format of one table gets one file per rate, NAME-RATEHz.SUFFIX, if the selection has several rates.

    Args:
        selection: Content of the file.
        path: The file.
        rate_hz: Resample everything to this rate [Hz], in memory.
        method: Method of resampling.
        force: Replace existing files.
        progress: Callback for the completed fraction, 0 to 1.

    Raises:
        InputError: The file cannot be used, or the format cannot hold the selection.
    """
    check_output(path, force=force)
    kind = _writer_class(path)
    source: Selection = selection
    if rate_hz is not None:
        source = resample(selection, rate_hz, method)
    jobs = [(path, source)]
    if kind.merged and len(source.tables) > 1:
        jobs = [(_rate_path(path, table, source), replace(source, tables=(table,))) for table in source.tables]
    total = sum(table.rows for table in source.tables)
    for target, part in jobs:
        for output in [target, *([_sidecar_path(target)] if kind.sidecar else [])]:
            check_output(output, force=force, suffixes=(*written_suffixes(), ".json"))
            check_output_differs([each.path for each in selection.recording.parts], output)
        for table in part.tables:
            names = [column.name for column in table.columns]
            if len(set(names)) < len(names):
                raise InputError("channels", "different names", names)
            if not kind.sparse and (missing := part.missing[table.name]) > table.rows // 2 + _MAX_MISSING:
                must = f"one with fewer gaps for a {path.suffix} file (set --from and --to)"
                raise InputError("range", must, Words(f"{missing} rows missing in {table.name}"))
    done = 0
    written = []
    with ExitStack() as stack:
        for target, part in jobs:
            writer = kind(stack.enter_context(whole_file(target)), part)
            whole = False
            try:
                for table in part.tables:
                    for chunk in part.chunks(table, sparse=kind.sparse):
                        writer.write(table, chunk)
                        progress((done + chunk.index) / total)
                    done += table.rows
                writer.close()
                whole = True
            finally:
                if not whole:
                    with suppress(Exception):
                        writer.abandon()
            if kind.sidecar:
                text = json.dumps(part.sidecar(), indent=1, ensure_ascii=False)
                stack.enter_context(whole_file(_sidecar_path(target))).write_text(text + "\n", encoding="utf-8")
            tables = tuple((t.name, t.rate_hz, t.rows, part.missing[t.name]) for t in part.tables)
            events = f"{len(part.events)} event{'s' * (len(part.events) != 1)}, catalogue, parameters and scene"
            where = f"in {_sidecar_path(target).name}" if kind.sidecar else kind.documents
            columns = sum(len(table.columns) for table in part.tables)
            written.append(Written(target, tables, columns, f"{events}: {where}"))
    return written


def _sidecar_path(path: Path) -> Path:
    return path.with_name(path.name + ".json")


def _rate_path(path: Path, table: ExportTable, selection: Selection) -> Path:
    alike = [other for other in selection.tables if f"{other.rate_hz:g}" == f"{table.rate_hz:g}"]
    more = f"-{alike.index(table) + 1}" if len(alike) > 1 else ""
    return path.with_name(f"{path.stem}-{table.rate_hz:g}Hz{more}{path.suffix}")


@dataclass(frozen=True)
class _Resampled(Selection):
    """Selection resampled to one rate: a table without streams and without missing rows."""

    held: np.ndarray = None  # type: ignore[assignment]
    """Counts or values, float64, shape (rows, columns)."""

    def chunks(self, table: ExportTable, rows: int = ROWS, *, sparse: bool = False) -> Iterator[ExportChunk]:
        """Yield rows in order."""
        for start in range(0, table.rows, rows):
            values = self.held[start : start + rows]
            times_s = table.first_s + np.arange(start, start + len(values)) / table.rate_hz
            yield ExportChunk(index=start, times_s=times_s, values=values, present=np.ones(len(values), dtype=bool))


def resample(selection: Selection, rate_hz: float, method: Method) -> Selection:
    """Return a selection resampled to one table at one rate, in memory.

    Raises:
        InputError: The rate is out of range, rows are missing, or the unit is counts, which cannot be interpolated.
    """
    if not 1.0 <= rate_hz <= 1e6:
        raise InputError("rate_hz", "between 1 and 1e6", rate_hz)
    if selection.unit == "counts":
        raise InputError("unit", "engineering or volts for resampling", selection.unit)
    first_s = max(table.first_s for table in selection.tables)
    last_s = min(table.first_s + (table.rows - 1) / table.rate_hz for table in selection.tables)
    rows = int((last_s - first_s) * rate_hz + 1e-6) + 1
    if rows < 2:
        raise InputError("range", "one in which all channels have samples", Words(f"{first_s:g} to {last_s:g} s"))
    wanted = first_s + np.arange(rows) / rate_hz
    columns, parts = [], []
    for table in selection.tables:
        if not selection.is_complete(table):
            raise InputError("range", "free of missing rows for resampling (set from_s and to_s)",
                             Words(f"{selection.missing[table.name]} missing in {table.name}"))  # fmt: skip
        values = np.concatenate([chunk.values for chunk in selection.chunks(table)])
        axis = clock.TimeAxis(table.first_s, table.rate_hz, table.rows)
        for c, column in enumerate(table.columns):
            if method == "linear":
                values_c = clock.interpolate_linear(values[:, c], axis, wanted)
            else:
                values_c = clock.resample_polyphase(values[:, c], axis, first_s, rate_hz, rows)
            # Counts cannot be interpolated: a sensor's column is exported in its unit.
            linear = column.linear
            parts.append(values_c if linear is None else values_c * linear[0] + linear[1])
            columns.append(replace(column, linear=None, source=None))
    title = "; ".join(table.title for table in selection.tables)
    table = ExportTable("resampled", title, tuple(columns), (), rate_hz, first_s, rows, 0)
    how = clock.FILTER if method == "polyphase" else "linear interpolation"
    rates = ", ".join(f"{other:g}" for other in sorted({table.rate_hz for table in selection.tables}))
    return _Resampled(
        recording=selection.recording, tables=(table,), unit=selection.unit, from_s=selection.from_s,
        to_s=selection.to_s, notes={**selection.notes, "resampled": f"from {rates} Hz to {rate_hz:g} Hz: {how}"},
        held=np.stack(parts, axis=1),
    )  # fmt: skip
