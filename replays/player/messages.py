"""Messages of a recording, or of its parts, read chunk by chunk for a player."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from recorder.files.chunks import Chunk
from recorder.reader import join
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import ChannelTable


class Message(NamedTuple):
    """One recorded payload.

    Attributes:
        key: Key of the payload.
        time_ns: Simulated time [ns] of a block's first sample, or of a document.
        arrival_ns: Wall time of its arrival [unix ns].
        payload: Recorded bytes.
    """

    key: str
    time_ns: int
    arrival_ns: int
    payload: bytes


class Track:
    """The rig's messages in one recording, or in the parts of one.

    Only the positions of chunks are kept in memory. Messages added by the recorder are skipped.

    Args:
        paths: Complete or truncated files; parts are sorted.

    Raises:
        InputError: If a file cannot be read, is not a recording, or belongs to another run.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._recording = join(list(paths))
        self.paths = tuple(part.path for part in self._recording.parts)
        self.chunks: Sequence[Chunk] = self._recording.chunks
        if not self.chunks:
            raise InputError("file", "a recording with messages", str(self.paths[0]))
        self.begin_ns = min(chunk.begin_ns for chunk in self.chunks)
        """Smallest simulated time of all messages [ns]."""
        self.end_ns = max(chunk.end_ns for chunk in self.chunks)
        """Largest simulated time of all messages [ns]; the last blocks begin there and end slightly later."""
        self.commands = self._commands()
        """Commands accepted by the rig, in order, as listed in its scene document (`taken`)."""

    @property
    def complete(self) -> bool:
        """True if all files are complete."""
        return self._recording.complete

    @property
    def table(self) -> ChannelTable:
        """Channels of the rig."""
        return self._recording.table

    @property
    def documents(self) -> dict[str, dict[str, Any]]:
        """Documents of the rig by key: catalogue, parameters and scene."""
        one = self._recording
        return {wire.CATALOGUE: one.catalogue, wire.PARAMETERS: one.parameters, wire.SCENE: one.scene}

    def read(self, chunk: Chunk) -> Iterator[Message]:
        """Yield the rig's messages of one chunk, in the order of the file.

        Raises:
            InputError: If the file has changed or can no longer be read.
        """
        for message in self._recording.read(chunk):
            if message[0].startswith(f"{wire.ROOT}/"):
                yield Message(*message)

    def _commands(self) -> list[dict[str, Any]]:
        fields = ("id", "tick", "command", "request")
        entries = [entry for part in self._recording.parts for entry in part.scene.get("taken", [])]
        entries += [event for event in self._recording.events if event.get("event") == "command"]
        return [{name: entry[name] for name in fields} for entry in entries if all(name in entry for name in fields)]
