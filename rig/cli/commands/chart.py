"""`rig chart`: speed against accuracy of our engines and other people's solvers, measured and drawn here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import Law
from rig.cli.output.progress import reporting
from rig.cli.output.tables import echo


def chart(
    *,
    quick: Annotated[bool, typer.Option("--quick", help="Few points, in about two minutes (the default).")] = False,
    full: Annotated[bool, typer.Option("--full", help="All points, within an hour.")] = False,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FOLDER", help="Folder for pictures and data.")
    ] = Path("chart"),
    only: Annotated[
        str | None, typer.Option("--only", metavar="PHASE", help="One phase: first-impacts, transient, whirl, ...")
    ] = None,
    panel: Annotated[
        list[str] | None,
        typer.Option(
            "--panel", metavar="PANEL", help="exact, smoothed, memory, rub, profile, scenes; may be repeated."
        ),
    ] = None,
    no_peers: Annotated[bool, typer.Option("--no-peers", help="Our engines only.")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Start over instead of going on where a run ended.")] = False,
    law: Law = None,
    add: Annotated[
        list[Path] | None,
        typer.Option("--add", metavar="FILE.csv", help="Add a solver by its results; may be repeated."),
    ] = None,
    problem: Annotated[
        str | None, typer.Option("--problem", metavar="PHASE", help="Write a phase's problem for a solver of yours.")
    ] = None,
    draw: Annotated[bool, typer.Option("--draw", help="Draw chart.csv of the folder again; measure nothing.")] = False,
) -> None:
    """Chart speed against error: our engines against other solvers, by phase of the motion and by contact law."""
    from replays.studies.chart.session import Progress, add_solvers, draw_again, make_chart
    from replays.studies.chart.submission import write_problem
    from replays.studies.common.law_scene import add_law_scene
    from rig.base.errors import InputError, Words

    if quick and full:
        raise InputError("--quick, --full", "one of the two", Words("both"))
    if sum((bool(add), problem is not None, any((quick, full, only, panel, no_peers, fresh, draw)))) > 1:
        raise InputError("--add or --problem", "the only option besides --output", Words("more options"))
    if problem is not None:
        echo(str(write_problem(problem, output)))
        return
    if draw:
        for path in draw_again(output, only=only, panels=panel).files:
            echo(str(path))
        return
    if law is not None:
        add_law_scene(law)
    mode = "full" if full else "quick"
    with reporting(compiles=True) as reporter:
        reporter.show("references")
        progress = Progress(begin=reporter.begin, step=reporter.step)
        if add:
            outcome = add_solvers(output, add, progress=progress)
        else:
            outcome = make_chart(
                output, mode=mode, only=only, panels=panel, peers=not no_peers, fresh=fresh,
                command="rig chart --full" if full else "rig chart", progress=progress,
            )  # fmt: skip
    if outcome.missing:
        missing = ", ".join(outcome.missing)
        echo(f"not installed: {missing} (pip install 'rotor-stator-rig[peers]'); charted without", err=True)
    if outcome.outdated:
        echo(f"{outcome.outdated} points of other code were measured anew", err=True)
    left = f", {outcome.left} left for want of time: run again to add them" if outcome.left else ""
    counts = f"{outcome.measured} points measured, {outcome.resumed} kept, {outcome.failures} failures drawn"
    echo(counts + left, err=True)
    for path in outcome.files:
        echo(str(path))
    if outcome.interrupted:
        echo("stopped; the same command goes on from here", err=True)
        raise typer.Exit(130)
