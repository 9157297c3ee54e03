"""`rig replay`: a recording served as if it were the rig."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.can_output import (
    CanBitrate,
    CanBus,
    CanClassic,
    CanFd,
    CanOverload,
    CanRate,
    CanSlcan,
    CanSocketcand,
    can_output,
)
from rig.errors import InputError
from rig.transport import DEFAULT_ENDPOINT

if TYPE_CHECKING:
    from replays.player.player import Player

_PART, _CHANGE = "What is played", "What is changed"
_INTERRUPTED = 130


class Spacing(StrEnum):
    """What the spacing follows."""

    SIMULATED = "simulated"
    ARRIVAL = "arrival"


class Numbers(StrEnum):
    """Which ticks and row numbers go out."""

    ORIGINAL = "original"
    NEW = "new"


class Only(StrEnum):
    """What goes out."""

    SENSORS = "sensors"


def replay(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="A recording, or its parts in their order.")],
    *,
    rate: Annotated[float, typer.Option(help="Recorded seconds a second, 0.01 to 1000.")] = 1.0,
    burst: Annotated[
        bool, typer.Option("--burst", help="As fast as the clients take it, without loss; for the start see --pause.")
    ] = False,
    spacing: Annotated[
        Spacing, typer.Option("--by", help="By simulated time, or as it had arrived at the recorder.")
    ] = Spacing.SIMULATED,
    from_s: Annotated[
        float | None, typer.Option("--from", metavar="S", help="Where to begin, in s.", rich_help_panel=_PART)
    ] = None,
    to_s: Annotated[
        float | None, typer.Option("--to", metavar="S", help="Where to end, in s.", rich_help_panel=_PART)
    ] = None,
    start_s: Annotated[
        float | None,
        typer.Option("--start", metavar="S", help="Where the first pass begins, in s.", rich_help_panel=_PART),
    ] = None,
    loop: Annotated[
        int, typer.Option(metavar="N", help="Passes through it; 0: endless.", rich_help_panel=_PART, min=0)
    ] = 1,
    pause: Annotated[
        bool, typer.Option("--pause", help="Wait for `rig resume`, or `rig step`.", rich_help_panel=_PART)
    ] = False,
    time: Annotated[
        Numbers,
        typer.Option(
            help="Ticks and row numbers as recorded, or new ones that run on through loops and seeks.",
            rich_help_panel=_CHANGE,
        ),
    ] = Numbers.ORIGINAL,
    only: Annotated[
        Only | None, typer.Option(help="Leave out what no instrument could know.", rich_help_panel=_CHANGE)
    ] = None,
    remap: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=KEY", help="The same payloads on another key; may be repeated.", rich_help_panel=_CHANGE
        ),
    ] = None,
    channels: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...", help="Only these, in this order within their groups.", rich_help_panel=_CHANGE
        ),
    ] = None,
    rename: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=NAME", help="Another name for a channel, as if wired so.", rich_help_panel=_CHANGE),
    ] = None,
    listen: Annotated[str, typer.Option(metavar="HOST:PORT", help="Where to listen.")] = DEFAULT_ENDPOINT,
    expose: Annotated[
        bool, typer.Option("--expose", help="Allow --listen and --can-socketcand on a host other than 127.0.0.1.")
    ] = False,
    can: CanBus = None,
    can_rate: CanRate = None,
    can_classic: CanClassic = False,
    can_fd: CanFd = False,
    can_bitrate: CanBitrate = None,
    can_overload: CanOverload = False,
    can_socketcand: CanSocketcand = None,
    can_slcan: CanSlcan = False,
) -> None:
    """Play a recording to whoever listens, as if it were the rig.

    From another terminal: `rig pause`, `rig resume`, `rig seek S`, `rig rate X`, `rig step`, `rig stop`, `rig status`.
    """
    from rig.cli.run import stopping_on_signals
    from rig.pacing import FreeRun, RealTime, rare_collections

    with rare_collections():
        from replays.player.edit import Edit
        from replays.player.player import Part, Player, check_rate
        from replays.player.tape import Tape
        from replays.player.timeline import By
        from rig.transport.zenoh import ZenohServer
        from rig.wire import CATALOGUE

        check_rate(rate)
        if burst and rate != 1.0:
            raise InputError("rate", "left out with --burst", rate)
        tape = Tape(files)
        edit = Edit(
            tape.documents[CATALOGUE],
            keys=_pairs("--remap", remap),
            channels=None if channels is None else [name.strip() for name in channels.split(",")],
            names=_pairs("--rename", rename),
            truth=only is None,
        )
        bus = can_output(
            can,
            classic=can_classic,
            fd=can_fd,
            rate_hz=can_rate,
            bitrate=can_bitrate,
            overload=can_overload,
            socketcand=can_socketcand,
            slcan=can_slcan,
            expose=expose,
        )
    # What the transport keeps for those who miss it lasts shorter when it goes faster, so there it waits for them.
    with ZenohServer(listen, expose=expose, wait=burst or rate > 1.0) as server, ExitStack() as stack:
        if bus is not None:
            stack.enter_context(bus)
        player = Player(
            tape,
            server if bus is None else bus.beside(server),
            FreeRun() if burst else RealTime(),
            part=Part(from_s=from_s, to_s=to_s, start_s=start_s, loops=loop or None),
            edit=edit,
            by=By(spacing),
            rate=rate,
            renumber=time is Numbers.NEW,
            paused=pause,
        )
        player.prepare()
        if bus is not None:
            bus.start(paced=not burst)
            typer.echo(f"rig: {bus}", err=True)
        begin_s, end_s = player.reach_s
        if not tape.complete:
            typer.echo("rig: the recording was cut off; it is played as far as it goes", err=True)
        what = "paused" if pause else "burst" if burst else f"x{rate:g}"
        typer.echo(f"rig: replay of {', '.join(map(str, files))}, {begin_s:g} to {end_s:g} s, {what}", err=True)
        typer.echo(f"rig: listening on {server.endpoint}; Ctrl-C or `rig stop` ends it", err=True)
        interrupted = threading.Event()

        def stop() -> None:
            interrupted.set()
            player.stop()

        with stopping_on_signals(stop), _showing(player):
            summary = player.run()
    _tell(summary)
    if bus is not None:
        typer.echo(bus.summary())
    if interrupted.is_set():
        raise typer.Exit(_INTERRUPTED)


def _pairs(option: str, texts: list[str] | None) -> dict[str, str]:
    """OLD=NEW, each OLD once."""
    pairs: dict[str, str] = {}
    for text in texts or []:
        old, equals, new = (part.strip() for part in text.partition("="))
        if not equals or not old or not new or old in pairs:
            raise InputError(option, "OLD=NEW, each OLD once", text)
        pairs[old] = new
    return pairs


@contextmanager
def _showing(player: Player) -> Iterator[None]:
    """Show how far it is: a bar on a terminal, else a line every 5 s."""
    done = threading.Event()
    # A thread of its own, so that a terminal that is held up (Ctrl-S) holds up nothing else.
    show = _show_bar if sys.stderr.isatty() else _show_lines
    thread = threading.Thread(target=show, args=(player, done), name="display", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join(timeout=1.0)


def _show_bar(player: Player, done: threading.Event) -> None:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    begin_s, end_s = player.reach_s
    with Progress(
        BarColumn(bar_width=32), TextColumn("{task.description}"), console=Console(stderr=True), transient=True
    ) as bar:
        task = bar.add_task("", total=max(end_s - begin_s, 1e-9))
        while not done.wait(0.25):
            status = player.status()
            bar.update(task, completed=status["time_s"] - begin_s, description=_line(status))


def _show_lines(player: Player, done: threading.Event) -> None:
    while not done.wait(5.0):
        typer.echo(_line(player.status()), err=True)


def _line(status: dict[str, Any]) -> str:
    late, play = status["lateness_ms"], status["replay"]
    parts = [
        f"{status['time_s']:9.2f} of {status['end_s']:.2f} s",
        "paused" if play["paused"] else f"x{play['achieved_rate']:.4f}",
        f"late p99 {late['p99']:.2f} max {late['max']:.2f} ms",
        f"clients {len(status['clients'])}",
    ]
    if play["passes"] != 1:
        parts.append(f"pass {play['pass']}" + (f" of {play['passes']}" if play["passes"] else ""))
    if status["congestion"].get("stalled_links"):
        parts.append(f"stalled links {status['congestion']['stalled_links']:.0f}")
    return "  ".join(parts)


def _tell(summary: dict[str, Any]) -> None:
    late, play = summary["lateness_ms"], summary["replay"]
    typer.echo(
        f"replay: {summary['reason']} at {summary['time_s']:.3f} s, pass {play['pass']}; "
        f"{summary['played_s']:.3f} s played in {summary['wall_s']:.3f} s, x{play['achieved_rate']:.5g} without pauses"
    )
    typer.echo(
        f"{play['payloads']} payloads, {summary['blocks']} blocks, {summary['rows']} rows; "
        f"left out {summary['left_out']} payloads"
    )
    if play["rate"] is not None:
        typer.echo(
            f"lateness p50 {late['p50']:.3f} p99 {late['p99']:.3f} max {late['max']:.3f} last {late['last']:.3f} ms, "
            f"not ready when due {summary['overruns']}"
        )
