"""Client of a rig on a CAN bus: commands as acknowledged frames, and the rig's events as far as frames carry them.

Requests for which the bus has no frame are refused here by name: truth tables, steps, and fault fields except the main
one. A note is sent by a tag that is a kind of note, channel and value; the rig builds the text. A device under test is
identified by its node number.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any

from drivers.can.devices import (
    DeviceKind,
    DeviceState,
    NoteKind,
    device_frame,
    device_name,
    find_value,
    note_frame,
    sender_frame,
)
from drivers.can.signals import (
    EVENT_VALUES,
    MAX_LEAD,
    CommandKind,
    EventKind,
    Field,
    Result,
    RigState,
    clear_frame,
    command_frame,
    fault_frame,
)
from drivers.sources.can import CanSource
from rig.base import wire
from rig.base.errors import InputError, Words
from rig.base.files import Closing
from rig.serve.transport import NoReplyError
from rig.serve.waiting import Deadline

_US = 1e-6
_WRAP = 1 << 32
_MAX_SYNC_AGE_TICKS = 60_000_000
"""Largest difference between Sync and the last time [us]; beyond it, the client has just joined or a new run has begun.
"""
_HEARTBEAT_TIMEOUT_S = 1.5
"""Longest time between two heartbeats, with a margin [s]."""
_VALUE_STEP = 0.1
"""Unit per step of an event's value in the message Event."""


class CanClient(Closing):
    """Transport to a rig by one node of a CAN bus.

    Args:
        spec: Bus, as for `CanSource`.
        wait_s: Longest wait for a rig [s].

    Raises:
        InputError: The bus does not exist, or has no rig.
    """

    foreign = 0

    def __init__(self, spec: str, *, wait_s: float = 3.0) -> None:
        self._changed = threading.Condition()
        self._tick = 0
        self._beats = 0
        self._beat: dict[str, int] = {}
        self._status: dict[str, int] = {}
        self._counter: int | None = None
        self._acknowledgements: queue.SimpleQueue[dict[str, int]] = queue.SimpleQueue()
        self._device_states: queue.SimpleQueue[tuple[DeviceState, int]] = queue.SimpleQueue()
        self._joined = False
        self._blocks: dict[int, int] = {}
        """Block numbers of the latest blocks, by their end [ticks]."""
        self._subscribers: dict[str, list[Callable[[str, bytes], None]]] = {}
        self._request_lock = threading.Lock()
        self.node = -1
        self.source = CanSource(spec, wait_s=max(wait_s, _HEARTBEAT_TIMEOUT_S), on_frame=self._take)
        self.node = self.source.node
        try:
            if not isinstance(self.node, int) or not 0 <= self.node <= 0xFF:
                raise InputError("node", "a number from 0 to 255", self.node)
            self.source.wait()
            with self._changed:
                self._changed.wait_for(lambda: self._beats > 0, _HEARTBEAT_TIMEOUT_S)
        except BaseException:
            self.source.close()
            raise

    @property
    def rig(self) -> str | None:
        """Always None: frames do not identify the rig process."""
        return None

    # ---- received frames, on the reading thread ----

    def _take(self, name: str, raw: dict[str, int]) -> None:
        if name == "Heartbeat":
            with self._changed:
                self._beat, self._counter = raw, raw["counter"]
                self._unwrap_tick(raw["time"])
                self._beats += 1
                self._changed.notify_all()
        elif name == "Sync":
            tick = raw["index"] * 1_000_000 // raw["rate"]
            if abs(tick - self._tick) > _MAX_SYNC_AGE_TICKS:
                self._tick = tick
                self._unwrap_tick(self._beat.get("time", tick))
        elif name == "Status":
            self._status = raw
        elif name == "Acknowledge":
            if raw["result"] in (Result.ACCEPTED, Result.OUT_OF_RANGE, Result.REFUSED, Result.TIMED_OUT):
                self._counter = raw["counter"]
            self._acknowledgements.put(raw)
        elif name == "Event" and raw["event"] != EventKind.DEVICE:
            kind = EventKind(raw["event"])
            field = EVENT_VALUES.get(kind.name.lower())
            value = {field: raw["value"] * _VALUE_STEP} if field else {}
            self._publish(wire.EVENTS, {"event": kind.name.lower(), **self._time(raw["time"]), **value})
        elif name == "DeviceState":
            standing = DeviceState(raw["state"])
            if raw["node"] == self.node:
                if standing is not DeviceState.REFUSED:  # it may concern another device with the same number
                    self._joined = standing is DeviceState.JOINED
                self._device_states.put((standing, self._unwrap_tick(raw["time"])))
            if standing is not DeviceState.REFUSED:
                device = {"device": device_name(raw["node"]), "state": standing.name.lower()}
                self._publish(wire.EVENTS, {"event": "device", **self._time(raw["time"]), **device})
        elif name == "Block":
            end = self._time(raw["time"])
            self._blocks = {**dict(list(self._blocks.items())[-3:]), end["tick"]: raw["block"]}
            self._publish(wire.BLOCK, {"block": raw["block"], **end, "messages": {}})

    def _unwrap_tick(self, raw: int) -> int:
        """Return the tick of a wrapped time: the one nearest to the last tick."""
        tick = self._tick + (raw - self._tick + _WRAP // 2) % _WRAP - _WRAP // 2
        self._tick = max(self._tick, tick)
        return tick

    def _time(self, raw: int) -> dict[str, Any]:
        tick = self._unwrap_tick(raw)
        return {"tick": tick, "time_s": tick * _US}

    def _publish(self, key: str, document: dict[str, Any]) -> None:
        payload = wire.encode_document(document)
        for take in self._subscribers.get(key, ()):
            take(key, payload)

    # ---- requests ----

    def subscribe(self, key: str, on_message: Callable[[str, bytes], None], **_: Any) -> None:
        """Receive events or ends of blocks; samples come from `source`.

        Raises:
            InputError: The key is another one.
        """
        if key not in (wire.EVENTS, wire.BLOCK):
            raise InputError("key", "that of events or of ends of blocks: a CAN bus carries no other documents", key)
        self._subscribers.setdefault(key, []).append(on_message)

    def settle(self) -> None:
        """Return at once: a node receives all frames from the beginning."""

    def wait_for(self, key: str, number: int, *, timeout_s: float) -> bool:
        """Return True: frames arrive in the order in which they were sent."""
        return True

    def request(self, key: str, payload: bytes = b"", *, timeout_s: float = 2.0) -> bytes:
        """Send a request for which the bus has a frame, and return the reply.

        Raises:
            InputError: The bus has no frame for it.
            NoReplyError: The rig did not reply in time.
        """
        if key == wire.STATUS:
            return wire.encode_document(self._build_status())
        if key == wire.CATALOGUE:
            table = self.source.channels.model_dump(mode="json")
            return wire.encode_document({"table": table, "tick_rate_hz": 1.0 / _US})
        fields = wire.decode_document(payload)
        fields.pop("from", None)
        command = key.removeprefix(wire.command_key(""))
        with self._request_lock:
            if command in ("join", "done", "leave"):
                return wire.encode_document(self._device(DeviceKind[command.upper()], fields, timeout_s))
            if command == "note":
                return wire.encode_document(self._note(fields))
            return wire.encode_document(self._command(command, fields, timeout_s))

    def _build_status(self) -> dict[str, Any]:
        """Return the status as far as frames carry it; they do not carry the length of a block."""
        state = RigState(self._beat.get("state", RigState.PREPARING))
        return {
            "state": "ended" if state is RigState.ENDED else "running",
            "pace": "lockstep" if self.source.lockstep else "real-time",
            "block_ms": None,
            "tick": self._tick,
            "time_s": self._tick * _US,
            "spin_hz": self._status.get("spin", 0) * 1e-3,
        }

    def _frame(self, command: str, fields: Mapping[str, Any], counter: int) -> tuple[int, bytes]:
        if command == "fault":
            channel, kind = str(fields["channel"]), str(fields["kind"])
            rest = [value for name, value in fields.items() if name not in ("channel", "kind")]
            if len(rest) > 1 or "for_s" in fields:
                raise InputError("fault", "with only its main number over CAN (zenoh: all)", dict(fields))
            return fault_frame(channel, kind, counter, number=rest[0] if rest else None, table=self.source.table)
        if command == "clear":
            return clear_frame(counter, number=0 if fields["id"] == "all" else int(fields["id"]))
        if command.upper() not in CommandKind.__members__:
            names = ", ".join(each.name.lower() for each in CommandKind)
            raise InputError("command", f"one with a CAN frame ({names}, fault, clear)", command)
        return command_frame(CommandKind[command.upper()], counter, **fields)

    def _command(self, command: str, fields: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        """Send a command, and return the reply."""
        beats = self._beats
        answer = self._send_command(command, fields, timeout_s)
        if answer["result"] == Result.STALE_COUNTER:
            # Other clients have advanced the counter: the next heartbeat gives its value.
            with self._changed:
                self._changed.wait_for(lambda: self._beats > beats, _HEARTBEAT_TIMEOUT_S)
            answer = self._send_command(command, fields, timeout_s)
        if answer["result"] != Result.ACCEPTED:
            field, limit = Field(answer["field"]), 0.1 * answer["limit"]
            exceeded = f" ({field.name.lower()}, limit {limit:g})" if field is not Field.NONE else ""
            result = Result(answer["result"]).name.lower().replace("_", " ")
            return {"accepted": False, "error": f"{command} was refused over CAN: {result}{exceeded}"}
        reply: dict[str, Any] = {"accepted": True, "id": answer["counter"], **self._time(answer["time"])}
        if command == "fault":
            reply |= self._describe_fault(str(fields["channel"]), answer["limit"] // 10, reply["time_s"])
        return reply

    def _describe_fault(self, channel: str, number: int, time_s: float) -> dict[str, Any]:
        """Return the fields that a reply to a fault has in addition."""
        groups, channels = self.source.channels.groups, self.source.channels.channels
        group = groups[channel if channel in groups else channels[channel].group]
        names = list(group.names) if channel in groups else [channel]
        return {"fault": number, "channels": names, "first_row": {group.name: round(time_s * group.rate_hz)}}

    def _send_command(self, command: str, fields: Mapping[str, Any], timeout_s: float) -> dict[str, int]:
        """Send a command, and return its Acknowledge."""
        # Devices that share the counter lead it by different numbers, so that each knows its own Acknowledge.
        counter = ((self._counter or 0) + 1 + (self.node - 1) % MAX_LEAD) & 0xFF
        frame = self._frame(command, fields, counter)
        while not self._acknowledgements.empty():
            self._acknowledgements.get()
        if self._joined:
            self.source.send(*sender_frame(self.source.table.by_name["Device"], self.node, frame[1]))
        self.source.send(*frame)
        deadline = Deadline(timeout_s)
        while True:
            try:
                answer = self._acknowledgements.get(timeout=deadline.left_s)
            except queue.Empty:
                raise NoReplyError(f"the rig on this bus did not acknowledge {command} in {timeout_s:g} s") from None
            if answer["counter"] == counter:
                return answer

    def _note(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Send a note as the device with this node's number; a bus has no reply to it."""
        kinds = {kind.tag: kind for kind in NoteKind}
        found = [kinds[tag] for tag in fields["tags"] if tag in kinds]
        if not found:
            raise InputError("tags", f"with one of {', '.join(kinds)} over CAN", fields["tags"])
        words = str(fields["text"]).split()
        channel = next((word for word in words if word in self.source.channels.channels), None)
        alarm = next((kinds[word] for word in words if word in kinds and kinds[word] is not found[0]), None)
        ends = found[0] in (NoteKind.CLEAR, NoteKind.RESET)
        value = find_value(words, {*kinds, *self.source.channels.channels, *self.source.channels.groups})
        message, alarm = self.source.table.by_name["Device"], alarm if ends else None
        self.source.send(*note_frame(message, found[0], self.node, channel=channel, value=value, alarm=alarm))
        return {"accepted": True, "id": 0, "tick": self._tick, "time_s": self._tick * _US}

    def _device(self, kind: DeviceKind, fields: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        """Join, finish a block or leave as the device with this node's number; the name in the request is ignored."""
        name, message = kind.name.lower(), self.source.table.by_name["Device"]
        if kind is not DeviceKind.JOIN and not self._joined:
            return {"accepted": False, "error": f"{name}: {device_name(self.node)} has not joined, or was removed"}
        if kind is DeviceKind.DONE:
            block = self._blocks.get(fields["tick"])
            if block is None:
                raise InputError(
                    "done.tick", f"the end of a block ({', '.join(map(str, self._blocks))})", fields["tick"]
                )
            self.source.send(*device_frame(message, kind, self.node, block=block))
            return {"accepted": True, "id": 0, "tick": fields["tick"], "time_s": fields["tick"] * _US}
        if not self.source.lockstep:
            raise InputError(name, "sent to a rig with --pace lockstep", Words("another pace"))
        while not self._device_states.empty():
            self._device_states.get()
        self.source.send(*device_frame(message, kind, self.node, patience_s=fields.get("patience_s", 0.0)))
        try:
            standing, tick = self._device_states.get(timeout=timeout_s)
        except queue.Empty:
            raise NoReplyError(f"the rig on this bus did not reply to {name} in {timeout_s:g} s") from None
        if standing is DeviceState.REFUSED:
            return {"accepted": False, "error": f"{name}: the rig refused {device_name(self.node)} (try another node)"}
        return {"accepted": True, "id": 0, "tick": tick, "time_s": tick * _US}

    def watch(self, key: str, callback: Callable[[bool], None]) -> None:
        """Ignore: a bus has no tokens; the source reports a rig that stops."""

    def report(self, key: str, payload: bytes) -> None:
        """Ignore: a bus has no frame for a reader's position."""

    def close(self) -> None:
        """Leave the bus."""
        self.source.close()
