"""Transport between the service and its clients: a pair of protocols, and one module per transport.

A `Server` is the rig's side, a `Client` the other side. Payloads are the bytes of `rig.base.wire`; a transport does not
interpret them.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

DEFAULT_ENDPOINT = "127.0.0.1:7460"
"""Default address of a rig."""
EXPOSED_PORT = 7463
"""Default port of an exposed rig."""


class NoReplyError(ConnectionError):
    """No reply to a request in time: no rig runs there, or it hangs."""


class RigLostError(ConnectionError):
    """The rig was killed or restarted, or the link to it is lost; a restarted rig is another rig."""


class Server(Protocol):
    """The rig's side of a transport."""

    @property
    def identities(self) -> frozenset[str]:
        """Identities of this rig, one of which each client sees as `Client.rig`."""
        ...

    def publish(self, key: str, payload: bytes) -> None:
        """Send one payload to all subscribers. May be slow; must not be called from the simulation thread."""
        ...

    def answer(self, key: str, handler: Callable[[bytes], bytes]) -> None:
        """Answer requests on a key; the handler is called on the transport's threads."""
        ...

    def answer_all(self, expression: str, handler: Callable[[str, bytes], bytes | Future[bytes]]) -> None:
        """Answer requests on all matching keys by a handler of key and payload; the answer may come later."""
        ...

    def on_failure(self, callback: Callable[[str, BaseException], None]) -> None:
        """Set the function that receives place and error of failures on the transport's threads, which continue."""
        ...

    def subscribe_reports(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Receive the clients' reports on keys that match `key` (for example `rig/clients/*`)."""
        ...

    def announce(self) -> None:
        """Publish the rig's token; called once all requests can be answered."""
        ...

    def congestion(self) -> dict[str, float]:
        """Return counters that show stalled subscribers; their names depend on the transport."""
        ...

    def close(self) -> None:
        """Undeclare everything and close."""
        ...


class Client(Protocol):
    """A client's side of a transport."""

    foreign: int
    """Number of ignored messages from other rigs than the linked one."""

    @property
    def rig(self) -> str | None:
        """Identity of the linked rig, which changes with a restart; None without a link."""
        ...

    def subscribe(
        self,
        key: str,
        on_message: Callable[[str, bytes], None],
        *,
        on_miss: Callable[[str, int], None] | None = None,
        history: bool = False,
        lossless: bool = True,
    ) -> None:
        """Receive payloads in order.

        Args:
            key: A key, or an expression with `*` / `**`.
            on_message: Called with key and payload.
            on_miss: Called with key and number of messages that recovery could not bring back.
            history: Also fetch what the rig's cache still holds.
            lossless: Recover gaps from the rig's cache; False takes what arrives (viewers).
        """
        ...

    def request(self, key: str, payload: bytes = b"", *, timeout_s: float = 2.0) -> bytes:
        """Send a request to the rig and return its reply.

        Raises:
            NoReplyError: There was no answer in time.
        """
        ...

    def settle(self) -> None:
        """Wait until all subscriptions are in effect: whatever is published afterwards arrives."""
        ...

    def wait_for(self, key: str, number: int, *, timeout_s: float) -> bool:
        """Wait for the delivery of a message, by its number from 0; True at once for a key without subscription."""
        ...

    def watch(self, key: str, callback: Callable[[bool], None]) -> None:
        """Call back with True / False when the rig's token appears / disappears."""
        ...

    def report(self, key: str, payload: bytes) -> None:
        """Send one payload to the rig (client heartbeats)."""
        ...

    def close(self) -> None:
        """Undeclare everything and close."""
        ...


def get_transports(server: Server) -> dict[str, Server]:
    """Return the transports of a rig, by "zenoh" and "can"."""
    return getattr(server, "transports", {"zenoh": server})
