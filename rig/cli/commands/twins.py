"""`rig twins`: simulated instruments of a running rig, for their drivers."""

from __future__ import annotations

from typing import Annotated

import typer

from drivers.link import DEFAULT_ENDPOINT as INSTRUMENTS
from rig.cli.connections.connection import Connection
from rig.cli.output.tables import echo
from rig.cli.signals import stop_on_signals


def twins(
    *,
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Serve over zenoh at --listen (default)")] = False,
    pty: Annotated[bool, typer.Option("--pty", help="Serve each instrument at a pseudo-terminal")] = False,
    can: Annotated[
        str | None, typer.Option(metavar="SPEC", help="Serve on a CAN bus, INTERFACE:CHANNEL, such as zenoh:can0")
    ] = None,
    listen: Annotated[str, typer.Option(metavar="HOST:PORT", help="Address to listen on with --zenoh")] = INSTRUMENTS,
    connection: Connection,
) -> None:
    """Serve the simulated instruments of a running rig to their drivers; Ctrl-C switches them off."""
    import threading

    from drivers.instruments.twins import Twins
    from rig.cli.connections.can_output import parse_spec
    from rig.serve.transport.endpoint import parse_loopback

    # Check the options before connecting to a rig.
    parse_loopback(listen, field="--listen")
    if can is not None:
        parse_spec(can)
    done = threading.Event()
    with connection.client() as client, Twins(client) as serving:
        if zenoh or not (pty or can):
            serving.serve_zenoh(listen)
        if pty:
            serving.serve_pty()
        if can:
            serving.serve_can(can)
        for twin in serving.twins:
            echo(f"{twin.CODEC.address.name:14s}{twin.url}")
        echo("rig: open one with its driver, such as drivers.instruments.hammer.driver.Hammer; Ctrl-C ends", err=True)
        with stop_on_signals(done.set):
            done.wait()
