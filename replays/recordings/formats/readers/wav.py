"""Reading and writing of WAV files by soundfile (libsndfile): channels of one rate, with their full scales."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat

from replays.estimate.spool import ROWS, spool
from replays.recordings.formats.exporting import export
from replays.recordings.formats.source import Entry, FileSignal, Source, load_library
from rig.base.checks import DOCUMENT_BYTES, check
from rig.base.errors import InputError, Words
from rig.base.files import read_file

if TYPE_CHECKING:
    from replays.recordings.formats.exporting.selection import ExportChunk, ExportTable, Selection
    from replays.recordings.formats.mapping import FileOptions

_PCM = {"PCM_U8": 8, "PCM_16": 16, "PCM_24": 24, "PCM_32": 32}
_FLOAT_BITS = 24
"""Word length of counts that single precision represents exactly."""
RULE = (
    "value = sample * full_scale + offset, with sample from -1 to 1; of integer samples, sample = integer / 2^31 "
    "(32 bits), which is the converter's count shifted to the left"
)


def look_into(path: Path, options: FileOptions) -> Source:
    """Open a WAV file; names, units and full scales come from FILE.wav.json if it exists.

    Raises:
        InputError: The file is not WAV, or soundfile is missing.
    """
    soundfile = load_library("WAV", "soundfile")
    with soundfile.SoundFile(path) as file:
        rate, channels, rows, subtype = file.samplerate, file.channels, file.frames, file.subtype
        comment = file.copy_metadata().get("comment", "")
    bits = _PCM.get(subtype)
    columns, first_s, start = _read_sidecar(path, channels)
    about = {"samples": subtype, **({"comment": comment} if comment else {})}
    entries = tuple(
        Entry(column.name or f"channel {c + 1}", "", column.unit, rows, float(rate), c, column.label)
        for c, column in enumerate(columns)
    )

    def read(entry: Entry) -> FileSignal:
        with soundfile.SoundFile(path) as file:
            kind, shift = ("float64", 0) if bits is None else ("int32", 32 - bits)
            parts = (block[:, entry.place] for block in file.blocks(ROWS, dtype=kind, always_2d=True))
            values = spool(part >> shift if shift else part.copy() for part in parts)
        column = columns[entry.place]
        full, offset = column.full_scale, column.offset_exported
        rails = None
        if bits is not None:
            full /= 2.0 ** (bits - 1)
            rails = (-(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1.0)
        return FileSignal(values=values, scale=full, offset=offset, rate_hz=float(rate), first_s=first_s, rails=rails)

    return Source(path=path, format=f"WAV {subtype}", entries=entries, read=read, about=about, start=start)


class _Column(BaseModel):
    """Description of a channel in the sidecar document."""

    name: str = ""
    unit: str = ""
    label: str = ""
    full_scale: FiniteFloat = 1.0
    offset_exported: FiniteFloat = 0.0


class _SidecarTable(BaseModel):
    first_s: FiniteFloat
    columns: Annotated[tuple[_Column, ...], Field(min_length=1)]


class _Sidecar(BaseModel):
    start: datetime
    tables: Annotated[tuple[_SidecarTable, ...], Field(min_length=1, max_length=1)]


def _read_sidecar(path: Path, channels: int) -> tuple[tuple[_Column, ...], float, datetime | None]:
    """Return channels, first time [s] and start from the sidecar document; defaults if there is none.

    Raises:
        InputError: The document is not from this rig, or belongs to another file.
    """
    beside = path.with_name(path.name + ".json")
    if not beside.is_file():
        return (_Column(),) * channels, 0.0, None
    sidecar = check(_Sidecar, read_file(beside, DOCUMENT_BYTES), field=beside.name, most_bytes=DOCUMENT_BYTES)
    table = sidecar.tables[0]
    if len(table.columns) != channels:
        raise InputError(beside.name, f"of a file with {channels} channels", len(table.columns))
    return table.columns, table.first_s, sidecar.start


class WavWriter(export.FormatWriter):
    """Writer of WAV files. Counts are 32-bit integers, other values floating point from -1 to 1."""

    merged = True
    sidecar = True

    def __init__(self, path: Path, selection: Selection) -> None:
        soundfile = load_library("WAV", "soundfile")
        table = selection.tables[0]
        if not float(table.rate_hz).is_integer():
            raise InputError("rate_hz", "a whole number for a WAV file", table.rate_hz)
        if len(table.columns) > 1024:
            raise InputError("channels", "at most 1024 in a WAV file", len(table.columns))
        if not selection.is_complete(table):
            raise InputError(
                "range", "free of missing rows for a WAV file (set from_s and to_s)", Words("one with gaps")
            )
        truth = any(column.source is None for column in table.columns)
        bits = max((column.source.adc_bits for column in table.columns if column.source is not None), default=64)
        self._integers = selection.unit == "counts" and not truth
        subtype = "PCM_32" if self._integers else "DOUBLE" if truth or bits > _FLOAT_BITS else "FLOAT"
        large = table.rows * len(table.columns) * 8 > 0xFFFF0000
        self._file = soundfile.SoundFile(
            path, "w", samplerate=round(table.rate_hz), channels=len(table.columns), subtype=subtype,
            format="RF64" if large else "WAV",
        )  # fmt: skip
        scales = "; ".join(f"{column.name}: {column.full_scale:.9g} {column.unit}" for column in table.columns)
        self._file.title = f"{selection.metadata['scene']} {selection.metadata['recording']}"
        self._file.date = selection.start.isoformat()
        self._file.comment = f"{RULE}. full_scale {scales}"[:2000]

    def write(self, table: ExportTable, chunk: ExportChunk) -> None:
        """Write rows."""
        if self._integers:
            shifts = [32 - column.source.adc_bits for column in table.columns if column.source is not None]
            samples = np.stack([table.raw(c, chunk) << shift for c, shift in enumerate(shifts)], axis=1)
        else:
            # A sample is the count over half of the converter's range, independent of the unit.
            halves = [1.0 if column.source is None else 2.0 ** (column.source.adc_bits - 1) for column in table.columns]
            samples = chunk.values / np.array(halves)
        self._file.write(samples)
