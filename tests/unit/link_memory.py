"""A link inside one process: two ends, each with a bounded queue."""

from __future__ import annotations

from drivers.link import QUEUE_MESSAGES, LinkClosedError, LinkTimeoutError
from rig.serve.waiting import BoundedQueue

_MAX_BYTES = 1 << 16


class MemoryLink:
    """One end of a pair; see `pair`."""

    def __init__(self, inbox: BoundedQueue[bytes], outbox: BoundedQueue[bytes]) -> None:
        self._inbox = inbox
        self._outbox = outbox
        self._closed = False
        self.max_bytes = _MAX_BYTES
        self.lost = 0

    def send(self, message: bytes, *, timeout_s: float) -> None:
        """Put a message into the other end's queue, as soon as it has room."""
        if not self._outbox.put(message, timeout_s):
            self._check()
            raise LinkTimeoutError(f"the other end took nothing for {timeout_s:g} s")

    def receive(self, *, timeout_s: float) -> bytes | None:
        """Return the next message, or None after the timeout."""
        message = None if self._closed else self._inbox.take(timeout_s)
        if message is None or self._closed:
            self._check()
        return message

    def _check(self) -> None:
        if self._inbox.closed or self._outbox.closed:
            raise LinkClosedError("the link is closed" if self._closed else "the other end has closed the link")

    def close(self) -> None:
        """Close; the other end notices."""
        self._closed = True
        self._inbox.close()
        self._outbox.close()


def make_pair(*, room: int = QUEUE_MESSAGES) -> tuple[MemoryLink, MemoryLink]:
    """Return two ends of one link.

    Args:
        room: Capacity of the queue at each end [messages].
    """
    down, up = BoundedQueue[bytes](room), BoundedQueue[bytes](room)
    return MemoryLink(up, down), MemoryLink(down, up)
