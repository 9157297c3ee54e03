"""One frame, and how many bits it has on the bus.

Bits follow ISO 11898-1:2015, 10.4 and 10.5: classic and CAN FD (ISO, with the stuff count), base and extended format,
stuffing by the frame's own content. The compiled part is loaded at the first count, so that a client that only sends
and receives does not wait for it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from rig.errors import InputError

EXTENDED = 1 << 31
REMOTE = 1 << 30
FD = 1
BRS = 2
ESI = 4
ONE_SHOT = 16

FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Bytes of data of each data length code in a CAN FD frame (ISO 11898-1:2015, table 5)."""

INTERMISSION = 3
"""Recessive bits after each frame, counted with it."""

RECORD = np.dtype(
    [
        ("time_ns", "<u8"),
        ("identifier", "<u4"),
        ("length", "u1"),
        ("flags", "u1"),
        ("node", "<u2"),
        ("data", "u1", (64,)),
    ]
)
"""A frame in an array: `identifier` with EXTENDED and REMOTE as SocketCAN has them, `length` [bytes], `flags` FD, BRS,
ESI, ONE_SHOT added up, `time_ns` and `node` when and by which node it is offered; data beyond the length are zero."""

_PACKING = struct.Struct("<QIBBH64s")
_FD_LENGTHS = frozenset(FD_LENGTHS)


class Frame(NamedTuple):
    """A CAN frame.

    Attributes:
        identifier: 11 bits, or 29 bits where `extended`; the lower wins the bus.
        data: Up to 8 bytes, in CAN FD a length of `FD_LENGTHS`. Of a remote frame only the length counts: that is how
            many bytes it asks for.
        extended: Whether the identifier has 29 bits.
        remote: Whether the frame asks for data; not in CAN FD.
        fd: Whether it is a CAN FD frame.
        brs: Whether its data phase has the higher bit rate; CAN FD only.
        esi: Whether it says that its sender is error passive; CAN FD only.
    """

    identifier: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    fd: bool = False
    brs: bool = False
    esi: bool = False


class Encoded(NamedTuple):
    """A frame as it is on the bus when it is acknowledged, from start of frame to the end of the intermission.

    Attributes:
        bits: Levels, 0 dominant, 1 recessive, shape (bits,).
        fast: Which are sent at the data rate, shape (bits,). The bit BRS counts as nominal, the CRC delimiter as fast:
            each is cut at its sample point, and the two together last just that.
        stuff: Which are stuff bits by content, shape (bits,).
        fixed: Which are fixed stuff bits of CAN FD, shape (bits,).
        crc: CRC sequence, of 15, 17 or 21 bits.
    """

    bits: np.ndarray
    fast: np.ndarray
    stuff: np.ndarray
    fixed: np.ndarray
    crc: int


def pad(data: bytes, *, fill: int = 0) -> bytes:
    """Data with as many bytes appended as the next length of CAN FD needs.

    Args:
        data: At most 64 bytes.
        fill: Value of the added bytes.
    """
    for length in FD_LENGTHS:
        if length >= len(data):
            return data + bytes([fill]) * (length - len(data))
    raise InputError("data", "at most 64 bytes long", len(data))


def check(frame: Frame) -> Frame:
    """The same frame, if a controller can send it; else an InputError that says why not."""
    bits = 29 if frame.extended else 11
    if not 0 <= frame.identifier < 1 << bits:
        raise InputError("identifier", f"a number of {bits} bits", frame.identifier)
    if frame.fd:
        if frame.remote:
            raise InputError("remote", "false in CAN FD, which has no remote frames", True)
        if len(frame.data) not in _FD_LENGTHS:
            raise InputError("data", f"of a CAN FD length ({', '.join(map(str, FD_LENGTHS))} bytes)", len(frame.data))
        return frame
    if len(frame.data) > 8:
        raise InputError("data", "at most 8 bytes long in a classic frame", len(frame.data))
    if frame.brs or frame.esi:
        raise InputError("brs" if frame.brs else "esi", "false in a classic frame", True)
    return frame


def pack(frame: Frame, *, node: int = 0, time_ns: int = 0, one_shot: bool = False) -> bytes:
    """A frame as the bytes of one record.

    Args:
        frame: The frame; it is checked.
        node: Number of the node that offers it.
        time_ns: When [ns].
        one_shot: Whether it is given up after one attempt.
    """
    check(frame)
    word = frame.identifier | (EXTENDED if frame.extended else 0) | (REMOTE if frame.remote else 0)
    flags = (FD if frame.fd else 0) | (BRS if frame.brs else 0) | (ESI if frame.esi else 0)
    if one_shot:
        flags |= ONE_SHOT
    return _PACKING.pack(time_ns, word, len(frame.data), flags, node, b"" if frame.remote else frame.data)


def records(frames: Iterable[Frame]) -> np.ndarray:
    """Frames as an array of `RECORD`, shape (frames,)."""
    return np.frombuffer(bytearray(b"".join([pack(frame) for frame in frames])), RECORD)


def frames(array: np.ndarray) -> list[Frame]:
    """The frames of an array of `RECORD`."""
    return [unpack(*fields) for fields in _PACKING.iter_unpack(np.ascontiguousarray(array).tobytes())]


def unpack(time_ns: int, word: int, length: int, flags: int, node: int, data: bytes) -> Frame:
    """The frame in the fields of one record."""
    extended = word & EXTENDED != 0
    return Frame(
        word & (0x1FFFFFFF if extended else 0x7FF),
        data[:length],
        extended,
        word & REMOTE != 0,
        flags & FD != 0,
        flags & BRS != 0,
        flags & ESI != 0,
    )


def check_records(array: np.ndarray) -> np.ndarray:
    """The same array, if a controller can send all its frames; else an InputError that names the first bad one."""
    if array.dtype != RECORD:
        if array.dtype.itemsize != RECORD.itemsize or array.dtype.names != RECORD.names:
            raise InputError("frames", "an array of drivers.can.frame.RECORD", array.dtype)
        array = np.ascontiguousarray(array).view(RECORD)
    word, length, flags = array["identifier"], array["length"], array["flags"]
    fd = flags & FD != 0
    extended = word & EXTENDED != 0
    remote = word & REMOTE != 0
    number = word & 0x1FFFFFFF
    fault = np.where(fd, remote | ~_IS_FD_LENGTH[length], (length > 8) | (flags & (BRS | ESI) != 0))
    fault |= ~extended & (number > 0x7FF)
    if fault.any():
        check(frames(array[fault][:1])[0])
        raise InputError("frames", "frames that a controller can send", array[fault][0])
    return array


_IS_FD_LENGTH = np.isin(np.arange(256), FD_LENGTHS)


def encode(frame: Frame) -> Encoded:
    """All bits of a frame on the bus."""
    from drivers.can import kernels

    record = np.frombuffer(pack(frame), RECORD)[0]
    bits = np.zeros(kernels.LONGEST, np.uint8)
    kinds = np.zeros(kernels.LONGEST, np.uint8)
    count, crc = kernels.encode(
        int(record["identifier"]), int(record["length"]), int(record["flags"]), record["data"], bits, kinds
    )
    kinds = kinds[:count]
    return Encoded(
        bits[:count],
        kinds & kernels.FAST != 0,
        kinds & kernels.STUFF != 0,
        kinds & kernels.FIXED != 0,
        int(crc),
    )


def frame_bits(frame: Frame) -> tuple[int, int]:
    """Bits of a frame on the bus, with stuffing and intermission: at the nominal rate, and at the data rate."""
    nominal, fast = bits_of(np.frombuffer(pack(frame), RECORD))
    return int(nominal[0]), int(fast[0])


def bits_of(array: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`frame_bits` for an array of `RECORD`: nominal bits and fast bits, int64, shape (frames,)."""
    from drivers.can import kernels

    array = check_records(array)
    nominal = np.zeros(len(array), np.int64)
    fast = np.zeros(len(array), np.int64)
    kernels.count_many(array["identifier"], array["length"], array["flags"], array["data"], nominal, fast)
    return nominal, fast
