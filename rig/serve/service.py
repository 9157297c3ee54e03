"""Service of a simulation: the only module that combines a simulation, a clock and a transport.

The simulation thread (the caller of `Service.run`) takes commands at a block boundary, advances, waits until the block
is due and puts it into a bounded queue; it never waits for another process. A publisher thread encodes and publishes. A
paced run drops the oldest blocks when the queue is full, counts them, and the gap shows in the row numbers. An unpaced
run waits for the publisher instead.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rig.base import wire
from rig.base.errors import InputError, Words
from rig.base.text import replace_nonfinite
from rig.channels.faults import TRANSPORTS, Message
from rig.run.commands import SUMMARIES
from rig.run.commands.table import SERVICE_COMMANDS
from rig.serve.devices import Devices, describe_waits
from rig.serve.pacing import Clock, Lockstep, RealTime
from rig.serve.request_handler import (
    CommandHistory,
    DoneRequest,
    JoinRequest,
    LeaveRequest,
    NoteRequest,
    PendingCommand,
    StepRequest,
)
from rig.serve.served_run import ServedRun
from rig.serve.transport import Server, get_transports
from rig.serve.transport.limit import CommandLimit
from rig.serve.waiting import BoundedQueue

if TYPE_CHECKING:
    from rig.channels.faults.delivery import Frame
    from rig.run.simulation import Simulation

COMMANDS = (*SUMMARIES, *SERVICE_COMMANDS)
REPLAY_COMMANDS = ("pause", "resume", "seek", "rate")
"""Commands of a replay only (`replays.player`)."""

_MAX_STEP_S = 3600
"""Longest single step [s of simulated time]."""
_DEVICE_WAIT_S = 0.1
"""Longest single wait for devices, unless one must be removed sooner [s]."""
_WAIT_WARNING_S = 5.0
"""Wait for devices above which a warning is shown [s]."""
_MAX_HELD = 256
"""Commands that may wait for other devices."""
_UNLIMITED_HZ = 1e9
"""Commands per second of one sender in lockstep: no limit."""
_CLIENT_POLL_S = 2e-3
_QUEUE_WARNING_S = 1.0
"""Waiting time of blocks above which a warning is shown [s]."""


@dataclass(slots=True)
class _Entry:
    """Unit of publishing: events, a block of all streams, events, the end of the block, and the waiting replies."""

    events_before: list[dict[str, Any]]
    frame: Frame | None = None
    events_after: list[dict[str, Any]] = field(default_factory=list)
    block_end: dict[str, Any] | None = None
    replies: list[tuple[PendingCommand, dict[str, Any]]] = field(default_factory=list)


def _inherit(dropped: _Entry, following: _Entry) -> None:
    """Pass events and replies of a dropped block to the next entry; they are few, and must not be lost."""
    following.events_before = [*dropped.events_before, *dropped.events_after, *following.events_before]
    following.replies = [*dropped.replies, *following.replies]


class Service(ServedRun):
    """Runs one simulation to its end and serves it.

    Args:
        simulation: The simulation.
        server: Transport; stays open when the run ends.
        clock: Pace.
        block_ticks: Length of a published block [ticks], a whole multiple of the simulation's own.
        queue_seconds: Blocks that may wait for the publisher [s of simulated time]; longer than the transport waits for
            a client that stalls during its recovery.
        status_period_s: Wall time between status messages [s].
        linger_s: Longest wait at the end of a run until clients have recovered missed messages [s].
        limit: Limit of commands per second; in lockstep unlimited by default.

    Raises:
        InputError: `block_ticks` does not fit the simulation.
    """

    def __init__(
        self,
        simulation: Simulation,
        server: Server,
        clock: Clock,
        *,
        block_ticks: int,
        queue_seconds: float = 30.0,
        status_period_s: float = 0.5,
        linger_s: float = 10.0,
        limit: CommandLimit | None = None,
    ) -> None:
        if block_ticks <= 0 or block_ticks % simulation.block_ticks:
            raise InputError("block_ticks", f"a whole multiple of {simulation.block_ticks} ticks", block_ticks)
        super().__init__(
            server,
            clock,
            scene=simulation.scene_document(),
            tick_rate_hz=simulation.tick_rate_hz,
            commands=COMMANDS,
            unsupported={
                name: f"{name} is for a recording that is replayed (rig replay); this is a simulator, which runs on"
                for name in REPLAY_COMMANDS
            },
            running="the rig runs",
            linger_s=linger_s,
            # In lockstep many commands cause no delay, and none may be refused because of the wall clock.
            limit=limit or (CommandLimit(_UNLIMITED_HZ) if isinstance(clock, Lockstep) else None),
        )
        simulation.set_transports(tuple(get_transports(server)))
        self._simulation = simulation
        self._block_ticks = block_ticks
        self._status_period_s = status_period_s
        self._queue: BoundedQueue[_Entry] = BoundedQueue(
            max(2, math.ceil(queue_seconds * self._rate / block_ticks)),
            size=lambda entry: int(entry.frame is not None),
            inherit=_inherit,
        )
        self._publisher = threading.Thread(target=self._publish_all, name="publisher", daemon=True)
        self._end_event: dict[str, Any] = {}
        self._may_drop = isinstance(clock, RealTime)
        self._overflowing = False
        self._tick = simulation.tick
        self._health: dict[str, Any] = {}
        self._next_health_s = 0.0

        self._history = CommandHistory()
        """Accepted commands: a late client needs them to repeat the scene."""
        self._waiting: list[PendingCommand] = []
        """Commands of devices that wait for other devices."""
        self._steps: list[tuple[int, PendingCommand, dict[str, Any]]] = []
        self._step_target: int | None = None

        self._devices = Devices()
        self._blocks = 0
        """Number of blocks run."""
        self._ends: dict[int | None, int] = {}
        """Ends of the last two blocks [ticks], by number."""
        self._notified: tuple[int, float] = (-1, 0.0)
        """End of the last block of which devices were notified [ticks], and when [s, monotonic]."""
        self._sent_counts: dict[str, int] = {}
        """Messages published by key, as zenoh numbers them."""
        self._previous_counts: dict[str, int] = {}
        """The same at the end of the previous block."""

        self._rows = wire.Continuity()
        self._samples_rate_hz = 0.0
        self._samples_published = 0

    # ---- from any thread ----

    @property
    def published(self) -> int:
        """Index after the last published row, of the stream that clients report on."""
        return self._samples_published

    def status(self) -> dict[str, Any]:
        """Return the status document (see rig/KEYS.md)."""
        queue, end_tick = self._queue, self._simulation.end_tick
        warnings = list(self._health.get("warnings", []))
        if queue.dropped:
            warnings.append(f"{queue.dropped} blocks dropped: the publisher did not keep up")
        waiting_s = queue.used * self._block_ticks / self._rate
        if self._may_drop and waiting_s > _QUEUE_WARNING_S:
            warnings.append(f"{waiting_s:.1f} s of blocks wait: a client holds up the publisher")
        devices = self._devices.status_rows(*self._notified, time.monotonic())
        if (waits := describe_waits(devices)) and max(row["behind_s"] for row in devices) > _WAIT_WARNING_S:
            warnings.append(waits)
        status = self._status(
            tick=self._tick,
            end_s=None if end_tick is None else end_tick / self._rate,
            pace=self._clock.pace,
            block_ms=1e3 * self._block_ticks / self._rate,
            queue={
                "depth": queue.used,
                "capacity": queue.room,
                "high_water": queue.high_water,
                "dropped": queue.dropped,
            },
            rate_hz=self._samples_rate_hz,
            health=self._health,
            warnings=warnings,
        )
        return {**status, "devices": devices}

    def _warn(self, text: str) -> None:
        self._queue.push(_Entry([self._event("warning", self._simulation.tick, text=text)]))

    # ---- on the simulation thread ----

    def _prepare_documents(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Compile all kernels."""
        self._simulation.warm_up()
        self._health = self._simulation.health()
        return self._simulation.catalogue(), self._simulation.parameters_document()

    def _scene_document(self) -> dict[str, Any]:
        return {**self._scene, **self._history.document}

    def _run_to_end(self) -> str:
        simulation = self._simulation
        start = {"scene": self._scene.get("name"), "seed": self._scene.get("seed"), "pace": self._clock.pace}
        self._queue.push(_Entry([self._event("start", simulation.tick, **start)]))
        self._publisher.start()
        self._clock.start(simulation.tick, self._rate)
        reason = self._advance_all()
        # A recording keeps the last status, which must be that of the end.
        self._next_health_s = 0.0
        self._refresh_health()
        return reason

    def _advance_all(self) -> str:
        """Advance block by block; return the reason for the end."""
        simulation, clock, queue = self._simulation, self._clock, self._queue
        end = simulation.end_tick
        while True:
            events = self._take_commands()
            if self._stop_requested:
                queue.push(_Entry(events))
                return "stopped"
            if self._devices.find_unfinished(simulation.tick):
                self._wait_for_devices(events)
                continue
            if replies := self._finished_steps():
                queue.push(_Entry(events, replies=replies))
                events = []
            if not self._may_drop:
                # The client that grants the next block may wait for these events.
                self._defer(events)
                events = []
            if end is not None and simulation.tick >= end:
                queue.push(_Entry(events))
                return "completed"
            ticks_due = self._block_ticks
            if end is not None:
                ticks_left = end - simulation.tick
                ticks_due = min(ticks_due, math.ceil(ticks_left / simulation.block_ticks) * simulation.block_ticks)
            if not self._may_drop and not queue.wait_for_room(0.1):
                self._defer(events)
                continue
            if clock.pace == "free" and self._must_wait():
                self._defer(events)
                time.sleep(_CLIENT_POLL_S)
                continue
            ticks = clock.grant(ticks_due)
            if ticks == 0:
                self._defer(events)
                continue
            frame = simulation.advance(ticks)
            answered = []
            while not clock.release(simulation.tick):
                # A command received before the block is due takes effect at its end, and is answered now.
                answered += self._take_commands()
            self._tick = simulation.tick
            events_after = [{**event, "wall_s": time.time()} for event in frame.events]
            self._blocks += 1
            self._ends = {self._blocks - 1: frame.tick, self._blocks: self._tick}
            block_end = {"block": self._blocks, "tick": self._tick, "time_s": self._tick / self._rate}
            entry = _Entry(
                events, frame, [*events_after, *answered], block_end if self._devices else None, self._finished_steps()
            )
            self._report_overflow(queue.push(entry))
            self._refresh_health()

    def _must_wait(self) -> bool:
        """Return whether a client has received too little of what was produced."""
        rate_hz = self._samples_rate_hz
        block_rows = rate_hz * self._block_ticks / self._rate
        return self._is_client_behind(self.published + round(self._queue.used * block_rows), rate_hz, block_rows)

    def _defer(self, events: list[dict[str, Any]]) -> None:
        """Publish events without a block."""
        if events:
            self._queue.push(_Entry(events))

    def _wait_for_devices(self, events: list[dict[str, Any]]) -> None:
        """Wait for devices that have not finished the last block; remove those that exceed their time limit."""
        tick, now_s, (notified_tick, since_s) = self._simulation.tick, time.monotonic(), self._notified
        # Their time begins when they are notified of the end of the block.
        since_s = since_s if notified_tick == tick else now_s
        late, left_s = self._devices.remove_late(tick, since_s, now_s, {pending.sender for pending in self._waiting})
        self._defer([*events, *(self._device_event(name, "lost", reason=reason) for name, reason in late.items())])
        if now_s - since_s > _WAIT_WARNING_S:
            self._handler.warn(describe_waits(self._devices.status_rows(tick, since_s, now_s)))
        if not late:
            self._clock.hold(min(left_s, _DEVICE_WAIT_S))

    def _device_event(self, name: str, state: str, **more: Any) -> dict[str, Any]:
        return self._event("device", self._simulation.tick, device=name, state=state, **more)

    def _report_overflow(self, dropped: int) -> None:
        """Report each overflow of the queue once; the status has the count."""
        if dropped and not self._overflowing:
            text = "the publisher does not keep up: the oldest blocks in the queue are dropped"
            self._queue.push(_Entry([self._event("warning", self._simulation.tick, text=text)]))
        self._overflowing = bool(dropped)

    def _received_commands(self) -> Iterator[PendingCommand]:
        """Yield the received commands, those of devices in the order of their names, independent of their arrival.

        A device's command is executed once all devices before it have finished the block.
        """
        for pending in self._handler.take_commands():
            if len(self._waiting) < _MAX_HELD:
                self._waiting.append(pending)
            else:
                pending.refuse(
                    InputError("commands", f"at most {_MAX_HELD} that wait for other devices", _MAX_HELD + 1)
                )
        while (index := self._devices.find_first_due(self._waiting, self._simulation.tick)) is not None:
            yield self._waiting.pop(index)

    def _execute(self, pending: PendingCommand) -> dict[str, Any] | None:
        arguments, tick, done_tick = pending.arguments, self._simulation.tick, None
        if isinstance(arguments, JoinRequest | DoneRequest | LeaveRequest):
            return self._handle_device(pending, arguments)
        result: dict[str, Any] = {}
        if pending.command == "stop":
            self._stop_requested = True
        elif isinstance(arguments, StepRequest):
            done_tick = self._check_step(arguments)
        elif not isinstance(arguments, NoteRequest):
            tick = self._simulation.submit(pending.command, dict(pending.request))
            result = self._simulation.command_result
            self._history.add(
                {"id": self._accepted + 1, "tick": tick, "command": pending.command, "request": pending.request}
            )
        reply = self._accept(pending, tick if done_tick is None else done_tick)
        if done_tick is None:
            pending.answer({**reply, **result})
        else:
            self._steps.append((done_tick, pending, reply))
        if isinstance(arguments, NoteRequest):
            # A separate event: it does not affect the rig, so it is skipped when commands are repeated.
            return {**self._event("note", tick, id=self._accepted), **arguments.model_dump(), "from": pending.sender}
        detail = {"id": self._accepted, "command": pending.command, "request": pending.request, "from": pending.sender}
        return self._event("command", tick, **detail)

    def _handle_device(
        self, pending: PendingCommand, arguments: JoinRequest | DoneRequest | LeaveRequest
    ) -> dict[str, Any] | None:
        """Handle a device that joins, has finished a block, or leaves."""
        self._require_lockstep(pending.command)
        tick, name = self._simulation.tick, arguments.device
        if isinstance(arguments, DoneRequest):
            by_block = arguments.block is not None
            end = self._ends.get(arguments.block) if by_block else arguments.tick
            text = f"block {arguments.block}" if by_block else f"tick {end}"
            reason = self._devices.done(name, end, tick, text, arguments.secret)
            if reason is not None:
                must = f"with tick {tick}, the end of the last block ({self._blocks})"
                pending.refuse(InputError("done", must, Words(text)))
                return self._device_event(name, "lost", reason=reason)
            # Not counted, and without an event: there is one per block, and the order of several devices is random.
            pending.answer({"accepted": True, "id": 0, "command": "done", "tick": tick, "time_s": tick / self._rate})
            return None
        if isinstance(arguments, JoinRequest):
            self._devices.join(name, arguments.patience_s, tick, arguments.secret)
            pending.answer(self._accept(pending, tick))
            return self._device_event(name, "joined", **{"from": pending.sender}, patience_s=arguments.patience_s)
        self._devices.leave(name, arguments.secret)
        pending.answer(self._accept(pending, tick))
        return self._device_event(name, "left", **{"from": pending.sender})

    def _require_lockstep(self, command: str) -> Lockstep:
        if isinstance(self._clock, Lockstep):
            return self._clock
        raise InputError(command, "sent to a rig that runs with --pace lockstep", Words(f"--pace {self._clock.pace}"))

    def _check_step(self, arguments: StepRequest) -> int:
        """Grant a step; return the tick of its end."""
        clock = self._require_lockstep("step")
        ticks, unit = arguments.ticks, self._simulation.block_ticks
        max_ticks = _MAX_STEP_S * self._rate
        if arguments.blocks is not None:
            raise InputError("step.blocks", "left out, except for a replay", arguments.blocks)
        if ticks is None or ticks > max_ticks or ticks % unit:
            raise InputError("ticks", f"a positive whole multiple of {unit}, at most {max_ticks}", ticks)
        start = self._step_target if self._step_target is not None else self._simulation.tick
        end = self._simulation.end_tick
        if end is not None and start + ticks > end:
            raise InputError("ticks", f"at most {end - start}, the rest of the scene", ticks)
        self._step_target = start + ticks
        clock.allow(ticks)
        return self._step_target

    def _finished_steps(self) -> list[tuple[PendingCommand, dict[str, Any]]]:
        """Return the steps completed by the last block, which are answered after publishing and all devices."""
        if not self._steps or self._devices.find_unfinished(self._tick):
            return []
        lost = {"lost": dict(self._devices.lost)} if self._devices.lost else {}
        done = [(reply, {**document, **lost}) for tick, reply, document in self._steps if tick <= self._tick]
        if done:
            self._devices.lost.clear()
        self._steps = [row for row in self._steps if row[0] > self._tick]
        if not self._steps:
            self._step_target = None
        return done

    def _refresh_health(self) -> None:
        """Update the simulation's health a few times per second; each new kind of warning becomes an event."""
        now = time.monotonic()
        if now < self._next_health_s:
            return
        self._next_health_s = now + self._status_period_s
        self._health = self._simulation.health()
        for text in self._health.get("warnings", []):
            self._handler.warn(text)

    def _end(self, reason: str) -> dict[str, Any]:
        self._handler.close(f"{wire.ENDED}: {reason}", [*(pending for _, pending, _ in self._steps), *self._waiting])
        self._end_event = self._event("end", self._simulation.tick, reason=reason)
        self._queue.close()
        if self._publisher.ident is not None:
            self._publisher.join(timeout=60.0)
        # If the publisher failed, the remaining steps are answered here.
        while (entry := self._queue.take(0.0)) is not None:
            self._answer(entry)
        return {"rows": dict(self._rows.next)}

    # ---- on the publisher thread ----

    def _publish_all(self) -> None:
        next_status_s = time.monotonic()
        while not self._queue.ended:
            entry = self._queue.take(max(0.0, next_status_s - time.monotonic()))
            if entry is not None:
                self._publish_entry(entry)
            now = time.monotonic()
            if now >= next_status_s:
                self._run_guarded("publishing the status", self._publish_status)
                # Not one period after the last one, so that a delayed status is not followed by a burst.
                next_status_s = now + self._status_period_s
        # The last event: failures while the queue is published are reported before it.
        self._run_guarded("publishing events", self._publish_event, self._end_event)
        self._run_guarded("publishing the status", self._publish_status)

    def _run_guarded(self, task: str, work: Callable[..., None], *arguments: Any) -> None:
        """Do one task of this thread; a failure does not affect other streams or the pace."""
        try:
            work(*arguments)
        except Exception as error:
            self._handler.record_failure(task, error)

    def _publish_entry(self, entry: _Entry) -> None:
        for event in entry.events_before:
            self._run_guarded("publishing events", self._publish_event, event)
        if entry.frame is not None:
            for document in entry.frame.documents:
                self._run_guarded(
                    "publishing faults",
                    self._server.publish,
                    wire.FAULTS,
                    wire.encode_document(replace_nonfinite(document)),
                )
            for message in entry.frame.messages:
                self._run_guarded(f"publishing {message.key}", self._publish_block, message)
            self._count_samples(entry.frame)
        for event in entry.events_after:
            self._run_guarded("publishing events", self._publish_event, event)
        if entry.block_end is not None:
            self._run_guarded("publishing the end of a block", self._publish_block_end, entry.block_end)
            self._notified = (entry.block_end["tick"], time.monotonic())
            self._wake()
        if entry.frame is not None:
            self._previous_counts = dict(self._sent_counts)
        self._answer(entry)

    def _publish_block(self, message: Message) -> None:
        # A client that misses rows learns from the end event what is missing.
        self._rows.follow(message.key, message.row, len(message.block.values), late_rows=math.inf)
        if "zenoh" in message.transports:
            self._sent_counts[message.key] = self._sent_counts.get(message.key, 0) + 1
        servers = [self._server]
        if message.transports != TRANSPORTS:
            servers = [server for name, server in get_transports(self._server).items() if name in message.transports]
        for server in servers:
            server.publish(message.key, wire.encode_block(message.block))

    def _publish_block_end(self, block_end: dict[str, Any]) -> None:
        """Publish the end of a block, with the number of the last message of each key that had new messages."""
        last = {key: sent - 1 for key, sent in self._sent_counts.items() if sent != self._previous_counts.get(key)}
        self._server.publish(wire.BLOCK, wire.encode_document({**block_end, "messages": last}))

    def _publish_event(self, event: dict[str, Any]) -> None:
        self._sent_counts[wire.EVENTS] = self._sent_counts.get(wire.EVENTS, 0) + 1
        self._server.publish(wire.EVENTS, wire.encode_document(replace_nonfinite(self._rows.add_row_counts(event))))

    def _publish_status(self) -> None:
        self._server.publish(wire.STATUS, wire.encode_document(self.status()))

    def _count_samples(self, frame: Frame) -> None:
        """Update the reference for client lag: the probes, or the first group of a scene without probes."""
        group = "probes" if "probes" in frame.samples else next(iter(frame.samples), None)
        if group is not None:
            self._samples_rate_hz = frame.samples[group].rate_hz
            self._samples_published = self._rows.next.get(wire.sensor_key(group), 0)

    @staticmethod
    def _answer(entry: _Entry) -> None:
        for pending, document in entry.replies:
            pending.answer(document)
