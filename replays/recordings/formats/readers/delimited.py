"""Delimited text: CSV in all its dialects, and LabVIEW measurement files (.lvm). Parsed by pyarrow."""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.estimate.spool import Spool, transform
from replays.recordings.formats.readers import columnar
from replays.recordings.formats.readers.dialect import (
    MISSING,
    Layout,
    find_layout,
    has_ambiguous_date,
    instant,
    join_segments,
    time_column,
)
from replays.recordings.formats.source import Entry, FileSignal, Source, even_rate_hz, read_error
from replays.recordings.resimulation.background import Background
from rig.base.errors import InputError, Words
from rig.base.files import TextLines, open_file
from rig.base.text import printable

_BLOCK_BYTES = 1 << 21
"""Bytes parsed at a time."""
_LAST_BYTES = 1 << 16
"""Bytes at the end of a file in which its last line is searched."""
_ISO = re.compile(r"\d{4}-\d\d-\d\d([ T]\d\d:\d\d(:\d\d(\.\d{1,9})?)?(Z|[-+]\d\d:?\d\d)?)?$")
"""Dates and times that pyarrow can read."""
_NANOSECONDS = re.compile(r"[.,:]\d{6}(\d{1,3})(?!\d)")
_NO_NUMBER, _MAX_MARKS = re.compile(r"column #(\d+): .* invalid value '([^'\d]+)'"), 32
"""Error of pyarrow on a text without digits in a column of numbers, and most such texts in a file."""
_EPOCH_MS = 1e11
"""Times in s reach this number in the year 5138, times in ms since 1970 in 1973."""
_BLANKS = [" " * n for n in range(1, 33)]
"""Blank fields, as in fixed-width columns."""
_MAX_CACHED_VALUES = 1 << 24
"""Values of a file that are kept in memory; larger files are parsed again each time."""

if TYPE_CHECKING:
    from replays.recordings.formats.exporting.selection import Selection
    from replays.recordings.formats.mapping import FileOptions


def look_into(path: Path, options: FileOptions) -> Source:
    """Open a text file and read its columns.

    Raises:
        InputError: The layout is not recognised; the message names the missing option or the line.
    """
    layout = find_layout(path, options)
    names = list(layout.names)
    stamps = None if layout.empty_first else time_column(names, options.time_column, path=path)
    if layout.stamps is not None:
        stamps = None
    elif stamps is None and options.time_column is None and not layout.empty_first:
        stamps = _find_datetime_column(path, layout, options)
    start, base, rows, rate = layout.start, 0, 0, layout.rate_hz
    unit, scale, zero, epoch = "", 1.0, 0.0, ()
    first = _first_fields(path, layout)
    stamps, date = (None, None) if options.time_column == "none" else _date_and_time(layout, first, stamps)
    if stamps is not None and layout.dialect.is_number(first[stamps]) and not options.time_format:
        missing = first[stamps] in ("", *MISSING, *options.missing)
        number = "nan" if missing else layout.dialect.normalise(first[stamps]).replace(layout.dialect.decimal, ".")
        unit, scale, zero = options.time_in_s(names[stamps], layout.units[stamps], float(number))
        if float(number) >= _EPOCH_MS:
            epoch = (f"numbers of {names[stamps]} read as {unit} since 1970",)
    kept: list[list[Any]] | None = []
    marks: dict[str, str] = {}
    while True:
        try:
            for part in _parse_columns(path, layout, options, stamps, date):
                if stamps is not None:
                    if not rows:
                        start, base = start or columnar.first_instant(part[stamps]), columnar.base_ns(part[stamps])
                    part_s = (columnar.numbers(part[stamps], base) - zero) * scale
                    if np.isnan(part_s).any():
                        line = layout.first + rows + int(np.argmax(np.isnan(part_s))) + 1
                        must = "a column without missing values"
                        raise InputError("file.time_column", must, Words(f"{path}, line {line}"))
                    rate = rate if rows else even_rate_hz(part_s)
                rows += len(part[0])
                kept = None if kept is None or rows * len(names) > _MAX_CACHED_VALUES else [*kept, part]
            break
        except InputError as error:
            text, name = _find_mark(error, layout, (stamps, date))
            if len(marks) == _MAX_MARKS:
                raise
            marks[text], rows, kept = name, 0, []
            options = options.model_copy(update={"missing": (*options.missing, text)})
    if not rows:
        raise InputError("file", "a text file with lines of numbers", str(path))
    others = {stamps, date, *layout.texts, *(layout.stamps or ())}
    kept_names = [(c, name) for c, name in enumerate(names) if c not in others]
    entries = tuple(Entry(name, "", layout.units[c], rows, rate, c) for c, name in kept_names)

    def pieces(entries: Sequence[Entry]) -> Iterator[list[FileSignal]]:
        for part in _parse_columns(path, layout, options, stamps, date) if kept is None else kept:
            part_s = None if stamps is None else (columnar.numbers(part[stamps], base) - zero) * scale
            yield [signal(columnar.numbers(part[entry.place]), part_s) for entry in entries]

    def signal(values: np.ndarray, times_s: np.ndarray | None) -> FileSignal:
        return FileSignal(values, times_s=times_s, rate_hz=layout.rate_hz, first_s=layout.first_s)

    @cache
    def columns() -> list[np.ndarray]:
        spools = [Spool() for _ in names]
        for part in _parse_columns(path, layout, options, stamps, date) if kept is None else kept:
            for each, column in zip(spools, part, strict=True):
                each.add(columnar.numbers(column, base))
        return [each.array() for each in spools]

    @cache
    def times_s() -> np.ndarray | None:
        stored = columns()[stamps] if stamps is not None else None
        return None if stored is None else transform(lambda part: (part - zero) * scale, stored)

    def read(entry: Entry) -> FileSignal:
        if layout.stamps is not None:
            own_s = columns()[layout.stamps[entry.place]]
            return signal(columns()[entry.place][np.isfinite(own_s)], own_s[np.isfinite(own_s)])
        return signal(columns()[entry.place], times_s())

    if layout.stamps is not None:
        own = [read(entry).times_s for entry in entries]
        entries = tuple(
            replace(entry, rows=len(times), rate_hz=even_rate_hz(times))
            for entry, times in zip(entries, own, strict=True)
            if times is not None
        )
    dialect, remarks = layout.dialect, (*layout.remarks, *epoch)
    if marks:
        texts = ", ".join(f"{text!r} ({name})" for text, name in marks.items())
        remarks += (f"texts read as missing values: {texts}",)
    if left_out := [names[c] for c in layout.texts if c not in (stamps, date)]:
        remarks += (f"columns of text left out: {', '.join(left_out)}",)
    if not options.time_format and (
        dates := [first[c] for c in (stamps, date) if c is not None and has_ambiguous_date(first[c])]
    ):
        remarks += (f"dates such as {dates[0]} read as month/day/year (set file.time_format to override)",)
    last = dialect.fields(_last_line(path, layout.encoding))
    if not layout.ragged and len(last) < layout.width:
        remarks += (f"{Source.CUT_LAST_LINE}: {len(last)} of {layout.width} columns",)
    dialect_options: dict[str, str | int] = {"delimiter": dialect.delimiter, "decimal": dialect.decimal}
    dialect_options |= {"thousands": dialect.thousands} if dialect.thousands else {}
    dialect_options["first_line"] = layout.first + 1
    if stamps is not None:
        dialect_options["time_column"] = names[stamps] or stamps + 1
    if unit not in ("", "s"):
        dialect_options["time_unit"] = unit
    whole = pieces if layout.stamps is None else None
    return Source(path, "text", entries, read, whole, start=start, remarks=remarks, options=dialect_options)


def _find_mark(error: InputError, layout: Layout, stamps: Sequence[int | None]) -> tuple[str, str]:
    """Return the text that is no number and stopped the parser, and the name of its column.

    Raises:
        InputError: Another error, a text in a column of times, or one with digits, which may be a damaged number.
    """
    match = _NO_NUMBER.search(str(error.received))
    number = int(match[1]) - layout.empty_first if match else None
    if match is None or number is None or number in stamps:
        raise error
    return match[2], layout.names[number]


def _first_fields(path: Path, layout: Layout) -> list[str]:
    with TextLines(open_file(path), layout.encoding) as file:
        return layout.dialect.fields([file.readline() for _ in range(layout.first + 1)][layout.first])


def _find_datetime_column(path: Path, layout: Layout, options: FileOptions) -> int | None:
    """Return the column that has dates and times instead of numbers, whatever its name."""
    for c, text in enumerate(_first_fields(path, layout)[: len(layout.names)]):
        if not layout.dialect.is_number(text) and instant(text, options.time_format) is not None:
            return c
    return None


def _date_and_time(layout: Layout, first: Sequence[str], stamps: int | None) -> tuple[int | None, int | None]:
    """Return the time column, and the column of its dates if it has times of day, else None."""
    found = [
        (c, instant(text, None))
        for c, text in enumerate(first[: len(layout.names)])
        if not layout.dialect.is_number(text)
    ]
    times = [c for c, moment in found if isinstance(moment, float)]
    dates = [c for c, moment in found if isinstance(moment, datetime) and ":" not in first[c]]
    if not times or not dates or stamps not in (None, *times, *dates):
        return stamps, None
    return (stamps if stamps in times else times[0]), dates[0]


def _parse_columns(
    path: Path, layout: Layout, options: FileOptions, stamps: int | None, date: int | None
) -> Iterator[list[Any]]:
    """Yield pieces of the columns from pyarrow; times of day with a column of dates become instants.

    Raises:
        InputError: Lines have a wrong number of columns, or unreadable values.
    """
    import pyarrow
    from pyarrow import csv

    numbered = [f"c{c}" for c in range(layout.width)]
    kept = numbered[layout.empty_first : layout.empty_first + len(layout.names)]
    bad: list[Any] = []

    def note(row: Any) -> str:
        bad.append(row)
        return "skip"

    kinds: dict[str, Any] = dict.fromkeys(kept, pyarrow.float64())
    kinds |= {kept[c]: pyarrow.string() for c in layout.texts}
    first = _first_fields(path, layout)
    source, skipped, encoding = _body(path, layout)
    if stamps is not None and options.time_unit in (None, "datetime"):
        kinds[kept[stamps]] = _time_kind(first[stamps], layout, options)
    if date is not None:
        kinds[kept[date]] = _time_kind(first[date], layout, options)
    try:
        reader = csv.open_csv(
            source,
            read_options=csv.ReadOptions(
                column_names=numbered, skip_rows=skipped, use_threads=False, encoding=encoding, block_size=_BLOCK_BYTES
            ),
            parse_options=csv.ParseOptions(
                delimiter=layout.dialect.delimiter, invalid_row_handler=note, ignore_empty_lines=True
            ),
            convert_options=csv.ConvertOptions(
                column_types=kinds, include_columns=kept, decimal_point=layout.dialect.decimal,
                null_values=[*MISSING, *_BLANKS, *options.missing], strings_can_be_null=True,
            ),
        )  # fmt: skip
        for batch in reader:
            columns = batch.columns
            for c in (stamps, date):
                if c is not None and pyarrow.types.is_string(columns[c].type):
                    columns[c] = _instants(path, columns[c], options)
            for c in layout.texts:
                if c not in (stamps, date):
                    columns[c] = pyarrow.nulls(len(batch), pyarrow.float64())
            if stamps is not None and date is not None:
                columns[stamps] = columnar.join_instants(columns[date], columns[stamps])
                columns[date] = pyarrow.nulls(len(batch), pyarrow.float64())
            if len(batch):
                yield columns
    except pyarrow.ArrowInvalid as error:
        raise read_error(path, "text", error) from None
    cut = len(bad) == 1 and bad[0].actual_columns < layout.width
    if bad and not (cut and bad[0].text.strip() == _last_line(path, layout.encoding)):
        row = bad[0]
        line = f"line {row.number + layout.first - skipped}: " if row.number else ""
        raise InputError(
            "file", f"a text file of {layout.width} columns throughout",
            Words(f"{path}, where {len(bad)} lines differ ({line}{row.actual_columns} columns, {row.text[:40]!r})"),
        )  # fmt: skip


def _last_line(path: Path, encoding: str) -> str:
    """Return the last non-empty line of a file, stripped."""
    with open_file(path) as file:
        file.seek(max(0, path.stat().st_size - _LAST_BYTES))
        return file.read().decode(encoding, errors="replace").rstrip().rpartition("\n")[2].strip()


def _body(path: Path, layout: Layout) -> tuple[Any, int, str]:
    """Return the input for pyarrow, lines to skip, and encoding: the file, or a copy with repaired lines."""
    dialect = layout.dialect
    if not (dialect.delimiter == " " or dialect.thousands or layout.encoding == "utf-16" or layout.ragged):
        return str(path), layout.first, layout.encoding.replace("-sig", "")
    mended = []
    lines = path.read_text(encoding=layout.encoding).splitlines()[layout.first :]
    for fields in join_segments(lines, layout) if layout.ragged else map(dialect.fields, lines):
        fields = [dialect.normalise(text) if dialect.is_number(text) else text for text in fields]
        mended.append(dialect.delimiter.join(fields))
    return io.BytesIO("\n".join(mended).encode()), 0, "utf8"


def _time_kind(text: str, layout: Layout, options: FileOptions) -> Any:
    """Return the pyarrow type of a time column; formats that pyarrow does not know are read as text."""
    import pyarrow

    if options.time_format is None and layout.dialect.is_number(text):
        return pyarrow.float64()
    parsed = instant(text, options.time_format)
    if parsed is None:
        must = "set for times that are not numbers (such as %d.%m.%Y %H:%M:%S)"
        raise InputError("file.time_format", must if options.time_format is None else "that of the times", text)
    if options.time_format is not None or not _ISO.match(text) or not isinstance(parsed, datetime):
        return pyarrow.string()
    return pyarrow.timestamp("ns", tz=None if parsed.tzinfo is None else "UTC")


def _instants(path: Path, column: Any, options: FileOptions) -> Any:
    """Convert texts to instants, or to times of day."""
    import pyarrow

    moments: list[Any] = []
    zoned = False
    for text in column.to_pylist():
        moment = instant(str(text), options.time_format)
        if moment is None:
            raise InputError("file.time_format", f"that of the times in {path.name}", str(text))
        if not isinstance(moment, datetime):
            moments.append(moment)
            continue
        zoned = zoned or moment.tzinfo is not None
        utc = moment.astimezone(UTC).replace(tzinfo=None) if moment.tzinfo else moment
        finer = _NANOSECONDS.search(str(text))  # a datetime has microseconds only
        moments.append(np.datetime64(utc, "ns") + np.timedelta64(int(finer[1].ljust(3, "0")) if finer else 0, "ns"))
    instants = isinstance(moments[0], np.datetime64)
    return pyarrow.array(
        np.array(moments), pyarrow.timestamp("ns", tz="UTC" if zoned else None) if instants else pyarrow.float64()
    )


def _quoted(name: str) -> str:
    return printable(name).replace('"', '""')


class CsvRows:
    """CSV file written row by row, with the shortest decimal form of each number, on two threads."""

    def __init__(self, path: Path, names: Sequence[str], *, whole: Collection[str] = ()) -> None:
        """Write the headings.

        Args:
            path: The file.
            names: Headings of the columns.
            whole: Headings of integer columns, in which nan is written as an empty field.
        """
        self._whole = [name in whole for name in names]
        self._file = path.open("wb")
        self._file.write((",".join(f'"{_quoted(name)}"' for name in names) + "\n").encode())
        # Formatting a number takes ten times as long as simulating it, and does not hold the GIL.
        self._background = Background(self._file.write, threads=2)

    def write(self, columns: Sequence[np.ndarray]) -> None:
        """Write rows, column by column, each shape (n,)."""
        self._background.call(_lines, columns, self._whole)

    def close(self) -> None:
        """Write pending rows, and close the file."""
        try:
            self._background.finish()
        finally:
            self._file.close()


def _lines(columns: Sequence[np.ndarray], whole: Sequence[bool]) -> bytes:
    """Return rows as text; without pyarrow, in a minimal install, this is five times slower."""
    try:
        import pyarrow
        from pyarrow import csv
    except ModuleNotFoundError:
        texts = [
            ["" if value != value else f"{value:.0f}" for value in column] if integer else map(repr, column)
            for column, integer in zip((np.asarray(each).tolist() for each in columns), whole, strict=True)
        ]
        return "".join(",".join(row) + "\n" for row in zip(*texts, strict=True)).encode()
    kinds = [pyarrow.int32() if integer else pyarrow.float64() for integer in whole]
    schema = pyarrow.schema([(f"{c}", kind) for c, kind in enumerate(kinds)])
    buffer = io.BytesIO()
    csv.write_csv(columnar.arrow_table(columns, schema), buffer, csv.WriteOptions(include_header=False))
    return buffer.getvalue()


class CsvWriter(columnar.ParquetWriter):
    """Writer of CSV files: `time [s]` and one column per channel."""

    sidecar = True

    def __init__(self, path: Path, selection: Selection) -> None:
        columns = selection.tables[0].columns
        counts = [column.heading for column in columns if selection.unit == "counts" and column.source is not None]
        self._file = CsvRows(path, ["time [s]", *(column.heading for column in columns)], whole=counts)
