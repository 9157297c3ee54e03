"""Service of a replay with the keys, documents, token and reports of a live rig, at the recorded spacing.

Published data are the same as from a rig; only the status document identifies a recording and gives its position and
lateness. Deadlines are absolute from one origin; pauses, seeks and changes of the rate set a new origin. No payload is
ever dropped because it is late.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

from replays.player.edit import Edit
from replays.player.messages import Track
from replays.player.outlet import Outlet
from replays.player.play_range import Mark, Part, Passes, has_block, payload_size
from replays.player.playhead import NS, Playhead
from replays.player.readahead import ReadAhead
from replays.player.timeline import Batch, By, Timeline
from rig.base import wire
from rig.base.errors import InputError, RefusedError, Words
from rig.base.text import replace_nonfinite
from rig.serve.pacing import FreeRun, RealTime
from rig.serve.request_handler import PendingCommand, RateRequest, SeekRequest, StepRequest
from rig.serve.served_run import ServedRun
from rig.serve.service import COMMANDS, REPLAY_COMMANDS
from rig.serve.transport import Server
from rig.serve.waiting import Deadline

_ACCEPTED_COMMANDS = (*REPLAY_COMMANDS, "step", "stop")
_POLL_S = 0.1
_BURST_POLL_S = 2e-3
_MAX_STEP_S = 3600
"""Longest single step [s of simulated time]."""


@dataclass(slots=True)
class _PlayStep:
    """A step in progress: until an instant [ns of the replay], or for a number of blocks."""

    reply: PendingCommand
    until_ns: int | None = None
    blocks: int = 0


class Player(ServedRun):
    """Plays one recording to its end and serves it.

    Args:
        track: The recording.
        server: Transport; stays open when the replay ends.
        clock: `RealTime` for the recorded spacing, or `FreeRun` for a burst, limited by the acknowledgements of the
            clients and by the transport, which must wait for them.
        part: Part of the recording to play.
        edit: Changes to the payloads; None: none.
        by: Time that determines the spacing.
        rate: Recorded seconds per second, without a burst.
        renumber: Renumber ticks and rows from 0, without a step at loops and seeks. If False, numbers stay as recorded
            and step at loops and seeks.
        paused: Wait for `resume`, `step` or `seek` before publishing.
        wait_for: Number of acknowledging clients to wait for before publishing; `resume` and `pause` end the wait.
        wait_s: Longest wait for these clients before an error [s].
        hold: Pause at the end of the recording, so that a client can seek back, instead of ending the replay.
        linger_s: Longest time at the end for clients to recover missing blocks [s].

    Raises:
        InputError: If the recording has no such part, or the rate is invalid.
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
        hold: bool = False,
        linger_s: float = 10.0,
    ) -> None:
        documents = track.documents
        super().__init__(
            server,
            clock,
            scene=documents[wire.SCENE],
            tick_rate_hz=int(documents[wire.CATALOGUE]["tick_rate_hz"]),
            commands=_ACCEPTED_COMMANDS,
            unsupported={
                name: f"a replay does not accept {name}; accepted commands: {', '.join(_ACCEPTED_COMMANDS)}"
                for name in COMMANDS
                if name not in _ACCEPTED_COMMANDS
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
        """True if the recording is published unchanged, so that the row numbers in its `end` event are valid."""

        self._paused = paused or wait_for > 0
        self._awaited = wait_for
        """Number of clients to wait for; 0 if only a command ends the pause."""
        self._wait_s = wait_s
        self._hold = hold
        self._step: _PlayStep | None = None
        self._pending_warnings: deque[str] = deque()
        """Warnings for the playing thread to publish."""
        self._woken = threading.Event()

        self._position_ns = self._passes.start_ns
        """Simulated time of the recording up to which everything is published [ns]."""
        self._pass = 1
        self._begun = False
        self._ahead: ReadAhead[Batch | Mark] | None = None
        self._head: Batch | Mark | None = None
        self._base_ns = 0
        """Offset from deadlines of the recording to instants of the replay [ns]."""
        self._anchor_ns = 0
        """Instant of the replay at which the next pass, or the data after a seek, begins [ns]."""

    # ---- called from any thread ----

    @property
    def published(self) -> int:
        """Number of published rows of the stream that clients acknowledge."""
        return self._outlet.published

    @property
    def reach_s(self) -> tuple[float, float]:
        """Begin and end of a pass, as far as they are known in advance [s of simulated time]."""
        return self._passes.from_ns / NS, self._passes.end_ns / NS

    def status(self) -> dict[str, Any]:
        """Return the status document: a rig's, with `replay` for the replay itself.

        Spin, energy and engine come from the last recorded status.
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
        return replace_nonfinite(
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
        warnings = ["this is a replay of a recording, not a rig"]
        warnings += [f"recorded: {text}" for text in self._outlet.recorded_status.get("warnings", [])]
        if behind_s := self._playhead.behind_s:
            warnings.append(
                f"x{self._playhead.rate:g} is faster than this machine and its clients: late by {behind_s:.1f} s"
            )
        return warnings

    def _scene_document(self) -> dict[str, Any]:
        commands_by_id = {entry["id"]: entry for entry in self._scene.get("taken", ())}
        for entry in self._track.commands:
            if entry["tick"] * NS < self._position_ns * self._rate and entry["command"] not in _ACCEPTED_COMMANDS:
                commands_by_id.setdefault(entry["id"], entry)
        commands = {"taken": list(commands_by_id.values())} if commands_by_id or "taken" in self._scene else {}
        return {**self._scene, **commands, **({} if self._as_recorded else {"replayed": "in part, or changed"})}

    def _wake(self) -> None:
        self._woken.set()
        self._clock.wake()

    def _warn(self, text: str) -> None:
        self._pending_warnings.append(text)

    # ---- called on the playing thread ----

    def _prepare_documents(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Read the first batches; return the catalogue and the parameters."""
        self._open(self._passes.start_ns).ready(5.0)
        return self._edit.catalogue, self._parameters

    def _run_to_end(self) -> str:
        assert self._ahead is not None
        if not self._paused:
            self._playhead.start()
        deadline = Deadline(self._wait_s)
        while True:
            self._take_commands()
            while self._pending_warnings:
                self._outlet.publish_event(self._event("warning", self._tick, text=self._pending_warnings.popleft()))
            if self._stop_requested:
                return "stopped"
            if self._awaited and self._step is None:
                self._check_clients(deadline)
            if not self._playhead.runs:
                self._wait(_POLL_S)
                continue
            if self._head is None:
                self._head = self._ahead.take(_POLL_S)
                if self._head is None and self._ahead.ended:
                    if not self._hold:
                        return "completed"
                    self._cancel_step("the end of the recording")
                    self._paused = True
                    self._playhead.hold(self._now_ns())
            if isinstance(self._head, Mark):
                if self._burst and self._begun and self._handler.clients.max_lag_rows(self.published):
                    # Row numbers may step back: clients must first acknowledge the earlier rows.
                    self._wait(_BURST_POLL_S)
                    continue
                self._begin(self._head)
                self._head = None
            elif self._head is not None:
                self._play_batch(self._head)

    def _check_clients(self, deadline: Deadline) -> None:
        """Resume once all expected clients are present."""
        present = self._handler.clients.active_count
        if present >= self._awaited:
            self._resume()
        elif deadline.passed:
            raise RefusedError(f"{present} of {self._awaited} clients were present after {self._wait_s:g} s")

    def _play_batch(self, batch: Batch) -> None:
        """Publish the next batch if it is due."""
        step, instant_ns = self._step, self._base_ns + batch[0].due_ns
        if step is not None and step.until_ns is not None and instant_ns > step.until_ns:
            if self._playhead.release(step.until_ns):
                self._end_step(step, step.until_ns)
            return
        if self._burst and self._is_client_behind(self.published, self._outlet.rate_hz, self._outlet.block_rows):
            self._wait(_BURST_POLL_S)
            return
        if not self._playhead.release(instant_ns):
            return
        for item in batch:
            try:
                self._outlet.send(item)
            except Exception as error:
                self._handler.record_failure(f"publishing {item.key}", error)
        self._head = None
        self._playhead.play_ns = instant_ns
        self._position_ns = max(self._position_ns, *(item.position_ns for item in batch))
        if step is not None and step.until_ns is None and has_block(batch):
            step.blocks -= 1
            if step.blocks == 0:
                self._end_step(step, instant_ns)

    def _wait(self, seconds: float) -> None:
        """Wait for a time or until a command arrives."""
        self._woken.wait(seconds)
        self._woken.clear()

    def _open(self, from_ns: int) -> ReadAhead[Batch | Mark]:
        """Start reading at a position of the recording."""
        if self._ahead is not None:
            self._ahead.close()
        self._head = None
        self._ahead = ReadAhead(self._passes.play(from_ns, self._pass), size=payload_size)
        return self._ahead

    def _begin(self, mark: Mark) -> None:
        """Start a pass or the data after a seek: set their time base and numbering."""
        first = mark.from_ns if self._passes.timeline.by is By.SIMULATED else mark.due_ns
        if mark.number > self._pass:
            self._anchor_ns = self._playhead.play_ns
        self._base_ns = self._anchor_ns - first
        self._pass = mark.number
        self._position_ns = mark.from_ns
        self._outlet.begin(mark.number, mark.tick)
        if not self._begun and mark.from_ns > self._track.begin_ns:
            # The recorded start event is outside the played part.
            about = {"scene": self._scene.get("name"), "seed": self._scene.get("seed"), "pace": "replay"}
            self._outlet.publish_event(self._event("start", self._tick, **about))
        self._begun = True

    def _end(self, reason: str) -> dict[str, Any]:
        """End the stream, with the recorded end event if the played part includes it."""
        self._handler.close(f"{wire.ENDED}: {reason}", [] if self._step is None else [self._step.reply])
        self._playhead.hold(self._playhead.play_ns)
        if self._ahead is not None:
            self._ahead.close()
        completed = reason == "completed"
        if not (completed and self._outlet.end(as_recorded=self._as_recorded)):
            if completed:
                whole = self._passes.part.to_s is None
                reason += f", {'end of the recording' if whole else 'end of the selected part'}"
            self._outlet.publish_event(self._event("end", self._tick, reason=reason))
        if completed:
            self._outlet.end_status()
        out = self._outlet
        counts = {"blocks": out.blocks, "rows": out.rows, "left_out": out.left_out}
        return {"played_s": self._playhead.play_ns / NS, **counts}

    # Commands.

    def _execute(self, pending: PendingCommand) -> None:
        arguments = pending.arguments
        if isinstance(arguments, StepRequest):
            self._begin_step(pending, arguments)
            return
        if pending.command == "stop":
            self._stop_requested = True
        elif isinstance(arguments, SeekRequest):
            self._seek(arguments.time_s)
        elif isinstance(arguments, RateRequest):
            if self._burst:
                raise InputError("rate", "sent to a replay without --burst", Words("a replay with --burst"))
            self._playhead.set_rate(arguments.rate, self._now_ns())
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
            raise InputError("command", f"one of {', '.join(_ACCEPTED_COMMANDS)}", pending.command)
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

    def _begin_step(self, pending: PendingCommand, arguments: StepRequest) -> None:
        if not self._paused or self._step is not None:
            raise InputError("step", "sent to a paused replay", Words("a replay that runs"))
        most = _MAX_STEP_S * self._rate
        for name, value in arguments:
            if value is not None and value > most:
                raise InputError(name, f"a whole number of 1 to {most}", value)
        if arguments.ticks is not None and arguments.blocks is None:
            self._step = _PlayStep(pending, until_ns=self._now_ns() + arguments.ticks * NS // self._rate)
        elif arguments.blocks is not None and arguments.ticks is None:
            self._step = _PlayStep(pending, blocks=arguments.blocks)
        else:
            raise InputError("step", "either ticks or blocks", sorted(pending.request))
        self._playhead.start()

    def _end_step(self, step: _PlayStep, at_ns: int) -> None:
        self._step = None
        self._playhead.play_ns = at_ns
        self._playhead.hold(at_ns)
        step.reply.answer(self._accept(step.reply, self._tick))

    def _cancel_step(self, by: str) -> None:
        if self._step is not None:
            self._step.reply.refuse(InputError("step", "completed before another command", by))
            self._playhead.hold(self._now_ns())
            self._step = None

    def _resume(self) -> None:
        self._paused, self._awaited = False, 0
        self._playhead.start()

    # ---- position ----

    @property
    def _tick(self) -> int:
        """Position in the recording [ticks]."""
        return self._position_ns * self._rate // NS

    def _now_ns(self) -> int:
        """Return the current instant of the replay [ns]."""
        return self._playhead.now_ns(self._base_ns + self._head[0].due_ns if isinstance(self._head, list) else None)
