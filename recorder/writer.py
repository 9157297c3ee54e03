"""Writer of a recording: an MCAP file that survives a kill, includes its calibration and opens in generic viewers."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

from recorder.contents.counts import NS, Counts, Tally
from recorder.contents.documents import get_definition
from recorder.contents.metadata import Beginning, Head, describe_view, instant
from recorder.contents.views import Messages, View, Views
from recorder.files import schemas
from recorder.files.mcap_file import McapFile
from recorder.files.payload import Payload
from recorder.files.unfinished_file import Draft
from rig.base.errors import DiskError, InputError
from rig.base.wire import EDGES, EVENTS, Gap, encode_document

_CLOCK_STEP_TOLERANCE_NS = 60 * NS
"""Backward step of the wall clock that restarts the clock pairs [ns]; smaller steps occur between streams."""


class RecordingError(DiskError):
    """Recording ended by a disk error; all data written before are kept."""


def check_view_rate(view_rate_hz: float) -> None:
    """Refuse an invalid rate of plot messages [Hz].

    Raises:
        InputError: The rate is negative, nan or above 1e6.
    """
    if not 0.0 <= view_rate_hz <= 1e6:
        raise InputError("view_rate_hz", "between 0 (none) and 1e6", view_rate_hz)


class RecordingWriter:
    """Writer of payloads as received, with derived plot messages, gaps and clock pairs.

    `log_time` of every message is simulated time [ns], so that plots align with the physics and recordings with each
    other; `publish_time` is the wall time of arrival [unix ns]. Each message is thus a clock pair; `recorder/clock`
    repeats two per second as JSON.

    The file is FILE.mcap.part until `finish`. It is flushed often enough that a kill loses less than 0.5 s.

    Attributes:
        path: Final name of the file.
        closed: Whether the file was finished, or ended by a disk error.
        tally: Counts of the written data.
        head: Documents of the rig.
        file: MCAP file.
    """

    def __init__(
        self,
        path: Path,
        *,
        catalogue: dict[str, Any],
        parameters: dict[str, Any],
        scene: dict[str, Any],
        view_rate_hz: float = 500.0,
        beginning: Beginning | None = None,
        force: bool = False,
        sync_every_s: float = 0.25,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create the file and write calibration, parameters and scene to it.

        Args:
            path: File name, ending in .mcap.
            catalogue: Catalogue document of the rig: channel table, truth tables, tick rate.
            parameters: Parameter document of the rig.
            scene: Scene document of the rig.
            view_rate_hz: Rate of the plot messages [Hz of simulated time]; 0 for none.
            beginning: Start of a file that continues or derives from another one.
            force: Replace an existing file.
            sync_every_s: Longest time between two flushes to the disk while messages arrive [s].
            wall_ns: Wall clock [unix ns].
            monotonic_s: Clock for the flush interval [s].

        Raises:
            InputError: The destination, the view rate or the catalogue cannot be used.
            RecordingError: The disk reports an error; no file remains.
        """
        check_view_rate(view_rate_hz)
        self.head, beginning = Head(catalogue, parameters, scene), beginning or Beginning()
        self.path, self.closed = path, False
        self.tally = Tally(self.head.tick_rate_hz, due=beginning.due, from_start=beginning.from_start)
        self._sync_every_s = sync_every_s
        self._monotonic_s = monotonic_s
        self._synced_s = monotonic_s()
        self._draft = Draft(path, force=force)
        self._has_begun = False
        with self._guard():
            self.file = McapFile(self._draft)
            self._topics = _Topics(self.file, self.head, self.tally, view_rate_hz=view_rate_hz, wall_ns=wall_ns)
            self._topics.begin(beginning)
            self.sync()
            self._draft.sync_folder()
            self._has_begun = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        self.finish("closed" if kind is None else f"failed: {error or kind.__name__}")

    @property
    def part(self) -> Path:
        """Name of the file while it is being written."""
        return self._draft.part

    @property
    def sha256(self) -> str:
        """SHA-256 digest of the written bytes."""
        return self._draft.digest.hexdigest()

    def counts(self) -> Counts:
        """Return the totals up to now. Safe to call from any thread."""
        return self.tally.counts(size_bytes=self.file.size_bytes, safe_time_ns=self._safe_time_ns)

    def write(self, key: str, data: bytes, wall_ns: int) -> None:
        """Decode data received on a key at a wall time [unix ns], and write them."""
        self.take(Payload.read(key, data, wall_ns))

    def take(self, payload: Payload) -> None:
        """Write a payload unchanged, with the data derived from it.

        Raises:
            RecordingError: The disk reports an error; the file is closed and its contents are kept.
        """
        with self._guard():
            self._topics.add(payload)
        self.sync_if_due()

    def write_missed(self, key: str, messages: int, wall_ns: int) -> None:
        """Record messages that the transport dropped.

        Lost rows of a block stream also appear as a step of its row numbers and are counted there. For lost documents,
        and for lost blocks at the end of a stream, this record is the only trace.

        Args:
            key: Key of the stream.
            messages: Number of messages.
            wall_ns: Wall time of the report [unix ns].
        """
        self.tally.count_missed(key, messages)
        with self._guard():
            self._topics.add_missed(key, messages, wall_ns)

    def note_short(self, rows: dict[str, int], wall_ns: int) -> None:
        """Record the rows missing at the end of streams as gaps.

        Args:
            rows: Number of the row after the last one published, by key.
            wall_ns: Wall time [unix ns].
        """
        with self._guard():
            for gap in self.tally.end(rows):
                self._topics.add_gap(gap, self.tally.last_time_ns, wall_ns)

    def sync_if_due(self) -> None:
        """Flush to the disk if the flush interval has passed."""
        if self._monotonic_s() - self._synced_s >= self._sync_every_s:
            self.sync()

    def sync(self) -> None:
        """Flush to the disk."""
        with self._guard():
            self._topics.settle()
            self.file.sync()
            self._safe_time_ns = self.tally.last_time_ns
            self._synced_s = self._monotonic_s()

    def abandon(self) -> None:
        """Close and remove an unfinished file; a file that it would have replaced stays."""
        if not self.closed:
            self.closed = True
            self._draft.discard()

    def finish(self, reason: str, *, notes: dict[str, str] | None = None) -> None:
        """Write the final counts, close the file and give it its final name; no effect on a closed file.

        Args:
            reason: Reason for the end of the recording.
            notes: Additional entries for the `end` metadata.

        Raises:
            RecordingError: The disk reports an error; the .part file is kept.
        """
        if self.closed:
            return
        with self._guard():
            self._topics.end(reason, notes or {})
            self.file.finish()
            self._safe_time_ns = self.tally.last_time_ns
            self.closed = True
        self._draft.sync_folder()

    @contextlib.contextmanager
    def _guard(self) -> Iterator[None]:
        """Close the file on a disk error and raise one RecordingError."""
        if self.closed:
            raise RecordingError(f"recording {self.path} is closed")
        try:
            yield
        except OSError as error:
            self.closed = True
            self._draft.close()
            kept = f"the earlier data are kept in {self.part}; `rig recover` finishes the file"
            if not self._has_begun:
                # A file without its calibration is useless.
                self._draft.discard()
                kept = f"{self.part} could not be started"
            elif not self.part.exists():
                kept = f"no file is left at {self.part}"
            raise RecordingError(f"recording stopped by the disk: {error.strerror or error}; {kept}") from error


class _Topics:
    """Topics of an open file, and the assignment of messages to them."""

    def __init__(
        self, file: McapFile, head: Head, tally: Tally, *, view_rate_hz: float, wall_ns: Callable[[], int]
    ) -> None:
        self._head = head
        self._file = file
        self._tally = tally
        self._view_rate_hz = view_rate_hz
        self._views = Views(head.table, rate_hz=view_rate_hz)
        self._wall_ns = wall_ns
        self._clock_ns = 0

    def begin(self, beginning: Beginning) -> None:
        """Write everything before the first message."""
        now = self._wall_ns()
        metadata = self._head.metadata(beginning.metadata, view_rate_hz=self._view_rate_hz, wall_ns=now)
        for name in dict.fromkeys(["rig", *metadata]):
            self._file.mcap.add_metadata(name, metadata[name])
        for name, media_type, data in self._head.attachments(metadata):
            self._file.mcap.add_attachment(now, 0, name, media_type, data)
        for name, data in beginning.attachments.items():
            self._file.mcap.add_attachment(now, 0, name, "application/octet-stream", data)
        for key in (*self._head.streams, EDGES, EVENTS, schemas.GAPS, schemas.CLOCK):
            self._register(key)
        for view in self._views.all:
            about = describe_view(view, self._view_rate_hz)
            self._file.register(view.topic, schemas.JOINT_STATE, about)
        if self._view_rate_hz:
            self._file.register(schemas.VIEW_EVENTS, schemas.LOG, {"source": EVENTS})

    def add(self, payload: Payload) -> None:
        """Write a payload unchanged, with the data derived from it; a malformed payload has none."""
        start_ns, _ = self._tally.extent_ns(self._tally.restore(payload))
        self._register(payload.key)
        if (gap := self._tally.take(payload)) is not None:
            self.add_gap(gap, start_ns, payload.wall_ns)
        self._file.add(payload.key, payload.data, time_ns=start_ns, wall_ns=payload.wall_ns)
        group = self._head.group(payload.key)
        if payload.block is not None and group is not None:
            self._add_clock(payload, start_ns)
            if (plotted := self._views.add(group, payload.block, start_ns)) is not None:
                self._add_view(*plotted, payload.wall_ns)
        elif payload.document is not None and payload.key == EVENTS and self._view_rate_hz:
            level, text = schemas.event_text(payload.document)
            line = schemas.encode_log(start_ns, level, payload.key, text)
            self._file.add(schemas.VIEW_EVENTS, line, time_ns=start_ns, wall_ns=payload.wall_ns)

    def add_gap(self, gap: Gap, time_ns: int, wall_ns: int) -> None:
        """Write the gap of rows missing before a simulated time [ns]."""
        about = {"kind": "rows", "key": gap.key, "index": gap.index, "size": gap.size}
        self._add_document(schemas.GAPS, about, time_ns, wall_ns)

    def add_missed(self, key: str, messages: int, wall_ns: int) -> None:
        """Write the gap of messages dropped by the transport."""
        about = {"kind": "messages", "key": key, "index": -1, "size": messages}
        self._add_document(schemas.GAPS, about, self._tally.last_time_ns, wall_ns)

    def settle(self) -> None:
        """Write the completed plot messages."""
        for view in self._views.all:
            self._add_view(view, view.take_complete(), self._wall_ns())

    def end(self, reason: str, notes: dict[str, str]) -> None:
        """Write the last plot messages and the final counts."""
        for view in self._views.all:
            self._add_view(view, view.take_all(), self._wall_ns())
        counts = self._tally.counts(size_bytes=0)
        about = {
            "reason": reason,
            "ended": instant(self._wall_ns()),
            "first_time_s": f"{(counts.first_time_ns or 0) / NS:.9f}",
            "last_time_s": f"{counts.last_time_ns / NS:.9f}",
            "rows": json.dumps(counts.rows),
            "lost_rows": json.dumps({key: lost for key, lost in counts.lost.items() if lost}),
            "declared_rows": json.dumps({key: rows for key, rows in counts.declared.items() if rows}),
            "gaps": str(counts.gaps),
            "missed_messages": json.dumps(counts.missed),
            "malformed": str(counts.malformed),
        }
        self._file.mcap.add_metadata("end", {**about, **notes})

    def _register(self, key: str) -> None:
        """Register the topic of a key, with its calibration, at its first payload."""
        if key not in self._file:
            self._file.register(key, get_definition(key), self._head.about(key))

    def _add_clock(self, payload: Payload, time_ns: int) -> None:
        """Write a pair of simulated and wall time, twice per second."""
        since_ns = payload.wall_ns - self._clock_ns
        if since_ns >= NS // 2 or since_ns < -_CLOCK_STEP_TOLERANCE_NS:
            self._clock_ns = payload.wall_ns
            self._add_document(schemas.CLOCK, {"tick": payload.tick}, time_ns, payload.wall_ns)

    def _add_document(self, topic: str, about: dict[str, Any], time_ns: int, wall_ns: int) -> None:
        data = encode_document({**about, "time_s": time_ns / NS, "wall_s": wall_ns / NS})
        self._file.add(topic, data, time_ns=time_ns, wall_ns=wall_ns)

    def _add_view(self, view: View, messages: Messages, wall_ns: int) -> None:
        times_ns, data = messages
        for row, time_ns in zip(data, times_ns.tolist(), strict=True):
            self._file.add(view.topic, row.tobytes(), time_ns=time_ns, wall_ns=wall_ns)
