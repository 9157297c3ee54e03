"""The MCAP container: records, chunks, indexes and summary, written fast.

The records are those of the `mcap` package, whose own writer spends most of its time on the small messages for plots:
here a message is one packed head and its bytes, and rows of equal size go in together. The format is that of
https://mcap.dev/spec; what is written is read by the package's reader in the tests.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

if TYPE_CHECKING:
    from mcap.data_stream import RecordBuilder

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQHIQQ")
_ROW_HEAD = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log", "<u8"),
    ("publish", "<u8"),
]
_INDEX = struct.Struct("<BQHI")
_MESSAGE, _MESSAGE_INDEX = 0x05, 0x07
_BODY = _HEAD.size - 9
"""Bytes of a message's body before its data."""


class Container:
    """Writes one MCAP file, chunk by chunk; a chunk that was flushed is on the disk whatever happens then."""

    def __init__(self, file: BinaryIO, *, chunk_bytes: int = 1 << 20) -> None:
        """Take a file that is open for writing, at its start.

        Args:
            file: The file; remains the caller's to close.
            chunk_bytes: Size at which a chunk is written [bytes before compression].
        """
        from mcap.records import Statistics

        self._file = file
        self._chunk_bytes = chunk_bytes
        self._position = 0
        self._schemas: list[Any] = []
        self._channels: list[Any] = []
        self._chunks: list[Any] = []
        self._attachments: list[Any] = []
        self._metadata: list[Any] = []
        self._statistics = Statistics(
            attachment_count=0,
            channel_count=0,
            channel_message_counts={},
            chunk_count=0,
            message_count=0,
            message_end_time=0,
            message_start_time=0,
            metadata_count=0,
            schema_count=0,
        )
        self._parts: list[bytes] = []
        self._size = 0
        self._index: dict[int, tuple[list[int], list[int]]] = {}

    def start(self, profile: str, library: str) -> None:
        """Write magic and header."""
        from mcap.records import Header

        self._put(MAGIC)
        self._put(_record(Header(profile, library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; returns its number."""
        from mcap.records import Schema

        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._hold(_record(schema))
        return schema.id

    def register_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Add a channel; returns its number."""
        from mcap.records import Channel

        channel = Channel(
            id=len(self._channels) + 1, topic=topic, message_encoding=encoding, metadata=metadata, schema_id=schema
        )
        self._channels.append(channel)
        self._hold(_record(channel))
        return channel.id

    def add_message(self, channel: int, log_time: int, data: bytes, publish_time: int, sequence: int) -> None:
        """Add one message; times in ns."""
        times, offsets = self._index.setdefault(channel, ([], []))
        times.append(log_time)
        offsets.append(self._size)
        self._parts.append(_HEAD.pack(_MESSAGE, _BODY + len(data), channel, sequence, log_time, publish_time))
        self._parts.append(data)
        self._size += _HEAD.size + len(data)
        if self._size > self._chunk_bytes:
            self._end_chunk()

    def add_rows(self, channel: int, log_times: np.ndarray, rows: np.ndarray, publish_time: int, sequence: int) -> None:
        """Add messages of one size that came together.

        Args:
            channel: Number of the channel.
            log_times: Time of each [ns], int64, shape (n,).
            rows: Their bytes, uint8, shape (n, size).
            publish_time: Time of all [ns].
            sequence: Number of the first one.
        """
        count, size = rows.shape
        messages = np.empty(count, dtype=np.dtype([*_ROW_HEAD, ("data", "u1", (size,))]))
        messages["opcode"] = _MESSAGE
        messages["length"] = _BODY + size
        messages["channel"] = channel
        messages["sequence"] = (np.arange(count, dtype=np.int64) + sequence) & 0xFFFFFFFF
        messages["log"] = log_times
        messages["publish"] = publish_time
        messages["data"] = rows
        times, offsets = self._index.setdefault(channel, ([], []))
        times += log_times.tolist()
        offsets += range(self._size, self._size + messages.nbytes, messages.itemsize)
        self._hold(messages.tobytes())
        if self._size > self._chunk_bytes:
            self._end_chunk()

    def add_attachment(self, create_time: int, log_time: int, name: str, media_type: str, data: bytes) -> None:
        """Add an attachment."""
        from mcap.records import Attachment, AttachmentIndex

        self._end_chunk()
        attachment = Attachment(create_time=create_time, log_time=log_time, name=name, media_type=media_type, data=data)
        raw = _record(attachment)
        self._attachments.append(
            AttachmentIndex(
                offset=self._position,
                length=len(raw),
                create_time=create_time,
                log_time=log_time,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )
        self._put(raw)

    def add_metadata(self, name: str, entries: dict[str, str]) -> None:
        """Add a metadata record."""
        from mcap.records import Metadata, MetadataIndex

        self._end_chunk()
        raw = _record(Metadata(name=name, metadata=entries))
        self._metadata.append(MetadataIndex(offset=self._position, length=len(raw), name=name))
        self._put(raw)

    def flush(self) -> None:
        """End the chunk and hand everything to the operating system."""
        self._end_chunk()
        self._file.flush()

    def finish(self) -> None:
        """Write the summary and the end of the file."""
        from mcap.data_stream import RecordBuilder
        from mcap.opcode import Opcode
        from mcap.records import DataEnd, Footer, SummaryOffset

        self._end_chunk()
        self._put(_record(DataEnd(0)))
        statistics = self._statistics
        statistics.schema_count, statistics.channel_count = len(self._schemas), len(self._channels)
        statistics.chunk_count = len(self._chunks)
        statistics.attachment_count, statistics.metadata_count = len(self._attachments), len(self._metadata)
        groups = (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        start = self._position
        summary = RecordBuilder()
        offsets = []
        for opcode, records in groups:
            begin = summary.count
            for record in records:
                record.write(summary)
            offsets.append(
                SummaryOffset(group_opcode=opcode, group_start=start + begin, group_length=summary.count - begin)
            )
        offset_start = start + summary.count
        for offset in offsets:
            offset.write(summary)
        data = summary.end()
        # The sum covers the summary and the footer up to the sum itself.
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 8 + 8 + 4, start, offset_start)
        self._put(data)
        self._put(
            _record(
                Footer(
                    summary_start=start,
                    summary_offset_start=offset_start,
                    summary_crc=zlib.crc32(footer, zlib.crc32(data)),
                )
            )
        )
        self._put(MAGIC)

    def _put(self, data: bytes) -> None:
        self._file.write(data)
        self._position += len(data)

    def _hold(self, data: bytes) -> None:
        self._parts.append(data)
        self._size += len(data)

    def _end_chunk(self) -> None:
        """Compress what is held and write it with its index; schemas and channels alone wait for a message."""
        import zstandard
        from mcap.records import Chunk, ChunkIndex

        if not self._index:
            return
        data = b"".join(self._parts)
        first = min(min(times) for times, _ in self._index.values())
        last = max(max(times) for times, _ in self._index.values())
        packed = zstandard.compress(data)
        chunk = Chunk(
            compression="zstd",
            data=packed,
            message_start_time=first,
            message_end_time=last,
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        start = self._position
        self._put(_record(chunk))
        index = ChunkIndex(
            message_start_time=first,
            message_end_time=last,
            chunk_start_offset=start,
            chunk_length=self._position - start,
            message_index_offsets={},
            message_index_length=0,
            compression="zstd",
            compressed_size=len(packed),
            uncompressed_size=len(data),
        )
        begin = self._position
        statistics = self._statistics
        for channel, (times, offsets) in self._index.items():
            index.message_index_offsets[channel] = self._position
            pairs = np.column_stack((times, offsets)).astype("<u8").tobytes()
            self._put(_INDEX.pack(_MESSAGE_INDEX, 6 + len(pairs), channel, len(pairs)) + pairs)
            counts = statistics.channel_message_counts
            counts[channel] = counts.get(channel, 0) + len(times)
            statistics.message_count += len(times)
        index.message_index_length = self._position - begin
        if not self._chunks:
            statistics.message_start_time = first
        statistics.message_start_time = min(statistics.message_start_time, first)
        statistics.message_end_time = max(statistics.message_end_time, last)
        self._chunks.append(index)
        self._parts, self._size, self._index = [], 0, {}


def _record(record: Any) -> bytes:
    """Bytes of one of the package's records."""
    from mcap.data_stream import RecordBuilder

    builder: RecordBuilder = RecordBuilder()
    record.write(builder)
    return builder.end()
