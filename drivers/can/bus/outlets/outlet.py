"""A client of a bus that speaks in text: what it writes is taken on one thread, and whole messages leave on another."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from drivers.can.bus import codec
from rig.serve.health import Guard, Rising

if TYPE_CHECKING:
    import can

OpenBus = Callable[[], "can.BusABC"]
"""Makes one more node on a bus."""

ROOM = 3000
"""Messages that may wait for one client: 0.4 s of a full classic bus at 1 Mbit/s."""
PATIENCE_S = 10.0
"""How long a client for which text waits may take nothing before it is given up."""

_SEND_S = 0.5
"""How long a client's frame may wait for room in its transmit queue."""
_READ = 4096
_WRITTEN = 1024
"""Bytes that are written together: a client that reads as many at a time meets whole messages while it keeps up."""
_POLL_S = 0.1
_PARTING_S = 1.0


def message_of(identifier: int, data: bytes, *, length: int, extended: bool, remote: bool, **kind: bool) -> can.Message:
    """A frame that a client has written.

    Raises:
        CodecError: No controller can send it; it says why.
    """
    import can

    message = can.Message(
        arbitration_id=identifier,
        is_extended_id=extended,
        is_remote_frame=remote,
        dlc=length,
        data=None if remote else data,
        **kind,
    )
    codec.offered(message)
    return message


class Outlet:
    """One client at a descriptor, with at most one node of a bus at a time.

    What waits for it is bounded, a message is never torn, and nobody ever waits for it: frames without room are
    dropped and counted, and of a client that asks and asks and reads nothing no more is read.

    Args:
        descriptor: Of a socket or terminal; must not block. Its owner closes it.
        name: What warnings call it.
        room: Messages that may wait for the client.
        patience_s: How long it may take nothing of what waits [s].
    """

    def __init__(self, descriptor: int, *, name: str, room: int = ROOM, patience_s: float = PATIENCE_S) -> None:
        self._descriptor = descriptor
        self._name = name
        self._patience_s = patience_s
        self._room = room
        self._changed = threading.Condition()
        self._messages: deque[bytes] = deque()
        self._rest = b""
        """What is being written."""
        self.bus: can.BusABC | None = None
        self._hearing: threading.Thread | None = None
        self._ending = False
        self._stalled = False
        self._guard = Guard(name)
        self._dropping = Rising(f"{name}: " + "{} frames were dropped: the client does not read them in time")
        self.counts: Counter[str] = Counter()
        self._writer = threading.Thread(target=self._write_all, name=f"{name} writes", daemon=True)

    # What a kind of client provides.

    def _take(self, data: bytes) -> None:
        """What the client has written."""
        raise NotImplementedError

    def show_frame(self, message: can.Message) -> bytes | None:
        """Text of a frame, or None where the client is not to have it."""
        raise NotImplementedError

    def _overflow(self) -> bytes:
        """What to tell the client of frames that found no room, when there is some again."""
        raise NotImplementedError

    def _tick(self) -> None:
        """Called every now and then while there is a bus."""

    def _lose(self) -> None:
        """The bus fails."""

    def _give_up(self) -> None:
        """The client has taken nothing for too long, and what waited for it was forgotten."""
        self._ending = True

    # Life.

    def serve(self) -> None:
        """Serve the client until it has gone, or `stop`."""
        self._writer.start()
        try:
            while not self._ending:
                self._guard(self._read)
        finally:
            self._ending = True
            self._leave()
            self._writer.join()

    def stop(self) -> None:
        """Begin to end, without waiting."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()

    def warnings(self) -> list[str]:
        """What a person should know of, while it is so."""
        return [*self._guard.warnings(), *self._dropping.warnings(self.counts["dropped"])]

    # From the client.

    def _read(self) -> None:
        if self._stalled:
            self._give_up()
            self._stalled = False
            self.counts["given_up"] += 1
        if not self._ready(select.POLLIN):
            return
        try:
            data = os.read(self._descriptor, _READ)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._take(data)
        else:
            self._ending = True

    def _ready(self, event: int) -> bool:
        poll = select.poll()
        poll.register(self._descriptor, event)
        return bool(poll.poll(_POLL_S * 1000))

    def _answer(self, text: bytes) -> None:
        """Put what each costs its client a question; waits for room."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._messages) < self._room or self._ending)
            self.put(text)

    # To the client.

    def put(self, text: bytes) -> bool:
        """Add a message that must not be torn; False where there is no room."""
        with self._changed:
            if len(self._messages) >= self._room:
                return False
            self._messages.append(text)
            self._changed.notify_all()
            return True

    def _forget(self) -> None:
        with self._changed:
            self._messages.clear()
            self._rest = b""
            self._changed.notify_all()

    def _write_all(self) -> None:
        moved_s = time.monotonic()
        while True:
            with self._changed:
                if not self._rest:
                    moved_s = time.monotonic()
                    self._changed.wait_for(lambda: self._messages or self._ending, _POLL_S)
                    while self._messages and (not self._rest or len(self._rest + self._messages[0]) <= _WRITTEN):
                        self._rest += self._messages.popleft()
                    self._changed.notify_all()
                if not self._rest:
                    if self._ending:
                        return
                    continue
            if self._ready(select.POLLOUT):
                try:
                    with self._changed, contextlib.suppress(BlockingIOError):
                        self._rest = self._rest[os.write(self._descriptor, self._rest) :]
                        moved_s = time.monotonic()
                except OSError:
                    self._ending = True
                    self._forget()
            elif time.monotonic() - moved_s > (_PARTING_S if self._ending else self._patience_s):
                self._forget()
                self._stalled = True

    # The bus.

    def _enter(self, bus: can.BusABC) -> None:
        """Hear a bus from now on, which is left and shut down with the client."""
        self.bus = bus
        self._hearing = threading.Thread(target=self._hear_all, args=(bus,), name=f"{self._name} hears", daemon=True)
        self._hearing.start()

    def _leave(self) -> None:
        hearing, self.bus, self._hearing = self._hearing, None, None
        if hearing is not None:
            hearing.join(timeout=5.0)

    def _send(self, message: can.Message) -> None:
        """Send a frame; waits a little for room. Raises CanError where the bus does not take it."""
        assert self.bus is not None
        self.bus.send(message, timeout=_SEND_S)

    def _hear_all(self, bus: can.BusABC) -> None:
        import can

        crowded = False
        try:
            while self.bus is bus:
                message = bus.recv(_POLL_S / 2)
                self._guard(self._tick)
                text = None if message is None else self._guard(self.show_frame, message)
                if text is None:
                    continue
                crowded = not self.put(self._overflow() + text if crowded else text)
                self.counts["dropped"] += crowded
        except Exception as error:
            if not isinstance(error, (can.CanError, OSError, ValueError)):
                self._guard.tell("hearing the bus", error)
            self._lose()
        finally:
            self._guard(bus.shutdown)
