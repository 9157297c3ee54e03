"""Numba kernels: functions of floats, arrays and NamedTuples only.

numba's cache checks only the file of the function that it loads: it returns stale machine code when a kernel or a
constant in *another* file has changed. Therefore a digest of every kernel and engine file, including those of installed
packages that add an engine, names the cache folder before the first kernel is defined (unless the user set
NUMBA_CACHE_DIR).

numba also applies a caller's `fastmath` to the functions that it calls. Kernels shared by engines set their own, so
that their bits do not depend on which engine was compiled first.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from numba.core import config as numba_config

from rig.base.checks import find_entry_points

ENGINE_GROUP = "rig.engines"
"""Entry-point group of installed packages that add an engine (`rig.physics.engines`)."""
_KERNELS = Path(__file__).parent
_SOURCES = (_KERNELS, _KERNELS.parent / "engines", _KERNELS.parents[1] / "channels" / "sensors")


def source_digest() -> str:
    """Return the digest of all files with compiled code and of their location, which names numba's cache folder."""
    digest = hashlib.sha256(str(Path(__file__).parent).encode())
    own = (path for folder in _SOURCES for path in folder.rglob("*.py"))
    for path in [*sorted(own), *_files_of_other_packages()]:
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def _files_of_other_packages() -> Iterator[Path]:
    for package in sorted({point.module.partition(".")[0] for point in find_entry_points(ENGINE_GROUP)}):
        spec = find_spec(package)
        if spec is not None and spec.submodule_search_locations:
            yield from sorted(path for folder in spec.submodule_search_locations for path in Path(folder).rglob("*.py"))
        elif spec is not None and spec.origin:
            yield Path(spec.origin)


def _cache_folder() -> Path:
    if sys.platform == "win32":
        root = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    else:
        root = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return root / "rotor-stator-rig" / "kernels" / source_digest()


if "NUMBA_CACHE_DIR" not in os.environ:
    numba_config.CACHE_DIR = str(_cache_folder())  # pyright: ignore[reportAttributeAccessIssue]


def has_compiled_kernels() -> bool:
    """Return True if the cache holds kernels of these sources, so that the start is quick."""
    folder = Path(str(numba_config.CACHE_DIR))  # pyright: ignore[reportAttributeAccessIssue]
    return folder.is_dir() and any(folder.rglob("*.nbc"))
