"""CAN access for programs without zenoh: a socketcand server, and pseudo-terminals that act as SLCAN adapters."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drivers.can.bus.outlets.outlet import OpenBus
    from drivers.can.bus.outlets.slcan import SlcanPort
    from drivers.can.bus.outlets.socketcand import SocketcandServer
    from drivers.can.bus.timing import Speed


class CanOutlets:
    """The outlets of the CAN buses.

    Args:
        buses: Functions that create a node, by bus.
        speed: Bit rates of the buses.
        socketcand: HOST:PORT of a server for all buses; None: no server.
        slcan: Open a pseudo-terminal with an SLCAN adapter for each bus.

    Raises:
        InputError: The server's address is invalid or in use.
    """

    def __init__(
        self,
        buses: Mapping[str, OpenBus],
        speed: Speed,
        *,
        socketcand: str | None = None,
        slcan: bool = False,
    ) -> None:
        self._server: SocketcandServer | None = None
        self._ports: dict[str, SlcanPort] = {}
        self._stack = ExitStack()
        with ExitStack() as stack:
            if socketcand is not None:
                from drivers.can.bus.outlets.socketcand import SocketcandServer
                from rig.serve.transport.endpoint import parse_loopback

                host, port = parse_loopback(socketcand, field="socketcand")
                self._server = stack.enter_context(SocketcandServer(buses, host=host, port=port))
            if slcan:
                from drivers.can.bus.outlets.slcan import SlcanPort

                for name, open_bus in buses.items():
                    self._ports[name] = stack.enter_context(SlcanPort(open_bus, speed=speed))
            self._stack = stack.pop_all()

    def __enter__(self) -> CanOutlets:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def lines(self) -> list[str]:
        """Return the address of each outlet in a line."""
        lines = [f"CAN {name} as an SLCAN adapter on {port.path}" for name, port in self._ports.items()]
        if self._server is not None:
            lines.append(f"CAN by socketcand on {self._server.host}:{self._server.port}, classic frames only")
        return lines

    def warnings(self) -> list[str]:
        """Return the current warnings."""
        outlets = [*self._ports.values(), *([] if self._server is None else [self._server])]
        return [text for outlet in outlets for text in outlet.warnings()]

    def dropped(self) -> int:
        """Return the number of frames dropped because clients read too slowly."""
        ports = sum(port.counts["dropped"] for port in self._ports.values())
        return ports + (0 if self._server is None else self._server.counts()["dropped"])

    def summary(self) -> list[str]:
        """Return the counters of each outlet in a line."""
        counters = {f"slcan {port.path}": port.figures() for port in self._ports.values()}
        if self._server is not None:
            counters["socketcand"] = self._server.counts()
        return [
            "  ".join([name, *(f"{what.replace('_', ' ')} {count}" for what, count in counts.items() if count)])
            for name, counts in counters.items()
            if any(counts.values())
        ]
