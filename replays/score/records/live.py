"""A DAQ under test that delivers while the rig runs: a bounded stretch of its rows, and beside it what the rig sends.

Both lie in files of a folder then, which are judged as any others. What files do not have is when each row came: of
the DAQ here, of the rig in its session, both by this computer's clock and in this process.
"""

from __future__ import annotations

import os
import threading
import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rig.base.errors import InputError, RefusedError, Words
from rig.serve.waiting import Deadline

if TYPE_CHECKING:
    from recorder.contents.summary import Progress
    from rig.serve.transport import Client

SHORTEST_S, LONGEST_S = 2.0, 600.0
"""Of a stretch [s], ..."""
MOST_BYTES = 4 << 30
"""... and what the DAQ's rows may take of the disk; there the stretch ends."""
PATIENCE_S = 30.0
"""How long the first row may take [s]."""
_READ = 1 << 16
_LOOK_S = 0.05
_BEHIND_S = 0.5
"""So much longer the rig is recorded than the DAQ, and the DAQ is read than a rig that ends [s]."""
_FLOOR_LINES, _FLOOR_STEP_S = 100, 2e-3


@dataclass(frozen=True)
class Arrivals:
    """When rows came.

    Attributes:
        rows: How many had come, each time that some did, shape (n,).
        unix_s: When that was [unix s], shape (n,).
        floor_s: What a line took through a pipe of this computer to here, in 95 of 100 [s].
    """

    rows: np.ndarray
    unix_s: np.ndarray
    floor_s: float

    def since_s(self, numbers: np.ndarray) -> np.ndarray:
        """When rows came by their numbers from 0, from the first time on [s], shape (n,)."""
        at = np.searchsorted(self.rows, numbers, side="right")
        return self.unix_s[np.minimum(at, len(self.rows) - 1)] - self.unix_s[0]


@dataclass(frozen=True)
class Delivered:
    """What came in a stretch.

    Attributes:
        file: The DAQ's lines.
        session: What the rig sent.
        arrivals: When the lines came.
        remarks: What else is to be known of it.
    """

    file: Path
    session: Path
    arrivals: Arrivals
    remarks: tuple[str, ...]


class Lines:
    """Takes down what is written into a pipe, and when each line came; reads on beyond, so that nobody is held up."""

    def __init__(self, source: int, path: Path) -> None:
        """Read from a file descriptor into a file, from now on, on a thread of its own."""
        self.count, self.size, self.ended = 0, 0, False
        self._source, self._path = source, path
        self._counts, self._unix_s = array("q"), array("d")
        self._whole = 0
        self._file, self._lock = path.open("wb"), threading.Lock()
        threading.Thread(target=self._read, name="rows of the DAQ", daemon=True).start()

    def _read(self) -> None:
        while data := os.read(self._source, _READ):
            now_s = time.time()
            with self._lock:
                if self._file.closed:
                    continue
                self._take(data, now_s)
        with self._lock:
            if not self._file.closed and self.size > self._whole:  # a last line without an end is one
                self._take(b"\n", time.time())
        self.ended = True

    def _take(self, data: bytes, now_s: float) -> None:
        self._file.write(data)
        if lines := data.count(b"\n"):
            self._whole = self.size + data.rindex(b"\n") + 1
            self.count += lines
            self._counts.append(self.count)
            self._unix_s.append(now_s)
        self.size += len(data)

    def close(self) -> tuple[np.ndarray, np.ndarray]:
        """Keep the whole lines; how many there were each time that some came, and when that was, each shape (n,)."""
        with self._lock:
            self._file.close()
        os.truncate(self._path, self._whole)
        return np.array(self._counts), np.array(self._unix_s)


def _floor_s(folder: Path) -> float:
    """What a line takes through a pipe to here, in 95 of 100 [s]."""
    read, write = os.pipe()
    lines, written_s = Lines(read, folder / "floor.csv"), []
    for _ in range(_FLOOR_LINES):
        written_s.append(time.time())
        os.write(write, b"0\n")
        time.sleep(_FLOOR_STEP_S)
    os.close(write)
    while not lines.ended:
        time.sleep(_LOOK_S)
    found = Arrivals(*lines.close(), 0.0)
    os.close(read)
    return float(np.quantile(found.since_s(np.arange(_FLOOR_LINES)) + found.unix_s[0] - written_s, 0.95))


def collect(
    client: Client, source: int, folder: Path, for_s: float, *, stopped: threading.Event,
    tell: Callable[[float, str], None],
) -> Delivered:  # fmt: skip
    """Take down what a DAQ delivers as lines of CSV, and what the rig sends meanwhile.

    Args:
        client: Connection to the rig; remains the caller's to close.
        source: File descriptor from which the lines come.
        folder: Where both are written.
        for_s: How long, from the first line on [s].
        stopped: Ends it before.
        tell: Told how much of it is over, 0 to 1, and what has come.

    Raises:
        InputError: No line comes.
        RefusedError: The rig cannot be recorded.
        NoReplyError: No rig answers.
    """
    from recorder.session import RecordingSession

    session = RecordingSession(client, folder / "rig.mcap", name=f"score-{os.getpid()}", view_rate_hz=0.0)
    begun, summaries, errors = threading.Event(), [], []

    def watch(progress: Progress) -> None:
        if progress.rows:
            begun.set()

    def record() -> None:
        try:
            summaries.append(session.run(watch))
        except BaseException as error:  # raised anew where it is waited for
            errors.append(error)
        begun.set()

    recording = threading.Thread(target=record, name="what the rig sends", daemon=True)
    recording.start()
    try:
        floor_s = _floor_s(folder)
        begun.wait(2.0)  # a rig in lockstep may wait for the DAQ
        lines = Lines(source, folder / "standard-input.csv")
        why = _watch(lines, recording, for_s, stopped, tell)
        counts, unix_s = lines.close()
        stopped.wait(_BEHIND_S)
    finally:
        session.stop()
        recording.join()
    if errors:
        raise errors[0]
    if summaries[0].error:
        raise RefusedError(summaries[0].error)
    if not lines.count:
        raise InputError("FILE", "lines of CSV on standard input", Words(f"none, {why}"))
    lost = sum(summaries[0].lost.values())
    remarks = (
        f"live: {lines.count} lines in {unix_s[-1] - unix_s[0]:.1f} s, {why}",
        *((f"{lost} rows of the rig were lost on the way to here: the DAQ's are foreign ones",) if lost else ()),
    )
    return Delivered(folder / "standard-input.csv", session.path, Arrivals(counts, unix_s, floor_s), remarks)


def _watch(
    lines: Lines, recording: threading.Thread, for_s: float, stopped: threading.Event,
    tell: Callable[[float, str], None],
) -> str:  # fmt: skip
    """Wait for the end of the stretch; why that was."""
    due, first, rest = Deadline(PATIENCE_S), False, None
    while True:
        if not first and lines.count:
            first, due = True, Deadline(for_s)
        if stopped.is_set():
            return "until it was interrupted"
        if lines.ended:
            return "to the DAQ's end"
        if lines.size > MOST_BYTES:
            return f"until they took {MOST_BYTES / 1e9:.0f} GB"
        rest = Deadline(_BEHIND_S) if rest is None and not recording.is_alive() else rest
        if rest is not None and rest.passed:
            return "to the end of the rig's run"
        if due.passed:
            return "all of the stretch" if first else f"in {PATIENCE_S:g} s"
        tell(1.0 - due.left_s / for_s if first else 0.0, f"{lines.count} lines")
        stopped.wait(_LOOK_S)
