"""Files of other measuring systems as signals: what is in them, and the values of each, whatever the format."""

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
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field

from rig.base.checks import DOCUMENT_BYTES, describe_error, load_extensions, open_file, read_json, unreadable
from rig.base.errors import InputError, RefusedError, Words

if TYPE_CHECKING:
    from replays.recordings.formats.mapping import FileOptions


def _check_ending(text: str) -> str:
    if not text.startswith(".") or text in (".", ".mcap") or text != text.lower():
        raise ValueError("an ending in lower case such as .raw, and not .mcap")
    return text


class Format(NamedTuple):
    """A file format that is read, and perhaps written.

    Another package adds one by an entry point of the group `rig.formats` that refers to a `Format`.
    """

    title: str
    """Name in words."""
    suffixes: Annotated[tuple[Annotated[str, AfterValidator(_check_ending)], ...], Field(min_length=1)]
    """Endings of its files, in lower case; one that is written ends in the first."""
    module: str
    """Where `look_into(path, options)` returns a file's `Source`."""
    writer: str = ""
    """Class in that module that writes it (`exporting.export.FormatWriter`); empty: it is read only."""


_OWN = "replays.recordings.formats.readers"
FORMATS = {
    "mdf": Format("MDF", (".mf4", ".mdf", ".dat"), f"{_OWN}.mdf", "MdfWriter"),
    "tdms": Format("TDMS", (".tdms",), f"{_OWN}.tdms", "TdmsWriter"),
    "uff": Format("universal (UFF)", (".uff", ".unv"), f"{_OWN}.uff", "UffWriter"),
    "text": Format("text", (".csv", ".txt", ".asc", ".tsv", ".lvm"), f"{_OWN}.delimited", "CsvWriter"),
    "parquet": Format("Parquet", (".parquet",), f"{_OWN}.columnar", "ParquetWriter"),
    "wav": Format("WAV", (".wav",), f"{_OWN}.wav", "WavWriter"),
}
"""Our own formats by name."""


@cache
def formats() -> dict[str, Format]:
    """Our formats, then those of other packages, by name."""
    return FORMATS | _extensions()[0]


@cache
def _extensions() -> tuple[dict[str, Format], list[str]]:
    found, broken = load_extensions("rig.formats", Format, FORMATS)
    taken = {suffix for each in FORMATS.values() for suffix in each.suffixes}
    for name, form in list(found.items()):
        if twice := taken.intersection(form.suffixes):
            broken.append(f"{name} ({', '.join(sorted(twice))} is the ending of another format)")
            del found[name]
        taken.update(form.suffixes)
    return found, broken


def load_format(form: Format) -> Any:
    """Import the module of a format.

    Raises:
        RefusedError: It cannot be imported, or lacks what the format names.
    """
    try:
        module = importlib.import_module(form.module)
    except RefusedError:
        raise
    except (Exception, SystemExit) as error:  # whatever other people's code raises
        raise RefusedError(f"{form.title} files need {form.module}, which fails: {describe_error(error)}") from None
    for name in ("look_into", form.writer):
        if name and not callable(getattr(module, name, None)):
            raise RefusedError(f"{form.title} files need {name} in {form.module}, which has none")
    return module


_MOST_ABOUT = 2000
"""Longest text that is taken over of what a file tells of itself [characters]; longer ones are documents."""
DOCUMENTS = ("catalogue.json", "parameters.json", "scene.json")
"""What `rig export` attaches."""
MAX_RATE_HZ = 1e9
"""Highest sample rate of a file: one by time stamps in ns [Hz]."""
_MOST_S = 1e12


@dataclass(frozen=True)
class Entry:
    """One signal in a file, before its values are read.

    Attributes:
        name: Its name in the file.
        group: The file's group that it stands in; empty where there are none.
        unit: Unit as the file spells it; empty where it tells none.
        rows: Number of values.
        rate_hz: Rate that the file tells, or that its time stamps have [Hz]; None where it tells neither.
        place: Where the reader finds it.
        label: What the file says about it.
        group_number: Number of the group in the file, from 0.
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
    """The values of one signal.

    Attributes:
        values: Numbers as they stand in the file, integer or float64, shape (n,).
        scale: Physical value of one of them, ...
        offset: ... and physical value of zero: `physical` applies both.
        times_s: Time stamp of each from the file's start [s], shape (n,); None for an even rate.
        rate_hz: The even rate [Hz], if the file tells one.
        first_s: Time of the first value from the file's start [s].
        rails: Numbers at which the converter was at its end, where the file tells.
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
        """Values in the file's unit, float64, shape (n,)."""
        values = self.values.astype(float)
        if (self.scale, self.offset) != (1.0, 0.0):
            values = values * self.scale + self.offset
        return values


@dataclass(frozen=True)
class Source:
    """A file of another measuring system.

    Attributes:
        path: The file.
        format: What it is, in words.
        entries: Its signals.
        read: Reads the values of one of them.
        pieces: Reads some that have the same stamps, row after row in pieces; None: this format is read whole.
        start: When its time zero was, if it tells.
        about: What it tells of itself.
        documents: The rig's own by name, as text, where `rig export` has made the file.
        remarks: What had to be assumed to read it.
        options: What the mapping has to say of the file so that it is read so again.
    """

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
    """Look into a file.

    Raises:
        InputError: It cannot be read, is no such file, or the library for it is missing.
    """
    suffix = path.suffix.lower()
    form = next((each for each in formats().values() if suffix in each.suffixes), None)
    if form is None:
        known = ", ".join(suffix for each in formats().values() for suffix in each.suffixes)
        broken = _extensions()[1]
        unusable = f"; not usable: {', '.join(broken)}" if broken else ""
        raise InputError("file", f"a file that ends in {known}{unusable}", str(path))
    try:
        with open_file(path) as file:
            empty = not file.read(1)
    except OSError as error:
        raise unreadable(path, error) from None
    if empty:
        raise InputError("file", "a file with something in it", str(path))
    if form is not FORMATS["text"]:
        options.only_for_text(path)
    what, module = form.title, load_format(form)
    with _parsing(path, what):
        source = module.look_into(path, options)
        if not isinstance(source, Source):
            raise TypeError(f"{form.module}.look_into returns {type(source).__name__}, no Source")
    if not source.entries:
        raise InputError("file", "a file with signals in it", str(path))
    if not any(entry.rows for entry in source.entries):
        raise InputError("file", "a file with rows of values", Words(f"{path}, which has columns without a row"))

    def read(entry: Entry) -> FileSignal:
        where = f"{what} (signal {entry.name})"
        with _parsing(path, where):
            signal = source.read(entry)
            _check(signal)
        return signal

    def pieces(entries: Sequence[Entry]) -> Iterator[list[FileSignal]]:
        assert source.pieces is not None
        with _parsing(path, what):
            for piece in source.pieces(entries):
                for signal in piece:
                    _check(signal)
                yield piece

    entries = tuple(
        entry if entry.rate_hz is None or 0.0 < entry.rate_hz <= MAX_RATE_HZ else replace(entry, rate_hz=None)
        for entry in source.entries
    )
    distinct = _distinct(entries)
    twice = [
        f"several are named {one.name!r}: this one is {new.name!r}"
        for one, new in zip(entries, distinct, strict=True)
        if one.name != new.name
    ]
    about = {key: text for key, text in source.about.items() if len(text) <= _MOST_ABOUT}
    documents = {name: source.about[name] for name in DOCUMENTS if name in source.about} or _beside(path)
    return replace(
        source, entries=distinct, read=read, pieces=source.pieces and pieces, about=about, documents=documents,
        remarks=(*source.remarks, *twice),
    )  # fmt: skip


def _beside(path: Path) -> dict[str, str]:
    """The rig's documents in FILE.json, where `rig export` puts them beside a format without a place for them."""
    try:
        with open_file(path.with_name(path.name + ".json")) as file:
            told = read_json(file.read(DOCUMENT_BYTES + 1)).get("documents")
    except (OSError, InputError):  # there is none, or it is another program's
        return {}
    found = told if isinstance(told, dict) else {}
    kinds = {name: found.get(name.removesuffix(".json")) for name in DOCUMENTS}
    return {name: json.dumps(document) for name, document in kinds.items() if isinstance(document, dict)}


@contextmanager
def _parsing(path: Path, what: str) -> Iterator[None]:
    """Whatever a library raises on a file that it cannot read, for want of memory too, becomes the one line."""
    try:
        yield
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise damaged(path, what, error) from None


def _check(signal: FileSignal) -> None:
    """See that the numbers of a signal are such that a measurement can have.

    Raises:
        ValueError: They are not.
    """
    values, times_s = signal.values, signal.times_s
    if values.ndim != 1 or values.dtype.kind not in "iufb":
        raise ValueError(f"values of {values.dtype} in {values.ndim} dimensions")
    if signal.rate_hz is not None and not 0.0 < signal.rate_hz <= MAX_RATE_HZ:
        raise ValueError(f"a rate of {signal.rate_hz} Hz")
    if not (math.isfinite(signal.scale) and signal.scale and math.isfinite(signal.offset)):
        raise ValueError(f"a scale of {signal.scale}, an offset of {signal.offset}")
    if not abs(signal.first_s) <= _MOST_S:
        raise ValueError(f"a beginning at {signal.first_s} s")
    if times_s is not None and not (times_s.shape == values.shape and bool((np.abs(times_s) <= _MOST_S).all())):
        raise ValueError(f"time stamps that are no numbers up to {_MOST_S:g} s, one a row")


def _distinct(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """The same with a number behind a name that a group has twice."""
    seen: dict[tuple[str, str], int] = {}
    found = []
    for entry in entries:
        key = (entry.group, entry.name)
        seen[key] = seen.get(key, 0) + 1
        found.append(entry if seen[key] == 1 else replace(entry, name=f"{entry.name} #{seen[key]}"))
    return tuple(found)


def library(what: str, name: str, module: str | None = None) -> Any:
    """An optional library.

    Args:
        what: The format that it is for.
        name: What pip knows it by.
        module: What Python knows it by, if that is another name.

    Raises:
        RefusedError: It is not installed, or fails when it is imported.
    """
    try:
        return importlib.import_module(module or name)
    except Exception as error:  # whatever a broken installation raises
        need = f"{what} files need the package {name}, which is"
        if isinstance(error, ModuleNotFoundError) and error.name == (module or name):
            line = f"{need} not installed: pip install 'rotor-stator-rig[formats]'"
        else:
            broken = f"{need} installed and broken ({type(error).__name__}: {error})"
            line = f"{broken}: pip install --force-reinstall {name}"
        raise RefusedError(line) from None


def damaged(path: Path, what: str, error: BaseException | str) -> InputError:
    """The one line for whatever a library raises on a file that it cannot read."""
    text = error if isinstance(error, str) else describe_error(error)
    return InputError("file", f"an intact {what} file", Words(f"{path} ({text})"[:300]))


def even_rate_hz(times_s: np.ndarray, rows: int | None = None) -> float | None:
    """Return the mean rate of time stamps [Hz]; None where they do not ascend, or faster than a rate can be.

    Args:
        times_s: The stamps, or the first and last of them [s], shape (n,).
        rows: Number of rows, if not all stamps are given.
    """
    span = float(times_s[-1] - times_s[0]) if len(times_s) > 1 else 0.0
    steps = (rows or len(times_s)) - 1
    return steps / span if span > 0.0 and steps <= MAX_RATE_HZ * span else None
