"""Program that runs a test's child process and ends all of its processes when standard input closes.

Usage: `python cleanup.py OUTPUT_BYTES END_S PROGRAM ...`. Standard input closes when the test process ends, however it
ends, so a killed test run leaves nothing running. Any byte on standard input kills the processes at once. On Linux this
program is a subreaper, so that it also finds descendants in a session of their own; elsewhere it finds the process
group only. It copies the program's output up to a number of bytes. Uses the standard library only.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

END_S = 5.0
"""Default time between SIGTERM and SIGKILL [s]."""
OUTPUT_BYTES = 100_000_000
"""Default size of the output that is kept [bytes]."""
KILLED = 128 + signal.SIGKILL
"""Exit status of a program that had to be killed."""
_SET_SUBREAPER, _GET_SUBREAPER = 36, 37
"""Options of prctl, from linux/prctl.h."""
_DRAIN_S = 2.0
"""Longest wait for the last output, which an escaped descendant may hold open [s]."""
_ATTEMPTS, _PAUSE_S = 1000, 0.002
"""Number of times that descendants are searched, as each may start another, and pause between them [s]."""


def find_containment() -> str:
    """Return how descendants of a program are found: "subreaper" or "process group"."""
    return "subreaper" if _call_prctl(_GET_SUBREAPER, ctypes.byref(ctypes.c_int())) else "process group"


def _call_prctl(option: int, argument: object) -> bool:
    return sys.platform == "linux" and ctypes.CDLL(None).prctl(option, argument, 0, 0, 0) == 0


def supervise(output_bytes: int, end_s: float, command: list[str]) -> int:
    """Run a program in its own session and return its exit status as a shell reports it."""
    _call_prctl(_SET_SUBREAPER, 1)
    try:
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
        )
    except OSError as error:
        print(f"{command[0]}: {error.strerror}", file=sys.stderr)
        return 127
    copier = threading.Thread(target=_copy_output, args=(child, output_bytes), daemon=True)
    copier.start()
    threading.Thread(target=_watch, args=(child, end_s), daemon=True).start()
    status = child.wait()
    _kill_all(child.pid)
    copier.join(_DRAIN_S)
    return status if status >= 0 else 128 - status


def _copy_output(child: subprocess.Popen[bytes], left: int) -> None:
    assert child.stdout is not None
    while data := os.read(child.stdout.fileno(), 1 << 16):
        while kept := data[: max(left, 0)]:
            written = os.write(1, kept)
            data, left = data[written:], left - written
        left -= len(data)  # output beyond the limit is read, so that the program does not wait, and dropped
    if left < 0:
        os.write(1, f"\n{-left} more bytes of output were dropped\n".encode())


def _watch(child: subprocess.Popen[bytes], end_s: float) -> None:
    while os.read(0, 4096):  # sys.stdin's lock might be held by this thread at exit
        _signal(child.pid, signal.SIGKILL)
    _signal(child.pid, signal.SIGTERM)
    with contextlib.suppress(subprocess.TimeoutExpired):
        child.wait(end_s)
        return
    _signal(child.pid, signal.SIGKILL)


def _kill_all(group: int) -> None:
    """Terminate the remaining processes of a group and, for a subreaper, all remaining descendants."""
    _signal(group, signal.SIGKILL)
    for _ in range(_ATTEMPTS):
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        for pid in find_children(os.getpid()):  # children of a killed process become children of the subreaper
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(_PAUSE_S)


def find_children(parent: int) -> list[int]:
    """Return the process numbers of a process's children, where the system lists processes in /proc."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, IndexError):
            if int((folder / "stat").read_bytes().rpartition(b")")[2].split()[1]) == parent:
                found.append(int(folder.name))
    return found


def _signal(group: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(group, number)


if __name__ == "__main__":
    sys.exit(supervise(int(sys.argv[1]), float(sys.argv[2]), sys.argv[3:]))
