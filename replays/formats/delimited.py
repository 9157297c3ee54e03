"""Text with delimiters: CSV in all its dialects, and LabVIEW's measurement files (.lvm). Parsed by pyarrow.

What a mapping does not say is found out: delimiter, decimal comma, lines of names and units, the column of times.
"""

from __future__ import annotations

import io
import re
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.formats import columnar
from replays.formats import unit as units
from replays.formats.source import Entry, Signal, Source, damaged, even_rate_hz
from rig.errors import InputError

if TYPE_CHECKING:
    from replays.formats.mapping import FileOptions
    from replays.formats.selection import Chunk, Selection, Table

_HEAD_LINES = 200
_DELIMITERS = {"tab": "\t", "comma": ",", "semicolon": ";", "space": " "}
_MISSING = ["", "nan", "NaN", "NAN", "n/a", "NA", "null", "--", "---", "-", "#N/A", "1.#QNAN", "-1.#IND", "Overload"]
_LVM = "LabVIEW Measurement"
_LVM_END = "***End_of_Header***"


@dataclass(frozen=True)
class _Layout:
    """Where things are in a text file; lines count from 0."""

    encoding: str
    delimiter: str
    decimal: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    first: int
    """First line of data."""
    empty_first: bool = False
    """The first field of every line is empty, as LabVIEW leaves its column of times."""
    rate_hz: float | None = None
    first_s: float = 0.0
    start: datetime | None = None
    remarks: tuple[str, ...] = ()


def open_file(path: Path, options: FileOptions) -> Source:
    """Look into a text file and read its columns.

    Raises:
        InputError: It cannot be understood; the message names what is missing or the line.
    """
    layout = _layout(path, options)
    table = _parse(path, layout, options)
    columns = [columnar.numbers(column) for column in table.columns]
    names = list(layout.names)
    stamps = None if layout.empty_first else columnar.time_column(names, options.time_column, path=path)
    times_s, start = None, layout.start
    if stamps is not None:
        start = start or columnar.first_instant(table.column(stamps))
        times_s = columns[stamps] * options.time_scale(layout.units[stamps])
        if np.isnan(times_s).any():
            line = layout.first + int(np.argmax(np.isnan(times_s))) + 1
            raise InputError("file.time_column", "a column without holes", f"{path}, line {line}")
    rate = layout.rate_hz if times_s is None else even_rate_hz(times_s)
    entries = tuple(
        Entry(name, "", layout.units[c], len(columns[c]), rate, c) for c, name in enumerate(names) if c != stamps
    )

    def read(entry: Entry) -> Signal:
        values = columns[entry.place]
        return Signal(values=values, times_s=times_s, rate_hz=layout.rate_hz, first_s=layout.first_s)

    told: dict[str, str | int] = {"delimiter": layout.delimiter, "decimal": layout.decimal}
    told["first_line"] = layout.first + 1
    if stamps is not None:
        told["time_column"] = names[stamps] or stamps + 1
    return Source(
        path=path, format="text", entries=entries, read=read, start=start, remarks=layout.remarks, options=told
    )


def _layout(path: Path, options: FileOptions) -> _Layout:
    text, encoding, remarks = _head(path, options.encoding)
    lines = text.splitlines()
    if lines and lines[0].startswith(_LVM):
        return _lvm_layout(path, text.split("\n"), encoding)
    if options.delimiter is not None:
        delimiter = _DELIMITERS.get(options.delimiter, options.delimiter)
        dialects = [(delimiter, mark) for mark in ([options.decimal] if options.decimal else [".", ","])]
    else:
        pairs = [("\t", "."), ("\t", ","), (";", ","), (";", "."), ("|", "."), (",", "."), (" ", ".")]
        dialects = [pair for pair in pairs if options.decimal in (None, pair[1])]
    found = [(_data_start(lines, *dialect, options), dialect) for dialect in dialects]
    found = [(start, dialect) for start, dialect in found if start is not None and dialect[0] != dialect[1]]
    if not found:
        raise InputError("input", "a text file with lines of numbers (file.delimiter, file.decimal say how)", str(path))
    # The dialect that makes most columns of a line, all of them numbers.
    first, (delimiter, decimal) = max(
        found, key=lambda item: len(lines[item[0]].split(item[1][0])) if item[0] is not None else 0
    )
    assert first is not None
    width = len(_fields(lines[first], delimiter))
    names, names_at = _names(lines, first, delimiter, width, options)
    units_row = _units(lines, first, names_at, delimiter, width, options)
    headings = [columnar.parse_heading(name) for name in names]
    told = tuple(unit or row for (_, unit), row in zip(headings, units_row, strict=True))
    if options.delimiter is None:
        shown = {value: key for key, value in _DELIMITERS.items()}.get(delimiter, delimiter)
        remarks += (f"read with delimiter {shown}, decimal {decimal!r}, first line of data {first + 1}",)
    plain = _distinct([name for name, _ in headings])
    return _Layout(encoding, delimiter, decimal, plain, told, first, remarks=remarks)


def _head(path: Path, encoding: str | None) -> tuple[str, str, tuple[str, ...]]:
    with path.open("rb") as file:
        raw = b"".join(file.readline(1 << 16) for _ in range(_HEAD_LINES))
    if encoding is None and raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encoding = "utf-16"
    if b"\0" in raw and encoding is None:
        raise InputError("input", "a text file", f"{path}, which is binary")
    try:
        return raw.decode(encoding or "utf-8-sig"), encoding or "utf-8-sig", ()
    except LookupError:
        raise InputError("file.encoding", "a text encoding such as utf-8, latin-1, cp1252", encoding) from None
    except UnicodeDecodeError as error:
        if encoding is not None:
            raise InputError("file.encoding", "that of the file", f"{encoding} ({error.reason})") from None
        return raw.decode("latin-1"), "latin-1", ("read as latin-1, as it is no UTF-8",)


def _fields(line: str, delimiter: str) -> list[str]:
    line = line.rstrip("\r\n")
    parts = line.split() if delimiter == " " else line.split(delimiter)
    if len(parts) > 1 and not parts[-1].strip():
        parts.pop()  # a delimiter that ends the line
    return [part.strip().strip('"').strip() for part in parts]


def _is_number(text: str, decimal: str) -> bool:
    if not text or text in _MISSING:
        return True
    if decimal != "." and "." in text:
        return False
    try:
        float(text.replace(decimal, "."))
    except ValueError:
        return False
    return True


def _is_instant(text: str) -> bool:
    try:
        datetime.fromisoformat(text)
    except ValueError:
        return False
    return True


def _data_start(lines: list[str], delimiter: str, decimal: str, options: FileOptions) -> int | None:
    """First of the lines that are all numbers, by a delimiter; the next ones must be so, too."""
    if options.first_line is not None:
        return options.first_line - 1 if options.first_line <= len(lines) else None

    def width(line: str) -> int:
        fields = _fields(line, delimiter)
        body = [text for c, text in enumerate(fields) if not (c == 0 and _is_instant(text))]
        good = any(body) and all(_is_number(text, decimal) for text in body)
        return len(fields) if good and (line.strip() or delimiter == "\t") else 0

    widths = [width(line) for line in lines]
    for n, size in enumerate(widths):
        if size and all(other == size for other in widths[n : n + 3]):
            return n
    return None


def _names(
    lines: list[str], first: int, delimiter: str, width: int, options: FileOptions
) -> tuple[list[str], int | None]:
    numbered = [f"column {c + 1}" for c in range(width)]
    if options.header_line == 0:
        return numbered, None
    if options.header_line is not None:
        at = options.header_line - 1
        fields = _fields(lines[at], delimiter) if at < len(lines) else []
        if len(fields) < width:
            raise InputError("file.header_line", f"a line of {width} names", options.header_line)
        return fields[:width], at
    # The line nearest to the data with so many texts, above a line of units.
    candidates = [n for n in range(first - 1, -1, -1) if len(_fields(lines[n], delimiter)) == width > 1]
    candidates = candidates or [n for n in range(first - 1, first - 2, -1) if n >= 0 and width == 1]
    for at in candidates[:3]:
        fields = _fields(lines[at], delimiter)
        if not all(_looks_like_unit(text) for text in fields) or at == candidates[min(2, len(candidates) - 1)]:
            return [text.lstrip("#").strip() or f"column {c + 1}" for c, text in enumerate(fields)], at
    return numbered, None


def _looks_like_unit(text: str) -> bool:
    return units.known(text.strip("[]()"))


def _units(
    lines: list[str], first: int, names_at: int | None, delimiter: str, width: int, options: FileOptions
) -> list[str]:
    at = None if options.units_line is None else options.units_line - 1
    if at is None and names_at is not None and names_at + 1 < first:
        fields = _fields(lines[names_at + 1], delimiter)
        at = names_at + 1 if fields and any(text and _looks_like_unit(text) for text in fields) else None
    if at is None or at >= len(lines):
        return [""] * width
    fields = lines[at].rstrip("\r\n").split(None if delimiter == " " else delimiter)
    fields = [text.strip().strip('"').strip().strip("[]()") for text in fields]
    return (fields + [""] * width)[:width]


def _distinct(names: Sequence[str]) -> tuple[str, ...]:
    seen: dict[str, int] = {}
    found = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        found.append(name if seen[name] == 1 else f"{name} #{seen[name]}")
    return tuple(found)


def _lvm_layout(path: Path, lines: list[str], encoding: str) -> _Layout:
    """A LabVIEW measurement file: its own header tells the dialect (National Instruments' specification of .lvm)."""
    head: dict[str, list[str]] = {}
    ends = [n for n, line in enumerate(lines) if line.startswith(_LVM_END)]
    tab = next((line.rstrip("\r").split("Separator")[1][:1] for line in lines if line.startswith("Separator")), "\t")
    for line in lines[: ends[-1]] if ends else []:
        key, *values = line.rstrip("\r").split(tab)
        head[key] = [value.strip() for value in values]
    if len(ends) < 2:
        raise InputError("input", "a LabVIEW measurement file with a header of its data", str(path))
    decimal = (head.get("Decimal_Separator") or ["."])[0] or "."
    mode = (head.get("X_Columns") or ["No"])[0].lower()
    if mode not in ("no", "one"):
        raise InputError("input", "a .lvm file with no or one column of times", f"{path} (X_Columns {mode})")

    def number(key: str) -> float | None:
        try:
            return float(next(text for text in head.get(key, []) if text).replace(decimal, "."))
        except (StopIteration, ValueError):
            return None

    first = ends[1] + 2
    names = [name.strip() for name in lines[first - 1].rstrip("\r").split(tab)]
    width = len(lines[first].rstrip("\r").split(tab))
    names = _distinct(names[:width])
    told = (["", *head.get("Y_Unit_Label", [])] + [""] * width)[:width]
    step = number("Delta_X")
    empty = mode == "no"
    date, clock = (next(iter(head.get(key, [])), "") for key in ("Date", "Time"))
    start = None
    match = re.match(r"(\d+)/(\d+)/(\d+) (\d+):(\d+):(\d+)(?:[.,](\d{1,6}))?", f"{date} {clock}")
    if match:
        parts = [int(part) for part in match.groups()[:6]]
        start = datetime(*parts[:6], int((match[7] or "0").ljust(6, "0")))  # type: ignore[misc]
    return _Layout(
        encoding, tab, decimal, names[1:] if empty else names, tuple(told[1:] if empty else told), first,
        empty_first=empty, rate_hz=1.0 / step if empty and step else None, first_s=number("X0") or 0.0, start=start,
        remarks=("LabVIEW measurement file: dialect, units and rate from its header",),
    )  # fmt: skip


def _parse(path: Path, layout: _Layout, options: FileOptions) -> Any:
    import pyarrow
    from pyarrow import csv

    width = len(layout.names) + layout.empty_first
    numbered = [f"c{c}" for c in range(width)]
    kept = numbered[layout.empty_first :]
    bad: list[Any] = []

    def note(row: Any) -> str:
        bad.append(row)
        return "skip"

    kinds: dict[str, Any] = dict.fromkeys(kept, pyarrow.float64())
    stamps = None
    if not layout.empty_first:
        stamps = columnar.time_column(list(layout.names), options.time_column, path=path)
    source, skipped = _body(path, layout, width)
    if stamps is not None and options.time_unit in (None, "datetime"):
        kinds[kept[stamps]] = _time_kind(path, layout, stamps, options)
    try:
        table = csv.read_csv(
            source,
            read_options=csv.ReadOptions(
                column_names=numbered, skip_rows=skipped, use_threads=False,
                encoding=layout.encoding.replace("-sig", ""),
            ),
            parse_options=csv.ParseOptions(
                delimiter=layout.delimiter, invalid_row_handler=note, ignore_empty_lines=True
            ),
            convert_options=csv.ConvertOptions(
                column_types=kinds, include_columns=kept, decimal_point=layout.decimal,
                null_values=[*_MISSING, *options.missing], strings_can_be_null=True,
            ),
        )  # fmt: skip
    except pyarrow.ArrowInvalid as error:
        raise damaged(path, "text", error) from None
    if bad:
        row = bad[0]
        line = f"line {row.number + layout.first - skipped}: " if row.number else ""
        raise InputError(
            "input", f"a text file of {width} columns throughout",
            f"{path}, where {len(bad)} lines are not so ({line}{row.actual_columns} columns, {row.text[:40]!r})",
        )  # fmt: skip
    if not table.num_rows:
        raise InputError("input", "a text file with lines of numbers", str(path))
    for c, name in enumerate(kept):
        column = table.column(name)
        stamp = c == stamps and pyarrow.types.is_string(column.type)
        if stamp:
            table = table.set_column(c, name, _instants(path, column, options))
    return table


def _body(path: Path, layout: _Layout, width: int) -> tuple[Any, int]:
    """What pyarrow parses, and how many of its lines to skip: the file, or a copy with its lines mended."""
    with path.open("rb") as file:
        head = [file.readline() for _ in range(layout.first + 3)][layout.first :]
    mends = layout.delimiter == " " or layout.encoding == "utf-16"
    ending = all(line.decode(layout.encoding, "replace").rstrip("\r\n").count(layout.delimiter) >= width
                 for line in head if line.strip())  # fmt: skip
    if not mends and not ending and width > 1:
        return str(path), layout.first
    text = path.read_text(encoding=layout.encoding)
    lines = [layout.delimiter.join(_fields(line, layout.delimiter)) for line in text.splitlines()[layout.first :]]
    return io.BytesIO("\n".join(lines).encode(layout.encoding.replace("-sig", ""))), 0


def _time_kind(path: Path, layout: _Layout, stamps: int, options: FileOptions) -> Any:
    import pyarrow

    with path.open(encoding=layout.encoding) as file:
        line = [file.readline() for _ in range(layout.first + 1)][layout.first]
    text = _fields(line, layout.delimiter)[stamps]
    if options.time_format is not None:
        return pyarrow.string()
    if _is_number(text, layout.decimal):
        return pyarrow.float64()
    if not _is_instant(text):
        raise InputError("file.time_format", "given for times that are no numbers (such as %d.%m.%Y %H:%M:%S)", text)
    return pyarrow.timestamp("ns")


def _instants(path: Path, column: Any, options: FileOptions) -> Any:
    import pyarrow

    assert options.time_format is not None
    found = []
    for text in column.to_pylist():
        try:
            # strptime takes six digits of a second at most.
            found.append(datetime.strptime(re.sub(r"(\.\d{6})\d+", r"\1", str(text)), options.time_format))
        except ValueError:
            raise InputError("file.time_format", f"that of the times in {path.name}", str(text)) from None
    return pyarrow.chunked_array([pyarrow.array(found, pyarrow.timestamp("us"))])


class Rows:
    """A CSV file that grows by rows: numbers in the fewest digits that give them back, on two threads."""

    def __init__(self, path: Path, schema: Any) -> None:
        from pyarrow import csv

        self._csv = csv
        self._schema = schema
        self._file = path.open("wb")
        self._file.write((",".join(f'"{name}"' for name in schema.names) + "\n").encode())
        # Formatting a number takes ten times as long as simulating it, and needs no lock.
        self._pool = ThreadPoolExecutor(max_workers=2)
        self._due: deque[Future[bytes]] = deque()

    def write(self, columns: Sequence[np.ndarray]) -> None:
        """Take rows, column by column, each shape (n,)."""
        self._due.append(self._pool.submit(self._format, columnar.arrow_table(columns, self._schema)))
        while len(self._due) > 4:
            self._file.write(self._due.popleft().result())

    def _format(self, table: Any) -> bytes:
        buffer = io.BytesIO()
        self._csv.write_csv(table, buffer, self._csv.WriteOptions(include_header=False))
        return buffer.getvalue()

    def close(self) -> None:
        """Write what is left."""
        try:
            while self._due:
                self._file.write(self._due.popleft().result())
        finally:
            self._pool.shutdown(cancel_futures=True)
            self._file.close()


class Writer:
    """A CSV file: `time [s]` and a column a channel."""

    merged = True
    sidecar = True

    def __init__(self, path: Path, selection: Selection) -> None:
        import pyarrow

        table = selection.tables[0]
        kind = pyarrow.int32() if selection.unit == "counts" else pyarrow.float64()
        fields = [("time [s]", pyarrow.float64())]
        fields += [(column.heading, pyarrow.float64() if column.source is None else kind) for column in table.columns]
        self._rows = Rows(path, pyarrow.schema(fields))

    def write(self, table: Table, chunk: Chunk) -> None:
        """Take rows; those that no stream has are left out."""
        values = [table.exported(c, chunk)[chunk.present] for c in range(len(table.columns))]
        self._rows.write([chunk.times_s[chunk.present], *values])

    def close(self) -> None:
        """Write what is left."""
        self._rows.close()

    def abandon(self) -> None:
        """Let go of the file."""
        self._rows.close()
