"""The messages of one recording or of its parts, chunk by chunk: what a player reads from."""

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


class Track:
    """What a rig published, from one recording or from the parts of one.

    Only the positions of chunks are kept in memory. What the recorder added of its own is passed over.

    Args:
        paths: Files, finished or cut off; parts are put in their order.

    Raises:
        InputError: A file cannot be read, is no recording, or is of another run than the others.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._recording = join(list(paths))
        self.paths = tuple(part.path for part in self._recording.parts)
        self.chunks: Sequence[Chunk] = self._recording.chunks
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
    def table(self) -> ChannelTable:
        """What the rig measured."""
        return self._recording.table

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
        for message in self._recording.read(chunk):
            if message[0].startswith(f"{wire.ROOT}/"):
                yield Message(*message)

    def _commands(self) -> list[dict[str, Any]]:
        fields = ("id", "tick", "command", "request")
        found = [entry for part in self._recording.parts for entry in part.scene.get("taken", [])]
        found += [event for event in self._recording.events if event.get("event") == "command"]
        return [{name: entry[name] for name in fields} for entry in found if all(name in entry for name in fields)]
