"""What carries an instrument's messages: a link at the host's end, a port at the instrument's, one module a transport.

A message is whole or lost, never cut: what is made of bytes (a serial line) or of short frames (CAN) is put together
below. No module here looks inside a message; those are `drivers.instruments.common.protocol`'s.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from rig.base.errors import InputError

DEFAULT_ENDPOINT = "127.0.0.1:7462"
"""Where instruments on zenoh listen unless told otherwise."""
FORMS = "zenoh:HOST:PORT, pty:PATH, serial:PATH[@BAUD], can:INTERFACE:CHANNEL[?NAME=VALUE&...]"
ROOM = 500
"""Messages that wait at either end: at least 5 s of blocks of 10 ms."""
FAREWELL_S = 0.5
"""How long a port that is closed tries to send what waits."""


class LinkError(ConnectionError):
    """The bytes do not get through."""


class LinkTimeoutError(LinkError, TimeoutError):
    """Nothing came in time, or nothing could be sent in time."""


class LinkClosedError(LinkError):
    """The link was closed, by this end or the other."""


class Address(NamedTuple):
    """Where an instrument is found on a link that many share.

    Attributes:
        name: Name, which keys hold.
        number: Number of 1 to 31, which CAN identifiers hold.
    """

    name: str
    number: int


class Link(Protocol):
    """The host's end of the way to one instrument (and either end of a way that is the same from both)."""

    @property
    def max_bytes(self) -> int:
        """Length of the longest message [bytes]."""
        ...

    @property
    def lost(self) -> int:
        """Messages that were dropped or spoilt at this end."""
        ...

    def send(self, message: bytes, *, timeout_s: float) -> None:
        """Send one message.

        Raises:
            LinkTimeoutError: It was not taken in time.
            LinkClosedError: There is no other end any more.
        """
        ...

    def receive(self, *, timeout_s: float) -> bytes | None:
        """The next message, or None where none came in time.

        Raises:
            LinkClosedError: There is no other end any more, and nothing is left of what came before.
        """
        ...

    def close(self) -> None:
        """Close; may be called again."""
        ...


class Port(Protocol):
    """The instrument's end: answers requests, and pushes data."""

    @property
    def url(self) -> str:
        """What a host opens."""
        ...

    @property
    def max_bytes(self) -> int:
        """Length of the longest message [bytes]."""
        ...

    def serve(self, answer: Callable[[bytes], bytes], on_idle: Callable[[], None]) -> None:
        """Answer requests from now on.

        Args:
            answer: Makes the reply to a request; called for one request after another.
            on_idle: Called when all data that were pushed have left.
        """
        ...

    @property
    def idle(self) -> bool:
        """Whether all data that were pushed have left: what is pushed now leaves at once."""
        ...

    def push(self, message: bytes) -> bool:
        """Send data without waiting; False where there is no room and it was dropped."""
        ...

    def discard(self) -> None:
        """Forget data that wait to be sent."""
        ...

    def close(self) -> None:
        """Close; may be called again."""
        ...


def open_link(url: str, address: Address) -> Link:
    """The way to an instrument.

    Args:
        url: `zenoh:127.0.0.1:7462`, `pty:/dev/pts/3`, `serial:/dev/ttyUSB0@921600`, `can:socketcan:can0`, or, with
            settings of python-can's bus, `can:zenoh:can0?endpoint=127.0.0.1:7461`.
        address: The instrument among those that share a link.

    Raises:
        InputError: The text is none of that.
        LinkError: Nothing is there.
    """
    kind, colon, rest = url.partition(":")
    if not colon or not rest or kind not in ("zenoh", "pty", "serial", "can"):
        raise InputError("url", f"one of {FORMS}", url)
    if kind == "zenoh":
        from drivers.link.zenoh import ZenohLink

        return ZenohLink(rest, address)
    if kind == "can":
        from drivers.link.can import CanLink

        return CanLink(rest, address)
    from drivers.link.serial import open_serial

    return open_serial(rest, field=kind)
