"""A recording of a bench, made beside the test."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING

from replays.campaigns.equipment.bench import BenchError
from rig.serve.waiting import Deadline, wait_until

if TYPE_CHECKING:
    from recorder.contents.summary import Progress, Summary
    from recorder.reader import Recording
    from recorder.session import RecordingSession
    from replays.campaigns.equipment.bench import Bench

_BEGIN_S, _END_S = 30.0, 60.0
"""Longest that a recording takes to begin, and to end [s]."""


class Record:
    """Records a bench from now on, or from the start of its run where the bench is the test's own.

    Args:
        bench: The bench.
        path: The file, ends in .mcap.
    """

    def __init__(self, bench: Bench, path: Path) -> None:
        from recorder.session import RecordingSession
        from rig.serve.transport.zenoh import client_of

        self.path, self._bench = path, bench
        self._client = client_of(bench.url, wait_s=_BEGIN_S)
        own = bench.target.own
        # Plots are made of the evidence alone, so none are kept of the whole.
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
            self._summary = self._session.run(self._tell)
        except BaseException as error:  # told by whoever waits for the recording
            self._error = error
        finally:
            self._client.close()

    def _tell(self, progress: Progress) -> None:
        self._progress = progress

    def wait_until_there(self) -> None:
        """Wait until it listens.

        Raises:
            BenchError: It does not.
        """
        for _ in Deadline(_BEGIN_S).polls():
            if "campaign" in self._bench.status()["clients"]:
                return
            if not self._thread.is_alive():
                break
        raise BenchError(f"nothing is recorded: {self._error or 'the rig does not hear of it'}")

    def stop(self) -> Recording:
        """End it, and open what was recorded; rows that the rig has sent are waited for.

        Raises:
            BenchError: Rows are missing that no fault took, or the disk refused.
        """
        from recorder.reader import Recording

        if self._summary is None and self._error is None:
            self._wait_for_the_rest()
            self._session.stop("the test's end")
            self._thread.join(_END_S)
        summary = self._summary
        if summary is None:
            raise BenchError(f"the recording failed: {self._error or 'it did not end'}")
        if summary.error or summary.losses:
            raise BenchError(f"the recording lacks {'; '.join(summary.losses) or summary.error}")
        return Recording.open(self.path)

    def wait(self) -> None:
        """Wait until it has ended by itself, with the rig's run."""
        self._thread.join(_END_S)

    def _wait_for_the_rest(self) -> None:
        """Wait for what a rig in lockstep has published: it is done with the step before its rows are here."""
        if self._bench.pace != "lockstep" or not self._thread.is_alive():
            return
        time_s = self._bench.status()["time_s"]

        def all_here() -> bool:
            return self._progress is not None and self._progress.time_s >= time_s - _LAST_S

        if time_s > 0.0:
            wait_until(lambda: all_here() or not self._thread.is_alive(), 5.0)


_LAST_S = 2e-3
"""No stream has rows further apart than this [s]."""
