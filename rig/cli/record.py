"""`rig record`: everything a rig publishes, into one file, several, or one around each trigger."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.connection import Connect
from rig.cli.options import Force
from rig.errors import InputError, RefusedError
from rig.transport import DEFAULT_ENDPOINT, NoReplyError

if TYPE_CHECKING:
    from recorder.session import Progress, RecordingSession, Summary

_FILES, _TRIGGERS, _DISK = "Several files", "Around triggers", "The disk"


class WhenFull(StrEnum):
    """What happens when there is no more room."""

    STOP = "stop"
    REMOVE_OLDEST = "remove-oldest"


class Again(StrEnum):
    """What a trigger does during a capture."""

    EXTEND = "extend"
    IGNORE = "ignore"


def record(
    output: Annotated[Path, typer.Option("--output", "-o", help="File to record to, ends in .mcap.")],
    *,
    connect: Connect = DEFAULT_ENDPOINT,
    duration_s: Annotated[
        float | None, typer.Option(help="Simulated time to record, in s; without it until the rig's run ends.")
    ] = None,
    view_rate_hz: Annotated[
        float, typer.Option(help="Rate of the messages for plots, in Hz; 0 leaves them out.")
    ] = 500.0,
    history: Annotated[
        bool, typer.Option(help="From the start of the run on, as far as the rig's cache reaches.")
    ] = False,
    force: Force = False,
    rotate_mb: Annotated[
        float | None,
        typer.Option(help="A new file at about this size, in MB: NAME.0000.mcap, ...", rich_help_panel=_FILES),
    ] = None,
    rotate_s: Annotated[
        float | None, typer.Option(help="A new file after this simulated time, in s.", rich_help_panel=_FILES)
    ] = None,
    trigger: Annotated[
        list[str] | None,
        typer.Option(
            help="Record only around this: an event (hammer, speed, release, note, warning) or a level such as "
            "'P_E>500' or '|disk_x|>0.5'; may be repeated. One file each: NAME.hammer-001.mcap, ...",
            rich_help_panel=_TRIGGERS,
        ),
    ] = None,
    pre_s: Annotated[
        float, typer.Option(help="Simulated time kept before a trigger, in s.", rich_help_panel=_TRIGGERS)
    ] = 0.5,
    post_s: Annotated[
        float, typer.Option(help="Simulated time kept after a trigger, in s.", rich_help_panel=_TRIGGERS)
    ] = 2.0,
    trigger_count: Annotated[
        int | None, typer.Option(help="End after so many captures.", rich_help_panel=_TRIGGERS)
    ] = None,
    again: Annotated[
        Again, typer.Option(help="What a trigger does during a capture.", rich_help_panel=_TRIGGERS)
    ] = Again.EXTEND,
    budget_mb: Annotated[
        float | None, typer.Option(help="What all files of this recording may take, in MB.", rich_help_panel=_DISK)
    ] = None,
    keep_free_mb: Annotated[
        float, typer.Option(help="Room to leave on the disk, in MB.", rich_help_panel=_DISK)
    ] = 100.0,
    when_full: Annotated[
        WhenFull,
        typer.Option(
            help="At the budget, or with no more room: end, or remove the oldest file.", rich_help_panel=_DISK
        ),
    ] = WhenFull.STOP,
    backlog_mb: Annotated[
        float,
        typer.Option(help="What may wait in memory for a slow disk, in MB; more is a gap.", rich_help_panel=_DISK),
    ] = 256.0,
) -> None:
    """Record all streams of a running rig to FILE.mcap, losslessly; Ctrl-C ends the recording well."""
    import os

    from recorder.series import MB, Limits
    from recorder.session import RIG_LOST, RecordingSession
    from recorder.trigger import Capture, Trigger
    from rig.transport.zenoh import ZenohClient

    if not 1.0 <= backlog_mb <= 1e5:
        raise InputError("backlog_mb", "from 1 to 1e5", backlog_mb)
    limits = Limits(
        rotate_mb=rotate_mb,
        rotate_s=rotate_s,
        budget_mb=budget_mb,
        keep_free_mb=keep_free_mb,
        when_full=WhenFull(when_full).value,
    )
    triggers = tuple(Trigger.parse(text) for text in trigger or ())
    capture = Capture(triggers, pre_s, post_s, trigger_count, Again(again).value) if triggers else None
    if capture is None and trigger_count is not None:
        raise InputError("trigger_count", "used with --trigger", trigger_count)

    def session_of(client: ZenohClient | None) -> RecordingSession:
        return RecordingSession(
            client,  # type: ignore[arg-type]  # only checked, in the first of two calls
            output,
            name=f"recorder-{os.getpid()}",
            duration_s=duration_s,
            view_rate_hz=view_rate_hz,
            history=history,
            force=force,
            limits=limits,
            capture=capture,
            inbox_bytes=round(backlog_mb * MB),
        )

    session_of(None)  # whatever is wrong with the options is said before a rig is looked for
    try:
        with ZenohClient(connect) as client:
            summary = _run(session_of(client))
    except NoReplyError as error:
        raise RefusedError(str(error)) from None
    _tell(summary)
    if summary.error or summary.reason == RIG_LOST:
        raise typer.Exit(1)


def _run(session: RecordingSession) -> Summary:
    """Record with a line of progress; the first SIGINT or SIGTERM ends it well, a second one at once."""
    import signal

    from rich.console import Console

    ends = (signal.SIGINT, signal.SIGTERM)

    def stop(number: int, _: object) -> None:
        session.stop(f"interrupted by {signal.Signals(number).name}")
        for each in ends:
            signal.signal(each, before[each])

    before = {number: signal.signal(number, stop) for number in ends}
    try:
        with Console(stderr=True).status(f"recording {session.path}: waiting for the rig") as status:

            def show(progress: Progress) -> None:
                lost = f"[red]{progress.lost} lost[/]" if progress.lost else "0 lost"
                files = f", {progress.files} files finished" if progress.files else ""
                backlog = f", {progress.backlog_bytes / 1e6:.1f} MB wait" if progress.backlog_bytes > 1e6 else ""
                status.update(
                    f"recording {session.path}: {progress.time_s:.1f} s, {progress.rows} samples, {lost}, "
                    f"{progress.size_bytes / 1e6:.1f} MB{files}{backlog}"
                )

            return session.run(show)
    finally:
        for number in ends:
            signal.signal(number, before[number])


def _tell(summary: Summary) -> None:
    """What became of a recording, line by line."""
    from rig.wire import SENSORS, TRUTH

    sensors = [rows for key, rows in summary.rows.items() if key.startswith(SENSORS + "/")]
    truth = sum(rows for key, rows in summary.rows.items() if key.startswith(TRUTH + "/"))
    files = str(summary.path)
    if len(summary.files) > 1:
        files = f"{summary.files[0]} to {summary.path.name} ({len(summary.files)} files)"
    elif not summary.files:
        files = f"{summary.path}: no file"
    typer.echo(
        f"{files}: {summary.duration_s:.3f} s from {summary.first_time_s:.3f} s on, "
        f"{sum(sensors)} samples in {len(sensors)} streams, {truth} rows of truth, "
        f"{summary.size_bytes / 1e6:.1f} MB; ended: {summary.reason}"
    )
    if summary.removed:
        typer.echo(f"{summary.removed} older files were removed to make room")
    if summary.lost or summary.missed:
        for key, lost in summary.lost.items():
            typer.echo(f"lost: {lost} rows of {key}")
        for key, missed in summary.missed.items():
            typer.echo(f"lost: {missed} messages of {key}, says the transport")
        typer.echo(f"the gaps ({summary.gaps}) are recorded in the file on recorder/gaps")
    else:
        typer.echo("lost: nothing")
    if summary.dropped:
        typer.echo(
            f"{summary.dropped} blocks found no room before the disk; they are among the lost "
            f"(at most {summary.high_water_bytes / 1e6:.1f} MB waited)"
        )
    if summary.malformed:
        typer.echo(f"{summary.malformed} payloads were not what their key promises; they are in the file as they came")
    if summary.error:
        typer.echo(summary.error, err=True)
