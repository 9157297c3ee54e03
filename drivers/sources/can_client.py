"""A rig on a CAN bus as a client has it: commands as frames that are acknowledged, and what frames tell of its events.

What the bus has no frame for is refused here by name: the truth, notes, steps, and numbers of a fault beside its main
one. A device under test is known by its number on the bus.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any

from drivers.can.devices import DeviceKind, Standing, device_frame, name_of
from drivers.can.signals import (
    EVENT_VALUES,
    EventKind,
    Field,
    Kind,
    Result,
    State,
    clear_frame,
    command_frame,
    fault_frame,
)
from drivers.sources.can import CanSource
from rig.base import wire
from rig.base.closeable import Closing
from rig.base.errors import InputError, Words
from rig.serve.transport import NoReplyError
from rig.serve.waiting import Deadline

_US = 1e-6
_WRAP = 1 << 32
_MAX_SYNC_AGE_TICKS = 60_000_000
"""A Sync corrects a time that is further off: the client has just joined, or a new run has begun [us]."""
_BEAT_S = 1.5
"""A heartbeat comes within this time [s]."""
_VALUE_STEP = 0.1
"""Unit per step of the value of an event, as the message Event has it."""


class CanClient(Closing):
    """One node of a bus, as a client of the rig there.

    Args:
        spec: As of `CanSource`.
        wait_s: How long to wait for a rig to be there [s].

    Raises:
        InputError: There is no such bus, or no rig on it.
    """

    foreign = 0

    def __init__(self, spec: str, *, wait_s: float = 3.0) -> None:
        self._changed = threading.Condition()
        self._tick = 0
        self._beats = 0
        self._beat: dict[str, int] = {}
        self._status: dict[str, int] = {}
        self._counter: int | None = None
        self._answers: queue.SimpleQueue[dict[str, int]] = queue.SimpleQueue()
        self._standings: queue.SimpleQueue[tuple[Standing, int]] = queue.SimpleQueue()
        self._joined = False
        self._blocks: dict[int, int] = {}
        """Numbers of the last blocks, by their end [ticks]."""
        self._takers: dict[str, list[Callable[[str, bytes], None]]] = {}
        self._asking = threading.Lock()
        self.node = -1
        self.source = CanSource(spec, wait_s=max(wait_s, _BEAT_S), on_frame=self._take)
        self.node = self.source.node
        try:
            if not isinstance(self.node, int) or not 0 <= self.node <= 0xFF:
                raise InputError("node", "a number from 0 to 255", self.node)
            self.source.wait()
            with self._changed:
                self._changed.wait_for(lambda: self._beats > 0, _BEAT_S)
        except BaseException:
            self.source.close()
            raise

    @property
    def rig(self) -> str | None:
        """A bus does not tell who sends."""
        return None

    # What comes, on the thread that reads.

    def _take(self, name: str, raw: dict[str, int]) -> None:
        if name == "Heartbeat":
            with self._changed:
                self._beat, self._counter = raw, raw["counter"]
                self._at(raw["time"])
                self._beats += 1
                self._changed.notify_all()
        elif name == "Sync":
            tick = raw["index"] * 1_000_000 // raw["rate"]
            if abs(tick - self._tick) > _MAX_SYNC_AGE_TICKS:
                self._tick = tick
                self._at(self._beat.get("time", tick))
        elif name == "Status":
            self._status = raw
        elif name == "Acknowledge":
            if raw["result"] in (Result.ACCEPTED, Result.OUT_OF_RANGE, Result.REFUSED, Result.TIMED_OUT):
                self._counter = raw["counter"]
            self._answers.put(raw)
        elif name == "Event" and raw["event"] != EventKind.DEVICE:
            kind = EventKind(raw["event"])
            field = EVENT_VALUES.get(kind.name.lower())
            value = {field: raw["value"] * _VALUE_STEP} if field else {}
            self._tell(wire.EVENTS, {"event": kind.name.lower(), **self._time(raw["time"]), **value})
        elif name == "DeviceState":
            standing = Standing(raw["state"])
            if raw["node"] == self.node:
                if standing is not Standing.REFUSED:  # which may be another's, who took the same number
                    self._joined = standing is Standing.JOINED
                self._standings.put((standing, self._at(raw["time"])))
            if standing is not Standing.REFUSED:
                told = {"device": name_of(raw["node"]), "state": standing.name.lower()}
                self._tell(wire.EVENTS, {"event": "device", **self._time(raw["time"]), **told})
        elif name == "Block":
            end = self._time(raw["time"])
            self._blocks = {**dict(list(self._blocks.items())[-3:]), end["tick"]: raw["block"]}
            self._tell(wire.BLOCK, {"block": raw["block"], **end, "messages": {}})

    def _at(self, raw: int) -> int:
        """The tick of a time that is cut short, near the last one."""
        tick = self._tick + (raw - self._tick + _WRAP // 2) % _WRAP - _WRAP // 2
        self._tick = max(self._tick, tick)
        return tick

    def _time(self, raw: int) -> dict[str, Any]:
        tick = self._at(raw)
        return {"tick": tick, "time_s": tick * _US}

    def _tell(self, key: str, document: dict[str, Any]) -> None:
        payload = wire.encode_document(document)
        for take in self._takers.get(key, ()):
            take(key, payload)

    # What a client asks for.

    def subscribe(self, key: str, on_message: Callable[[str, bytes], None], **_: Any) -> None:
        """Receive what frames tell of events, or of the ends of blocks; samples come from `source`.

        Raises:
            InputError: The bus carries nothing else.
        """
        if key not in (wire.EVENTS, wire.BLOCK):
            raise InputError("key", "of events or ends of blocks: a CAN bus carries nothing else as documents", key)
        self._takers.setdefault(key, []).append(on_message)

    def settle(self) -> None:
        """A node hears all from the beginning."""

    def wait_for(self, key: str, number: int, *, timeout_s: float) -> bool:
        """Frames come in one line: what went before has come."""
        return True

    def request(self, key: str, payload: bytes = b"", *, timeout_s: float = 2.0) -> bytes:
        """Ask the rig what frames can ask.

        Raises:
            InputError: There is no frame for it.
            NoReplyError: It was not answered in time.
        """
        if key == wire.STATUS:
            return wire.encode_document(self._said())
        if key == wire.CATALOGUE:
            table = self.source.channels.model_dump(mode="json")
            return wire.encode_document({"table": table, "tick_rate_hz": 1.0 / _US})
        fields = wire.decode_document(payload)
        fields.pop("from", None)
        command = key.removeprefix(wire.command_key(""))
        with self._asking:
            if command in ("join", "done", "leave"):
                return wire.encode_document(self._device(DeviceKind[command.upper()], fields, timeout_s))
            return wire.encode_document(self._command(command, fields, timeout_s))

    def _said(self) -> dict[str, Any]:
        """The status as far as frames tell it; the length of a block they do not."""
        state = State(self._beat.get("state", State.PREPARING))
        return {
            "state": "ended" if state is State.ENDED else "running",
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
                raise InputError("fault", "with its main number alone, over CAN: zenoh takes the others", dict(fields))
            return fault_frame(channel, kind, counter, number=rest[0] if rest else None, table=self.source.table)
        if command == "clear":
            return clear_frame(counter, number=0 if fields["id"] == "all" else int(fields["id"]))
        if command.upper() not in Kind.__members__:
            known = ", ".join(each.name.lower() for each in Kind)
            raise InputError("command", f"one that a CAN bus has a frame for ({known}, fault, clear)", command)
        return command_frame(Kind[command.upper()], counter, **fields)

    def _command(self, command: str, fields: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        """Send a command; returns the reply to it."""
        beats = self._beats
        answer = self._ask(command, fields, timeout_s)
        if answer["result"] == Result.STALE_COUNTER:
            # Others have gone on with the counter meanwhile: the next heartbeat tells it.
            with self._changed:
                self._changed.wait_for(lambda: self._beats > beats, _BEAT_S)
            answer = self._ask(command, fields, timeout_s)
        if answer["result"] != Result.ACCEPTED:
            field, limit = Field(answer["field"]), 0.1 * answer["limit"]
            passed = f" ({field.name.lower()}, limit {limit:g})" if field is not Field.NONE else ""
            result = Result(answer["result"]).name.lower().replace("_", " ")
            return {"accepted": False, "error": f"{command} was refused over CAN: {result}{passed}"}
        told: dict[str, Any] = {"accepted": True, "id": answer["counter"], **self._time(answer["time"])}
        if command == "fault":
            told |= self._meets(str(fields["channel"]), answer["limit"] // 10, told["time_s"])
        return told

    def _meets(self, channel: str, number: int, time_s: float) -> dict[str, Any]:
        """What the reply to a fault has beyond others."""
        groups, channels = self.source.channels.groups, self.source.channels.channels
        group = groups[channel if channel in groups else channels[channel].group]
        names = list(group.names) if channel in groups else [channel]
        return {"fault": number, "channels": names, "first_row": {group.name: round(time_s * group.rate_hz)}}

    def _ask(self, command: str, fields: Mapping[str, Any], timeout_s: float) -> dict[str, int]:
        """The Acknowledge of a command."""
        counter = ((self._counter or 0) + 1) & 0xFF
        frame = self._frame(command, fields, counter)
        while not self._answers.empty():
            self._answers.get()
        self.source.send(*frame)
        deadline = Deadline(timeout_s)
        while True:
            try:
                answer = self._answers.get(timeout=deadline.left_s)
            except queue.Empty:
                raise NoReplyError(f"the rig on this bus did not acknowledge {command} in {timeout_s:g} s") from None
            if answer["counter"] == counter:
                return answer

    def _device(self, kind: DeviceKind, fields: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        """Take part in lockstep under the number of this node, whatever the name."""
        name, message = kind.name.lower(), self.source.table.by_name["Device"]
        if kind is not DeviceKind.JOIN and not self._joined:
            return {"accepted": False, "error": f"{name}: the rig does not wait for {name_of(self.node)}, or no longer"}
        if kind is DeviceKind.DONE:
            block = self._blocks.get(fields["tick"])
            if block is None:
                raise InputError(
                    "done.tick", f"the end of a block ({', '.join(map(str, self._blocks))})", fields["tick"]
                )
            self.source.send(*device_frame(message, kind, self.node, block=block))
            return {"accepted": True, "id": 0, "tick": fields["tick"], "time_s": fields["tick"] * _US}
        if not self.source.lockstep:
            raise InputError(name, "sent to a rig that runs with --pace lockstep", Words("another"))
        while not self._standings.empty():
            self._standings.get()
        self.source.send(*device_frame(message, kind, self.node, patience_s=fields.get("patience_s", 0.0)))
        try:
            standing, tick = self._standings.get(timeout=timeout_s)
        except queue.Empty:
            raise NoReplyError(f"the rig on this bus did not answer {name} in {timeout_s:g} s") from None
        if standing is Standing.REFUSED:
            return {"accepted": False, "error": f"{name}: the rig refused {name_of(self.node)} (?node=N is another)"}
        return {"accepted": True, "id": 0, "tick": tick, "time_s": tick * _US}

    def watch(self, key: str, callback: Callable[[bool], None]) -> None:
        """A bus has no tokens; the source tells when the rig has gone."""

    def report(self, key: str, payload: bytes) -> None:
        """A bus does not ask how far its nodes are."""

    def close(self) -> None:
        """Leave the bus."""
        self.source.close()
