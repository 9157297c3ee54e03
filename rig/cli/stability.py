"""`rig stability`: trials of every engine, each with its expected verdict; maps of where they hold and fail."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.options import Json
from rig.cli.progress import reporting
from rig.cli.tables import echo, echo_json, new_table, table_console

if TYPE_CHECKING:
    from rich.text import Text

    from replays.studies.stability.cell import Cell


def stability(
    *,
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="T3,T7", help="Only these trials; pictures stay whole."),
    ] = None,
    engines: Annotated[
        str | None, typer.Option("--engines", metavar="NAMES", help="Only these engines, joined by commas.")
    ] = None,
    full: Annotated[
        bool, typer.Option("--full/--quick", help="Long ladders and fine maps (some minutes), or the short ones.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="Draw the maps as well, as PNG and SVG.")
    ] = None,
    json_output: Json = False,
) -> None:
    """Test where integration methods fail; exit status 1 if any does not do what theory expects."""
    from replays.studies.stability.table import chosen_engines, chosen_trials, run_trials

    trials, names = chosen_trials(only), chosen_engines(engines)
    cells: list[Cell] = []
    pictures: list[Path] = []
    with reporting() as reporter:
        for cell in run_trials(trials, names, quick=not full):
            cells.append(cell)
            reporter.step(f"{cell.trial} {cell.case}, {cell.method}")
        if output is not None:
            from replays.studies.stability.figure import draw_all

            reporter.say("pictures")
            pictures = draw_all(output, names, quick=not full)
    wrong = [cell for cell in cells if not cell.agrees]
    if json_output:
        document = {
            "cells": [cell.document() for cell in cells],
            "disagree": len(wrong),
            "pictures": [str(path) for path in pictures],
        }
        echo_json(document)
    else:
        _show(cells, names)
        for path in pictures:
            echo(f"picture  {path}")
    if wrong:
        raise typer.Exit(1)


def _show(cells: list[Cell], names: list[str]) -> None:
    from rich.text import Text

    from replays.studies.stability.trials import TRIALS

    console = table_console()
    ours = [cell for cell in cells if cell.method in names]
    headings = ("trial", "case", *(f">{name}" for name in names))
    table = new_table("trials by engine: measured, and whether that holds", *headings, whole=("trial",))
    rows = dict.fromkeys((cell.trial, cell.case) for cell in ours)
    seen = ""
    for trial, case in rows:
        found = {cell.method: cell for cell in ours if (cell.trial, cell.case) == (trial, case)}
        if trial != seen:
            table.add_row(Text(trial, style="bold"), Text(TRIALS[trial].title, style="bold"))
            seen = trial
        table.add_row("", Text(f"  {case}"), *(_text(found.get(name)) for name in names))
    console.print(table)
    others = [cell for cell in cells if cell.method not in names]
    if others:
        headings = ("trial", "case", "solver", "measured", "because")
        peers = new_table("\nother people's solvers, where they are known to fail or to hold", *headings)
        for cell in others:
            peers.add_row(cell.trial, Text(cell.case), cell.method, _text(cell), Text(cell.skipped or cell.because))
        console.print(peers)
    console.print(
        "\nholds: within its limit. fails*: as was expected, by theory or by measurement (--json says why). "
        "Those marked ! do not do what was expected; a bare "
        "number has no expectation.",
        highlight=False,
    )
    for cell in cells:
        if not cell.agrees:
            console.print(
                f"! {cell.trial} {cell.case}, {cell.method}: {cell.value:.3g} {cell.unit}, limit {cell.limit:.3g}, "
                f"expected to {'hold' if cell.expected else 'fail'}: {cell.because}",
                highlight=False,
            )


def _text(cell: Cell | None) -> Text:
    from rich.text import Text

    if cell is None:
        return Text("-", style="dim")
    if cell.skipped:
        return Text("skipped", style="dim")
    value = f"{cell.value:.1e}" if math.isfinite(cell.value) else str(cell.value)
    if cell.value == 0.0:
        value = "0"
    if cell.expected is None:
        return Text(value + "        ")
    if not cell.agrees:
        return Text(f"{value} {'holds!' if cell.holds else 'FAILS!'} ", style="bold red")
    return Text(f"{value} holds " if cell.holds else f"{value} fails*", style="" if cell.holds else "dim")
