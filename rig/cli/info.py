"""`rig info`: what a recording holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def info(file: Annotated[Path, typer.Argument(help="A recording, finished or cut off.")]) -> None:
    """Show contents, calibration, gaps, events and end of a recording."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from recorder.reader import Recording
    from recorder.schemas import event_text

    recording = Recording.open(file)
    console = Console(highlight=False)
    about = recording.metadata["rig"]
    streams = recording.streams
    first_s = min((stream.first_time_s for stream in streams.values() if stream.rows), default=0.0)
    last_s = max((stream.last_time_s for stream in streams.values() if stream.rows), default=0.0)
    state = "complete" if recording.complete else "not complete"
    for name, value in (
        ("file", f"{file}, {file.stat().st_size / 1e6:.1f} MB, {state}"),
        ("scene", f"{about['scene']}, seed {about['seed']}, parameters {about['parameter_set']}"),
        ("recorded", about["created"]),
        ("time", f"{first_s:.4f} s to {last_s:.4f} s ({last_s - first_s:.4f} s simulated)"),
        ("ended", recording.end_reason),
    ):
        console.print(Text.assemble((f"{name:9}", "bold"), value), soft_wrap=True)

    table = Table("stream", box=None, header_style="bold")
    for heading in ("blocks", "rows", "from, s", "to, s", "lost"):
        table.add_column(heading, justify="right")
    for key, stream in streams.items():
        numbers = (str(stream.messages), str(stream.rows), f"{stream.first_time_s:.4f}", f"{stream.last_time_s:.4f}")
        table.add_row(key, *numbers, str(stream.lost), style="red" if stream.lost else None)
    console.print(table)

    table = Table("channel", "unit", "range", "step", "rate", "label", box=None, header_style="bold")
    for group in recording.table.groups.values():
        if f"rig/sensors/{group.name}" not in streams:
            continue
        for channel in group.channels:
            ends = sorted((volts - channel.bias_v) / channel.sensitivity_v for volts in channel.range_v)
            reach = f"{ends[0]:.4g} to {ends[1]:.4g}"
            step = f"{abs(channel.scale):.2g}"
            table.add_row(channel.name, channel.unit, reach, step, f"{group.rate_hz} Hz", channel.label)
    console.print(table)

    for event in recording.events:
        time_s = event.get("time_s")
        stamp = f"{time_s:9.4f} s  " if isinstance(time_s, float | int) else " " * 13
        console.print(Text(stamp + event_text(event)[1]), soft_wrap=True)
    gaps = recording.gaps
    console.print(f"gaps noted by the recorder: {len(gaps) or 'none'}")
    for gap in gaps[:20]:
        what = f"{gap.size} messages" if gap.index < 0 else f"{gap.size} rows from {gap.index} on"
        console.print(f"  {gap.key}: {what}", soft_wrap=True)
    if len(gaps) > 20:
        console.print(f"  and {len(gaps) - 20} more")
