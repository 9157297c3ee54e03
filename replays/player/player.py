"""Serves a recording as a rig serves its run: the same keys, documents, token and reports, at the recorded spacing.

Clients cannot tell the difference from what is published. Only who asks for the status learns that it is a recording,
how far it is, and how late. Deadlines are absolute, from one origin; the operator's pauses, seeks and changes of the
rate set a new one. Nothing is ever left out for lateness.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from replays.player.edit import Edit, Stamp
from replays.player.readahead import ReadAhead
from replays.player.tape import Chunk, Message
from replays.player.timeline import Batch, By, Item, Timeline
from rig import wire
from rig.errors import InputError, RefusedError
from rig.pacing import FreeRun, RealTime, short_collections
from rig.service import COMMANDS, REPLAY_COMMANDS, Pending, finite, one_line, only_fields, parse_command, refusal
from rig.transport import Server
from rig.transport.clients import Clients

_NS = 1_000_000_000
LEAST_RATE, GREATEST_RATE = 0.01, 1000.0
_OWN = (*REPLAY_COMMANDS, "step", "stop")
_AHEAD_S = 30.0
_AHEAD_BLOCKS = 2000
"""How far a burst may be ahead of the slowest client that reports: below what the transport keeps of a key (3000) and
what a recorder can take in (90 s of the default streams)."""
_LOOK_S = 0.1
_CROWDED_S = 2e-3


class Recorded(Protocol):
    """What the player needs of a `Tape`."""

    chunks: list[Chunk]
    begin_ns: int
    end_ns: int
    commands: list[dict[str, Any]]

    @property
    def paths(self) -> Sequence[Path]:
        """The files."""
        ...

    @property
    def documents(self) -> dict[str, dict[str, Any]]:
        """Catalogue, parameters and scene by key."""
        ...

    def read(self, chunk: Chunk, /) -> Iterator[Message]:
        """The messages of one chunk."""
        ...


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
        linger_s: At the end, wait at most this long [s] until clients have recovered what they missed.

    Raises:
        InputError: The recording has no such part, or there is no such rate.
    """

    def __init__(
        self,
        tape: Recorded,
        server: Server,
        clock: RealTime | FreeRun,
        *,
        part: Part | None = None,
        edit: Edit | None = None,
        by: By = By.SIMULATED,
        rate: float = 1.0,
        renumber: bool = False,
        paused: bool = False,
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
        self._rate = check_rate(rate)
        self._stamp = Stamp() if renumber else None
        self._linger_s = linger_s
        self._from_ns, self._to_ns, self._start_ns = self._range(self._part)
        self._as_recorded = self._part == Part() and not self._edit.changes and not renumber
        """What goes out is the recording itself: the row numbers that its `end` tells are right."""

        self._state = "running"
        self._paused = paused
        self._stop_requested = False
        self._step: _Step | None = None
        self._accepted = 0
        self._pending: deque[Pending] = deque()
        self._pending_lock = threading.Lock()
        self._accepting = True
        self._woken = threading.Event()
        self._prepared = False

        self._ahead: ReadAhead[Batch | _Mark] | None = None
        self._head: Batch | _Mark | None = None
        self._base_ns = 0
        """Added to a deadline of the recording it gives the instant of the play [ns]."""
        self._anchor_ns = 0
        """Instant of the play at which the next pass, or what follows a seek, begins [ns]."""
        self._play_ns = 0
        """Instant of the play of the last batch; pauses do not count [ns]."""
        self._resume_ns = 0
        """Instant of the play at which it stands while paused [ns]."""
        self._position_ns = self._start_ns
        """Simulated time of the recording up to which everything has gone out [ns]."""
        self._pass = 1
        self._begun = False
        self._running_since_s: float | None = None
        self._ran_s = 0.0

        self._held: dict[str, list[bytes]] = {wire.EVENTS: [], wire.STATUS: []}
        """What tells that the recorded run has ended, until the play has."""
        self._shown: dict[str, Any] = {}
        self._rows: dict[str, int] = {}
        self._blocks = 0
        self._all_rows = 0
        self._payloads = 0
        self._left_out = 0
        self._counted = self._counted_key()
        self._counted_hz = 0.0
        self._counted_rows = 0
        self._clients = Clients()

    # ---- from any thread ----

    def stop(self) -> None:
        """End the play; from any thread or signal handler."""
        self._stop_requested = True
        self._wake()

    @property
    def reach_s(self) -> tuple[float, float]:
        """Where a pass begins and ends, as far as it is known beforehand [s of simulated time]."""
        return self._from_ns / _NS, (self._tape.end_ns if self._to_ns is None else self._to_ns) / _NS

    def status(self) -> dict[str, Any]:
        """The status document: as a rig's, and `replay` about the play itself.

        Spin, energy and engine are those of the last recorded status.
        """
        begin_s, end_s = self.reach_s
        tick = self._position_ns * self._tick_rate_hz // _NS
        ahead = self._ahead
        return finite(
            {
                "scene": self._documents[wire.SCENE].get("name"),
                "tick": tick,
                "time_s": self._position_ns / _NS,
                "end_s": end_s,
                "wall_s": time.time(),
                "state": self._state,
                "pace": "replay",
                "block_ms": round(1e3 * self._counted_rows / self._counted_hz, 6) if self._counted_hz else 0.0,
                **self._clock.statistics(),
                "real_time_factor": round(self.achieved_rate, 6),
                "queue": {
                    "depth": len(ahead) if ahead is not None else 0,
                    "capacity": 0,
                    "high_water": 0,
                    "dropped": 0,
                },
                "congestion": self._server.congestion(),
                "clients": self._clients.rows(self._published, self._counted_hz),
                "spin_hz": self._shown.get("spin_hz"),
                "energy": self._shown.get("energy", {}),
                "engine": self._shown.get("engine", {}),
                "warnings": self._warnings(),
                "samples_published": self._published,
                "commands": self._accepted,
                "replay": {
                    "files": [str(path) for path in self._tape.paths],
                    "from_s": begin_s,
                    "to_s": end_s,
                    "position_s": self._position_ns / _NS,
                    "paused": self._paused,
                    "rate": None if self._burst else self._rate,
                    "achieved_rate": round(self.achieved_rate, 4),
                    "by": str(self._timeline.by),
                    "time": "original" if self._stamp is None else "new",
                    "pass": self._pass,
                    "passes": self._part.loops,
                    "payloads": self._payloads,
                },
            }
        )

    @property
    def achieved_rate(self) -> float:
        """Recorded seconds played a second, without pauses."""
        ran_s = self._ran_s
        if (since_s := self._running_since_s) is not None:
            ran_s += time.monotonic() - since_s
        return self._play_ns / _NS / ran_s if ran_s > 0.0 else 0.0

    def _warnings(self) -> list[str]:
        warnings = ["this is a recording that is replayed, not a rig"]
        warnings += [f"recorded: {text}" for text in self._shown.get("warnings", [])]
        if self._clients.malformed:
            warnings.append(f"{self._clients.malformed} client reports could not be read")
        return warnings

    # ---- on transport threads ----

    def _serve(self) -> None:
        for key, document in (
            (wire.CATALOGUE, self._edit.catalogue),
            (wire.PARAMETERS, self._documents[wire.PARAMETERS]),
        ):
            payload = wire.encode_document(document)
            self._server.answer(key, lambda _, payload=payload: payload)
        self._server.answer(wire.SCENE, lambda _: wire.encode_document(self._scene()))
        self._server.answer(wire.STATUS, lambda _: wire.encode_document(self.status()))
        for name in dict.fromkeys((*COMMANDS, *REPLAY_COMMANDS)):
            self._server.answer(wire.command_key(name), lambda payload, name=name: self._on_command(name, payload))
        self._server.hear(f"{wire.CLIENTS}/*", self._clients.take)

    def _scene(self) -> dict[str, Any]:
        """The recorded document, with the commands that the rig had taken by now."""
        scene = self._documents[wire.SCENE]
        taken = {entry["id"]: entry for entry in scene.get("taken", ())}
        for entry in self._tape.commands:
            if entry["tick"] * _NS < self._position_ns * self._tick_rate_hz and entry["command"] not in _OWN:
                taken.setdefault(entry["id"], entry)
        return {**scene, "taken": list(taken.values())} if taken or "taken" in scene else scene

    def _on_command(self, name: str, payload: bytes) -> bytes:
        """Hand a command to the playing thread and wait for its answer."""
        try:
            pending = parse_command(name, payload)
            if name not in _OWN:
                line = f"this is a recording that is replayed, which takes no {name}; it takes {', '.join(_OWN)}"
                raise RefusedError(line)
            with self._pending_lock:
                if not self._accepting:
                    raise InputError(name, "sent while the recording plays", "one that has ended")
                self._pending.append(pending)
        except InputError as error:
            return wire.encode_document(refusal(error))
        self._wake()
        return wire.encode_document(pending.reply.result())

    def _wake(self) -> None:
        self._woken.set()
        self._clock.wake()

    # ---- on the playing thread ----

    def prepare(self) -> None:
        """Answer requests and show the token; `run` does it where it was not done before."""
        if not self._prepared:
            self._serve()
            self._open(self._start_ns).ready(5.0)
            self._server.announce()
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
                    self._run_on()
                reason = self._play()
        except KeyboardInterrupt:
            reason = "stopped"
            raise
        except BaseException as error:
            reason = f"failed: {type(error).__name__}: {one_line(error)}"
            raise
        finally:
            self._stop_watch()
            wall_s = time.monotonic() - began_s
            if self._ahead is not None:
                self._ahead.close()
            self._finish(reason)
            self._clients.settle(self._server, self._published, patience_s=self._linger_s)
        status = self.status()
        kept = ("scene", "time_s", "lateness_ms", "overruns", "samples_published", "commands", "replay")
        return {
            "reason": reason,
            "wall_s": wall_s,
            **{name: status[name] for name in kept},
            "played_s": self._play_ns / _NS,
            "blocks": self._blocks,
            "rows": self._all_rows,
            "left_out": self._left_out,
        }

    def _play(self) -> str:
        """The loop; returns why it ended."""
        assert self._ahead is not None
        while True:
            self._take_commands()
            if self._stop_requested:
                return "stopped"
            if self._paused and self._step is None:
                self._rest(_LOOK_S)
                continue
            if self._head is None:
                if self._ahead.ready(_LOOK_S):
                    self._head = self._ahead.take()
                elif self._ahead.ended:
                    return "completed"
            if isinstance(self._head, _Mark):
                if self._burst and self._begun and self._clients.behind(self._published):
                    # Row numbers may step back: clients must have said that they have what came before.
                    self._rest(_CROWDED_S)
                    continue
                self._begin(self._head)
                self._head = None
            elif self._head is not None:
                self._play_batch(self._head)

    def _play_batch(self, batch: Batch) -> None:
        """Publish what is due next, or find that it is not time yet."""
        step, instant_ns = self._step, self._base_ns + batch[0].due_ns
        if step is not None and step.until_ns is not None and instant_ns > step.until_ns:
            if self._clock.release(step.until_ns):
                self._play_ns = step.until_ns
                self._end_step(step)
            return
        if self._burst and self._crowded():
            self._rest(_CROWDED_S)
            return
        if not self._clock.release(instant_ns):
            return
        for item in batch:
            self._send(item)
        self._head = None
        self._play_ns = instant_ns
        self._position_ns = max(self._position_ns, *(item.position_ns for item in batch))
        if step is not None and step.until_ns is None and _has_block(batch):
            step.blocks -= 1
            if step.blocks == 0:
                self._end_step(step)

    def _rest(self, seconds: float) -> None:
        """Wait, but not for longer than until a command comes."""
        self._woken.wait(seconds)
        self._woken.clear()

    def _crowded(self) -> bool:
        """Whether a client that reports has too much on its way."""
        rows = min(_AHEAD_S * self._counted_hz, _AHEAD_BLOCKS * self._counted_rows)
        return rows > 0 and self._clients.crowded(self._published, round(rows))

    # Passes through the recording.

    def _range(self, part: Part) -> tuple[int, int | None, int]:
        """Beginning, end (None: all there is) and first beginning of a pass [ns]."""
        tape = self._tape
        first_s, last_s = tape.begin_ns / _NS, tape.end_ns / _NS
        for name, value in (("from", part.from_s), ("to", part.to_s), ("start", part.start_s)):
            if value is not None and not first_s <= value <= last_s:
                raise InputError(name, f"within the recording, {first_s:g} to {last_s:g} s", value)
        if part.loops is not None and part.loops < 1:
            raise InputError("loop", "at least 1", part.loops)
        begin_ns = tape.begin_ns if part.from_s is None else round(part.from_s * _NS)
        to_ns = None if part.to_s is None else round(part.to_s * _NS)
        start_ns = begin_ns if part.start_s is None else round(part.start_s * _NS)
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
                position = from_ns * self._tick_rate_hz // _NS
                yield _Mark(number, from_ns, first[0][0].due_ns, position if tick is None else tick)
            yield from first
            yield from batches
            number += 1
            from_ns = self._from_ns

    def _begin(self, mark: _Mark) -> None:
        """What follows is due from now on; its numbers follow on those before, where they are given anew."""
        first = mark.from_ns if self._timeline.by is By.SIMULATED else mark.due_ns
        if mark.number > self._pass:
            self._anchor_ns = self._play_ns
        self._base_ns = self._anchor_ns - first
        self._pass = mark.number
        self._position_ns = mark.from_ns
        self._left_out += sum(len(waiting) for waiting in self._held.values())
        for waiting in self._held.values():
            waiting.clear()
        if self._stamp is not None:
            self._stamp.jump(mark.tick)
        if not self._begun and mark.from_ns > self._tape.begin_ns:
            # The recorded start is not in what is played.
            about = self._documents[wire.SCENE]
            self._tell("start", scene=about.get("name"), seed=about.get("seed"), pace="replay")
        self._begun = True

    # Publishing.

    def _send(self, item: Item) -> None:
        key = self._edit.key(item.key)
        if key is None:
            self._left_out += 1
        elif item.block is not None:
            self._send_block(key, item, item.block)
        elif item.key in self._held:
            self._send_document(key, item)
        else:
            self._publish(key, item.payload)

    def _send_block(self, key: str, item: Item, recorded: wire.Block) -> None:
        block = self._edit.block(item.key, recorded)
        if self._stamp is not None:
            block = self._stamp.block(item.key, block)
        self._publish(key, item.payload if block is recorded else wire.encode_block(block))
        rows = len(block.values)
        self._rows[key] = block.index + rows
        self._blocks += 1
        self._all_rows += rows
        if key == self._counted:
            self._counted_hz, self._counted_rows = block.rate_hz, rows

    def _send_document(self, key: str, item: Item) -> None:
        """Events and status as they came; what ends the run waits for the end of the play."""
        payload = item.payload
        try:
            document = wire.decode_document(payload)
        except ValueError:
            self._publish(key, payload)
            return
        if self._stamp is not None:
            if document.get("event") == "start" and self._pass > 1:
                self._left_out += 1
                return
            stamped = self._stamp.document(document, self._tick_rate_hz)
            payload = payload if stamped is document else wire.encode_document(stamped)
        waiting = self._held[item.key]
        if document.get("event") == "end" or document.get("state") == "ended":
            waiting.append(payload)
            return
        while waiting:  # It went on, so that was not its end.
            self._publish(key, waiting.pop(0))
        if item.key == wire.STATUS:
            self._shown = document
        self._publish(key, payload)

    def _publish(self, key: str, payload: bytes) -> None:
        self._server.publish(key, payload)
        self._payloads += 1

    def _tell(self, name: str, **fields: Any) -> None:
        """Publish an event that the recording does not have."""
        tick = self._position_ns * self._tick_rate_hz // _NS
        event = {"event": name, "tick": tick, "time_s": tick / self._tick_rate_hz, "wall_s": time.time(), **fields}
        if self._stamp is not None:
            event = self._stamp.document(event, self._tick_rate_hz)
        if (key := self._edit.key(wire.EVENTS)) is not None:
            self._publish(key, wire.encode_document(finite(event)))

    def _finish(self, reason: str) -> None:
        """End the stream: as it was recorded, where that belongs to what was played."""
        self._state = "ended"
        with self._pending_lock:
            self._accepting = False
            waiting = [pending.reply for pending in self._pending]
            self._pending.clear()
        if self._step is not None:
            waiting.append(self._step.reply.reply)
        for reply in waiting:
            reply.set_result(refusal(InputError("command", "sent while the recording plays", f"its end: {reason}")))
        ends, statuses = (self._held[key] for key in (wire.EVENTS, wire.STATUS))
        if reason != "completed" or not ends:
            why = reason
            if reason == "completed":
                why += ", the recording has no more" if self._to_ns is None else ", the end of what was to be replayed"
            self._tell("end", reason=why, rows=dict(self._rows))
            ends = []
        for payload in ends:
            if not self._as_recorded:
                # Clients tell from these numbers what they still lack.
                payload = wire.encode_document({**wire.decode_document(payload), "rows": dict(self._rows)})
            self._publish(self._edit.key(wire.EVENTS) or wire.EVENTS, payload)
        for payload in statuses if reason == "completed" else []:
            self._publish(self._edit.key(wire.STATUS) or wire.STATUS, payload)

    # Commands.

    def _take_commands(self) -> None:
        while self._pending:
            with self._pending_lock:
                pending = self._pending.popleft()
            try:
                self._carry_out(pending)
            except InputError as error:
                pending.reply.set_result(refusal(error))

    def _carry_out(self, pending: Pending) -> None:
        request = pending.request
        if pending.command == "step":
            only_fields(request, ("ticks", "blocks"))
            self._begin_step(pending)
            return
        fields = {"seek": ("time_s",), "rate": ("rate",)}.get(pending.command, ())
        only_fields(request, fields)
        if pending.command == "stop":
            self._stop_requested = True
        elif pending.command == "seek":
            self._seek(request.get("time_s"))
        elif pending.command == "rate":
            if self._burst:
                raise InputError("rate", "sent to a replay with a rate of its own", "one that runs with --burst")
            self._rate = check_rate(request.get("rate"))
            if self._runs:
                self._run_on(self._now_ns())
        elif pending.command == "pause":
            self._cancel_step("a pause")
            self._pause(self._now_ns())
        elif self._paused:
            self._cancel_step("a resume")
            self._paused = False
            self._run_on(self._now_ns())
        self._accept(pending)

    def _accept(self, pending: Pending) -> None:
        self._accepted += 1
        tick = self._position_ns * self._tick_rate_hz // _NS
        reply = {"accepted": True, "id": self._accepted, "command": pending.command}
        pending.reply.set_result({**reply, "tick": tick, "time_s": tick / self._tick_rate_hz})

    def _seek(self, time_s: Any) -> None:
        begin_s, end_s = self.reach_s
        number = isinstance(time_s, float | int) and not isinstance(time_s, bool)
        if not number or not begin_s <= time_s < end_s:
            raise InputError("time_s", f"a position from {begin_s:g} to below {end_s:g} s", time_s)
        self._cancel_step("a seek")
        self._anchor_ns = self._play_ns = self._now_ns()
        self._as_recorded = False
        self._position_ns = round(time_s * _NS)
        self._open(self._position_ns)
        if self._runs:
            self._run_on(self._anchor_ns)
        else:
            self._resume_ns = self._anchor_ns

    def _begin_step(self, pending: Pending) -> None:
        request = pending.request
        if not self._paused or self._step is not None:
            raise InputError("step", "sent to a replay that is paused", "one that plays")
        if len(request) != 1:
            raise InputError("step", "of ticks or of blocks", sorted(request))
        (name, value), most = next(iter(request.items())), 3600 * self._tick_rate_hz
        if not isinstance(value, int) or isinstance(value, bool) or not 0 < value <= most:
            raise InputError(name, f"a whole number of 1 to {most}", value)
        if name == "blocks":
            self._step = _Step(pending, blocks=value)
        else:
            self._step = _Step(pending, until_ns=self._resume_ns + value * _NS // self._tick_rate_hz)
        self._run_on(self._resume_ns)

    def _end_step(self, step: _Step) -> None:
        self._step = None
        self._pause(self._play_ns)
        self._accept(step.reply)

    def _cancel_step(self, by: str) -> None:
        if self._step is not None:
            self._step.reply.reply.set_result(refusal(InputError("step", "done before anything else", by)))
            self._pause(self._now_ns())
            self._step = None

    # Time.

    @property
    def _runs(self) -> bool:
        return not self._paused or self._step is not None

    def _now_ns(self) -> int:
        """Instant of the play [ns], never past what is still to be published."""
        if not self._runs:
            return self._resume_ns
        now_ns = max(self._clock.position(), self._play_ns)
        if isinstance(self._head, list):
            now_ns = min(now_ns, self._base_ns + self._head[0].due_ns)
        return now_ns

    def _run_on(self, play_ns: int = 0) -> None:
        """Wall time runs from now on, at this instant of the play."""
        # A tick of this clock is a nanosecond of the recording: a rate is so many of them a second.
        self._clock.start(play_ns, round(self._rate * _NS))
        if self._running_since_s is None:
            self._running_since_s = time.monotonic()

    def _pause(self, play_ns: int) -> None:
        self._paused = True
        self._resume_ns = play_ns
        self._stop_watch()

    def _stop_watch(self) -> None:
        since_s, self._running_since_s = self._running_since_s, None
        if since_s is not None:
            self._ran_s += time.monotonic() - since_s

    @property
    def _published(self) -> int:
        """Row after the last one published, of the stream that clients report on."""
        return self._rows.get(self._counted, 0)

    def _counted_key(self) -> str:
        groups = list(self._edit.catalogue["table"]["groups"])
        key = wire.sensor_key("probes" if "probes" in groups else groups[0])
        return self._edit.key(key) or key


def check_rate(rate: Any) -> float:
    """The rate, if it is one.

    Raises:
        InputError: It is no number, or too small or too great.
    """
    number = isinstance(rate, float | int) and not isinstance(rate, bool)
    if not number or not LEAST_RATE <= rate <= GREATEST_RATE:
        raise InputError("rate", f"a number of {LEAST_RATE:g} to {GREATEST_RATE:g}", rate)
    return float(rate)


def _is_block(item: Item) -> bool:
    """Whether it is a block of samples or of the truth; edges come with those."""
    return item.block is not None and item.key != wire.EDGES


def _has_block(batch: Batch) -> bool:
    return any(map(_is_block, batch))


def _size(read: Batch | _Mark) -> int:
    return sum(len(item.payload) for item in read) if isinstance(read, list) else 0
