"""Recording of a bench during a test."""

from __future__ import annotations

import hashlib
import os
import sys
import threading
import weakref
from pathlib import Path, PosixPath
from typing import TYPE_CHECKING

from replays.campaigns.equipment.bench import BenchError
from rig.base.files import PART_SUFFIX
from rig.base.outcome import InconclusiveError
from rig.serve.waiting import Deadline, wait_until

if TYPE_CHECKING:
    from recorder.contents.summary import Progress, Summary
    from recorder.reader import Recording
    from recorder.session import RecordingSession
    from replays.campaigns.equipment.bench import Bench

_BEGIN_S, _END_S = 30.0, 60.0
"""Longest start and longest end of a recording [s]."""


class ReplacedRecordingError(BenchError, InconclusiveError):
    """Error of a recording that is not the one that was written, and cannot be judged."""


class _OpenPath(PosixPath):
    """Path of a file that is opened through a descriptor, so that a file put in its place is not read."""

    opened = ""

    def __fspath__(self) -> str:
        return self.opened or str(self)


class Record:
    """Records a bench: from the start of the run if the test started the rig, otherwise from now on.

    Args:
        bench: The bench.
        path: Output file, ending in .mcap, in a folder that no device under test is told.
    """

    def __init__(self, bench: Bench, path: Path) -> None:
        from recorder.session import RecordingSession
        from rig.serve.transport.zenoh import connect_url

        self.path, self._bench = path, bench
        self._client = connect_url(bench.url, wait_s=_BEGIN_S)
        own = bench.target.owns_rig
        # Plots come from the evidence, so the whole recording needs no data for views.
        self._session: RecordingSession = RecordingSession(
            self._client, path, name="campaign", view_rate_hz=0.0, history=own, force=True
        )
        self._summary: Summary | None = None
        self._error: BaseException | None = None
        self._progress: Progress | None = None
        self._thread = threading.Thread(target=self._run, name="campaign-recorder", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._summary = self._session.run(self._update_progress)
        except BaseException as error:  # reported by `stop` and `wait_until_there`
            self._error = error
        finally:
            self._client.close()

    def _update_progress(self, progress: Progress) -> None:
        self._progress = progress

    def wait_until_connected(self) -> None:
        """Wait until the recorder is connected.

        Raises:
            BenchError: If it does not connect.
        """
        for _ in Deadline(_BEGIN_S).polls():
            if "campaign" in self._bench.status()["clients"]:
                # No device has been started yet.
                self._descriptor = os.open(self.path.with_name(self.path.name + PART_SUFFIX), os.O_RDONLY)
                weakref.finalize(self, os.close, self._descriptor)
                return
            if not self._thread.is_alive():
                break
        raise BenchError(f"the recording did not start: {self._error or 'the rig does not list the recorder'}")

    def stop(self) -> Recording:
        """Stop recording after all published samples have arrived, and open the recording.

        Raises:
            BenchError: If samples are missing that no fault removed, or the disk failed.
            ReplacedRecordingError: If the file was removed, replaced or altered.
        """
        from recorder.reader import Recording

        if self._summary is None and self._error is None:
            self._wait_for_samples()
            self._session.stop("the test's end")
            self._thread.join(_END_S)
        summary = self._summary
        if summary is None:
            raise BenchError(f"the recording failed: {self._error or 'it did not end'}")
        self._check_file(summary)
        if summary.error or summary.losses:
            raise BenchError(f"the recording lacks {'; '.join(summary.losses) or summary.error}")
        path = _OpenPath(self.path)
        if sys.platform == "linux":
            path.opened = f"/proc/self/fd/{self._descriptor}"
        return Recording.open(path)

    def _check_file(self, summary: Summary) -> None:
        """Compare the file with the one that was opened before any device started.

        Raises:
            ReplacedRecordingError: If inode, size or digest differ.
        """
        from recorder.files.unfinished_file import ALTERED

        opened = os.fstat(self._descriptor)
        wrong = ""
        try:
            named = summary.path.lstat()
            if not os.path.samestat(named, opened):
                wrong = "another file has its name"
        except OSError:
            wrong = "it was removed"
        if not wrong and not summary.error:
            digest, position = hashlib.sha256(), 0
            while data := os.pread(self._descriptor, 1 << 20, position):
                digest.update(data)
                position += len(data)
            if position != summary.size_bytes or digest.hexdigest() != summary.sha256:
                wrong = f"its {position} bytes are not the {summary.size_bytes} bytes that were written"
        elif not wrong and ALTERED in summary.error:
            wrong = "it was truncated or appended to, or its records cannot be read"
        if wrong:
            raise ReplacedRecordingError(f"the recording was replaced or altered during the test: {wrong}")

    @property
    def sha256(self) -> str:
        """Digest of the recording; empty while it is being written."""
        return "" if self._summary is None else self._summary.sha256

    def wait(self) -> None:
        """Wait until the recording has ended with the rig's run."""
        self._thread.join(_END_S)

    def _wait_for_samples(self) -> None:
        """Wait for the last published samples: a rig in lockstep completes a step before they arrive."""
        if self._bench.pace != "lockstep" or not self._thread.is_alive():
            return
        time_s = self._bench.status()["time_s"]

        def has_all_samples() -> bool:
            return self._progress is not None and self._progress.time_s >= time_s - _MAX_INTERVAL_S

        if time_s > 0.0:
            wait_until(lambda: has_all_samples() or not self._thread.is_alive(), 5.0)


_MAX_INTERVAL_S = 2e-3
"""Largest interval between two samples of any stream [s]."""
