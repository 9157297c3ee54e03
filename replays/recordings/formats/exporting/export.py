"""Recordings for other tools: MDF4, TDMS, UFF58, CSV, Parquet, WAV, by the suffix."""

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
from rig.base.errors import InputError, Words, check_new_file, check_not_among, whole_file

Method = Literal["polyphase", "linear"]
_MOST_MISSING = 1_000_000
"""Missing rows that a format with a start and a step fills in, besides as many as there are."""


class FormatWriter:
    """Writes the tables of a selection; one of each format derives from it.

    Attributes:
        merged: The format takes one table, with all channels of one rate.
        sparse: Rows that no stream has are left out.
        sidecar: It has no place for metadata: FILE.json stands beside it.
    """

    merged = False
    sparse = False
    sidecar = False
    documents = "in the file"
    """Where events, catalogue, parameters and scene are."""
    _file: Any
    """What the values go to; has `close`."""

    def __init__(self, path: Path, selection: Selection) -> None:
        raise NotImplementedError

    def write(self, table: ExportTable, chunk: ExportChunk) -> None:
        """Take rows; a missing one is nan where the format has a start and a step and no times."""
        raise NotImplementedError

    def close(self) -> None:
        """Write what is left, and close the file."""
        self._file.close()

    def abandon(self) -> None:
        """Let go of the file, which will be removed."""
        self._file.close()


@dataclass(frozen=True)
class Written:
    """One file that was made.

    Attributes:
        path: The file.
        tables: Name, rate [Hz], rows and rows missing of each of its tables.
        columns: Number of columns in all.
        documents: What became of events, catalogue, parameters and scene, in words.
    """

    path: Path
    tables: tuple[tuple[str, float, int, int], ...]
    columns: int
    documents: str


def written_suffixes() -> tuple[str, ...]:
    """Endings of the files that can be written."""
    return tuple(form.suffixes[0] for form in formats().values() if form.writer)


def check_output(path: Path, *, force: bool, suffixes: tuple[str, ...] = ()) -> None:
    """Refuse a file that cannot be written, before anything is worked out.

    Raises:
        InputError: Another suffix, a folder that is missing or read-only, or an existing file.
    """
    check_new_file(path, field="output", suffixes=suffixes or written_suffixes(), force=force)


def merged(path: Path) -> bool:
    """Whether a format holds one table of one rate."""
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
    """Write a selection, block by block; nothing is left behind on an error.

    Formats of one table get a file a rate, NAME-RATEHz.SUFFIX, where the selection has several rates.

    Args:
        selection: What to write.
        path: The file.
        rate_hz: Bring everything to this rate [Hz], in memory.
        method: How.
        force: Replace existing files.
        progress: Told the part done, 0 to 1.

    Raises:
        InputError: The file cannot be used, or the format cannot hold it.
    """
    check_output(path, force=force)
    kind = _writer_class(path)
    source: Selection = selection
    if rate_hz is not None:
        source = resampled(selection, rate_hz, method)
    jobs = [(path, source)]
    if kind.merged and len(source.tables) > 1:
        jobs = [(_rated(path, table, source), replace(source, tables=(table,))) for table in source.tables]
    total = sum(table.rows for table in source.tables)
    for target, part in jobs:
        for made in [target, *([_beside(target)] if kind.sidecar else [])]:
            check_output(made, force=force, suffixes=(*written_suffixes(), ".json"))
            check_not_among([each.path for each in selection.recording.parts], made)
        for table in part.tables:
            names = [column.name for column in table.columns]
            if len(set(names)) < len(names):
                raise InputError("channels", "given once each", names)
            if not kind.sparse and (missing := part.missing[table.name]) > table.rows // 2 + _MOST_MISSING:
                must = f"one of which a {path.suffix} file can hold the gaps (--from and --to choose)"
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
                stack.enter_context(whole_file(_beside(target))).write_text(text + "\n", encoding="utf-8")
            tables = tuple((t.name, t.rate_hz, t.rows, part.missing[t.name]) for t in part.tables)
            events = f"{len(part.events)} event{'s' * (len(part.events) != 1)}, catalogue, parameters and scene"
            where = f"in {_beside(target).name}" if kind.sidecar else kind.documents
            columns = sum(len(table.columns) for table in part.tables)
            written.append(Written(target, tables, columns, f"{events}: {where}"))
    return written


def _beside(path: Path) -> Path:
    return path.with_name(path.name + ".json")


def _rated(path: Path, table: ExportTable, selection: Selection) -> Path:
    alike = [other for other in selection.tables if f"{other.rate_hz:g}" == f"{table.rate_hz:g}"]
    more = f"-{alike.index(table) + 1}" if len(alike) > 1 else ""
    return path.with_name(f"{path.stem}-{table.rate_hz:g}Hz{more}{path.suffix}")


@dataclass(frozen=True)
class _Resampled(Selection):
    """A selection that was brought to one rate: a table of no streams, which lacks no rows."""

    held: np.ndarray = None  # type: ignore[assignment]
    """Counts or values, float64, shape (rows, columns)."""

    def chunks(self, table: ExportTable, rows: int = ROWS, *, sparse: bool = False) -> Iterator[ExportChunk]:
        """Rows, in order."""
        for start in range(0, table.rows, rows):
            values = self.held[start : start + rows]
            times_s = table.first_s + np.arange(start, start + len(values)) / table.rate_hz
            yield ExportChunk(index=start, times_s=times_s, values=values, present=np.ones(len(values), dtype=bool))


def resampled(selection: Selection, rate_hz: float, method: Method) -> Selection:
    """Everything of a selection in one table at one rate, in memory.

    Raises:
        InputError: The rate cannot be, rows are missing, or counts are asked for, which have no values in between.
    """
    if not 1.0 <= rate_hz <= 1e6:
        raise InputError("rate_hz", "between 1 and 1e6", rate_hz)
    if selection.unit == "counts":
        raise InputError("unit", "engineering or volts where samples are resampled", selection.unit)
    first_s = max(table.first_s for table in selection.tables)
    last_s = min(table.first_s + (table.rows - 1) / table.rate_hz for table in selection.tables)
    rows = int((last_s - first_s) * rate_hz + 1e-6) + 1
    if rows < 2:
        raise InputError("range", "one that all channels share", Words(f"{first_s:g} to {last_s:g} s"))
    wanted = first_s + np.arange(rows) / rate_hz
    columns, parts = [], []
    for table in selection.tables:
        if not selection.whole(table):
            raise InputError("range", "free of missing rows where samples are resampled (from_s and to_s choose)",
                             Words(f"{selection.missing[table.name]} missing in {table.name}"))  # fmt: skip
        values = np.concatenate([chunk.values for chunk in selection.chunks(table)])
        axis = clock.Axis(table.first_s, table.rate_hz, table.rows)
        for c, column in enumerate(table.columns):
            if method == "linear":
                values_c = clock.linear(values[:, c], axis, wanted)
            else:
                values_c = clock.polyphase(values[:, c], axis, first_s, rate_hz, rows)
            # Between counts there is no count: a sensor's column is exported as the value that it has.
            linear = column.linear
            parts.append(values_c if linear is None else values_c * linear[0] + linear[1])
            columns.append(replace(column, linear=None, source=None))
    title = "; ".join(table.title for table in selection.tables)
    table = ExportTable("resampled", title, tuple(columns), (), rate_hz, first_s, rows, 0)
    how = clock.FILTER if method == "polyphase" else "straight lines between samples"
    rates = ", ".join(f"{other:g}" for other in sorted({table.rate_hz for table in selection.tables}))
    return _Resampled(
        recording=selection.recording, tables=(table,), unit=selection.unit, from_s=selection.from_s,
        to_s=selection.to_s, notes={**selection.notes, "resampled": f"from {rates} Hz to {rate_hz:g} Hz: {how}"},
        held=np.stack(parts, axis=1),
    )  # fmt: skip
