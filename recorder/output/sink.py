"""Sink of a recording session: destination of its payloads, in one or several files within the disk limits."""

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
from recorder.output.disk_limits import DiskLimits, Room
from recorder.writer import RecordingWriter
from rig.channels.table import ChannelTable

OpenFile = Callable[[Path, dict[str, Any], Beginning], RecordingWriter]
"""Factory of a file from its path, the scene document and the beginning of the file."""


@dataclass(frozen=True)
class Needs:
    """Settings of a sink.

    Attributes:
        table: Channel table of the rig.
        tick_rate_hz: Ticks per simulated second [Hz].
        scene: Scene document of the rig.
        open_file: Factory of one file.
        limits: Limits of file size and disk space.
        force: Whether to replace existing files.
        monotonic_s: Clock for the interval between two checks of the disk [s].
    """

    table: ChannelTable
    tick_rate_hz: int
    scene: dict[str, Any]
    open_file: OpenFile
    limits: DiskLimits
    force: bool = False
    monotonic_s: Callable[[], float] = time.monotonic


class Sink(ABC):
    """Destination of received payloads: `Series` keeps all of them, `Captures` those around triggers.

    Attributes:
        path: Name of the recording, ending in .mcap.
        tally: Counts of received data, recorded or not.
        files: Finished files in order.
        sha256: Digest of the last finished file, as it was written.
        removed: Number of finished files removed to free disk space.
        ended: Limit that ended the recording; empty before.
        out_of_room: Whether that limit was disk space.
        remarks: Messages to the user, one line each.
    """

    def __init__(self, path: Path, needs: Needs, *, from_start: bool = False) -> None:
        """Store the settings, and whether row 0 is expected first in every stream; open no file."""
        self.path = path
        self.tally = Tally(needs.tick_rate_hz, from_start=from_start)
        self.files: list[Path] = []
        self.sha256 = ""
        self.removed = 0
        self.ended = ""
        self.out_of_room = False
        self.remarks: tuple[str, ...] = ()
        self._needs = needs
        self._room = Room(path.parent, needs.limits, monotonic_s=needs.monotonic_s)
        self._commands = Commands(needs.scene)
        self._writer: RecordingWriter | None = None
        """File being written, or ended by a disk error."""
        self._kept: list[Counts] = []
        """Totals of the finished files."""

    @property
    def part(self) -> Path | None:
        """Name of the file being written; None if there is none."""
        return None if self._writer is None else self._writer.part

    def counts(self) -> Counts:
        """Return the totals of received data and the size of the files. Safe to call from any thread."""
        return self.tally.counts(size_bytes=sum(each.size_bytes for each in self.kept()))

    def kept(self) -> list[Counts]:
        """Return the totals of the files for each interval recorded without interruption."""
        writer = self._writer
        return [*self._kept] if writer is None else [*self._kept, writer.counts()]

    @abstractmethod
    def take(self, payload: Payload) -> None:
        """Take a payload.

        Raises:
            RecordingError: The disk reports an error.
        """

    def write_missed(self, key: str, messages: int, wall_ns: int) -> None:
        """Record messages that the transport dropped; see `RecordingWriter.write_missed`."""
        self.tally.count_missed(key, messages)
        if self._writer is not None:
            self._writer.write_missed(key, messages, wall_ns)

    def note_short(self, rows: dict[str, int], wall_ns: int) -> None:
        """Record the rows missing at the end of streams as gaps; see `RecordingWriter.note_short`."""
        self.tally.end(rows)
        if self._writer is not None:
            self._writer.note_short(rows, wall_ns)

    def sync_if_due(self) -> None:
        """Flush to the disk if the flush interval has passed."""
        if self._writer is not None:
            self._writer.sync_if_due()

    def finish(self, reason: str, *, notes: dict[str, str] | None = None) -> None:
        """Finish the last file."""
        if self._writer is not None:
            self._close(self._writer, reason, notes)

    def _close(self, writer: RecordingWriter, reason: str, notes: dict[str, str] | None = None) -> None:
        """Finish the file being written."""
        if writer.closed:
            return
        writer.finish(reason, notes=notes)
        self.files.append(writer.path)
        self.sha256 = writer.sha256
        counts = writer.counts()
        self._room.finished_bytes += counts.size_bytes
        self._kept.append(counts)
        self._writer = None

    def _end(self, reason: str) -> None:
        """End the recording because the disk space is used up."""
        self.ended, self.out_of_room = reason, True
