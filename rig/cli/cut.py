"""`rig cut`: a part of a recording, or the parts of one joined, to a new file."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.progress import reporting


class Only(StrEnum):
    """Which streams are kept."""

    SENSORS = "sensors"
    TRUTH = "truth"


def cut(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings of one run, in any order.")],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="The new file, ends in .mcap.")],
    from_s: Annotated[float, typer.Option("--from", metavar="S", help="Begin, in s of simulated time.")] = -math.inf,
    to_s: Annotated[float, typer.Option("--to", metavar="S", help="End, in s of simulated time.")] = math.inf,
    only: Annotated[Only | None, typer.Option(help="Leave the others out.")] = None,
    channels: Annotated[
        str, typer.Option(metavar="NAME,NAME...", help="Keep only these channels of the sensors.")
    ] = "",
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Cut a recording, or join several files of one run; what is kept is kept byte for byte, trimmed at the edges."""
    from recorder.reader import join
    from recorder.rewrite import cut as cut_recording
    from recorder.writer import check_destination

    check_destination(output, force=force)
    with reporting() as report:
        made = cut_recording(
            join(files),
            output,
            from_s=from_s,
            to_s=to_s,
            only=None if only is None else Only(only).value,
            channels=tuple(name.strip() for name in channels.split(",") if name.strip()),
            force=force,
            on_progress=lambda done: report.part(done, f"writing {output}"),
        )
    counts = made.counts
    typer.echo(
        f"{output}: {(counts.first_time_ns or 0) / 1e9:.4f} s to {counts.last_time_ns / 1e9:.4f} s, "
        f"{sum(counts.rows.values())} rows in {len(counts.rows)} streams, {output.stat().st_size / 1e6:.1f} MB"
    )
