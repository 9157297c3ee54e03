"""Rigs of this user on this machine by name: who is called what, where it listens, and which process it is.

Each rig that has a name keeps a file in a folder that is this user's alone, and holds a lock on it while it runs: the
file of a process that is gone, however it ended, is locked by nobody, and counts as not there.
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from pydantic import Field

from rig.base.checks import Outside, check
from rig.base.errors import InputError, UnknownNameError, Words
from rig.serve.transport import DEFAULT_ENDPOINT
from rig.serve.transport.endpoint import parse_endpoint
from rig.serve.waiting import Deadline

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_SUFFIX = ".json"
_AGAIN_S = 0.1
"""How often a rig that is waited for is looked for [s]."""


class Named(Outside):
    """A rig that runs under a name."""

    name: str
    endpoint: str
    """HOST:PORT."""
    pid: Annotated[int, Field(gt=0)]


def parse_name(text: str, *, field: str = "--name") -> str:
    """A name that a rig can have.

    Raises:
        InputError: It cannot.
    """
    if not _NAME.fullmatch(text):
        raise InputError(
            field, "1 to 64 letters, digits, dots, dashes and underscores, the first a letter or digit", text
        )
    return text


@contextmanager
def registered(name: str, endpoint: str) -> Iterator[None]:
    """Be found under a name, until the end of the `with` or of the process.

    Raises:
        InputError: A rig that runs has that name, or it cannot be one.
    """
    import fcntl

    file = _folder() / (parse_name(name) + _SUFFIX)
    with _alone():
        taken = _read(file)
        if taken is not None:
            raise InputError("--name", f"one that no other rig has (process {taken.pid} at {taken.endpoint})", name)
        entry = Named(name=name, endpoint=endpoint, pid=os.getpid())
        handle = os.open(file, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        fcntl.flock(handle, fcntl.LOCK_EX)
        os.write(handle, entry.model_dump_json().encode())
    try:
        yield
    finally:
        with _alone():
            file.unlink(missing_ok=True)
            os.close(handle)


def running() -> list[Named]:
    """The rigs that run under a name, by name."""
    with _alone():
        files = sorted(_folder().glob(f"*{_SUFFIX}"))
        return [entry for entry in map(_read, files) if entry is not None]


def check_name(name: str) -> None:
    """Find out early whether a name can be had.

    Raises:
        InputError: It cannot, or a rig that runs has it.
    """
    with registered(name, DEFAULT_ENDPOINT):
        pass


def endpoint_of(text: str, *, field: str, wait_s: float = 0.0) -> tuple[str, int]:
    """Where a rig listens that is told by HOST:PORT, or by its name: the one place that knows names.

    Args:
        text: One of these, or a URL with one; what has a colon is no name.
        field: What errors call it.
        wait_s: How long to wait for a rig of that name to be there [s].

    Raises:
        InputError: It is neither.
    """
    text = text.removeprefix("zenoh:")
    if ":" in text:
        return parse_endpoint(text, field=field)
    found = {}
    for _ in Deadline(wait_s).polls(_AGAIN_S):
        found = {entry.name: entry.endpoint for entry in running()} if _NAME.fullmatch(text) else {}
        if text in found:
            return parse_endpoint(found[text], field=field)
    must = f"HOST:PORT such as {DEFAULT_ENDPOINT}, or the name of a rig that runs"
    raise UnknownNameError(field, must, text, found) if found else InputError(field, f"{must} (none does)", text)


def address_in(url: str) -> str:
    """What stands for a rig in a URL, zenoh:HOST:PORT[?tls=DIR] or zenoh:NAME; a name alone is a URL too.

    Raises:
        InputError: It is another URL.
    """
    kind, colon, rest = url.partition(":")
    if not colon and url:
        return url
    if kind != "zenoh" or not rest:
        raise InputError("url", "zenoh:HOST:PORT[?tls=DIR], or the name of a rig", url)
    return rest


def _folder() -> Path:
    """The folder of this user's names, made where it is missing.

    Raises:
        InputError: Somebody else has made it, or may write there.
    """
    runtime = Path(os.environ.get("XDG_RUNTIME_DIR") or "/nowhere")
    folder = runtime / "rig" if runtime.is_dir() else Path(tempfile.gettempdir()) / f"rig-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise InputError("names", f"kept in a folder that is its owner's alone (chmod 700 {folder})", Words("another"))
    return folder


@contextmanager
def _alone() -> Iterator[None]:
    """Look at names and change them one process at a time."""
    import fcntl

    handle = os.open(_folder() / ".lock", os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _read(file: Path) -> Named | None:
    """The rig of a file; one that is gone is forgotten."""
    import fcntl

    with contextlib.suppress(FileNotFoundError), file.open("rb") as opened:
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            with contextlib.suppress(InputError):
                return check(Named, opened.read(), field="name")
        else:
            file.unlink()
    return None
