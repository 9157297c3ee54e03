"""`rig cut`: cut a part from a recording, or join its files."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import Channels, Force, FromS, RecordingFiles, ToS, split_names
from rig.cli.output.progress import reporting
from rig.cli.output.tables import echo


class Only(StrEnum):
    """Streams that are kept."""

    SENSORS = "sensors"
    TRUTH = "truth"


def cut(
    files: RecordingFiles,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="New recording, .mcap")],
    from_s: FromS = None,
    to_s: ToS = None,
    only: Annotated[Only | None, typer.Option(help="Keep only these streams")] = None,
    channels: Channels = None,
    force: Force = False,
) -> None:
    """Cut a part from a recording, or join the files of a run; payloads are copied unchanged, trimmed at the edges."""
    from recorder.files.unfinished_file import check_destination
    from recorder.reader import join
    from recorder.rewrite import cut as cut_recording

    check_destination(output, force=force)
    with reporting() as report:
        result = cut_recording(
            join(files, in_part=from_s is not None or to_s is not None),
            output,
            from_s=-math.inf if from_s is None else from_s,
            to_s=math.inf if to_s is None else to_s,
            only=None if only is None else Only(only).value,
            channels=tuple(split_names(channels, "--channels")),
            force=force,
            on_progress=lambda done: report.part(done, f"writing {output}"),
        )
    for line in result.missing_rows:
        echo(f"rig: {line}", err=True)
    counts = result.counts
    echo(
        f"{output}: {(counts.first_time_ns or 0) / 1e9:.4f} s to {counts.last_time_ns / 1e9:.4f} s, "
        f"{sum(counts.rows.values())} rows in {len(counts.rows)} streams, {output.stat().st_size / 1e6:.1f} MB"
    )
