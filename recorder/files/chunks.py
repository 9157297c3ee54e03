"""Chunks of an MCAP file: decompression, checksums and records."""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO

import zstandard
from mcap.opcode import Opcode

from rig.base.errors import InputError, Words

MAX_CHUNK_BYTES = 64 << 20
"""Largest decompressed chunk [bytes]. The writer closes a chunk at 1 MiB, but its last message may be long."""
RECORD = struct.Struct("<BQ")
MESSAGE = struct.Struct("<HIQQ")
CHUNK = struct.Struct("<QQQII")
READ_BYTES = 1 << 20
"""Read size [bytes]."""
MAX_NAME_BYTES = 32
"""Longest accepted name of a compression method [bytes]."""
_CUT_READ_BYTES = 4096


class DamagedError(ValueError):
    """Record with a wrong checksum or an invalid structure."""


@dataclass(frozen=True)
class Chunk:
    """Group of consecutive messages that are compressed together; see `Recording.chunks`.

    Attributes:
        offset: Position of its record in the file [bytes].
        length: Length of the record's body [bytes].
        begin_ns: Earliest simulated time of its messages [ns].
        end_ns: Latest simulated time of its messages [ns].
        channels: Channels with messages in the chunk, where the file states them.
        cut: Whether the file ends within the chunk.
        part: Index of its file in `Recording.parts`.
        bare: Whether these are records outside a chunk, in sequence from `offset`.
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
    """Return channel, sequence number, simulated time [ns] and arrival time [unix ns] of a message."""
    if end - start < MESSAGE.size:
        raise DamagedError("a message shorter than its header")
    return MESSAGE.unpack_from(data, start)


def records(data: bytes, *, cut: bool = False) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of the body of each record.

    Args:
        data: Consecutive records.
        cut: Whether the last record may be incomplete.

    Raises:
        DamagedError: The last record does not end at the end of the data.
    """
    position = 0
    while position + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, position)
        if opcode == 0:  # padding
            break
        start = position + RECORD.size
        position = start + length
        if position <= len(data):
            yield opcode, start, position
    if position != len(data) and not cut:
        raise DamagedError("records that do not end with their chunk")


def messages(data: bytes, wanted: Container[int], *, cut: bool = False) -> Iterator[tuple[int, int, int, bytes]]:
    """Yield channel, simulated time [ns], arrival time [unix ns] and payload of the messages of some channels."""
    for opcode, start, end in records(data, cut=cut):
        if opcode == Opcode.MESSAGE:
            number, _, log_time, publish_time = stamp(data, start, end)
            if number in wanted:
                yield number, log_time, publish_time, data[start + MESSAGE.size : end]


def unpack(file: BinaryIO, chunk: Chunk) -> bytes:
    """Return the decompressed records of a chunk, with size and checksum verified.

    Args:
        file: The file.
        chunk: The chunk; records outside a chunk are returned unchanged.

    Raises:
        DamagedError: The chunk is damaged, larger than `MAX_CHUNK_BYTES`, or uses an unknown compression.
        InputError: The decompression library is not installed.
    """
    if chunk.length > MAX_CHUNK_BYTES + READ_BYTES:
        raise DamagedError(f"a chunk of {chunk.length} bytes")
    file.seek(chunk.offset + (0 if chunk.bare else RECORD.size))
    body = file.read(chunk.length)
    if chunk.bare:
        return body
    if len(body) < CHUNK.size + 8:
        if chunk.cut:
            return b""
        raise DamagedError("a chunk shorter than its header")
    *_, size, checksum, name_length = CHUNK.unpack_from(body)
    name, packed = body[CHUNK.size : CHUNK.size + name_length], body[CHUNK.size + name_length + 8 :]
    if size > MAX_CHUNK_BYTES or name not in _UNPACKERS:
        raise DamagedError(f"a chunk of {size} bytes, compressed by {name[:MAX_NAME_BYTES]!r}")
    if chunk.cut:
        return _UNPACKERS[name](packed, size, True)
    stated = int.from_bytes(body[CHUNK.size + name_length : CHUNK.size + name_length + 8], "little")
    if stated > len(packed):
        raise DamagedError("a chunk shorter than its stated length")
    data = _UNPACKERS[name](packed[:stated], size, False)
    if len(data) != size or (checksum and zlib.crc32(data) != checksum):  # 0: no checksum
        raise DamagedError("a chunk with a wrong checksum")
    return data


def _unpack_zstd(packed: bytes, size: int, cut: bool) -> bytes:
    if not cut:
        try:
            # zstd allocates the size stated in the frame, so check it first.
            if zstandard.frame_content_size(packed) not in (-1, size):
                raise DamagedError("a chunk whose size differs from the stated size")
            return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
        except zstandard.ZstdError as error:
            raise DamagedError(str(error)) from None
    pieces, length = [], 0
    # Small pieces recover all compressed blocks before the point where the file ends.
    with (
        contextlib.suppress(zstandard.ZstdError),
        zstandard.ZstdDecompressor().stream_reader(BytesIO(packed), read_size=_CUT_READ_BYTES) as reader,
    ):
        while length < size and (data := reader.read(min(_CUT_READ_BYTES, size - length))):
            pieces.append(data)
            length += len(data)
    return b"".join(pieces)


def _unpack_lz4(packed: bytes, size: int, cut: bool) -> bytes:
    try:
        from lz4.frame import LZ4FrameDecompressor
    except ImportError:
        must = "compressed by zstd or not at all; for lz4, install its library (pip install lz4)"
        raise InputError("file", must, Words("chunks compressed by lz4")) from None
    decompressor, pieces, length = LZ4FrameDecompressor(), [], 0
    step = _CUT_READ_BYTES if cut else max(1, len(packed))
    try:
        for start in range(0, len(packed), step):
            pieces.append(decompressor.decompress(packed[start : start + step], max_length=size - length + 1))
            length += len(pieces[-1])
            if decompressor.eof or length > size:
                break
    except RuntimeError as error:
        if not cut:
            raise DamagedError(str(error)) from None
    return b"".join(pieces)


_UNPACKERS: dict[bytes, Callable[[bytes, int, bool], bytes]] = {
    b"": lambda packed, size, cut: packed,
    b"zstd": _unpack_zstd,
    b"lz4": _unpack_lz4,
}
"""Decompressors by compression name: (data, size, cut) to bytes; with `cut`, as much as can be decompressed."""
