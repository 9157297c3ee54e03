"""`rig record`: all streams of a rig in one file, in several, or in one around each trigger."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.errors import InputError
from rig.base.text import printable
from rig.cli.connections.connection import Connection
from rig.cli.groups import panel
from rig.cli.options import Force
from rig.cli.output.display import fit_width
from rig.cli.output.tables import echo, plain_text, table_console
from rig.run.commands import SUMMARIES

if TYPE_CHECKING:
    from recorder.contents.summary import Progress, Summary
    from recorder.output.disk_limits import DiskLimits
    from recorder.output.trigger import Capture
    from recorder.session import RecordingSession
    from rig.serve.transport.zenoh import ZenohClient

_EVENTS = ", ".join([*filter(SUMMARIES.get, SUMMARIES), "note", "warning"])
"""Events that start a capture, as in `recorder.output.trigger`; a test compares them."""
_files, _triggers, _disk = panel("Several files"), panel("Around triggers"), panel("The disk")


class WhenFull(StrEnum):
    """Action at the disk limit."""

    STOP = "stop"
    REMOVE_OLDEST = "remove-oldest"


class RetriggerAction(StrEnum):
    """Effect of a trigger during a capture."""

    EXTEND = "extend"
    IGNORE = "ignore"


_PRE_S, _POST_S = 0.5, 2.0
_SPINNER = 2
"""Width of the spinner with its space [columns]."""


@dataclass(frozen=True)
class Rotation:
    """Limits of size and time at which a new file starts."""

    rotate_mb: Annotated[float | None, _files("Start a new file at about this size in MB: NAME.0000.mcap")] = None
    rotate_s: Annotated[float | None, _files("Start a new file after this simulated time in s")] = None


@dataclass(frozen=True)
class Triggers:
    """Triggers of captures; without triggers all is recorded."""

    trigger: Annotated[
        list[str] | None,
        _triggers(
            f"Record only around an event ({_EVENTS}) or a level such as "
            "'|disk_x|>0.5' or 'P_E>3200' (unit of the channel, preload included); repeatable. A level triggers at a "
            "crossing, and again after 0.25 s below it. One file each: NAME.hammer-001.mcap",
            metavar="EVENT|LEVEL",
        ),
    ] = None
    pre_s: Annotated[
        float | None, _triggers("Simulated time kept before a trigger in s", show_default=f"{_PRE_S:g}")
    ] = None
    post_s: Annotated[
        float | None, _triggers("Simulated time kept after a trigger in s", show_default=f"{_POST_S:g}")
    ] = None
    longest_s: Annotated[float | None, _triggers("Longest capture in s of simulated time", show_default="60")] = None
    trigger_count: Annotated[int | None, _triggers("Stop after this number of captures")] = None
    again: Annotated[
        RetriggerAction | None,
        _triggers(
            "Effect of a trigger during a capture",
            show_default="extend for events, ignore for levels",
        ),
    ] = None

    def capture(self) -> Capture | None:
        """Return what to capture of a run, or None to record all of it.

        Raises:
            InputError: A trigger is invalid, or the other options are given without a trigger.
        """
        from recorder.output.trigger import Capture, Trigger

        around = {
            "pre_s": self.pre_s,
            "post_s": self.post_s,
            "count": self.trigger_count,
            "again": None if self.again is None else RetriggerAction(self.again).value,
            "longest_s": self.longest_s,
        }
        options = {name: value for name, value in around.items() if value is not None}
        triggers = tuple(Trigger.parse(text) for text in self.trigger or ())
        if options and not triggers:
            name, value = next(iter(options.items()))
            raise InputError("trigger_count" if name == "count" else name, "used with --trigger", value)
        settings: dict[str, Any] = {"pre_s": _PRE_S, "post_s": _POST_S, **options}
        return Capture(triggers, **settings) if triggers else None


@dataclass(frozen=True)
class Disk:
    """Limits of disk space and memory."""

    budget_mb: Annotated[float | None, _disk("Limit of all files of this recording in MB")] = None
    keep_free_mb: Annotated[float, _disk("Free disk space to leave in MB")] = 100.0
    when_full: Annotated[WhenFull, _disk("At a disk limit: stop, or remove the oldest file")] = WhenFull.STOP
    backlog_mb: Annotated[float, _disk("Memory for data that waits for the disk in MB; more is lost")] = 256.0

    def limits(self, rotation: Rotation) -> DiskLimits:
        """Return the limits of file size and disk space.

        Raises:
            InputError: The backlog is out of range.
        """
        from recorder.output.disk_limits import DiskLimits

        if not 1.0 <= self.backlog_mb <= 1e5:
            raise InputError("backlog_mb", "from 1 to 1e5", self.backlog_mb)
        return DiskLimits(
            rotate_mb=rotation.rotate_mb,
            rotate_s=rotation.rotate_s,
            budget_mb=self.budget_mb,
            keep_free_mb=self.keep_free_mb,
            when_full=WhenFull(self.when_full).value,
        )


def record(
    output: Annotated[Path, typer.Option("--output", "-o", help="File to record to, .mcap")],
    *,
    connection: Connection,
    duration_s: Annotated[
        float | None, typer.Option(help="Simulated time to record in s; default: until the run ends")
    ] = None,
    view_rate_hz: Annotated[float, typer.Option(help="Rate of the messages for plots in Hz; 0: none")] = 500.0,
    history: Annotated[bool, typer.Option(help="Include earlier data, as far as the rig's cache has it")] = False,
    patience_s: Annotated[
        float,
        typer.Option(
            metavar="S",
            help="Time to wait for a lost rig to return in s; then continue",
            min=0.0,
        ),
    ] = 10.0,
    force: Force = False,
    rotation: Rotation,
    triggers: Triggers,
    disk: Disk,
) -> None:
    """Record all streams of a running rig to FILE.mcap, without loss; Ctrl-C ends the recording.

    Exit status: 0 the recording is complete; 1 rows or messages were lost, the run failed, the rig was lost or the disk
    was full (the losses are listed and the rest is kept); 2 wrong input.
    """
    import os

    from recorder.output.disk_limits import MB
    from recorder.session import RecordingSession

    limits, capture = disk.limits(rotation), triggers.capture()

    def create_session(client: ZenohClient | None) -> RecordingSession:
        return RecordingSession(
            client,  # type: ignore[arg-type]  # None in the first call, which only checks the options
            output,
            name=f"recorder-{os.getpid()}",
            duration_s=duration_s,
            view_rate_hz=view_rate_hz,
            history=history,
            patience_s=patience_s,
            force=force,
            limits=limits,
            capture=capture,
            inbox_bytes=round(disk.backlog_mb * MB),
        )

    create_session(None)  # checks the options before it connects
    with connection.client() as client:
        summary = run_session(create_session(client))
    print_result(summary)
    if not summary.good:
        raise typer.Exit(1)


def run_session(session: RecordingSession) -> Summary:
    """Record with a line of progress; the first SIGINT or SIGTERM ends the recording, a second one interrupts it."""
    import signal

    ends = (signal.SIGINT, signal.SIGTERM)

    def stop(number: int, _: object) -> None:
        session.stop(f"interrupted by {signal.Signals(number).name}")
        for ending in ends:
            signal.signal(ending, before[ending])

    def print_remarks(lines: tuple[str, ...]) -> None:
        nonlocal printed_count
        for line in lines[printed_count:]:
            console.print(line, soft_wrap=True)
        printed_count = len(lines)

    before = {number: signal.signal(number, stop) for number in ends}
    console = table_console(stderr=True)
    printed_count, has_begun, files = 0, False, session.first_files
    more = "" if files == [session.path] else ", ..."
    name = f"recording {printable(' or '.join(file.name for file in files), 30)}{more}"
    try:
        with console.status(plain_text(f"{name}: waiting for the rig")) as status:

            def show(progress: Progress) -> None:
                nonlocal has_begun
                if progress.rows and not has_begun and not console.is_terminal:
                    into = printable(" or ".join(map(str, files))) + more
                    echo(f"rig: recording {into}; Ctrl-C ends it well", err=True)  # scripts wait for this line
                has_begun = has_begun or progress.rows > 0
                print_remarks(progress.remarks)
                lost = f"{progress.lost} lost"
                parts = [
                    f"{name}: {progress.time_s:.1f} s",
                    lost,
                    f"{progress.size_bytes / 1e6:.1f} MB",
                    *([f"{progress.backlog_bytes / 1e6:.1f} MB waiting"] if progress.backlog_bytes > 1e6 else []),
                    *([f"{progress.files} files finished"] if progress.files else []),
                    f"{progress.rows} samples",
                ]
                line = plain_text(fit_width(parts, console.width - _SPINNER, ", "))
                line.highlight_words([lost] if progress.lost else [], "red")
                status.update(line)

            summary = session.run(show)
            print_remarks(summary.remarks)
            return summary
    finally:
        for number in ends:
            signal.signal(number, before[number])


def print_result(summary: Summary) -> None:
    """Print the result of a recording."""
    from rig.base.wire import SENSORS, TRUTH

    sensors = [rows for key, rows in summary.rows.items() if key.startswith(SENSORS + "/")]
    truth = sum(rows for key, rows in summary.rows.items() if key.startswith(TRUTH + "/"))
    files = str(summary.path)
    if len(summary.files) > 1:
        files = f"{summary.files[0]} to {summary.path.name} ({len(summary.files)} files)"
    elif not summary.files:
        files = f"{summary.path}: no file"
    triggers = "1 trigger" if summary.fired == 1 else f"{summary.fired} triggers"
    if summary.fired is not None and not summary.files:
        trigger_text = triggers if summary.fired else "no trigger"
        echo(f"{trigger_text} in {summary.received_s:.3f} s; nothing written; ended: {summary.reason}")
    else:
        around = ""
        if summary.fired is not None:
            around = f" (around {triggers}, of {summary.received_s:.3f} s received)"
        echo(
            f"{files}: {summary.duration_s:.3f} s from {summary.first_time_s:.3f} s on{around}, "
            f"{sum(sensors)} samples in {len(sensors)} streams, {f'{truth} rows of' if truth else 'no'} truth, "
            f"{summary.size_bytes / 1e6:.1f} MB; ended: {summary.reason}"
        )
    if summary.removed:
        echo(f"{summary.removed} older files were removed to free disk space")
    for line in summary.losses or ("nothing",):
        echo(f"lost: {line}")
    for key, rows in summary.declared.items():
        echo(f"not lost: {rows} rows of {key}, removed or delayed by a declared fault")
    if summary.lost or summary.missed:
        inside = ", those inside a capture," if summary.fired is not None else ""
        echo(f"the gaps ({summary.gaps}){inside} are recorded in the file on recorder/gaps")
    if summary.dropped:
        echo(
            f"{summary.dropped} blocks exceeded the memory limit; they are included in the losses "
            f"(at most {summary.high_water_bytes / 1e6:.1f} MB were waiting)"
        )
    if summary.malformed:
        echo(f"{summary.malformed} payloads did not match the schema of their key; they are recorded unchanged")
    if summary.refused:
        echo(f"{summary.refused} messages were invalid or from another rig; they were left out")
    if summary.error:
        echo(summary.error, err=True)
