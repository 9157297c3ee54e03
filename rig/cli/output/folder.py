"""Folders that commands write into."""

from __future__ import annotations

import os
from pathlib import Path

from rig.base.errors import InputError


def check_folder(path: Path, *, field: str) -> None:
    """Refuse a folder that neither is there nor can be made, before anything is worked out.

    Args:
        path: The folder; one that is missing is made by `path.mkdir(exist_ok=True)` when there is something to write.
        field: What the user knows it by.

    Raises:
        InputError: Its parent is missing, or it is a file.
    """
    if path.exists() and not path.is_dir():
        raise InputError(field, "a folder, not a file", str(path))
    if not path.parent.is_dir():
        raise InputError(field, "a folder, or a new one in a folder that exists", str(path))
    if not os.access(path if path.exists() else path.parent, os.W_OK | os.X_OK):
        raise InputError(field, "a folder that can be written to", str(path))
