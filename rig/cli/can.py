"""`rig can`: the virtual CAN bus."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from functools import partial
from typing import Annotated, Any

import typer

from rig.cli.can_messages import dbc, load
from rig.cli.progress import reporting
from rig.cli.signals import stopping_on_signals
from rig.cli.tables import echo

__all__ = ["can", "dbc", "hub", "load"]

LISTEN = "127.0.0.1:7461"
_SPEED = "1M/8M"


def can(context: typer.Context) -> None:
    """Run virtual CAN buses, and show what the rig sends on one."""
    if context.invoked_subcommand is None:
        echo(context.get_help())


def hub(
    channels: Annotated[list[str], typer.Argument(metavar="CHANNEL...", help="Names of the buses, such as can0.")],
    *,
    speed: Annotated[
        str, typer.Option(metavar="RATE[/RATE]", help="Bit rate, and that of the data phase of CAN FD: 500k, 1M/8M.")
    ] = _SPEED,
    listen: Annotated[str, typer.Option(metavar="HOST:PORT", help="Where to listen.")] = LISTEN,
    socketcand: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT", help="Also serve socketcand clients (classic frames), usually at 127.0.0.1:29536."
        ),
    ] = None,
    slcan: Annotated[
        bool, typer.Option("--slcan", help="Also play an SLCAN adapter on a port of its own for each bus.")
    ] = False,
    acknowledge: Annotated[
        bool, typer.Option(help="Acknowledge frames, so that an only node on the bus can send.")
    ] = True,
    error_rate: Annotated[float, typer.Option(metavar="SHARE", help="Share of bits that arrive wrong.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Seed of the wrong bits.")] = 0,
) -> None:
    """Run virtual CAN buses of their own, without a rig, until Ctrl-C.

    Programs reach one by python-can: can.Bus(interface="zenoh", channel="can0"), or can_logger -i zenoh -c can0.
    """
    from drivers.can.bus.hub import Hub
    from drivers.can.bus.model import BusModel
    from drivers.can.interface import HubBus
    from rig.cli.can_outlets import CanOutlets
    from rig.cli.can_output import bit_rates
    from rig.errors import InputError
    from rig.transport.endpoint import parse_loopback
    from rig.transport.zenoh import ZenohServer

    parse_loopback(listen, field="--listen")
    if len(set(channels)) < len(channels):
        raise InputError("CHANNEL", "named once each", " ".join(channels))
    rates = bit_rates(speed, field="--speed")
    models = [BusModel(rates, error_rate=error_rate, seed=seed + number) for number in range(len(channels))]
    with ZenohServer(listen) as server, ExitStack() as stack:
        hubs = [Hub(model, name, server, acknowledge=acknowledge) for model, name in zip(models, channels, strict=True)]
        stopped = threading.Event()
        with stopping_on_signals(stopped.set):
            with reporting(compiles=True):
                for one in hubs:
                    stack.enter_context(one)
            buses = {one.channel: partial(HubBus, one) for one in hubs}
            outlets = stack.enter_context(CanOutlets(buses, rates, socketcand=socketcand, slcan=slcan))
            for line in outlets.lines():
                echo(f"rig: {line}", err=True)
            echo(f"rig: CAN {', '.join(channels)} at {rates} on {listen}; Ctrl-C ends it", err=True)
            while not stopped.wait(5.0):
                for one in hubs:
                    echo(_line(one.status()), err=True)
                for text in (text for part in (*hubs, outlets) for text in part.warnings()):
                    echo(f"rig: warning: {text}", err=True)
        for line in (*(_line(one.status()) for one in hubs), *outlets.summary()):
            echo(line)


def _line(status: dict[str, Any]) -> str:
    counts = status["counts"]
    lost = "  ".join(f"{name} {counts[name]}" for name in counts if name != "frames" and counts[name])
    line = f"{status['channel']}  {status['time_s']:.1f} s  nodes {len(status['nodes'])}  frames {counts['frames']}"
    return f"{line}  {lost}".rstrip()
