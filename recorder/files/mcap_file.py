"""MCAP file being written: topics, messages, metadata and attachments, independent of their contents."""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Iterator
from itertools import count
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from mcap.stream_reader import MAGIC_SIZE
from mcap.writer import Writer

from recorder.files.chunks import CHUNK, RECORD
from recorder.files.schemas import TEXT, Definition, wrap_text
from recorder.files.unfinished_file import ALTERED, Draft

_CHUNK_BYTES = 1 << 20
_CHUNK_LIST = "_Writer__chunk_indices"
"""Private attribute of the MCAP writer: its chunk list, which would grow with the file.

No public option omits the list and still writes the index. The dependency is limited to mcap<2 for this reason.
"""
_CHANNEL = struct.Struct("<H")
_MESSAGE_BYTES = 47
"""Overhead of a message: its header and its entry in the chunk's index [bytes]."""
_END_BYTES = 100_000
"""Size of the summary without the chunk index [bytes]: repeated channels and schemas, and the last plot messages."""


class McapFile:
    """Writer of MCAP records to a draft file, chunk by chunk.

    Attributes:
        draft: The file.
        mcap: MCAP writer, for metadata and attachments.
        size_bytes: File size at the last flush [bytes].
        unflushed_bytes: Uncompressed data in memory since the last flush [bytes].
    """

    def __init__(self, draft: Draft) -> None:
        """Start the file.

        Raises:
            OSError: The disk reports an error.
        """
        self.draft = draft
        self.size_bytes = self.unflushed_bytes = 0
        self._chunks = self._chunk_bytes = 0
        self._schemas: dict[str, int] = {}
        self._topics: dict[str, tuple[int, Iterator[int], bool]] = {}
        """Channel number, sequence counter and whether messages are wrapped as text, by topic."""
        self.mcap = Writer(draft, chunk_size=_CHUNK_BYTES, enable_data_crcs=True)  # type: ignore[arg-type]
        setattr(self.mcap, _CHUNK_LIST, _ChunkIndexes(draft.file))
        self.mcap.start(profile="ros2", library="rotor-stator-rig recorder")

    @property
    def index_bytes(self) -> int:
        """Estimated size of the index at the end of the file, which lists each chunk and its topics [bytes]."""
        return (60 + 10 * len(self._topics)) * self._chunks

    @property
    def final_bytes(self) -> int:
        """Upper bound of the file size if it is finished now [bytes]."""
        return self.size_bytes + self.unflushed_bytes + self.index_bytes + _END_BYTES

    def __contains__(self, topic: str) -> bool:
        return topic in self._topics

    def register(self, topic: str, definition: Definition, metadata: dict[str, str]) -> None:
        """Register a topic with its message definition and metadata."""
        if definition.name not in self._schemas:
            number = self.mcap.register_schema(definition.name, definition.language, definition.text)
            self._schemas[definition.name] = number
        number = self._schemas[definition.name]
        channel = self.mcap.register_channel(topic, definition.encoding, number, metadata)
        self._topics[topic] = channel, count(), definition == TEXT

    def add(self, topic: str, data: bytes, *, time_ns: int, wall_ns: int) -> None:
        """Write a message with its simulated time [ns] and arrival time [unix ns].

        On a document topic, `data` is the text of a ROS 2 string message.
        """
        channel, numbers, wrapped = self._topics[topic]
        data = wrap_text(data) if wrapped else data
        self.mcap.add_message(channel, time_ns, data, wall_ns, next(numbers) & 0xFFFFFFFF)
        self._chunk_bytes += len(data)
        self.unflushed_bytes += len(data) + _MESSAGE_BYTES
        if self._chunk_bytes >= _CHUNK_BYTES:
            self._chunks += 1
            self._chunk_bytes = 0

    def sync(self) -> None:
        """Close the chunk and flush everything to the disk.

        Raises:
            OSError: The disk reports an error.
        """
        self.mcap.flush()
        self._chunks += 1
        self.size_bytes = self.draft.sync()
        self.unflushed_bytes = self._chunk_bytes = 0

    def finish(self) -> None:
        """Write the index and rename the file to its final name.

        Raises:
            OSError: The disk reports an error.
        """
        self.draft.verify()
        try:
            self.mcap.finish()
        except (struct.error, ValueError, OverflowError):  # the index is read from the file
            raise OSError(errno.EIO, f"the file was altered {ALTERED}") from None
        self.size_bytes = self.draft.sync()
        self.draft.finish()


class _ChunkIndexes:
    """Chunk index of a file, read back from the disk instead of held in memory."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def append(self, index: ChunkIndex) -> None:
        """Discard the entry; the index is read from the file."""

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
        if position != os.fstat(number).st_size:
            raise ValueError("a record beyond the end of the file")
