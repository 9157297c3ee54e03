"""`rig replay`: a recording published as a running rig would."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.errors import InputError
from rig.cli.connections.can_output import CanOptions
from rig.cli.connections.connection import Serving, serve
from rig.cli.groups import panel
from rig.cli.options import Channels, FromS, RecordingFiles, ToS, parse_pairs, split_names
from rig.cli.output.display import lateness_summary, lateness_text
from rig.cli.output.tables import echo

if TYPE_CHECKING:
    from replays.player.edit import Edit
    from replays.player.messages import Track
    from replays.player.play_range import Part
    from replays.player.player import Player
    from rig.serve.transport import Server

_part, _change = panel("What is played"), panel("What is changed")


class Spacing(StrEnum):
    """Time base of the replay."""

    SIMULATED = "simulated"
    ARRIVAL = "arrival"


class Numbers(StrEnum):
    """Numbering of ticks and rows."""

    ORIGINAL = "original"
    NEW = "new"


class Only(StrEnum):
    """Streams that are published."""

    SENSORS = "sensors"


@dataclass(frozen=True)
class PlayRange:
    """Range of the replay, and the condition for its start."""

    from_s: FromS = None
    to_s: ToS = None
    start_s: Annotated[float | None, _part("Start of the first pass in s", "--start", metavar="S")] = None
    loop: Annotated[int, _part("Number of passes; 0: endless", metavar="N", min=0)] = 1
    pause: Annotated[bool, _part("Start paused; continue with `rig resume` or `rig step`", "--pause")] = False
    wait_for: Annotated[
        int,
        _part("Start when N clients are connected, so that they receive all", metavar="N", min=0),
    ] = 0
    wait_s: Annotated[float, _part("Time limit for --wait-for in s", metavar="S")] = 60.0

    def part(self) -> Part:
        """Return the range to play and the number of passes."""
        from replays.player.play_range import Part

        return Part(from_s=self.from_s, to_s=self.to_s, start_s=self.start_s, loops=self.loop or None)


@dataclass(frozen=True)
class ReplayEdit:
    """Changes between the recording and the published data."""

    time: Annotated[Numbers, _change("Ticks and row numbers: as recorded, or continuous")] = Numbers.ORIGINAL
    only: Annotated[Only | None, _change("Publish only these streams")] = None
    remap: Annotated[
        list[str] | None, _change("Publish a key's payloads on another key; repeatable", metavar="KEY=KEY")
    ] = None
    channels: Channels = None
    rename: Annotated[list[str] | None, _change("Rename a channel; repeatable", metavar="NAME=NAME")] = None

    def edit(self, track: Track) -> Edit:
        """Return the edit of a track: its payloads, their keys and their columns.

        Raises:
            InputError: The recording lacks a key or channel, or two would have the same name.
        """
        from replays.player.edit import Edit
        from rig.base.wire import CATALOGUE

        return Edit(
            track.documents[CATALOGUE],
            keys=parse_pairs("--remap", self.remap, "KEY=KEY"),
            channels=None if self.channels is None else split_names(self.channels, "--channels"),
            names=parse_pairs("--rename", self.rename, "NAME=NAME"),
            truth=self.only is None,
        )


def replay(
    files: RecordingFiles,
    *,
    rate: Annotated[float, typer.Option(help="Speed, recorded over real time, 0.01 to 1000")] = 1.0,
    burst: Annotated[
        bool, typer.Option("--burst", help="Play as fast as the clients can read; see --wait-for")
    ] = False,
    spacing: Annotated[
        Spacing, typer.Option("--by", help="Time base: simulated time, or arrival at the recorder")
    ] = Spacing.SIMULATED,
    played: PlayRange,
    changed: ReplayEdit,
    serving: Serving,
    can: CanOptions,
) -> None:
    """Publish a recording as a running rig would.

    From another terminal: `rig pause`, `rig resume`, `rig seek S`, `rig rate X`, `rig step`, `rig stop`, `rig status`.
    """
    serving.exposure()  # checks these options first
    from rig.serve.pacing import FreeRun, RealTime, reduce_garbage_collections

    with reduce_garbage_collections():
        from replays.player.messages import Track
        from replays.player.player import Player
        from replays.player.playhead import check_rate
        from replays.player.timeline import By

        check_rate(rate)
        if burst and rate != 1.0:
            raise InputError("rate", "left out with --burst", rate)
        if played.wait_for and played.pause:
            raise InputError("--wait-for", "left out with --pause", played.wait_for)
        track = Track(files)
        edit = changed.edit(track)
        bus = can.output(track.table)

    def make(server: Server) -> Player:
        player = Player(
            track,
            server,
            FreeRun() if burst else RealTime(),
            part=played.part(),
            edit=edit,
            by=By(spacing),
            rate=rate,
            renumber=changed.time is Numbers.NEW,
            paused=played.pause,
            wait_for=played.wait_for,
            wait_s=played.wait_s,
        )
        begin_s, end_s = player.reach_s
        if not track.complete:
            echo("rig: the recording was cut off; it is played up to that point", err=True)
        what = "paused" if played.pause else "burst" if burst else f"x{rate:g}"
        if played.wait_for:
            what += f", waiting for {_clients(played.wait_for)}"
        echo(f"rig: replay of {', '.join(map(str, files))}, {begin_s:g} to {end_s:g} s, {what}", err=True)
        return player

    # At higher rates the transport's history covers less time, so the replay waits for slow clients.
    serve(make, _words, _print_summary, serving=serving, bus=bus, paced=not burst, wait=burst or rate > 1.0)


def _clients(count: int) -> str:
    return "1 client" if count == 1 else f"{count} clients"


def _words(status: dict[str, Any]) -> list[str]:
    play = status["replay"]
    if play["waiting_for"]:
        pace = f"waiting for {_clients(play['waiting_for'])}"
    else:
        pace = "paused" if play["paused"] else f"x{play['achieved_rate']:.4f}"
    if play["behind_s"]:
        pace += f" of x{play['rate']:g}, late by {play['behind_s']:.1f} s"
    words = [f"{status['time_s']:7.2f} of {status['end_s']:.2f} s", pace, lateness_text(status)]
    if play["passes"] != 1:
        words.append(f"pass {play['pass']}" + (f" of {play['passes']}" if play["passes"] else ""))
    return words


def _print_summary(summary: dict[str, Any]) -> None:
    play = summary["replay"]
    echo(
        f"replay: {summary['reason']} at {summary['time_s']:.3f} s, pass {play['pass']}; "
        f"{summary['played_s']:.3f} s played in {summary['wall_s']:.3f} s, x{play['achieved_rate']:.5g} without pauses"
    )
    echo(
        f"{play['payloads']} payloads, {summary['blocks']} blocks, {summary['rows']} rows; "
        f"left out {summary['left_out']} payloads"
    )
    if play["rate"] is not None:
        echo(f"{lateness_summary(summary)}, overruns {summary['overruns']}")
        if play["behind_s"]:
            echo(
                f"warning: the replay ended {play['behind_s']:.1f} s late; for full speed use --burst",
                err=True,
            )
