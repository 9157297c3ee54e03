"""Commands from frames: checked, sent to the rig and acknowledged."""

from __future__ import annotations

import contextlib
import math
import secrets
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import pydantic

from drivers.can.devices import DeviceKind, DeviceRequest, device_name
from drivers.can.message import MessageTable
from drivers.can.signals import FIELDS, LIMITS, Command, CommandKind, Field, Result, default_messages, parse_command
from rig.base import wire
from rig.base.checks import DOCUMENT_BYTES, StrictModel, check
from rig.serve.health import Guard
from rig.serve.transport import Client, NoReplyError
from rig.serve.transport.limit import Bucket

if TYPE_CHECKING:
    import can

_MAX_PENDING = 16
"""Largest number of commands that wait for the rig."""
IDENTIFIERS = [default_messages().by_name[name].identifier for name in ("Stop", "Command", "Fault", "Device")]
_ORDER_TIMEOUT_S = 3600.0
"""Longest wait of a device's note or command for devices that precede it by name [s]: the largest patience."""
_MAX_REFUSALS_PER_S = 50.0
_MAX_REFUSAL_BURST = 20.0


@dataclass(slots=True)
class _PendingCommand:
    """A command that waits for the rig."""

    command: Command | DeviceRequest
    deadline_s: float
    device: str = ""
    """Name of the device that sent it; empty for a command that no device has announced."""
    ordered: bool = False
    """Whether the rig orders it by the device's name, so that it may have to wait for other devices."""
    started: bool = False
    answered: bool = False


class _Reply(StrictModel, extra="ignore"):
    """The rig's reply to a command: the time at which it takes effect, or the invalid field."""

    accepted: bool
    time_s: Annotated[float, pydantic.Field(ge=0.0, le=1e9)] = 0.0
    field: str = ""
    fault: Annotated[int, pydantic.Field(ge=0)] = 0


class _Entry(StrictModel, extra="ignore"):
    value: float


class _Values(StrictModel, extra="ignore"):
    top_speed: Annotated[_Entry, pydantic.Field(alias="drive.top_speed")]


class _Parameters(StrictModel, extra="ignore"):
    """The parameters of the rig that limit a command."""

    values: _Values


class Commands:
    """Passes commands from a bus to a rig; each command is sent to the rig once, whatever the result.

    Args:
        client: Transport to the rig.
        acknowledge: Sends an Acknowledge with these raw values.
        refuse_device: Reports to a device, by its number, that its frame was refused.
        timeout_s: Longest time for the rig to reply to a command [s].
        now: Clock [s].
        guard: Receives failures.
        table: Messages; by default those of the standard channel table.
    """

    def __init__(
        self,
        client: Client,
        acknowledge: Callable[..., None],
        refuse_device: Callable[[int], None],
        *,
        timeout_s: float,
        now: Callable[[], float] = time.monotonic,
        guard: Guard,
        table: MessageTable | None = None,
    ) -> None:
        self._client = client
        self._table = table
        self._acknowledge = acknowledge
        self._refuse_device = refuse_device
        self._timeout_s = timeout_s
        self._secret = secrets.token_hex(16)
        """Secret of all devices on this bus: only frames can end their blocks or remove them."""
        self._now = now
        self._guard = guard
        self._work = threading.Condition()
        self._stopping = False
        self._refusal_limit = Bucket(_MAX_REFUSALS_PER_S, _MAX_REFUSAL_BURST, now())
        self.waiting: deque[_PendingCommand] = deque()
        """Commands that wait for the rig."""
        self._announced: dict[int, tuple[int, str]] = {}
        """Checksum of a command that a device has announced, and its name, by the command's counter."""
        self.counter = 0
        """Counter of the last command that reached the rig."""
        self.accepted = 0
        """Number of commands that the rig accepted."""
        self.refused: Counter[str] = Counter()
        """Number of refused commands, by reason."""

    def close(self) -> None:
        """Send the waiting commands, then end `send_all`."""
        with self._work:
            self._stopping = True
            self._work.notify_all()

    def take_message(self, message: can.Message) -> None:
        """Process a frame from the bus, which may be a command."""
        if message.is_error_frame or message.is_remote_frame or message.is_extended_id or message.is_fd:
            return
        if message.is_rx and message.arbitration_id in IDENTIFIERS:
            self.take(message.arbitration_id, bytes(message.data))

    def take(self, identifier: int, data: bytes) -> None:
        """Process a classic data frame with the identifier of a command."""
        command = parse_command(identifier, data, self.counter, self._table)
        if isinstance(command, Result):
            self._refuse(command, None if len(data) < 2 else data[1])
            return
        if isinstance(command, Command):
            signature, device = self._announced.pop(command.counter, (-1, ""))
            device, ordered = device if signature == data[7] else "", signature == data[7]
        else:
            device, ordered = device_name(command.node), command.kind is DeviceKind.NOTE
            if command.kind is DeviceKind.COMMAND:
                self._announced[command.values["counter"]] = command.values["signature"], device
                return
        # A device's frame may have to wait for its earlier ones: its time begins when it is sent.
        deadline_s = math.inf if device else self._now() + self._timeout_s
        item = _PendingCommand(command, deadline_s, device, ordered)
        # A stop waits for earlier notes of the device that has announced it, and for nothing else.
        is_sent_at_once = command.kind is CommandKind.STOP and not ordered
        with self._work:
            if len(self.waiting) >= _MAX_PENDING:
                self._refuse(Result.BUSY, command)
                return
            if isinstance(command, Command):
                # The counter is used up whatever the rig replies, so that the same frame is not accepted twice.
                self.counter = command.counter
            item.started = is_sent_at_once
            self.waiting.append(item)
            self._work.notify_all()
        if is_sent_at_once:
            self._send_aside(item)

    def send_all(self) -> None:
        """Send one command after another to the rig, until `close`; a device's next one follows the reply to its last.

        Notes and commands of devices may have to wait for the `done` of another device, which must not wait for them.
        """
        while True:
            with self._work:
                item = self._find_next()
                if item is None:
                    if self._stopping and all(row.started for row in self.waiting):
                        return
                    self._work.wait(0.2)
                    continue
                item.started = True
                if item.device and not item.ordered:
                    item.deadline_s = self._now() + self._timeout_s
            if item.ordered:
                self._send_aside(item)
            else:
                self._guard(self._send, item)

    def _find_next(self) -> _PendingCommand | None:
        """Return the oldest command that is not sent, of a device without an earlier one in the list."""
        busy: set[str] = set()
        for row in self.waiting:
            if not row.started and row.device not in busy:
                return row
            busy.update([row.device] if row.device else [])
        return None

    def _send_aside(self, item: _PendingCommand) -> None:
        threading.Thread(target=self._guard, args=(self._send, item), name="can gateway waits", daemon=True).start()

    def _send(self, item: _PendingCommand) -> None:
        command = item.command
        secret = {"secret": self._secret} if "device" in command.values else {}  # join, done, leave
        request = wire.encode_document({"from": item.device if item.ordered else "CAN", **secret, **command.values})
        timeout_s = _ORDER_TIMEOUT_S if item.ordered else self._timeout_s
        try:
            key = wire.command_key(command.kind.name.lower())
            reply = check(_Reply, self._client.request(key, request, timeout_s=timeout_s), field="reply")
        except Exception as error:
            reply = None
            if not isinstance(error, (NoReplyError, ValueError)):
                self._guard.record_failure("sending a command to the rig", error)
        if not self._mark_answered(item):
            return
        if reply is None:
            self._refuse(Result.TIMED_OUT, command)
        elif isinstance(command, DeviceRequest):
            # The state of a device that the rig knows is reported by events.
            if not reply.accepted:
                self._refuse(Result.REFUSED, command)
        elif reply.accepted:
            self.accepted += 1
            self._acknowledge(
                counter=command.counter,
                result=Result.ACCEPTED,
                time=round(1e6 * reply.time_s) & 0xFFFFFFFF,
                limit=min(10 * reply.fault, 0xFFFF),
            )
        else:
            self._refuse_with_reason(reply, command)

    def _mark_answered(self, item: _PendingCommand) -> bool:
        """Remove a command from the list; return False if it was answered before."""
        with self._work:
            if item.answered:
                return False
            item.answered = True
            with contextlib.suppress(ValueError):
                self.waiting.remove(item)
            self._work.notify_all()
            return True

    def time_out(self) -> None:
        """Refuse commands to which the rig has not replied in time."""
        with self._work:
            late = [row for row in self.waiting if self._now() > row.deadline_s]
        for row in late:
            if self._mark_answered(row):
                self._refuse(Result.TIMED_OUT, row.command)

    def _refuse_with_reason(self, reply: _Reply, command: Command) -> None:
        """Refuse a command for the reason of the rig's check: the field, and the limit it exceeds."""
        name = reply.field.rpartition(".")[2]
        if name not in FIELDS or name not in command.values:
            self._refuse(Result.REFUSED, command)
            return
        low, high = LIMITS.get(name, (0.0, self._top_speed() if name == "speed_hz" else 0.0))
        limit = round(min(10 * (low if command.values[name] < low else high), 0xFFFF))
        self._refuse(Result.OUT_OF_RANGE, command, field=FIELDS[name], limit=limit)

    def _top_speed(self) -> float:
        """Return the drive's top speed from the rig's parameters [Hz]; 0 if it is unavailable."""
        with contextlib.suppress(NoReplyError, ValueError):
            document = self._client.request(wire.PARAMETERS, timeout_s=self._timeout_s)
            parameters = check(_Parameters, document, field="parameters", most_bytes=DOCUMENT_BYTES)
            return max(0.0, parameters.values.top_speed.value)
        return 0.0

    def _refuse(
        self, result: Result, what: Command | DeviceRequest | int | None, *, field: Field = Field.NONE, limit: int = 0
    ) -> None:
        """Count and report the refusal of a command, or of a frame with that counter."""
        self.refused[result.name.lower()] += 1
        if isinstance(what, DeviceRequest) and what.kind is DeviceKind.NOTE:
            return  # a refusal by DeviceState is that of a join
        if self._refusal_limit.count_tokens(self._now()) >= 1.0:
            # Limited, so that a flood of invalid frames does not cause a flood of replies.
            self._refusal_limit.remove_token()
            if isinstance(what, DeviceRequest):
                self._refuse_device(what.node)
                return
            counter = what.counter if isinstance(what, Command) else what or 0
            self._acknowledge(counter=counter, result=result, field=field, limit=limit)
