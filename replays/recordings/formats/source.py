"""Access to files of other measuring systems: list of signals and their values, independent of the format."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field

from replays.estimate.clock import find_rate
from replays.estimate.spool import Spool, blocks, spool
from rig.base.checks import DOCUMENT_BYTES, describe_error, load_extensions, read_json
from rig.base.errors import InputError, RefusedError, Words
from rig.base.files import build_read_error, open_file, read_file

if TYPE_CHECKING:
    from replays.recordings.formats.mapping import FileOptions


def _check_ending(text: str) -> str:
    if not text.startswith(".") or text in (".", ".mcap") or text != text.lower():
        raise ValueError("an ending in lower case such as .raw, and not .mcap")
    return text


class Format(NamedTuple):
    """File format that can be read, and possibly written.

    Another package adds one by an entry point of the group `rig.formats` that refers to a `Format`.
    """

    title: str
    """Display name."""
    suffixes: Annotated[tuple[Annotated[str, AfterValidator(_check_ending)], ...], Field(min_length=1)]
    """File suffixes in lower case; written files have the first."""
    module: str
    """Module whose `look_into(path, options)` returns a file's `Source`."""
    writer: str = ""
    """Class in that module that writes the format (`exporting.export.FormatWriter`); empty: read only."""


_READERS_PACKAGE = "replays.recordings.formats.readers"
FORMATS = {
    "mdf": Format("MDF", (".mf4", ".mdf", ".dat"), f"{_READERS_PACKAGE}.mdf", "MdfWriter"),
    "tdms": Format("TDMS", (".tdms",), f"{_READERS_PACKAGE}.tdms", "TdmsWriter"),
    "uff": Format("universal (UFF)", (".uff", ".unv"), f"{_READERS_PACKAGE}.uff", "UffWriter"),
    "text": Format("text", (".csv", ".txt", ".asc", ".tsv", ".lvm"), f"{_READERS_PACKAGE}.delimited", "CsvWriter"),
    "parquet": Format("Parquet", (".parquet",), f"{_READERS_PACKAGE}.columnar", "ParquetWriter"),
    "wav": Format("WAV", (".wav",), f"{_READERS_PACKAGE}.wav", "WavWriter"),
}
"""Built-in formats by name."""


@cache
def formats() -> dict[str, Format]:
    """Return built-in formats, then those of other packages, by name."""
    return FORMATS | _extensions()[0]


@cache
def _extensions() -> tuple[dict[str, Format], list[str]]:
    plugins, broken = load_extensions("rig.formats", Format, FORMATS)
    suffixes_in_use = {suffix for each in FORMATS.values() for suffix in each.suffixes}
    for name, form in list(plugins.items()):
        if renamed := suffixes_in_use.intersection(form.suffixes):
            broken.append(f"{name} ({', '.join(sorted(renamed))} is the ending of another format)")
            del plugins[name]
        suffixes_in_use.update(form.suffixes)
    return plugins, broken


def load_format(form: Format) -> Any:
    """Import the module of a format.

    Raises:
        RefusedError: It cannot be imported, or lacks what the format names.
    """
    try:
        module = importlib.import_module(form.module)
    except RefusedError:
        raise
    except (Exception, SystemExit) as error:  # other packages may raise anything
        raise RefusedError(f"{form.title} files need {form.module}, which fails: {describe_error(error)}") from None
    for name in ("look_into", form.writer):
        if name and not callable(getattr(module, name, None)):
            raise RefusedError(f"{form.title} files need {name} in {form.module}, which lacks it")
    return module


_MAX_PROPERTY_LENGTH = 2000
"""Longest file property that is copied [characters]; longer ones are documents."""
DOCUMENTS = ("catalogue.json", "parameters.json", "scene.json")
"""Documents that `rig export` attaches."""
MAX_RATE_HZ = 1e9
"""Highest sample rate [Hz], given by time stamps in ns."""
_MIN_RATE_HZ = 1e-6
"""Lowest sample rate [Hz]: a value in eleven days."""
_MAX_TIME_S, _MAX_VALUE = 1e12, 1e30
"""Largest time stamp [s], and largest value in any unit; instruments write 9.9e37 for an overload."""


@dataclass(frozen=True)
class Entry:
    """Signal in a file, before its values are read.

    Attributes:
        name: Name in the file.
        group: Group in the file; empty if the file has no groups.
        unit: Unit as spelled in the file; empty if the file has none.
        rows: Number of values.
        rate_hz: Rate in the file or of its time stamps [Hz]; None if it has neither.
        place: Position of the signal, for the reader.
        label: Description in the file.
        group_number: Index of the group in the file, from 0.
    """

    name: str
    group: str
    unit: str
    rows: int
    rate_hz: float | None
    place: Any = None
    label: str = ""
    group_number: int = 0


@dataclass(frozen=True)
class FileSignal:
    """Values of one signal.

    Attributes:
        values: Numbers as stored in the file, integer or float64, shape (n,).
        scale: Physical value per stored unit; `physical` applies scale and offset.
        offset: Physical value of a stored 0.
        times_s: Time of each value from the file's start [s], shape (n,); None for an even rate.
        rate_hz: Even rate [Hz], if the file has one.
        first_s: Time of the first value from the file's start [s].
        rails: Stored numbers at which the converter saturated, if known.
    """

    values: np.ndarray
    scale: float = 1.0
    offset: float = 0.0
    times_s: np.ndarray | None = None
    rate_hz: float | None = None
    first_s: float = 0.0
    rails: tuple[float, float] | None = None

    @property
    def physical(self) -> np.ndarray:
        """Values in the file's unit, nan for those that no measurement has, float64, shape (n,)."""
        return spool(self.convert(rows) for rows in blocks(len(self.values), self.values))

    def convert(self, rows: slice) -> np.ndarray:
        """Return some rows of `physical`."""
        values = self.values[rows].astype(float)
        if self.values.dtype.kind == "f":
            values[~(np.abs(values) <= _MAX_VALUE)] = np.nan
        if (self.scale, self.offset) != (1.0, 0.0):
            values = values * self.scale + self.offset
        return values


@dataclass(frozen=True)
class Source:
    """File of another measuring system.

    Attributes:
        path: The file.
        format: Name of the format.
        entries: Its signals.
        read: Function that reads the values of one signal.
        pieces: Function that reads signals with common time stamps in pieces; None: the format is read whole.
        start: Wall time of the file's time zero, if known.
        about: Properties stored in the file.
        documents: The rig's own documents as text, by name, if `rig export` wrote the file.
        remarks: Assumptions made by the reader.
        options: Options that the mapping needs to read the file the same way.
    """

    CUT_LAST_LINE: ClassVar[str] = "the last line is cut and was ignored"
    """Start of the remark on a text file whose last line is incomplete."""
    path: Path
    format: str
    entries: tuple[Entry, ...]
    read: Callable[[Entry], FileSignal]
    pieces: Callable[[Sequence[Entry]], Iterator[list[FileSignal]]] | None = None
    start: datetime | None = None
    about: dict[str, str] = field(default_factory=dict)
    documents: dict[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    options: dict[str, str | int] = field(default_factory=dict)


def open_source(path: Path, options: FileOptions) -> Source:
    """Open a file and list its signals.

    Raises:
        InputError: The file cannot be read, has another format, or its library is missing.
    """
    suffix = path.suffix.lower()
    form = next((each for each in formats().values() if suffix in each.suffixes), None)
    if form is None:
        suffixes = ", ".join(suffix for each in formats().values() for suffix in each.suffixes)
        broken = _extensions()[1]
        unusable = f"; not usable: {', '.join(broken)}" if broken else ""
        raise InputError("file", f"a file that ends in {suffixes}{unusable}", str(path))
    try:
        with open_file(path) as file:
            empty = not file.read(1)
    except OSError as error:
        raise build_read_error(path, error) from None
    if empty:
        raise InputError("file", "a file that is not empty", str(path))
    if form is not FORMATS["text"]:
        options.reject_text_options(path)
    what, module = form.title, load_format(form)
    with _translate_errors(path, what):
        source = module.look_into(path, options)
        if not isinstance(source, Source):
            raise TypeError(f"{form.module}.look_into returns {type(source).__name__}, not Source")
    if not source.entries:
        raise InputError("file", "a file with signals", str(path))
    if not any(entry.rows for entry in source.entries):
        raise InputError("file", "a file with rows of values", Words(f"{path}, which has columns but no rows"))

    def read(entry: Entry) -> FileSignal:
        where = f"{what} (signal {entry.name})"
        with _translate_errors(path, where):
            signal = source.read(entry)
            _check(signal)
            _check_count(len(signal.values), entry)
        return signal if isinstance(signal.values, np.memmap) else replace(signal, values=spool([signal.values]))

    def pieces(entries: Sequence[Entry]) -> Iterator[list[FileSignal]]:
        assert source.pieces is not None
        rows = 0
        with _translate_errors(path, what):
            for piece in source.pieces(entries):
                for signal in piece:
                    _check(signal)
                rows += len(piece[0].values)
                yield piece
            _check_count(rows, entries[0])

    entries = tuple(
        entry if entry.rate_hz is None or _MIN_RATE_HZ <= entry.rate_hz <= MAX_RATE_HZ else replace(entry, rate_hz=None)
        for entry in source.entries
        if entry.rows
    )
    distinct = _make_distinct(entries)
    remarks = [
        f"several signals are named {one.name!r}; one is renamed to {new.name!r}"
        for one, new in zip(entries, distinct, strict=True)
        if one.name != new.name
    ]
    if empty_count := len(source.entries) - len(entries):
        remarks.append(f"{empty_count} signals without values ignored")
    about = {key: text for key, text in source.about.items() if len(text) <= _MAX_PROPERTY_LENGTH}
    documents = {name: source.about[name] for name in DOCUMENTS if name in source.about} or _read_sidecar(path)
    return replace(
        source, entries=distinct, read=read, pieces=source.pieces and pieces, about=about, documents=documents,
        remarks=(*source.remarks, *remarks),
    )  # fmt: skip


def _read_sidecar(path: Path) -> dict[str, str]:
    """Return the rig's documents from FILE.json, where `rig export` writes them for formats without metadata."""
    try:
        attached = read_json(read_file(path.with_name(path.name + ".json"), DOCUMENT_BYTES)).get("documents")
    except (OSError, InputError):  # missing, or written by another program
        return {}
    documents = attached if isinstance(attached, dict) else {}
    kinds = {name: documents.get(name.removesuffix(".json")) for name in DOCUMENTS}
    return {name: json.dumps(document) for name, document in kinds.items() if isinstance(document, dict)}


@contextmanager
def _translate_errors(path: Path, what: str) -> Iterator[None]:
    """Turn any error of a library on an unreadable file, including lack of memory, into one line."""
    try:
        yield
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise read_error(path, what, error) from None


def join_pieces(pieces: Iterator[list[FileSignal]]) -> FileSignal:
    """Return the pieces of one signal as a whole, in temporary files if they are long."""
    values, times_s = Spool(), Spool()
    signal: FileSignal | None = None
    for (signal,) in pieces:
        values.add(signal.values)
        if signal.times_s is not None:
            times_s.add(signal.times_s)
    if signal is None:
        raise ValueError("no values")
    return replace(signal, values=values.array(), times_s=None if signal.times_s is None else times_s.array())


def _check(signal: FileSignal) -> None:
    """Check that the numbers of a signal are plausible for a measurement.

    Raises:
        ValueError: They are not.
    """
    values, times_s = signal.values, signal.times_s
    if values.ndim != 1 or values.dtype.kind not in "iufb":
        raise ValueError(f"values of {values.dtype} in {values.ndim} dimensions")
    if signal.rate_hz is not None and not _MIN_RATE_HZ <= signal.rate_hz <= MAX_RATE_HZ:
        raise ValueError(f"a rate of {signal.rate_hz} Hz")
    if not (math.isfinite(signal.scale) and signal.scale and math.isfinite(signal.offset)):
        raise ValueError(f"a scale of {signal.scale}, an offset of {signal.offset}")
    if not abs(signal.first_s) <= _MAX_TIME_S:
        raise ValueError(f"a start time of {signal.first_s} s")
    if times_s is not None and not (
        times_s.shape == values.shape
        and all((np.abs(times_s[rows]) <= _MAX_TIME_S).all() for rows in blocks(len(times_s), times_s))
    ):
        raise ValueError(f"time stamps that are not finite numbers up to {_MAX_TIME_S:g} s, one per row")


def _check_count(rows: int, entry: Entry) -> None:
    """Raise ValueError for a signal with fewer values than the file declares."""
    if rows < entry.rows:
        raise ValueError(f"{rows} of {entry.rows} values")


def _make_distinct(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """Return the entries with a number appended to names that repeat in a group."""
    counts: dict[tuple[str, str], int] = {}
    distinct = []
    for entry in entries:
        key = (entry.group, entry.name)
        counts[key] = counts.get(key, 0) + 1
        distinct.append(entry if counts[key] == 1 else replace(entry, name=f"{entry.name} #{counts[key]}"))
    return tuple(distinct)


def load_library(what: str, name: str, module: str | None = None) -> Any:
    """Import an optional library.

    Args:
        what: Format that needs it.
        name: Package name for pip.
        module: Module name for Python, if different.

    Raises:
        RefusedError: It is not installed, or its import fails.
    """
    try:
        return importlib.import_module(module or name)
    except Exception as error:  # a broken installation may raise anything
        need = f"{what} files need the package {name}, which is"
        if isinstance(error, ModuleNotFoundError) and error.name == (module or name):
            line = f"{need} not installed: pip install 'rotor-stator-rig[formats]'"
        else:
            broken = f"{need} installed and broken ({type(error).__name__}: {error})"
            line = f"{broken}: pip install --force-reinstall {name}"
        raise RefusedError(line) from None


def read_error(path: Path, what: str, error: BaseException | str) -> InputError:
    """Return the one-line error for a file that a library cannot read."""
    text = error if isinstance(error, str) else describe_error(error)
    return InputError("file", f"an intact {what} file", Words(f"{path} ({text})"[:300]))


def even_rate_hz(times_s: np.ndarray) -> float | None:
    """Return the rate of time stamps [Hz]; None if they do not ascend, or the rate exceeds the limit.

    Args:
        times_s: The stamps, or the first ones [s], shape (n,).
    """
    if (rate_hz := find_rate(times_s, MAX_RATE_HZ)) is not None:
        return rate_hz
    span = float(times_s[-1] - times_s[0]) if len(times_s) > 1 else 0.0
    steps = len(times_s) - 1
    return steps / span if span > 0.0 and steps <= MAX_RATE_HZ * span else None
