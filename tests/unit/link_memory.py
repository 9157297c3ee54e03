"""A link inside one process: two ends, each with a bounded queue."""

from __future__ import annotations

import threading
import time
from collections import deque

from drivers.link import ROOM, LinkClosedError, LinkTimeoutError

_MAX_BYTES = 1 << 16


class MemoryLink:
    """One end of a pair; see `pair`."""

    def __init__(self, changed: threading.Condition, room: int) -> None:
        self._changed = changed
        self._room = room
        self._inbox: deque[bytes] = deque()
        self._other: MemoryLink = self
        self._closed = False
        self.max_bytes = _MAX_BYTES
        self.lost = 0

    def send(self, message: bytes, *, timeout_s: float) -> None:
        """Put a message into the other end's queue, when it has room."""
        other, deadline = self._other, time.monotonic() + timeout_s
        with self._changed:
            while len(other._inbox) >= other._room and not (self._closed or other._closed):
                if (left := deadline - time.monotonic()) <= 0:
                    raise LinkTimeoutError(f"the other end took nothing for {timeout_s:g} s")
                self._changed.wait(left)
            self._check()
            other._inbox.append(message)
            self._changed.notify_all()

    def receive(self, *, timeout_s: float) -> bytes | None:
        """The next message, or None where none came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._inbox or self._closed or self._other._closed, timeout_s)
            if self._inbox and not self._closed:
                self._changed.notify_all()
                return self._inbox.popleft()
            self._check()
            return None

    def _check(self) -> None:
        if self._closed or self._other._closed:
            raise LinkClosedError("the link is closed" if self._closed else "the other end has closed the link")

    def close(self) -> None:
        """Close; the other end notices."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


def pair(*, room: int = ROOM) -> tuple[MemoryLink, MemoryLink]:
    """Two ends of one link.

    Args:
        room: Number of messages that wait at each end.
    """
    changed = threading.Condition()
    one, other = MemoryLink(changed, room), MemoryLink(changed, room)
    one._other, other._other = other, one
    return one, other
