"""`rig score`: the recording of a DAQ under test compared with the signals of the rig."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from rig.base.errors import InputError, Words
from rig.base.files import check_new_file, check_output_differs, write_file
from rig.base.text import replace_nonfinite
from rig.cli.connections.connection import Connection
from rig.cli.groups import panel
from rig.cli.options import Channels, Force, Wide, split_names
from rig.cli.output.progress import reporting
from rig.cli.output.provenance import origin
from rig.cli.output.tables import echo, make_printable, new_table, table_console

if TYPE_CHECKING:
    from rich.console import Console

    from replays.recordings.formats.mapping import Mapping
    from replays.score.card.limits import ScoreLimits
    from replays.score.card.scorecard import Scorecard

_live = panel("Live")
_FOR_S = 10.0
"""Default duration of a live score [s]."""
_MATRIX_COLUMNS = 28
"""Number of channels per matrix that fits 80 columns."""


class _Method(StrEnum):
    DIGITAL = "digital"
    ANALOGUE = "analogue"


_STYLES = {"pass": "", "fail": "red", "inconclusive": "yellow", "no limit": ""}


def score(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="The DAQ's recording: a format of `rig import`, .mcap or CAN log; -: CSV from stdin",
        ),
    ],
    *,
    against: Annotated[
        list[Path] | None,
        typer.Option("--against", metavar="SESSION.mcap", help="Session that the rig sent; repeat for its parts"),
    ] = None,
    for_s: Annotated[
        float | None,
        _live("Duration from the first line in s, default 10; Ctrl-C ends it", metavar="S"),
    ] = None,
    connection: Connection,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="Write a report with pictures, .html or .pdf")
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(metavar="FILE.xml", help="Write JUnit XML, one case per quantity")
    ] = None,
    as_json: Annotated[
        Path | None, typer.Option("--json", metavar="FILE.json", help="Write all results as JSON")
    ] = None,
    limits: Annotated[
        str | None, typer.Option(metavar="SET", help="Limits: as-calibrated, api-670, iso-20816 or a .toml file")
    ] = None,
    channels: Channels = None,
    mapping: Annotated[
        Path | None,
        typer.Option("--mapping", "-m", metavar="FILE.toml", help="Names, units and bits, in the form of `rig import`"),
    ] = None,
    path: Annotated[_Method | None, typer.Option(help="Input of the DAQ; default: detected from the file")] = None,
    force: Force = False,
    wide: Wide = False,
) -> None:
    """Score a DAQ by comparing its recording with what the rig sent.

    A DAQ with digital input is compared row by row, exactly; one with its own sampling clock is fitted to the known
    signal by least squares. With FILE -, CSV from stdin is compared with the streams of the rig at --connect. Exit
    status: 0 pass, 1 fail, 2 wrong input, 3 inconclusive.
    """
    from replays.recordings.formats.mapping import load_mapping
    from replays.report import check_report, write_report
    from replays.score.card.limits import load_limits
    from replays.score.card.scorecard import write_junit
    from replays.score.judgement import judge

    if output is not None:
        check_report(output, force=force, field="--output")
    for target, field, suffix in ((junit, "--junit", ".xml"), (as_json, "--json", ".json")):
        if target is not None:
            check_new_file(target, field=field, suffixes=(suffix,), force=force)
            check_output_differs([file, *(against or ())], target, field=field)
    score_limits = load_limits(limits)
    mapped = None if mapping is None else load_mapping(mapping)
    due = None if channels is None else split_names(channels, "--channels")
    method = None if path is None else "digital" if path is _Method.DIGITAL else "analogue"
    live = str(file) == "-"
    if live == (against is not None):
        must = "left out where FILE is -: what the rig at --connect sends" if live else "given: what the rig sent"
        raise InputError("--against", must, None if against is None else str(against[0]))
    if for_s is not None and not live:
        raise InputError("--for-s", "left out where a file is judged", for_s)
    if live:
        card = _judge_live(connection, _FOR_S if for_s is None else for_s, score_limits, method, due, mapped)
    else:
        with reporting() as reporter:
            card = judge(
                file, against or [], limits=score_limits, path=method, channels=due, mapping=mapped,
                step=reporter.step, report=reporter.note,
            )  # fmt: skip
    if output is not None:
        from replays.score.report import make_report

        session = against[0].name if against else connection.connect
        write_report(make_report(card, origin=origin(file=file.name, session=session, limits=card.limits)), output)
    if junit is not None:
        write_junit(card, junit)
    if as_json is not None:
        write_file(as_json, json.dumps(replace_nonfinite(card.document()), indent=2, allow_nan=False) + "\n")
    _show(card, table_console(wide=wide), wide=wide)
    for target in (output, junit, as_json):
        if target is not None:
            echo(f"written  {target}")
    if card.outcome.exit_status:
        raise typer.Exit(card.outcome.exit_status)


def _judge_live(
    connection: Connection, for_s: float, limits: ScoreLimits, path: Literal["digital", "analogue"] | None,
    channels: list[str] | None, mapping: Mapping | None,
) -> Scorecard:  # fmt: skip
    """Collect the lines from stdin and the streams of the rig at the same time, and score them."""
    import sys
    import tempfile
    import threading

    from replays.score.judgement import judge
    from replays.score.records.live import MAX_STRETCH_S, MIN_STRETCH_S, collect
    from rig.cli.signals import stop_on_signals

    if not MIN_STRETCH_S <= for_s <= MAX_STRETCH_S:
        raise InputError("--for-s", f"from {MIN_STRETCH_S:g} to {MAX_STRETCH_S:g}", for_s)
    if sys.stdin.isatty():
        raise InputError("FILE", "fed by a pipe where it is -: my-daq | rig score -", Words("a terminal"))
    stopped = threading.Event()
    with tempfile.TemporaryDirectory(prefix="rig-score-") as folder:
        with connection.client() as client, reporting() as reporter, stop_on_signals(stopped.set):
            collected = collect(client, sys.stdin.fileno(), Path(folder), for_s, stopped=stopped, report=reporter.part)
        with reporting() as reporter:
            card = judge(
                collected.file, [collected.session], limits=limits, path=path, arrivals=collected.arrivals,
                channels=channels, mapping=mapping, step=reporter.step, report=reporter.note,
            )  # fmt: skip
    card.title = f"standard input, compared with the rig at {connection.connect}"
    card.remarks[:0] = collected.remarks
    return card


def _show(card: Scorecard, console: Console, *, wide: bool) -> None:
    from replays.score.card.scorecard import FAIL, INCONCLUSIVE, LEGEND, make_matrix

    console.print(make_printable(f"{card.title}, limits {card.limits}"))
    console.print(make_printable(card.verdict_line))
    names, lines = make_matrix(card)
    for first in range(0, len(names) if lines else 0, _MATRIX_COLUMNS):
        part = names[first : first + _MATRIX_COLUMNS]
        height = max(map(len, part))  # names are written vertically above their marks
        above = [("", *letters) for letters in zip(*(name.rjust(height) for name in part), strict=True)]
        for quantity, *marks in (*above, *((line[0], *line[1 + first :][: len(part)]) for line in lines)):
            cells = "".join(f" {mark:1}" for mark in marks)
            console.print(make_printable(f"{quantity:<22}{cells}".rstrip()))
    if lines:
        console.print(f"{LEGEND}\n")
    for line in (*card.evidence_gaps[1:], *card.findings):
        console.print(make_printable(line))
    table = new_table(
        "", "quantity", "channel", ">value", "95 %", "unit", "limit", "verdict", "note", "to show it", "source",
        wrapped=("note", "to show it", "source"), spare=("source", "to show it", "note", "95 %"),
    )  # fmt: skip
    printed = [row for row in card.rows if wide or row.verdict in (FAIL, INCONCLUSIVE)]
    for row in printed:
        source = "" if row.limit is None else row.limit.source
        table.add_row(*row.cells(), row.note, row.run, source, style=_STYLES[row.verdict])
    console.print(table)
    if len(printed) < len(card.rows):
        echo("passed quantities and those without a limit: see --wide, the report, JUnit or JSON")
