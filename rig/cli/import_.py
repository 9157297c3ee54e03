"""`rig import`: logs of other measuring systems as recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.options import Force
from rig.cli.tables import Form, echo, echo_json, new_table
from rig.errors import InputError, Words, check_new_file, check_not_among, whole_file

if TYPE_CHECKING:
    from rich.console import Console

    from replays.recordings.formats.conversion import Conversion


def import_(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="FILE...", help=".mf4, .tdms, .uff, .csv, .txt, .lvm, .parquet or .wav; several to align."
        ),
    ] = None,
    *,
    mapping: Annotated[Path | None, typer.Option("--mapping", "-m", help="Which signal becomes which channel.")] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Recording to write, ends in .mcap.")] = None,
    template: Annotated[
        Path | None,
        typer.Option(
            "--template",
            metavar="FILE.toml",
            help="Write a starting mapping instead; without logs, an example with every option.",
        ),
    ] = None,
    force: Force = False,
    form: Form,
) -> None:
    """Turn logs of a real rig into a recording that `rig info`, `view`, `replay`, `validate` and `identify` read.

    Start with --template, edit the mapping, then import. Everything that was done to the samples is printed, and stands
    in the recording.
    """
    if (template is None) == (mapping is None):
        raise InputError("import", "given either --mapping or --template", Words("both" if mapping else "neither"))
    from rig.scenes import rig_table

    rig_table()
    if template is not None:
        if output is not None:
            raise InputError("--output", "left out with --template", str(output))
        _write_template(files or [], template, force=force)
        return
    if not files:
        raise InputError("FILE", "given: the logs to import", None)
    if output is None or mapping is None:
        raise InputError("--output", "given: a recording to write, such as -o log.mcap", None)
    from recorder.draft import check_destination
    from replays.recordings.formats.conversion import convert, write_recording
    from replays.recordings.formats.mapping import Mapping, load_mapping
    from rig.cli.progress import reporting

    check_destination(output, force=force)
    check_not_among([*files, mapping], output)
    checked = load_mapping(mapping)
    with reporting() as reporter:
        try:
            conversion = convert(files, checked, say=reporter.step)
        except InputError as error:
            # What is wrong with a file is no fault of the mapping, whose table [file] has other fields.
            if error.field == "file" or error.field.split(".")[0] not in Mapping.model_fields:
                raise
            raise InputError(f"{mapping.name}: {error.field}", error.must, error.received) from None

        def tell(part: float) -> None:
            reporter.part(part, "writing")

        write_recording(conversion, output, force=force, progress=tell)
    if form.as_json:
        echo_json(conversion.document)
    else:
        _tell(conversion, output, form.console())


def _write_template(files: list[Path], path: Path, *, force: bool) -> None:
    from replays.recordings.formats.template import CHECK, example, template

    check_new_file(path, field="--template", suffixes=(".toml",), force=force)
    check_not_among(files, path, field="--template")
    text = template(files) if files else example()
    with whole_file(path) as draft:
        draft.write_text(text, encoding="utf-8")
    guesses = text.count(CHECK)
    told = "a mapping to start from" if files else "an example with every option"
    told += f"; {guesses} {'line' if guesses == 1 else 'lines'} with {CHECK}" if guesses else ""
    echo(f"{path}: {told}")


_JITTER_US, _DRIFT_PPM, _DUST = 1e-3, 1e-2, 1e-6
"""Less than this is rounding: of time stamps, of clocks, and beside a channel's largest value."""


def _tell(conversion: Conversion, output: Path, console: Console) -> None:
    size = output.stat().st_size / 1e6
    seconds = conversion.end_tick / 1e6
    console.print(f"{output}: {len(conversion.channels)} channels, {seconds:.6g} s, {size:.1f} MB, from "
                  f"{conversion.start.isoformat()}")  # fmt: skip
    columns = _columns(conversion)
    words = ("channel", "source", "value", "unit")
    headings = (heading if heading in words else f">{heading}" for heading in columns)
    table = new_table("", *headings, wrapped=("source", "value"), spare=("clock [ppm]", "jitter [us]"))
    for row, channel in zip(zip(*columns.values(), strict=True), conversion.channels, strict=True):
        trouble = channel.missing or channel.overrange
        table.add_row(*row, style="yellow" if trouble else "")
    console.print(table)
    for line in _in_common(conversion):
        console.print(line)
    for remark in conversion.remarks:
        console.print(remark)
    if conversion.experiment is None:
        console.print("no scene: it cannot be simulated again until the mapping has an [experiment]")


def _columns(conversion: Conversion) -> dict[str, list[str]]:
    """The table's columns by heading; those in which nothing stands are left out."""
    channels, files = conversion.channels, conversion.document["files"]
    only = f"{files[0]['name']} " if len(files) == 1 else ""
    ends = [max(abs(channel.low), abs(channel.high)) * _DUST for channel in channels]
    columns = {
        "channel": [channel.name for channel in channels],
        "source": [channel.source.removeprefix(only) for channel in channels],
        "value": [channel.formula for channel in channels],
        "low": [f"{c.low if abs(c.low) > dust else 0.0:.4g}" for c, dust in zip(channels, ends, strict=True)],
        "high": [f"{c.high if abs(c.high) > dust else 0.0:.4g}" for c, dust in zip(channels, ends, strict=True)],
        "unit": ["" if channel.unit == "1" else channel.unit for channel in channels],
        "missing": [f"{channel.missing or ''}" for channel in channels],
        "overrange": [f"{channel.overrange or ''}" for channel in channels],
        "jitter [us]": [f"{c.jitter_us:.2g}" if c.jitter_us >= _JITTER_US else "" for c in channels],
        "clock [ppm]": [f"{c.drift_ppm:+.2g}" if abs(c.drift_ppm) >= _DRIFT_PPM else "" for c in channels],
    }
    return {heading: cells for heading, cells in columns.items() if any(cells)}


def _in_common(conversion: Conversion) -> list[str]:
    """What was done to the samples, each thing once, with the channels that it was done to."""
    done: dict[str, list[str]] = {}
    for channel in conversion.channels:
        # A count of the source's own differs from channel to channel, and stands in the recording.
        rule = channel.counts.split(",")[0] if "," in channel.counts else "a power of two of the unit"
        for text in (f"{channel.rate_hz} Hz, {channel.time}", f"one count: {rule}"):
            done.setdefault(text, []).append(channel.name)
    whole = len(conversion.channels)
    return [f"{'all' if len(names) == whole else ', '.join(names)}: {text}" for text, names in done.items()]
