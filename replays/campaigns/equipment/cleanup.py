"""Runs a program, and ends it with all that it has started when its own input ends: with whoever started both.

What comes in before that kills it at once. A program of its own, `python cleanup.py PROGRAM ...`, of the standard
library alone: a test run that is killed leaves nothing running.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

PATIENCE_S = 5.0
"""How long a program may take to end by itself [s]."""
KILLED = 128 + signal.SIGKILL
"""Exit status of one that did not."""


def keep(command: list[str]) -> int:
    """Run a program in a session of its own; returns its exit status, as a shell would."""
    try:
        child = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
    except OSError as error:
        print(f"{command[0]}: {error.strerror}", file=sys.stderr)
        return 127
    threading.Thread(target=_watch, args=(child,), daemon=True).start()
    status = child.wait()
    _signal(child.pid, signal.SIGKILL)  # what it has left behind
    return status if status >= 0 else 128 - status


def _watch(child: subprocess.Popen[bytes]) -> None:
    while os.read(0, 4096):  # not through Python's own buffer, whose lock nobody could take at the end
        _signal(child.pid, signal.SIGKILL)
    _signal(child.pid, signal.SIGTERM)
    try:
        child.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        _signal(child.pid, signal.SIGKILL)


def _signal(group: int, number: int) -> None:
    try:
        os.killpg(group, number)
    except (ProcessLookupError, PermissionError):
        return


if __name__ == "__main__":
    sys.exit(keep(sys.argv[1:]))
