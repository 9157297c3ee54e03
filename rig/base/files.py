"""Files: opening those from outside, writing those that are complete or absent, and closing.

All input files are opened, and all output files written, by these functions; a test finds other calls. Outputs are
written to a new file with a name that cannot be guessed, so that no symbolic link in the folder is followed.
"""

from __future__ import annotations

import errno
import io
import os
import secrets
import stat
import tempfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import IO, Any, Self

from rig.base.errors import DiskError, InputError, SimulationError, Words
from rig.base.text import find_similar

PART_SUFFIX = ".part"
"""Suffix of a file while it is written."""
_MAX_NAME = 50
"""Characters of a file name in that of its draft; a name has at most 255 bytes, a character up to four."""
_MAX_INFLATED, _MAX_RATIO = 256 << 20, 100
_MAX_LINE = 1 << 21
"""Longest line of a text file [characters]; pyarrow accepts no longer line in its blocks."""


def open_file(path: Path) -> BufferedReader:
    """Open a regular file for reading; pipes and devices, which may never end or begin, are refused.

    Raises:
        OSError: The file cannot be read, or is not a regular file.
    """

    def opener(name: str, flags: int) -> int:
        number = os.open(name, flags | getattr(os, "O_NONBLOCK", 0))
        if not stat.S_ISREG(os.fstat(number).st_mode):
            os.close(number)
            raise OSError(errno.EINVAL, "not a regular file", name)
        return number

    return open(path, "rb", opener=opener)


def read_file(path: Path, most_bytes: int) -> bytes:
    """Return the contents of a regular file.

    Raises:
        OSError: The file cannot be read, is not a regular file, or is larger than `most_bytes`.
    """
    with open_file(path) as file:
        data = file.read(most_bytes + 1)
    if data is None or len(data) > most_bytes:  # None: a file of the kernel that has no data yet
        reason = "no data" if data is None else f"larger than {most_bytes / 1048576:g} MB"
        raise OSError(errno.EFBIG, reason, str(path))
    return data


class TextLines(io.TextIOWrapper):
    """A text file whose lines have a limited length, so that a line without an end cannot fill the memory."""

    def readline(self, size: int = -1, /) -> str:
        """Return the next line, as an iteration does.

        Raises:
            ValueError: The line has more than 2 million characters.
        """
        line = super().readline(_MAX_LINE if size < 0 else size)
        if len(line) == _MAX_LINE:
            raise ValueError(f"a line of more than {_MAX_LINE} characters")
        return line


def is_file(path: Path) -> bool:
    """Return whether a path is a regular file; False also for a name that the system does not accept."""
    with suppress(OSError):
        return path.is_file()
    return False


def find_data_limit(file_bytes: int) -> int:
    """Return the most data that a compressed file of some size may hold [bytes]."""
    return max(_MAX_INFLATED, _MAX_RATIO * file_bytes)


def inflate(blocks: Iterable[bytes], file_bytes: int) -> Iterator[bytes]:
    """Yield the data of zlib blocks in pieces of at most 1 MB, unless they would fill the memory.

    Args:
        blocks: All compressed blocks of a file; damaged ones are left to its reader.
        file_bytes: Size of the file [bytes].

    Raises:
        InputError: The data exceed 256 MB and 100 times the size of the file; not more is decompressed.
    """
    left = find_data_limit(file_bytes)
    for block in blocks:
        decompressor = zlib.decompressobj()
        with suppress(zlib.error):
            while left > 0 and (piece := decompressor.decompress(block, 1 << 20)):
                left, block = left - len(piece), decompressor.unconsumed_tail
                yield piece
        if left <= 0:
            must = f"one with at most {_MAX_RATIO} times its size of data, or {_MAX_INFLATED >> 20} MB"
            raise InputError("file", must, Words("a file with more compressed data"))


def build_read_error(path: Path, error: OSError) -> InputError:
    """Return the error for an unreadable file, with similar names in its folder, such as an unfinished recording."""
    names: list[str] = []
    if isinstance(error, FileNotFoundError):
        with suppress(OSError):
            names = sorted(each.name for each in path.parent.iterdir() if path.suffix in each.name)
    names = [name for name in names if name.startswith(f"{path.stem}.")][:3] or find_similar(path.name, names)
    such = f", such as {', '.join(str(path.with_name(name)) for name in names)}" if names else ""
    return InputError("file", f"a file that can be read{such}", Words(f"{path} ({error.strerror})"))


def check_new_file(path: Path, *, field: str, suffixes: tuple[str, ...], force: bool) -> None:
    """Raise an error early for a file that cannot be written.

    Args:
        path: The file.
        field: Name of the option, for errors.
        suffixes: Allowed suffixes.
        force: Allow replacing an existing file.

    Raises:
        InputError: The suffix is wrong, the folder is missing or read-only, or the file exists.
    """
    if path.suffix not in suffixes:  # also of a path without a name, such as "" and /
        *others, last = suffixes
        endings = f"{', '.join(others)} or {last}" if others else last
        raise InputError(field, f"a file name that ends in {endings}", str(path))
    try:
        path.with_name(path.name + PART_SUFFIX).exists()
    except OSError as error:  # a name that is too long
        raise InputError(field, "a file name that the system accepts", Words(f"{path} ({error.strerror})")) from None
    if not path.parent.is_dir():
        raise InputError(field, "in a folder that exists", str(path))
    if path.is_dir():
        raise InputError(field, "a file, not a folder", str(path))
    if path.exists() and not path.is_file():
        raise InputError(field, "a file, not a pipe, socket or device", str(path))
    if os.path.lexists(path) and not force:
        raise InputError(field, "a new file (--force replaces one)", Words(f"{path}, which exists"))
    try:
        # Permissions alone are not sufficient: try it.
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise InputError(field, "in a folder that can be written", Words(f"{path} ({error.strerror})")) from None


def check_output_differs(sources: list[Path], output: Path, *, field: str = "output") -> None:
    """Raise an error for an output that is one of the sources, under any name.

    Raises:
        InputError: The output, or its temporary file, is one of the sources.
    """
    for candidate in (output, output.with_name(output.name + PART_SUFFIX)):
        for source in sources:
            with suppress(OSError):  # one of them does not exist
                if source.samefile(candidate):
                    raise InputError(field, "another file than those that are read", str(output))


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary file that replaces `path` if the block succeeds, and is removed otherwise.

    A symbolic link at `path` is replaced, not followed. A file that another process creates there meanwhile is kept,
    and the temporary file too. A killed process leaves the temporary file, whose name ends in .part.

    Raises:
        DiskError: The disk refused, whatever error the writing library raised.
    """
    existed = os.path.lexists(path)
    draft = path.with_name(f"{path.name[:_MAX_NAME]}.{secrets.token_hex(8)}{PART_SUFFIX}")
    try:
        os.close(os.open(draft, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield draft
        if not existed and not _claim(draft, path):
            kept = draft.rename(draft.with_suffix(path.suffix))
            raise DiskError(f"{path} was created by another process meanwhile; this output is {kept}")
        draft.replace(path)
    except (InputError, SimulationError, DiskError):
        raise
    except (OSError, RuntimeError, ValueError) as error:  # errors of writing libraries; any other is a bug
        # A library that closes after a failure may fail again: the system's first error is reported.
        reason, cause = str(error) or type(error).__name__, error
        while cause is not None:
            reason = (isinstance(cause, OSError) and cause.strerror) or reason
            cause = cause.__context__
        raise DiskError(f"{path} could not be written: {reason}; nothing of it is kept") from error
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)


def _claim(draft: Path, path: Path) -> bool:
    """Give a draft its final name as well; return False if the name is taken."""
    try:
        os.link(draft, path)
    except FileExistsError:
        return False
    except OSError:  # a file system without links: the draft is only renamed
        pass
    return True


def write_file(path: Path, data: str | bytes, *, sync: bool = False) -> None:
    """Write a file at once, text in UTF-8.

    Args:
        path: The file.
        data: Its content.
        sync: Have the disk store the content before the file gets its name, so that a power failure leaves no part.

    Raises:
        DiskError: The disk refused; an existing file stays unchanged.
    """
    with whole_file(path) as draft:
        draft.write_bytes(data.encode() if isinstance(data, str) else data)
        if sync:
            with draft.open("rb+") as file:
                os.fsync(file.fileno())


def lock_folder(folder: Path, what: str) -> int:
    """Create a folder if necessary and lock it.

    Args:
        folder: The folder.
        what: Kind of command that locks it, for errors.

    Returns:
        The handle that holds the lock until it is closed, or the process ends.

    Raises:
        DiskError: The folder cannot be created or opened.
        InputError: It is a file, or another process holds the lock.
    """
    import fcntl

    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except FileExistsError:
        raise InputError("--output", "a folder", Words(f"{folder}, which is a file")) from None
    except OSError as error:
        raise DiskError(f"{folder}: {error.strerror}") from None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        raise InputError("--output", f"a folder that no other running {what} writes to", str(folder)) from None
    return handle


def open_output(path: Path, mode: str) -> IO[Any]:
    """Open a file that others may read while it is written: a log, a journal; a symbolic link is refused.

    Args:
        path: The file.
        mode: Mode of `open`; text is UTF-8.

    Raises:
        OSError: The file cannot be written, or is a symbolic link.
    """
    encoding = None if "b" in mode else "utf-8"
    return open(path, mode, encoding=encoding, opener=lambda name, flags: os.open(name, flags | os.O_NOFOLLOW, 0o666))


class Closing(ABC):
    """An object whose `close` is called at the end of a `with`."""

    @abstractmethod
    def close(self) -> None:
        """Release all resources."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
