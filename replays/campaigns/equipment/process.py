"""A program that a test starts, under a keeper that ends it with the test, whatever becomes of that."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from rig.base.errors import DiskError
from rig.serve.waiting import Deadline

_KEEPER = Path(__file__).with_name("cleanup.py")


class Program:
    """A program that runs; its output goes to a file.

    Args:
        command: Its words.
        log: The file.
        folder: Where it works.
    """

    def __init__(self, command: Sequence[str], log: Path, *, folder: Path | None = None) -> None:
        self.command, self.log = list(command), log
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
        environment = {**os.environ, "PATH": path, "PYTHONUNBUFFERED": "1"}
        try:
            with log.open("wb") as output:
                self._kept = subprocess.Popen(
                    [sys.executable, "-I", "-S", str(_KEEPER), *self.command],
                    stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT, cwd=folder, env=environment,
                    start_new_session=True,  # Ctrl-C is the test's, which ends one thing after the other
                )  # fmt: skip
        except OSError as error:
            raise DiskError(f"{self.command[0]} could not be started: {error}") from None

    @property
    def status(self) -> int | None:
        """Its exit status, 128 and the signal's number where one has ended it; None while it runs."""
        return self._kept.poll()

    def said(self) -> str:
        """What it has printed so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    @property
    def last_line(self) -> str:
        """The last line that it has printed."""
        return next((line for line in reversed(self.said().splitlines()) if line.strip()), "nothing")

    def wait(self, timeout_s: float) -> int | None:
        """Its exit status once it has ended; None where it has not."""
        try:
            return self._kept.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def wait_for(self, words: str, timeout_s: float) -> str | None:
        """The line with these words, once it is printed; None where it ends before, or does not print it."""
        for _ in Deadline(timeout_s).polls():
            ended = self.status is not None
            for line in self.said().splitlines(keepends=True):
                if words in line and line.endswith("\n"):
                    return line.strip()
            if ended:
                return None
        return None

    def kill(self) -> None:
        """Kill it, as a power cut would, and wait until it is gone."""
        assert self._kept.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended already
            self._kept.stdin.write(b"kill")
            self._kept.stdin.flush()
        self._kept.wait()

    def end(self) -> None:
        """End it: first by SIGTERM, and at the latest after some seconds."""
        assert self._kept.stdin is not None
        self._kept.stdin.close()
        self._kept.wait()
