"""Journal of results: one JSON line per result, written to disk at once, so that a study can be resumed."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from rig.base.checks import read_json
from rig.base.errors import InputError, Words
from rig.base.files import open_output, read_file, write_file

_MAX_BYTES = 1 << 28
"""Largest journal that is continued [bytes]."""


def prepare_folder(folder: Path) -> None:
    """Create a folder if it is missing.

    Raises:
        InputError: If it cannot be created or written, or is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("output", "a folder", Words(f"{folder}, which is a file"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("output", "a folder that can be created", Words(f"{folder} ({error.strerror})")) from None
    if not os.access(folder, os.W_OK):
        raise InputError("output", "a folder that can be written", str(folder))


class Journal:
    """A file of JSON lines in a folder; only lines measured by the same code count.

    Attributes:
        rows: Valid lines, in the order of the file.
        outdated: Number of lines of other code.
    """

    def __init__(self, folder: Path, name: str, code: str, *, fresh: bool = False) -> None:
        """Open the journal in a folder, which is created if missing.

        Args:
            folder: The folder.
            name: Name of the file.
            code: Digest of the code; must equal the field `code` of a line.
            fresh: Delete earlier results.

        Raises:
            InputError: If the folder cannot be written, or is a file.
        """
        prepare_folder(folder)
        self.path = folder / name
        self.rows: list[dict[str, Any]] = []
        self.outdated = 0
        if fresh:
            self.path.unlink(missing_ok=True)
        if self.path.is_file():
            self._load(code)

    def _load(self, code: str) -> None:
        try:
            text, _, incomplete = read_file(self.path, _MAX_BYTES).decode().rpartition("\n")
            lines = [read_json(line.encode(), field="line") for line in text.splitlines()]
            if not "{".startswith(incomplete[:1]):
                raise InputError("last line", "a JSON object", incomplete[:60])
        except (ValueError, OSError) as error:
            must = f"a folder whose {self.path.name} is of an earlier run"
            raise InputError("--output", must, Words(f"another file ({error})")) from None
        if incomplete:  # the last line of a killed run
            write_file(self.path, text + "\n" * bool(text))
        self.rows = [line for line in lines if line.get("code") == code]
        self.outdated = len(lines) - len(self.rows)

    def add(self, row: dict[str, Any]) -> None:
        """Append a line; it is written to disk before this returns."""
        with open_output(self.path, "a") as file:
            file.write(json.dumps(row, allow_nan=False) + "\n")
        self.rows.append(row)
