"""Folder of the compiled kernels: another one where the user's cache cannot be written, and removal of old ones."""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from rig.base.errors import DiskError

_VARIABLE = "NUMBA_CACHE_DIR"
_DIGEST = re.compile("[0-9a-f]{16}")
_KEPT, _MAX_AGE_S = 3, 30 * 86400.0


def choose_folder() -> None:
    """Set a temporary folder of this user for compiled kernels if the cache cannot be written, before numba is used.

    Raises:
        DiskError: No folder can be written.
    """
    try:
        folder = os.environ.get(_VARIABLE) or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        if sys.platform == "win32" or _is_writable(Path(folder)):
            return
    except RuntimeError:  # a user without a home
        folder = "the home folder"
    try:
        other = Path(tempfile.gettempdir()) / f"rotor-stator-rig-{os.getuid()}"
        other.mkdir(mode=0o700, exist_ok=True)
        entry = other.lstat()
        if other.is_symlink() or entry.st_uid != os.getuid() or entry.st_mode & 0o077:  # made by somebody else
            other = Path(tempfile.mkdtemp(prefix="rotor-stator-rig-"))
    except OSError:
        raise DiskError(f"kernels cannot be compiled: {folder} cannot be written (set {_VARIABLE})") from None
    os.environ[_VARIABLE] = str(other)
    if "numba" in sys.modules:
        from numba.core import config

        vars(config)["CACHE_DIR"] = str(other)


def _is_writable(folder: Path) -> bool:
    existing = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)


def remove_old_kernels(folder: Path) -> None:
    """Remove kernels of other versions beside a version's folder, but the newest ones and those of the last month."""
    if folder.parts[-3:-1] != ("rotor-stator-rig", "kernels"):  # a folder of the user
        return
    with suppress(OSError):
        others = [each for each in folder.parent.iterdir() if each != folder and _DIGEST.fullmatch(each.name)]
        oldest_s = time.time() - _MAX_AGE_S
        others.sort(key=lambda each: -each.stat().st_mtime)
        for old in (each for each in others[_KEPT:] if each.stat().st_mtime < oldest_s):
            shutil.rmtree(old, ignore_errors=True)
