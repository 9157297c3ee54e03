"""An MCAP file as records, each byte that counts held against a checksum; knows nothing of what they say."""

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
    LONGEST_NAME,
    MESSAGE,
    MOST_CHUNK_BYTES,
    PIECE,
    RECORD,
    Chunk,
    DamagedError,
    records,
    stamp,
    unpack,
)

MAGIC = b"\x89MCAP0\r\n"
COPY = "metadata.json"
"""Attachment that repeats the metadata at the start of a file: a record of metadata has no checksum of its own."""
_MOST_ATTACHED = 64 << 20
"""Attachments of a file, together [bytes]."""
_MOST_METADATA = 16 << 20
"""Metadata of a file, together [bytes]."""
_HEAD_BYTES = 1 << 10
"""What one of them takes at least, as reading it costs time."""
_MOST_SUMMARY = 256 << 20
"""Largest summary: that of some 600 GB [bytes]."""
_MOST_PACKED = 1000
"""Chunks unpack to at most so many times the file, and to `MOST_CHUNK_BYTES` of a small one."""
_LEAST_RECORD = 24
"""A file of records shorter than this, on the whole, is none of a recorder's [bytes]."""
_CHUNK_INDEX = struct.Struct("<QQQQI")
_INDEXED = struct.Struct("<HQ")
_BARE = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
"""What may stand in chunks, or outside them."""
_LAST_OPCODE = 0x0F
"""Records of a higher number are of a later version of the format, or private (0x80 on); a reader passes over them."""
_SURE = 0x8F
"""In a file without an end a number up to this one may be a known one with a flipped bit, which no checksum covers."""
_FOOTER = struct.Struct("<BQQQI")
_DATA_END = struct.Struct("<BQI")


@dataclass
class Contents:
    """What stands in a file outside its chunks, and where these are.

    Attributes:
        complete: The file was finished, and is taken for it.
        finished: It has an end, whatever is damaged before that.
        damaged: Records that are not what was written, and are passed over.
        unchecked: What no checksum covers.
        metadata: Metadata by name.
        attachments: Attachments by name.
        topics: Topic of each channel.
        about: What a channel says of its topic, by topic.
        counts: Number of messages by channel.
        chunks: The chunks with messages, in file order.
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
    """Look through a file; a finished one is held against its checksums from the first byte to the last.

    Args:
        file: The file, behind its magic bytes.
        size: Its length [bytes].
        salvage: Take it for one that was cut off, whether it is or not.
        in_part: Only some of its chunks will be read, each by its own checksum: leave out the one of the whole.

    Raises:
        DamagedError: A finished file is not what was written.
    """
    footer = _footer(file, size)
    if footer is None or salvage:
        found, _ = _walked(file, size)
        if footer is not None:
            found.finished = True
            with contextlib.suppress(DamagedError):  # a chunk with channels may be among the damaged ones
                summary = _summary(file, size, footer).found
                found.topics, found.about = summary.topics | found.topics, summary.about | found.about
        return _counted(file, found)
    summary = _summary(file, size, footer)
    room = _Room(size)
    found, data_end = summary.found, summary.start - _DATA_END.size
    if not summary.indexed or not _take_data(file, summary, data_end, room):
        found, data_end = _walked(file, size, finished=True)
        if data_end is None or found.damaged:
            raise DamagedError("records of the data section that are not what was written")
        _check_against(summary, _counted(file, found))
    _check_end(file, found, data_end, in_part=in_part)
    found.complete = found.finished = True
    return found


def _check_end(file: BinaryIO, found: Contents, data_end: int, *, in_part: bool) -> None:
    """Hold the data section against its checksum; where none was written, name what nothing covers."""
    file.seek(data_end)
    opcode, length, expected = _DATA_END.unpack(file.read(_DATA_END.size))
    if opcode != Opcode.DATA_END or length < 4:
        raise DamagedError("no end of the data")
    if expected:
        if not in_part and _sum(file, data_end) != expected:
            raise DamagedError("the checksum of the whole does not fit")
        found.unchecked = ()
    elif COPY not in found.attachments:
        found.unchecked = ("its metadata (by an earlier version, without a checksum of the whole)",)
    else:
        found.unchecked += ("what has no checksum of its own (its writer made none of the whole)",)


def _check_against(summary: _Summary, found: Contents) -> None:
    """Hold what was found in the data section against what the summary states of it."""
    stated, chunks = summary.found, {chunk.offset for chunk in found.chunks}
    if found.damaged or not set(found.counts) <= set(found.topics):
        raise DamagedError("chunks that are not what was written")
    if not {chunk.offset for chunk in stated.chunks if chunk.channels} <= chunks:
        raise DamagedError("an index that does not fit what is there")
    if summary.counted and {number: count for number, count in stated.counts.items() if count} != found.counts:
        raise DamagedError("counts that do not fit the index")


def _take_data(file: BinaryIO, summary: _Summary, data_end: int, room: _Room) -> bool:
    """Hold the records of the data against their index, and take metadata and attachments.

    Returns:
        Whether the index leads to all messages; False where messages stand outside chunks.
    """
    found, position, places = summary.found, len(MAGIC), set()
    indexed = summary.places | {(chunk.offset, chunk.length + RECORD.size) for chunk in found.chunks}
    found.chunks = [chunk for chunk in found.chunks if chunk.channels]  # one without an index has no messages
    while position < data_end:
        file.seek(position)
        opcode, length = _head(file)
        end = position + RECORD.size + length
        if end > data_end:
            raise DamagedError("records that do not end with the data")
        if opcode == Opcode.MESSAGE:
            return False
        room.take(opcode, file, length)
        if opcode == Opcode.CHUNK or opcode in summary.kinds:
            places.add((position, end - position))
        if opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            _take(found, opcode, file.read(length))
        position = end
    if places != indexed:
        raise DamagedError("an index that does not fit what is there")
    if sum(found.counts.values()) > room.unpacked // (RECORD.size + MESSAGE.size):
        raise DamagedError("more messages counted than there is room for")
    counted = {number for number, count in found.counts.items() if count}
    if counted != set().union(*(chunk.channels or () for chunk in found.chunks)):
        raise DamagedError("counts that do not fit the index")
    return True


class _Room:
    """What the records of a file may take, so that a small file costs neither memory nor time."""

    def __init__(self, size: int) -> None:
        self.unpacked = 0
        self._most = _MOST_PACKED * size + MOST_CHUNK_BYTES
        self._records = size // _LEAST_RECORD + 10_000
        self._kept: dict[int, int] = {Opcode.ATTACHMENT: _MOST_ATTACHED, Opcode.METADATA: _MOST_METADATA}

    def take(self, opcode: int, file: BinaryIO, length: int) -> None:
        """Count a record; the file is where its body begins, and stays there.

        Raises:
            DamagedError: It is too large, or there are too many of them.
        """
        self._records -= 1
        if opcode == Opcode.CHUNK:
            start = file.tell()
            head = file.read(CHUNK.size)
            file.seek(start)
            unpacked = CHUNK.unpack(head)[2] if len(head) == CHUNK.size else 0
            self.unpacked += unpacked if unpacked <= MOST_CHUNK_BYTES else 0  # a larger one is not unpacked
        elif opcode in self._kept:
            self._kept[opcode] -= length + _HEAD_BYTES
            if self._kept[opcode] < 0:
                raise DamagedError(f"a record of {length} bytes")
        if self._records < 0 or self.unpacked > self._most:
            raise DamagedError("more records, or more packed into them, than a recorder makes of a file of that size")


def _head(file: BinaryIO) -> tuple[int, int]:
    """Opcode and length of the record that begins here."""
    return RECORD.unpack(file.read(RECORD.size))


def _sum(file: BinaryIO, end: int) -> int:
    """CRC-32 of a file up to a place."""
    file.seek(0)
    checksum = 0
    while (left := end - file.tell()) > 0 and (data := file.read(min(PIECE, left))):
        checksum = zlib.crc32(data, checksum)
    return checksum


def _footer(file: BinaryIO, size: int) -> tuple[int, int] | None:
    """Where the summary of a finished file begins, and its checksum."""
    at = size - len(MAGIC) - _FOOTER.size
    if at < len(MAGIC):
        return None
    file.seek(at)
    opcode, length, start, _, checksum = _FOOTER.unpack(file.read(_FOOTER.size))
    whole = (opcode, length) == (Opcode.FOOTER, _FOOTER.size - RECORD.size) and file.read(len(MAGIC)) == MAGIC
    return (start, checksum) if whole else None


@dataclass
class _Summary:
    """What a file states at its end, each part of which a writer may leave out.

    Attributes:
        start: Where it begins [bytes].
        found: Channels, counts and chunks.
        counted: It has statistics.
        places: Offset and length of indexed metadata and attachments.
        kinds: Opcodes of those of the two that are indexed.
    """

    start: int
    found: Contents = field(default_factory=Contents)
    counted: bool = False
    places: set[tuple[int, int]] = field(default_factory=set)
    kinds: set[int] = field(default_factory=set)

    @property
    def indexed(self) -> bool:
        """Whether the messages can be found by it: channels, counts, and an index of the chunks with their channels."""
        chunks, counts = self.found.chunks, {number for number, count in self.found.counts.items() if count}
        listed = set().union(*(chunk.channels or () for chunk in chunks))
        return self.counted and bool(listed) and counts | listed <= set(self.found.topics)


def _summary(file: BinaryIO, size: int, footer: tuple[int, int]) -> _Summary:
    """Read what the file states at its end."""
    start, expected = footer
    if start == 0:
        return _Summary(start)
    end = size - len(MAGIC) - _FOOTER.size
    if start < len(MAGIC) + _DATA_END.size or start > end:
        raise DamagedError("a footer that points nowhere")
    if size - start > _MOST_SUMMARY:
        raise DamagedError(f"a summary of {size - start} bytes")
    file.seek(start)
    data = file.read(size - len(MAGIC) - 4 - start)
    if expected and zlib.crc32(data) != expected:
        raise DamagedError("the checksum of the summary does not fit")
    summary = _Summary(start)
    found, room = summary.found, _Room(len(data))
    for opcode, at, stop in records(data[: end - start]):
        room.take(opcode, file, 0)
        if opcode == Opcode.CHUNK_INDEX:
            found.chunks.append(_chunk_indexed(data[at:stop]))
            continue
        body = ReadDataStream(BytesIO(data[at:stop]))
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(body)
            _add_topic(found, channel)
        elif opcode == Opcode.STATISTICS:
            found.counts, summary.counted = dict(Statistics.read(body).channel_message_counts), True
        elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            attached = opcode == Opcode.ATTACHMENT_INDEX
            index = (AttachmentIndex if attached else MetadataIndex).read(body)
            summary.places.add((index.offset, index.length))
            summary.kinds.add(Opcode.ATTACHMENT if attached else Opcode.METADATA)
    found.chunks.sort(key=lambda chunk: chunk.offset)
    for earlier, later in pairwise(found.chunks):
        if later.offset < earlier.offset + earlier.length:
            raise DamagedError("chunks that lie upon each other")
    return summary


def _chunk_indexed(body: bytes) -> Chunk:
    begin_ns, end_ns, offset, length, indexed = _CHUNK_INDEX.unpack_from(body)
    stop = _CHUNK_INDEX.size + indexed
    if stop > len(body) or indexed % _INDEXED.size or length < RECORD.size:
        raise DamagedError("an index of a chunk that is none")
    channels = frozenset(number for number, _ in _INDEXED.iter_unpack(body[_CHUNK_INDEX.size : stop]))
    return Chunk(offset, length - RECORD.size, begin_ns, end_ns, channels)


def _add_topic(found: Contents, channel: Channel) -> None:
    if found.topics.setdefault(channel.id, channel.topic) != channel.topic:
        raise DamagedError("one number for two channels")
    found.about[channel.topic] = channel.metadata


def _take(found: Contents, opcode: int, body: bytes) -> None:
    """Take a record of metadata or an attachment.

    Raises:
        DamagedError: It is not what was written, or its name comes twice.
    """
    stream = ReadDataStream(BytesIO(body))
    try:
        if opcode == Opcode.ATTACHMENT:
            attachment = Attachment.read(stream)
            stated = int.from_bytes(body[stream.count - 4 : stream.count], "little")
            if stated and zlib.crc32(body[: stream.count - 4]) != stated:  # 0: the writer made none
                raise DamagedError("an attachment whose checksum does not fit")
            kept, name, value = found.attachments, attachment.name, attachment.data
        else:
            metadata = Metadata.read(stream)
            kept, name, value = found.metadata, metadata.name, metadata.metadata
    except (McapError, struct.error, UnicodeDecodeError):
        raise DamagedError("a record that does not end where it should") from None
    if stream.count > len(body) or name in kept:  # bytes after the last field are for later versions of the format
        raise DamagedError(f"{name} twice" if name in kept else "a record that does not end where it should")
    kept[name] = value  # type: ignore[assignment]


def _walked(file: BinaryIO, size: int, *, finished: bool = False) -> tuple[Contents, int | None]:
    """Return what the records of a file contain, read from its beginning, and where the data section ends.

    A record counts only if all of it lies in the file: a cut at any byte costs at most the chunk it went through. The
    end is None where the file does not reach it.
    """
    found, bare_from = Contents(), 0
    position, room = len(MAGIC), _Room(size)
    while position + RECORD.size <= size:
        file.seek(position)
        opcode, length = _head(file)
        end = position + RECORD.size + length
        bare = opcode in _BARE and end <= size
        if bare_from and not (bare and end - bare_from <= PIECE):
            found.chunks.append(Chunk(bare_from, position - bare_from, bare=True))
            bare_from = 0
        if opcode == 0 or end > size:
            # Cut off, or zeros where a power cut left unwritten pages; else its length is not what was written.
            if opcode == Opcode.CHUNK and _says(file, length):
                found.chunks.append(Chunk(position, size - position - RECORD.size, cut=True))
            elif not (length == 0 and _zeros(file) if opcode == 0 else _says_index(file, opcode, length)):
                found.damaged += 1
            break
        if opcode == Opcode.DATA_END and length >= 4:
            return found, position
        room.take(opcode, file, length)
        if bare:
            bare_from = bare_from or position
        elif opcode == Opcode.CHUNK:
            found.chunks.append(Chunk(position, length))
        elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            try:
                _take(found, opcode, file.read(length))
            except DamagedError:
                found.damaged += 1
        elif opcode not in (Opcode.HEADER, Opcode.MESSAGE_INDEX) and opcode <= (_LAST_OPCODE if finished else _SURE):
            found.damaged += 1
        position = end
    else:
        if bare_from:
            found.chunks.append(Chunk(bare_from, position - bare_from, bare=True))
    return found, None


def _says(file: BinaryIO, length: int) -> bool:
    """Whether a chunk that was cut is as long as it says in two places, as far as the file goes."""
    head = file.read(CHUNK.size + LONGEST_NAME + 8)
    if len(head) < CHUNK.size:
        return True
    name = CHUNK.unpack_from(head)[-1]
    packed = head[CHUNK.size + name : CHUNK.size + name + 8]
    return len(packed) < 8 or CHUNK.size + name + 8 + int.from_bytes(packed, "little") == length


def _says_index(file: BinaryIO, opcode: int, length: int) -> bool:
    """The same of another record that was cut: an index behind a chunk, or the metadata at the end."""
    if opcode == Opcode.MESSAGE_INDEX:
        head = file.read(6)
        return len(head) < 6 or 6 + int.from_bytes(head[2:], "little") == length
    return opcode in (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.DATA_END, *_BARE)


def _zeros(file: BinaryIO) -> bool:
    while data := file.read(PIECE):
        if data.count(0) < len(data):
            return False
    return True


def _counted(file: BinaryIO, found: Contents) -> Contents:
    """Find channels, counts and times of a cut file in its chunks; one that does not unpack is passed over."""
    good, counts, unchecked, bare = [], [], 0, 0
    for chunk in found.chunks:
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
                    _add_topic(found, Channel.read(ReadDataStream(BytesIO(data[start:end]))))
        except (McapError, struct.error, ValueError):
            found.damaged += 1
            continue
        if times_ns:
            good.append(replace(chunk, begin_ns=min(times_ns), end_ns=max(times_ns), channels=frozenset(inside)))
            counts.append(inside)
            unchecked += len(times_ns) if chunk.cut else 0
            bare += len(times_ns) if chunk.bare else 0
    for inside in counts:
        if not set(inside) <= set(found.topics):
            found.damaged += 1
        for number in set(inside) & set(found.topics):
            found.counts[number] = found.counts.get(number, 0) + inside[number]
    found.chunks = good
    if COPY not in found.attachments:
        found.unchecked += ("its metadata (by an earlier version)",)
    if unchecked:
        found.unchecked += (f"the last {unchecked} messages (of the chunk in which it was cut off)",)
    if bare:
        found.unchecked += (f"{bare} messages outside chunks",)
    return found
