"""Instruments over zenoh: a request is a query, data are published; the keys are `rig/instruments/NAME/...`."""

from __future__ import annotations

import threading
from collections.abc import Callable

from drivers.link import QUEUE_MESSAGES, Address, LinkClosedError, LinkTimeoutError
from drivers.link.port import Outbox, OutboxPort
from rig.serve.transport import NoReplyError, Server
from rig.serve.waiting import BoundedQueue, take_first

_ROOT = "rig/instruments"
_MAX_BYTES = 1 << 16


def request_key(name: str) -> str:
    """Return the key of an instrument's requests."""
    return f"{_ROOT}/{name}/request"


def data_key(name: str) -> str:
    """Return the key of an instrument's data."""
    return f"{_ROOT}/{name}/data"


class ZenohLink:
    """Host's end of a connection to one instrument.

    Args:
        endpoint: HOST:PORT where the instruments listen.
        address: The instrument.
        wait_s: Longest wait for the instruments [s].

    Raises:
        InputError: The endpoint is malformed.
        LinkClosedError: No instruments reply.
    """

    def __init__(self, endpoint: str, address: Address, *, wait_s: float = 1.0) -> None:
        from rig.serve.transport.endpoint import parse_endpoint
        from rig.serve.transport.zenoh import ZenohClient

        parse_endpoint(endpoint, field="zenoh")
        self._name = address.name
        self._endpoint = endpoint
        self._changed = threading.Condition()
        self._replies: BoundedQueue[bytes] = BoundedQueue(QUEUE_MESSAGES, changed=self._changed)
        # Never waits: a host that does not read loses the oldest data, and sees the gap in the row numbers.
        self._data: BoundedQueue[bytes] = BoundedQueue(QUEUE_MESSAGES, changed=self._changed)
        self._missed = 0
        self.max_bytes = _MAX_BYTES
        try:
            self._client = ZenohClient(endpoint, wait_s=wait_s)
            try:
                self._client.subscribe(data_key(address.name), self._take, on_miss=self._count_missed)
            except BaseException:
                self._client.close()
                raise
        except NoReplyError:
            raise LinkClosedError(
                f"no instruments reply at {endpoint}; start them with: rig twins (see rig twins --help)"
            ) from None

    @property
    def lost(self) -> int:
        """Messages that did not arrive, or found no space."""
        return self._missed + self._data.dropped

    def _take(self, _: str, payload: bytes) -> None:
        self._data.push(payload)

    def _count_missed(self, _: str, count: int) -> None:
        self._missed += count

    def send(self, message: bytes, *, timeout_s: float) -> None:
        """Send a request; when this returns, its reply can be received."""
        if self._replies.closed:
            raise LinkClosedError("the link is closed")
        try:
            reply = self._client.request(request_key(self._name), message, timeout_s=timeout_s)
        except NoReplyError:
            raise LinkTimeoutError(f"no {self._name} replies at {self._endpoint}") from None
        self._replies.push(reply)

    def receive(self, *, timeout_s: float) -> bytes | None:
        """Return the next reply, else the next data, or None if none arrived in time."""
        message = take_first(self._changed, (self._replies, self._data), timeout_s)
        if self._replies.closed:
            raise LinkClosedError("the link is closed")
        return message

    def close(self) -> None:
        """Close the connection."""
        with self._changed:
            if self._replies.closed:
                return
            self._replies.close()
        self._client.close()


class ZenohPort(OutboxPort):
    """Instrument's end of a connection, on a server that several instruments share.

    Args:
        server: Transport; its owner closes it.
        address: The instrument.
        url: URL for the host to open.
    """

    def __init__(self, server: Server, address: Address, url: str) -> None:
        self._server = server
        self._address = address
        super().__init__(Outbox(self._publish, f"{url} {address.name} publishes"), url, _MAX_BYTES)

    def serve(self, answer: Callable[[bytes], bytes], on_idle: Callable[[], None]) -> None:
        """Start to reply to requests."""
        self._outbox.start(on_idle)
        self._server.answer(request_key(self._address.name), answer)

    def _publish(self, message: bytes) -> bool:
        self._server.publish(data_key(self._address.name), message)
        return True

    def close(self) -> None:
        """Publish what waits, for at most FAREWELL_S; the server stays open."""
        self._outbox.close()
