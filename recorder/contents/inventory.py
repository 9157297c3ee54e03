"""What a file of a recording holds, counted from what is there, and what in it does not fit the rest of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from recorder.contents import documents
from recorder.contents.consistency import Agreement
from recorder.contents.recording_file import RecordingFile
from recorder.contents.samples import row_times_s
from recorder.files import schemas
from rig.base.wire import EDGES, EVENTS, FAULTS, Block, Gap, schema_of
from rig.channels.faults.ledger import Declared

_LEAST_SPAN_S = 0.5
"""A stream without rows raises doubt in a recording of this length; in a shorter one it may not have begun."""
_OFF_RATE = 1e-3
"""Part by which the rate of a block may be off that of its stream: an import's is a whole number."""
OnBlock = Callable[[str, Block], None]
"""Is shown each block, with its key."""


@dataclass
class Stream:
    """What a recording holds of one block stream.

    Attributes:
        messages: Number of blocks.
        rows: Number of rows in them.
        lost: Number of rows missing between them, counted anew from the row numbers.
        declared: Of these, those that a fault has taken, as the rig told.
        around: The same before the first row and behind the last: number of the first, and how many.
        first_time_s: Simulated time of the first row [s].
        last_time_s: Simulated time of the last row [s].
        start_s: Simulated time of the first tick that a block names, which edges lie behind [s].
        first: Number of the first row.
        due: Number of the row after the last one.
        odd: Number of payloads that are no blocks, or do not fit the catalogue.
        back: Number of blocks that begin before the row that was due.
        off: Number of blocks at another rate than the catalogue says.
        misplaced: Number of blocks whose time does not fit their row number, or whose edges do not ascend.
        missing: Rows that the file says it has, or the rig that it made, and that are not there.
    """

    messages: int = 0
    rows: int = 0
    lost: int = 0
    first_time_s: float = 0.0
    last_time_s: float = 0.0
    start_s: float = 0.0
    first: int = 0
    due: int = 0
    odd: int = 0
    back: int = 0
    off: int = 0
    misplaced: int = 0
    missing: int = 0
    declared: int = 0
    around: list[list[int]] = field(default_factory=list)

    def then(self, later: Stream) -> Stream:
        """The same stream with what it goes on with in another file."""
        sums = {
            name: getattr(self, name) + getattr(later, name)
            for name in ("messages", "rows", "lost", "odd", "back", "off", "misplaced", "missing", "declared")
        }
        if not (self.rows and later.rows):
            return replace(self if self.rows else later, **sums, around=[*self.around, *later.around])
        sums["lost"] += max(0, later.first - self.due)
        reached = self.due
        for row, rows in sorted([*self.around, *later.around]):
            end = min(row + rows, later.first)
            sums["declared"] += max(0, end - max(row, reached))
            reached = max(reached, end)
        return replace(self, **sums, last_time_s=later.last_time_s, due=later.due, around=later.around)


class Survey:
    """Counts what one file holds.

    Attributes:
        file: The file.
        streams: Extent of every block stream by key.
    """

    def __init__(self, file: RecordingFile, on_block: OnBlock | None = None, *, hears: bool = True) -> None:
        """Read the whole file.

        Args:
            file: The file.
            on_block: Is shown each block that fits the catalogue.
            hears: What the rig told of faults of blocks counts.

        Raises:
            InputError: The file is damaged.
        """
        self.file, self._hears = file, hears
        self._continuity, self._steps = Declared(), dict[str, list[Gap]]()
        self._agreement = Agreement(file)
        self.streams: dict[str, Stream] = {}
        self._begun: dict[str, tuple[float, int]] = {}
        self._counted: dict[str, int] = {}
        self._malformed: dict[str, int] = {}
        self._published: dict[str, int] = {}
        self._noted: set[tuple[str, int]] = set()
        self._noted_bytes = 0
        for key, time_ns, _, payload in file.stamped(None):
            self._counted[key] = self._counted.get(key, 0) + 1
            if schema_of(key) is None:
                self._take_document(key, time_ns, payload)
            elif (block := self._take_block(key, time_ns, payload)) is not None and on_block is not None:
                on_block(key, block)
        self._end()

    @cached_property
    def short(self) -> tuple[str, ...]:
        """Rows that the file says it has, and that are not there though all of it is as it was written."""
        return tuple(f"{one.missing} rows of {key} are missing" for key, one in self.streams.items() if one.missing)

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """What in the file does not fit the rest of it though every checksum holds, in a line each."""
        promises, messages = self.file.promises, self.file.messages
        found = list(self.short)
        for key, stream in self.streams.items():
            if stream.odd:
                found.append(f"payloads of {key} that are no blocks, or do not fit the catalogue: {stream.odd}")
            if stream.back:
                found.append(f"blocks of {key} that repeat row numbers, or go back: {stream.back}")
            if stream.off:
                found.append(f"blocks of {key} at another rate than the catalogue says: {stream.off}")
            if stream.misplaced:
                wrong = (
                    "edges no later than the ones before"
                    if key == EDGES
                    else "a time that does not fit their row number"
                )
                found.append(f"{stream.misplaced} blocks of {key} have {wrong}")
            if stream.rows > (stated := self.file.stated_rows.get(key, stream.rows)):
                found.append(f"{key} has {stream.rows} rows where the file says {stated}")
            if stream.rows and key not in promises:
                found.append(f"{key} is not in the catalogue")
        found += [f"messages of {key} that are not what it promises: {n}" for key, n in self._malformed.items()]
        for topic in sorted(set(messages) | set(self._counted)):
            if (is_there := self._counted.get(topic, 0)) != (stated := messages.get(topic, 0)):
                found.append(f"{is_there} messages of {topic} where the file says {stated}")
        filled = {key: one for key, one in self.streams.items() if one.rows}
        span_s = max((one.last_time_s for one in filled.values()), default=0.0)
        span_s -= min((one.first_time_s for one in filled.values()), default=0.0)
        for key in sorted(set(promises) - {EDGES} - set(filled)):
            if span_s > max(_LEAST_SPAN_S, 2.0 / promises[key].rate_hz):
                found.append(f"no rows of {key}, which the catalogue promises")
        sound = {key: self._steps.get(key, []) for key, one in self.streams.items() if not one.odd}
        found += self._agreement.doubts(self.streams, sound)
        return tuple(found)

    def _take_block(self, key: str, time_ns: int, payload: bytes) -> Block | None:
        stream = self.streams.setdefault(key, Stream())
        block, promise = self.file.block(key, payload), self.file.promises.get(key)
        if block is None:
            stream.odd += 1
            return None
        here, block = block, self._continuity.true(key, block)
        gap = self._continuity.take(key, here)
        self._agreement.timed(key, time_ns, block.tick)
        if not stream.messages or (gap is None and block.index < stream.first):
            stream.first, stream.start_s = block.index, block.tick / block.tick_rate_hz
        if gap is not None:
            self._steps.setdefault(key, []).append(gap)
        stream.messages += 1
        stream.back += gap is not None and gap.size < 0
        if promise is not None and promise.rate_hz:
            stream.off += abs(block.rate_hz / promise.rate_hz - 1.0) > _OFF_RATE
        if key != EDGES:
            start_s, index = self._begun.setdefault(key, (block.start_s, block.index))
            stray_s = block.start_s - start_s - (block.index - index) / block.rate_hz
            stream.misplaced += abs(stray_s) * block.tick_rate_hz > 0.5
        if len(block.values):
            times_s = row_times_s(key, block)
            first_s, last_s = times_s[[0, -1]].tolist()
            if key == EDGES and (gap is None or gap.size > 0):
                late = stream.rows > 0 and first_s <= stream.last_time_s
                stream.misplaced += bool(late or (np.diff(times_s) <= 0.0).any())
            stream.last_time_s = max(stream.last_time_s, last_s)
            stream.first_time_s = stream.first_time_s if stream.rows else first_s
            stream.rows += len(block.values)
        return here

    def _take_document(self, key: str, time_ns: int, payload: bytes) -> None:
        """Follow what the rig says of the rows that it published, and the recorder of those that never arrived."""
        if key not in documents.KINDS:
            return
        if (document := documents.document_in(key, payload)) is None:
            self._malformed[key] = self._malformed.get(key, 0) + 1
            return
        if key == FAULTS:
            if not self._hears:
                return
            self._continuity.declare(document)
        self._agreement.follow(key, time_ns, document)
        if key == schemas.GAPS:
            self._noted_bytes = documents.check_kept(self._noted_bytes + len(payload), key, self.file.path)
            if document["index"] >= 0:
                self._noted.add((document["key"], document["index"] + document["size"]))
        elif key == EVENTS and document["event"] in ("start", "end"):
            self._published = (document.get("rows") or {}) if document["event"] == "end" else {}

    def _end(self) -> None:
        """Hold what was counted against what the file says of itself, and the rig of what it published."""
        stated, continuity = self.file.stated_rows, self._continuity
        # A file that does not go to the end of a run ends where it was to end.
        whole = not {"trigger", "cut"} & set(self.file.metadata)
        for key in {*self.streams, *continuity.faulty} | {key for key, rows in stated.items() if rows}:
            stream = self.streams.setdefault(key, Stream())
            stream.rows, stream.lost = continuity.received.get(key, 0), continuity.lost.get(key, 0)
            stream.declared, stream.around = continuity.declared.get(key, 0), continuity.around(key)
            stream.due = continuity.next.get(key, 0)
            end = self._published.get(key, stream.due)
            short = end - stream.due if whole and key in continuity.next and (key, end) not in self._noted else 0
            stream.missing = max(0, stated.get(key, stream.rows) - stream.rows, short)
        self.streams = dict(sorted(self.streams.items()))
