"""In-process transport, for tests: each call completes before it returns, on the caller's thread."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future

from rig.base.files import Closing
from rig.serve.transport import NoReplyError


def key_matches(expression: str, key: str) -> bool:
    """Return whether a key matches an expression: `*` is one chunk, `**` any number of chunks."""

    def match(pattern: list[str], chunks: list[str]) -> bool:
        if not pattern:
            return not chunks
        if pattern[0] == "**":
            return any(match(pattern[1:], chunks[n:]) for n in range(len(chunks) + 1))
        return bool(chunks) and pattern[0] in ("*", chunks[0]) and match(pattern[1:], chunks[1:])

    return match(expression.split("/"), key.split("/"))


Subscription = tuple[str, Callable[[str, bytes], None], "MemoryClient"]
"""Expression of the keys, callback of key and payload, and owner."""


class MemoryServer(Closing):
    """The rig's side; `MemoryClient(server)` creates a client.

    Args:
        cache: Number of messages kept for subscribers that ask for history.
    """

    def __init__(self, *, cache: int = 100_000) -> None:
        self._lock = threading.RLock()
        self._cache: deque[tuple[str, bytes]] = deque(maxlen=cache)
        self._subscriptions: list[Subscription] = []
        self._watchers: list[tuple[MemoryClient, Callable[[bool], None]]] = []
        self._handlers: dict[str, Callable[[str, bytes], bytes | Future[bytes]]] = {}
        self._listeners: list[tuple[str, Callable[[str, bytes], None]]] = []
        self._announced = False
        self._closed = False

    @property
    def identities(self) -> frozenset[str]:
        """Identity of this server."""
        return frozenset({f"{id(self):x}"})

    def publish(self, key: str, payload: bytes) -> None:
        """Deliver one payload to all subscribers, in the order of their subscriptions."""
        with self._lock:
            self._cache.append((key, payload))
            matching = [take for expression, take, _ in self._subscriptions if key_matches(expression, key)]
            # Delivery under the lock keeps each subscriber's messages in order; the lock is re-entrant for callbacks
            # that send a request to the rig.
            for take in matching:
                take(key, payload)

    def answer(self, key: str, handler: Callable[[bytes], bytes]) -> None:
        """Answer requests on a key; the handler is called on the client's thread."""
        self.answer_all(key, lambda _, payload: handler(payload))

    def answer_all(self, expression: str, handler: Callable[[str, bytes], bytes | Future[bytes]]) -> None:
        """Answer requests on all keys that match; the handler is called on the client's thread."""
        with self._lock:
            self._handlers[expression] = handler

    def on_failure(self, callback: Callable[[str, BaseException], None]) -> None:
        """Ignore the function: without threads, failures reach the caller."""

    def subscribe_reports(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Receive the clients' reports on matching keys."""
        with self._lock:
            self._listeners.append((key, callback))

    def announce(self) -> None:
        """Publish the rig's token."""
        with self._lock:
            self._announced = True
            watchers = list(self._watchers)
        for _, callback in watchers:
            callback(True)

    # ---- for its clients ----

    def subscribe(self, subscription: Subscription, *, history: bool) -> None:
        """Add a subscription, and deliver the earlier payloads if `history`."""
        expression, take, _ = subscription
        with self._lock:
            for key, payload in list(self._cache) if history else ():
                if key_matches(expression, key):
                    take(key, payload)
            self._subscriptions.append(subscription)

    def handler_of(self, key: str) -> Callable[[str, bytes], bytes | Future[bytes]] | None:
        """Return the handler of requests on a key."""
        with self._lock:
            return next((take for expression, take in self._handlers.items() if key_matches(expression, key)), None)

    def watch(self, watcher: MemoryClient, callback: Callable[[bool], None]) -> None:
        """Call back when the token appears or disappears."""
        with self._lock:
            self._watchers.append((watcher, callback))
            announced = self._announced and not self._closed
        if announced:
            callback(True)

    def take_report(self, key: str, payload: bytes) -> None:
        """Deliver a client's report."""
        with self._lock:
            listeners = list(self._listeners)
        for expression, callback in listeners:
            if key_matches(expression, key):
                callback(key, payload)

    def forget(self, client: MemoryClient) -> None:
        """Remove a client's subscriptions and watches."""
        with self._lock:
            self._subscriptions = [row for row in self._subscriptions if row[2] is not client]
            self._watchers = [row for row in self._watchers if row[0] is not client]

    # ---- for the rig ----

    def congestion(self) -> dict[str, float]:
        """Return no counters: messages arrive before `publish` returns."""
        return {}

    def close(self) -> None:
        """Remove all subscribers and notify the watchers."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            watchers = list(self._watchers) if self._announced else []
            self._handlers.clear()
            self._subscriptions.clear()
            self._listeners.clear()
            self._watchers.clear()
        for _, callback in watchers:
            callback(False)


class MemoryClient(Closing):
    """A client's side of a `MemoryServer` in the same process."""

    foreign = 0

    def __init__(self, server: MemoryServer) -> None:
        self._server = server
        (self.rig,) = server.identities

    def subscribe(
        self,
        key: str,
        on_message: Callable[[str, bytes], None],
        *,
        on_miss: Callable[[str, int], None] | None = None,
        history: bool = False,
        lossless: bool = True,
    ) -> None:
        """Receive payloads in order; nothing is missed here, so `on_miss` and `lossless` have no effect."""
        self._server.subscribe((key, on_message, self), history=history)

    def request(self, key: str, payload: bytes = b"", *, timeout_s: float = 2.0) -> bytes:
        """Send a request to the rig and return its reply.

        Raises:
            NoReplyError: The key has no handler.
        """
        handler = self._server.handler_of(key)
        if handler is None:
            raise NoReplyError(f"no rig answers {key} in this process")
        reply = handler(key, payload)
        return reply.result() if isinstance(reply, Future) else reply

    def settle(self) -> None:
        """Return at once: nothing is in flight."""

    def wait_for(self, key: str, number: int, *, timeout_s: float) -> bool:
        """Return True: a message is delivered when it is published."""
        return True

    def watch(self, key: str, callback: Callable[[bool], None]) -> None:
        """Call back with True / False when the rig's token appears / disappears."""
        self._server.watch(self, callback)

    def report(self, key: str, payload: bytes) -> None:
        """Send one payload to the rig."""
        self._server.take_report(key, payload)

    def close(self) -> None:
        """Remove this client's subscriptions and watches."""
        self._server.forget(self)
