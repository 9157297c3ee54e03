"""A recording in one file, or in several that follow each other, within what the disk may take.

NAME.mcap becomes NAME.0000.mcap, NAME.0001.mcap, ...: four digits, so that they sort. Each is complete in itself:
calibration, parameters, and the scene with the commands sent up to its beginning. A part ends between two blocks of
simulated time, for all streams at once, and the next one knows which row is due, so that a row lost at a seam is
recorded like any other. History, which comes stream by stream, stands in the first part, however long it is.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from recorder.payload import block_in
from recorder.writer import NS, Counts, RecordingError, RecordingWriter, check_destination, remove
from rig.errors import PART_SUFFIX, InputError
from rig.wire import EDGES, EVENTS, schema_of

MB = 1_000_000
MOST_PARTS = 1_000_000
_PENDING_BYTES = 2 * MB
"""What may still come to a file at its end, but for its index: a chunk that is not yet on the disk."""
_NEW_BYTES = 300_000
"""What a file takes that was only just begun, with its end."""
_FLUSH_BYTES = MB // 4
"""At the budget, more than that in memory is flushed, for it is less once it is compressed; less is let go."""
_MOST_COMMANDS = 10_000
"""Latest commands that a file names as sent before it."""
_CHECK_S = 0.25
_BEHIND_NS = NS
"""Simulated time by which streams may be apart at a seam: more, and one of them is still catching up [ns]."""
_CATCH_UP_S = 5.0
"""Longest wait with a full file for a stream that may never come [s]."""


@dataclass(frozen=True)
class Limits:
    """How large files become, and what they may take of the disk; None or 0 where there is no limit.

    Attributes:
        rotate_mb: About this size of a part [MB].
        rotate_s: Length of a part [s of simulated time].
        budget_mb: All parts together [MB].
        keep_free_mb: Room that is left to others on the disk [MB].
        when_full: What happens at the budget, or when there is no more room: the recording stops, or its oldest part
            is removed.
    """

    rotate_mb: float | None = None
    rotate_s: float | None = None
    budget_mb: float | None = None
    keep_free_mb: float = 0.0
    when_full: Literal["stop", "remove-oldest"] = "stop"

    def __post_init__(self) -> None:
        for name, least in (("rotate_mb", 1.0), ("rotate_s", 0.1), ("budget_mb", 5.0)):
            value = getattr(self, name)
            if value is not None and not least <= value <= 1e9:
                raise InputError(name, f"from {least:g} to 1e9", value)
        if not 0.0 <= self.keep_free_mb <= 1e9:
            raise InputError("keep_free_mb", "from 0 to 1e9", self.keep_free_mb)
        if self.when_full not in ("stop", "remove-oldest"):
            raise InputError("when_full", "stop or remove-oldest", self.when_full)
        if self.when_full == "remove-oldest" and not self.rotates:
            raise InputError("when_full", "stop for a recording in one file (--rotate-mb, --rotate-s)", self.when_full)
        least = 2.0 * (self.rotate_mb or 0.0)
        if self.when_full == "remove-oldest" and self.budget_mb is not None and self.budget_mb < least:
            raise InputError("budget_mb", f"at least two files, {least:g}, where the oldest makes room", self.budget_mb)

    @property
    def rotates(self) -> bool:
        """Whether there are several files."""
        return self.rotate_mb is not None or self.rotate_s is not None


def part_path(path: Path, number: int) -> Path:
    """Name of a part of a recording."""
    return path.with_name(f"{path.stem}.{number:04d}{path.suffix}")


def check_series(path: Path, limits: Limits, *, force: bool = False) -> None:
    """Refuse names that cannot become the files of a recording; remove nothing.

    Raises:
        InputError: As `check_destination`, for any part; or the disk has too little room to begin with.
    """
    check_destination(part_path(path, 0) if limits.rotates else path, force=force)
    if limits.rotates and not force and (taken := _parts_of(path)):
        raise InputError("output", "new files (--force replaces them)", f"{taken[0]}, which exists")
    check_room(path, limits)


def check_room(path: Path, limits: Limits) -> None:
    """Refuse to begin on a disk that has too little room.

    Raises:
        InputError: It has.
    """
    if why := lack_of_room(path.parent, limits.keep_free_mb):
        raise InputError("output", f"on a disk with room: {why} (--keep-free-mb)", str(path))


def _parts_of(path: Path) -> list[Path]:
    """Files that look like parts of a recording of that name."""
    name = re.compile(rf"{re.escape(path.stem)}\.\d{{4,}}{re.escape(path.suffix)}({re.escape(PART_SUFFIX)})?")
    return sorted(each for each in path.parent.iterdir() if name.fullmatch(each.name))


def lack_of_room(folder: Path, keep_free_mb: float, *, index_bytes: int = 0) -> str:
    """What is wrong if a disk has less room than is to be left on it [MB]; empty if nothing is.

    With nothing to be left there must still be room to end the file well.
    """
    try:
        disk = os.statvfs(folder)
    except OSError:
        return ""  # the next write says what is wrong
    if disk.f_bavail * disk.f_frsize >= keep_free_mb * MB + _PENDING_BYTES + index_bytes:
        return ""
    return f"less than {keep_free_mb:g} MB are free on the disk" if keep_free_mb else "the disk is full"


class Room:
    """What the files of a recording may still take of the disk."""

    def __init__(self, folder: Path, limits: Limits, *, monotonic_s: Callable[[], float] = time.monotonic) -> None:
        """Take the folder and its limits.

        Args:
            folder: Where the files are.
            limits: What they may take.
            monotonic_s: Clock that times the looks at the disk [s].
        """
        self._folder = folder
        self._limits = limits
        self._monotonic_s = monotonic_s
        self._checked_s = -1e9
        self._unchecked_bytes = 0

    def needs_look(self, payload_bytes: int, finished_bytes: int, writer: RecordingWriter) -> bool:
        """Whether it is time for `lack`, after a payload of that size; costs next to nothing."""
        self._unchecked_bytes += payload_bytes
        if self._over_budget(finished_bytes, writer):
            return True
        return self._unchecked_bytes >= MB // 2 or self._monotonic_s() - self._checked_s >= _CHECK_S

    def lack(self, finished_bytes: int, writer: RecordingWriter | None = None) -> str:
        """What there is no more room for; empty if there is room for all.

        Args:
            finished_bytes: Size of the finished files that are there [bytes].
            writer: The file that is being written; None for one that is to be begun.
        """
        self._checked_s = self._monotonic_s()
        self._unchecked_bytes = 0
        if self._over_budget(finished_bytes, writer):
            if writer is not None and writer.unflushed_bytes > _FLUSH_BYTES:
                writer.sync()
            if self._over_budget(finished_bytes, writer):
                return f"the budget of {self._limits.budget_mb:g} MB is used up"
        index_bytes = 0 if writer is None else writer.index_bytes
        return lack_of_room(self._folder, self._limits.keep_free_mb, index_bytes=index_bytes)

    def _over_budget(self, finished_bytes: int, writer: RecordingWriter | None) -> bool:
        if self._limits.budget_mb is None:
            return False
        file_bytes = _NEW_BYTES if writer is None else writer.final_bytes
        return finished_bytes + file_bytes > self._limits.budget_mb * MB


class Commands:
    """The scene document, kept up to date: whoever has only a later file needs the commands that came before it."""

    def __init__(self, scene: dict[str, Any]) -> None:
        self._scene = scene
        self._taken = {entry.get("id"): entry for entry in scene.get("taken", [])}

    def follow(self, key: str, document: dict[str, Any] | None) -> None:
        """Take a document of the stream."""
        if key == EVENTS and document is not None and document.get("event") == "command":
            if len(self._taken) >= _MOST_COMMANDS:
                self._taken.pop(next(iter(self._taken)))
            fields = ("id", "tick", "command", "request")
            self._taken.setdefault(document.get("id"), {name: document.get(name) for name in fields})

    @property
    def scene(self) -> dict[str, Any]:
        """The scene document with all commands so far."""
        if not self._taken and "taken" not in self._scene:
            return self._scene
        return {**self._scene, "taken": list(self._taken.values())}


class Series:
    """Writes a recording to one file or to several in turn; to the outside like a `RecordingWriter`.

    Attributes:
        files: The finished files that are there, in order.
        removed: Number of finished files that were removed for want of room.
        ended: Why nothing more can be recorded, where the disk's limits ended it; empty before.
        out_of_room: It is for want of room.
    """

    out_of_room = False
    remarks: tuple[str, ...] = ()

    def __init__(
        self,
        path: Path,
        *,
        scene: dict[str, Any],
        limits: Limits,
        open_writer: Callable[..., RecordingWriter],
        force: bool = False,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Open the first file.

        Args:
            path: Name of the recording, ends in .mcap.
            scene: The rig's scene document.
            limits: Limits of the files.
            open_writer: Opens one file, given its path and the keywords `scene`, `due`, `metadata` and `from_start`.
            force: Replace what is there of that name.
            monotonic_s: Clock that times the looks at the disk [s].

        Raises:
            InputError: The file cannot be created.
        """
        check_series(path, limits, force=force)
        self.path = path
        self.files: list[Path] = []
        self.removed = 0
        self.ended = ""
        self._limits = limits
        self._open_writer = open_writer
        self._monotonic_s = monotonic_s
        self._room = Room(path.parent, limits, monotonic_s=monotonic_s)
        self._commands = Commands(scene)
        self._closed = Counts()
        self._sizes: list[int] = []
        self._finished_bytes = 0
        self._number = 0
        self._reached_ns: dict[str, int] = {}
        self._expected: set[str] = set()
        self._full_s: float | None = None
        self._series = f"{path.stem} {time.time_ns():x}"
        if force and limits.rotates:
            remove(_parts_of(path))
        self._writer = self._open(path if not limits.rotates else part_path(path, 0), previous="", from_start=True)
        self._expected = set(self._writer.streams)

    @property
    def part(self) -> Path:
        """Name of the file that is being written."""
        return self._writer.part

    @property
    def table(self) -> Any:
        """The channel table."""
        return self._writer.table

    @property
    def next_index(self) -> dict[str, int]:
        """Number of the row that is due next, by key."""
        return self._writer.next_index

    def counts(self) -> Counts:
        """What was written so far, to all files; from any thread."""
        return self._closed + self._writer.counts()

    def write(self, key: str, payload: bytes, wall_ns: int) -> dict[str, Any] | None:
        """Write one payload, to the next file where that is due; see `RecordingWriter.write`."""
        if self._limits.rotates and self._is_seam(key, payload):
            self._rotate()
        document = self._writer.write(key, payload, wall_ns)
        self._commands.follow(key, document)
        if self._room.needs_look(len(payload), self._finished_bytes, self._writer):
            self._make_room()
        return document

    def kept(self) -> list[Counts]:
        """What the files hold: it is all of one stretch."""
        return [self.counts()]

    def write_missed(self, key: str, messages: int, wall_ns: int) -> None:
        """Record that the transport lost messages for good."""
        self._writer.write_missed(key, messages, wall_ns)

    def short_of(self, rows: dict[str, int]) -> dict[str, int]:
        """Streams that have not come to the end of what was published; see `RecordingWriter.short_of`."""
        return self._writer.short_of(rows)

    def note_short(self, rows: dict[str, int], wall_ns: int) -> None:
        """Record as gaps what is missing at the end of streams."""
        self._writer.note_short(rows, wall_ns)

    def sync_if_due(self) -> None:
        """Flush to the disk if the last flush was long enough ago."""
        self._writer.sync_if_due()

    def finish(self, reason: str, *, notes: dict[str, str] | None = None) -> None:
        """Finish the last file."""
        if not self._writer.closed:
            self._writer.finish(reason, notes=notes)
            self.files.append(self._writer.path)

    def _open(
        self, path: Path, *, previous: str, from_start: bool, due: dict[str, int] | None = None
    ) -> RecordingWriter:
        metadata = {}
        if self._limits.rotates:
            about = {
                "id": self._series,
                "number": str(self._number),
                "previous": previous,
                "due": json.dumps(due or {}),
            }
            metadata["series"] = about
        return self._open_writer(path, scene=self._commands.scene, due=due, metadata=metadata, from_start=from_start)

    def _is_seam(self, key: str, payload: bytes) -> bool:
        """Whether the file is full and this is the first block of a later time than all that it holds."""
        writer, limits = self._writer, self._limits
        if key == EDGES or schema_of(key) is None:
            return False
        try:
            tick = block_in(key, payload).tick
        except ValueError:
            return False
        block_ns = self._reached_ns[key] = tick * NS // writer.tick_rate_hz
        if writer.first_time_ns is None or block_ns <= writer.last_time_ns:
            return False
        full = limits.rotate_mb is not None and writer.size_bytes >= limits.rotate_mb * MB
        if limits.rotate_s is not None and block_ns - writer.first_time_ns >= limits.rotate_s * NS:
            full = True
        return full and not self._await_others(block_ns)

    def _await_others(self, block_ns: int) -> bool:
        """Whether streams are still catching up with a block that would begin the next file."""
        behind = {key for key in self._expected if self._reached_ns.get(key, -_BEHIND_NS) < block_ns - _BEHIND_NS}
        now_s = self._monotonic_s()
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
            self.ended, self.out_of_room = f"{MOST_PARTS} files are written", True
            return
        old = self._writer
        self._number += 1
        new = part_path(self.path, self._number)
        old.finish("rotated", notes={"next": new.name})
        self.files.append(old.path)
        self._sizes.append(old.size_bytes)
        self._finished_bytes += old.size_bytes
        try:
            writer = self._open(new, previous=old.path.name, from_start=False, due=dict(old.next_index))
        except (InputError, RecordingError) as error:
            raise RecordingError(f"{error}; what was written before is kept, finished, in {old.path}") from None
        self._closed += old.counts()
        self._writer = writer

    def _make_room(self) -> None:
        while why := self._room.lack(self._finished_bytes, self._writer):
            if self._limits.when_full == "stop" or not self.files:
                self.ended, self.out_of_room = why, True
                return
            try:
                self.files[0].unlink(missing_ok=True)
            except OSError as error:
                self.ended, self.out_of_room = f"{why}, and {self.files[0]} stays ({error.strerror})", True
                return
            self.files.pop(0)
            self._finished_bytes -= self._sizes.pop(0)
            self.removed += 1
