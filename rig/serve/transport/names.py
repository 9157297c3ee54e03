"""Names of this user's rigs on this computer, with their addresses and processes.

Each named rig keeps a file in a folder that only this user can access, and holds a lock on it while it runs. A file
without a lock is from an ended process and is ignored.
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

from rig.base.checks import StrictModel, check
from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.files import open_file
from rig.serve.transport import DEFAULT_ENDPOINT
from rig.serve.transport.endpoint import parse_endpoint
from rig.serve.waiting import Deadline

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
FORMS = "[zenoh:]HOST:PORT[?tls=DIR], or the name of a rig"
"""Spelling of the address of a rig."""
_SUFFIX = ".json"
_POLL_S = 0.1
"""Period of looking for a rig that has not started yet [s]."""


class NamedRig(StrictModel):
    """A running rig with a name."""

    name: str
    endpoint: str
    """HOST:PORT."""
    pid: Annotated[int, Field(gt=0)]


def parse_name(text: str, *, field: str = "--name") -> str:
    """Return a valid name of a rig.

    Raises:
        InputError: The name is invalid.
    """
    if not _NAME.fullmatch(text):
        raise InputError(
            field, "1 to 64 letters, digits, dots, dashes and underscores, the first a letter or digit", text
        )
    return text


@contextmanager
def register_name(name: str, endpoint: str) -> Iterator[None]:
    """Register a name until the end of the block or of the process.

    Raises:
        InputError: The name is invalid, or a running rig has it.
    """
    import fcntl

    file = _folder() / (parse_name(name) + _SUFFIX)
    with _hold_lock():
        owner = _read_entry(file)
        if owner is not None:
            raise InputError("--name", f"one that no other rig has (process {owner.pid} at {owner.endpoint})", name)
        entry = NamedRig(name=name, endpoint=endpoint, pid=os.getpid())
        handle = os.open(file, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        fcntl.flock(handle, fcntl.LOCK_EX)
        os.write(handle, entry.model_dump_json().encode())
    try:
        yield
    finally:
        with _hold_lock():
            file.unlink(missing_ok=True)
            os.close(handle)


def list_running() -> list[NamedRig]:
    """Return the running rigs that have a name, sorted by name."""
    with _hold_lock():
        files = sorted(_folder().glob(f"*{_SUFFIX}"))
        return [entry for entry in map(_read_entry, files) if entry is not None]


def check_name(name: str) -> None:
    """Raise an error early for a name that cannot be used.

    Raises:
        InputError: The name is invalid, or a running rig has it.
    """
    with register_name(name, DEFAULT_ENDPOINT):
        pass


def resolve_endpoint(text: str, *, field: str, wait_s: float = 0.0) -> tuple[str, int]:
    """Return the address of a rig given by HOST:PORT or by its name; the only place that resolves names.

    Args:
        text: HOST:PORT, a name, or a URL with one of them; a text with a colon is not a name.
        field: Name of the option, for errors.
        wait_s: Longest wait for a rig of that name [s].

    Raises:
        InputError: The text is neither.
    """
    text = text.removeprefix("zenoh:")
    if ":" in text:
        return parse_endpoint(text, field=field)
    rigs = {}
    for _ in Deadline(wait_s).polls(_POLL_S):
        rigs = {entry.name: entry.endpoint for entry in list_running()} if _NAME.fullmatch(text) else {}
        if text in rigs:
            return parse_endpoint(rigs[text], field=field)
    must = f"HOST:PORT such as {DEFAULT_ENDPOINT}, or the name of a running rig"
    raise (UnknownNameError(field, must, text, rigs) if rigs else InputError(field, f"{must} (none runs)", text))


def parse_url(url: str) -> str:
    """Return the address part of a URL: zenoh:HOST:PORT[?tls=DIR] or zenoh:NAME; `zenoh:` may be left out.

    Raises:
        InputError: The URL has another form.
    """
    address = url.removeprefix("zenoh:")
    host, colon, port = address.partition("?")[0].rpartition(":")
    if not (host and port.isdecimal()) if colon else not port:
        raise InputError("url", FORMS, url)
    return address


def _folder() -> Path:
    """Return the folder of this user's names; create it if it is missing.

    Raises:
        InputError: Another user owns it, or may access it.
    """
    runtime = Path(os.environ.get("XDG_RUNTIME_DIR") or "/nowhere")
    folder = runtime / "rig" if runtime.is_dir() else Path(tempfile.gettempdir()) / f"rig-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise InputError("names", f"kept in a folder private to its owner (chmod 700 {folder})", Words("another"))
    return folder


@contextmanager
def _hold_lock() -> Iterator[None]:
    """Hold the lock for reading and changing the names."""
    import fcntl

    handle = os.open(_folder() / ".lock", os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _read_entry(file: Path) -> NamedRig | None:
    """Return the rig of a file; remove the file of an ended process."""
    import fcntl

    with contextlib.suppress(FileNotFoundError), open_file(file) as opened:
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            with contextlib.suppress(InputError):
                return check(NamedRig, opened.read(), field="name")
        else:
            file.unlink()
    return None
