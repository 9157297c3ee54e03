"""Reads a recording: finished ones, and what a kill or a full disk left of one."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import BaseModel

from recorder import documents, schemas
from recorder.payload import block_in
from recorder.records import COPY, MAGIC, Chunk, DamagedError, messages, read_contents, unpack
from rig.errors import InputError
from rig.outside import open_file, read_json
from rig.wire import (
    EDGES,
    EVENTS,
    STATUS,
    Block,
    Continuity,
    Gap,
    schema_of,
    sensor_key,
    truth_key,
)

_MOST_KEPT = 64 << 20
"""Documents of one kind that are kept in memory [bytes]."""
_LEAST_SPAN_S = 0.5
"""A stream without rows in a recording of this length is told; in a shorter one it may not have begun."""
_OFF_RATE = 1e-3
"""Part by which the rate of a block may be off that of its stream: an import's is a whole number."""
_OURS = "a recording made by `rig record`"


@dataclass(frozen=True)
class Samples:
    """One sensor group or truth table as columns.

    Attributes:
        name: Name of the group or table.
        times_s: Simulated time of each row [s], shape (n,).
        index: Number of each row since the start of the stream, int64, shape (n,); a step other than 1 is a gap.
        values: Engineering values, shape (n, columns).
        names: Column names.
        units: Column units.
        rate_hz: Rows per simulated second [Hz].
    """

    name: str
    times_s: np.ndarray
    index: np.ndarray
    values: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]
    rate_hz: float

    def column(self, name: str) -> np.ndarray:
        """Values of one column, shape (n,).

        Raises:
            InputError: There is no such column.
        """
        if name not in self.names:
            raise InputError("column", f"one of {', '.join(self.names)}", name)
        return self.values[:, self.names.index(name)]


@dataclass(frozen=True)
class Stream:
    """What a recording holds of one block stream.

    Attributes:
        messages: Number of blocks.
        rows: Number of rows in them.
        lost: Number of rows missing between them, counted anew from the row numbers.
        first_time_s: Simulated time of the first row [s].
        last_time_s: Simulated time of the last row [s].
        first: Number of the first row.
        due: Number of the row after the last one.
        odd: Number of payloads that are no blocks, or do not fit the catalogue.
        back: Number of blocks that begin before the row that was due.
        off: Number of blocks at another rate than the catalogue says.
        missing: Rows that the file says it has, or the rig that it made, and that are not there.
    """

    messages: int = 0
    rows: int = 0
    lost: int = 0
    first_time_s: float = 0.0
    last_time_s: float = 0.0
    first: int = 0
    due: int = 0
    odd: int = 0
    back: int = 0
    off: int = 0
    missing: int = 0


class Recording:
    """One recording, read topic by topic from the disk; nothing but documents is kept in memory.

    Attributes:
        path: The file.
        complete: The file was finished; False for a .part file or one that was cut off, of which everything up to the
            last whole message is read.
        damaged: Records that are not what was written, and are passed over by whoever salvages; else 0.
        unchecked: What of it no checksum covers.
        catalogue: The rig's catalogue document.
        table: The channel table in it.
        parameters: The rig's parameter document.
        scene: The rig's scene document.
        metadata: Metadata records by name: `rig` (start), `end` (closing counts, only if complete).
        messages: Number of messages by topic.
    """

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        """Scan the records of a file; `Recording.open` reads the same.

        Args:
            path: The file.
            salvage: Take what can be read of a finished file, too, where it is damaged.
        """
        self.path = path
        try:
            with open_file(path) as file, self._intact():
                if file.read(len(MAGIC)) != MAGIC:
                    raise InputError("file", _OURS, f"{path}, which is no MCAP file")
                found = read_contents(file, path.stat().st_size, salvage=salvage)
                self._take_metadata(found.metadata, found.attachments.get(COPY), salvage=salvage)
        except OSError as error:
            raise _unreadable(path, error) from None
        self.complete = found.complete
        self.damaged += found.damaged
        self.unchecked = found.unchecked
        self._attachments, self._chunks, self._topics = found.attachments, found.chunks, found.topics
        self._told_rows: dict[str, int] = {}
        with contextlib.suppress(InputError):
            told = found.metadata.get("end", {}) if found.finished else {}  # one that was cut off lacks what it lacks
            end = documents.told(documents.End, told, field="end")
            self._told_rows = read_json(end.rows.encode())
        self.messages = {self._topics[number]: count for number, count in sorted(found.counts.items())}
        if len(set(self._topics.values())) < len(self._topics):
            raise InputError("file", "a recording with each channel once", str(path))
        about = self.metadata.get("rig", {})
        if about.get("format") != schemas.FORMAT:
            raise InputError("file", _OURS, str(path))
        documents.check_version(about)
        for name, model in documents.METADATA.items():
            if name in self.metadata:
                documents.told(model, self.metadata[name], field=f"{path.name}: {name}")
        payloads = {name: self._attachments.get(f"{name}.json") for name in documents.ATTACHED}
        if None in payloads.values():
            # Where it is damaged it is not there either.
            must = "a recording with its calibration; this one was cut off in it, or damaged"
            raise InputError("file", must, str(path))
        read = {
            name: documents.read(model, payloads[name] or b"", field=f"{path.name}: {name}.json")
            for name, model in documents.ATTACHED.items()
        }
        if self.damaged and not salvage:
            must = "an intact recording (`rig recover` passes over what is damaged)"
            raise InputError("file", must, f"{path}, with {self.damaged} damaged records")
        self.catalogue, self.parameters, self.scene = (read[name][0] for name in ("catalogue", "parameters", "scene"))
        catalogue = read["catalogue"][1]
        assert isinstance(catalogue, documents.Catalogue)
        self.table = catalogue.table

    def _take_metadata(self, found: dict[str, dict[str, str]], copy: bytes | None, *, salvage: bool) -> None:
        """Believe the copy that has a checksum, where a file has one."""
        self.damaged, self.metadata = 0, found
        if copy is None:
            return
        told = read_json(copy, field=COPY)
        if {name: found.get(name) for name in told} != told:
            self.damaged = 1
        self.metadata = {**({"end": found["end"]} if "end" in found and not salvage else {}), **told}

    @classmethod
    def open(cls, path: Path | str) -> Self:
        """Open a recording, finished or cut off.

        Raises:
            InputError: The file cannot be read, or is no recording.
        """
        return cls(Path(path))

    @property
    def attachments(self) -> dict[str, bytes]:
        """All attachments by name; catalogue, parameters and scene are among them."""
        return dict(self._attachments)

    @property
    def parts(self) -> tuple[Recording, ...]:
        """The files that it is read from."""
        return (self,)

    @property
    def chunks(self) -> tuple[Chunk, ...]:
        """Where its messages are, in file order, for who reads from somewhere in the middle; see `read`."""
        return tuple(self._chunks)

    @property
    def end_reason(self) -> str:
        """Why the recording ended."""
        if self.complete:
            return self.metadata.get("end", {}).get("reason", "unknown")
        return "cut off: the recorder did not finish the file"

    @property
    def span_s(self) -> tuple[float, float] | None:
        """Simulated times of the first and the last row, without a look at the samples [s]; None if there is none.

        As the recorder counted them; of a file that it did not finish those of its messages, which is to the block.
        """
        if self.complete:
            end = self.metadata.get("end", {})
            if not {"first_time_s", "last_time_s"} <= set(end) or end.get("rows", "{}") == "{}":
                return None
            return float(end["first_time_s"]), float(end["last_time_s"])
        if not self._chunks:
            return None
        return min(each.begin_ns for each in self._chunks) / 1e9, max(each.end_ns for each in self._chunks) / 1e9

    @cached_property
    def events(self) -> list[dict[str, Any]]:
        """The rig's events, in order of arrival."""
        return [event for _, event in self._documents(EVENTS, documents.Event)]

    @cached_property
    def last_status(self) -> dict[str, Any] | None:
        """The last of the rig's status documents; None without one."""
        last = None
        for _, document in self._documents(STATUS, documents.Status):
            last = document
        return last

    @cached_property
    def gaps(self) -> list[Gap]:
        """Losses that the recorder noted; index -1 where it is messages that are counted, not rows."""
        return [gap for _, gap in self.timed_gaps]

    @cached_property
    def timed_gaps(self) -> list[tuple[float, Gap]]:
        """The same with the simulated time at which each was noted [s]."""
        found = self._documents(schemas.GAPS, documents.Gap)
        return [(time_ns / 1e9, Gap(gap["key"], gap["index"], gap["size"])) for time_ns, gap in found]

    @cached_property
    def clock(self) -> np.ndarray:
        """Pairs of simulated time and wall time of arrival [s, unix s], shape (n, 2)."""
        found = self._documents(schemas.CLOCK, documents.ClockPair)
        return np.array([(pair["time_s"], pair["wall_s"]) for _, pair in found], dtype=float).reshape(-1, 2)

    @cached_property
    def streams(self) -> dict[str, Stream]:
        """Extent of every block stream by key, counted from the blocks."""
        return self._survey[0]

    @cached_property
    def short(self) -> tuple[str, ...]:
        """Rows that the file says it has, and that are not there though all of it is as it was written."""
        found = [f"{one.missing} rows of {key} are missing" for key, one in self._survey[0].items() if one.missing]
        return tuple(found)

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """What in the file does not fit the rest of it though every checksum holds, in a line each."""
        streams, counted = self._survey
        found = list(self.short)
        for key, stream in streams.items():
            if stream.odd:
                found.append(f"payloads of {key} that are no blocks, or do not fit the catalogue: {stream.odd}")
            if stream.back:
                found.append(f"blocks of {key} that repeat row numbers, or go back: {stream.back}")
            if stream.off:
                found.append(f"blocks of {key} at another rate than the catalogue says: {stream.off}")
            if stream.rows > (told := self._told_rows.get(key, stream.rows)):
                found.append(f"{key} has {stream.rows} rows where the file says {told}")
            if stream.rows and key not in self._widths:
                found.append(f"{key} is not in the catalogue")
        for topic in sorted(set(self.messages) | set(counted)):
            if (is_there := counted.get(topic, 0)) != (told := self.messages.get(topic, 0)):
                found.append(f"{is_there} messages of {topic} where the file says {told}")
        filled = [stream for stream in streams.values() if stream.rows]
        span_s = max((one.last_time_s for one in filled), default=0.0) - min(
            (one.first_time_s for one in filled), default=0.0
        )
        for key in sorted(set(self._widths) - {EDGES} - {key for key, one in streams.items() if one.rows}):
            if span_s > max(_LEAST_SPAN_S, 2.0 / self._rates[key]):
                found.append(f"no rows of {key}, which the catalogue promises")
        return tuple(found)

    @cached_property
    def _survey(self) -> tuple[dict[str, Stream], dict[str, int]]:
        """Extent of every block stream by key, and messages by topic, counted from what is there."""
        continuity = Continuity()
        streams: dict[str, Stream] = {}
        counted: dict[str, int] = {}
        extents: dict[str, list[float]] = {}
        starts: dict[str, int] = {}
        for key, _, payload in self._messages(set(self._topics.values())):
            counted[key] = counted.get(key, 0) + 1
            if schema_of(key) is None:
                continue
            stream = streams.setdefault(key, Stream())
            block = self._block(key, payload)
            if block is None:
                streams[key] = replace(stream, odd=stream.odd + 1)
                continue
            starts.setdefault(key, block.index)
            gap = continuity.follow(key, block.index, len(block.values))
            back = gap is not None and gap.size < 0
            off = stream.off + (abs(block.rate_hz / self._rates.get(key, block.rate_hz or 1.0) - 1.0) > _OFF_RATE)
            off = 0 if key == EDGES else off
            streams[key] = replace(stream, messages=stream.messages + 1, back=stream.back + back, off=off)
            if len(block.values):
                times_s = self._row_times_s(key, block)
                extents.setdefault(key, [times_s[0], times_s[-1]])[1] = times_s[-1]
        told = self._told_rows
        ends = self._published_rows()
        for key in set(streams) | {key for key, rows in told.items() if rows}:
            rows, due = continuity.received.get(key, 0), continuity.next.get(key, 0)
            first_s, last_s = extents.get(key, (0.0, 0.0))
            short = ends.get(key, due) - due if key in continuity.next else 0
            streams[key] = replace(
                streams.get(key, Stream()), rows=rows, lost=continuity.lost.get(key, 0), first_time_s=float(first_s),
                last_time_s=float(last_s), first=starts.get(key, 0), due=due,
                missing=max(0, told.get(key, rows) - rows, short),
            )  # fmt: skip
        return dict(sorted(streams.items())), counted

    def _published_rows(self) -> dict[str, int]:
        """Number of the row after the last one that the rig published, by key; without losses that are noted.

        Empty where the file does not go to the end of a run.
        """
        runs = [event for event in self.events if event["event"] in ("start", "end")]
        if not runs or runs[-1]["event"] == "start" or {"trigger", "cut"} & set(self.metadata):
            return {}
        noted = {(gap.key, gap.index + gap.size) for gap in self.gaps if gap.index >= 0}
        return {key: due for key, due in (runs[-1].get("rows") or {}).items() if (key, due) not in noted}

    def samples(self, group: str) -> Samples:
        """A sensor group in engineering units, in order of arrival.

        Args:
            group: Name of a group of the channel table.

        Raises:
            InputError: The recording has no such group, or the file is damaged.
        """
        if group not in self.table.groups:
            raise InputError("group", f"one of {', '.join(self.table.groups)}", group)
        channels = self.table.groups[group].channels
        scales = np.array([channel.scale for channel in channels])
        offsets = np.array([channel.offset for channel in channels])
        return self._columns(
            name=group,
            key=sensor_key(group),
            names=tuple(channel.name for channel in channels),
            units=tuple(channel.unit for channel in channels),
            rate_hz=float(self.table.groups[group].rate_hz),
            scales=scales,
            offsets=offsets,
        )

    def truth(self, table: str) -> Samples:
        """A truth table, in order of arrival.

        Args:
            table: Name of a truth table of the catalogue.

        Raises:
            InputError: The recording has no such table, or the file is damaged.
        """
        tables = self.catalogue.get("truth", {})
        if table not in tables:
            raise InputError("truth", f"one of {', '.join(tables)}", table)
        columns = tables[table]["columns"]
        return self._columns(
            name=table,
            key=truth_key(table),
            names=tuple(column["name"] for column in columns),
            units=tuple(column["unit"] for column in columns),
            rate_hz=float(tables[table].get("rate_hz", 0.0)),
        )

    def edges(self) -> np.ndarray:
        """Times of the keyphasor edges, simulated [s], shape (n,)."""
        times = [self._row_times_s(EDGES, block) for block in self.blocks(EDGES)]
        return np.concatenate(times) if times else np.empty(0)

    def blocks(self, key: str) -> Iterator[Block]:
        """The blocks of one stream, in order of arrival; payloads that are no blocks are passed over."""
        for _, payload in self.payloads(key):
            block = self._block(key, payload)
            if block is not None:
                yield block

    def blocks_of(self, keys: set[str]) -> Iterator[tuple[str, Block]]:
        """Keys and blocks of several streams in one pass, in file order; without payloads that are none."""
        for key, _, payload in self._messages(keys):
            block = self._block(key, payload)
            if block is not None:
                yield key, block

    def everything(self) -> Iterator[tuple[str, int, int, bytes]]:
        """Every message in file order: topic, simulated time [ns], wall time of arrival [unix ns] and payload."""
        yield from self._stamped(set(self.messages))

    def read(self, chunk: Chunk) -> Iterator[tuple[str, int, int, bytes]]:
        """The messages of one of its chunks, as `everything` gives them.

        Raises:
            InputError: The file has changed, or cannot be read any more.
        """
        part = self.parts[chunk.part]
        yield from part._read([chunk], part._topics)

    def payloads(self, key: str) -> Iterator[tuple[int, bytes]]:
        """The payloads of one key, byte for byte as they came: pairs of simulated time [ns] and bytes."""
        for _, log_time, payload in self._messages({key}):
            yield log_time, payload

    def _columns(
        self,
        *,
        name: str,
        key: str,
        names: tuple[str, ...],
        units: tuple[str, ...],
        rate_hz: float,
        scales: np.ndarray | None = None,
        offsets: np.ndarray | None = None,
    ) -> Samples:
        blocks = list(self.blocks(key))
        sizes = [len(block.values) for block in blocks]
        values = np.empty((sum(sizes), len(names)))
        times_s = np.empty(len(values))
        index = np.empty(len(values), dtype=np.int64)
        start = 0
        for block, size in zip(blocks, sizes, strict=True):
            rows = slice(start, start + size)
            values[rows] = block.values
            times_s[rows] = block.times_s
            index[rows] = np.arange(block.index, block.index + size)
            start += size
        if scales is not None and offsets is not None:
            values *= scales
            values += offsets
        return Samples(
            name=name,
            times_s=times_s,
            index=index,
            values=values,
            names=names,
            units=units,
            rate_hz=blocks[0].rate_hz if blocks else rate_hz,
        )

    def _row_times_s(self, key: str, block: Block) -> np.ndarray:
        if key == EDGES:
            return (block.tick + block.values[:, 0]) / block.tick_rate_hz
        return block.times_s

    @cached_property
    def _widths(self) -> dict[str, int]:
        """Columns of each stream that the catalogue knows."""
        widths = {sensor_key(name): len(group.channels) for name, group in self.table.groups.items()}
        truth = self.catalogue.get("truth", {})
        return {**widths, **{truth_key(name): len(table["columns"]) for name, table in truth.items()}, EDGES: 1}

    @cached_property
    def _rates(self) -> dict[str, float]:
        """Rows a second of the same, edges aside [Hz]."""
        rates = {sensor_key(name): float(group.rate_hz) for name, group in self.table.groups.items()}
        return {
            **rates,
            **{truth_key(name): table["rate_hz"] for name, table in self.catalogue.get("truth", {}).items()},
        }

    def _block(self, key: str, payload: bytes) -> Block | None:
        if schema_of(key) is None:
            raise InputError("key", "a key of blocks (sensors or truth)", key)
        try:
            block = block_in(key, payload)
        except ValueError:
            return None
        columns = block.values.shape[1]
        fits = columns == self._widths.get(key, columns) and block.tick_rate_hz == self.catalogue["tick_rate_hz"]
        return block if fits else None

    def _documents(self, topic: str, model: type[BaseModel]) -> Iterator[tuple[int, dict[str, Any]]]:
        """Simulated time [ns] and document of each message that is what its key promises."""
        kept = 0
        for time_ns, payload in self.payloads(topic):
            try:
                document, told = documents.read(model, payload, field=topic)
                if isinstance(told, documents.Event) and told.event == "command":
                    documents.read(documents.Command, payload, field=topic)
            except InputError:
                continue
            if topic in (EVENTS, schemas.GAPS) and (kept := kept + len(payload)) > _MOST_KEPT:
                raise InputError("file", f"a recording with at most {_MOST_KEPT} bytes of {topic}", str(self.path))
            yield time_ns, document

    @contextlib.contextmanager
    def _intact(self) -> Iterator[None]:
        """Whatever a damaged file makes the parsers raise becomes one clear error."""
        from mcap.exceptions import McapError

        try:
            yield
        except InputError:
            raise
        except DamagedError as error:
            must = "an intact recording (`rig recover` passes over what is damaged)"
            raise InputError("file", must, f"{self.path} ({error})") from None
        except (McapError, struct.error, ValueError, MemoryError, OverflowError) as error:
            raise InputError("file", "an intact recording", f"{self.path} ({error})") from None

    def _messages(self, topics: set[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time and payload of every message on some topics, in file order."""
        for topic, log_time, _, payload in self._stamped(topics):
            yield topic, log_time, payload

    def _stamped(self, topics: set[str]) -> Iterator[tuple[str, int, int, bytes]]:
        """Topic, log time, publish time and payload of every message on some topics, in file order."""
        wanted = {number: topic for number, topic in self._topics.items() if topic in topics}
        if wanted:
            yield from self._read(self._chunks, wanted)

    def _read(self, chunks: list[Chunk], wanted: dict[int, str]) -> Iterator[tuple[str, int, int, bytes]]:
        """The messages on some channels, of some chunks of this file."""
        try:
            file = open_file(self.path)
        except OSError as error:
            raise _unreadable(self.path, error) from None
        with file, self._intact():
            for chunk in chunks:
                if chunk.channels is not None and chunk.channels.isdisjoint(wanted):
                    continue
                for number, log_time, publish_time, payload in messages(unpack(file, chunk), cut=chunk.cut):
                    if number in wanted:
                        yield wanted[number], log_time, publish_time, payload


def _unreadable(path: Path, error: OSError) -> InputError:
    return InputError("file", "a file that can be read", f"{path} ({error.strerror})")


class Joined(Recording):
    """Several files of one run, such as the parts of a rotation, read as one recording; see `join`."""

    def __init__(self, parts: tuple[Recording, ...]) -> None:
        """Join recordings in the given order."""
        first, last = parts[0], parts[-1]
        self._parts = parts
        self.path = first.path
        self.complete = all(part.complete for part in parts)
        self.damaged = sum(part.damaged for part in parts)
        self.unchecked = tuple(dict.fromkeys(text for part in parts for text in part.unchecked))
        self.metadata = {**last.metadata, **first.metadata, "end": last.metadata.get("end", {})}
        self.messages = {}
        for part in parts:
            for topic, count in part.messages.items():
                self.messages[topic] = self.messages.get(topic, 0) + count
        self._attachments = first.attachments
        self.catalogue, self.table = first.catalogue, first.table
        self.parameters, self.scene = first.parameters, first.scene

    @property
    def parts(self) -> tuple[Recording, ...]:
        """The files that it is read from."""
        return self._parts

    @property
    def chunks(self) -> tuple[Chunk, ...]:
        """Where its messages are, part after part."""
        return tuple(replace(chunk, part=number) for number, part in enumerate(self._parts) for chunk in part.chunks)

    @property
    def span_s(self) -> tuple[float, float] | None:
        """Simulated times of the first and the last row of all files [s]."""
        spans = [span for part in self._parts if (span := part.span_s) is not None]
        return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None

    @property
    def end_reason(self) -> str:
        """Why the recording ended."""
        return self._parts[-1].end_reason

    @cached_property
    def streams(self) -> dict[str, Stream]:
        """Extent of every block stream by key, over all files."""
        streams: dict[str, Stream] = {}
        for part in self._parts:
            for key, later in part.streams.items():
                earlier = streams.get(key, later)
                streams[key] = later if earlier is later else _behind(earlier, later)
        return dict(sorted(streams.items()))

    @cached_property
    def short(self) -> tuple[str, ...]:
        """Of each file, the rows that it says it has and that are not there."""
        return tuple(f"{part.path.name}: {text}" for part in self._parts for text in part.short)

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """Of each file, what does not fit together."""
        return tuple(f"{part.path.name}: {text}" for part in self._parts for text in part.doubts)

    def _stamped(self, topics: set[str]) -> Iterator[tuple[str, int, int, bytes]]:
        for part in self._parts:
            yield from part._stamped(topics)


def _behind(earlier: Stream, later: Stream) -> Stream:
    """A stream that goes on in another file."""
    if not (earlier.rows and later.rows):
        kept = earlier if earlier.rows else later
        first_s, last_s, first, due, between = kept.first_time_s, kept.last_time_s, kept.first, kept.due, 0
    else:
        first_s, last_s, first, due = earlier.first_time_s, later.last_time_s, earlier.first, later.due
        between = max(0, later.first - earlier.due)
    sums = {
        name: getattr(earlier, name) + getattr(later, name)
        for name in ("messages", "rows", "lost", "odd", "back", "off", "missing")
    }
    sums["lost"] += between
    return Stream(**sums, first_time_s=first_s, last_time_s=last_s, first=first, due=due)


def join(paths: list[Path]) -> Recording:
    """Open one file, or several of one run as one recording, whatever their order.

    Args:
        paths: The files.

    Raises:
        InputError: A file cannot be read, or they are not of one run or not behind each other.
    """
    parts = [Recording.open(path) for path in paths]
    if len(parts) == 1:
        return parts[0]
    series = {part.metadata.get("series", {}).get("id") for part in parts}
    if len(series) == 1 and None not in series:
        parts.sort(key=lambda part: int(part.metadata["series"]["number"]))
        numbers = [part.metadata["series"]["number"] for part in parts]
        if len(set(numbers)) < len(numbers):
            raise InputError("files", "different parts of a recording", ", ".join(str(part.path) for part in parts))
        _check_one_run(parts)
        return Joined(tuple(parts))
    _check_one_run(parts)
    parts.sort(key=lambda part: _extent_s(part)[0])
    for earlier, later in pairwise(parts):
        if _extent_s(later)[0] < _extent_s(earlier)[1]:
            raise InputError("files", "recordings behind each other", f"{earlier.path} and {later.path}, which overlap")
    return Joined(tuple(parts))


def _check_one_run(parts: list[Recording]) -> None:
    for part in parts[1:]:
        if _run_of(part) != _run_of(parts[0]):
            raise InputError("files", "recordings of one run", f"{parts[0].path} and {part.path}")


def _run_of(recording: Recording) -> tuple[Any, ...]:
    scene = {name: value for name, value in recording.scene.items() if name not in ("taken", "forgotten")}
    return scene, recording.parameters, recording.catalogue


def _extent_s(recording: Recording) -> tuple[float, float]:
    """Simulated times of the first and the last row [s]."""
    streams = [stream for key, stream in recording.streams.items() if stream.rows and key != EDGES]
    return (
        min((stream.first_time_s for stream in streams), default=0.0),
        max((stream.last_time_s for stream in streams), default=0.0),
    )
