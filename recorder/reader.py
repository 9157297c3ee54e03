"""Reader of recordings: one file, or several files of one run, such as a series, as one recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterator
from copy import copy
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np

from recorder.contents import documents
from recorder.contents.inventory import OnBlock, Stream, Survey
from recorder.contents.recording_file import Message, RecordingFile
from recorder.contents.samples import build_samples, row_times_s
from recorder.files import schemas
from recorder.files.chunks import Chunk
from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.samples import Plottable, Samples, merge_samples
from rig.base.text import build_html_table
from rig.base.wire import EDGES, EVENTS, FAULTS, STATUS, Block, Gap, get_schema, sensor_key, truth_key
from rig.channels.faults.ledger import Declared, sort_blocks


class Recording(Plottable):
    """Recording, read from the disk topic by topic. Only documents are kept in memory, and no file stays open.

    Attributes:
        parts: Its files in order.
        complete: Whether all files were finished.
        damaged, unchecked, messages: As in `RecordingFile`, for all files.
        path, catalogue, table, parameters, scene, attachments: Those of the first file.
        metadata: Metadata records by name: `rig` (start), `end` (final counts of the last file, only if complete).

    Example:
        >>> with Recording.open("replays/sessions/hammer-5.2.mcap") as recording:
        ...     forces = recording.samples("forces")
        ...     both = recording.samples("disk_x", "speed")  # without names: all groups
        >>> recording
        Recording(replays/sessions/hammer-5.2.mcap: scene hammer, 0 to 0.5998 s, completed; probes, forces, ...)
        >>> forces
        Samples(P_N, P_S, P_E, P_W [N]; 3000 rows at 5000 Hz, 0 to 0.5998 s)
        >>> f"{forces['P_E'][0]:.0f} {forces.unit('P_E')}", [event["event"] for event in recording.events]
        ('3000 N', ['start', 'hammer', 'end'])
        >>> f"{both.to_si()['disk_x'].max():.5f} m at {both['speed'].mean():.2f} {both.unit('speed')}"
        '0.00156 m at 5.10 Hz'
    """

    def __init__(self, parts: tuple[RecordingFile, ...], surveys: tuple[Survey, ...] = ()) -> None:
        """Combine files in the given order, with existing surveys of them; see `open` and `join`."""
        first, last = parts[0], parts[-1]
        self.parts, self.path = parts, first.path
        self.complete = all(part.complete for part in parts)
        self.damaged = sum(part.damaged for part in parts)
        self.unchecked = tuple(dict.fromkeys(text for part in parts for text in part.unchecked))
        self.metadata = {**last.metadata, **first.metadata}
        self.metadata.pop("end", None)
        if "end" in last.metadata:
            self.metadata["end"] = last.metadata["end"]
        self.messages: dict[str, int] = {}
        for part in parts:
            for topic, count in part.messages.items():
                self.messages[topic] = self.messages.get(topic, 0) + count
        self.attachments = dict(first.attachments)
        self.catalogue, self.table = first.catalogue, first.table
        self.parameters, self.scene = first.parameters, first.scene
        self._surveys, self.in_part = surveys, False
        self.true = False
        """True if the effects of faults on blocks are reversed; see `with_true_blocks`."""
        self.applies_faults = True
        """True if the fault documents are applied; see `without_faults`."""
        self.correction: tuple[str, Callable[[Samples], None]] | tuple[None, None] = None, None
        """Description of a correction, and the function that changes samples; see `with_correction`."""

    @classmethod
    def open(cls, path: Path | str, *, salvage: bool = False) -> Self:
        """Open a recording in one file, complete or interrupted.

        Args:
            path: The file.
            salvage: Also read the intact part of a damaged file.

        Raises:
            InputError: The file cannot be read, or is not a recording.
        """
        return cls((RecordingFile(Path(path), salvage=salvage),))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass  # no file stays open between calls

    def __repr__(self) -> str:
        span = "no rows" if self.span_s is None else f"{self.span_s[0]:g} to {self.span_s[1]:g} s"
        more = f" and {len(self.parts) - 1} more" if len(self.parts) > 1 else ""
        return (
            f"Recording({self.path}{more}: scene {self.scene.get('name')}, {span}, {self.end_reason}; "
            f"{', '.join(self.table.groups)})"
        )

    def _repr_html_(self) -> str:
        rows = [
            (name, ", ".join(group.names), f"{group.rate_hz} Hz", self.messages.get(sensor_key(name), 0))
            for name, group in self.table.groups.items()
        ]
        return build_html_table(repr(self), ("group", "channels", "rate", "blocks"), rows)

    @property
    def chunks(self) -> tuple[Chunk, ...]:
        """Chunks with messages, file by file, for random access with `read`."""
        return tuple(replace(chunk, part=number) for number, part in enumerate(self.parts) for chunk in part.chunks)

    @property
    def end_reason(self) -> str:
        """Reason for the end of the recording."""
        return self.parts[-1].end_reason

    @property
    def span_s(self) -> tuple[float, float] | None:
        """Simulated times of the first and the last row, without reading samples [s]; None if there are no rows."""
        spans = [span for part in self.parts if (span := part.span_s) is not None]
        return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None

    @cached_property
    def events(self) -> list[dict[str, Any]]:
        """Events of the rig in order of arrival."""
        return [event for _, event in self._documents(EVENTS)]

    @property
    def commands(self) -> list[dict[str, Any]]:
        """Commands received by the rig, including those before the recording: id, tick, command, request."""
        declared = [*self.scene.get("taken", []), *(event for event in self.events if event.get("event") == "command")]
        commands = {
            entry["id"]: {name: entry[name] for name in ("id", "tick", "command", "request")} for entry in declared
        }
        return [commands[number] for number in sorted(commands)]

    @cached_property
    def last_status(self) -> dict[str, Any] | None:
        """Last status document of the rig; None without one."""
        last = None
        for _, document in self._documents(STATUS):
            last = document
        return last

    @cached_property
    def gaps(self) -> list[Gap]:
        """Gaps noted by the recorder; an index of -1 means that `size` counts messages, not rows."""
        return [gap for _, gap in self.timed_gaps]

    @cached_property
    def timed_gaps(self) -> list[tuple[float, Gap]]:
        """Gaps with the simulated time at which each was noted [s]."""
        documents = self._documents(schemas.GAPS)
        return [(time_ns / 1e9, Gap(gap["key"], gap["index"], gap["size"])) for time_ns, gap in documents]

    @cached_property
    def clock(self) -> np.ndarray:
        """Pairs of simulated time and arrival time [s, unix s], shape (n, 2)."""
        pairs = [(pair["time_s"], pair["wall_s"]) for _, pair in self._documents(schemas.CLOCK)]
        return np.array(pairs, dtype=float).reshape(-1, 2)

    @cached_property
    def streams(self) -> dict[str, Stream]:
        """Contents of every block stream by key, counted from the blocks."""
        streams: dict[str, Stream] = {}
        for survey in self._surveyed():
            for key, later in survey.streams.items():
                streams[key] = streams[key].extend(later) if key in streams else later
        return dict(sorted(streams.items()))

    @property
    def missing_rows(self) -> tuple[str, ...]:
        """Rows that the files state and do not contain, one line per stream."""
        return self._collect_remarks(lambda survey: survey.missing_rows)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Contradictions in files whose checksums are all valid, one line each."""
        return self._collect_remarks(lambda survey: survey.doubts)

    def scan(self, on_block: OnBlock | None = None) -> None:
        """Scan all files; `streams`, `missing_rows` and `doubts` then need no further pass.

        Args:
            on_block: Callback for each block that fits the catalogue, in file order.

        Raises:
            InputError: The file is damaged.
        """
        self._surveys = tuple(Survey(part, on_block, applies_faults=self.applies_faults) for part in self.parts)

    def clear_surveys(self) -> None:
        """Discard the result of the scan; the next access scans the files again."""
        self._surveys = ()
        self.__dict__.pop("streams", None)

    def _surveyed(self) -> tuple[Survey, ...]:
        if not self._surveys:
            self.scan()
        return self._surveys

    def _collect_remarks(self, what: Callable[[Survey], tuple[str, ...]]) -> tuple[str, ...]:
        """Return lines about each file, prefixed by its name if there are several."""
        if self.in_part:
            return ()
        names = [""] if len(self.parts) == 1 else [f"{part.path.name}: " for part in self.parts]
        surveys = zip(names, self._surveyed(), strict=True)
        return tuple(name + text for name, survey in surveys for text in what(survey))

    def samples(self, *names: str) -> Samples:
        """Return sensor channels in engineering units, shape (n, channels).

        Args:
            names: Channels and groups of the channel table; none for all recorded groups. Samples of one group are in
                order of arrival. Several groups are joined by row number, limited to the rows that all of them have.

        Raises:
            InputError: The recording has no such channel or group, the groups do not share the same instants, or the
                file is damaged.
        """
        groups, homes = self.table.groups, {name: each.group for name, each in self.table.channels.items()}
        for name in names:
            if name not in groups and name not in homes:
                raise UnknownNameError("samples", "a channel or a group of the recording", name, [*homes, *groups])
        wanted = dict.fromkeys(name if name in groups else homes[name] for name in names)
        whole = merge_samples(
            [self._group(name) for name in wanted or groups if names or sensor_key(name) in self.messages]
        )
        if all(name in groups for name in names):
            return whole
        return whole.select(*(each for name in names for each in (groups[name].names if name in groups else (name,))))

    def _group(self, name: str) -> Samples:
        group = self.table.groups[name]
        samples = build_samples(
            self.blocks(sensor_key(name)),
            name=name,
            names=group.names,
            units=tuple(channel.unit for channel in group.channels),
            rate_hz=float(group.rate_hz),
        )
        values = samples.values  # convert in place: may be gigabytes
        values *= np.array([channel.scale for channel in group.channels])
        values += np.array([channel.offset for channel in group.channels])
        if self.correction[1] is not None:
            self.correction[1](samples)
        return samples

    def truth(self, table: str) -> Samples:
        """Return a truth table in order of arrival.

        Args:
            table: Name of a truth table of the catalogue.

        Raises:
            InputError: The recording has no such table, or the file is damaged.
        """
        tables = self.catalogue.get("truth", {})
        if table not in tables:
            raise UnknownNameError("truth", "one of the recording's tables", table, tables)
        columns = tables[table]["columns"]
        return build_samples(
            self.blocks(truth_key(table)),
            name=table,
            names=tuple(column["name"] for column in columns),
            units=tuple(column["unit"] for column in columns),
            rate_hz=float(tables[table].get("rate_hz", 0.0)),
        )

    def edges(self) -> np.ndarray:
        """Return the simulated times of the keyphasor edges [s], shape (n,)."""
        times = [row_times_s(EDGES, block) for block in self.blocks(EDGES)]
        return np.concatenate(times) if times else np.empty(0)

    def blocks(self, key: str) -> Iterator[Block]:
        """Yield the blocks of a stream in order of arrival; invalid payloads are skipped."""
        for _, block in self.blocks_of({key}):
            yield block

    def blocks_of(self, keys: set[str]) -> Iterator[tuple[str, Block]]:
        """Yield keys and blocks of several streams in one pass, in file order; invalid payloads are skipped."""
        for key in keys:
            if get_schema(key) is None:
                raise InputError("key", "a key of blocks (sensors or truth)", key)
        blocks = self._blocks_as_sent(keys)
        return sort_blocks(blocks) if self.true else blocks

    def _blocks_as_sent(self, keys: set[str]) -> Iterator[tuple[str, Block]]:
        declared = Declared() if self.true else None
        for part in self.parts:
            for key, _, _, payload in part.stamped(keys if declared is None else {*keys, FAULTS}):
                if declared is not None and key == FAULTS:
                    declared.declare(documents.parse_document(key, payload) or {})
                elif (block := part.block(key, payload)) is not None:
                    yield key, block if declared is None else declared.true(key, block)

    def with_correction(self, text: str, correct: Callable[[Samples], None]) -> Self:
        """Return the recording with samples that a function corrects in place when they are read.

        Args:
            text: Description of the correction, for reports.
            correct: Function that changes the values of one group in engineering units.
        """
        recording = copy(self)
        recording.correction = text, correct
        return recording

    def with_true_blocks(self) -> Self:
        """Return the recording with reported block faults reversed: each block once, in order, at its own time."""
        recording = copy(self)
        recording.true = FAULTS in self.messages
        return recording

    def between(self, from_s: float, to_s: float) -> Self:
        """Return the recording limited to the rows between two times [s]; see `RecordingFile.between`.

        Its `streams` cover only the rows near these times; `missing_rows` and `doubts` are empty, as the rest is not
        read.
        """
        if math.isinf(from_s) and math.isinf(to_s):
            return self
        recording = type(self)(tuple(part.between(from_s, to_s) for part in self.parts))
        recording.true, recording.applies_faults, recording.in_part = self.true, self.applies_faults, True
        recording.correction = self.correction
        return recording

    def without_faults(self) -> Self:
        """Return the recording with its fault documents ignored; only `doubts` and `streams` differ."""
        recording = copy(self)
        recording.applies_faults = False
        recording.clear_surveys()
        return recording

    def everything(self, topics: Container[str] | None = None) -> Iterator[Message]:
        """Yield every message in file order: topic, simulated time [ns], arrival time [unix ns] and payload.

        Args:
            topics: Topics to read; None for all.
        """
        yield from self._stamped(topics)

    def read(self, chunk: Chunk) -> Iterator[Message]:
        """Yield the messages of one chunk in the form of `everything`.

        Raises:
            InputError: The file has changed, or can no longer be read.
        """
        yield from self.parts[chunk.part].stamped(None, [chunk])

    def payloads(self, key: str) -> Iterator[tuple[int, bytes]]:
        """Yield the payloads of a key as recorded: simulated time [ns] and bytes."""
        for _, time_ns, _, payload in self._stamped({key}):
            yield time_ns, payload

    def _stamped(self, topics: Container[str] | None) -> Iterator[Message]:
        for part in self.parts:
            yield from part.stamped(topics)

    def _documents(self, topic: str) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield simulated time [ns] and document of each valid message of a topic."""
        kept_bytes = 0
        for time_ns, payload in self.payloads(topic):
            document = documents.parse_document(topic, payload)
            if document is not None:
                if topic in (EVENTS, schemas.GAPS):
                    kept_bytes = documents.check_total_size(kept_bytes + len(payload), topic, self.path)
                yield time_ns, document


def join(paths: list[Path], *, in_part: bool = False) -> Recording:
    """Open one file, or several files of one run in any order, as one recording.

    Args:
        paths: The files.
        in_part: Verify checksums only of the parts that are read; see `Recording.between`.

    Raises:
        InputError: A file cannot be read, the files belong to different runs, or they overlap in time.
    """
    parts = [RecordingFile(path, in_part=in_part) for path in paths]
    if len(parts) == 1:
        return Recording((parts[0],))
    series = {part.metadata.get("series", {}).get("id") for part in parts}
    if len(series) == 1 and None not in series:
        parts.sort(key=lambda part: int(part.metadata["series"]["number"]))
        numbers = [part.metadata["series"]["number"] for part in parts]
        if len(set(numbers)) < len(numbers):
            raise InputError("files", "different parts of a recording", ", ".join(str(part.path) for part in parts))
        _check_one_run(parts)
        return Recording(tuple(parts))
    _check_one_run(parts)
    surveys = sorted(map(Survey, parts), key=lambda survey: _extent_s(survey)[0])
    for earlier, later in pairwise(surveys):
        if _extent_s(later)[0] < _extent_s(earlier)[1]:
            names = Words(f"{earlier.file.path} and {later.file.path}")
            raise InputError("files", "recordings that do not overlap in time", names)
    return Recording(tuple(survey.file for survey in surveys), tuple(surveys))


def _check_one_run(parts: list[RecordingFile]) -> None:
    for part in parts[1:]:
        if _get_run_key(part) != _get_run_key(parts[0]):
            raise InputError("files", "recordings of one run", Words(f"{parts[0].path} and {part.path}"))


def _get_run_key(part: RecordingFile) -> tuple[Any, ...]:
    scene = {name: value for name, value in part.scene.items() if name not in ("taken", "forgotten")}
    return scene, part.parameters, part.catalogue


def _extent_s(survey: Survey) -> tuple[float, float]:
    """Return the simulated times of the first and the last row of a file [s]."""
    filled = {key: stream for key, stream in survey.streams.items() if stream.rows}
    streams = [stream for key, stream in filled.items() if key != EDGES] or list(filled.values())
    return (
        min((stream.first_time_s for stream in streams), default=0.0),
        max((stream.last_time_s for stream in streams), default=0.0),
    )
