"""Text that waits for a client that may be slow, and the node of a bus whose frames become that text."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import can

OpenBus = Callable[[], "can.BusABC"]
"""Makes one more node on a bus."""

ROOM = 1 << 17
"""Bytes that may wait for one client: about 3000 frames, 0.4 s of a full classic bus at 1 Mbit/s."""
PATIENCE_S = 10.0
"""How long a client for which text waits may take nothing before it is given up."""
SEND_S = 0.5
"""How long a client's frame may wait for room in its transmit queue."""

_READ = 4096
_POLL_S = 0.1
_IDLE_S = 0.05
_RETRY_S = 0.005
_AT_ONCE = 256
"""Frames that are written together."""


class Backlog:
    """Bytes that wait for a descriptor which does not block: bounded, and nobody ever waits here.

    Args:
        write: Writes some of the bytes without waiting and returns how many, as `os.write` does.
        room: Bytes that may wait.
        clock: Monotonic clock [s].
    """

    def __init__(
        self, write: Callable[[memoryview], int], *, room: int = ROOM, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._write = write
        self._room = room
        self._clock = clock
        self._lock = threading.Lock()
        self._bytes = bytearray()
        self._moved_s = 0.0
        self.gone = False
        """Whether there is nobody to write to any more."""

    @property
    def waiting(self) -> int:
        """Bytes that wait."""
        return len(self._bytes)

    @property
    def crowded(self) -> bool:
        """Whether there is no room: then no more should be asked for."""
        return len(self._bytes) >= self._room

    @property
    def stalled_s(self) -> float:
        """How long something has waited of which nothing moved [s]; 0 where nothing waits."""
        with self._lock:
            return self._clock() - self._moved_s if self._bytes else 0.0

    def put(self, text: bytes, *, always: bool = False) -> bool:
        """Add text as a whole; `flush` sends it.

        Args:
            text: What must not be torn apart.
            always: Keep it whether there is room or not: an answer, of which each costs its client a question.

        Returns:
            False where there is no room, and the text is dropped.
        """
        with self._lock:
            if not always and len(self._bytes) + len(text) > self._room:
                return False
            if not self._bytes:
                self._moved_s = self._clock()
            self._bytes += text
            return True

    def clear(self) -> None:
        """Forget what waits."""
        with self._lock:
            self._bytes.clear()

    def flush(self) -> None:
        """Write as much as is taken at once."""
        with self._lock:
            while self._bytes and not self.gone:
                try:
                    with memoryview(self._bytes) as view, view[: 1 << 16] as portion:
                        count = self._write(portion)
                except (BlockingIOError, InterruptedError):
                    return
                except OSError:
                    self.gone = True
                    return
                if not count:
                    return
                del self._bytes[:count]
                self._moved_s = self._clock()


class Tap:
    """A node of a bus, whose frames go into a backlog as text, on a thread of its own.

    Args:
        bus: The node; closed with the tap, by its thread.
        backlog: Where the text goes.
        show: Text of a frame, or None where the client is not to have it.
        overflow: What to tell the client of frames that found no room, when there is some again.
        tick: Called every now and then, at least every 0.1 s.
        on_lost: Called when the bus fails.
        name: Of the thread.
    """

    def __init__(
        self,
        bus: can.BusABC,
        backlog: Backlog,
        *,
        show: Callable[[can.Message], bytes | None],
        overflow: Callable[[], bytes] = lambda: b"",
        tick: Callable[[], None] = lambda: None,
        on_lost: Callable[[], None] = lambda: None,
        name: str,
    ) -> None:
        self.bus = bus
        self._backlog = backlog
        self._show = show
        self._overflow = overflow
        self._tick = tick
        self._closed = False
        self._on_lost = on_lost
        self._overflowed = False
        self.dropped = 0
        """Frames that found no room."""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def send(self, message: can.Message) -> None:
        """Send a frame; waits a little for room.

        Raises:
            CanError: The bus does not take it.
        """
        self.bus.send(message, timeout=SEND_S)

    def close(self) -> None:
        """Leave the bus."""
        self._closed = True
        self._thread.join(timeout=5.0)

    def _run(self) -> None:
        import can

        try:
            while not self._closed:
                message = self.bus.recv(_RETRY_S if self._backlog.waiting else _IDLE_S)
                count = 0
                while message is not None:
                    self._put(message)
                    count += 1
                    message = self.bus.recv(0) if count < _AT_ONCE else None
                self._tick()
                self._backlog.flush()
        except (can.CanError, OSError):
            self._on_lost()
        finally:
            with contextlib.suppress(can.CanError, OSError):
                self.bus.shutdown()

    def _put(self, message: can.Message) -> None:
        text = self._show(message)
        if text is None:
            return
        if self._overflowed:
            text = self._overflow() + text
        if self._backlog.put(text):
            self._overflowed = False
        else:
            self._overflowed = True
            self.dropped += 1


class Outlet:
    """One client at a descriptor: what it writes is taken on a thread of its own, what it does not read is bounded.

    Args:
        descriptor: Of a socket or terminal; must not block. Its owner closes it.
        name: Of the thread.
        room: Bytes that may wait for the client.
        patience_s: How long it may take nothing of what waits [s].
    """

    def __init__(self, descriptor: int, *, name: str, room: int = ROOM, patience_s: float = PATIENCE_S) -> None:
        self._descriptor = descriptor
        self._patience_s = patience_s
        self._backlog = Backlog(lambda data: os.write(descriptor, data), room=room)
        self._ending = False
        self.counts: Counter[str] = Counter()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    # What a kind of client provides.

    def _take(self, data: bytes) -> None:
        """What the client has written."""
        raise NotImplementedError

    def _give_up(self) -> None:
        """The client has taken nothing for too long."""
        raise NotImplementedError

    def _finish(self) -> None:
        """The thread ends."""
        raise NotImplementedError

    # Life.

    def start(self) -> None:
        """Serve the client from now on."""
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether it is being served."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Serve it no longer."""
        self._ending = True
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(timeout=6.0)

    def _answer(self, text: bytes) -> None:
        self._backlog.put(text, always=True)

    def _run(self) -> None:
        poll = select.poll()
        try:
            while not (self._ending or self._backlog.gone):
                # A client that asks and asks and reads nothing waits in its own buffers.
                events = 0 if self._backlog.crowded else select.POLLIN
                events |= select.POLLOUT if self._backlog.waiting else 0
                poll.register(self._descriptor, events)
                ready = poll.poll(_POLL_S * 1000)
                if ready and ready[0][1] & ~select.POLLOUT:
                    try:
                        data = os.read(self._descriptor, _READ)
                    except BlockingIOError:
                        continue
                    if not data:
                        return
                    self._take(data)
                self._backlog.flush()
                if self._backlog.stalled_s > self._patience_s:
                    self._give_up()
        except OSError:
            # The client has gone in the midst of it.
            pass
        finally:
            self._finish()
