"""The --connect option and what the commands that use it share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.tables import echo
from rig.errors import RefusedError

if TYPE_CHECKING:
    from drivers.console import Accepted, Console

Connect = Annotated[str, typer.Option(metavar="HOST:PORT", help="Where the rig listens.")]


@contextmanager
def console(connect: str, command: str) -> Iterator[Console]:
    """A console connected to the rig, closed afterwards.

    Args:
        connect: HOST:PORT of the rig.
        command: Name of the command, which signs its requests.

    Raises:
        RefusedError: No rig answers there.
    """
    from drivers.console import Console
    from rig.transport import NoReplyError
    from rig.transport.zenoh import ZenohClient

    try:
        with ZenohClient(connect) as client:
            yield Console(client, name=f"rig {command} pid {os.getpid()}")
    except NoReplyError as error:
        raise RefusedError(str(error)) from None


def show(accepted: Accepted, what: str) -> None:
    """One line for a command that the rig took."""
    echo(f"{what} accepted: number {accepted.id}, at {accepted.time_s:.6f} s (tick {accepted.tick})")
