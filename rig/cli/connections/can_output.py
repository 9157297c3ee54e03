"""`rig run --can` and `rig replay --can`: the rig as a node of a CAN bus, in addition to its own transport."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from rig.base.errors import InputError, Words
from rig.cli.groups import panel
from rig.cli.output.progress import reporting

if TYPE_CHECKING:
    import can

    from drivers.can.bus.hub import Hub
    from drivers.can.bus.outlets.outlet import OpenBus
    from drivers.can.bus.timing import Speed
    from drivers.can.gateway import Gateway
    from drivers.can.schedule import Schedule
    from rig.channels.table import ChannelTable
    from rig.cli.connections.can_outlets import CanOutlets
    from rig.serve.transport import Server

_can = panel("CAN")


@dataclass(frozen=True)
class CanMessages:
    """Frames that carry the samples, their rate, and the bit rates."""

    can_rate: Annotated[int | None, _can("Sample rate in Hz; default: 1000 classic, 10000 FD", metavar="HZ")] = None
    can_classic: Annotated[bool, _can("Send samples in classic frames (default)", "--can-classic")] = False
    can_fd: Annotated[bool, _can("Send samples as counts in CAN FD frames", "--can-fd")] = False
    can_bitrate: Annotated[
        str | None,
        _can("Bit rate, and CAN FD data bit rate; default: 1M, 1M/8M", metavar="RATE[/RATE]"),
    ] = None

    def plan(self, channels: ChannelTable | None = None) -> tuple[Schedule, Speed]:
        """Return the schedule of the messages and the bit rates.

        Args:
            channels: Channels to send; by default the rig's own.

        Raises:
            InputError: A rate is invalid, or a channel has no message.
        """
        from drivers.can.schedule import schedule_from
        from drivers.can.signals import messages_for

        table = None if channels is None else messages_for(channels)
        schedule = schedule_from(classic=self.can_classic, fd=self.can_fd, rate_hz=self.can_rate, table=table)
        usual = "1M" if schedule.fd_hz is None else "1M/8M"
        return schedule, bit_rates(self.can_bitrate or usual, field="--can-bitrate")


@dataclass(frozen=True)
class CanOptions:
    """The CAN bus that the rig joins, if any, and its settings."""

    can: Annotated[
        str | None,
        _can(
            "Join a CAN bus: zenoh:can0 (starts a hub), virtual:rig, socketcan:vcan0, slcan:/dev/pts/3; "
            "more python-can settings as ?NAME=VALUE&...",
            metavar="INTERFACE:CHANNEL",
        ),
    ] = None
    messages: CanMessages = CanMessages()
    can_overload: Annotated[
        bool,
        _can(
            "Run even if the bus is overloaded; frames are dropped, counted",
            "--can-overload",
        ),
    ] = False
    can_socketcand: Annotated[
        str | None,
        _can("Serve socketcand here (classic frames), e.g. 127.0.0.1:29536", metavar="HOST:PORT"),
    ] = None
    can_slcan: Annotated[bool, _can("Open a pseudo-terminal that acts as an SLCAN adapter", "--can-slcan")] = False

    def output(self, channels: ChannelTable | None) -> CanOutput | None:
        """Return the CAN output for these channels, or None without --can; see `CanOutput`.

        Raises:
            InputError: The bus is invalid, or options of the bus are given without --can.
        """
        if self.can is not None:
            return CanOutput(self.can, self, channels)
        if self != CanOptions():
            raise InputError("--can", "given with the other --can options", None)
        return None


_SHARED = ("zenoh", "virtual", "socketcan")
"""Interfaces that allow several nodes in one process."""


class CanOutput:
    """A CAN bus as an additional transport of the rig.

    Args:
        spec: INTERFACE:CHANNEL, with ?NAME=VALUE&... for more of python-can's settings.
        options: Settings of the rig's node.
        channels: Channels of the rig; by default the rig's own.

    Raises:
        InputError: The bus is invalid, or cannot carry the messages.
    """

    def __init__(self, spec: str, options: CanOptions | None = None, channels: ChannelTable | None = None) -> None:
        options = options or CanOptions()
        socketcand, slcan = options.can_socketcand, options.can_slcan
        from rig.serve.transport.endpoint import parse_loopback
        from rig.serve.transport.memory import MemoryServer

        self.interface, self.channel, self._settings = parse_spec(spec)
        # Check all addresses before anything is opened.
        if socketcand is not None:
            parse_loopback(socketcand, field="--can-socketcand")
        if self.interface == "zenoh" and "endpoint" in self._settings:
            parse_loopback(str(self._settings["endpoint"]), field="--can")
        self.schedule, self.speed = options.messages.plan(channels)
        if channels is not None:
            from drivers.can.gateway.samples import find_decimations

            find_decimations(channels, self.schedule)
        if options.can_overload:
            self.load = self.schedule.load(self.speed)
        else:
            self.load = self.schedule.check(self.speed)
        if self.interface == "slcan" and self.schedule.fd_hz is not None:
            raise InputError("--can", "an interface that has CAN FD", spec)
        if (socketcand is not None or slcan) and self.interface not in _SHARED:
            must = f"on {', '.join(_SHARED[:-1])} or {_SHARED[-1]} with --can-socketcand and --can-slcan"
            raise InputError("--can", must, spec)
        self._outlet_settings: dict[str, Any] = {"socketcand": socketcand, "slcan": slcan}
        self._outlets: CanOutlets | None = None
        self._open_more: OpenBus | None = None
        self._memory = MemoryServer(cache=0)
        self._gateway: Gateway | None = None
        self._hub: Hub | None = None
        self._stack = ExitStack()
        self._bus: can.BusABC | None = None

    def __enter__(self) -> CanOutput:
        with ExitStack() as stack:
            with reporting(compiles=True):
                self._bus = stack.enter_context(self._open())
            stack.callback(self._memory.close)
            if self._outlet_settings["socketcand"] is not None or self._outlet_settings["slcan"]:
                from rig.cli.connections.can_outlets import CanOutlets

                assert self._open_more is not None
                buses = {self.channel: self._open_more}
                self._outlets = stack.enter_context(CanOutlets(buses, self.speed, **self._outlet_settings))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def join_server(self, server: Server) -> Server:
        """Return a server that serves both the rig's transport and the bus."""
        from rig.serve.transport.fanout import Fanout

        transports: dict[str, Server] = {"zenoh": server, "can": self._memory}
        return Fanout([*transports.values()], transports=transports, figures=self._figures, warnings=self._warnings)

    def start(self, *, paced: bool) -> None:
        """Start the gateway; call it once the rig answers requests.

        Args:
            paced: The rig runs by the wall clock.
        """
        from drivers.can.gateway import Gateway
        from rig.serve.transport.memory import MemoryClient

        assert self._bus is not None
        client = MemoryClient(self._memory)
        gateway = Gateway(client, self._bus, self.schedule, paced=paced, load=self.load)
        self._gateway = self._stack.enter_context(gateway)

    def summary(self) -> str:
        """Return the counters of the bus in a line."""
        counts = self._figures()
        reasons = ", ".join(
            f"{name.removeprefix('can_refused_').replace('_', ' ')} {count:g}"
            for name, count in counts.items()
            if name.startswith("can_refused_")
        )
        return (
            f"CAN: {counts['can_frames']:g} frames sent, {counts['can_dropped']:g} dropped, commands accepted "
            f"{counts['can_accepted']:g}, refused {counts['can_refused']:g}" + (f" ({reasons})" if reasons else "")
        ) + "".join(f"\n{line}" for line in (self._outlets.summary() if self._outlets is not None else []))

    def __str__(self) -> str:
        rates = [("classic", self.schedule.classic_hz), ("FD", self.schedule.fd_hz)]
        sent = " and ".join(f"{rate} Hz in {name} frames" for name, rate in rates if rate is not None)
        return (
            f"CAN {self.interface}:{self.channel} at {self.speed}, all channels at {sent}; "
            f"load at most {100 * self.load:.1f} %"
        ) + "".join(
            f"\nrig: {line}"
            for line in (
                *(f"warning: {warning}" for warning in self.schedule.warnings(self.speed)),
                *(self._outlets.lines() if self._outlets is not None else []),
            )
        )

    def _figures(self) -> dict[str, float]:
        if self._gateway is None:
            return {}
        hub = {} if self._hub is None else {f"can_{name}": count for name, count in self._hub.figures().items()}
        outlets = {} if self._outlets is None else {"can_clients_dropped": self._outlets.dropped()}
        return {**self._gateway.figures(), **hub, **outlets}

    def _warnings(self) -> list[str]:
        return [
            text for part in (self._gateway, self._hub, self._outlets) if part is not None for text in part.warnings()
        ]

    @contextmanager
    def _open(self) -> Iterator[can.BusABC]:
        if self.interface == "zenoh":
            with self._with_hub() as bus:
                yield bus
            return
        import can

        settings: dict[str, Any] = dict(self._settings)
        if self.interface == "socketcan":
            settings.setdefault("fd", self.schedule.fd_hz is not None)
        elif self.interface != "virtual":
            settings.setdefault("bitrate", round(self.speed.nominal_bit_s))
        self._open_more = partial(can.Bus, interface=self.interface, channel=self.channel, **settings)
        try:
            bus = self._open_more()
        except (can.CanError, OSError, ValueError, TypeError) as error:
            raise InputError(
                "--can", "a bus that can be opened", Words(f"{self.interface}:{self.channel}: {error}")
            ) from None
        with bus:
            yield bus

    @contextmanager
    def _with_hub(self) -> Iterator[can.BusABC]:
        """Open the hub of a virtual bus in this process, and a node on it."""
        from drivers.can.bus import codec
        from drivers.can.bus.hub import Hub
        from drivers.can.bus.model import BusModel
        from drivers.can.interface import HubBus
        from rig.serve.transport.zenoh import ZenohServer

        settings = dict(self._settings)
        endpoint = str(settings.pop("endpoint", codec.DEFAULT_ENDPOINT))
        if settings:
            raise InputError("--can", "zenoh:CHANNEL, or zenoh:CHANNEL?endpoint=HOST:PORT", "&".join(settings))
        with (
            ZenohServer(endpoint) as server,
            Hub(BusModel(self.speed), self.channel, server) as hub,
            HubBus(hub) as bus,
        ):
            self._hub, self._open_more = hub, partial(HubBus, hub, in_order=True)
            yield bus


def bit_rates(text: str, *, field: str) -> Speed:
    """Return the bit rates of a bus from an option such as 1M/8M.

    Raises:
        InputError: A rate is invalid.
    """
    from drivers.can.bus.timing import speed

    try:
        return speed(text)
    except InputError as error:
        raise InputError(field, error.must, error.received) from None


def parse_spec(spec: str) -> tuple[str, str, dict[str, Any]]:
    """Return interface, channel and further settings of INTERFACE:CHANNEL?NAME=VALUE&...

    Raises:
        InputError: The text has another form.
    """
    from drivers.link.can import parse_spec as parse

    try:
        return parse(spec)
    except InputError:
        must = "INTERFACE:CHANNEL such as zenoh:can0, with ?NAME=VALUE&... for more settings"
        raise InputError("--can", must, spec) from None
