"""What a recording session has come to: while it lasts, and in the end."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Progress:
    """State of a session, for display.

    Attributes:
        time_s: Simulated time recorded since its first row [s].
        rows: Rows of sensor blocks received.
        lost: Rows of all block streams that never arrived.
        size_bytes: Size of the file.
        waiting: Payloads in the inbox.
        backlog_bytes: Bytes in the inbox.
        dropped: Payloads that found the inbox full.
        files: Finished files.
        remarks: What the user should know at once, a line each; more come behind these.
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
        reason: Why the session ended.
        error: What went wrong at the disk or in the recorder, or that there was no more room; empty if nothing did.
        first_time_s: Simulated time of the first row in the files [s].
        duration_s: Simulated time from the first to the last row; of all captures in sum [s].
        rows: Rows by key in the files that are on the disk.
        lost: Rows that were lost, by key, only keys that lost some; of captures also those lost between them.
        declared: Rows that a fault of the rig has taken, which told so, by key: none of the lost.
        gaps: Gaps that the files contain.
        missed: Messages that the transport gave up, by key.
        dropped: Payloads that found the inbox full; they are among the lost.
        malformed: Payloads that were not what their key promises; they are in the file as they came.
        size_bytes: Size of the files.
        files: All files that are there, in order; among them a .part file that could not be finished.
        removed: Files that were removed for want of room.
        high_water_bytes: Most that ever waited in the inbox.
        received_s: Simulated time from the first to the last row received, kept or not [s].
        fired: Triggers that came; None where it was not recorded around triggers.
        remarks: What the user should know, a line each.
        refused: Blocks that cannot be of the rig, and were left out.
        ended_early: Up to which time it is recorded, where that is not all that was asked for; empty else.
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
        """What is missing, a line each."""
        lines = [f"{lost} rows of {key}" for key, lost in self.lost.items()]
        lines += [f"{missed} messages of {key}, says the transport" for key, missed in self.missed.items()]
        return (*lines, self.ended_early) if self.ended_early else tuple(lines)

    @property
    def good(self) -> bool:
        """Whether the run did not fail, and all of it was recorded that was to be."""
        return not (self.error or self.losses or self.reason.startswith("failed"))
