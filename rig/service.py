"""The only place where a simulation, a clock and a transport meet.

The simulation thread (the caller of `Service.run`) takes commands at a block boundary, advances, waits until the block
is due and puts it into a bounded queue; it never waits for another process. A publisher thread encodes and
publishes. What does not fit into the queue of a paced run is dropped oldest first, whole blocks at a time, and counted;
the gap also shows in the row numbers. An unpaced run waits for the publisher instead.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from rig import wire
from rig.bounded_queue import BoundedQueue
from rig.desk import Desk, Note, Pending, Step, finite, one_line
from rig.errors import InputError
from rig.pacing import Clock, Lockstep, RealTime, StepTimeoutError, short_collections
from rig.transport import Server
from rig.transport.limit import CommandLimit

SIMULATION_COMMANDS = ("hammer", "speed", "release")
"""Commands that the simulation itself checks and carries out."""
COMMANDS = (*SIMULATION_COMMANDS, "stop", "step", "note")
REPLAY_COMMANDS = ("pause", "resume", "seek", "rate")
"""Commands that only a replayed recording takes (`replays.player`)."""

_STEP_S = 3600
"""Longest single step [s of simulated time]."""
_HELD_UP_S = 1.0
"""Blocks that wait to be published for longer than this are told [s]."""
_TAKEN_BYTES = 500_000
"""What is told to latecomers of the commands so far; the oldest go first, and are counted."""


class Frame(Protocol):
    """Everything that one `advance` produced; its arrays are not written to again."""

    @property
    def tick(self) -> int:
        """Start [ticks]."""
        ...

    @property
    def ticks(self) -> int:
        """Length [ticks]."""
        ...

    @property
    def samples(self) -> Mapping[str, wire.Block]:
        """ADC counts by sensor group."""
        ...

    @property
    def edges(self) -> wire.Block | None:
        """Keyphasor edges, where there were any."""
        ...

    @property
    def truth(self) -> Mapping[str, wire.Block]:
        """Model values by truth table."""
        ...

    @property
    def events(self) -> list[dict[str, Any]]:
        """What took effect: event, tick, time_s and further fields."""
        ...


class Simulation(Protocol):
    """What the service needs of `rig.simulation.Simulation`."""

    @property
    def tick(self) -> int:
        """Where it stands [ticks]."""
        ...

    @property
    def tick_rate_hz(self) -> int:
        """Ticks per simulated second."""
        ...

    @property
    def block_ticks(self) -> int:
        """Every advance is a whole multiple of this [ticks]."""
        ...

    @property
    def end_tick(self) -> int | None:
        """Where it ends, or None."""
        ...

    def advance(self, ticks: int, /) -> Frame:
        """Simulate on."""
        ...

    def submit(self, command: str, request: dict[str, Any], /) -> int:
        """Check a command and take it; returns the tick at which it takes effect. Raises InputError."""
        ...

    def catalogue(self) -> dict[str, Any]:
        """Channels and truth tables."""
        ...

    def parameters_document(self) -> dict[str, Any]:
        """All parameters with unit, source and kind."""
        ...

    def scene_document(self) -> dict[str, Any]:
        """Name, scene and seed."""
        ...

    def health(self) -> dict[str, Any]:
        """`spin_hz`, `energy` and `warnings`."""
        ...

    def warm_up(self) -> None:
        """Compile and run all kernels once."""
        ...


@dataclass(slots=True)
class _Entry:
    """What the publisher sends in one go: events, a block of everything, events; then replies that waited for it."""

    before: list[dict[str, Any]]
    frame: Frame | None = None
    after: list[dict[str, Any]] = field(default_factory=list)
    replies: list[tuple[Pending, dict[str, Any]]] = field(default_factory=list)


def _inherit(dropped: _Entry, following: _Entry) -> None:
    """Events and replies are few, and are not dropped with their block."""
    following.before = [*dropped.before, *dropped.after, *following.before]
    following.replies = [*dropped.replies, *following.replies]


class Service:
    """Runs one simulation to its end and serves it.

    Args:
        simulation: Advances, checks commands, describes itself.
        server: Transport; stays open when the run ends.
        clock: Pace.
        block_ticks: Length of a published block [ticks], a whole multiple of the simulation's own.
        queue_seconds: Blocks that may wait for the publisher [s of simulated time]; more than the transport's patience
            with one client that stalls in the middle of its recovery.
        status_period_s: Wall time between status messages [s].
        linger_s: At the end of a run, wait at most this long [s] until clients have recovered what they missed.
        limit: How many commands a second are taken.

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
        self._simulation = simulation
        self._server = server
        self._clock = clock
        self._block_ticks = block_ticks
        self._status_period_s = status_period_s
        self._linger_s = linger_s
        self._rate = simulation.tick_rate_hz
        self._queue: BoundedQueue[_Entry] = BoundedQueue(
            max(2, math.ceil(queue_seconds * self._rate / block_ticks)),
            size=lambda entry: int(entry.frame is not None),
            inherit=_inherit,
        )
        self._may_drop = isinstance(clock, RealTime)

        self._scene = simulation.scene_document()
        self._tick = simulation.tick
        self._state = "running"
        self._prepared = False
        self._stop_requested = False
        self._health: dict[str, Any] = {}
        self._next_health_s = 0.0
        self._overflowing = False

        self._desk = Desk(
            server,
            commands=COMMANDS,
            others={
                name: f"{name} is for a recording that is replayed (rig replay); this is a simulator, which runs on"
                for name in REPLAY_COMMANDS
            },
            running="the rig runs",
            wake=clock.wake,
            tell=self._warn,
            limit=limit,
        )
        self._accepted = 0
        self._taken: tuple[dict[str, Any], ...] = ()
        """Commands that the simulation took: whoever comes later cannot run the scene again without them."""
        self._taken_bytes = 0
        self._forgotten = 0
        """Of these, how many are no longer told."""
        self._steps: list[tuple[int, Pending, dict[str, Any]]] = []
        self._step_target: int | None = None

        self._rows = wire.Continuity()
        self._samples_rate_hz = 0.0
        self._samples_published = 0
        self._congestion: dict[str, float] = {}

    # ---- from any thread ----

    def stop(self) -> None:
        """End the run at the next block boundary; from any thread or signal handler."""
        self._stop_requested = True
        self._clock.wake()

    def status(self) -> dict[str, Any]:
        """The status document (see rig/KEYS.md)."""
        health = self._health
        warnings = list(health.get("warnings", []))
        if self._queue.dropped:
            warnings.append(f"{self._queue.dropped} blocks dropped: the publisher did not keep up")
        waiting_s = self._queue.used * self._block_ticks / self._rate
        if self._may_drop and waiting_s > _HELD_UP_S:
            warnings.append(f"{waiting_s:.1f} s of blocks wait: a client holds up the publisher")
        warnings += self._desk.warnings()
        return finite(
            {
                "scene": self._scene.get("name"),
                "tick": self._tick,
                "time_s": self._tick / self._rate,
                "end_s": None if self._simulation.end_tick is None else self._simulation.end_tick / self._rate,
                "wall_s": time.time(),
                "state": self._state,
                "pace": self._clock.pace,
                "block_ms": 1e3 * self._block_ticks / self._rate,
                **self._clock.statistics(),
                "queue": {
                    "depth": self._queue.used,
                    "capacity": self._queue.room,
                    "high_water": self._queue.high_water,
                    "dropped": self._queue.dropped,
                },
                "congestion": self._congestion,
                "clients": self._desk.clients.rows(self._samples_published, self._samples_rate_hz),
                "spin_hz": health.get("spin_hz"),
                "energy": health.get("energy", {}),
                "engine": health.get("engine", {}),
                "warnings": warnings,
                "samples_published": self._samples_published,
                "commands": self._accepted,
            }
        )

    # ---- on the simulation thread ----

    def prepare(self) -> None:
        """Compile everything, answer requests and show the rig's token; `run` does it where it was not done before."""
        if self._prepared:
            return
        self._simulation.warm_up()
        self._health = self._simulation.health()
        catalogue, parameters = self._simulation.catalogue(), self._simulation.parameters_document()
        self._desk.open(
            {
                wire.CATALOGUE: lambda: catalogue,
                wire.PARAMETERS: lambda: parameters,
                wire.SCENE: self._scene_now,
                wire.STATUS: self.status,
            }
        )
        self._prepared = True

    def _scene_now(self) -> dict[str, Any]:
        forgotten = {"forgotten": self._forgotten} if self._forgotten else {}
        return {**self._scene, "taken": self._taken, **forgotten}

    def run(self) -> dict[str, Any]:
        """Run to the end, to a stop, or to a failure, which is raised after the stream has been ended.

        Returns:
            Summary: reason, tick, time_s, wall_s, rows by key, and the last status's figures.
        """
        simulation = self._simulation
        self.prepare()
        start = {"scene": self._scene.get("name"), "seed": self._scene.get("seed"), "pace": self._clock.pace}
        self._queue.push(_Entry([self._event("start", **start)]))
        publisher = threading.Thread(target=self._publish_all, name="publisher", daemon=True)
        publisher.start()
        started = time.monotonic()
        reason = "failed: the service itself failed"
        try:
            with short_collections():
                started = time.monotonic()
                self._clock.start(simulation.tick, self._rate)
                reason = self._advance_all()
        except KeyboardInterrupt:
            reason = "stopped"
            raise
        except StepTimeoutError as error:
            reason = f"failed: {error}"
            raise
        except BaseException as error:
            reason = f"failed: {type(error).__name__}: {one_line(error)}"
            raise
        finally:
            wall_s = time.monotonic() - started
            self._finish(reason)
            publisher.join(timeout=60.0)
            # Where the publisher failed, nobody else answers the steps that it left.
            while (entry := self._queue.take(0.0)) is not None:
                self._answer(entry)
            self._linger()
        status = self.status()
        kept = ("scene", "pace", "tick", "time_s", "real_time_factor", "lateness_ms", "overruns", "queue", "congestion")
        return {
            "reason": reason,
            "wall_s": wall_s,
            **{name: status[name] for name in kept},
            "samples_published": self._samples_published,
            "commands": self._accepted,
            "rows": dict(self._rows.next),
            "troubles": self._desk.troubles,
        }

    def _advance_all(self) -> str:
        """The loop; returns why it ended."""
        simulation, clock, queue = self._simulation, self._clock, self._queue
        end = simulation.end_tick
        while True:
            events = self._take_commands()
            if self._stop_requested or (end is not None and simulation.tick >= end):
                queue.push(_Entry(events))
                return "stopped" if self._stop_requested else "completed"
            want = self._block_ticks
            if end is not None:
                rest = end - simulation.tick
                want = min(want, math.ceil(rest / simulation.block_ticks) * simulation.block_ticks)
            if not self._may_drop and not queue.wait_for_room(0.1):
                self._defer(events)
                continue
            ticks = clock.grant(want)
            if ticks == 0:
                self._defer(events)
                continue
            frame = simulation.advance(ticks)
            answered = []
            while not clock.release(simulation.tick):
                # A command that comes while the block is not yet due takes effect at its end, and is answered now.
                answered += self._take_commands()
            self._tick = simulation.tick
            after = [{**event, "wall_s": time.time()} for event in frame.events]
            self._overflow(queue.push(_Entry(events, frame, [*after, *answered], self._finished_steps())))
            self._refresh_health()

    def _defer(self, events: list[dict[str, Any]]) -> None:
        """Publish events without a block, where the next block is not yet to be run."""
        if events:
            self._queue.push(_Entry(events))

    def _overflow(self, dropped: int) -> None:
        """Say once for each time that the queue overflows; the count is in the status."""
        if dropped and not self._overflowing:
            text = "the publisher does not keep up: the oldest blocks in the queue are dropped"
            self._queue.push(_Entry([self._event("warning", text=text)]))
        self._overflowing = bool(dropped)

    def _take_commands(self) -> list[dict[str, Any]]:
        """Carry out all commands that have arrived; returns their events."""
        events = []
        for pending in self._desk.taken():
            try:
                events.append(self._carry_out(pending))
            except InputError as error:
                pending.refuse(error)
            except Exception as error:
                # A request that the simulation's own checks let through must not end the run.
                pending.refuse(InputError(pending.command, "readable", one_line(error)))
                self._desk.trouble(pending.command, error)
        return events

    def _carry_out(self, pending: Pending) -> dict[str, Any]:
        simulation = self._simulation
        tick, done_tick = simulation.tick, None
        if pending.command == "stop":
            self._stop_requested = True
        elif isinstance(pending.asked, Step):
            done_tick = self._check_step(pending.asked)
        elif not isinstance(pending.asked, Note):
            tick = simulation.submit(pending.command, dict(pending.request))
            self._keep({"id": self._accepted + 1, "tick": tick, "command": pending.command, "request": pending.request})
        self._accepted += 1
        reply = {"accepted": True, "id": self._accepted, "command": pending.command}
        if done_tick is None:
            pending.answer({**reply, "tick": tick, "time_s": tick / self._rate})
        else:
            reply |= {"tick": done_tick, "time_s": done_tick / self._rate}
            self._steps.append((done_tick, pending, reply))
        if isinstance(pending.asked, Note):
            # An event of its own: it does nothing to the rig, so whoever repeats the commands can pass over it.
            return {**self._event("note", id=self._accepted), **pending.asked.model_dump(), "from": pending.sender}
        detail = {"id": self._accepted, "command": pending.command, "request": pending.request, "from": pending.sender}
        return self._event("command", tick=tick, **detail)

    def _keep(self, taken: dict[str, Any]) -> None:
        """Remember a command for latecomers, within bounds."""
        rows = (*self._taken, taken)
        self._taken_bytes += _size(taken)
        while self._taken_bytes > _TAKEN_BYTES:
            self._taken_bytes -= _size(rows[0])
            rows = rows[1:]
            self._forgotten += 1
        self._taken = rows  # a new one, as other threads read it

    def _check_step(self, asked: Step) -> int:
        """Grant a step; returns the tick at which it is done."""
        if not isinstance(self._clock, Lockstep):
            raise InputError("step", "sent to a rig that runs with --pace lockstep", f"--pace {self._clock.pace}")
        ticks, unit = asked.ticks, self._simulation.block_ticks
        most = _STEP_S * self._rate
        if asked.blocks is not None:
            raise InputError("step.blocks", "left out, but for a replay", asked.blocks)
        if ticks is None or ticks > most or ticks % unit:
            raise InputError("ticks", f"a positive whole multiple of {unit}, at most {most}", ticks)
        start = self._step_target if self._step_target is not None else self._simulation.tick
        end = self._simulation.end_tick
        if end is not None and start + ticks > end:
            raise InputError("ticks", f"at most {end - start}, the rest of the scene", ticks)
        self._step_target = start + ticks
        self._clock.allow(ticks)
        return self._step_target

    def _finished_steps(self) -> list[tuple[Pending, dict[str, Any]]]:
        """Steps that the last block completed; they are answered once that block is published."""
        if not self._steps:
            return []
        done = [(reply, document) for tick, reply, document in self._steps if tick <= self._tick]
        self._steps = [row for row in self._steps if row[0] > self._tick]
        if not self._steps:
            self._step_target = None
        return done

    def _refresh_health(self) -> None:
        """Ask the simulation how it is, a few times a second; each new kind of warning becomes an event."""
        now = time.monotonic()
        if now < self._next_health_s:
            return
        self._next_health_s = now + self._status_period_s
        self._health = self._simulation.health()
        for text in self._health.get("warnings", []):
            self._desk.warn(text)

    def _warn(self, text: str) -> None:
        """Put a warning into the stream; on any thread."""
        self._queue.push(_Entry([self._event("warning", text=text)]))

    def _event(self, name: str, *, tick: int | None = None, **fields: Any) -> dict[str, Any]:
        tick = self._simulation.tick if tick is None else tick
        return {"event": name, "tick": tick, "time_s": tick / self._rate, "wall_s": time.time(), **fields}

    def _finish(self, reason: str) -> None:
        """Refuse what is still waiting, and put the end of the stream into the queue."""
        self._state = "ended"
        self._desk.close(f"a run that ended: {reason}", [pending for _, pending, _ in self._steps])
        self._queue.push(_Entry([self._event("end", reason=reason)]))
        self._queue.close()

    def _linger(self) -> None:
        """Keep the cache until everybody who is connected has everything."""

        def see(counts: dict[str, float]) -> None:
            self._congestion = counts

        self._desk.clients.settle(self._server, self._samples_published, patience_s=self._linger_s, see=see)

    # ---- on the publisher thread ----

    def _publish_all(self) -> None:
        next_status_s = time.monotonic()
        while not self._queue.ended:
            entry = self._queue.take(max(0.0, next_status_s - time.monotonic()))
            if entry is not None:
                self._publish_entry(entry)
            now = time.monotonic()
            if now >= next_status_s:
                self._guarded("publishing the status", self._publish_status)
                # Not one period after the last: a status that was held up is not followed by a burst.
                next_status_s = now + self._status_period_s
        self._guarded("publishing the status", self._publish_status)

    def _guarded(self, what: str, work: Callable[..., None], *arguments: Any) -> None:
        """Do one thing of this thread, which fails alone: pacing and all other streams go on."""
        try:
            work(*arguments)
        except Exception as error:
            self._desk.trouble(what, error)

    def _publish_entry(self, entry: _Entry) -> None:
        for event in entry.before:
            self._guarded("publishing events", self._publish_event, event)
        if entry.frame is not None:
            for key, block in blocks_of(entry.frame):
                self._guarded(f"publishing {key}", self._publish_block, key, block)
            self._count_samples(entry.frame)
        for event in entry.after:
            self._guarded("publishing events", self._publish_event, event)
        self._answer(entry)

    def _publish_block(self, key: str, block: wire.Block) -> None:
        self._rows.follow(
            key, block.index, len(block.values)
        )  # whoever does not get it learns from the end what is missing
        self._server.publish(key, wire.encode_block(block))

    def _publish_event(self, event: dict[str, Any]) -> None:
        self._server.publish(wire.EVENTS, wire.encode_document(finite(self._rows.tell(event))))

    def _publish_status(self) -> None:
        self._congestion = self._server.congestion()
        self._server.publish(wire.STATUS, wire.encode_document(self.status()))

    def _count_samples(self, frame: Frame) -> None:
        """What clients are measured against: the probes, or the first group of a scene without them."""
        group = "probes" if "probes" in frame.samples else next(iter(frame.samples), None)
        if group is not None:
            self._samples_rate_hz = frame.samples[group].rate_hz
            self._samples_published = self._rows.next[wire.sensor_key(group)]

    @staticmethod
    def _answer(entry: _Entry) -> None:
        for pending, document in entry.replies:
            pending.answer(document)


def blocks_of(frame: Frame) -> Iterator[tuple[str, wire.Block]]:
    """Keys and blocks of a frame, in the order in which they are published."""
    for group, block in frame.samples.items():
        yield wire.sensor_key(group), block
    if frame.edges is not None:
        yield wire.EDGES, frame.edges
    for table, block in frame.truth.items():
        yield wire.truth_key(table), block


def _size(taken: dict[str, Any]) -> int:
    return len(wire.encode_document(taken))
