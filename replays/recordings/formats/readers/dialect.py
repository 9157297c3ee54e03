"""Layout of text files, detected from the first lines as far as the mapping does not define it."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from rig.base import units
from rig.base.errors import InputError, Words
from rig.base.files import open_file

if TYPE_CHECKING:
    from replays.recordings.formats.mapping import FileOptions

_HEAD_LINES = 200
_DELIMITERS = {"tab": "\t", "comma": ",", "semicolon": ";", "space": " "}
MISSING = ["", "nan", "NaN", "NAN", "n/a", "NA", "null", "--", "---", "-", "#N/A", "1.#QNAN", "-1.#IND", "Overload"]
"""Texts for a missing value."""
_LVM = "LabVIEW Measurement"
_LVM_END = "***End_of_Header***"
_HEADING = re.compile(r"\s*(.*?)\s*[\[(]([^\])]*)[\])]\s*")
_TIMES = re.compile(r"(time|zeit|timestamp|timestamps|t|x_value|seconds|datetime|date.?time)([ _].*)?", re.IGNORECASE)
_TIME_OF_DAY = re.compile(r"(\d{1,2}):(\d\d):(\d\d(?:[.,]\d+)?)")


@dataclass(frozen=True)
class Dialect:
    """Format of numbers in a line."""

    delimiter: str
    decimal: str
    thousands: str = ""
    """Separator between groups of three digits; empty: none."""

    def fields(self, line: str) -> list[str]:
        """Return the fields of a line, without quotes and surrounding spaces."""
        line = line.rstrip("\r\n")
        if self.delimiter == " ":
            return [text.strip('"') for text in line.split()]
        if '"' in line:
            return [text.strip() for text in next(csv.reader([line], delimiter=self.delimiter, skipinitialspace=True))]
        return [text.strip() for text in line.split(self.delimiter)]

    def normalise(self, text: str) -> str:
        """Return a number without digit separators."""
        return re.sub(r"\s", "", text) if self.thousands == " " else text.replace(self.thousands or "\0", "")

    def is_number(self, text: str) -> bool:
        """Return whether a text is a number or a missing value."""
        if not text or text in MISSING:
            return True
        if self.thousands:
            group = r"\s" if self.thousands == " " else re.escape(self.thousands)
            text = self.normalise(text) if re.match(rf"[-+]?\d{{1,3}}({group}\d{{3}})+(?!\d)", text) else text
        if self.decimal != "." and "." in text:
            return False
        try:
            float(text.replace(self.decimal, "."))
        except ValueError:
            return False
        return "_" not in text  # Python accepts it


@dataclass(frozen=True)
class Layout:
    """Layout of a text file; lines count from 0."""

    encoding: str
    dialect: Dialect
    names: tuple[str, ...]
    units: tuple[str, ...]
    first: int
    """First line of data."""
    width: int
    """Fields of a line of data, possibly with an empty one at either end."""
    empty_first: bool = False
    """True if the first field of every line is empty, where LabVIEW omits its time column."""
    ragged: bool = False
    """True if lines may have additional fields, empty ones or a comment."""
    rate_hz: float | None = None
    first_s: float = 0.0
    start: datetime | None = None
    remarks: tuple[str, ...] = ()


def parse_heading(text: str) -> tuple[str, str]:
    """Return name and unit of a heading such as `disk_x [mm]`, `P_N (N)` or `disk_x, mm`."""
    match = _HEADING.fullmatch(text)
    if match and match[1]:
        return match[1], match[2]
    name, comma, unit = (part.strip() for part in text.rpartition(","))
    return (name, unit) if comma and name and unit and units.is_known(unit) else (text.strip(), "")


def is_time(name: str) -> bool:
    """Return whether a heading names a time column."""
    return _TIMES.fullmatch(name.strip()) is not None


def time_column(names: Sequence[str], wanted: str | int | None, *, path: Path) -> int | None:
    """Return the index of the time column: the requested one, else the first with a name of a time.

    Raises:
        InputError: There is no such column.
    """
    if wanted is None:
        return next((c for c, name in enumerate(names) if is_time(name)), None)
    if wanted == "none":
        return None
    if isinstance(wanted, int) and 1 <= wanted <= len(names):
        return wanted - 1
    if wanted in names:
        return names.index(str(wanted))
    must = f'a column of {path.name} ({", ".join(names)}), its number from 1, or "none"'
    raise InputError("file.time_column", must, wanted)


def find_layout(path: Path, options: FileOptions) -> Layout:
    """Detect the layout of a text file.

    Raises:
        InputError: The layout is not recognised.
    """
    text, encoding, remarks = _head(path, options.encoding)
    lines = text.splitlines()
    if lines and lines[0].startswith(_LVM):
        return _lvm_layout(path, text.split("\n"), encoding)
    layouts = [layout for dialect in _dialects(options) if (layout := _layout(lines, dialect, encoding, options))]
    if not layouts:
        grouped = [Dialect(*marks) for marks in (
            (";", ",", "."), ("\t", ",", "."), (";", ",", " "), ("\t", ",", " "), (",", ".", ","), (";", ".", ","),
            ("\t", ".", ","), (";", ".", "'"), (";", ",", "'"),
        )] if options.thousands is None else []  # fmt: skip
        layouts = [layout for dialect in grouped if (layout := _layout(lines, dialect, encoding, options))]
    if not layouts:
        must = "a text file with lines of numbers (set file.delimiter, decimal, thousands, time_format)"
        raise InputError("file", must, str(path))
    # A layout with column names is preferred; then the one with most numeric columns.
    layout = max(layouts, key=lambda item: (item[0], item[1].width))[1]
    dialect = layout.dialect
    if options.delimiter is None:
        shown = {value: key for key, value in _DELIMITERS.items()}.get(dialect.delimiter, dialect.delimiter)
        grouping = f", thousands {dialect.thousands!r}" if dialect.thousands else ""
        line = layout.first + 1
        remarks += (f"read with delimiter {shown}, decimal {dialect.decimal!r}{grouping}, first line of data {line}",)
    return Layout(encoding, dialect, layout.names, layout.units, layout.first, layout.width, remarks=remarks)


def _dialects(options: FileOptions) -> list[Dialect]:
    thousands = options.thousands or ""
    if options.delimiter is not None:
        delimiter = _DELIMITERS.get(options.delimiter, options.delimiter)
        pairs = [(delimiter, mark) for mark in ([options.decimal] if options.decimal else [".", ","])]
    else:
        pairs = [("\t", "."), ("\t", ","), (";", ","), (";", "."), ("|", "."), (",", "."), (" ", ".")]
        pairs = [pair for pair in pairs if options.decimal in (None, pair[1])]
    return [Dialect(*pair, thousands) for pair in pairs if pair[0] != pair[1] != thousands]


def _layout(lines: list[str], dialect: Dialect, encoding: str, options: FileOptions) -> tuple[bool, Layout] | None:
    """Return the layout for a dialect, and whether its columns have names; None if the dialect does not fit."""
    first = _data_start(lines, dialect, options)
    if first is None:
        return None
    width = len(dialect.fields(lines[first]))
    data = [fields for line in lines[first:] if line.strip() and len(fields := dialect.fields(line)) == width]
    # A delimiter at the end of every line does not make a column, unless that has a name.
    open_end = width > 1 and dialect.delimiter != " " and all(not fields[-1] for fields in data)
    names, names_at = _names(lines, first, dialect, width, options, open_end=open_end)
    unit_row = _units(lines, first, names_at, dialect, len(names), options)
    headings = [parse_heading(name) for name in names]
    both = tuple(unit or row for (_, unit), row in zip(headings, unit_row, strict=True))
    plain = tuple(name for name, _ in headings)
    return names_at is not None, Layout(encoding, dialect, plain, both, first, width)


def _head(path: Path, encoding: str | None) -> tuple[str, str, tuple[str, ...]]:
    with open_file(path) as file:
        raw = b"".join(file.readline(1 << 16) for _ in range(_HEAD_LINES))
    if encoding is None and raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encoding = "utf-16"
        raw = raw[: len(raw) // 2 * 2]  # the line was cut within its end
    if b"\0" in raw and encoding is None:
        raise InputError("file", "a text file", Words(f"{path}, which is binary"))
    try:
        return raw.decode(encoding or "utf-8-sig"), encoding or "utf-8-sig", ()
    except LookupError:
        raise InputError("file.encoding", "a text encoding such as utf-8, latin-1, cp1252", encoding) from None
    except UnicodeDecodeError as error:
        if encoding is not None:
            raise InputError("file.encoding", "that of the file", Words(f"{encoding} ({error.reason})")) from None
        return raw.decode("latin-1"), "latin-1", ("read as latin-1, as it is not UTF-8",)


def instant(text: str, time_format: str | None) -> datetime | float | None:
    """Return a date with time, or a time of day [s]; None for other texts.

    Args:
        text: The text.
        time_format: Format for strptime; None: ISO 8601, or hours:minutes:seconds.
    """
    try:
        if time_format is not None:  # strptime accepts at most six digits of a second
            return datetime.strptime(re.sub(r"([.,]\d{6})\d+", r"\1", text), time_format)
        day = _TIME_OF_DAY.fullmatch(text)
        if day:
            return 3600.0 * int(day[1]) + 60.0 * int(day[2]) + float(day[3].replace(",", "."))
        return datetime.fromisoformat(text.replace(",", "."))
    except ValueError:
        return None


def _data_start(lines: list[str], dialect: Dialect, options: FileOptions) -> int | None:
    """Return the first line of only numbers and a date or time that is followed by similar lines."""
    if options.first_line is not None:
        return options.first_line - 1 if options.first_line <= len(lines) else None

    def width(line: str) -> int:
        fields = dialect.fields(line)
        texts = [text for text in fields if not dialect.is_number(text)]
        moments = [instant(text, options.time_format) for text in texts]
        date_and_time = len(texts) == 2 and {type(each) for each in moments} == {datetime, float}
        good = len(texts) < sum(map(bool, fields)) and (len(texts) <= 1 or date_and_time)
        return len(fields) if good and None not in moments else 0

    filled = [n for n, line in enumerate(lines) if line.strip()]
    widths = [width(lines[n]) for n in filled]
    for at, (n, size) in enumerate(zip(filled, widths, strict=True)):
        if size and all(other == size for other in widths[at : at + 3]):
            return n
    return None


def _names(
    lines: list[str], first: int, dialect: Dialect, width: int, options: FileOptions, *, open_end: bool
) -> tuple[list[str], int | None]:
    """Return the names of the columns, and their line; an empty last column without a name is dropped."""
    columns = width - open_end
    numbered = [f"column {c + 1}" for c in range(columns)]

    def named(fields: list[str]) -> list[str] | None:
        """Return the line as names, if it is as long as a line of data."""
        if columns > 1 and len(fields) > columns and not any(fields[columns:]):
            fields = fields[:columns]  # names may have trailing delimiters that data lines lack
        return fields if len(fields) in (columns, width) else None

    if options.header_line == 0:
        return numbered, None
    if options.header_line is not None:
        at = options.header_line - 1
        fields = dialect.fields(lines[at]) if at < len(lines) else []
        if len(fields) < columns:
            raise InputError("file.header_line", f"a line of {columns} names", options.header_line)
        return fields[:columns], at
    # The nearest line above the data with this many texts that is not a line of units.
    above = [n for n in range(first - 1, -1, -1) if lines[n].strip()]
    if columns == 1:
        above = [n for n in above[:1] if not lines[n].startswith("#")]
    candidates = [n for n in above if named(dialect.fields(lines[n]))][:3]
    for at in candidates:
        fields = named(dialect.fields(lines[at])) or []
        if not all(_looks_like_unit(text) for text in fields) or at == candidates[-1]:
            return [text.lstrip("#").strip() or f"column {c + 1}" for c, text in enumerate(fields)], at
    return numbered, None


def _looks_like_unit(text: str) -> bool:
    return units.is_known(text.strip("[]()"))


def _units(
    lines: list[str], first: int, names_at: int | None, dialect: Dialect, columns: int, options: FileOptions
) -> list[str]:
    at = None if options.units_line is None else options.units_line - 1
    if at is None and names_at is not None and names_at + 1 < first:
        fields = dialect.fields(lines[names_at + 1])
        at = names_at + 1 if any(text and _looks_like_unit(text) for text in fields) else None
    if at is None or at >= len(lines):
        return [""] * columns
    fields = [text.strip("[]()") for text in dialect.fields(lines[at])]
    return (fields + [""] * columns)[:columns]


def _lvm_layout(path: Path, lines: list[str], encoding: str) -> Layout:
    """Return the layout of a LabVIEW measurement file from its header (National Instruments' specification of .lvm)."""
    head: dict[str, list[str]] = {}
    ends = [n for n, line in enumerate(lines) if line.startswith(_LVM_END)]
    tab = next((line.rstrip("\r").split("Separator")[1][:1] for line in lines if line.startswith("Separator")), "\t")
    for line in lines[: ends[-1]] if ends else []:
        key, *values = line.rstrip("\r").split(tab)
        head[key] = [value.strip() for value in values]
    if len(ends) < 2:
        raise InputError("file", "a LabVIEW measurement file with a header of its data", str(path))
    decimal = (head.get("Decimal_Separator") or ["."])[0] or "."
    mode = (head.get("X_Columns") or ["No"])[0].lower()
    if mode not in ("no", "one"):
        raise InputError("file", "a .lvm file with at most one time column", Words(f"{path} (X_Columns {mode})"))

    def number(key: str) -> float | None:
        try:
            return float(next(text for text in head.get(key, []) if text).replace(decimal, "."))
        except (StopIteration, ValueError):
            return None

    first = ends[1] + 2
    names = [name.strip() for name in lines[first - 1].rstrip("\r").split(tab)]
    width = len(lines[first].rstrip("\r").split(tab))
    names = tuple(names[:width])
    unit_row = (["", *head.get("Y_Unit_Label", [])] + [""] * width)[:width]
    step = number("Delta_X")
    empty = mode == "no"
    date, clock = (next(iter(head.get(key, [])), "") for key in ("Date", "Time"))
    start = None
    match = re.match(r"(\d+)/(\d+)/(\d+) (\d+):(\d+):(\d+)(?:[.,](\d{1,6}))?", f"{date} {clock}")
    if match:
        parts = [int(part) for part in match.groups()[:6]]
        start = datetime(*parts[:6], int((match[7] or "0").ljust(6, "0")))  # type: ignore[misc]
    return Layout(
        encoding, Dialect(tab, decimal), names[empty:], tuple(unit_row[empty:]), first, width, empty_first=empty,
        ragged=True, rate_hz=1.0 / step if empty and step else None, first_s=number("X0") or 0.0,
        start=start, remarks=("LabVIEW measurement file: dialect, units and rate are from its header",),
    )  # fmt: skip
