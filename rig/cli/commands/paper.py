"""`rig paper`: the figures, tables and conclusions of the paper, reproduced and judged in one report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.options import Force
from rig.cli.output.folder import check_folder
from rig.cli.output.progress import reporting
from rig.cli.output.provenance import origin
from rig.cli.output.tables import Form, echo, echo_json, new_table

if TYPE_CHECKING:
    from rich.console import Console

    from replays.studies.paper.findings import Findings


def paper(
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="Write the report, .html or .pdf")
    ] = None,
    pictures: Annotated[
        Path | None, typer.Option("--pictures", metavar="FOLDER", help="Also write the main pictures as PNG files")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick/--full", help="Few short runs (some seconds) or all (about a minute)")
    ] = False,
    processes: Annotated[int, typer.Option(min=1, max=64, help="Number of parallel processes")] = 2,
    force: Force = False,
    form: Form,
) -> None:
    """Reproduce the figures, tables and claims of the paper, as printed and as corrected, each with a verdict."""
    from replays.report import check_report, write_report
    from replays.studies.paper.document import draw_pictures, write_up
    from replays.studies.paper.findings import find, steps

    if output is not None:
        check_report(output, force=force, field="--output")
    if pictures is not None:
        check_folder(pictures, field="--pictures")
    with reporting(compiles=True) as reporter:
        reporter.begin(steps(quick=quick))
        findings = find(quick=quick, processes=processes, progress=reporter.step)
        if output is not None:
            reporter.show_activity("report")
            sets = f"as-printed, corrected; {'few, short' if quick else 'all'} runs"
            write_report(write_up(findings, quick=quick, origin=origin(parameter_sets=sets)), output)
        drawn = []
        if pictures is not None:
            pictures.mkdir(exist_ok=True)
            drawn = draw_pictures(findings, pictures)
    if form.as_json:
        echo_json(summary(findings))
        return
    _show(findings, form.console())
    for path in drawn:
        echo(f"picture  {path}")
    if output is not None:
        echo(f"report  {output}")
    elif not drawn:
        echo("no file written; -o paper.html writes the report with all figures and tables")


def summary(findings: Findings) -> dict[str, object]:
    """Return the summary as a JSON document; values are low, median and high, NaN if undefined."""
    from replays.studies.paper.scans.spread import percentiles

    return {
        "statements": [
            {
                **line.statement.model_dump(exclude={"low", "high"}),
                "values": {name: percentiles(values) for name, values in line.values.items()},
                "inside": {name: line.statement.inside(values) for name, values in line.values.items()},
                "bounds": {name: line.statement.bounds(values) for name, values in line.values.items()},
                "runs": {name: line.statement.count_runs(values) for name, values in line.values.items()},
                "verdicts": line.verdicts,
            }
            for line in [*findings.lines, *findings.claims]
        ]
    }


def _show(findings: Findings, console: Console) -> None:
    from rich.text import Text

    from replays.studies.paper.findings import JUDGED_BY

    headings = ("statement", "the paper", ">unit", ">as-printed", ">corrected", ">inside", "verdict")
    table = new_table("the paper's statements, and this model's", *headings, wrapped=("statement", "verdict"))
    colours = {"good": "green", "bad": "bold red", "open": "yellow", "plain": ""}
    for line in [*findings.lines, *findings.claims]:
        row = line.row()
        says, _, *cells, verdict = row.cells
        table.add_row(says, *cells, Text(verdict, colours[row.mark]))
    console.print(table)
    console.print(
        f"median (5–95 %), share inside with 95 % bounds (runs), over phases, values and readings; {JUDGED_BY}"
    )
