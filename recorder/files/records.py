"""Records of an MCAP file with checksum verification, independent of their contents."""

from __future__ import annotations

import contextlib
import struct
import zlib
from dataclasses import dataclass, field, replace
from io import BytesIO
from itertools import pairwise
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, Metadata, MetadataIndex, Statistics

from recorder.files.chunks import (
    CHUNK,
    MAX_CHUNK_BYTES,
    MAX_NAME_BYTES,
    MESSAGE,
    READ_BYTES,
    RECORD,
    Chunk,
    DamagedError,
    records,
    stamp,
    unpack,
)

MAGIC = b"\x89MCAP0\r\n"
COPY = "metadata.json"
"""Attachment that repeats the metadata of the file start, because a metadata record has no checksum of its own."""
_MAX_ATTACHED_BYTES = 64 << 20
"""Size limit of all attachments of a file [bytes]."""
_MAX_METADATA_BYTES = 16 << 20
"""Size limit of all metadata of a file [bytes]."""
_MIN_RECORD_COST_BYTES = 1 << 10
"""Smallest size counted for each attachment or metadata record [bytes]; reading one takes time."""
_MAX_SUMMARY_BYTES = 256 << 20
"""Largest accepted summary [bytes]; corresponds to a file of about 600 GB."""
_MAX_COMPRESSION_RATIO = 1000
"""Largest accepted compression ratio of a file; a small file may always decompress to `MAX_CHUNK_BYTES`."""
_MIN_RECORD_BYTES = 24
"""Smallest plausible mean size of a record [bytes]."""
_CHUNK_INDEX = struct.Struct("<QQQQI")
_INDEX_ENTRY = struct.Struct("<HQ")
_CHUNKABLE_OPCODES = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
"""Records that may be inside or outside chunks."""
_LAST_OPCODE = 0x0F
"""Last opcode of this format version; higher ones are of later versions or private (from 0x80), and are skipped."""
_LAST_SUSPECT_OPCODE = 0x8F
"""Largest opcode that counts as damage in an unfinished file: a valid opcode with its highest bit flipped."""
_FOOTER = struct.Struct("<BQQQI")
_DATA_END = struct.Struct("<BQI")


@dataclass
class Contents:
    """Contents of a file outside its chunks, and the positions of the chunks.

    Attributes:
        complete: Whether the file was finished and verified as such.
        finished: Whether the file has a valid end, even if damaged elsewhere.
        damaged: Number of damaged records that were skipped.
        unchecked: Descriptions of the data without a checksum.
        metadata: Metadata by name.
        attachments: Attachments by name.
        topics: Topic of each channel.
        about: Channel metadata by topic.
        counts: Number of messages by channel.
        chunks: Chunks with messages, in file order.
    """

    complete: bool = False
    finished: bool = False
    damaged: int = 0
    unchecked: tuple[str, ...] = ()
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    topics: dict[int, str] = field(default_factory=dict)
    about: dict[str, dict[str, str]] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    chunks: list[Chunk] = field(default_factory=list)


def read_contents(file: BinaryIO, size: int, *, salvage: bool, in_part: bool = False) -> Contents:
    """Read the structure of a file and verify the checksums of a finished one.

    Args:
        file: The file, positioned after its magic bytes.
        size: Its length [bytes].
        salvage: Treat the file as unfinished.
        in_part: Skip the checksum of the whole file; each chunk is verified when it is read.

    Raises:
        DamagedError: A finished file is damaged.
    """
    footer = _read_footer(file, size)
    if footer is None or salvage:
        contents, _ = _walk_records(file, size)
        if footer is not None:
            contents.finished = True
            with contextlib.suppress(DamagedError):  # a damaged chunk may have held channel records
                summary = _read_summary(file, size, footer).contents
                contents.topics, contents.about = summary.topics | contents.topics, summary.about | contents.about
        return _count_messages(file, contents)
    summary = _read_summary(file, size, footer)
    limits = _RecordLimits(size)
    contents, data_end = summary.contents, summary.start - _DATA_END.size
    if not summary.indexed or not _check_index(file, summary, data_end, limits):
        contents, data_end = _walk_records(file, size, finished=True)
        if data_end is None or contents.damaged:
            raise DamagedError("damaged records in the data section")
        _check_against(summary, _count_messages(file, contents))
    _check_end(file, contents, data_end, in_part=in_part)
    contents.complete = contents.finished = True
    return contents


def _check_end(file: BinaryIO, contents: Contents, data_end: int, *, in_part: bool) -> None:
    """Verify the checksum of the data section; if there is none, name the unverified data."""
    file.seek(data_end)
    opcode, length, expected = _DATA_END.unpack(file.read(_DATA_END.size))
    if opcode != Opcode.DATA_END or length < 4:
        raise DamagedError("a data section without an end")
    if expected:
        if not in_part and _checksum(file, data_end) != expected:
            raise DamagedError("a wrong checksum of the data section")
        contents.unchecked = ()
    elif COPY not in contents.attachments:
        contents.unchecked = ("its metadata (written by an earlier version, without a checksum of the whole file)",)
    else:
        contents.unchecked += ("records without a checksum of their own (the file has no checksum of the whole)",)


def _check_against(summary: _Summary, contents: Contents) -> None:
    """Compare the contents of the data section with the summary."""
    stated, chunks = summary.contents, {chunk.offset for chunk in contents.chunks}
    if contents.damaged or not set(contents.counts) <= set(contents.topics):
        raise DamagedError("damaged chunks")
    if not {chunk.offset for chunk in stated.chunks if chunk.channels} <= chunks:
        raise DamagedError("an index that does not fit the file")
    if summary.counted and {number: count for number, count in stated.counts.items() if count} != contents.counts:
        raise DamagedError("message counts that do not fit the file")


def _check_index(file: BinaryIO, summary: _Summary, data_end: int, limits: _RecordLimits) -> bool:
    """Compare the records of the data section with the index, and read metadata and attachments.

    Returns:
        True if the index lists all messages; False if there are messages outside chunks.
    """
    contents, position, places = summary.contents, len(MAGIC), set()
    indexed = summary.places | {(chunk.offset, chunk.length + RECORD.size) for chunk in contents.chunks}
    contents.chunks = [chunk for chunk in contents.chunks if chunk.channels]  # a chunk without an index has no messages
    while position < data_end:
        file.seek(position)
        opcode, length = _read_head(file)
        end = position + RECORD.size + length
        if end > data_end:
            raise DamagedError("records longer than the data section")
        if opcode == Opcode.MESSAGE:
            return False
        limits.count_record(opcode, file, length)
        if opcode == Opcode.CHUNK or opcode in summary.kinds:
            places.add((position, end - position))
        if opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            _read_record(contents, opcode, file.read(length))
        position = end
    if places != indexed:
        raise DamagedError("an index that does not fit the file")
    if sum(contents.counts.values()) > limits.unpacked // (RECORD.size + MESSAGE.size):
        raise DamagedError("a message count larger than the file can hold")
    counted = {number for number, count in contents.counts.items() if count}
    if counted != set().union(*(chunk.channels or () for chunk in contents.chunks)):
        raise DamagedError("message counts that do not fit the index")
    return True


class _RecordLimits:
    """Limits on the records of a file, so that a small malicious file cannot exhaust memory or time."""

    def __init__(self, size: int) -> None:
        self.unpacked = 0
        self._max_unpacked = _MAX_COMPRESSION_RATIO * size + MAX_CHUNK_BYTES
        self._records = size // _MIN_RECORD_BYTES + 10_000
        self._kept: dict[int, int] = {Opcode.ATTACHMENT: _MAX_ATTACHED_BYTES, Opcode.METADATA: _MAX_METADATA_BYTES}

    def count_record(self, opcode: int, file: BinaryIO, length: int) -> None:
        """Count a record. The file is positioned at the record's body and stays there.

        Raises:
            DamagedError: The record is too large, or there are too many records.
        """
        self._records -= 1
        if opcode == Opcode.CHUNK:
            start = file.tell()
            head = file.read(CHUNK.size)
            file.seek(start)
            unpacked = CHUNK.unpack(head)[2] if len(head) == CHUNK.size else 0
            self.unpacked += unpacked if unpacked <= MAX_CHUNK_BYTES else 0  # larger chunks are never decompressed
        elif opcode in self._kept:
            self._kept[opcode] -= length + _MIN_RECORD_COST_BYTES
            if self._kept[opcode] < 0:
                raise DamagedError(f"a record of {length} bytes")
        if self._records < 0 or self.unpacked > self._max_unpacked:
            raise DamagedError("more records, or more data in them, than a recorder writes to a file of this size")


def _read_head(file: BinaryIO) -> tuple[int, int]:
    """Return opcode and length of the record at the current position."""
    return RECORD.unpack(file.read(RECORD.size))


def _checksum(file: BinaryIO, end: int) -> int:
    """Return the CRC-32 of a file up to a position."""
    file.seek(0)
    checksum = 0
    while (remaining := end - file.tell()) > 0 and (data := file.read(min(READ_BYTES, remaining))):
        checksum = zlib.crc32(data, checksum)
    return checksum


def _read_footer(file: BinaryIO, size: int) -> tuple[int, int] | None:
    """Return the position and checksum of the summary of a finished file; None for an unfinished one."""
    at = size - len(MAGIC) - _FOOTER.size
    if at < len(MAGIC):
        return None
    file.seek(at)
    opcode, length, start, _, checksum = _FOOTER.unpack(file.read(_FOOTER.size))
    whole = (opcode, length) == (Opcode.FOOTER, _FOOTER.size - RECORD.size) and file.read(len(MAGIC)) == MAGIC
    return (start, checksum) if whole else None


@dataclass
class _Summary:
    """Summary at the end of a file; every part of it is optional in MCAP.

    Attributes:
        start: Position of the summary [bytes].
        contents: Channels, counts and chunks.
        counted: Whether it has statistics.
        places: Offset and length of each indexed metadata record and attachment.
        kinds: Opcodes of the indexed kinds of the two.
    """

    start: int
    contents: Contents = field(default_factory=Contents)
    counted: bool = False
    places: set[tuple[int, int]] = field(default_factory=set)
    kinds: set[int] = field(default_factory=set)

    @property
    def indexed(self) -> bool:
        """True if the summary suffices to find all messages: channels, counts, and a chunk index with channels."""
        chunks, counts = self.contents.chunks, {number for number, count in self.contents.counts.items() if count}
        listed = set().union(*(chunk.channels or () for chunk in chunks))
        return self.counted and bool(listed) and counts | listed <= set(self.contents.topics)


def _read_summary(file: BinaryIO, size: int, footer: tuple[int, int]) -> _Summary:
    """Read the summary at the end of a file."""
    start, expected = footer
    if start == 0:
        return _Summary(start)
    end = size - len(MAGIC) - _FOOTER.size
    if start < len(MAGIC) + _DATA_END.size or start > end:
        raise DamagedError("a footer with an invalid position of the summary")
    if size - start > _MAX_SUMMARY_BYTES:
        raise DamagedError(f"a summary of {size - start} bytes")
    file.seek(start)
    data = file.read(size - len(MAGIC) - 4 - start)
    if expected and zlib.crc32(data) != expected:
        raise DamagedError("a wrong checksum of the summary")
    summary = _Summary(start)
    contents, limits = summary.contents, _RecordLimits(len(data))
    for opcode, at, stop in records(data[: end - start]):
        limits.count_record(opcode, file, 0)
        if opcode == Opcode.CHUNK_INDEX:
            contents.chunks.append(_parse_chunk_index(data[at:stop]))
            continue
        body = ReadDataStream(BytesIO(data[at:stop]))
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(body)
            _add_topic(contents, channel)
        elif opcode == Opcode.STATISTICS:
            contents.counts, summary.counted = dict(Statistics.read(body).channel_message_counts), True
        elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            attached = opcode == Opcode.ATTACHMENT_INDEX
            index = (AttachmentIndex if attached else MetadataIndex).read(body)
            summary.places.add((index.offset, index.length))
            summary.kinds.add(Opcode.ATTACHMENT if attached else Opcode.METADATA)
    contents.chunks.sort(key=lambda chunk: chunk.offset)
    for earlier, later in pairwise(contents.chunks):
        if later.offset < earlier.offset + earlier.length:
            raise DamagedError("overlapping chunks")
    return summary


def _parse_chunk_index(body: bytes) -> Chunk:
    begin_ns, end_ns, offset, length, indexed = _CHUNK_INDEX.unpack_from(body)
    stop = _CHUNK_INDEX.size + indexed
    if stop > len(body) or indexed % _INDEX_ENTRY.size or length < RECORD.size:
        raise DamagedError("an invalid chunk index")
    channels = frozenset(number for number, _ in _INDEX_ENTRY.iter_unpack(body[_CHUNK_INDEX.size : stop]))
    return Chunk(offset, length - RECORD.size, begin_ns, end_ns, channels)


def _add_topic(contents: Contents, channel: Channel) -> None:
    if contents.topics.setdefault(channel.id, channel.topic) != channel.topic:
        raise DamagedError("two channels with the same number")
    contents.about[channel.topic] = channel.metadata


def _read_record(contents: Contents, opcode: int, body: bytes) -> None:
    """Read a metadata record or an attachment.

    Raises:
        DamagedError: The record is damaged, or its name occurs twice.
    """
    stream = ReadDataStream(BytesIO(body))
    try:
        if opcode == Opcode.ATTACHMENT:
            attachment = Attachment.read(stream)
            stated = int.from_bytes(body[stream.count - 4 : stream.count], "little")
            if stated and zlib.crc32(body[: stream.count - 4]) != stated:  # 0: no checksum
                raise DamagedError("an attachment with a wrong checksum")
            kept, name, value = contents.attachments, attachment.name, attachment.data
        else:
            metadata = Metadata.read(stream)
            kept, name, value = contents.metadata, metadata.name, metadata.metadata
    except (McapError, struct.error, UnicodeDecodeError):
        raise DamagedError("a record of the wrong length") from None
    if stream.count > len(body) or name in kept:  # later format versions may append fields
        raise DamagedError(f"two records named {name}" if name in kept else "a record of the wrong length")
    kept[name] = value  # type: ignore[assignment]


def _walk_records(file: BinaryIO, size: int, *, finished: bool = False) -> tuple[Contents, int | None]:
    """Return the contents of a file read record by record, and the end of the data section; None if it is not reached.

    Only records that lie completely in the file count, so a truncation costs at most one chunk.
    """
    contents, bare_from = Contents(), 0
    position, limits, last = len(MAGIC), _RecordLimits(size), _LAST_OPCODE if finished else _LAST_SUSPECT_OPCODE
    while position + RECORD.size <= size:
        file.seek(position)
        opcode, length = _read_head(file)
        end = position + RECORD.size + length
        bare = opcode in _CHUNKABLE_OPCODES and end <= size
        if bare_from and not (bare and end - bare_from <= READ_BYTES):
            contents.chunks.append(Chunk(bare_from, position - bare_from, bare=True))
            bare_from = 0
        if opcode == 0 or end > size:
            # Truncated, or zeros from unwritten pages after a power failure; otherwise the length is damaged.
            if opcode == Opcode.CHUNK and _lengths_agree(file, length):
                contents.chunks.append(Chunk(position, size - position - RECORD.size, cut=True))
            elif not (length == 0 and _only_zeros(file) if opcode == 0 else _is_plausible(file, opcode, length)):
                contents.damaged += 1
            break
        if opcode == Opcode.DATA_END and length >= 4:
            return contents, position
        limits.count_record(opcode, file, length)
        if bare:
            bare_from = bare_from or position
        elif opcode == Opcode.CHUNK:
            contents.chunks.append(Chunk(position, length))
        elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            try:
                _read_record(contents, opcode, file.read(length))
            except DamagedError:
                contents.damaged += 1
        elif opcode not in (Opcode.HEADER, Opcode.MESSAGE_INDEX) and opcode <= last:
            contents.damaged += 1
        position = end
    else:
        if bare_from:
            contents.chunks.append(Chunk(bare_from, position - bare_from, bare=True))
    return contents, None


def _lengths_agree(file: BinaryIO, length: int) -> bool:
    """Return whether the two lengths in the header of a truncated chunk agree, as far as the file contains them."""
    head = file.read(CHUNK.size + MAX_NAME_BYTES + 8)
    if len(head) < CHUNK.size:
        return True
    name = CHUNK.unpack_from(head)[-1]
    packed = head[CHUNK.size + name : CHUNK.size + name + 8]
    return len(packed) < 8 or CHUNK.size + name + 8 + int.from_bytes(packed, "little") == length


def _is_plausible(file: BinaryIO, opcode: int, length: int) -> bool:
    """Return whether another truncated record is plausible: a message index, or a record of the file's end."""
    if opcode == Opcode.MESSAGE_INDEX:
        head = file.read(6)
        return len(head) < 6 or 6 + int.from_bytes(head[2:], "little") == length
    return opcode in (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.DATA_END, *_CHUNKABLE_OPCODES)


def _only_zeros(file: BinaryIO) -> bool:
    while data := file.read(READ_BYTES):
        if data.count(0) < len(data):
            return False
    return True


def _count_messages(file: BinaryIO, contents: Contents) -> Contents:
    """Determine channels, counts and times of an unfinished file from its chunks; unreadable chunks are skipped."""
    good, counts, unchecked, bare = [], [], 0, 0
    for chunk in contents.chunks:
        times_ns: list[int] = []
        inside: dict[int, int] = {}
        try:
            data = unpack(file, chunk)
            for opcode, start, end in records(data, cut=chunk.cut):
                if opcode == Opcode.MESSAGE:
                    number, _, time_ns, _ = stamp(data, start, end)
                    inside[number] = inside.get(number, 0) + 1
                    times_ns.append(time_ns)
                elif opcode == Opcode.CHANNEL:
                    _add_topic(contents, Channel.read(ReadDataStream(BytesIO(data[start:end]))))
        except (McapError, struct.error, ValueError):
            contents.damaged += 1
            continue
        if times_ns:
            good.append(replace(chunk, begin_ns=min(times_ns), end_ns=max(times_ns), channels=frozenset(inside)))
            counts.append(inside)
            unchecked += len(times_ns) if chunk.cut else 0
            bare += len(times_ns) if chunk.bare else 0
    for inside in counts:
        if not set(inside) <= set(contents.topics):
            contents.damaged += 1
        for number in set(inside) & set(contents.topics):
            contents.counts[number] = contents.counts.get(number, 0) + inside[number]
    contents.chunks = good
    if COPY not in contents.attachments:
        contents.unchecked += ("its metadata (written by an earlier version)",)
    if unchecked:
        contents.unchecked += (f"the last {unchecked} messages (of the chunk in which the file ends)",)
    if bare:
        contents.unchecked += (f"{bare} messages outside chunks",)
    return contents
