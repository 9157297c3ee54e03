"""Commands from frames: what comes from the bus is checked, asked of the rig, and acknowledged."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import pydantic

from drivers.can.devices import Said
from drivers.can.message import MessageTable
from drivers.can.signals import FIELDS, LIMITS, Command, Field, Kind, Result, default_messages, parse_command
from rig.base import wire
from rig.base.checks import DOCUMENT_BYTES, Outside, check
from rig.serve.health import Guard
from rig.serve.transport import Client, NoReplyError
from rig.serve.transport.limit import Bucket

if TYPE_CHECKING:
    import can

_PENDING = 16
"""Commands that may wait for the rig."""
IDENTIFIERS = [default_messages().by_name[name].identifier for name in ("Stop", "Command", "Fault", "Device")]
_REFUSALS_A_SECOND = 50.0
_REFUSALS_AT_ONCE = 20.0


@dataclass(slots=True)
class _Asked:
    """A command that waits for the rig."""

    command: Command | Said
    deadline_s: float
    answered: bool = False


class _Reply(Outside, extra="ignore"):
    """The rig's answer to a command: when it takes effect, or the field that is wrong."""

    accepted: bool
    time_s: Annotated[float, pydantic.Field(ge=0.0, le=1e9)] = 0.0
    field: str = ""
    fault: Annotated[int, pydantic.Field(ge=0)] = 0


class _Entry(Outside, extra="ignore"):
    value: float


class _Values(Outside, extra="ignore"):
    top_speed: Annotated[_Entry, pydantic.Field(alias="drive.top_speed")]


class _Parameters(Outside, extra="ignore"):
    """What of the rig's parameters limits a command."""

    values: _Values


class Commands:
    """Takes the commands of a bus to a rig; a command is asked once, whatever becomes of it.

    Args:
        client: Transport to the rig.
        acknowledge: Sends an acknowledge with these raw values.
        turn_down: Tells a device, by its number, that what it said was refused.
        timeout_s: How long the rig may take for a command [s].
        now: Clock [s].
        guard: Takes what fails.
        table: Messages; those of the rig's own channel table unless given.
    """

    def __init__(
        self,
        client: Client,
        acknowledge: Callable[..., None],
        turn_down: Callable[[int], None],
        *,
        timeout_s: float,
        now: Callable[[], float] = time.monotonic,
        guard: Guard,
        table: MessageTable | None = None,
    ) -> None:
        self._client = client
        self._table = table
        self._acknowledge = acknowledge
        self._turn_down = turn_down
        self._timeout_s = timeout_s
        self._now = now
        self._guard = guard
        self._work = threading.Condition()
        self._stopping = False
        self._answers = Bucket(_REFUSALS_A_SECOND, _REFUSALS_AT_ONCE, now())
        self.waiting: deque[_Asked] = deque()
        """Those that wait for the rig."""
        self.counter = 0
        """Counter of the last command that reached the rig."""
        self.accepted = 0
        """Commands that the rig took."""
        self.refused: Counter[str] = Counter()
        """Commands refused, by reason."""

    def close(self) -> None:
        """Ask for what still waits, then end `ask_all`."""
        with self._work:
            self._stopping = True
            self._work.notify_all()

    def take_message(self, message: can.Message) -> None:
        """A frame from the bus, which may be a command."""
        if message.is_error_frame or message.is_remote_frame or message.is_extended_id or message.is_fd:
            return
        if message.is_rx and message.arbitration_id in IDENTIFIERS:
            self.take(message.arbitration_id, bytes(message.data))

    def take(self, identifier: int, data: bytes) -> None:
        """A classic data frame with the identifier of a command."""
        command = parse_command(identifier, data, self.counter, self._table)
        if isinstance(command, Result):
            self._refuse(command, None if len(data) < 2 else data[1])
            return
        asked = _Asked(command, self._now() + self._timeout_s)
        with self._work:
            if len(self.waiting) >= _PENDING:
                self._refuse(Result.BUSY, command)
                return
            if isinstance(command, Command):
                # Used up, whatever the rig says: the same frame once more must not be taken.
                self.counter = command.counter
            self.waiting.append(asked)
            if command.kind is not Kind.STOP:
                self._work.notify_all()
        if command.kind is Kind.STOP:
            # A stop does not wait behind others.
            threading.Thread(target=self._guard, args=(self._ask, asked), name="can gateway stops", daemon=True).start()

    def ask_all(self) -> None:
        """Ask the rig for one command after another, until `close`."""
        while True:
            with self._work:
                waiting = [row for row in self.waiting if not row.answered and row.command.kind is not Kind.STOP]
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
            self._refuse(Result.TIMED_OUT, command)
        elif isinstance(command, Said):
            # What became of a device that the rig knows, events tell.
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
            self._refuse_for(reply, command)

    def _settle(self, asked: _Asked) -> bool:
        """Take a command off the list; False where it had been answered before."""
        with self._work:
            if asked.answered:
                return False
            asked.answered = True
            with contextlib.suppress(ValueError):
                self.waiting.remove(asked)
            return True

    def time_out(self) -> None:
        """Refuse commands that the rig has not answered in time."""
        with self._work:
            late = [row for row in self.waiting if self._now() > row.deadline_s]
        for row in late:
            if self._settle(row):
                self._refuse(Result.TIMED_OUT, row.command)

    def _refuse_for(self, reply: _Reply, command: Command) -> None:
        """Tell the bus what the rig's own check says: which field, and which limit it passed."""
        name = reply.field.rpartition(".")[2]
        if name not in FIELDS or name not in command.values:
            self._refuse(Result.REFUSED, command)
            return
        low, high = LIMITS.get(name, (0.0, self._top_speed() if name == "speed_hz" else 0.0))
        limit = round(min(10 * (low if command.values[name] < low else high), 0xFFFF))
        self._refuse(Result.OUT_OF_RANGE, command, field=FIELDS[name], limit=limit)

    def _top_speed(self) -> float:
        """The drive's highest speed, as the rig's parameters have it [Hz]; 0 where they do not tell."""
        with contextlib.suppress(NoReplyError, ValueError):
            document = self._client.request(wire.PARAMETERS, timeout_s=self._timeout_s)
            parameters = check(_Parameters, document, field="parameters", most_bytes=DOCUMENT_BYTES)
            return max(0.0, parameters.values.top_speed.value)
        return 0.0

    def _refuse(
        self, result: Result, what: Command | Said | int | None, *, field: Field = Field.NONE, limit: int = 0
    ) -> None:
        """Count and tell that a command, or a frame with that counter, was refused."""
        self.refused[result.name.lower()] += 1
        if self._answers.left(self._now()) >= 1.0:
            # A flood of nonsense must not become a flood of answers.
            self._answers.take()
            if isinstance(what, Said):
                self._turn_down(what.node)
                return
            counter = what.counter if isinstance(what, Command) else what or 0
            self._acknowledge(counter=counter, result=result, field=field, limit=limit)
