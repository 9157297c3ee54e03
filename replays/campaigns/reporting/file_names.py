"""Names of the files of a campaign, which do not depend on the working directory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path


def name_files(paths: Iterable[Path]) -> dict[Path, str]:
    """Return the name of each file, with as many of its folders as distinguish it from files of the same name.

    Example:
        >>> name_files([Path("/a/x.py"), Path("/b/x.py"), Path("/b/y.py")])[Path("/b/x.py")]
        'b/x.py'
    """
    names: dict[Path, str] = {}
    left, depth = set(paths), 1
    while left:
        short = {path: str(Path(*path.parts[-depth:])) for path in left}
        counts = Counter(short.values())
        names |= {path: name for path, name in short.items() if counts[name] == 1 or depth > len(path.parts)}
        left, depth = left - names.keys(), depth + 1
    return names
