"""`rig view`: a recording or the running rig in the rerun viewer."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.base.errors import DiskError, InputError, RefusedError, Words
from rig.base.files import check_new_file, whole_file
from rig.cli.connections.connection import Connection
from rig.cli.options import Force, OptionalRecordingFiles
from rig.cli.output.progress import reporting
from rig.cli.output.tables import echo

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

    from recorder.viewer.window import Kind, Window

_PROGRESS_PERIOD_S = 5.0
"""Time between lines of progress without a live line [s]."""


def view(
    files: OptionalRecordingFiles = None,
    *,
    live: Annotated[bool, typer.Option("--live", help="View the running rig")] = False,
    connection: Connection,
    web: Annotated[bool, typer.Option("--web", help="Serve the viewer to a browser on this computer")] = False,
    save: Annotated[Path | None, typer.Option(help="Write an .rrd file instead of opening a viewer")] = None,
    screenshot: Annotated[Path | None, typer.Option(help="Write a .png picture instead of opening a viewer")] = None,
    at_s: Annotated[
        float | None, typer.Option(help="Time of the picture in s; default: last contact, or the end")
    ] = None,
    only: Annotated[
        str | None, typer.Option(metavar="TITLE", help="Show only views with this text in their title.")
    ] = None,
    force: Force = False,
) -> None:
    """View a recording, or the running rig, in rerun.

    With a display it opens a window; otherwise it serves the viewer on 127.0.0.1 and prints the address.
    """
    _check(files, live=live, web=web, save=save, screenshot=screenshot, at_s=at_s, force=force)
    _prepare_rerun()
    from recorder.viewer.window import WindowError

    try:
        with _interruptible():
            if live:
                _view_live(connection, web=web, save=save, only=only)
            elif files:
                _view_file(files, web=web, save=save, screenshot=screenshot, at_s=at_s, only=only)
    except WindowError as error:
        raise RefusedError(str(error)) from None


def _check(
    files: list[Path] | None,
    *,
    live: bool,
    web: bool,
    save: Path | None,
    screenshot: Path | None,
    at_s: float | None,
    force: bool,
) -> None:
    """Raise an error for options that exclude each other, before anything starts."""
    if bool(files) == live:
        raise InputError("view", "given either a FILE or --live", Words("both" if live else "neither"))
    if sum((web, save is not None, screenshot is not None)) > 1:
        raise InputError("view", "given at most one of --web, --save and --screenshot", Words("several"))
    if live and screenshot is not None:
        raise InputError("--screenshot", "used with a FILE", "--live")
    if at_s is not None and screenshot is None:
        raise InputError("--at-s", "used with --screenshot", at_s)
    for option, path, suffix in (("--save", save, ".rrd"), ("--screenshot", screenshot, ".png")):
        if path is not None:
            check_new_file(path, field=option, suffixes=(suffix,), force=force)


def _view_file(
    files: list[Path], *, web: bool, save: Path | None, screenshot: Path | None, at_s: float | None, only: str | None
) -> None:
    from recorder.reader import join
    from recorder.viewer import blueprint
    from recorder.viewer.canvas import Canvas, new_stream
    from recorder.viewer.drawings.geometry import Geometry
    from recorder.viewer.file import paint
    from recorder.viewer.painter import list_missing_views

    recording = join(files)
    name = recording.path.name + (f" and {len(files) - 1} more" if len(files) > 1 else "")
    for text in list_missing_views(recording.table):
        echo(f"not shown: {text}", err=True)
    stream = new_stream(name, batch_s=2.0)
    plan = blueprint.layout(recording.table, Geometry.from_parameters(recording.parameters), live=False, only=only)
    if save is not None:
        with _saved(stream, save, plan):
            painted = paint(recording, Canvas(stream))
        size = save.stat().st_size / 1e6
        echo(f"{save}: {size:.1f} MB, {painted.points} points of curves, {painted.end_s:.3f} s")
        return
    size = (1920, 1080) if only is None else (1100, 620)
    with _window_of_file(screenshot, web=web, size=size) as shown:
        _connect(stream, shown, plan)
        try:
            painted = paint(recording, Canvas(stream))
        finally:
            _close(stream, timeout_s=60.0)
        if screenshot is not None:
            if at_s is None:
                at_s = painted.end_s if painted.last_contact_s is None else painted.last_contact_s
            if not painted.start_s <= at_s <= painted.end_s:
                raise InputError("--at-s", f"in the recording, {painted.start_s:g} to {painted.end_s:g} s", at_s)
            shown.picture(screenshot, at_s=at_s, end_s=painted.end_s)
            echo(f"{screenshot}: at {at_s:.3f} s")
        else:
            _print_address(shown, name)
            _wait_for_the_end(shown)


def _view_live(connection: Connection, *, web: bool, save: Path | None, only: str | None) -> None:
    from recorder.viewer import blueprint, live, window
    from recorder.viewer.canvas import VIEWING_BATCH_S, Canvas, new_stream

    with connection.client() as client:
        described = live.request_document(client)
        batch_s = VIEWING_BATCH_S if save is None else live.SAVING_INTERVAL_S
        stream = new_stream(f"rig at {connection.connect}", batch_s=batch_s)
        plan = blueprint.layout(described.table, described.geometry, live=True, only=only)
        if save is not None:
            view = live.LiveView(client, Canvas(stream), described, interval_s=live.SAVING_INTERVAL_S)
            with _saved(stream, save, plan, live=True):
                echo(view.run())
            if view.failed:
                raise typer.Exit(1)
            return
        with window.Window(_kind(web=web), live=True) as shown:
            _connect(stream, shown, plan)
            _print_address(shown, f"the rig at {connection.connect}")
            try:
                view = live.LiveView(client, Canvas(stream), described, get_processed=shown.get_processed_picture)
                with reporting() as reporter:

                    def report(text: str) -> None:
                        if shown.page is not None:
                            shown.page.title = f"rig: {text}"
                        reporter.show(text, every_s=_PROGRESS_PERIOD_S)

                    reason = view.run(stop=lambda: not shown.open, on_message=report)
                echo(reason)
            finally:
                _close(stream)
            if shown.open:
                echo("the viewer stays open; end it with Ctrl-C")
            try:
                _wait_for_the_end(shown)
            finally:
                if view.failed:
                    raise typer.Exit(1)


def _window_of_file(screenshot: Path | None, *, web: bool, size: tuple[int, int]) -> Window:
    from recorder.viewer import window

    if screenshot is None:
        return window.Window(_kind(web=web))
    return window.open_headless(screenshot, on_message=lambda text: echo(text, err=True), size=size)


def _kind(*, web: bool) -> Kind:
    from recorder.viewer.window import screen_is_there

    return "web" if web or not screen_is_there() else "native"


def _print_address(shown: Window, what: str) -> None:
    # The address comes first, so that no terminal wraps it.
    echo(f"{shown.address} shows {what}" if shown.address else f"viewing {what}")
    if shown.page is not None:
        shown.page.title = f"rig: {what}"
    echo("Ctrl-C ends the viewer")
    sys.stdout.flush()  # shows the address at once, also in a pipe


def _wait_for_the_end(shown: Window) -> None:
    """Wait until the user closes the viewer or ends the command."""
    sys.stdout.flush()
    while not shown.wait(0.5):
        pass
    if shown.failure:
        raise RefusedError(f"the viewer failed: {shown.failure} (--web needs no graphics driver)")


def _prepare_rerun() -> None:
    """Keep rerun's log off the terminal, as a closed window is not an error here, and let it release memory at once."""
    import os

    os.environ.setdefault("RUST_LOG", "off")
    os.environ.setdefault("MIMALLOC_PURGE_DELAY", "0")  # ms; otherwise a live view grows for a quarter of an hour


def _connect(stream: rr.RecordingStream, shown: Window, plan: rrb.Blueprint) -> None:
    """Connect a stream to a viewer with our layout; a mere default would yield to the last layout shown."""
    stream.connect_grpc(shown.url)
    stream.send_blueprint(plan)


def _close(stream: rr.RecordingStream, *, timeout_s: float = 5.0) -> None:
    """Send the buffered data while the viewer is there."""
    with suppress(RuntimeError, ValueError):  # the viewer has closed
        stream.flush(timeout_sec=timeout_s)
    stream.disconnect()


@contextmanager
def _saved(stream: rr.RecordingStream, path: Path, plan: rrb.Blueprint, *, live: bool = False) -> Iterator[None]:
    """Write the drawing to a file that gets its name once it is complete.

    Args:
        stream: Stream to draw to.
        path: The file.
        plan: The blueprint.
        live: Keep the file after Ctrl-C, and write no table of contents, as rerun keeps it in memory until the end.
    """
    from recorder.viewer.canvas import piped

    with whole_file(path) as draft:
        with draft.open("wb") as file, piped(file) as pipe:
            stream.save(pipe, default_blueprint=plan, write_footer=not live)
            try:
                with suppress(*([KeyboardInterrupt] if live else [])):
                    yield
                stream.flush(timeout_sec=60.0)
            finally:
                stream.disconnect()
        # rerun only logs a failure; a complete file of a recording ends with its table of contents.
        with draft.open("rb") as file:
            file.seek(max(0, draft.stat().st_size - 64))
            if not live and b"RRF2FOOT" not in file.read():
                raise DiskError(f"{path} could not be written completely; it was removed")


@contextmanager
def _interruptible() -> Iterator[None]:
    """End the viewer normally on Ctrl-C and requests to terminate, with its child processes."""
    import signal

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    except KeyboardInterrupt:
        pass
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
