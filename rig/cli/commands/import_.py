"""`rig import`: logs of other measuring systems as recordings."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base import units
from rig.base.errors import InputError, Words
from rig.base.files import check_new_file, check_output_differs, write_file
from rig.cli.options import Force
from rig.cli.output.tables import Form, echo, echo_json, new_table

if TYPE_CHECKING:
    from rich.console import Console

    from replays.recordings.formats.conversion import Conversion
    from replays.recordings.formats.guessing.guess import Guess


IMPORTED = "Logs to align: .mf4, .mdf, .dat, .tdms, .uff, .unv, .csv, .txt, .asc, .tsv, .lvm, .parquet or .wav"
"""Endings of `FORMATS`, which would take too long to import for help: tests/unit/test_entries.py compares them."""


def import_(
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="FILE...", help=IMPORTED),
    ] = None,
    *,
    mapping: Annotated[
        Path | None, typer.Option("--mapping", "-m", help="TOML file that maps signals to channels")
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Recording to write, .mcap")] = None,
    template: Annotated[
        Path | None,
        typer.Option(
            "--template",
            metavar="FILE.toml",
            help="Write a draft mapping; without logs: an example of every option",
        ),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also draw the signals of the logs, .png or .svg")
    ] = None,
    force: Force = False,
    form: Form,
) -> None:
    """Convert logs of a real rig to a recording that `rig info`, `view`, `replay`, `validate` and `identify` read.

    Without --mapping, each signal is guessed from its name, unit and samples, and the reason is printed; with -o it is
    imported by that guess. --template writes the guess as a mapping for you to correct. Changes to the samples are
    printed and stored in the recording.
    """
    if template is not None and mapping is not None:
        raise InputError("import", "given either --mapping or --template", Words("both"))
    if mapping is not None and output is None:
        raise InputError("--output", "given: a recording to write, such as -o log.mcap", None)
    if template is not None and output is not None:
        raise InputError("--output", "left out with --template", str(output))
    if not files and (template is None or picture is not None):
        raise InputError("FILE", "given: the logs to import", None)
    from rig.run.scenes import rig_table

    rig_table()
    if mapping is not None:
        if picture is not None:
            raise InputError("--picture", "left out with --mapping: `rig view` shows the recording", str(picture))
        assert output is not None
        _import(files or [], mapping, output, force=force, form=form)
        return
    _guess(files or [], template, output, picture, force=force, form=form)


def _import(
    files: list[Path],
    mapping: Path | str,
    output: Path,
    *,
    left_out: Mapping[str, InputError] = MappingProxyType({}),
    force: bool,
    form: Form,
) -> None:
    """Import by a mapping, given as a file or as the text of a guess, without some of its channels."""
    from recorder.files.unfinished_file import check_destination
    from replays.recordings.formats.conversion import convert, write_recording
    from replays.recordings.formats.mapping import Mapping as MappingFile
    from replays.recordings.formats.mapping import load_mapping, parse_mapping
    from rig.cli.output.progress import reporting

    check_destination(output, force=force)
    check_output_differs(files if isinstance(mapping, str) else [*files, mapping], output)
    name = "the guess (--template writes it)" if isinstance(mapping, str) else mapping.name
    if isinstance(mapping, str):
        data = tomllib.loads(mapping)
        data["channels"] = {key: each for key, each in data.get("channels", {}).items() if key not in left_out}
        if "hammer" in left_out:
            data.pop("hammer", None)
            if data.get("experiment", {}).get("commands") == "detected":
                data.pop("experiment")
        if left_out and not data["channels"]:
            raise next(iter(left_out.values()))
        checked = parse_mapping(data, name=name)
    else:
        checked = load_mapping(mapping)
    with reporting() as reporter:
        try:
            doubts = (
                [f"assumed, not in the mapping: {question}" for question in _find_questions(mapping)]
                if isinstance(mapping, str)
                else []
            )
            doubts += [f"left out: {error}" for error in left_out.values()]
            conversion = convert(files, checked, doubts=doubts, say=reporter.step)
        except InputError as error:
            # An error in a log file is not an error in the mapping, whose table [file] has other fields.
            if error.field == "file" or error.field.split(".")[0] not in MappingFile.model_fields:
                raise
            raise InputError(f"{name}: {error.field}", error.must, error.received) from None

        def report_progress(part: float) -> None:
            reporter.part(part, "writing")

        write_recording(conversion, output, force=force, progress=report_progress)
    if form.as_json:
        echo_json(conversion.document)
    else:
        _print_result(conversion, output, form.console())
        if isinstance(mapping, str):
            echo("imported by the guess; to correct it: --template FILE.toml, then --mapping FILE.toml")


def _guess(
    files: list[Path], path: Path | None, output: Path | None, picture: Path | None, *, force: bool, form: Form
) -> None:
    """Guess the signals of the logs and print the guess; write it as a mapping or a picture, or import by it."""
    from replays.recordings.formats.guessing.template import example, guess_mapping

    for wanted, field, suffixes in ((path, "--template", (".toml",)), (picture, "--picture", (".png", ".svg"))):
        if wanted is not None:
            check_new_file(wanted, field=field, suffixes=suffixes, force=force)
            check_output_differs(files, wanted, field=field)
    text, guesses = guess_mapping(files) if files else (example(), [])
    if path is not None:
        write_file(path, text)
    if picture is not None:
        from replays.recordings.formats.guessing.overview import draw

        draw(guesses, picture)
    if form.as_json and output is None:
        echo_json([_document(guess) for guess in guesses])
    elif guesses and not form.as_json:
        _tell_guesses(guesses, text, form.console())
    if path is not None and not form.as_json:
        question_count = len(_find_questions(text))
        description = "a mapping to start from" if files else "an example with every option"
        description += (
            f"; {question_count} {'line' if question_count == 1 else 'lines'} to check" if question_count else ""
        )
        echo(f"{path}: {description}")
    if output is not None:
        _import(files, text, output, left_out=_find_left_out(guesses), force=force, form=form)


def _find_left_out(guesses: list[Guess]) -> dict[str, InputError]:
    """Return the signals that cannot be imported by a guess, with the reason, by the name of the channel."""
    left_out = {}
    for guess in guesses:
        name, unit = guess.entry.name, guess.entry.unit
        try:
            if guess.features.missing == len(guess.features.values):
                raise InputError(name, "a signal with valid values", Words("none"))
            if "unit" in guess.asks and unit:
                units.parse(unit, field=f"unit of {name} (--template FILE.toml asks for it)")
        except InputError as error:
            left_out[guess.channel or name] = error
    return left_out


def _find_questions(text: str) -> list[str]:
    """Return the questions of a mapping, each with its table."""
    from replays.recordings.formats.guessing.template import CHECK

    questions, table = [], ""
    for line in text.splitlines():
        if (bare := line.removeprefix("# ")).startswith("["):
            table = bare.partition("#")[0].strip()
        if CHECK in line:
            held, _, question = line.partition(f"# {CHECK}: ")
            held = held.strip().lstrip("# ")
            about = f"{table} {'' if held == table else held}".strip()
            questions.append(f"{about}: {question.partition(' (')[0]}")
    return questions


_SPARK = 12
"""Width of a signal's sparkline in a table [characters]."""


def _tell_guesses(guesses: list[Guess], text: str, console: Console) -> None:
    headings = ("signal", "course", "becomes", "unit", "confidence", "reason")
    table = new_table("", *headings, wrapped=("signal", "reason"), spare=("course",))
    for guess in guesses:
        unit = f" [{guess.entry.unit}]" if guess.entry.unit else ""
        where = f"{guess.entry.group} " if len({each.entry.group for each in guesses}) > 1 else ""
        reason = guess.why if guess.channel else "not a channel of the rig; kept as a new channel"
        style = "" if guess.channel and guess.confidence != "open" else "yellow"
        table.add_row(
            f"{where}{guess.entry.name}{unit}",
            guess.features.sparkline(_SPARK),
            guess.channel or "-",
            (guess.sensitivity or guess.own_unit) + "?" * bool({"unit", "sensitivity"} & set(guess.asks)),
            guess.confidence if guess.channel else "-",
            reason,
            style=style,
        )
    console.print(table)
    if questions := _find_questions(text):
        echo("Not contained in the logs:")
        for question in questions:
            echo(f"  {question}")


def _document(guess: Guess) -> dict[str, Any]:
    return {
        "file": guess.source.path.name, "group": guess.entry.group, "signal": guess.entry.name,
        "unit": guess.entry.unit, "channel": guess.channel or None, "sure": guess.confidence if guess.channel else None,
        "why": guess.why, "asks": guess.asks, "mean": guess.features.mean, "low": guess.features.extent[0],
        "high": guess.features.extent[1], "rate_hz": guess.features.axis.rate_hz if guess.features.timed else None,
    }  # fmt: skip


_JITTER_US, _DRIFT_PPM, _DUST = 1e-3, 1e-2, 1e-6
"""Rounding limits: time stamps [us], clocks [ppm], and relative to a channel's largest value. Less is not shown."""


def _print_result(conversion: Conversion, output: Path, console: Console) -> None:
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
    for line in _common_lines(conversion):
        console.print(line)
    for remark in conversion.remarks:
        console.print(remark)
    if conversion.experiment is None:
        console.print("no scene: add an [experiment] to the mapping to simulate it again")


def _columns(conversion: Conversion) -> dict[str, list[str]]:
    """Return the table's columns by heading, without empty ones."""
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


def _common_lines(conversion: Conversion) -> list[str]:
    """Return one line per processing step, with the channels it applied to."""
    done: dict[str, list[str]] = {}
    for channel in conversion.channels:
        # A count size from the source differs between channels and is stored in the recording.
        rule = channel.counts.split(",")[0] if "," in channel.counts else "a power of two of the unit"
        for text in (f"{channel.rate_hz:.9g} Hz, {channel.time}", f"step of the stored counts: {rule}"):
            done.setdefault(text, []).append(channel.name)
    whole = len(conversion.channels)
    return [f"{'all' if len(names) == whole else ', '.join(names)}: {text}" for text, names in done.items()]
