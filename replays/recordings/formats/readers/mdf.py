"""Reading and writing of MDF4 files, common in automotive and test-rig data acquisition, by asammdf."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from traceback import walk_tb
from typing import TYPE_CHECKING, Any
from weakref import finalize

import numpy as np

from replays.recordings.formats.exporting import export
from replays.recordings.formats.source import (
    DOCUMENTS,
    Entry,
    FileSignal,
    Source,
    even_rate_hz,
    join_pieces,
    load_library,
    read_error,
)
from rig.base.errors import InputError
from rig.base.files import find_data_limit, inflate, open_file

if TYPE_CHECKING:
    from replays.recordings.formats.exporting.history import ExportEvent
    from replays.recordings.formats.exporting.selection import ExportChunk, ExportTable, Selection
    from replays.recordings.formats.mapping import FileOptions

_TEXT = re.compile(r"<TX>(.*?)</TX>|<TX/>", re.DOTALL)
"""Text in an XML comment."""
_SYNC_NONE, _SYNC_TIME = 0, 1
"""Kinds of master channel in MDF4; 2 is an angle, 3 a length, 4 an index."""
_PIECE = 1 << 22
"""Bytes of records read at a time."""
_EARLY_ROWS = 1 << 16
"""Records whose stamps give the rate of a group."""
_SCAN_BYTES, _MAX_BLOCK_BYTES = 1 << 20, 1 << 28
"""Bytes that are searched for blocks at a time, and most bytes of a block that are measured."""
_HEAD, _FLAGS = 64, 4
"""Size of the first block, and of the flags at its end that mark an unfinished file, in MDF4."""
_MASTER, _REMOTE_MASTER = 2, 8
"""Channel type of recorded time stamps, and group flag of stamps stored in another group, in MDF4."""
_MARKER, _BY_TOOL = 6, 2
"""Type and cause of an event in MDF4."""
_IDENTITY, _LINEAR = 0, 1
"""Conversion types in MDF4; no conversion is the identity as well."""


@contextmanager
def _suppress_output() -> Iterator[None]:
    """Suppress deprecation warnings inside asammdf, numpy and pandas, and asammdf's prints on slow reading."""
    with warnings.catch_warnings(), redirect_stdout(StringIO()):
        for category in (DeprecationWarning, FutureWarning, PendingDeprecationWarning):
            warnings.simplefilter("ignore", category)
        yield


def look_into(path: Path, options: FileOptions) -> Source:
    """Open an MDF file (version 3 or 4) and list its signals.

    Raises:
        InputError: The file is not MDF, or asammdf is missing.
    """
    mdf = _open(path)
    with _suppress_output():
        _check_records(mdf, find_data_limit(path.stat().st_size))
        entries, texts = _entries(mdf, options)

    def read(entry: Entry) -> FileSignal:
        if _has_own_stamps(mdf, entry.group_number):
            return join_pieces(pieces([entry]))
        with _suppress_output():
            group, index = entry.place
            return _signal(mdf, group, index, options)

    def pieces(signals: Sequence[Entry]) -> Iterator[list[FileSignal]]:
        group = signals[0].group_number
        if not _has_own_stamps(mdf, group):
            yield [read(entry) for entry in signals]
            return
        second, master = _time_unit_s(mdf, group, options), mdf.masters_db[group]
        kinds = [_find_scale(mdf, *entry.place) for entry in signals]
        columns = [(master, None), *zip((entry.place[1] for entry in signals), kinds, strict=True)]
        streams: list[Iterator[Any]] = [
            mdf.iter_get(group=group, index=index, samples_only=True, raw=kind is not None) for index, kind in columns
        ]
        while True:
            with _suppress_output():
                blocks = [next(stream, ()) for stream in streams]
            if not blocks[0]:
                return
            times_s = None if second is None else np.asarray(blocks[0][0], dtype=float) * second
            yield [_from_records(part, kind, times_s) for part, kind in zip(blocks[1:], kinds, strict=True)]

    remarks = (f"non-numeric channels left out: {', '.join(texts)}",) if texts else ()
    about = {"version": str(mdf.version), "comment": str(mdf.header.description or ""), **_documents(mdf)}
    return Source(
        path, f"MDF {mdf.version}", tuple(entries), read, pieces, start=mdf.header.start_time,
        about={key: text for key, text in about.items() if text}, remarks=remarks,
    )  # fmt: skip


def _documents(mdf: Any) -> dict[str, str]:
    """Return the documents that `rig export` attached."""
    documents = {}
    for index, attachment in enumerate(mdf.attachments if str(mdf.version) >= "4" else ()):
        if attachment.file_name in DOCUMENTS:
            content, *_ = mdf.extract_attachment(index=index)
            documents[attachment.file_name] = bytes(content).decode(errors="replace")
    return documents


def _find_compressed_blocks(path: Path) -> Iterator[bytes]:
    """Yield the data of all blocks that are compressed by zlib."""
    # Read by parts, not mapped: a mapped file that another process truncates would end this process.
    with open_file(path) as file:
        number, begin = file.fileno(), 0
        with suppress(OSError):  # at the last data of the file; its holes are skipped
            while len(part := os.pread(number, _SCAN_BYTES, begin := os.lseek(number, begin, os.SEEK_DATA))) > 3:
                for found in re.finditer(b"##(DZ|AT)", part):
                    first = begin + found.start() + (48 if found[1] == b"DZ" else 96)
                    size = int.from_bytes(os.pread(number, 8, first - 8), "little")  # the last field of both headers
                    yield os.pread(number, min(size, _MAX_BLOCK_BYTES), first)
                begin += len(part) - 3


def _open(path: Path) -> Any:
    asammdf = load_library("MDF", "asammdf")
    for _ in inflate(_find_compressed_blocks(path), path.stat().st_size):
        pass  # refuses too much data before asammdf decompresses it
    file = open_file(path)
    finished = file.read(_HEAD)[-_FLAGS:] == bytes(_FLAGS)
    try:
        with _suppress_output():
            # Given a path, asammdf maps the whole file into memory, and repairs a copy of an unfinished one.
            mdf = asammdf.MDF(file if finished else path)
            mdf.configure(read_fragment_size=_PIECE)
            finalize(mdf, file.close)
            # The object is part of a reference cycle, and the collector may close its temporary file first.
            finalize(mdf, mdf._mdf._tempfile.close)  # noqa: SLF001 - its own ways to close it wait for the collector
            return mdf
    except Exception as error:
        file.close()
        # The partly constructed object of an unreadable file closes itself on collection and prints an error. Closing
        # it here prevents that.
        for frame, _ in walk_tb(error.__traceback__):
            with suppress(Exception):
                frame.f_locals["self"].close()
        raise read_error(path, "MDF", error) from None


def _check_records(mdf: Any, data_limit: int) -> None:
    """Refuse channels outside their records, for which asammdf would read other memory, and records that fill it.

    Raises:
        ValueError: There is such a channel, or the records of a group exceed the limit [bytes].
    """
    for group in mdf.groups:
        about = group.channel_group
        record_bits = 8 * (about.samples_byte_nr + getattr(about, "invalidation_bytes_nr", 0))
        if record_bits // 8 * max(1, about.cycles_nr) > data_limit:
            raise ValueError(f"{about.cycles_nr} records of {record_bits // 8} bytes")
        for channel in group.channels:
            # Version 3 has one offset in bits and further bytes, version 4 bytes and bits.
            fields = (("start_offset", 1), ("additional_byte_offset", 8), ("byte_offset", 8), ("bit_offset", 1))
            first = sum(bits * getattr(channel, name, 0) for name, bits in fields)
            if first + channel.bit_count > record_bits:
                raise ValueError(f"channel {channel.name} outside its record")


def _entries(mdf: Any, options: FileOptions) -> tuple[list[Entry], list[str]]:
    entries, texts = [], list[str]()
    for number, group in enumerate(mdf.groups):
        rows = int(group.channel_group.cycles_nr)
        if not rows:
            continue
        name = str(getattr(group.channel_group, "acq_name", "") or f"group {number}")
        scale = _time_unit_s(mdf, number, options)
        early = mdf.get_master(number, record_offset=0, record_count=min(rows, _EARLY_ROWS))
        rate = None if scale is None else even_rate_hz(np.asarray(early, dtype=float) * scale)
        master = mdf.masters_db.get(number)
        for index, channel in enumerate(group.channels):
            if index == master:
                continue
            if not _numeric(mdf, number, index):
                texts.append(str(channel.name))
                continue
            unit = str(channel.unit or getattr(channel.conversion, "unit", "") or "")
            text = _TEXT.search(str(channel.comment or ""))
            label = (text[1] or "") if text else str(channel.comment or "")
            entries.append(Entry(str(channel.name), name, unit, rows, rate, (number, index), label, number))
    return entries, texts


def _time_unit_s(mdf: Any, group: int, options: FileOptions) -> float | None:
    """Return the unit of a group's master channel [s]; None if it has none, or is an angle, a length or an index.

    The format requires seconds; some programs write other units.
    """
    index = mdf.masters_db.get(group)
    if index is None:
        return None
    master = mdf.groups[group].channels[index]
    if getattr(master, "sync_type", _SYNC_TIME) not in (_SYNC_NONE, _SYNC_TIME):
        return None
    unit = str(master.unit or getattr(master.conversion, "unit", "") or "")
    _, size_s, zero = options.time_in_s("", unit, 0.0)
    if zero:
        raise InputError(
            "file.time_unit", "a unit of durations, such as s or d, with MDF files", options.time_unit or unit
        )
    return size_s


def _numeric(mdf: Any, group: int, index: int) -> bool:
    try:
        few = mdf.get(group=group, index=index, record_offset=0, record_count=2, ignore_invalidation_bits=True).samples
    except Exception:  # what cannot be decoded is not numeric
        return False
    return few.ndim == 1 and few.dtype.kind in "iufb"


def _has_own_stamps(mdf: Any, group: int) -> bool:
    """Return whether the stamps of a group are in its own records, which can then be read in pieces."""
    master, stored = mdf.masters_db.get(group), mdf.groups[group]
    own = not getattr(stored.channel_group, "flags", 0) & _REMOTE_MASTER
    return str(mdf.version) >= "4" and master is not None and own and stored.channels[master].channel_type == _MASTER


def _find_scale(mdf: Any, group: int, index: int) -> tuple[float, float] | None:
    """Return scale and offset of a channel's integers; None if they are not integers, or not linear."""
    arguments = {"group": group, "index": index, "record_offset": 0, "record_count": 1}
    raw = mdf.get(raw=True, ignore_invalidation_bits=True, **arguments)
    law = raw.conversion
    kind = _IDENTITY if law is None else law.conversion_type
    if raw.samples.dtype.kind not in "iu" or kind not in (_IDENTITY, _LINEAR):
        return None
    return (1.0, 0.0) if law is None or kind == _IDENTITY else (float(law.a), float(law.b))


def _signal(mdf: Any, group: int, index: int, options: FileOptions) -> FileSignal:
    kind, second = _find_scale(mdf, group, index), _time_unit_s(mdf, group, options)
    data = mdf.get(group=group, index=index, raw=kind is not None, ignore_invalidation_bits=True)
    times_s = None if second is None else np.asarray(data.timestamps, dtype=float) * second
    return _from_records((data.samples, data.invalidation_bits), kind, times_s)


def _from_records(record: Sequence[Any], linear: tuple[float, float] | None, times_s: np.ndarray | None) -> FileSignal:
    values, invalid = record
    if linear is None:
        values = values.astype(float)
    if invalid is not None and np.any(invalid):
        values = values.astype(float)
        values[np.asarray(invalid, dtype=bool)] = np.nan
    scale, offset = linear or (1.0, 0.0)
    return FileSignal(values=values, scale=scale, offset=offset, times_s=times_s)


def _event(event: ExportEvent) -> Any:
    """Return a marker for an event, to the microsecond of the rig's clock, valid for all groups."""
    from asammdf.blocks.v4_blocks import EventBlock

    block = EventBlock(
        event_type=_MARKER, sync_type=_SYNC_TIME, cause=_BY_TOOL, flags=0, sync_base=round(event.time_s * 1e6),
        sync_factor=1e-6,
    )  # fmt: skip
    block.name, block.comment = event.name, event.text
    return block


class MdfWriter(export.FormatWriter):
    """Writer of MDF 4.10 files: one channel group per sensor group, integer counts with a linear conversion.

    Events are MDF events; the rig's documents are attached.
    """

    sparse = True

    def __init__(self, path: Path, selection: Selection) -> None:
        asammdf = load_library("MDF", "asammdf")
        self._path = path
        self._selection = selection
        self._signal = asammdf.Signal
        self._groups: dict[str, int] = {}
        with _suppress_output():
            self._file = asammdf.MDF(version="4.10")
            self._file.header.start_time = selection.start
            self._file.header.description = selection.summary()
            self._file.header.project, self._file.header.subject = "rotor-stator-rig", selection.metadata["scene"]
            for name, text in selection.documents.items():
                self._file.attach(text.encode(), file_name=name, comment="of the rig", mime="application/json")
            self._file.events.extend(map(_event, selection.events))

    def write(self, table: ExportTable, chunk: ExportChunk) -> None:
        """Write rows; those that no stream has are left out."""
        present = chunk.present
        times_s = chunk.times_s[present]
        if not len(times_s):
            return
        columns: Sequence[np.ndarray] = [table.raw(c, chunk)[present] for c in range(len(table.columns))]
        with _suppress_output():
            if table.name in self._groups:
                pairs = [(times_s, None), *((values, None) for values in columns)]
                self._file.extend(self._groups[table.name], pairs)
                return
            signals = [
                self._signal(
                    samples=values, timestamps=times_s, name=column.name, unit=column.unit,
                    comment=column.describe(table.title),
                    conversion=None if column.linear is None else dict(zip("ab", column.linear, strict=True)),
                )
                for column, values in zip(table.columns, columns, strict=True)
            ]  # fmt: skip
            number = self._file.append(signals, acq_name=table.name, comment=table.title, common_timebase=True)
        self._groups[table.name] = number

    def close(self) -> None:
        """Write the file."""
        # Given a path, asammdf would change the suffix.
        with _suppress_output(), self._path.open("wb+") as file:
            self._file.save(file)
            self._file.close()

    def abandon(self) -> None:
        """Release the file."""
        with _suppress_output():
            self._file.close()
