"""`rig modbus`: a running rig as the Modbus TCP gateway of a protection rack."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Annotated

import typer

from rig.base.errors import InputError, Words, require_package
from rig.cli.connections.connection import Connection
from rig.cli.options import ChannelFile
from rig.cli.output.tables import Form, echo, echo_document, echo_json, new_table
from rig.cli.signals import stop_on_signals

if TYPE_CHECKING:
    from drivers.protection.modbus.registers import RegisterMap

LISTEN = "127.0.0.1:5020"
_RETRY_S = 1.0


def modbus(
    *,
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Address to listen on, on 127.0.0.1; port 0: any free port")
    ] = LISTEN,
    allow_commands: Annotated[
        bool, typer.Option("--allow-commands", help="Allow clients to trip, stop and reset by coils")
    ] = False,
    alert_um: Annotated[float, typer.Option(help="Set point of the alert of each pair of probes")] = 500.0,
    danger_um: Annotated[float, typer.Option(help="Set point of the danger of each pair of probes")] = 1500.0,
    map_: Annotated[bool, typer.Option("--map", help="Print the register map, without a rig")] = False,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print the map as Markdown")] = False,
    channels: ChannelFile = None,
    form: Form,
    connection: Connection,
) -> None:
    """Serve a running rig to Modbus TCP clients as a protection rack, until Ctrl-C; `--map` prints the registers."""
    from drivers.protection import Settings
    from drivers.protection.modbus.registers import RegisterMap

    settings = {"alert_um": alert_um, "danger_um": danger_um}
    Settings(**settings)  # check
    if map_:
        from rig.channels.channel_file import read_channels
        from rig.channels.table import default_table

        _print(RegisterMap(default_table() if channels is None else read_channels(channels)), form, markdown=markdown)
        return
    if channels is not None or markdown or form.as_json:
        raise InputError("--channels, --markdown and --json", "given with --map", Words("no --map"))
    require_package("pymodbus", "modbus")
    _serve(listen, settings, connection, allow_commands=allow_commands)


def _serve(listen: str, settings: dict[str, float], connection: Connection, *, allow_commands: bool) -> None:
    import threading

    from drivers.protection.modbus.gateway import Gateway
    from drivers.protection.modbus.registers import RegisterMap
    from drivers.protection.modbus.server import serve
    from drivers.sources.stream import RigStream
    from rig.serve.transport.endpoint import check_free, choose_listen_address

    address = choose_listen_address(listen, field="--listen")
    check_free(address, field="--listen")
    with connection.client() as client:
        registers = RegisterMap(RigStream(client).table())
    gateway, stopped, last = Gateway(registers, settings), threading.Event(), ""
    with (
        stop_on_signals(stopped.set),
        serve(registers, address, gateway.command if allow_commands else None) as publish,
    ):
        access = "reads and commands" if allow_commands else "reads only"
        if allow_commands and connection.tls is not None:
            echo("rig: warning: every program here can trip and stop the rig: Modbus carries no secret", err=True)
        start = cache(
            partial(echo, f"rig: Modbus TCP at {address[0]}:{address[1]}, {access}; Ctrl-C ends it", err=True)
        )
        while not stopped.is_set():
            try:
                # Not for --wait-s: a wait inside zenoh would delay the end by Ctrl-C.
                with replace(connection, wait_s=0.0).client() as client:
                    gateway.follow(client, publish, stopped, start)
            except (InputError, OSError, EOFError) as error:
                if str(error) != last:
                    echo(f"rig: no rig to read, all OK bits are off: {error}", err=True)
                last = str(error)
                stopped.wait(_RETRY_S)


def _print(registers: RegisterMap, form: Form, *, markdown: bool) -> None:
    rows = [asdict(entry) for entry in registers.entries]
    if form.as_json:
        echo_json(rows)
        return
    headings = [name.replace("_", " ") for name in rows[0]]
    cells = [["" if value is None else str(value) for value in row.values()] for row in rows]
    if markdown:
        echo_document("".join(f"| {' | '.join(row)} |\n" for row in (headings, ["---"] * len(headings), *cells)))
        return
    table = new_table("", *headings, keys=2)
    for row in cells:
        table.add_row(*row)
    form.console().print(table)
