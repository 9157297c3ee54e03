"""Folders for the output of commands."""

from __future__ import annotations

import tempfile
from pathlib import Path

from rig.base.errors import InputError, Words


def check_folder(path: Path, *, field: str) -> None:
    """Raise an error early for a folder that neither exists nor can be created.

    Args:
        path: The folder; the caller creates a missing one by `path.mkdir(exist_ok=True)` when it writes.
        field: Name of the option, for errors.

    Raises:
        InputError: Its parent is missing, it is a file, or it is not writable.
    """
    if path.exists() and not path.is_dir():
        raise InputError(field, "a folder, not a file", str(path))
    if not path.parent.is_dir():
        raise InputError(field, "a folder, or a new one in a folder that exists", str(path))
    try:
        tempfile.TemporaryFile(dir=path if path.exists() else path.parent).close()
    except OSError as error:
        raise InputError(field, "a folder that can be written to", Words(f"{path} ({error.strerror})")) from None
