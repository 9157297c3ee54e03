"""`rig demo`: one complete session, from the service to the verdict."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated

import typer

from rig.base.files import open_output
from rig.cli.output.tables import Table, echo, new_table, table_console

if TYPE_CHECKING:
    import subprocess

    from replays.recordings.verdict import Verdict

    Process = subprocess.Popen[bytes]

_STABLE_S = 3.0
_READY_S = 60.0
"""Time limit for the start of a service on a slow machine [s]."""
_CLOSE_S = 60.0
"""Time limit for service and recorder to close [s]."""


def demo(
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="New folder for the files")
    ] = None,
    speed_hz: Annotated[float, typer.Option(min=1.0, max=15.0, help="Spin speed in Hz")] = 6.2,
    whirl_s: Annotated[float, typer.Option(min=3.0, max=600.0, help="Time after the impact in s")] = 15.0,
) -> None:
    """Start the service, record an impact and the whirl, stop; then judge and draw the recording (about 30 s)."""
    import time
    from datetime import datetime

    from rig.base.errors import InputError, Words

    folder = output or Path(f"rig-demo-{datetime.now().astimezone():%Y%m%d-%H%M%S}")
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise InputError("--output", "a new folder", str(folder)) from None
    except OSError as error:
        raise InputError("--output", "a folder that can be made", Words(f"{folder} ({error.strerror})")) from None
    begin = time.perf_counter()

    def print_line(text: str) -> None:
        echo(f"[{time.perf_counter() - begin:5.1f} s] {text}")

    file, picture = folder / "demo.mcap", folder / "demo.png"
    _record_session(file, speed_hz=speed_hz, whirl_s=whirl_s, print_line=print_line)

    print_line("reading the recording")
    from rich.text import Text

    from recorder.reader import Recording
    from replays.recordings.picture import draw
    from replays.recordings.verdict import judge

    recording = Recording.open(file)
    verdict = judge(recording)
    draw(recording, picture)
    console = table_console()
    console.print(verdict_table(verdict))
    if verdict.remark:
        console.print(Text(verdict.remark, "yellow"))
    print_line(f"verdict: {'pass' if verdict.good else 'fail'}")
    echo(f"\nrecording   {file}\npicture     {picture}\nview        rig view {file}   (or: rerun {file})")
    if not verdict.good:
        raise typer.Exit(1)


def _record_session(file: Path, *, speed_hz: float, whirl_s: float, print_line: Callable[[str], None]) -> None:
    """Run service and recorder as processes, and command them until the file is closed."""
    import time

    from drivers.console import Console
    from rig.cli.output.progress import reporting
    from rig.run.scenes import load_scene
    from rig.run.simulation import Simulation
    from rig.serve.transport.endpoint import free_port
    from rig.serve.transport.zenoh import ZenohClient

    with reporting(compiles=True) as reporter:
        reporter.show_activity("loading the kernels")
        Simulation(load_scene("stable-run")).warm_up()  # compiles here, where the user sees the progress
    endpoint = f"127.0.0.1:{free_port()}"
    with _processes(file.with_name("processes.log")) as start:
        print_line(f"starting the service: rig run stable-run --set drive.speed_hz={speed_hz:g} --listen {endpoint}")
        arguments = ("--set", f"drive.speed_hz={speed_hz}", "--duration-s", "3600", "--listen", endpoint)
        service = start("run", "stable-run", *arguments)
        _wait_until_up(endpoint, service)
        recorder = start("record", "-o", str(file), "--connect", endpoint, "--history")
        with ZenohClient(endpoint, wait_s=5.0) as client:
            console = Console(client, name="rig demo")
            print_line(f"service up, recording to {file}; spinning without contact for {_STABLE_S:g} s")
            time.sleep(_STABLE_S)
            pulse = console.hammer(force_n=100.0, duration_ms=5.0, direction="x")
            effect = f"takes effect at {pulse.time_s:.3f} s of simulated time"
            print_line(f"hammer: 100 N for 5 ms along x; command {pulse.id}, {effect}")
            for _ in range(3):
                time.sleep(whirl_s / 3)
                status = console.status()
                late = status["lateness_ms"]
                lateness = f"{late['p50']:.3f} ms (p50), {late['p99']:.3f} ms (p99)"
                print_line(f"spin {status['spin_hz']:.3f} Hz; blocks late by {lateness}")
            console.stop()
        print_line("stopped; the recorder closes its file")
        service.wait(_CLOSE_S)
        if recorder.wait(_CLOSE_S) != 0:
            raise typer.Exit(_report_failure(file.with_name("processes.log"), "the recorder failed"))


@contextmanager
def _processes(log: Path) -> Iterator[Callable[..., Process]]:
    """Yield a function that starts `rig` commands; their output is logged, and they end with the block."""
    import subprocess
    import sys

    started: list[Process] = []
    file: IO[str] = open_output(log, "w")

    def start(*arguments: str) -> Process:
        # -P: a user's file in the working directory must not shadow a package of the rig.
        command = [sys.executable, "-P", "-m", "rig", *arguments]
        started.append(subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, stderr=file))
        return started[-1]

    try:
        yield start
    finally:
        for process in reversed(started):
            if process.poll() is None:
                process.terminate()
                try:
                    process.wait(10)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
        file.close()


def _wait_until_up(endpoint: str, service: Process) -> None:
    from rig.base.wire import STATUS
    from rig.serve.transport import NoReplyError
    from rig.serve.transport.zenoh import ZenohClient
    from rig.serve.waiting import Deadline

    for _ in Deadline(_READY_S).polls(0.2):
        if service.poll() is not None:
            break
        with suppress(NoReplyError), ZenohClient(endpoint) as client:
            client.request(STATUS)
            return
    raise typer.Exit(
        _report_failure(None, f"the service did not start (status {service.poll()}); see processes.log in the folder")
    )


def _report_failure(log: Path | None, text: str) -> int:
    echo(f"rig: {text}" + (f"; see {log}" if log else ""), err=True)
    return 1


def verdict_table(verdict: Verdict) -> Table:
    """Return the lines of a verdict as a table."""
    from rich.text import Text

    texts = ("quantity", "measured", "expected")
    table = new_table("Verdict, from the recorded samples", *texts, "verdict", wrapped=texts)
    marks = {True: Text("pass", "green"), False: Text("FAIL", "bold red"), None: ""}
    for row in verdict.rows:
        table.add_row(row.quantity, row.measured, row.expected, marks[row.good])
    return table
