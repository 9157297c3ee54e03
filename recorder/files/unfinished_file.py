"""File of a recording in progress: NAME.mcap.part, locked by its recorder, renamed to NAME.mcap when complete.

Unlike `rig.base.files.whole_file`, an interrupted recording keeps its file, for `rig recover`.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
from collections.abc import Iterable
from pathlib import Path

from rig.base.errors import InputError, Words
from rig.base.files import PART_SUFFIX, check_new_file, open_file

ALTERED = "while it was being written"
"""Words of each error of a file that another process removed, replaced or altered."""


def get_part_path(path: Path) -> Path:
    """Return the name of a recording in progress."""
    return path.with_name(path.name + PART_SUFFIX)


def check_destination(path: Path, *, force: bool = False) -> None:
    """Refuse a file that cannot become a recording, before subscribing or overwriting anything.

    Args:
        path: Output file.
        force: Allow replacing an existing file.

    Raises:
        InputError: The name does not end in .mcap, the folder is missing or read-only, or the file exists.
    """
    check_new_file(path, field="output", suffixes=(".mcap",), force=force)
    if (part := get_part_path(path)).exists() and not force:
        raise InputError("output", "a new file (--force replaces one)", Words(f"{part}, which exists"))


def find_files(path: Path, what: str) -> list[Path]:
    """Return the files named NAME.WHAT.mcap in the folder of NAME.mcap, finished or not.

    Args:
        path: NAME.mcap.
        what: Regular expression for WHAT.
    """
    name = re.compile(rf"{re.escape(path.stem)}\.{what}{re.escape(path.suffix)}({re.escape(PART_SUFFIX)})?")
    return sorted(each for each in path.parent.iterdir() if name.fullmatch(each.name))


def remove(files: Iterable[Path]) -> None:
    """Remove the files of an earlier recording; if one is in use, remove none.

    Raises:
        InputError: Another recorder is writing to one of the files, or one cannot be removed.
    """
    import fcntl

    files = list(files)
    for file in files:
        with contextlib.suppress(FileNotFoundError), open_file(file) as old:
            try:
                fcntl.flock(old, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError("output", "files that no other recording is writing to", str(file)) from None
    for file in files:
        try:
            file.unlink(missing_ok=True)
        except OSError as error:
            raise InputError("output", "files that can be replaced", Words(f"{file} ({error.strerror})")) from None


class Draft:
    """Locked file of a recording in progress, renamed when it is finished.

    Attributes:
        path: Final name.
        part: Current name; differs from the initial one if the file was removed or replaced, and saved elsewhere.
        file: The open file.
        digest: SHA-256 digest of the written bytes.
    """

    def __init__(self, path: Path, *, force: bool = False) -> None:
        """Create the file.

        Args:
            path: Final name.
            force: Replace what an earlier recording left there, unless a recorder is writing to it.

        Raises:
            InputError: The destination cannot be used, or another recorder is writing to it.
        """
        import fcntl

        check_destination(path, force=force)
        self.path, self.part = path, get_part_path(path)
        self._force, self.digest, self._size_bytes = force, hashlib.sha256(), 0
        try:
            if force and self.part.exists():
                # Create a new file instead of truncating the old one, so that no other process has it open.
                remove([self.part])
            # Readable, so that it can be saved after a removal. Appending, because a position after the end of a file
            # that was truncated would hide that from a comparison of sizes.
            flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_APPEND
            self.file = os.fdopen(os.open(self.part, flags, 0o666), "a+b")
            fcntl.flock(self.file, fcntl.LOCK_EX)
        except OSError as error:
            raise InputError("output", "a file that can be written", Words(f"{self.part} ({error.strerror})")) from None

    def write(self, data: bytes) -> int:
        """Append bytes to the file."""
        self.digest.update(data)
        self._size_bytes += len(data)
        return self.file.write(data)

    def tell(self) -> int:
        """Return the number of bytes written, which the file does not have if another process truncated it."""
        return self._size_bytes

    def flush(self) -> None:
        """Pass all written bytes to the operating system."""
        self.file.flush()

    def sync(self) -> int:
        """Flush to the disk and return the file size [bytes].

        Raises:
            OSError: The disk reports an error, or another process changed the file; see `verify`.
        """
        self.file.flush()
        os.fsync(self.file.fileno())
        self.verify()
        return self.tell()

    def sync_folder(self) -> None:
        """Flush the folder entry to the disk, where the file system supports it."""
        with contextlib.suppress(OSError):
            number = os.open(self.part.parent, os.O_RDONLY)
            try:
                os.fsync(number)
            finally:
                os.close(number)

    def close(self) -> None:
        """Close the file and keep it under its current name."""
        with contextlib.suppress(OSError):
            self.file.close()

    def discard(self) -> None:
        """Close and remove the file; a file that it would have replaced stays."""
        self.close()
        self.part.unlink(missing_ok=True)

    def finish(self) -> None:
        """Rename the flushed file to its final name and close it.

        Raises:
            OSError: The final name was taken by another process, the file was replaced by another one, or the disk
                reports an error.
        """
        if self.path.exists() and not self._force:
            raise FileExistsError(errno.EEXIST, f"{self.path} was created by another process meanwhile")
        self.verify()
        self.part.replace(self.path)
        if not self._is_at(self.path):  # replaced between the comparison and the renaming
            self._save("replaced")
        self.file.close()

    def verify(self) -> None:
        """Check that the file still has its name and the size that was written.

        Raises:
            OSError: If it was truncated or appended to; or removed or replaced, and then it was copied, if possible, to
                its folder or the nearest existing parent.
        """
        self.file.flush()
        if not self._is_at(self.part):
            entry = os.fstat(self.file.fileno())
            if entry.st_nlink and entry.st_size != self.tell():
                raise OSError(errno.EIO, f"{self.part} was truncated or appended to {ALTERED}")
            # A removed file can still be written, but is lost when it is closed.
            self._save("replaced" if entry.st_nlink else "removed")

    def _is_at(self, path: Path) -> bool:
        """Return whether a name leads to the open file, with the size that was written."""
        with contextlib.suppress(OSError):
            named = path.lstat()
            return os.path.samestat(named, os.fstat(self.file.fileno())) and named.st_size == self.tell()
        return False

    def _save(self, what: str) -> None:
        """Copy the open file to a free name, in its folder or the nearest existing parent, and raise an OSError."""
        part_path = self.part
        folder = next(folder for folder in part_path.absolute().parents if folder.is_dir())
        with contextlib.suppress(OSError):
            self.part = folder / part_path.name
            if os.path.lexists(self.part):
                self.part = folder / f"{self.path.stem}.saved{self.path.suffix}{PART_SUFFIX}"
            with self.part.open("xb") as copy:
                position = 0
                while data := os.pread(self.file.fileno(), 1 << 20, position):
                    copy.write(data)
                    position += len(data)
        raise OSError(errno.ENOENT, f"{part_path} was {what} {ALTERED}")
