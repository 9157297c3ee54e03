"""The rig as a node of a CAN bus: sends samples, events and status, receives commands.

A gateway is a client of the rig, in the rig's process or in another one. Threads: the rig's publisher puts blocks into
a bounded queue. The sender packs them and passes each frame to the bus when its last sample is due, or all frames of a
block at once to a bus that holds them until then. The receiver checks commands, and a worker sends them to the rig and
acknowledges them. None of these can delay the simulation: what does not fit is dropped, oldest first, and counted.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Self

import pydantic

from drivers.can.bus.frame import STANDARD_MASK
from drivers.can.devices import DeviceState, device_node
from drivers.can.gateway.commands import IDENTIFIERS, Commands
from drivers.can.gateway.outbox import Outbox
from drivers.can.gateway.samples import find_decimations, make_sample_frames
from drivers.can.schedule import SLOT_S, Schedule
from drivers.can.signals import EVENT_VALUES, EventKind, RigState
from rig.base import wire
from rig.base.checks import DOCUMENT_BYTES, StrictModel, check, input_error
from rig.base.files import Closing
from rig.channels.table import ChannelTable
from rig.serve.health import Guard, IncreaseWarning
from rig.serve.stream_check import parse_block_end
from rig.serve.transport import Client
from rig.serve.waiting import BoundedQueue

if TYPE_CHECKING:
    import can

_SYNC_S = 0.1
_STATUS_S = 0.5
_HEARTBEAT_S = 1.0
_IDLE_S = 0.02
_MAX_BACKLOG_S = 0.25
"""Largest number of samples that wait for room on the bus after the computer was held up, as a time [s]."""
_FLUSH_TIMEOUT_S = 0.5
"""Longest wait at the end for a bus without room [s]."""
_MAX_LATENCY_S = 1.0
"""Longest further wait at the end for frames that are not due [s]: the rig waits 2 s for the gateway."""
_WORD_32 = 0xFFFFFFFF
_DOCUMENT_KEYS = (wire.EVENTS, wire.STATUS, wire.FAULTS, wire.BLOCK)
"""Keys of documents, which are few and never dropped."""


class _Catalogue(StrictModel, extra="ignore"):
    """The rig's channel table, as received."""

    tick_rate_hz: Annotated[int, pydantic.Field(ge=1, le=10**12)]
    table: dict[str, Any]


class _RowRange(StrictModel, extra="ignore"):
    key: str
    row: int
    rows: int


class _FaultReport(StrictModel, extra="ignore"):
    """The rig's report on faults: rows whose blocks were affected."""

    blocks: list[_RowRange] = pydantic.Field(default=[])


class Gateway(Closing):
    """Sends what a rig publishes as CAN messages, and passes commands from the bus to the rig.

    Args:
        client: Transport to the rig, which must be ready to reply; the caller closes it.
        bus: Any bus of python-can; the caller shuts it down.
        schedule: Sample layouts and their rates.
        paced: Send each frame when its last sample is due. False sends at once, and lets a full queue hold up the
            publisher (for runs that are not paced by the wall clock).
        load: Load of the bus, for the status.
        queue_seconds: Size of the queue of blocks for the sender [s of simulated time].
        command_timeout_s: Longest time for the rig to reply to a command [s].
        now: Clock [s].

    Raises:
        InputError: The rig's samples cannot be sent at that rate, or have another calibration than the table.
        NoReplyError: No rig replies.
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
        self._now = now
        answer = client.request(wire.CATALOGUE, timeout_s=5.0)
        catalogue = check(_Catalogue, answer, field="catalogue", most_bytes=DOCUMENT_BYTES)
        try:
            table = ChannelTable.model_validate(catalogue.table)
        except pydantic.ValidationError as error:
            raise input_error(error, "catalogue.table", ChannelTable) from None
        self._tick_rate_hz = catalogue.tick_rate_hz
        self._messages, self._layout = schedule.table.by_name, schedule.table.layout
        self._rate_hz, self._steps = find_decimations(table, schedule)
        self._samples = make_sample_frames(table, schedule, self._steps)
        self._numbers_of_messages = {
            f"{layout}_messages": sum(each.message.fd == fd for each in self._samples)
            for layout, fd in (("fd", True), ("classic", False))
        }
        self._groups = tuple(table.groups)
        self._queue_seconds = queue_seconds
        self._changed = threading.Condition()
        self._queue: BoundedQueue[tuple[str, bytes]] = BoundedQueue(
            8 * len(self._groups), size=lambda entry: int(entry[0] not in _DOCUMENT_KEYS), changed=self._changed
        )
        self._stopping = False
        self._end_s = math.inf

        self._time_us = 0
        self.state = RigState.PREPARING
        self._ended = False
        self._status: dict[str, Any] = {}
        self._beat_number = 0
        self._last_sync: dict[str, int] | None = None
        self._event_number = 0
        self._next_status_s = self._next_heartbeat_s = now()

        self.fault_skipped = 0
        """Frames that a fault of blocks prevented: it removed their samples, or sent them out of order."""
        self._fault_ends: dict[str, int] = {}
        """First row number after the rows affected by such a fault, by group."""
        self.bus_errors = 0
        """Errors of the bus while receiving."""
        self.guard = Guard("the CAN gateway")
        self.dropping = IncreaseWarning("CAN: {} frames were dropped: the bus does not take them in time")
        self._falling_behind = IncreaseWarning("CAN: {} blocks were dropped: the gateway does not keep up")
        room = math.ceil(_MAX_BACKLOG_S * sum(1.0 / period_s for period_s in schedule.messages().values()))
        self.outbox = Outbox(bus, room=room, paced=paced, now=now)
        self.commands = Commands(
            client,
            self._acknowledge,
            lambda node: self._send_device_state(node, DeviceState.REFUSED, self._time_us),
            timeout_s=command_timeout_s,
            now=now,
            guard=self.guard,
            table=schedule.table,
        )
        self._threads = [
            threading.Thread(target=target, name=f"can gateway {name}", daemon=True)
            for name, target in (
                ("sends", self._send_all),
                ("receives", self._receive),
                ("asks", self.commands.send_all),
            )
        ]

    # ---- start and end ----

    def start(self) -> None:
        """Start: the gateway is a node of the bus from now on."""
        self._bus.set_filters([{"can_id": each, "can_mask": STANDARD_MASK, "extended": False} for each in IDENTIFIERS])
        for group in self._groups:
            self._client.subscribe(wire.sensor_key(group), self._take)
        for key in (wire.EDGES, *_DOCUMENT_KEYS):
            self._client.subscribe(key, self._take)
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Send what is still due, then end."""
        with self._changed:
            self._stopping = True
            self._queue.close()
        self.commands.close()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=2.0)

    def __enter__(self) -> Self:
        self.start()
        return self

    def figures(self) -> dict[str, float]:
        """Return the counts for the rig's status."""
        refused = dict(self.commands.refused)
        return {
            "can_load": round(self._load, 4),
            "can_frames": self.outbox.sent,
            "can_dropped": self.dropped,
            "can_blocks_dropped": self.blocks_dropped,
            "can_accepted": self.commands.accepted,
            "can_refused": sum(refused.values()),
            **{f"can_refused_{reason}": count for reason, count in refused.items()},
        }

    def warnings(self) -> list[str]:
        """Return the current warnings for the operator."""
        return [
            *self.guard.warnings(),
            *self.dropping.warnings(self.dropped),
            *self._falling_behind.warnings(self.blocks_dropped),
        ]

    @property
    def blocks_dropped(self) -> int:
        """Blocks dropped because the sender was too slow."""
        return self._queue.dropped

    @property
    def dropped(self) -> int:
        """Frames that the bus did not accept, or that were never built because samples were missing."""
        return self.outbox.dropped + sum(each.skipped for each in self._samples) - self.fault_skipped

    # ---- on the publisher's thread ----

    def _take(self, key: str, payload: bytes) -> None:
        if self._paced or not self._queue.put((key, payload)):
            self._queue.push((key, payload))

    # ---- on the sender's thread ----

    def _send_all(self) -> None:
        while not (done := self.guard(self._send_some)):
            if done is None:
                if self._stopping:
                    return
                time.sleep(_IDLE_S)

    def _send_some(self) -> bool:
        """Send what is due, and wait for more; return whether everything was sent and the gateway is stopping."""
        for key, payload in self._queue.take_many(len(self._queue), 0.0):
            self.guard(self.unpack, key, payload)
        now = self._now()
        self.outbox.send_due()
        if self._ended and self.state != RigState.ENDED and not self.outbox.undue and not self.outbox.waiting:
            # Only now: a receiver of the state must not expect samples any more.
            self.state = RigState.ENDED
            self._next_status_s = self._next_heartbeat_s = now
        self._send_periodic(now)
        self.commands.time_out()
        with self._changed:
            if self._queue and not self._paced:
                return False
            if self._stopping and not self._queue:
                # A block with a false time may be due when no receiver waits for it any more.
                self._end_s = min(self._end_s, now + min(self.outbox.latency_s, _MAX_LATENCY_S) + _FLUSH_TIMEOUT_S)
                if now >= self._end_s or not (self.outbox.undue or self.outbox.stuck):
                    self.outbox.drop_all()
                    return True
            if not self._paced:
                self._changed.wait(_IDLE_S)
                return False
            if not self._queue and not self.outbox.stuck:
                next_s = min(self.outbox.next_s, self._next_status_s, self._next_heartbeat_s)
                self._changed.wait(min(max(next_s - self._now(), 0.0), _IDLE_S))
            waiting = bool(self._queue or self.outbox.stuck)
        if waiting:
            # Wake on a grid of slots, so that blocks that arrive together are sent together.
            time.sleep(SLOT_S - self._now() % SLOT_S)
        return False

    def unpack(self, key: str, payload: bytes) -> None:
        """Convert a publication of the rig to frames.

        Raises:
            ValueError: It is not a valid publication of a rig.
        """
        if key == wire.EVENTS:
            self._on_event(wire.decode_document(payload))
        elif key == wire.FAULTS:
            report = check(_FaultReport, payload, field="faults", most_bytes=DOCUMENT_BYTES)
            self._fault_ends |= {one.key.rpartition("/")[2]: one.row + one.rows for one in report.blocks}
        elif key == wire.STATUS:
            self._status = wire.decode_document(payload)
            self._follow_pace(self._status)
        elif key == wire.BLOCK:
            end = parse_block_end(payload)
            time_us = round(1e6 * end.time_s)
            self.outbox.put_one(
                self._messages["Block"], end.time_s, block=end.block & _WORD_32, time=time_us & _WORD_32
            )
        elif key == wire.EDGES:
            self._on_edges(wire.decode_block(payload, wire.TRUTH_SCHEMA))
        else:
            self._on_samples(key.rpartition("/")[2], wire.decode_block(payload, wire.SAMPLE_SCHEMA))

    def _on_samples(self, group: str, block: wire.Block) -> None:
        if not len(block.values):
            return
        self._follow_time(block)
        if self.state == RigState.PREPARING:
            self.state = RigState.RUNNING
        for each in self._samples:
            if group not in each.columns:
                continue
            skipped = each.skipped
            if (complete := each.take(group, block)) is not None:
                # A frame is due with its last instant.
                last, data = complete
                self.outbox.put(each.message, data, last / self._rate_hz)
            if any(block.index <= self._fault_ends.get(name, -1) for name in each.columns):
                self.fault_skipped += each.skipped - skipped
        if group == self._groups[0]:
            self._sync(block)

    def _follow_time(self, block: wire.Block) -> None:
        self.outbox.follow(block)
        length_s = len(block.values) / block.rate_hz
        self._time_us = max(self._time_us, round(1e6 * (block.tick / block.tick_rate_hz + length_s)))
        if self._paced:
            blocks = math.ceil(self._queue_seconds / length_s)
            self._queue.room = max(8 * len(self._groups), blocks * (len(self._groups) + 1))

    def _sync(self, block: wire.Block) -> None:
        every = round(_SYNC_S * self._rate_hz)
        for index in range(-(-block.index // every) * every, block.index + len(block.values), every):
            # Use the time in the block: a receiver that ties bus time to the stream must see its discontinuities.
            time_s = block.start_s + (index - block.index) / self._rate_hz
            self._last_sync = {"index": index & _WORD_32, "time": round(1e6 * time_s) & _WORD_32}
            self.outbox.put_one(self._messages["Sync"], time_s, **self._last_sync)

    def _on_edges(self, block: wire.Block) -> None:
        for number, ticks in enumerate(block.values[:, 0].tolist(), start=block.index):
            time_us = (block.tick + ticks) / self._tick_rate_hz * 1e6
            fraction = min(round((time_us % 1.0) * 65536), 65535)
            self.outbox.put_one(
                self._messages["Keyphasor"],
                time_us * 1e-6,
                number=number & 0xFFFF,
                time=int(time_us) & _WORD_32,
                fraction=fraction,
            )

    def _on_event(self, event: dict[str, Any]) -> None:
        name = str(event.get("event", ""))
        kind = EventKind[name.upper()] if name.upper() in EventKind.__members__ else EventKind.OTHER
        self._ended |= kind is EventKind.END
        time_us = round(1e6 * float(event.get("time_s", 0.0)))
        value = event.get(EVENT_VALUES.get(name, ""), 0.0)
        value = value if isinstance(value, (int, float)) and math.isfinite(value) else 0.0
        # Sent with the samples of its time; its identifier loses against theirs, so that the end comes last.
        self.outbox.put_one(
            self._messages["Event"],
            time_us * 1e-6,
            event=kind,
            number=self._event_number & 0xFF,
            time=time_us & _WORD_32,
            value=min(max(round(10 * value), 0), 0xFFFF),
        )
        self._event_number += 1
        if kind is EventKind.START:
            self._follow_pace(event)
        if kind is EventKind.DEVICE and (node := device_node(event.get("device"))) is not None:
            self._send_device_state(node, DeviceState[str(event["state"]).upper()], time_us)

    def _send_device_state(self, node: int, standing: DeviceState, time_us: int) -> None:
        message = self._messages["DeviceState"]
        self.outbox.put_one(message, time_us * 1e-6, node=node, state=standing, time=time_us & _WORD_32)

    def _follow_pace(self, document: dict[str, Any]) -> None:
        """Report lockstep before the first block, as devices must join before it."""
        if document.get("pace") == "lockstep" and self.state in (RigState.PREPARING, RigState.RUNNING):
            self.state = RigState.LOCKSTEP
            self._next_heartbeat_s = self._now()

    def _send_periodic(self, now: float) -> None:
        if now >= self._next_status_s:
            self._next_status_s = max(self._next_status_s + _STATUS_S, now)
            self._send_status()
        if now >= self._next_heartbeat_s:
            self._next_heartbeat_s = max(self._next_heartbeat_s + _HEARTBEAT_S, now)
            self._beat_number = self._beat_number + 1 & 0xFF
            if self.state == RigState.LOCKSTEP and self._last_sync is not None:
                # Repeat Sync between steps: a node that joins then would otherwise wait for it in vain.
                self.outbox.answer(self._messages["Sync"], **self._last_sync)
            self.outbox.answer(
                self._messages["Clock"],
                seconds=self._time_us // 1_000_000 & _WORD_32,
                **self._numbers_of_messages,
            )
            self.outbox.answer(
                self._messages["Heartbeat"],
                state=self.state,
                beat=self._beat_number,
                counter=self.commands.counter,
                time=self._time_us & _WORD_32,
                layout=self._layout,
            )
            self.outbox.answer(
                self._messages["Rates"],
                rate=min(self._rate_hz, 0xFFFFFF),
                fd_step=self._steps.get(True, 0),
                classic_step=self._steps.get(False, 0),
                latency=min(round(self.outbox.latency_s / 1e-5), 0xFFFF),
            )

    def _send_status(self) -> None:
        status = self._status
        spin = status.get("spin_hz")
        late = status.get("lateness_ms", {}).get("p99") or 0.0
        self.outbox.answer(
            self._messages["Status"],
            state=self.state,
            warnings=min(len(status.get("warnings", ())), 15),
            spin=min(max(round(1e3 * spin), 0), 0xFFFF) if isinstance(spin, (int, float)) else 0,
            lateness=min(round(100 * late), 0xFFFF),
            dropped=self.dropped & 0xFFF,
            refused=self.commands.refused.total() & 0xFFF,
        )

    # ---- commands ----

    def _acknowledge(self, **raw: int) -> None:
        self.outbox.answer(self._messages["Acknowledge"], **{"time": self._time_us & _WORD_32, **raw})

    def _receive(self) -> None:
        import can

        while not self._stopping:
            try:
                message = self._bus.recv(0.2)
            except Exception as error:
                # Bus off, or no hub: it may recover, and the rig continues meanwhile.
                self.bus_errors += 1
                if not isinstance(error, (can.CanError, OSError, ValueError)):
                    self.guard.record_failure("receiving from the bus", error)
                time.sleep(0.1)
                continue
            if message is not None:
                self.guard(self.commands.take_message, message)
