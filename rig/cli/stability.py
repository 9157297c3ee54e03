"""`rig stability`: trials of every engine, each with its expected verdict; maps of where they hold and fail."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.progress import reporting
from rig.cli.tables import Form, Table, echo, echo_json, new_table

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from replays.studies.stability.cell import Cell


def stability(
    *,
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="T3,T7", help="Only these trials; pictures stay whole."),
    ] = None,
    engines: Annotated[str | None, typer.Option("--engines", metavar="ENGINE,...", help="Only these engines.")] = None,
    full: Annotated[
        bool, typer.Option("--full/--quick", help="Long ladders and fine maps (some minutes), or the short ones.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="Draw the maps as well, as PNG and SVG.")
    ] = None,
    form: Form,
) -> None:
    """Test where integration methods fail; exit status 1 if any does not do what theory expects."""
    from replays.studies.stability.table import chosen_engines, chosen_trials, run_trials

    trials, names = chosen_trials(only), chosen_engines(engines)
    cells: list[Cell] = []
    pictures: list[Path] = []
    with reporting(compiles=True) as reporter:
        for cell in run_trials(trials, names, quick=not full):
            cells.append(cell)
            reporter.step(f"{cell.trial} {cell.case}, {cell.method}")
        if output is not None:
            from replays.studies.stability.figure import draw_all

            reporter.say("pictures")
            pictures = draw_all(output, names, quick=not full)
    wrong = [cell for cell in cells if not cell.agrees]
    if form.as_json:
        document = {
            "cells": [cell.document() for cell in cells],
            "disagree": len(wrong),
            "pictures": [str(path) for path in pictures],
        }
        echo_json(document)
    else:
        _show(cells, names, form.console())
        for path in pictures:
            echo(f"picture  {path}")
    if wrong:
        raise typer.Exit(1)


def _show(cells: list[Cell], names: list[str], console: Console) -> None:
    console.print(trials_table([cell for cell in cells if cell.method in names], names))
    if others := [cell for cell in cells if cell.method not in names]:
        console.print()
        console.print(peers_table(others))
    console.print(
        "\n*: fails, as was expected by theory or by measurement (--json says why); !: does not do what was expected; "
        "in brackets: nothing is expected; all others hold, within their limits."
    )
    for cell in cells:
        if not cell.agrees:
            console.print(
                f"! {cell.trial} {cell.case}, {cell.method}: {cell.value:.3g} {cell.unit}, limit {cell.limit:.3g}, "
                f"expected to {'hold' if cell.expected else 'fail'}: {cell.because}"
            )


def trials_table(cells: list[Cell], names: list[str]) -> Table:
    """What each engine of these names did in each case."""
    from rich.text import Text

    from replays.studies.stability.trials import TRIALS

    table = new_table("trials by engine: measured", "trial", "case", *(f">{name}" for name in names), keys=2)
    seen = ""
    for trial, case in dict.fromkeys((cell.trial, cell.case) for cell in cells):
        found = {cell.method: cell for cell in cells if (cell.trial, cell.case) == (trial, case)}
        if trial != seen:
            table.add_row(Text(f"{trial}: {TRIALS[trial].title}", "bold"))
            seen = trial
        table.add_row(trial, case, *(_text(found.get(name)) for name in names))
    return table


def peers_table(cells: list[Cell]) -> Table:
    """What other people's solvers did."""
    title = "other people's solvers, where they are known to fail or to hold"
    headings = ("trial", "case", "solver", ">measured", "because")
    table = new_table(title, *headings, wrapped=("because", "case"), keys=2)
    for cell in cells:
        table.add_row(cell.trial, cell.case, cell.method, _text(cell), cell.skipped or cell.because)
    return table


def _text(cell: Cell | None) -> Text:
    from rich.text import Text

    if cell is None:
        return Text("-", "dim")
    if cell.skipped:
        return Text("skipped", "dim")
    value = f"{cell.value:.1e}" if cell.value and math.isfinite(cell.value) else f"{cell.value:g}"
    if cell.expected is None:
        return Text(f"({value})")
    if not cell.agrees:
        return Text(f"{value}!", "bold red")
    return Text(value) if cell.holds else Text(f"{value}*", "dim")
