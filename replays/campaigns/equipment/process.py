"""Program started by a test, under a supervisor that ends it together with the test process."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import uuid
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path

from replays.campaigns.equipment.cleanup import END_S, OUTPUT_BYTES
from rig.base.errors import DiskError
from rig.serve.waiting import Deadline

_SUPERVISOR = Path(__file__).with_name("cleanup.py")
_TAIL_BYTES = 1 << 16
"""Part of the output that is searched for its last line [bytes]."""
_SUPERVISOR_S = 10.0
"""Longest time for the supervisor to end after its program was killed [s]."""
_MARKER = "RIG_SUPERVISED"
"""Environment variable that marks the processes of a program."""


class Program:
    """A running program whose output is written to a file.

    Args:
        command: Words of the command line.
        log: Output file.
        folder: Working directory.
        end_s: Time between SIGTERM and SIGKILL [s].
        output_bytes: Size of the output that is kept [bytes].

    Attributes:
        is_ended: True once the test has ended or killed the program.
        before_end: Function called before the test first ends or kills the program.
    """

    def __init__(
        self, command: Sequence[str], log: Path, *, folder: Path | None = None, end_s: float = END_S,
        output_bytes: int = OUTPUT_BYTES,
    ) -> None:  # fmt: skip
        self.command, self.log, self.is_ended = list(command), log, False
        self._end_s, self.max_output_bytes = end_s, output_bytes
        self.before_end: Callable[[], object] = lambda: None
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
        self._marker = f"{_MARKER}={uuid.uuid4().hex}"
        environment = {**os.environ, "PATH": path, "PYTHONUNBUFFERED": "1", _MARKER: self._marker.partition("=")[2]}
        try:
            # Read through this descriptor: the program may replace the file.
            self._output = os.open(log, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
            weakref.finalize(self, os.close, self._output)
            self._supervisor = subprocess.Popen(
                [sys.executable, "-I", "-S", str(_SUPERVISOR), str(output_bytes), str(end_s), *self.command],
                bufsize=0, stdin=subprocess.PIPE, stdout=self._output, stderr=subprocess.STDOUT, cwd=folder,
                env=environment,
                start_new_session=True,  # Ctrl-C is sent to the test only, which ends its programs in order
            )  # fmt: skip
        except OSError as error:
            raise DiskError(f"{self.command[0]} could not be started: {error}") from None

    @property
    def status(self) -> int | None:
        """Exit status (128 plus the signal number if killed), or None while it runs."""
        status = self._supervisor.poll()
        return status if status is None or status >= 0 else 128 - status

    @property
    def output_bytes(self) -> int:
        """Size of the output until now [bytes]; above the limit if some was dropped."""
        return os.fstat(self._output).st_size

    @property
    def is_output_cut(self) -> bool:
        """Whether output beyond the limit was dropped."""
        return self.output_bytes > self.max_output_bytes

    def read_output(self) -> str:
        """Return the output printed until now."""
        return os.pread(self._output, self.output_bytes, 0).decode(errors="replace")

    @property
    def last_line(self) -> str:
        """Last line of the output."""
        tail = os.pread(self._output, _TAIL_BYTES, max(0, self.output_bytes - _TAIL_BYTES))
        lines = tail.decode(errors="replace").splitlines()
        return next((line for line in reversed(lines) if line.strip()), "nothing")

    def wait(self, timeout_s: float) -> int | None:
        """Wait for the end of the program; return its exit status, or None if it still runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._supervisor.wait(timeout_s)
        return self.status

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
        self._note_end()
        with contextlib.suppress(BrokenPipeError):  # it has ended
            self._supervisor.stdin.write(b"kill")
            self._supervisor.stdin.flush()
        self._wait_for_supervisor()

    def end(self) -> None:
        """End the program by SIGTERM, or by SIGKILL after a few seconds."""
        assert self._supervisor.stdin is not None
        self._note_end()
        with contextlib.suppress(BrokenPipeError):
            self._supervisor.stdin.close()
        self._wait_for_supervisor()

    def _note_end(self) -> None:
        if not self.is_ended:
            self.before_end()
        self.is_ended = True

    def _wait_for_supervisor(self) -> None:
        """Wait for the end of the supervisor, which the program may have stopped or killed."""
        try:
            self._supervisor.wait(self._end_s + _SUPERVISOR_S)
        except subprocess.TimeoutExpired:
            self._supervisor.kill()
            self._supervisor.wait()
        if self._supervisor.returncode < 0:
            self._kill_marked()

    def _kill_marked(self) -> None:
        """Terminate what remains of a program whose supervisor was killed, where /proc shows environments."""
        # Three times, because a process may have started another one meanwhile.
        for folder in (each for _ in range(3) for each in Path("/proc").glob("[0-9]*")):
            with contextlib.suppress(OSError):
                if self._marker.encode() in (folder / "environ").read_bytes().split(b"\0"):
                    os.kill(int(folder.name), signal.SIGKILL)
