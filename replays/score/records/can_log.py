"""Logs of a DAQ on a CAN bus, in python-can's formats: the rig's sample messages as signals."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np

from replays.score.records.recorded import Pieces, Recorded, RecordedTable
from rig.base.checks import describe_error
from rig.base.errors import InputError, Words
from rig.base.files import TextLines, build_read_error, inflate, open_file
from rig.channels.table import ChannelTable

_SUFFIXES = (".log", ".asc", ".blf", ".trc")
_BLF_HEAD, _BLF_OBJECT = struct.Struct("<4sI"), struct.Struct("<4sHHII")
_BLF_CONTAINER, _ZLIB = struct.Struct("<HH12x"), 2
_MAX_OBJECT = 64 << 20
"""Largest object of a BLF file [bytes]; containers have about 128 kB."""
_ENDLESS = re.compile(rb"LOBJ.{4}\0{4}", re.DOTALL)
"""Object of size 0, after which python-can would read the same one again and again."""


def is_can_log(path: Path) -> bool:
    """Return whether a file is a log of a CAN bus, by its suffix and, for .asc, by its first word."""
    if path.suffix.lower() not in _SUFFIXES:
        return False
    if path.suffix.lower() != ".asc":
        return True
    try:
        with open_file(path) as file:
            return file.read(5).lower() == b"date "
    except OSError as error:
        raise build_read_error(path, error) from None


def _open_reader(path: Path, file: BufferedReader) -> Any:
    import can

    if path.suffix.lower() == ".blf":
        tail = b""
        for piece in inflate(_find_containers(file), path.stat().st_size):
            if _ENDLESS.search(tail + piece):
                raise InputError("file", "an intact one", Words("data with a block of size 0"))
            tail = (tail + piece)[-16:]
        file.seek(0)
        return can.BLFReader(file)
    readers: dict[str, Any] = {".log": can.CanutilsLogReader, ".asc": can.ASCReader, ".trc": can.TRCReader}
    return readers[path.suffix.lower()](TextLines(file, "utf-8", errors="replace"))


def _find_containers(file: BufferedReader) -> Iterator[bytes]:
    """Yield the data of all containers of a BLF file, compressed by zlib.

    Raises:
        ValueError: An object is smaller than its header, and python-can would take the rest of the file for its data,
            or it would fill the memory.
    """
    _, length = _BLF_HEAD.unpack(file.read(_BLF_HEAD.size))
    file.seek(length)
    while len(head := file.read(_BLF_OBJECT.size)) == _BLF_OBJECT.size:
        _, _, _, size, kind = _BLF_OBJECT.unpack(head)
        if not _BLF_OBJECT.size <= size <= _MAX_OBJECT:
            raise ValueError(f"an object of {size} bytes")
        data = file.read(size - _BLF_OBJECT.size)
        file.read(size % 4)
        if kind == 10 and len(data) > _BLF_CONTAINER.size:
            method, data = _BLF_CONTAINER.unpack_from(data)[0], data[_BLF_CONTAINER.size :]
            yield data if method == _ZLIB else zlib.compress(data, 0)


def open_can_log(path: Path, table: ChannelTable) -> list[Recorded]:
    """Return the signals of a log's sample messages, in the FD layout if the log has it; other frames are ignored.

    Args:
        path: The log: candump, ASC or BLF, or TRC.
        table: Channels of the rig that sent.

    Raises:
        InputError: The log cannot be read, or has none of the rig's samples.
    """
    from drivers.can.signals import messages_for
    from drivers.sources.can import SampleDecoder

    messages = messages_for(table)
    frames: dict[str, tuple[list[bytes], list[float]]] = {}
    rates = {"rate": next(iter(table.channels.values())).rate_hz}
    try:
        with open_file(path) as file, _open_reader(path, file) as reader:
            for frame in reader:
                message = messages.by_identifier.get(frame.arbitration_id)
                if message is None or frame.is_extended_id or frame.is_error_frame or frame.is_remote_frame:
                    continue
                if message.name == "Rates" and len(frame.data) == message.length:
                    rates = message.decode(bytes(frame.data))
                elif message.samples is not None and len(frame.data) == message.length:
                    data, times_s = frames.setdefault(message.name, ([], []))
                    data.append(bytes(frame.data))
                    times_s.append(frame.timestamp)
    except InputError:
        raise
    except Exception as error:  # whatever python-can raises on a log that it cannot read
        reason = build_read_error(path, error) if isinstance(error, OSError) else None
        raise reason or InputError("FILE", "an intact CAN log", Words(f"{path} ({describe_error(error)})")) from None
    fd = any(messages.by_name[name].fd for name in frames)
    signals = []
    for name, (data, stamps) in frames.items():
        message = messages.by_name[name]
        form = message.samples
        if message.fd is not fd or form is None:
            continue
        step = rates.get(f"{'fd' if fd else 'classic'}_step") or round(rates["rate"] * message.period_s / form.rows)
        parts = SampleDecoder({name: message}).decode(name, data, rates["rate"], step, 0)
        values = np.concatenate([part.values for part in parts])
        times_s = np.repeat(stamps, form.rows)
        # Stamps are those of frames, and show when these arrived, not the sampling rate.
        whole = RecordedTable(len(values), values.shape[1], _read_pieces(values, times_s))
        for column, (channel, bits) in enumerate(zip(form.channels, form.shifts.tolist(), strict=True)):
            if not np.isnan(values[:, column]).all():
                signals.append(Recorded(channel.name, channel.unit, whole, column, rates["rate"] / step, bits))
    if not signals:
        raise InputError("FILE", "a CAN log with samples of the rig", str(path))
    return signals


def _read_pieces(values: np.ndarray, times_s: np.ndarray) -> Pieces:
    return lambda columns: [np.column_stack([times_s, values[:, columns]])]
