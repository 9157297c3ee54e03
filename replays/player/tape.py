"""The messages of one recording or of its parts, chunk by chunk: what a player reads from."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

from recorder.reader import join
from rig import wire
from rig.errors import InputError

_MAGIC_BYTES = 8
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQ")
_COUNTED = 500
"""Messages of a file that was cut off that are taken together."""


@dataclass(frozen=True, slots=True)
class Message:
    """One payload as it was recorded.

    Attributes:
        key: Key that it came on.
        time_ns: Simulated time [ns]: of a block's first row, or of a document.
        arrival_ns: Wall time of its arrival [unix ns].
        payload: Its bytes.
    """

    key: str
    time_ns: int
    arrival_ns: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Chunk:
    """Some messages in a row, read and unpacked together.

    Attributes:
        part: Number of the file.
        offset: Where the body of its record begins [bytes]; in a file that was cut off, number of its first message.
        length: Length of that body [bytes]; in a file that was cut off, number of its messages.
        begin_ns: Least simulated time of its messages [ns].
        end_ns: Greatest simulated time of its messages [ns].
    """

    part: int
    offset: int
    length: int
    begin_ns: int
    end_ns: int


class Tape:
    """What a rig published, from one recording or from the parts of one.

    Only the positions of chunks are kept in memory. What the recorder added of its own is passed over.

    Args:
        paths: Files, finished or cut off; parts are put in their order.

    Raises:
        InputError: A file cannot be read, is no recording, or is of another run than the others.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._recording = join(list(paths))
        parts = self._recording.parts
        self.paths = tuple(part.path for part in parts)
        self._topics: dict[tuple[int, int], str] = {}
        self._under_way: dict[int, tuple[int, Iterator[Message]]] = {}
        self.chunks: list[Chunk] = []
        for part, recording in enumerate(parts):
            self.chunks += self._scan(part) if recording.complete else self._count_out(part)
        if not self.chunks:
            raise InputError("file", "a recording with messages", str(self.paths[0]))
        self.begin_ns = min(chunk.begin_ns for chunk in self.chunks)
        """Least simulated time of all messages [ns]."""
        self.end_ns = max(chunk.end_ns for chunk in self.chunks)
        """Greatest simulated time of all messages [ns]; the last blocks begin there, and end a little later."""
        self.commands = self._commands()
        """The commands that the rig took, in order, as its scene document lists them (`taken`)."""

    @property
    def complete(self) -> bool:
        """Whether all files were finished."""
        return self._recording.complete

    @property
    def documents(self) -> dict[str, dict[str, Any]]:
        """What the rig answered: catalogue, parameters and scene, by key."""
        one = self._recording
        return {wire.CATALOGUE: one.catalogue, wire.PARAMETERS: one.parameters, wire.SCENE: one.scene}

    def read(self, chunk: Chunk) -> Iterator[Message]:
        """The rig's messages of one chunk, in the order of the file.

        Raises:
            InputError: The file has changed or cannot be read any more.
        """
        if not self._recording.parts[chunk.part].complete:
            yield from self._read_on(chunk)
            return
        from mcap.opcode import Opcode

        topics, message, data = self._topics, int(Opcode.MESSAGE), self._unpack(chunk)
        for opcode, start, end in _records(data):
            if opcode == message:
                number, _, time_ns, arrival_ns = _MESSAGE.unpack_from(data, start)
                key = topics.get((chunk.part, number))
                if key is not None:
                    yield Message(key, time_ns, arrival_ns, data[start + _MESSAGE.size : end])

    def _commands(self) -> list[dict[str, Any]]:
        fields = ("id", "tick", "command", "request")
        found = [entry for part in self._recording.parts for entry in part.scene.get("taken", [])]
        found += [event for event in self._recording.events if event.get("event") == "command"]
        return [{name: entry[name] for name in fields} for entry in found if all(name in entry for name in fields)]

    # Finished files: by their records, so that any position is found without reading what is before it.

    def _scan(self, part: int) -> list[Chunk]:
        """Walk over a file's records."""
        from mcap.opcode import Opcode

        found: list[Chunk] = []
        indexed: set[int] = set()
        path = self.paths[part]
        size = path.stat().st_size
        with path.open("rb") as file:
            position = _MAGIC_BYTES
            while position + _RECORD.size <= size:
                file.seek(position)
                opcode, length = _RECORD.unpack(file.read(_RECORD.size))
                if opcode == Opcode.FOOTER:
                    break
                if opcode == Opcode.CHUNK:
                    begin_ns, end_ns = _CHUNK.unpack(file.read(_CHUNK.size))
                    found.append(Chunk(part, position + _RECORD.size, length, begin_ns, end_ns))
                elif opcode == Opcode.CHANNEL:
                    self._note_channel(part, file.read(length))
                elif opcode == Opcode.MESSAGE_INDEX and found:
                    indexed.add(found[-1].offset)
                position += _RECORD.size + length
        # One without an index has no messages, and no times.
        return [chunk for chunk in found if chunk.offset in indexed]

    def _note_channel(self, part: int, body: bytes) -> None:
        from mcap.data_stream import ReadDataStream
        from mcap.records import Channel

        channel = Channel.read(ReadDataStream(BytesIO(body)))
        if _is_rigs(channel.topic):
            self._topics[part, channel.id] = channel.topic

    def _unpack(self, chunk: Chunk) -> bytes:
        """Records of a chunk, checked against their sum."""
        import zstandard
        from mcap.data_stream import ReadDataStream
        from mcap.exceptions import McapError
        from mcap.records import Chunk as ChunkRecord
        from mcap.stream_reader import get_chunk_data_stream

        path = self.paths[chunk.part]
        try:
            with path.open("rb") as file:
                file.seek(chunk.offset)
                record = ChunkRecord.read(ReadDataStream(BytesIO(file.read(chunk.length))))
            stream, length = get_chunk_data_stream(record, validate_crc=True)
            return stream.read(length)
        except OSError as error:
            raise InputError("file", "a file that can be read", f"{path} ({error.strerror})") from None
        except (McapError, struct.error, zstandard.ZstdError, ValueError) as error:
            raise InputError("file", "an intact recording", f"{path} ({error})") from None

    # Files that were cut off: what the reader can save of them, counted out into chunks of our own.

    def _messages(self, part: int) -> Iterator[Message]:
        for key, time_ns, arrival_ns, payload in self._recording.parts[part].everything():
            if _is_rigs(key):
                yield Message(key, time_ns, arrival_ns, payload)

    def _count_out(self, part: int) -> list[Chunk]:
        found: list[Chunk] = []
        times_ns: list[int] = []
        for message in self._messages(part):
            times_ns.append(message.time_ns)
            if len(times_ns) == _COUNTED:
                found.append(Chunk(part, _COUNTED * len(found), _COUNTED, min(times_ns), max(times_ns)))
                times_ns = []
        if times_ns:
            found.append(Chunk(part, _COUNTED * len(found), len(times_ns), min(times_ns), max(times_ns)))
        return found

    def _read_on(self, chunk: Chunk) -> list[Message]:
        """The messages of a chunk: the next ones, or where it is an earlier one, from the file's beginning on."""
        number, messages = self._under_way.pop(chunk.part, (0, self._messages(chunk.part)))
        if number > chunk.offset:
            number, messages = 0, self._messages(chunk.part)
        found = list(islice(messages, chunk.offset - number, chunk.offset - number + chunk.length))
        self._under_way[chunk.part] = (chunk.offset + chunk.length, messages)
        return found


def _is_rigs(topic: str) -> bool:
    return topic.startswith(f"{wire.ROOT}/")


def _records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the body of each record of a chunk."""
    position = 0
    while position < len(data):
        opcode, length = _RECORD.unpack_from(data, position)
        start = position + _RECORD.size
        position = start + length
        yield opcode, start, position
