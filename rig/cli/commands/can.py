"""`rig can`: virtual CAN buses."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.errors import InputError
from rig.base.files import check_new_file, write_file
from rig.cli.connections.can_output import CanMessages, bit_rates
from rig.cli.options import ChannelFile, Force
from rig.cli.output.progress import reporting
from rig.cli.output.tables import Form, echo, echo_document, echo_json, new_table
from rig.cli.signals import stop_on_signals

if TYPE_CHECKING:
    from drivers.can.bus.timing import Speed
    from drivers.can.schedule import Schedule
    from rig.channels.table import ChannelTable

LISTEN = "127.0.0.1:7461"
_SPEED = "1M/8M"


def can(context: typer.Context) -> None:
    """Run virtual CAN buses, and list the CAN messages of the rig."""
    if context.invoked_subcommand is None:
        echo(context.get_help())


def hub(
    channels: Annotated[list[str], typer.Argument(metavar="CHANNEL...", help="Names of the buses, such as can0")],
    *,
    speed: Annotated[
        str, typer.Option(metavar="RATE[/RATE]", help="Bit rate, and CAN FD data bit rate: 500k, 1M/8M")
    ] = _SPEED,
    listen: Annotated[str, typer.Option(metavar="HOST:PORT", help="Address to listen on")] = LISTEN,
    socketcand: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Serve socketcand here (classic frames), e.g. 127.0.0.1:29536"),
    ] = None,
    slcan: Annotated[
        bool, typer.Option("--slcan", help="Open a pseudo-terminal per bus that acts as an SLCAN adapter")
    ] = False,
    acknowledge: Annotated[bool, typer.Option(help="Acknowledge frames, so that a single node can send")] = True,
    error_rate: Annotated[float, typer.Option(metavar="SHARE", help="Fraction of bits received wrong, 0 to 1")] = 0.0,
    seed: Annotated[int, typer.Option(help="Seed of the bit errors")] = 0,
) -> None:
    """Run virtual CAN buses without a rig, until Ctrl-C.

    Connect with python-can: can.Bus(interface="zenoh", channel="can0"), or can_logger -i zenoh -c can0.
    """
    from drivers.can.bus.hub import Hub
    from drivers.can.bus.model import BusModel
    from drivers.can.interface import HubBus
    from rig.cli.connections.can_outlets import CanOutlets
    from rig.serve.transport.endpoint import parse_loopback
    from rig.serve.transport.zenoh import ZenohServer

    parse_loopback(listen, field="--listen")
    if len(set(channels)) < len(channels):
        raise InputError("CHANNEL", "named once each", " ".join(channels))
    rates = bit_rates(speed, field="--speed")
    models = [BusModel(rates, error_rate=error_rate, seed=seed + number) for number in range(len(channels))]
    with ZenohServer(listen) as server, ExitStack() as stack:
        hubs = [Hub(model, name, server, acknowledge=acknowledge) for model, name in zip(models, channels, strict=True)]
        stopped = threading.Event()
        with stop_on_signals(stopped.set):
            with reporting(compiles=True):
                for can_hub in hubs:
                    stack.enter_context(can_hub)
            buses = {can_hub.channel: partial(HubBus, can_hub, in_order=True) for can_hub in hubs}
            outlets = stack.enter_context(CanOutlets(buses, rates, socketcand=socketcand, slcan=slcan))
            for line in outlets.lines():
                echo(f"rig: {line}", err=True)
            echo(f"rig: CAN {', '.join(channels)} at {rates} on {listen}; Ctrl-C ends it", err=True)
            while not stopped.wait(5.0):
                for can_hub in hubs:
                    echo(_line(can_hub.status()), err=True)
                for text in (text for part in (*hubs, outlets) for text in part.warnings()):
                    echo(f"rig: warning: {text}", err=True)
        for line in (*(_line(can_hub.status()) for can_hub in hubs), *outlets.summary()):
            echo(line)


def _line(status: dict[str, Any]) -> str:
    counts = status["counts"]
    lost = "  ".join(f"{name} {counts[name]}" for name in counts if name != "frames" and counts[name])
    line = f"{status['channel']}  {status['time_s']:.1f} s  nodes {len(status['nodes'])}  frames {counts['frames']}"
    return f"{line}  {lost}".rstrip()


def dbc(
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.dbc", help="Write the DBC to this file")
    ] = None,
    force: Force = False,
    channels: ChannelFile = None,
) -> None:
    """Show the DBC of the rig's messages, generated from the channel table, or write it to a file."""
    from drivers.can.dbc import text

    if output is not None:
        check_new_file(output, field="--output", suffixes=(".dbc",), force=force)
    schedule, speed = CanMessages(can_classic=True).plan(_table(channels))
    _warn(schedule, speed)
    if output is None:
        echo_document(text(schedule.table))
        return
    write_file(output, text(schedule.table).encode("cp1252"))
    echo(f"{output} written")


def _table(channels: Path | None) -> ChannelTable:
    from rig.channels.channel_file import read_channels
    from rig.run.scenes import rig_table

    return rig_table() if channels is None else read_channels(channels)


def load(*, messages: CanMessages, channels: ChannelFile = None, form: Form) -> None:
    """Show period and bus load of every message of the rig, with its longest response time."""
    from drivers.can.gateway.samples import find_decimations

    table = _table(channels)
    schedule, speed = messages.plan(table)
    find_decimations(table, schedule)
    messages_found = [
        {
            "id": message.identifier,
            "message": message.name,
            "from": message.sender,
            "bytes": message.length,
            "fd": message.fd,
            "periodic": message.periodic,
            "period_s": row.message.period_s,
            "transmission_s": row.transmission_s,
            "load": row.transmission_s / row.message.period_s,
            "worst_response_s": row.worst_s,
            "in_time": row.schedulable,
        }
        for message, row in schedule.response_times(speed)
    ]
    if form.as_json:
        echo_json({"speed": str(speed), "load": schedule.load(speed), "messages": messages_found})
    else:
        numbers = (">bytes", ">every [ms]", ">frame [us]", ">load [%]", ">worst response [ms]", ">in time")
        table = new_table(f"CAN at {speed}, every frame at its longest", ">id", "message", "from", *numbers)
        for row in messages_found:
            table.add_row(
                f"{row['id']:#05x}",
                row["message"],
                row["from"],
                f"{row['bytes']}{' FD' if row['fd'] else ''}",
                f"{'' if row['periodic'] else '>= '}{1e3 * row['period_s']:g}",
                f"{1e6 * row['transmission_s']:.1f}",
                f"{100 * row['load']:.2f}",
                f"{1e3 * row['worst_response_s']:.3f}",
                "yes" if row["in_time"] else "no",
            )
        console = form.console()
        console.print(table)
        console.print(f"load: at most {100 * schedule.load(speed):.1f} % of the bus")
    _warn(schedule, speed)


def _warn(schedule: Schedule, speed: Speed) -> None:
    for warning in schedule.warnings(speed):
        echo(f"rig: warning: {warning}", err=True)
