"""`rig foxglove`: the running rig, or a recording, in the Foxglove app."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from rig.base.errors import InputError, require_package
from rig.base.files import check_new_file, write_file
from rig.base.text import printable
from rig.cli.connections.connection import Connection, SecretFile
from rig.cli.options import Force
from rig.cli.output.tables import echo
from rig.cli.signals import stop_on_signals

_ADDRESS = "127.0.0.1:8765"
"""Default address of the Foxglove app."""


def foxglove(
    *,
    replay: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Serve this recording (.mcap), controlled by the app's play bar")
    ] = None,
    layout: Annotated[
        Path | None, typer.Option(metavar="FILE.json", help="Write a layout for the app to this file, and end")
    ] = None,
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Address to listen on, on 127.0.0.1; port 0: any free port")
    ] = _ADDRESS,
    allow_commands: Annotated[
        bool, typer.Option("--allow-commands", help="Accept commands, and the play bar of a replay that runs")
    ] = False,
    secret: SecretFile = None,
    view_rate_hz: Annotated[float, typer.Option(help="Rate of the messages for plots in Hz")] = 500.0,
    connection: Connection,
    force: Force = False,
) -> None:
    """Serve a running rig, or a recording, to the Foxglove app, until Ctrl-C.

    Other programs with Foxglove's WebSocket protocol can connect too; only commands can need a secret.
    """
    from recorder.writer import check_view_rate
    from rig.serve.transport.endpoint import check_free, parse_loopback

    if layout is not None:
        _write_layout(layout, replay, force=force)
        return
    require_package("foxglove", "foxglove")
    address = parse_loopback(listen, field="--listen", least=0)
    check_free(address, field="--listen")
    check_view_rate(view_rate_hz)
    if view_rate_hz == 0.0:
        raise InputError("--view-rate-hz", "above 0", view_rate_hz)
    if replay is not None and connection.connect != Connection.connect:
        raise InputError("--connect", "left out with --replay FILE", connection.connect)
    source = connection if replay is None else replace(connection, tls=None)
    shown = f"the rig at {source.connect}" if replay is None else printable(str(replay))
    required = source.read_secret(secret, allow_commands=allow_commands)
    playback = replay is not None or (allow_commands and required is None)
    with nullcontext(source.connect) if replay is None else _replayed(replay) as endpoint:
        _serve(
            replace(source, connect=endpoint), shown, address, view_rate_hz,
            allow_commands=allow_commands, allow_playback=playback, secret=required,
        )  # fmt: skip


def _write_layout(path: Path, recording: Path | None, *, force: bool) -> None:
    from recorder.foxglove.layout import make_layout
    from replays.player.messages import Track
    from rig.run.scenes import rig_table

    check_new_file(path, field="--layout", suffixes=(".json",), force=force)
    write_file(path, make_layout(rig_table() if recording is None else Track([recording]).table))
    echo(f"{path} written; in the app: layout menu, Import from file")


def _serve(
    connection: Connection, shown: str, address: tuple[str, int], view_rate_hz: float, *, secret: str | None,
    **access: bool,
) -> None:  # fmt: skip
    """Serve the rig at an address until a signal."""
    from drivers.console import Console
    from recorder.foxglove.server import FoxgloveServer

    done = threading.Event()
    with connection.client() as client:
        console = Console(client, name=f"rig foxglove pid {os.getpid()}", any_rig=True)
        with (
            FoxgloveServer(
                client, address, view_rate_hz=view_rate_hz, send=console.send, secret=secret, **access
            ) as server,
            stop_on_signals(done.set),
        ):
            echo(f"ws://127.0.0.1:{server.port} serves {shown}; {server.app_url}")
            if access["allow_commands"] and secret is None:
                echo("rig: warning: every program and every page in a browser here can send commands", err=True)
            echo("rig: Ctrl-C ends it", err=True)
            server.run(done.is_set)
            malformed = f", {server.malformed} malformed blocks ignored" if server.malformed else ""
            echo(f"{server.messages} messages sent{malformed}")


@contextmanager
def _replayed(recording: Path) -> Iterator[str]:
    """Yield the address of a paused replay of a recording, which stays at its end until it is moved back."""
    from replays.player.messages import Track
    from replays.player.player import Player
    from rig.serve.pacing import RealTime
    from rig.serve.transport.zenoh import ZenohServer

    with ZenohServer("127.0.0.1:0") as server:
        track = Track([recording])
        if not track.complete:
            echo("rig: the recording was cut off; it is played up to that point", err=True)
        player = Player(track, server, RealTime(), paused=True, hold=True, linger_s=0.5)
        player.prepare()
        playing = threading.Thread(target=player.run, name="player", daemon=True)
        playing.start()
        try:
            yield server.endpoint
        finally:
            player.stop()
            playing.join(timeout=5.0)
