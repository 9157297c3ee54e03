"""`rig step`: let a rig in lockstep, or a replay that is paused, go on a little."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.connection import Connection
from rig.cli.tables import echo
from rig.errors import InputError, Words


def step(
    ticks: Annotated[
        int | None,
        typer.Argument(help="Microseconds of simulated time; for a rig, a whole multiple of the scene's block."),
    ] = None,
    *,
    blocks: Annotated[int | None, typer.Option(help="A number of blocks instead; only for a replay.")] = None,
    connection: Connection,
) -> None:
    """Let a rig that runs with --pace lockstep simulate TICKS more, or a paused replay play them; returns when done."""
    if (ticks is None) == (blocks is None):
        raise InputError("step", "given TICKS or --blocks", Words("neither" if ticks is None else "both"))
    with connection.console("step") as rig:
        done = rig.step(ticks) if ticks is not None else rig.step_blocks(blocks or 0)
        echo(f"stepped to {done.time_s:.6f} s (tick {done.tick})")
