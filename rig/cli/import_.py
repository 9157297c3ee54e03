"""`rig import`: logs of other measuring systems as recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.options import Force
from rig.errors import InputError

if TYPE_CHECKING:
    from replays.formats.conversion import Conversion


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
) -> None:
    """Turn logs of a real rig into a recording that `rig info`, `view`, `replay`, `validate` and `identify` read.

    Start with --template, edit the mapping, then import. Everything that was done to the samples is printed, and stands
    in the recording.
    """
    if (template is None) == (mapping is None):
        raise InputError("import", "given either --mapping or --template", "both" if mapping else "neither")
    if template is not None:
        if output is not None:
            raise InputError("--output", "left out with --template", str(output))
        _write_template(files or [], template, force=force)
        return
    if not files:
        raise InputError("FILE", "given", None)
    if output is None or mapping is None:
        raise InputError("--output", "given", None)
    from recorder.writer import check_destination
    from replays.formats.conversion import convert
    from replays.formats.imported import write_recording
    from replays.formats.mapping import Mapping, load_mapping
    from rig.cli.progress import reporting

    check_destination(output, force=force)
    checked = load_mapping(mapping)
    with reporting() as reporter:
        try:
            conversion = convert(files, checked, say=reporter.step)
        except InputError as error:
            if error.field.split(".")[0] not in Mapping.model_fields:
                raise
            raise InputError(f"{mapping.name}: {error.field}", error.must, error.received) from None

        def tell(part: float) -> None:
            reporter.part(part, "writing")

        write_recording(conversion, output, force=force, progress=tell)
    _tell(conversion, output)


def _write_template(files: list[Path], path: Path, *, force: bool) -> None:
    from replays.formats.export import check_output
    from replays.formats.template import example, template

    check_output(path, force=force, suffixes=(".toml",))
    text = template(files) if files else example()
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)
    told = "a mapping to start from; lines with PLEASE CHECK are guesses" if files else "an example with every option"
    typer.echo(f"{path}: {told}")


def _tell(conversion: Conversion, output: Path) -> None:
    from rich.text import Text

    from rig.cli.tables import new_table, table_console

    console = table_console(highlight=False)
    size = output.stat().st_size / 1e6
    seconds = conversion.end_tick / 1e6
    console.print(f"{output}: {len(conversion.channels)} channels, {seconds:.6g} s, {size:.1f} MB, from "
                  f"{conversion.start.isoformat()}", soft_wrap=True, markup=False)  # fmt: skip
    table = new_table("")
    for heading in ("channel", "source", "formula", "time and samples", "counts", "from", "to"):
        table.add_column(heading, overflow="fold")
    for heading in ("rate", "jitter", "clock", "missing", "overrange"):
        table.add_column(heading, justify="right", overflow="fold")
    for channel in conversion.channels:
        trouble = channel.missing or channel.overrange
        cells = (
            channel.name, channel.source, channel.formula, channel.time, channel.counts, f"{channel.low:.4g}",
            f"{channel.high:.4g} {channel.unit}", f"{channel.rate_hz} Hz", f"{channel.jitter_us:.2g} us",
            f"{channel.drift_ppm:+.2g} ppm", str(channel.missing), str(channel.overrange),
        )  # fmt: skip
        # Names in brackets are names, not rich's markup.
        table.add_row(*(Text(cell) for cell in cells), style="yellow" if trouble else None)
    console.print(table)
    for remark in conversion.remarks:
        console.print(remark, soft_wrap=True, markup=False)
    if conversion.experiment is None:
        console.print("no scene: it cannot be simulated again until the mapping has an [experiment]", soft_wrap=True,
                      markup=False)  # fmt: skip
