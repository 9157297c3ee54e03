"""WAV, by soundfile (libsndfile): every channel of one rate, with the full scale that a sample of 1 stands for."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from replays.formats.source import Entry, Signal, Source, damaged, library
from rig.errors import InputError

if TYPE_CHECKING:
    from replays.formats.mapping import FileOptions
    from replays.formats.selection import Chunk, Selection, Table

_PCM = {"PCM_U8": 8, "PCM_16": 16, "PCM_24": 24, "PCM_32": 32}
_FLOAT_BITS = 24
"""Counts of so many bits are exact in single precision."""
RULE = (
    "value = sample * full_scale + offset, with sample from -1 to 1; of integer samples, sample = integer / 2^31 "
    "(32 bits), which is the converter's count shifted to the left"
)


def open_file(path: Path, options: FileOptions) -> Source:
    """Look into a WAV file; names, units and full scales come from FILE.wav.json if it stands beside it.

    Raises:
        InputError: It is none, or soundfile is missing.
    """
    soundfile = library("soundfile")
    try:
        with soundfile.SoundFile(path) as file:
            rate, channels, rows, subtype = file.samplerate, file.channels, file.frames, file.subtype
            comment = file.copy_metadata().get("comment", "")
    except Exception as error:
        raise damaged(path, "WAV", error) from None
    bits = _PCM.get(subtype)
    columns, start = _beside(path, channels)
    about = {"samples": subtype, **({"comment": comment} if comment else {})}
    entries = tuple(
        Entry(
            str(columns[c].get("name", f"channel {c + 1}")), "", str(columns[c].get("unit", "")), rows, float(rate), c,
            str(columns[c].get("label", "")),
        )
        for c in range(channels)
    )  # fmt: skip

    def read(entry: Entry) -> Signal:
        try:
            with soundfile.SoundFile(path) as file:
                parts = [
                    block[:, entry.place].copy()
                    for block in file.blocks(1 << 16, dtype="float64" if bits is None else "int32", always_2d=True)
                ]
        except Exception as error:
            raise damaged(path, "WAV", error) from None
        values = np.concatenate(parts) if parts else np.empty(0)
        column = columns[entry.place]
        full, offset = float(column.get("full_scale", 1.0)), float(column.get("offset_exported", 0.0))
        first_s = float(column.get("first_s", 0.0))
        rails = None
        if bits is not None:
            shift = 32 - bits
            values = values.astype(np.int32) >> shift
            full /= 2.0 ** (bits - 1)
            rails = (-(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1.0)
        return Signal(values=values, scale=full, offset=offset, rate_hz=float(rate), first_s=first_s, rails=rails)

    return Source(path=path, format=f"WAV {subtype}", entries=entries, read=read, about=about, start=start)


def _beside(path: Path, channels: int) -> tuple[list[dict], datetime | None]:
    """What a document beside the file says of its channels and its start; nothing if there is none of ours."""
    nothing = [{} for _ in range(channels)], None
    try:
        document = json.loads(path.with_name(path.name + ".json").read_text(encoding="utf-8"))
        table = document["tables"][0]
        found = [{**column, "first_s": table["first_s"]} for column in table["columns"]]
        return (found, datetime.fromisoformat(document["start"])) if len(found) == channels else nothing
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return nothing


class Writer:
    """A WAV file. Counts as 32-bit integers, all else as floating point from -1 to 1."""

    merged = True
    sparse = False
    sidecar = True

    def __init__(self, path: Path, selection: Selection) -> None:
        soundfile = library("soundfile")
        table = selection.tables[0]
        if not float(table.rate_hz).is_integer():
            raise InputError("rate_hz", "a whole number for a WAV file", table.rate_hz)
        if len(table.columns) > 1024:
            raise InputError("channels", "at most 1024 in a WAV file", len(table.columns))
        if not selection.whole(table):
            raise InputError("range", "free of missing rows for a WAV file (from_s and to_s choose)", "one with gaps")
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

    def write(self, table: Table, chunk: Chunk) -> None:
        """Take rows."""
        if self._integers:
            shifts = [32 - column.source.adc_bits for column in table.columns if column.source is not None]
            samples = np.stack([table.raw(c, chunk) << shift for c, shift in enumerate(shifts)], axis=1)
        else:
            # The sample is the count over half the converter's counts, whatever unit a sample of 1 is told in.
            halves = [1.0 if column.source is None else 2.0 ** (column.source.adc_bits - 1) for column in table.columns]
            samples = chunk.values / np.array(halves)
        self._file.write(samples)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def abandon(self) -> None:
        """Let go of the file."""
        self._file.close()
