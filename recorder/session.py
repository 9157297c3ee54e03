"""One recording session: from the rig's streams, through a bounded inbox, to a file."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from recorder.payload import block_in
from recorder.series import Limits, Series, check_room, check_series
from recorder.trigger import Capture, Captures, check_captures
from recorder.writer import NS, Counts, RecordingError, RecordingWriter, check_view_rate
from rig.bounded_queue import BoundedQueue
from rig.channels import ChannelTable
from rig.errors import InputError
from rig.intake import Catalogue, Intake
from rig.text import printable
from rig.transport import Client, NoReplyError
from rig.transport.clients import Reporter
from rig.wire import (
    ALIVE,
    CATALOGUE,
    EDGES,
    EVENTS,
    PARAMETERS,
    SCENE,
    SENSORS,
    STATUS,
    TRUTH,
    decode_document,
    schema_of,
    sensor_key,
    truth_key,
)

RIG_LOST = "rig lost"
"""End reason of a session whose rig vanished without an end event."""
INBOX_BYTES = 256 << 20
"""About a minute and a half of the default streams: longer than any stall of a disk that still works."""
_PORTION = 1000
"""Payloads that are taken out of the inbox at a time: only when all of them are written does their room come free."""
_ROUND_NS = NS // 5
"""Streams that begin within this time of each other begin together, each with its first block [ns]."""
HEARTBEAT_S = 0.5
QUIET_S = 0.3
"""After the end of the stream, with all streams whole: silence after which nothing more is expected [s]."""
RECOVERY_S = 2.0
"""After the end of the stream, or of the time to record, with blocks still missing: silence after which they are given
up [s]."""
PATIENCE_S = 30.0
"""After the end of the stream: longest wait [s]."""
RETURN_S = 10.0
"""Unless told otherwise, how long a rig that is lost may take to be there again with the same run [s]: a recorder that
was stopped for a minute loses its links, and is linked again in a second or two."""
_DOCUMENTS_BYTES = 64 << 20
"""What documents may take of memory when blocks find no more room."""


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
        rows: Rows in the files by key.
        lost: Rows that were lost, by key, only keys that lost some; of captures also those lost between them.
        gaps: Number of gaps that they are in.
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


class Sink(Protocol):
    """Where payloads go: a `Series`, or `Captures`."""

    path: Path
    files: list[Path]
    removed: int
    ended: str
    out_of_room: bool
    remarks: tuple[str, ...]

    @property
    def part(self) -> Path:
        """Name of the file that is being written."""
        ...

    @property
    def table(self) -> ChannelTable:
        """The channel table."""
        ...

    @property
    def next_index(self) -> dict[str, int]:
        """Number of the row that is due next, by key."""
        ...

    def counts(self) -> Counts:
        """What was received so far."""
        ...

    def kept(self) -> list[Counts]:
        """What stands in the files, for each stretch of time that is recorded without a pause."""
        ...

    def write(self, key: str, payload: bytes, wall_ns: int) -> dict[str, Any] | None:
        """Take one payload."""
        ...

    def write_missed(self, key: str, messages: int, wall_ns: int) -> None:
        """Record that the transport lost messages for good."""
        ...

    def short_of(self, rows: dict[str, int]) -> dict[str, int]:
        """Streams that have not come to the end of what was published."""
        ...

    def note_short(self, rows: dict[str, int], wall_ns: int) -> None:
        """Record what is missing at the end of streams."""
        ...

    def sync_if_due(self) -> None:
        """Flush to the disk if the last flush was long enough ago."""
        ...

    def finish(self, reason: str, *, notes: dict[str, str] | None = None) -> None:
        """Close the last file."""
        ...


class RecordingSession:
    """Records what a rig publishes until the stream ends, somebody stops it, or the rig or the disk is gone.

    Payloads are taken over on the transport's threads and written on one thread of the session; the thread that calls
    `run` watches.
    """

    def __init__(
        self,
        client: Client,
        path: Path,
        *,
        name: str = "recorder",
        duration_s: float | None = None,
        view_rate_hz: float = 500.0,
        history: bool = False,
        wait_s: float = 0.0,
        patience_s: float | None = None,
        force: bool = False,
        limits: Limits | None = None,
        capture: Capture | None = None,
        inbox_bytes: int = INBOX_BYTES,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Check the options and the destination; nothing is asked of the rig yet.

        Args:
            client: Connection to the rig; remains the caller's to close.
            path: File to write, ends in .mcap.
            name: Name in the rig's list of clients.
            duration_s: Simulated time to record [s], to the block; None until something else ends the session.
            view_rate_hz: Rate of the plottable messages [Hz]; 0 writes none.
            history: Also record what the rig's cache still holds from before; rows since the start of the run that it
                no longer holds count as lost.
            wait_s: How long a rig may take to answer at the beginning [s]: one that is being prepared listens already.
            patience_s: How long a rig that is lost may take to be there again [s]; the same run is then recorded on,
                with a gap. None: `RETURN_S`.
            force: Replace an existing file.
            limits: Size of the files, and what they may take of the disk.
            capture: Record only around triggers.
            inbox_bytes: Capacity of the inbox between transport and disk.
            wall_ns: Wall clock [unix ns].
            monotonic_s: Clock of waits and deadlines [s].

        Raises:
            InputError: An option or the destination cannot be used.
        """
        if duration_s is not None and not duration_s > 0.0:
            raise InputError("duration_s", "above 0", duration_s)
        check_view_rate(view_rate_hz)
        if not wait_s >= 0.0:
            raise InputError("wait_s", "at least 0", wait_s)
        patience_s = RETURN_S if patience_s is None else patience_s
        if not patience_s >= 0.0:
            raise InputError("patience_s", "at least 0", patience_s)
        self._limits = limits or Limits()
        self._capture = capture
        if capture is None:
            check_series(path, self._limits, force=force)
        else:
            for field in ("rotate_mb", "rotate_s"):
                if (given := getattr(self._limits, field)) is not None:
                    raise InputError(field, "left out where it is recorded around triggers", given)
            check_captures(path, capture, force=force)
            check_room(path, self._limits)
        self.path = path
        self._client = client
        self._reporter = Reporter(client, name)
        self._duration_ns = math.inf if duration_s is None else duration_s * NS
        self._view_rate_hz = view_rate_hz
        self._history = history
        self._wait_s = wait_s
        self._patience_s = patience_s
        self._force = force
        self._wall_ns = wall_ns
        self._monotonic_s = monotonic_s
        self._inbox: BoundedQueue[tuple[str, bytes, int]] = BoundedQueue(
            inbox_bytes, size=lambda item: len(item[1]), holds=True
        )
        """Payloads that wait to be written; a full one refuses blocks, for a transport that waits would stall the rig.
        What it refuses shows as a gap of the row numbers. Documents are small and rare, and have room of their own."""
        self._misses: deque[tuple[str, int, int]] = deque()
        self._wake = threading.Event()
        self._stop_reason = ""
        self._end_reason = ""
        self._end_rows: dict[str, int] | None = None
        """Number of the row after the last one published, by key, as the end event tells it."""
        self._rig: str | None = None
        """Who the rig is, as the transport tells."""
        self._rig_lost = False
        self._lost_s = 0.0
        self._replaced = False
        self._remarks: list[str] = []
        self._heard_s = 0.0
        self._streams: set[str] = set()
        self._beyond: set[str] = set()
        """Streams that have come to the end of the time to record."""
        self._begin_ns: dict[str, int] = {}
        self._within_s = 0.0
        self._failure: BaseException | None = None

    def stop(self, reason: str = "stopped") -> None:
        """End the session from another thread or a signal handler; what was received is still written."""
        # Only a flag: a signal handler that took the lock of an event could wait for its own thread.
        self._stop_reason = self._stop_reason or reason

    def run(self, on_progress: Callable[[Progress], None] | None = None) -> Summary:
        """Record until the end.

        Args:
            on_progress: Called about five times a second on the calling thread.

        Returns:
            The outcome; a failure of the disk is in it, not raised.

        Raises:
            NoReplyError: No rig answers.
            InputError: The file cannot be created.
        """
        catalogue, parameters, scene = (decode_document(self._ask(key)) for key in (CATALOGUE, PARAMETERS, SCENE))
        promised = Catalogue.read(catalogue)
        self._rig = self._client.rig
        writer = self._open_sink(catalogue, parameters, scene)
        self._intake = Intake(promised)
        self._tick_rate_hz = round(promised.tick_rate_hz)
        self._streams = {*map(sensor_key, promised.table.groups), *map(truth_key, promised.truth)}
        thread = threading.Thread(target=self._write_all, args=(writer,), name="recorder-writer", daemon=True)
        thread.start()
        reason = "failed"
        try:
            self._client.watch(ALIVE, self._on_alive)
            for key in (f"{SENSORS}/**", f"{TRUTH}/**", EVENTS, STATUS):
                self._client.subscribe(key, self._on_message, on_miss=self._on_miss, history=self._history)
            reason = self._wait_for_end(writer, on_progress)
        except BaseException as error:
            reason = f"failed: {error or type(error).__name__}"
            raise
        finally:
            self._inbox.close()
            thread.join()
            trouble = self._finish(writer, reason)
        if not self._rig_lost:
            self._report(writer, done=True)  # lets the rig drop its cache at once
        return self._summary(writer, reason, trouble)

    def _ask(self, key: str) -> bytes:
        """Request a document, again for as long as a rig may take to answer."""
        deadline_s = self._monotonic_s() + self._wait_s
        while True:
            try:
                return self._client.request(key)
            except NoReplyError:
                if self._stop_reason or self._monotonic_s() >= deadline_s:
                    raise
                time.sleep(0.05)

    def _open_sink(self, catalogue: dict[str, Any], parameters: dict[str, Any], scene: dict[str, Any]) -> Sink:
        def open_writer(path: Path, *, from_start: bool, **options: Any) -> RecordingWriter:
            return RecordingWriter(
                path,
                catalogue=catalogue,
                parameters=parameters,
                view_rate_hz=self._view_rate_hz,
                from_start=from_start and self._history,
                force=self._force,
                wall_ns=self._wall_ns,
                monotonic_s=self._monotonic_s,
                **options,
            )

        if self._capture is None:
            return Series(
                self.path,
                scene=scene,
                limits=self._limits,
                open_writer=open_writer,
                force=self._force,
                monotonic_s=self._monotonic_s,
            )
        return Captures(
            self.path,
            self._capture,
            table=Catalogue.read(catalogue).table,
            tick_rate_hz=round(catalogue["tick_rate_hz"]),
            scene=scene,
            open_writer=open_writer,
            limits=self._limits,
            force=self._force,
            monotonic_s=self._monotonic_s,
        )

    # On the transport's threads.

    def _on_message(self, key: str, payload: bytes) -> None:
        wall_ns = self._wall_ns()
        if schema_of(key) is None:
            if not self._replaced:
                self._inbox.offer((key, payload, wall_ns), room=self._inbox.room + _DOCUMENTS_BYTES)
            return
        due = self._intake.next.get(key, 0)
        try:
            taken = self._intake.take(key, payload, wall_ns)
        except ValueError:
            if self._intake.knows(key):
                self._inbox.offer((key, payload, wall_ns))  # kept as it came, for the reader to judge
            return
        if taken:
            # Whoever goes on after the rig was lost and counts from the start again is another one in its place.
            self._replaced = self._replaced or (self._rig_lost and taken[0].block.index < due)
            self._heard_s = self._monotonic_s()
        for each in taken if not self._replaced else ():
            self._inbox.offer((each.key, each.payload, each.wall_ns))

    def _on_miss(self, key: str, messages: int) -> None:
        self._misses.append((key, messages, self._wall_ns()))

    def _on_alive(self, alive: bool) -> None:
        if not alive:
            self._lost_s = self._monotonic_s()
            self._rig_lost = True
        elif self._rig_lost:
            self._replaced = self._replaced or self._client.rig != self._rig
            self._rig_lost = self._replaced
            if not self._replaced:
                self._remarks.append("the link to the rig was lost, and is back; what could not be fetched is a gap")
        self._wake.set()

    # On the writer thread.

    def _write_all(self, writer: Sink) -> None:
        try:
            while not self._inbox.ended:
                for key, payload, wall_ns in self._inbox.take_many(_PORTION, 0.1):
                    if not self._is_in_time(key, payload):
                        continue
                    document = writer.write(key, payload, wall_ns)
                    if document is not None:
                        self._follow(key, document)
                    if writer.ended:
                        self._inbox.close()
                        self._wake.set()
                        return
                while self._misses:
                    writer.write_missed(*self._misses.popleft())
                writer.sync_if_due()
        except BaseException as error:  # handed over to the watching thread, which ends the session with it
            self._failure = error
            self._inbox.close()
            self._wake.set()

    def _is_in_time(self, key: str, payload: bytes) -> bool:
        """Whether a payload is of the time to record; only what is a block can be of a later one."""
        if math.isinf(self._duration_ns) or schema_of(key) is None:
            return True
        try:
            start_ns = block_in(key, payload).tick * NS // self._tick_rate_hz
        except ValueError:
            return True
        begin_ns = self._begin_ns.setdefault(key, start_ns)
        first_ns = min(self._begin_ns.values())
        if key == EDGES or begin_ns - first_ns > _ROUND_NS:
            begin_ns = first_ns
        if start_ns < begin_ns + self._duration_ns:
            self._within_s = self._monotonic_s()
            return True
        self._beyond.add(key)
        return False

    def _follow(self, key: str, document: dict) -> None:
        if key == EVENTS and document.get("event") == "end":
            self._end_rows = document.get("rows")
            self._end_reason = printable(document.get("reason") or "ended", 500)
            self._wake.set()
        elif key == STATUS and document.get("state") == "ended" and not self._end_reason:
            self._end_reason = "ended before the recording began"
            self._wake.set()

    # On the calling thread.

    def _wait_for_end(self, writer: Sink, on_progress: Callable[[Progress], None] | None) -> str:
        """Watch, report and return why the session ends."""
        heartbeat_s = -1e9
        ended_s = None
        while True:
            now_s = self._monotonic_s()
            if self._failure is not None:
                return "disk error" if isinstance(self._failure, RecordingError) else f"failed: {self._failure}"
            if self._stop_reason:
                return self._stop_reason
            if writer.ended:
                return writer.ended
            if self._beyond and (self._beyond >= self._streams or now_s - self._within_s > RECOVERY_S):
                return "duration reached"
            gone = self._replaced or (self._rig_lost and now_s - self._lost_s > self._patience_s)
            if ended_s is None and (self._end_reason or gone):
                ended_s = now_s
            if ended_s is not None and self._nothing_left(writer, now_s, ended_s):
                return self._end_reason or RIG_LOST
            if now_s - heartbeat_s >= HEARTBEAT_S and not self._rig_lost:
                heartbeat_s = now_s
                self._report(writer)
            self._look_for_strangers()
            if on_progress is not None:
                on_progress(self._progress(writer))
            self._wake.wait(0.2 if ended_s is None else 0.05)
            self._wake.clear()

    def _look_for_strangers(self) -> None:
        """Say once that somebody else publishes what only the rig should."""
        for count, what in (
            (self._client.foreign, "messages that are not from this rig were left out"),
            (
                self._intake.refused,
                f"blocks that cannot be of this rig were left out ({printable(self._intake.why, 300)})",
            ),
        ):
            if count and not any(what in remark for remark in self._remarks):
                self._remarks.append(f"warning: {what}")

    def _nothing_left(self, writer: Sink, now_s: float, ended_s: float) -> bool:
        """After the end: whatever may still come has had its time."""
        if now_s - ended_s > PATIENCE_S or self._replaced:
            return True
        # The `end` event can overtake blocks that are being recovered: while a stream is short of it, wait longer.
        whole = self._end_rows is not None and not len(self._inbox) and not writer.short_of(self._end_rows)
        quiet_s = now_s - max(ended_s, self._heard_s)
        return quiet_s > (QUIET_S if whole or self._rig_lost else RECOVERY_S)

    def _report(self, writer: Sink, *, done: bool = False) -> None:
        groups = list(writer.table.groups)
        first = sensor_key("probes" if "probes" in groups or not groups else groups[0])
        lost = sum(writer.counts().lost.values())
        self._reporter.tell(writer.next_index.get(first, 0), lost=lost, done=done)

    def _progress(self, writer: Sink) -> Progress:
        counts = writer.counts()
        return Progress(
            time_s=0.0 if counts.first_time_ns is None else (counts.last_time_ns - counts.first_time_ns) / NS,
            rows=sum(rows for key, rows in counts.rows.items() if key.startswith(SENSORS + "/")),
            lost=sum(counts.lost.values()),
            size_bytes=counts.size_bytes,
            waiting=len(self._inbox),
            backlog_bytes=self._inbox.used,
            dropped=self._inbox.dropped,
            files=len(writer.files),
            remarks=(*writer.remarks, *self._remarks),
        )

    def _finish(self, writer: Sink, reason: str) -> str:
        """Close the file; return what the disk had against it."""
        if isinstance(self._failure, RecordingError):
            return str(self._failure)
        try:
            while self._misses:
                writer.write_missed(*self._misses.popleft())
            for each in self._intake.rest(self._end_rows) if not self._replaced and self._failure is None else ():
                if self._is_in_time(each.key, each.payload):
                    writer.write(each.key, each.payload, each.wall_ns)
            if reason == self._end_reason and self._end_rows:
                writer.note_short(self._end_rows, self._wall_ns())
            notes = {
                "dropped_payloads": str(self._inbox.dropped),
                "backlog_high_water_bytes": str(self._inbox.high_water),
                "refused_blocks": str(self._intake.refused),
                "foreign_messages": str(self._client.foreign),
            }
            writer.finish(reason, notes=notes)
        except RecordingError as error:
            return str(error)
        if self._failure is not None:
            return f"recording stopped by {type(self._failure).__name__}: {self._failure}; what came before it is kept"
        return ""

    def _summary(self, writer: Sink, reason: str, trouble: str) -> Summary:
        files = tuple(writer.files)
        if trouble and writer.part.exists():
            files = (*files, writer.part)
        counts = writer.counts()
        kept = writer.kept()
        in_files = sum(kept, Counts())
        return Summary(
            path=files[-1] if files else writer.path,
            reason=reason,
            error=trouble or (writer.ended if writer.out_of_room else ""),
            first_time_s=(in_files.first_time_ns or 0) / NS,
            duration_s=sum(each.extent_ns for each in kept) / NS,
            rows=in_files.rows,
            lost={key: lost for key, lost in counts.lost.items() if lost},
            gaps=counts.gaps,
            missed=counts.missed,
            dropped=self._inbox.dropped,
            malformed=counts.malformed,
            size_bytes=sum(file.stat().st_size for file in files if file.exists()),
            files=files,
            removed=writer.removed,
            high_water_bytes=self._inbox.high_water,
            received_s=counts.extent_ns / NS,
            fired=writer.fired if isinstance(writer, Captures) else None,
            remarks=(*writer.remarks, *self._remarks),
            refused=self._intake.refused + self._client.foreign,
            ended_early=self._ended_early(writer, reason, trouble),
        )

    def _ended_early(self, writer: Sink, reason: str, trouble: str) -> str:
        """Up to which time it is recorded, where that is not all that was asked for; empty else."""
        counts = sum(writer.kept(), Counts())
        if trouble or writer.out_of_room:
            return f"all that came after {counts.safe_time_ns / NS:.3f} s, where the recording ended before the run"
        if self._rig_lost and not self._end_reason:
            return f"what the rig may have sent after {counts.last_time_ns / NS:.3f} s, where it was lost"
        return ""
