"""`rig can dbc` and `rig can load`: the rig's CAN messages, and what they make of a bus."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.can_output import CanMessages
from rig.cli.tables import echo
from rig.errors import whole_file

if TYPE_CHECKING:
    from drivers.can.bus.timing import Speed
    from drivers.can.schedule import Schedule


def dbc(
    *,
    out: Annotated[Path | None, typer.Option("--out", "-o", metavar="FILE", help="Write it to this file.")] = None,
) -> None:
    """Show the DBC of the rig's messages, made from the channel table, or write it to a file."""
    from drivers.can.dbc import text
    from rig.scenes import rig_table

    rig_table()
    _warn(*CanMessages(can_classic=True).plan())
    if out is None:
        echo(text(), nl=False)
        return
    with whole_file(out) as draft:
        draft.write_text(text(), encoding="utf-8")
    echo(f"{out} written")


def load(*, messages: CanMessages) -> None:
    """Show every message of the rig with its period, share of the bus and longest response time."""
    from rig.cli.tables import new_table, table_console
    from rig.scenes import rig_table

    rig_table()
    schedule, speed = messages.plan()
    numbers = (">bytes", ">every, ms", ">frame, us", ">load, %", ">worst response, ms", ">in time")
    table = new_table(f"CAN at {speed}, every frame at its longest", ">id", "message", "from", *numbers)
    for message, row in schedule.response_times(speed):
        table.add_row(
            f"{message.identifier:#05x}",
            message.name,
            message.sender,
            f"{message.length}{' FD' if message.fd else ''}",
            f"{'' if message.periodic else '>= '}{1e3 * row.message.period_s:g}",
            f"{1e6 * row.transmission_s:.1f}",
            f"{100 * row.transmission_s / row.message.period_s:.2f}",
            f"{1e3 * row.worst_s:.3f}",
            "yes" if row.schedulable else "no",
        )
    console = table_console(width=120)
    console.print(table)
    console.print(f"load: at most {100 * schedule.load(speed):.1f} % of the bus")
    _warn(schedule, speed)


def _warn(schedule: Schedule, speed: Speed) -> None:
    for warning in schedule.warnings(speed):
        echo(f"rig: warning: {warning}", err=True)
