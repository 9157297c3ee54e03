"""The ends of a connection to a rig: --connect and --tls of those who use one, --expose of those who serve."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.tables import echo
from rig.errors import InputError, RefusedError
from rig.transport import EXPOSED_PORT

if TYPE_CHECKING:
    from drivers.console import Accepted, Console
    from rig.transport.zenoh import Exposure, ZenohServer

Connect = Annotated[str, typer.Option(metavar="HOST:PORT", help="Where the rig listens.")]
Tls = Annotated[
    Path | None,
    typer.Option(
        "--tls", metavar="DIR", envvar="RIG_TLS", help="Folder with the keys of a role, for a rig that is exposed."
    ),
]


@contextmanager
def console(connect: str, command: str, tls: Path | None) -> Iterator[Console]:
    """A console connected to the rig, closed afterwards.

    Args:
        connect: HOST:PORT of the rig.
        command: Name of the command, which signs its requests.
        tls: Folder with the keys of a role, or none.

    Raises:
        RefusedError: No rig answers there, or it denies this.
    """
    from drivers.console import Console
    from rig.transport import NoReplyError
    from rig.transport.zenoh import ZenohClient

    try:
        with ZenohClient(connect, tls=tls) as client:
            yield Console(client, name=f"rig {command} pid {os.getpid()}")
    except NoReplyError as error:
        raise RefusedError(str(error)) from None


def show(accepted: Accepted, what: str) -> None:
    """One line for a command that the rig took."""
    echo(f"{what} accepted: number {accepted.id}, at {accepted.time_s:.6f} s (tick {accepted.tick})")


def exposure(expose: str | None, keys: Path | None, *, plaintext: bool) -> Exposure | None:
    """Where a rig is to listen beyond the loopback, if anywhere.

    Raises:
        InputError: It is not said who may connect there, or that without a place.
    """
    if expose is None:
        if keys is not None or plaintext:
            raise InputError("--tls" if keys is not None else "--plaintext", "given with --expose HOST", None)
        return None
    if (keys is not None) == plaintext:
        must = f"given with --tls DIR (made by: rig keys init DIR --host {expose.partition(':')[0]}), or --plaintext"
        raise InputError("--expose", must, "both" if plaintext else "neither")
    from rig.transport.certificates import holder_in
    from rig.transport.zenoh import Exposure

    endpoint = expose if ":" in expose else f"{expose}:{EXPOSED_PORT}"
    return Exposure(endpoint, None if keys is None else holder_in(keys, server=True))


def tell_where(server: ZenohServer, exposed: Exposure | None) -> None:
    """Where a rig listens, and who may do what there."""
    from rig.transport.access import ROLES, TRUTH

    if exposed is not None and exposed.holder is not None:
        own = f"{exposed.holder.name} until {exposed.holder.expires:%Y-%m-%d}"
        echo(f"rig: exposed at {exposed.endpoint} to holders of certificates (who may do what: rig keys)", err=True)
        echo(f"rig: its own certificate is for {own}", err=True)
    elif exposed is not None:
        doors = ", ".join(door.what for door in (*ROLES["operator"], TRUTH))
        echo(f"rig: WARNING: {exposed.endpoint} is open to everybody who reaches it, unencrypted:", err=True)
        echo(f"rig: WARNING: {doors}", err=True)
    echo(f"rig: listening on {server.endpoint}; Ctrl-C or `rig stop` ends it", err=True)
