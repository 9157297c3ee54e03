"""Inventory of a recording file: counted contents and contradictions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from recorder.contents import documents
from recorder.contents.consistency import ConsistencyCheck
from recorder.contents.recording_file import RecordingFile
from recorder.contents.samples import row_times_s
from recorder.files import schemas
from rig.base.wire import EDGES, EVENTS, FAULTS, Block, Gap, get_schema
from rig.channels.faults.ledger import Declared

_MIN_SPAN_S = 0.5
"""Shortest recording in which a stream without rows is reported [s]; in a shorter one the stream may not have begun."""
_RATE_TOLERANCE = 1e-3
"""Relative tolerance of a block's rate; the rate of an imported channel group is rounded to an integer."""
OnBlock = Callable[[str, Block], None]
"""Callback for each block, called with its key."""


@dataclass
class Stream:
    """Contents of one block stream in a recording.

    Attributes:
        messages: Number of blocks.
        rows: Number of rows.
        lost: Number of rows missing between blocks, counted from the row numbers.
        declared: Rows among the lost that the rig reported as removed by a fault.
        gap_rows: Declared losses outside the recorded rows: [first row number, number of rows] each.
        first_time_s: Simulated time of the first row [s].
        last_time_s: Simulated time of the last row [s].
        start_s: Simulated time of the first block's tick [s]; edges lie after it.
        first: Number of the first row.
        due: Number of the row after the last one.
        invalid: Number of payloads that are not valid blocks or do not fit the catalogue.
        stepped_back: Number of blocks that begin before the expected row.
        wrong_rate: Number of blocks whose rate differs from the catalogue's.
        misplaced: Number of blocks whose time does not fit their row number, or whose edges are not in ascending order.
        missing: Number of rows stated by the file or published by the rig that are not in the file.
    """

    messages: int = 0
    rows: int = 0
    lost: int = 0
    first_time_s: float = 0.0
    last_time_s: float = 0.0
    start_s: float = 0.0
    first: int = 0
    due: int = 0
    invalid: int = 0
    stepped_back: int = 0
    wrong_rate: int = 0
    misplaced: int = 0
    missing: int = 0
    declared: int = 0
    gap_rows: list[list[int]] = field(default_factory=list)

    def extend(self, later: Stream) -> Stream:
        """Return this stream extended by its continuation in a later file."""
        sums = {
            name: getattr(self, name) + getattr(later, name)
            for name in (
                "messages",
                "rows",
                "lost",
                "invalid",
                "stepped_back",
                "wrong_rate",
                "misplaced",
                "missing",
                "declared",
            )
        }
        if not (self.rows and later.rows):
            return replace(self if self.rows else later, **sums, gap_rows=[*self.gap_rows, *later.gap_rows])
        sums["lost"] += max(0, later.first - self.due)
        reached = self.due
        for row, rows in sorted([*self.gap_rows, *later.gap_rows]):
            end = min(row + rows, later.first)
            sums["declared"] += max(0, end - max(row, reached))
            reached = max(reached, end)
        return replace(self, **sums, last_time_s=later.last_time_s, due=later.due, gap_rows=later.gap_rows)


class Survey:
    """Full scan of one file.

    Attributes:
        file: The file.
        streams: Contents of every block stream by key.
    """

    def __init__(self, file: RecordingFile, on_block: OnBlock | None = None, *, applies_faults: bool = True) -> None:
        """Read the whole file.

        Args:
            file: The file.
            on_block: Callback for each block that fits the catalogue.
            applies_faults: Whether to apply the fault documents to the row numbers.

        Raises:
            InputError: The file is damaged.
        """
        self.file, self._applies_faults = file, applies_faults
        self._continuity, self._steps = Declared(), dict[str, list[Gap]]()
        self._consistency = ConsistencyCheck(file)
        self.streams: dict[str, Stream] = {}
        self._first_blocks: dict[str, tuple[float, int]] = {}
        self._counted: dict[str, int] = {}
        self._malformed: dict[str, int] = {}
        self._published_rows: dict[str, int] = {}
        self._noted_ends: set[tuple[str, int]] = set()
        self._noted_bytes = 0
        for key, time_ns, _, payload in file.stamped(None):
            self._counted[key] = self._counted.get(key, 0) + 1
            if get_schema(key) is None:
                self._add_document(key, time_ns, payload)
            elif (block := self._add_block(key, time_ns, payload)) is not None and on_block is not None:
                on_block(key, block)
        self._end()

    @cached_property
    def missing_rows(self) -> tuple[str, ...]:
        """Rows that the file states and does not contain, one line per stream."""
        return tuple(
            f"{stream.missing} rows of {key} are missing" for key, stream in self.streams.items() if stream.missing
        )

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """Contradictions in a file whose checksums are all valid, one line each."""
        formats, messages = self.file.formats, self.file.messages
        doubts = list(self.missing_rows)
        for key, stream in self.streams.items():
            if stream.invalid:
                doubts.append(f"payloads of {key} that are not blocks or do not fit the catalogue: {stream.invalid}")
            if stream.stepped_back:
                doubts.append(f"blocks of {key} with repeated or decreasing row numbers: {stream.stepped_back}")
            if stream.wrong_rate:
                doubts.append(f"blocks of {key} whose rate differs from the catalogue: {stream.wrong_rate}")
            if stream.misplaced:
                wrong = (
                    "edges that are not in ascending order"
                    if key == EDGES
                    else "a time that does not fit their row number"
                )
                doubts.append(f"{stream.misplaced} blocks of {key} have {wrong}")
            if stream.rows > (stated := self.file.stated_rows.get(key, stream.rows)):
                doubts.append(f"{key} has {stream.rows} rows, but the file states {stated}")
            if stream.rows and key not in formats:
                doubts.append(f"{key} is not in the catalogue")
        doubts += [f"malformed messages of {key}: {n}" for key, n in self._malformed.items()]
        for topic in sorted(set(messages) | set(self._counted)):
            if (counted := self._counted.get(topic, 0)) != (stated := messages.get(topic, 0)):
                doubts.append(f"{counted} messages of {topic}, but the file states {stated}")
        filled = {key: stream for key, stream in self.streams.items() if stream.rows}
        span_s = max((stream.last_time_s for stream in filled.values()), default=0.0)
        span_s -= min((stream.first_time_s for stream in filled.values()), default=0.0)
        for key in sorted(set(formats) - {EDGES} - set(filled)):
            if span_s > max(_MIN_SPAN_S, 2.0 / formats[key].rate_hz):
                doubts.append(f"no rows of {key}, which is in the catalogue")
        sound = {key: self._steps.get(key, []) for key, stream in self.streams.items() if not stream.invalid}
        doubts += self._consistency.find_contradictions(self.streams, sound)
        return tuple(doubts)

    def _add_block(self, key: str, time_ns: int, payload: bytes) -> Block | None:
        stream = self.streams.setdefault(key, Stream())
        block, stream_format = self.file.block(key, payload), self.file.formats.get(key)
        if block is None:
            stream.invalid += 1
            return None
        true_block, block = block, self._continuity.true(key, block)
        gap = self._continuity.take(key, true_block)
        self._consistency.check_time(key, time_ns, block.tick)
        if not stream.messages or (gap is None and block.index < stream.first):
            stream.first, stream.start_s = block.index, block.tick / block.tick_rate_hz
        if gap is not None:
            self._steps.setdefault(key, []).append(gap)
        stream.messages += 1
        stream.stepped_back += gap is not None and gap.size < 0
        if stream_format is not None and stream_format.rate_hz:
            stream.wrong_rate += abs(block.rate_hz / stream_format.rate_hz - 1.0) > _RATE_TOLERANCE
        if key != EDGES:
            start_s, index = self._first_blocks.setdefault(key, (block.start_s, block.index))
            offset_s = block.start_s - start_s - (block.index - index) / block.rate_hz
            stream.misplaced += abs(offset_s) * block.tick_rate_hz > 0.5
        if len(block.values):
            times_s = row_times_s(key, block)
            first_s, last_s = times_s[[0, -1]].tolist()
            if key == EDGES and (gap is None or gap.size > 0):
                late = stream.rows > 0 and first_s <= stream.last_time_s
                stream.misplaced += bool(late or (np.diff(times_s) <= 0.0).any())
            stream.last_time_s = max(stream.last_time_s, last_s)
            stream.first_time_s = stream.first_time_s if stream.rows else first_s
            stream.rows += len(block.values)
        return true_block

    def _add_document(self, key: str, time_ns: int, payload: bytes) -> None:
        """Read row counts and faults published by the rig, and the gaps noted by the recorder."""
        if key not in documents.KINDS:
            return
        if (document := documents.parse_document(key, payload)) is None:
            self._malformed[key] = self._malformed.get(key, 0) + 1
            return
        if key == FAULTS:
            if not self._applies_faults:
                return
            self._continuity.declare(document)
        self._consistency.add_document(key, time_ns, document)
        if key == schemas.GAPS:
            self._noted_bytes = documents.check_total_size(self._noted_bytes + len(payload), key, self.file.path)
            if document["index"] >= 0:
                self._noted_ends.add((document["key"], document["index"] + document["size"]))
        elif key == EVENTS and document["event"] in ("start", "end"):
            self._published_rows = (document.get("rows") or {}) if document["event"] == "end" else {}

    def _end(self) -> None:
        """Compare the counted rows with those stated by the file and published by the rig."""
        stated, continuity = self.file.stated_rows, self._continuity
        # A cut or triggered recording is complete without the end of the run.
        is_complete = not {"trigger", "cut"} & set(self.file.metadata)
        for key in {*self.streams, *continuity.faulty} | {key for key, rows in stated.items() if rows}:
            stream = self.streams.setdefault(key, Stream())
            stream.rows, stream.lost = continuity.received.get(key, 0), continuity.lost.get(key, 0)
            stream.declared, stream.gap_rows = continuity.declared.get(key, 0), continuity.around(key)
            stream.due = continuity.next.get(key, 0)
            end = self._published_rows.get(key, stream.due)
            short = (
                end - stream.due if is_complete and key in continuity.next and (key, end) not in self._noted_ends else 0
            )
            stream.missing = max(0, stated.get(key, stream.rows) - stream.rows, short)
        self.streams = dict(sorted(self.streams.items()))
