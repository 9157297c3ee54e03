"""Where a run is asked, commanded and reported to, be it a simulation that is served or a recording that is played.

All that clients say comes in here and is checked here: requests for documents are answered on the transport's threads,
commands wait for the thread that runs, which takes them between two blocks.
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
from rig.base.checks import LARGEST, Name, Outside, a_line, check, read_json
from rig.base.errors import InputError, RefusedError
from rig.base.text import printable
from rig.serve.transport import Server
from rig.serve.transport.clients import Clients
from rig.serve.transport.limit import CommandLimit
from rig.serve.waiting import BoundedQueue

REQUEST_BYTES = 10_000
_PENDING_COMMANDS = 256
_AT_ONCE = 64
"""Commands that are taken between two blocks: they take some ms."""
_TAKEN_BYTES = 500_000
"""What is told to latecomers of the commands so far."""
_KINDS = 100
"""Kinds of warnings that become events; the status shows the latest of the others too."""
_FIGURES = re.compile(r"\d+(\.\d+)?(e[-+]?\d+)?")


class Nothing(Outside):
    """A command without fields: `stop`, `pause`, `resume`."""


class Step(Outside):
    """How far a run in lockstep, or a replay that is paused, goes on."""

    ticks: Annotated[int, Field(gt=0, le=LARGEST)] | None = None
    blocks: Annotated[int, Field(gt=0, le=LARGEST)] | None = None


def _a_word(text: str) -> str:
    if " " in text:
        raise ValueError("a word")
    return text


class Note(Outside):
    """A line into every recording that is being made."""

    text: Annotated[str, a_line(1000)]
    tags: list[Annotated[str, a_line(40), AfterValidator(_a_word)]] = Field(default=[], max_length=10)


class Join(Outside):
    """A device under test: no block is run before it is done with the one before."""

    device: Name
    patience_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 10.0
    """How long it may take over a block, wall time [s]; a whole number will do."""


class Done(Outside):
    """A device has dealt with everything up to the end of a block."""

    device: Name
    tick: Annotated[int, Field(ge=0, le=LARGEST)] | None = None
    """Where that block ends, or:"""
    block: Annotated[int, Field(ge=0, le=LARGEST)] | None = None
    """its number."""

    @model_validator(mode="after")
    def _one_of_both(self) -> Done:
        if (self.tick is None) == (self.block is None):
            raise ValueError("told by a tick or by a block")
        return self


class Leave(Outside):
    """A device is waited for no longer."""

    device: Name


class Seek(Outside):
    """Another position of a replay."""

    time_s: float


class Rate(Outside):
    """Recorded seconds that a replay plays a second."""

    rate: float


REQUESTS: dict[str, type[Outside]] = {
    "stop": Nothing,
    "step": Step,
    "note": Note,
    "join": Join,
    "done": Done,
    "leave": Leave,
    "pause": Nothing,
    "resume": Nothing,
    "seek": Seek,
    "rate": Rate,
}
"""Commands that are about the run itself; what is done to the rig, the simulation checks (`rig.run.scenes`)."""


@dataclass(slots=True)
class Pending:
    """A command on its way from a transport's thread to the one that runs.

    Attributes:
        command: Its name.
        request: Its fields as they came, within the bounds of every document.
        asked: The same, checked, of those in `REQUESTS`.
        sender: What the sender calls itself.
        reply: Takes the payload of the answer.
    """

    command: str
    request: dict[str, Any]
    asked: Any
    sender: str
    reply: Future[bytes] = field(default_factory=Future)

    def answer(self, document: Mapping[str, Any]) -> None:
        """Reply with a document."""
        self.reply.set_result(wire.encode_document(dict(document)))

    def refuse(self, error: Exception) -> None:
        """Reply that the command was not taken, and why."""
        self.answer(refusal(error))


class Desk:
    """Answers what is asked of one run, until it is closed.

    Args:
        server: Transport; stays open.
        commands: Names of those that are taken.
        others: Commands that are known and refused here, each with the line that says so.
        running: What a command that comes too late should have been sent while, such as "the rig runs".
        wake: Makes the thread that runs look for commands.
        tell: Takes each new kind of trouble, on any thread, for an event.
        limit: How many commands a second are taken, without `step` and `done`, which wait for their turn, and `stop`.
    """

    def __init__(
        self,
        server: Server,
        *,
        commands: tuple[str, ...],
        others: Mapping[str, str],
        running: str,
        wake: Callable[[], None],
        tell: Callable[[str], None],
        limit: CommandLimit | None = None,
    ) -> None:
        self._server = server
        self._commands = commands
        self._others = others
        self._running = running
        self._wake = wake
        self._tell = tell
        self._limit = limit or CommandLimit()
        self._pending: BoundedQueue[Pending] = BoundedQueue(_PENDING_COMMANDS)
        self._lock = threading.Lock()
        self._ended = ""
        self._kinds: set[str] = set()
        self._troubles: dict[str, str] = {}
        self._passing: set[str] = set()
        """Kinds of warnings of the transports, which come and go."""
        self.clients = Clients()

    def open(self, documents: Mapping[str, Callable[[], dict[str, Any]]]) -> None:
        """Begin to answer, with these documents by key, and show the token."""
        self._server.on_trouble(self.trouble)
        for key, make in documents.items():
            self._server.answer(key, lambda _, make=make: wire.encode_document(make()))
        self._server.answer_all(wire.command_key("*"), self._on_command)
        self._server.hear(f"{wire.CLIENTS}/*", self.clients.take)
        self._server.announce()

    def _on_command(self, key: str, payload: bytes) -> bytes | Future[bytes]:
        """Hand a command to the thread that runs; answered there, or when the run ends."""
        name = key.removeprefix(wire.command_key(""))
        try:
            pending = self._parse(name, payload)
            if not self._pending.offer(pending):
                if self._ended:
                    raise InputError(name, f"sent while {self._running}", self._ended)
                raise InputError("commands", f"at most {_PENDING_COMMANDS} at a time", _PENDING_COMMANDS + 1)
        except InputError as error:
            return wire.encode_document(refusal(error))
        self._wake()
        return pending.reply

    def _parse(self, name: str, payload: bytes) -> Pending:
        if name in self._others:
            raise RefusedError(self._others[name])
        if name not in self._commands:
            raise InputError("command", f"one of {', '.join(self._commands)}", name)
        request = read_json(payload, field=name, most_bytes=REQUEST_BYTES)
        sender = check(_Signed, {"from": request.pop("from", "unknown")}, field="").sender
        if name not in ("step", "done", "stop"):
            self._limit.check(sender)
        model = REQUESTS.get(name)
        return Pending(name, request, None if model is None else check(model, request, field=name), sender)

    def taken(self) -> Iterator[Pending]:
        """The commands that have come, oldest first, as many as may be taken between two blocks."""
        for _ in range(_AT_ONCE):
            pending = self._pending.take(0.0)
            if pending is None:
                return
            yield pending
        self._wake()  # there may be more

    def close(self, ended: str, also: list[Pending]) -> None:
        """Refuse what is still waiting, and what comes later.

        Args:
            ended: What the command met instead of a run.
            also: Commands that were taken and cannot be done any more.
        """
        self._ended = ended
        self._pending.close()
        for pending in [*self._pending.take_many(_PENDING_COMMANDS), *also]:
            pending.refuse(InputError("command", f"sent while {self._running}", ended))

    def trouble(self, where: str, error: BaseException) -> None:
        """Something failed that must not end the run, on any thread: a warning, and an event for each new kind."""
        text = f"{where} failed: {type(error).__name__}: {one_line(error)}"
        with self._lock:
            known = where in self._troubles
            if known or len(self._troubles) < _KINDS:
                self._troubles[where] = text
        if not known:
            self.warn(text)

    def warn(self, text: str) -> None:
        """Tell a warning whose kind is new: one whose figures have moved on is not, and the status shows the latest."""
        kind = _FIGURES.sub("#", text)
        with self._lock:
            new = kind not in self._kinds and len(self._kinds) < _KINDS
            if new:
                self._kinds.add(kind)
        if new:
            self._tell(text)

    def warnings(self) -> list[str]:
        """What went wrong here, for the status."""
        told = getattr(self._server, "warnings", list)()
        kinds = {_FIGURES.sub("#", text) for text in told}
        with self._lock:
            # What has passed is told anew when it comes again.
            self._kinds -= self._passing - kinds
            self._passing = kinds
        for text in told:
            self.warn(text)
        warnings = [*self.troubles, *told]
        if self.clients.malformed:
            warnings.append(f"{self.clients.malformed} client reports could not be read")
        if self.clients.hidden:
            warnings.append(f"{self.clients.hidden} more clients report than are shown")
        return warnings

    @property
    def troubles(self) -> list[str]:
        """What failed, the latest of each place."""
        return list(self._troubles.values())


class Kept:
    """Commands that a run took, for latecomers, within bounds: the oldest go first, and are counted."""

    def __init__(self) -> None:
        self.told: dict[str, Any] = {"taken": ()}
        """For the scene document, from any thread: `taken`, and how many of these are `forgotten`."""
        self._bytes = 0

    def add(self, taken: dict[str, Any]) -> None:
        """Keep one more."""
        rows, forgotten = (*self.told["taken"], taken), self.told.get("forgotten", 0)
        self._bytes += _size(taken)
        while self._bytes > _TAKEN_BYTES:
            self._bytes -= _size(rows[0])
            rows, forgotten = rows[1:], forgotten + 1
        # A new one, as other threads read it.
        self.told = {"taken": rows, **({"forgotten": forgotten} if forgotten else {})}


def _size(taken: dict[str, Any]) -> int:
    return len(wire.encode_document(taken))


class _Signed(Outside):
    sender: Name = Field(alias="from")


def refusal(error: Exception) -> dict[str, Any]:
    """The reply to a command that was not taken: the line, and its parts where it names a field."""
    parts = {"field": error.field, "must": error.must} if type(error) is InputError else {}
    return {"accepted": False, "error": one_line(error), **parts}


def one_line(error: BaseException) -> str:
    """What an error says, without line breaks."""
    return " ".join(printable(str(error), 2000).split()) or type(error).__name__
