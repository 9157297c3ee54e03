"""One service on several transports."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future

from rig.serve.transport import Server


class Fanout:
    """The rig's side of several transports: publishes to all, and accepts requests and reports from each.

    Args:
        servers: The transports, in the order of publishing; the caller closes them.
        transports: The transports by name.
        figures: Returns further counters for the status, as `congestion` does.
        warnings: Returns further current warnings.
    """

    def __init__(
        self,
        servers: Sequence[Server],
        *,
        transports: Mapping[str, Server] | None = None,
        figures: Callable[[], dict[str, float]] | None = None,
        warnings: Callable[[], list[str]] = list,
    ) -> None:
        self._servers = tuple(servers)
        self.transports = dict(transports or {"zenoh": self._servers[0]})
        self.warnings = warnings
        self._figures = figures

    @property
    def identities(self) -> frozenset[str]:
        """Identities on all transports."""
        return frozenset().union(*(server.identities for server in self._servers))

    def publish(self, key: str, payload: bytes) -> None:
        """Send one payload to all subscribers of all transports."""
        for server in self._servers:
            server.publish(key, payload)

    def answer(self, key: str, handler: Callable[[bytes], bytes]) -> None:
        """Answer requests on a key on all transports."""
        for server in self._servers:
            server.answer(key, handler)

    def answer_all(self, expression: str, handler: Callable[[str, bytes], bytes | Future[bytes]]) -> None:
        """Answer requests on all keys that match on all transports."""
        for server in self._servers:
            server.answer_all(expression, handler)

    def on_failure(self, callback: Callable[[str, BaseException], None]) -> None:
        """Report failures on the threads of all transports."""
        for server in self._servers:
            server.on_failure(callback)

    def subscribe_reports(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Receive the reports of clients of all transports."""
        for server in self._servers:
            server.subscribe_reports(key, callback)

    def announce(self) -> None:
        """Publish the rig's token on all transports."""
        for server in self._servers:
            server.announce()

    def congestion(self) -> dict[str, float]:
        """Return the counters of all transports, and the further ones."""
        counts: dict[str, float] = {}
        for server in self._servers:
            counts |= server.congestion()
        return counts | (self._figures() if self._figures is not None else {})

    def close(self) -> None:
        """Close all transports."""
        for server in self._servers:
            server.close()
