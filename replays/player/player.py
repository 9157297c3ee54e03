"""Serves a recording as a rig serves its run: the same keys, documents, token and reports, at the recorded spacing.

Clients cannot tell the difference from what is published. Only who asks for the status learns that it is a recording,
how far it is, and how late. Deadlines are absolute, from one origin; the operator's pauses, seeks and changes of the
rate set a new one. Nothing is ever left out for lateness.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from replays.player.edit import Edit
from replays.player.outlet import Outlet
from replays.player.playhead import NS, Playhead
from replays.player.readahead import ReadAhead
from replays.player.tape import Tape
from replays.player.timeline import Batch, By, Item, Timeline
from rig import wire
from rig.desk import Desk, Pending, Rate, Seek, Step, finite, one_line
from rig.errors import InputError, RefusedError
from rig.pacing import FreeRun, RealTime, short_collections
from rig.service import COMMANDS, REPLAY_COMMANDS
from rig.transport import Server

_OWN = (*REPLAY_COMMANDS, "step", "stop")
_AHEAD_S = 30.0
_AHEAD_BLOCKS = 2000
"""How far a burst may be ahead of the slowest client that reports: below what the transport keeps of a key (3000) and
what a recorder can take in (90 s of the default streams)."""
_LOOK_S = 0.1
_CROWDED_S = 2e-3
_HELD_S = 5.0
_BEHIND_S = 0.5
"""Lateness that is told: a busy machine is late by tens of milliseconds, and catches up."""


@dataclass(frozen=True)
class Part:
    """What is played of a recording; times are simulated ones of the recording [s].

    Attributes:
        from_s: Where a pass begins; None: at the beginning.
        to_s: Where it ends; None: at the end.
        start_s: Where the first pass begins; None: where each does.
        loops: Number of passes; None: endless.
    """

    from_s: float | None = None
    to_s: float | None = None
    start_s: float | None = None
    loops: int | None = 1


@dataclass(frozen=True, slots=True)
class _Mark:
    """A pass begins here, or what follows a seek.

    Attributes:
        number: Of the pass, from 1.
        from_ns: Position in the recording [ns of simulated time].
        due_ns: First deadline [ns, on the scale of the timeline].
        tick: Of the first block [ticks], or where there is none, of the position.
    """

    number: int
    from_ns: int
    due_ns: int
    tick: int


@dataclass(slots=True)
class _Step:
    """A step that is under way: until an instant [ns of the play], or for a number of blocks."""

    reply: Pending
    until_ns: int | None = None
    blocks: int = 0


class Player:
    """Plays one recording to its end and serves it.

    Args:
        tape: The recording.
        server: Transport; stays open when the play ends.
        clock: `RealTime` for the recorded spacing, `FreeRun` for a burst: as fast as the clients take it, by what they
            report and by the transport, which must wait for them.
        part: What is played.
        edit: What is changed; None: nothing.
        by: What the spacing follows.
        rate: Recorded seconds a second, without a burst.
        renumber: Give ticks and row numbers anew, from 0 and without a step at loops and seeks; False leaves them as
            recorded, where a loop or seek is a step of the row number.
        paused: Wait for `resume`, `step` or `seek` before anything is published.
        wait_for: Wait for so many clients that report before anything is published; `resume` and `pause` end that.
        wait_s: Fail where they are not there in this time [s].
        linger_s: At the end, wait at most this long [s] until clients have recovered what they missed.

    Raises:
        InputError: The recording has no such part, or there is no such rate.
    """

    def __init__(
        self,
        tape: Tape,
        server: Server,
        clock: RealTime | FreeRun,
        *,
        part: Part | None = None,
        edit: Edit | None = None,
        by: By = By.SIMULATED,
        rate: float = 1.0,
        renumber: bool = False,
        paused: bool = False,
        wait_for: int = 0,
        wait_s: float = 60.0,
        linger_s: float = 10.0,
    ) -> None:
        self._tape = tape
        self._server = server
        self._clock = clock
        self._part = part or Part()
        self._documents = tape.documents
        self._edit = edit or Edit(self._documents[wire.CATALOGUE])
        self._tick_rate_hz = int(self._documents[wire.CATALOGUE]["tick_rate_hz"])
        self._timeline = Timeline(tape, by)
        self._burst = not isinstance(clock, RealTime)
        self._playhead = Playhead(clock, rate)
        self._renumber = renumber
        self._outlet = Outlet(server, self._edit, self._tick_rate_hz, renumber=renumber)
        self._linger_s = linger_s
        self._from_ns, self._to_ns, self._start_ns = self._range(self._part)
        self._as_recorded = self._part == Part() and not self._edit.changes and not renumber
        """What goes out is the recording itself: the row numbers that its `end` tells are right."""

        self._state = "running"
        self._paused = paused or wait_for > 0
        self._awaited = wait_for
        """Clients that it is paused for; 0 where only a command ends the pause."""
        self._wait_s = wait_s
        self._stop_requested = False
        self._step: _Step | None = None
        self._accepted = 0
        self._desk = Desk(
            server,
            commands=_OWN,
            others={
                name: f"this is a recording that is replayed, which takes no {name}; it takes {', '.join(_OWN)}"
                for name in COMMANDS
                if name not in _OWN
            },
            running="the recording plays",
            wake=self._wake,
            tell=lambda text: self._told.append(text),
        )
        self._held: tuple[str, float] | None = None
        """Name of the client that a burst waits for, and since when [s, monotonic]."""
        self._told: deque[str] = deque()
        """Warnings that wait for the playing thread."""
        self._woken = threading.Event()
        self._prepared = False

        self._ahead: ReadAhead[Batch | _Mark] | None = None
        self._head: Batch | _Mark | None = None
        self._base_ns = 0
        """Added to a deadline of the recording it gives the instant of the play [ns]."""
        self._anchor_ns = 0
        """Instant of the play at which the next pass, or what follows a seek, begins [ns]."""
        self._position_ns = self._start_ns
        """Simulated time of the recording up to which everything has gone out [ns]."""
        self._pass = 1
        self._begun = False

    # ---- from any thread ----

    def stop(self) -> None:
        """End the play; from any thread or signal handler."""
        self._stop_requested = True
        self._wake()

    @property
    def reach_s(self) -> tuple[float, float]:
        """Where a pass begins and ends, as far as it is known beforehand [s of simulated time]."""
        return self._from_ns / NS, (self._tape.end_ns if self._to_ns is None else self._to_ns) / NS

    def status(self) -> dict[str, Any]:
        """The status document: as a rig's, and `replay` about the play itself.

        Spin, energy and engine are those of the last recorded status.
        """
        begin_s, end_s = self.reach_s
        ahead, out = self._ahead, self._outlet
        shown, achieved_rate = out.recorded_status, self._playhead.achieved_rate
        return finite(
            {
                "scene": self._documents[wire.SCENE].get("name"),
                "tick": self._tick,
                "time_s": self._position_ns / NS,
                "end_s": end_s,
                "wall_s": time.time(),
                "state": self._state,
                "pace": "replay",
                "block_ms": round(1e3 * out.block_rows / out.rate_hz, 6) if out.rate_hz else 0.0,
                **self._clock.statistics(),
                "real_time_factor": round(achieved_rate, 6),
                "queue": {
                    "depth": len(ahead) if ahead is not None else 0,
                    "capacity": 0,
                    "high_water": 0,
                    "dropped": 0,
                },
                "congestion": self._server.congestion(),
                "clients": self._desk.clients.rows(out.published, out.rate_hz),
                "spin_hz": shown.get("spin_hz"),
                "energy": shown.get("energy", {}),
                "engine": shown.get("engine", {}),
                "warnings": self._warnings(),
                "samples_published": out.published,
                "commands": self._accepted,
                "replay": {
                    "files": [str(path) for path in self._tape.paths],
                    "from_s": begin_s,
                    "to_s": end_s,
                    "position_s": self._position_ns / NS,
                    "paused": self._paused,
                    "waiting_for": self._awaited,
                    "rate": None if self._burst else self._playhead.rate,
                    "achieved_rate": round(achieved_rate, 4),
                    "behind_s": round(self._behind_s, 3),
                    "by": str(self._timeline.by),
                    "time": "new" if self._renumber else "original",
                    "pass": self._pass,
                    "passes": self._part.loops,
                    "payloads": out.payloads,
                },
            }
        )

    def _warnings(self) -> list[str]:
        warnings = ["this is a recording that is replayed, not a rig"]
        warnings += [f"recorded: {text}" for text in self._outlet.recorded_status.get("warnings", [])]
        if self._behind_s:
            warnings.append(
                f"x{self._playhead.rate:g} is more than this machine and the clients keep up with: "
                f"{self._behind_s:.1f} s behind"
            )
        if self._held is not None and (held_s := time.monotonic() - self._held[1]) > _HELD_S:
            warnings.append(f"has waited {held_s:.0f} s for client {self._held[0]} to take what was sent")
        return warnings + self._desk.warnings()

    @property
    def _behind_s(self) -> float:
        """How late the last payload was, where that is more than a passing hold-up [s]; else 0."""
        late_s = 0.0 if self._burst else self._clock.last_late_s
        return late_s if late_s > _BEHIND_S else 0.0

    def _scene(self) -> dict[str, Any]:
        """The recorded document, with the commands that the rig had taken by now."""
        scene = self._documents[wire.SCENE]
        taken = {entry["id"]: entry for entry in scene.get("taken", ())}
        for entry in self._tape.commands:
            if entry["tick"] * NS < self._position_ns * self._tick_rate_hz and entry["command"] not in _OWN:
                taken.setdefault(entry["id"], entry)
        return {**scene, "taken": list(taken.values())} if taken or "taken" in scene else scene

    def _wake(self) -> None:
        self._woken.set()
        self._clock.wake()

    # ---- on the playing thread ----

    def prepare(self) -> None:
        """Answer requests and show the token; `run` does it where it was not done before."""
        if not self._prepared:
            self._open(self._start_ns).ready(5.0)
            self._desk.open(
                {
                    wire.CATALOGUE: lambda: self._edit.catalogue,
                    wire.PARAMETERS: lambda: self._documents[wire.PARAMETERS],
                    wire.SCENE: self._scene,
                    wire.STATUS: self.status,
                }
            )
            self._prepared = True

    def run(self) -> dict[str, Any]:
        """Play to the end, to a stop, or to a failure, which is raised after the stream has been ended.

        Returns:
            Summary: reason, position, counts, achieved rate and lateness.
        """
        self.prepare()
        reason = "failed: the player itself failed"
        began_s = time.monotonic()
        try:
            with short_collections():
                began_s = time.monotonic()
                if not self._paused:
                    self._playhead.start()
                reason = self._play()
        except KeyboardInterrupt:
            reason = "stopped"
            raise
        except BaseException as error:
            kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
            reason = f"failed: {kind}{one_line(error)}"
            raise
        finally:
            self._playhead.hold(self._playhead.play_ns)
            wall_s = time.monotonic() - began_s
            if self._ahead is not None:
                self._ahead.close()
            self._finish(reason)
            self._desk.clients.settle(self._server, self._outlet.published, patience_s=self._linger_s)
        status = self.status()
        kept = ("scene", "time_s", "lateness_ms", "overruns", "samples_published", "commands", "replay")
        return {
            "reason": reason,
            "wall_s": wall_s,
            **{name: status[name] for name in kept},
            "played_s": self._playhead.play_ns / NS,
            "blocks": self._outlet.blocks,
            "rows": self._outlet.rows,
            "left_out": self._outlet.left_out,
            "troubles": self._desk.troubles,
        }

    def _play(self) -> str:
        """The loop; returns why it ended."""
        assert self._ahead is not None
        give_up_s = time.monotonic() + self._wait_s
        while True:
            self._take_commands()
            while self._told:
                self._outlet.tell("warning", self._tick, text=self._told.popleft())
            if self._stop_requested:
                return "stopped"
            if self._awaited and self._step is None:
                self._look_for_clients(give_up_s)
            if not self._playhead.runs:
                self._rest(_LOOK_S)
                continue
            if self._head is None:
                self._head = self._ahead.take(_LOOK_S)
                if self._head is None and self._ahead.ended:
                    return "completed"
            if isinstance(self._head, _Mark):
                if self._burst and self._begun and self._desk.clients.behind(self._outlet.published):
                    # Row numbers may step back: clients must have said that they have what came before.
                    self._rest(_CROWDED_S)
                    continue
                self._begin(self._head)
                self._head = None
            elif self._head is not None:
                self._play_batch(self._head)

    def _look_for_clients(self, give_up_s: float) -> None:
        """Go on once all are there that are waited for."""
        present = self._desk.clients.present
        if present >= self._awaited:
            self._resume()
        elif time.monotonic() > give_up_s:
            raise RefusedError(f"{present} of {self._awaited} clients were there after {self._wait_s:g} s")

    def _play_batch(self, batch: Batch) -> None:
        """Publish what is due next, or find that it is not time yet."""
        step, instant_ns = self._step, self._base_ns + batch[0].due_ns
        if step is not None and step.until_ns is not None and instant_ns > step.until_ns:
            if self._clock.release(step.until_ns):
                self._end_step(step, step.until_ns)
            return
        if self._burst and self._crowded():
            self._rest(_CROWDED_S)
            return
        if not self._clock.release(instant_ns):
            return
        for item in batch:
            try:
                self._outlet.send(item)
            except Exception as error:
                self._desk.trouble(f"publishing {item.key}", error)
        self._head = None
        self._playhead.play_ns = instant_ns
        self._position_ns = max(self._position_ns, *(item.position_ns for item in batch))
        if step is not None and step.until_ns is None and _has_block(batch):
            step.blocks -= 1
            if step.blocks == 0:
                self._end_step(step, instant_ns)

    def _rest(self, seconds: float) -> None:
        """Wait, but not for longer than until a command comes."""
        self._woken.wait(seconds)
        self._woken.clear()

    def _crowded(self) -> bool:
        """Whether a client that reports has too much on its way."""
        rows = min(_AHEAD_S * self._outlet.rate_hz, _AHEAD_BLOCKS * self._outlet.block_rows)
        name = self._desk.clients.crowded(self._outlet.published, round(rows)) if rows > 0 else None
        if name is None:
            self._held = None
        elif self._held is None or self._held[0] != name:
            self._held = name, time.monotonic()
        return name is not None

    # Passes through the recording.

    def _range(self, part: Part) -> tuple[int, int | None, int]:
        """Beginning, end (None: all there is) and first beginning of a pass [ns]."""
        tape = self._tape
        first_s, last_s = tape.begin_ns / NS, tape.end_ns / NS
        for name, value in (("from", part.from_s), ("to", part.to_s), ("start", part.start_s)):
            if value is not None and not first_s <= value <= last_s:
                raise InputError(name, f"within the recording, {first_s:g} to {last_s:g} s", value)
        if part.loops is not None and part.loops < 1:
            raise InputError("loop", "at least 1", part.loops)
        begin_ns = tape.begin_ns if part.from_s is None else round(part.from_s * NS)
        to_ns = None if part.to_s is None else round(part.to_s * NS)
        start_ns = begin_ns if part.start_s is None else round(part.start_s * NS)
        end_ns = tape.end_ns if to_ns is None else to_ns
        if not begin_ns < end_ns:
            raise InputError("to", "later than from", part.to_s)
        if not begin_ns <= start_ns < end_ns:
            raise InputError("start", "within from and to", part.start_s)
        if next(self._timeline.play(start_ns, to_ns), None) is None:
            raise InputError("to", "late enough for a whole block", part.to_s)
        return begin_ns, to_ns, start_ns

    def _open(self, from_ns: int) -> ReadAhead[Batch | _Mark]:
        """Go on from a position of the recording."""
        if self._ahead is not None:
            self._ahead.close()
        self._head = None
        self._ahead = ReadAhead(self._passes(from_ns, self._pass), size=_size)
        return self._ahead

    def _passes(self, from_ns: int, number: int) -> Iterator[Batch | _Mark]:
        """What is to come, on the reading thread: for each pass a mark, and its batches."""
        while self._part.loops is None or number <= self._part.loops:
            batches = self._timeline.play(from_ns, self._to_ns)
            first: list[Batch] = []
            for batch in batches:
                first.append(batch)
                if _has_block(batch):
                    break
            if first:
                tick = next((item.block.tick for item in first[-1] if _is_block(item) and item.block is not None), None)
                position = from_ns * self._tick_rate_hz // NS
                yield _Mark(number, from_ns, first[0][0].due_ns, position if tick is None else tick)
            yield from first
            yield from batches
            number += 1
            from_ns = self._from_ns

    def _begin(self, mark: _Mark) -> None:
        """What follows is due from now on; its numbers follow on those before, where they are given anew."""
        first = mark.from_ns if self._timeline.by is By.SIMULATED else mark.due_ns
        if mark.number > self._pass:
            self._anchor_ns = self._playhead.play_ns
        self._base_ns = self._anchor_ns - first
        self._pass = mark.number
        self._position_ns = mark.from_ns
        self._outlet.begin(mark.number, mark.tick)
        if not self._begun and mark.from_ns > self._tape.begin_ns:
            # The recorded start is not in what is played.
            about = self._documents[wire.SCENE]
            self._outlet.tell("start", self._tick, scene=about.get("name"), seed=about.get("seed"), pace="replay")
        self._begun = True

    def _finish(self, reason: str) -> None:
        """End the stream: as it was recorded, where that belongs to what was played."""
        self._state = "ended"
        self._desk.close(f"its end: {reason}", [] if self._step is None else [self._step.reply])
        completed = reason == "completed"
        if not (completed and self._outlet.end(as_recorded=self._as_recorded)):
            if completed:
                reason += (
                    ", the recording has no more" if self._to_ns is None else ", the end of what was to be replayed"
                )
            self._outlet.tell("end", self._tick, reason=reason)
        if completed:
            self._outlet.end_status()

    # Commands.

    def _take_commands(self) -> None:
        for pending in self._desk.taken():
            try:
                self._carry_out(pending)
            except Exception as error:
                pending.refuse(error)
                if not isinstance(error, InputError):
                    self._desk.trouble(pending.command, error)

    def _carry_out(self, pending: Pending) -> None:
        asked = pending.asked
        if isinstance(asked, Step):
            self._begin_step(pending, asked)
            return
        if pending.command == "stop":
            self._stop_requested = True
        elif isinstance(asked, Seek):
            self._seek(asked.time_s)
        elif isinstance(asked, Rate):
            if self._burst:
                raise InputError("rate", "sent to a replay with a rate of its own", "one that runs with --burst")
            self._playhead.set_rate(asked.rate, self._now_ns())
        elif pending.command == "pause":
            self._cancel_step("a pause")
            self._awaited = 0
            self._paused = True
            self._playhead.hold(self._now_ns())
        elif self._paused:
            self._cancel_step("a resume")
            self._resume()
        self._accept(pending)

    def _accept(self, pending: Pending) -> None:
        self._accepted += 1
        reply = {"accepted": True, "id": self._accepted, "command": pending.command}
        pending.answer({**reply, "tick": self._tick, "time_s": self._tick / self._tick_rate_hz})

    def _seek(self, time_s: float) -> None:
        begin_s, end_s = self.reach_s
        if not begin_s <= time_s < end_s:
            raise InputError("time_s", f"a position from {begin_s:g} to below {end_s:g} s", time_s)
        self._cancel_step("a seek")
        self._anchor_ns = self._now_ns()
        self._as_recorded = False
        self._position_ns = round(time_s * NS)
        self._open(self._position_ns)
        self._playhead.jump(self._anchor_ns)

    def _begin_step(self, pending: Pending, asked: Step) -> None:
        if not self._paused or self._step is not None:
            raise InputError("step", "sent to a replay that is paused", "one that plays")
        most = 3600 * self._tick_rate_hz
        for name, value in asked:
            if value is not None and value > most:
                raise InputError(name, f"a whole number of 1 to {most}", value)
        if asked.ticks is not None and asked.blocks is None:
            self._step = _Step(pending, until_ns=self._now_ns() + asked.ticks * NS // self._tick_rate_hz)
        elif asked.blocks is not None and asked.ticks is None:
            self._step = _Step(pending, blocks=asked.blocks)
        else:
            raise InputError("step", "of ticks or of blocks", sorted(pending.request))
        self._playhead.start()

    def _end_step(self, step: _Step, at_ns: int) -> None:
        self._step = None
        self._playhead.play_ns = at_ns
        self._playhead.hold(at_ns)
        self._accept(step.reply)

    def _cancel_step(self, by: str) -> None:
        if self._step is not None:
            self._step.reply.refuse(InputError("step", "done before anything else", by))
            self._playhead.hold(self._now_ns())
            self._step = None

    def _resume(self) -> None:
        self._paused, self._awaited = False, 0
        self._playhead.start()

    # Where it is.

    @property
    def _tick(self) -> int:
        """Position in the recording [ticks]."""
        return self._position_ns * self._tick_rate_hz // NS

    def _now_ns(self) -> int:
        """Instant of the play [ns]."""
        return self._playhead.now_ns(self._base_ns + self._head[0].due_ns if isinstance(self._head, list) else None)


def _is_block(item: Item) -> bool:
    """Whether it is a block of samples or of the truth; edges come with those."""
    return item.block is not None and item.key != wire.EDGES


def _has_block(batch: Batch) -> bool:
    return any(map(_is_block, batch))


def _size(read: Batch | _Mark) -> int:
    return sum(len(item.payload) for item in read) if isinstance(read, list) else 0
