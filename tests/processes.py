"""Processes that a test starts, ended for certain, and addresses for them."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
COMPILE_S = 240.0
"""Longest that a start takes where nothing is compiled yet."""


def free_port() -> int:
    """A port of the loopback that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def free_endpoint() -> str:
    """An address of the loopback that nobody listens at."""
    return f"127.0.0.1:{free_port()}"


@contextmanager
def python(*arguments: str, **settings: Any) -> Iterator[subprocess.Popen[str]]:
    """A Python process in the tree's root, both of its outputs as pipes unless the settings say else."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    usual = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": environment, "cwd": ROOT}
    chosen: dict[str, Any] = {**usual, **settings}
    with subprocess.Popen([sys.executable, *arguments], text=True, **chosen) as child:
        try:
            yield child
        finally:
            child.kill()


def rig(*arguments: str, **settings: Any) -> Any:
    """A command of `rig` as a process."""
    return python("-m", "rig", *arguments, **settings)


def line_of(child: subprocess.Popen[str], words: str) -> str:
    """The first line of its error output with these words in it."""
    assert child.stderr is not None
    for line in child.stderr:
        if words in line:
            return line
    raise AssertionError(f"it ended without {words!r}")
