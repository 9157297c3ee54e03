"""`rig can dbc` and `rig can load`: the rig's CAN messages, and what they make of a bus."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.can_output import CanMessages
from rig.cli.options import ChannelFile
from rig.cli.tables import Form, echo, echo_document, echo_json, new_table
from rig.errors import check_new_file, whole_file

if TYPE_CHECKING:
    from drivers.can.bus.timing import Speed
    from drivers.can.schedule import Schedule
    from rig.channels import ChannelTable


def dbc(
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.dbc", help="Write it to this file.")
    ] = None,
    channels: ChannelFile = None,
) -> None:
    """Show the DBC of the rig's messages, made from the channel table, or write it to a file."""
    from drivers.can.dbc import text

    if output is not None:
        check_new_file(output, field="--output", suffixes=(".dbc",), force=True)
    schedule, speed = CanMessages(can_classic=True).plan(_table(channels))
    _warn(schedule, speed)
    if output is None:
        echo_document(text(schedule.table))
        return
    with whole_file(output) as draft:
        draft.write_text(text(schedule.table), encoding="cp1252")
    echo(f"{output} written")


def _table(channels: Path | None) -> ChannelTable:
    from rig.channel_file import read_channels
    from rig.scenes import rig_table

    return rig_table() if channels is None else read_channels(channels)


def load(*, messages: CanMessages, channels: ChannelFile = None, form: Form) -> None:
    """Show every message of the rig with its period, share of the bus and longest response time."""
    from drivers.can.gateway.samples import steps

    table = _table(channels)
    schedule, speed = messages.plan(table)
    steps(table, schedule)
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
