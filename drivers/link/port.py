"""Ports of an instrument: a queue of data to send, and threads that reply and send."""

from __future__ import annotations

import threading
from collections.abc import Callable

from drivers.link import FLUSH_TIMEOUT_S, QUEUE_MESSAGES, Link, LinkClosedError, LinkError
from rig.serve.waiting import BoundedQueue, take_first

_QUEUE_BYTES = 1 << 20
"""About 3 s of four channels at 20 kHz."""
_POLL_S = 0.2
_SEND_TIMEOUT_S = 1.0


class Outbox:
    """Queues of replies and data, and the thread that sends them.

    Args:
        send: Sends one message, and may block. Returns False if the other end has disconnected.
        name: Name of the thread.
        room: Capacity for data [bytes]; a single message may be longer.
    """

    def __init__(self, send: Callable[[bytes], bool], name: str, *, room: int = _QUEUE_BYTES) -> None:
        self._send = send
        self._changed = threading.Condition()
        self._replies: BoundedQueue[bytes] = BoundedQueue(QUEUE_MESSAGES, changed=self._changed)
        self._data: BoundedQueue[bytes] = BoundedQueue(
            room, size=lambda message: min(len(message), room), changed=self._changed
        )
        self._is_sending = False
        self._on_idle: Callable[[], None] = lambda: None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self, on_idle: Callable[[], None]) -> None:
        """Start to send."""
        self._on_idle = on_idle
        self._thread.start()

    @property
    def idle(self) -> bool:
        """Whether no data are waiting or being sent."""
        return not (self._data or self._is_sending)

    def push(self, message: bytes) -> bool:
        """Queue data; return False if the queue is full."""
        return self._data.offer(message)

    def reply(self, message: bytes) -> None:
        """Queue a reply, which is sent before all data; wait while the queue is full."""
        # A host that sends requests and reads no replies must wait here instead of filling the memory.
        self._replies.put(message)

    def discard(self) -> None:
        """Discard waiting data."""
        self._data.clear()

    def _run(self) -> None:
        while True:
            with self._changed:
                message = take_first(self._changed, (self._replies, self._data))
                if message is None or self._data.closed:
                    return
                self._is_sending = True
            is_connected = False
            try:
                is_connected = self._send(message)
            finally:
                with self._changed:
                    self._is_sending = False
                    self._changed.notify_all()
                    if not is_connected:
                        self._end()
            if self.idle:
                self._on_idle()

    def _end(self) -> None:
        self._replies.close()
        self._data.close()

    def close(self, *, before_join: Callable[[], None] = lambda: None) -> None:
        """Send what waits, for at most FAREWELL_S; then end the thread.

        Args:
            before_join: Ends a send that blocks.
        """
        with self._changed:
            if self._thread.is_alive() and self._thread is not threading.current_thread():
                self._changed.wait_for(lambda: self._data.closed or (self.idle and not self._replies), FLUSH_TIMEOUT_S)
            self._end()
        before_join()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)


class OutboxPort:
    """Base of ports that queue their data in an outbox.

    Args:
        outbox: Sends the data.
        url: URL for the host to open.
        max_bytes: Length of the longest message [bytes].
    """

    def __init__(self, outbox: Outbox, url: str, max_bytes: int) -> None:
        self._outbox, self.url, self.max_bytes = outbox, url, max_bytes

    @property
    def idle(self) -> bool:
        """Whether data pushed now are sent at once."""
        return self._outbox.idle

    def push(self, message: bytes) -> bool:
        """Queue data; return False if the queue is full."""
        return self._outbox.push(message)

    def discard(self) -> None:
        """Discard data that wait to be sent."""
        self._outbox.discard()


class MessagePort(OutboxPort):
    """Port on a symmetric link (memory, serial line, CAN).

    Args:
        link: This end; closed with the port.
        url: URL for the host to open.
        room: Capacity for data that wait to be sent [bytes].
    """

    def __init__(self, link: Link, url: str, *, room: int = _QUEUE_BYTES) -> None:
        self._link = link
        super().__init__(Outbox(self._send, f"{url} sends", room=room), url, link.max_bytes)
        self._closed = False
        self._thread: threading.Thread | None = None
        self.unsent = 0
        """Messages that the link did not accept in time."""

    def serve(self, answer: Callable[[bytes], bytes], on_idle: Callable[[], None]) -> None:
        """Start to reply to requests."""
        self._outbox.start(on_idle)
        self._thread = threading.Thread(target=self._answer, args=(answer,), name=f"{self.url} answers", daemon=True)
        self._thread.start()

    def _answer(self, answer: Callable[[bytes], bytes]) -> None:
        while not self._closed:
            try:
                message = self._link.receive(timeout_s=_POLL_S)
            except LinkError:
                return
            if message is not None:
                self._outbox.reply(answer(message))

    def _send(self, message: bytes) -> bool:
        try:
            self._link.send(message, timeout_s=_SEND_TIMEOUT_S)
        except LinkClosedError:
            return False
        except LinkError:
            # The host is absent or too slow: the gap shows in the row numbers.
            self.unsent += 1
        return True

    def close(self) -> None:
        """Send what waits, for at most FAREWELL_S; then close the link and end both threads."""
        self._closed = True
        self._outbox.close(before_join=self._link.close)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)
