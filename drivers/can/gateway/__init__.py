"""The rig as a node of a CAN bus: samples, events and status go out, commands come in.

A gateway is a client of the rig like any other; it may run in the rig's process or in another one. Threads: the rig's
publisher leaves blocks in a bounded queue; the sender packs them and hands frames to the bus once a millisecond, each
when its last sample is due; the receiver checks commands; a worker asks the rig and acknowledges. None of them can hold
up the simulation: what does not fit is dropped, oldest first, and counted.
"""

from __future__ import annotations

import contextlib
import math
import re
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import pydantic

from drivers.can.bus import codec
from drivers.can.bus.frame import STANDARD_MASK, octets
from drivers.can.schedule import SLOT_S, Schedule
from drivers.can.signals import (
    ABSENT,
    FIELDS,
    Command,
    EventKind,
    Field,
    Kind,
    Message,
    Result,
    State,
    default_messages,
    parse_command,
)
from drivers.health import Guard, Rising
from rig import wire
from rig.channels import ChannelTable
from rig.errors import InputError
from rig.outside import DOCUMENT_BYTES, Outside, check, input_error
from rig.transport import Client, NoReplyError

if TYPE_CHECKING:
    import can

_RECORD = codec.RECORDS[codec.FD_WIDTH]
_SYNC_S = 0.1
_STATUS_S = 0.5
_HEARTBEAT_S = 1.0
_IDLE_S = 0.02
_SETTLE_S = 1e-3
"""Added to the length of a block, so that a block that comes a little late still goes out on time [s]."""
_PENDING = 16
"""Commands that may wait for the rig, and answers that may wait for the bus."""
_PORTION = 64
"""Frames that the bus gets in one go."""
_WAIT_S = 0.25
"""Samples that may wait for room on the bus, after the machine had been held up [s]."""
_FAREWELL_S = 0.5
"""How long a bus without room is waited for at the end [s]."""
_REFUSALS_A_SECOND = 50.0
_REFUSALS_AT_ONCE = 20.0
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_WORD_32 = 0xFFFFFFFF


@dataclass(slots=True)
class _Rows:
    """Picked samples of one sensor group that a message has not sent yet.

    Attributes:
        first: Running number of the first row, in steps of the message.
        counts: Rows, shape (rows, channels of the group that the message has).
    """

    first: int
    counts: np.ndarray

    @property
    def end(self) -> int:
        return self.first + len(self.counts)


class _Stream:
    """The samples of one message; only whole frames are made, so the last instants of a run may never be sent.

    Args:
        message: With samples.
        step: Samples of the recording from one to the next.
        columns: Columns of each sensor group's blocks, for the groups that the rig has.
    """

    def __init__(self, message: Message, step: int, columns: dict[str, list[int]]) -> None:
        assert message.samples is not None
        self.message = message
        self.step = step
        self.columns = columns
        self._samples = message.samples
        self._rows: dict[str, _Rows] = {}
        self._places = {
            group: [place for place, channel in enumerate(message.samples.channels) if channel.group == group]
            for group in columns
        }
        self._whole = len(columns) == 1 and len(self._places[next(iter(columns))]) == len(message.samples.channels)
        self._absent = len(message.samples.channels) - sum(map(len, self._places.values()))
        self._next: int | None = None
        self.skipped = 0
        """Frames that never were, because samples were missing."""

    def take(self, group: str, block: wire.Block) -> tuple[np.ndarray, np.ndarray] | None:
        """Add a block; returns what is complete with it: running numbers, shape (frames,), and data of frames."""
        step, rows = self.step, self._samples.rows
        first = -(-block.index // step)
        counts = block.values[first * step - block.index :: step]
        counts = counts if len(self.columns[group]) == counts.shape[1] else counts[:, self.columns[group]]
        kept = self._rows.get(group)
        if kept is not None and kept.end == first:
            if len(kept.counts):
                counts = np.concatenate((kept.counts, counts))
            first = kept.first
        self._rows[group] = _Rows(first, counts)
        if len(self._rows) < len(self.columns):
            return None
        low = -(-max(row.first for row in self._rows.values()) // rows)
        high = min(row.end for row in self._rows.values()) // rows
        if high <= low:
            return None
        start, size = low * rows, (high - low) * rows
        if self._whole:
            kept = self._rows[group]
            values = kept.counts[start - kept.first :][:size]
        else:
            values = np.zeros((size, len(self._samples.channels)), np.int32)
            for name, kept in self._rows.items():
                values[:, self._places[name]] = kept.counts[start - kept.first :][:size]
        for kept in self._rows.values():
            cut = start + size - kept.first
            kept.first, kept.counts = kept.first + cut, kept.counts[cut:]
        if self._next is not None and low > self._next:
            self.skipped += low - self._next
        self._next = high
        numbers = np.arange(low, high) * rows
        data = self._samples.pack(numbers * step if self.message.fd else numbers, values, self.message.length)
        if self._absent:
            data = self._mark_absent(data)
        return numbers, data

    def _mark_absent(self, data: np.ndarray) -> np.ndarray:
        """Classic frames say of each channel that the rig does not have that it is not there."""
        missing = ABSENT.to_bytes(2, "little", signed=True)
        for place, channel in enumerate(self._samples.channels):
            if channel.group not in self.columns:
                start = self._samples.index_width + 2 * place
                data[:, start : start + 2] = np.frombuffer(missing, np.uint8)
        return data


@dataclass(slots=True)
class _Asked:
    """A command that waits for the rig."""

    identifier: int
    command: Command
    deadline_s: float
    answered: bool = False


class _Catalogue(Outside, extra="ignore"):
    """The rig's channels, as they come."""

    tick_rate_hz: Annotated[int, pydantic.Field(ge=1, le=10**12)]
    table: dict[str, Any]


class _Reply(Outside, extra="ignore"):
    """The rig's answer to a command: when it takes effect, or the field that is wrong and what it must be."""

    accepted: bool
    time_s: Annotated[float, pydantic.Field(ge=0.0, le=1e9)] = 0.0
    field: str = ""
    must: str = ""


@dataclass(slots=True)
class Counts:
    """What a gateway has done.

    Attributes:
        frames: Frames handed to the bus.
        dropped: Frames that the bus did not take, or that were never made because samples were missing.
        blocks_dropped: Blocks that the sender had no time for.
        accepted: Commands that the rig took.
        refused: Commands refused, by reason.
        errors: Calls of the bus that failed while receiving.
    """

    frames: int = 0
    dropped: int = 0
    blocks_dropped: int = 0
    accepted: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    errors: int = 0


class Gateway:
    """Sends what a rig publishes as CAN messages, and gives it the commands that come from the bus.

    Args:
        client: Transport to the rig, which must be ready to answer; stays the caller's to close.
        bus: Any bus of python-can; stays the caller's to shut down. Where it has `send_records` (a node of the virtual
            CAN), frames go there many at a time.
        schedule: Which samples, how often.
        paced: Send each frame when its last sample is due; False: at once, and let a full queue hold up the publisher
            (for runs that are not paced by the wall clock).
        load: Load of the bus, for the status.
        queue_seconds: Blocks that may wait for the sender [s of simulated time].
        command_timeout_s: How long the rig may take for a command [s].
        now: Clock [s].

    Raises:
        InputError: The rig's samples cannot be sent at that rate, or have another calibration than the table.
        NoReplyError: No rig answers.
    """

    def __init__(
        self,
        client: Client,
        bus: can.BusABC,
        schedule: Schedule,
        *,
        paced: bool = True,
        load: float = 0.0,
        queue_seconds: float = 1.0,
        command_timeout_s: float = 1.0,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._client = client
        self._bus = bus
        self._paced = paced
        self._load = load
        self._timeout_s = command_timeout_s
        self._now = now
        answer = client.request(wire.CATALOGUE, timeout_s=5.0)
        catalogue = check(_Catalogue, answer, field="catalogue", most_bytes=DOCUMENT_BYTES)
        try:
            table = ChannelTable.model_validate(catalogue.table)
        except pydantic.ValidationError as error:
            raise input_error(error, "catalogue.table") from None
        self._tick_rate_hz = catalogue.tick_rate_hz
        self._messages = default_messages()
        self._by_name = self._messages.by_name
        self._rate_hz, self._steps = _steps(table, schedule)
        self._streams = _streams(table, self._steps)
        self._commands = {self._by_name[name].identifier for name in ("Stop", "Command")}
        self._groups = tuple(table.groups)
        self._queue: deque[tuple[str, bytes]] = deque()
        self._queue_seconds = queue_seconds
        self._capacity = 8 * len(self._groups)
        self._changed = threading.Condition()
        self._sending = threading.Lock()
        self._stopping = False

        self._slots: dict[int, list[np.ndarray]] = {}
        self._origin_s: float | None = None
        self._latency_s = 0.0
        self._last_slot: dict[int, int] = {}
        self._time_us = 0
        self._state = State.PREPARING
        self._ended = False
        self._status: dict[str, Any] = {}
        self._beat = 0
        self._event_number = 0
        self._next_status_s = self._next_heartbeat_s = now()

        self.counts = Counts()
        self._counter = 0
        self._asked: deque[_Asked] = deque()
        self._work = threading.Condition()
        self._refusal_credit = _REFUSALS_AT_ONCE
        self._refusal_s = now()
        self._guard = Guard("the CAN gateway")
        self._dropping = Rising("CAN: {} frames were dropped: the bus does not take them in time")
        self._falling_behind = Rising("CAN: {} blocks were dropped: the gateway does not keep up")
        self._send_records = getattr(bus, "send_records", None)
        self._urgent: deque[np.ndarray] = deque()
        self._waiting: deque[np.ndarray] = deque()
        self._waiting_frames = 0
        self._room = math.ceil(_WAIT_S * sum(1.0 / period_s for period_s in schedule.messages().values()))
        self._end_s = math.inf
        self._threads = [
            threading.Thread(target=target, name=f"can gateway {name}", daemon=True)
            for name, target in (("sends", self._send_all), ("receives", self._receive), ("asks", self._ask_all))
        ]

    # Life.

    def start(self) -> None:
        """Begin: from now on the gateway is a node of the bus."""
        self._bus.set_filters(
            [{"can_id": each, "can_mask": STANDARD_MASK, "extended": False} for each in self._commands]
        )
        for group in self._groups:
            self._client.subscribe(wire.sensor_key(group), self._take)
        for key in (wire.EDGES, wire.EVENTS, wire.STATUS):
            self._client.subscribe(key, self._take)
        for thread in self._threads:
            thread.start()

    def close(self, *, timeout_s: float = 2.0) -> None:
        """Send what is still due, then end.

        Args:
            timeout_s: How long that may take [s].
        """
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        with self._work:
            self._work.notify_all()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=timeout_s)

    def __enter__(self) -> Gateway:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def figures(self) -> dict[str, float]:
        """Counts for the rig's status."""
        counts = self.counts
        return {
            "can_load": round(self._load, 4),
            "can_frames": counts.frames,
            "can_dropped": self._dropped(),
            "can_blocks_dropped": counts.blocks_dropped,
            "can_accepted": counts.accepted,
            "can_refused": counts.refused.total(),
            **{f"can_refused_{reason}": count for reason, count in list(counts.refused.items())},
        }

    def warnings(self) -> list[str]:
        """What a person should know of, while it is so."""
        return [
            *self._guard.warnings(),
            *self._dropping.warnings(self._dropped()),
            *self._falling_behind.warnings(self.counts.blocks_dropped),
        ]

    def _dropped(self) -> int:
        return self.counts.dropped + sum(stream.skipped for stream in self._streams)

    # On the publisher's thread.

    def _take(self, key: str, payload: bytes) -> None:
        with self._changed:
            if not self._paced:
                while len(self._queue) >= self._capacity and not self._stopping:
                    self._changed.wait(0.1)
            while len(self._queue) >= self._capacity and key not in (wire.EVENTS, wire.STATUS):
                self._queue.popleft()
                self.counts.blocks_dropped += 1
            self._queue.append((key, payload))
            if not self._paced:
                self._changed.notify_all()

    # On the sender's thread.

    def _send_all(self) -> None:
        while not (done := self._guard(self._send_some)):
            if done is None:
                if self._stopping:
                    return
                time.sleep(_IDLE_S)

    def _send_some(self) -> bool:
        """What is due now, and the wait for more; whether that was all."""
        with self._changed:
            entries = list(self._queue)
            self._queue.clear()
            if not self._paced:
                self._changed.notify_all()
        for key, payload in entries:
            self._guard(self._unpack, key, payload)
        now = self._now()
        self._send_due(now)
        self._send_waiting()
        if self._ended and self._state != State.ENDED and not self._slots and not self._waiting:
            # Only now: who hears it must not expect samples any more.
            self._state = State.ENDED
            self._next_status_s = self._next_heartbeat_s = now
        self._send_periodic(now)
        self._time_out(now)
        with self._changed:
            if self._queue and not self._paced:
                return False
            if self._stopping and not self._queue and not self._slots:
                self._end_s = min(self._end_s, now + _FAREWELL_S)
                if now >= self._end_s or not (self._waiting or self._urgent):
                    self.counts.dropped += self._waiting_frames + len(self._urgent)
                    return True
            if self._paced:
                # On a grid of slots: a block that comes in between waits for the next one.
                busy = self._slots or self._queue or self._waiting or self._urgent
                rest = SLOT_S - self._now() % SLOT_S if busy else _IDLE_S
            else:
                rest = _IDLE_S
            self._changed.wait(rest)
        return False

    def _unpack(self, key: str, payload: bytes) -> None:
        if key == wire.EVENTS:
            self._on_event(wire.decode_document(payload))
        elif key == wire.STATUS:
            self._status = wire.decode_document(payload)
        elif key == wire.EDGES:
            self._on_edges(wire.decode_block(payload, wire.TRUTH_SCHEMA))
        else:
            self._on_samples(key.rpartition("/")[2], wire.decode_block(payload, wire.SAMPLE_SCHEMA))

    def _on_samples(self, group: str, block: wire.Block) -> None:
        if not len(block.values):
            return
        self._follow_time(block)
        if self._state == State.PREPARING:
            self._state = State.RUNNING
        for stream in self._streams:
            if group in stream.columns and (complete := stream.take(group, block)) is not None:
                numbers, data = complete
                # A frame is due with its last instant.
                last = (numbers + stream.message.samples.rows - 1) * stream.step  # type: ignore[union-attr]
                self._put(stream.message, data, last / self._rate_hz)
        if group == self._groups[0]:
            self._sync(block)

    def _follow_time(self, block: wire.Block) -> None:
        """What wall time a simulated time is due at: the earliest that a block ever came, and a block's length more."""
        length_s = len(block.values) / block.rate_hz
        end_s = block.tick / block.tick_rate_hz + length_s
        self._time_us = max(self._time_us, round(1e6 * end_s))
        came = self._now() - end_s
        if self._origin_s is None or came < self._origin_s:
            self._origin_s = came
        # The last block of a run may be shorter than the others; its frames wait no less.
        self._latency_s = max(self._latency_s, length_s + _SETTLE_S)
        capacity = max(8 * len(self._groups), math.ceil(self._queue_seconds / length_s) * (len(self._groups) + 1))
        self._capacity = capacity if self._paced else self._capacity

    def _sync(self, block: wire.Block) -> None:
        every = round(_SYNC_S * self._rate_hz)
        number = -(-block.index // every)
        message = self._by_name["Sync"]
        while number * every < block.index + len(block.values):
            index = number * every
            time_us = round(1e6 * index / self._rate_hz)
            data = message.encode(index=index & _WORD_32, time=time_us & _WORD_32)
            self._put(message, np.frombuffer(data, np.uint8)[None], np.array([index / self._rate_hz]))
            number += 1

    def _on_edges(self, block: wire.Block) -> None:
        message = self._by_name["Keyphasor"]
        for number, ticks in enumerate(block.values[:, 0].tolist(), start=block.index):
            time_us = (block.tick + ticks) / self._tick_rate_hz * 1e6
            fraction = min(round((time_us % 1.0) * 65536), 65535)
            data = message.encode(number=number & 0xFFFF, time=int(time_us) & _WORD_32, fraction=fraction)
            self._put(message, np.frombuffer(data, np.uint8)[None], np.array([time_us * 1e-6]))

    def _on_event(self, event: dict[str, Any]) -> None:
        name = str(event.get("event", ""))
        kind = EventKind[name.upper()] if name.upper() in EventKind.__members__ else EventKind.OTHER
        self._ended |= kind is EventKind.END
        time_us = round(1e6 * float(event.get("time_s", 0.0)))
        value = event.get("force_n" if kind is EventKind.HAMMER else "speed_hz", 0.0)
        value = value if isinstance(value, (int, float)) and math.isfinite(value) else 0.0
        message = self._by_name["Event"]
        data = message.encode(
            event=kind,
            number=self._event_number & 0xFF,
            time=time_us & _WORD_32,
            value=min(max(round(10 * value), 0), 0xFFFF),
        )
        self._event_number += 1
        # With the samples of its time; its identifier loses against theirs, so that the end comes last.
        self._put(message, np.frombuffer(data, np.uint8)[None], np.array([time_us * 1e-6]))

    def _put(self, message: Message, data: np.ndarray, times_s: np.ndarray) -> None:
        """Keep frames until their slot; times are simulated ones [s], ascending."""
        records = _records(message, data)
        if not self._paced or self._origin_s is None:
            self._slots.setdefault(0, []).append(records)
            return
        due = np.ceil((times_s + (self._origin_s + self._latency_s)) / SLOT_S).astype(np.int64)
        # Where the origin has moved, frames must not overtake those of the same message before them.
        np.maximum(due, self._last_slot.get(message.identifier, 0), out=due)
        self._last_slot[message.identifier] = int(due[-1])
        edges = [0, *(np.flatnonzero(np.diff(due)) + 1).tolist(), len(due)]
        for low, high in pairwise(edges):
            self._slots.setdefault(int(due[low]), []).append(records[low:high])

    def _send_due(self, now: float) -> None:
        slot = math.floor(now / SLOT_S) if self._paced else 0
        for number in sorted(number for number in self._slots if number <= slot or not number):
            parts = self._slots.pop(number)
            self._hand_over(parts[0] if len(parts) == 1 else np.concatenate(parts))

    def _send_periodic(self, now: float) -> None:
        if now >= self._next_status_s:
            self._next_status_s = max(self._next_status_s + _STATUS_S, now)
            self._send_status()
        if now >= self._next_heartbeat_s:
            self._next_heartbeat_s = max(self._next_heartbeat_s + _HEARTBEAT_S, now)
            self._send_message("Heartbeat", **self._heartbeat())
            self._send_message(
                "Rates",
                rate=min(self._rate_hz, 0xFFFFFF),
                fd_step=self._steps.get(True, 0),
                classic_step=self._steps.get(False, 0),
                latency=min(round(self._latency_s / 1e-5), 0xFFFF),
            )

    def _heartbeat(self) -> dict[str, int]:
        self._beat = self._beat + 1 & 0xFF
        return {"state": self._state, "beat": self._beat, "counter": self._counter, "time": self._time_us & _WORD_32}

    def _send_status(self) -> None:
        status = self._status
        spin = status.get("spin_hz")
        late = status.get("lateness_ms", {}).get("p99") or 0.0
        self._send_message(
            "Status",
            state=self._state,
            warnings=min(len(status.get("warnings", ())), 15),
            spin=min(max(round(1e3 * spin), 0), 0xFFFF) if isinstance(spin, (int, float)) else 0,
            lateness=min(round(100 * late), 0xFFFF),
            dropped=self._dropped() & 0xFFF,
            refused=self.counts.refused.total() & 0xFFF,
        )

    def _send_message(self, name: str, **raw: int) -> None:
        message = self._by_name[name]
        if len(self._urgent) < _PENDING:
            self._urgent.append(_records(message, np.frombuffer(message.encode(**raw), np.uint8)[None]))
        else:
            self.counts.dropped += 1
        self._send_waiting()

    def _hand_over(self, records: np.ndarray) -> None:
        """Give frames to the bus in their order; those without room there wait for a while."""
        with self._sending:
            self._waiting.append(records)
            self._waiting_frames += len(records)
        self._send_waiting()

    def _send_waiting(self) -> None:
        with self._sending:
            # First what answers somebody: it does not wait behind samples.
            while self._urgent and self._give(self._urgent[0]):
                self._urgent.popleft()
            while self._waiting and not self._urgent:
                portion = self._waiting[0][:_PORTION]
                given = self._give(portion)
                self._waiting_frames -= given
                if given < len(self._waiting[0]):
                    self._waiting[0] = self._waiting[0][given:]
                else:
                    self._waiting.popleft()
                if given < len(portion):
                    break
            while self._waiting_frames > self._room:
                oldest = self._waiting.popleft()
                self._waiting_frames -= len(oldest)
                self.counts.dropped += len(oldest)

    def _give(self, records: np.ndarray) -> int:
        """How many of some frames the bus has taken, from the first on."""
        import can

        # Nothing waits here where the rig runs by the clock; else the bus has a second.
        timeout = 0.0 if self._paced else 1.0
        given = 0
        try:
            if self._send_records is not None:
                self._send_records(records, timeout)
                given = len(records)
            else:
                for message in codec.messages_of(records):
                    self._bus.send(message, timeout)
                    given += 1
        except (can.CanError, OSError):
            if not self._paced:
                # Waiting has not helped.
                self.counts.frames += given
                self.counts.dropped += len(records) - given
                return len(records)
        self.counts.frames += given
        return given

    # Commands.

    def _receive(self) -> None:
        import can

        while not self._stopping:
            try:
                message = self._bus.recv(0.2)
            except Exception as error:
                # Bus off, or no hub: it may come back, and the rig runs on meanwhile.
                self.counts.errors += 1
                if not isinstance(error, (can.CanError, OSError, ValueError)):
                    self._guard.tell("hearing the bus", error)
                time.sleep(0.1)
                continue
            if message is not None:
                self._guard(self._take_message, message)

    def _take_message(self, message: can.Message) -> None:
        if message.is_error_frame or message.is_remote_frame or message.is_extended_id or message.is_fd:
            return
        if message.is_rx and message.arbitration_id in self._commands:
            self._on_command(message.arbitration_id, bytes(message.data))

    def _on_command(self, identifier: int, data: bytes) -> None:
        command = parse_command(identifier, data, self._counter)
        if isinstance(command, Result):
            self._refuse(command, data[1] if len(data) > 1 else 0)
            return
        asked = _Asked(identifier, command, self._now() + self._timeout_s)
        with self._work:
            if len(self._asked) >= _PENDING:
                self._refuse(Result.BUSY, command.counter)
                return
            # Used up, whatever the rig says: the same frame once more must not be taken.
            self._counter = command.counter
            self._asked.append(asked)
            if command.kind is not Kind.STOP:
                self._work.notify_all()
        if command.kind is Kind.STOP:
            # A stop does not wait behind others.
            stop = partial(self._guard, self._ask, asked)
            threading.Thread(target=stop, name="can gateway stops", daemon=True).start()

    def _ask_all(self) -> None:
        while True:
            with self._work:
                waiting = [row for row in self._asked if not row.answered and row.command.kind is not Kind.STOP]
                if not waiting:
                    if self._stopping:
                        return
                    self._work.wait(0.2)
                    continue
            self._guard(self._ask, waiting[0])

    def _ask(self, asked: _Asked) -> None:
        command = asked.command
        request = wire.encode_document({"from": "CAN", **command.values})
        try:
            key = wire.command_key(command.kind.name.lower())
            reply = check(_Reply, self._client.request(key, request, timeout_s=self._timeout_s), field="reply")
        except Exception as error:
            reply = None
            if not isinstance(error, (NoReplyError, ValueError)):
                self._guard.tell("asking the rig", error)
        if not self._settle(asked):
            return
        if reply is None:
            self._refuse(Result.TIMED_OUT, command.counter)
        elif reply.accepted:
            self.counts.accepted += 1
            self._acknowledge(Result.ACCEPTED, command.counter, time_us=round(1e6 * reply.time_s))
        else:
            self._refuse_for(reply, command)

    def _settle(self, asked: _Asked) -> bool:
        """Take a command off the list; False where it had been answered before."""
        with self._work:
            if asked.answered:
                return False
            asked.answered = True
            with contextlib.suppress(ValueError):
                self._asked.remove(asked)
            return True

    def _time_out(self, now: float) -> None:
        if not self._asked:
            return
        with self._work:
            late = [row for row in self._asked if now > row.deadline_s]
        for row in late:
            if self._settle(row):
                self._refuse(Result.TIMED_OUT, row.command.counter)

    def _refuse_for(self, reply: _Reply, command: Command) -> None:
        """Tell the bus what the rig's own check says: which field, and which limit it passed."""
        name = reply.field.rpartition(".")[2]
        if name not in FIELDS or name not in command.values:
            self._refuse(Result.REFUSED, command.counter)
            return
        value = command.values[name]
        limit = min(map(float, _NUMBER.findall(reply.must)), key=lambda each: abs(each - value), default=0.0)
        self._refuse(Result.OUT_OF_RANGE, command.counter, place=FIELDS[name], limit=limit)

    def _refuse(self, result: Result, counter: int, *, place: Field = Field.NONE, limit: float = 0.0) -> None:
        self.counts.refused[result.name.lower()] += 1
        now = self._now()
        credit = self._refusal_credit + (now - self._refusal_s) * _REFUSALS_A_SECOND
        self._refusal_credit, self._refusal_s = min(credit, _REFUSALS_AT_ONCE), now
        if self._refusal_credit >= 1.0:
            # A flood of nonsense must not become a flood of answers.
            self._refusal_credit -= 1.0
            self._acknowledge(result, counter, place=place, limit=limit)

    def _acknowledge(
        self,
        result: Result,
        counter: int,
        *,
        time_us: int | None = None,
        place: Field = Field.NONE,
        limit: float = 0.0,
    ) -> None:
        self._send_message(
            "Acknowledge",
            counter=counter,
            result=result,
            field=place,
            time=(self._time_us if time_us is None else time_us) & _WORD_32,
            limit=round(min(max(10 * limit, 0), 0xFFFF)),
        )


def _steps(table: ChannelTable, schedule: Schedule) -> tuple[int, dict[bool, int]]:
    """Rate of the rig's samples, and how many go from one to the next, for FD (True) and classic frames."""
    rates = {group.rate_hz for group in table.groups.values()}
    if len(rates) != 1:
        raise InputError("sample rates", "the same for all sensor groups to go on a CAN bus", sorted(rates))
    rate = rates.pop()
    known = {channel.name: channel for group in default_messages().fd for channel in group.samples.channels}  # type: ignore[union-attr]
    for name, channel in table.channels.items():
        if name not in known or (known[name].scale, known[name].offset) != (channel.scale, channel.offset):
            raise InputError(f"channel {name}", "calibrated as in the channel table, which the DBC is made from", name)
    steps = {}
    for fd, wanted in ((True, schedule.fd_hz), (False, schedule.classic_hz)):
        if wanted is not None:
            if rate % wanted:
                raise InputError("--can-rate", f"a divisor of the samples' rate, {rate} Hz", wanted)
            steps[fd] = rate // wanted
    return rate, steps


def _streams(table: ChannelTable, steps: dict[bool, int]) -> list[_Stream]:
    found = []
    for message in (*default_messages().fd, *default_messages().classic):
        samples = message.samples
        if samples is None or message.fd not in steps:
            continue
        columns = {
            group: [table.groups[group].names.index(row.name) for row in samples.channels if row.group == group]
            for group in samples.groups
            if group in table.groups
        }
        if columns:
            found.append(_Stream(message, steps[message.fd], columns))
    return found


def _records(message: Message, data: np.ndarray) -> np.ndarray:
    """Frames as an array of the widest layout of `drivers.can.bus.codec`, shape (frames,)."""
    records = np.zeros(len(data), _RECORD)
    records["identifier"] = message.identifier
    records["length"] = message.length
    records["flags"] = codec.FD | codec.BRS if message.fd else 0
    octets(records)[:, : message.length] = data
    return records
