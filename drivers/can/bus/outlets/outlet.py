"""Base of a text client of a bus: one thread reads from the client, another writes complete messages to it."""

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
from rig.serve.health import Guard, IncreaseWarning

if TYPE_CHECKING:
    import can

OpenBus = Callable[[], "can.BusABC"]
"""Function that opens a new node on a bus."""

ROOM = 3000
"""Largest number of messages that wait for one client: 0.4 s of a full classic bus at 1 Mbit/s."""
PATIENCE_S = 10.0
"""Longest time for which a client may read nothing of waiting text before it is given up [s]."""

_SEND_S = 0.5
"""Longest wait of a client's frame for room in its transmit queue [s]."""
_READ_BYTES = 4096
_WRITE_BYTES = 1024
"""Bytes that are written together: a client that reads as many at a time receives complete messages while it keeps up.
"""
_POLL_S = 0.1
_FLUSH_TIMEOUT_S = 1.0


def make_message(identifier: int, data: bytes, *, length: int, extended: bool, remote: bool, **fd: bool) -> can.Message:
    """Build a frame from a client's values.

    Raises:
        CodecError: No controller can send it, for the reason in the message.
    """
    import can

    message = can.Message(
        arbitration_id=identifier,
        is_extended_id=extended,
        is_remote_frame=remote,
        dlc=length,
        data=None if remote else data,
        **fd,
    )
    codec.make_offer(message)
    return message


class Outlet:
    """One client at a file descriptor, with at most one node of a bus at a time.

    The queue for the client is bounded, messages are never torn, and no other client waits for it: frames without room
    are dropped and counted, and nothing more is read from a client that sends requests and reads no replies.

    Args:
        descriptor: File descriptor of a socket or terminal, non-blocking; its owner closes it.
        name: Name in warnings.
        room: Largest number of messages that wait for the client.
        patience_s: Longest time for which it may read nothing of waiting text [s].
    """

    def __init__(self, descriptor: int, *, name: str, room: int = ROOM, patience_s: float = PATIENCE_S) -> None:
        self._descriptor = descriptor
        self._name = name
        self._patience_s = patience_s
        self._room = room
        self._changed = threading.Condition()
        self._messages: deque[bytes] = deque()
        self._rest = b""
        """Text that is being written."""
        self.bus: can.BusABC | None = None
        self._receiver: threading.Thread | None = None
        self._ending = False
        self._stalled = False
        self._guard = Guard(name)
        self._dropping = IncreaseWarning(f"{name}: " + "{} frames were dropped: the client does not read them in time")
        self.counts: Counter[str] = Counter()
        self._writer = threading.Thread(target=self._write_all, name=f"{name} writes", daemon=True)

    # ---- provided by the kind of client ----

    def _take(self, data: bytes) -> None:
        """Process data from the client."""
        raise NotImplementedError

    def show_frame(self, message: can.Message) -> bytes | None:
        """Return the text of a frame; None if it is not for the client."""
        raise NotImplementedError

    def _overflow(self) -> bytes:
        """Return the text that reports dropped frames to the client, once there is room again."""
        raise NotImplementedError

    def _tick(self) -> None:
        """Perform periodic work; called repeatedly while there is a bus."""

    def _lose(self) -> None:
        """Handle a failure of the bus."""

    def _give_up(self) -> None:
        """Give the client up: it has read nothing for too long, and the text that waited for it was discarded."""
        self._ending = True

    # ---- start and end ----

    def serve(self) -> None:
        """Serve the client until it disconnects, or until `stop`."""
        self._writer.start()
        try:
            while not self._ending:
                self._guard(self._read)
        finally:
            self._ending = True
            self._leave()
            self._writer.join()

    def stop(self) -> None:
        """Request the end, without waiting."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()

    def warnings(self) -> list[str]:
        """Return the current warnings for the operator."""
        return [*self._guard.warnings(), *self._dropping.warnings(self.counts["dropped"])]

    # ---- from the client ----

    def _read(self) -> None:
        if self._stalled:
            self._give_up()
            self._stalled = False
            self.counts["given_up"] += 1
        if not self._ready(select.POLLIN):
            return
        try:
            data = os.read(self._descriptor, _READ_BYTES)
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
        """Queue a reply to the client; wait for room."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._messages) < self._room or self._ending)
            self.put(text)

    # ---- to the client ----

    def put(self, text: bytes) -> bool:
        """Queue a message that must not be torn; return False if the queue is full."""
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
        last_write_s = time.monotonic()
        while True:
            with self._changed:
                if not self._rest:
                    last_write_s = time.monotonic()
                    self._changed.wait_for(lambda: self._messages or self._ending, _POLL_S)
                    while self._messages and (not self._rest or len(self._rest + self._messages[0]) <= _WRITE_BYTES):
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
                        last_write_s = time.monotonic()
                except OSError:
                    self._ending = True
                    self._forget()
            elif time.monotonic() - last_write_s > (_FLUSH_TIMEOUT_S if self._ending else self._patience_s):
                self._forget()
                self._stalled = True

    # ---- bus ----

    def _enter(self, bus: can.BusABC) -> None:
        """Receive from a bus from now on; it is shut down with the client."""
        self.bus = bus
        self._receiver = threading.Thread(
            target=self._receive, args=(bus,), name=f"receiver of {self._name}", daemon=True
        )
        self._receiver.start()

    def _leave(self) -> None:
        receiver, self.bus, self._receiver = self._receiver, None, None
        if receiver is not None:
            receiver.join(timeout=5.0)

    def _send(self, message: can.Message) -> None:
        """Send a frame, after a short wait for room; raises CanError if the bus does not accept it."""
        assert self.bus is not None
        self.bus.send(message, timeout=_SEND_S)

    def _receive(self, bus: can.BusABC) -> None:
        import can

        overflowed = False
        try:
            while self.bus is bus:
                message = bus.recv(_POLL_S / 2)
                self._guard(self._tick)
                text = None if message is None else self._guard(self.show_frame, message)
                if text is None:
                    continue
                overflowed = not self.put(self._overflow() + text if overflowed else text)
                self.counts["dropped"] += overflowed
        except Exception as error:
            if not isinstance(error, (can.CanError, OSError, ValueError)):
                self._guard.record_failure("receiving from the bus", error)
            self._lose()
        finally:
            self._guard(bus.shutdown)
