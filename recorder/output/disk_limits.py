"""Limits of the disk space used by a recording."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from recorder.files.unfinished_file import check_destination, find_files
from recorder.writer import RecordingWriter
from rig.base.errors import InputError, Words

MB = 1_000_000
_PENDING_BYTES = 2 * MB
"""Space reserved for the end of a file, without its index [bytes]: a chunk not yet on the disk."""
_NEW_BYTES = 300_000
"""Size of a new file with its end [bytes]."""
_FLUSH_BYTES = MB // 4
"""Smallest amount in memory that is flushed when the budget is reached [bytes]; compression then reduces it."""
_CHECK_S = 0.25


@dataclass(frozen=True)
class DiskLimits:
    """Limits of file size and disk space; None or 0 for no limit.

    Attributes:
        rotate_mb: Approximate size of a file in a series [MB].
        rotate_s: Length of a file in a series [s of simulated time].
        budget_mb: Total size of all files [MB].
        keep_free_mb: Space to leave free on the disk [MB].
        when_full: Action at the budget or without disk space: stop the recording, or remove its oldest file.
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
        """True if the recording is split into several files."""
        return self.rotate_mb is not None or self.rotate_s is not None


def check_files(path: Path, first: Iterable[Path], pattern: str, limits: DiskLimits, *, force: bool) -> None:
    """Refuse names that cannot become the files of a recording, without removing anything.

    Args:
        path: Name of the recording.
        first: Possible names of the first file.
        pattern: Regular expression for the numbered files (`find_files`); empty if there are none.
        limits: Limits of the disk space.
        force: Allow replacing existing files.

    Raises:
        InputError: A name is refused by `check_destination`, numbered files exist, or the disk is full.
    """
    for name in first:
        check_destination(name, force=force)
    if pattern and not force and (existing := find_files(path, pattern)):
        raise InputError("output", "new files (--force replaces them)", Words(f"{existing[0]}, which exists"))
    if reason := _find_disk_shortage(path.parent, limits.keep_free_mb):
        raise InputError("output", f"on a disk with room: {reason} (--keep-free-mb)", str(path))


def _find_disk_shortage(folder: Path, keep_free_mb: float, *, index_bytes: int = 0) -> str:
    """Return why the disk has too little space; empty if it has enough.

    The end of the file needs space even with `keep_free_mb` of 0.
    """
    try:
        disk = os.statvfs(folder)
    except OSError:
        return ""  # the next write reports the error
    if disk.f_bavail * disk.f_frsize >= keep_free_mb * MB + _PENDING_BYTES + index_bytes:
        return ""
    return f"less than {keep_free_mb:g} MB are free on the disk" if keep_free_mb else "the disk is full"


class Room:
    """Disk space left for the files of a recording.

    Attributes:
        finished_bytes: Size of the finished files [bytes].
    """

    def __init__(self, folder: Path, limits: DiskLimits, *, monotonic_s: Callable[[], float] = time.monotonic) -> None:
        """Store the folder and its limits.

        Args:
            folder: Folder of the files.
            limits: Limits of the disk space.
            monotonic_s: Clock for the interval between two checks of the disk [s].
        """
        self.finished_bytes = 0
        self._folder = folder
        self._limits = limits
        self._monotonic_s = monotonic_s
        self._checked_s = -1e9
        self._unchecked_bytes = 0

    def find_shortage_after(self, payload_bytes: int, writer: RecordingWriter) -> str:
        """Return the result of `find_shortage` after a payload of a size; checks the disk only at intervals."""
        self._unchecked_bytes += payload_bytes
        due = self._unchecked_bytes >= MB // 2 or self._monotonic_s() - self._checked_s >= _CHECK_S
        return self.find_shortage(writer) if self._over_budget(writer) or due else ""

    def find_shortage(self, writer: RecordingWriter | None = None) -> str:
        """Return why there is no more space; empty if there is enough.

        Args:
            writer: File being written; None before a new file.
        """
        self._checked_s = self._monotonic_s()
        self._unchecked_bytes = 0
        if self._over_budget(writer):
            if writer is not None and writer.file.unflushed_bytes > _FLUSH_BYTES:
                writer.sync()
            if self._over_budget(writer):
                return f"the budget of {self._limits.budget_mb:g} MB is used up"
        index_bytes = 0 if writer is None else writer.file.index_bytes
        return _find_disk_shortage(self._folder, self._limits.keep_free_mb, index_bytes=index_bytes)

    def _over_budget(self, writer: RecordingWriter | None) -> bool:
        if self._limits.budget_mb is None:
            return False
        file_bytes = _NEW_BYTES if writer is None else writer.file.final_bytes
        return self.finished_bytes + file_bytes > self._limits.budget_mb * MB
