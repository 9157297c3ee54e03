"""`rig daqmx`: a running rig as a device of NI-DAQmx, over gRPC."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.base.errors import InputError, require_package
from rig.base.text import printable
from rig.cli.connections.connection import Connection, SecretFile
from rig.cli.output.tables import echo
from rig.cli.signals import stop_on_signals

_ADDRESS = "127.0.0.1:31763"
"""The port is that of NI's own server."""
_POLL_S = 0.1
"""Period at which the start of the first task is checked [s]."""


def daqmx(
    *,
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Address to listen on, on 127.0.0.1; port 0: any free port")
    ] = _ADDRESS,
    device: Annotated[
        str, typer.Option(metavar="NAME", help="Name of the device in the program, such as Dev1")
    ] = "rig",
    allow_commands: Annotated[
        bool, typer.Option("--allow-commands", help="Let digital and analog outputs command the rig")
    ] = False,
    secret: SecretFile = None,
    connection: Connection,
) -> None:
    """Serve a running rig to programs that use nidaqmx, over gRPC, until Ctrl-C."""
    import threading

    from rig.serve.transport.endpoint import check_free, parse_loopback

    if not (device.isascii() and device.replace("_", "").isalnum()):
        raise InputError("--device", "letters, digits and _", printable(device))
    address = parse_loopback(listen, field="--listen", least=0)
    check_free(address, field="--listen")
    for package in ("nidaqmx", "grpc"):
        require_package(package, "nidaqmx")
    from drivers.daqmx.server import DaqmxServer

    required = connection.read_secret(secret, allow_commands=allow_commands)
    done = threading.Event()
    with (
        connection.client() as client,
        DaqmxServer(client, port=address[1], device=device, allow_commands=allow_commands, secret=required) as server,
    ):
        for physical, channel in server.device.channels.items():
            row = server.device.table.channels[channel]
            echo(f"{physical:14s}{channel:12s}{row.unit}")
        for terminal, signal in server.device.terminals.items():
            echo(f"{terminal:14s}{signal.channel}")
        echo(f"rig: NI-DAQmx device {device} at 127.0.0.1:{server.port}; Ctrl-C ends it", err=True)
        with stop_on_signals(done.set):
            while not (done.wait(_POLL_S) or server.task_started.is_set()):
                pass
            if not done.is_set():
                echo("rig: a task started", err=True)
            done.wait()
