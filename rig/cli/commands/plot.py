"""`rig plot`: the usual pictures of a recording, each with its numbers."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from rig.base.errors import InputError
from rig.cli.options import FromS, RecordingFiles, RunOut, ToS, split_names, subtract_run_out
from rig.cli.output.folder import check_folder
from rig.cli.output.progress import reporting
from rig.cli.output.tables import echo


def plot(
    files: RecordingFiles,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FOLDER", help="Folder for pictures and tables")],
    only: Annotated[str | None, typer.Option(metavar="orbit,bode", help="Draw only these kinds of plots")] = None,
    from_s: FromS = None,
    to_s: ToS = None,
    runout: RunOut = None,
    svg: Annotated[bool, typer.Option("--svg", help="Write pictures as SVG, not PNG")] = False,
    parquet: Annotated[bool, typer.Option("--parquet", help="Write tables as Parquet, not CSV")] = False,
) -> None:
    """Draw orbit, spectra, Bode plot and others of a recording, with the numbers of each.

    Each pair of probes, such as disk_x and disk_y, has a picture of each kind: orbit-disk.png, with its numbers in
    orbit-disk.csv. Plots that the data do not allow, such as a Bode plot at constant speed, are left out, with the
    reason. Existing files are replaced.
    """
    from recorder.reader import join
    from replays.plots.methods import list_pictures
    from replays.plots.signals import read_signals

    check_folder(output, field="--output")
    bounds = -math.inf if from_s is None else from_s, math.inf if to_s is None else to_s
    recording = join(files, in_part=bounds != (-math.inf, math.inf)).between(*bounds)
    (recording,) = subtract_run_out(runout, recording, show=partial(echo, err=True))
    signals = read_signals(recording, from_s=from_s, to_s=to_s)
    pictures, written = list_pictures(signals, split_names(only, "--only")), list[Path]()
    left_out: dict[tuple[str, str], tuple[list[str], InputError]] = {}
    with reporting() as reporter:
        reporter.begin(len(pictures))
        for name, draw in pictures.items():
            try:
                drawn = draw()
            except InputError as error:
                left_out.setdefault((error.field, error.must), ([], error))[0].append(name)
            else:
                output.mkdir(exist_ok=True)
                path = output / f"{name}{'.svg' if svg else '.png'}"
                written += drawn.save(path, table=".parquet" if parquet else ".csv", source=str(recording.path))
                drawn.axes[0].figure.clear()  # frees its arrays now, not at a later garbage collection
            reporter.step(name)
    if only and left_out and not written:
        raise next(reversed(left_out.values()))[1]
    for path in written:
        echo(path)
    for names, reason in left_out.values():
        echo(f"left out: {', '.join(names)}: {reason}", err=True)
    if not written:
        raise InputError("files", "recordings from which something can be drawn", str(recording.path))
