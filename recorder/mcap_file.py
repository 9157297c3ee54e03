"""An MCAP file in the making: topics, messages, metadata and attachments; knows nothing of what they say."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

from mcap.writer import Writer

from recorder.chunk_index import keep_on_disk
from recorder.draft import Draft
from recorder.schemas import Definition

_CHUNK_BYTES = 1 << 20
_MESSAGE_BYTES = 47
"""What a message takes besides its data: its head, and its place in the index of the chunk."""
_END_BYTES = 100_000
"""What comes to a file when it is finished, its index aside: channels and schemas again, and the last plotted rows."""


class McapFile:
    """Writes to a draft, chunk by chunk.

    Attributes:
        draft: The file.
        mcap: Writes metadata and attachments to it.
        size_bytes: Its size at the last flush.
        unflushed_bytes: What waits in memory for the next flush, not yet compressed.
    """

    def __init__(self, draft: Draft) -> None:
        """Begin the file.

        Raises:
            OSError: The disk refused.
        """
        self.draft = draft
        self.size_bytes = self.unflushed_bytes = 0
        self._chunks = self._chunk_bytes = 0
        self._schemas: dict[str, int] = {}
        self._topics: dict[str, tuple[int, Iterator[int]]] = {}
        """Number of the channel of each topic, and the numbers of its messages."""
        self.mcap = Writer(draft.file, chunk_size=_CHUNK_BYTES, enable_data_crcs=True)
        keep_on_disk(self.mcap, draft.file)
        self.mcap.start(profile="ros2", library="rotor-stator-rig recorder")

    @property
    def index_bytes(self) -> int:
        """About what the index at the end of the file will take: it names each chunk, and each topic in it [bytes]."""
        return (60 + 10 * len(self._topics)) * self._chunks

    @property
    def final_bytes(self) -> int:
        """What the file comes to at most if it is finished now [bytes]."""
        return self.size_bytes + self.unflushed_bytes + self.index_bytes + _END_BYTES

    def __contains__(self, topic: str) -> bool:
        return topic in self._topics

    def register(self, topic: str, definition: Definition, metadata: dict[str, str]) -> None:
        """Register a topic of messages of some form, with its metadata."""
        if definition.name not in self._schemas:
            number = self.mcap.register_schema(definition.name, definition.language, definition.text)
            self._schemas[definition.name] = number
        number = self._schemas[definition.name]
        self._topics[topic] = self.mcap.register_channel(topic, definition.encoding, number, metadata), count()

    def add(self, topic: str, data: bytes, *, time_ns: int, wall_ns: int) -> None:
        """Write a message of a simulated time [ns], which came at a wall time [unix ns]."""
        channel, numbers = self._topics[topic]
        self.mcap.add_message(channel, time_ns, data, wall_ns, next(numbers) & 0xFFFFFFFF)
        self._chunk_bytes += len(data)
        self.unflushed_bytes += len(data) + _MESSAGE_BYTES
        if self._chunk_bytes >= _CHUNK_BYTES:
            self._chunks += 1
            self._chunk_bytes = 0

    def sync(self) -> None:
        """End the chunk and bring all to the disk.

        Raises:
            OSError: The disk refused.
        """
        self.mcap.flush()
        self._chunks += 1
        self.size_bytes = self.draft.sync()
        self.unflushed_bytes = self._chunk_bytes = 0

    def finish(self) -> None:
        """Write the index, and give the file its name.

        Raises:
            OSError: The disk refused.
        """
        self.mcap.finish()
        self.size_bytes = self.draft.sync()
        self.draft.finish()
