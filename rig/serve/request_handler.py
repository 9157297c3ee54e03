"""Request handling of a run, for a served simulation or a replayed recording.

All client messages arrive and are checked here. Requests for documents are answered on the transport's threads.
Commands wait for the run's thread, which takes them between two blocks.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator

from rig.base import wire
from rig.base.checks import MAX_INTEGER, Name, StrictModel, a_line, check, read_json
from rig.base.errors import InputError, RefusedError
from rig.base.text import printable
from rig.serve.devices import MAX_PATIENCE_S
from rig.serve.transport import Server
from rig.serve.transport.clients import Clients
from rig.serve.transport.limit import CommandLimit
from rig.serve.waiting import BoundedQueue

REQUEST_BYTES = 10_000
_PENDING_COMMANDS = 256
_MAX_COMMANDS_PER_BLOCK = 64
"""Commands taken between two blocks; they take some ms."""
_HISTORY_BYTES = 500_000
"""Size of the command history for late clients [bytes]."""
_MAX_KINDS = 100
"""Kinds of warnings that become events; the status shows the latest of further ones too."""
_FIGURES = re.compile(r"\d+(\.\d+)?(e[-+]?\d+)?")


class EmptyRequest(StrictModel):
    """A command without fields: `stop`, `pause`, `resume`."""


class StepRequest(StrictModel):
    """Length of a step of a lockstep run or a paused replay."""

    ticks: Annotated[int, Field(gt=0, le=MAX_INTEGER)] | None = None
    blocks: Annotated[int, Field(gt=0, le=MAX_INTEGER)] | None = None


def _check_word(text: str) -> str:
    if " " in text:
        raise ValueError("a word")
    return text


class NoteRequest(StrictModel):
    """A text line for all current recordings."""

    text: Annotated[str, a_line(1000)]
    tags: list[Annotated[str, a_line(40), AfterValidator(_check_word)]] = Field(default=[], max_length=10)


_Secret = Annotated[str, a_line(64)] | None
"""Secret that a device has chosen for its join; `done` and `leave` without it are from another client."""


class JoinRequest(StrictModel):
    """Registration of a device under test: each block waits until the device has finished the one before."""

    device: Name
    patience_s: Annotated[float, Field(gt=0.0, le=MAX_PATIENCE_S)] = 10.0
    """Time limit for the device per block, wall time [s]."""
    secret: _Secret = None


class DoneRequest(StrictModel):
    """Report that a device has finished a block."""

    device: Name
    tick: Annotated[int, Field(ge=0, le=MAX_INTEGER)] | None = None
    """End of the block; alternative to `block`."""
    block: Annotated[int, Field(ge=0, le=MAX_INTEGER)] | None = None
    """Number of the block; alternative to `tick`."""
    secret: _Secret = None

    @model_validator(mode="after")
    def _require_one(self) -> DoneRequest:
        if (self.tick is None) == (self.block is None):
            raise ValueError("given by either a tick or a block")
        return self


class LeaveRequest(StrictModel):
    """End of a device's registration."""

    device: Name
    secret: _Secret = None


class SeekRequest(StrictModel):
    """New position of a replay."""

    time_s: float


class RateRequest(StrictModel):
    """Speed of a replay: recorded over real time."""

    rate: float


REQUESTS: dict[str, type[StrictModel]] = {
    "stop": EmptyRequest,
    "step": StepRequest,
    "note": NoteRequest,
    "join": JoinRequest,
    "done": DoneRequest,
    "leave": LeaveRequest,
    "pause": EmptyRequest,
    "resume": EmptyRequest,
    "seek": SeekRequest,
    "rate": RateRequest,
}
"""Commands of the run itself; commands of the rig are checked by the simulation (`rig.run.scenes`)."""


@dataclass(slots=True)
class PendingCommand:
    """A command passed from a transport's thread to the run's thread.

    Attributes:
        command: Its name.
        request: Its fields as received, within the size limit of documents.
        arguments: The validated fields, for commands in `REQUESTS`.
        sender: Name in the sender's certificate; without one, the name that the sender gives itself.
        reply: Receives the payload of the reply.
    """

    command: str
    request: dict[str, Any]
    arguments: Any
    sender: str
    reply: Future[bytes] = field(default_factory=Future)

    def answer(self, document: Mapping[str, Any]) -> None:
        """Reply with a document."""
        self.reply.set_result(wire.encode_document(dict(document)))

    def refuse(self, error: Exception) -> None:
        """Reply that the command was refused, with the reason."""
        self.answer(refusal(error))


class RequestHandler:
    """Answers the requests to one run, until it is closed.

    Args:
        server: Transport; stays open.
        commands: Names of the accepted commands.
        unsupported: Known commands that are refused here, each with the error text.
        running: Condition for the error of a late command, such as "the rig runs".
        wake: Makes the run's thread check for commands.
        on_warning: Receives each new kind of failure for an event, on any thread.
        limit: Limit of commands per second, except `step` and `done`, which wait for their turn, and `stop`.
    """

    def __init__(
        self,
        server: Server,
        *,
        commands: tuple[str, ...],
        unsupported: Mapping[str, str],
        running: str,
        wake: Callable[[], None],
        on_warning: Callable[[str], None],
        limit: CommandLimit | None = None,
    ) -> None:
        self._server = server
        self._commands = commands
        self._unsupported = unsupported
        self._running = running
        self._wake = wake
        self._on_warning = on_warning
        self._limit = limit or CommandLimit()
        self._pending: BoundedQueue[PendingCommand] = BoundedQueue(_PENDING_COMMANDS)
        self._lock = threading.Lock()
        self._end_reason = ""
        self._kinds: set[str] = set()
        self._failures: dict[str, str] = {}
        self._transport_kinds: set[str] = set()
        """Kinds of the transports' current warnings."""
        self.clients = Clients()

    def open(self, documents: Mapping[str, Callable[[], dict[str, Any]]]) -> None:
        """Start answering, with these documents by key, and publish the token."""
        self._server.on_failure(self.record_failure)
        for key, build in documents.items():
            self._server.answer(key, lambda _, build=build: wire.encode_document(build()))
        for keys in ("*", "*/*"):  # the second: commands of devices with a certificate of their own
            self._server.answer_all(wire.command_key(keys), self._on_command)
        self._server.subscribe_reports(f"{wire.CLIENTS}/*", self.clients.take)
        self._server.announce()

    def _on_command(self, key: str, payload: bytes) -> bytes | Future[bytes]:
        """Queue a command for the run's thread, which answers it, at the latest when the run ends."""
        name, _, device = key.removeprefix(wire.command_key("")).partition("/")
        try:
            pending = self._parse(name, payload, device)
            if not self._pending.offer(pending):
                if self._end_reason:
                    raise InputError(name, f"sent while {self._running}", self._end_reason)
                raise InputError("commands", f"at most {_PENDING_COMMANDS} at a time", _PENDING_COMMANDS + 1)
        except InputError as error:
            return wire.encode_document(refusal(error))
        self._wake()
        return pending.reply

    def _parse(self, name: str, payload: bytes, device: str) -> PendingCommand:
        """Return a checked command; `device` is the name in the sender's certificate, empty without one."""
        if name in self._unsupported:
            raise RefusedError(self._unsupported[name])
        if name not in self._commands:
            raise InputError("command", f"one of {', '.join(self._commands)}", name)
        request = read_json(payload, field=name, most_bytes=REQUEST_BYTES)
        fields = {name: request.pop(name) for name in ("from", "rig") if name in request}
        origin = check(_Origin, fields | ({"from": device} if device else {}), field="")
        if origin.rig is not None and origin.rig not in self._server.identities:
            raise RefusedError(f"{name} was sent to another rig, which ran here before: connect again")
        sender = origin.sender
        if name not in ("step", "done", "stop"):
            self._limit.check(sender)
        model = REQUESTS.get(name)
        arguments = None if model is None else check(model, request, field=name)
        if device and (named := getattr(arguments, "device", device)) != device:
            raise InputError(f"{name}.device", f"{device}, the name in the certificate", named)
        return PendingCommand(name, request, arguments, sender)

    def take_commands(self) -> Iterator[PendingCommand]:
        """Yield the received commands, oldest first, up to the limit per block."""
        for _ in range(_MAX_COMMANDS_PER_BLOCK):
            pending = self._pending.take(0.0)
            if pending is None:
                return
            yield pending
        self._wake()  # there may be more

    def close(self, end_reason: str, accepted: list[PendingCommand]) -> None:
        """Refuse all waiting and later commands.

        Args:
            end_reason: Reason given to the sender.
            accepted: Accepted commands that can no longer be completed.
        """
        self._end_reason = end_reason
        self._pending.close()
        for pending in [*self._pending.take_many(_PENDING_COMMANDS), *accepted]:
            pending.refuse(InputError("command", f"sent while {self._running}", end_reason))

    def record_failure(self, where: str, error: BaseException) -> None:
        """Record a failure that must not end the run, from any thread: a warning, and an event for each new kind."""
        text = f"{where} failed: {type(error).__name__}: {one_line(error)}"
        with self._lock:
            is_known = where in self._failures
            if is_known or len(self._failures) < _MAX_KINDS:
                self._failures[where] = text
        if not is_known:
            self.warn(text)

    def warn(self, text: str) -> None:
        """Report a warning of a new kind; a text with other figures is the same kind, and only updates the status."""
        kind = _FIGURES.sub("#", text)
        with self._lock:
            is_new = kind not in self._kinds and len(self._kinds) < _MAX_KINDS
            if is_new:
                self._kinds.add(kind)
        if is_new:
            self._on_warning(text)

    def warnings(self) -> list[str]:
        """Return the warnings for the status."""
        server_warnings = getattr(self._server, "warnings", list)()
        kinds = {_FIGURES.sub("#", text) for text in server_warnings}
        with self._lock:
            # A warning that has disappeared is reported again when it returns.
            self._kinds -= self._transport_kinds - kinds
            self._transport_kinds = kinds
        for text in server_warnings:
            self.warn(text)
        warnings = [*self.failures, *server_warnings]
        if self.clients.malformed:
            warnings.append(f"{self.clients.malformed} client reports could not be read")
        if self.clients.hidden_count:
            warnings.append(f"{self.clients.hidden_count} more clients report than are shown")
        return warnings

    @property
    def failures(self) -> list[str]:
        """Failures, the latest of each place."""
        return list(self._failures.values())


class CommandHistory:
    """History of accepted commands for late clients; the oldest are removed at the size limit, and counted."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {"taken": ()}
        """Part of the scene document, readable from any thread: `taken`, and the number of `forgotten` commands."""
        self._bytes = 0

    def add(self, command: dict[str, Any]) -> None:
        """Add a command."""
        rows, forgotten = (*self.document["taken"], command), self.document.get("forgotten", 0)
        self._bytes += _size(command)
        while self._bytes > _HISTORY_BYTES:
            self._bytes -= _size(rows[0])
            rows, forgotten = rows[1:], forgotten + 1
        # A new object, as other threads read it.
        self.document = {"taken": rows, **({"forgotten": forgotten} if forgotten else {})}


def _size(command: dict[str, Any]) -> int:
    return len(wire.encode_document(command))


class _Origin(StrictModel):
    """Fields of every command: the sender, and the rig that it means."""

    sender: Annotated[Name, Field(alias="from")] = "unknown"
    rig: Annotated[str, a_line(64)] | None = None


def refusal(error: Exception) -> dict[str, Any]:
    """Return the reply to a refused command: the error line, and its parts if it names a field."""
    parts = {"field": error.field, "must": error.must} if type(error) is InputError else {}
    return {"accepted": False, "error": one_line(error), **parts}


def one_line(error: BaseException) -> str:
    """Return the text of an error without line breaks."""
    return " ".join(printable(str(error), 2000).split()) or type(error).__name__
