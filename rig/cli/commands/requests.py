"""Requests to a running rig or to the replay of a recording, each a command: it is made, and the answer shown."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.base.errors import InputError, Words
from rig.cli.connections.connection import Connection, show
from rig.cli.output.tables import echo


def hammer(
    *,
    force_n: Annotated[float, typer.Option(help="Peak force, in N.")] = 100.0,
    duration_ms: Annotated[float, typer.Option(help="Length of the half-sine pulse, in ms.")] = 5.0,
    direction: Annotated[
        str, typer.Option(metavar="x|y|-x|-y|ANGLE", help="Along x or y, or at an angle from x towards y, in degrees.")
    ] = "x",
    connection: Connection,
) -> None:
    """Hit the shaft of a running rig at the disk."""
    try:
        along: str | float = float(direction)
    except ValueError:
        along = direction  # a name, or an error that the rig explains
    with connection.console("hammer") as rig:
        show(rig.hammer(force_n=force_n, duration_ms=duration_ms, direction=along), "hammer")


def speed(
    speed_hz: Annotated[
        float, typer.Argument(metavar="HZ", help="Spin speed [Hz], approached at the drive's ramp rate.")
    ],
    *,
    connection: Connection,
) -> None:
    """Set the spin speed of a running rig."""
    with connection.console("speed") as rig:
        show(rig.speed(speed_hz), f"speed {speed_hz:g} Hz")


def release(*, connection: Connection) -> None:
    """Make the magnets of a running rig let go of the shaft."""
    with connection.console("release") as rig:
        show(rig.release(), "release")


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


def note(
    text: Annotated[str, typer.Argument(help="One line of text.")],
    *,
    tag: Annotated[
        list[str] | None, typer.Option(metavar="WORD", help="A word to find it by; may be repeated.")
    ] = None,
    connection: Connection,
) -> None:
    """Put a note into every recording that is being made of a rig, with the present simulated and wall time."""
    with connection.console("note") as rig:
        show(rig.note(text, tags=tag or []), "note")


def stop(*, connection: Connection) -> None:
    """End the run of a rig; recordings of it close."""
    with connection.console("stop") as rig:
        show(rig.stop(), "stop")


def pause(*, connection: Connection) -> None:
    """Hold the replay of a recording: nothing more goes out until `rig resume`, `rig step` or `rig seek`."""
    with connection.console("pause") as rig:
        show(rig.pause(), "pause")


def resume(*, connection: Connection) -> None:
    """Let the replay of a recording go on."""
    with connection.console("resume") as rig:
        show(rig.resume(), "resume")


def seek(
    time_s: Annotated[float, typer.Argument(metavar="SECONDS", help="Simulated time in the recording, in s.")],
    *,
    connection: Connection,
) -> None:
    """Let the replay of a recording go on from another position; one that is paused stays so."""
    with connection.console("seek") as rig:
        show(rig.seek(time_s), "seek")


def rate(
    rate: Annotated[float, typer.Argument(metavar="X", help="Recorded seconds a second, 0.01 to 1000.")],
    *,
    connection: Connection,
) -> None:
    """Set how fast the replay of a recording goes."""
    with connection.console("rate") as rig:
        show(rig.rate(rate), "rate")
