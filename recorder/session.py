"""Recording session: transfers the streams of a rig through a bounded inbox to files."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from recorder.contents.counts import NS, Counts
from recorder.contents.metadata import Beginning
from recorder.contents.summary import Progress, Summary
from recorder.files.payload import Payload
from recorder.output.captures import Captures, capture_path, check_captures
from recorder.output.disk_limits import DiskLimits
from recorder.output.series import Series, check_series, part_path
from recorder.output.sink import Needs, Sink
from recorder.output.trigger import Capture
from recorder.writer import RecordingError, RecordingWriter, check_view_rate
from rig.base import wire
from rig.base.errors import InputError
from rig.base.text import printable
from rig.serve.stream_check import AcceptedBlock, BlockValidator, Catalogue
from rig.serve.transport import Client
from rig.serve.transport.clients import Reporter
from rig.serve.waiting import BoundedQueue

Document = dict[str, Any]
RIG_LOST = "rig lost"
"""End reason of a session whose rig disappeared without an end event."""
INBOX_BYTES = 256 << 20
"""Capacity of the inbox [bytes]: about 90 s of the default streams, longer than any stall of a working disk."""
_BATCH_PAYLOADS = 1000
"""Payloads taken from the inbox at a time; their space is released after all of them are written."""
_COMMON_START_NS = NS // 5
"""Streams that begin within this time of each other start at their own first blocks [ns]."""
HEARTBEAT_S = 0.5
"""Interval of the reports to the rig [s]."""
QUIET_S = 0.3
"""Silence that ends the session after the end event, if all streams are complete but the last status is missing [s]."""
RECOVERY_S = 2.0
"""Silence after which missing blocks are given up, after the end event or at the end of the time to record [s]."""
PATIENCE_S = 30.0
"""Longest wait after the end event [s]."""
RETURN_S = 10.0
"""Default time that a lost rig may take to return with the same run [s].

A recorder that was suspended for a minute loses its links, and has them again in a second or two.
"""
_DOCUMENTS_BYTES = 64 << 20
"""Additional capacity of the inbox for documents when it is full of blocks [bytes]."""


class _Extent:
    """Simulated time to record, counted from the first block of each stream."""

    def __init__(self, duration_s: float | None, streams: Catalogue, monotonic_s: Callable[[], float]) -> None:
        self._duration_ns = math.inf if duration_s is None else duration_s * NS
        self._tick_rate_hz = round(streams.tick_rate_hz)
        self._streams = {*map(wire.sensor_key, streams.table.groups), *map(wire.truth_key, streams.truth)}
        self._monotonic_s = monotonic_s
        self._begin_ns: dict[str, int] = {}
        self._within_s = 0.0
        self._finished: set[str] = set()
        """Streams that have reached the end of the time to record."""

    def takes(self, payload: Payload) -> bool:
        """Return whether a payload belongs to the time to record; a document always does."""
        key, block = payload.key, payload.block
        if math.isinf(self._duration_ns) or block is None:
            return True
        start_ns = block.tick * NS // self._tick_rate_hz
        begin_ns = self._begin_ns.setdefault(key, start_ns)
        first_ns = min(self._begin_ns.values())
        if key == wire.EDGES or begin_ns - first_ns > _COMMON_START_NS:
            begin_ns = first_ns
        if start_ns < begin_ns + self._duration_ns:
            self._within_s = self._monotonic_s()
            return True
        self._finished.add(key)
        return False

    def over(self, now_s: float) -> bool:
        """Return whether all streams have reached the end, or the remaining ones are silent."""
        return bool(self._finished) and (self._finished >= self._streams or now_s - self._within_s > RECOVERY_S)


class RecordingSession:
    """Recording of a rig's streams until they end, the session is stopped, or the rig or the disk fails.

    Payloads are received on the transport's threads and written on one thread of the session. The thread that calls
    `run` monitors both.
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
        patience_s: float | None = None,
        force: bool = False,
        limits: DiskLimits | None = None,
        capture: Capture | None = None,
        inbox_bytes: int = INBOX_BYTES,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Check the options and the destination without contacting the rig.

        Args:
            client: Connection to the rig; closed by the caller.
            path: Output file, ending in .mcap.
            name: Name in the rig's list of clients.
            duration_s: Simulated time to record, accurate to one block [s]; None for no limit.
            view_rate_hz: Rate of the plot messages [Hz]; 0 for none.
            history: Also record the rig's cache of earlier blocks; rows since the start of the run that are no longer
                in the cache count as lost.
            patience_s: Time that a lost rig may take to return [s]; the same run then continues after a gap. None for
                `RETURN_S`.
            force: Replace an existing file.
            limits: Limits of file size and disk space; None for no limits.
            capture: Record only around triggers; None to record everything.
            inbox_bytes: Capacity of the inbox [bytes].
            wall_ns: Wall clock [unix ns].
            monotonic_s: Clock for waits and deadlines [s].

        Raises:
            InputError: An option or the destination cannot be used.
        """
        if duration_s is not None and not duration_s > 0.0:
            raise InputError("duration_s", "above 0", duration_s)
        check_view_rate(view_rate_hz)
        patience_s = RETURN_S if patience_s is None else patience_s
        if not patience_s >= 0.0:
            raise InputError("patience_s", "at least 0", patience_s)
        self._limits = limits or DiskLimits()
        self._capture = capture
        if capture is None:
            check_series(path, self._limits, force=force)
        else:
            for field in ("rotate_mb", "rotate_s"):
                if (limit := getattr(self._limits, field)) is not None:
                    raise InputError(field, "omitted for a recording around triggers", limit)
            check_captures(path, capture, self._limits, force=force)
        self.path = path
        self._client = client
        self._reporter = Reporter(client, name)
        self._duration_s = duration_s
        self._view_rate_hz = view_rate_hz
        self._history = history
        self._patience_s = patience_s
        self._force = force
        self._wall_ns = wall_ns
        self._monotonic_s = monotonic_s
        self._inbox: BoundedQueue[Payload] = BoundedQueue(
            inbox_bytes, size=lambda payload: len(payload.data), holds=True
        )
        """Payloads to be written. A full inbox drops blocks, because a waiting transport would stall the rig; dropped
        blocks appear as gaps. Documents are small and rare, and have additional capacity."""
        self._order = threading.Lock()
        self._misses: deque[tuple[str, int, int]] = deque()
        self._wake = threading.Event()
        self._stop_reason = ""
        self._end_reason = ""
        self._end_rows: dict[str, int] | None = None
        """Number of the row after the last one published, by key, as stated in the end event."""
        self._last_status = False
        """True if the final status of the run has arrived."""
        self._rig_id: str | None = None
        """Identity of the rig on the transport."""
        self._rig_lost = False
        self._lost_s = 0.0
        self._replaced = False
        self._remarks: list[str] = []
        self._last_block_s = 0.0
        self._failure: BaseException | None = None

    def stop(self, reason: str = "stopped") -> None:
        """End the session from another thread or a signal handler; received data are still written."""
        # Set only a flag: a signal handler that locks an event can deadlock with its own thread.
        self._stop_reason = self._stop_reason or reason

    @property
    def waiting(self) -> int:
        """Number of payloads in the inbox."""
        return len(self._inbox)

    def run(self, on_progress: Callable[[Progress], None] | None = None) -> Summary:
        """Record until the session ends.

        Args:
            on_progress: Callback about five times per second, on the calling thread.

        Returns:
            The outcome; a disk error is part of it and is not raised.

        Raises:
            NoReplyError: No rig replies.
            InputError: The file cannot be created.
        """
        keys = (wire.CATALOGUE, wire.PARAMETERS, wire.SCENE)
        catalogue, parameters, scene = (wire.decode_document(self._client.request(key)) for key in keys)
        streams = Catalogue.read(catalogue)
        self._rig_id = self._client.rig
        writer = self._open_sink(streams, catalogue, parameters, scene)
        self._validator = BlockValidator(streams)
        self._extent = _Extent(self._duration_s, streams, self._monotonic_s)
        self._table = streams.table
        thread = threading.Thread(target=self._write_all, args=(writer,), name="recorder-writer", daemon=True)
        thread.start()
        reason = "failed"
        try:
            self._client.watch(wire.ALIVE, self._on_alive)
            for key in (f"{wire.SENSORS}/**", f"{wire.TRUTH}/**", wire.EVENTS, wire.STATUS):
                self._client.subscribe(key, self._on_message, on_miss=self._on_miss, history=self._history)
            reason = self._wait_for_end(writer, on_progress)
        except BaseException as error:
            reason = f"failed: {error or type(error).__name__}"
            raise
        finally:
            self._inbox.close()
            thread.join()
            disk_error = self._finish(writer, reason)
        if not self._rig_lost:
            self._report(writer, done=True)  # the rig can then release its cache
        return self._summary(writer, reason, disk_error)

    @property
    def first_files(self) -> list[Path]:
        """Output file, or the first of several for each trigger."""
        if self._capture is not None:
            return list(dict.fromkeys(capture_path(self.path, trigger, 1) for trigger in self._capture.triggers))
        return [part_path(self.path, 0) if self._limits.rotates else self.path]

    def _open_sink(self, streams: Catalogue, catalogue: Document, parameters: Document, scene: Document) -> Sink:
        def open_file(path: Path, scene: Document, beginning: Beginning) -> RecordingWriter:
            return RecordingWriter(
                path,
                catalogue=catalogue,
                parameters=parameters,
                scene=scene,
                view_rate_hz=self._view_rate_hz,
                beginning=beginning,
                force=self._force,
                wall_ns=self._wall_ns,
                monotonic_s=self._monotonic_s,
            )

        tick_rate_hz = round(streams.tick_rate_hz)
        needs = Needs(streams.table, tick_rate_hz, scene, open_file, self._limits, self._force, self._monotonic_s)
        if self._capture is None:
            return Series(self.path, needs, from_start=self._history)
        return Captures(self.path, self._capture, needs)

    # Called on the transport's threads.

    def _on_message(self, key: str, payload: bytes) -> None:
        wall_ns = self._wall_ns()
        if wire.get_schema(key) is not None:
            with self._order:
                self._take(key, payload, wall_ns)
        elif not self._replaced:
            document = Payload(key, payload, wall_ns)
            self._inbox.offer(document, room=self._inbox.room + _DOCUMENTS_BYTES)
            if key == wire.FAULTS and document.document is not None:
                with self._order:
                    self._offer(self._validator.declare(document.document))

    def _offer(self, blocks: list[AcceptedBlock]) -> None:
        for accepted in blocks if not self._replaced else ():
            self._inbox.offer(Payload.from_block(accepted))

    def _take(self, key: str, payload: bytes, wall_ns: int) -> None:
        """Process a block on the thread of its stream."""
        due = self._validator.next.get(key, 0)
        try:
            blocks = self._validator.take(key, payload, wall_ns)
        except ValueError:
            if self._validator.has_stream(key):
                self._inbox.offer(Payload.read(key, payload, wall_ns))  # recorded unchanged as malformed
            return
        if blocks:
            # A rig whose row numbers restart after a lost link is a different one.
            self._replaced = self._replaced or (self._rig_lost and blocks[0].block.index < due)
            self._last_block_s = self._monotonic_s()
        self._offer(blocks)

    def _on_miss(self, key: str, messages: int) -> None:
        self._misses.append((key, messages, self._wall_ns()))

    def _on_alive(self, alive: bool) -> None:
        if not alive:
            self._lost_s = self._monotonic_s()
            self._rig_lost = True
        elif self._rig_lost:
            self._replaced = self._replaced or self._client.rig != self._rig_id
            self._rig_lost = self._replaced
            if not self._replaced:
                self._remarks.append("the link to the rig was lost and restored; data not fetched are recorded as gaps")
        self._wake.set()

    # Called on the writer thread.

    def _write_all(self, writer: Sink) -> None:
        try:
            while not self._inbox.ended:
                for payload in self._inbox.take_many(_BATCH_PAYLOADS, 0.1):
                    if not self._extent.takes(payload):
                        continue
                    writer.take(payload)
                    self._follow(payload)
                    if writer.ended:
                        self._inbox.close()
                        self._wake.set()
                        return
                while self._misses:
                    writer.write_missed(*self._misses.popleft())
                writer.sync_if_due()
        except BaseException as error:  # reported by the monitoring thread, which ends the session
            self._failure = error
            self._inbox.close()
            self._wake.set()

    def _follow(self, payload: Payload) -> None:
        document = payload.document or {}
        if payload.event("end"):
            self._end_rows = document.get("rows")
            self._end_reason = printable(document.get("reason") or "ended", 500)
            self._wake.set()
        elif payload.key == wire.STATUS and document.get("state") == "ended":
            self._end_reason = self._end_reason or "ended before the recording began"
            self._last_status = True
            self._wake.set()

    # Called on the calling thread.

    def _wait_for_end(self, writer: Sink, on_progress: Callable[[Progress], None] | None) -> str:
        """Wait for the end of the session and return its reason."""
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
            if self._extent.over(now_s):
                return "duration reached"
            expired = self._replaced or (self._rig_lost and now_s - self._lost_s > self._patience_s)
            if ended_s is None and (self._end_reason or expired):
                ended_s = now_s
            if ended_s is not None and self._wait_is_over(writer, now_s, ended_s):
                return self._end_reason or RIG_LOST
            if now_s - heartbeat_s >= HEARTBEAT_S and not self._rig_lost:
                heartbeat_s = now_s
                self._report(writer)
            self._report_foreign_messages()
            if on_progress is not None:
                on_progress(self._progress(writer))
            self._wake.wait(0.2 if ended_s is None else 0.05)
            self._wake.clear()

    def _report_foreign_messages(self) -> None:
        """Add one remark for each kind of message that does not come from the rig."""
        for count, what in (
            (self._client.foreign, "messages that are not from this rig were left out"),
            (
                self._validator.refused,
                f"blocks that cannot be of this rig were left out ({printable(self._validator.reason, 300)})",
            ),
        ):
            if count and not any(what in remark for remark in self._remarks):
                self._remarks.append(f"warning: {what}")

    def _wait_is_over(self, writer: Sink, now_s: float, ended_s: float) -> bool:
        """Return whether the wait for outstanding data after the end is over."""
        if now_s - ended_s > PATIENCE_S or self._replaced:
            return True
        # The end event can overtake blocks that are being recovered and documents about refused blocks, so wait
        # longer while a stream is incomplete.
        due = self.waiting or self._validator.refused or self._end_rows is None
        complete = not due and not writer.tally.find_missing_rows(self._end_rows or {})
        if complete and self._last_status and writer.tally.next.keys() >= (self._end_rows or {}).keys():
            return True
        quiet_s = now_s - max(ended_s, self._last_block_s)
        return quiet_s > (QUIET_S if complete or self._rig_lost else RECOVERY_S)

    def _report(self, writer: Sink, *, done: bool = False) -> None:
        groups = list(self._table.groups)
        first = wire.sensor_key("probes" if "probes" in groups or not groups else groups[0])
        lost = writer.counts().undeclared_lost
        self._reporter.send(writer.tally.next.get(first, 0), lost=lost, done=done)

    def _progress(self, writer: Sink) -> Progress:
        counts = writer.counts()
        return Progress(
            time_s=0.0 if counts.first_time_ns is None else (counts.last_time_ns - counts.first_time_ns) / NS,
            rows=sum(rows for key, rows in counts.rows.items() if key.startswith(wire.SENSORS + "/")),
            lost=counts.undeclared_lost,
            size_bytes=counts.size_bytes,
            waiting=self.waiting,
            backlog_bytes=self._inbox.used,
            dropped=self._inbox.dropped,
            files=len(writer.files),
            remarks=(*writer.remarks, *self._remarks),
        )

    def _finish(self, writer: Sink, reason: str) -> str:
        """Close the file and return the disk error, if any."""
        if isinstance(self._failure, RecordingError):
            return str(self._failure)
        try:
            while self._misses:
                writer.write_missed(*self._misses.popleft())
            for accepted in (
                self._validator.take_waiting(self._end_rows) if not self._replaced and self._failure is None else ()
            ):
                payload = Payload.from_block(accepted)
                if self._extent.takes(payload):
                    writer.take(payload)
            if reason == self._end_reason and self._end_rows:
                writer.note_short(self._end_rows, self._wall_ns())
            notes = {
                "dropped_payloads": str(self._inbox.dropped),
                "backlog_high_water_bytes": str(self._inbox.high_water),
                "refused_blocks": str(self._validator.refused),
                "foreign_messages": str(self._client.foreign),
            }
            writer.finish(reason, notes=notes)
        except RecordingError as error:
            return str(error)
        if self._failure is not None:
            return f"recording stopped by {type(self._failure).__name__}: {self._failure}; the earlier data are kept"
        return ""

    def _summary(self, writer: Sink, reason: str, disk_error: str) -> Summary:
        files = tuple(writer.files)
        if disk_error and writer.part is not None and writer.part.exists():
            files = (*files, writer.part)
        counts = writer.counts()
        kept = writer.kept()
        in_files = sum(kept, Counts())
        return Summary(
            path=files[-1] if files else writer.path,
            reason=reason,
            error=disk_error or (writer.ended if writer.out_of_room else ""),
            first_time_s=(in_files.first_time_ns or 0) / NS,
            duration_s=sum(part.extent_ns for part in kept) / NS,
            rows=in_files.rows,
            lost={key: more for key, lost in counts.lost.items() if (more := lost - counts.declared.get(key, 0)) > 0},
            declared={key: rows for key, rows in counts.declared.items() if rows},
            gaps=in_files.gaps,
            missed=counts.missed,
            dropped=self._inbox.dropped,
            malformed=in_files.malformed,
            size_bytes=sum(file.stat().st_size for file in files if file.exists()),
            sha256=writer.sha256,
            files=files,
            removed=writer.removed,
            high_water_bytes=self._inbox.high_water,
            received_s=counts.extent_ns / NS,
            fired=writer.fired if isinstance(writer, Captures) else None,
            remarks=(*writer.remarks, *self._remarks),
            refused=self._validator.refused + self._client.foreign,
            ended_early=self._ended_early(writer, reason, disk_error),
        )

    def _ended_early(self, writer: Sink, reason: str, disk_error: str) -> str:
        """Return what is missing at the end of an incomplete recording; empty otherwise."""
        counts = sum(writer.kept(), Counts())
        if disk_error or writer.out_of_room:
            return f"all data after {counts.safe_time_ns / NS:.3f} s, where the recording ended before the run"
        if self._rig_lost and not self._end_reason:
            return f"data that the rig may have sent after {counts.last_time_ns / NS:.3f} s, where it was lost"
        return ""
