"""Ports of an instrument: a queue of data before whatever sends them, and threads that answer and send."""

from __future__ import annotations

import threading
from collections.abc import Callable

from drivers.link import FAREWELL_S, ROOM, Link, LinkClosedError, LinkError
from rig.serve.waiting import BoundedQueue, take_first

_ROOM_BYTES = 1 << 20
"""About 3 s of four channels at 20 kHz."""
_SLICE_S = 0.2
_PATIENCE_S = 1.0


class Outbox:
    """Data that wait, and the thread that sends them.

    Args:
        send: Sends one message; may take its time. Returns False where there is no other end any more.
        name: Of the thread.
        room: Bytes of data that wait; one message may be longer.
    """

    def __init__(self, send: Callable[[bytes], bool], name: str, *, room: int = _ROOM_BYTES) -> None:
        self._send = send
        self._changed = threading.Condition()
        self._replies: BoundedQueue[bytes] = BoundedQueue(ROOM, changed=self._changed)
        self._data: BoundedQueue[bytes] = BoundedQueue(
            room, size=lambda message: min(len(message), room), changed=self._changed
        )
        self._busy = False
        self._on_idle: Callable[[], None] = lambda: None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self, on_idle: Callable[[], None]) -> None:
        """Begin to send."""
        self._on_idle = on_idle
        self._thread.start()

    @property
    def idle(self) -> bool:
        """Whether nothing waits and nothing is being sent."""
        return not (self._data or self._busy)

    def push(self, message: bytes) -> bool:
        """Queue data; False where the queue is full."""
        return self._data.offer(message)

    def reply(self, message: bytes) -> None:
        """Queue a reply, which goes before all data; waits while many wait."""
        # A host that asks and asks and takes no answer waits here, not in our memory.
        self._replies.put(message)

    def discard(self) -> None:
        """Forget data that wait."""
        self._data.clear()

    def _run(self) -> None:
        while True:
            with self._changed:
                message = take_first(self._changed, (self._replies, self._data))
                if message is None or self._data.closed:
                    return
                self._busy = True
            there = False
            try:
                there = self._send(message)
            finally:
                with self._changed:
                    self._busy = False
                    self._changed.notify_all()
                    if not there:
                        self._end()
            if self.idle:
                self._on_idle()

    def _end(self) -> None:
        self._replies.close()
        self._data.close()

    def close(self, *, before_join: Callable[[], None] = lambda: None) -> None:
        """Send what waits, if that is soon done; then end the thread.

        Args:
            before_join: Ends a send that takes its time.
        """
        with self._changed:
            if self._thread.is_alive() and self._thread is not threading.current_thread():
                self._changed.wait_for(lambda: self._data.closed or (self.idle and not self._replies), FAREWELL_S)
            self._end()
        before_join()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)


class OutboxPort:
    """What ports have in common that queue their data in an outbox.

    Args:
        outbox: Sends it.
        url: What a host opens.
        max_bytes: Length of the longest message [bytes].
    """

    def __init__(self, outbox: Outbox, url: str, max_bytes: int) -> None:
        self._outbox, self.url, self.max_bytes = outbox, url, max_bytes

    @property
    def idle(self) -> bool:
        """Whether what is pushed now leaves at once."""
        return self._outbox.idle

    def push(self, message: bytes) -> bool:
        """Queue data; False where the queue is full."""
        return self._outbox.push(message)

    def discard(self) -> None:
        """Forget data that wait to be sent."""
        self._outbox.discard()


class MessagePort(OutboxPort):
    """A port on a link that is the same from both ends (memory, serial line, CAN).

    Args:
        link: This end; closed with the port.
        url: What a host opens.
        room: Bytes of data that wait to be sent.
    """

    def __init__(self, link: Link, url: str, *, room: int = _ROOM_BYTES) -> None:
        self._link = link
        super().__init__(Outbox(self._send, f"{url} sends", room=room), url, link.max_bytes)
        self._closed = False
        self._thread: threading.Thread | None = None
        self.unsent = 0
        """Messages that the link did not take in time."""

    def serve(self, answer: Callable[[bytes], bytes], on_idle: Callable[[], None]) -> None:
        """Answer requests from now on."""
        self._outbox.start(on_idle)
        self._thread = threading.Thread(target=self._answer, args=(answer,), name=f"{self.url} answers", daemon=True)
        self._thread.start()

    def _answer(self, answer: Callable[[bytes], bytes]) -> None:
        while not self._closed:
            try:
                message = self._link.receive(timeout_s=_SLICE_S)
            except LinkError:
                return
            if message is not None:
                self._outbox.reply(answer(message))

    def _send(self, message: bytes) -> bool:
        try:
            self._link.send(message, timeout_s=_PATIENCE_S)
        except LinkClosedError:
            return False
        except LinkError:
            # Nobody listens, or too slowly: the gap shows in the numbers of the rows.
            self.unsent += 1
        return True

    def close(self) -> None:
        """Send what waits, if that is soon done; then close the link and end both threads."""
        self._closed = True
        self._outbox.close(before_join=self._link.close)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)
