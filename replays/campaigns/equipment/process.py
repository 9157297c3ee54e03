"""Program started by a test, under a supervisor that ends it together with the test process."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from rig.base.errors import DiskError
from rig.serve.waiting import Deadline

_SUPERVISOR = Path(__file__).with_name("cleanup.py")


class Program:
    """A running program whose output is written to a file.

    Args:
        command: Words of the command line.
        log: Output file.
        folder: Working directory.
    """

    def __init__(self, command: Sequence[str], log: Path, *, folder: Path | None = None) -> None:
        self.command, self.log = list(command), log
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
        environment = {**os.environ, "PATH": path, "PYTHONUNBUFFERED": "1"}
        try:
            with log.open("wb") as output:
                self._supervisor = subprocess.Popen(
                    [sys.executable, "-I", "-S", str(_SUPERVISOR), *self.command],
                    stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT, cwd=folder, env=environment,
                    start_new_session=True,  # Ctrl-C is sent to the test only, which ends its programs in order
                )  # fmt: skip
        except OSError as error:
            raise DiskError(f"{self.command[0]} could not be started: {error}") from None

    @property
    def status(self) -> int | None:
        """Exit status (128 plus the signal number if killed), or None while it runs."""
        return self._supervisor.poll()

    def read_output(self) -> str:
        """Return the output printed until now."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    @property
    def last_line(self) -> str:
        """Last line of the output."""
        return next((line for line in reversed(self.read_output().splitlines()) if line.strip()), "nothing")

    def wait(self, timeout_s: float) -> int | None:
        """Wait for the end of the program; return its exit status, or None if it still runs."""
        try:
            return self._supervisor.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def wait_for(self, words: str, timeout_s: float) -> str | None:
        """Wait for a line that contains `words` and return it, or None if the program ends or the time runs out."""
        for _ in Deadline(timeout_s).polls():
            ended = self.status is not None
            for line in self.read_output().splitlines(keepends=True):
                if words in line and line.endswith("\n"):
                    return line.strip()
            if ended:
                return None
        return None

    def kill(self) -> None:
        """Terminate the program without a grace period, like a power cut, and wait until it has ended."""
        assert self._supervisor.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended
            self._supervisor.stdin.write(b"kill")
            self._supervisor.stdin.flush()
        self._supervisor.wait()

    def end(self) -> None:
        """End the program by SIGTERM, or by SIGKILL after a few seconds."""
        assert self._supervisor.stdin is not None
        self._supervisor.stdin.close()
        self._supervisor.wait()
