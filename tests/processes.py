"""Processes that a test starts and always ends, and addresses for them."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[1]
COMPILE_S = 600.0
"""Longest start with an empty cache: 35 s of processor time, thirty programs on two cores."""


def free_port() -> int:
    """Return an unused port of the loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def free_endpoint() -> str:
    """Return an unused address of the loopback."""
    return f"127.0.0.1:{free_port()}"


@contextmanager
def start_python(*arguments: str, **settings: Any) -> Iterator[subprocess.Popen[str]]:
    """Start a Python process in the tree's root, with both outputs as pipes unless the settings differ."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    usual = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": environment, "cwd": ROOT}
    chosen: dict[str, Any] = {**usual, **settings}
    with subprocess.Popen([sys.executable, *arguments], text=True, **chosen) as child:
        try:
            yield child
        finally:
            child.kill()


def start_rig(*arguments: str, **settings: Any) -> Any:
    """Start a command of `rig` as a process."""
    return start_python("-m", "rig", *arguments, **settings)


@contextmanager
def running_rig(scene: str, *arguments: str, says: str = "") -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start `rig run` for a day, wait until it listens, and stop it at the end.

    Args:
        scene: Name of the scene.
        *arguments: Options.
        says: Text of a line that it must print before it listens.

    Yields:
        The process and its address.
    """
    endpoint = free_endpoint()
    with start_rig("run", scene, "--listen", endpoint, "--duration-s", "86400", *arguments) as child:
        for words in filter(None, (says, "listening on")):  # then it is compiled and connected to its CAN bus
            read_line(child, words)
        yield child, endpoint
        child.terminate()
        child.communicate(timeout=PATIENCE_S)


def read_line(child: subprocess.Popen[str], words: str) -> str:
    """Return the first line with these words from its error output, or from its only output.

    Raises:
        AssertionError: It ended without such a line; the message contains its output.
    """
    pipe = child.stderr or child.stdout
    assert pipe is not None
    printed = []
    for line in pipe:
        printed.append(line)
        if words in line:
            return line
    raise AssertionError(f"it ended with status {child.wait()} and without {words!r}:\n{''.join(printed)}")
