"""Progress and outcome of a recording session."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Progress:
    """State of a session, for display.

    Attributes:
        time_s: Simulated time recorded since the first row [s].
        rows: Number of sensor rows received.
        lost: Number of rows lost, over all block streams.
        size_bytes: Size of the file [bytes].
        waiting: Payloads in the inbox.
        backlog_bytes: Size of the payloads in the inbox [bytes].
        dropped: Payloads dropped because the inbox was full.
        files: Number of finished files.
        remarks: Messages to the user, one line each; later ones are appended.
    """

    time_s: float
    rows: int
    lost: int
    size_bytes: int
    waiting: int
    backlog_bytes: int = 0
    dropped: int = 0
    files: int = 0
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Summary:
    """Outcome of a session.

    Attributes:
        path: The last file; the .part file if it could not be finished.
        reason: Reason for the end of the session.
        error: Disk or recorder error, or lack of disk space; empty without one.
        first_time_s: Simulated time of the first row in the files [s].
        duration_s: Simulated time from the first to the last row [s]; summed over captures.
        rows: Rows by key in the files on the disk.
        lost: Lost rows by key, only keys with losses; for captures including rows lost between them.
        declared: Rows that the rig reported as removed by a fault, by key; not among the lost.
        gaps: Number of gaps in the files.
        missed: Messages that the transport dropped, by key.
        dropped: Payloads dropped because the inbox was full; included in the lost rows.
        malformed: Payloads that do not fit the format of their key; they are recorded unchanged.
        size_bytes: Size of the files [bytes].
        sha256: Digest of the last finished file, as it was written; empty without one.
        files: All files in order, including a .part file that could not be finished.
        removed: Number of files removed to free disk space.
        high_water_bytes: Largest size of the inbox [bytes].
        received_s: Simulated time from the first to the last row received, recorded or not [s].
        fired: Number of triggers; None for a session without a trigger.
        remarks: Messages to the user, one line each.
        refused: Blocks left out because they cannot come from the rig.
        ended_early: Time up to which the session was recorded, if it is incomplete; otherwise empty.
    """

    path: Path
    reason: str
    error: str
    first_time_s: float
    duration_s: float
    rows: dict[str, int]
    lost: dict[str, int]
    gaps: int
    missed: dict[str, int]
    dropped: int
    malformed: int
    size_bytes: int
    sha256: str = ""
    files: tuple[Path, ...] = ()
    removed: int = 0
    high_water_bytes: int = 0
    received_s: float = 0.0
    fired: int | None = None
    remarks: tuple[str, ...] = ()
    refused: int = 0
    ended_early: str = ""
    declared: dict[str, int] = field(default_factory=dict)

    @property
    def losses(self) -> tuple[str, ...]:
        """Missing data, one line each."""
        lines = [f"{lost} rows of {key}" for key, lost in self.lost.items()]
        lines += [f"{missed} messages of {key}, reported by the transport" for key, missed in self.missed.items()]
        return (*lines, self.ended_early) if self.ended_early else tuple(lines)

    @property
    def good(self) -> bool:
        """True if the session ended without failure and without losses."""
        return not (self.error or self.losses or self.reason.startswith("failed"))
