"""Comparison of generated files with the present tables: the differing lines, and the command that writes each file."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import rig
from drivers.can import dbc

MAX_LINES = 3
"""Missing lines shown, and surplus lines shown; in a shifted table all lines differ."""
MAX_CHARACTERS = 200
"""Characters shown of a line; the list of all kinds of faults is one line of 1,000."""


def missing_in_generated_files() -> Iterator[str]:
    """Yield a line for each generated file that is out of date, with the command and the first differing lines."""
    keys = Path(rig.__file__).with_name("KEYS.md")
    for name, path, arguments, command in (
        ("rig/KEYS.md", keys, ("keys", "--markdown"), "rig keys --markdown > rig/KEYS.md"),
        ("drivers/can/rig.dbc", dbc.COPY, ("can", "dbc"), "rig can dbc -o drivers/can/rig.dbc --force"),
    ):
        # Another process uses the rig's own channel table, not that of the tests.
        made = subprocess.run([sys.executable, "-m", "rig", *arguments], capture_output=True, check=True)
        text, committed = made.stdout.decode(), path.read_text(encoding="utf-8")
        if committed == text:
            continue
        old, new = committed.splitlines(), text.splitlines()
        lacking = [line[:MAX_CHARACTERS] for line in new if line not in old][:MAX_LINES]
        surplus = [line[:MAX_CHARACTERS] for line in old if line not in new][:MAX_LINES]
        shown = [*(f"lacks {line!r}" for line in lacking), *(f"has a surplus {line!r}" for line in surplus)]
        yield f"{name} is out of date, run `{command}`: it {'; it '.join(shown) or 'has another order'}"
