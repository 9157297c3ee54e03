"""A recording in one file, or in several that follow each other, within what the disk may take.

NAME.mcap becomes NAME.0000.mcap, NAME.0001.mcap, ...: four digits, so that they sort. Each is complete in itself:
calibration, parameters, and the scene with the commands sent up to its beginning. A part ends between two blocks of
simulated time, for all streams at once, and the next one knows which row is due, so that a row lost at a seam is
recorded like any other. History, which comes stream by stream, stands in the first part, however long it is.
"""

from __future__ import annotations

import json
import time
from collections import deque
from pathlib import Path

from recorder.contents.counts import NS, Counts
from recorder.contents.metadata import Beginning
from recorder.files.payload import Payload
from recorder.files.unfinished_file import files_like, remove
from recorder.output.disk_limits import MB, Limits, check_files
from recorder.output.sink import Needs, Sink
from recorder.writer import RecordingError, RecordingWriter
from rig.base.errors import InputError
from rig.base.wire import EDGES, EVENTS, FAULTS

MOST_PARTS = 1_000_000
_NUMBER = r"\d{4,}"
_BEHIND_NS = NS
"""Simulated time by which streams may be apart at a seam: more, and one of them is still catching up [ns]."""
_TOLD = 8
"""Documents on faults that each file begins with."""
_CATCH_UP_S = 5.0
"""Longest wait with a full file for a stream that may never come [s]."""


def part_path(path: Path, number: int) -> Path:
    """Name of a part of a recording."""
    return path.with_name(f"{path.stem}.{number:04d}{path.suffix}")


def check_series(path: Path, limits: Limits, *, force: bool = False) -> None:
    """Refuse names that cannot become the files of a recording, as `check_files` does."""
    rotates = limits.rotates
    check_files(path, [part_path(path, 0) if rotates else path], _NUMBER if rotates else "", limits, force=force)


class Series(Sink):
    """Writes a recording to one file or to several in turn."""

    def __init__(self, path: Path, needs: Needs, *, from_start: bool = False) -> None:
        """Open the first file.

        Args:
            path: Name of the recording, ends in .mcap.
            needs: What a sink needs.
            from_start: Every stream is meant to be recorded from its row 0.

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
        self._told: deque[Payload] = deque(maxlen=_TOLD)
        """The latest that was told of faults."""
        self._series = f"{path.stem} {time.time_ns():x}"
        if needs.force and rotates:
            remove(files_like(path, _NUMBER))
        self._file = self._writer = self._open(part_path(path, 0) if rotates else path, from_start=from_start)
        self._expected = set(self._file.head.streams)

    def take(self, payload: Payload) -> None:
        """Write one payload, to the next file where that is due."""
        if self._limits.rotates and self._is_seam(payload):
            self._rotate()
        self.tally.take(payload)
        self._file.take(payload)
        if payload.key == EVENTS:
            self._commands.follow(payload.document)
        if payload.key == FAULTS:
            self._told.append(payload)
        self._make_room(len(payload.data))

    def kept(self) -> list[Counts]:
        """What stands in the files: it is all of one stretch."""
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
        """Whether the file is full and this is the first block of a later time than all that it holds."""
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
        """Whether streams are still catching up with a block that would begin the next file."""
        behind = {key for key in self._expected if self._reached_ns.get(key, -_BEHIND_NS) < block_ns - _BEHIND_NS}
        now_s = self._needs.monotonic_s()
        if not behind:
            self._full_s = None
        elif self._full_s is None:
            self._full_s = now_s
        elif now_s - self._full_s > _CATCH_UP_S:
            self._expected -= behind
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
            raise RecordingError(f"{error}; what was written before is kept, finished, in {old.path}") from None
        for told in self._told:  # they may be about blocks that come behind the seam
            self._file.take(told)

    def _make_room(self, payload_bytes: int) -> None:
        why = self._room.lack_after(payload_bytes, self._file)
        while why:
            if self._limits.when_full == "stop" or not self.files:
                self._end(why)
                return
            try:
                self.files[0].unlink(missing_ok=True)
            except OSError as error:
                self._end(f"{why}, and {self.files[0]} stays ({error.strerror})")
                return
            self.files.pop(0)
            self._room.finished_bytes -= self._sizes.pop(0)
            self._kept.pop(0)
            self.removed += 1
            why = self._room.lack(self._file)
