"""Serves a recording as a rig serves its run: the same keys, documents, token and reports, at the recorded spacing.

Clients cannot tell the difference from what is published. Only who asks for the status learns that it is a recording,
how far it is, and how late. Deadlines are absolute, from one origin; the operator's pauses, seeks and changes of the
rate set a new one. Nothing is ever left out for lateness.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

from replays.player.edit import Edit
from replays.player.messages import Track
from replays.player.outlet import Outlet
from replays.player.play_range import Mark, Part, Passes, has_block, size_of
from replays.player.playhead import NS, Playhead
from replays.player.readahead import ReadAhead
from replays.player.timeline import Batch, By, Timeline
from rig.base import wire
from rig.base.errors import InputError, RefusedError, Words
from rig.base.text import finite
from rig.serve.pacing import FreeRun, RealTime
from rig.serve.request_handler import Pending, Rate, Seek, Step
from rig.serve.served_run import ServedRun
from rig.serve.service import COMMANDS, REPLAY_COMMANDS
from rig.serve.transport import Server
from rig.serve.waiting import Deadline

_OWN = (*REPLAY_COMMANDS, "step", "stop")
_AHEAD_S = 30.0
_AHEAD_BLOCKS = 2000
"""How far a burst may be ahead of the slowest client that reports: below what the transport keeps of a key (3000) and
what a recorder can take in (90 s of the default streams)."""
_LOOK_S = 0.1
_CROWDED_S = 2e-3
_HELD_S = 5.0
_STEP_S = 3600
"""Longest single step [s of simulated time]."""


@dataclass(slots=True)
class _Step:
    """A step that is under way: until an instant [ns of the play], or for a number of blocks."""

    reply: Pending
    until_ns: int | None = None
    blocks: int = 0


class Player(ServedRun):
    """Plays one recording to its end and serves it.

    Args:
        track: The recording.
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
        track: Track,
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
        documents = track.documents
        super().__init__(
            server,
            clock,
            scene=documents[wire.SCENE],
            tick_rate_hz=int(documents[wire.CATALOGUE]["tick_rate_hz"]),
            commands=_OWN,
            others={
                name: f"this is a recording that is replayed, which takes no {name}; it takes {', '.join(_OWN)}"
                for name in COMMANDS
                if name not in _OWN
            },
            running="the recording plays",
            linger_s=linger_s,
        )
        self._track = track
        self._parameters = documents[wire.PARAMETERS]
        self._passes = Passes(Timeline(track, by), part or Part(), self._rate)
        self._edit = edit or Edit(documents[wire.CATALOGUE])
        self._burst = not isinstance(clock, RealTime)
        self._playhead = Playhead(clock, rate)
        self._renumber = renumber
        self._outlet = Outlet(server, self._edit, self._rate, renumber=renumber)
        self._as_recorded = self._passes.part == Part() and not self._edit.changes and not renumber
        """What goes out is the recording itself: the row numbers that its `end` tells are right."""

        self._paused = paused or wait_for > 0
        self._awaited = wait_for
        """Clients that it is paused for; 0 where only a command ends the pause."""
        self._wait_s = wait_s
        self._step: _Step | None = None
        self._held: tuple[str, float] | None = None
        """Name of the client that a burst waits for, and since when [s, monotonic]."""
        self._told: deque[str] = deque()
        """Warnings that wait for the playing thread."""
        self._woken = threading.Event()

        self._position_ns = self._passes.start_ns
        """Simulated time of the recording up to which everything has gone out [ns]."""
        self._pass = 1
        self._begun = False
        self._ahead: ReadAhead[Batch | Mark] | None = None
        self._head: Batch | Mark | None = None
        self._base_ns = 0
        """Added to a deadline of the recording it gives the instant of the play [ns]."""
        self._anchor_ns = 0
        """Instant of the play at which the next pass, or what follows a seek, begins [ns]."""

    # ---- from any thread ----

    @property
    def published(self) -> int:
        """Row after the last one published, of the stream that clients report on."""
        return self._outlet.published

    @property
    def reach_s(self) -> tuple[float, float]:
        """Where a pass begins and ends, as far as it is known beforehand [s of simulated time]."""
        return self._passes.from_ns / NS, self._passes.end_ns / NS

    def status(self) -> dict[str, Any]:
        """The status document: as a rig's, and `replay` about the play itself.

        Spin, energy and engine are those of the last recorded status.
        """
        begin_s, end_s = self.reach_s
        out, play = self._outlet, self._playhead
        status = self._status(
            tick=self._tick,
            end_s=end_s,
            pace="replay",
            block_ms=round(1e3 * out.block_rows / out.rate_hz, 6) if out.rate_hz else 0.0,
            queue={"depth": len(self._ahead or ()), "capacity": 0, "high_water": 0, "dropped": 0},
            rate_hz=out.rate_hz,
            health=out.recorded_status,
            warnings=self._warnings(),
        )
        position_s = self._position_ns / NS
        return finite(
            {
                **status,
                "time_s": position_s,
                "real_time_factor": round(play.achieved_rate, 6),
                "replay": {
                    "files": [str(path) for path in self._track.paths],
                    "from_s": begin_s,
                    "to_s": end_s,
                    "position_s": position_s,
                    "paused": self._paused,
                    "waiting_for": self._awaited,
                    "rate": None if self._burst else play.rate,
                    "achieved_rate": round(play.achieved_rate, 4),
                    "behind_s": round(play.behind_s, 3),
                    "by": str(self._passes.timeline.by),
                    "time": "new" if self._renumber else "original",
                    "pass": self._pass,
                    "passes": self._passes.part.loops,
                    "payloads": out.payloads,
                },
            }
        )

    def _warnings(self) -> list[str]:
        warnings = ["this is a recording that is replayed, not a rig"]
        warnings += [f"recorded: {text}" for text in self._outlet.recorded_status.get("warnings", [])]
        if behind_s := self._playhead.behind_s:
            warnings.append(
                f"x{self._playhead.rate:g} is more than this machine and the clients keep up with: "
                f"{behind_s:.1f} s behind"
            )
        if self._held is not None and (held_s := time.monotonic() - self._held[1]) > _HELD_S:
            warnings.append(f"has waited {held_s:.0f} s for client {self._held[0]} to take what was sent")
        return warnings

    def _scene_now(self) -> dict[str, Any]:
        taken = {entry["id"]: entry for entry in self._scene.get("taken", ())}
        for entry in self._track.commands:
            if entry["tick"] * NS < self._position_ns * self._rate and entry["command"] not in _OWN:
                taken.setdefault(entry["id"], entry)
        told = {"taken": list(taken.values())} if taken or "taken" in self._scene else {}
        return {**self._scene, **told, **({} if self._as_recorded else {"replayed": "in part, or changed"})}

    def _wake(self) -> None:
        self._woken.set()
        self._clock.wake()

    def _warn(self, text: str) -> None:
        self._told.append(text)

    # ---- on the playing thread ----

    def _get_ready(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Read what comes first."""
        self._open(self._passes.start_ns).ready(5.0)
        return self._edit.catalogue, self._parameters

    def _go(self) -> str:
        assert self._ahead is not None
        if not self._paused:
            self._playhead.start()
        deadline = Deadline(self._wait_s)
        while True:
            self._take_commands()
            while self._told:
                self._outlet.tell(self._event("warning", self._tick, text=self._told.popleft()))
            if self._stop_requested:
                return "stopped"
            if self._awaited and self._step is None:
                self._look_for_clients(deadline)
            if not self._playhead.runs:
                self._rest(_LOOK_S)
                continue
            if self._head is None:
                self._head = self._ahead.take(_LOOK_S)
                if self._head is None and self._ahead.ended:
                    return "completed"
            if isinstance(self._head, Mark):
                if self._burst and self._begun and self._desk.clients.behind(self.published):
                    # Row numbers may step back: clients must have said that they have what came before.
                    self._rest(_CROWDED_S)
                    continue
                self._begin(self._head)
                self._head = None
            elif self._head is not None:
                self._play_batch(self._head)

    def _look_for_clients(self, deadline: Deadline) -> None:
        """Go on once all are there that are waited for."""
        present = self._desk.clients.present
        if present >= self._awaited:
            self._resume()
        elif deadline.passed:
            raise RefusedError(f"{present} of {self._awaited} clients were there after {self._wait_s:g} s")

    def _play_batch(self, batch: Batch) -> None:
        """Publish what is due next, or find that it is not time yet."""
        step, instant_ns = self._step, self._base_ns + batch[0].due_ns
        if step is not None and step.until_ns is not None and instant_ns > step.until_ns:
            if self._playhead.release(step.until_ns):
                self._end_step(step, step.until_ns)
            return
        if self._burst and self._crowded():
            self._rest(_CROWDED_S)
            return
        if not self._playhead.release(instant_ns):
            return
        for item in batch:
            try:
                self._outlet.send(item)
            except Exception as error:
                self._desk.trouble(f"publishing {item.key}", error)
        self._head = None
        self._playhead.play_ns = instant_ns
        self._position_ns = max(self._position_ns, *(item.position_ns for item in batch))
        if step is not None and step.until_ns is None and has_block(batch):
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
        name = self._desk.clients.crowded(self.published, round(rows)) if rows > 0 else None
        if name is None:
            self._held = None
        elif self._held is None or self._held[0] != name:
            self._held = name, time.monotonic()
        return name is not None

    def _open(self, from_ns: int) -> ReadAhead[Batch | Mark]:
        """Go on from a position of the recording."""
        if self._ahead is not None:
            self._ahead.close()
        self._head = None
        self._ahead = ReadAhead(self._passes.play(from_ns, self._pass), size=size_of)
        return self._ahead

    def _begin(self, mark: Mark) -> None:
        """What follows is due from now on; its numbers follow on those before, where they are given anew."""
        first = mark.from_ns if self._passes.timeline.by is By.SIMULATED else mark.due_ns
        if mark.number > self._pass:
            self._anchor_ns = self._playhead.play_ns
        self._base_ns = self._anchor_ns - first
        self._pass = mark.number
        self._position_ns = mark.from_ns
        self._outlet.begin(mark.number, mark.tick)
        if not self._begun and mark.from_ns > self._track.begin_ns:
            # The recorded start is not in what is played.
            about = {"scene": self._scene.get("name"), "seed": self._scene.get("seed"), "pace": "replay"}
            self._outlet.tell(self._event("start", self._tick, **about))
        self._begun = True

    def _end(self, reason: str) -> dict[str, Any]:
        """End the stream: as it was recorded, where that belongs to what was played."""
        self._desk.close(f"{wire.ENDED}: {reason}", [] if self._step is None else [self._step.reply])
        self._playhead.hold(self._playhead.play_ns)
        if self._ahead is not None:
            self._ahead.close()
        completed = reason == "completed"
        if not (completed and self._outlet.end(as_recorded=self._as_recorded)):
            if completed:
                whole = self._passes.part.to_s is None
                reason += f", {'the recording has no more' if whole else 'the end of what was to be replayed'}"
            self._outlet.tell(self._event("end", self._tick, reason=reason))
        if completed:
            self._outlet.end_status()
        out = self._outlet
        counts = {"blocks": out.blocks, "rows": out.rows, "left_out": out.left_out}
        return {"played_s": self._playhead.play_ns / NS, **counts}

    # Commands.

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
                raise InputError("rate", "sent to a replay with a rate of its own", Words("one that runs with --burst"))
            self._playhead.set_rate(asked.rate, self._now_ns())
        elif pending.command == "pause":
            self._cancel_step("a pause")
            self._awaited = 0
            self._paused = True
            self._playhead.hold(self._now_ns())
        elif pending.command == "resume":
            if self._paused:
                self._cancel_step("a resume")
                self._resume()
        else:
            raise InputError("command", f"one of {', '.join(_OWN)}", pending.command)
        pending.answer(self._accept(pending, self._tick))

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
            raise InputError("step", "sent to a replay that is paused", Words("one that plays"))
        most = _STEP_S * self._rate
        for name, value in asked:
            if value is not None and value > most:
                raise InputError(name, f"a whole number of 1 to {most}", value)
        if asked.ticks is not None and asked.blocks is None:
            self._step = _Step(pending, until_ns=self._now_ns() + asked.ticks * NS // self._rate)
        elif asked.blocks is not None and asked.ticks is None:
            self._step = _Step(pending, blocks=asked.blocks)
        else:
            raise InputError("step", "of ticks or of blocks", sorted(pending.request))
        self._playhead.start()

    def _end_step(self, step: _Step, at_ns: int) -> None:
        self._step = None
        self._playhead.play_ns = at_ns
        self._playhead.hold(at_ns)
        step.reply.answer(self._accept(step.reply, self._tick))

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
        return self._position_ns * self._rate // NS

    def _now_ns(self) -> int:
        """Instant of the play [ns]."""
        return self._playhead.now_ns(self._base_ns + self._head[0].due_ns if isinstance(self._head, list) else None)
