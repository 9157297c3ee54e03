"""Layout of text files, detected from the first lines as far as the mapping does not define it."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from rig.base import units
from rig.base.errors import InputError, Words
from rig.base.files import open_file

if TYPE_CHECKING:
    from replays.recordings.formats.mapping import FileOptions

_HEAD_LINES, _COMPARED_LINES = 2000, 100
"""Lines among which the first line of data is searched, and lines of data that determine the layout."""
_DELIMITERS = {"tab": "\t", "comma": ",", "semicolon": ";", "space": " "}
_MARKS = (
    "nan", "n/a", "na", "null", "none", "nil", "inf", "-inf", "--", "---", "-", "*", "**", "***", "?", "over", "ovl",
    "ovr", "ol", "overload", "overflow", "overrange", "under", "underrange", "error", "err", "fault", "bad", "invalid",
    "missing", "open", "#n/a", "#na", "#num!", "#div/0!", "#value!", "#ref!", "#null!", "1.#inf", "-1.#inf", "1.#qnan",
    "-1.#qnan", "1.#ind", "-1.#ind", "1.#snan", "1.#inf00", "-1.#inf00", "1.#qnan0", "-1.#ind00",
)  # fmt: skip
MISSING = ["", "NaN", *dict.fromkeys(form(text) for text in _MARKS for form in (str, str.upper, str.capitalize))]
"""Texts for a missing or invalid value."""
_LVM = "LabVIEW Measurement"
_LVM_END = "***End_of_Header***"
_HEADING = re.compile(r"\s*(.*?)\s*[\[(]([^\])]*)[\])]\s*")
_TIMES = re.compile(
    r"[\W_]*((elapsed|abs|absolute|rel|relative|local|utc|gps|log|daq|system|sample|sampling|record|meas|test)[ ._-]*)?"
    r"(times?|zeit|uhrzeit|zeitstempel|timestamps?|time[ _-]stamps?|temps|tiempo|tempo|czas|tijd"
    r"|t|x_value|seconds|secs?|datetime|date.?time)([ _].*|\W*)",
    re.IGNORECASE,
)
_DAY = (
    r"(?P<y>\d{4})[-/.](?P<m>\d{1,2})[-/.](?P<d>\d{1,2})"
    r"|(?P<a>\d{1,2})(?P<s>[-/. ])(?P<b>\d{1,2}|[A-Za-zä]{3,9})\.?[-/. ](?P<z>\d{4}|\d\d)"
)
_TIME_OF_DAY = (
    r"(?P<hour>\d{1,2}):(?P<minute>\d\d):(?P<second>\d\d)"
    r"(?:[.,:](?P<part>\d+))?\s*(?:(?P<pm>[AP])\.?M\.?)?"
)
_MOMENT = re.compile(rf"(?:{_DAY})?(?:^|$|[T,]? *)(?:{_TIME_OF_DAY})?", re.IGNORECASE)
_MAX_DAY_S, _MONTHS_OF_A_YEAR, _MIN_TEXT_LINES = 90_000.0, 12, 4
"""Largest time of day [s], and fewest lines of data by which columns of text are recognised."""
_MONTHS = ("jan", "feb", "mar mär", "apr", "may mai", "jun", "jul", "aug", "sep", "oct okt", "nov", "dec dez")


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
    texts: tuple[int, ...] = ()
    """Columns of text among the names."""
    ragged: bool = False
    """True if lines may have additional fields, empty ones or a comment."""
    stamps: tuple[int, ...] | None = None
    """Column of the times of each column, where LabVIEW writes several; else None."""
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
        return _lvm_layout(path, path.read_text(encoding=encoding).split("\n"), encoding, options)
    layouts = [layout for dialect in _dialects(options) if (layout := _layout(lines, dialect, encoding, options))]
    if not layouts:
        grouped = [Dialect(*marks) for marks in (
            (";", ",", "."), ("\t", ",", "."), (";", ",", " "), ("\t", ",", " "), (",", ".", ","), (";", ".", ","),
            ("\t", ".", ","), (";", ".", "'"), (";", ",", "'"),
        )] if options.thousands is None else []  # fmt: skip
        layouts = [layout for dialect in grouped if (layout := _layout(lines, dialect, encoding, options))]
    if not layouts:
        layouts = [
            found for each in _dialects(options) if (found := _layout(lines, each, encoding, options, texts=True))
        ]
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
    return replace(layout, remarks=remarks)


def _dialects(options: FileOptions) -> list[Dialect]:
    thousands = options.thousands or ""
    if options.delimiter is not None:
        delimiter = _DELIMITERS.get(options.delimiter, options.delimiter)
        pairs = [(delimiter, mark) for mark in ([options.decimal] if options.decimal else [".", ","])]
    else:
        pairs = [("\t", "."), ("\t", ","), (";", ","), (";", "."), ("|", "."), (",", "."), (" ", ".")]
        pairs = [pair for pair in pairs if options.decimal in (None, pair[1])]
    return [Dialect(*pair, thousands) for pair in pairs if pair[0] != pair[1] != thousands]


def _layout(
    lines: list[str], dialect: Dialect, encoding: str, options: FileOptions, *, texts: bool = False
) -> tuple[bool, Layout] | None:
    """Return the layout for a dialect, and whether its columns have names; None if the dialect does not fit."""
    first = (_text_data_start if texts else _data_start)(lines, dialect, options)
    if first is None:
        return None
    width = len(dialect.fields(lines[first]))
    part = lines[first : first + _COMPARED_LINES]
    data = [fields for line in part if line.strip() and len(fields := dialect.fields(line)) == width]
    # A delimiter at the end of every line does not make a column, unless that has a name.
    open_end = width > 1 and dialect.delimiter != " " and all(not fields[-1] for fields in data)
    names, names_at = _names(lines, first, dialect, width, options, open_end=open_end)
    unit_row = _units(lines, first, names_at, dialect, len(names), options)
    headings = [parse_heading(name) for name in names]
    both = tuple(unit or row for (_, unit), row in zip(headings, unit_row, strict=True))
    plain = tuple(name for name, _ in headings)
    words = _find_texts(data, len(plain), dialect, options)
    return names_at is not None, Layout(encoding, dialect, plain, both, first, width, texts=words)


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
        time_format: Format for strptime; None: ISO 8601, or a date and a time of day in a common order. Numbers with
            slashes are month/day/year, unless the first one is above 12.
    """
    try:
        if time_format is not None:  # strptime accepts at most six digits of a second
            return datetime.strptime(re.sub(r"([.,]\d{6})\d+", r"\1", text), time_format)
        match = _MOMENT.fullmatch(text.strip())
        if match is None or not (match["hour"] or match["y"] or match["z"]):
            return datetime.fromisoformat(text.replace(",", "."))
        seconds = 0.0
        if match["hour"]:
            hour = int(match["hour"]) % 12 + 12 * (match["pm"] in "Pp") if match["pm"] else int(match["hour"])
            seconds = 3600.0 * hour + 60.0 * int(match["minute"]) + int(match["second"])
        part = match["part"] or "0"
        if not (match["y"] or match["z"]):
            return seconds + float(f"0.{part}") if seconds < _MAX_DAY_S else None
        return datetime(*_day(match)) + timedelta(seconds=seconds, microseconds=int(part.ljust(6, "0")[:6]))
    except (ValueError, StopIteration):
        return None


def _day(match: re.Match[str]) -> tuple[int, int, int]:
    """Return year, month and day of a matched date."""
    if match["y"]:
        return int(match["y"]), int(match["m"]), int(match["d"])
    year, first, second = int(match["z"]) + 2000 * (len(match["z"]) == 2), int(match["a"]), match["b"].lower()
    if second.isalpha():
        return year, next(n for n, names in enumerate(_MONTHS, 1) if second[:3] in names.split()), first
    day_first = match["s"] == "." or first > _MONTHS_OF_A_YEAR
    return (year, int(second), first) if day_first else (year, first, int(second))


def has_ambiguous_date(text: str) -> bool:
    """Return whether month and day of a date could be either way round."""
    match = _MOMENT.fullmatch(text.strip())
    if match is None or not match["z"] or match["s"] == "." or match["pm"] or not match["b"].isdigit():
        return False
    return match["a"] != match["b"] and max(int(match["a"]), int(match["b"])) <= _MONTHS_OF_A_YEAR


def _kind(text: str, dialect: Dialect, options: FileOptions) -> str:
    """Return the kind of a field: number, instant or text; empty for a missing value."""
    if not text or text in MISSING or text in options.missing:
        return ""
    return "number" if dialect.is_number(text) else "text" if instant(text, options.time_format) is None else "instant"


def _find_texts(rows: Sequence[Sequence[str]], columns: int, dialect: Dialect, options: FileOptions) -> tuple[int, ...]:
    """Return the columns in which most values are texts."""
    kinds = [[_kind(row[c], dialect, options) for row in rows] for c in range(columns)]
    return tuple(c for c, each in enumerate(kinds) if 2 * each.count("text") > sum(map(bool, each)))


def _text_data_start(lines: list[str], dialect: Dialect, options: FileOptions) -> int | None:
    """Return the first line of the longest sequence of lines with columns of one kind each, some of them numbers."""
    if options.first_line is not None:
        return _data_start(lines, dialect, options)
    best, start, kinds, size = (0, 0), None, list[str](), 0
    for n, line in enumerate(lines):
        if not line.strip():
            continue
        fields = [_kind(text, dialect, options) for text in dialect.fields(line)]
        same = len(fields) == len(kinds) and all(not a or not b or a == b for a, b in zip(kinds, fields, strict=True))
        if start is None or not same:
            start, kinds, size = n, fields, 0
        kinds, size = [a or b for a, b in zip(kinds, fields, strict=True)], size + 1
        if "number" in kinds and len(kinds) > 1:
            best = max(best, (size, -start))
    return -best[1] if best[0] >= _MIN_TEXT_LINES else None


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
    for at, n in enumerate(filled):
        if (size := width(lines[n])) and all(width(lines[other]) == size for other in filled[at + 1 : at + 3]):
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


def _lvm_head(lines: Sequence[str], tab: str) -> tuple[dict[str, list[str]], float | None, datetime | None]:
    """Return the header of a segment of a LabVIEW file, the first time of its rows [s], and its start."""
    head = {key: [value.strip() for value in values] for key, *values in (line.split(tab) for line in lines)}
    date, clock = (next(iter(head.get(key, [])), "") for key in ("Date", "Time"))
    start = instant(f"{date} {clock}", None)
    return head, _lvm_number(head, "X0"), start if isinstance(start, datetime) else None


def _lvm_number(head: dict[str, list[str]], key: str) -> float | None:
    try:
        return float(next(text for text in head.get(key, []) if text).replace(",", "."))
    except (StopIteration, ValueError):
        return None


def join_segments(lines: Sequence[str], layout: Layout) -> list[list[str]]:
    """Return the fields of a LabVIEW file's rows without the headers of later segments, with times if there are any.

    Args:
        lines: Lines from the first row on.
        layout: Layout of the first segment.
    """
    tab, decimal, width = layout.dialect.delimiter, layout.dialect.decimal, layout.width
    rows, late_s, number, step = list[list[str]](), 0.0, 0, 1.0 / layout.rate_hz if layout.rate_hz else 0.0
    first_s, restarts, in_head, head_lines = layout.first_s, False, False, list[str]()
    for line in lines:
        if line.startswith(_LVM_END):
            head, x0, start = _lvm_head(head_lines, tab)
            step, first_s, number, restarts = _lvm_number(head, "Delta_X") or step, x0 or 0.0, -1, True
            if start is not None and layout.start is not None:
                late_s = (start - layout.start).total_seconds()
            in_head = False
        elif in_head or line.startswith("Channels" + tab):
            in_head, head_lines = True, [*(head_lines if in_head else []), line]
        elif number < 0:  # the names of the columns
            number = 0
        elif line.strip():
            fields = (layout.dialect.fields(line) + [""] * width)[:width]
            if layout.rate_hz and not layout.empty_first:
                fields[0] = repr(late_s + first_s + number * step).replace(".", decimal)
            elif restarts and late_s:
                for c in {*(layout.stamps or (0,))}:
                    own_s = fields[c].replace(decimal, ".")
                    fields[c] = repr(late_s + float(own_s)).replace(".", decimal) if own_s else ""
            rows.append(fields)
            number += 1
    return rows


def _lvm_layout(path: Path, lines: list[str], encoding: str, options: FileOptions) -> Layout:
    """Return the layout of a LabVIEW measurement file from its header (National Instruments' specification of .lvm)."""
    lines = [line.rstrip("\r") for line in lines]
    ends = [n for n, line in enumerate(lines) if line.startswith(_LVM_END)]
    if len(ends) < 2:
        raise InputError("file", "a LabVIEW measurement file with a header of its data", str(path))
    tab = next((line.split("Separator")[1][:1] for line in lines if line.startswith("Separator")), "\t")
    head, first_s, start = _lvm_head(lines[: ends[1]], tab)
    decimal = (head.get("Decimal_Separator") or ["."])[0] or "."
    mode = (head.get("X_Columns") or ["No"])[0].lower()
    first, step, empty = ends[1] + 2, _lvm_number(head, "Delta_X"), mode == "no"
    names = [name.strip() for name in "".join(lines[first - 1 : first]).split(tab)]
    names = names[:-1] if names[-1] == "Comment" else names
    if not "".join(lines[first:]).strip():
        raise InputError("file", "a file with rows of values", Words(f"{path}, which has columns but no rows"))
    width = min(len(names), max(len(line.split(tab)) for line in lines[first : first + _COMPARED_LINES]))
    names, texts, stamps, at = names[:width], head.get("Y_Unit_Label", []), list[int](), 0
    for c, name in enumerate(names):
        at = c if name == "X_Value" else at
        stamps.append(at)
    channels = (c for c, at in enumerate(stamps) if c != at)
    units_by_column = dict(zip(channels, texts, strict=False))
    unit_row = [units_by_column.get(c, "") for c in range(width)]
    dialect = Dialect(tab, decimal)
    early = [(dialect.fields(line) + [""] * width)[:width] for line in lines[first : first + _COMPARED_LINES]]
    hidden = empty and len(ends) == 2  # with several segments, the empty column receives their times
    words = [c - hidden for c in _find_texts(early, width, dialect, options) if c not in stamps]
    return Layout(
        encoding, dialect, tuple(names[hidden:]), tuple(unit_row[hidden:]), first, width, empty_first=hidden,
        texts=tuple(words), ragged=True, stamps=tuple(stamps) if mode == "multi" else None,
        rate_hz=1.0 / step if empty and step else None, first_s=first_s or 0.0, start=start,
        remarks=(
            "LabVIEW measurement file: dialect, units and rate are from its header",
            *([f"{len(ends) - 1} segments, each at the time of its header"] if len(ends) > 2 else []),
        ),
    )  # fmt: skip
