"""Triggered recording: a ring buffer of the latest blocks, and one file for each capture.

A capture consists of whole blocks, from the one that contains `pre_s` before the trigger to the one that contains
`post_s` after it. Each file is self-contained. Blocks stay in the ring buffer while a file is written, so that the
next capture has its full time before the trigger, even if two files then contain the same rows.
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
from recorder.files.unfinished_file import find_files, remove
from recorder.output.disk_limits import DiskLimits, check_files
from recorder.output.sink import Needs, Sink
from recorder.output.trigger import Capture, Crossings, Trigger
from recorder.writer import RecordingError, RecordingWriter
from rig.base.errors import InputError
from rig.base.wire import EDGES, EVENTS, FAULTS

_WAIT_NS = NS // 2
"""Time that a capture waits after its end for delayed streams [ns of simulated time].

The ring buffer is longer by this time, for events that arrive after their blocks.
"""
_MAX_AHEAD_NS = 60 * NS
"""Largest time by which an event may be ahead of the streams [ns]; beyond it, the event counts as current."""
_NUMBERED = r"\w+-\d{3,}"
_MAX_LISTED_TRIGGERS = 1000
"""Largest number of triggers listed in a file; further ones are only counted."""


def capture_path(path: Path, trigger: Trigger, number: int) -> Path:
    """Return the name of a capture's file."""
    return path.with_name(f"{path.stem}.{trigger.name}-{number:03d}{path.suffix}")


def check_captures(path: Path, capture: Capture, limits: DiskLimits, *, force: bool = False) -> None:
    """Refuse a name that cannot become the files of captures; see `check_files`."""
    names = {trigger.name: capture_path(path, trigger, 1) for trigger in capture.triggers}
    check_files(path, names.values(), _NUMBERED, limits, force=force)


class _RingEntry(NamedTuple):
    """Payload in the ring buffer, with the simulated time that it covers and that of its arrival [ns]."""

    payload: Payload
    start_ns: int
    end_ns: int
    arrival_ns: int


@dataclass
class _OpenCapture:
    """Capture being written."""

    writer: RecordingWriter
    end_ns: int
    latest_end_ns: int
    """End of the capture at its maximum length [ns]."""
    fired: list[dict[str, Any]]
    full: bool = False
    """True if the maximum length cut the capture short."""
    count: int = 1


class Captures(Sink):
    """Sink that writes captures around triggers.

    Attributes:
        fired: Number of triggers, including those during a capture.
    """

    def __init__(self, path: Path, capture: Capture, needs: Needs) -> None:
        """Check names and triggers; the first trigger opens a file.

        Args:
            path: NAME.mcap, which becomes NAME.TRIGGER-001.mcap and so on.
            capture: Triggers and times to keep.
            needs: Settings of the sink.

        Raises:
            InputError: The name or a channel cannot be used.
        """
        check_captures(path, capture, needs.limits, force=needs.force)
        self._crossings = {each: Crossings(each, needs.table) for each in capture.triggers if each.level is not None}
        if needs.force:
            remove(find_files(path, _NUMBERED))
        super().__init__(path, needs)
        self.fired = 0
        self._capture = capture
        self._pre_ns, self._post_ns = round(capture.pre_s * NS), round(capture.post_s * NS)
        self._ring: deque[_RingEntry] = deque()
        self._reached_ns: dict[str, int] = {}
        self._number = 0
        self._open: _OpenCapture | None = None

    @property
    def payload_count(self) -> int:
        """Number of payloads in the ring buffer."""
        return len(self._ring)

    def take(self, payload: Payload) -> None:
        """Add a payload to the ring buffer, and to the open capture."""
        original = self.tally.restore(payload)
        self.tally.take(payload)
        if payload.block is None:
            start_ns = end_ns = self._time_of(payload)
        else:
            start_ns, end_ns = self.tally.extent_ns(original)
            if payload.key != EDGES:
                self._reached_ns[payload.key] = max(self._reached_ns.get(payload.key, 0), end_ns)
        latest_ns = self.tally.last_time_ns
        self._ring.append(_RingEntry(payload, start_ns, end_ns, latest_ns))
        if self._open is not None and (start_ns <= self._open.end_ns or payload.key == FAULTS):
            self._write(self._open.writer, payload)
        # `_commands` has the commands before the oldest payload in the ring. Payloads are removed by arrival time, as
        # the tick of an event can be far off.
        while self._ring and self._ring[0].arrival_ns < latest_ns - self._pre_ns - _WAIT_NS:
            removed = self._ring.popleft().payload
            if removed.key == EVENTS:
                self._commands.follow(removed.document)
        for trigger, time_ns, is_new in self._fired_by(payload, start_ns):
            self._fire(trigger, time_ns, is_new=is_new)
        self._close_if_over()

    def finish(self, reason: str, *, notes: dict[str, str] | None = None) -> None:
        """Close the open capture before its end."""
        if self._open is not None:
            self._close_capture(self._open, f"{reason}, before the capture was over", notes)

    def _time_of(self, payload: Payload) -> int:
        """Return the simulated time of a document [ns], or the latest time of the streams if the two are far apart."""
        time_ns, _ = self.tally.extent_ns(payload)
        latest_ns = self.tally.last_time_ns
        plausible = -self._pre_ns - _WAIT_NS <= time_ns - latest_ns <= _MAX_AHEAD_NS
        return time_ns if plausible or self.tally.first_time_ns is None else latest_ns

    def _write(self, writer: RecordingWriter, payload: Payload) -> None:
        """Write to the open capture while there is disk space."""
        if self.ended:
            return
        writer.take(payload)
        if reason := self._room.find_shortage_after(len(payload.data), writer):
            self._end(reason)

    def _fired_by(self, payload: Payload, start_ns: int) -> list[tuple[Trigger, int, bool]]:
        """Return the triggers of a payload, their simulated times [ns], and whether each may start a capture."""
        fired = []
        for trigger in self._capture.triggers:
            crossings = self._crossings.get(trigger)
            if crossings is None:
                fired += [(trigger, start_ns, True)] if payload.event(trigger.name) else []
            elif payload.block is not None and payload.key == crossings.key:
                fired += [(trigger, *each) for each in crossings.take(payload.block, start_ns)]
                if crossings.remark and crossings.remark not in self.remarks:
                    self.remarks += (crossings.remark,)
        return fired

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
        if len(writing.fired) < _MAX_LISTED_TRIGGERS:
            writing.fired.append(about)
        if self._capture.is_extended_by(trigger):
            end_ns = max(writing.end_ns, time_ns + self._post_ns)
            writing.full = writing.full or end_ns > writing.latest_end_ns
            writing.end_ns = min(end_ns, writing.latest_end_ns)

    def _begin(self, trigger: Trigger, time_ns: int, about: dict[str, Any]) -> None:
        """Start a capture and write the contents of the ring buffer that belong to it."""
        if self._open is not None:
            self._close_capture(self._open)
        if self.ended:
            return
        if reason := self._room.find_shortage():
            self._end(reason)
            return
        self._number += 1
        start_ns = max(0, time_ns - self._pre_ns)
        entries = {
            "trigger": trigger.text,
            "time_s": f"{time_ns / NS:.9f}",
            "pre_s": f"{self._capture.pre_s:g}",
            "post_s": f"{self._capture.post_s:g}",
            "again": "extend" if self._capture.is_extended_by(trigger) else "ignore",
            "longest_s": f"{self._capture.max_length_s:g}",
            "number": str(self._number),
        }
        path = capture_path(self.path, trigger, self._number)
        try:
            writer = self._needs.open_file(path, self._scene_before(start_ns), Beginning(metadata={"trigger": entries}))
        except InputError as error:
            raise RecordingError(f"recording stopped: {error}; the captures before it are kept") from None
        latest_end_ns = time_ns - self._pre_ns + round(self._capture.max_length_s * NS)
        self._writer = writer
        self._open = _OpenCapture(writer, time_ns + self._post_ns, latest_end_ns, [about])
        for entry in self._ring:
            inside = entry.end_ns >= start_ns and entry.start_ns <= self._open.end_ns
            if inside or entry.payload.key == FAULTS:  # may concern blocks of the capture
                self._write(writer, entry.payload)

    def _scene_before(self, start_ns: int) -> dict[str, Any]:
        """Return the scene with the commands sent before the start of a file."""
        commands = Commands(self._commands.scene)
        for entry in self._ring:
            if entry.payload.key == EVENTS and entry.end_ns < start_ns:
                commands.follow(entry.payload.document)
        return commands.scene

    def _close_if_over(self) -> None:
        """Close the capture when all streams have reached its end, or the wait for them is over."""
        if self._open is None or self.tally.last_time_ns < self._open.end_ns:
            return
        waited = self.tally.last_time_ns >= self._open.end_ns + _WAIT_NS
        if waited or min(self._reached_ns.values(), default=0) >= self._open.end_ns:
            self._close_capture(self._open)

    def _close_capture(self, writing: _OpenCapture, reason: str = "", notes: dict[str, str] | None = None) -> None:
        """Close a capture; without a reason, because it is complete."""
        full = f", up to its longest length of {self._capture.max_length_s:g} s" if writing.full else ""
        self._open = None
        fired = {"triggers": json.dumps(writing.fired), "trigger_count": str(writing.count)}
        self._close(writing.writer, reason or f"captured{full}", {**(notes or {}), **fired})
        if not self.ended and self._capture.count is not None and self._number >= self._capture.count:
            self.ended = f"{self._number} capture{'s' * (self._number != 1)} made"
