"""A journal of what has been measured: a line a result, on the disk as it comes, so that a study can go on."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from rig.base.errors import InputError, Words


def prepare_folder(folder: Path) -> None:
    """Make a folder where it is missing.

    Raises:
        InputError: It cannot be made or written, or is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("output", "a folder", Words(f"{folder}, which is a file"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("output", "a folder that can be made", Words(f"{folder} ({error.strerror})")) from None
    if not os.access(folder, os.W_OK):
        raise InputError("output", "a folder that can be written", str(folder))


class Journal:
    """A file of JSON lines in a folder, of which those count that the same code has measured.

    Attributes:
        rows: What counts, in the order in which it came.
        outdated: How many lines are of other code.
    """

    def __init__(self, folder: Path, name: str, code: str, *, fresh: bool = False) -> None:
        """Open it in a folder, which is made where it is missing.

        Args:
            folder: The folder.
            name: Of the file.
            code: Digest of the code; the field `code` of a line must be the same.
            fresh: Start over.

        Raises:
            InputError: It cannot be written, or is a file.
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
        text = self.path.read_text(encoding="utf-8")
        if text and not text.endswith("\n"):  # the last line of a run that was killed
            text = text[: text.rfind("\n") + 1]
            self.path.write_text(text, encoding="utf-8")
        lines = [json.loads(line) for line in text.splitlines()]
        self.rows = [line for line in lines if line.get("code") == code]
        self.outdated = len(lines) - len(self.rows)

    def add(self, row: dict[str, Any]) -> None:
        """Keep a line; it is on the disk when this returns."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row, allow_nan=False) + "\n")
        self.rows.append(row)
