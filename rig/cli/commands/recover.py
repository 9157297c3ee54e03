"""`rig recover`: complete recordings from files cut off by a kill or a full disk."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.base.errors import InputError, Words
from rig.cli.options import Force
from rig.cli.output.progress import reporting
from rig.cli.output.tables import echo


def recover(
    files: Annotated[list[Path], typer.Argument(metavar="FILE.mcap.part...", help="Unfinished files")],
    *,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="New file; default: FILE.recovered.mcap"),
    ] = None,
    force: Force = False,
) -> None:
    """Recover recordings that were cut off or damaged; the source files are not changed.

    A complete file is copied only with --force. Exit status 1 if rows or records are lost.
    """
    from recorder.files.unfinished_file import check_destination
    from recorder.rewrite import recovered_path
    from rig.base.files import build_read_error, open_file

    if output is not None and len(files) > 1:
        raise InputError("--output", "used with one FILE", Words(f"{len(files)} files"))
    for file in files:
        try:
            open_file(file).close()
        except OSError as error:
            raise build_read_error(file, error) from None
    broken = [file for file in files if force or not _is_whole(file)]
    outputs = [output or recovered_path(file) for file in broken]
    for new in outputs:
        check_destination(new, force=force)
    good = [_recover(file, new, force=force) for file, new in zip(broken, outputs, strict=True)]
    if not all(good):
        raise typer.Exit(1)


def _is_whole(file: Path) -> bool:
    from recorder.rewrite import is_whole

    with reporting() as report:
        whole = is_whole(file, on_progress=lambda done: report.part(done, f"reading {file}"))
    if whole:
        echo(f"{file} is complete: nothing to recover, nothing written (--force makes a copy)")
    return whole


def _recover(file: Path, new: Path, *, force: bool) -> bool:
    """Recover a file; return whether it is complete."""
    from recorder.rewrite import recover as recover_file

    with reporting() as report:
        result = recover_file(file, new, force=force, on_progress=lambda done: report.part(done, f"recovering {file}"))
    counts = result.counts
    lost = counts.undeclared_lost
    echo(
        f"{new}: {(counts.first_time_ns or 0) / 1e9:.3f} s to {counts.last_time_ns / 1e9:.3f} s, "
        f"{sum(counts.rows.values())} rows, {new.stat().st_size / 1e6:.1f} MB"
        + (f"; {result.damaged} damaged record{'s' * (result.damaged > 1)} skipped" if result.damaged else "")
        + "".join(f"; {text}: no checksum covers them" for text in result.unchecked)
        + (f"; {lost} {'row is' if lost == 1 else 'rows are'} missing in it" if lost else "")
        + "".join(f"; {text}" for text in result.missing_rows)
    )
    return not (result.damaged or lost or result.missing_rows)
