"""Chunks of an MCAP file: their records, unpacked and held against their checksums."""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO

import zstandard
from mcap.opcode import Opcode

from rig.base.errors import InputError, Words

MOST_CHUNK_BYTES = 64 << 20
"""Largest chunk, unpacked: a writer closes one at 1 MiB, and the message that it closes with may be long."""
RECORD = struct.Struct("<BQ")
MESSAGE = struct.Struct("<HIQQ")
CHUNK = struct.Struct("<QQQII")
PIECE = 1 << 20
"""Bytes that are read at a time."""
LONGEST_NAME = 32
"""Longest name of a compression that is looked at [bytes]."""
_CUT_PIECE = 4096


class DamagedError(ValueError):
    """A record is not what was written: its checksum, or its form, says so."""


@dataclass(frozen=True)
class Chunk:
    """Messages in a row that were packed together; see `Recording.chunks`.

    Attributes:
        offset: Where its record begins in its file [bytes].
        length: Length of the record's body [bytes].
        begin_ns: Least simulated time of its messages [ns].
        end_ns: Greatest simulated time of its messages [ns].
        channels: Channels with messages in it, where the file says so.
        cut: The file ends in it.
        part: Number of the file that it is in, of `Recording.parts`.
        bare: No chunk but records one after another in the data section, which begin at `offset`.
    """

    offset: int
    length: int
    begin_ns: int = 0
    end_ns: int = 0
    channels: frozenset[int] | None = None
    cut: bool = False
    part: int = 0
    bare: bool = False


def stamp(data: bytes, start: int, end: int) -> tuple[int, int, int, int]:
    """Channel, number, simulated time [ns] and wall time of arrival [unix ns] of a message."""
    if end - start < MESSAGE.size:
        raise DamagedError("a message without a head")
    return MESSAGE.unpack_from(data, start)


def records(data: bytes, *, cut: bool = False) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the body of each record.

    Args:
        data: Records behind each other.
        cut: The last one may be cut off.

    Raises:
        DamagedError: They do not end with the data.
    """
    position = 0
    while position + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, position)
        if opcode == 0:  # no record: zeros
            break
        start = position + RECORD.size
        position = start + length
        if position <= len(data):
            yield opcode, start, position
    if position != len(data) and not cut:
        raise DamagedError("records that do not end with their chunk")


def messages(data: bytes, *, cut: bool = False) -> Iterator[tuple[int, int, int, bytes]]:
    """Channel, simulated time [ns], wall time of arrival [unix ns] and payload of each message of a chunk."""
    for opcode, start, end in records(data, cut=cut):
        if opcode == Opcode.MESSAGE:
            number, _, log_time, publish_time = stamp(data, start, end)
            yield number, log_time, publish_time, data[start + MESSAGE.size : end]


def unpack(file: BinaryIO, chunk: Chunk) -> bytes:
    """Return the records of a chunk, unpacked to the size that it declares and checked against their sum.

    Args:
        file: The file.
        chunk: Where it is; of records outside chunks these themselves.

    Raises:
        DamagedError: It is not what was written, larger than `MOST_CHUNK_BYTES`, or packed by an unknown method.
        InputError: The library that unpacks it is not installed.
    """
    if chunk.length > MOST_CHUNK_BYTES + PIECE:
        raise DamagedError(f"a chunk of {chunk.length} bytes")
    file.seek(chunk.offset + (0 if chunk.bare else RECORD.size))
    body = file.read(chunk.length)
    if chunk.bare:
        return body
    if len(body) < CHUNK.size + 8:
        if chunk.cut:
            return b""
        raise DamagedError("a chunk without a head")
    *_, size, checksum, name_length = CHUNK.unpack_from(body)
    name, packed = body[CHUNK.size : CHUNK.size + name_length], body[CHUNK.size + name_length + 8 :]
    if size > MOST_CHUNK_BYTES or name not in _UNPACKERS:
        raise DamagedError(f"a chunk of {size} bytes, packed by {name[:LONGEST_NAME]!r}")
    if chunk.cut:
        return _UNPACKERS[name](packed, size, True)
    stated = int.from_bytes(body[CHUNK.size + name_length : CHUNK.size + name_length + 8], "little")
    if stated > len(packed):
        raise DamagedError("a chunk that does not end where it should")
    data = _UNPACKERS[name](packed[:stated], size, False)
    if len(data) != size or (checksum and zlib.crc32(data) != checksum):  # 0: the writer made none
        raise DamagedError("a chunk whose checksum does not fit")
    return data


def _unpack_zstd(packed: bytes, size: int, cut: bool) -> bytes:
    if not cut:
        try:
            # What the packed data say of their size is allocated, so it is asked first.
            if zstandard.frame_content_size(packed) not in (-1, size):
                raise DamagedError("a chunk of another size than it says")
            return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
        except zstandard.ZstdError as error:
            raise DamagedError(str(error)) from None
    found, length = [], 0
    # In small pieces: where it ends in zeros or in nothing, the blocks before that are good.
    with (
        contextlib.suppress(zstandard.ZstdError),
        zstandard.ZstdDecompressor().stream_reader(BytesIO(packed), read_size=_CUT_PIECE) as reader,
    ):
        while length < size and (data := reader.read(min(_CUT_PIECE, size - length))):
            found.append(data)
            length += len(data)
    return b"".join(found)


def _unpack_lz4(packed: bytes, size: int, cut: bool) -> bytes:
    try:
        from lz4.frame import LZ4FrameDecompressor
    except ImportError:
        must = "packed by zstd or not at all, or read where the library lz4 is (pip install lz4)"
        raise InputError("file", must, Words("chunks packed by lz4")) from None
    decompressor, found, length = LZ4FrameDecompressor(), [], 0
    step = _CUT_PIECE if cut else max(1, len(packed))
    try:
        for start in range(0, len(packed), step):
            found.append(decompressor.decompress(packed[start : start + step], max_length=size - length + 1))
            length += len(found[-1])
            if decompressor.eof or length > size:
                break
    except RuntimeError as error:
        if not cut:
            raise DamagedError(str(error)) from None
    return b"".join(found)


_UNPACKERS: dict[bytes, Callable[[bytes, int, bool], bytes]] = {
    b"": lambda packed, size, cut: packed,
    b"zstd": _unpack_zstd,
    b"lz4": _unpack_lz4,
}
"""Unpacks bytes to a size, by the name of the compression; of a chunk that the file ends in, as far as it goes."""
