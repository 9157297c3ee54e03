"""Where a session's payloads go: one or several files, and the room that these may take."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recorder.contents.counts import Counts, Tally
from recorder.contents.metadata import Beginning, Commands
from recorder.files.payload import Payload
from recorder.output.disk_limits import Limits, Room
from recorder.writer import RecordingWriter
from rig.channels.table import ChannelTable

OpenFile = Callable[[Path, dict[str, Any], Beginning], RecordingWriter]
"""Opens one file, given its path, the rig's scene document and how the file begins."""


@dataclass(frozen=True)
class Needs:
    """What both kinds of sink need.

    Attributes:
        table: The rig's channel table.
        tick_rate_hz: Ticks per simulated second.
        scene: The rig's scene document.
        open_file: Opens one file.
        limits: Limits of the files.
        force: Replace what is there of that name.
        monotonic_s: Clock that times the looks at the disk [s].
    """

    table: ChannelTable
    tick_rate_hz: int
    scene: dict[str, Any]
    open_file: OpenFile
    limits: Limits
    force: bool = False
    monotonic_s: Callable[[], float] = time.monotonic


class Sink(ABC):
    """Takes all that is received: a `Series` keeps all of it, `Captures` what is around triggers.

    Attributes:
        path: Name of the recording, ends in .mcap.
        tally: What was received, whether kept or not.
        files: The finished files that are there, in order.
        removed: Number of finished files that were removed for want of room.
        ended: Why nothing more is recorded, where a limit ended it; empty before.
        out_of_room: It is for want of room.
        remarks: What the user should know at once, a line each.
    """

    def __init__(self, path: Path, needs: Needs, *, from_start: bool = False) -> None:
        """Take what both kinds need, and whether row 0 is due of each stream; opens nothing."""
        self.path = path
        self.tally = Tally(needs.tick_rate_hz, from_start=from_start)
        self.files: list[Path] = []
        self.removed = 0
        self.ended = ""
        self.out_of_room = False
        self.remarks: tuple[str, ...] = ()
        self._needs = needs
        self._room = Room(path.parent, needs.limits, monotonic_s=needs.monotonic_s)
        self._commands = Commands(needs.scene)
        self._writer: RecordingWriter | None = None
        """The file that is being written, or that the disk ended."""
        self._kept: list[Counts] = []
        """What stands in the finished files."""

    @property
    def part(self) -> Path | None:
        """Name of the file that is being written, if there is one."""
        return None if self._writer is None else self._writer.part

    def counts(self) -> Counts:
        """What was received so far, and the size of the files; from any thread."""
        return self.tally.counts(size_bytes=sum(each.size_bytes for each in self.kept()))

    def kept(self) -> list[Counts]:
        """What stands in the files, for each stretch of time that is recorded without a pause."""
        writer = self._writer
        return [*self._kept] if writer is None else [*self._kept, writer.counts()]

    @abstractmethod
    def take(self, payload: Payload) -> None:
        """Take one payload.

        Raises:
            RecordingError: The disk refused.
        """

    def write_missed(self, key: str, messages: int, wall_ns: int) -> None:
        """Record that the transport lost messages for good; see `RecordingWriter.write_missed`."""
        self.tally.miss(key, messages)
        if self._writer is not None:
            self._writer.write_missed(key, messages, wall_ns)

    def note_short(self, rows: dict[str, int], wall_ns: int) -> None:
        """Record as gaps what is missing at the end of streams; see `RecordingWriter.note_short`."""
        self.tally.end(rows)
        if self._writer is not None:
            self._writer.note_short(rows, wall_ns)

    def sync_if_due(self) -> None:
        """Flush to the disk if the last flush was long enough ago."""
        if self._writer is not None:
            self._writer.sync_if_due()

    def finish(self, reason: str, *, notes: dict[str, str] | None = None) -> None:
        """Finish the last file."""
        if self._writer is not None:
            self._close(self._writer, reason, notes)

    def _close(self, writer: RecordingWriter, reason: str, notes: dict[str, str] | None = None) -> None:
        """Finish the file that is being written."""
        if writer.closed:
            return
        writer.finish(reason, notes=notes)
        self.files.append(writer.path)
        counts = writer.counts()
        self._room.finished_bytes += counts.size_bytes
        self._kept.append(counts)
        self._writer = None

    def _end(self, why: str) -> None:
        """There is no more room."""
        self.ended, self.out_of_room = why, True
