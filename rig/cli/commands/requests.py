"""Requests to a running rig or a replay, one command each, which prints the reply."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Annotated, Any

import typer

from rig.base.errors import InputError, Words
from rig.cli.connections.connection import Connection, show
from rig.cli.output.tables import echo
from rig.run.commands import SUMMARIES


def scene_command(name: str) -> Callable[..., None]:
    """Return the command line of a scene command: required fields are arguments, others are options."""
    from rig.run.commands import mechanical
    from rig.run.commands.command import as_number, find_commands

    fields, hints, parameters = (
        find_commands(mechanical)[name].quantities(),
        dict[str, Any](),
        list[inspect.Parameter](),
    )
    for field, each in fields.items():
        quantity, unit = each.quantity, each.quantity.unit.replace(" ", "")
        shown = {"metavar": each.quantity.metavar, "help": each.quantity.help}
        if each.required:
            parameter: Any = typer.Argument(**{**shown, "metavar": quantity.metavar or unit.upper()})
        else:
            parameter = typer.Option(**shown)
        hints[field] = Annotated[str if each.takes_text else float, parameter]
        default = inspect.Parameter.empty if each.required else each.default
        parameters.append(inspect.Parameter(field, inspect.Parameter.KEYWORD_ONLY, default=default))

    def command(*, connection: Connection, **arguments: Any) -> None:
        values = {field: as_number(value) if isinstance(value, str) else value for field, value in arguments.items()}
        value_texts = [f"{values[field]:g} {each.quantity.unit}" for field, each in fields.items() if each.required]
        with connection.console(name) as rig:
            show(rig.send(name, **values), " ".join([name, *value_texts]))

    parameters.append(inspect.Parameter("connection", inspect.Parameter.KEYWORD_ONLY))
    command.__name__, command.__doc__ = name, f"{SUMMARIES[name]}."
    command.__annotations__ = {**hints, "connection": Connection}
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return command


def step(
    ticks: Annotated[
        int | None,
        typer.Argument(help="Simulated time in us; for a rig, a multiple of the block"),
    ] = None,
    *,
    blocks: Annotated[int | None, typer.Option(help="Number of blocks instead of TICKS; replay only")] = None,
    connection: Connection,
) -> None:
    """Advance a lockstep run or a paused replay by TICKS; returns when done."""
    if (ticks is None) == (blocks is None):
        raise InputError("step", "given TICKS or --blocks", Words("neither" if ticks is None else "both"))
    with connection.console("step") as rig:
        done = rig.step(ticks) if ticks is not None else rig.step_blocks(blocks or 0)
        echo(f"stepped to {done.time_s:.6f} s (tick {done.tick})")


def note(
    text: Annotated[str, typer.Argument(help="One line of text")],
    *,
    tag: Annotated[list[str] | None, typer.Option(metavar="WORD", help="Tag to find the note by; repeatable")] = None,
    connection: Connection,
) -> None:
    """Add a note to every recording of a running rig, with the current simulated and wall time."""
    with connection.console("note") as rig:
        show(rig.note(text, tags=tag or []), "note")


def stop(*, connection: Connection) -> None:
    """End the run of a rig and close its recordings."""
    with connection.console("stop") as rig:
        show(rig.stop(), "stop")


def pause(*, connection: Connection) -> None:
    """Pause a replay until `rig resume`, `rig step` or `rig seek`."""
    with connection.console("pause") as rig:
        show(rig.pause(), "pause")


def resume(*, connection: Connection) -> None:
    """Resume a replay."""
    with connection.console("resume") as rig:
        show(rig.resume(), "resume")


def seek(
    time_s: Annotated[float, typer.Argument(metavar="SECONDS", help="Simulated time in the recording in s")],
    *,
    connection: Connection,
) -> None:
    """Move a replay to another time; a paused replay stays paused."""
    with connection.console("seek") as rig:
        show(rig.seek(time_s), "seek")


def rate(
    rate: Annotated[float, typer.Argument(metavar="X", help="Speed, recorded over real time, 0.01 to 1000")],
    *,
    connection: Connection,
) -> None:
    """Set the speed of a replay."""
    with connection.console("rate") as rig:
        show(rig.rate(rate), "rate")
