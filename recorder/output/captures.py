"""Triggered recording: a ring of the latest blocks in memory, and one file for each event around which it is kept.

A capture holds whole blocks, from the one that contains `pre_s` before the trigger to the one that contains `post_s`
after it; each file is complete in itself. Blocks also stay in the ring while a file is written, so that the next
capture has its full time before the trigger, even if the same rows then stand in two files.
"""

from __future__ import annotations

import json
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from recorder.contents.counts import NS
from recorder.contents.metadata import Beginning, Commands
from recorder.files.payload import Payload
from recorder.files.unfinished_file import files_like, remove
from recorder.output.disk_limits import Limits, check_files
from recorder.output.sink import Needs, Sink
from recorder.output.trigger import Capture, Crossings, Trigger
from recorder.writer import RecordingError, RecordingWriter
from rig.base.errors import InputError
from rig.base.wire import EDGES, EVENTS, FAULTS

_LATE_NS = NS // 2
"""For so long after its end a capture waits for streams that are behind the others, and the ring keeps more than it
need for an event that comes after its blocks [ns of simulated time]."""
_FAR_NS = 60 * NS
"""An event that names a later time, or one that the ring no longer holds, counts as one of now [ns]."""
_NUMBERED = r"\w+-\d{3,}"
_MOST_FIRED = 1000
"""Triggers that a file lists; more are only counted."""


def capture_path(path: Path, trigger: Trigger, number: int) -> Path:
    """Name of the file of a capture."""
    return path.with_name(f"{path.stem}.{trigger.name}-{number:03d}{path.suffix}")


def check_captures(path: Path, capture: Capture, limits: Limits, *, force: bool = False) -> None:
    """Refuse names that cannot become the files of captures, as `check_files` does."""
    names = {trigger.name: capture_path(path, trigger, 1) for trigger in capture.triggers}
    check_files(path, names.values(), _NUMBERED, limits, force=force)


class _Held(NamedTuple):
    """A payload in the ring, with the simulated time that it covers, and at which it came [ns]."""

    payload: Payload
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
    fired: list[dict[str, Any]]
    full: bool = False
    """It would have gone on otherwise."""
    count: int = 1


class Captures(Sink):
    """Writes captures.

    Attributes:
        fired: Triggers so far, those during a capture included.
    """

    def __init__(self, path: Path, capture: Capture, needs: Needs) -> None:
        """Check names and triggers; a file is opened by the first trigger.

        Args:
            path: NAME.mcap, which becomes NAME.TRIGGER-001.mcap and so on.
            capture: What is kept.
            needs: What a sink needs.

        Raises:
            InputError: The name or a channel cannot be used.
        """
        check_captures(path, capture, needs.limits, force=needs.force)
        self._crossings = {each: Crossings(each, needs.table) for each in capture.triggers if each.level is not None}
        if needs.force:
            remove(files_like(path, _NUMBERED))
        super().__init__(path, needs)
        self.fired = 0
        self._capture = capture
        self._pre_ns, self._post_ns = round(capture.pre_s * NS), round(capture.post_s * NS)
        self._ring: deque[_Held] = deque()
        self._reached_ns: dict[str, int] = {}
        self._number = 0
        self._open: _Open | None = None

    @property
    def held(self) -> int:
        """Payloads in the ring."""
        return len(self._ring)

    def take(self, payload: Payload) -> None:
        """Take one payload: into the ring, and into the capture that is open."""
        true = self.tally.true(payload)
        self.tally.take(payload)
        if payload.block is None:
            start_ns = end_ns = self._time_of(payload)
        else:
            start_ns, end_ns = self.tally.extent_ns(true)
            if payload.key != EDGES:
                self._reached_ns[payload.key] = max(self._reached_ns.get(payload.key, 0), end_ns)
        latest_ns = self.tally.last_time_ns
        self._ring.append(_Held(payload, start_ns, end_ns, latest_ns))
        if self._open is not None and (start_ns <= self._open.end_ns or payload.key == FAULTS):
            self._write(self._open.writer, payload)
        # The ring's own scene: what was sent before the first thing that it still holds. It is emptied by the time at
        # which things came, as an event can name a tick that is far off.
        while self._ring and self._ring[0].came_ns < latest_ns - self._pre_ns - _LATE_NS:
            gone = self._ring.popleft().payload
            if gone.key == EVENTS:
                self._commands.follow(gone.document)
        for trigger, time_ns, is_new in self._fired_by(payload, start_ns):
            self._fire(trigger, time_ns, is_new=is_new)
        self._close_if_over()

    def finish(self, reason: str, *, notes: dict[str, str] | None = None) -> None:
        """Close the capture that is open, before its time."""
        if self._open is not None:
            self._close_capture(self._open, f"{reason}, before the capture was over", notes)

    def _time_of(self, payload: Payload) -> int:
        """Simulated time that a document names [ns], where that is near what the streams have come to."""
        time_ns, _ = self.tally.extent_ns(payload)
        latest_ns = self.tally.last_time_ns
        near = -self._pre_ns - _LATE_NS <= time_ns - latest_ns <= _FAR_NS
        return time_ns if near or self.tally.first_time_ns is None else latest_ns

    def _write(self, writer: RecordingWriter, payload: Payload) -> None:
        """To the capture that is open, as long as there is room for it."""
        if self.ended:
            return
        writer.take(payload)
        if why := self._room.lack_after(len(payload.data), writer):
            self._end(why)

    def _fired_by(self, payload: Payload, start_ns: int) -> list[tuple[Trigger, int, bool]]:
        """Triggers that a payload sets off, with their simulated times [ns], and whether each may start a capture."""
        found = []
        for trigger in self._capture.triggers:
            crossings = self._crossings.get(trigger)
            if crossings is None:
                found += [(trigger, start_ns, True)] if payload.event(trigger.name) else []
            elif payload.block is not None and payload.key == crossings.key:
                found += [(trigger, *each) for each in crossings.take(payload.block, start_ns)]
                if crossings.remark and crossings.remark not in self.remarks:
                    self.remarks += (crossings.remark,)
        return found

    def _fire(self, trigger: Trigger, time_ns: int, *, is_new: bool) -> None:
        writing = self._open if self._open is not None and time_ns <= self._open.end_ns else None
        if writing is None and not is_new:
            return
        self.fired += 1
        about = {"trigger": trigger.text, "time_s": time_ns / NS}
        if writing is None:
            self._begin(trigger, time_ns, about)
            return
        writing.count += 1
        if len(writing.fired) < _MOST_FIRED:
            writing.fired.append(about)
        if self._capture.extends(trigger):
            end_ns = max(writing.end_ns, time_ns + self._post_ns)
            writing.full = writing.full or end_ns > writing.latest_end_ns
            writing.end_ns = min(end_ns, writing.latest_end_ns)

    def _begin(self, trigger: Trigger, time_ns: int, about: dict[str, Any]) -> None:
        """Begin a capture, and write to it what the ring holds of it."""
        if self._open is not None:
            self._close_capture(self._open)
        if self.ended:
            return
        if why := self._room.lack():
            self._end(why)
            return
        self._number += 1
        start_ns = max(0, time_ns - self._pre_ns)
        entries = {
            "trigger": trigger.text,
            "time_s": f"{time_ns / NS:.9f}",
            "pre_s": f"{self._capture.pre_s:g}",
            "post_s": f"{self._capture.post_s:g}",
            "again": "extend" if self._capture.extends(trigger) else "ignore",
            "longest_s": f"{self._capture.most_s:g}",
            "number": str(self._number),
        }
        path = capture_path(self.path, trigger, self._number)
        try:
            writer = self._needs.open_file(path, self._scene_before(start_ns), Beginning(metadata={"trigger": entries}))
        except InputError as error:
            raise RecordingError(f"recording stopped: {error}; the captures before it are kept") from None
        latest_end_ns = time_ns - self._pre_ns + round(self._capture.most_s * NS)
        self._writer = writer
        self._open = _Open(writer, time_ns + self._post_ns, latest_end_ns, [about])
        for held in self._ring:
            inside = held.end_ns >= start_ns and held.start_ns <= self._open.end_ns
            if inside or held.payload.key == FAULTS:  # which may be about blocks that lie inside
                self._write(writer, held.payload)

    def _scene_before(self, start_ns: int) -> dict[str, Any]:
        """The scene with the commands that came before what the file will hold."""
        commands = Commands(self._commands.scene)
        for held in self._ring:
            if held.payload.key == EVENTS and held.end_ns < start_ns:
                commands.follow(held.payload.document)
        return commands.scene

    def _close_if_over(self) -> None:
        """Close the capture when all streams have come to its end, or have had their time."""
        if self._open is None or self.tally.last_time_ns < self._open.end_ns:
            return
        late = self.tally.last_time_ns >= self._open.end_ns + _LATE_NS
        if late or min(self._reached_ns.values(), default=0) >= self._open.end_ns:
            self._close_capture(self._open)

    def _close_capture(self, writing: _Open, reason: str = "", notes: dict[str, str] | None = None) -> None:
        """Close a capture; without a reason because it has come to its end."""
        full = f", up to its longest length of {self._capture.most_s:g} s" if writing.full else ""
        self._open = None
        fired = {"triggers": json.dumps(writing.fired), "trigger_count": str(writing.count)}
        self._close(writing.writer, reason or f"captured{full}", {**(notes or {}), **fired})
        if not self.ended and self._capture.count is not None and self._number >= self._capture.count:
            self.ended = f"{self._number} capture{'s' * (self._number != 1)} made"
