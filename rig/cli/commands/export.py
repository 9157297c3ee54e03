"""`rig export`: a recording in the formats of other programs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from rig.base.errors import InputError
from rig.cli.options import Force, FromS, RecordingFiles, ToS, split_names
from rig.cli.output.tables import echo

EXPORTED = "File: .mf4, .tdms, .uff, .csv, .parquet or .wav"
"""Endings of `FORMATS`, as in `import_`."""


def export(
    files: RecordingFiles,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help=EXPORTED)],
    channels: Annotated[
        str | None,
        typer.Option("--channels", metavar="NAME,...", help="Only these channels, groups or truth.TABLE[.COLUMN]"),
    ] = None,
    truth: Annotated[bool, typer.Option("--truth", help="Also export the true state of the model")] = False,
    unit: Annotated[str, typer.Option(metavar="engineering|volts|counts", help="Unit of the samples")] = "engineering",
    from_s: FromS = None,
    to_s: ToS = None,
    rate_hz: Annotated[float | None, typer.Option(help="Resample all channels to this rate in Hz")] = None,
    method: Annotated[
        str, typer.Option(metavar="polyphase|linear", help="Resampling method; polyphase is band-limited")
    ] = "polyphase",
    force: Force = False,
) -> None:
    """Write a recording as MDF4, TDMS, UFF58b, CSV, Parquet or WAV, with units and calibration.

    Impacts, commands, notes, parameters and scene are included: in MDF4 as events and attachments, for CSV and WAV in
    FILE.json; UFF58 has none of them. A CSV, Parquet or WAV file holds one rate: channels with several rates become
    several files, unless --rate-hz resamples them.
    """
    from recorder.reader import join
    from replays.recordings.formats.exporting.export import check_output, holds_one_table
    from replays.recordings.formats.exporting.export import export as write
    from replays.recordings.formats.exporting.selection import select
    from rig.base.wire import EDGES
    from rig.cli.output.progress import reporting

    if unit not in ("engineering", "volts", "counts"):
        raise InputError("--unit", "engineering, volts or counts", unit)
    if method not in ("polyphase", "linear"):
        raise InputError("--method", "polyphase or linear", method)
    check_output(output, force=force)
    bounds = -math.inf if from_s is None else from_s, math.inf if to_s is None else to_s
    recording = join(files, in_part=bounds != (-math.inf, math.inf)).between(*bounds)
    selection = select(
        recording, channels=split_names(channels, "--channels"), truth=truth, unit=unit, from_s=from_s, to_s=to_s,
        merged=holds_one_table(output),
    )  # fmt: skip
    with reporting() as reporter:

        def report_progress(part: float) -> None:
            reporter.part(part, f"exporting {recording.path.name}")

        written = write(selection, output, rate_hz=rate_hz, method=method, force=force, progress=report_progress)
    for line in recording.doubts:  # the export is incomplete or uncertain
        echo(f"rig: {line}", err=True)
    for exported in written:
        size = exported.path.stat().st_size / 1e6
        echo(f"{exported.path}: {exported.columns} columns, {size:.1f} MB, {unit}")
        for name, rate, rows, missing in exported.tables:
            lost = f", {missing} missing" if missing else ""
            echo(f"  {name}: {rows} rows at {rate:g} Hz{lost}")
        echo(f"  {exported.documents}")
    if EDGES in recording.streams:
        echo("left out: the exact times of the keyphasor's edges (the channel keyphasor has the pulses)")
