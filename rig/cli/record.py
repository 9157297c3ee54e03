"""`rig record`: everything a rig publishes, into one file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.connection import Connect
from rig.errors import InputError, RefusedError
from rig.transport import DEFAULT_ENDPOINT, NoReplyError

if TYPE_CHECKING:
    from recorder.session import Progress, RecordingSession, Summary


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
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Record all streams of a running rig to FILE.mcap, losslessly; Ctrl-C ends the recording well."""
    import os

    from recorder.session import RIG_LOST, RecordingSession
    from recorder.writer import check_destination, check_view_rate
    from rig.transport.zenoh import ZenohClient

    check_destination(output, force=force)
    check_view_rate(view_rate_hz)
    if duration_s is not None and not duration_s > 0.0:
        raise InputError("duration_s", "above 0", duration_s)
    try:
        with ZenohClient(connect) as client:
            session = RecordingSession(
                client,
                output,
                name=f"recorder-{os.getpid()}",
                duration_s=duration_s,
                view_rate_hz=view_rate_hz,
                history=history,
                force=force,
            )
            summary = _run(session)
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
                status.update(
                    f"recording {session.path}: {progress.time_s:.1f} s, {progress.rows} samples, {lost}, "
                    f"{progress.size_bytes / 1e6:.1f} MB"
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
    typer.echo(
        f"{summary.path}: {summary.duration_s:.3f} s from {summary.first_time_s:.3f} s on, "
        f"{sum(sensors)} samples in {len(sensors)} streams, {truth} rows of truth, "
        f"{summary.size_bytes / 1e6:.1f} MB; ended: {summary.reason}"
    )
    if summary.lost or summary.missed:
        for key, lost in summary.lost.items():
            typer.echo(f"lost: {lost} rows of {key}")
        for key, missed in summary.missed.items():
            typer.echo(f"lost: {missed} messages of {key}, says the transport")
        typer.echo(f"the gaps ({summary.gaps}) are recorded in the file on recorder/gaps")
    else:
        typer.echo("lost: nothing")
    if summary.dropped:
        typer.echo(f"{summary.dropped} blocks found no room before the disk; they are among the lost")
    if summary.malformed:
        typer.echo(f"{summary.malformed} payloads were not what their key promises; they are in the file as they came")
    if summary.error:
        typer.echo(summary.error, err=True)
