"""An MCAP file as records, each byte that counts held against a checksum; knows nothing of what they say."""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from io import BytesIO
from itertools import pairwise
from typing import BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, Metadata, MetadataIndex, Statistics

MAGIC = b"\x89MCAP0\r\n"
COPY = "metadata.json"
"""Attachment that repeats the metadata at the start of a file: a record of metadata has no checksum of its own."""
MOST_CHUNK_BYTES = 64 << 20
"""Largest chunk, unpacked: a writer closes one at 1 MiB, and the message that it closes with may be long."""
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
RECORD = struct.Struct("<BQ")
MESSAGE = struct.Struct("<HIQQ")
CHUNK = struct.Struct("<QQQII")
_CHUNK_INDEX = struct.Struct("<QQQQI")
_INDEXED = struct.Struct("<HQ")
_FOOTER = struct.Struct("<BQQQI")
_DATA_END = struct.Struct("<BQI")
_PIECE = 1 << 20
_CUT_PIECE = 4096
_LONGEST_NAME = 32


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
    """

    offset: int
    length: int
    begin_ns: int = 0
    end_ns: int = 0
    channels: frozenset[int] | None = None
    cut: bool = False
    part: int = 0


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


def read_contents(file: BinaryIO, size: int, *, salvage: bool) -> Contents:
    """Look through a file; a finished one is held against its checksums from the first byte to the last.

    Args:
        file: The file, behind its magic bytes.
        size: Its length [bytes].
        salvage: Take it for one that was cut off, whether it is or not.

    Raises:
        DamagedError: A finished file is not what was written.
    """
    footer = _footer(file, size)
    if footer is None or salvage:
        found = _walked(file, size)
        if footer is not None:
            found.finished = True
            with contextlib.suppress(DamagedError):  # a chunk with channels may be among the damaged ones
                summary = _summary(file, size, footer)[0]
                found.topics, found.about = summary.topics | found.topics, summary.about | found.about
        return _counted(file, found)
    found, indexed, data_end = _summary(file, size, footer)
    _take_data(file, found, indexed, data_end)
    file.seek(data_end)
    opcode, length, expected = _DATA_END.unpack(file.read(_DATA_END.size))
    if (opcode, length) != (Opcode.DATA_END, 4):
        raise DamagedError("no end of the data")
    if expected or COPY in found.attachments:
        if _sum(file, data_end) != expected:
            raise DamagedError("the checksum of the whole does not fit")
    else:
        found.unchecked = ("its metadata (by an earlier version, without a checksum of the whole)",)
    found.complete = found.finished = True
    return found


def _take_data(file: BinaryIO, found: Contents, indexed: set[tuple[int, int]], data_end: int) -> None:
    """Hold the records of the data against their index, and take metadata and attachments."""
    position, room, chunks = len(MAGIC), _Room(data_end), set()
    for chunk in found.chunks:
        indexed.add((chunk.offset, chunk.length + RECORD.size))
    found.chunks = [chunk for chunk in found.chunks if chunk.channels]  # one without an index has no messages
    while position < data_end:
        file.seek(position)
        opcode, length = _head(file)
        end = position + RECORD.size + length
        if end > data_end or opcode == Opcode.MESSAGE:
            raise DamagedError("records that do not end with the data, or messages outside of chunks")
        room.take(opcode, file, length)
        if opcode in (Opcode.CHUNK, Opcode.METADATA, Opcode.ATTACHMENT):
            chunks.add((position, end - position))
            if opcode != Opcode.CHUNK:
                _take(found, opcode, file.read(length))
        position = end
    if chunks != indexed:
        raise DamagedError("an index that does not fit what is there")
    if sum(found.counts.values()) > room.unpacked // (RECORD.size + MESSAGE.size):
        raise DamagedError("more messages counted than there is room for")
    counted = {number for number, count in found.counts.items() if count}
    if counted != set().union(*(chunk.channels or () for chunk in found.chunks)):
        raise DamagedError("counts that do not fit the index")


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
    while (left := end - file.tell()) > 0 and (data := file.read(min(_PIECE, left))):
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


def _summary(file: BinaryIO, size: int, footer: tuple[int, int]) -> tuple[Contents, set[tuple[int, int]], int]:
    """Channels, counts and chunks by the summary; where metadata and attachments are; where the data end."""
    start, expected = footer
    data_end, end = start - _DATA_END.size, size - len(MAGIC) - _FOOTER.size
    if data_end < len(MAGIC) or start > end:
        raise DamagedError("a footer that points nowhere")
    if size - start > _MOST_SUMMARY:
        raise DamagedError(f"a summary of {size - start} bytes")
    file.seek(start)
    data = file.read(size - len(MAGIC) - 4 - start)
    if zlib.crc32(data) != expected:
        raise DamagedError("the checksum of the summary does not fit")
    found, places = Contents(), set()
    room = _Room(len(data))
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
            found.counts = dict(Statistics.read(body).channel_message_counts)
        elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            index = (AttachmentIndex if opcode == Opcode.ATTACHMENT_INDEX else MetadataIndex).read(body)
            places.add((index.offset, index.length))
    for earlier, later in pairwise(found.chunks):
        if later.offset < earlier.offset + earlier.length:
            raise DamagedError("chunks that lie upon each other")
    used = set(found.counts).union(*(chunk.channels or () for chunk in found.chunks))
    if not used <= set(found.topics):
        raise DamagedError("messages on a channel that is not there")
    return found, places, data_end


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
            if len(body) < 4 or zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
                raise DamagedError("an attachment whose checksum does not fit")
            attachment = Attachment.read(stream)
            kept, name, value = found.attachments, attachment.name, attachment.data
        else:
            metadata = Metadata.read(stream)
            kept, name, value = found.metadata, metadata.name, metadata.metadata
    except (McapError, struct.error, UnicodeDecodeError):
        raise DamagedError("a record that does not end where it should") from None
    if stream.count != len(body) or name in kept:
        raise DamagedError(f"{name} twice" if name in kept else "a record that does not end where it should")
    kept[name] = value  # type: ignore[assignment]


def _walked(file: BinaryIO, size: int) -> Contents:
    """The records of a file that was cut off, one behind the other, as far as it goes.

    A record counts only if all of it lies in the file: a cut at any byte costs at most the chunk it went through.
    """
    found = Contents()
    position, room = len(MAGIC), _Room(size)
    while position + RECORD.size <= size:
        file.seek(position)
        opcode, length = _head(file)
        end = position + RECORD.size + length
        if opcode == 0 or end > size:
            # Cut off, or zeros where a power cut left unwritten pages; else its length is not what was written.
            if opcode == Opcode.CHUNK and _says(file, length):
                found.chunks.append(Chunk(position, size - position - RECORD.size, cut=True))
            elif not (length == 0 and _zeros(file) if opcode == 0 else _says_index(file, opcode, length)):
                found.damaged += 1
            break
        if opcode == Opcode.DATA_END and length == 4:
            break
        room.take(opcode, file, length)
        if opcode == Opcode.CHUNK:
            found.chunks.append(Chunk(position, length))
        elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            try:
                _take(found, opcode, file.read(length))
            except DamagedError:
                found.damaged += 1
        elif opcode not in (Opcode.HEADER, Opcode.MESSAGE_INDEX):
            found.damaged += 1
        position = end
    return found


def _says(file: BinaryIO, length: int) -> bool:
    """Whether a chunk that was cut is as long as it says in two places, as far as the file goes."""
    head = file.read(CHUNK.size + _LONGEST_NAME + 8)
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
    return opcode in (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.DATA_END)


def _zeros(file: BinaryIO) -> bool:
    while data := file.read(_PIECE):
        if data.count(0) < len(data):
            return False
    return True


def _counted(file: BinaryIO, found: Contents) -> Contents:
    """Find channels, counts and times of a cut file in its chunks; one that does not unpack is passed over."""
    good, counts, unchecked = [], [], 0
    for chunk in found.chunks:
        times_ns: list[int] = []
        inside: dict[int, int] = {}
        try:
            data = unpack(file, chunk)
            for opcode, start, end in records(data, cut=chunk.cut):
                if opcode == Opcode.MESSAGE:
                    number, _, time_ns, _ = _stamp(data, start, end)
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
    return found


def _stamp(data: bytes, start: int, end: int) -> tuple[int, int, int, int]:
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
            number, _, log_time, publish_time = _stamp(data, start, end)
            yield number, log_time, publish_time, data[start + MESSAGE.size : end]


def unpack(file: BinaryIO, chunk: Chunk) -> bytes:
    """Records of a chunk, unpacked to the size that it declares and checked against their sum.

    Raises:
        DamagedError: It is not what was written, or larger than a recorder makes one.
    """
    if chunk.length > MOST_CHUNK_BYTES + _PIECE:
        raise DamagedError(f"a chunk of {chunk.length} bytes")
    file.seek(chunk.offset + RECORD.size)
    body = file.read(chunk.length)
    if len(body) < CHUNK.size + 8:
        if chunk.cut:
            return b""
        raise DamagedError("a chunk without a head")
    *_, size, checksum, name_length = CHUNK.unpack_from(body)
    name, packed = body[CHUNK.size : CHUNK.size + name_length], body[CHUNK.size + name_length + 8 :]
    if size > MOST_CHUNK_BYTES or name not in (b"", b"zstd"):
        raise DamagedError(f"a chunk of {size} bytes, packed by {name[:_LONGEST_NAME]!r}")
    if chunk.cut:
        return _unpack_cut(packed, size) if name else packed
    stated = int.from_bytes(body[CHUNK.size + name_length : CHUNK.size + name_length + 8], "little")
    if stated != len(packed):
        raise DamagedError("a chunk that does not end where it should")
    data = packed
    if name:
        try:
            # What the packed data say of their size is allocated, so it is asked first.
            if zstandard.frame_content_size(packed) not in (-1, size):
                raise DamagedError("a chunk of another size than it says")
            data = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
        except zstandard.ZstdError as error:
            raise DamagedError(str(error)) from None
    if len(data) != size or zlib.crc32(data) != checksum:
        raise DamagedError("a chunk whose checksum does not fit")
    return data


def _unpack_cut(packed: bytes, size: int) -> bytes:
    """What can be unpacked of a chunk that the file ends in; the last record in it may be cut."""
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
