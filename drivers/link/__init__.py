"""Transports of instrument messages: links at the host's end, ports at the instrument's; a module for each.

A message arrives complete or is lost, never cut: this package assembles what is sent as bytes (serial line) or as short
frames (CAN). No module here reads the content of a message; that is done by `drivers.instruments.common.protocol`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from rig.base.errors import InputError

DEFAULT_ENDPOINT = "127.0.0.1:7462"
"""Default address of instruments on zenoh."""
FORMS = "zenoh:HOST:PORT, pty:PATH, serial:PATH[@BAUD], can:INTERFACE:CHANNEL[?NAME=VALUE&...]"
QUEUE_MESSAGES = 500
"""Messages that wait at either end: at least 5 s of 10 ms blocks."""
FLUSH_TIMEOUT_S = 0.5
"""Longest time for which a port that is closed continues to send waiting data [s]."""


class LinkError(ConnectionError):
    """The connection to an instrument failed."""


class LinkTimeoutError(LinkError, TimeoutError):
    """No message arrived, or none could be sent, in time."""


class LinkClosedError(LinkError):
    """The link was closed by this end or the other."""


class Address(NamedTuple):
    """Address of an instrument on a link that several share.

    Attributes:
        name: Name, part of the keys.
        number: Number from 1 to 31, part of the CAN identifiers.
    """

    name: str
    number: int


class Link(Protocol):
    """Host's end of a connection to one instrument, or either end of a symmetric connection."""

    @property
    def max_bytes(self) -> int:
        """Length of the longest message [bytes]."""
        ...

    @property
    def lost(self) -> int:
        """Messages that were dropped or corrupted at this end."""
        ...

    def send(self, message: bytes, *, timeout_s: float) -> None:
        """Send one message.

        Args:
            message: At most `max_bytes` long.
            timeout_s: Longest wait for the connection to accept it [s].

        Raises:
            LinkTimeoutError: The message was not accepted in time.
            LinkClosedError: The link is closed, or the other end has disconnected.
        """
        ...

    def receive(self, *, timeout_s: float) -> bytes | None:
        """Return the next message, or None if none arrived in time.

        Raises:
            LinkClosedError: The link is closed, or the other end has disconnected and all messages were read.
        """
        ...

    def close(self) -> None:
        """Close the link; further calls have no effect."""
        ...


class Port(Protocol):
    """Instrument's end of a connection: replies to requests and pushes data."""

    @property
    def url(self) -> str:
        """URL for the host to open."""
        ...

    @property
    def max_bytes(self) -> int:
        """Length of the longest message [bytes]."""
        ...

    def serve(self, answer: Callable[[bytes], bytes], on_idle: Callable[[], None]) -> None:
        """Start to reply to requests.

        Args:
            answer: Returns the reply to a request; called for one request after another.
            on_idle: Called when all pushed data have been sent.
        """
        ...

    @property
    def idle(self) -> bool:
        """Whether all pushed data have been sent, so that new data are sent at once."""
        ...

    def push(self, message: bytes) -> bool:
        """Queue data without waiting; return False if the queue is full and the data were dropped."""
        ...

    def discard(self) -> None:
        """Discard data that wait to be sent."""
        ...

    def close(self) -> None:
        """Close the port; further calls have no effect."""
        ...


def open_link(url: str, address: Address) -> Link:
    """Open the link to an instrument.

    Args:
        url: `zenoh:127.0.0.1:7462`, `pty:/dev/pts/3`, `serial:/dev/ttyUSB0@921600`, `can:socketcan:can0`, or, with
            settings of python-can's bus, `can:zenoh:can0?endpoint=127.0.0.1:7461`.
        address: The instrument, on a link that several share.

    Raises:
        InputError: The URL has none of these forms.
        LinkError: No instrument replies.
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
