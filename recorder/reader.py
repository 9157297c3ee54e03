"""Reads a recording: finished ones, and what a kill or a full disk left of one."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Self

import numpy as np

from recorder import schemas
from rig.channels import ChannelTable
from rig.errors import InputError
from rig.wire import (
    EDGES,
    EVENTS,
    STATUS,
    Block,
    Continuity,
    Gap,
    decode_block,
    decode_document,
    schema_of,
    sensor_key,
    truth_key,
)

if TYPE_CHECKING:
    from mcap.records import Channel

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_DOCUMENTS = ("catalogue", "parameters", "scene")
_OURS = "a recording made by `rig record`"


@dataclass(frozen=True)
class Samples:
    """One sensor group or truth table as columns.

    Attributes:
        name: Name of the group or table.
        times_s: Simulated time of each row [s], shape (n,).
        index: Number of each row since the start of the stream, int64, shape (n,); a step other than 1 is a gap.
        values: Engineering values, shape (n, columns).
        names: Column names.
        units: Column units.
        rate_hz: Rows per simulated second [Hz].
    """

    name: str
    times_s: np.ndarray
    index: np.ndarray
    values: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]
    rate_hz: float

    def column(self, name: str) -> np.ndarray:
        """Values of one column, shape (n,).

        Raises:
            InputError: There is no such column.
        """
        if name not in self.names:
            raise InputError("column", f"one of {', '.join(self.names)}", name)
        return self.values[:, self.names.index(name)]


@dataclass(frozen=True)
class Stream:
    """What a recording holds of one block stream.

    Attributes:
        messages: Number of blocks.
        rows: Number of rows in them.
        lost: Number of rows missing between them, counted anew from the row numbers.
        first_time_s: Simulated time of the first row [s].
        last_time_s: Simulated time of the last row [s].
    """

    messages: int
    rows: int
    lost: int
    first_time_s: float
    last_time_s: float


@dataclass(frozen=True)
class _Chunk:
    offset: int
    length: int
    channels: frozenset[int] | None
    """Channels with messages in it, where the file says so."""


class Recording:
    """One recording, read topic by topic from the disk; nothing but documents is kept in memory.

    Attributes:
        path: The file.
        complete: The file was finished; False for a .part file or one that was cut off, of which everything up to the
            last whole chunk is read.
        catalogue: The rig's catalogue document.
        table: The channel table in it.
        parameters: The rig's parameter document.
        scene: The rig's scene document.
        metadata: Metadata records by name: `rig` (start), `end` (closing counts, only if complete).
        messages: Number of messages by topic.
    """

    def __init__(self, path: Path) -> None:
        """Scan the records of a file; `Recording.open` reads the same."""
        self.path = path
        self.complete = False
        self.metadata: dict[str, dict[str, str]] = {}
        self.messages: dict[str, int] = {}
        self._attachments: dict[str, bytes] = {}
        self._chunks: list[_Chunk] = []
        self._channels: dict[int, Channel] = {}
        try:
            with path.open("rb") as file, self._intact():
                self._scan(file)
        except OSError as error:
            raise InputError("file", "a file that can be read", f"{path} ({error.strerror})") from None
        about = self.metadata.get("rig", {})
        if about.get("format") != schemas.FORMAT:
            raise InputError("file", _OURS, str(path))
        if about.get("version") != schemas.VERSION:
            raise InputError("file", f"a recording of format version {schemas.VERSION}", about.get("version"))
        try:
            documents = {
                name: decode_document(self._attachments[f"{name}.json"])
                for name in ("catalogue", "parameters", "scene")
            }
            self.table = ChannelTable.model_validate(documents["catalogue"]["table"])
        except (KeyError, ValueError):
            raise InputError(
                "file", "a recording with its calibration; this one was cut off in it", str(path)
            ) from None
        self.catalogue: dict[str, Any] = documents["catalogue"]
        self.parameters: dict[str, Any] = documents["parameters"]
        self.scene: dict[str, Any] = documents["scene"]

    @classmethod
    def open(cls, path: Path | str) -> Self:
        """Open a recording, finished or cut off.

        Raises:
            InputError: The file cannot be read, or is no recording.
        """
        return cls(Path(path))

    @property
    def end_reason(self) -> str:
        """Why the recording ended."""
        if self.complete:
            return self.metadata.get("end", {}).get("reason", "unknown")
        return "cut off: the recorder did not finish the file"

    @cached_property
    def events(self) -> list[dict[str, Any]]:
        """The rig's events, in order of arrival."""
        return self._documents(EVENTS)

    @cached_property
    def statuses(self) -> list[dict[str, Any]]:
        """The rig's status documents, in order of arrival."""
        return self._documents(STATUS)

    @cached_property
    def gaps(self) -> list[Gap]:
        """Losses that the recorder noted; index -1 where it is messages that are counted, not rows."""
        found = self._documents(schemas.GAPS)
        return [Gap(key=gap["key"], index=gap["index"], size=gap["size"]) for gap in found]

    @cached_property
    def clock(self) -> np.ndarray:
        """Pairs of simulated time and wall time of arrival [s, unix s], shape (n, 2)."""
        pairs = [(pair["time_s"], pair["wall_s"]) for pair in self._documents(schemas.CLOCK)]
        return np.array(pairs, dtype=float).reshape(-1, 2)

    @cached_property
    def streams(self) -> dict[str, Stream]:
        """Extent of every block stream by key, counted from the blocks."""
        continuity = Continuity()
        extents: dict[str, list[float]] = {}
        counts: dict[str, int] = {}
        keys = {key for key in self.messages if schema_of(key) is not None}
        for key, _, payload in self._messages(keys):
            block = self._block(key, payload)
            if block is None:
                continue
            counts[key] = counts.get(key, 0) + 1
            continuity.follow(key, block.index, len(block.values))
            if len(block.values):
                times_s = self._row_times_s(key, block)
                extents.setdefault(key, [times_s[0], times_s[-1]])[1] = times_s[-1]
        return {
            key: Stream(
                messages=counts[key],
                rows=continuity.received[key],
                lost=continuity.lost[key],
                first_time_s=float(extents.get(key, [0.0, 0.0])[0]),
                last_time_s=float(extents.get(key, [0.0, 0.0])[1]),
            )
            for key in sorted(counts)
        }

    def samples(self, group: str) -> Samples:
        """A sensor group in engineering units, in order of arrival.

        Args:
            group: Name of a group of the channel table.

        Raises:
            InputError: The recording has no such group, or the file is damaged.
        """
        if group not in self.table.groups:
            raise InputError("group", f"one of {', '.join(self.table.groups)}", group)
        channels = self.table.groups[group].channels
        scales = np.array([channel.scale for channel in channels])
        offsets = np.array([channel.offset for channel in channels])
        return self._columns(
            name=group,
            key=sensor_key(group),
            names=tuple(channel.name for channel in channels),
            units=tuple(channel.unit for channel in channels),
            rate_hz=float(self.table.groups[group].rate_hz),
            scales=scales,
            offsets=offsets,
        )

    def truth(self, table: str) -> Samples:
        """A truth table, in order of arrival.

        Args:
            table: Name of a truth table of the catalogue.

        Raises:
            InputError: The recording has no such table, or the file is damaged.
        """
        tables = self.catalogue.get("truth", {})
        if table not in tables:
            raise InputError("truth", f"one of {', '.join(tables)}", table)
        columns = tables[table]["columns"]
        return self._columns(
            name=table,
            key=truth_key(table),
            names=tuple(column["name"] for column in columns),
            units=tuple(column["unit"] for column in columns),
            rate_hz=float(tables[table].get("rate_hz", 0.0)),
        )

    def edges(self) -> np.ndarray:
        """Times of the keyphasor edges, simulated [s], shape (n,)."""
        times = [self._row_times_s(EDGES, block) for block in self.blocks(EDGES)]
        return np.concatenate(times) if times else np.empty(0)

    def blocks(self, key: str) -> Iterator[Block]:
        """The blocks of one stream, in order of arrival; payloads that are no blocks are passed over."""
        for _, payload in self.payloads(key):
            block = self._block(key, payload)
            if block is not None:
                yield block

    def payloads(self, key: str) -> Iterator[tuple[int, bytes]]:
        """The payloads of one key, byte for byte as they came: pairs of simulated time [ns] and bytes."""
        for _, log_time, payload in self._messages({key}):
            yield log_time, payload

    def _columns(
        self,
        *,
        name: str,
        key: str,
        names: tuple[str, ...],
        units: tuple[str, ...],
        rate_hz: float,
        scales: np.ndarray | None = None,
        offsets: np.ndarray | None = None,
    ) -> Samples:
        blocks = [block for block in self.blocks(key) if block.values.shape[1] == len(names)]
        sizes = [len(block.values) for block in blocks]
        values = np.empty((sum(sizes), len(names)))
        times_s = np.empty(len(values))
        index = np.empty(len(values), dtype=np.int64)
        start = 0
        for block, size in zip(blocks, sizes, strict=True):
            rows = slice(start, start + size)
            values[rows] = block.values
            times_s[rows] = block.times_s
            index[rows] = np.arange(block.index, block.index + size)
            start += size
        if scales is not None and offsets is not None:
            values *= scales
            values += offsets
        return Samples(
            name=name,
            times_s=times_s,
            index=index,
            values=values,
            names=names,
            units=units,
            rate_hz=blocks[0].rate_hz if blocks else rate_hz,
        )

    def _row_times_s(self, key: str, block: Block) -> np.ndarray:
        if key == EDGES:
            return (block.tick + block.values[:, 0]) / block.tick_rate_hz
        return block.times_s

    def _block(self, key: str, payload: bytes) -> Block | None:
        schema = schema_of(key)
        if schema is None:
            raise InputError("key", "a key of blocks (sensors or truth)", key)
        try:
            return decode_block(payload, schema)
        except ValueError:
            return None

    def _documents(self, topic: str) -> list[dict[str, Any]]:
        found = []
        for _, payload in self.payloads(topic):
            try:
                found.append(decode_document(payload))
            except ValueError:
                continue
        return found

    @contextmanager
    def _intact(self) -> Iterator[None]:
        """Whatever a damaged file makes the parsers raise becomes one clear error."""
        import zstandard
        from mcap.exceptions import McapError

        try:
            yield
        except InputError:
            raise
        except (McapError, struct.error, zstandard.ZstdError, ValueError, MemoryError, OverflowError) as error:
            raise InputError("file", "an intact recording", f"{self.path} ({error})") from None

    def _scan(self, file: BinaryIO) -> None:
        """Walk over the top-level records: where the chunks are, and everything that is not in a chunk.

        A record counts only if all of it lies in the file: a cut at any byte costs at most the chunk it went through.
        """
        from mcap.data_stream import ReadDataStream
        from mcap.opcode import Opcode
        from mcap.records import Attachment, Channel, MessageIndex, Metadata, Statistics

        size = self.path.stat().st_size
        if file.read(len(_MAGIC)) != _MAGIC:
            raise InputError("file", _OURS, f"{self.path}, which is no MCAP file")
        indexed: dict[int, set[int]] = {}
        counts: dict[int, int] = {}
        footer = False
        position = len(_MAGIC)
        last_chunk = -1
        while not footer and position + _RECORD.size <= size:
            file.seek(position)
            opcode, length = _RECORD.unpack(file.read(_RECORD.size))
            end = position + _RECORD.size + length
            if end > size or opcode == 0:  # cut off, or zeros where a power cut left unwritten pages
                break
            if opcode == Opcode.CHUNK:
                last_chunk = position
                self._chunks.append(_Chunk(offset=position, length=length, channels=None))
            elif opcode in (
                Opcode.METADATA,
                Opcode.ATTACHMENT,
                Opcode.CHANNEL,
                Opcode.STATISTICS,
                Opcode.MESSAGE_INDEX,
            ):
                stream = ReadDataStream(BytesIO(file.read(length)))
                if opcode == Opcode.METADATA:
                    metadata = Metadata.read(stream)
                    self.metadata[metadata.name] = metadata.metadata
                elif opcode == Opcode.ATTACHMENT:
                    attachment = Attachment.read(stream)
                    self._attachments[attachment.name] = attachment.data
                elif opcode == Opcode.CHANNEL:
                    channel = Channel.read(stream)
                    self._channels[channel.id] = channel
                elif opcode == Opcode.STATISTICS:
                    counts = dict(Statistics.read(stream).channel_message_counts)
                else:
                    indexed.setdefault(last_chunk, set()).add(MessageIndex.read(stream).channel_id)
            elif opcode == Opcode.FOOTER:
                footer = True
            position = end
        if footer:
            file.seek(position)
            self.complete = file.read(len(_MAGIC)) == _MAGIC
        if self.complete:
            self._chunks = [
                _Chunk(offset=chunk.offset, length=chunk.length, channels=frozenset(indexed.get(chunk.offset, ())))
                for chunk in self._chunks
            ]
        else:
            counts = self._scan_chunks(file)
        self.messages = {self._channels[number].topic: count for number, count in sorted(counts.items())}

    def _scan_chunks(self, file: BinaryIO) -> dict[int, int]:
        """Find channels and counts of a cut file in its chunks; a chunk that does not unpack ends it."""
        import zstandard
        from mcap.data_stream import ReadDataStream
        from mcap.exceptions import McapError
        from mcap.opcode import Opcode
        from mcap.records import Channel

        counts: dict[int, int] = {}
        good = []
        for chunk in self._chunks:
            try:
                data = _unpack(file, chunk)
            except (McapError, struct.error, zstandard.ZstdError, ValueError):
                break
            good.append(chunk)
            for opcode, start, end in _records(data):
                if opcode == Opcode.MESSAGE:
                    number = _MESSAGE.unpack_from(data, start)[0]
                    counts[number] = counts.get(number, 0) + 1
                elif opcode == Opcode.CHANNEL:
                    channel = Channel.read(ReadDataStream(BytesIO(data[start:end])))
                    self._channels[channel.id] = channel
        self._chunks = good
        return counts

    def _messages(self, topics: set[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time and payload of every message on some topics, in file order."""
        from mcap.opcode import Opcode

        wanted = {number: channel.topic for number, channel in self._channels.items() if channel.topic in topics}
        if not wanted:
            return
        with self.path.open("rb") as file, self._intact():
            for chunk in self._chunks:
                if chunk.channels is not None and chunk.channels.isdisjoint(wanted):
                    continue
                data = _unpack(file, chunk)
                for opcode, start, end in _records(data):
                    if opcode == Opcode.MESSAGE:
                        number, _, log_time, _ = _MESSAGE.unpack_from(data, start)
                        if number in wanted:
                            yield wanted[number], log_time, data[start + _MESSAGE.size : end]


def _records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the body of each record of a chunk."""
    position = 0
    while position < len(data):
        opcode, length = _RECORD.unpack_from(data, position)
        start = position + _RECORD.size
        position = start + length
        yield opcode, start, position


def _unpack(file: BinaryIO, chunk: _Chunk) -> bytes:
    """Records of a chunk, unpacked and checked against their sum."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk
    from mcap.stream_reader import get_chunk_data_stream

    file.seek(chunk.offset + _RECORD.size)
    record = Chunk.read(ReadDataStream(BytesIO(file.read(chunk.length))))
    stream, length = get_chunk_data_stream(record, validate_crc=True)
    return stream.read(length)
