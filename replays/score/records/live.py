"""Recording of a DAQ under test while the rig runs: a limited stretch of its rows, and the rig's samples.

Both are written to files of a folder and are judged as any other files. The arrival times of rows, which files do not
have, are measured in this process for the DAQ, and in the recorded session for the rig, both by this computer's clock.
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
from rig.base.files import open_output
from rig.serve.waiting import Deadline

if TYPE_CHECKING:
    from recorder.contents.summary import Progress
    from rig.serve.transport import Client

MIN_STRETCH_S, MAX_STRETCH_S = 2.0, 600.0
"""Limits of the length of a stretch [s]."""
MAX_BYTES = 4 << 30
"""Largest size of the DAQ's rows on disk, at which the stretch ends."""
PATIENCE_S = 30.0
"""Timeout for the first row [s]."""
_READ = 1 << 16
_LOOK_S = 0.05
_MARGIN_S = 0.5
"""Time by which the rig is recorded longer than the DAQ, and the DAQ is read longer than a rig that ends [s]."""
_FLOOR_LINES, _FLOOR_STEP_S = 100, 2e-3


@dataclass(frozen=True)
class Arrivals:
    """Arrival times of rows.

    Attributes:
        rows: Number of rows received by each arrival, shape (n,).
        unix_s: Time of each arrival [unix s], shape (n,).
        floor_s: Latency of a line through a pipe of this computer, 95 % quantile [s].
    """

    rows: np.ndarray
    unix_s: np.ndarray
    floor_s: float

    def since_s(self, numbers: np.ndarray) -> np.ndarray:
        """Return the arrival times of rows by their numbers from 0, after the first arrival [s], shape (n,)."""
        at = np.searchsorted(self.rows, numbers, side="right")
        return self.unix_s[np.minimum(at, len(self.rows) - 1)] - self.unix_s[0]


@dataclass(frozen=True)
class Delivered:
    """Files and arrival times of a stretch.

    Attributes:
        file: The DAQ's lines.
        session: The rig's samples.
        arrivals: Arrival times of the lines.
        remarks: Remarks for the scorecard.
    """

    file: Path
    session: Path
    arrivals: Arrivals
    remarks: tuple[str, ...]


class Lines:
    """Recorder of lines from a pipe with their arrival times; it reads on afterwards, so that no writer blocks."""

    def __init__(self, source: int, path: Path) -> None:
        """Start a thread that reads from a file descriptor and writes to a file."""
        self.count, self.size, self.ended = 0, 0, False
        self._source, self._path = source, path
        self._counts, self._unix_s = array("q"), array("d")
        self._whole = 0
        self._file, self._lock = open_output(path, "wb"), threading.Lock()
        threading.Thread(target=self._read, name="rows of the DAQ", daemon=True).start()

    def _read(self) -> None:
        while data := os.read(self._source, _READ):
            now_s = time.time()
            with self._lock:
                if self._file.closed:
                    continue
                self._write(data, now_s)
        with self._lock:
            if not self._file.closed and self.size > self._whole:  # a last line without a line end counts
                self._write(b"\n", time.time())
        self.ended = True

    def _write(self, data: bytes, now_s: float) -> None:
        self._file.write(data)
        if lines := data.count(b"\n"):
            self._whole = self.size + data.rindex(b"\n") + 1
            self.count += lines
            self._counts.append(self.count)
            self._unix_s.append(now_s)
        self.size += len(data)

    def close(self) -> tuple[np.ndarray, np.ndarray]:
        """Close the file after its last whole line; return the number of lines by each arrival, and its time."""
        with self._lock:
            self._file.close()
        os.truncate(self._path, self._whole)
        return np.array(self._counts), np.array(self._unix_s)


def _measure_floor_s(folder: Path) -> float:
    """Return the latency of a line through a pipe of this computer, 95 % quantile [s]."""
    read, write = os.pipe()
    lines, written_s = Lines(read, folder / "floor.csv"), []
    for _ in range(_FLOOR_LINES):
        written_s.append(time.time())
        os.write(write, b"0\n")
        time.sleep(_FLOOR_STEP_S)
    os.close(write)
    while not lines.ended:
        time.sleep(_LOOK_S)
    arrivals = Arrivals(*lines.close(), 0.0)
    os.close(read)
    return float(np.quantile(arrivals.since_s(np.arange(_FLOOR_LINES)) + arrivals.unix_s[0] - written_s, 0.95))


def collect(
    client: Client, source: int, folder: Path, for_s: float, *, stopped: threading.Event,
    report: Callable[[float, str], None],
) -> Delivered:  # fmt: skip
    """Record the CSV lines that a DAQ delivers, and what the rig sends meanwhile.

    Args:
        client: Connection to the rig; the caller closes it.
        source: File descriptor from which the lines are read.
        folder: Folder for both files.
        for_s: Length of the stretch from the first line [s].
        stopped: Event that ends the stretch early.
        report: Function that is called with the elapsed part, 0 to 1, and the number of lines.

    Raises:
        InputError: No line arrives.
        RefusedError: The rig cannot be recorded.
        NoReplyError: No rig replies.
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
        except BaseException as error:  # raised again by the caller
            errors.append(error)
        begun.set()

    recording = threading.Thread(target=record, name="what the rig sends", daemon=True)
    recording.start()
    try:
        floor_s = _measure_floor_s(folder)
        begun.wait(2.0)  # a rig in lockstep may wait for the DAQ
        lines = Lines(source, folder / "standard-input.csv")
        why = _wait_for_end(lines, recording, for_s, stopped, report)
        counts, unix_s = lines.close()
        stopped.wait(_MARGIN_S)
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
        *((f"{lost} rows of the rig were lost in transmission: they count as foreign",) if lost else ()),
    )
    return Delivered(folder / "standard-input.csv", session.path, Arrivals(counts, unix_s, floor_s), remarks)


def _wait_for_end(
    lines: Lines, recording: threading.Thread, for_s: float, stopped: threading.Event,
    report: Callable[[float, str], None],
) -> str:  # fmt: skip
    """Wait for the end of the stretch; return its reason."""
    due, first, rest = Deadline(PATIENCE_S), False, None
    while True:
        if not first and lines.count:
            first, due = True, Deadline(for_s)
        if stopped.is_set():
            return "until it was interrupted"
        if lines.ended:
            return "to the DAQ's end"
        if lines.size > MAX_BYTES:
            return f"until they took {MAX_BYTES / 1e9:.0f} GB"
        rest = Deadline(_MARGIN_S) if rest is None and not recording.is_alive() else rest
        if rest is not None and rest.passed:
            return "to the end of the rig's run"
        if due.passed:
            return "all of the stretch" if first else f"in {PATIENCE_S:g} s"
        report(1.0 - due.left_s / for_s if first else 0.0, f"{lines.count} lines")
        stopped.wait(_LOOK_S)
