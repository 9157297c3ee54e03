"""Reading and writing of Parquet files, by pyarrow."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.recordings.formats.exporting import export
from replays.recordings.formats.readers.dialect import parse_heading, time_column
from replays.recordings.formats.source import Entry, FileSignal, Source, even_rate_hz, join_pieces
from rig.base.files import find_data_limit

_PIECE = 1 << 16
"""Rows of a piece."""

if TYPE_CHECKING:
    from replays.recordings.formats.exporting.selection import Column, ExportChunk, ExportTable, Selection
    from replays.recordings.formats.mapping import FileOptions


def look_into(path: Path, options: FileOptions) -> Source:
    """Open a Parquet file and list its signals.

    Raises:
        InputError: The file is not Parquet, or has no numeric column.
    """
    from pyarrow import parquet

    file = parquet.ParquetFile(path, buffer_size=1 << 20)
    about, limit = file.metadata, find_data_limit(path.stat().st_size)
    declared = sum(about.row_group(group).total_byte_size for group in range(about.num_row_groups))
    if max(8 * about.num_rows * about.num_columns, declared) > limit:
        raise ValueError(f"{about.num_rows} rows of {about.num_columns} columns, more than {limit >> 20} MB")
    schema = file.schema_arrow
    headings = [parse_heading(field.name) for field in schema]
    names = [name for name, _ in headings]
    stamps = time_column(names, options.time_column, path=path)
    if stamps is None and options.time_column is None:  # pandas names an index of instants differently
        stamps = next((c for c in range(len(names)) if _is_clock(schema.field(c).type)), None)

    def batches(columns: Sequence[int], groups: Iterable[int]) -> Iterator[list[Any]]:
        wanted = [schema.field(c).name for c in columns]
        for group in groups:  # for several groups at once, pyarrow keeps those already read
            for batch in file.iter_batches(_PIECE, row_groups=[group], columns=wanted, use_threads=False):
                yield [batch.column(batch.schema.names.index(name)) for name in wanted]

    scale, zero, start, rate, base = 1.0, 0.0, None, None, 0
    if stamps is not None and file.metadata.num_rows:
        (first,) = next(batches([stamps], [0]))
        start, base = first_instant(first), base_ns(first)
        if _numeric(schema.field(stamps).type):
            _, scale, zero = options.time_in_s(*headings[stamps], float(numbers(first, base)[0]))
        rate = even_rate_hz((numbers(first, base) - zero) * scale)
    about = schema.metadata or {}
    entries = []
    for c, (name, unit) in enumerate(headings):
        field = schema.field(c)
        if c != stamps and _numeric(field.type):
            notes = {key.decode(): text.decode(errors="replace") for key, text in (field.metadata or {}).items()}
            entries.append(
                Entry(name, "", unit or notes.get("unit", ""), file.metadata.num_rows, rate, c, notes.get("label", ""))
            )

    def read(entry: Entry) -> FileSignal:
        return join_pieces(pieces([entry]))

    def pieces(entries: Sequence[Entry]) -> Iterator[list[FileSignal]]:
        wanted = [entry.place for entry in entries]
        for columns in batches(wanted if stamps is None else [*wanted, stamps], range(file.num_row_groups)):
            arrays = [numbers(column, base) for column in columns]
            part_s = None if stamps is None else (arrays.pop() - zero) * scale
            yield [FileSignal(values=values, times_s=part_s) for values in arrays]

    kept = {key.decode(): text.decode(errors="replace") for key, text in about.items() if key != b"ARROW:schema"}
    texts = [name for c, (name, _) in enumerate(headings) if c != stamps and not _numeric(schema.field(c).type)]
    remarks = (f"non-numeric columns left out: {', '.join(texts)}",) if texts else ()
    return Source(path, "Parquet", tuple(entries), read, pieces, about=kept, start=start, remarks=remarks)


def _numeric(kind: Any) -> bool:
    import pyarrow.types as types

    return types.is_integer(kind) or types.is_floating(kind)


def _is_clock(kind: Any) -> bool:
    import pyarrow.types as types

    return types.is_timestamp(kind) or types.is_duration(kind)


def numbers(column: Any, base: int = 0) -> np.ndarray:
    """Return a column of pyarrow as numbers: integers if all are present, else floats with nan; times in seconds.

    Args:
        column: The column, or a piece of it.
        base: Origin of instants [ns], see `base_ns`.
    """
    import pyarrow
    import pyarrow.compute as compute
    import pyarrow.types as types

    if _is_clock(column.type):
        zoned = types.is_timestamp(column.type)
        ns = column.cast(pyarrow.timestamp("ns", tz=column.type.tz) if zoned else pyarrow.duration("ns"))
        whole = np.array(ns.cast(pyarrow.int64()))
        return np.asarray(whole, dtype=float) / 1e9 if column.null_count else (whole - base) / 1e9
    if column.null_count or not types.is_integer(column.type):
        return np.array(compute.cast(column, pyarrow.float64()), dtype=float)
    return np.array(column)


def join_instants(dates: Any, times_s: Any) -> Any:
    """Return a column of instants: dates at midnight plus times of day [s]."""
    import pyarrow

    ns = np.rint(1e9 * np.asarray(times_s, dtype=float)).astype("timedelta64[ns]")
    return pyarrow.array(np.asarray(dates).astype("datetime64[ns]") + ns, pyarrow.timestamp("ns"))


def base_ns(column: Any) -> int:
    """Return the whole second of a column's first instant [ns], as `first_instant`; 0 for other columns."""
    import pyarrow
    import pyarrow.types as types

    if not types.is_timestamp(column.type) or not len(column) or not column[0].is_valid:
        return 0  # durations have their own origin
    first = column[0].cast(pyarrow.timestamp("ns", tz=column.type.tz)).value
    return first - first % 1_000_000_000


def first_instant(column: Any) -> datetime | None:
    """Return the whole second of a column's first instant; None for other columns."""
    import pyarrow
    import pyarrow.types as types

    if not types.is_timestamp(column.type) or not len(column):
        return None
    first = column[0].cast(pyarrow.timestamp("us", tz=column.type.tz)).as_py()
    return None if first is None else first.replace(microsecond=0)


class ParquetRows:
    """Parquet file written row by row."""

    def __init__(self, path: Path, schema: Any) -> None:
        from pyarrow import parquet

        self._schema = schema
        # Dictionaries would not compress continuous quantities.
        self._writer = parquet.ParquetWriter(path, schema, compression="lz4", use_dictionary=False)

    def write(self, columns: Sequence[np.ndarray]) -> None:
        """Write rows, column by column, each shape (n,)."""
        self._writer.write_table(arrow_table(columns, self._schema))

    def close(self) -> None:
        """Write pending rows, and close the file."""
        self._writer.close()


def float_schema(names: Sequence[str]) -> Any:
    """Return a schema of float64 columns."""
    import pyarrow

    return pyarrow.schema([(name, pyarrow.float64()) for name in names])


def arrow_table(columns: Sequence[np.ndarray], schema: Any) -> Any:
    """Return columns as a pyarrow table; nan in a column of integers becomes null."""
    import pyarrow

    arrays = []
    for values, field in zip(columns, schema, strict=True):
        if field.type == pyarrow.int32():
            missing = np.isnan(values)
            array = pyarrow.array(np.where(missing, 0.0, values).astype(np.int32), mask=missing)
        else:
            # pyarrow.array would import pandas to inspect its argument, which takes as long as writing a second's rows.
            whole = np.ascontiguousarray(values, dtype=float)
            array = pyarrow.Array.from_buffers(pyarrow.float64(), len(whole), [None, pyarrow.py_buffer(whole)])
        arrays.append(array)
    return pyarrow.Table.from_arrays(arrays, schema=schema)


class ParquetWriter(export.FormatWriter):
    """Writer of Parquet files: `time [s]` and one column per channel, with its calibration as metadata.

    Events and the rig's documents are metadata of the file.
    """

    merged = True
    sparse = True

    def __init__(self, path: Path, selection: Selection) -> None:
        import pyarrow

        table = selection.tables[0]
        kind = pyarrow.int32() if selection.unit == "counts" else pyarrow.float64()
        fields = [pyarrow.field("time [s]", pyarrow.float64())]
        for column in table.columns:
            metadata = {key: str(value) for key, value in column.metadata.items()}
            fields.append(pyarrow.field(column.heading, _type(column, kind), metadata=metadata))
        events = json.dumps([event.document for event in selection.events])
        whole = {"rig": json.dumps({**selection.metadata, "rate_hz": table.rate_hz}), "events": events}
        whole |= selection.documents
        self._file = ParquetRows(path, pyarrow.schema(fields, metadata=whole))

    def write(self, table: ExportTable, chunk: ExportChunk) -> None:
        """Write rows; those that no stream has are left out."""
        values = [table.convert_column(c, chunk)[chunk.present] for c in range(len(table.columns))]
        self._file.write([chunk.times_s[chunk.present], *values])


def _type(column: Column, kind: Any) -> Any:
    import pyarrow

    return pyarrow.float64() if column.source is None else kind
