"""Sink for a recording in one file, or in a series of files, within the disk limits.

NAME.mcap becomes NAME.0000.mcap, NAME.0001.mcap, ...: four digits, so that the names sort. Each file is self-contained,
with calibration, parameters, and the scene including earlier commands. A file ends between two blocks of simulated
time, for all streams at once, and the next one states its first expected rows, so that a row lost in between is
recorded as a gap. History arrives stream by stream and is written to the first file, whatever its length.
"""

from __future__ import annotations

import json
import time
from collections import deque
from pathlib import Path

from recorder.contents.counts import NS, Counts
from recorder.contents.metadata import Beginning
from recorder.files.payload import Payload
from recorder.files.unfinished_file import find_files, remove
from recorder.output.disk_limits import MB, DiskLimits, check_files
from recorder.output.sink import Needs, Sink
from recorder.writer import RecordingError, RecordingWriter
from rig.base.errors import InputError
from rig.base.wire import EDGES, EVENTS, FAULTS

MOST_PARTS = 1_000_000
_NUMBER = r"\d{4,}"
_MAX_DELAY_NS = NS
"""Largest delay between streams at a file change [ns of simulated time]; beyond it, a stream is still catching up."""
_MAX_REPEATED_FAULTS = 8
"""Number of earlier fault documents repeated at the start of each file."""
_CATCH_UP_S = 5.0
"""Longest wait with a full file for a delayed stream, which may never arrive [s]."""


def part_path(path: Path, number: int) -> Path:
    """Return the name of a file in the series."""
    return path.with_name(f"{path.stem}.{number:04d}{path.suffix}")


def check_series(path: Path, limits: DiskLimits, *, force: bool = False) -> None:
    """Refuse names that cannot become the files of a recording; see `check_files`."""
    rotates = limits.rotates
    check_files(path, [part_path(path, 0) if rotates else path], _NUMBER if rotates else "", limits, force=force)


class Series(Sink):
    """Sink that writes a recording to one file or to a series of files."""

    def __init__(self, path: Path, needs: Needs, *, from_start: bool = False) -> None:
        """Open the first file.

        Args:
            path: Name of the recording, ending in .mcap.
            needs: Settings of the sink.
            from_start: Expect row 0 first in every stream.

        Raises:
            InputError: The file cannot be created.
        """
        self._limits, rotates = needs.limits, needs.limits.rotates
        check_series(path, needs.limits, force=needs.force)
        super().__init__(path, needs, from_start=from_start)
        self._sizes: list[int] = []
        self._number = 0
        self._reached_ns: dict[str, int] = {}
        self._full_s: float | None = None
        self._faults: deque[Payload] = deque(maxlen=_MAX_REPEATED_FAULTS)
        """Latest fault documents."""
        self._series = f"{path.stem} {time.time_ns():x}"
        if needs.force and rotates:
            remove(find_files(path, _NUMBER))
        self._file = self._writer = self._open(part_path(path, 0) if rotates else path, from_start=from_start)
        self._expected = set(self._file.head.streams)

    def take(self, payload: Payload) -> None:
        """Write a payload, after a change to the next file if that is due."""
        if self._limits.rotates and self._is_seam(payload):
            self._rotate()
        self.tally.take(payload)
        self._file.take(payload)
        if payload.key == EVENTS:
            self._commands.follow(payload.document)
        if payload.key == FAULTS:
            self._faults.append(payload)
        self._make_room(len(payload.data))

    def kept(self) -> list[Counts]:
        """Return the total of all files as one interval."""
        return [sum(super().kept(), Counts())]

    def _open(
        self, path: Path, *, previous: str = "", from_start: bool = False, due: dict[str, int] | None = None
    ) -> RecordingWriter:
        metadata, due = {}, due or {}
        if self._limits.rotates:
            metadata["series"] = {
                "id": self._series,
                "number": str(self._number),
                "previous": previous,
                "due": json.dumps(due),
            }
        beginning = Beginning(from_start=from_start, due=due, metadata=metadata)
        return self._needs.open_file(path, self._commands.scene, beginning)

    def _is_seam(self, payload: Payload) -> bool:
        """Return whether the file is full and a payload is the first block later than all rows in it."""
        if payload.block is None or payload.key == EDGES:
            return False
        limits, tally = self._limits, self._file.tally
        block_ns, _ = tally.extent_ns(payload)
        self._reached_ns[payload.key] = block_ns
        if tally.first_time_ns is None or block_ns <= tally.last_time_ns:
            return False
        full = limits.rotate_mb is not None and self._file.file.size_bytes >= limits.rotate_mb * MB
        if limits.rotate_s is not None and block_ns - tally.first_time_ns >= limits.rotate_s * NS:
            full = True
        return full and not self._await_others(block_ns)

    def _await_others(self, block_ns: int) -> bool:
        """Return whether other streams are still catching up with a block that would start the next file."""
        slow = {key for key in self._expected if self._reached_ns.get(key, -_MAX_DELAY_NS) < block_ns - _MAX_DELAY_NS}
        now_s = self._needs.monotonic_s()
        if not slow:
            self._full_s = None
        elif self._full_s is None:
            self._full_s = now_s
        elif now_s - self._full_s > _CATCH_UP_S:
            self._expected -= slow
            self._full_s = None
        return self._full_s is not None

    def _rotate(self) -> None:
        if self._number + 1 >= MOST_PARTS:
            self._end(f"{MOST_PARTS} files are written")
            return
        old = self._file
        self._number += 1
        new = part_path(self.path, self._number)
        self._close(old, "rotated", {"next": new.name})
        if self._limits.when_full == "stop":  # no file is removed, so one sum is enough
            self._kept = self.kept()
        self._sizes.append(old.file.size_bytes)
        try:
            self._file = self._writer = self._open(new, previous=old.path.name, due=dict(old.tally.next))
        except (InputError, RecordingError) as error:
            raise RecordingError(f"{error}; the earlier data are complete in {old.path}") from None
        for fault in self._faults:  # may concern blocks of the new file
            self._file.take(fault)

    def _make_room(self, payload_bytes: int) -> None:
        reason = self._room.find_shortage_after(payload_bytes, self._file)
        while reason:
            if self._limits.when_full == "stop" or not self.files:
                self._end(reason)
                return
            try:
                self.files[0].unlink(missing_ok=True)
            except OSError as error:
                self._end(f"{reason}, and {self.files[0]} stays ({error.strerror})")
                return
            self.files.pop(0)
            self._room.finished_bytes -= self._sizes.pop(0)
            self._kept.pop(0)
            self.removed += 1
            reason = self._room.find_shortage(self._file)
