"""Writes one recording: an MCAP file that survives a kill, holds its own calibration and opens in foreign readers."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import struct
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Self

from recorder import schemas
from recorder.payload import block_in, document_in, tick_in
from recorder.records import COPY
from recorder.views import Messages, View, Views
from rig.channels import ChannelTable, Group
from rig.errors import PART_SUFFIX, DiskError, InputError, check_new_file
from rig.wire import (
    EDGES,
    EVENTS,
    SCHEMAS,
    SENSORS,
    TRUTH,
    Block,
    Continuity,
    Gap,
    encode_document,
    schema_of,
    sensor_key,
    truth_key,
)

if TYPE_CHECKING:
    from mcap.records import ChunkIndex
    from mcap.writer import Writer

NS = 1_000_000_000
_CHUNK_BYTES = 1 << 20
_MESSAGE_BYTES = 47
"""What a message takes besides its data: its head, and its place in the index of the chunk."""
_END_BYTES = 100_000
"""What comes to a file when it is finished, its index aside: channels and schemas again, and the last plotted rows."""
_SET_BACK_NS = 60 * NS
"""Step back of the wall clock after which clock pairs begin anew; smaller ones are of streams that came in turn."""


class RecordingError(DiskError):
    """The disk ended the recording; everything written before is kept."""


@dataclass(frozen=True)
class Counts:
    """What was written, to one file or to several in turn.

    Attributes:
        first_time_ns: Simulated time of the first row [ns]; None before it.
        last_time_ns: Simulated time of the last row [ns].
        rows: Rows received by key.
        lost: Rows lost by key.
        gaps: Number of gaps that they are in.
        missed: Messages that the transport gave up, by key.
        malformed: Payloads that were not what their key promises.
        size_bytes: Bytes on the disk.
        safe_time_ns: Simulated time up to which all is on the disk [ns].
    """

    first_time_ns: int | None = None
    last_time_ns: int = 0
    rows: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    gaps: int = 0
    missed: dict[str, int] = field(default_factory=dict)
    malformed: int = 0
    size_bytes: int = 0
    safe_time_ns: int = 0

    @property
    def extent_ns(self) -> int:
        """Simulated time from the first to the last row [ns]."""
        return 0 if self.first_time_ns is None else self.last_time_ns - self.first_time_ns

    def __add__(self, later: Counts) -> Counts:
        firsts = [each.first_time_ns for each in (self, later) if each.first_time_ns is not None]
        return Counts(
            first_time_ns=min(firsts, default=None),
            last_time_ns=max(self.last_time_ns, later.last_time_ns),
            rows=_sum(self.rows, later.rows),
            lost=_sum(self.lost, later.lost),
            gaps=self.gaps + later.gaps,
            missed=_sum(self.missed, later.missed),
            malformed=self.malformed + later.malformed,
            size_bytes=self.size_bytes + later.size_bytes,
            safe_time_ns=max(self.safe_time_ns, later.safe_time_ns),
        )


def _sum(first: dict[str, int], second: dict[str, int]) -> dict[str, int]:
    return {key: first.get(key, 0) + second.get(key, 0) for key in {**first, **second}}


def check_destination(path: Path, *, force: bool = False) -> None:
    """Refuse a file that cannot become a recording, before anything is subscribed or overwritten.

    Args:
        path: File to record to.
        force: An existing file may be replaced.

    Raises:
        InputError: The name does not end in .mcap, the folder is missing or read-only, or the file exists.
    """
    check_new_file(path, field="output", suffixes=(".mcap",), force=force)
    if (part := part_of(path)).exists() and not force:
        raise InputError("output", "a new file (--force replaces one)", f"{part}, which exists")


def _open_part(part: Path, *, replace: bool) -> BinaryIO:
    """Create the file of a recording in the making, locked for as long as it is open.

    Args:
        part: The file.
        replace: What another recording left there may go, but not what one is writing to.

    Raises:
        InputError: Another recording is writing to it.
        OSError: The disk refused.
    """
    import fcntl

    if replace and part.exists():
        # A new file under the name, not the old one emptied: nobody else can have it open.
        remove([part])
    file = part.open("x+b")  # readable, to save it if somebody removes it
    fcntl.flock(file, fcntl.LOCK_EX)
    return file


def remove(files: Iterable[Path]) -> None:
    """Remove files of an earlier recording, all or none of them.

    Raises:
        InputError: Another recording is writing to one, or one cannot be removed.
    """
    import fcntl

    files = list(files)
    for file in files:
        with contextlib.suppress(FileNotFoundError), file.open("rb") as old:
            try:
                fcntl.flock(old, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError("output", "files that no other recording is writing to", str(file)) from None
    for file in files:
        try:
            file.unlink(missing_ok=True)
        except OSError as error:
            raise InputError("output", "files that can be replaced", f"{file} ({error.strerror})") from None


def _sync_folder(folder: Path) -> None:
    """Bring names of files to the disk as well; not every file system can."""
    with contextlib.suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def check_view_rate(view_rate_hz: float) -> None:
    """Refuse a viewing rate [Hz] that means nothing.

    Raises:
        InputError: It is negative, infinite or no number.
    """
    if not 0.0 <= view_rate_hz <= 1e6:
        raise InputError("view_rate_hz", "between 0 (none) and 1e6", view_rate_hz)


def part_of(path: Path) -> Path:
    """Name of a recording while it is being written."""
    return path.with_name(path.name + PART_SUFFIX)


@dataclass(slots=True)
class _Topic:
    """One topic of the file, with what is needed to derive view messages from it."""

    channel: int
    schema: str | None = None
    sequence: int = 0
    group: Group | None = None


class _ChunkIndexes:
    """The index of a file's chunks, read off the file when it is finished: kept in memory it would grow with it.

    Args:
        file: The file in the making.
    """

    _RECORD, _CHUNK, _CHANNEL = struct.Struct("<BQ"), struct.Struct("<QQQII"), struct.Struct("<H")

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def append(self, index: ChunkIndex) -> None:
        """Keep nothing."""

    def __iter__(self) -> Iterator[ChunkIndex]:
        from mcap.opcode import Opcode
        from mcap.records import ChunkIndex
        from mcap.stream_reader import MAGIC_SIZE

        self._file.flush()
        number, position = self._file.fileno(), MAGIC_SIZE
        index = None
        while head := os.pread(number, 100, position):
            kind, length = self._RECORD.unpack_from(head)
            body, whole = self._RECORD.size, self._RECORD.size + length
            if kind == Opcode.MESSAGE_INDEX and index is not None:
                index.message_index_offsets[self._CHANNEL.unpack_from(head, body)[0]] = position
                index.message_index_length += whole
            elif index is not None:
                yield index
                index = None
            if kind == Opcode.CHUNK:
                first, last, raw_size, _, letters = self._CHUNK.unpack_from(head, body)
                data = body + self._CHUNK.size + letters
                index = ChunkIndex(
                    message_start_time=first,
                    message_end_time=last,
                    chunk_start_offset=position,
                    chunk_length=whole,
                    message_index_offsets={},
                    message_index_length=0,
                    compression=head[data - letters : data].decode(),
                    compressed_size=length - (data - body) - 8,
                    uncompressed_size=raw_size,
                )
            position += whole


class RecordingWriter:
    """Writes payloads as they came, the view messages derived from them, gaps and clock pairs.

    `log_time` of every message is simulated time [ns], so that plots align with the physics and two recordings with
    each other; `publish_time` is the wall time of arrival [unix ns]. Each message is thus a clock pair;
    `recorder/clock` repeats two a second in plain JSON.

    The file is FILE.mcap.part until `finish`, and is flushed to the disk so often that a kill loses less than 0.5 s.
    """

    def __init__(
        self,
        path: Path,
        *,
        catalogue: dict[str, Any],
        parameters: dict[str, Any],
        scene: dict[str, Any],
        view_rate_hz: float = 500.0,
        from_start: bool = False,
        force: bool = False,
        due: dict[str, int] | None = None,
        metadata: dict[str, dict[str, str]] | None = None,
        attachments: dict[str, bytes] | None = None,
        sync_every_s: float = 0.25,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create the file and write calibration, parameters and scene to it.

        Args:
            path: File name, ends in .mcap.
            catalogue: The rig's catalogue document: channel table, truth tables, tick rate.
            parameters: The rig's parameter document.
            scene: The rig's scene document.
            view_rate_hz: Rate of the plottable messages [Hz of simulated time]; 0 writes none.
            from_start: Every stream is meant to be recorded from its row 0: what is missing there is a gap, too.
            force: Replace an existing file.
            due: Number of the row that is to come first, by key, where this file goes on from another one.
            metadata: More metadata records for the start of the file, by name; entries under `rig` replace its own.
            attachments: More attachments, by name.
            sync_every_s: Longest time between two flushes to the disk while messages arrive [s].
            wall_ns: Wall clock [unix ns].
            monotonic_s: Clock that times the flushes [s].

        Raises:
            InputError: The destination, the view rate or the catalogue cannot be used.
        """
        check_view_rate(view_rate_hz)
        check_destination(path, force=force)
        self.path = path
        self.part = part_of(path)
        try:
            self.table = ChannelTable.model_validate(catalogue["table"])
            self.tick_rate_hz = round(catalogue["tick_rate_hz"])
            if self.tick_rate_hz < 1:
                raise ValueError(f"tick rate {self.tick_rate_hz}")
        except (KeyError, TypeError, ValueError) as error:
            raise InputError("catalogue", "a document with a channel table and a tick rate", str(error)) from None
        self.view_rate_hz = view_rate_hz
        self._views = Views(self.table, rate_hz=view_rate_hz)
        self.continuity = Continuity()
        self.gaps = 0
        """Steps of the row numbers."""
        self.missed: dict[str, int] = {}
        """Messages that the transport reported as lost for good, by key."""
        self.malformed = 0
        self.first_time_ns: int | None = None
        self.last_time_ns = 0
        """Simulated time of the latest row [ns]."""
        self.messages = 0
        self.size_bytes = 0
        """Size of the file at the last flush."""
        self._from_start = from_start
        self._force = force
        self._truth = catalogue.get("truth", {})
        self._sync_every_s = sync_every_s
        self._wall_ns = wall_ns
        self._monotonic_s = monotonic_s
        self._synced_s = monotonic_s()
        self._safe_time_ns = 0
        self._clock_ns = 0
        self._chunks = 0
        self._chunk_bytes = 0
        self._unflushed_bytes = 0
        self._begun = False
        self._topics: dict[str, _Topic] = {}
        self._schema_ids: dict[str, int] = {}
        for key, index in (due or {}).items():
            self.continuity.follow(key, index, 0)
        try:
            self._file = _open_part(self.part, replace=force)
        except OSError as error:
            raise InputError("output", "a file that can be written", f"{self.part} ({error.strerror})") from None
        from mcap.writer import Writer as McapWriter

        mcap = McapWriter(self._file, chunk_size=_CHUNK_BYTES, enable_data_crcs=True)
        mcap._Writer__chunk_indices = _ChunkIndexes(self._file)  # type: ignore[attr-defined]
        self._mcap: Writer | None = mcap
        with self._guard():
            mcap.start(profile="ros2", library="rotor-stator-rig recorder")
            self._write_head(catalogue, parameters, scene, metadata or {}, attachments or {})
            for group in self.table.groups:
                self._topic(sensor_key(group))
            for table in self._truth:
                self._topic(truth_key(table))
            for key in (EDGES, EVENTS, schemas.GAPS, schemas.CLOCK):
                self._topic(key)
            for view in self._views.all:
                about = {
                    "sources": json.dumps([sensor_key(group) for group in view.groups]),
                    "rate_hz": f"{view_rate_hz:g}",
                    "filter": "none: every n-th row",
                    "names": json.dumps(view.names),
                    "arrays": json.dumps(view.slots),
                }
                self._topics[view.topic] = self._channel(view.topic, schemas.JOINT_STATE_SCHEMA, about)
            if view_rate_hz:
                self._view_events = self._channel(schemas.VIEW_EVENTS, schemas.LOG_SCHEMA, {"source": EVENTS})
            self._sync()
            _sync_folder(self.part.parent)
            self._begun = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if self._mcap is not None:
            self.finish("closed" if kind is None else f"failed: {error or kind.__name__}")

    @property
    def index_bytes(self) -> int:
        """About what the index at the end of the file will take: it names each chunk, and each topic in it [bytes]."""
        return (60 + 10 * len(self._topics)) * self._chunks

    @property
    def unflushed_bytes(self) -> int:
        """What waits in memory for the next flush, not yet compressed [bytes]."""
        return self._unflushed_bytes

    @property
    def final_bytes(self) -> int:
        """What the file comes to at most if it is finished now [bytes]."""
        return self.size_bytes + self._unflushed_bytes + self.index_bytes + _END_BYTES

    @property
    def streams(self) -> set[str]:
        """Keys of the streams that the catalogue promises."""
        return {sensor_key(group) for group in self.table.groups} | {truth_key(table) for table in self._truth}

    @property
    def next_index(self) -> dict[str, int]:
        """Number of the row that is due next, by key."""
        return self.continuity.next

    @property
    def closed(self) -> bool:
        """Nothing more can be written: finished, or ended by the disk."""
        return self._mcap is None

    def write(self, key: str, payload: bytes, wall_ns: int) -> dict[str, Any] | None:
        """Write one payload, byte for byte, and what derives from it.

        Args:
            key: Key that it came on.
            payload: Its bytes.
            wall_ns: Wall time of its arrival [unix ns].

        Returns:
            The document, if it is one.

        Raises:
            RecordingError: The disk refused; the file is closed and what stood in it is kept.
        """
        with self._guard():
            topic = self._topic(key)
            document = block = None
            try:
                if topic.schema is None:
                    document = document_in(key, payload)
                else:
                    block = block_in(key, payload)
            except ValueError:
                # Not what the key promises: kept as it came, counted, and left to the reader to judge.
                self.malformed += 1
                self._add(topic, payload, self.last_time_ns, wall_ns)
            if document is not None:
                self._write_document(topic, key, payload, document, wall_ns)
            elif block is not None:
                self._write_block(topic, key, payload, block, wall_ns)
            self._sync_if_due()
        return document

    def write_missed(self, key: str, messages: int, wall_ns: int) -> None:
        """Record that the transport lost messages for good.

        Lost rows of block streams show as a step of the row number as well, and are counted there; this is the only
        trace of lost documents and of blocks that were the last of their stream.

        Args:
            key: Key of the stream.
            messages: Number of messages.
            wall_ns: Wall time of the report [unix ns].
        """
        self.missed[key] = self.missed.get(key, 0) + messages
        with self._guard():
            self._write_gap({"kind": "messages", "key": key, "index": -1, "size": messages}, wall_ns)

    def counts(self) -> Counts:
        """What was written so far; from any thread."""
        return Counts(
            first_time_ns=self.first_time_ns,
            last_time_ns=self.last_time_ns,
            rows=dict(self.continuity.received),
            lost=dict(self.continuity.lost),
            gaps=self.gaps,
            missed=dict(self.missed),
            malformed=self.malformed,
            size_bytes=self.size_bytes,
            safe_time_ns=self._safe_time_ns,
        )

    def short_of(self, rows: dict[str, int]) -> dict[str, int]:
        """Streams that have not come to the end of what was published.

        Args:
            rows: Number of the row after the last one published, by key.

        Returns:
            The same for the streams that were met and are short of it.
        """
        due = dict(self.continuity.next)
        return {key: end for key, end in rows.items() if due.get(key, end) < end}

    def note_short(self, rows: dict[str, int], wall_ns: int) -> None:
        """Record as gaps what is missing at the end of streams.

        Args:
            rows: Number of the row after the last one published, by key.
            wall_ns: Wall time [unix ns].
        """
        with self._guard():
            for key, end in self.short_of(rows).items():
                gap = self.continuity.follow(key, end, 0)
                if gap is not None:
                    self._note_gap(gap, wall_ns)

    def sync_if_due(self) -> None:
        """Flush to the disk if the last flush was long enough ago."""
        with self._guard():
            self._sync_if_due()

    def sync(self) -> None:
        """Flush to the disk now."""
        with self._guard():
            self._sync()

    def abandon(self) -> None:
        """Close without finishing and remove what was written; a file that was to be replaced stays."""
        if self._mcap is None:
            return
        self._mcap = None
        self._file.close()
        self.part.unlink(missing_ok=True)

    def finish(self, reason: str, *, notes: dict[str, str] | None = None) -> None:
        """Write the closing counts, close the file and give it its final name.

        Args:
            reason: Why the recording ended.
            notes: More entries for the closing metadata.

        Raises:
            RecordingError: The disk refused; the .part file is kept.
        """
        if self._mcap is None:
            return
        with self._guard():
            for view in self._views.all:
                self._add_view(view, view.rest(), self._wall_ns())
            self._mcap.add_metadata("end", self._end_metadata(reason) | (notes or {}))
            self._mcap.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._check_name()
            self.size_bytes = self._file.tell()
            self._file.close()
            if self.path.exists() and not self._force:
                raise FileExistsError(errno.EEXIST, f"{self.path} was created by someone else meanwhile")
            self.part.replace(self.path)
            self._safe_time_ns = self.last_time_ns
            self._mcap = None
        _sync_folder(self.path.parent)

    @contextlib.contextmanager
    def _guard(self) -> Iterator[None]:
        """Turn a refusal of the disk into one clear error, with the file closed behind it."""
        if self._mcap is None:
            raise RecordingError(f"recording {self.path} is closed")
        try:
            yield
        except OSError as error:
            self._mcap = None
            with contextlib.suppress(OSError):
                self._file.close()
            kept = f"what was written before is kept in {self.part}; `rig recover` makes a finished file of it"
            if not self._begun:
                # Without its calibration it is of no use to anybody.
                self.part.unlink(missing_ok=True)
                kept = f"{self.part} could not be begun"
            elif not self.part.exists():
                kept = f"nothing is left at {self.part}"
            raise RecordingError(f"recording stopped by the disk: {error.strerror or error}; {kept}") from error

    def _check_name(self) -> None:
        """See that the file still has its name: a removed one can be written to, and is gone when it is closed.

        Raises:
            OSError: It was removed; it has been copied to the nearest folder that still exists, where that was
                possible.
        """
        if os.fstat(self._file.fileno()).st_nlink:
            return
        gone = self.part
        folder = next(folder for folder in gone.absolute().parents if folder.is_dir())
        with contextlib.suppress(OSError):
            self.part = folder / gone.name
            with self.part.open("xb") as copy:
                position = 0
                while data := os.pread(self._file.fileno(), 1 << 20, position):
                    copy.write(data)
                    position += len(data)
        raise OSError(errno.ENOENT, f"{gone} was removed while it was written")

    def _write_head(
        self,
        catalogue: dict[str, Any],
        parameters: dict[str, Any],
        scene: dict[str, Any],
        metadata: dict[str, dict[str, str]],
        more: dict[str, bytes],
    ) -> None:
        assert self._mcap is not None
        now = self._wall_ns()
        about = {
            "format": schemas.FORMAT,
            "version": schemas.VERSION,
            "created": datetime.fromtimestamp(now / NS, tz=UTC).isoformat(),
            "log_time": "simulated time [ns]",
            "publish_time": "wall time of arrival [unix ns]",
            "tick_rate_hz": str(self.tick_rate_hz),
            "scene": str(scene.get("name", "")),
            "seed": str(scene.get("seed", "")),
            "parameter_set": str(parameters.get("set", "")),
            "view_rate_hz": f"{self.view_rate_hz:g}",
            **metadata.get("rig", {}),
        }
        metadata = {**metadata, "rig": about}
        for name in dict.fromkeys(["rig", *metadata]):
            self._mcap.add_metadata(name, metadata[name])
        attachments = {
            COPY: metadata,
            "catalogue.json": catalogue,
            "parameters.json": parameters,
            "scene.json": scene,
        }
        self._mcap.add_attachment(now, 0, "README.txt", "text/plain", self._readme(catalogue).encode())
        for name, document in attachments.items():
            text = json.dumps(document, indent=1, allow_nan=False)
            self._mcap.add_attachment(now, 0, name, "application/json", text.encode())
        for name, data in more.items():
            self._mcap.add_attachment(now, 0, name, "application/octet-stream", data)

    def _end_metadata(self, reason: str) -> dict[str, str]:
        first = 0 if self.first_time_ns is None else self.first_time_ns
        return {
            "reason": reason,
            "ended": datetime.fromtimestamp(self._wall_ns() / NS, tz=UTC).isoformat(),
            "first_time_s": f"{first / NS:.9f}",
            "last_time_s": f"{self.last_time_ns / NS:.9f}",
            "rows": json.dumps(self.continuity.received),
            "lost_rows": json.dumps({key: lost for key, lost in self.continuity.lost.items() if lost}),
            "gaps": str(self.gaps),
            "missed_messages": json.dumps(self.missed),
            "malformed": str(self.malformed),
        }

    def _schema_id(self, name: str, encoding: str, definition: bytes) -> int:
        assert self._mcap is not None
        if name not in self._schema_ids:
            self._schema_ids[name] = self._mcap.register_schema(name, encoding, definition)
        return self._schema_ids[name]

    def _channel(self, topic: str, schema: str | None, metadata: dict[str, str]) -> _Topic:
        assert self._mcap is not None
        definitions = {
            **SCHEMAS,
            schemas.JOINT_STATE_SCHEMA: schemas.JOINT_STATE_DEFINITION,
            schemas.LOG_SCHEMA: schemas.LOG_DEFINITION,
        }
        if schema is None:
            name, definition = schemas.DOCUMENT_SCHEMAS.get(topic, schemas.ANY_DOCUMENT)
            encoding, number = "json", self._schema_id(name, "jsonschema", definition)
        else:
            encoding, number = "cdr", self._schema_id(schema, "ros2msg", definitions[schema].encode())
        return _Topic(channel=self._mcap.register_channel(topic, encoding, number, metadata), schema=schema)

    def _topic(self, key: str) -> _Topic:
        """The topic of a key, registered with its calibration when it is first met."""
        topic = self._topics.get(key)
        if topic is not None:
            return topic
        schema = schema_of(key)
        group = self.table.groups.get(key.removeprefix(SENSORS + "/")) if key.startswith(SENSORS + "/") else None
        if group is not None:
            topic = self._channel(key, schema, _calibration(group))
            topic.group = group
        elif key == EDGES:
            about = {"names": '["edge"]', "units": '["ticks after `tick`"]'}
            topic = self._channel(key, schema, about)
        elif schema is not None:
            columns = self._truth.get(key.removeprefix(TRUTH + "/"), {}).get("columns", [])
            about = {
                field + "s": json.dumps([column.get(field, "") for column in columns])
                for field in ("name", "unit", "label")
            }
            topic = self._channel(key, schema, about)
        else:
            topic = self._channel(key, None, {})
        self._topics[key] = topic
        return topic

    def _add(self, topic: _Topic, payload: bytes, time_ns: int, wall_ns: int) -> None:
        assert self._mcap is not None
        self._mcap.add_message(topic.channel, time_ns, payload, wall_ns, topic.sequence)
        topic.sequence = (topic.sequence + 1) & 0xFFFFFFFF
        self.messages += 1
        self._chunk_bytes += len(payload)
        self._unflushed_bytes += len(payload) + _MESSAGE_BYTES
        if self._chunk_bytes >= _CHUNK_BYTES:
            self._chunks += 1
            self._chunk_bytes = 0

    def _time_ns(self, tick: int) -> int:
        """Simulated time of a tick as a message can have it: of one that no clock has, the last one there is [ns]."""
        return max(0, min(tick * NS // self.tick_rate_hz, 1 << 62))

    def _write_block(self, topic: _Topic, key: str, payload: bytes, block: Block, wall_ns: int) -> None:
        time_ns = self._time_ns(block.tick)
        rows = len(block.values)
        if self._from_start and key not in self.continuity.next:
            self.continuity.follow(key, 0, 0)
        gap = self.continuity.follow(key, block.index, rows)
        if gap is not None:
            self._note_gap(gap, wall_ns, time_ns=time_ns)
        self._add(topic, payload, time_ns, wall_ns)
        self.first_time_ns = time_ns if self.first_time_ns is None else min(time_ns, self.first_time_ns)
        if key != EDGES and block.rate_hz > 0.0:
            self.last_time_ns = max(self.last_time_ns, time_ns + round((rows - 1) * NS / block.rate_hz))
        if topic.group is None:
            return
        since_ns = wall_ns - self._clock_ns
        if since_ns >= NS // 2 or since_ns < -_SET_BACK_NS:
            self._clock_ns = wall_ns
            pair = {"tick": block.tick, "time_s": time_ns / NS, "wall_s": wall_ns / NS}
            self._add(self._topics[schemas.CLOCK], encode_document(pair), time_ns, wall_ns)
        shown = self._views.add(topic.group, block, time_ns)
        if shown is not None:
            self._add_view(*shown, wall_ns)

    def _add_view(self, view: View, messages: Messages, wall_ns: int) -> None:
        assert self._mcap is not None
        if not len(messages):
            return
        topic = self._topics[view.topic]
        data, size = messages.data.tobytes(), messages.data.shape[1]
        for number, time_ns in enumerate(messages.times_ns.tolist()):
            self._add(topic, data[number * size : (number + 1) * size], time_ns, wall_ns)

    def _write_document(self, topic: _Topic, key: str, payload: bytes, document: dict[str, Any], wall_ns: int) -> None:
        tick = tick_in(document)
        time_ns = self.last_time_ns if tick is None else self._time_ns(tick)
        self._add(topic, payload, time_ns, wall_ns)
        if key == EVENTS and self.view_rate_hz:
            level, text = schemas.event_text(document)
            self._add(self._view_events, schemas.encode_log(time_ns, level, key, text), time_ns, wall_ns)

    def _note_gap(self, gap: Gap, wall_ns: int, *, time_ns: int | None = None) -> None:
        self.gaps += 1
        about = {"kind": "rows", "key": gap.key, "index": gap.index, "size": gap.size}
        self._write_gap(about, wall_ns, time_ns=time_ns)

    def _write_gap(self, about: dict[str, Any], wall_ns: int, *, time_ns: int | None = None) -> None:
        at_ns = self.last_time_ns if time_ns is None else time_ns
        document = {**about, "time_s": at_ns / NS, "wall_s": wall_ns / NS}
        self._add(self._topics[schemas.GAPS], encode_document(document), at_ns, wall_ns)

    def _sync_if_due(self) -> None:
        if self._monotonic_s() - self._synced_s >= self._sync_every_s:
            self._sync()

    def _sync(self) -> None:
        assert self._mcap is not None
        for view in self._views.all:
            self._add_view(view, view.settled(), self._wall_ns())
        self._mcap.flush()
        self._chunks += 1
        os.fsync(self._file.fileno())
        self._check_name()
        self.size_bytes = self._file.tell()
        self._unflushed_bytes = self._chunk_bytes = 0
        self._safe_time_ns = self.last_time_ns
        self._synced_s = self._monotonic_s()

    def _readme(self, catalogue: dict[str, Any]) -> str:
        lines = [_README]
        for group in self.table.groups.values():
            lines.append(f"\n{sensor_key(group.name)}: {group.title}; {group.rate_hz} Hz")
            lines += [
                f"  {channel.name} [{channel.unit}] = counts * {channel.scale:.9g} + {channel.offset:.9g}"
                f"   (volts = counts * {channel.lsb_v:.9g}; {channel.sensitivity_v:g} V per {channel.unit}, "
                f"{channel.bias_v:g} V at 0)   {channel.label}"
                for channel in group.channels
            ]
        for table, about in self._truth.items():
            lines.append(f"\n{truth_key(table)}: {about.get('rate_hz', '?')} Hz")
            lines += [
                f"  {column.get('name', '?')} [{column.get('unit', '?')}]   {column.get('label', '')}"
                for column in about.get("columns", [])
            ]
        reference = catalogue.get("reference", {})
        lines += [f"\n{name}: {text}" for name, text in reference.items()]
        return "\n".join(lines) + "\n"


def _calibration(group: Group) -> dict[str, str]:
    """Channel metadata: one JSON list a property, in column order."""
    channels = group.channels
    lists = {
        "names": [channel.name for channel in channels],
        "units": [channel.unit for channel in channels],
        "scales": [channel.scale for channel in channels],
        "offsets": [channel.offset for channel in channels],
        "volts_per_count": [channel.lsb_v for channel in channels],
        "labels": [channel.label for channel in channels],
    }
    about = {name: json.dumps(values) for name, values in lists.items()}
    return {**about, "rate_hz": str(group.rate_hz), "formula": "value [unit] = counts * scale + offset"}


_README = """\
A recording of the virtual rotor-stator rig.

log_time is simulated time in ns, publish_time the wall time of arrival in unix ns.

rig/sensors/GROUP: rig_msgs/msg/SampleBlock (ROS 2 CDR, its definition is in the file). int32 ADC counts, row after row,
    `columns` values a row, `rate_hz` rows a second; the first is number `index`, at `tick` / `tick_rate_hz` seconds.
    value = counts * scale + offset, from the channel's metadata (JSON lists in column order) or the table below.
rig/sensors/keyphasor_edges: rig_msgs/msg/TruthBlock of one column; edges at (`tick` + value) / `tick_rate_hz` seconds.
rig/truth/TABLE: rig_msgs/msg/TruthBlock, float64 rows of the model's true state; units in the channel's metadata.
rig/events, rig/status: JSON, as the rig published them.
recorder/gaps: JSON, what never arrived: `size` rows from number `index` on, or `size` messages (kind "messages").
    No message there means that nothing was lost.
recorder/clock: JSON, pairs of simulated and wall time.
view/GROUP+GROUP: sensor_msgs/msg/JointState in engineering units at the viewing rate, every n-th row without a filter:
    for plots only. Lengths stand in `position`, forces in `effort`, all else in `velocity`; nan elsewhere.
view/events: rcl_interfaces/msg/Log of rig/events.

Attachments: catalogue.json (channel table with calibration), parameters.json, scene.json; metadata.json repeats the
    metadata at the start, which have no checksum of their own. The whole has one too (`data_section_crc`).
Metadata "rig" opens the file; metadata "end" closes it with the end reason and the counts.
Metadata "series": one of several files in a row; its number, the file before it, and the row due of each stream.
Metadata "trigger": recorded around a trigger only; what ended it stands in "end".
"cut", "recovered": what this file was made of.
A file without "end" was cut off; what stands in it is good.
"""
