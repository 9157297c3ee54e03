"""Where the DAQ client's samples come from: the rig's own keys, or a CAN bus, one module each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from drivers.sources.samples import Samples
from rig.base.errors import InputError

FORMS = "zenoh:HOST:PORT[?tls=DIR], the name of a rig, can:INTERFACE:CHANNEL[?NAME=VALUE&...]"


class Source(Protocol):
    """Streams of samples: each has some channels, all can be had at one rate."""

    def streams(self) -> Mapping[str, Sequence[str]]:
        """Names of the streams that there are, and the channels of each.

        Raises:
            ConnectionError: Nothing answers.
        """
        ...

    def start(
        self,
        streams: Sequence[str],
        rate_hz: float | None,
        on_samples: Callable[[str, Samples], None],
        on_end: Callable[[str, str], None],
    ) -> float:
        """Begin; returns the rate [Hz].

        Args:
            streams: Names of those that are wanted.
            rate_hz: Rows per second [Hz]; None is the fastest that all have.
            on_samples: Takes the name of a stream and its samples, on any thread; must not wait.
            on_end: Takes the name of a stream, and the reason for which no more comes.

        Raises:
            InputError: That rate cannot be had.
        """
        ...

    def taken(self, index: int | None, *, room: int, lost: int) -> None:
        """Take note of what was read; must not wait, and may be of no use.

        Args:
            index: Number of the row after the last that was read; None where nothing has come yet.
            room: How many rows find room beyond that.
            lost: How many never came.
        """
        ...

    def close(self) -> None:
        """End; may be called again."""
        ...


def open_source(url: str, *, wait_s: float = 3.0) -> Source:
    """The source at a URL.

    Args:
        url: `zenoh:127.0.0.1:7460`, `zenoh:lab.example:7463?tls=keys/viewer` for a rig that is exposed, the name of a
            rig of this machine, or `can:zenoh:can0` with settings of python-can's bus as `?NAME=VALUE&...`.
        wait_s: How long to wait for a rig to be there [s].

    Raises:
        InputError: The URL is malformed.
        ConnectionError: Nothing is there.
    """
    kind, colon, rest = url.partition(":")
    if (kind == "zenoh" and rest) or (url and not colon):
        from drivers.sources.rig import RigSource
        from rig.serve.transport.zenoh import client_of

        client = client_of(url, wait_s=wait_s)
        return RigSource(client, close=client.close)
    if kind == "can" and rest:
        from drivers.sources.can import CanSource

        return CanSource(rest, wait_s=wait_s)
    raise InputError("url", f"one of {FORMS}", url)
