"""The file of a recording in the making: NAME.mcap.part, locked by who writes it, and NAME.mcap once it is whole.

Not `rig.base.errors.whole_file`: what a kill or a full disk leaves of a recording stays, for `rig recover`.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
from collections.abc import Iterable
from pathlib import Path

from rig.base.errors import PART_SUFFIX, InputError, Words, check_new_file


def part_of(path: Path) -> Path:
    """Name of a recording while it is being written."""
    return path.with_name(path.name + PART_SUFFIX)


def check_destination(path: Path, *, force: bool = False) -> None:
    """Refuse a file that cannot become a recording, before anything is subscribed or overwritten.

    Args:
        path: File to record to.
        force: An existing file may be replaced.

    Raises:
        InputError: The name does not end in .mcap, the folder is missing or read-only, or the file exists.
    """
    check_new_file(path, field="output", suffixes=(".mcap",), force=force)
    if (part := part_of(path)).exists() and not force:
        raise InputError("output", "a new file (--force replaces one)", Words(f"{part}, which exists"))


def files_like(path: Path, what: str) -> list[Path]:
    """Files beside a recording NAME.mcap that look like NAME.WHAT.mcap, finished or not; WHAT is an expression."""
    name = re.compile(rf"{re.escape(path.stem)}\.{what}{re.escape(path.suffix)}({re.escape(PART_SUFFIX)})?")
    return sorted(each for each in path.parent.iterdir() if name.fullmatch(each.name))


def remove(files: Iterable[Path]) -> None:
    """Remove files of an earlier recording, all or none of them.

    Raises:
        InputError: Another recording is writing to one, or one cannot be removed.
    """
    import fcntl

    files = list(files)
    for file in files:
        with contextlib.suppress(FileNotFoundError), file.open("rb") as old:
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
    """A recording's file for as long as it is written, locked; it takes its name when it is finished.

    Attributes:
        path: Its name in the end.
        part: Its name meanwhile; another one, where somebody removed it and it was saved.
        file: The open file.
    """

    def __init__(self, path: Path, *, force: bool = False) -> None:
        """Create the file.

        Args:
            path: Its name in the end.
            force: What another recording left there may go, but not what one is writing to.

        Raises:
            InputError: The destination cannot be used, or another recording is writing to it.
        """
        import fcntl

        check_destination(path, force=force)
        self.path, self.part = path, part_of(path)
        self._force = force
        try:
            if force and self.part.exists():
                # A new file under the name, not the old one emptied: nobody else can have it open.
                remove([self.part])
            self.file = self.part.open("x+b")  # readable, to save it if somebody removes it
            fcntl.flock(self.file, fcntl.LOCK_EX)
        except OSError as error:
            raise InputError("output", "a file that can be written", Words(f"{self.part} ({error.strerror})")) from None

    def sync(self) -> int:
        """Bring what was written to the disk; gives the file's size [bytes].

        Raises:
            OSError: The disk refused, or the file was removed: then it has been copied to the nearest folder that still
                exists, where that was possible.
        """
        self.file.flush()
        os.fsync(self.file.fileno())
        # A removed file can be written to, and is gone when it is closed.
        if not os.fstat(self.file.fileno()).st_nlink:
            self._save()
        return self.file.tell()

    def sync_folder(self) -> None:
        """Bring the names of files to the disk as well; not every file system can."""
        with contextlib.suppress(OSError):
            number = os.open(self.part.parent, os.O_RDONLY)
            try:
                os.fsync(number)
            finally:
                os.close(number)

    def close(self) -> None:
        """Close the file as it is; what was written stays under its draft's name."""
        with contextlib.suppress(OSError):
            self.file.close()

    def discard(self) -> None:
        """Close the file and remove what was written; a file that was to be replaced stays."""
        self.close()
        self.part.unlink(missing_ok=True)

    def finish(self) -> None:
        """Close the file, which was synced, and give it its name.

        Raises:
            OSError: Somebody else took the name meanwhile, or the disk refused.
        """
        self.file.close()
        if self.path.exists() and not self._force:
            raise FileExistsError(errno.EEXIST, f"{self.path} was created by someone else meanwhile")
        self.part.replace(self.path)

    def _save(self) -> None:
        gone = self.part
        folder = next(folder for folder in gone.absolute().parents if folder.is_dir())
        with contextlib.suppress(OSError):
            self.part = folder / gone.name
            with self.part.open("xb") as copy:
                position = 0
                while data := os.pread(self.file.fileno(), 1 << 20, position):
                    copy.write(data)
                    position += len(data)
        raise OSError(errno.ENOENT, f"{gone} was removed while it was written")
