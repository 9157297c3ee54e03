"""Sources of the DAQ client's samples: the rig's own keys, or a CAN bus; one module each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from drivers.sources.samples import Samples


class Source(Protocol):
    """A set of streams, each with its own channels, that can be read at one common rate."""

    def streams(self) -> Mapping[str, Sequence[str]]:
        """Return the channels of each stream by name.

        Raises:
            ConnectionError: No rig replies.
        """
        ...

    def start(
        self,
        streams: Sequence[str],
        rate_hz: float | None,
        on_samples: Callable[[str, Samples], None],
        on_end: Callable[[str, str], None],
    ) -> float:
        """Start the streams, and return the sample rate [Hz].

        Args:
            streams: Names of the streams to start.
            rate_hz: Sample rate [Hz]; None for the highest rate that all these streams have.
            on_samples: Called with the name of a stream and its samples, on any thread; must not block.
            on_end: Called with the name of a stream and the reason for its end.

        Raises:
            InputError: The streams do not have this rate.
        """
        ...

    def report_position(self, index: int | None, *, room: int, lost: int) -> None:
        """Receive the position of the reader. Must not block; a source may ignore it.

        Args:
            index: Number of the row after the last one read; None if nothing has arrived yet.
            room: Number of rows that the reader can buffer after it.
            lost: Number of rows that never arrived.
        """
        ...

    def close(self) -> None:
        """Stop; further calls have no effect."""
        ...


def open_source(url: str, *, wait_s: float = 3.0) -> Source:
    """Open the source at a URL.

    Args:
        url: `127.0.0.1:7460` or `zenoh:127.0.0.1:7460`; `zenoh:lab.example:7463?tls=keys/viewer` for a rig served with
            TLS; the name of a rig on this computer; or `can:zenoh:can0`, with settings of python-can's bus as
            `?NAME=VALUE&...`.
        wait_s: Longest wait for a rig to reply [s].

    Raises:
        InputError: The URL is malformed.
        ConnectionError: No rig replies.
    """
    if url.startswith("can:"):
        from drivers.sources.can import CanSource

        return CanSource(url.removeprefix("can:"), wait_s=wait_s)
    from drivers.sources.rig import RigSource
    from rig.serve.transport.zenoh import connect_url

    client = connect_url(url, wait_s=wait_s)
    return RigSource(client, close=client.close)
