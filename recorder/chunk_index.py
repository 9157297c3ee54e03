"""The index of a file's chunks, which an MCAP file ends with, taken from the disk and not from memory."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from mcap.stream_reader import MAGIC_SIZE
from mcap.writer import Writer

from recorder.records import CHUNK, RECORD

_CHANNEL = struct.Struct("<H")


def keep_on_disk(writer: Writer, file: BinaryIO) -> None:
    """Let a writer keep no list of its chunks, which would grow with the file, but read it off the file at the end.

    The list is private to `mcap.writer.Writer`, which has no public way to leave it out and still write the index;
    the version is bounded for that (mcap<2).
    """
    name = "_Writer__chunk_indices"
    assert isinstance(getattr(writer, name), list), "mcap.writer.Writer keeps its chunks otherwise"
    setattr(writer, name, _ChunkIndexes(file))


class _ChunkIndexes:
    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def append(self, index: ChunkIndex) -> None:
        """Keep nothing."""

    def __iter__(self) -> Iterator[ChunkIndex]:
        self._file.flush()
        number, position = self._file.fileno(), MAGIC_SIZE
        index = None
        while head := os.pread(number, 100, position):
            kind, length = RECORD.unpack_from(head)
            body, whole = RECORD.size, RECORD.size + length
            if kind == Opcode.MESSAGE_INDEX and index is not None:
                index.message_index_offsets[_CHANNEL.unpack_from(head, body)[0]] = position
                index.message_index_length += whole
            elif index is not None:
                yield index
                index = None
            if kind == Opcode.CHUNK:
                first, last, raw_size, _, letters = CHUNK.unpack_from(head, body)
                data = body + CHUNK.size + letters
                index = ChunkIndex(
                    message_start_time=first,
                    message_end_time=last,
                    chunk_start_offset=position,
                    chunk_length=whole,
                    message_index_offsets={},
                    message_index_length=0,
                    compression=head[data - letters : data].decode(),
                    compressed_size=length - (data - body) - 8,
                    uncompressed_size=raw_size,
                )
            position += whole
