"""`rig sessions`: list the reference sessions, or record them again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.base.errors import InputError
from rig.cli.options import Force
from rig.cli.output.folder import check_folder
from rig.cli.output.progress import reporting
from rig.cli.output.tables import echo


def sessions(
    names: Annotated[list[str] | None, typer.Argument(metavar="[SESSION]...", help="Only these")] = None,
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="Record them again in this folder")
    ] = None,
    force: Force = False,
) -> None:
    """List or record again the reference sessions, small recordings that are installed with the rig.

    With -o, they are recorded again, and their quantities are written as text, for review as a diff.
    """
    from replays.sessions import FOLDER, SESSIONS, make

    chosen = names or list(SESSIONS)
    for name in chosen:
        if name not in SESSIONS:
            raise InputError("session", f"one of {', '.join(SESSIONS)}", name)
    if output is None:
        for name in chosen:
            echo(str(FOLDER / f"{name}.mcap"))
        return
    check_folder(output, field="--output")
    existing = [path for name in chosen for path in (output / f"{name}.mcap", output / f"{name}.toml") if path.exists()]
    if existing and not force:
        raise InputError("output", "a folder without these files (--force replaces them)", str(existing[0]))
    output.mkdir(exist_ok=True)
    with reporting() as reporter:
        reporter.begin(len(chosen))
        for name in chosen:
            recording, text = make(SESSIONS[name], output, step=reporter.step)
            echo(f"{recording}  {recording.stat().st_size / 1e3:.0f} kB, {text.name}")
