"""How the service and its clients reach each other: one pair of protocols, one module a transport.

A `Server` is the rig's side, a `Client` is everybody else's. Payloads are the bytes of `rig.base.wire`; a transport
never looks inside.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

DEFAULT_ENDPOINT = "127.0.0.1:7460"
"""Where a rig listens, and clients look for one, unless told otherwise."""
EXPOSED_PORT = 7463
"""Port of a rig on a host that it is exposed on, unless told otherwise."""


class NoReplyError(ConnectionError):
    """Nobody answered a request in time: no rig runs there, or it hangs."""


class Server(Protocol):
    """The rig's side of a transport."""

    def publish(self, key: str, payload: bytes) -> None:
        """Send one payload to all subscribers; may be slow, must never be called from the simulation thread."""
        ...

    def answer(self, key: str, handler: Callable[[bytes], bytes]) -> None:
        """Answer requests on a key; the handler is called on the transport's threads."""
        ...

    def answer_all(self, expression: str, handler: Callable[[str, bytes], bytes | Future[bytes]]) -> None:
        """Answer requests on all keys that match, told key and payload; an answer may come later."""
        ...

    def on_trouble(self, tell: Callable[[str, BaseException], None]) -> None:
        """Tell where and why something failed on the transport's threads, which go on."""
        ...

    def hear(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Receive what clients report on keys that match `key` (for instance `rig/clients/*`)."""
        ...

    def announce(self) -> None:
        """Show the rig's token to those who watch; called once everything is ready to be asked."""
        ...

    def congestion(self) -> dict[str, float]:
        """What a stalled subscriber looks like from here; the names of the counts are the transport's own."""
        ...

    def close(self) -> None:
        """Undeclare everything and close."""
        ...


class Client(Protocol):
    """A client's side of a transport."""

    foreign: int
    """Messages that were left out because they were not from the rig that this client is linked to."""

    @property
    def rig(self) -> str | None:
        """Who the rig at the other end of the link is; another one when it is started again. None without a link."""
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
        """Ask the rig and return its reply.

        Raises:
            NoReplyError: Nobody answered in time.
        """
        ...

    def settle(self) -> None:
        """Return when all subscriptions so far are in effect: what is published from then on arrives."""
        ...

    def wait_for(self, key: str, number: int, *, timeout_s: float) -> bool:
        """Wait until a message was handed on, by its number from 0 on; True at once of a key that is not subscribed."""
        ...

    def watch(self, key: str, callback: Callable[[bool], None]) -> None:
        """Call back with True / False when the rig's token appears / vanishes."""
        ...

    def report(self, key: str, payload: bytes) -> None:
        """Send one payload to the rig (client heartbeats)."""
        ...

    def close(self) -> None:
        """Undeclare everything and close."""
        ...


def doors_of(server: Server) -> dict[str, Server]:
    """The ways out of a rig, "zenoh" and "can", each with its transport."""
    return getattr(server, "doors", {"zenoh": server})
