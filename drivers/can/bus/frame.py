"""CAN frames: their records, and whether a controller can send them.

Formats follow ISO 11898-1:2015, 10.4 and 10.5: classic and CAN FD (ISO, with the stuff count), base and extended. This
module loads no compiled code, so that a client that only sends and receives starts fast.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rig.base.errors import InputError

# Flags in the identifier's word, as in SocketCAN.
EXTENDED = 1 << 31
REMOTE = 1 << 30
ERROR = 1 << 29
STANDARD_MASK = (1 << 11) - 1
EXTENDED_MASK = (1 << 29) - 1
# Flags in the byte of flags.
FD = 1
BRS = 2
ESI = 4

CLASSIC_WIDTH = 8
FD_WIDTH = 64
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Data length of each data length code in a CAN FD frame [bytes] (ISO 11898-1:2015, table 5)."""

INTERMISSION = 3
"""Recessive bits after each frame, counted with it."""


def _layout(data: Any) -> np.dtype:
    head = [("time_ns", "<u8"), ("identifier", "<u4"), ("length", "u1"), ("flags", "u1"), ("node", "<u2")]
    return np.dtype([*head, ("data", *data)])


WIDTHS = (CLASSIC_WIDTH, FD_WIDTH)
RECORDS = {width: _layout((f"V{width}",)) for width in WIDTHS}
"""Layout of frames in an array, by width of the data field: `time_ns` time [ns]; `identifier` with EXTENDED, REMOTE,
ERROR; `length` of the data, or the requested length [bytes]; `flags` FD, BRS, ESI added; `node` number of the sender.
Data beyond the length are zero."""
OCTETS = {width: _layout(("u1", (width,))) for width in WIDTHS}
"""The same layouts with single bytes of data."""
RECORD = OCTETS[FD_WIDTH]
"""The layout of the bus model and of compiled code."""

_MAX_LOOP_FRAMES = 8
"""Number of frames up to which a loop is faster than arrays."""
_IS_NO_FD_LENGTH = np.isin(np.arange(256), FD_LENGTHS, invert=True)


class Record(NamedTuple):
    """One frame as a record; the fields are those of `RECORDS`, the data without padding."""

    time_ns: int
    identifier: int
    length: int
    flags: int
    node: int
    data: bytes


def _find_faults(word: Any, length: Any, flags: Any, room: Any, *, fd: bool) -> Iterator[tuple[Any, str]]:
    """Yield each rule that a frame can break: where it is broken, and its text; for numbers or arrays."""
    base, data, is_fd, classic = word & EXTENDED == 0, word & REMOTE == 0, flags & FD != 0, flags & FD == 0
    yield word & ERROR != 0, "an error frame, which only controllers send"
    yield data & (length > room), "{length} bytes of data in a field of {room}"
    yield (
        base & (word & EXTENDED_MASK > STANDARD_MASK),
        "identifier {number:#x} has more than 11 bits, and the frame is not extended",
    )
    yield flags & (0xFF ^ FD ^ BRS ^ ESI) != 0, "unknown flags {flags:#x}"
    if not fd:
        yield is_fd, "a CAN FD frame, on a bus for classic CAN"
    yield is_fd & (word & REMOTE != 0), "a remote frame, which CAN FD does not have"
    yield is_fd & _IS_NO_FD_LENGTH[length], "{length} bytes, which is not a CAN FD length"
    yield (
        classic & (flags & (BRS | ESI) != 0),
        "a bit rate switch or error state indicator, which classic CAN does not have",
    )
    yield classic & (length > CLASSIC_WIDTH), "{length} bytes in a classic frame"


def find_fault(record: Record, *, fd: bool = True) -> str | None:
    """Return the reason why no controller could send a frame; None if one could.

    Args:
        record: A frame to send.
        fd: Whether the bus supports CAN FD frames.
    """
    word, length, flags, room = record.identifier, record.length, record.flags, len(record.data)
    if not 0 <= word < 1 << 32 or not 0 <= length < 256:
        return f"identifier {word:#x} or length {length}, which does not fit into a frame"
    for wrong, text in _find_faults(word, length, flags, room, fd=fd):
        if wrong:
            return text.format(length=length, room=room, flags=flags, number=word & EXTENDED_MASK)
    return None


def are_sendable(records: np.ndarray, *, fd: bool = True) -> np.ndarray:
    """Return for each frame whether a controller could send it (see `find_fault`), shape of `records`.

    Args:
        records: Array of one of the `RECORDS` layouts.
        fd: Whether the bus supports CAN FD frames.
    """
    if len(records) <= _MAX_LOOP_FRAMES:
        return np.array([find_fault(Record(*row), fd=fd) is None for row in records.tolist()], bool)
    room = records.dtype["data"].itemsize
    wrong = np.zeros(len(records), bool)
    for broken, _ in _find_faults(records["identifier"], records["length"], records["flags"], room, fd=fd):
        wrong |= broken
    return ~wrong


class Frame(NamedTuple):
    """A CAN frame.

    Attributes:
        identifier: 11 bits, or 29 bits if `extended`; the lower wins the bus.
        data: Up to 8 bytes, in CAN FD a length of `FD_LENGTHS`. For a remote frame only its length counts: the number
            of bytes requested.
        extended: Whether the identifier has 29 bits.
        remote: Whether the frame requests data; not in CAN FD.
        fd: Whether it is a CAN FD frame.
        brs: Whether its data phase has the higher bit rate; CAN FD only.
        esi: Whether it reports that its sender is error passive; CAN FD only.
    """

    identifier: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    fd: bool = False
    brs: bool = False
    esi: bool = False


def make_record(frame: Frame, *, node: int = 0, time_ns: int = 0) -> Record:
    """Convert a frame to its record.

    Args:
        frame: The frame.
        node: Number of the node that offers it.
        time_ns: Time of the offer [ns].

    Raises:
        InputError: No controller can send it, for the reason in the message.
    """
    # An identifier that would overlap the flags must remain invalid.
    fits = 0 <= frame.identifier <= EXTENDED_MASK
    word = frame.identifier | EXTENDED * frame.extended | REMOTE * frame.remote if fits else -1
    flags = FD * frame.fd | BRS * frame.brs | ESI * frame.esi
    record = Record(time_ns, word, len(frame.data), flags, node, frame.data)
    if (fault := find_fault(record)) is not None:
        raise InputError("frame", "one that a controller can send", fault if fits else frame.identifier)
    return record._replace(data=b"") if frame.remote else record


def pack_records(rows: Iterable[Record], width: int | None = None) -> np.ndarray:
    """Pack records into an array of the layout of that width, or of the narrowest that fits all, shape (frames,)."""
    rows = list(rows)
    if width is None:
        width = FD_WIDTH if any(len(row.data) > CLASSIC_WIDTH for row in rows) else CLASSIC_WIDTH
    pack = struct.Struct(f"<QIBBH{width}s").pack
    return np.frombuffer(bytearray(b"".join([pack(*row) for row in rows])), RECORDS[width])


def records(frames: Iterable[Frame]) -> np.ndarray:
    """Convert frames to an array of `RECORD`, shape (frames,)."""
    return pack_records(map(make_record, frames), FD_WIDTH).view(RECORD)


def frames(array: np.ndarray) -> list[Frame]:
    """Convert an array of `RECORD` to frames."""
    return [_frame(Record(*fields)) for fields in np.ascontiguousarray(array).view(RECORDS[FD_WIDTH]).tolist()]


def _frame(record: Record) -> Frame:
    extended = record.identifier & EXTENDED != 0
    return Frame(
        record.identifier & (EXTENDED_MASK if extended else STANDARD_MASK),
        record.data[: record.length],
        extended,
        record.identifier & REMOTE != 0,
        record.flags & FD != 0,
        record.flags & BRS != 0,
        record.flags & ESI != 0,
    )


def octets(array: np.ndarray) -> np.ndarray:
    """Return the data fields of an array of a `RECORDS` layout as bytes, shape (frames, width); a view."""
    return array.view(OCTETS[array.dtype["data"].itemsize])["data"]


def join_records(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Join arrays of one layout, 20 times faster than `np.concatenate`.

    Args:
        parts: Arrays of one of the `RECORDS` layouts, at least one.
    """
    return np.frombuffer(bytearray(b"".join([each.tobytes() for each in parts])), parts[0].dtype)


def resize_records(array: np.ndarray, width: int = FD_WIDTH) -> np.ndarray:
    """Copy frames to the layout of another width: data are padded with zeros, or truncated."""
    broken = np.zeros(len(array), RECORDS[width])
    for name in ("time_ns", "identifier", "length", "flags", "node"):
        broken[name] = array[name]
    narrowest = min(width, array.dtype["data"].itemsize)
    octets(broken)[:, :narrowest] = octets(array)[:, :narrowest]
    return broken
