"""Triggered recording: a ring of the latest blocks in memory, and one file for each event around which it is kept.

A capture holds whole blocks, from the one that contains `pre_s` before the trigger to the one that contains `post_s`
after it; each file is complete in itself. Blocks also stay in the ring while a file is written, so that the next
capture has its full time before the trigger, even if the same rows then stand in two files.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from recorder.payload import block_in, document_in, tick_in
from recorder.series import Commands, Limits, Room
from recorder.writer import NS, Counts, RecordingError, RecordingWriter, check_destination, remove
from rig.channels import ChannelTable
from rig.errors import PART_SUFFIX, InputError
from rig.wire import EDGES, EVENTS, SENSORS, Block, Continuity, schema_of

EVENT_NAMES = ("hammer", "speed", "release", "note", "warning")
"""Events of the stream that can be waited for."""
_LEVEL = re.compile(r"\s*(\|?)([A-Za-z_]\w*)(\|?)\s*([<>])\s*([-+.\deE]+)\s*")
_LATE_NS = NS // 2
"""For so long after its end a capture waits for streams that are behind the others, and the ring keeps more than it
need for an event that comes after its blocks [ns of simulated time]."""
_FAR_NS = 60 * NS
"""An event that names a later time, or one that the ring no longer holds, counts as one of now [ns]."""
MOST_CAPTURES = 1000
_MOST_FIRED = 1000
"""Triggers that a file lists; more are only counted."""
_MOST_PRE_S = 120.0
LONGEST_S = 60.0
"""Longest length of a capture unless told otherwise [s of simulated time]."""
REARM_S = 0.25
"""A level starts a new capture only if nothing was beyond it for so long: whirl crosses one twice a turn, and would
otherwise start captures for as long as it lasts [s of simulated time]."""


@dataclass(frozen=True)
class Trigger:
    """What starts a capture: an event, or a channel that crosses a level.

    Attributes:
        text: As the user wrote it.
        name: Event or channel; goes into the name of the file.
        level: Level [unit of the channel]; None for an event.
        above: The value rises above the level; False: it falls below.
        magnitude: It is the absolute value that counts.
    """

    text: str
    name: str
    level: float | None = None
    above: bool = True
    magnitude: bool = False

    @classmethod
    def parse(cls, text: str) -> Trigger:
        """Read a trigger: an event such as `hammer`, or a level such as `P_E>3200`, `speed<5` or `|disk_x|>0.5`.

        Raises:
            InputError: It is neither.
        """
        if text in EVENT_NAMES:
            return cls(text=text, name=text)
        match = _LEVEL.fullmatch(text)
        must = f"one of {', '.join(EVENT_NAMES)}, or like P_E>3200, speed<5 or |disk_x|>0.5"
        if match is None or match[1] != match[3]:
            raise InputError("trigger", must, text)
        try:
            level = float(match[5])
        except ValueError:
            raise InputError("trigger", must, text) from None
        if not math.isfinite(level):
            raise InputError("trigger", must, text)
        return cls(text=text, name=match[2], level=level, above=match[4] == ">", magnitude=bool(match[1]))

    def crossed(self, values: np.ndarray) -> np.ndarray:
        """Where values are beyond the level, shape (n,)."""
        values = np.abs(values) if self.magnitude else values
        return values > self.level if self.above else values < self.level

    def already(self, unit: str) -> str:
        """What to say where the first value is beyond the level, in this unit."""
        name = f"|{self.name}|" if self.magnitude else self.name
        side, other = ("above", "below") if self.above else ("below", "above")
        return f"{name} is {side} {self.level:g} {unit} already; waiting until it has been {other}"


@dataclass(frozen=True)
class Capture:
    """Which triggers, and how much around them is kept.

    Attributes:
        triggers: Any of them starts a capture.
        pre_s: Time kept before the trigger [s of simulated time].
        post_s: Time kept after it [s of simulated time].
        count: The recording ends after so many captures; None if it does not.
        again: A trigger during a capture makes it longer, to `post_s` after the last one; or is ignored. Either way
            it is counted, and noted in the file. None: an event makes it longer, a level is ignored, for it can be
            crossed again for as long as the rig whirls.
        longest_s: Longest length of a capture, with the time before the trigger [s of simulated time]; None for
            `LONGEST_S`, or `pre_s` and `post_s` where they are more.
    """

    triggers: tuple[Trigger, ...]
    pre_s: float = 0.5
    post_s: float = 2.0
    count: int | None = None
    again: Literal["extend", "ignore"] | None = None
    longest_s: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.pre_s <= _MOST_PRE_S:
            raise InputError("pre_s", f"from 0 to {_MOST_PRE_S:g}, as it is kept in memory", self.pre_s)
        if not 0.0 < self.post_s <= 1e6:
            raise InputError("post_s", "above 0, at most 1e6", self.post_s)
        if self.count is not None and not 1 <= self.count <= MOST_CAPTURES:
            raise InputError("count", f"from 1 to {MOST_CAPTURES}", self.count)
        if self.again not in ("extend", "ignore", None):
            raise InputError("again", "extend or ignore", self.again)
        least_s = self.pre_s + self.post_s
        if self.longest_s is not None and not least_s <= self.longest_s <= 1e6:
            raise InputError("longest_s", f"at least pre_s and post_s, {least_s:g}, at most 1e6", self.longest_s)
        if self.longest_s is None:
            object.__setattr__(self, "longest_s", max(LONGEST_S, least_s))

    @property
    def longest_ns(self) -> int:
        """Longest length of a capture [ns of simulated time]."""
        assert self.longest_s is not None
        return round(self.longest_s * NS)

    def extends(self, trigger: Trigger) -> bool:
        """Whether this trigger makes a capture longer that is being made."""
        return trigger.level is None if self.again is None else self.again == "extend"

    def check(self, table: ChannelTable) -> None:
        """Refuse channels that the rig does not have.

        Raises:
            InputError: A trigger names one.
        """
        for trigger in self.triggers:
            if trigger.level is not None and trigger.name not in table.channels:
                raise InputError("trigger", f"on one of {', '.join(table.channels)}", trigger.text)


def capture_path(path: Path, trigger: Trigger, number: int) -> Path:
    """Name of the file of a capture."""
    return path.with_name(f"{path.stem}.{trigger.name}-{number:03d}{path.suffix}")


def check_captures(path: Path, capture: Capture, *, force: bool = False) -> None:
    """Refuse names that cannot become the files of captures.

    Raises:
        InputError: As `check_destination`, or a file of an earlier capture is there.
    """
    for name in {trigger.name: trigger for trigger in capture.triggers}.values():
        check_destination(capture_path(path, name, 1), force=force)
    if not force and (taken := _captures_of(path)):
        raise InputError("output", "new files (--force replaces them)", f"{taken[0]}, which exists")


def _captures_of(path: Path) -> list[Path]:
    name = re.compile(rf"{re.escape(path.stem)}\.\w+-\d{{3,}}{re.escape(path.suffix)}({re.escape(PART_SUFFIX)})?")
    return sorted(each for each in path.parent.iterdir() if name.fullmatch(each.name))


@dataclass
class _Item:
    """A payload in the ring, with the simulated time that it covers, and at which it came [ns]."""

    key: str
    payload: bytes
    wall_ns: int
    start_ns: int
    end_ns: int
    came_ns: int


@dataclass
class _Open:
    """A capture that is being written."""

    writer: RecordingWriter
    end_ns: int
    latest_end_ns: int
    """Where it ends at the latest, at its longest length."""
    full: bool = False
    """It would have gone on otherwise."""
    fired: list[dict[str, Any]] = field(default_factory=list)
    count: int = 1


class Captures:
    """Writes captures; to the outside like a `RecordingWriter`, whose counts are those of everything received.

    Attributes:
        files: The finished files, in order.
        ended: Why the recording ends, where the number of captures or their room was limited; empty before.
        out_of_room: It is for want of room.
        fired: Triggers so far, those during a capture included.
        remarks: What the user should know at once, a line each.
    """

    removed = 0

    def __init__(
        self,
        path: Path,
        capture: Capture,
        *,
        table: ChannelTable,
        tick_rate_hz: int,
        scene: dict[str, Any],
        open_writer: Callable[..., RecordingWriter],
        limits: Limits | None = None,
        force: bool = False,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Check names and triggers; a file is opened by the first trigger.

        Args:
            path: NAME.mcap, which becomes NAME.TRIGGER-001.mcap and so on.
            capture: What is kept.
            table: The channel table.
            tick_rate_hz: Ticks per simulated second.
            scene: The rig's scene document.
            open_writer: Opens one file, given its path and the keywords `scene`, `due`, `metadata` and `from_start`.
            limits: Budget, and room that is left to others on the disk; by default neither.
            force: Replace what is there of that name.
            monotonic_s: Clock that times the looks at the disk [s].

        Raises:
            InputError: The name or a channel cannot be used.
        """
        check_captures(path, capture, force=force)
        capture.check(table)
        if force:
            remove(_captures_of(path))
        self.path = self.part = path
        self.table = table
        self.files: list[Path] = []
        self.ended = ""
        self.out_of_room = False
        self.fired = 0
        self.remarks: tuple[str, ...] = ()
        self._capture = capture
        self._tick_rate_hz = tick_rate_hz
        self._limits = limits or Limits(keep_free_mb=0.0)
        self._room = Room(path.parent, self._limits, monotonic_s=monotonic_s)
        self._commands = Commands(scene)
        self._open_writer = open_writer
        self._pre_ns, self._post_ns = round(capture.pre_s * NS), round(capture.post_s * NS)
        self._ring: deque[_Item] = deque()
        self._beyond: dict[Trigger, bool] = {}
        self._beyond_ns: dict[Trigger, int] = {}
        """Simulated time of the latest value beyond each level [ns]."""
        self._reached_ns: dict[str, int] = {}
        self._latest_ns = 0
        self._first_ns: int | None = None
        self._continuity = Continuity()
        self.next_index = self._continuity.next
        self._gaps = 0
        self._missed: dict[str, int] = {}
        self._malformed = 0
        self._size_bytes = 0
        self._kept: list[Counts] = []
        self._number = 0
        self._open: _Open | None = None

    def counts(self) -> Counts:
        """What was received so far, whether kept or not, and the size of the files."""
        writing = self._open
        return Counts(
            first_time_ns=self._first_ns,
            last_time_ns=self._latest_ns,
            rows=dict(self._continuity.received),
            lost=dict(self._continuity.lost),
            gaps=self._gaps,
            missed=dict(self._missed),
            malformed=self._malformed,
            size_bytes=self._size_bytes + (writing.writer.size_bytes if writing else 0),
        )

    def kept(self) -> list[Counts]:
        """What the files hold, capture by capture."""
        return [*self._kept, self._open.writer.counts()] if self._open else list(self._kept)

    def write(self, key: str, payload: bytes, wall_ns: int) -> dict[str, Any] | None:
        """Take one payload: into the ring, and into the capture that is open."""
        schema = schema_of(key)
        document = block = None
        try:
            if schema is None:
                document = document_in(key, payload)
            else:
                block = block_in(key, payload)
        except ValueError:
            self._malformed += 1
        if block is not None:
            start_ns, end_ns = self._follow(key, block)
        else:
            start_ns = end_ns = self._time_of(document)
        item = _Item(key, payload, wall_ns, start_ns, end_ns, self._latest_ns)
        self._ring.append(item)
        if self._open is not None and start_ns <= self._open.end_ns:
            self._write(key, payload, wall_ns)
        # The ring's own scene: what was sent before the first thing that it still holds. It is emptied by the time at
        # which things came, as an event can name a tick that is far off.
        while self._ring and self._ring[0].came_ns < self._latest_ns - self._pre_ns - _LATE_NS:
            gone = self._ring.popleft()
            if gone.key == EVENTS:
                self._commands.follow(EVENTS, _document(gone.payload))
        for trigger, time_ns, is_new in self._fired_by(key, document, block):
            self._fire(trigger, time_ns, is_new=is_new)
        self._close_if_over()
        return document

    def write_missed(self, key: str, messages: int, wall_ns: int) -> None:
        """Record that the transport lost messages for good."""
        self._missed[key] = self._missed.get(key, 0) + messages
        if self._open is not None:
            self._open.writer.write_missed(key, messages, wall_ns)

    def short_of(self, rows: dict[str, int]) -> dict[str, int]:
        """Streams that have not come to the end of what was published."""
        return {key: end for key, end in rows.items() if self.next_index.get(key, end) < end}

    def note_short(self, rows: dict[str, int], wall_ns: int) -> None:
        """Count what is missing at the end of streams, and record it in the capture that is open."""
        for key, end in self.short_of(rows).items():
            self._gaps += self._continuity.follow(key, end, 0) is not None
        if self._open is not None:
            self._open.writer.note_short(rows, wall_ns)

    def sync_if_due(self) -> None:
        """Flush to the disk if the last flush was long enough ago."""
        if self._open is not None:
            self._open.writer.sync_if_due()

    def finish(self, reason: str, *, notes: dict[str, str] | None = None) -> None:
        """Close the capture that is open, before its time."""
        if self._open is not None:
            self._close(f"{reason}, before the capture was over", notes)

    def _follow(self, key: str, block: Block) -> tuple[int, int]:
        rows = len(block.values)
        self._gaps += self._continuity.follow(key, block.index, rows) is not None
        start_ns = max(0, block.tick * NS // self._tick_rate_hz)
        end_ns = start_ns
        if key != EDGES and block.rate_hz > 0.0:
            end_ns += round((rows - 1) * NS / block.rate_hz)
            self._reached_ns[key] = max(self._reached_ns.get(key, 0), end_ns)
            self._latest_ns = max(self._latest_ns, end_ns)
        self._first_ns = start_ns if self._first_ns is None else min(self._first_ns, start_ns)
        return start_ns, end_ns

    def _time_of(self, document: dict[str, Any] | None) -> int:
        """Simulated time that a document names [ns], where that is near what the streams have come to."""
        tick = tick_in(document)
        time_ns = self._latest_ns if tick is None else max(0, tick * NS // self._tick_rate_hz)
        near = -self._pre_ns - _LATE_NS <= time_ns - self._latest_ns <= _FAR_NS
        return time_ns if near or self._first_ns is None else self._latest_ns

    def _write(self, key: str, payload: bytes, wall_ns: int) -> None:
        """To the capture that is open, as long as there is room for it."""
        assert self._open is not None
        if self.ended:
            return
        writer = self._open.writer
        writer.write(key, payload, wall_ns)
        if self._room.needs_look(len(payload), self._size_bytes, writer) and (
            why := self._room.lack(self._size_bytes, writer)
        ):
            self.ended, self.out_of_room = why, True

    def _fired_by(
        self, key: str, document: dict[str, Any] | None, block: Block | None
    ) -> list[tuple[Trigger, int, bool]]:
        """Triggers that this payload sets off, with their simulated times [ns], and whether it may start a capture."""
        found = []
        for trigger in self._capture.triggers:
            if trigger.level is None:
                if key == EVENTS and document is not None and document.get("event") == trigger.name:
                    found.append((trigger, self._time_of(document), True))
                continue
            group = self.table.groups.get(key.removeprefix(SENSORS + "/")) if block is not None else None
            if block is None or group is None or trigger.name not in group.names:
                continue
            column = group.names.index(trigger.name)
            if not len(block.values) or block.values.shape[1] != len(group.channels):
                continue
            channel = group.channels[column]
            beyond = trigger.crossed(block.values[:, column] * channel.scale + channel.offset)
            # What is beyond its level from the first row on has not crossed it.
            if trigger not in self._beyond and beyond[0]:
                self.remarks += (trigger.already(channel.unit),)
            before = np.concatenate(([self._beyond.get(trigger, True)], beyond[:-1]))
            self._beyond[trigger] = bool(beyond[-1])
            there = np.flatnonzero(beyond)
            if not len(there):
                continue
            begin_ns, row_ns = block.tick * NS // self._tick_rate_hz, NS / block.rate_hz
            crossings = np.flatnonzero(beyond & ~before)
            # Time for which nothing was beyond the level, at each crossing.
            places = np.searchsorted(there, crossings)
            earlier_ns = self._beyond_ns.get(trigger, -math.inf) - begin_ns
            before_ns = np.where(places > 0, there[places - 1] * row_ns, earlier_ns)
            is_new = crossings * row_ns - before_ns >= REARM_S * NS
            self._beyond_ns[trigger] = begin_ns + round(int(there[-1]) * row_ns)
            # One that may start a capture, or else the first, counts, and the last, which may make it longer.
            picked = dict.fromkeys((int(np.argmax(is_new)), len(crossings) - 1)) if len(crossings) else ()
            found += [
                (trigger, begin_ns + round(int(crossings[which]) * row_ns), bool(is_new[which])) for which in picked
            ]
        return found

    def _fire(self, trigger: Trigger, time_ns: int, *, is_new: bool) -> None:
        writing = self._open if self._open is not None and time_ns <= self._open.end_ns else None
        if writing is None and not is_new:
            return
        self.fired += 1
        about = {"trigger": trigger.text, "time_s": time_ns / NS}
        if writing is not None:
            writing.count += 1
            if len(writing.fired) < _MOST_FIRED:
                writing.fired.append(about)
            if self._capture.extends(trigger):
                end_ns = max(writing.end_ns, time_ns + self._post_ns)
                writing.full = writing.full or end_ns > writing.latest_end_ns
                writing.end_ns = min(end_ns, writing.latest_end_ns)
            return
        if self._open is not None:
            self._close_captured()
        if self.ended:
            return
        if why := self._room.lack(self._size_bytes):
            self.ended, self.out_of_room = why, True
            return
        self._number += 1
        start_ns = max(0, time_ns - self._pre_ns)
        metadata = {
            "trigger": {
                "trigger": trigger.text,
                "time_s": f"{time_ns / NS:.9f}",
                "pre_s": f"{self._capture.pre_s:g}",
                "post_s": f"{self._capture.post_s:g}",
                "again": "extend" if self._capture.extends(trigger) else "ignore",
                "longest_s": f"{self._capture.longest_s:g}",
                "number": str(self._number),
            }
        }
        path = capture_path(self.path, trigger, self._number)
        scene = self._scene_before(start_ns)
        try:
            writer = self._open_writer(path, scene=scene, due=None, metadata=metadata, from_start=False)
        except InputError as error:
            raise RecordingError(f"recording stopped: {error}; the captures before it are kept") from None
        latest_end_ns = time_ns - self._pre_ns + self._capture.longest_ns
        self._open = _Open(writer, time_ns + self._post_ns, latest_end_ns, fired=[about])
        self.part = writer.part
        for item in self._ring:
            if item.end_ns >= start_ns and item.start_ns <= self._open.end_ns:
                self._write(item.key, item.payload, item.wall_ns)

    def _scene_before(self, start_ns: int) -> dict[str, Any]:
        """The scene with the commands that came before what the file will hold."""
        commands = Commands(self._commands.scene)
        for item in self._ring:
            if item.key == EVENTS and item.end_ns < start_ns:
                commands.follow(EVENTS, _document(item.payload))
        return commands.scene

    def _close_if_over(self) -> None:
        """Close the capture when all streams have come to its end, or have had their time."""
        if self._open is None or self._latest_ns < self._open.end_ns:
            return
        late = self._latest_ns >= self._open.end_ns + _LATE_NS
        if late or min(self._reached_ns.values(), default=0) >= self._open.end_ns:
            self._close_captured()

    def _close_captured(self) -> None:
        assert self._open is not None
        full = f", up to its longest length of {self._capture.longest_s:g} s" if self._open.full else ""
        self._close("captured" + full)

    def _close(self, reason: str, notes: dict[str, str] | None = None) -> None:
        writing, self._open = self._open, None
        assert writing is not None
        if writing.writer.closed:
            return
        fired = {"triggers": json.dumps(writing.fired), "trigger_count": str(writing.count)}
        writing.writer.finish(reason, notes={**(notes or {}), **fired})
        self.files.append(writing.writer.path)
        self._size_bytes += writing.writer.size_bytes
        self._kept.append(writing.writer.counts())
        if self.ended:
            return
        if self._capture.count is not None and self._number >= self._capture.count:
            self.ended = f"{self._number} captures made"


def _document(payload: bytes) -> dict[str, Any] | None:
    try:
        return document_in(EVENTS, payload)
    except ValueError:
        return None
