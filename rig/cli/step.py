"""`rig step`: let a rig in lockstep run on."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.connection import Connect, console
from rig.transport import DEFAULT_ENDPOINT


def step(
    ticks: Annotated[
        int, typer.Argument(help="Microseconds of simulated time, a whole multiple of the scene's block.")
    ],
    *,
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Let a rig that runs with --pace lockstep simulate TICKS more; returns when they are done."""
    with console(connect, "step") as rig:
        done = rig.step(ticks)
        typer.echo(f"stepped to {done.time_s:.6f} s (tick {done.tick})")
