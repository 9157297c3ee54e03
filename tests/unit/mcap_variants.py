"""A recording rewritten in each way that the MCAP specification allows: the dimensions of its conformance suite."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode  # noqa: TID253 - the subject
from mcap.reader import make_reader  # noqa: TID253 - the subject
from mcap.writer import CompressionType, IndexType, Writer  # noqa: TID253 - the subject

MAGIC = b"\x89MCAP0\r\n"
PADDING = b"\x01\xff\xff"
"""Bytes after the last field of a record, as a later version of the format may have them."""

_ALL = IndexType.ATTACHMENT | IndexType.CHUNK | IndexType.MESSAGE | IndexType.METADATA
WRITERS: dict[str, dict[str, Any]] = {
    "lz4": {"compression": CompressionType.LZ4},
    "zstd": {"compression": CompressionType.ZSTD},
    "not packed": {"compression": CompressionType.NONE},
    "without chunks": {"use_chunking": False},
    "without chunks and checksums": {"use_chunking": False, "enable_crcs": False, "enable_data_crcs": False},
    "without checksums": {"enable_crcs": False, "enable_data_crcs": False},
    "without statistics": {"use_statistics": False},
    "without a chunk index": {"index_types": _ALL & ~IndexType.CHUNK},
    "without a message index": {"index_types": _ALL & ~IndexType.MESSAGE},
    "without an attachment index": {"index_types": _ALL & ~IndexType.ATTACHMENT},
    "without a metadata index": {"index_types": _ALL & ~IndexType.METADATA},
    "without repeated channels": {"repeat_channels": False},
    "without repeated schemas": {"repeat_schemas": False},
    "without summary offsets": {"use_summary_offsets": False},
    "without anything": {
        "index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False, "repeat_channels": False,
        "repeat_schemas": False, "enable_crcs": False, "enable_data_crcs": False, "compression": CompressionType.LZ4,
    },
    "chunks of 4 MiB": {"chunk_size": 4 << 20},
    "a chunk for each message": {"chunk_size": 1},
}  # fmt: skip


def write(source: Path, target: Path, name: str) -> Path:
    """Write a recording in a variant."""
    if name in WRITERS:
        _rewrite(source, target, {"compression": CompressionType.ZSTD, "chunk_size": 1 << 16, **WRITERS[name]})
    else:
        target.write_bytes(BY_HAND[name](source.read_bytes()))
    return target


def _rewrite(source: Path, target: Path, options: dict[str, Any]) -> None:
    with source.open("rb") as old, target.open("wb") as new:
        reader, schemas, channels = make_reader(old), {0: 0}, {}
        writer = Writer(new, **{"enable_data_crcs": True, **options})
        writer.start(library="another program")
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
            )
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.id not in channels:
                if schema is not None and schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id if schema else 0], channel.metadata
                )
            number, times = channels[channel.id], (message.log_time, message.publish_time)
            writer.add_message(number, times[0], message.data, times[1], message.sequence)
        writer.finish()


def read_records(data: bytes) -> list[tuple[int, bytes]]:
    """Return opcode and body of each record outside chunks."""
    found, position = [], len(MAGIC)
    while position < len(data) - len(MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, position)
        found.append((opcode, data[position + 9 : position + 9 + length]))
        position += 9 + length
    return found


def joined(rows: list[tuple[int, bytes]]) -> bytes:
    return b"".join(struct.pack("<BQ", opcode, len(body)) + body for opcode, body in rows)


def _split(data: bytes) -> tuple[list[tuple[int, bytes]], list[tuple[int, bytes]]]:
    rows = read_records(data)
    end = next(number for number, (opcode, _) in enumerate(rows) if opcode == Opcode.DATA_END)
    return rows[:end], rows[end + 1 : -1]


def finish_file(data: bytes, summary: bytes = b"", *, checked: bool = True) -> bytes:
    """Return a file of a data section and a summary."""
    body = MAGIC + data
    body += struct.pack("<BQI", Opcode.DATA_END, 4, zlib.crc32(body) if checked else 0)
    footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, len(body) if summary else 0, 0)
    return body + summary + footer + struct.pack("<I", zlib.crc32(summary + footer) if checked else 0) + MAGIC


def _padded_data(data: bytes) -> bytes:
    plain = (Opcode.MESSAGE, Opcode.CHUNK)
    return finish_file(joined([(one, body + PADDING * (one not in plain)) for one, body in _split(data)[0]]))


def _padded_summary(data: bytes) -> bytes:
    rows, summary = _split(data)
    return finish_file(joined(rows), joined([(one, body + PADDING) for one, body in summary]))


def _private(data: bytes) -> bytes:
    mixed = [row for each in _split(data)[0] for row in (each, (0x80, b"private"), (0x42, b"of a later version"))]
    return finish_file(joined(mixed), checked=False)


def _private_summary(data: bytes) -> bytes:
    rows, summary = _split(data)
    return finish_file(joined(rows), joined([(0x91, b""), *summary, (0x7F, b"later")]))


def _one_message_outside(data: bytes) -> bytes:
    """Return chunks with the last of them unpacked into the data section."""
    import zstandard

    rows = _split(data)[0]
    last = max(number for number, (opcode, _) in enumerate(rows) if opcode == Opcode.CHUNK)
    body = rows[last][1]
    size, name = struct.unpack_from("<Q", body, 16)[0], struct.unpack_from("<I", body, 28)[0]
    packed = body[32 + name + 8 :]
    loose = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size) if name else packed
    return finish_file(
        joined(rows[:last]) + loose + joined([row for row in rows[last + 1 :] if row[0] != Opcode.MESSAGE_INDEX])
    )


def _without_sums(data: bytes) -> bytes:
    """Return a file whose attachments and chunks have checksums of 0."""
    rows = []
    for opcode, body in _split(data)[0]:
        if opcode == Opcode.ATTACHMENT:
            body = body[:-4] + bytes(4)
        elif opcode == Opcode.CHUNK:
            body = body[:24] + bytes(4) + body[28:]
        rows.append((opcode, body))
    return finish_file(joined(rows), joined(_split(data)[1]), checked=False)


BY_HAND: dict[str, Callable[[bytes], bytes]] = {
    "padded data": _padded_data,
    "padded summary": _padded_summary,
    "private records": _private,
    "private records in the summary": _private_summary,
    "without a summary": lambda data: finish_file(joined(_split(data)[0])),
    "without a summary and checksums": lambda data: finish_file(joined(_split(data)[0]), checked=False),
    "a chunk and messages outside": _one_message_outside,
    "without any checksum": _without_sums,
}
NAMES = [*WRITERS, *BY_HAND]
