"""`rig compare`: what changed between two recordings."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.options import Force, ReportFile, RunOut, subtract_run_out
from rig.cli.output.progress import reporting
from rig.cli.output.provenance import origin
from rig.cli.output.tables import Form, echo, echo_json, make_printable, new_table

if TYPE_CHECKING:
    from rich.console import Console

    from replays.recordings.changes import Comparison

_MAX_ROWS = 20
"""Rows shown without --wide."""


def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="Recording (.mcap)")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Recording (.mcap) to compare with it")],
    *,
    runout: RunOut = None,
    report: ReportFile = None,
    force: Force = False,
    form: Form,
) -> None:
    """Show what changed between two recordings, by phase and channel, without a model.

    Each phase is compared by its statistics, so the recordings need no common clock or trigger. A row has changed if
    the interval of its difference excludes zero; the intervals hold for all rows together with 95 %. Exit status: 0
    nothing changed, 1 changed, 2 wrong input, 3 inconclusive (a phase or channel exists in one recording only).
    """
    from recorder.reader import join
    from replays.recordings.changes import compare as compare_recordings
    from replays.report import check_report, write_report

    if report is not None:
        check_report(report, force=force)
    with reporting() as reporter:
        reporter.show("reading")
        recordings = subtract_run_out(runout, join([first]), join([second]), show=partial(echo, err=True))
        reporter.show("comparing the phases")
        result = compare_recordings(*recordings)
        if report is not None:
            head = origin(a=first.name, b=second.name, correction=recordings[0].correction[0])
            write_report(result.report(head), report)
    if form.as_json:
        echo_json(result.document())
    else:
        _show(result, form.console(), wide=form.wide)
        if report is not None:
            echo(f"report  {report}")
    if result.outcome.exit_status:
        raise typer.Exit(result.outcome.exit_status)


def _show(result: Comparison, console: Console, *, wide: bool) -> None:
    from replays.recordings.changes.comparison import HEADINGS, NOTE

    console.print(make_printable(f"A {result.files[0]}, B {result.files[1]}"))
    console.print(result.line)
    for line in result.missing:
        console.print(make_printable(line))
    shown = result.changes if wide else result.changes[:_MAX_ROWS]
    table = new_table("Changes, largest first", *HEADINGS, spare=("A", "B"), keys=3)
    for one in shown:
        table.add_row(*one.cells)
    if not shown:
        return
    console.print()
    console.print(table)
    if len(shown) < len(result.changes):
        console.print(f"{len(result.changes) - len(shown)} more rows with --wide or --json")
    console.print(f"\n{NOTE}")
