"""Program that runs a test's child process and terminates its process group when standard input closes.

Usage: `python cleanup.py PROGRAM ...`. Standard input closes when the test process ends, however it ends, so a killed
test run leaves nothing running. Any byte on standard input kills the group at once. Uses the standard library only.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

PATIENCE_S = 5.0
"""Time between SIGTERM and SIGKILL [s]."""
KILLED = 128 + signal.SIGKILL
"""Exit status of a program that had to be killed."""


def supervise(command: list[str]) -> int:
    """Run a program in its own session and return its exit status as a shell reports it."""
    try:
        child = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
    except OSError as error:
        print(f"{command[0]}: {error.strerror}", file=sys.stderr)
        return 127
    threading.Thread(target=_watch, args=(child,), daemon=True).start()
    status = child.wait()
    _signal(child.pid, signal.SIGKILL)  # remaining processes of the group
    return status if status >= 0 else 128 - status


def _watch(child: subprocess.Popen[bytes]) -> None:
    while os.read(0, 4096):  # sys.stdin's lock might be held by this thread at exit
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
    sys.exit(supervise(sys.argv[1:]))
