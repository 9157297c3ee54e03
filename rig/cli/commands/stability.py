"""`rig stability`: trials of every engine with expected verdicts, maps of their limits, and random scenes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.errors import InputError
from rig.cli.options import Law, split_names
from rig.cli.output.progress import reporting
from rig.cli.output.tables import Form, Table, echo, echo_json, new_table

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from replays.studies.stability.scenes.scene_atlas import SceneOutcome
    from replays.studies.stability.trials.cell import Cell


def stability(
    *,
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="T3,T7", help="Run only these trials, or scenes with --random or --scenes"),
    ] = None,
    engines: Annotated[
        str | None, typer.Option("--engines", metavar="ENGINE,...", help="Test only these engines")
    ] = None,
    full: Annotated[
        bool, typer.Option("--full/--quick", help="Run all steps and fine maps (minutes), or short ones")
    ] = False,
    random: Annotated[
        int | None,
        typer.Option("--random", metavar="N", min=1, help="Run N random scenes instead, against accurate runs"),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random scenes")] = 1,
    scenes: Annotated[
        bool,
        typer.Option("--scenes", help="Run the chart's twelve scenes with all engines and peers"),
    ] = False,
    law: Law = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            help="Also draw the maps (.png, .svg); with --random: continue here",
        ),
    ] = None,
    form: Form,
) -> None:
    """Find where integration methods fail; exit status 1 if any result differs from theory.

    With --random, every engine runs random scenes, with a wide range of parameters, laws and model levels, against two
    accurate engines that agree; exit status 1 if the first engine fails, or is wrong without a warning. With --scenes,
    the same for twelve scenes, from coarse to fine settings, including installed peers unless --engines excludes them
    (12 min). --law adds the hammer scene with that law to the twelve; its name for --only is "law".
    """
    from replays.studies.stability.table import run_trials, select_engines, select_trials

    if scenes and (full or random is not None):
        raise InputError("--scenes", "given without --full and --random", "--full" if full else f"--random {random}")
    if law is not None:
        from replays.studies.common.law_scene import add_law_scene

        if not scenes:
            raise InputError("--law", "given with --scenes", str(law))
        name = add_law_scene(law)
        only = only and ",".join(name if part == "law" else part for part in split_names(only, "--only"))
    names = select_engines(engines)
    if scenes:
        _twelve(only, None if engines is None else names, output, form)
        return
    if random is not None:
        _sweep(random, seed, only, names, output, form)
        return
    trials = select_trials(only)
    cells: list[Cell] = []
    pictures: list[Path] = []
    with reporting(compiles=True) as reporter:
        for cell in run_trials(trials, names, quick=not full):
            cells.append(cell)
            reporter.step(f"{cell.trial} {cell.case}, {cell.method}")
        if output is not None:
            from replays.studies.stability.maps.figure import draw_all

            reporter.show_activity("pictures")
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


def _sweep(count: int, seed: int, only: str | None, engines: list[str], folder: Path | None, form: Form) -> None:
    from replays.studies.stability.scenes.sweep import select_numbers, summary, sweep

    numbers, rows, interrupted = select_numbers(only, count), [], False
    with reporting() as reporter:
        reporter.begin(len(numbers))
        try:
            for row in sweep(numbers, seed=seed, engines=engines, folder=folder):
                rows.append(row)
                reporter.step(f"scene {row['number']}: {row['status']}")
        except KeyboardInterrupt:
            interrupted = True
    result = summary(rows, engines)
    pictures: list[Path] = []
    if folder is not None and result["scenes"]["decided"]:
        from replays.studies.stability.scenes.sweep_figure import draw_sweep

        pictures = draw_sweep(folder, rows, engines)
    if form.as_json:
        echo_json({"seed": seed, **result, "pictures": [str(path) for path in pictures]})
    else:
        console = form.console()
        console.print(sweep_table(result, seed))
        for line in _sweep_lines(result):
            echo(line)
        for path in pictures:
            echo(f"picture  {path}")
    if interrupted:
        echo("stopped; run the same command with the same -o FOLDER to continue", err=True)
        raise typer.Exit(130)
    own = result["engines"][engines[0]]
    if any(own[kind] for kind in ("silent", "crashes", "hangs", "absurd")):
        raise typer.Exit(1)


def _twelve(only: str | None, engines: list[str] | None, folder: Path | None, form: Form) -> None:
    from replays.studies.common.journal import prepare_folder
    from replays.studies.stability.scenes.scene_atlas import (
        OUTCOMES,
        SceneOutcome,
        draw_scene_atlas,
        is_silent,
        outcomes,
        select_scenes,
    )

    names, runs, interrupted = select_scenes(only), list[SceneOutcome](), False
    if folder is not None:
        prepare_folder(folder)
    with reporting(compiles=True) as reporter:
        try:
            for outcome in outcomes(names, engines, peers=engines is None):
                runs.append(outcome)
                reporter.step(f"{outcome.scene}, {outcome.method} {outcome.setting}: {outcome.kind}")
        except KeyboardInterrupt:
            interrupted = True
    pictures = [] if folder is None or interrupted else draw_scene_atlas(folder, runs)
    if form.as_json:
        echo_json({"outcomes": [outcome.document() for outcome in runs], "pictures": [str(path) for path in pictures]})
    else:
        form.console().print(scenes_table(runs))
        echo("\n" + "\n".join(f"{kind}: {text.removeprefix(f'{kind}: ')}" for kind, (_, text) in OUTCOMES.items()))
        for path in pictures:
            echo(f"picture  {path}")
    if interrupted:
        echo("stopped; only the runs shown were measured, and no picture was drawn", err=True)
        raise typer.Exit(130)
    if any(is_silent(outcome) for outcome in runs if outcome.method == runs[0].method):
        raise typer.Exit(1)


def scenes_table(outcomes: list[SceneOutcome]) -> Table:
    """Return a table of how often each method had each outcome."""
    from replays.studies.stability.scenes.scene_atlas import OUTCOMES

    scenes = len({outcome.scene for outcome in outcomes})
    table = new_table(
        f"{scenes} scenes, each method at its settings: number of runs", "method", *(f">{k}" for k in OUTCOMES)
    )
    for method in dict.fromkeys(outcome.method for outcome in outcomes):
        kinds = [outcome.kind for outcome in outcomes if outcome.method == method]
        table.add_row(method, *(str(kinds.count(kind) or "-") for kind in OUTCOMES))
    return table


def sweep_table(sweep: dict[str, Any], seed: int) -> Table:
    """Return a table of each engine's results in random scenes."""
    from replays.studies.stability.scenes.sweep import QUANTILES

    scenes = sweep["scenes"]
    table = new_table(
        f"random scenes of seed {seed}: " + ", ".join(f"{number} {status}" for status, number in scenes.items()),
        "engine", ">told", *(f">{share:.0%}" for share in QUANTILES), ">within", ">silent", ">false", ">crash", ">hang",
        ">absurd", ">slowest", ">median",
    )  # fmt: skip
    for name, result in sweep["engines"].items():
        errors = [f"{error:.0e}" for error in result["error"] or []] or ["-"] * len(QUANTILES)
        within = "-" if result["within"] is None else f"{result['within']:.0%}"
        faults = [str(len(result[kind])) for kind in ("silent", "false_alarms", "crashes", "hangs", "absurd")]
        speeds = ["-" if speed is None else f"{speed:.3g}" for speed in (result["slowest"], result["median_speed"])]
        table.add_row(name, str(result["compared"]), *errors, within, *faults, *speeds)
    return table


def _sweep_lines(sweep: dict[str, Any]) -> Iterator[str]:
    """Yield the explanations of the table's columns, and the numbers of the affected scenes."""
    yield (
        "\nQuantiles of the scaled error in decided scenes; within: share of non-chaotic scenes with an error "
        "of at most 10 times the tolerance; silent: wrong by more than 0.1 without a warning; false: warned, and "
        "within; speeds: simulated s over processor s. Untold: scenes that fewer than two accurate engines accept; "
        "unbounded: scenes in which the model gains energy without limit; faults there do not count."
    )
    for name, result in sweep["engines"].items():
        for kind in ("silent", "false_alarms", "crashes", "hangs", "absurd"):
            if result[kind]:
                yield f"{name}, {kind.replace('_', ' ')}: scenes {', '.join(map(str, result[kind]))}"
        for reason, number in result["refused"].items():
            if "accurate" not in name:
                yield f"{name} refuses {number}: {reason}"
    for scene in sweep["undecided"]:
        odd = f", {scene['odd']} alone" if scene["odd"] else ""
        yield (
            f"undecided: scene {scene['number']}, accurate runs differ by {scene['distance']:.1e}{odd}; "
            f"a perturbation grows {scene['growth'] or math.nan:.1e} times"
        )


def _show(cells: list[Cell], names: list[str], console: Console) -> None:
    console.print(trials_table([cell for cell in cells if cell.method in names], names))
    if others := [cell for cell in cells if cell.method not in names]:
        console.print()
        console.print(peers_table(others))
    console.print(
        "\n*: fails as expected from theory or measurement (--json gives the reason); !: differs from the expectation; "
        "in brackets: no expectation; all others hold, within their limits."
    )
    for cell in cells:
        if not cell.agrees:
            console.print(
                f"! {cell.trial} {cell.case}, {cell.method}: {cell.value:.3g} {cell.unit}, limit {cell.limit:.3g}, "
                f"expected to {'hold' if cell.expected else 'fail'}: {cell.because}"
            )


def trials_table(cells: list[Cell], names: list[str]) -> Table:
    """Return a table of each engine's result in each case."""
    from rich.text import Text

    from replays.studies.stability.trials.trials import TRIALS

    table = new_table("trials by engine: measured", "trial", "case", *(f">{name}" for name in names), keys=2)
    previous_trial = ""
    for trial, case in dict.fromkeys((cell.trial, cell.case) for cell in cells):
        cells_by_method = {cell.method: cell for cell in cells if (cell.trial, cell.case) == (trial, case)}
        if trial != previous_trial:
            table.add_row(Text(f"{trial}: {TRIALS[trial].title}", "bold"))
            previous_trial = trial
        table.add_row(trial, case, *(_text(cells_by_method.get(name)) for name in names))
    return table


def peers_table(cells: list[Cell]) -> Table:
    """Return a table of the results of other solvers."""
    title = "other solvers, in cases where they are known to fail or to hold"
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
